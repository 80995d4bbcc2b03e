"""Presets of the demo, one row each: worlds, encoders, generator, and what a run costs."""

from __future__ import annotations

from dataclasses import dataclass, replace

from palpate.sim import PRESETS as WORLDS
from palpate.sim import WorldOptions


@dataclass(frozen=True)
class DemoPreset:
    """A complete run.

    Attributes:
        name: of the preset.
        world: the embedded data set, used where no data is given.
        pretraining: another world, of other objects, on which encoders and autoencoder are trained
            where no ready ones are taken.
        encoder, diffusion: names of the presets of those rooms.
        models: shipped models that stand for the pretrained ones: the frozen CLIP and autoencoder,
            and the tactile encoder that training goes on from; None: all are trained in the run.
        start: whether the generator goes on from that of ``models`` instead of from random weights.
        train: share of the train part.
        tactile_epochs: passes of the tactile encoder over the pretraining samples, then over the
            train part (the first are left out where it goes on from a ready one).
    """

    name: str
    world: WorldOptions
    pretraining: WorldOptions
    encoder: str
    diffusion: str
    models: str | None = None
    start: bool = False
    train: float = 0.75
    tactile_epochs: tuple[float, float] = (5, 6)


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
_MINI_BEFORE = replace(WORLDS["pretrain"], materials=_TEN, objects_per_material=40)


PRESETS = {
    p.name: p
    for p in (
        #              name    world   pretraining                encoder diffusion
        DemoPreset("tiny", _TINY, replace(_TINY, seed=1000), "tiny", "tiny", train=0.75),
        DemoPreset(
            "mini",
            _MINI,
            _MINI_BEFORE,
            "mini",
            "mini",
            models="palpate/mini",
            start=True,
            train=0.85,
        ),
    )
}
