"""Precision, recall, density and coverage: do generated touches lie among the real ones, and real ones among the generated?

The ball of a sample reaches to its k-th nearest neighbor in its own set. With ``B_k(r)`` the balls of the m real samples and
``B_k(g)`` those of the n generated ones (Kynkäänniemi et al., arXiv 1904.06991; Naeem et al., arXiv 2002.09797)::

    precision = share of generated samples inside at least one real ball
    recall    = share of real samples inside at least one generated ball
    density   = number of (generated sample, real ball around it) / (k n)
    coverage  = share of real balls with at least one generated sample inside

Conventions. A sample is not its own neighbor; an equal row of another sample is one, at distance 0. *Inside* is strictly nearer than
the radius, as in the package ``prdc``, whose ``nearest_k`` is our k (Kynkäänniemi et al. write <=, which differs in ties alone). Distances that
differ by less than rounding (1e-12 of the squared norms about the center) are ties, so that no value depends on the block size; a ball of
radius 0, around a row that occurs more than k times, holds nothing.

**Videos.** Neighboring frames of one video are nearly equal. A k-th neighbor among all frames is therefore a frame of the same video,
and the radius measures the frame rate: at 30 Hz real touches of another video would score a precision near 0. Where groups are known,
``grouped`` looks for the k neighbors in *other* groups; the comparison of the two sets is over all pairs. The density of samples of new
videos is then near 1, and that of samples of the reference's own videos larger, by as much as their balls hold of their own video.

All four depend on n, m and k: compare at equal numbers alone. O((n^2 + m^2 + n m) d) time in float64, memory of one block of pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate import __version__
from palpate.core import FeatureSet, PalpateError, Progress, Score, quiet
from palpate.metrics.inputs import (
    Floats,
    checked_level,
    checked_names,
    checked_pair,
    checked_whole,
    copies_across,
)
from palpate.metrics.intervals import mean_interval

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Rows by columns of the blocks of pairs: 32 MB of squared distances.
BLOCK = (1024, 4096)
#: Squared distances closer than this share of the squared norms are equal.
TIE = 1e-12


def prdc(
    generated: FeatureSet,
    reference: FeatureSet,
    k: int = 5,
    *,
    grouped: bool | None = None,
    normalize: bool = False,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
    progress: Progress = quiet,
) -> list[Score]:
    """Precision, recall, density and coverage, in that order; higher is better for all four.

    Args:
        generated: (n, d) features of generated touches, n > k.
        reference: (m, d) features of real touches, m > k.
        k: which neighbor gives the radius; 5 as in Naeem et al. (Kynkäänniemi et al. use 3).
        grouped: look for neighbors in other groups only; see the head of this file. Default: where both sets have groups. ``False`` gives the
            values of the package ``prdc``.
        normalize: divide every row by its norm first.
        subject: what is scored, kept in the scores.
        split: digest of the split, kept in the scores.
        level: coverage of the intervals.
        progress: told how many rows are done, three times.

    Returns:
        Four scores. The intervals are of the mean over rows (generated ones for precision and density, real ones for the other two),
        robust to whole groups deviating together; the balls are taken as they are. ``details`` holds the median radii.

    Raises:
        PalpateError: on features that are refused, unequal widths, encoders of different digests, k < 1, a set of k rows or fewer, or
            (grouped) a group outside which there are fewer than k rows.
    """
    return prdc_rows(
        generated,
        reference,
        k,
        grouped=grouped,
        normalize=normalize,
        subject=subject,
        split=split,
        level=level,
        progress=progress,
    )[0]


def prdc_rows(
    generated: FeatureSet,
    reference: FeatureSet,
    k: int = 5,
    *,
    grouped: bool | None = None,
    normalize: bool = False,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
    progress: Progress = quiet,
) -> tuple[list[Score], dict[str, Array]]:
    """As :func:`prdc`, with what each score is the mean of: (n,) of the generated rows for Precision and Density, (m,) of the real ones for the others."""
    checked_whole(1, k=k)
    checked_level(level)
    x, y = checked_sets(generated, reference, normalize=normalize, least=k + 1)
    groups = [
        checked_names("groups", s.groups, len(v))
        for s, v in zip((generated, reference), (x, y), strict=True)
    ]
    known = groups[0] is not None and groups[1] is not None
    if grouped and not known:
        raise PalpateError(
            "grouped=True must have groups in both sets",
            "a set without",
            "Fill groups, or pass grouped=False",
        )
    grouped = known if grouped is None else grouped
    center = (x.sum(axis=0, dtype=np.float64) + y.sum(axis=0, dtype=np.float64)) / (len(x) + len(y))
    sets = [
        _Set.of(name, v, center, g if grouped else None, k, progress)
        for name, v, g in zip(("generated", "real"), (x, y), groups, strict=True)
    ]
    inside, note = _compare(sets[0], sets[1], progress), copies_note(copies_across(x, y), len(x))
    settings = {"k": k, "grouped": grouped, "normalize": normalize, "inside": "<"}
    common: dict[str, Any] = {
        "subject": subject,
        "level": level,
        "estimator": "per-row mean",
        "n": len(x),
        "m": len(y),
        "encoder": generated.encoder,
        "reference": reference.digest,
        "split": split,
        "higher_is_better": True,
        "settings": settings,
    }
    rows = {
        "Precision": inside.precision,
        "Recall": inside.recall,
        "Density": inside.density / k,
        "Coverage": inside.coverage,
    }
    scores = [
        _score("Precision", inside.precision, groups[0], sets, note, common),
        _score("Recall", inside.recall, groups[1], sets, note, common),
        _score("Density", inside.density / k, groups[0], sets, note, common),
        _score("Coverage", inside.coverage, groups[1], sets, note, common),
    ]
    return scores, {name: np.asarray(v, dtype=np.float64) for name, v in rows.items()}


def checked_sets(
    generated: FeatureSet, reference: FeatureSet, *, normalize: bool, least: int
) -> tuple[Floats, Floats]:
    """The features of both sets of one width and dtype.

    Raises:
        PalpateError: as :func:`palpate.metrics.inputs.checked_pair`, and on encoders of different digests.
    """
    if (
        generated.encoder is not None
        and reference.encoder is not None
        and generated.encoder != reference.encoder
    ):
        got = f"digests {generated.encoder[:12]} and {reference.encoder[:12]}"
        raise PalpateError(
            "Generated and reference features must come from one encoder",
            got,
            "Embed both with the same encoder",
        )
    names = ("The generated features", "The reference features")
    return checked_pair(
        generated.features, reference.features, normalize=normalize, least=least, names=names
    )


def copies_note(copies: int | None, n: int) -> str:
    """What is to be said of generated rows that equal real ones."""
    return (
        f"{copies} of {n} generated rows equal a real row bit for bit: a copy is not a generator"
        if copies
        else ""
    )


@dataclass(frozen=True)
class _Set:
    """One set with its balls.

    Attributes:
        x: (n, d), float32 or float64.
        center: (d,) what is subtracted before any product, so that distances are not lost in a large common mean.
        norms: (n,) squared norms about the center, float64.
        radii: (n,) squared radii.
    """

    x: Floats
    center: Array
    norms: Array
    radii: Array

    @classmethod
    def of(
        cls,
        name: str,
        x: Floats,
        center: Array,
        groups: Sequence[str] | None,
        k: int,
        progress: Progress,
    ) -> _Set:
        norms = np.concatenate(
            [(_rows(x, center, at) ** 2).sum(axis=1) for at in _slices(len(x), BLOCK[0])]
        )
        unit = (
            np.arange(len(x))
            if groups is None
            else np.unique(np.asarray(groups, dtype=str), return_inverse=True)[1]
        )
        others = len(x) - np.bincount(unit)
        if (short := others[unit] < k).any():
            group = groups[int(np.flatnonzero(short)[0])] if groups is not None else ""
            got = f"{int(others[unit][short][0])} outside group {group!r}"
            fix = "Pass a smaller k, more groups, or grouped=False"
            raise PalpateError(
                f"Every group must have at least k = {k} {name} rows outside it", got, fix
            )
        bare = cls(x, center, norms, np.empty(0))
        return cls(x, center, norms, _radii(bare, unit, k, f"radii of {name} samples", progress))


@dataclass(frozen=True)
class _Inside:
    """Per generated row: inside a real ball, number of real balls; per real row: inside a generated ball, ball not empty."""

    precision: Array
    density: Array
    recall: Array
    coverage: Array


def _slices(n: int, step: int) -> list[slice]:
    return [slice(start, min(start + step, n)) for start in range(0, n, step)]


def _rows(x: Floats, center: Array, at: slice) -> Array:
    return x[at].astype(np.float64) - center


def _squares(a: _Set, at: slice, rows: Array, b: _Set, to: slice) -> Array:
    """Squared distances (rows, columns) of one block of pairs; not negative."""
    squares = rows @ _rows(b.x, b.center, to).T
    squares *= -2
    squares += a.norms[at, None]
    squares += b.norms[to]
    return np.maximum(squares, 0, out=squares)


def _radii(own: _Set, unit: Index, k: int, what: str, progress: Progress) -> Array:
    """Squared distance to the k-th nearest row of another unit, (n,)."""
    n = len(own.x)
    radii = np.empty(n)
    for at in _slices(n, BLOCK[0]):
        rows, nearest = _rows(own.x, own.center, at), np.full((at.stop - at.start, k), np.inf)
        for to in _slices(n, BLOCK[1]):
            squares = _squares(own, at, rows, own, to)
            squares[unit[at, None] == unit[to]] = np.inf
            nearest = np.partition(np.hstack([nearest, squares]), k - 1, axis=1)[:, :k]
        furthest = nearest.max(axis=1)
        radii[at] = np.where(
            furthest <= 2 * TIE * own.norms[at], 0, furthest
        )  # what rounding leaves between equal rows
        progress(what, at.stop, n)
    return radii


def _compare(generated: _Set, real: _Set, progress: Progress) -> _Inside:
    """Which generated rows lie in which real balls, and the other way round."""
    n, m = len(generated.x), len(real.x)
    count, recall, coverage = np.zeros(n), np.zeros(m, dtype=bool), np.zeros(m, dtype=bool)
    for at in _slices(n, BLOCK[0]):
        rows = _rows(generated.x, generated.center, at)
        for to in _slices(m, BLOCK[1]):
            squares = _squares(generated, at, rows, real, to)
            squares += TIE * generated.norms[at, None]
            squares += TIE * real.norms[to]
            in_real = squares < real.radii[to]
            count[at] += in_real.sum(axis=1)
            coverage[to] |= in_real.any(axis=0)
            recall[to] |= (squares < generated.radii[at, None]).any(axis=0)
        progress("comparing samples", at.stop, n)
    return _Inside(
        (count > 0).astype(np.float64),
        count,
        recall.astype(np.float64),
        coverage.astype(np.float64),
    )


def _score(
    metric: str,
    values: Array,
    groups: Sequence[str] | None,
    sets: list[_Set],
    note: str,
    common: dict[str, Any],
) -> Score:
    interval, method = mean_interval(values, groups, common["level"])
    if interval is not None:  # the t interval knows no bounds, a share does
        interval = (
            max(0.0, interval[0]),
            interval[1] if metric == "Density" else min(1.0, interval[1]),
        )
    radii = [float(np.median(np.sqrt(s.radii))) for s in sets]
    empty = [int((s.radii == 0).sum()) for s in sets]
    details: dict[str, Any] = {
        "radius_generated": radii[0],
        "radius_real": radii[1],
        "empty_balls": empty[0] if metric == "Recall" else empty[1],
    }
    notes = [note] if note else []
    if details["empty_balls"]:
        balls, total = ("generated", common["n"]) if metric == "Recall" else ("real", common["m"])
        notes.append(
            f"{details['empty_balls']} of {total} {balls} rows occur more than k times: their balls hold nothing"
        )
    if interval is None:
        notes.append("No interval: one group, or no variation between them")
    return Score(
        metric,
        value=float(values.mean()),
        interval=interval,
        interval_method=method,
        details={**details, "version": __version__},
        note=". ".join(notes),
        **common,
    )
