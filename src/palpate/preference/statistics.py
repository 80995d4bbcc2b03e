"""Statistics of votes: arrays in, numbers out.

A vote of rater r on comparison c of item i is 1 (the first method), 0 (the same), -1 (the second)
or NaN (none), in an array (R, C, N).

**Preference** of the first method: the share of votes for it, ties as half.

**Two-way interval**: raters and items are resampled at once, each with replacement, and a vote
weighs the product of the two counts (the pigeonhole bootstrap, Owen 2007). Percentiles of the
replicates. Votes are not independent: of 40 items and 10 raters, intervals that take them so cover
67 % instead of 95 %. Two raters are no sample of people: with ``FEW_RATERS`` or fewer, items alone
are resampled, and the interval is for these raters.

**Davidson's model** (1970) of methods with strengths ``theta`` and a tie parameter ``nu``::

    P(i > j) : P(i = j) : P(j > i)  =  exp(theta_i) : nu exp((theta_i + theta_j)/2) : exp(theta_j)

fitted by maximum likelihood under a prior N(0, 3^2) on every ``theta`` and on ``log nu``, without
which a method that always wins would be infinitely strong.

**Krippendorff's alpha**, nominal: ``1 - D_o / D_e`` of the coincidences of values within units;
missing cells are left out. Chance is within a comparison, where a rater can choose no method that
is not shown: observed and expected disagreements are added up over comparisons, as are those of
**Cohen's kappa**, ``sum n (p_o - p_e) / sum n (1 - p_e)``. Pooled over the pairs of three methods,
raters who toss coins would have an alpha of about 0.4.

**Unanimous votes** do not vary when resampled. The bound is that of Clopper and Pearson (1934) for
n of n items: the items that people would judge otherwise are at most a share ``1 - 0.025^(1/n)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special
from scipy.sparse import csgraph

Array = NDArray[np.float64]
Interval = tuple[float, float]

#: So many raters or fewer stand for themselves alone; a note reports fewer than ``ENOUGH``.
FEW_RATERS, ENOUGH = 2, 5
REPLICATES = 1000
#: Standard deviation of the prior of strengths, in logits.
PRIOR = 3.0
#: What the expected width assumes, in logits; gives the first method a preference of about 0.7.
SIMULATED, ASSUMED = 100, {"mean": 1.2, "item_sd": 1.5, "rater_sd": 0.7, "tie_band": 0.5}


@dataclass(frozen=True)
class Weights:
    """How often each replicate has each rater (B, R) and each item (B, N)."""

    raters: Array
    items: Array

    @classmethod
    def draw(cls, raters: int, items: int, rng: np.random.Generator, count: int) -> Weights:
        """Resample items, and raters where there are more than ``FEW_RATERS``."""
        few = raters <= FEW_RATERS
        of_raters = np.ones((count, raters)) if few else _resampled(raters, rng, count)
        return cls(of_raters, _resampled(items, rng, count))

    @classmethod
    def once(cls, raters: int, items: int) -> Weights:
        """Everything once: the data themselves."""
        return cls(np.ones((1, raters)), np.ones((1, items)))


def _resampled(n: int, rng: np.random.Generator, count: int) -> Array:
    return rng.multinomial(n, np.full(n, 1 / n), size=count).astype(np.float64)


def percentiles(replicates: Array) -> Interval | None:
    """The central 95 % of replicates; None if they do not vary or fewer than half are known."""
    finite = replicates[np.isfinite(replicates)]
    if 2 * len(finite) < len(replicates) or np.ptp(finite) < 1e-12:
        return None
    low, high = np.quantile(finite, [0.025, 0.975])
    return float(low), float(high)


def unanimous_bound(share: float, items: int) -> Interval:
    """The 95 % interval of a preference that is the same in all of so many items."""
    reach = (1 - 0.025 ** (1 / items)) * max(share, 1 - share)
    return max(0.0, share - reach), min(1.0, share + reach)


def outcome_counts(votes: Array, weights: Weights) -> Array:
    """Weighted counts of wins, ties and losses of the first method.

    Args:
        votes: (R, C, N).
        weights: B replicates.

    Returns:
        (B, C, 3).
    """
    cells = np.stack([votes == 1, votes == 0, votes == -1], axis=-1).astype(np.float64)
    of_raters = np.tensordot(weights.raters, cells, axes=1)  # (B, C, N, 3)
    return np.einsum("bcno,bn->bco", of_raters, weights.items)


def preferences(counts: Array) -> Array:
    """Share of the first method, ties as half, of counts (..., 3); NaN without votes."""
    total = counts.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (counts[..., 0] + counts[..., 1] / 2) / total


def method_preferences(shares: Array, pairs: Sequence[tuple[int, int]], methods: int) -> Array:
    """Mean preference of each method over its comparisons: (..., C) -> (..., methods)."""
    total, count = np.zeros((*shares.shape[:-1], methods)), np.zeros(methods)
    for c, (a, b) in enumerate(pairs):
        total[..., a] += shares[..., c]
        total[..., b] += 1 - shares[..., c]
        count[[a, b]] += 1
    return total / count


def davidson(
    counts: Array, pairs: Sequence[tuple[int, int]], methods: int, start: Array | None = None
) -> Array:
    """Fit Davidson's model.

    Args:
        counts: (C, 3) wins, ties and losses of the first method of each pair.
        pairs: (first, second) method of each comparison.
        methods: how many.
        start: a result to start from.

    Returns:
        (methods + 1,) strengths in logits of mean 0, and log nu.
    """
    first, second = np.array(pairs).T
    rows = np.arange(len(pairs))
    design: Array = np.zeros((len(pairs), 3, methods + 1))
    design[rows, 0, first] = design[rows, 2, second] = design[:, 1, methods] = 1
    design[rows, 1, first] = design[rows, 1, second] = 0.5
    total = counts.sum(axis=1)

    def loss(x: Array) -> tuple[float, Array]:
        logits = design @ x
        top = logits.max(axis=1, keepdims=True)  # scipy's logsumexp takes ten times as long
        weight = np.exp(logits - top)
        norm = weight.sum(axis=1, keepdims=True)
        value = total @ (np.log(norm) + top)[:, 0] - (counts * logits).sum()
        slope = np.tensordot(total[:, None] * weight / norm - counts, design, 2)
        return float(value + x @ x / (2 * PRIOR**2)), slope + x / PRIOR**2

    guess = np.zeros(methods + 1) if start is None else start
    x = np.asarray(optimize.minimize(loss, guess, jac=True, method="BFGS").x, np.float64)
    x[:methods] -= x[:methods].mean()
    return x


def prior_decides(counts: Array, pairs: Sequence[tuple[int, int]], methods: int) -> bool:
    """Whether some methods never win or tie against the others: likelihood has no maximum there."""
    wins = np.zeros((methods, methods))
    for (a, b), (won, ties, lost) in zip(pairs, counts, strict=True):
        wins[a, b], wins[b, a] = won + ties, lost + ties
    return int(csgraph.connected_components(wins, connection="strong")[0]) > 1


def sign_test(a: int, b: int) -> float:
    """Two-sided p-value of ``a`` against ``b`` where both are equally likely; NaN for 0 and 0."""
    return min(1.0, 2 * float(special.bdtr(min(a, b), a + b, 0.5))) if a + b else float("nan")


Codes = NDArray[np.intp]


def raw_agreement(codes: Codes) -> float:
    """Share of equal votes among all pairs of raters on a unit; (R, ...) codes, -1 for none."""
    pairs = [_common(codes, a, b) for a, b in combinations(range(len(codes)), 2)]
    same, n = sum(int((x == y).sum()) for x, y in pairs), sum(len(x) for x, _ in pairs)
    return same / n if n else float("nan")


def cohen_kappa(codes: Codes) -> float:
    """Cohen's kappa (1960), of more than two raters the mean over their pairs; NaN without any.

    Args:
        codes: (R, C, U), chance within each of C comparisons, or (R, U) of one; -1 for none.
    """
    values: list[float] = []
    for a, b in combinations(range(len(codes)), 2):
        beyond = possible = 0.0
        for comparison in _comparisons(codes):
            x, y = _common(comparison, a, b)
            size = int(codes.max()) + 1
            counts = [np.bincount(z, minlength=size) for z in (x, y)]
            chance = float(counts[0] @ counts[1]) / max(1, len(x))  # n p_e
            beyond += float((x == y).sum()) - chance
            possible += len(x) - chance
        values += [beyond / possible] if possible > 0 else []
    return float(np.mean(values)) if values else float("nan")


def _common(codes: Codes, a: int, b: int) -> tuple[Codes, Codes]:
    both = (codes[a] >= 0) & (codes[b] >= 0)
    return codes[a][both], codes[b][both]


def _comparisons(codes: Codes) -> Codes:
    """(R, C, U) or (R, U) -> (C, R, U)."""
    return np.moveaxis(codes.reshape(len(codes), -1, codes.shape[-1]), 1, 0)


def krippendorff_alpha(codes: Codes) -> float:
    """Krippendorff's alpha (nominal); NaN without two values.

    Args:
        codes: (R, C, U), chance within each of C comparisons, or (R, U) of one; -1 for none.
    """
    observed = expected = 0.0
    for comparison in _comparisons(codes):
        size = int(codes.max(initial=0)) + 1
        n_uc = np.stack([(comparison == c).sum(axis=0) for c in range(size)], axis=1)
        n_uc = n_uc[n_uc.sum(axis=1) >= 2].astype(np.float64)  # one value pairs with nothing
        m = n_uc.sum(axis=1, keepdims=True)
        # o_ck: ordered pairs of values c, k within a unit, which weighs as many as it has values.
        o = (n_uc / (m - 1)).T @ n_uc - np.diag((n_uc / (m - 1)).sum(axis=0))
        n_c = o.sum(axis=1)
        observed += o.sum() - np.trace(o)
        expected += (n_c.sum() ** 2 - n_c @ n_c) / max(1.0, n_c.sum() - 1)
    return float(1 - observed / expected) if expected > 0 else float("nan")


def tau_b(x: Array, y: Array, weights: Array, *, mirrored: bool = False) -> float:
    """Kendall's tau-b of x and y (n,), each observation weighing w (n,); NaN where one is constant.

    With ``mirrored`` every (x, y) counts as (-x, -y) as well: differences of two methods have no
    direction of their own.
    """
    both = of_x = of_y = 0.0
    for sign in (1, -1) if mirrored else (1,):
        sx = np.sign(np.subtract.outer(x, sign * x))
        sy = np.sign(np.subtract.outer(y, sign * y))
        both += float(weights @ (sx * sy) @ weights)
        of_x += float(weights @ np.abs(sx) @ weights)
        of_y += float(weights @ np.abs(sy) @ weights)
    return both / np.sqrt(of_x * of_y) if of_x * of_y > 0 else float("nan")


def expected_half_width(items: int, raters: int) -> float:
    """Mean half-width of the interval of a preference in ``SIMULATED`` studies as ``ASSUMED``.

    Logits vary between items and raters; small differences are ties. Studies without an interval
    are left out; NaN if they are more than half.
    """
    rng, a = np.random.default_rng(0), ASSUMED
    widths: list[float] = []
    for _ in range(SIMULATED):
        logit = a["mean"] + a["item_sd"] * rng.standard_normal(items)
        logit = logit + a["rater_sd"] * rng.standard_normal((raters, 1))
        felt = logit + rng.logistic(size=(raters, items))
        votes = np.where(np.abs(felt) < a["tie_band"], 0.0, np.sign(felt))[:, None]
        weights = Weights.draw(raters, items, rng, 300)
        interval = percentiles(preferences(outcome_counts(votes, weights))[:, 0])
        widths += [(interval[1] - interval[0]) / 2] if interval else []
    return float(np.mean(widths)) if 2 * len(widths) >= SIMULATED else float("nan")
