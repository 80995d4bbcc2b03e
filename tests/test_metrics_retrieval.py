"""Retrieval against all orders of the keys, on hand counts, and without a matrix of all pairs."""

from itertools import permutations

import numpy as np
import pytest
from scipy import stats

from palpate.core import FeatureSet
from palpate.metrics import retrieval as module
from palpate.metrics.retrieval import both_ranks, retrieval, unit_rows
from palpate.report.labels import label_of


def features(x, groups=None, start=0):
    ids = [f"s{start + k}" for k in range(len(x))]
    return FeatureSet(ids, np.asarray(x, np.float32), None, groups, "e")


def all_orders(similar, good, measure):
    """Mean of a measure of (row's goodness in order) over the orders that agree with similarity."""
    means = []
    for row, right in zip(similar, good, strict=True):
        orders = [o for o in permutations(range(len(row))) if (np.diff(row[list(o)]) <= 0).all()]
        means.append(np.mean([measure(right[list(o)]) for o in orders]))
    return np.array(means)


def random_rows(ties, n=6):
    rng = np.random.default_rng(3)
    keys = rng.normal(size=(n, 3))
    if ties:
        keys[1] = keys[2] = keys[4]
        keys[3] = keys[0]
    return unit_rows(keys + 0.8 * rng.normal(size=(n, 3))), unit_rows(keys)


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("many", [False, True])
def test_ranks_equal_all_orders_in_both_directions(ties, many):
    a, b = random_rows(ties)
    texts = unit_rows(np.random.default_rng(4).normal(size=(6, 2))) if many else None
    good = (
        np.eye(6, dtype=bool) if texts is None else (texts @ texts.T > 0.6) | np.eye(6, dtype=bool)
    )
    forth, back = both_ranks(a, b, texts, 0.6)
    similar = (a.astype(float) @ b.T.astype(float)).round(6)
    for ranks, matrix in ((forth, similar), (back, similar.T)):
        for k in (1, 2, 5, 6):
            slow = all_orders(matrix, good, lambda order, k=k: order[:k].any())
            assert ranks.within(k) == pytest.approx(slow)
        first = all_orders(matrix, good, lambda order: 1 + np.argmax(order))
        assert ranks.expected == pytest.approx(first)
        assert (ranks.right == good.sum(axis=1)).all()


@pytest.mark.parametrize("many", [False, True])
def test_blocks_of_any_size_give_the_same_ranks(many, monkeypatch):
    a, b = random_rows(True, 40)
    texts = unit_rows(np.random.default_rng(4).normal(size=(40, 2))) if many else None
    whole = both_ranks(a, b, texts, 0.9)
    monkeypatch.setattr(module, "CELLS", 150)
    parts = both_ranks(a, b, texts, 0.9)
    for x, y in zip(whole, parts, strict=True):
        for name in ("above", "ties", "wrong", "right"):
            assert (getattr(x, name) == getattr(y, name)).all()


def test_keys_at_the_reach_of_a_tie_are_tied_above_and_not_below():
    """The right key of row 0 has a cosine of 0; of 128 numbers a tie reaches 128 * 2^-26 far."""
    reach = np.float32(2.0**-19)
    queries, keys = np.zeros((2, 3, 128), np.float32)
    queries[0, 0], keys[1:, 0] = 1, (reach, -reach)
    for ranks in (both_ranks(queries, keys)[0], both_ranks(keys, queries)[1]):
        assert (ranks.above[0], ranks.ties[0]) == (0, 2)


def test_equal_keys_score_chance():
    same = features(np.ones((10, 4)))
    forth, _ = retrieval(same, same, names=("tactile", "text"), top=(1, 5))
    scores = [*(mean.score for mean in forth.top), forth.median]
    assert [label_of(s) for s in scores] == [
        "top-1 of 10 (text by tactile)",
        "top-5 of 10 (text by tactile)",
        "median rank of 10 (text by tactile)",
    ]
    assert [s.value for s in scores] == pytest.approx([0.1, 0.5, 5.5])
    assert [s.details["chance"] for s in scores] == pytest.approx([0.1, 0.5, 5.5])


def test_equal_texts_count_with_a_threshold_and_chance_follows():
    keys = np.eye(4)[[0, 1, 2, 3]]
    queries = keys[[1, 0, 2, 3]]  # the first two are swapped
    texts = np.eye(3)[[0, 0, 1, 2]]  # and have one text
    strict, _ = retrieval(features(queries), features(keys), top=(1,))
    similar, _ = retrieval(features(queries), features(keys), top=(1,), texts=texts)
    assert strict.top[0].score.value == 0.5
    assert similar.top[0].score.value == 1.0
    assert similar.top[0].score.details["chance"] == pytest.approx(
        (2 / 4 + 2 / 4 + 1 / 4 + 1 / 4) / 4
    )
    assert similar.top[0].score.details["right_keys"] == 1.5
    assert strict.top[0].score.settings != similar.top[0].score.settings


@pytest.mark.parametrize("n", [40, 160])
def test_chance_of_a_pool_does_not_depend_on_n(n, monkeypatch):
    rng = np.random.default_rng(0)
    a, b = (features(rng.normal(size=(n, 5))) for _ in range(2))
    top5 = retrieval(a, b, top=(5,), pool=20)[0].top[0].score
    assert (top5.metric, top5.settings["pool"]) == ("top-5", 20)
    assert top5.details["chance"] == pytest.approx(0.25)
    assert top5.value == pytest.approx(0.25, abs=0.12)
    assert retrieval(a, b, top=(5,), pool=20)[0].top[0].score == top5
    assert retrieval(a, a, pool=20)[0].top[0].score.value == 1.0
    assert top5.details["pools"] == 20
    monkeypatch.setattr(module, "POOLED", 3 * 20**2)  # of all cells of three pools
    assert retrieval(a, b, top=(5,), pool=20)[0].top[0].score.details["pools"] == 3


def test_a_pool_of_all_is_no_pool_and_ranks_over_the_pool_are_skipped():
    a, b = (features(rows) for rows in random_rows(False))
    assert [m.score.value for m in retrieval(a, b, pool=6)[0].top] == [
        m.score.value for m in retrieval(a, b)[0].top
    ]
    assert [label_of(m.score) for m in retrieval(a, b, top=(1, 5, 6, 10))[0].top] == [
        "top-1 of 6 (b by a)",
        "top-5 of 6 (b by a)",
    ]


def test_the_interval_of_the_median_rank_by_hand():
    """The share of ranks up to the median is 1 / 2 with an interval; its limits are quantiles."""
    ranks, groups = np.arange(1.0, 41.0), [f"v{k}" for k in range(40)]
    score = module._median(ranks, groups, {}, {"subject": "x"})
    below = ranks <= 20.5
    error = np.sqrt(((below - 0.5) ** 2).sum() / 40 / 39)  # the jackknife of a mean
    half = stats.t.ppf(0.975, 39) * error
    assert score.value == 20.5
    assert score.interval == (np.ceil(40 * (0.5 - half)), np.ceil(40 * (0.5 + half)))


def test_the_interval_of_the_median_rank_holds_it_as_often_as_promised():
    rng, hits = np.random.default_rng(1), []
    for _ in range(150):  # ranks of 20 videos of 8 frames; a video shifts all of its own
        groups = np.repeat([f"v{k}" for k in range(20)], 8)
        ranks = np.exp(2 + np.repeat(0.7 * rng.normal(size=20), 8) + rng.normal(size=160))
        score = module._median(ranks, groups.tolist(), {}, {"subject": "x"})
        hits.append(score.interval[0] <= np.exp(2) <= score.interval[1])
    assert 0.88 <= np.mean(hits) <= 1


@pytest.mark.parametrize("d", [384, 512, 640, 768, 1000])
def test_rows_that_are_all_equal_tie_whatever_their_width(d):
    texts = unit_rows(np.random.default_rng(0).normal(size=(300, 32)))
    for n in (16, 300):
        a = unit_rows(np.ones((n, d)))
        for ranks in (both_ranks(a, a)[0], both_ranks(a, a, texts[:n], 0.6)[0]):
            assert ranks.within(1) == pytest.approx(ranks.right / n, rel=1e-6)
            assert ranks.expected.max() <= (n + 1) / 2
