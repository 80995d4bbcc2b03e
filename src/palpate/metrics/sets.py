"""Scores of sets of features that are requested by name: Vendi, and MIND.

**Vendi** (Friedman and Dieng, arXiv 2210.02410), how many different samples there seem to be:
``exp(-sum l log l)`` over the eigenvalues l of ``K / n`` with ``K = X X'`` of rows of length 1.
It is 1 for equal samples, n for orthogonal ones, and grows with n: compare at equal n only, with
that of real images as floor, where these are as many.

**MIND**, the Monge Inception distance (Berthet et al., arXiv 2605.06797): squared Wasserstein
distances of the projections on random directions u of length 1, exact by sorting, averaged::

    MIND = d mean_u W_2^2(u'X, u'Y),   W_2^2 = integral_0^1 (F^-1(q) - G^-1(q))^2 dq

With the factor d, the width of the features, a moved mean counts as in FID: |mu1 - mu2|^2. As FID
it is biased upwards at few samples. Published with the features of Inception.

Intervals are jackknifes over at most 20 blocks of whole groups, as those of FID.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate._version import __version__
from palpate.core import FeatureSet, Note, Score, rng_for
from palpate.metrics.blocks import FidOptions, checked_rows, draw_blocks
from palpate.metrics.inputs import Array, Index, checked_whole, with_columns
from palpate.metrics.intervals import Scored, Spread, score_of
from palpate.metrics.paired import Comparison, compared, same_samples

#: Random directions of MIND, and how many are in memory at a time.
DIRECTIONS, AT_ONCE = 1024, 64


def vendi(features: Any, **options: Unpack[FidOptions]) -> Score:
    """Vendi score of one set of samples: an effective number of different ones, in [1, n].

    Args:
        features: (n, d), n >= 2: an array, a tensor, a list of rows, or a FeatureSet; rows are
            scaled to length 1.
        **options: as of :func:`palpate.metrics.fid`.

    Returns:
        Value and interval; closer to that of real images is better.

    Raises:
        PalpateError: on features that cannot be used, or fewer than two rows.
    """
    (x,), settings = with_columns(options, generated=features)
    return _vendi(x, None, **settings).score


def mind(generated: Any, reference: Any, **options: Unpack[FidOptions]) -> Score:
    """MIND between generated and real samples; lower is better.

    Args:
        generated: (n, d) features, n >= 2: an array, a tensor, a list of rows, or a FeatureSet.
        reference: (m, d) features, m >= 2.
        **options: as of :func:`palpate.metrics.fid`; ``seed`` draws the directions, too.

    Returns:
        Value and interval.

    Raises:
        PalpateError: on features that cannot be used, unequal widths, fewer than two rows, or
            encoders of different digests.
    """
    (x, y), settings = with_columns(options, generated=generated, reference=reference)
    return _mind(x, y, **settings).score


def compare_vendi(
    generators: Mapping[str, FeatureSet],
    reference: FeatureSet,
    *,
    seed: int = 0,
    split: str | None = None,
) -> Comparison:
    """Vendi of several generators on the same samples, with paired differences.

    Args:
        generators: name -> features; all with the same ids, labels and groups.
        reference: features of real samples; of as many, their score is the floor.
        seed: as of :func:`vendi`.
        split: digest of the split, kept in the scores.

    Raises:
        PalpateError: if generators differ in ids, labels, groups or encoder.
    """
    each = {
        n: [_vendi(s, reference, subject=n, seed=seed, split=split)]
        for n, s in same_samples(generators).items()
    }
    floor = _vendi(reference, None, seed=seed)
    same = all(len(s.ids) == len(reference.ids) for s in generators.values())
    return compared(each, (floor if same else None,))


def compare_mind(
    generators: Mapping[str, FeatureSet],
    reference: FeatureSet,
    *,
    seed: int = 0,
    split: str | None = None,
) -> Comparison:
    """MIND of several generators on the same samples, with paired differences.

    Args:
        generators: name -> features; all with the same ids, labels and groups.
        reference: features of the real samples.
        seed: as of :func:`mind`.
        split: digest of the split, kept in the scores.

    Raises:
        PalpateError: if generators differ in ids, labels, groups or encoder, or as :func:`mind`.
    """
    sets = same_samples(generators)
    each = {n: [_mind(s, reference, subject=n, seed=seed, split=split)] for n, s in sets.items()}
    return compared(each)


def _vendi(
    features: FeatureSet, real: FeatureSet | None, *, seed: int = 0, **fields: Any
) -> Scored:
    def values(x: Array, _: Array, at: Index, __: Index, count: int) -> Array:
        return np.array([_effective(x[at != b]) for b in range(-1, count)])

    result = _jackknifed("Vendi", features, features, values, (1, np.inf), seed, **fields)
    floor = None
    if real is not None and len(real.ids) == len(features.ids):
        floor = _vendi(real, None, seed=seed).score.value
    score = replace(result.score, higher_is_better=None, m=None, reference=None, floor=floor)
    return replace(result, score=replace(score, notes=(Note("vendi-of-n"), *score.notes)))


def _effective(x: Array) -> float:
    x = x.astype(np.float64)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), np.finfo(float).tiny)
    gram = x.T @ x if x.shape[0] > x.shape[1] else x @ x.T  # they have the same eigenvalues
    shares = np.linalg.eigvalsh(gram) / len(x)
    shares = shares[shares > 0]
    return float(np.exp(-np.sum(shares * np.log(shares))))


def _mind(generated: FeatureSet, reference: FeatureSet, *, seed: int = 0, **fields: Any) -> Scored:
    def values(x: Array, y: Array, at: Index, other: Index, count: int) -> Array:
        rng, d = rng_for(seed, "directions of MIND"), x.shape[1]
        sums = np.zeros(count + 1)
        for _ in range(0, DIRECTIONS, AT_ONCE):
            u = rng.normal(size=(AT_ONCE, d))
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            orders = [(p, np.argsort(p, axis=1)) for p in (u @ x.T, u @ y.T)]
            for b in range(-1, count):
                a, c = (
                    _sorted_without(p, o, k == b)
                    for (p, o), k in zip(orders, (at, other), strict=True)
                )
                sums[b + 1] += _squared_distances(a, c).sum()
        return d * sums / DIRECTIONS

    result = _jackknifed("MIND", generated, reference, values, (0, np.inf), seed, **fields)
    score = replace(result.score, notes=(Note("fid-biased"), *result.score.notes))
    return replace(result, score=score)


def _sorted_without(values: Array, order: Index, out: NDArray[np.bool_]) -> Array:
    """Rows of values (L, n) sorted, without the columns that are left out."""
    keep = ~out[order]
    return np.take_along_axis(values, order, axis=1)[keep].reshape(len(values), -1)


def _squared_distances(a: Array, b: Array) -> Array:
    """W_2^2 of sorted rows (L, n) and (L, m): quantile functions are steps, of 1/n and 1/m."""
    n, m = a.shape[1], b.shape[1]
    if n == m:
        return np.mean((a - b) ** 2, axis=1)
    ends = np.unique(np.concatenate([np.arange(1, n + 1) * m, np.arange(1, m + 1) * n]))
    widths = np.diff(ends, prepend=0) / (n * m)
    return ((a[:, (ends - 1) // m] - b[:, (ends - 1) // n]) ** 2) @ widths


def _jackknifed(  # noqa: PLR0917 - in the order of the scores' own
    metric: str,
    generated: FeatureSet,
    reference: FeatureSet,
    values: Callable[[Array, Array, Index, Index, int], Array],
    bounds: tuple[float, float],
    seed: int,
    *,
    subject: str = "generated",
    split: str | None = None,
) -> Scored:
    """The score whose values on all, then without each block, ``values`` gives."""
    checked_whole(0, seed=seed)
    x, y, groups, notes = checked_rows(generated, reference, 2)
    blocks = draw_blocks(len(x), len(y), groups, seed)
    sets = ((x, blocks.x), (y, blocks.y))
    enough = min(len(v) - np.bincount(at).max() for v, at in sets) > 1
    units = list(blocks.names) if enough else []
    value, *without = values(x, y, blocks.x, blocks.y, len(units)).tolist()
    replicates = np.array(without)
    spread = Spread.of(value, replicates, blocks.details["left_out"], blocks.tail)
    notes += [Note("no-interval-few-units")] if not spread.known else []
    score = score_of(
        metric,
        subject,
        spread,
        bounds,
        estimator="plug-in",
        n=len(x),
        m=len(y),
        seed=seed,
        encoder=generated.encoder,
        reference=reference.digest,
        split=split,
        details=blocks.details | {"version": __version__},
        notes=tuple(notes),
    )
    return Scored(score, replicates, units)
