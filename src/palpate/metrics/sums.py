"""Kernel sums by segment and unit: all that the metrics know of the pairs, and small.

A *segment* is a cell of (set, class, half); a *unit* is what a jackknife leaves out (a video; a
sample where no videos are known). An *item* is what the pass over the pairs keeps apart: all
samples of one (unit, segment), or a single sample. From sums of items with segments follow every
metric, every leave-one-unit-out value and the sums without same-unit pairs; from sums of items with
items also any exchange of units between sets, without another look at a feature.

Sums leave out i = j. What the diagonal would add is separate (``diagonal``): 0 for the Gaussian,
whose k - 1 vanishes there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from palpate.metrics.inputs import Array, Index


@dataclass(frozen=True)
class Totals:
    """Sums by pair of segments.

    Attributes:
        n: (S,) samples.
        sums: (S, S) sum of k over ordered pairs i != j.
        same: (S, S) the part of ``sums`` from pairs inside one unit.
        pairs: (S, S) ordered pairs inside one unit, a sample with itself included.
        diagonal: (S,) sum of k(x_i, x_i).
    """

    n: Array
    sums: Array
    same: Array
    pairs: Array
    diagonal: Array

    def merge(self, to: Index, segments: int) -> Totals:
        """Segments joined: segment s becomes ``to[s]``; -1 drops it."""
        m = one_hot(to, segments)
        sums, same, pairs = (m.T @ a @ m for a in (self.sums, self.same, self.pairs))
        return Totals(self.n @ m, sums, same, pairs, self.diagonal @ m)


@dataclass(frozen=True)
class PairSums:
    """Sums of k of each item with each segment.

    Attributes:
        n: (P,) samples of an item.
        rows: (P, S) sum over pairs of a sample of the item and another sample of a segment.
        same: (P, S) the part of ``rows`` from pairs inside one unit.
        diagonal: (P,) sum of k(x_i, x_i).
        segment: (P,) the item's segment, 0 <= segment < S.
        unit: (P,) the item's unit, any integers.
        block: (P, P) sums of items with items, or None where there would be too many.
        backend: ``"blocked"`` or ``"moments"``.
        bound: what the remainders of ``rows`` and ``same`` by moments cannot exceed; None if exact.
    """

    n: Array
    rows: Array
    same: Array
    diagonal: Array
    segment: Index
    unit: Index
    block: Array | None = None
    backend: str = "blocked"
    bound: PairSums | None = field(default=None, repr=False)

    @classmethod
    def from_block(
        cls, block: Array, n: Array, diagonal: Array, segment: Index, unit: Index, **more: Any
    ) -> PairSums:
        """From sums of items with items; ``more``: ``segments`` (S), ``backend``, ``bound``."""
        m = one_hot(segment, more.pop("segments"))
        same = np.where(unit[:, None] == unit, block, 0.0)
        return cls(n, block @ m, same @ m, diagonal, segment, unit, block, **more)

    @property
    def segments(self) -> int:
        """S."""
        return self.rows.shape[1]

    @cached_property
    def units(self) -> Index:
        """The different units, in the order of :meth:`leave_one_out`."""
        return np.unique(self.unit)

    def merge(self, to: Index, segments: int) -> PairSums:
        """Segments joined: segment s becomes ``to[s]``; -1 drops it and its items."""
        m, keep = one_hot(to, segments), to[self.segment] >= 0
        return PairSums(
            self.n[keep],
            self.rows[keep] @ m,
            self.same[keep] @ m,
            self.diagonal[keep],
            to[self.segment][keep],
            self.unit[keep],
            None if self.block is None else self.block[np.ix_(keep, keep)],
            self.backend,
            None if self.bound is None else self.bound.merge(to, segments),
        )

    def _part(self, at: Index | slice) -> tuple[Array, Array, Array, Array]:
        """(n, sums, same, diagonal) of some items against all segments, by segment of the item."""
        m = one_hot(self.segment[at], self.segments)
        return self.n[at] @ m, m.T @ self.rows[at], m.T @ self.same[at], self.diagonal[at] @ m

    @cached_property
    def totals(self) -> Totals:
        """Sums over all items."""
        n, sums, same, diagonal = self._part(slice(None))
        cell = np.searchsorted(self.units, self.unit) * self.segments + self.segment
        count = np.bincount(cell, weights=self.n, minlength=len(self.units) * self.segments)
        count = count.reshape(-1, self.segments).astype(np.float64)
        return Totals(n, sums, same, count.T @ count, diagonal)

    def leave_one_out(self) -> Iterator[Totals]:
        """The totals without each unit in turn: ``sums - C - C' + B``.

        C are the sums of the unit with all samples, B those of the unit with itself.
        """
        full = self.totals
        for at in split_by(self.unit):
            n, with_all, inside, diagonal = self._part(at)
            yield Totals(
                full.n - n,
                full.sums - with_all - with_all.T + inside,
                full.same - inside,
                full.pairs - np.outer(n, n),
                full.diagonal - diagonal,
            )


def split_by(key: Index) -> list[Index]:
    """Positions of equal keys, one array a key, in the order of the keys."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(order) else []


def one_hot(to: Index, segments: int) -> Array:
    """(n, segments) float64 indicators; -1 is a row of zeros."""
    return (to[:, None] == np.arange(segments)).astype(np.float64)
