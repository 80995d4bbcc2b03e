"""``palpate generate``: tactile images for photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, guard_output, require_extra
from palpate.core import PalpateError, Problem, ProblemsError


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Make a tactile image for each photo, or for each sample of a part of a data set. Run again to go on."""

    photos: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Photos, or one folder of them."""
    output: OutPath
    """A .png for one photo; else a folder for images/ and index.json."""
    model: str = "palpate/mini"
    """Folder of `palpate train`, hub id, or the generator that ships with palpate, which knows a synthetic world alone."""
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
    """Generates and prints where the images are, and what the generator cannot know."""
    require_extra("palpate generate")
    single = _check(options)
    terminal.say(f"Loading {options.model} ...")  # torch and its friends take seconds to import
    from palpate.core import Split
    from palpate.data.manifest import Manifest
    from palpate.diffusion.pipeline import Pipeline
    from palpate.encoders.towers import pick_device
    from palpate.generate import generate, generate_one

    manifest = None if options.manifest is None else Manifest.load(options.manifest)
    if manifest is not None and options.split is not None:
        manifest = manifest.part(Split.load(options.split), options.part)
    pipeline = Pipeline.load(options.model).to(pick_device(options.device))
    sampling: dict[str, Any] = {"seed": options.seed, "guidance": options.guidance, "steps": options.steps}
    skipped: Sequence[Problem] = ()
    if single:
        new = generate_one(pipeline, options.photos[0], options.output, **sampling)
        facts: dict[str, Any] = {"image": str(options.output), "images": 1, "made_now": int(new)}
    else:
        photos = None if manifest is not None else options.photos[0] if len(options.photos) == 1 else list(options.photos)
        with terminal.progress() as progress:
            made = generate(
                pipeline, out=options.output, manifest=manifest, photos=photos, batch=options.batch, skip_bad=options.skip_bad,
                progress=progress, **sampling,
            )  # fmt: skip
        skipped = made.skipped
        facts = {"folder": str(options.output), "images": len(made.ids), "made_now": made.made}
    facts |= {"skipped": len(skipped), "model": options.model, "pipeline": pipeline.digest, "notice": pipeline.notice or None}
    terminal.facts(f"Touch{'' if single else 'es'} {options.output}", facts)
    terminal.skipped(skipped)
    return facts | {"skipped": [asdict(p) for p in skipped]}


def _check(options: Options) -> bool:
    """Refuses what cannot work before anything large is imported; returns whether one PNG is asked for."""
    if bool(options.photos) == (options.manifest is not None):
        given = "both" if options.photos else "neither"
        raise PalpateError("Generating takes photos or --manifest", given, "E.g. palpate generate photo.jpg -o touch.png")
    from palpate.data.images import SUFFIXES

    if not options.skip_bad and (missing := [p for p in options.photos if not p.exists()]):
        problems = [Problem(str(p), "missing-file", "no such file or folder") for p in missing]
        raise ProblemsError(problems, "Check the names, or pass --skip-bad")
    suffix = options.output.suffix.lower()
    if suffix not in SUFFIXES:
        return False
    if options.output.is_dir():
        must = f"-o with {options.output.suffix} takes the touch of one photo, as a file"
        raise PalpateError(must, f"the folder {options.output}", "Choose another name; a folder's must not end like a picture's")
    if suffix != ".png":
        raise PalpateError("A touch is written as PNG, which loses nothing", f"-o {options.output}", f"E.g. -o {options.output.stem}.png")
    if len(options.photos) != 1 or options.photos[0].is_dir():
        got = "a manifest" if options.manifest else "a folder" if len(options.photos) == 1 else f"{len(options.photos)} photos"
        raise PalpateError("-o with .png takes the touch of one photo", got, f"Name a folder, e.g. -o {options.output.stem}/")
    _require_whole(options.photos[0])  # a second now, instead of after the model is loaded
    # Every touch bears this mark near its head: an earlier one may be replaced, a photo may not.
    guard_output(options.output, options.photos, (b"palpate.settings",))
    return True


def _require_whole(photo: Path) -> None:
    """Refuses a photo that cannot be decoded."""
    from palpate.data.images import read_image

    try:
        read_image(photo)
    except PalpateError as error:
        raise ProblemsError([Problem(str(photo), "bad-image", error.got)], "Choose another photo, or mend this one") from None
