"""The linear probe and retrieval against hand counts and slow loops."""

from itertools import permutations

import numpy as np
import pytest
from scipy.special import logsumexp

from palpate.core import FeatureSet, PalpateError
from palpate.metrics.probe import fit_probe, material_accuracy, retrieval


def features(x, labels=None, groups=None, encoder="e", start=0):
    ids = [f"s{start + k}" for k in range(len(x))]
    return FeatureSet(ids, np.asarray(x, np.float32), labels, groups, encoder)


def clusters(n=30, classes=3, noise=0.3, seed=0):
    rng = np.random.default_rng(seed)
    center = np.random.default_rng(9).normal(size=(classes, 6))
    y = np.arange(n) % classes
    x = center[y] + noise * rng.normal(size=(n, 6))
    return features(x, [f"m{k}" for k in y], [f"v{seed}-{k // 3 % 10}" for k in range(n)])


def test_separable_classes_score_1_and_noise_scores_chance():
    good = material_accuracy(clusters(60), clusters(30, seed=1))
    assert good.value == 1.0
    assert good.details["chance"] == pytest.approx(1 / 3)
    rng = np.random.default_rng(0)
    labels, groups = [f"m{k % 3}" for k in range(600)], [f"v{k // 6}" for k in range(600)]
    train, test = (features(rng.normal(size=(600, 6)), labels, groups) for _ in range(2))
    assert material_accuracy(train, test).value == pytest.approx(1 / 3, abs=0.08)


def test_the_probe_minimizes_its_objective():
    train = clusters(40, noise=2.0)
    probe = fit_probe(train, l2=0.01)
    y = np.array([probe.classes.index(label) for label in train.labels])
    x = (train.features - probe.mean) / probe.sd

    def objective(weight, bias):
        logits = x @ weight + bias
        loss = logsumexp(logits, axis=1) - logits[np.arange(len(y)), y]
        return loss.mean() + 0.01 * (weight**2).sum()

    best, rng = objective(probe.weight, probe.bias), np.random.default_rng(0)
    for _ in range(100):
        moved = [v + 0.01 * rng.normal(size=v.shape) for v in (probe.weight, probe.bias)]
        assert objective(*moved) > best - 1e-7


def test_accuracy_recall_and_unseen_classes_by_hand():
    x = [[0.0, 1.0], [0.1, 1.0], [1.0, 0.0], [1.0, 0.1]] * 3
    train = features(x, ["a", "a", "b", "b"] * 3, [f"v{k}" for k in range(12)])
    x = [[0, 1], [1, 0], [0, 1], [1, 0], [1, 0]]
    test = features(x, ["a", "b", "b", "b", "zinc"], ["v", "v", "w", "w", "w"])
    score = material_accuracy(train, test, l2=1e-3)
    assert score.value == pytest.approx(3 / 5)
    assert score.details["recall"] == pytest.approx({"a": 1.0, "b": 2 / 3, "zinc": 0.0})
    assert score.details["unseen_classes"] == ["zinc"]
    assert (score.n, score.encoder, score.higher_is_better) == (5, "e", True)
    balanced = material_accuracy(train, test, l2=1e-3, balanced=True)
    assert balanced.value == pytest.approx((1 + 2 / 3 + 0) / 3)
    assert balanced.metric != score.metric


def test_the_interval_is_the_jackknife_over_groups():
    # accuracies 1, 1, 0 in groups of 2, 2, 4: leave-one-out ratios 2/6, 2/6, 4/4
    train = features([[0.0], [1.0]] * 6, ["a", "b"] * 6, [f"v{k}" for k in range(12)])
    test = features([[0.0]] * 4 + [[1.0]] * 4, ["a"] * 8, list("ppqqrrrr"))
    score = material_accuracy(train, test, l2=1e-3)
    left = np.array([2 / 6, 2 / 6, 1.0])
    half = 4.302652729911275 * np.sqrt(2 / 3 * ((left - left.mean()) ** 2).sum())
    assert score.value == 0.5
    assert score.interval == pytest.approx((max(0, 0.5 - half), min(1, 0.5 + half)))
    one_group = material_accuracy(train, features([[0.0]], ["a"], ["p"]), l2=1e-3)
    assert one_group.interval is None


def test_the_penalty_is_chosen_by_groups():
    """Each video has a pattern of its own: held-out rows prefer a weak penalty, videos a strong."""
    rng = np.random.default_rng(0)
    video = np.repeat(np.arange(24), 6)
    signal = 0.4 * (video % 2 * 2 - 1) + 0.5 * rng.normal(size=144)
    pattern = 3 * rng.normal(size=(24, 40))[video] + 0.01 * rng.normal(size=(144, 40))
    x, labels = np.column_stack([signal, pattern]), ["ab"[v % 2] for v in video]
    by_video = fit_probe(features(x, labels, [f"v{v}" for v in video])).l2
    by_row = fit_probe(features(x, labels, [f"r{k}" for k in range(144)])).l2
    assert by_video > by_row


def test_rows_without_a_label_are_skipped():
    train = clusters(30)
    some = FeatureSet(train.ids, train.features, [*train.labels[:-1], ""], train.groups)
    assert fit_probe(some, l2=0.01).classes == ("m0", "m1", "m2")


@pytest.mark.parametrize(
    ("train", "test", "match"),
    [
        (features([[0.0], [1.0]], ["a", "a"]), clusters(9), "two materials"),
        (clusters(), features(clusters(9).features), "test features must have rows"),
        (clusters(), features(clusters(9).features, [""] * 9), "rows with a material"),
        (clusters(), features(np.ones((9, 6)), ["m0"] * 9, encoder="other"), "one encoder"),
    ],
)
def test_the_probe_rejects_sets_it_cannot_use(train, test, match):
    with pytest.raises(PalpateError, match=match):
        material_accuracy(train, test)


def slow_hit(similar, good, k):
    """Share of the orders of the keys that agree with similarity and have a positive in top k."""
    hits = []
    for row, right in zip(similar, good, strict=True):
        orders = [o for o in permutations(range(len(row))) if (np.diff(row[list(o)]) <= 0).all()]
        hits.append(np.mean([right[list(o[:k])].any() for o in orders]))
    return np.mean(hits)


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("many", [False, True])
def test_retrieval_equals_all_orders(ties, many):
    rng = np.random.default_rng(3)
    keys = rng.normal(size=(6, 3)).astype(np.float32)
    if ties:
        keys[1] = keys[2] = keys[4]
        keys[3] = keys[0]
    queries = keys + 0.8 * rng.normal(size=(6, 3)).astype(np.float32)
    good = rng.random((6, 6)) < (0.3 if many else 0)
    unit = lambda x: x.astype(float) / np.linalg.norm(x.astype(float), axis=1)[:, None]  # noqa: E731
    similar = (unit(queries) @ unit(keys).T).round(9)
    positives = good if many else None
    tops = (1, 2, 5, 6)
    scores = retrieval(features(queries), features(keys), top=tops, positives=positives)
    for k, score in zip(tops, scores, strict=True):
        assert score.value == pytest.approx(slow_hit(similar, good | np.eye(6, dtype=bool), k))
        assert score.metric == f"retrieval top-{k}"
    assert scores[-1].value == pytest.approx(1.0)


def test_equal_keys_score_chance():
    same = features(np.ones((10, 4)))
    scores = retrieval(same, same)
    assert [s.value for s in scores] == pytest.approx([0.1, 0.5])
    assert [s.details["chance"] for s in scores] == pytest.approx([0.1, 0.5])


@pytest.mark.parametrize("n", [40, 160])
def test_chance_of_a_pool_does_not_depend_on_n(n):
    rng = np.random.default_rng(0)
    a, b = (features(rng.normal(size=(n, 5))) for _ in range(2))
    (top5,) = retrieval(a, b, top=(5,), pool=20, repeats=60)
    assert top5.details["chance"] == pytest.approx(0.25)
    assert top5.value == pytest.approx(0.25, abs=0.12)
    assert retrieval(a, b, top=(5,), pool=20, repeats=60) == [top5]
    assert retrieval(a, a, pool=20)[0].value == 1.0


@pytest.mark.parametrize(
    ("queries", "keys", "pool", "match"),
    [
        (np.eye(4), features(np.eye(4), start=1), None, "same ids"),
        (np.eye(4), features(np.eye(4)), 5, "`pool` must lie in 2 to 4"),
        (np.eye(1), features(np.eye(1)), None, "two samples"),
        (np.eye(4), features(np.ones((4, 2))), None, "common space"),
    ],
)
def test_retrieval_rejects_sets_that_do_not_pair(queries, keys, pool, match):
    with pytest.raises(PalpateError, match=match):
        retrieval(features(queries), keys, pool=pool)
