"""``palpate generate``: tactile images for photos."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, require_extra
from palpate.core import PalpateError


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Make a tactile image for each photo, or for each sample of a part of a data set. Run again to go on."""

    model: Annotated[Path, tyro.conf.Positional]
    """Folder of `palpate train`."""
    output: OutPath
    """Folder for images/ and index.json."""
    photos: tuple[Path, ...] = ()
    """Photos, or one folder of them."""
    manifest: Path | None = None
    """Instead of photos: manifest file or the folder of an import."""
    split: Path | None = None
    """With --manifest: take one part of this split (default: all samples)."""
    part: Literal["train", "val", "test"] = "test"
    """Which part of the split."""
    seed: int = 0
    """Of the noise; an image depends on the seed and its id alone."""
    guidance: float | None = None
    """Scale of classifier-free guidance (default: the preset's; 1 is none)."""
    steps: int | None = None
    """Sampling steps (default: the preset's)."""
    batch: int | None = None
    """Images at a time; the images do not depend on it."""
    skip_bad: bool = False
    """Leave out unreadable photos and list them, instead of refusing."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Generates and prints where the images are."""
    require_extra("palpate generate")
    if bool(options.photos) == (options.manifest is not None):
        given = "both" if options.photos else "neither"
        raise PalpateError("Generating takes --photos or --manifest", given, "E.g. palpate generate model/ --photos photo.jpg -o out/")
    from palpate.core import Split
    from palpate.data.manifest import Manifest
    from palpate.diffusion.pipeline import Pipeline
    from palpate.encoders.towers import pick_device
    from palpate.generate import generate

    pipeline = Pipeline.load(options.model).to(pick_device(options.device))
    manifest = None if options.manifest is None else Manifest.load(options.manifest)
    if manifest is not None and options.split is not None:
        manifest = manifest.part(Split.load(options.split), options.part)
    photos = None if manifest is not None else options.photos[0] if len(options.photos) == 1 else list(options.photos)
    with terminal.progress() as progress:
        made = generate(
            pipeline, out=options.output, manifest=manifest, photos=photos, seed=options.seed, guidance=options.guidance, steps=options.steps,
            batch=options.batch, skip_bad=options.skip_bad, progress=progress,
        )  # fmt: skip
    facts = {
        "folder": str(options.output),
        "images": len(made.ids),
        "made_now": made.made,
        "skipped": len(made.skipped),
        "pipeline": pipeline.digest,
    }
    terminal.facts(f"Touches {options.output}", facts)
    terminal.skipped(made.skipped)
    return facts | {"skipped": [asdict(p) for p in made.skipped]}
