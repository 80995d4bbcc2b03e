"""Precision, recall, density, coverage: do generated samples lie among real ones, and vice versa?

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

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from palpate import __version__
from palpate.core import FeatureSet, Note, PalpateError, Score
from palpate.metrics.inputs import (
    Array,
    checked_names,
    checked_pair,
    checked_whole,
    copies_across,
    feature_set,
    require_one_encoder,
)
from palpate.metrics.intervals import spread_of_values

#: Squared distances that are in memory at a time: 64 MB.
BLOCK = 1 << 23
#: Squared distances closer than this share of the squared norms are equal.
TIE = 1e-12


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
    **options: Any,
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
        **options: ``grouped``: look for neighbors in other groups only (see the top of this file),
            default where both sets have groups, False gives the values of the package ``prdc``;
            ``subject`` and ``split`` are kept in the scores.

    Returns:
        Four scores. Intervals are of the mean over rows (see :func:`prdc_rows`), robust to whole
        groups deviating together, for fixed balls. ``details`` holds the median radii.

    Raises:
        PalpateError: on features that cannot be used, unequal widths, encoders of different
            digests, or (grouped) a group outside which there are fewer than k rows.
    """
    x = feature_set(generated, ids=ids, groups=groups, encoder=encoder)
    y = feature_set(
        reference, argument="reference", ids=reference_ids, groups=reference_groups, encoder=encoder
    )
    return prdc_rows(x, y, k, **options)[0]


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
    require_one_encoder(generated, reference, "Generated and reference")
    sets, names = (generated.features, reference.features), ("generated", "reference")
    x, y = checked_pair(*sets, normalize=False, least=k + 1, names=names)
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
        _squared_radii(name, rows, unit if grouped else None, k)
        for name, rows, unit in zip(("generated", "real"), (x, y), groups, strict=True)
    ]
    median = [float(np.median(np.sqrt(r))) for r in radii]
    rows = _compare(x, y, radii, k)
    scores: list[Score] = []
    for metric, values in rows.items():
        over_real, balls = metric in ("Recall", "Coverage"), int(metric != "Recall")
        spread = spread_of_values(values, groups[over_real])
        interval = spread.interval(0.0, np.inf if metric == "Density" else 1.0)
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
                interval_method=spread.method if interval else "",
                estimator="per-row mean",
                n=len(x),
                m=len(y),
                encoder=generated.encoder,
                reference=reference.digest,
                split=split,
                higher_is_better=True,
                settings={"k": k, "grouped": grouped, "inside": "<"},
                details=details | {"version": __version__},
                notes=tuple(note for holds, note in notes if holds),
            )
        )
    return scores, rows


def _squared_radii(name: str, x: Array, groups: Sequence[str] | None, k: int) -> Array:
    """Squared distance (n,) to the k-th nearest row of another group; without groups of any row."""
    n = len(x)
    unit = np.arange(n) if groups is None else np.unique(groups, return_inverse=True)[1]
    others = (n - np.bincount(unit))[unit]
    if groups is not None and others.min() < k:
        must = f"Every group must have at least k = {k} {name} rows outside it"
        got = f"{others.min()} outside group {groups[int(others.argmin())]!r}"
        raise PalpateError(must, got, "Choose a smaller k, more groups, or leave the groups out")
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
