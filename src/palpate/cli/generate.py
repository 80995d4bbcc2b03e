"""``palpate generate``: tactile images for photos or a text."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from palpate.cli.terminal import Common, OutPath, PathArguments, Switch, Terminal, option_group
from palpate.core import plain, problem_lines


@option_group
class Options(Common):
    """Make a tactile image for each photo or sample of a data set, or for a text, or a video of a
    touch for one of a surface. Run again to continue.
    """

    photos: PathArguments = ()
    """Photos, a folder of them, or a manifest (its file or the folder of an import)."""
    output: OutPath
    """A .png for one photo, an .mp4 for a video; else a folder for images/ and index.json."""
    text: str | None = None
    """What is felt, e.g. "rough, porous stone"; alone, or next to photos for all of them."""
    weight: float | None = None
    """With photos and a text: how much the photo counts, in [0, 1]; the text has the rest (default:
    0.5)."""
    gel: Path | None = None
    """Picture of your sensor's gel without contact; the images are made on it (default: the
    no-contact image of each sample, else the model's stock gel, a typical one)."""
    at: tuple[float, float] | None = None
    """Where the contact is, in shares of the gel's width and height from the top left. What is not
    asked for, of this and the next, is as in some touch of training, by the seed."""
    area: float | None = None
    """Share of the gel in contact."""
    strength: float | None = None
    """How strong the contact is, from 0 to 1: its quantile among those of training."""
    shear: tuple[float, float] | None = None
    """How far the gel's markers are dragged right and down, in % of its width."""
    force: float | None = None
    """In newtons, in place of a strength, for a model that learned from forces."""
    depth: float | None = None
    """In mm, in place of a strength, for a model that learned from depths."""
    profile: Path | None = None
    """With a video: table of time_s, strength, shear_x, shear_y (default: the touches of the
    gelsight.mp4 beside it)."""
    like: Path | None = None
    """Folder of images or of a data set: store the images in its formats, with its JPEG tables
    (default: PNG)."""
    model: str = "palpate/mini"
    """Folder of `palpate train generator`, hub id, or palpate/mini (which knows a synthetic world
    alone; on real photos it was at chance)."""
    split: Path | None = None
    """With a manifest: take one part of this split (default: all samples)."""
    part: Literal["train", "val", "test"] = "test"
    """Which part of the split."""
    seed: int = 0
    """Of the noise; an image depends on the seed and the id of its sample alone."""
    guidance: float | None = None
    """How strongly the condition is followed: the scale of classifier-free guidance (default: the
    model's; 1 is none)."""
    steps: int | None = None
    """Denoising steps (default: the model's)."""
    batch: int | None = None
    """Images at a time; the images do not depend on it."""
    skip_bad: Switch = False
    """Skip unreadable photos and list them."""
    strict: Switch = False
    """Refuse photos and texts that are unlike 95 % of those of the training, and words that no text
    of it has."""
    dry_run: Switch = False
    """Write nothing; print how many images are missing, and how many passes through the network
    they take."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""
    slice: str | None = None
    """Make slice i/n alone, whole recordings, in a folder of its own below the output."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Generate and print where the images are, and what the generator cannot know."""
    from palpate.diffusion.generation import generate

    photos: Any = (options.photos[0] if len(options.photos) == 1 else options.photos) or None
    images = terminal.run(generate, photos, **options.keywords("photos"))
    for note in images.notes:
        terminal.note(note)
    if options.dry_run:
        terminal.print(
            f"{images.missing:,} images to make, {images.evaluations:,} passes through the network"
        )
        return {"missing": images.missing, "evaluations": images.evaluations}
    facts: dict[str, Any] = {
        "image" if images.folder is None else "folder": str(options.output),
        "images": len(images.files),
        "made_now": images.new,
        "skipped": len(images.skipped),
        "most_unlike": max(images.unlike.values(), default=None),
        "model": options.model,
        "pipeline": images.settings["pipeline"],
        "notice": images.notice or None,
    }
    terminal.facts(f"Tactile images {options.output}", facts)
    if images.skipped:
        terminal.print_line(f"Skipped {len(images.skipped)}:")
        for line in problem_lines(images.skipped):
            terminal.print_line(line)
    notes = plain(images.notes)
    return facts | {"skipped": [asdict(p) for p in images.skipped], "notes": notes}
