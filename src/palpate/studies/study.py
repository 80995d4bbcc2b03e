"""Studies as typed objects: on what data, with which methods, controls and metrics, how large.

A study is one entry of :data:`STUDIES`. The data are the embedded world (``world`` names the
options that differ), or a data set on disk that ``read`` imports from ``--root``. Everything else
about the size of a run is its :class:`Preset`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from palpate.core import Progress
from palpate.data.importing import import_dataset
from palpate.diffusion.options import AutoencoderOptions, BackgroundOptions, UNetOptions
from palpate.diffusion.presets import MINI, PAPER, DiffusionPreset
from palpate.encoders.presets import PRESETS as ENCODERS
from palpate.encoders.presets import EncoderPreset
from palpate.sim.options import WorldOptions
from palpate.sim.presets import PRESETS as WORLDS
from palpate.studies.controls import CONTROLS
from palpate.studies.methods import METHODS, Make, Method, Metric
from palpate.studies.names import BEST, GVST, NOLEAK, OURS, SHIPPED, TEN
from palpate.training.options import Precision


@dataclass(frozen=True)
class Preset:
    """The size of a study.

    Attributes:
        name: of the preset.
        world: the embedded world, before what a study changes in it.
        encoder: the tactile encoder; one is trained for each split and seed.
        diffusion: U-Net, schedule and sampler of all methods; its condition is that of ``best``.
        steps: optimizer steps of each method.
        autoencoder: of the methods, given the no-contact image; trained on the train part.
        vq: the paper's kind of autoencoder, for the methods that are not given it: trained as well,
            or a trained one's folder, hub id or ``.ckpt``; None: it must be given.
        clip: frozen vision and text encoders: a shipped name, hub id or folder.
        precision: of the methods' training (:class:`~palpate.training.options.Compute`).
        permutations: of the permutation test of TMMD.
    """

    name: str
    world: WorldOptions
    encoder: EncoderPreset
    diffusion: DiffusionPreset
    steps: int
    autoencoder: BackgroundOptions
    vq: AutoencoderOptions | str | None
    clip: str
    precision: Precision = "float32"
    permutations: int = 999


def imported(root: Path, folder: Path, progress: Progress) -> None:
    """Import any data set that ``palpate import`` reads into ``folder``."""
    import_dataset(root, folder, overwrite=True, progress=progress)


@dataclass(frozen=True)
class Study:
    """What is run.

    Attributes:
        name: of the study.
        title: heading of its page.
        tables: the paper's tables that it makes, by number.
        world: options of the embedded world that differ from the preset's; None: data on disk.
        read: writes the imported data set; called with its root, the folder to fill, and progress.
        noleak: the published split without leaks of this data set, or its rule; None: whole videos,
            with as large a train part as the data set's own split has.
        methods: what is compared, on the split without leaks.
        on_both: names of methods that are trained on the data set's own split as well.
        controls: name -> what makes their images.
        metrics: further metrics.
        useful: names of methods whose images train classifiers, where there are materials.
        presets: sizes by name.
        paper: whether the data are those of the paper, whose numbers then stand beside ours.
    """

    name: str
    title: str
    tables: Sequence[int]
    world: Mapping[str, Any] | None = None
    read: Callable[[Path, Path, Progress], None] = imported
    noleak: Literal["touch-and-go", "hct"] | None = None
    methods: Sequence[Method] = tuple(METHODS.values())
    on_both: Sequence[str] = (OURS,)
    controls: Mapping[str, Make] = field(default_factory=lambda: dict(CONTROLS))
    metrics: Sequence[Metric] = ()
    useful: Sequence[str] = (OURS, BEST)
    presets: Mapping[str, Preset] = field(default_factory=lambda: PRESETS)
    paper: bool = False

    def trained_on(self, split: str) -> list[Method]:
        """The methods that make images for the test part of a split."""
        return [m for m in self.methods if split == NOLEAK or m.name in self.on_both]


#: The embedded world of studies, and of the demo with fewer frames; phases as in those on record.
WORLD = WorldOptions(
    materials=TEN,
    objects_per_material=24,
    contacts_per_video=3,
    free_written="background",
    phases="spaced",
)
_SMOKE_WORLD = replace(
    WORLDS["tiny"], objects_per_material=8, test=0.375, free_written="background"
)
_VQ = AutoencoderOptions(
    patch=2, widths=(32, 64), channels=4, codes=8192, steps_free=1000, steps_quantized=200
)

PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset(
            "smoke",
            _SMOKE_WORLD,
            ENCODERS["tiny"],
            replace(
                MINI,
                name="smoke",
                size=32,
                unet=UNetOptions(
                    widths=(32, 48), attention=(False, True), layers=1, head_width=16, groups=8
                ),
                condition=replace(MINI.condition, photo_size=32, photo_width=16),
                sampler=replace(MINI.sampler, steps=4),
            ),
            steps=12,
            autoencoder=BackgroundOptions(narrow=16, wide=32, steps=80, crop=0),
            vq=replace(_VQ, widths=(16, 32), codes=256, steps_free=60, steps_quantized=20, crop=0),
            clip="palpate/mini",
            permutations=99,
        ),
        Preset(
            "mini",
            WORLD,
            ENCODERS["mini"],
            MINI,
            steps=1500,
            autoencoder=BackgroundOptions(steps=1200),
            vq=_VQ,
            clip="palpate/mini",
            precision="bf16",  # 1.35 times as many steps a second with AMX, .65 without
        ),
    )
}

#: For data on disk also the paper's size, counted in docs/start/plan.md and never run to its end.
ON_DISK: Mapping[str, Preset] = {
    **PRESETS,
    "paper": Preset(
        "paper",
        WORLD,
        ENCODERS["paper"],
        PAPER,
        steps=10_500,  # 30 epochs of Touch and Go's train part in batches of 32
        autoencoder=BackgroundOptions(narrow=96, wide=192, steps=20_000, crop=128),
        vq=None,
        clip="openai/clip-vit-large-patch14",
        precision="bf16",
    ),
}

STUDIES: Mapping[str, Study] = {
    study.name: study
    for study in (
        Study(
            "world-gelsight",
            "The study on the procedural world, GelSight",
            (1, 3, 4),
            {"look": "gelsight", "layout": "frames", "leak": "contact", "seed": 71},
        ),
        Study(
            "world-digit",
            "The study on the procedural world, DIGIT",
            (2, 4),
            {"look": "digit", "layout": "frames", "leak": "frame", "seed": 72},
            # The paper has its table of all methods on Touch and Go alone.
            methods=[METHODS[n] for n in (OURS, GVST, BEST, SHIPPED)],
        ),
        Study(
            "tag",
            "The study on Touch and Go",
            (1, 3, 4),
            noleak="touch-and-go",
            presets=ON_DISK,
            paper=True,
        ),
        Study("hct", "The study on HCT", (2, 4), noleak="hct", presets=ON_DISK, paper=True),
        Study("clips", "The study on clips of Touch and Go", (1, 3, 4), presets=ON_DISK),
    )
}
