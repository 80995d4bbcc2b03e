"""``palpate split``: splits that do not leak, and the check of an existing one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.importing import Reading
from palpate.cli.terminal import (
    FAILED_CHECK,
    Common,
    OptionalOutPath,
    Switch,
    Terminal,
    guard_output,
)
from palpate.core import PalpateError, Split, atomic_folder, require, require_new_folder, write_json

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
    nulls: Literal["raise", "single"] = "raise"
    """Samples without a value in a --by column: an error, or each a group by itself."""


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Make a split in which no group is in two parts and every material keeps its share.

    The largest deviation of any material's share is minimized. The same data, options and seed give
    the same split.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """A manifest, a table, a folder, or frame lists (`video/frame.jpg,label` per line), which are
    joined."""
    output: OptionalOutPath = None
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
    tolerance: float = 0.0
    """How far the largest deviation may be above the smallest possible, for more varied splits."""
    noleak: Literal["touch-and-go", "hct"] | None = None
    """Published split of Touch and Go (without samples, over its videos), or its rule for HCT."""
    verify: Annotated[Path | None, tyro.conf.arg(metavar="SPLITFILE")] = None
    """Check an existing split file instead; exit status 1 if it does not hold."""
    lists: Path | None = None
    """Also write the split in the data set's list format, with SHA256SUMS, into this new folder."""
    cache: Path | None = None
    """With --near: folder that keeps decoded images, so that an interrupted run resumes."""
    skip_bad: Switch = False
    """Skip bad rows of lists and tables, and list them."""
    together: Groups = field(default_factory=Groups)
    reading: Reading = field(default_factory=Reading)


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Make and write splits, or check one."""
    from palpate.data.importing import write_summed_lists
    from palpate.leakage import split, verify
    from palpate.leakage.inputs import read

    _check(options)
    data = list(options.paths) or None
    by = "auto" if options.together.by == ("auto",) else options.together.by
    common: dict[str, Any] = {"by": by, "near": options.together.near, "cache": options.cache}
    with terminal.progress() as progress:
        common |= {"reading": options.reading.options()}
        common |= {"skip_bad": options.skip_bad, "progress": progress}
        if options.verify is not None:
            verified = verify(data, options.verify, **common)
            terminal.print(str(verified))
            if verified.audit is not None:
                terminal.show(verified.audit)
            return verified.to_json(), FAILED_CHECK if verified.failed else 0
        several = options.seeds is not None and options.folds is None
        seeds = range(options.seed, options.seed + (options.seeds or 1))
        result = split(
            data,
            train=options.train,
            val=options.val,
            seed=list(seeds) if several else options.seed,
            folds=options.folds,
            noleak=options.noleak,
            nulls=options.together.nulls,
            tolerance=options.tolerance,
            **common,
        )
    assert options.output is not None
    splits = [result] if isinstance(result, Split) else result
    for note in splits[0].notes:
        terminal.note(note)
    rows = [_facts(s) for s in splits]
    if isinstance(result, Split):
        result.save(options.output)
        terminal.facts(f"Split {options.output}", rows[0])
        files: list[str] = []
        if options.lists is not None:
            listed = read(data, options.skip_bad).manifest
            files = write_summed_lists(listed, result, options.lists)
        return rows[0] | {"lists": files, "path": str(options.output)}, 0
    names = [
        f"fold-{k}" if options.folds else f"seed-{s.rule['seed']}" for k, s in enumerate(splits)
    ]
    _write_folder(options.output, names, splits, rows)
    for name, row in zip(names, rows, strict=True):
        terminal.print(f"{name}: {row['counts']}, deviation {row['deviation']}, {row['digest']}")
    different = len({s.digest for s in splits})
    if different < len(splits):
        terminal.print_line(
            f"Note: only {different} of {len(splits)} splits differ: --tolerance 0.02 gives more"
        )
    return {"splits": rows, "different": different, "path": str(options.output)}, 0


def _check(options: Options) -> None:
    """Reject options that exclude each other and outputs in the way, before any work.

    Raises:
        PalpateError: saying which.
    """
    names = ("seeds", "folds", "noleak", "verify")
    used = [f"--{name}" for name in names if getattr(options, name) is not None]
    if len(used) > 1:
        raise PalpateError(
            "--seeds, --folds, --noleak and --verify exclude each other",
            " and ".join(used),
            "Choose one",
        )
    require(
        options.seeds is None or options.seeds >= 1, "seeds", "must be at least 1", options.seeds
    )
    if not options.paths and options.noleak != "touch-and-go":
        raise PalpateError(
            "A split needs samples", "no path", "E.g. palpate split tag/ -o noleak.json"
        )
    if options.noleak and (options.together != Groups() or options.tolerance):
        raise PalpateError(
            "A published split has its rule",
            "--by, --near, --nulls or --tolerance with --noleak",
            "Leave them out, or leave out --noleak",
        )
    if options.verify is None and options.output is None:
        raise PalpateError(
            "A split needs an output file", "no -o", "E.g. palpate split tag/ -o noleak.json"
        )
    if options.lists is not None and (used not in ([], ["--noleak"]) or not options.paths):
        raise PalpateError(
            "must go with one split of samples", used[0], "Make the split alone", argument="lists"
        )
    if options.output is not None and used not in (["--seeds"], ["--folds"]):
        guard_output(options.output, options.paths, (b'"format": "palpate-',))
    for folder in (options.output if used in (["--seeds"], ["--folds"]) else None, options.lists):
        if folder is not None:
            require_new_folder(folder)


def _facts(split: Split) -> dict[str, Any]:
    facts = {name: split.rule[name] for name in SHOWN if name in split.rule}
    return {"digest": split.digest, "counts": split.counts(), **facts}


def _write_folder(
    output: Path, names: Sequence[str], splits: Sequence[Split], rows: Sequence[dict[str, Any]]
) -> None:
    """A file for each split, and ``splits.json`` with what was achieved."""
    listed = [{"file": f"{name}.json", **row} for name, row in zip(names, rows, strict=True)]
    with atomic_folder(output) as folder:
        for name, split in zip(names, splits, strict=True):
            split.save(folder / f"{name}.json")
        facts = {"format": "palpate-splits/1", "manifest": splits[0].manifest, "splits": listed}
        write_json(folder / "splits.json", facts)
