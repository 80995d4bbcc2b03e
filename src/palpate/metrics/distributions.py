"""Distances of distributions of features: FID, and precision, recall, density and coverage.

FID is the Fréchet distance of two sets taken as Gaussians (Heusel, arXiv 1706.08500).

``|mu1 - mu2|^2 + tr S1 + tr S2 - 2 tr (S1 S2)^(1/2)``, covariances divided by n - 1, in float64.
With factors ``S = F' F`` the trace of the root is the sum of the singular values of ``F1 F2'``, so
no matrix root is needed (``scipy.linalg.sqrtm`` may turn complex or fail). F is a Cholesky factor;
of n <= d samples it is the thin ``(X - mu) / sqrt(n - 1)``: a covariance would lose digits.

**Bias.** FID is biased upwards, by about c / n with a c that depends on the generator (Chong and
Forsyth, arXiv 1911.07023): compare values of equal n only. ``details["infinity"]`` is the intercept
of a line in 1 / n fitted to FID of parts of both sets, made of whole blocks of groups; it has less
bias and somewhat more noise. With n <= d the value is mostly bias.

**Interval.** A jackknife leaves out one block of whole groups from both sets at a time. It is an
interval for the FID expected at this n, bias included. The difference of two generators on the same
samples is jackknifed as a whole, with the same blocks (:func:`compare_fid`).

Precision and its companions ask: do generated samples lie among the real ones, and back?

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
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate import __version__
from palpate.core import FeatureSet, Note, PalpateError, Progress, Score, quiet, rng_for
from palpate.metrics.inputs import (
    checked_level,
    checked_names,
    checked_pair,
    checked_whole,
    copies_across,
    feature_set,
    require_one_encoder,
)
from palpate.metrics.intervals import Scored, jackknife_errors, mean_interval, t_interval
from palpate.metrics.paired import Comparison, difference, holm, same_samples

Array = NDArray[np.float64]
Index = NDArray[np.intp]
#: Mean (d,) and factor (r, d) of a covariance F' F.
Gaussian = tuple[Array, Array]
#: Number of rows, their sum (d,) and the sum of their outer products (d, d), about a center.
Sums = tuple[int, Array, Array]

#: Rows turned to float64 at a time.
ROWS = 8192
#: A covariance may differ from its transpose by this share of its largest entry.
SYMMETRY = 1e-6
EPSILON = float(np.finfo(np.float64).eps)


class FidOptions(TypedDict, total=False):
    """Options of :func:`fid` and :func:`compare_fid`.

    Attributes:
        normalize: divide every row by its norm first, default False as published.
        blocks: the most blocks that the jackknife leaves out, default 20. With no more groups than
            that it leaves out one group at a time; else groups are drawn into blocks of about equal
            size. Groups count only if both sets have them; the same name is the same group.
        seed: of that draw.
        split: digest of the split, kept in the score.
        level: coverage of the interval, 0.95.
    """

    normalize: bool
    blocks: int
    seed: int
    split: str | None
    level: float


def fid(
    generated: Any,
    reference: Any,
    *,
    ids: Any = None,
    groups: Any = None,
    reference_ids: Any = None,
    reference_groups: Any = None,
    encoder: str | None = None,
    subject: str = "generated",
    interval: bool = True,
    **options: Unpack[FidOptions],
) -> Score:
    """FID between generated and real samples; lower is better.

    Args:
        generated: (n, d) features, n >= 2: an array, a tensor, a list of rows, or a FeatureSet; FID
            as published takes the 2048 pool features of Inception.
        reference: (m, d) features, m >= 2.
        ids: n sample ids.
        groups: n groups (videos) of ``generated``.
        reference_ids: m sample ids.
        reference_groups: m groups of ``reference``.
        encoder: digest of the encoder of both.
        subject: what is scored, kept in the score.
        interval: compute the interval and ``details["infinity"]``, which cost about ``blocks + 11``
            times the distance itself.
        **options: see :class:`FidOptions`.

    Returns:
        Value and interval; ``details["infinity"]`` (None where half of a set has no more than d
        rows, or with fewer than 8 blocks) and ``details["mean_term"]``, the part |mu1 - mu2|^2.

    Raises:
        PalpateError: on features that cannot be used, unequal widths, fewer than two rows, or
            encoders of different digests.
    """
    x = feature_set(generated, argument="generated", ids=ids, groups=groups, encoder=encoder)
    y = feature_set(
        reference, argument="reference", ids=reference_ids, groups=reference_groups, encoder=encoder
    )
    return _fid(x, y, subject=subject, interval=interval, **options).score


def compare_fid(
    generators: Mapping[str, FeatureSet], reference: FeatureSet, **options: Unpack[FidOptions]
) -> Comparison:
    """FID of several generators on the same samples, with paired differences.

    Args:
        generators: name -> features; all with the same ids (any order), labels and groups.
        reference: features of the real samples.
        **options: see :class:`FidOptions`.

    Returns:
        Differences of FID at this n, in which the biases of the two need not be equal;
        ``details["infinity"]`` is the difference of the two extrapolations, or None.

    Raises:
        PalpateError: if generators differ in ids, labels, groups or encoder, or as :func:`fid`.
    """
    sets = same_samples(generators)
    scored = {name: _fid(s, reference, subject=name, **options) for name, s in sets.items()}
    differences: list[Score] = []
    for a, b in combinations(scored.values(), 2):
        delta, limits = difference(a, b), [v.score.details["infinity"] for v in (a, b)]
        limit = None if None in limits else limits[0] - limits[1]
        notes = (Note("fid-difference-biased"),) if delta.interval else delta.notes
        details = {**delta.details, "infinity": limit}
        differences.append(replace(delta, notes=notes, details=details))
    return Comparison([s.score for s in scored.values()], holm(differences))


def _fid(
    generated: FeatureSet,
    reference: FeatureSet,
    *,
    subject: str,
    interval: bool = True,
    normalize: bool = False,
    blocks: int = 20,
    seed: int = 0,
    split: str | None = None,
    level: float = 0.95,
) -> Scored:
    """FID, and its value without each block."""
    checked_whole(2, blocks=blocks)
    checked_whole(0, seed=seed)
    checked_level(level)
    require_one_encoder(generated, reference, "reference")
    names = ("generated", "reference")
    x, y = checked_pair(
        generated.features, reference.features, normalize=normalize, least=2, names=names
    )
    center = (x.mean(axis=0, dtype=np.float64) + y.mean(axis=0, dtype=np.float64)) / 2
    a, b = _gaussian(x, center), _gaussian(y, center)
    value, delta = _distance(a, b), a[0] - b[0]
    details: dict[str, Any] = {"mean_term": float(delta @ delta), "infinity": None}
    limits, method, replicates, units = None, "", np.zeros(0), []
    if interval:
        parts = _draw_parts(generated, reference, blocks, seed)
        sets = [_Parted(v, block, center) for v, block in zip((x, y), parts.block, strict=True)]
        replicates = _replicates(sets, parts.count)
        units = parts.names if len(replicates) else []
        error = float(jackknife_errors(replicates[:, None])[0])
        if error > 0:  # false for NaN as well
            low, high = t_interval(value, error, parts.count - 1, level)
            limits, method = (max(0.0, low), high), parts.method
        details["infinity"] = _infinity(sets, parts.count, value, seed)
        details |= {"units": parts.units, "unit": parts.unit, "left_out": parts.left_out}
    score = Score(
        "FID",
        subject,
        value,
        limits,
        level=level,
        interval_method=method,
        estimator="plug-in",
        n=len(x),
        m=len(y),
        seed=seed if interval else None,
        encoder=generated.encoder,
        reference=reference.digest,
        split=split,
        details=details | {"version": __version__},
        settings={"normalize": normalize, "covariance": "n - 1"},
        notes=_notes(x, y, details["infinity"] is not None, interval and limits is None),
    )
    return Scored(score, replicates, units)


def _notes(x: Array, y: Array, extrapolated: bool, no_interval: bool) -> tuple[Note, ...]:
    n, d = min(len(x), len(y)), x.shape[1]
    copies, biased = copies_across(x, y), Note("fid-biased", {"extrapolated": extrapolated})
    notes = [
        (copies, Note("copied-rows", {"count": copies, "n": len(x)})),
        (True, biased if n > d else Note("fid-mostly-bias", {"n": n, "d": d})),
        (no_interval, Note("no-interval-few-units")),
    ]
    return tuple(note for holds, note in notes if holds)


def frechet_distance(mean1: Any, cov1: Any, mean2: Any, cov2: Any) -> float:
    """The squared Fréchet (2-Wasserstein) distance of two Gaussians.

    Args:
        mean1: (d,).
        cov1: (d, d) symmetric, positive semi-definite; may be singular.
        mean2: (d,).
        cov2: as ``cov1``.

    Returns:
        The distance, not negative: to about 1e-12 relative for covariances of full rank, 1e-7 for
        singular ones, as much as the rounding of their entries leaves.

    Raises:
        PalpateError: on wrong shapes, NaN or infinity, or matrices that are not symmetric.
    """
    means = [np.asarray(v, np.float64) for v in (mean1, mean2)]
    d = means[0].size
    for name, mean in zip(("mean1", "mean2"), means, strict=True):
        if mean.shape != (d,) or not d or not np.isfinite(mean).all():
            must, got = f"must be a finite vector ({d},)", f"shape {mean.shape}"
            raise PalpateError(must, got, "Pass the mean over rows", argument=name)
    covs = [_checked_covariance(f"cov{i}", c, d) for i, c in enumerate((cov1, cov2), 1)]
    return _distance((means[0], _factor(covs[0])), (means[1], _factor(covs[1])))


def _checked_covariance(name: str, value: Any, d: int) -> Array:
    cov = np.asarray(value, dtype=np.float64)
    if cov.shape != (d, d) or not np.isfinite(cov).all():
        got = f"shape {cov.shape}" if cov.shape != (d, d) else "NaN or infinity"
        fix = "Pass the covariance of the same features as the mean"
        raise PalpateError(f"must be a finite matrix ({d}, {d})", got, fix, argument=name)
    off = float(np.abs(cov - cov.T).max())
    if off > SYMMETRY * float(np.abs(cov).max()):
        got = f"entries that differ from their mirror by {off:.3g}"
        raise PalpateError("must be symmetric", got, "Pass a covariance matrix", argument=name)
    return (cov + cov.T) / 2


def _gaussian(x: Array, center: Array) -> Gaussian:
    """Mean about the center, and factor, of the rows of (n, d) features."""
    if len(x) > x.shape[1]:
        return _gaussian_of_sums(_sums(x, center))
    rows = x - center
    mean = rows.mean(axis=0)
    return mean, (rows - mean) / np.sqrt(len(x) - 1)


def _sums(x: Array, center: Array) -> Sums:
    d = x.shape[1]
    total, squares = np.zeros(d), np.zeros((d, d))
    for start in range(0, len(x), ROWS):
        rows = x[start : start + ROWS] - center
        total += rows.sum(axis=0)
        squares += rows.T @ rows
    return len(x), total, squares


def _gaussian_of_sums(sums: Sums) -> Gaussian:
    n, total, squares = sums
    mean = total / n
    return mean, _factor((squares - n * np.outer(mean, mean)) / (n - 1))


def _factor(cov: Array) -> Array:
    """F (r, d) with F' F = cov; of r = rank rows where Cholesky finds the matrix singular."""
    try:
        return linalg.cholesky(cov, check_finite=False)
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(cov, check_finite=False)
        keep = values > len(values) * EPSILON * max(values[-1], 0.0)
        return (vectors[:, keep] * np.sqrt(values[keep])).T


def _distance(a: Gaussian, b: Gaussian) -> float:
    delta, (f, g) = a[0] - b[0], (a[1], b[1])
    cross = f @ g.T
    if len(f) == len(g) == f.shape[1]:  # faster; squares lose no digits that matter at full rank
        values = linalg.eigvalsh(cross @ cross.T, check_finite=False)
        # rounding leaves +-eps * largest for a zero, whose root would count
        values[values < len(values) * EPSILON * max(values[-1], 0.0)] = 0
        roots = np.sqrt(values)
    else:
        roots = linalg.svdvals(cross, check_finite=False) if cross.size else np.zeros(1)
    traces = np.einsum("ij,ij->", f, f) + np.einsum("ij,ij->", g, g)
    return max(float(delta @ delta + traces - 2 * np.sum(roots)), 0.0)


@dataclass(frozen=True)
class _Parted:
    """Features (n, d) and the block of every row (n,)."""

    x: Array
    block: Index
    center: Array

    def sums(self, b: int) -> Sums:
        """Of the rows of one block."""
        return _sums(self.x[self.block == b], self.center)

    def all_but_each(self, count: int) -> list[Gaussian]:
        """The Gaussian without each block."""
        d, whole = self.x.shape[1], None
        without: list[Gaussian] = []
        for b in range(count):
            kept = self.block != b
            if kept.sum() <= d:
                without.append(_gaussian(self.x[kept], self.center))
                continue
            whole = whole or _sums(self.x, self.center)
            n, total, squares = self.sums(b)
            without.append(_gaussian_of_sums((whole[0] - n, whole[1] - total, whole[2] - squares)))
        return without


def _replicates(sets: Sequence[_Parted], count: int) -> Array:
    """The distance (count,) without each block; empty where fewer than two rows would be left."""
    if min(len(s.x) - np.bincount(s.block).max() for s in sets) < 2:
        return np.zeros(0)
    pairs = zip(*(s.all_but_each(count) for s in sets), strict=True)
    return np.array([_distance(a, b) for a, b in pairs])


def _infinity(sets: Sequence[_Parted], count: int, value: float, seed: int) -> float | None:
    """FID extrapolated to infinitely many rows in both sets; None with too little to fit."""
    d, full = sets[0].x.shape[1], [len(s.x) for s in sets]
    if count < 8 or min(full) <= 2 * d:
        return None
    order = rng_for(seed, "fid infinity").permutation(count)
    sizes = {int(np.ceil(count * share)) for share in (0.5, 0.6, 0.7, 0.8, 0.9)}
    points = [(1.0, value)]
    for start in (0, count // 2):  # the halves of the two runs are disjoint
        grown: list[Sums] = [(0, np.zeros(d), np.zeros((d, d))) for _ in sets]
        for k, b in enumerate(np.roll(order, -start), 1):
            added = [s.sums(int(b)) for s in sets]
            grown = [
                (m + n, total + t, squares + q)
                for (m, total, squares), (n, t, q) in zip(grown, added, strict=True)
            ]
            if k in sizes and min(n for n, *_ in grown) > d:
                # the bias is a / n + b / m; both shrink together along these points
                inverse = sum(n / part[0] for n, part in zip(full, grown, strict=True)) / 2
                points.append((inverse, _distance(*map(_gaussian_of_sums, grown))))
    if len({inverse for inverse, _ in points}) < 3:
        return None
    inverses, values = np.array(points).T
    return float(np.polynomial.polynomial.polyfit(inverses, values, 1)[0])


@dataclass(frozen=True)
class _Parts:
    """Rows of both sets in blocks of whole units.

    Attributes:
        block: the block of every row, (n,) and (m,).
        names: of the blocks; a block that is one group has its name.
        unit: ``"group"`` or ``"row"``.
        units: how many of them there are.
    """

    block: tuple[Index, Index]
    names: Sequence[str]
    unit: str
    units: int

    @property
    def count(self) -> int:
        """Number of blocks."""
        return len(self.names)

    @property
    def left_out(self) -> str:
        """What is left out at a time: a ``"group"``, or a ``"block"`` of groups or rows."""
        return "group" if self.unit == "group" and self.count == self.units else "block"

    @property
    def method(self) -> str:
        """The interval method, in words."""
        blocks = ""
        if self.unit == "row":
            blocks = f", {self.count} random blocks of rows, taken as independent"
        elif self.left_out == "block":
            blocks = f", {self.count} random blocks of whole groups ({self.units} groups)"
        return f"leave-one-{self.left_out}-out jackknife{blocks}, t, {self.count - 1} df"


def _draw_parts(generated: FeatureSet, reference: FeatureSet, most: int, seed: int) -> _Parts:
    """Groups, or rows where a set has no groups, in at most ``most`` blocks."""
    n, m = len(generated.ids), len(reference.ids)
    rng = rng_for(seed, "fid blocks")
    groups = [checked_names("groups", s.groups, len(s.ids)) for s in (generated, reference)]
    if groups[0] is None or groups[1] is None:
        names = [f"block {b}" for b in range(min(most, n, m))]
        drawn = rng.permutation(n) % len(names), rng.permutation(m) % len(names)
        return _Parts(drawn, names, "row", n + m)
    names, unit = np.unique(groups[0] + groups[1], return_inverse=True)
    units, block, names = len(names), np.arange(len(names)), [str(name) for name in names]
    if units > most:
        # the largest group first into the block that has least, ties at random: nearly equal sizes
        counts = [np.bincount(u, minlength=units) / len(u) for u in (unit[:n], unit[n:])]
        size, order, load = counts[0] + counts[1], rng.permutation(units), np.zeros(most)
        for u in order[np.argsort(-size[order], kind="stable")]:
            block[u] = int(load.argmin())
            load[block[u]] += size[u]
        names = [f"block {b}" for b in range(most)]
    return _Parts((block[unit[:n]], block[unit[n:]]), names, "group", units)


Array = NDArray[np.float64]

#: Squared distances that are in memory at a time: 64 MB.
BLOCK = 1 << 23
#: Squared distances closer than this share of the squared norms are equal.
TIE = 1e-12


class NeighborOptions(TypedDict, total=False):
    """Options of :func:`prdc`.

    Attributes:
        grouped: look for neighbors in other groups only (see the top of this file). Default: where
            both sets have groups. False gives the values of the package ``prdc``.
        normalize: divide every row by its norm first, default False.
        subject: what is scored, kept in the scores.
        split: digest of the split, kept in the scores.
        level: coverage of the intervals, 0.95.
        progress: called three times with the rows done.
    """

    grouped: bool | None
    normalize: bool
    subject: str
    split: str | None
    level: float
    progress: Progress


def prdc(
    generated: Any,
    reference: Any,
    k: int = 5,
    *,
    ids: Any = None,
    groups: Any = None,
    reference_ids: Any = None,
    reference_groups: Any = None,
    encoder: str | None = None,
    **options: Unpack[NeighborOptions],
) -> list[Score]:
    """Precision, recall, density and coverage, in that order; higher is better for all four.

    Args:
        generated: (n, d) features, n > k: an array, a tensor, a list of rows, or a FeatureSet.
        reference: (m, d) features of real images, m > k.
        k: which neighbor gives the radius; 5 as Naeem et al. (Kynkäänniemi et al. use 3).
        ids: n sample ids.
        groups: n groups (videos) of ``generated``.
        reference_ids: m sample ids.
        reference_groups: m groups of ``reference``.
        encoder: digest of the encoder of both.
        **options: see :class:`NeighborOptions`.

    Returns:
        Four scores. Intervals are of the mean over rows (see :func:`prdc_rows`), robust to whole
        groups deviating together, for fixed balls. ``details`` holds the median radii.

    Raises:
        PalpateError: on features that cannot be used, unequal widths, encoders of different
            digests, or (grouped) a group outside which there are fewer than k rows.
    """
    x = feature_set(generated, argument="generated", ids=ids, groups=groups, encoder=encoder)
    y = feature_set(
        reference, argument="reference", ids=reference_ids, groups=reference_groups, encoder=encoder
    )
    return prdc_rows(x, y, k, **options)[0]


def precision_recall(generated: Any, reference: Any, k: int = 3, **options: Any) -> list[Score]:
    """Precision and recall alone, with k = 3 as Kynkäänniemi et al.; arguments as :func:`prdc`."""
    return prdc(generated, reference, k, **options)[:2]


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
    """As :func:`prdc`, with the rows that each score is the mean of.

    (n,) over generated rows for Precision and Density, (m,) over real ones for Recall and Coverage.
    """
    checked_whole(1, k=k)
    checked_level(level)
    require_one_encoder(generated, reference, "reference")
    names = ("generated", "reference")
    x, y = checked_pair(
        generated.features, reference.features, normalize=normalize, least=k + 1, names=names
    )
    groups = [checked_names("groups", s.groups, len(s.ids)) for s in (generated, reference)]
    known = None not in groups
    if grouped and not known:
        must, fix = "must be False without groups in both sets", "Fill the groups"
        raise PalpateError(must, "True", fix, argument="grouped")
    grouped = known if grouped is None else grouped
    copies = copies_across(x, y)
    center = (x.sum(axis=0, dtype=np.float64) + y.sum(axis=0, dtype=np.float64)) / (len(x) + len(y))
    x, y = x - center, y - center  # so that a large common mean costs no digits
    radii = [
        _squared_radii(name, rows, unit if grouped else None, k, progress)
        for name, rows, unit in zip(("generated", "real"), (x, y), groups, strict=True)
    ]
    median = [float(np.median(np.sqrt(r))) for r in radii]
    rows = _compare(x, y, radii, k, progress)
    scores: list[Score] = []
    for metric, values in rows.items():
        over_real, balls = metric in ("Recall", "Coverage"), int(metric != "Recall")
        interval, method = mean_interval(values, groups[over_real], level)
        if interval is not None:  # a t interval may leave the bounds of a share
            high = interval[1] if metric == "Density" else min(1.0, interval[1])
            interval = (max(0.0, interval[0]), high)
        empty, of = int((radii[balls] == 0).sum()), ("generated", "real")[balls]
        details = {"radius_generated": median[0], "radius_real": median[1], "empty_balls": empty}
        notes = [
            (copies, Note("copied-rows", {"count": copies, "n": len(x)})),
            (empty, Note("empty-balls", {"count": empty, "n": len(radii[balls]), "of": of})),
            (interval is None, Note("no-interval-over-groups")),
        ]
        scores.append(
            Score(
                metric,
                subject,
                float(values.mean()),
                interval,
                level,
                method,
                estimator="per-row mean",
                n=len(x),
                m=len(y),
                encoder=generated.encoder,
                reference=reference.digest,
                split=split,
                higher_is_better=True,
                settings={"k": k, "grouped": grouped, "normalize": normalize, "inside": "<"},
                details=details | {"version": __version__},
                notes=tuple(note for holds, note in notes if holds),
            )
        )
    return scores, rows


def _squared_radii(
    name: str, x: Array, groups: Sequence[str] | None, k: int, progress: Progress
) -> Array:
    """Squared distance (n,) to the k-th nearest row of another group; without groups of any row."""
    n = len(x)
    unit = np.arange(n) if groups is None else np.unique(groups, return_inverse=True)[1]
    others = (n - np.bincount(unit))[unit]
    if groups is not None and others.min() < k:
        must = f"Every group must have at least k = {k} {name} rows outside it"
        got = f"{others.min()} outside group {groups[int(others.argmin())]!r}"
        raise PalpateError(must, got, "Choose a smaller k, more groups, or grouped=False")
    radii = np.empty(n)
    for rows, squares in _blocks(x, x):
        squares[unit[rows, None] == unit] = np.inf
        radii[rows] = np.partition(squares, k - 1, axis=1)[:, k - 1]
        progress(f"radii of {name} samples", rows.stop, n)
    radii[radii <= 2 * TIE * (x * x).sum(axis=1)] = 0  # what rounding leaves between equal rows
    return radii


def _compare(
    x: Array, y: Array, radii: Sequence[Array], k: int, progress: Progress
) -> dict[str, Array]:
    """Which generated rows are inside which real balls, and the other way round."""
    balls, recall, coverage = np.zeros(len(x)), np.zeros(len(y), bool), np.zeros(len(y), bool)
    for rows, squares in _blocks(x, y, TIE):
        in_real = squares < radii[1]
        balls[rows] = in_real.sum(axis=1)
        coverage |= in_real.any(axis=0)
        recall |= (squares < radii[0][rows, None]).any(axis=0)
        progress("comparing samples", rows.stop, len(x))
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
