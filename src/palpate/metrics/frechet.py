"""FID: the Fréchet distance between two sets of features, each taken as a Gaussian (Heusel et al., arXiv 1706.08500).

``FID = |mu1 - mu2|^2 + tr S1 + tr S2 - 2 tr (S1 S2)^(1/2)``, covariances divided by n - 1, everything in float64.

The trace of the root needs no matrix root. With any factor ``S1 = R R'`` the eigenvalues of ``S1 S2`` are those of the symmetric
``R' S2 R``: real, not negative, and their roots are summed (``scipy.linalg.sqrtm`` of the unsymmetric ``S1 S2`` may turn complex or fail).
R is a Cholesky factor, or the root by eigenvalues where S1 is singular. A set of n <= d samples spans less than the space: then
``S = F' F`` with the thin ``F = (X - mu) / sqrt(n - 1)``, and the trace is the sum of the singular values of ``F1 F2'``: cheaper, and
exact where a formed covariance would lose half the digits of its small eigenvalues.

**Bias.** FID is biased upwards, by about c / n with a c that depends on the generator (Chong and Forsyth, arXiv 1911.07023): compare
values of equal n alone. ``details["infinity"]`` is the intercept of a line in 1 / n fitted to FID of parts of both sets, made of whole blocks
of groups, so that frames of one video do not pass for so many samples; it has less bias and somewhat more noise. With n <= d the value is
bias mostly, and the note says so.

**Interval.** A jackknife leaves out one block of whole groups from both sets at a time. It is an interval for the FID expected at
this n, bias included, not for FID at infinity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate import __version__
from palpate.core import FeatureSet, PalpateError, Score, rng_for
from palpate.metrics.checks import Floats, checked_features, checked_names, copies_across
from palpate.metrics.intervals import t_interval
from palpate.metrics.neighbours import checked_sets, copies_note

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Rows turned to float64 at a time.
ROWS = 8192
#: Two covariances that differ from their transposes by more than this, relative to the largest entry, are no covariances.
SYMMETRY = 1e-6


@dataclass
class Moments:
    """Mean and scatter of rows that arrive in parts; mergeable over files and processes.

    The state is centred at its own mean and updated by the formula of Chan, Golub and LeVeque, ``M = M_a + M_b + delta delta' n_a n_b / n``,
    so that features far from the origin lose no digits.

    Attributes:
        n: rows so far.
        mean: (d,) float64.
        scatter: (d, d) float64, ``sum (x - mean)(x - mean)'``.
    """

    n: int = 0
    mean: Array = field(default_factory=lambda: np.empty(0))
    scatter: Array = field(default_factory=lambda: np.empty((0, 0)))

    @classmethod
    def of(cls, features: Any) -> Moments:
        """The moments of (n, d) features."""
        return cls().add(features)

    def add(self, features: Any) -> Moments:
        """Adds rows, in place.

        Args:
            features: (k, d) finite floats; k may be 0. A torch tensor is fetched from its device.

        Returns:
            self.

        Raises:
            PalpateError: on integers, another width than before, NaN or infinity (rows are named).
        """
        x = checked_features("features", _on_host(features), normalize=False, least=0)
        for start in range(0, len(x), ROWS):
            rows = x[start : start + ROWS].astype(np.float64)
            mean = rows.mean(axis=0)
            rows -= mean
            self.merge(Moments(len(rows), mean, rows.T @ rows))
        return self

    def merge(self, other: Moments) -> Moments:
        """Adds the rows that ``other`` has seen, in place.

        Returns:
            self.

        Raises:
            PalpateError: if the widths differ.
        """
        if not other.n:
            return self
        if not self.n:
            self.n, self.mean, self.scatter = other.n, other.mean.copy(), other.scatter.copy()
            return self
        _same_width(self.mean, other.mean)
        n, delta = self.n + other.n, other.mean - self.mean
        self.scatter = self.scatter + other.scatter + np.outer(delta, delta * (self.n * other.n / n))
        self.mean = self.mean + delta * (other.n / n)
        self.n = n
        return self

    def without(self, part: Moments) -> Moments:
        """The moments of the other rows, given those of some of them; the inverse of :meth:`merge`, as a new object.

        Raises:
            PalpateError: if the widths differ, or ``part`` has more rows than there are.
        """
        n = self.n - part.n
        if n < 0:
            raise PalpateError("A part must have at most as many rows as the whole", f"{part.n} of {self.n}", "Take away what was added")
        if not part.n:
            return Moments(self.n, self.mean, self.scatter)
        if not n:
            return Moments()
        _same_width(self.mean, part.mean)
        mean = self.mean + (self.mean - part.mean) * (part.n / n)
        delta = part.mean - mean
        return Moments(n, mean, self.scatter - part.scatter - np.outer(delta, delta * (n * part.n / self.n)))

    @property
    def covariance(self) -> Array:
        """(d, d), divided by n - 1.

        Raises:
            PalpateError: with fewer than two rows.
        """
        if self.n < 2:
            raise PalpateError("A covariance must come from at least 2 rows", f"{self.n}", "Add more samples")
        return self.scatter / (self.n - 1)


def _on_host(x: Any) -> Any:
    if not hasattr(x, "detach"):
        return x
    x = x.detach().cpu()
    return (x.float() if str(x.dtype) == "torch.bfloat16" else x).numpy()  # NumPy has no bfloat16


def _same_width(a: Array, b: Array) -> None:
    if a.shape != b.shape:
        raise PalpateError("All features must have the same width", f"{len(a)} and {len(b)}", "Embed all with the same encoder")


def frechet_distance(mean1: Any, cov1: Any, mean2: Any, cov2: Any) -> float:
    """The squared Fréchet (2-Wasserstein) distance of two Gaussians.

    Args:
        mean1: (d,).
        cov1: (d, d) symmetric, positive semi-definite; a singular one is handled.
        mean2: (d,).
        cov2: as ``cov1``.

    Returns:
        The distance, not negative. Of covariances of full rank: to about 1e-12 relative; of singular ones to about 1e-7, as much as the
        rounding of their entries leaves.

    Raises:
        PalpateError: on wrong shapes, NaN or infinity, or matrices that are not symmetric.
    """
    means = [_checked_mean(f"mean{i}", mean) for i, mean in enumerate((mean1, mean2), 1)]
    _same_width(means[0], means[1])
    covs = [_checked_covariance(f"cov{i}", cov, len(means[0])) for i, cov in enumerate((cov1, cov2), 1)]
    return _distance(means[0], means[1], float(np.trace(covs[0]) + np.trace(covs[1])), _root_trace(covs[0], covs[1]))


def _checked_mean(name: str, value: Any) -> Array:
    mean = np.asarray(value, dtype=np.float64)
    if mean.ndim != 1 or not mean.size or not np.isfinite(mean).all():
        raise PalpateError(f"{name} must be a finite vector (d,)", f"shape {mean.shape}", "Pass the mean over rows")
    return mean


def _checked_covariance(name: str, value: Any, d: int) -> Array:
    cov = np.asarray(value, dtype=np.float64)
    if cov.shape != (d, d) or not np.isfinite(cov).all():
        got = f"shape {cov.shape}" if cov.shape != (d, d) else "NaN or infinity"
        raise PalpateError(f"{name} must be a finite matrix ({d}, {d})", got, "Pass the covariance of the same features as the mean")
    off = float(np.abs(cov - cov.T).max())
    if off > SYMMETRY * float(np.abs(cov).max()):
        raise PalpateError(f"{name} must be symmetric", f"entries that differ from their mirror by {off:.3g}", "Pass a covariance matrix")
    return (cov + cov.T) / 2


def _distance(mean1: Array, mean2: Array, traces: float, root: float) -> float:
    delta = mean1 - mean2
    return max(float(delta @ delta) + traces - 2 * root, 0.0)


def _root_trace(cov1: Array, cov2: Array) -> float:
    """``tr (S1 S2)^(1/2)``: see the head of this file."""
    root = _factor(cov1)
    values = linalg.eigvalsh(root.T @ cov2 @ root, check_finite=False)
    # Rounding leaves +-eps * largest where a zero belongs, whose root would be 1e-8 and count once a missing dimension.
    values[values < len(values) * np.finfo(np.float64).eps * max(values[-1], 0.0)] = 0
    return float(np.sqrt(values).sum())


def _factor(cov: Array) -> Array:
    """R (d, r) with ``R R' = cov``; by eigenvalues, and of r = rank columns, where Cholesky finds the matrix singular."""
    try:
        return linalg.cholesky(cov, lower=True, check_finite=False)
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(cov, check_finite=False)
        keep = values > len(values) * np.finfo(np.float64).eps * max(values[-1], 0.0)
        return vectors[:, keep] * np.sqrt(values[keep]) if keep.any() else np.zeros((len(cov), 1))


def _of_moments(a: Moments, b: Moments) -> float:
    one, two = a.covariance, b.covariance
    return _distance(a.mean, b.mean, float(np.trace(one) + np.trace(two)), _root_trace(one, two))


def _of_features(x: Floats, y: Floats) -> float:
    """FID of two arrays of at least two rows, one of which has no more rows than columns."""
    means = x.mean(axis=0, dtype=np.float64), y.mean(axis=0, dtype=np.float64)
    thin = [(v - mean) / np.sqrt(len(v) - 1) for v, mean in zip((x, y), means, strict=True)]
    traces = sum(float(np.einsum("ij,ij->", f, f)) for f in thin)
    # Of a set larger than d, its covariance's factor stands for it: no product is larger than (d, d).
    a, b = (f if len(f) <= f.shape[1] else _factor(f.T @ f).T for f in thin)
    return _distance(*means, traces, float(np.sum(linalg.svdvals(a @ b.T, check_finite=False))))


def fid(
    generated: FeatureSet,
    reference: FeatureSet,
    *,
    normalize: bool = False,
    interval: bool = True,
    blocks: int = 20,
    seed: int = 0,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
) -> Score:
    """FID between generated and real touches; lower is better.

    Args:
        generated: (n, d) features, n >= 2; FID as published takes the 2048 pool features of Inception.
        reference: (m, d) features, m >= 2.
        normalize: divide every row by its norm first; FID as published does not.
        interval: make the interval and ``details["infinity"]``, which cost about ``blocks + 11`` times the distance itself.
        blocks: the most blocks that the jackknife leaves out. With no more groups than that it leaves one group out at a time; else
            groups are drawn into blocks of about equal size. Groups count only if both sets have them; the same name is the same group.
        seed: of that draw.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.
        level: coverage of the interval.

    Returns:
        Value, interval; ``details["infinity"]`` (None where half of a set has no more than d rows, or there are fewer than 8 blocks) and
        ``details["mean_term"]``, the part ``|mu1 - mu2|^2``.

    Raises:
        PalpateError: on features that are refused, unequal widths, fewer than two rows, or encoders of different digests.
    """
    if blocks < 2:
        raise PalpateError("blocks must be at least 2", str(blocks), "Pass e.g. blocks=20")
    x, y = checked_sets(generated, reference, normalize=normalize, least=2)
    whole = Moments.of(x), Moments.of(y)
    value = _of_moments(*whole) if min(len(x), len(y)) > x.shape[1] else _of_features(x, y)
    details: dict[str, Any] = {"mean_term": float(((whole[0].mean - whole[1].mean) ** 2).sum()), "infinity": None, "version": __version__}
    note, found, method = copies_note(copies_across(x, y), len(x)), None, ""
    if interval:
        parts = _draw_parts(generated, reference, (x, y), blocks, seed)
        error = parts.error(whole)
        if error is not None:
            low, high = t_interval(value, error, parts.count - 1, level)
            found, method = (max(0.0, low), high), parts.method
        details |= {"infinity": parts.infinity(value, seed), "units": parts.units, "unit": parts.unit}
    return Score(
        "FID", subject, value, found, level=level, interval_method=method, estimator="plug-in", n=len(x), m=len(y),
        seed=seed if interval else None, encoder=generated.encoder, split=split, details=details,
        settings={"normalize": normalize, "covariance": "n - 1"},
        note=". ".join(filter(None, [note, _note(min(len(x), len(y)), x.shape[1], value, details["infinity"], interval and found is None)])),
    )  # fmt: skip


def _note(n: int, d: int, value: float, limit: float | None, lacking: bool) -> str:
    if n <= d:
        text = f"Not meaningful: {n} samples do not span the {d} dimensions, so the value is mostly bias"
    elif limit is not None:
        text = f"Biased upwards at this size: {value:.4g} extrapolates to about {limit:.4g} for infinitely many samples"
    else:
        text = "Biased upwards, the more the fewer samples: compare at equal sizes alone"
    return text + ". No interval: too few groups or samples to leave some out" * lacking


@dataclass(frozen=True)
class _Parts:
    """Rows of both sets in ``count`` blocks of whole units.

    Attributes:
        sets: the features, (n, d) and (m, d).
        block: the block of every row, (n,) and (m,).
        count: number of blocks.
        unit: ``"group"`` or ``"row"``.
        units: how many of them there are.
    """

    sets: tuple[Floats, Floats]
    block: tuple[Index, Index]
    count: int
    unit: str
    units: int

    @property
    def method(self) -> str:
        """What :meth:`error` did, in words."""
        if self.unit == "row":
            what = f"leave-one-block-out jackknife, {self.count} random blocks of rows, taken as independent"
        elif self.count == self.units:
            what = "leave-one-group-out jackknife"
        else:
            what = f"leave-one-block-out jackknife, {self.count} random blocks of whole groups ({self.units} groups)"
        return f"{what}, t, {self.count - 1} df"

    def rows(self, b: int) -> list[Floats]:
        """The rows of one block, by set."""
        return [x[block == b] for x, block in zip(self.sets, self.block, strict=True)]

    def error(self, whole: Sequence[Moments]) -> float | None:
        """Standard error by leaving out one block at a time, or None where what is left is no set or nothing varies."""
        values: list[float] = []
        for b in range(self.count):
            kept = [len(x) - int((block == b).sum()) for x, block in zip(self.sets, self.block, strict=True)]
            if min(kept) < 2:
                return None
            if min(kept) > self.sets[0].shape[1]:
                values.append(_of_moments(*(w.without(Moments.of(rows)) for w, rows in zip(whole, self.rows(b), strict=True))))
            else:
                values.append(_of_features(*(x[block != b] for x, block in zip(self.sets, self.block, strict=True))))
        if self.count < 2:
            return None
        return float(np.sqrt((self.count - 1) * np.var(values))) or None

    def infinity(self, value: float, seed: int) -> float | None:
        """FID extrapolated to infinitely many rows in both sets, or None where there is too little to fit a line to."""
        d, full = self.sets[0].shape[1], [len(x) for x in self.sets]
        if self.count < 8 or min(full) <= 2 * d:
            return None
        order = rng_for(seed, "fid infinity").permutation(self.count)
        ask = {int(np.ceil(self.count * share)) for share in (0.5, 0.6, 0.7, 0.8, 0.9)}
        points = [(1.0, value)]
        for start in (0, self.count // 2):  # the halves of the two runs are disjoint
            grown = Moments(), Moments()
            for k, b in enumerate(np.roll(order, -start), 1):
                for moments, rows in zip(grown, self.rows(int(b)), strict=True):
                    moments.add(rows)
                if k in ask and min(m.n for m in grown) > d:
                    # The bias is a / n + b / m; both shrink together along these points.
                    inverse = sum(n / m.n for n, m in zip(full, grown, strict=True)) / 2
                    points.append((inverse, _of_moments(*grown)))
        if len({inverse for inverse, _ in points}) < 3:
            return None
        at, values = np.array(points).T
        return float(np.polynomial.polynomial.polyfit(at, values, 1)[0])


def _draw_parts(generated: FeatureSet, reference: FeatureSet, sets: tuple[Floats, Floats], most: int, seed: int) -> _Parts:
    n, m = len(sets[0]), len(sets[1])
    rng = rng_for(seed, "fid blocks")
    names = [checked_names("groups", s.groups, len(x)) for s, x in zip((generated, reference), sets, strict=True)]
    if names[0] is None or names[1] is None:
        count = min(most, n, m)
        return _Parts(sets, (rng.permutation(n) % count, rng.permutation(m) % count), count, "row", n + m)
    unit = np.unique(np.array(names[0] + names[1], dtype=str), return_inverse=True)[1]
    units = int(unit.max()) + 1
    block = np.arange(units)
    if units > most:
        # The largest group first into the block that holds least, ties at random: blocks of nearly equal size.
        size = np.bincount(unit[:n], minlength=units) / n + np.bincount(unit[n:], minlength=units) / m
        load = np.zeros(most)
        order = rng.permutation(units)
        for u in order[np.argsort(-size[order], kind="stable")]:
            block[u] = int(load.argmin())
            load[block[u]] += size[u]
    return _Parts(sets, (block[unit[:n]], block[unit[n:]]), min(units, most), "group", units)
