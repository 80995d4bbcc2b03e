"""Interval lists: contacts as ``video,start,end,label`` lines, with or without recordings.

::

    root/
      contacts.csv                     any table (:mod:`palpate.data.tables`), or lines of
                                       ``video start end [label]``
      <video>/video.mp4  gelsight.mp4, or video_frame/ gelsight_frame/, as in Touch and Go, also
                                       under dataset/ or final_dataset/

Columns of other names are given by map expressions (:mod:`palpate.data.mapping`); without a header
the order is video, start, end, label. ``start`` and ``end`` are frame numbers from 0 that **both
belong to the contact**. ``label`` (or ``material``), ``object``, ``text`` and ``session`` are
optional. A label of -1 marks contact of unclear
material: no samples, but no background is taken from there either.

Each interval is a contact ``video#000k`` in the order of frames; each of its frames is a sample
(``every`` thins). Backgrounds follow the rule of Touch and Go. Intervals that overlap are all
skipped: which is true is unknown. Without recordings every frame of an interval is a sample by its
name alone.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from palpate.core import PalpateError, Problem, Progress, quiet, require
from palpate.data.formats.layout import require_videos
from palpate.data.formats.recordings import Pairing, Recordings, Row
from palpate.data.images import Check
from palpate.data.imported import Imported
from palpate.data.manifest import Manifest, is_image
from palpate.data.mapping import LINE, compile_maps
from palpate.data.rows import manifest_rows, read_classes, without_repeats
from palpate.data.scanning import Facts, Format, Into, Scan, require_some
from palpate.data.tables import (
    INCONCLUSIVE,
    TABLES,
    Table,
    csv_table,
    first_line,
    header_of,
    lines_of,
    open_table,
    text_in,
)

FACTS = Facts(
    name="your own recordings with an interval list",
    samples="as many as the intervals have frames",
    group="the column video",
)
NEEDED = ("video", "start", "end")
ORDER = ("video", "start", "end", "label")
WORDS = ("material", "object", "text", "session")
END = pl.col("end")
#: Between the cells of a line.
SEPARATORS = re.compile(r"[\s,;]+")
#: Frames that the intervals of one list may have together, where there are no recordings.
MOST_FRAMES = 20_000_000
LOOKS_FOR = f"a table with the columns {', '.join(ORDER)}, next to folders of recordings"


@dataclass(frozen=True)
class Interval:
    """A contact: frames ``first`` to ``last``, both included."""

    where: str
    video: str
    first: int
    last: int
    words: Mapping[str, str | None]  # further cells of the manifest
    inconclusive: bool


def detect(source: Path) -> bool:
    """Whether this is a table with video, start and end and without images, or bare lines."""
    first = _first_row(source) if source.is_file() else []
    if {"vision", "tactile"} & set(first):
        return False
    return _is_bare(first) or set(NEEDED) <= set(first)


def by_name(
    source: Path, columns: Mapping[str, str] | None = None, classes: Path | None = None
) -> Imported:
    """Every frame of every interval, by its name; a frame of several intervals is of the first.

    Raises:
        PalpateError: if there are more than ``MOST_FRAMES``, or none.
    """
    result = Scan(source.parent)
    rows = _read(result, source, columns, classes)
    rows = rows.filter(~pl.col("unclear"))
    count = int((rows["end"] - rows["start"] + 1).sum())
    must, fix = f"{source} must have at most {MOST_FRAMES:,} frames", "Check their ends"
    require(count <= MOST_FRAMES, None, must, f"{count:,}", fix=fix)
    require_some(count, source, result.problems)
    contact = pl.format("{}#{}-{}", "video", "start", "end")
    frames = rows.select("video", *WORDS, contact=contact, frame=pl.int_ranges("start", END + 1))
    frames = frames.explode("frame").unique(["video", "frame"], keep="first", maintain_order=True)
    frames = frames.with_columns(id=pl.format("{}/{}", "video", "frame"))
    manifest = Manifest.of_table(frames, source.parent, {"dataset": source.stem})
    result.problems.sort(key=Problem.sort_key)
    return Imported(manifest, result.problems, inconclusive=result.inconclusive)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a list and its recordings are read by.

    Attributes:
        root: folder of the recordings (default: that of the list).
        columns: ``video``, ``start``, ``end``, ``material`` ... -> map expression.
        classes: table of classes, whose numbers are the labels.
        every: take every n-th frame of a contact, from its first.
        sensor: the tactile sensor.
        size: their shorter side is reduced to so many pixels.
        pairing: whether frames of both sides belong together by their time stamps, where these
            show other rates or gaps, or by number.
    """

    root: Path | None = None
    columns: Mapping[str, str] | None = None
    classes: Path | None = None
    every: int = 1
    sensor: str | None = None
    size: int | None = None
    pairing: Pairing = "time"


def scan(
    source: Path,
    options: Options,
    *,
    check: Check = "decode",
    into: Into | None = None,
    progress: Progress = quiet,
) -> Scan:
    """Read a list and its recordings; without ``into`` nothing is written."""
    every, columns = options.every, options.columns
    require(every >= 1, "every", "must be at least 1", every)
    base = source.parent if options.root is None else Path(options.root)
    must = "must be the folder of the recordings"
    require(base.is_dir(), "root", must, f"no folder {base}", fix="Check the path")
    result = Scan(base, {"dataset": source.stem})
    work = Recordings(result, into, require_videos(base), {}, options.size, pairing=options.pairing)
    listed = [
        Interval(
            f"{source}:{row[LINE]}",
            row["video"],
            row["start"],
            row["end"],
            {"sensor": options.sensor} | {name: row[name] for name in WORDS if row[name]},
            row["unclear"],
        )
        for row in _read(result, source, columns, options.classes).iter_rows(named=True)
    ]
    contacts = _contacts(work, listed, progress)
    rows = [row for name in contacts for row in _frames(work, name, contacts[name], every)]
    starts = {contact: (i.video, i.first) for contact, i in contacts.items()}
    work.add(rows, starts, check=check, progress=progress)
    result.state_texts(f"column {(columns or {}).get('text', 'text')}")
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan, record=Options)


def _first_row(path: Path) -> list[str]:
    """The cells of the first line that is not empty."""
    if path.suffix.lower() in TABLES:
        return header_of(path)
    return SEPARATORS.split(first_line(path))


def _is_bare(cells: list[str]) -> bool:
    """Whether the cells of a first line are an interval already, and no header."""
    numbers = all(cell.isdecimal() for cell in cells[1:3])
    return len(cells) in (3, 4) and cells[0] != "" and numbers and not is_image(cells[0])


def _of_lines(path: Path, names: Sequence[str] | None) -> Table:
    """The table of a text whose cells spaces, tabs, commas or semicolons separate.

    The last cell of a line may be absent.
    """
    header = ORDER if names else SEPARATORS.split(first_line(path))
    rows = (SEPARATORS.split(line.strip()) for line in lines_of(text_in(path)))
    filled = ([*cells, ""] if len(cells) == len(header) - 1 else cells for cells in rows)
    return csv_table(path, "\n".join(map(",".join, filled)), ORDER if names else None)


def _read(
    result: Scan, path: Path, columns: Mapping[str, str] | None, classes: Path | None
) -> pl.DataFrame:
    """The well-formed intervals of a list, in its order.

    Returns:
        ``LINE``, the columns of ``NEEDED`` and ``WORDS``, and ``unclear``: whether the material is.
    """
    first = _first_row(path)
    names = ORDER[: len(first)] if _is_bare(first) else None
    table = open_table(path, names) if path.suffix.lower() in TABLES else _of_lines(path, names)
    maps = dict(columns or {})
    if "label" in table.names and "material" not in table.names:
        maps.setdefault("material", "label")
    compiled = compile_maps(maps, table.names, [*NEEDED, *WORDS])
    absent = [name for name in NEEDED if name not in compiled.expressions]
    if absent and (table.names or not table.problems):
        got = f"no {', '.join(absent)} among {', '.join(table.names) or 'no columns'}"
        must, example = f"{path} must have the columns {', '.join(NEEDED)}", {absent[0]: "COLUMN"}
        raise PalpateError(must, got, "Map your columns", example={"columns": example})
    cells = compiled.apply(table.read(compiled.columns))
    result.problems += table.problems
    cells = without_repeats(cells, table.place, result.problems)
    cells = cells.with_columns(
        pl.lit(None, pl.String).alias(name)
        for name in (*NEEDED, *WORDS)
        if name not in cells.columns
    )
    unclear = (pl.col("material") == str(INCONCLUSIVE)).fill_null(False)
    labels = read_classes(classes)
    parts = [
        manifest_rows(cells.filter(~unclear), table.place, labels, result.problems)[0],
        manifest_rows(cells.filter(unclear), table.place, None, result.problems)[0],
    ]
    rows = pl.concat(parts).with_columns(unclear=unclear).sort(LINE)
    empty = pl.any_horizontal(pl.col(NEEDED).is_null())
    for row in rows.filter(empty | (pl.col("start") > END)).iter_rows(named=True):
        lacking = [name for name in NEEDED if row[name] is None]
        text = f"the contact ends at frame {row['end']} before it starts at {row['start']}"
        problem = (
            ("empty-cell", f"no {' and no '.join(lacking)}") if lacking else ("bad-interval", text)
        )
        result.problem(table.place(row[LINE]), *problem)
    rows = rows.filter(~empty & (pl.col("start") <= END))
    result.inconclusive = int(rows["unclear"].sum())
    return rows


def _contacts(work: Recordings, listed: list[Interval], progress: Progress) -> dict[str, Interval]:
    """The usable contacts by name; opens their recordings."""
    rows = [Row(i.where, i.video, i.video, i.first, i.where) for i in listed]
    opened = {row.where for row in work.open(rows, progress)}
    listed = [i for i in listed if i.where in opened and _within(work, i)]
    in_contact: dict[str, set[int]] = {i.video: set() for i in listed}
    for i in listed:
        in_contact[i.video].update(range(i.first, i.last + 1))
    work.in_contact = in_contact
    contacts: dict[str, Interval] = {}
    count: Counter[str] = Counter()
    for i in _apart(listed, work.scan.problems):
        if not i.inconclusive:
            count[i.video] += 1
            contacts[f"{i.video}#{count[i.video]:04d}"] = i
    return contacts


def _within(work: Recordings, interval: Interval) -> bool:
    """Whether an interval is within the recording; if not, it is a problem."""
    length = min(map(len, work.frames[interval.video].values()))
    if interval.last >= length:
        text = f"the contact reaches frame {interval.last} of {interval.video!r}: both modalities "
        text += f"have {length} frames, counted from 0"
        work.scan.problem(interval.where, "beyond-end", text)
    return interval.last < length


def _apart(listed: list[Interval], problems: list[Problem]) -> list[Interval]:
    """The intervals that share no frame with another, sorted by video and frame."""
    ordered = sorted(listed, key=lambda i: (i.video, i.first, i.last))
    overlaps: dict[str, tuple[Interval, Interval]] = {}
    widest: Interval | None = None  # of those before, the one that reaches furthest
    for i in ordered:
        same = widest if widest is not None and widest.video == i.video else None
        if same is not None and i.first <= same.last:
            overlaps[i.where] = i, same
            overlaps.setdefault(same.where, (same, i))
        widest = same if same is not None and same.last >= i.last else i
    for i, other in overlaps.values():
        text = f"frames {i.first} to {i.last} of {i.video!r} overlap with "
        text += f"{other.first} to {other.last} at {other.where}"
        problems.append(Problem(i.where, "overlap", text))
    return [i for i in ordered if i.where not in overlaps]


def _frames(work: Recordings, contact: str, interval: Interval, every: int) -> list[Row]:
    """A row for each frame that both modalities have; one problem for those that one lacks."""
    video, where = interval.video, interval.where
    numbers = range(interval.first, interval.last + 1, every)
    missing: set[int] = set()
    for modality, source in work.frames[video].items():
        if lacking := [k for k in numbers if not source.has(k)]:
            text = f"no {modality} image of {len(lacking)} of the frames of {contact}, the first "
            text += f"of them {lacking[0]}, in {source.source}"
            work.scan.problem(where, "missing-file", text)
            missing.update(lacking)
    frames = (k for k in numbers if k not in missing)
    return [Row(where, f"{video}/{k:010d}", video, k, contact, interval.words) for k in frames]
