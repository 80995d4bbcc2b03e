"""``palpate generate``: tactile images for photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, guard_output, require_extra
from palpate.core import PalpateError, Problem, ProblemsError

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest


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
    manifest = _manifest(options)
    terminal.say(f"Loading {options.model} ...")  # torch and its friends take seconds to import
    from palpate.diffusion.generate import generate, generate_one
    from palpate.diffusion.pipeline import TactilePipeline
    from palpate.encoders.encoder_set import pick_device

    device = pick_device(options.device)
    pipeline = TactilePipeline.load(options.model).to(device)
    sampling: dict[str, Any] = {
        "seed": options.seed,
        "guidance": options.guidance,
        "steps": options.steps,
    }
    skipped: Sequence[Problem] = ()
    if single:
        new = generate_one(pipeline, options.photos[0], options.output, **sampling)
        facts: dict[str, Any] = {"image": str(options.output), "images": 1, "made_now": int(new)}
    else:
        photos = None if manifest is not None else _photos(options)
        with terminal.progress() as progress:
            made = generate(
                pipeline,
                out=options.output,
                manifest=manifest,
                photos=photos,
                batch=options.batch,
                skip_bad=options.skip_bad,
                progress=progress,
                **sampling,
            )
        skipped = made.skipped
        facts = {"folder": str(options.output), "images": len(made.ids), "made_now": made.made}
    facts |= {
        "skipped": len(skipped),
        "model": options.model,
        "pipeline": pipeline.digest,
        "notice": pipeline.notice or None,
    }
    terminal.facts(f"Touch{'' if single else 'es'} {options.output}", facts)
    terminal.skipped(skipped)
    return facts | {"skipped": [asdict(p) for p in skipped]}


def _check(options: Options) -> bool:
    """Refuses what cannot work before anything large is imported; returns whether one PNG is asked for."""
    if bool(options.photos) == (options.manifest is not None):
        given = "both" if options.photos else "neither"
        raise PalpateError(
            "Generating takes photos or --manifest",
            given,
            "E.g. palpate generate photo.jpg -o touch.png",
        )
    if not options.skip_bad and (missing := [p for p in options.photos if not p.exists()]):
        problems = [Problem(str(p), "missing-file", "no such file or folder") for p in missing]
        raise ProblemsError(problems, "Check the names, or pass --skip-bad")
    single = _check_output(options)
    _check_model(options)
    from palpate.data.photos import photo_ids, require_readable

    if single:
        require_readable(options.photos[0], "Choose another photo, or mend this one")
    elif options.photos and options.skip_bad:
        photo_ids(_photos(options))
    elif options.photos:
        require_readable(_photos(options))
    return single


def _check_output(options: Options) -> bool:
    """Refuses an output that cannot be written or must not be; returns whether one PNG is asked for."""
    from palpate.data.images import SUFFIXES
    from palpate.diffusion.generate import require_place

    suffix = options.output.suffix.lower()
    if suffix not in SUFFIXES:
        require_place(options.output)
        return False
    if options.output.is_dir():
        must = f"-o with {options.output.suffix} takes the touch of one photo, as a file"
        raise PalpateError(
            must,
            f"the folder {options.output}",
            "Choose another name; a folder's must not end like a picture's",
        )
    if suffix != ".png":
        raise PalpateError(
            "A touch is written as PNG, which loses nothing",
            f"-o {options.output}",
            f"E.g. -o {options.output.stem}.png",
        )
    if len(options.photos) != 1 or options.photos[0].is_dir():
        got = (
            "a manifest"
            if options.manifest
            else "a folder"
            if len(options.photos) == 1
            else f"{len(options.photos)} photos"
        )
        raise PalpateError(
            "-o with .png takes the touch of one photo",
            got,
            f"Name a folder, e.g. -o {options.output.stem}/",
        )
    # Every touch bears this mark near its head: an earlier one may be replaced, a photo may not.
    guard_output(options.output, options.photos, (b"palpate.settings",))
    return True


def _check_model(options: Options) -> None:
    """Refuses a device by its name, and a model and settings of sampling by the model's card; one on the hub is not asked for here."""
    from palpate.core.shipped import is_hub_id
    from palpate.diffusion.card import require_sampler
    from palpate.training.device import require_device_name

    require_device_name(options.device)
    if not is_hub_id(options.model):
        from palpate.encoders.hub import find_model

        folder = find_model(options.model, "generator", "pipeline", "Make one with: palpate train")
        require_sampler(folder, guidance=options.guidance, steps=options.steps, batch=options.batch)


def _photos(options: Options) -> Path | list[Path]:
    """One photo or folder, or several photos."""
    return options.photos[0] if len(options.photos) == 1 else list(options.photos)


def _manifest(options: Options) -> Manifest | None:
    """The samples that are asked for, if they are those of a manifest."""
    from palpate.core import Split
    from palpate.data.manifest import Manifest

    if options.manifest is None:
        return None
    manifest = Manifest.load(options.manifest)
    return (
        manifest
        if options.split is None
        else manifest.part(Split.load(options.split), options.part)
    )
