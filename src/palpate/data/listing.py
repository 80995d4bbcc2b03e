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

from palpate.core import Problem, ProblemsError, write_text
from palpate.data.manifest import CLIMBS, Manifest
from palpate.data.recordings import contact_names
from palpate.data.tables import INCONCLUSIVE, first_line, lines_of, read_categories, text_in

PATH = r"^(?P<video>[^/\\]+)/(?P<stem>[^/\\]+)\.(?P<suffix>[A-Za-z0-9]+)$"
#: A good line; the video takes all commas before the slash.
LINE = (
    PATH.replace(r"stem>[^/\\]+", "stem>[0-9]{1,18}")[:-1] + r"\s*,\s*(?P<label>[+-]?[0-9]{1,18})$"
)
#: Paths that leave the data set, and those that begin with "./".
LEAVES = CLIMBS + r"|^\.[/\\]"
FIX = "Correct the lines, or skip the bad ones"


@dataclass(frozen=True)
class FrameList:
    """The rows of a list, or of several as one."""

    manifest: Manifest  # the usable rows in list order; image columns are null
    skipped: list[Problem]  # bad rows that were skipped
    inconclusive: int  # number of rows with the label -1, skipped as well
    #: The usable rows as a table ``source, line, id, video, frame, label, suffix``, in the order of
    #: the manifest.
    rows: pl.DataFrame
    #: Table ``video, frame`` of every readable row, inconclusive ones included: all frames in
    #: contact.
    contact: pl.DataFrame


def is_list(path: Path) -> bool:
    """Whether the first line that is not empty is a row of a frame list."""
    return re.match(LINE, first_line(path)) is not None


def read_list(
    path: Path, *, skip_bad: bool = False, categories: Mapping[int, str] | None = None
) -> FrameList:
    """Read one frame list, whose folder becomes the manifest's root.

    Args:
        path: the list.
        skip_bad: skip and list bad rows instead of raising. Of a frame with two labels every row is
            bad.
        categories: label -> class name. Default: ``category_reference.txt`` next to the list if
            there is one, else a label stays as it is (``"3"``). With a table, a label that it lacks
            is a problem.
    """
    root = path.parent
    categories = categories_in(root) if categories is None else categories
    return read_lists([path], root=root, skip_bad=skip_bad, categories=categories)


def read_lists(
    paths: Sequence[Path],
    *,
    root: Path,
    skip_bad: bool = False,
    categories: Mapping[int, str] | None = None,
) -> FrameList:
    """Read several lists as one: frames in two of them are detected, contacts numbered together.

    Arguments as :func:`read_list`; labels without ``categories`` stay text.
    """
    problems: list[Problem] = []
    every = pl.concat([_parse(path, problems) for path in paths])
    conclusive = every.filter(pl.col("label") != INCONCLUSIVE)
    rows = _without_duplicates(_with_known_labels(conclusive, categories, problems), problems)
    problems.sort(key=Problem.sort_key)
    if problems and not skip_bad:
        raise ProblemsError(problems, FIX, example={"skip_bad": True})
    names = contact_names(rows["video"], rows["frame"], rows["label"])
    label = pl.col("label").cast(pl.String)
    if categories is not None:
        names_by_label = {str(k): name for k, name in categories.items()}
        label = label.replace(list(names_by_label), list(names_by_label.values()))
    table = rows.select("id", "video", "frame", material=label, contact=names)
    facts = {"source": ", ".join(path.name for path in paths)}
    manifest = Manifest.of_table(table, root, facts)
    contact = every.select("video", "frame")
    return FrameList(manifest, problems, every.height - conclusive.height, rows, contact)


def write_list(path: Path, rows: Iterable[tuple[str, int]]) -> None:
    """Write a frame list, atomically.

    Args:
        path: the file.
        rows: (sample id or path, label); an id without a suffix gets ``.jpg``.
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
    write_text(path, "".join(lines))


def write_table(path: Path, manifest: Manifest) -> Path:
    """Write a manifest as CSV, without its empty columns; paths stay relative to its root."""
    write_text(path, manifest.filled().write_csv())
    return path


def categories_in(folder: Path) -> dict[int, str] | None:
    """The classes of ``category_reference.txt``, if a folder has one."""
    table = folder / "category_reference.txt"
    return read_categories(table) if table.is_file() else None


def read_frame_table(path: Path, problems: list[Problem]) -> dict[tuple[str, int], str]:
    """Read ``video/frame.jpg,words`` lines; the header ``frame,...`` is optional, so are quotes.

    Returns:
        (video, frame) -> its words; lines that cannot be read join ``problems``.
    """
    values: dict[tuple[str, int], str] = {}
    for number, line in enumerate(lines_of(text_in(path)), 1):
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
        problems.append(Problem(f"{path}:{number}", *problem))
    return values


def _frame_of(name: str) -> tuple[str, int] | None:
    """(video, frame) of ``video/frame.ext``; None for other paths and those that leave the root."""
    match = re.match(PATH, name)
    if match is None or not match["stem"].isdecimal() or re.search(LEAVES, name):
        return None
    return match["video"], int(match["stem"])


def _parse(path: Path, problems: list[Problem]) -> pl.DataFrame:
    """The well-formed rows of one list; every other line is a problem."""
    text = pl.col("text")
    lines = pl.DataFrame({"text": lines_of(text_in(path))}).with_row_index("line", offset=1)
    lines = lines.with_columns(text.str.strip_chars()).filter(text != "")
    if not lines.height:
        problems.append(Problem(str(path), "empty-list", "the list has no lines"))
    table = lines.with_columns(text.str.extract_groups(LINE).alias("parts")).unnest("parts")
    good = pl.col("label").is_not_null() & ~text.str.contains(LEAVES + "|\ufffd")
    for line, bad in table.filter(~good).select("line", "text").iter_rows():
        problems.append(Problem(f"{path}:{line}", *_reason(bad)))
    return table.filter(good).select(
        pl.lit(str(path)).alias("source"),
        "line",
        pl.format("{}/{}", "video", "stem").alias("id"),
        "video",
        pl.col("stem").cast(pl.Int64).alias("frame"),
        pl.col("label").cast(pl.Int64),
        "suffix",
    )


def _reason(line: str) -> tuple[str, str]:
    """What is wrong with a line that is not well formed, as (kind, text)."""
    path, comma, label = (part.strip() for part in line.rpartition(","))
    match = re.match(PATH, path)
    if "\ufffd" in line:
        return "bad-encoding", f"the line {line!r} is not UTF-8"
    if not comma:
        return "no-comma", f"the line {line!r} has no comma before a label"
    if re.search(LEAVES, path):
        return "outside-root", f"the path {path!r} leaves the data set"
    if match is None:
        return "bad-path", f"the path {path!r} is not video/frame.ext"
    if re.fullmatch("[0-9]{1,18}", match["stem"]) is None:
        return "bad-frame", f"the frame {match['stem']!r} is not an integer"
    return "bad-label", f"the label {label!r} is not an integer"


def _with_known_labels(
    rows: pl.DataFrame, categories: Mapping[int, str] | None, problems: list[Problem]
) -> pl.DataFrame:
    """Drop rows whose label is no class."""
    valid, reason = pl.col("label") >= 0, "is negative, but not -1 (inconclusive)"
    if categories is not None:
        valid, reason = pl.col("label").is_in(list(categories)), "is not in the category table"
    for source, line, label in rows.filter(~valid).select("source", "line", "label").iter_rows():
        text = f"the label {label} {reason}"
        problems.append(Problem(f"{source}:{line}", "unknown-label", text))
    return rows.filter(valid)


def _without_duplicates(rows: pl.DataFrame, problems: list[Problem]) -> pl.DataFrame:
    """Drop every row of a frame with two labels, and all but the first of equal rows."""
    rows = rows.with_row_index("row")
    again = rows.filter(pl.struct("video", "frame").is_duplicated())
    drop: list[int] = []
    for (video, frame), group in again.group_by("video", "frame", maintain_order=True):
        places = [f"{source}:{line}" for source, line in group.select("source", "line").iter_rows()]
        labels = group["label"].to_list()
        two = len(set(labels)) > 1
        for k in range(0 if two else 1, len(labels)):
            kind, text = "duplicate-row", f"is listed at {places[0]} already"
            if two:
                pairs = zip(labels, places, strict=True)
                elsewhere = ", ".join(f"{o} at {p}" for o, p in pairs if o != labels[k])
                kind, text = "two-labels", f"has two labels: {labels[k]} here, {elsewhere}"
            problems.append(Problem(places[k], kind, f"frame {frame} of {video!r} {text}"))
            drop.append(group["row"][k])
    return rows.filter(~pl.col("row").is_in(drop)).drop("row")
