"""``palpate split``: splits that do not leak."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import tyro

from palpate.cli.importing import Reading
from palpate.cli.terminal import Common, OutPath, Switch, Terminal, guard_output
from palpate.core import atomic_folder, require, require_new_folder

Column = Literal["auto", "video", "object", "session", "contact", "domain", "sensor"]
#: Facts of the rule that are printed.
PRINTED = (
    *("name", "audit", "group", "by", "groups", "deviation", "bound", "status", "limiting"),
    *("rare", "missing"),
)


@dataclass(frozen=True, kw_only=True)
class Groups:
    """What stays together."""

    by: Annotated[tuple[Column, ...], tyro.conf.arg(metavar="COLUMN ...")] = ("auto",)
    """Columns to keep whole; samples that share any of these stay together (auto: what the data
    set names, or the coarsest known: object, session, video, contact)."""
    near: Literal["vision", "tactile", "both"] | None = None
    """Keep near-duplicate images together as well."""

    def keywords(self) -> dict[str, Any]:
        """As arguments of the split."""
        return {"by": "auto" if self.by == ("auto",) else self.by, "near": self.near}


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

    several = options.folds is not None or options.seeds is not None
    _check(options, several)
    data = list(options.paths) or None
    names = ("paths", "output", "seed", "seeds", "folds", "lists")
    make = cast("Callable[..., Any]", partial(split, data, **options.keywords(*names)))
    with terminal.progress() as progress:
        if options.folds is None:
            seeds = range(options.seed, options.seed + (options.seeds or 1))
            names = [f"seed-{seed}" for seed in seeds]
            splits = [make(seed=seed, progress=progress) for seed in seeds]
        else:
            names = [f"fold-{k}" for k in range(options.folds)]
            splits = make(seed=options.seed, folds=options.folds, progress=progress)
    for note in splits[0].notes:
        terminal.note(note)
    rows = [
        {"digest": each.digest, "counts": each.counts()}
        | {name: each.rule[name] for name in PRINTED if name in each.rule}
        for each in splits
    ]
    if not several:
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


def _check(options: Options, several: bool) -> None:
    """Reject options that exclude each other and outputs in the way, before any work.

    Raises:
        PalpateError: saying which.
    """
    seeds, folds = options.seeds, options.folds is not None
    must = "must go without --folds"
    require(not folds or seeds is None, "seeds", must, "both", fix="Choose one")
    require(seeds is None or seeds >= 1, "seeds", "must be at least 1", seeds)
    some, fix = (
        options.paths or options.noleak == "touch-and-go",
        "E.g. palpate split tag/ -o s.json",
    )
    require(bool(some), None, "A split needs samples", "no path", fix=fix)
    free = not options.noleak or (not folds and options.together == Groups())
    must, got = "A published split has its rule", "--by, --near or --folds with --noleak"
    require(free, None, must, got, fix="Leave them out, or leave out --noleak")
    if options.lists is not None:
        must, got = (
            "must go with one split of samples",
            "several splits" if several else "no samples",
        )
        one = not several and bool(options.paths)
        require(one, "lists", must, got, fix="Make the split alone")
    if several:
        must = "must be a folder, without the ending of a file, for several splits"
        plain, got = options.output.suffix != ".json", options.output.name
        require(plain, "output", must, got, fix=f"E.g. -o {options.output.stem}/")
    else:
        guard_output(options.output, options.paths)
    for folder in (options.output if several else None, options.lists):
        if folder is not None:
            require_new_folder(folder)
