"""Frame lists: one ``video/frame.ext,label`` a line, as Touch and Go and its derivatives ship them.

No header; the order is free; UTF-8, or UTF-16 with a byte-order mark; any line ends; the last line may lack its own. The label is an integer: -1 is inconclusive,
others are classes. The line is split at its last comma, so a video's name may hold commas and spaces. The frame
is the integer value of the file's stem; ``video/33.jpg`` and ``video/0000000033.png`` name the same frame.

A **touch** is a maximal run of consecutive frames of one video with one label; touch ``k`` of a video, counted
from 1 in the order of frames, is called ``video#000k``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from palpate.core import PalpateError, Problem, ProblemsError, write_text
from palpate.data.manifest import SCHEMA, Manifest
from palpate.data.texts import decoded, lines_of

INCONCLUSIVE = -1
PATH = r"^(?P<video>[^/\\]+)/(?P<stem>[^/\\]+)\.(?P<suffix>[A-Za-z0-9]+)$"
#: A good line; the video takes all commas before the slash.
LINE = r"^(?P<video>[^/\\]+)/(?P<stem>[0-9]{1,18})\.(?P<suffix>[A-Za-z0-9]+)\s*,\s*(?P<label>[+-]?[0-9]{1,18})$"
#: Absolute paths, drive letters, and ``..`` as a component.
CLIMBS = r"^[/\\]|^[A-Za-z]:[/\\]|(?:^|[/\\])\.\.(?:[/\\]|$)|^\.[/\\]"
FIX = "Mend the lines, or read the list with --skip-bad to leave them out"
#: Names that the published category table misspells.
SPELLING = {"Ruber": "Rubber"}


@dataclass(frozen=True)
class FrameList:
    """What a list (or several, joined) holds.

    Attributes:
        manifest: the usable rows in list order; image columns are null.
        skipped: rows that were left out because they are bad.
        inconclusive: number of rows with the label -1, left out as well.
        rows: the usable rows as a table ``source, line, id, video, frame, label, suffix``, in the order of the manifest.
        contact: table ``video, frame`` of every readable row, inconclusive ones included: where the sensor touches something.
    """

    manifest: Manifest
    skipped: list[Problem]
    inconclusive: int
    rows: pl.DataFrame
    contact: pl.DataFrame


def read_list(
    path: Path, *, skip_bad: bool = False, categories: Mapping[int, str] | None = None
) -> FrameList:
    """Reads one frame list.

    Args:
        path: the list; its folder becomes the manifest's root.
        skip_bad: leave bad rows out and list them, instead of raising. Of a frame with two labels every row is left out.
        categories: label -> class name. Default: ``category_reference.txt`` beside the list if there is one, else a
            label stays its own name (``"3"``). With a table, a label that it lacks is a problem.

    Raises:
        PalpateError: if there is no such file.
        ProblemsError: unless ``skip_bad``, with every bad line at once.
    """
    path = Path(path)
    table = path.parent / "category_reference.txt"
    if categories is None and table.is_file():
        categories = read_categories(table)
    return read_lists([path], root=path.parent, skip_bad=skip_bad, categories=categories)


def read_lists(
    paths: Sequence[Path],
    *,
    root: Path,
    skip_bad: bool = False,
    categories: Mapping[int, str] | None = None,
) -> FrameList:
    """Reads several lists as one, so that frames which stand in two of them are found and touches are numbered together.

    Args:
        paths: the lists, in order.
        root: root of the manifest.
        skip_bad: as in :func:`read_list`.
        categories: label -> class name, or None to keep the label as text.

    Raises:
        PalpateError: if a list is missing.
        ProblemsError: unless ``skip_bad``.
    """
    parsed = [_parse(Path(p)) for p in paths]
    problems = [problem for _, found in parsed for problem in found]
    rows = pl.concat([table for table, _ in parsed])
    contact = rows.select("video", "frame")
    count = rows.height
    rows = rows.filter(pl.col("label") != INCONCLUSIVE)
    inconclusive = count - rows.height
    rows, found = _unknown_labels(rows, categories)
    problems += found
    rows, found = _duplicates(rows)
    problems += found
    if problems and not skip_bad:
        raise ProblemsError(_in_order(problems, paths), FIX)
    labels = rows["label"]
    names = (
        {label: str(label) for label in labels.unique()} if categories is None else dict(categories)
    )
    table = rows.select("id", "video", "frame").with_columns(
        contact=pl.Series(touches(rows["video"], rows["frame"], labels), dtype=pl.String),
        material=labels.replace_strict(names, return_dtype=pl.String)
        if rows.height
        else pl.Series([], dtype=pl.String),
    )
    empty = [
        pl.lit(None, dtype=kind).alias(name)
        for name, kind in SCHEMA.items()
        if name not in table.columns
    ]
    table = table.with_columns(empty).select(list(SCHEMA))
    facts = {"source": ", ".join(Path(p).name for p in paths)}
    return FrameList(
        Manifest(table, Path(root), facts), _in_order(problems, paths), inconclusive, rows, contact
    )


def touches(
    videos: Sequence[str] | pl.Series,
    frames: Sequence[int] | pl.Series,
    labels: Sequence[object] | pl.Series | None,
) -> list[str]:
    """The touch that each frame belongs to, in the order given.

    Args:
        videos: (n,) names.
        frames: (n,) integers, in any order.
        labels: (n,) classes that a touch must not mix, or None.

    Returns:
        ``n`` names ``video#0001``; the numbers count a video's touches from 1 in the order of frames.
    """
    table = pl.DataFrame(
        {"video": pl.Series(videos, dtype=pl.String), "frame": pl.Series(frames, dtype=pl.Int64)}
    ).with_row_index("row")
    table = table.with_columns(label=pl.lit(0) if labels is None else pl.Series(labels)).sort(
        "video", "frame", maintain_order=True
    )
    other = (pl.col("video") != pl.col("video").shift(1)) | (
        pl.col("label") != pl.col("label").shift(1)
    )
    opens = (other | (pl.col("frame").diff() > 1)).fill_null(True)
    table = table.with_columns(number=opens.cast(pl.Int64).cum_sum().over("video")).sort("row")
    return (
        table.select(pl.format("{}#{}", "video", pl.col("number").cast(pl.String).str.zfill(4)))
        .to_series()
        .to_list()
    )


def number_together(*manifests: Manifest) -> list[Manifest]:
    """Manifests of lists that were read apart, with their touches numbered over all of them, so that one name means one touch.

    Manifests with a row that has no video or frame stay as they are.
    """
    if any(m.table["video"].null_count() or m.table["frame"].null_count() for m in manifests):
        return list(manifests)
    whole = pl.concat([m.table.select("video", "frame", "material") for m in manifests])
    # A frame that stands in two lists belongs to one touch there and here.
    alone = whole.unique(["video", "frame"], maintain_order=True)
    names = alone.with_columns(
        contact=pl.Series(
            touches(alone["video"], alone["frame"], alone["material"]), dtype=pl.String
        )
    )
    found = whole.join(names, on=["video", "frame"], how="left", maintain_order="left")["contact"]
    out: list[Manifest] = []
    for m in manifests:
        out.append(
            Manifest(
                m.table.with_columns(contact=found.slice(sum(len(o) for o in out), len(m))),
                m.root,
                m.facts,
            )
        )
    return out


def write_list(path: Path, rows: Iterable[tuple[str, int]]) -> None:
    """Writes a frame list, atomically.

    Args:
        path: the file.
        rows: (sample id or path, label); an id without a suffix gets ``.jpg``.

    Raises:
        ProblemsError: if a row could not be read back.
    """
    lines: list[str] = []
    problems: list[Problem] = []
    for number, (name, label) in enumerate(rows, 1):
        name = name if re.search(r"\.[A-Za-z][A-Za-z0-9]*$", name) else f"{name}.jpg"
        match = re.match(PATH, name)
        if (
            match is None
            or not match["stem"].isdecimal()
            or re.search(CLIMBS, name)
            or "\n" in name
        ):
            problems.append(
                Problem(f"row {number}", "bad-path", f"{name!r} is not video/frame.ext")
            )
        lines.append(f"{name},{int(label)}\n")
    if problems:
        raise ProblemsError(problems, "Name samples video/frame, with an integer frame")
    write_text(Path(path), "".join(lines))


def write_table(path: Path, manifest: Manifest) -> Path:
    """Writes a manifest's rows as CSV, without its empty columns, atomically; paths stay relative to its root."""
    table = manifest.table.select(
        name for name in SCHEMA if manifest.table[name].null_count() < len(manifest)
    )
    write_text(Path(path), table.write_csv())
    return Path(path)


def read_categories(path: Path) -> dict[int, str]:
    """Reads a category table, ``Name: id`` a line, with uneven spaces, optional quotes and optional remarks in brackets.

    Returns:
        id -> name, the inconclusive class (-1) included if it is listed; known misspellings are mended.

    Raises:
        PalpateError: if the file is missing.
        ProblemsError: on lines of another form and on ids that stand twice.
    """
    path = Path(path)
    names: dict[int, str] = {}
    problems: list[Problem] = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        line = re.sub(r"\([^)]*\)|[\"'“”‘’]", "", line).strip().rstrip(",").strip()
        if not line:
            continue
        match = re.fullmatch(r"(.*\S)\s*:\s*([+-]?\d+)", line)
        if match is None:
            problems.append(Problem(f"{path}:{number}", "bad-line", f"{line!r} is not 'Name: id'"))
        elif (label := int(match[2])) in names:
            problems.append(
                Problem(
                    f"{path}:{number}",
                    "duplicate-id",
                    f"the id {label} names {names[label]!r} already",
                )
            )
        else:
            name = " ".join(match[1].split())
            names[label] = SPELLING.get(name, name)
    if problems:
        raise ProblemsError(problems, "Write one 'Name: id' a line")
    if not names:
        raise PalpateError(
            f"{path} must list classes as 'Name: id'",
            "an empty file",
            "Fetch category_reference.txt again",
        )
    return names


@dataclass(frozen=True)
class FrameTable:
    """Words for frames, by (video, frame), and the lines that could not be read."""

    values: dict[tuple[str, int], str]
    skipped: list[Problem]


def read_frame_table(path: Path) -> FrameTable:
    """Reads ``video/frame.jpg,words`` lines (CSV, with an optional header ``frame,...``); words may hold commas, quoted or not.

    Raises:
        PalpateError: if the file is missing.
    """
    path = Path(path)
    values: dict[tuple[str, int], str] = {}
    skipped: list[Problem] = []
    reader = csv.reader(_text(path).splitlines())
    for fields in reader:
        where = f"{path}:{reader.line_num}"
        if not any(field.strip() for field in fields) or (
            reader.line_num == 1 and fields[0].strip().lower() == "frame"
        ):
            continue
        match = re.match(PATH, fields[0].strip())
        words = ",".join(fields[1:]).strip()
        if match is None or not match["stem"].isdecimal() or re.search(CLIMBS, fields[0].strip()):
            skipped.append(Problem(where, "bad-path", f"{fields[0]!r} is not video/frame.ext"))
        elif not words:
            skipped.append(Problem(where, "bad-line", f"{fields[0]!r} has no words"))
        elif values.setdefault((match["video"], int(match["stem"])), words) != words:
            skipped.append(
                Problem(where, "two-labels", f"{fields[0]!r} has other words on an earlier line")
            )
    return FrameTable(values, skipped)


def _text(path: Path) -> str:
    """The file as text; bytes that are no UTF-8, or UTF-16 with a byte-order mark, become U+FFFD."""
    try:
        return decoded(path.read_bytes())
    except FileNotFoundError:
        raise PalpateError("The list must exist", f"no file {path}", "Check the path") from None
    except IsADirectoryError:
        raise PalpateError(
            "The list must be a file", f"the folder {path}", "Name the file itself"
        ) from None


def _parse(path: Path) -> tuple[pl.DataFrame, list[Problem]]:
    """The well-formed rows of one list, and a problem for each other line."""
    lines = pl.DataFrame(
        {"text": pl.Series(lines_of(_text(path)), dtype=pl.String)}
    ).with_row_index("line", offset=1)
    lines = lines.with_columns(pl.col("text").str.strip_chars()).filter(pl.col("text") != "")
    table = lines.with_columns(pl.col("text").str.extract_groups(LINE).alias("parts")).unnest(
        "parts"
    )
    table = table.with_columns(
        source=pl.lit(str(path)),
        id=pl.format("{}/{}", "video", "stem"),
        frame=pl.col("stem").cast(pl.Int64, strict=False),
        label=pl.col("label").cast(pl.Int64, strict=False),
        odd=pl.col("text").str.contains(CLIMBS)
        | pl.col("text").str.contains("\ufffd", literal=True),
    )
    bad = table.filter(pl.col("odd") | pl.col("frame").is_null() | pl.col("label").is_null())
    problems = [
        Problem(f"{path}:{line}", *_reason(text))
        for line, text in bad.select("line", "text").iter_rows()
    ]
    if not table.height:
        problems = [Problem(str(path), "empty-list", "the list has no lines")]
    table = table if not bad.height else table.filter(~pl.col("line").is_in(bad["line"].to_list()))
    return table.select("source", "line", "id", "video", "frame", "label", "suffix"), problems


def _reason(line: str) -> tuple[str, str]:
    """What is wrong with a line that is not well formed, as (kind, text)."""
    path, comma, label = (part.strip() for part in line.rpartition(","))
    match = re.match(PATH, path)
    if "\ufffd" in line:
        return "bad-encoding", f"the line {line!r} is not UTF-8"
    if not comma:
        return "no-comma", f"the line {line!r} has no comma before a label"
    if re.search(CLIMBS, path):
        return "outside-root", f"the path {path!r} leaves the data set"
    if match is None:
        return "bad-path", f"the path {path!r} is not video/frame.ext"
    if re.fullmatch("[0-9]{1,18}", match["stem"]) is None:
        return "bad-frame", f"the frame {match['stem']!r} is not an integer"
    return "bad-label", f"the label {label!r} is not an integer"


def _unknown_labels(
    rows: pl.DataFrame, categories: Mapping[int, str] | None
) -> tuple[pl.DataFrame, list[Problem]]:
    known = (
        pl.col("label") >= 0
        if categories is None
        else pl.col("label").is_in([k for k in categories if k != INCONCLUSIVE])
    )
    bad = rows.filter(~known)
    what = (
        "is negative, but not -1 (inconclusive)"
        if categories is None
        else "is not in the category table"
    )
    return rows.filter(known), [
        Problem(
            f"{row['source']}:{row['line']}", "unknown-label", f"the label {row['label']} {what}"
        )
        for row in bad.iter_rows(named=True)
    ]


def _duplicates(rows: pl.DataFrame) -> tuple[pl.DataFrame, list[Problem]]:
    """Drops every row of a frame with two labels, and all but the first of equal rows."""
    again = rows.select("video", "frame").is_duplicated()
    if not again.any():
        return rows, []
    rows = rows.with_row_index("row")
    problems: list[Problem] = []
    drop: list[int] = []
    for (video, frame), group in rows.filter(again).group_by("video", "frame", maintain_order=True):
        same = list(group.iter_rows(named=True))
        places = [f"{row['source']}:{row['line']}" for row in same]
        if group["label"].n_unique() > 1:
            for place, row in zip(places, same, strict=True):
                others = ", ".join(
                    f"{o['label']} at {p}"
                    for o, p in zip(same, places, strict=True)
                    if o["label"] != row["label"]
                )
                text = f"frame {frame} of {video!r} has two labels: {row['label']} here, {others}"
                problems.append(Problem(place, "two-labels", text))
            drop += group["row"].to_list()
        else:
            for place in places[1:]:
                problems.append(
                    Problem(
                        place,
                        "duplicate-row",
                        f"frame {frame} of {video!r} is listed at {places[0]} already",
                    )
                )
            drop += group["row"].to_list()[1:]
    return rows.filter(~pl.col("row").is_in(drop)).drop("row"), problems


def _in_order(problems: Iterable[Problem], paths: Sequence[Path]) -> list[Problem]:
    """Problems by list, then by line."""
    rank = {str(Path(p)): k for k, p in enumerate(paths)}

    def key(problem: Problem) -> tuple[int, int]:
        name, _, line = problem.where.rpartition(":")
        return (rank[name], int(line)) if name in rank else (rank.get(problem.where, len(rank)), 0)

    return sorted(problems, key=key)
