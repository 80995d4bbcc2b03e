"""Distributions of features: FID, and precision, recall, density, coverage.

**FID** is the Fréchet distance of two sets of features taken as Gaussians (arXiv 1706.08500).

``|mu1 - mu2|^2 + tr S1 + tr S2 - 2 tr (S1 S2)^(1/2)``, covariances divided by n - 1, in float64.
The trace of the root is the sum of the roots of the eigenvalues of S1 S2, which ``S1 S2 v = l v``
gives for symmetric matrices without a matrix root (``scipy.linalg.sqrtm`` may turn complex or
fail). Where a covariance is singular, it is that of the singular values of ``F1 F2'`` with factors
``S = F' F``; of n <= d samples the thin ``F = (X - mu) / sqrt(n - 1)``: S would lose digits.

**Bias.** FID is biased upwards, by about c / n with a c that depends on the generator (Chong and
Forsyth, arXiv 1911.07023): compare values of equal n only. With n <= d the value is mostly bias.

**Interval.** A jackknife leaves out one block of whole groups from both sets at a time. It is an
interval for the FID expected at this n, bias included. The difference of two generators on the same
samples is jackknifed as a whole, with the same blocks (:func:`compare_fid`).

**Precision, recall, density, coverage**: do generated samples lie among real ones, and vice versa?
The ball of a sample reaches to its k-th nearest neighbor in its own set. With ``B_k(r)`` the balls
of the m real samples and ``B_k(g)`` those of the n generated ones (Kynkäänniemi et al.,
arXiv 1904.06991; Naeem et al., arXiv 2002.09797)::

    precision = share of generated samples inside at least one real ball
    recall    = share of real samples inside at least one generated ball
    density   = number of (generated sample, real ball around it) / (k n)
    coverage  = share of real balls with at least one generated sample inside

A sample is not its own neighbor; an equal row of another sample is one, at distance 0. *Inside* is
strictly nearer than the radius, as in the package ``prdc``. Distances that differ by rounding
(1e-12 of the squared norms about the center) are ties, and a ball of radius 0, around a row that
occurs more than k times, holds nothing.

**Videos.** Neighboring frames of one video are nearly equal. A k-th neighbor among all frames is
therefore a frame of the same video, and the radius measures the frame rate: at 30 Hz real images
of another video would have a precision near 0. Where groups are known, ``grouped`` looks for the k
neighbors in *other* groups; the two sets are compared over all pairs.

All four depend on n, m and k: compare at equal numbers only. O((n^2 + m^2 + n m) d) in float64.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple, Unpack

import numpy as np
import scipy

from palpate._version import __version__
from palpate.core import FeatureSet, Note, Score, require
from palpate.metrics.blocks import FidOptions, checked_rows, draw_blocks
from palpate.metrics.inputs import Array, Index, PairColumns, checked_whole, with_columns
from palpate.metrics.intervals import Scored, Spread, score_of, spread_of_values
from palpate.metrics.paired import Comparison, compared, same_samples

#: Rows turned to float64 at a time.
ROWS = 8192
EPSILON = float(np.finfo(np.float64).eps)
#: Squared distances that are in memory at a time: 64 MB.
BLOCK = 1 << 23
#: Squared distances closer than this share of the squared norms are equal.
TIE = 1e-12


def fid(generated: Any, reference: Any, **options: Unpack[FidOptions]) -> Score:
    """FID between generated and real samples; lower is better.

    Args:
        generated: (n, d) features, n >= 2: an array, a tensor, a list of rows, or a FeatureSet; FID
            as published takes the 2048 pool features of Inception.
        reference: (m, d) features, m >= 2.
        **options: columns as of :func:`palpate.metrics.tmmd`; ``subject`` and ``split`` are kept in
            the score; ``seed`` draws more than 20 groups, or rows where there are none, into 20
            blocks of about equal size, which are then left out.

    Returns:
        Value and interval; ``details["mean_term"]``: the part |mu1 - mu2|^2.

    Raises:
        PalpateError: on features that cannot be used, unequal widths, fewer than two rows, or
            encoders of different digests.
    """
    (x, y), settings = with_columns(options, generated=generated, reference=reference)
    return _fid(x, y, **settings).score


def compare_fid(
    generators: Mapping[str, FeatureSet],
    reference: FeatureSet,
    *,
    seed: int = 0,
    split: str | None = None,
) -> Comparison:
    """FID of several generators on the same samples, with paired differences.

    Args:
        generators: name -> features; all with the same ids (any order), labels and groups.
        reference: features of the real samples.
        seed: as of :func:`fid`.
        split: digest of the split, kept in the scores.

    Returns:
        Differences of FID at this n, in which the biases of the two need not be equal.

    Raises:
        PalpateError: if generators differ in ids, labels, groups or encoder, or as :func:`fid`.
    """
    sets = same_samples(generators)
    each = {n: [_fid(s, reference, subject=n, seed=seed, split=split)] for n, s in sets.items()}
    result = compared(each)
    note = Note("fid-difference-biased")
    differences = [replace(d, notes=(note,)) if d.interval else d for d in result.differences]
    return replace(result, differences=differences)


def _fid(
    generated: FeatureSet,
    reference: FeatureSet,
    *,
    subject: str = "generated",
    seed: int = 0,
    split: str | None = None,
) -> Scored:
    """FID, and its value without each block."""
    checked_whole(0, seed=seed)
    x, y, groups, notes = checked_rows(generated, reference, 2)
    means = [v.mean(axis=0, dtype=np.float64) for v in (x, y)]
    center, delta = (means[0] + means[1]) / 2, means[0] - means[1]
    blocks, units = draw_blocks(len(x), len(y), groups, seed), list[str]()
    sets = ((x, blocks.x), (y, blocks.y))
    if min(len(v) - np.bincount(at).max() for v, at in sets) > 1:
        units = list(blocks.names)
    pairs = zip(*(_normals(v, at, len(units), center) for v, at in sets), strict=True)
    value, *without = (_distance(*pair) for pair in pairs)
    replicates = np.array(without)
    details: dict[str, Any] = {"mean_term": float(delta @ delta)}
    spread = Spread.of(value, replicates, blocks.details["left_out"], blocks.tail)
    n, d = min(len(x), len(y)), x.shape[1]
    notes.append(Note("fid-biased") if n > d else Note("fid-mostly-bias", {"n": n, "d": d}))
    notes += [Note("no-interval-few-units")] if not spread.known else []
    score = score_of(
        "FID",
        subject,
        spread,
        (0.0, np.inf),
        estimator="plug-in",
        n=len(x),
        m=len(y),
        seed=seed,
        encoder=generated.encoder,
        reference=reference.digest,
        split=split,
        details=details | blocks.details | {"version": __version__},
        settings={"covariance": "n - 1"},
        notes=tuple(notes),
    )
    return Scored(score, replicates, units)


class Normal(NamedTuple):
    """A set as a normal distribution: mean (d,), and covariance (d, d) or its factor F (r, d)."""

    mean: Array
    matrix: Array
    full: bool = False  # whether the matrix is the covariance

    @property
    def factor(self) -> Array:
        """F (r, d) with F' F the covariance, without what rounding left of no spread."""
        if not self.full:
            return self.matrix
        values, vectors = scipy.linalg.eigh(self.matrix, check_finite=False)
        keep = values > len(values) * EPSILON * max(values[-1], 0.0)
        return (vectors[:, keep] * np.sqrt(values[keep])).T


def _normals(x: Array, block: Index, count: int, center: Array) -> Iterator[Normal]:
    """The normal distribution of (n, d) features about the center; then that without each block."""
    total = _sums(x, center) if len(x) > x.shape[1] else None
    for b in range(-1, count):
        n = int(np.count_nonzero(block != b))
        if total is None or n <= x.shape[1]:
            rows = x[block != b] - center
            mean = rows.mean(axis=0)
            yield Normal(mean, (rows - mean) / np.sqrt(n - 1))
            continue
        sums = total - _sums(x[block == b], center)
        sums[1:] -= np.outer(sums[0] / n, sums[0])
        sums[1:] /= n - 1
        yield Normal(sums[0] / n, sums[1:], full=True)


def _sums(x: Array, center: Array) -> Array:
    """(d + 1, d): the sum of the rows about the center, and that of their outer products."""
    total = np.zeros((x.shape[1] + 1, x.shape[1]))
    for start in range(0, len(x), ROWS):
        rows = x[start : start + ROWS] - center
        total[0] += rows.sum(axis=0)
        total[1:] += rows.T @ rows
    return total


def _distance(a: Normal, b: Normal) -> float:
    delta, roots = a.mean - b.mean, None
    if a.full and b.full:
        with suppress(scipy.linalg.LinAlgError):  # b is singular
            values = scipy.linalg.eigh(
                *(a.matrix, b.matrix), type=2, eigvals_only=True, driver="gv", check_finite=False
            )
            # rounding leaves +-eps * largest for a zero, whose root would count
            values[values < len(values) * EPSILON * max(values[-1], 0.0)] = 0
            roots = np.sqrt(values)
    if roots is None:
        cross = a.factor @ b.factor.T
        roots = scipy.linalg.svdvals(cross, check_finite=False) if cross.size else np.zeros(1)
    traces = (np.trace(x.matrix) if x.full else np.vdot(x.matrix, x.matrix) for x in (a, b))
    return max(float(delta @ delta + sum(traces) - 2 * np.sum(roots)), 0.0)


class PrdcOptions(PairColumns, total=False):
    """What :func:`prdc` takes by name."""

    grouped: bool | None
    subject: str
    split: str | None


def prdc(generated: Any, reference: Any, k: int = 5, **options: Unpack[PrdcOptions]) -> list[Score]:
    """Precision, recall, density and coverage, in that order; higher is better for all four.

    Args:
        generated: (n, d) features, n > k: an array, a tensor, a list of rows, or a FeatureSet.
        reference: (m, d) features of real images, m > k.
        k: which neighbor gives the radius; 5 as Naeem et al. (Kynkäänniemi et al. use 3).
        **options: columns as of :func:`palpate.metrics.tmmd`; ``grouped``: look for neighbors in
            other groups only (see the top of this file), default where both sets have groups, False
            gives the values of the package ``prdc``; ``subject`` and ``split`` are kept in the
            scores.

    Returns:
        Four scores. Intervals are of the mean over rows (see :func:`prdc_rows`), robust to whole
        groups deviating together, for fixed balls. ``details`` holds the median radii.

    Raises:
        PalpateError: on features that cannot be used, unequal widths, encoders of different
            digests, or (grouped) a group outside which there are fewer than k rows.
    """
    (x, y), settings = with_columns(options, generated=generated, reference=reference)
    return prdc_rows(x, y, k, **settings)[0]


def prdc_rows(
    generated: FeatureSet,
    reference: FeatureSet,
    k: int = 5,
    *,
    grouped: bool | None = None,
    subject: str = "generated",
    split: str | None = None,
) -> tuple[list[Score], dict[str, Array]]:
    """As :func:`prdc`, with the rows that each score is the mean of.

    (n,) over generated rows for Precision and Density, (m,) over real ones for Recall and Coverage.
    """
    checked_whole(1, k=k)
    x, y, groups, copied = checked_rows(generated, reference, k + 1)
    both, must = None not in groups, "must be False without groups in both sets"
    require(both or not grouped, "grouped", must, grouped, fix="Fill the groups")
    grouped = both if grouped is None else grouped
    center = (x.sum(axis=0, dtype=np.float64) + y.sum(axis=0, dtype=np.float64)) / (len(x) + len(y))
    x, y = x - center, y - center  # so that a large common mean costs no digits
    radii = [
        _squared_radii(name, rows, unit if grouped else None, k)
        for name, rows, unit in zip(("generated", "real"), (x, y), groups, strict=True)
    ]
    median = [float(np.median(np.sqrt(r))) for r in radii]
    rows = _compare(x, y, radii, k)
    scores: list[Score] = []
    for metric, values in rows.items():
        over_real, balls = metric in ("Recall", "Coverage"), int(metric != "Recall")
        spread = spread_of_values(values, groups[over_real])
        empty, side = int((radii[balls] == 0).sum()), ("generated", "real")[balls]
        details = {"radius_generated": median[0], "radius_real": median[1], "empty_balls": empty}
        balls = Note("empty-balls", {"count": empty, "n": len(radii[balls]), "of": side})
        notes = [*copied, *[balls] * (empty > 0)]
        notes += [Note("no-interval-over-groups")] * (not spread.known)
        scores.append(
            score_of(
                metric,
                subject,
                spread,
                (0.0, np.inf if metric == "Density" else 1.0),
                estimator="per-row mean",
                n=len(x),
                m=len(y),
                encoder=generated.encoder,
                reference=reference.digest,
                split=split,
                higher_is_better=True,
                settings={"k": k, "grouped": grouped, "inside": "<"},
                details=details | {"version": __version__},
                notes=tuple(notes),
            )
        )
    return scores, rows


def _squared_radii(name: str, x: Array, groups: Sequence[str] | None, k: int) -> Array:
    """Squared distance (n,) to the k-th nearest row of another group; without groups of any row."""
    n = len(x)
    unit = np.arange(n) if groups is None else np.unique(groups, return_inverse=True)[1]
    outside = (n - np.bincount(unit))[unit]
    names = ["none"] * n if groups is None else groups
    must = f"Every group must have at least k = {k} {name} rows outside it"
    got = f"{outside.min()} outside group {names[int(outside.argmin())]!r}"
    fix = "Choose a smaller k, more groups, or leave the groups out"
    require(groups is None or int(outside.min()) >= k, None, must, got, fix=fix)
    radii = np.empty(n)
    for rows, squares in _blocks(x, x):
        squares[unit[rows, None] == unit] = np.inf
        radii[rows] = np.partition(squares, k - 1, axis=1)[:, k - 1]
    radii[radii <= 2 * TIE * (x * x).sum(axis=1)] = 0  # what rounding leaves between equal rows
    return radii


def _compare(x: Array, y: Array, radii: Sequence[Array], k: int) -> dict[str, Array]:
    """Which generated rows are inside which real balls, and the other way round."""
    balls, recall, coverage = np.zeros(len(x)), np.zeros(len(y), bool), np.zeros(len(y), bool)
    for rows, squares in _blocks(x, y, TIE):
        in_real = squares < radii[1]
        balls[rows] = in_real.sum(axis=1)
        coverage |= in_real.any(axis=0)
        recall |= (squares < radii[0][rows, None]).any(axis=0)
    return {
        "Precision": (balls > 0).astype(np.float64),
        "Recall": recall.astype(np.float64),
        "Density": balls / k,
        "Coverage": coverage.astype(np.float64),
    }


def _blocks(x: Array, y: Array, tie: float = 0.0) -> Iterator[tuple[slice, Array]]:
    """Squared distances (rows, m) of blocks of ``x`` to ``y``, plus ``tie`` times the norms."""
    x_norms, y_norms = ((1 + tie) * (v * v).sum(axis=1) for v in (x, y))
    step = max(1, BLOCK // len(y))
    for start in range(0, len(x), step):
        rows = slice(start, min(start + step, len(x)))
        squares = x[rows] @ (-2 * y.T)
        squares += x_norms[rows, None]
        squares += y_norms
        yield rows, squares
