"""One pass over the pairs, by the cheaper of two back ends that give the same sums.

* ``moments`` (:mod:`palpate.metrics.moments`): O(N d^2) time, for one Gaussian that is wide against the spread of the features. What it
  leaves out is bounded, and the bound is part of the result.
* ``blocked`` (:mod:`palpate.metrics.blocked`): O(N^2 d) time, any kernel, exact to rounding.

``auto`` takes moments where they are cheaper and their bound stays within the tolerance, else blocks; what was taken is recorded.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateError
from palpate.metrics.arrays import ops_of
from palpate.metrics.blocked import Sweep, blocked_sums
from palpate.metrics.inputs import release
from palpate.metrics.kernels import Gaussian, Index, Kernel
from palpate.metrics.moments import Moments, center_of
from palpate.metrics.sums import PairSums

Backend = Literal["auto", "blocked", "moments"]
BACKENDS = ("auto", "blocked", "moments")
#: Moments are tried from so many rows on, in units of the width and in all: there they take a fraction of the blocks' time.
ROWS_A_WIDTH, LEAST_ROWS = 8, 4096
#: Moments of all items may take so many bytes, and four times that where the pairs would take hours; up to the second number in any case.
MOMENT_BYTES, STATE_BYTES = 512 << 20, 64 << 20
#: From so many rows on a fall back to blocks is announced: it takes hours.
LONG = 300_000
STREAM = 1 << 15


def kernel_sums(
    parts: Sequence[Any],
    segment: Index,
    unit: Index,
    *,
    segments: int,
    kernel: Kernel,
    backend: Backend = "auto",
    tolerance: float = 1e-4,
    bound: Callable[[PairSums], float],
    block: int = 1024,
    spread: list[Index] | None = None,
) -> Sweep:
    """Sums of k by item and segment.

    Args:
        parts: feature arrays (n_k, d), checked, of one type and library; arrays on disk (``np.memmap``) are streamed by moments.
        segment: (N,) in [0, segments) over all parts, one after the other.
        unit: (N,).
        segments: S.
        kernel: what is summed.
        backend: see the module.
        tolerance: largest ``bound`` that ``auto`` takes moments with.
        bound: what the rests of moments can change in the statistic that matters.
        block: most rows of a block.
        spread: sets of segments whose centered squares are wanted.

    Raises:
        PalpateError: if moments are asked for where there are none.
    """
    width, rows = int(parts[0].shape[1]), len(segment)
    items, number = np.unique(np.stack([segment, unit]), axis=1, return_inverse=True)
    why_not = _no_moments(
        kernel, items.shape[1], width, MOMENT_BYTES if rows <= LONG else 4 * MOMENT_BYTES
    )
    if backend == "moments" and why_not:
        raise PalpateError(
            "The moments back end needs one Gaussian bandwidth and few items",
            why_not,
            'Pass backend="blocked"',
        )
    # Second moments that take more room than the features, and more than a little, are no saving.
    small = items.shape[1] * width**2 * 4 <= max(STATE_BYTES, rows * width * 4)
    if backend == "moments" or (
        backend == "auto"
        and not why_not
        and small
        and rows >= max(LEAST_ROWS, ROWS_A_WIDTH * width)
    ):
        found = _moments(parts, items, number.reshape(-1), segments, kernel, spread)
        rest = bound(found.sums)
        if backend == "moments" or rest <= tolerance:
            return found
        why_not = f"they would leave {rest:.2g} open, more than the tolerance {tolerance:.2g}"
    if rows > LONG:
        reason = f" Moments were not taken: {why_not}." if backend == "auto" and why_not else ""
        warnings.warn(
            f"All {rows**2 / 2:.2g} pairs are formed, which takes long.{reason}", stacklevel=4
        )
    x = ops_of(parts[0]).join(list(parts))
    return blocked_sums(
        x, segment, unit, segments=segments, kernel=kernel, block=block, spread=spread
    )


def _no_moments(kernel: Kernel, items: int, width: int, room: int) -> str:
    """Why the sums cannot come from moments; '' if they can."""
    if not isinstance(kernel, Gaussian) or kernel.bandwidth is None:
        return f"the kernel is {kernel.settings()}, not one Gaussian"
    if items * width**2 * 4 > room:
        return f"second moments of {items} (unit, segment) cells of width {width} take more than {room >> 20} MiB"
    return ""


def _moments(
    parts: Sequence[Any],
    items: Index,
    number: Index,
    segments: int,
    kernel: Kernel,
    spread: list[Index] | None,
) -> Sweep:
    moments, first = (
        Moments.empty(center_of(parts), float(kernel.bandwidth or 0), items.shape[1]),
        0,
    )  # type: ignore[attr-defined]
    for part in parts:
        for k in range(0, len(part), STREAM):
            slab = part[k : k + STREAM]
            moments.add(slab, number[first : first + len(slab)])
            release(part)
            first += len(slab)
    found = [moments.spread(np.flatnonzero(np.isin(items[0], s))) for s in spread or []]
    return Sweep(
        moments.sums(items[0], items[1], segments), np.array(found, dtype=np.float64).reshape(-1, 3)
    )
