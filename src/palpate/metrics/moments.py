"""Kernel sums of the Gaussian from moments, in O(N d^2): no pair is formed, samples may stream
past.

With ``z = (x - c) / sigma``, ``u = exp(-||z||^2 / 2)`` and ``e = u - 1``,

``k(x, y) - 1 = (e + e' + e e') + u u' (z.z') + u u' (z.z')^2 / 2 + remainder``,

so that the sum over all pairs of two items a, b is
``n_b E_a + n_a E_b + E_a E_b + F_a.F_b + <G_a, G_b> / 2 + remainder`` with the additive moments
``E = sum e``, ``F = sum u z``, ``G = sum u z z'``. The remainder is certified: with
``rho = max ||z||^2`` every ``|z.z'| <= rho``, and

``|remainder| <= h(rho) <G_a, G_b>``, ``h(rho) = (exp(rho) - 1 - rho - rho^2 / 2) / rho^2``
``= rho / 6 + O(rho^2)``,

as ``|exp(t) - 1 - t - t^2/2| <= t^2 h(|t|)`` with h increasing, and sums of squares are positive.
Unit-norm features with sigma = 10 have rho <= 0.01 about their center: the remainder of TMMD is
some 1e-5 where it is 10, and far less near 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from palpate.metrics.inputs import Array, Index, host, in_threads, like, release, row_norms, rows_at
from palpate.metrics.intervals import PairSums, split_by

#: Rows of an array on disk that are added together.
STREAM = 1 << 15
#: Rows that are multiplied together.
CHUNK = 2048
#: Second moments of all items are float64 up to this many bytes, else float32.
WIDE = 256 << 20
#: Largest ``rho`` that the bound is formed for (exp(30) is 1e13), and the value for no bound.
WIDEST, NO_BOUND = 30.0, 1e30
#: About so many rows give the center, in runs of so many.
CENTER_ROWS, RUN = 4096, 64
#: Sums over samples; ``rho`` is a maximum.
ADDITIVE = ("n", "zeroth", "first", "second", "fourth", "diagonal")


@dataclass
class Moments:
    """Weighted moments of the samples of P items about a fixed center.

    Attributes:
        center: (d,) subtracted from every row.
        sigma: bandwidth.
        n: (P,) samples.
        zeroth: (P,) E.
        first: (P, d) F.
        second: (P, d, d) G.
        fourth: (P,) sum of ``(u ||z||^2)^2``: what i = j adds to ``<G, G>``.
        diagonal: (P,) sum of the expansion at i = j, which is 0 for the kernel itself.
        rho: largest ``||z||^2`` so far.
    """

    center: Array
    sigma: float
    n: Array
    zeroth: Array
    first: Array
    second: Any
    fourth: Array
    diagonal: Array
    rho: float = 0.0

    @classmethod
    def empty(cls, center: Any, sigma: float, items: int) -> Moments:
        """Nothing added yet."""
        center = np.asarray(center, dtype=np.float64)
        d = len(center)
        second = np.zeros((items, d, d), np.float64 if items * d * d * 8 <= WIDE else np.float32)
        n, zeroth, fourth, diagonal = np.zeros((4, items))
        return cls(center, float(sigma), n, zeroth, np.zeros((items, d)), second, fourth, diagonal)

    def add(self, x: Any, item: Index) -> None:
        """Add rows (n, d); ``item`` (n,) of each."""
        jobs = [
            (int(item[at[0]]), at[k : k + CHUNK])
            for at in split_by(item)
            for k in range(0, len(at), CHUNK)
        ]
        parts = in_threads(lambda job: self._part(x, job[1]), jobs, x)
        for (p, at), (*sums, rho) in zip(jobs, parts, strict=True):
            for name, value in zip(ADDITIVE, (len(at), *sums), strict=True):
                getattr(self, name)[p] += value
            self.rho = max(self.rho, rho)

    def _part(self, x: Any, at: Index) -> tuple[Any, ...]:
        """(E, F, G, fourth, diagonal, rho) of some rows of one item."""
        adjacent = at[-1] - at[0] == len(at) - 1  # a slice is not copied
        rows = x[int(at[0]) : int(at[-1]) + 1] if adjacent else rows_at(x, at)
        z = rows - like(self.center, x)
        z *= 1 / self.sigma
        squares = row_norms(z) ** 2
        u, e = np.exp(-0.5 * squares), np.expm1(-0.5 * squares)
        root = like(np.sqrt(u), z)
        z *= root[:, None]
        # The expansion of k(x, x) - 1 = 0; it is taken out of sums over i != j.
        diagonal = 2 * e + e**2 + u**2 * squares + u**2 * squares**2 / 2
        weighted = u * squares
        first, second, fourth = host(root @ z), host(z.T @ z), weighted @ weighted
        return e.sum(), first, second, fourth, diagonal.sum(), float(squares.max())

    def products(self) -> tuple[Array, Array]:
        """(P, P) sums of k - 1 over i != j, and (P, P) what their remainders cannot exceed."""
        flat, e = self.second.reshape(len(self.n), -1), self.zeroth
        second = (flat @ flat.T).astype(np.float64)
        linear = np.outer(self.n, e) + np.outer(e, self.n) + np.outer(e, e)
        sums = linear + self.first @ self.first.T + second / 2
        at = np.diag_indices_from(sums)
        sums[at] -= self.diagonal
        if self.rho <= WIDEST:
            second[at] -= self.fourth  # i = j is known: it is 0
            return sums, remainder_factor(self.rho) * np.maximum(second, 0)
        # The weights u underflow where h overflows: their product is no bound. It stays finite, as
        # it is added and multiplied by zeros on its way.
        pairs = np.outer(self.n, self.n)
        pairs[at] -= self.n
        return sums, NO_BOUND * pairs

    def sums(self, cells: Index, segments: int) -> PairSums:
        """As by blocks, with ``bound``; ``cells`` (2, P) are the segment and unit of each item."""
        none = np.zeros(len(self.n))
        sums, bound = (
            PairSums.from_block(block, self.n, none, cells, segments) for block in self.products()
        )
        return replace(sums, backend="moments", bound=bound)


def moments_of(parts: Sequence[Any], item: Index, items: int, sigma: float) -> Moments:
    """Moments of all rows of the parts, read in slabs; ``item`` (N,) over one after the other."""
    moments, first = Moments.empty(center_of(parts), sigma, items), 0
    for part in parts:
        for k in range(0, len(part), STREAM):
            slab = part[k : k + STREAM]
            moments.add(slab, item[first : first + len(slab)])
            release(part)
            first += len(slab)
    return moments


def remainder_factor(rho: float) -> float:
    """``h(rho) = (exp(rho) - 1 - rho - rho^2 / 2) / rho^2``, accurate for small rho too."""
    if rho < 1e-80:
        return rho / 6
    # sum_{p >= 3} rho^p / p! = exp(rho) P(3, rho), P the regularized lower incomplete gamma
    return float(np.exp(rho) * scipy.special.gammainc(3, rho) / rho**2)


def center_of(parts: Iterable[Any]) -> Array:
    """The mean of some rows, in short runs spread evenly over the arrays.

    Any fixed center is right; one in the middle gives the smallest remainder. Runs, since an array
    on disk is read by pages.
    """
    parts = [p for p in parts if len(p)]
    step, picked = max(RUN, RUN * (sum(len(p) for p in parts) // CENTER_ROWS)), []
    for part in parts:
        picked += [host(part[k : k + RUN]) for k in range(0, len(part), step)]
        release(part)
    return np.concatenate(picked).mean(axis=0)
