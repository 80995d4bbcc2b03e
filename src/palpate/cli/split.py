"""``palpate split``: splits that do not leak."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.importing import Reading
from palpate.cli.terminal import Common, OutPath, Switch, Terminal, guard_output
from palpate.core import PalpateError, Split, atomic_folder, require, require_new_folder

Column = Literal["auto", "video", "object", "session", "contact", "domain", "sensor"]
#: Facts of the rule that are printed.
SHOWN = ("group", "by", "groups", "deviation", "bound", "status", "limiting", "rare", "missing")


@dataclass(frozen=True, kw_only=True)
class Groups:
    """What stays together."""

    by: Annotated[tuple[Column, ...], tyro.conf.arg(metavar="COLUMN ...")] = ("auto",)
    """Columns to keep whole; samples that share any of these stay together (auto: what the data
    set names, or the coarsest known: object, session, video, contact)."""
    near: Literal["vision", "tactile", "both"] | None = None
    """Keep near-duplicate images together as well."""


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Make a split in which no group is in two parts and every material keeps its share.

    The largest deviation of any material's share is minimized. The same data, options and seed give
    the same split.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """A manifest, a table, a folder, or frame lists (`video/frame.jpg,label` per line), which are
    joined."""
    output: OutPath
    """Split file to write; with --folds or --seeds a folder of them."""
    train: float = 0.8
    """Share of the train part."""
    val: float = 0.0
    """Share of the validation part; test gets the remainder."""
    seed: int = 0
    """Another seed gives another split of the same quality."""
    seeds: int | None = None
    """Make this many splits, with the seeds from --seed on."""
    folds: int | None = None
    """Make so many folds: file k tests fold k. With --val over 0, fold k + 1 validates."""
    noleak: Literal["touch-and-go", "hct"] | None = None
    """Published split of Touch and Go (without samples, over its videos), or its rule for HCT."""
    lists: Path | None = None
    """Also write the split in the data set's list format into this new folder."""
    cache: Path | None = None
    """With --near: folder that keeps decoded images, so that an interrupted run resumes."""
    skip_bad: Switch = False
    """Skip bad rows of lists and tables, and list them."""
    together: Groups = field(default_factory=Groups)
    reading: Reading = field(default_factory=Reading)


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Make and write splits."""
    from palpate.data.importing import write_lists
    from palpate.leakage import split
    from palpate.leakage.inputs import read

    _check(options)
    data = list(options.paths) or None
    by = "auto" if options.together.by == ("auto",) else options.together.by
    common: dict[str, Any] = {"by": by, "train": options.train, "val": options.val}
    common |= {"near": options.together.near, "noleak": options.noleak, "cache": options.cache}
    common |= {"reading": options.reading.options(), "skip_bad": options.skip_bad}
    with terminal.progress() as progress:
        common["progress"] = progress
        if options.folds is None:
            seeds = range(options.seed, options.seed + (options.seeds or 1))
            names = [f"seed-{seed}" for seed in seeds]
            splits = [split(data, seed=seed, **common) for seed in seeds]
        else:
            names = [f"fold-{k}" for k in range(options.folds)]
            splits = split(data, seed=options.seed, folds=options.folds, **common)
    for note in splits[0].notes:
        terminal.note(note)
    rows = [_facts(s) for s in splits]
    if not _several(options):
        splits[0].save(options.output)
        terminal.facts(f"Split {options.output}", rows[0])
        files: list[str] = []
        if options.lists is not None:
            listed = read(data, options.skip_bad).manifest
            with atomic_folder(options.lists) as folder:
                files = [path.name for path in write_lists(listed, splits[0], folder)]
        return rows[0] | {"lists": files, "path": str(options.output)}
    with atomic_folder(options.output) as folder:
        for name, each in zip(names, splits, strict=True):
            each.save(folder / f"{name}.json")
    for name, row in zip(names, rows, strict=True):
        terminal.print(f"{name}: {row['counts']}, deviation {row['deviation']}, {row['digest']}")
    return {"splits": rows, "path": str(options.output)}


def _several(options: Options) -> bool:
    return options.folds is not None or options.seeds is not None


def _check(options: Options) -> None:
    """Reject options that exclude each other and outputs in the way, before any work.

    Raises:
        PalpateError: saying which.
    """
    folds, several = options.folds is not None, _several(options)
    if folds and options.seeds is not None:
        raise PalpateError("must go without --folds", "both", "Choose one", argument="seeds")
    require(
        options.seeds is None or options.seeds >= 1, "seeds", "must be at least 1", options.seeds
    )
    if not options.paths and options.noleak != "touch-and-go":
        raise PalpateError(
            "A split needs samples", "no path", "E.g. palpate split tag/ -o noleak.json"
        )
    if options.noleak and (folds or options.together != Groups()):
        raise PalpateError(
            "A published split has its rule",
            "--by, --near or --folds with --noleak",
            "Leave them out, or leave out --noleak",
        )
    if options.lists is not None and (several or not options.paths):
        got = "several splits" if several else "no samples"
        raise PalpateError(
            "must go with one split of samples", got, "Make the split alone", argument="lists"
        )
    if not several:
        guard_output(options.output, options.paths, (b'"format": "palpate-',))
    for folder in (options.output if several else None, options.lists):
        if folder is not None:
            require_new_folder(folder)


def _facts(split: Split) -> dict[str, Any]:
    facts = {name: split.rule[name] for name in SHOWN if name in split.rule}
    return {"digest": split.digest, "counts": split.counts(), **facts}
