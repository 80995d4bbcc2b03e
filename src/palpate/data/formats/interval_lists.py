"""Interval lists as tables: read one, find overlaps, write the intervals of a split. The form is told in ``intervals.py``."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from palpate.core import PalpateError, Problem, Split, write_text
from palpate.data.manifest import Manifest
from palpate.data.mapping import compile_maps
from palpate.data.rows import manifest_rows, read_classes
from palpate.data.tables import header_of, open_table

#: What the columns of an interval list are called, besides their own names.
NAMES: Mapping[str, tuple[str, ...]] = {
    "video": ("video", "recording", "clip", "sequence", "video_id"),
    "start": ("start", "start_frame", "first", "first_frame", "begin", "from", "onset"),
    "end": ("end", "end_frame", "last", "last_frame", "stop", "to", "offset"),
    "material": ("material", "label", "class", "category"),
    "object": ("object",),
    "text": ("text", "caption", "description"),
    "session": ("session",),
    "background": ("background", "background_frame"),
}
NEEDED = ("video", "start", "end")
ORDER = ("video", "start", "end", "label")


@dataclass(frozen=True)
class Interval:
    """A touch: frames ``first`` to ``last``, both included, and what is said of it; ``number`` is None until it stands."""

    where: str
    video: str
    first: int
    last: int
    words: Mapping[str, str]
    background: int | None
    inconclusive: bool
    touch: str = ""


def read_intervals(
    path: Path, maps: dict[str, str], classes: Path | None, half_open: bool, problems: list[Problem]
) -> list[Interval]:
    """The well-formed lines of the list, in its order."""
    header = header_of(path)
    table = open_table(path, ORDER[: len(header)] if is_bare(header) else None)
    for target, synonyms in NAMES.items():
        theirs = next((name for name in table.names if name.lower() in synonyms), None)
        if target not in maps and target not in table.names and theirs is not None:
            maps[target] = theirs
    expressions = compile_maps(maps, table.names, list(NAMES))
    if (
        absent := [name for name in NEEDED if name not in expressions.expressions]
    ) and not table.problems:
        got = f"no {', '.join(absent)} among {', '.join(table.names) or 'no columns'}"
        raise PalpateError(
            f"{path} must have the columns {', '.join(NEEDED)}",
            got,
            "Map them: --map start=YOUR_COLUMN",
        )
    cells = expressions.apply(table.read(expressions.columns))
    problems += table.problems
    known = None if classes is None else read_classes(Path(classes))
    # Without classes, as an inconclusive contact (-1) is contact all the same.
    found, _ = manifest_rows(cells, len(table.lines), table.where, None, problems)
    intervals: list[Interval] = []
    for k, row in found:
        where, label = table.where(k), row.get("material")
        last = row.get("end", -1) - half_open
        background = row.pop("background", None)
        wrong: tuple[str, str] | None = None
        if lacking := [name for name in NEEDED if name not in row]:
            wrong = "empty-cell", f"no {' and no '.join(lacking)}"
        elif last < row["start"]:
            wrong = (
                "bad-interval",
                f"the touch ends at frame {last} before it starts at {row['start']}",
            )
        elif background is not None and not background.isdecimal():
            wrong = "bad-frame", f"the background {background!r} is not a whole number from 0"
        elif known is not None and label not in (None, "-1", *known.values()):
            name = known.get(int(label)) if str(label).isdecimal() else None
            wrong = (
                None
                if name
                else ("unknown-label", f"the class {label!r} is not in the table of classes")
            )
            label = name
        if wrong is not None:
            problems.append(Problem(where, *wrong))
            continue
        words = {name: row[name] for name in ("object", "text", "session") if name in row} | (
            {"material": label} if label else {}
        )
        first = row["start"]
        intervals.append(
            Interval(
                where,
                row["video"],
                first,
                last,
                words,
                None if background is None else int(background),
                label == "-1",
            )
        )
    return intervals


def apart(listed: list[Interval], problems: list[Problem]) -> list[Interval]:
    """The intervals that share no frame with another, sorted by video and frame."""
    order = sorted(
        range(len(listed)), key=lambda k: (listed[k].video, listed[k].first, listed[k].last, k)
    )
    partner: dict[int, int] = {}
    again: set[int] = set()
    widest = -1  # of those before, the one that reaches furthest
    for k in order:
        if (
            widest >= 0
            and listed[widest].video == listed[k].video
            and listed[k].first <= listed[widest].last
        ):
            i, j = listed[widest], listed[k]
            if (i.first, i.last, i.words) == (j.first, j.last, j.words):
                again.add(k)
                problems.append(
                    Problem(
                        j.where, "duplicate-row", f"the same interval stands at {i.where} already"
                    )
                )
                continue
            partner[k] = widest
            partner.setdefault(widest, k)
        if (
            widest < 0
            or listed[widest].video != listed[k].video
            or listed[k].last > listed[widest].last
        ):
            widest = k
    for k, other in sorted(partner.items()):
        i, o = listed[k], listed[other]
        text = f"frames {i.first} to {i.last} of {i.video!r} overlap with {o.first} to {o.last} at {o.where}"
        problems.append(Problem(i.where, "overlap", text))
    return [listed[k] for k in order if k not in partner and k not in again]


def numbered(listed: list[Interval]) -> Iterator[Interval]:
    """The conclusive intervals with their touches' names."""
    count: dict[str, int] = {}
    for i in listed:
        if not i.inconclusive:
            count[i.video] = count.get(i.video, 0) + 1
            yield Interval(
                i.where,
                i.video,
                i.first,
                i.last,
                i.words,
                i.background,
                False,
                f"{i.video}#{count[i.video]:04d}",
            )


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Writes ``<part>.csv`` with ``video,start,end,label,object,text`` lines that hold exactly the samples of the part.

    A line is a run of consecutive frames of one touch, both ends included.

    Raises:
        PalpateError: if a sample has no video or frame.
    """
    files: list[Path] = []
    for part in split.counts():
        table = manifest.part(split, part).table.sort("video", "frame")
        if len(bad := table.filter(pl.col("video").is_null() | pl.col("frame").is_null())["id"]):
            raise PalpateError(
                "An interval list needs the video and frame of every sample",
                f"none for {bad[0]!r}",
                "Write the split file alone",
            )
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([*ORDER, "object", "text"])
        writer.writerows(_runs(table))
        files.append(Path(folder) / f"{part}.csv")
        write_text(files[-1], out.getvalue())
    return files


def _runs(table: pl.DataFrame) -> Iterator[tuple[object, ...]]:
    """(video, first, last, material, object, text) of each run of consecutive frames with the same of all else."""
    run: tuple[object, ...] | None = None
    first = last = 0
    for video, frame, *said in table.select(
        "video", "frame", "contact", "material", "object", "text"
    ).iter_rows():
        key = (video, *said)
        if run == key and frame == last + 1:
            last = frame
            continue
        if run is not None:
            yield run[0], first, last, *run[2:]
        run, first, last = key, frame, frame
    if run is not None:
        yield run[0], first, last, *run[2:]


def is_bare(header: list[str]) -> bool:
    """Whether the first line of a table is an interval already, and no header."""
    return (
        len(header) in (3, 4) and header[0] != "" and all(cell.isdecimal() for cell in header[1:3])
    )
