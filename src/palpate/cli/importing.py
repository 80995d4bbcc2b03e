"""``palpate import``: a data set on disk becomes a manifest; and the options that name a source, shared with ``palpate validate``."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import SHOWN_PROBLEMS, Common, OutPath, Terminal
from palpate.core import PalpateError, Problem

#: All that an import writes.
IMPORT_FILES = {"manifest.parquet", "splits", "images"}
#: Options of formats that have a flag of their own -> the flag.
FLAGS = {
    "columns": "--map",
    "root": "--root",
    "side": "--as",
    "classes": "--classes",
    "size": "--size",
    "max_per_contact": "--max-per-contact",
    "check": "--check",
    "skip_bad": "--skip-bad",
    "progress": "--quiet",
}
WORDS = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}

Maps = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(name="map", metavar="COLUMN=EXPRESSION ..."),
]
Settings = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(name="set", metavar="OPTION=VALUE ..."),
]


@dataclass(frozen=True, kw_only=True)
class SourceOptions(Common):
    """What names a source and how to read it."""

    format: str = "auto"
    """Name of the format; `auto` recognizes it. `palpate validate --list` tells all formats and their options."""
    maps: Maps = ()
    """Manifest columns as expressions over the columns of a table, an interval list or a Hugging Face data set, or over the `path`
    of images in a folder: `--map vision=rgb tactile="replace(rgb, '_rgb', '_tac')" "video=substr(rgb, 1, 15)"`."""
    root: Path | None = None
    """Where the paths of a table, or the recordings of an interval list, lie (default: the folder of the table)."""
    side: Annotated[Literal["vision", "tactile"] | None, tyro.conf.arg(name="as")] = None
    """What a single folder of images shows."""
    classes: Path | None = None
    """Table of classes (`Name: id` or `id,name` a line) for materials that are numbers; -1 is inconclusive and left out."""
    settings: Settings = ()
    """Further options of the format, e.g. `--set labels=train.txt image_format=png`; `palpate validate --list` tells them."""
    check: Literal["decode", "header", "none"] = "decode"
    """How images are checked: `decode` finds truncated files, `header` is quicker."""


@dataclass(frozen=True, kw_only=True)
class Options(SourceOptions):
    r"""Turn a data set on disk into a manifest: any known format, a table, folders of images, an interval list, a Hugging Face data set.

    Expressions of --map are a column's name or polars SQL over the columns, e.g. substr(path, 1, 15), split_part(path, '/', -1),
    replace(path, 'old', 'new'), path || '.jpg'; see docs/concepts/mapping.md.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Root of the data set, a table (CSV, TSV, JSON lines, JSON, Parquet), or with `--format hf` a name on the hub."""
    output: OutPath
    """Folder for manifest.parquet, the data set's own splits and decoded frames."""
    size: int | None = None
    """Shorter side of frames that are decoded from videos (default: as they are)."""
    max_per_contact: int | None = None
    """Keep at most this many evenly spaced frames of each contact (Touch and Go)."""
    skip_bad: bool = False
    """Leave out bad rows and files and list them, instead of refusing."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Imports and prints what was found."""
    from palpate.data.importing import import_dataset

    given = source_options(options, options.source) | {
        "size": options.size,
        "max_per_contact": options.max_per_contact,
    }
    strange = (
        {p.name for p in options.output.iterdir()} - IMPORT_FILES
        if options.output.is_dir()
        else set[str]()
    )
    if strange:
        raise PalpateError(
            f"{options.output} must be new, empty, or an earlier import",
            f"a folder with {sorted(strange)[0]}",
            "Choose another -o",
        )
    with terminal.progress() as progress:
        done = import_dataset(
            options.source,
            options.output,
            format=options.format,
            check=options.check,
            skip_bad=options.skip_bad,
            progress=progress,
            **given,
        )
    manifest = done.manifest
    for path in (options.output / "splits").glob(
        "*.json"
    ):  # of an earlier import of something else
        if path.stem not in done.splits:
            path.unlink()
    facts = {
        "manifest": str(options.output / "manifest.parquet"),
        "digest": manifest.digest,
        "samples": len(manifest),
        **{
            many: manifest.table[one].drop_nulls().n_unique()
            for one, many in (
                ("video", "videos"),
                ("contact", "touches"),
                ("material", "materials"),
            )
        },
        "with_background": len(manifest) - manifest.table["background"].null_count(),
        "with_text": len(manifest) - manifest.table["text"].null_count(),
        "inconclusive": done.inconclusive,
        "skipped": len(done.skipped),
        "splits": {name: split.counts() for name, split in done.splits.items()},
        "suspicious": len(done.suspicious),
    }
    terminal.facts(f"Imported {options.source}", facts)
    terminal.skipped(done.skipped)
    list_problems("Suspicious, but imported", done.suspicious, terminal.say)
    lists = {
        "skipped": [asdict(p) for p in done.skipped],
        "suspicious": [asdict(p) for p in done.suspicious],
    }
    return facts | lists | {"facts": dict(manifest.facts)}


def list_problems(title: str, problems: Sequence[Problem], say: Callable[[str], None]) -> None:
    """Tells the first problems of a list and how many there are."""
    if problems:
        say(f"{title}: {len(problems)}")
        for problem in problems[:SHOWN_PROBLEMS]:
            say(f"  {problem}")
        if len(problems) > SHOWN_PROBLEMS:
            say(f"  ... and {len(problems) - SHOWN_PROBLEMS} more (--json lists all)")


def source_options(options: SourceOptions, source: Path) -> dict[str, Any]:
    """The options of the format as keywords of its scan or run; those not given are None or absent.

    Raises:
        PalpateError: on an item without ``=``, an option that the format lacks, or a value that does not fit it.
    """
    columns = _pairs(
        "--map", options.maps, "COLUMN=NAME", "E.g. --map vision=rgb_path tactile=gel_path"
    )
    settings = _pairs(
        "--set",
        options.settings,
        "OPTION=VALUE",
        "E.g. --set image_format=png; see palpate validate --list",
    )
    given: dict[str, Any] = {
        "columns": columns or None,
        "root": options.root,
        "side": options.side,
        "classes": options.classes,
    }
    if not settings:
        return given
    if used := [name for name in settings if name in FLAGS]:
        raise PalpateError(
            f"The option {used[0]} has a flag of its own",
            f"--set {used[0]}=...",
            f"Write {FLAGS[used[0]]}",
        )
    name = _recognized(source, options.format)
    kinds = format_options(name)
    if strange := [key for key in settings if key not in kinds]:
        takes = ", ".join(kinds) or "no options"
        raise PalpateError(
            f"--set of the format {name} takes {takes}", strange[0], "See: palpate validate --list"
        )
    return given | {key: _value(key, values, kinds[key]) for key, values in settings.items()}


def format_options(name: str) -> Mapping[str, Any]:
    """What ``--set`` takes for a format: option -> annotated type."""
    from palpate.data.formats import FORMATS

    kinds: dict[str, Any] = {}
    for function in (FORMATS[name].scan, FORMATS[name].run):
        if function is not None:
            hints = typing.get_type_hints(function)
            own = [
                p.name
                for p in inspect.signature(function).parameters.values()
                if p.kind is p.KEYWORD_ONLY
            ]
            kinds |= {key: hints[key] for key in own if key not in FLAGS}
    return kinds


def described(kind: Any) -> str:
    """A type in the words of the command line."""
    kinds = _plain_kinds(kind)
    return " or ".join(
        dict.fromkeys(
            "|".join(map(str, typing.get_args(k)))
            if typing.get_origin(k) is Literal
            else {
                bool: "yes|no",
                int: "a whole number",
                float: "a number",
                Path: "a path",
                str: "a text",
            }.get(k, "several paths" if typing.get_origin(k) else str(k))
            for k in kinds
        )
    )


def _recognized(source: Path, name: str) -> str:
    """The named format, or the one that the source looks like.

    Raises:
        PalpateError: if there is none.
    """
    from palpate.data.formats import FORMATS

    if name == "auto":
        name = next((n for n, f in FORMATS.items() if f.detect(source)), "")
    if name not in FORMATS:
        raise PalpateError(
            f"With --set the format must be known: one of {', '.join(FORMATS)}",
            f"{source}",
            "Name it: --format",
        )
    return name


def _pairs(flag: str, items: Sequence[Sequence[str]], form: str, fix: str) -> dict[str, Any]:
    """``KEY=VALUE`` items as a dictionary; with ``--set`` a key that stands twice has a list of values."""
    found: dict[str, Any] = {}
    for item in (item for some in items for item in some):
        key, equals, value = item.partition("=")
        if not equals or not key.strip() or not value.strip():
            raise PalpateError(f"{flag} takes {form}", repr(item), fix)
        key = key.strip()
        if flag == "--set":
            found.setdefault(key, []).append(value.strip())
        elif key in found:
            raise PalpateError(
                f"{flag} must name each column once", f"{key} twice", "Leave one out"
            )
        else:
            found[key] = value.strip()
    return found


def _plain_kinds(kind: Any) -> list[Any]:
    """The members of a union without None."""
    members = (
        typing.get_args(kind)
        if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union
        else (kind,)
    )
    return [m for m in members if m is not types.NoneType]


def _value(key: str, texts: Sequence[str], kind: Any) -> Any:
    """What the texts of ``--set key=text`` stand for.

    Raises:
        PalpateError: if a text does not fit the type, or several stand where one must.
    """
    kinds = _plain_kinds(kind)
    several = [k for k in kinds if typing.get_origin(k) not in (None, Literal)]
    if len(texts) > 1 and not several:
        raise PalpateError(
            f"--set {key} must stand once", f"{len(texts)} times", "Leave the others out"
        )
    single = [k for k in kinds if k not in several] or [typing.get_args(several[0])[0]]
    values = [_single(key, text, single, kind) for text in texts]
    return values if len(values) > 1 else values[0]


def _single(key: str, text: str, kinds: Sequence[Any], kind: Any) -> Any:
    for one in kinds:
        if typing.get_origin(one) is Literal:
            if text in (choices := {str(c): c for c in typing.get_args(one)}):
                return choices[text]
        elif one is bool:
            if text.lower() in WORDS:
                return WORDS[text.lower()]
        elif one in (int, float, str, Path):
            try:
                return one(text)
            except ValueError:
                continue
    raise PalpateError(
        f"--set {key} must be {described(kind)}", repr(text), "See: palpate validate --list"
    )
