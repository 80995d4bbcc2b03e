"""The linear probe and k-NN against hand counts and slow loops."""

import numpy as np
import pytest
from scipy.special import logsumexp

from palpate.core import FeatureSet
from palpate.metrics import probe as module
from palpate.metrics.probe import class_accuracies, fit_probe, material_accuracy, neighbor_hits


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


def test_folds_are_three_of_whole_groups_of_about_equal_number():
    groups = [f"v{k // 5}" for k in range(50)]
    fold = module._folds(groups, 0)
    assert len({(g, f) for g, f in zip(groups, fold, strict=True)}) == 10
    assert sorted(np.bincount(fold)) == [15, 15, 20]
    assert module._folds(groups[:25], 0) is None  # two groups a fold at least


def test_rows_without_a_label_are_skipped():
    train = clusters(30)
    some = FeatureSet(train.ids, train.features, [*train.labels[:-1], ""], train.groups)
    assert fit_probe(some, l2=0.01).classes == ("m0", "m1", "m2")


def test_both_classifiers_give_plain_and_balanced_accuracy_next_to_their_baselines(monkeypatch):
    monkeypatch.setattr(module, "NEIGHBORS", 3)
    x = [[0.0, 1.0], [0.1, 1.0], [1.0, 0.0], [1.0, 0.1]] * 3
    train = features(
        [*x, [1.0, 0.0]], ["a", "a", "b", "b"] * 3 + ["b"], [f"v{k}" for k in range(13)]
    )
    x = [[0, 1], [1, 0], [0, 1], [1, 0], [1, 0]]
    test = features(x, ["a", "b", "b", "b", "zinc"], ["v", "v", "w", "w", "w"])
    means = class_accuracies(train, test, label="metal", subject="e")
    assert {m.score.metric: m.score.value for m in means} == pytest.approx(
        {
            "metal accuracy": 3 / 5,
            "metal accuracy, balanced": (1 + 2 / 3 + 0) / 3,
            "metal accuracy, 3-NN": 3 / 5,
            "metal accuracy, 3-NN, balanced": (1 + 2 / 3 + 0) / 3,
        }
    )
    plain, balanced = (m.score.details for m in means[:2])
    assert (plain["chance"], plain["majority"]) == (0.5, 3 / 5)
    assert (balanced["chance"], balanced["majority"]) == (0.5, 1 / 3)
    assert plain["classes"] == ["a", "b", "zinc"]
    assert plain["matrix"][0] == [1, 0, 0]
    assert plain["matrix"][1] == pytest.approx([1 / 3, 2 / 3, 0], abs=1e-4)
    assert plain["matrix"][2] == [0, 1, 0]


def slow_neighbors(train, labels, query, truth, k):
    """Probability of a right vote over all orders of equally similar train rows."""
    unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)
    similar = (unit(train) @ unit(query)).round(6)
    order = np.argsort(-similar, kind="stable")
    last = similar[order[k - 1]]
    weight = np.where(similar > last, 1.0, 0.0)
    tied = similar == last
    weight[tied] = (k - weight.sum()) / tied.sum()
    votes = dict.fromkeys(labels, 0.0)
    for w, s, name in zip(weight, similar, labels, strict=True):
        votes[name] += w * np.exp(s / 0.07)
    best = [name for name, v in votes.items() if v >= max(votes.values()) * (1 - 1e-5)]
    return (truth in best) / len(best)


@pytest.mark.parametrize("k", [1, 4, 9])
@pytest.mark.parametrize("ties", [False, True])
def test_neighbors_vote_as_in_a_slow_loop(k, ties):
    rng = np.random.default_rng(k)
    train, test = rng.normal(size=(30, 3)), rng.normal(size=(12, 3))
    if ties:
        train[5:15] = train[4]
    labels, truth = [f"m{j % 3}" for j in range(30)], [f"m{j % 4}" for j in range(12)]
    hits = neighbor_hits(train, labels, test, truth, k)
    slow = [slow_neighbors(train, labels, q, t, k) for q, t in zip(test, truth, strict=True)]
    assert hits == pytest.approx(slow)


def test_more_neighbors_than_train_rows_are_all_of_them():
    train, test = clusters(9), clusters(6, seed=1)
    args = train.features, train.labels, test.features, test.labels
    assert neighbor_hits(*args, 500) == pytest.approx(neighbor_hits(*args, 9))
