"""The linear probe and retrieval against hand counts and slow loops."""

from itertools import permutations

import numpy as np
import pytest

from palpate.core import FeatureSet, PalpateError
from palpate.encoders.probe import fit_probe, material_accuracy, retrieval, text_positives


def features(x, labels=None, groups=None, encoder="e", start=0):
    return FeatureSet(
        [f"s{start + k}" for k in range(len(x))], np.asarray(x, np.float32), labels, groups, encoder
    )


def clusters(n=30, classes=3, noise=0.3, seed=0, start=0):
    rng = np.random.default_rng(seed)
    center = np.random.default_rng(9).normal(size=(classes, 6))
    y = np.arange(n) % classes
    return features(
        center[y] + noise * rng.normal(size=(n, 6)),
        [f"m{k}" for k in y],
        [f"v{seed}-{k // 3 % 10}" for k in range(n)],
        start=start,
    )


def test_separable_classes_are_found_and_noise_is_not():
    good = material_accuracy(clusters(60), clusters(30, seed=1))
    assert good.value == 1.0
    assert good.details["chance"] == pytest.approx(1 / 3)
    rng = np.random.default_rng(0)
    x = features(
        rng.normal(size=(600, 6)),
        [f"m{k % 3}" for k in range(600)],
        [f"v{k // 6}" for k in range(600)],
    )
    z = features(rng.normal(size=(600, 6)), x.labels, [f"w{k // 6}" for k in range(600)])
    assert material_accuracy(x, z).value == pytest.approx(1 / 3, abs=0.08)


def test_probe_sits_at_the_minimum_of_its_objective():
    train = clusters(40, noise=2.0)
    probe = fit_probe(train, l2=0.01)
    y = np.array([probe.classes.index(label) for label in train.labels])
    x = (train.features - probe.mean) / probe.sd

    def objective(weight, bias):
        logits = x @ weight + bias
        return float(
            np.mean([np.log(np.exp(row).sum()) - row[k] for row, k in zip(logits, y, strict=True)])
            + 0.01 * (weight**2).sum()
        )

    best = objective(probe.weight, probe.bias)
    rng = np.random.default_rng(0)
    for _ in range(200):
        assert (
            objective(
                probe.weight + 0.01 * rng.normal(size=probe.weight.shape),
                probe.bias + 0.01 * rng.normal(size=3),
            )
            > best - 1e-7
        )


def test_accuracy_recall_and_unseen_classes_by_hand():
    x = [[0.0, 1.0], [0.1, 1.0], [1.0, 0.0], [1.0, 0.1]] * 3
    train = features(x, ["a", "a", "b", "b"] * 3, [f"v{k}" for k in range(12)])
    test = features(
        [[0, 1], [1, 0], [0, 1], [1, 0], [1, 0]],
        ["a", "b", "b", "b", "zinc"],
        ["v", "v", "w", "w", "w"],
    )
    score = material_accuracy(train, test, l2=1e-3)
    assert score.value == pytest.approx(3 / 5)
    assert score.details["recall"] == pytest.approx({"a": 1.0, "b": 2 / 3, "zinc": 0.0})
    assert score.details["unseen_classes"] == ["zinc"]
    assert (score.n, score.encoder, score.higher_is_better) == (5, "e", True)
    balanced = material_accuracy(train, test, l2=1e-3, balanced=True)
    assert balanced.value == pytest.approx((1 + 2 / 3 + 0) / 3)
    assert balanced.metric != score.metric


def test_interval_is_the_jackknife_over_videos():
    # accuracies 1, 1, 0 in groups of 2, 2, 4: leave-one-out ratios 2/6, 2/6, 4/4
    train = features([[0.0], [1.0]] * 6, ["a", "b"] * 6, [f"v{k}" for k in range(12)])
    test = features([[0.0]] * 4 + [[1.0]] * 4, ["a"] * 8, ["p", "p", "q", "q", "r", "r", "r", "r"])
    score = material_accuracy(train, test, l2=1e-3)
    left = np.array([2 / 6, 2 / 6, 1.0])
    half = 4.302652729911275 * np.sqrt(2 / 3 * ((left - left.mean()) ** 2).sum())
    assert score.value == 0.5
    assert score.interval == (max(0, 0.5 - half), min(1, 0.5 + half))
    alone = material_accuracy(train, features([[0.0]], ["a"], ["p"]), l2=1e-3)
    assert alone.interval is None


def test_penalty_is_chosen_by_groups():
    """Each video has its own giveaway: rows of one video pick a weak penalty, left-out videos a strong one."""
    rng = np.random.default_rng(0)
    rows, labels, groups = [], [], []
    for v in range(24):
        own = rng.normal(size=40) * 3
        for _ in range(6):
            rows.append(
                np.concatenate(
                    [[0.4 * (v % 2 * 2 - 1) + 0.5 * rng.normal()], own + 0.01 * rng.normal(size=40)]
                )
            )
            labels.append("ab"[v % 2])
            groups.append(f"v{v}")
    by_video = fit_probe(features(rows, labels, groups)).l2
    by_row = fit_probe(features(rows, labels, [f"r{k}" for k in range(len(rows))])).l2
    assert by_video > by_row


def test_rows_without_a_label_are_left_out():
    train = clusters(30)
    labels = [*train.labels[:-1], ""]
    assert fit_probe(
        FeatureSet(train.ids, train.features, labels, train.groups), l2=0.01
    ).classes == ("m0", "m1", "m2")


def test_probe_refusals():
    train, test = clusters(30), clusters(9, seed=1)
    with pytest.raises(PalpateError, match="two materials"):
        fit_probe(features([[0.0], [1.0]], ["a", "a"]))
    with pytest.raises(PalpateError, match="test features must have materials"):
        material_accuracy(train, features(test.features))
    with pytest.raises(PalpateError, match="rows with a material"):
        material_accuracy(train, features(test.features, [""] * 9))
    with pytest.raises(PalpateError, match="one encoder"):
        material_accuracy(
            train, FeatureSet(test.ids, test.features, test.labels, test.groups, "other")
        )


def slow_hit(similar, good, k):
    """Share of all orders of the keys, consistent with similarity, that have a positive in the top k."""
    hits = []
    for row, right in zip(similar, good, strict=True):
        orders = [
            o
            for o in permutations(range(len(row)))
            if all(row[o[i]] >= row[o[i + 1]] for i in range(len(o) - 1))
        ]
        hits.append(np.mean([any(right[j] for j in o[:k]) for o in orders]))
    return np.mean(hits)


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("many", [False, True])
def test_retrieval_against_all_orders(ties, many):
    rng = np.random.default_rng(3)
    keys = rng.normal(size=(6, 3)).astype(np.float32)
    if ties:
        keys[1] = keys[2] = keys[4]
        keys[3] = keys[0]
    queries = keys + 0.8 * rng.normal(size=(6, 3)).astype(np.float32)
    good = rng.random((6, 6)) < 0.3 if many else np.zeros((6, 6), bool)
    norm = lambda x: np.linalg.norm(x.astype(float), axis=1)  # noqa: E731
    similar = (
        queries.astype(float) @ keys.astype(float).T / norm(queries)[:, None] / norm(keys)[None]
    )
    scores = retrieval(
        features(queries), features(keys), top=(1, 2, 5, 6), positives=good if many else None
    )
    for k, score in zip((1, 2, 5, 6), scores, strict=True):
        assert score.value == pytest.approx(
            slow_hit(similar.round(9), good | np.eye(6, dtype=bool), k)
        )
        assert score.metric == f"retrieval top-{k}"
    assert scores[-1].value == pytest.approx(1.0)


def test_equal_keys_score_chance():
    same = features(np.ones((10, 4)))
    top1, top5 = retrieval(same, same)
    assert (top1.value, top5.value) == pytest.approx((0.1, 0.5))
    assert (top1.details["chance"], top5.details["chance"]) == pytest.approx((0.1, 0.5))


def test_pools_hold_chance_whatever_the_size():
    rng = np.random.default_rng(0)
    for n in (40, 160):
        a, b = features(rng.normal(size=(n, 5))), features(rng.normal(size=(n, 5)))
        top5 = retrieval(a, b, top=(5,), pool=20, repeats=60)[0]
        assert top5.details["chance"] == pytest.approx(0.25)
        assert top5.value == pytest.approx(0.25, abs=0.12)
        assert top5.seed == 0
        assert retrieval(a, b, top=(5,), pool=20, repeats=60)[0] == top5
    assert retrieval(a, a, pool=20)[0].value == 1.0
    assert retrieval(a, a)[0].seed is None


def test_retrieval_refusals():
    a = features(np.eye(4))
    with pytest.raises(PalpateError, match="same ids"):
        retrieval(a, features(np.eye(4), start=1))
    with pytest.raises(PalpateError, match="pool must hold 2 to 4"):
        retrieval(a, a, pool=5)
    with pytest.raises(PalpateError, match="two samples"):
        retrieval(features(np.eye(1)), features(np.eye(1)))
    with pytest.raises(PalpateError, match="common space"):
        retrieval(a, features(np.ones((4, 2))))


def test_text_positives():
    x = np.array([[2, 0], [0.8, 0.6], [0, 1]], np.float32)
    assert text_positives(x).tolist() == [
        [True, True, False],
        [True, True, False],
        [False, False, True],
    ]
