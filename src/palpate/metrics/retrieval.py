"""Retrieval: how high the right key ranks by cosine similarity, in both directions.

Row i of a belongs to row i of b. Ties count as a random order would, in expectation, so equal keys
never look like hits. Strictly, only the key of the same sample is right; with texts, keys whose
text has a cosine above a threshold to the query's are right as well (TVL), and the first counts.

No matrix of all pairs is held: rows are taken a block at a time. The best right key of each query
is found first; then one product gives both directions, since a rank needs only counts over a row or
a column.

With a above the best right key, t tied with it (itself included) and w of these wrong,
``P(top k) = 1 - C(w, s) / C(t, s)`` with ``s = min(max(k - a, 0), t)`` places that the ties share,
and the expected rank is ``a + (t + 1) / (t - w + 1)``.

The interval of the median rank is Woodruff's (1952): that of the share of ranks up to the median,
by jackknife over groups, turned back into ranks.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from palpate.core import FeatureSet, Score, require, rng_for
from palpate.metrics.inputs import check, rows_text
from palpate.metrics.means import Array, Mean, mean_of

#: Cosines that differ by less are ties: products of equal vectors differ in the last bits.
TIE = 1e-6
#: Similarities in memory at a time (16 MB).
CELLS = 1 << 22
#: Similarities that random pools may take in all; each needs one pool at least.
POOLED = 4e8
#: Least deviation that numbers are divided by, as a share of that of simulated contacts.
LEAST_SPREAD = 0.1
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Ranks:
    """Where the first right key of each query stands: (n,) arrays of counts, in float64.

    Attributes:
        above: keys of higher similarity than the best right one.
        ties: keys that are equal to it, itself included.
        wrong: those of them that are not right.
        right: right keys in all.
        pool: keys in all.
    """

    above: Array
    ties: Array
    wrong: Array
    right: Array
    pool: int

    @property
    def expected(self) -> Array:
        """(n,) expected rank, from 1."""
        return self.above + (self.ties + 1) / (self.ties - self.wrong + 1)

    def within(self, k: int) -> Array:
        """(n,) probability that a right key is among the first k."""
        slots = np.clip(k - self.above, 0, self.ties)
        log_miss = scipy.special.gammaln(self.wrong + 1) - scipy.special.gammaln(
            self.wrong - slots + 1
        )
        return 1 - np.exp(
            log_miss
            - scipy.special.gammaln(self.ties + 1)
            + scipy.special.gammaln(self.ties - slots + 1)
        )

    def shuffled(self) -> Ranks:
        """The same where all keys are equal: chance."""
        all_tied = np.full(len(self.right), float(self.pool))
        return Ranks(
            np.zeros(len(all_tied)), all_tied, all_tied - self.right, self.right, self.pool
        )


class Retrieved(NamedTuple):
    """One direction: a mean for each k, and the median rank."""

    top: list[Mean]
    median: Score


def retrieval(
    a: FeatureSet,
    b: FeatureSet,
    *,
    names: tuple[str, str] = ("a", "b"),
    top: Sequence[int] = (1, 5, 10),
    pool: int | None = None,
    texts: NDArray[Any] | None = None,
    threshold: float = 0.999,
    seed: int = 0,
    **fields: Any,
) -> tuple[Retrieved, Retrieved]:
    """How often the right key is among the k most similar ones, and the median of its rank.

    Args:
        a: n rows, e.g. tactile embeddings of the test samples.
        b: n rows with the same ids in the same order, e.g. text embeddings.
        names: of both, e.g. ``("tactile", "text")``.
        top: the values of k; those over the pool's size are skipped.
        pool: rank among so many samples drawn at random instead of among all; chance is then
            k / pool whatever n. The mean is over up to 20 pools, fewer the larger they are.
        texts: (n, d) embeddings of the samples' texts: keys count as right as well if their text
            has a cosine above ``threshold`` to the query's. None counts the sample's own key only.
        threshold: see ``texts``; 0.999 takes equal texts.
        seed: of the pools.
        **fields: further fields of the scores: ``subject``, by default ``"real"``, ``split``, and
            more ``settings``.

    Returns:
        b found by a (``"top-1"`` with ``features`` of ``"text by tactile"``), and a found by b;
        ``settings["pool"]`` is the pool's size, ``details`` holds the chance level, and the mean
        number of right keys.

    Raises:
        PalpateError: if ids differ, the pool is larger than the set, n < 2, or on texts that are
            not finite.
    """
    n, widths = len(a.ids), (a.features.shape[1], b.features.shape[1])
    must = "Queries and keys must have the same ids in the same order"
    require(list(a.ids) == list(b.ids), None, must, "different ids", fix="Take the same from both")
    must = "Retrieval needs at least two samples in one common space"
    got = f"{n} samples, widths {widths[0]} and {widths[1]}"
    fix = "Embed both with one set of encoders"
    require(n > 1 and widths[0] == widths[1], None, must, got, fix=fix)
    must, fix = f"must lie in 2 to {n}, the number of samples", "Choose a smaller pool"
    require(pool is None or 2 <= pool <= n, "pool", must, pool, fix=fix)
    draws = [np.arange(n)]
    if pool is not None and pool < n:
        count = int(np.clip(POOLED // pool**2, 1, 20))
        draws = [rng_for(seed, "pool", r).choice(n, pool, replace=False) for r in range(count)]
    size, queries, keys = len(draws[0]), unit_rows(a.features), unit_rows(b.features)
    words = None if texts is None else unit_rows(texts, "The embeddings of texts")
    some = [slice(None)] if size == n else draws  # without a copy
    by_draw = [
        both_ranks(queries[rows], keys[rows], None if words is None else words[rows], threshold)
        for rows in some
    ]
    groups = np.array(a.ids if a.groups is None else a.groups, dtype=str)
    right = "the sample's own" if texts is None else f"text cosine > {threshold:g}"
    common = {
        "subject": "real",
        "encoder": a.encoder,
        "estimator": "mean",
        "seed": seed if len(draws) > 1 else None,
        **fields,
        "settings": {"pool": size, "right": right, **(fields.get("settings") or {})},
    }
    forth, back = (
        _retrieved(
            [pair[way] for pair in by_draw],
            draws,
            groups,
            top=top,
            fields={**common, "features": name},
        )
        for way, name in enumerate((f"{names[1]} by {names[0]}", f"{names[0]} by {names[1]}"))
    )
    return forth, back


def both_ranks(
    a: Floats, b: Floats, texts: Floats | None = None, threshold: float = 0.999
) -> tuple[Ranks, Ranks]:
    """Ranks of b's rows for a's rows as queries, and the other way round.

    Args:
        a: (n, d) rows of :func:`unit_rows`.
        b: the same.
        texts: (n, e), see :func:`retrieval`.
        threshold: see :func:`retrieval`.
    """
    n = len(a)
    best = np.full((2, n), -np.inf, np.float32)
    for rows in blocks(n, n):
        right = _right_keys(rows, n, texts, threshold)
        cosines = np.where(right, a[rows] @ b.T, np.float32(-np.inf))
        best[0, rows] = cosines.max(axis=1)
        np.maximum(best[1], cosines.max(axis=0), out=best[1])
    # Products of other shapes add in another order: a quarter of the worst error of such a sum.
    tie = np.float32(max(TIE, a.shape[1] * 2**-26))
    high, low = best + tie, best - tie
    above, upper, ties = (np.zeros((2, n)) for _ in range(3))  # directions, queries
    total = np.zeros(n)  # right keys of each query, the same in both directions
    for rows in blocks(n, n):
        cosines = a[rows] @ b.T
        right = _right_keys(rows, n, texts, threshold)
        total[rows] = _by_row(right)
        _count(cosines, rows, high, above)
        _count(cosines, rows, low, upper)
        np.copyto(cosines, -np.inf, where=~right)
        _count(cosines, rows, low, ties)
    forth, back = (
        Ranks(above[k], upper[k] - above[k], upper[k] - above[k] - ties[k], total, n)
        for k in (0, 1)
    )
    return forth, back


def unit_rows(x: NDArray[Any], name: str = "The features") -> Floats:
    """Rows of length 1 in float32; a row of zeros stays.

    Raises:
        PalpateError: on NaN or infinity in ``name``, which no rank could place.
    """
    x = np.asarray(x, dtype=np.float32)
    length = np.linalg.norm(x, axis=1, keepdims=True)
    bad, fix = ~np.isfinite(length[:, 0]), "Check what those rows were made from"
    check(not bad.any(), name, "must be finite", f"NaN or infinity in {rows_text(bad)}", fix)
    return x / np.maximum(length, 1e-12)


def standardized(
    sets: Sequence[NDArray[Any]], reference: NDArray[Any]
) -> tuple[list[NDArray[np.float32]], list[list[float]]]:
    """Rows (n, d) of each set centered and divided by the reference's (m, d) mean and deviation,
    then of length 1; and mean and deviation.
    """
    mean, spread = reference.mean(axis=0), np.maximum(reference.std(axis=0), LEAST_SPREAD)
    rows = [unit_rows((x - mean) / spread) for x in sets]
    return rows, [mean.round(4).tolist(), spread.round(4).tolist()]


def blocks(rows: int, columns: int) -> Generator[slice]:
    """Slices of rows, of about ``CELLS`` cells and below 256 rows each: counts fit into a byte."""
    step = int(np.clip(CELLS // columns, 1, 248))
    for start in range(0, rows, step):
        yield slice(start, min(start + step, rows))


def _right_keys(rows: slice, n: int, texts: Floats | None, threshold: float) -> NDArray[np.bool_]:
    """Which keys are right for the queries among the rows, (rows, n)."""
    own = np.arange(rows.start, rows.stop)
    right = np.zeros((len(own), n), bool)
    if texts is not None:
        np.greater(texts[rows] @ texts.T, threshold, out=right)
    right[own - rows.start, own] = True
    return right


def _count(cosines: Floats, rows: slice, bounds: Floats, counts: Array) -> None:
    """Add the cosines above the bounds of their rows, and of their columns, to (2, n) counts."""
    counts[0, rows] = _by_row(cosines > bounds[0, rows, None])
    # Bytes are added without a wider copy.
    counts[1] += (cosines > bounds[1]).view(np.uint8).sum(axis=0, dtype=np.uint8)


def _by_row(mask: NDArray[np.bool_]) -> Array:
    """(rows,) number of true cells of each row."""
    return np.array([np.count_nonzero(row) for row in mask], dtype=np.float64)


def _retrieved(
    by_draw: Sequence[Ranks],
    draws: Sequence[NDArray[np.intp]],
    groups: NDArray[np.str_],
    *,
    top: Sequence[int],
    fields: dict[str, Any],
) -> Retrieved:
    """Scores of one direction, averaged over the pools that a query was in."""
    seen, chance = np.zeros(len(groups)), [ranks.shuffled() for ranks in by_draw]
    for rows in draws:
        seen[rows] += 1
    used = np.flatnonzero(seen)

    def averaged(values: Sequence[Array]) -> Array:
        total = np.zeros(len(groups))
        for rows, part in zip(draws, values, strict=True):
            total[rows] += part
        return total[used] / seen[used]

    size, queries = by_draw[0].pool, groups[used].tolist()
    details = {"pools": len(draws)}
    details |= {"right_keys": float(np.mean([ranks.right.mean() for ranks in by_draw]))}
    means = [
        mean_of(
            f"top-{k}",
            averaged([ranks.within(k) for ranks in by_draw]),
            queries,
            weights=seen[used],
            details={"chance": float(np.mean([c.within(k) for c in chance])), **details},
            **fields,
        )
        for k in top
        if k < size
    ]
    ranks = averaged([r.expected for r in by_draw])
    details["chance"] = float(np.median(averaged([c.expected for c in chance])))
    median = _median(ranks, queries, details, fields)
    return Retrieved(means, median)


def _median(
    ranks: Array, groups: Sequence[str], details: dict[str, Any], fields: dict[str, Any]
) -> Score:
    value = float(np.median(ranks))
    share = mean_of("share", ranks <= value, groups, **fields).score
    interval, method = None, ""
    if share.interval is not None:
        half = (share.interval[1] - share.interval[0]) / 2
        bounds = np.clip([0.5 - half, 0.5 + half], 0, 1)
        low, high = np.quantile(ranks, bounds, method="inverted_cdf").tolist()
        interval, method = (low, high), f"Woodruff, from the {share.interval_method}"
    return replace(
        share,
        metric="median rank",
        value=value,
        estimator="median",
        interval=interval,
        interval_method=method,
        higher_is_better=False,
        details=details,
    )
