"""The exact signals of a leak, sample by sample: same sample, same bytes, same group, near frame.

Each gives every test sample a score in [0, 1] and a flag:

===================  =====================================================  ==================
signal               score                                                  flagged
===================  =====================================================  ==================
identical sample     1 if the id, or the video and frame, are in train and  score 1
                     no image file of the two differs
identical bytes      1 if an image file equals one of a train sample        score 1
shared group         1 if the video (object, session ...) is in train       score 1
time gap             ``2^(-gap / near)``, gap in frames within the video    gap <= near
===================  =====================================================  ==================

The signals of the images' content, whose thresholds are calibrated, are in ``near``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Note, Progress, quiet
from palpate.data.images import file_digest, file_stamp, in_threads
from palpate.data.manifest import SIDES, Manifest
from palpate.report.records import CANNOT_TELL, CAUSES, LeakPair, Signal

Ints = NDArray[np.int64]
#: The strongest pairs of a signal that are kept, and those of each cause that is no leak.
WORST, HARMLESS_PAIRS = 12, 3


@dataclass(frozen=True)
class Gaps:
    """The nearest train frame of the same video."""

    row: Ints  # (n,) its row in train; -1 where there is none
    frames: Ints  # (n,) its distance; -1 where there is none


def nearest_in_video(train: pl.DataFrame, test: pl.DataFrame) -> Gaps:
    """For each test row the nearest train row of the same video."""
    row, gap = np.full(test.height, -1, np.int64), np.full(test.height, -1, np.int64)
    base, queries = (
        table.select("video", "frame", frame_of=pl.col("frame"))
        .with_row_index(name)
        .drop_nulls()
        .sort("frame")
        for table, name in ((train, "train"), (test, "test"))
    )
    nearest = queries.join_asof(
        base, on="frame", by="video", strategy="nearest", check_sortedness=False
    ).drop_nulls("train")
    at = nearest["test"].to_numpy()
    row[at] = nearest["train"].to_numpy()
    gap[at] = (nearest["frame"] - nearest["frame_of_right"]).abs().to_numpy()
    return Gaps(row, gap)


def by_contact(*tables: pl.DataFrame) -> list[pl.DataFrame]:
    """The tables with contacts for videos, where frames begin anew in every contact of a video.

    Contacts of two tables are compared only where the paths of both gave them their names.
    """
    named = [t.select("video", "frame", "contact").drop_nulls().unique() for t in tables]
    if all("path" in t.columns for t in tables):
        named = [pl.concat(named).unique()]
    if not any(t.select("video", "frame").is_duplicated().any() for t in named):
        return list(tables)
    contact = pl.format("{}: {}", "video", "contact")
    return [t.with_columns(video=pl.coalesce(contact, "video")) for t in tables]


@dataclass(frozen=True, kw_only=True, eq=False)
class Flags(Signal):
    """A signal with what it says of every test sample, in their order."""

    score: NDArray[np.float32]  # (n,) in [0, 1]; NaN where the sample could not be checked
    flag: NDArray[np.bool_]  # (n,) whether it leaks by this signal
    #: (n,) row of the train sample that it leaks from, or is most similar to; -1 for none.
    nearest: Ints
    #: (n,) one of ``CAUSES``, or '' below the threshold; None for exact signals.
    cause: NDArray[np.str_] | None = None
    unread: float = 0.0  # the share of train or test, the larger, whose image cannot be read

    @classmethod
    def of(
        cls,
        kind: str,
        score: NDArray[np.float32],
        flag: NDArray[np.bool_],
        nearest: Ints,
        threshold: float = 1.0,
        **facts: Any,
    ) -> Flags:
        """Flags and how many they are; ``facts`` are further fields."""
        counts = int(np.isfinite(score).sum()), int(flag.sum())
        return cls(kind, *counts, threshold, score=score, flag=flag, nearest=nearest, **facts)

    def columns(self, ids: NDArray[np.object_]) -> dict[str, pl.Series]:
        """Score, flag, nearest train id and, where known, the cause, as table columns."""
        key = self.kind.replace("-", "_").replace(" ", "_")
        near = [str(ids[k]) if k >= 0 else None for k in self.nearest.tolist()]
        columns = {
            f"{key}_score": pl.Series(self.score, dtype=pl.Float32).fill_nan(None),
            f"{key}_flag": pl.Series(self.flag),
            f"{key}_nearest": pl.Series(near, dtype=pl.String),
        }
        if self.cause is not None:
            causes = pl.Series(self.cause.tolist(), dtype=pl.String)
            columns[f"{key}_cause"] = causes.replace("", None)
        return columns

    def summary(self, train: Manifest, test: Manifest, gaps: Gaps) -> Signal:
        """The signal as a result, with its strongest pairs."""
        signal = Signal(*(getattr(self, f.name) for f in fields(Signal)))
        if self.cause is not None:
            counts = {name: int((self.cause == name).sum()) for name in CAUSES}
            signal = replace(signal, causes={name: n for name, n in counts.items() if n})
        return replace(signal, worst=self._worst(train, test, gaps))

    def _worst(self, train: Manifest, test: Manifest, gaps: Gaps) -> list[LeakPair]:
        """The strongest pairs, one a video first; then a few of each cause that is no leak."""
        paired = self.nearest >= 0
        ranked = self.flag | (self.verdict == CANNOT_TELL)
        chosen = varied(np.flatnonzero(ranked & paired), self.score, test)
        if self.cause is not None:
            for name in CAUSES[1:]:
                rows = np.flatnonzero((self.cause == name) & paired)
                chosen += varied(rows, self.score, test, HARMLESS_PAIRS)
        return [self._pair(train, test, gaps, k) for k in chosen]

    def _pair(self, train: Manifest, test: Manifest, gaps: Gaps, k: int) -> LeakPair:
        j = int(self.nearest[k])
        a, b = test.table.row(k, named=True), train.table.row(j, named=True)
        gap = None
        if a["video"] == b["video"] and None not in (a["video"], a["frame"], b["frame"]):
            gap = abs(a["frame"] - b["frame"])
        cause = str(self.cause[k]) if self.cause is not None else ""
        score = round(float(self.score[k]), 4)
        return LeakPair(test.ref(a), train.ref(b), gap, score, cause)


def identical_samples(
    train: Manifest,
    test: Manifest,
    gaps: Gaps,
    named: Collection[str] = ("id", "video"),
    *,
    stated: bool = False,
) -> Flags:
    """Test samples whose id, or whose video and frame, are in train.

    Those with other images than there are not; unless they are ``stated`` to be the same.
    ``named`` are the columns in which equal names mean the same thing; without ``id`` and ``video``
    nothing can be checked.
    """
    ids = train.table.select("id").with_row_index("row").unique("id", keep="last")
    ids = ids if "id" in named else ids.clear()
    rows = test.table.select("id").join(ids, on="id", how="left", maintain_order="left")["row"]
    same = rows.cast(pl.Int64).fill_null(-1).to_numpy()
    nearest = np.where(same >= 0, same, np.where(gaps.frames == 0, gaps.row, -1))
    if not stated:
        nearest[_differ(train, test, nearest)] = -1
    flag = nearest >= 0
    score = np.where(bool({"id", "video"} & {*named}), flag, np.nan).astype(np.float32)
    return Flags.of("identical sample", score, flag, nearest)


def _differ(train: Manifest, test: Manifest, row: Ints) -> NDArray[np.bool_]:
    """(n,) whether a sample and that row of train have files of one kind that are not equal."""
    differ = np.zeros(len(test), bool)
    for column in SIDES:
        mine, base = test.column(column), train.column(column)
        for k in np.flatnonzero(row >= 0).tolist():
            if (name := mine[k]) and (other := base[row[k]]):
                files = [test.path(name), train.path(other)]
                sizes = {file_stamp(file)[0] for file in files}
                if -1 not in sizes and files[0] != files[1]:
                    differ[k] |= len(sizes) > 1 or len({*map(file_digest, files)}) > 1
    return differ


def shared_group(train: Manifest, test: Manifest, column: str, *, counts: bool) -> Flags | None:
    """Test samples whose group is in train; None if either part does not know the column at all.

    Rows without a group score NaN.
    """
    a, b = train.table[column], test.table[column]
    if a.null_count() == len(a) or b.null_count() == len(b):
        return None
    shared = b.is_in(a.drop_nulls().unique().implode()).fill_null(False).to_numpy()
    score = np.where(b.is_not_null().to_numpy(), shared, np.nan).astype(np.float32)
    notes = [
        Note("signal-nulls", {"count": n, "part": part, "group": column})
        for part, n in (("test", b.null_count()), ("train", a.null_count()))
        if n
    ]
    if not counts and shared.any():
        notes.append(Note("signal-not-counted", {"group": column}))
    none = np.full(len(b), -1, np.int64)
    return Flags.of(f"shared {column}", score, shared, none, counts=counts, notes=notes)


def time_gap(gaps: Gaps, near: int) -> Flags | None:
    """Nearness to the nearest train frame of the same video; None where no test sample has one.

    Args:
        gaps: the nearest train frames.
        near: flagged up to this many frames; the score halves with each further ``near``.
    """
    timed = gaps.frames >= 0
    if not timed.any():
        return None
    score = np.where(timed, np.exp2(-gaps.frames / max(near, 1)), 0.0).astype(np.float32)
    return Flags.of(
        "time gap",
        score,
        timed & (gaps.frames <= near),
        gaps.row,
        threshold=0.5 if near else 1.0,
        notes=[Note("near-frames", {"frames": near})],
    )


def identical_bytes(train: Manifest, test: Manifest, progress: Progress = quiet) -> Flags | None:
    """Test samples with an image file that is, byte for byte, one of a train sample.

    None without images in both parts. Only files of equal size are read. Of several equal train
    files the first row counts.
    """
    base, queries = _files(train), _files(test)
    sizes = {path: file_stamp(path)[0] for _, path in (*base, *queries)}
    if not base or not any(sizes[path] > 0 for _, path in queries):
        return None
    common = {sizes[p] for _, p in base} & {sizes[p] for _, p in queries} - {-1, 0}
    candidates = sorted(path for path, size in sizes.items() if size in common)
    digests = dict(in_threads(file_digest, candidates, "comparing files", progress))
    first: dict[str, int] = {}
    for row, path in sorted(base):
        if digest := digests.get(path):
            first.setdefault(digest, row)
    nearest = np.full(len(test), -1, np.int64)
    checked = np.zeros(len(test), bool)
    for row, path in queries:
        checked[row] |= sizes[path] >= 0
        if nearest[row] < 0:
            nearest[row] = first.get(digests.get(path) or "", -1)
    flag = nearest >= 0
    score = np.where(checked, flag, np.nan).astype(np.float32)
    empty = sum(size == 0 for size in sizes.values())
    notes = [Note("empty-files", {"count": empty})] if empty else []
    return Flags.of("identical bytes", score, flag, nearest, notes=notes)


def signal_table(
    test: Manifest, train: Manifest, flags: Sequence[Flags], gaps: Gaps
) -> pl.DataFrame:
    """A row for each test sample: ``id, video, frame, material, leaking, gap`` and every signal."""
    ids = np.array(train.ids, object)
    table = test.table.select("id", "video", "frame", "material").with_columns(
        leaking=pl.Series(leaking(flags, len(test))), gap=pl.Series(gaps.frames).replace(-1, None)
    )
    return table.with_columns(s.alias(name) for f in flags for name, s in f.columns(ids).items())


def leaking(flags: Sequence[Flags], count: int) -> NDArray[np.bool_]:
    """(count,) whether any signal that counts flags the sample."""
    counted = [f.flag for f in flags if f.counts]
    return np.any(counted, axis=0) if counted else np.zeros(count, bool)


def varied(rows: Ints, score: NDArray[Any], test: Manifest, most: int = WORST) -> list[int]:
    """Up to ``most`` rows by falling score, the best of each video first."""
    order = rows[np.argsort(-score[rows], kind="stable")].tolist()
    videos = test.table["video"].to_list()
    best: dict[str | None, int] = {}
    for k in order:
        if len(best) >= most:
            break
        best.setdefault(videos[k], k)
    return list(dict.fromkeys([*best.values(), *order]))[:most]


def _files(manifest: Manifest) -> list[tuple[int, Path]]:
    """(row, file) of all images but backgrounds, which are shared on purpose."""
    return [
        (row, manifest.path(name))
        for column in SIDES
        for row, name in enumerate(manifest.column(column))
        if name is not None
    ]
