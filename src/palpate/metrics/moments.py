"""Kernel sums of the Gaussian from moments, in O(N d^2): no pair is ever formed, and samples may stream past once.

With ``z = (x - c) / sigma``, ``u = exp(-||z||^2 / 2)`` and ``e = u - 1``,

``k(x, y) - 1 = (e + e' + e e') + u u' (z.z') + u u' (z.z')^2 / 2 + rest``,

so that the sum over all pairs of two items a, b is ``n_b E_a + n_a E_b + E_a E_b + F_a.F_b + <G_a, G_b> / 2 + rest`` with the additive
moments ``E = sum e``, ``F = sum u z``, ``G = sum u z z'``. The rest is certified: with ``rho = max ||z||^2`` every ``|z.z'| <= rho``, and

``|rest| <= h(rho) <G_a, G_b>``, ``h(rho) = (exp(rho) - 1 - rho - rho^2 / 2) / rho^2 = rho / 6 + O(rho^2)``,

as ``|exp(t) - 1 - t - t^2/2| <= t^2 h(|t|)`` with h increasing, and sums of squares are positive. Unit-norm features with sigma = 10 have
rho <= 0.01 about their center: the rest of TMMD is some 1e-5 where it is 10, and far less near 0.

States add up: over batches, processes and machines, if they share the center.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import special

from palpate.core import PalpateError
from palpate.metrics.arrays import Ops, ops_of
from palpate.metrics.inputs import release
from palpate.metrics.kernels import Array, Index
from palpate.metrics.sums import PairSums

CHUNK = 2048


@dataclass
class Moments:
    """Weighted moments of the samples of P items about a fixed center.

    Attributes:
        center: (d,) subtracted from every row.
        sigma: bandwidth.
        n: (P,) samples.
        zeroth: (P,) E.
        first: (P, d) F.
        second: (P, d, d) G, float64; float32 where that would take more than :data:`WIDE`.
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
        center, d = np.asarray(center, dtype=np.float64), len(center)
        wide = np.float64 if items * d * d * 8 <= WIDE else np.float32
        zeros = np.zeros(items)
        return cls(
            center,
            float(sigma),
            zeros,
            zeros.copy(),
            np.zeros((items, d)),
            np.zeros((items, d, d), wide),
            zeros.copy(),
            zeros.copy(),
        )

    def add(self, x: Any, item: Index | int = 0) -> None:
        """Adds rows.

        Args:
            x: (n, d) rows.
            item: (n,) which item each belongs to, or one for all.
        """
        items = np.full(len(x), item) if np.ndim(item) == 0 else np.asarray(item)
        order = np.argsort(items, kind="stable")
        cuts = np.r_[0, np.flatnonzero(np.diff(items[order])) + 1, len(x)]
        jobs = [
            (int(items[order[a]]), order[i : min(i + CHUNK, b)])
            for a, b in pairwise(cuts)
            for i in range(a, b, CHUNK)
            if a < b
        ]
        ops = ops_of(x)
        for (p, at), (e, f, g, fourth, diagonal, rho) in zip(
            jobs, ops.each(lambda job: self._part(x, job[1], ops), jobs), strict=True
        ):
            self.n[p] += len(at)
            self.zeroth[p] += e
            self.first[p] += f
            self.second[p] += g
            self.fourth[p] += fourth
            self.diagonal[p] += diagonal
            self.rho = max(self.rho, rho)

    def _part(self, x: Any, at: Index, ops: Ops) -> tuple[float, Array, Any, float, float, float]:
        """(E, F, G, fourth, diagonal, rho) of a few rows of one item."""
        run = (
            slice(int(at[0]), int(at[-1]) + 1) if len(at) and at[-1] - at[0] == len(at) - 1 else at
        )
        if type(ops) is Ops:
            z = np.subtract(x[run], self.center.astype(x.dtype), dtype=x.dtype)
            z *= x.dtype.type(1 / self.sigma)
            squares = ops.squares(z)
            u = np.exp(-0.5 * squares)
            first = (u.astype(z.dtype) @ z).astype(np.float64)
            z *= np.sqrt(u).astype(z.dtype)[:, None]
            second = z.T @ z
        else:
            xp = ops.xp  # type: ignore[attr-defined]
            rows = (
                x[run]
                if isinstance(run, slice)
                else xp.take(x, xp.asarray(run, device=ops.device), axis=0)
            )  # type: ignore[attr-defined]
            z = (rows - xp.asarray(self.center, dtype=x.dtype, device=ops.device)) / self.sigma  # type: ignore[attr-defined]
            wide = ops.squares(z)
            u, squares = ops.numpy(xp.exp(-0.5 * wide)), ops.numpy(wide)
            weights = xp.astype(xp.exp(-0.25 * wide), x.dtype)
            first = ops.numpy(xp.sum(xp.astype(xp.exp(-0.5 * wide), x.dtype)[:, None] * z, axis=0))
            z = z * weights[:, None]
            second = ops.numpy(z.T @ z)
        e = np.expm1(-0.5 * squares)
        # What the expansion says of k(x, x) - 1 = 0: it is taken out of sums over i != j.
        at_self = 2 * e + e**2 + u**2 * squares + u**2 * squares**2 / 2
        return (
            float(e.sum()),
            first,
            second,
            float((u * squares) @ (u * squares)),
            float(at_self.sum()),
            float(squares.max(initial=0.0)),
        )

    def merge(self, others: Iterable[Moments]) -> Moments:
        """The moments of all samples of this and others, item by item.

        Raises:
            PalpateError: if centers, bandwidths or shapes differ.
        """
        out = Moments(
            self.center,
            self.sigma,
            self.n.copy(),
            self.zeroth.copy(),
            self.first.copy(),
            self.second.copy(),
            self.fourth.copy(),
            self.diagonal.copy(),
            self.rho,
        )
        for other in others:
            if not (
                np.array_equal(out.center, other.center)
                and out.sigma == other.sigma
                and out.first.shape == other.first.shape
            ):
                got = f"sigma {out.sigma:g} and {other.sigma:g}, items and widths {out.first.shape} and {other.first.shape}"
                raise PalpateError(
                    "Moments that are merged must share center, bandwidth and items",
                    got,
                    "Begin all from one Moments.empty",
                )
            for name in ("n", "zeroth", "first", "second", "fourth", "diagonal"):
                getattr(out, name)[...] += getattr(other, name)
            out.rho = max(out.rho, other.rho)
        return out

    def products(self) -> tuple[Array, Array]:
        """(P, P) sums of k - 1 over i != j, and (P, P) what their rests cannot exceed."""
        flat = self.second.reshape(len(self.n), -1)
        second = (flat @ flat.T).astype(np.float64)
        e = self.zeroth
        sums = (
            np.outer(self.n, e)
            + np.outer(e, self.n)
            + np.outer(e, e)
            + self.first @ self.first.T
            + second / 2
        )
        sums[np.diag_indices_from(sums)] -= self.diagonal
        rest = second.copy()
        rest[np.diag_indices_from(rest)] -= self.fourth  # i = j is known: it is 0
        if self.rho <= WIDEST:
            return sums, rest_factor(self.rho) * np.maximum(rest, 0)
        # The weights u underflow where h overflows: their product says nothing. No kernel value is larger than 1, so this is no bound;
        # it stays finite, as it is added and multiplied by zeros on its way.
        pairs = np.outer(self.n, self.n)
        pairs[np.diag_indices_from(pairs)] -= self.n
        return sums, NO_BOUND * pairs

    def sums(self, segment: Index, unit: Index, segments: int) -> PairSums:
        """As :func:`palpate.metrics.blocked.blocked_sums` gives them, with ``bound``; item p lies in one segment and one unit."""
        block, rest = self.products()
        n = self.n.copy()
        bound = PairSums.from_block(
            rest, n, np.zeros_like(n), segment, unit, segments, backend="moments"
        )
        return PairSums.from_block(
            block, n, np.zeros_like(n), segment, unit, segments, backend="moments", bound=bound
        )

    def spread(self, items: Index) -> tuple[float, float, float]:
        """As :func:`palpate.metrics.blocked.centered_squares`, of the samples of some items, to leading order in 1 / sigma^2.

        ``Kc_ij = z_i . z_j`` with z centered on the mean of these samples: within ``rho`` of its size of the exact value.
        """
        n, first = self.n[items].sum(), self.first[items].sum(axis=0)
        if n < 2:
            return np.nan, np.nan, np.nan
        second = self.second[items].sum(axis=0, dtype=np.float64) - np.outer(first, first) / n
        own = self._fourth_about(items, first / n)
        return max(float((second**2).sum() - own), 0.0), float(np.trace(second)), own

    def _fourth_about(self, items: Index, mean: Array) -> float:
        """Sum of ``||z - mean||^4`` over the samples, with the mean distance taken for the cross terms: a correction of order 1 / n."""
        squares = float(self.fourth[items].sum())
        n, trace = self.n[items].sum(), float(np.trace(self.second[items].sum(axis=0)))
        shrunk = 1 - float(mean @ mean) * n / trace if trace > 0 else 0.0
        return squares * shrunk**2


#: Largest ``rho`` that the bound is formed for: exp(30) is 1e13, and every number is well inside float32.
WIDEST, NO_BOUND = 30.0, 1e30
#: Second moments of all items are float64 up to this many bytes.
WIDE = 256 << 20


def rest_factor(rho: float) -> float:
    """``h(rho) = (exp(rho) - 1 - rho - rho^2 / 2) / rho^2``, accurate for small rho too."""
    if rho <= 0:
        return 0.0
    # sum_{p >= 3} rho^p / p! = exp(rho) * P(3, rho), with P the regularized lower incomplete gamma function.
    with np.errstate(over="ignore"):
        return (
            float(np.exp(rho + np.log(special.gammainc(3, rho)) - 2 * np.log(rho)))
            if rho > 1e-80
            else rho / 6
        )


def center_of(parts: Iterable[Any], rows: int = 4096, run: int = 64) -> Array:
    """The mean of about ``rows`` rows in short runs spread evenly over the arrays.

    Any fixed center is right; one in the middle gives the least rest. Runs, since an array on disk is read by pages.
    """
    parts = [p for p in parts if len(p)]
    total, picked = sum(len(p) for p in parts), []
    step = max(run, run * (total // rows))
    for part in parts:
        ops = ops_of(part)
        picked += [ops.numpy(part[k : k + run]) for k in range(0, len(part), step)]
        release(part)
    return np.concatenate(picked).mean(axis=0)
