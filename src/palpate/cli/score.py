"""``palpate score``: how good are these tactile images, or their embeddings?"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OptionalOutPath, Switch, Terminal, guard_output
from palpate.core import PalpateError, is_stream

Companion = Literal[
    "fid", "kid", "cmmd", "prdc", "ssim", "psnr", "ms-ssim", "contact", "lpips", "none"
]


@dataclass(frozen=True, kw_only=True)
class Samples:
    """What the samples are called, and what belongs together."""

    names: tuple[str, ...] = ()
    """Names of the generators in the tables, instead of those of their folders and files."""
    labels: str | None = None
    """CSV or Parquet file with the columns id, material, video: instead of the inputs' own; or
    `cluster:8`, eight clusters of the reference's photos (else features) for materials."""
    group: Literal["auto", "video", "contact", "object"] = "auto"
    """What stays together in halves and intervals; `auto` takes what the split kept whole, else the
    video."""


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """What is computed, and how."""

    presets: tuple[Literal["grouped", "paper", "paper-tables", "cmmd"], ...] = ()
    """Readings of the TMMD family: `paper` is the formula to the letter, `grouped` keeps whole
    videos together. Default: both; without groups `paper`, and `grouped` for TMMD of images whose
    ids are those of the reference."""
    sigma: tuple[str, ...] = ()
    """Bandwidths: numbers, `median` (of the reference's distances), `multi` (five around it).
    Default: 10, comparable with the literature; for TMMD also `multi`, which sees more than the
    mean."""
    normalize: Literal["check", "yes", "no"] = "check"
    """Embeddings that are not of unit length: stop, divide by the norm, or keep them."""
    companions: tuple[Companion, ...] | None = None
    """Scores next to the TMMD family. Default: all whose inputs are there; `none` for none."""
    inception: Path | None = None
    """TorchScript file of Inception: FID and KID of its features, as published."""
    clip: str | None = None
    """Folder or hub id of a CLIP: CMMD of its features, as published."""
    lpips: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="BACKBONE HEADS")] = None
    """The two files of LPIPS: AlexNet's weights and the heads."""
    controls: bool = True
    """With a split: score the no-contact image and real images of the same material as well."""
    permutations: int = 999
    """Relabelings of the permutation test of TMMD; 0 for none."""
    seed: int = 0
    """Of random halves, permutations and the control images."""


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Score tactile images, or their embeddings, against real ones; one or several generators.

    With a split, its test part is scored, next to controls where the reference is a manifest.
    """

    generated: tuple[Path, ...]
    """What to score, one entry a generator: folders of images or of `palpate generate`, manifests,
    or embeddings (.npy, .npz)."""
    reference: Path
    """The real tactile images, of the same kinds. Ids are relative file names."""
    encoder: str | None = None
    """Folder of `palpate train encoder`, a hub id, or palpate/mini; the tactile encoder gives the
    features. Embeddings need none."""
    background: Path | None = None
    """One image of the sensor without contact, for all images of a folder: gives contact scores."""
    split: Path | None = None
    """Split file: its test part is scored, its train part gives the floor of TMMD, a material probe
    and the controls."""
    train: Path | None = None
    """What the generator was trained on, e.g. a folder or manifest of train images: adds how near
    its images lie to these (memorization). Of a manifest that --split knows, its train part."""
    allow_seen: Switch = False
    """Score with an encoder that was trained on some of the real images; every score says so."""
    output: OptionalOutPath = None
    """Write scores, gallery and settings as JSON, for `palpate report`."""
    latex: Path | None = None
    """Write the tables as LaTeX (booktabs)."""
    page: Path | None = None
    """Write the same as one self-contained page (.html), with .json and .md next to it."""
    cache: Path | None = None
    """Folder for embeddings and decoded images. Default: one next to -o, for a run that is
    interrupted; removed at the end."""
    samples: Samples = field(default_factory=Samples)
    metrics: Metrics = field(default_factory=Metrics)


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Score, print the tables, write JSON and LaTeX."""
    _check_outputs(options)
    from palpate.evaluation.scoring import score

    cache, metrics = _cache(options), options.metrics
    arguments: dict[str, Any] = {
        "encoder": options.encoder,
        "allow_seen": options.allow_seen,
        "split": options.split,
        "background": options.background,
        "train": options.train,
        **vars(options.samples),
        **vars(metrics),
        "names": options.samples.names or None,
        "presets": metrics.presets or None,
        "sigma": [_number_or_word(text) for text in metrics.sigma] or None,
        "normalize": {"check": "check", "yes": True, "no": False}[metrics.normalize],
        "companions": _companions(metrics.companions),
        "cache": cache,
    }
    with terminal.progress() as progress:
        results = score(list(options.generated), options.reference, progress=progress, **arguments)
    files = {"output": options.output, "page": options.page, "latex": options.latex}
    shown = terminal.deliver(results, **files)
    if cache is not None and options.cache is None:
        shutil.rmtree(cache, ignore_errors=True)
    return shown


def _check_outputs(options: Options) -> None:
    """Raise before anything is computed if an output cannot be written."""
    samples = options.samples
    given = (options.split, options.train)
    labels = Path(samples.labels) if samples.labels else None
    read = (options.reference, *given, labels, *options.generated)
    inputs = [path for path in read if path]
    if options.output:
        guard_output(options.output, inputs)
    if options.page:
        if options.page.suffix != ".html":
            raise PalpateError("must end in .html", options.page.name, "", argument="page")
        for suffix in (".html", ".json", ".md"):
            guard_output(options.page.with_suffix(suffix), inputs, (b"palpate",))
    if options.latex:
        guard_output(options.latex, inputs, (b"% palpate",))
        if options.output and options.latex.resolve() == options.output.resolve():
            got, fix = str(options.latex), "Choose another file for one of them"
            raise PalpateError("must not be the file of the results", got, fix, argument="latex")
    if options.cache and any(options.cache.resolve().is_relative_to(p.resolve()) for p in inputs):
        fix = "Choose a folder outside what is read"
        raise PalpateError("must not be an input", str(options.cache), fix, argument="cache")


def _cache(options: Options) -> Path | None:
    output = options.output or options.page or options.latex
    images = options.reference.is_dir() or options.encoder
    if options.cache or output is None or is_stream(output) or not images:
        return options.cache
    return output.absolute().parent / f".{output.name}.work"


def _companions(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
    if names is None or "none" not in names:
        return names
    if len(names) > 1:
        got = " ".join(names)
        raise PalpateError("must be none, or names", got, "Drop none", argument="companions")
    return ()


def _number_or_word(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
