"""``palpate score``: how good are these tactile images, or their embeddings?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, Files, OptionalOutPath, Switch, Terminal, working_folder
from palpate.core import require
from palpate.evaluation.names import Name

#: What the word of an option means.
NORMALIZE = {"check": "check", "yes": True, "no": False}
Companion = Literal[Name, "none"]


@dataclass(frozen=True, kw_only=True)
class Samples:
    """What belongs together."""

    labels: str | None = None
    """CSV or Parquet file with the columns id, material, video: instead of the inputs' own; or for
    materials `cluster:8`, eight clusters of the reference's photos (else features)."""
    group: Literal["auto", "object", "session", "video", "contact", "frame"] = "auto"
    """What stays together in halves, intervals and tests; `frame`: no two images are of one
    recording. `auto` takes what columns or names show: the coarsest that has eight recordings or
    more, or that the two sides do not share."""


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """What is computed, and how."""

    presets: tuple[Literal["grouped", "paper", "paper-tables", "cmmd"], ...] = ()
    """Readings of TMMD, I-TMMD, CI-TMMD and D-TMMD: `paper` is the formula to the letter, `grouped`
    keeps whole videos together. Default: both; without groups `paper`, and `grouped` for TMMD of
    images whose ids are those of the reference."""
    sigma: Annotated[
        tuple[float | Literal["median", "multi"], ...],
        tyro.conf.arg(metavar="NUMBER|median|multi ..."),
    ] = ()
    """Bandwidths: numbers, `median` (of the reference's distances), `multi` (five around it).
    Default: 10, comparable with the literature; for TMMD also `multi`, which sees more than the
    mean."""
    normalize: Literal["check", "yes", "no"] = "check"
    """Embeddings that are not of unit length: stop, divide by the norm, or keep them."""
    companions: tuple[Companion, ...] | None = None
    """Further metrics. Default: all whose inputs are there but `mind` and `vendi`; `none`."""
    inception: Path | None = None
    """TorchScript file of Inception: FID and KID of its features, as published."""
    trust_torchscript: Switch = False
    """Run the code in that file: a program, which runs with your rights and can write files."""
    clip: str | None = None
    """Folder or hub id of a CLIP: CMMD of its features, as published."""
    dinov2: str | None = None
    """Folder or hub id of a DINOv2: FD-DINOv2, as published."""
    lpips: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="BACKBONE HEADS")] = None
    """The two files of LPIPS: AlexNet's weights and the heads."""
    permutations: int = 999
    """Relabelings of the permutation test of TMMD; 0 for none."""


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Score tactile images, or their embeddings, against real ones; one or several generators.

    With a split, its test part is scored, next to controls where the reference is a manifest.
    """

    generated: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME=]PATH ...")]
    """What to score, one entry a generator: folders of images or of `palpate generate`, tables,
    manifests or embeddings (.npy, .npz). In the results a generator has its NAME, else that of its
    path."""
    reference: Path
    """The real tactile images, of the same kinds. Ids are relative file names."""
    encoder: str | None = None
    """Folder of `palpate train encoder`, a hub id, palpate/mini or palpate/handcrafted; the tactile
    encoder gives the features. Embeddings need none."""
    check_ruler: Switch = False
    """Add TMMD by palpate/handcrafted, which nobody trained: a second opinion on what the encoder
    sees."""
    background: Path | None = None
    """One image of the sensor without contact, for all images of a folder: gives contact scores,
    and rulers what they subtract."""
    split: Path | None = None
    """Split file: its test part is scored, its train part gives the floor of TMMD, a material probe
    and the controls."""
    train: Path | None = None
    """What the generator was trained on, e.g. a folder or manifest of train images: adds how near
    its images lie to these (memorization). Of a manifest that --split knows, its train part."""
    allow_seen: Switch = False
    """Score with an encoder that was trained on some of the real images; every score says so."""
    as_is: Switch = False
    """Compare images as they are stored. Default: where sides differ (PNG, JPEG), after the same
    lossy storage, with both values where it matters."""
    cache: Path | None = None
    """Folder for embeddings and decoded images. Default: one next to -o, for a run that is
    interrupted; removed at the end."""
    output: OptionalOutPath = None
    """The results as JSON, for `palpate report`."""
    page: Path | None = None
    """The same as one self-contained page (.html), with .json and .md next to it."""
    samples: Samples = field(default_factory=Samples)
    metrics: Metrics = field(default_factory=Metrics)


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Score, print the tables, write JSON and a page."""
    files, labels = Files(output=options.output, page=options.page), options.samples.labels
    generated, names = named_paths(options.generated)
    paths = (options.reference, options.split, options.train, labels and Path(labels))
    inputs = [path for path in (*paths, *generated) if path]
    files.guard(inputs)
    if (cache := options.cache) is not None:
        must, fix = "must not be an input", "Choose a folder outside what is read"
        apart = not any(cache.resolve().is_relative_to(path.resolve()) for path in inputs)
        require(apart, "cache", must, str(cache), fix=fix)
    for path in generated:  # before what takes seconds to import
        must, got = "What is scored must exist", f"nothing at {path}"
        require(path.exists(), None, must, got, fix="Check the path")
    companions = options.metrics.companions
    alone = companions is None or "none" not in companions or len(companions) == 1
    require(alone, "companions", "must be none, or names", " ".join(companions or ()))
    from palpate.data.slices import is_parted
    from palpate.evaluation.scoring import score

    output = files.output or files.page
    has_images = options.encoder or (
        options.reference.is_dir() and not is_parted(options.reference)
    )
    with working_folder(cache, output if has_images else None) as folder:
        with terminal.progress() as progress:
            results = score(
                generated,
                options.reference,
                names=names,
                progress=progress,
                **options.keywords(
                    *("generated", "reference", "output", "page"),
                    companions=() if companions == ("none",) else companions,
                    normalize=NORMALIZE[options.metrics.normalize],
                    cache=folder,
                ),
            )
        return terminal.deliver(results, files)


def named_paths(values: Sequence[str]) -> tuple[list[Path], list[str] | None]:
    """``[NAME=]PATH`` of generators: their paths, and their names if any has one.

    A path that exists is one, whatever is in it.
    """
    parts = [("", "", v) if Path(v).exists() else v.rpartition("=") for v in values]
    paths = [Path(path) for *_, path in parts]
    names = [name or path.stem for (name, *_), path in zip(parts, paths, strict=True)]
    return paths, names if any(equals for _, equals, _ in parts) else None
