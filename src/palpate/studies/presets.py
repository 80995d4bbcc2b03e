"""Presets of the demo, one row each: world, encoder and generator."""

from __future__ import annotations

from dataclasses import dataclass, replace

from palpate.diffusion.presets import MINI, DiffusionPreset
from palpate.encoders.presets import PRESETS as ENCODERS
from palpate.encoders.presets import EncoderPreset
from palpate.sim import PRESETS as WORLDS
from palpate.sim import WorldOptions


@dataclass(frozen=True)
class DemoPreset:
    """A complete run.

    Attributes:
        name: of the preset.
        world: the embedded data set, used where no data is given.
        encoder, diffusion: how the training of the shipped models goes on.
        train: share of the train part.
        tactile_epochs: passes of the tactile encoder over the train part.
    """

    name: str
    world: WorldOptions
    encoder: EncoderPreset
    diffusion: DiffusionPreset
    train: float
    tactile_epochs: float


#: Materials that feel different: with all twenty, minutes of training stay close to chance.
_FIVE = ("Wood", "Brick", "Tile", "Leather", "Synthetic Fabric")
_TEN = (*_FIVE, "Rubber", "Tree", "Grass", "Gravel", "Sand")
_TINY = replace(WORLDS["tiny"], objects_per_material=4, contacts_per_video=2, frames_per_contact=2)
_MINI = replace(
    WORLDS["demo"],
    materials=_TEN,
    objects_per_material=24,
    contacts_per_video=3,
    frames_per_contact=2,
    free_written="background",
)
PRESETS = {
    preset.name: preset
    for preset in (
        DemoPreset(
            "tiny",  # for tests
            _TINY,
            ENCODERS["mini"],
            replace(
                MINI,
                loop=replace(MINI.loop, steps=4, batch=8),
                sampler=replace(MINI.sampler, steps=2),
            ),
            train=0.75,
            tactile_epochs=0.5,
        ),
        DemoPreset("mini", _MINI, ENCODERS["mini"], MINI, train=0.85, tactile_epochs=6),
    )
}
