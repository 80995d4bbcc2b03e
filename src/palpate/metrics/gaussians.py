"""Sets of features taken as Gaussians: their moments, which can be merged and parted, and the Fréchet distance of two, in float64.

``|mu1 - mu2|^2 + tr S1 + tr S2 - 2 tr (S1 S2)^(1/2)``, covariances divided by n - 1. The trace of the root needs no matrix root. With any
factor ``S1 = R R'`` the eigenvalues of ``S1 S2`` are those of the symmetric ``R' S2 R``: real, not negative, and their roots are summed
(``scipy.linalg.sqrtm`` of the unsymmetric ``S1 S2`` may turn complex or fail). R is a Cholesky factor, or the root by eigenvalues where S1
is singular. A set of n <= d samples spans less than the space: then ``S = F' F`` with the thin ``F = (X - mu) / sqrt(n - 1)``, and the trace
is the sum of the singular values of ``F1 F2'``: cheaper, and exact where a formed covariance would lose half the digits of its small
eigenvalues.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.core import PalpateError
from palpate.metrics.inputs import Floats, checked_features

Array = NDArray[np.float64]

#: Rows turned to float64 at a time.
ROWS = 8192
#: Two covariances that differ from their transposes by more than this, relative to the largest entry, are no covariances.
SYMMETRY = 1e-6


@dataclass
class Moments:
    """Mean and scatter of rows that arrive in parts; mergeable over files and processes.

    The state is centered at its own mean and updated by the formula of Chan, Golub and LeVeque, ``M = M_a + M_b + delta delta' n_a n_b / n``,
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
        self.scatter = (
            self.scatter + other.scatter + np.outer(delta, delta * (self.n * other.n / n))
        )
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
            raise PalpateError(
                "A part must have at most as many rows as the whole",
                f"{part.n} of {self.n}",
                "Take away what was added",
            )
        if not part.n:
            return Moments(self.n, self.mean, self.scatter)
        if not n:
            return Moments()
        _same_width(self.mean, part.mean)
        mean = self.mean + (self.mean - part.mean) * (part.n / n)
        delta = part.mean - mean
        return Moments(
            n, mean, self.scatter - part.scatter - np.outer(delta, delta * (n * part.n / self.n))
        )

    @property
    def covariance(self) -> Array:
        """(d, d), divided by n - 1.

        Raises:
            PalpateError: with fewer than two rows.
        """
        if self.n < 2:
            raise PalpateError(
                "A covariance must come from at least 2 rows", f"{self.n}", "Add more samples"
            )
        return self.scatter / (self.n - 1)


def _on_host(x: Any) -> Any:
    if not hasattr(x, "detach"):
        return x
    x = x.detach().cpu()
    return (x.float() if str(x.dtype) == "torch.bfloat16" else x).numpy()  # NumPy has no bfloat16


def _same_width(a: Array, b: Array) -> None:
    if a.shape != b.shape:
        raise PalpateError(
            "All features must have the same width",
            f"{len(a)} and {len(b)}",
            "Embed all with the same encoder",
        )


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
    covs = [
        _checked_covariance(f"cov{i}", cov, len(means[0])) for i, cov in enumerate((cov1, cov2), 1)
    ]
    return _distance(
        means[0],
        means[1],
        float(np.trace(covs[0]) + np.trace(covs[1])),
        _root_trace(covs[0], covs[1]),
    )


def _checked_mean(name: str, value: Any) -> Array:
    mean = np.asarray(value, dtype=np.float64)
    if mean.ndim != 1 or not mean.size or not np.isfinite(mean).all():
        raise PalpateError(
            f"{name} must be a finite vector (d,)", f"shape {mean.shape}", "Pass the mean over rows"
        )
    return mean


def _checked_covariance(name: str, value: Any, d: int) -> Array:
    cov = np.asarray(value, dtype=np.float64)
    if cov.shape != (d, d) or not np.isfinite(cov).all():
        got = f"shape {cov.shape}" if cov.shape != (d, d) else "NaN or infinity"
        raise PalpateError(
            f"{name} must be a finite matrix ({d}, {d})",
            got,
            "Pass the covariance of the same features as the mean",
        )
    off = float(np.abs(cov - cov.T).max())
    if off > SYMMETRY * float(np.abs(cov).max()):
        raise PalpateError(
            f"{name} must be symmetric",
            f"entries that differ from their mirror by {off:.3g}",
            "Pass a covariance matrix",
        )
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


def distance_of_moments(a: Moments, b: Moments) -> float:
    """The Fréchet distance of two sets of more rows than columns."""
    one, two = a.covariance, b.covariance
    return _distance(a.mean, b.mean, float(np.trace(one) + np.trace(two)), _root_trace(one, two))


def distance_of_features(x: Floats, y: Floats) -> float:
    """The Fréchet distance of two arrays of at least two rows, one of which has no more rows than columns."""
    means = x.mean(axis=0, dtype=np.float64), y.mean(axis=0, dtype=np.float64)
    thin = [(v - mean) / np.sqrt(len(v) - 1) for v, mean in zip((x, y), means, strict=True)]
    traces = sum(float(np.einsum("ij,ij->", f, f)) for f in thin)
    # Of a set larger than d, its covariance's factor stands for it: no product is larger than (d, d).
    a, b = (f if len(f) <= f.shape[1] else _factor(f.T @ f).T for f in thin)
    return _distance(*means, traces, float(np.sum(linalg.svdvals(a @ b.T, check_finite=False))))
