"""What the embeddings know: material accuracy by a linear probe, and retrieval.

Probe: multinomial logistic regression on standardized features, ``min_W -1/n sum_i log softmax(W x_i)_{y_i} + l2 ||W||^2``, solved by
L-BFGS; l2 is chosen on the training side by leaving out whole groups (leaving out rows would let neighbors of one video pick it).

Retrieval: rank of the right key among the pool by cosine. Ties are counted as a random order would, in expectation, so equal keys
never look like hits. With R > 1 positives the first of them counts.

Intervals are leave-one-group-out jackknives with Student's t: frames of one video are not independent draws.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln
from scipy.stats import t as student

from palpate.core import FeatureSet, PalpateError, Score, rng_for

Floats = NDArray[np.float64]
GRID = (1e-4, 1e-3, 1e-2, 1e-1)


@dataclass(frozen=True)
class Probe:
    """A fitted linear probe: class scores are ``((x - mean) / sd) @ weight + bias``."""

    classes: tuple[str, ...]
    mean: Floats
    sd: Floats
    weight: Floats
    bias: Floats
    l2: float

    def predict(self, features: np.ndarray) -> list[str]:
        """The likeliest class of each row."""
        logits = ((features - self.mean) / self.sd) @ self.weight + self.bias
        return [self.classes[k] for k in logits.argmax(axis=1)]


def fit_probe(
    train: FeatureSet,
    *,
    l2: float | None = None,
    balanced: bool = False,
    folds: int = 3,
    seed: int = 0,
) -> Probe:
    """Fits a linear probe to labeled features.

    Args:
        train: features with labels; rows without a label are left out. Groups are needed to choose ``l2``.
        l2: the penalty, or None to choose among 1e-4 .. 1e-1 by group-wise cross-validation.
        balanced: weigh rows so that every class counts the same.
        folds: of the cross-validation.
        seed: of the folds.

    Raises:
        PalpateError: without labels, or with fewer than two classes.
    """
    x, labels, groups = _labeled(train, "train")
    classes = tuple(sorted(set(labels)))
    if len(classes) < 2:
        raise PalpateError(
            "A probe needs at least two materials in train",
            f"{len(classes)}",
            "Use a split whose train part has more",
        )
    number = {name: k for k, name in enumerate(classes)}
    y = np.array([number[label] for label in labels])
    mean, sd = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-8)
    z = (x - mean) / sd
    weights = 1 / np.bincount(y, minlength=len(classes))[y] if balanced else np.ones(len(y))
    if l2 is None:
        l2 = _choose(z, y, weights, groups, len(classes), folds, seed)
    weight, bias = _logistic(z, y, weights, len(classes), l2)
    return Probe(classes, mean, sd, weight, bias, l2)


def material_accuracy(
    train: FeatureSet,
    test: FeatureSet,
    *,
    probe: Probe | None = None,
    l2: float | None = None,
    balanced: bool = False,
    seed: int = 0,
    subject: str = "real",
    split: str | None = None,
) -> Score:
    """Accuracy of a linear probe on new samples (the paper's material classification; head and probe are our choice, section 9).

    Args:
        train: features with labels and groups.
        test: features of the same encoder.
        probe: one that was fitted to ``train`` before, to score several sets with; None fits one.
        l2: see :func:`fit_probe`.
        balanced: see :func:`fit_probe`; also averages the accuracy over classes.
        seed: see :func:`fit_probe`.
        subject: what is scored, for the score.
        split: digest, for the score.

    Returns:
        A score in [0, 1]; ``details`` holds chance (1 / classes), the majority baseline, recall by class, the penalty, and classes that
        train lacks, whose samples count as wrong.

    Raises:
        PalpateError: without labels on both sides, or on features of two encoders.
    """
    if train.encoder != test.encoder:
        raise PalpateError(
            "Both sides of a probe must come from one encoder",
            f"{train.encoder} and {test.encoder}",
            "Embed them again",
        )
    probe = probe or fit_probe(train, l2=l2, balanced=balanced, seed=seed)
    x, labels, groups = _labeled(test, "test")
    hit = np.array([a == b for a, b in zip(probe.predict(x), labels, strict=True)], dtype=float)
    counts = Counter(labels)
    rows = np.array([1 / counts[label] for label in labels]) if balanced else np.ones(len(hit))
    majority = Counter(_labeled(train, "train")[1]).most_common(1)[0][0]
    share = 1 / len(counts) * (majority in counts) if balanced else counts[majority] / len(labels)
    recall = {
        name: float(hit[[label == name for label in labels]].mean()) for name in sorted(counts)
    }
    return mean_over_groups(
        "material accuracy (balanced)" if balanced else "material accuracy",
        hit,
        rows,
        groups,
        subject,
        split,
        test.encoder,
        seed,
        {"probe": "logistic regression"},
        {
            "chance": 1 / len(probe.classes),
            "majority": share,
            "recall": recall,
            "l2": probe.l2,
            "train_samples": len(train.ids),
            "unseen_classes": sorted(set(labels) - set(probe.classes)),
        },
        "mean of class recalls" if balanced else "mean",
    )


def retrieval(
    queries: FeatureSet,
    keys: FeatureSet,
    *,
    top: Sequence[int] = (1, 5),
    pool: int | None = None,
    repeats: int = 20,
    positives: NDArray[np.bool_] | None = None,
    seed: int = 0,
    name: str = "retrieval",
    subject: str = "real",
    split: str | None = None,
) -> list[Score]:
    """How often the right key is among the k most similar ones.

    Args:
        queries: n rows, e.g. vision of the test samples.
        keys: n rows with the same ids in the same order, e.g. touch of the same samples.
        top: the values of k.
        pool: rank among that many samples drawn at random, ``repeats`` times, instead of among all; keeps chance at k / pool
            whatever the size of the set.
        repeats: pools to average over.
        positives: (n, n), which keys also count for which query (the diagonal always does), e.g. :func:`text_positives`.
        seed: of the pools.
        name: start of the metric's name (``"vision to touch"``).
        subject: what is scored, for the score.
        split: digest, for the score.

    Returns:
        One score a k, in [0, 1]; ``details`` holds the chance level.

    Raises:
        PalpateError: if ids differ, the pool is larger than the set, or there are fewer than two samples.
    """
    n = len(queries.ids)
    if list(queries.ids) != list(keys.ids):
        raise PalpateError(
            "Queries and keys must have the same ids in the same order",
            "different ones",
            "Take the same ids from both",
        )
    if n < 2 or queries.features.shape[1] != keys.features.shape[1]:
        got = f"{n} samples, widths {queries.features.shape[1]} and {keys.features.shape[1]}"
        raise PalpateError(
            "Retrieval needs at least two samples in one common space",
            got,
            "Embed both with one set of encoders",
        )
    if pool is not None and not 2 <= pool <= n:
        raise PalpateError(
            f"The pool must hold 2 to {n} samples", f"{pool}", "Choose a smaller pool"
        )
    right = np.eye(n, dtype=bool) if positives is None else positives | np.eye(n, dtype=bool)
    draws = (
        [np.arange(n)]
        if pool is None
        else [rng_for(seed, "pool", r).choice(n, pool, replace=False) for r in range(repeats)]
    )
    groups = list(queries.groups) if queries.groups is not None else list(queries.ids)
    out: list[Score] = []
    hits = {k: np.zeros(n) for k in top}
    chance = dict.fromkeys(top, 0.0)
    seen = np.zeros(n)
    for rows in draws:
        similar = _unit(queries.features[rows]) @ _unit(keys.features[rows]).T
        good = right[np.ix_(rows, rows)]
        seen[rows] += 1
        for k in top:
            hits[k][rows] += _hit_chance(similar, good, k)
            chance[k] += float(_hit_chance(np.zeros_like(similar), good, k).mean()) / len(draws)
    used = seen > 0
    for k in top:
        settings = {
            "pool": pool,
            "repeats": repeats if pool else None,
            "positives": "diagonal" if positives is None else "given",
        }
        value = hits[k][used] / seen[used]
        names = [g for g, u in zip(groups, used, strict=True) if u]
        out.append(
            mean_over_groups(
                f"{name} top-{k}",
                value,
                seen[used],
                names,
                subject,
                split,
                queries.encoder,
                seed if pool else None,
                settings,
                {"chance": chance[k], "key_encoder": keys.encoder},
                "mean over pools" if pool else "mean",
            )
        )
    return out


def text_positives(texts: np.ndarray, threshold: float = 0.6356) -> NDArray[np.bool_]:
    """Pairs of texts so similar that either counts as right: cosine above TVL's threshold (recipes section 5); (n, d) to (n, n)."""
    return _unit(texts) @ _unit(texts).T > threshold


def _unit(x: np.ndarray) -> Floats:
    """Rows of length 1, float64; a row of zeros stays."""
    x = x.astype(np.float64)
    return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)


def _hit_chance(similar: Floats, good: NDArray[np.bool_], k: int) -> Floats:
    """For each row, the probability that a positive is among the top k when ties are broken at random."""
    best = np.where(good, similar, -np.inf).max(axis=1, keepdims=True)
    # Products of equal vectors may differ in the last bits with the place in the matrix.
    tied = np.abs(similar - best) <= 1e-9
    above = ((similar > best) & ~tied).sum(axis=1)
    wrong, all_tied = (tied & ~good).sum(axis=1), tied.sum(axis=1)
    slots = np.clip(k - above, 0, all_tied)
    miss = np.zeros(len(similar))
    some = slots <= wrong  # else the wrong ones cannot fill the slots
    # C(wrong, slots) / C(all_tied, slots): only wrong ones in the slots.
    w, a, s = wrong[some], all_tied[some], slots[some]
    miss[some] = np.exp(gammaln(w + 1) - gammaln(w - s + 1) - gammaln(a + 1) + gammaln(a - s + 1))
    return 1 - miss


def _labeled(features: FeatureSet, side: str) -> tuple[Floats, list[str], list[str]]:
    """Rows that have a label: features as float64, labels, groups (the id where there is none)."""
    if features.labels is None:
        raise PalpateError(
            f"The {side} features must have materials",
            "none",
            "Fill the manifest's column material",
        )
    keep = [k for k, label in enumerate(features.labels) if label]
    if not keep:
        raise PalpateError(
            f"The {side} features must have rows with a material",
            "none",
            "Check the split and the column material",
        )
    groups = features.groups if features.groups is not None else features.ids
    named = [groups[k] or features.ids[k] for k in keep]
    return features.features[keep].astype(np.float64), [features.labels[k] for k in keep], named


def _logistic(
    x: Floats, y: NDArray[np.int64], rows: Floats, classes: int, l2: float
) -> tuple[Floats, Floats]:
    """Weight (d, classes) and bias (classes,) of the penalized logistic regression at the head of this file."""
    n, d = x.shape
    one = np.concatenate([x, np.ones((n, 1))], axis=1)
    rows = rows / rows.sum()

    def objective(flat: Floats) -> tuple[float, Floats]:
        w = flat.reshape(d + 1, classes)
        logits = one @ w
        logits -= logits.max(axis=1, keepdims=True)
        log_p = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
        error = np.exp(log_p)
        error[np.arange(n), y] -= 1
        gradient = one.T @ (error * rows[:, None])
        gradient[:d] += 2 * l2 * w[:d]
        return float(
            -(rows * log_p[np.arange(n), y]).sum() + l2 * (w[:d] ** 2).sum()
        ), gradient.ravel()

    found = minimize(
        objective,
        np.zeros((d + 1) * classes),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 300},
    )
    w = found.x.reshape(d + 1, classes)
    return w[:d], w[d]


def _choose(
    x: Floats,
    y: NDArray[np.int64],
    rows: Floats,
    groups: Sequence[str],
    classes: int,
    folds: int,
    seed: int,
) -> float:
    """The penalty with the best accuracy on left-out groups; the stronger one on a tie; 1e-2 with too few groups."""
    names = sorted(set(groups))
    if len(names) < 2 * folds:
        return 1e-2
    order = rng_for(seed, "probe folds").permutation(len(names))
    fold_of = {names[k]: at % folds for at, k in enumerate(order)}
    fold = np.array([fold_of[g] for g in groups])
    right = dict.fromkeys(GRID, 0.0)
    for f in range(folds):
        inside = fold != f
        for l2 in GRID:
            w, b = _logistic(x[inside], y[inside], rows[inside], classes, l2)
            right[l2] += float(rows[~inside] @ ((x[~inside] @ w + b).argmax(axis=1) == y[~inside]))
    return max(GRID, key=lambda l2: (right[l2], l2))


def mean_over_groups(
    metric: str,
    value: Floats,
    rows: Floats,
    groups: Sequence[str],
    subject: str,
    split: str | None,
    encoder: str | None,
    seed: int | None,
    settings: Mapping[str, object],
    details: Mapping[str, object],
    estimator: str = "mean",
) -> Score:
    """The weighted mean of per-sample values, with a leave-one-group-out jackknife interval."""
    mean = float((rows @ value) / rows.sum())
    names = sorted(set(groups))
    interval = None
    if len(names) >= 2:
        at = np.searchsorted(names, list(groups))
        top = np.bincount(at, weights=rows * value, minlength=len(names))
        bottom = np.bincount(at, weights=rows, minlength=len(names))
        left = (top.sum() - top) / (bottom.sum() - bottom)
        g = len(names)
        half = float(
            student.ppf(0.975, g - 1) * np.sqrt((g - 1) / g * ((left - left.mean()) ** 2).sum())
        )
        # Where leaving out any group changes nothing, the jackknife has nothing to say.
        interval = (max(0.0, mean - half), min(1.0, mean + half)) if half > 0 else None
    return Score(
        metric,
        subject,
        mean,
        interval,
        interval_method=f"leave-one-group-out jackknife, t, {len(names) - 1} df"
        if interval
        else "",
        estimator=estimator,
        n=len(value),
        seed=seed,
        encoder=encoder,
        split=split,
        higher_is_better=True,
        settings=settings,
        details=details,
    )
