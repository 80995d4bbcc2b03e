"""Parts of the impact of a leak: 1-NN with ties, and even thinning.

1-NN: a test row x gets the label of the train row z with the smallest ||x - z||^2. Equal images are
common (an untouched gel, a frame stored twice), so where several train rows are equally near, the
hit is the share of them with the right label: what a random choice among them would score on
average. Equally near means within the rounding of float32, ``TIE (||x||^2 + max ||z||^2)``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.core import rng_for

#: Entries of a block of distances (float32: 64 MB), of some test rows by all train rows.
CELLS = 1 << 24
#: Rounding of a float32 distance, relative to the squared lengths.
TIE = 2e-6

Floats = NDArray[np.float64]
Codes = NDArray[np.int64]


def nearest_hits(
    queries: NDArray[np.float32], base: NDArray[np.float32], query_class: Codes, base_class: Codes
) -> Floats:
    """Probability that 1-NN gets each query right, ties being broken at random.

    Args:
        queries: (m, d).
        base: (n, d).
        query_class: class numbers from 0, (m,).
        base_class: the same, (n,).

    Returns:
        (m,), in [0, 1].
    """
    classes = int(max(query_class.max(), base_class.max())) + 1
    one_hot = np.zeros((len(base), classes), np.float32)
    one_hot[np.arange(len(base)), base_class] = 1
    length = np.einsum("ij,ij->i", base, base)
    out = np.empty(len(queries))
    step = max(1, CELLS // len(base))
    for start in range(0, len(queries), step):
        x = queries[start : start + step]
        distance = x @ base.T
        distance *= -2
        distance += length
        rounding = TIE * (np.einsum("ij,ij->i", x, x) + length.max())
        tied = distance <= (distance.min(axis=1) + rounding)[:, None]
        # Sums of at most 2^24 ones are exact in float32.
        votes = tied.astype(np.float32) @ one_hot
        right = votes[np.arange(len(x)), query_class[start : start + step]]
        out[start : start + step] = right / votes.sum(axis=1)
    return out


def thin(rows: Codes, groups: Codes, classes: Codes, count: int, seed: int) -> Codes:
    """Choose rows evenly: every class keeps its share (at least one row), and so every group.

    Each class gets ``count * n_c / n`` rows, rounded so that the sum is ``count``; within a class
    the rows, sorted by group and at random within it, are taken at equal steps from a random start,
    so a group keeps its share to within one row.

    Args:
        rows: row numbers to choose from.
        groups: number of the group of each of ``rows``.
        classes: number of the class of each.
        count: rows to keep, at least the number of classes.
        seed: of the choice.

    Returns:
        ``count`` of ``rows`` (all of them, if they are no more), in a random order.
    """
    rng = rng_for(seed, "impact thin", count)
    order = rng.permutation(len(rows))
    if len(rows) <= count:
        return rows[order]
    sizes = np.bincount(classes)
    exact = count * sizes / len(rows)
    quota = np.where(sizes > 0, np.maximum(np.floor(exact), 1), 0).astype(np.int64)
    while (off := count - int(quota.sum())) != 0:
        room = (quota < sizes) if off > 0 else (quota > 1)
        gap = np.where(room, (exact - quota) * np.sign(off), -np.inf)
        quota[int(gap.argmax())] += np.sign(off)
    chosen: list[Codes] = []
    for c in np.flatnonzero(quota):
        of_class = order[classes[order] == c]
        line = of_class[np.argsort(groups[of_class], kind="stable")]
        at = (np.arange(quota[c]) + rng.random()) * len(line) / quota[c]
        chosen.append(line[at.astype(np.int64)])
    return rows[rng.permutation(np.concatenate(chosen))]


def code(names: Sequence[str]) -> tuple[list[str], Codes]:
    """The distinct names, sorted, and the number of each."""
    values, codes = np.unique(np.asarray(list(names), dtype=str), return_inverse=True)
    return [str(v) for v in values], codes.astype(np.int64)
