"""Frame lists as Touch and Go ships them: one ``video/frame.ext,label`` per line.

No header; the order is free; UTF-8, or UTF-16 with a byte-order mark; any line ends; the last line
may lack one. The label is an integer: -1 is inconclusive, others are classes. The line is split at
its last comma, so the name of a video may hold commas and spaces. The frame is the integer value of
the file's stem; ``video/33.jpg`` and ``video/0000000033.png`` name the same frame.

A **contact** is a maximal run of consecutive frames of one video with one label; contact ``k`` of a
video, counted from 1 in the order of frames, is called ``video#000k``.
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
LINE = r"^(?P<video>[^/\\]+)/(?P<stem>[0-9]{1,18})\.(?P<suffix>[A-Za-z0-9]+)\s*,\s*(?P<label>[+-]?[0-9]{1,18})$"  # noqa: E501
#: Absolute paths, drive letters, and ``..`` as a component.
CLIMBS = r"^[/\\]|^[A-Za-z]:[/\\]|(?:^|[/\\])\.\.(?:[/\\]|$)|^\.[/\\]"
FIX = "Correct the lines, or skip the bad ones"
#: Names that the published category table misspells.
SPELLING = {"Ruber": "Rubber"}


@dataclass(frozen=True)
class FrameList:
    """The rows of a list, or of several as one.

    Attributes:
        manifest: the usable rows in list order; image columns are null.
        skipped: bad rows that were skipped.
        inconclusive: number of rows with the label -1, skipped as well.
        rows: the usable rows as a table ``source, line, id, video, frame, label, suffix``, in the
            order of the manifest.
        contact: table ``video, frame`` of every readable row, inconclusive ones included: all
            frames in contact.
    """

    manifest: Manifest
    skipped: list[Problem]
    inconclusive: int
    rows: pl.DataFrame
    contact: pl.DataFrame


def read_list(
    path: Path, *, skip_bad: bool = False, categories: Mapping[int, str] | None = None
) -> FrameList:
    """Read one frame list.

    Args:
        path: the list; its folder becomes the manifest's root.
        skip_bad: skip and list bad rows instead of raising. Of a frame with two labels every row is
            bad.
        categories: label -> class name. Default: ``category_reference.txt`` next to the list if
            there is one, else a label stays as it is (``"3"``). With a table, a label that it lacks
            is a problem.

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
    """Read several lists as one: frames in two of them are detected, contacts numbered together.

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
    problems = [problem for _, bad in parsed for problem in bad]
    rows = pl.concat([table for table, _ in parsed])
    contact = rows.select("video", "frame")
    conclusive = rows.filter(pl.col("label") != INCONCLUSIVE)
    inconclusive = rows.height - conclusive.height
    rows, unknown = _unknown_labels(conclusive, categories)
    rows, doubled = _duplicates(rows)
    problems = _in_order([*problems, *unknown, *doubled], paths)
    if problems and not skip_bad:
        raise ProblemsError(problems, FIX, example={"skip_bad": True})
    labels = rows["label"]
    names = {k: str(k) for k in labels.unique()} if categories is None else dict(categories)
    table = rows.select("id", "video", "frame").with_columns(
        contact=pl.Series(contact_names(rows["video"], rows["frame"], labels), dtype=pl.String),
        material=labels.replace_strict(names, return_dtype=pl.String)
        if rows.height
        else pl.Series([], dtype=pl.String),
    )
    empty = (pl.lit(None, kind).alias(c) for c, kind in SCHEMA.items() if c not in table.columns)
    table = table.with_columns(empty).select(list(SCHEMA))
    facts = {"source": ", ".join(Path(p).name for p in paths)}
    return FrameList(Manifest(table, Path(root), facts), problems, inconclusive, rows, contact)


def contact_names(
    videos: Sequence[str] | pl.Series,
    frames: Sequence[int] | pl.Series,
    labels: Sequence[object] | pl.Series | None,
) -> list[str]:
    """The contact that each frame belongs to, in the order given.

    Args:
        videos: (n,) names.
        frames: (n,) integers, in any order.
        labels: (n,) classes that a contact must not mix, or None.

    Returns:
        ``n`` names ``video#0001``; the numbers count the contacts of a video from 1 in the order of
        frames.
    """
    video, label = pl.col("video"), pl.col("label")
    columns = {
        "video": pl.Series(videos, dtype=pl.String),
        "frame": pl.Series(frames, dtype=pl.Int64),
    }
    table = pl.DataFrame(columns).with_row_index("row")
    table = table.with_columns(label=pl.lit(0) if labels is None else pl.Series(labels))
    table = table.sort("video", "frame", maintain_order=True)
    first = (video != video.shift(1)) | (label != label.shift(1)) | (pl.col("frame").diff() > 1)
    number = first.fill_null(True).cast(pl.Int64).cum_sum().over("video")
    table = table.with_columns(number=number.cast(pl.String).str.zfill(4)).sort("row")
    return table.select(pl.format("{}#{}", "video", "number")).to_series().to_list()


def number_together(*manifests: Manifest) -> list[Manifest]:
    """Number the contacts of several lists together, so that one name means one contact.

    Manifests with a row that has no video or frame stay as they are.
    """
    if any(m.table["video"].null_count() or m.table["frame"].null_count() for m in manifests):
        return list(manifests)
    rows = pl.concat([m.table.select("video", "frame", "material") for m in manifests])
    # A frame in two lists belongs to one contact.
    distinct = rows.unique(["video", "frame"], maintain_order=True)
    names = contact_names(distinct["video"], distinct["frame"], distinct["material"])
    distinct = distinct.with_columns(contact=pl.Series(names, dtype=pl.String))
    joined = rows.join(distinct, on=["video", "frame"], how="left", maintain_order="left")
    numbered: list[Manifest] = []
    start = 0
    for m in manifests:
        contact = joined["contact"].slice(start, len(m))
        numbered.append(Manifest(m.table.with_columns(contact=contact), m.root, m.facts))
        start += len(m)
    return numbered


def write_list(path: Path, rows: Iterable[tuple[str, int]]) -> None:
    """Write a frame list, atomically.

    Args:
        path: the file.
        rows: (sample id or path, label); an id without a suffix gets ``.jpg``.

    Raises:
        ProblemsError: if a row could not be read again.
    """
    lines: list[str] = []
    problems: list[Problem] = []
    for number, (name, label) in enumerate(rows, 1):
        name = name if re.search(r"\.[A-Za-z][A-Za-z0-9]*$", name) else f"{name}.jpg"
        if _frame_of(name) is None or "\n" in name:
            text = f"{name!r} is not video/frame.ext"
            problems.append(Problem(f"row {number}", "bad-path", text))
        lines.append(f"{name},{int(label)}\n")
    if problems:
        raise ProblemsError(problems, "Name samples video/frame, with an integer frame")
    write_text(Path(path), "".join(lines))


def write_table(path: Path, manifest: Manifest) -> Path:
    """Write a manifest as CSV, without its empty columns; paths stay relative to its root."""
    write_text(Path(path), manifest.filled().write_csv())
    return Path(path)


def read_categories(path: Path) -> dict[int, str]:
    """Read a category table: ``Name: id`` per line; quotes and remarks in brackets are ignored.

    Returns:
        id -> name, the inconclusive class (-1) included if it is listed; known misspellings are
        corrected.

    Raises:
        PalpateError: if the file is missing or empty.
        ProblemsError: on lines of another form and on ids that occur twice.
    """
    path = Path(path)
    names: dict[int, str] = {}
    problems: list[Problem] = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        line = re.sub(r"\([^)]*\)|[\"'“”‘’]", "", line).strip().rstrip(",").strip()
        match = re.fullmatch(r"(.*\S)\s*:\s*([+-]?\d+)", line)
        if match is None:
            if line:
                problems.append(
                    Problem(f"{path}:{number}", "bad-line", f"{line!r} is not 'Name: id'")
                )
        elif (label := int(match[2])) in names:
            text = f"the id {label} names {names[label]!r} already"
            problems.append(Problem(f"{path}:{number}", "duplicate-id", text))
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
    """Read ``video/frame.jpg,words`` lines; the header ``frame,...`` is optional, so are quotes.

    Raises:
        PalpateError: if the file is missing.
    """
    path = Path(path)
    values: dict[tuple[str, int], str] = {}
    skipped: list[Problem] = []
    for number, line in enumerate(lines_of(_text(path)), 1):
        if not line.strip() or (number == 1 and line.lower().startswith("frame,")):
            continue
        name, *fields = next(csv.reader([line]))  # line by line: an open quote costs one line
        frame, words = _frame_of(name.strip()), ",".join(fields).strip()
        if frame is None:
            problem = "bad-path", f"{name!r} is not video/frame.ext"
        elif not words:
            problem = "bad-line", f"{name!r} has no words"
        elif values.setdefault(frame, words) != words:
            problem = "two-labels", f"{name!r} has other words on an earlier line"
        else:
            continue
        skipped.append(Problem(f"{path}:{number}", *problem))
    return FrameTable(values, skipped)


def _frame_of(name: str) -> tuple[str, int] | None:
    """(video, frame) of ``video/frame.ext``; None for other paths and those that leave the root."""
    match = re.match(PATH, name)
    if match is None or not match["stem"].isdecimal() or re.search(CLIMBS, name):
        return None
    return match["video"], int(match["stem"])


def _text(path: Path) -> str:
    """The file as text; what is neither UTF-8 nor UTF-16 becomes U+FFFD."""
    if not path.is_file():
        got = f"the folder {path}" if path.is_dir() else f"no file {path}"
        raise PalpateError("The list must be a file", got, "Check the path")
    return decoded(path.read_bytes())


def _parse(path: Path) -> tuple[pl.DataFrame, list[Problem]]:
    """The well-formed rows of one list, and a problem for each other line."""
    text = pl.col("text")
    lines = pl.DataFrame({"text": pl.Series(lines_of(_text(path)), dtype=pl.String)})
    lines = lines.with_row_index("line", offset=1)
    lines = lines.with_columns(text.str.strip_chars()).filter(text != "")
    table = lines.with_columns(text.str.extract_groups(LINE).alias("parts")).unnest("parts")
    good = (
        pl.col("label").is_not_null()
        & ~text.str.contains(CLIMBS)
        & ~text.str.contains("\ufffd", literal=True)
    )
    problems = [
        Problem(f"{path}:{line}", *_reason(bad))
        for line, bad in table.filter(~good).select("line", "text").iter_rows()
    ] or ([] if table.height else [Problem(str(path), "empty-list", "the list has no lines")])
    rows = table.filter(good).select(
        pl.lit(str(path)).alias("source"),
        "line",
        pl.format("{}/{}", "video", "stem").alias("id"),
        "video",
        pl.col("stem").cast(pl.Int64).alias("frame"),
        pl.col("label").cast(pl.Int64),
        "suffix",
    )
    return rows, problems


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
    label = pl.col("label")
    if categories is None:
        known, what = label >= 0, "is negative, but not -1 (inconclusive)"
    else:
        known = label.is_in([k for k in categories if k != INCONCLUSIVE])
        what = "is not in the category table"
    return rows.filter(known), [
        Problem(f"{source}:{line}", "unknown-label", f"the label {value} {what}")
        for source, line, value in rows.filter(~known).select("source", "line", "label").iter_rows()
    ]


def _duplicates(rows: pl.DataFrame) -> tuple[pl.DataFrame, list[Problem]]:
    """Drop every row of a frame with two labels, and all but the first of equal rows."""
    again = rows.select("video", "frame").is_duplicated()
    if not again.any():
        return rows, []
    rows = rows.with_row_index("row")
    problems: list[Problem] = []
    drop: list[int] = []
    for (video, frame), group in rows.filter(again).group_by("video", "frame", maintain_order=True):
        places = [f"{source}:{line}" for source, line in group.select("source", "line").iter_rows()]
        labels = group["label"].to_list()
        two = len(set(labels)) > 1
        for place, label in list(zip(places, labels, strict=True))[not two :]:
            others = (f"{o} at {p}" for o, p in zip(labels, places, strict=True) if o != label)
            text = f"frame {frame} of {video!r} " + (
                f"has two labels: {label} here, {', '.join(others)}"
                if two
                else f"is listed at {places[0]} already"
            )
            problems.append(Problem(place, "two-labels" if two else "duplicate-row", text))
        drop += group["row"].to_list()[not two :]
    return rows.filter(~pl.col("row").is_in(drop)).drop("row"), problems


def _in_order(problems: Iterable[Problem], paths: Sequence[Path]) -> list[Problem]:
    """Problems by list, then by line."""
    rank = {str(Path(p)): k for k, p in enumerate(paths)}

    def key(problem: Problem) -> tuple[int, int]:
        name, _, line = problem.where.rpartition(":")
        return (rank[name], int(line)) if name in rank else (rank.get(problem.where, len(rank)), 0)

    return sorted(problems, key=key)
