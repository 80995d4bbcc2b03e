"""The exact signals of a leak, sample by sample: the same sample, the same bytes, the same group, a near frame.

Each gives every test sample a score in [0, 1] and a flag:

===================  =====================================================  ==================
signal               score                                                  flagged
===================  =====================================================  ==================
identical sample     1 if the id, or the video and frame, are in train      score 1
identical bytes      1 if a picture's file equals one of a train sample     score 1
shared group         1 if the video (object, session ...) is in train       score 1
time gap             ``2^(-gap / near)``, gap in frames within the video    gap <= near
===================  =====================================================  ==================

The pictures' signals, whose thresholds are calibrated on the data, are in ``near``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Progress, quiet
from palpate.data.images import in_threads
from palpate.data.manifest import Manifest
from palpate.report.results import CAUSES, LeakPair, Signal

#: One second of video at 30 frames a second.
NEAR_FRAMES = 30
#: Pictures that are compared byte by byte; backgrounds are shared on purpose.
PICTURES = ("vision", "tactile")
CHUNK = 1 << 20


@dataclass(frozen=True)
class Flags:
    """One signal over all test samples, in their order.

    Attributes:
        kind: the signal's name, as in :class:`palpate.core.Signal`.
        score: (n,) in [0, 1]; NaN where the sample could not be looked at.
        flag: (n,) whether it leaks by this signal.
        nearest: (n,) row of the train sample that it leaks from, or is most like; -1 where there is none.
        threshold: score from which a sample is flagged.
        counts: whether flagged samples count as leaking; a shared group that was not asked about is told but not counted.
        false_positives, edges, unrelated, found: see :class:`palpate.core.Signal`.
        cause: (n,) one of ``CAUSES`` or '' where the score is below the threshold; None for exact signals.
        notes: sentences for people.
    """

    kind: str
    score: NDArray[np.float32]
    flag: NDArray[np.bool_]
    nearest: NDArray[np.int64]
    threshold: float = 1.0
    counts: bool = True
    false_positives: float | None = None
    edges: Sequence[float] = ()
    unrelated: Sequence[int] = ()
    found: Sequence[int] = ()
    cause: NDArray[np.str_] | None = None
    notes: Sequence[str] = field(default_factory=list)

    @property
    def key(self) -> str:
        """The name of its columns in a table: lower case, words joined by underscores."""
        return self.kind.replace("-", "_").replace(" ", "_")

    def columns(self, ids: NDArray[np.object_]) -> dict[str, pl.Series]:
        """Score, flag, nearest train id and, where there are several, the cause, as table columns."""
        near = (
            [str(ids[k]) if k >= 0 else None for k in self.nearest.tolist()]
            if (self.nearest >= 0).any()
            else [None] * len(self.flag)
        )
        out = {
            f"{self.key}_score": pl.Series(self.score, dtype=pl.Float32).fill_nan(None),
            f"{self.key}_flag": pl.Series(self.flag),
            f"{self.key}_nearest": pl.Series(near, dtype=pl.String),
        }
        if self.cause is not None:
            out[f"{self.key}_cause"] = pl.Series(self.cause.tolist(), dtype=pl.String).replace(
                "", None
            )
        return out

    def summary(
        self,
        train: Manifest,
        test: Manifest,
        gaps: NDArray[np.int64],
        rows: NDArray[np.int64],
        worst: int,
    ) -> Signal:
        """The signal as a result; ``gaps`` and ``rows`` are the nearest frames in time, to tell a pair's own gap."""
        causes: dict[str, int] = {}
        if self.cause is not None:
            causes = {name: n for name in CAUSES if (n := int((self.cause == name).sum()))}
        return Signal(
            self.kind,
            int(np.isfinite(self.score).sum()),
            int(self.flag.sum()),
            self.threshold,
            self.false_positives,
            [float(e) for e in self.edges],
            [int(n) for n in self.unrelated],
            [int(n) for n in self.found],
            causes,
            self._worst(train, test, gaps, rows, worst),
            list(self.notes),
            self.counts,
        )

    def _worst(
        self,
        train: Manifest,
        test: Manifest,
        gaps: NDArray[np.int64],
        rows: NDArray[np.int64],
        worst: int,
    ) -> list[LeakPair]:
        """The strongest pairs, one a group first; where pictures look alike for another cause, a few of those last."""
        strong = _varied(np.flatnonzero(self.flag & (self.nearest >= 0)), self.score, test, worst)
        if self.cause is not None:
            for name in CAUSES[1:]:
                strong += _varied(
                    np.flatnonzero((self.cause == name) & (self.nearest >= 0)),
                    self.score,
                    test,
                    min(3, worst),
                )
        pairs: list[LeakPair] = []
        for k in strong:
            j = int(self.nearest[k])
            a, b = test.table.row(k, named=True), train.table.row(j, named=True)
            known = (
                a["video"] is not None
                and a["video"] == b["video"]
                and None not in (a["frame"], b["frame"])
            )
            gap = (
                abs(int(a["frame"]) - int(b["frame"]))
                if known
                else int(gaps[k])
                if rows[k] == j and gaps[k] >= 0
                else None
            )
            cause = str(self.cause[k]) if self.cause is not None else ""
            pairs.append(
                LeakPair(test.ref(a), train.ref(b), gap, round(float(self.score[k]), 4), cause)
            )
        return pairs


def identical_samples(
    train: Manifest, test: Manifest, gaps: NDArray[np.int64], rows: NDArray[np.int64]
) -> Flags:
    """Test samples whose id, or whose video and frame, are in train.

    Args:
        train: the samples to compare with.
        test: the samples to judge.
        gaps: (n,) distance to the nearest train frame of the same video, -1 where there is none.
        rows: (n,) its row in train.
    """
    place = {name: k for k, name in enumerate(train.ids)}
    same = np.array([place.get(name, -1) for name in test.ids], np.int64)
    nearest = np.where(same >= 0, same, np.where(gaps == 0, rows, -1))
    flag = nearest >= 0
    return Flags("identical sample", flag.astype(np.float32), flag, nearest)


def shared_group(train: Manifest, test: Manifest, column: str, *, counts: bool) -> Flags | None:
    """Test samples whose group is in train; None if either side does not know the column at all.

    Rows without a group score NaN: nothing is known of them.
    """
    a, b = train.table[column], test.table[column]
    if a.null_count() == len(a) or b.null_count() == len(b):
        return None
    known = b.is_not_null().to_numpy()
    shared = b.is_in(a.drop_nulls().unique().implode()).fill_null(False).to_numpy()
    score = np.where(known, shared, np.nan).astype(np.float32)
    notes = [
        f"{n} test samples have no {column}: nothing is known of them."
        for n in [int((~known).sum())]
        if n
    ]
    notes += [
        f"{n} train samples have no {column}: what they share is not seen."
        for n in [a.null_count()]
        if n
    ]
    if not counts and shared.any():
        notes.append(
            f"Told, but not counted as a leak: the {column} is not what this audit was asked to keep apart."
        )
    return Flags(
        f"shared {column}", score, shared, np.full(len(b), -1, np.int64), counts=counts, notes=notes
    )


def time_gap(
    gaps: NDArray[np.int64], rows: NDArray[np.int64], near: int = NEAR_FRAMES
) -> Flags | None:
    """Nearness in time to the nearest train frame of the same video; None where no test sample has one.

    Args:
        gaps: (n,) distance in frames, -1 where there is none.
        rows: (n,) row of that frame in train.
        near: flagged up to this many frames; the score halves with each further ``near``.
    """
    if not (gaps >= 0).any():
        return None
    score = np.where(gaps >= 0, np.exp2(-gaps / max(near, 1)), 0.0).astype(np.float32)
    return Flags(
        "time gap",
        score,
        (gaps >= 0) & (gaps <= near),
        rows,
        threshold=0.5 if near else 1.0,
        notes=[f"Flagged up to {near} frames; the score is 2^(-gap/{near})."]
        if near
        else ["Flagged at a gap of 0 frames only."],
    )


def identical_bytes(train: Manifest, test: Manifest, progress: Progress = quiet) -> Flags | None:
    """Test samples one of whose pictures is, byte for byte, a picture of a train sample; None without pictures on both sides.

    Only files of equal size are read. Of several equal train files the first row counts.
    """
    first: dict[Path, int] = {}
    for column in PICTURES:
        for k, name in enumerate(train.column(column)):
            if name is not None:
                first.setdefault(train.path(name), k)
    used = [
        (k, test.path(name))
        for column in PICTURES
        for k, name in enumerate(test.column(column))
        if name is not None
    ]
    sizes = {path: _size(path) for path in {*first, *(path for _, path in used)}}
    if not first or not any(sizes[path] > 0 for _, path in used):
        return None
    both = {sizes[p] for p in first} & {sizes[p] for _, p in used} - {-1, 0}
    doubtful = sorted(p for p, size in sizes.items() if size in both)
    digests: dict[Path, str | None] = {}
    for done, (path, value) in enumerate(in_threads(_digest, doubtful), 1):
        digests[path] = value
        progress("comparing files", done, len(doubtful))
    owner: dict[str, int] = {}
    for path, k in first.items():
        if (value := digests.get(path)) is not None:
            owner[value] = min(k, owner.get(value, k))
    nearest = np.full(len(test), -1, np.int64)
    seen = np.zeros(len(test), bool)
    for k, path in used:
        seen[k] |= sizes[path] >= 0
        if nearest[k] < 0 and (value := digests.get(path)) is not None:
            nearest[k] = owner.get(value, -1)
    flag = nearest >= 0
    empty = sum(sizes[p] == 0 for p in sizes)
    notes = [f"{empty} files are empty (0 bytes) and were not compared."] if empty else []
    return Flags(
        "identical bytes",
        np.where(seen, flag, np.nan).astype(np.float32),
        flag,
        nearest,
        notes=notes,
    )


def signal_table(
    test: Manifest, train: Manifest, found: Sequence[Flags], gaps: NDArray[np.int64]
) -> pl.DataFrame:
    """Every signal of every test sample: ``id, video, frame, material, leaking, gap`` and the columns of each signal."""
    ids = np.array(train.ids, object)
    columns: Mapping[str, pl.Series] = {
        name: series for flags in found for name, series in flags.columns(ids).items()
    }
    gap = pl.Series(gaps).replace(-1, None)
    return test.table.select("id", "video", "frame", "material").with_columns(
        leaking=pl.Series(leaking(found, len(test))), gap=gap, **columns
    )


def leaking(found: Sequence[Flags], count: int) -> NDArray[np.bool_]:
    """(count,) whether any signal that counts flags the sample."""
    out = np.zeros(count, bool)
    for flags in found:
        if flags.counts:
            out |= flags.flag
    return out


def _varied(
    rows: NDArray[np.int64], score: NDArray[np.float32], test: Manifest, most: int
) -> list[int]:
    """Up to ``most`` rows by falling score, the best of each video first."""
    order = rows[np.argsort(-score[rows], kind="stable")].tolist()
    videos = test.table["video"]
    best: dict[str | None, int] = {}
    for k in order:
        if len(best) >= most:
            break
        best.setdefault(videos[k], k)
    first = list(best.values())
    taken = set(first)
    return [*first, *(k for k in order if k not in taken)][:most]


def _size(path: Path) -> int:
    """Size in bytes, -1 if there is no such file."""
    try:
        return path.stat().st_size
    except OSError:
        return -1


def _digest(path: Path) -> str | None:
    """BLAKE2b of a file's bytes; None if it cannot be read."""
    found = hashlib.blake2b(digest_size=16)
    try:
        with path.open("rb") as file:
            while block := file.read(CHUNK):
                found.update(block)
    except OSError:
        return None
    return found.hexdigest()
