"""``palpate probe``: what do the embeddings of an encoder know?"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, Files, OptionalOutPath, Switch, Terminal
from palpate.cli.training import Computing
from palpate.core import require


@dataclass(frozen=True, kw_only=True)
class Probing:
    """What is predicted, and what counts as right."""

    modality: Literal["tactile", "vision"] = "tactile"
    """Whose encoder."""
    label: tuple[str, ...] = ("material",)
    """Columns to predict."""
    group: Literal["auto", "object", "session", "video", "contact", "frame"] = "auto"
    """What stays together in cross-validation and intervals, as in `palpate score`: `auto` takes
    the coarsest of eight units or more, from what the split kept whole on; `frame`: no two images
    are of one recording."""
    top: tuple[int, ...] = (1, 5, 10)
    """Ranks within which retrieval must find a right key."""
    pool: int | None = None
    """Rank among so many test samples drawn at random. Default: all; of several splits as many as
    the smallest test part has."""
    text_threshold: float = 0.6356
    """Cosine from which another text counts as right, next to strict retrieval; the default is
    TVL's."""
    seed: int = 0
    """Of the folds of the cross-validation, pools and the queries on the page."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """Train an encoder on each split, in place of `--encoder`, and print what the first split is
    worth over the others.
    """

    train: Switch = False
    """Train and score one encoder for each split and seed. Run again to resume."""
    preset: str = "mini"
    """As in `palpate train encoder`."""
    clip: str | None = None
    """As in `palpate train encoder`."""
    epochs: float | None = None
    """Default: the preset's."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One training each; intervals are over videos and seeds."""
    work: Path = Path("runs/probe")
    """Folder of the trained encoders and caches, kept for the next run."""


@dataclass(frozen=True, kw_only=True)
class Machine(Computing):
    """How to train on the machine at hand, as in `palpate train encoder`."""

    chunk: int | None = None
    """Rows that the encoder sees at a time; the loss is that of the whole batch."""


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Score what an encoder's embeddings know: classes, by a linear probe and k-NN fitted to the
    train part, and which text and image belong to a sample, by retrieval within the test part.

    Several encoders, or several splits, are compared with paired differences.
    """

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file, the folder of an import, or a folder of palpate embed."""
    split: Annotated[tuple[Path, ...], tyro.conf.arg(aliases=["--splits"])]
    """Split files; their order is that of the differences: `--splits orig.json noleak.json`."""
    encoder: tuple[str, ...] = ()
    """Folders of `palpate train encoder`, hub ids, palpate/mini or palpate/handcrafted."""
    against: str | None = None
    """Another encoder, to choose between the two: adds how often TMMD by each tells two classes
    apart with 5, 10, 20 and 40 test recordings a side."""
    allow_seen: Switch = False
    """Probe an encoder that was trained on some of the test images; every score says so."""
    output: OptionalOutPath = None
    """Write the results as JSON, for `palpate report`, or as a page (.html)."""
    cache: Path | None = None
    """Folder for embeddings, which an interrupted run finds again."""
    probing: Probing = field(default_factory=Probing)
    training: Training = field(default_factory=Training)
    machine: Machine = field(default_factory=Machine)


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Probe, print the scores, write JSON or a page."""
    training, output = options.training, options.output
    from palpate.data.slices import is_parted

    got, fix = "both" if training.train else "neither", "E.g. --encoder palpate/mini"
    must, chosen = "Either an encoder or training must be chosen", bool(options.encoder)
    chosen |= is_parted(options.manifest)
    require(chosen != training.train, None, must, got, fix=fix)
    must = "must go with an encoder"
    fix = "Drop it"
    require(options.against is None or not training.train, "against", must, "training", fix=fix)
    is_page = output is not None and output.suffix == ".html"
    files = Files(page=output) if is_page else Files(output=output)
    files.guard([options.manifest, *options.split])
    one_or_all = lambda values: values[0] if len(values) == 1 else list(values)
    with terminal.progress() as progress:
        if training.train:
            from palpate.studies.split_study import compare_splits

            results = compare_splits(
                options.manifest,
                list(options.split),
                preset=training.preset,
                clip=training.clip,
                epochs=training.epochs,
                seeds=training.seeds,
                work=training.work,
                device=options.machine.device,
                compute=options.machine.compute,
                print_line=terminal.print_line,
                progress=progress,
                **vars(options.probing),
            )
        else:
            from palpate.evaluation.probing import probe

            results = probe(
                options.manifest,
                one_or_all(options.split),
                encoder=one_or_all(options.encoder) if options.encoder else None,
                against=options.against,
                cache=options.cache,
                allow_seen=options.allow_seen,
                progress=progress,
                **vars(options.probing),
            )
    report = terminal.deliver(results, files)
    for fact in results.facts:
        terminal.print(fact)
    return report
