"""What embeddings encode: class accuracy of a linear probe, and retrieval.

Probe: multinomial logistic regression on standardized features,
``min_W -1/n sum_i log softmax(W x_i)_{y_i} + l2 ||W||^2``, solved by L-BFGS. l2 is chosen by
cross-validation over whole groups: with rows left out, frames of one video would pick it.

Retrieval: rank of the right key by cosine similarity. Ties count as a random order would, in
expectation, so equal keys never look like hits. With several positives the first one counts.

Intervals are leave-one-group-out jackknives with Student's t.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln, log_softmax

from palpate.core import FeatureSet, PalpateError, Score, rng_for
from palpate.metrics.intervals import jackknife_errors, t_interval

Array = NDArray[np.float64]
#: Penalties that cross-validation chooses from.
GRID = (1e-4, 1e-3, 1e-2, 1e-1)
#: Cosines that differ by less are ties: products of equal vectors may differ in the last bits.
TIE = 1e-9


@dataclass(frozen=True)
class Probe:
    """A fitted linear probe: class scores are ``((x - mean) / sd) @ weight + bias``."""

    classes: tuple[str, ...]
    mean: Array
    sd: Array
    weight: Array
    bias: Array
    l2: float

    def predict(self, features: NDArray[Any]) -> list[str]:
        """The likeliest class of each row (n, d)."""
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
    """Fit a linear probe to labeled features.

    Args:
        train: features with labels; rows without a label are skipped.
        l2: the penalty; None chooses among 1e-4 to 1e-1 by cross-validation over groups.
        balanced: weight rows so that every class counts the same.
        folds: of the cross-validation.
        seed: of the folds.

    Raises:
        PalpateError: without labels, or with fewer than two classes.
    """
    x, labels, groups = _labeled(train, "train")
    classes = sorted(set(labels))
    if len(classes) < 2:
        must, fix = "A probe needs at least two materials in train", "Use another split"
        raise PalpateError(must, f"{len(classes)}", fix)
    y = np.searchsorted(classes, labels)
    mean, sd = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-8)
    z = (x - mean) / sd
    weights = 1 / np.bincount(y)[y] if balanced else np.ones(len(y))
    if l2 is None:
        l2 = _choose_penalty(z, y, weights, _folds(groups, folds, seed))
    weight, bias = _logistic(z, y, weights, len(classes), l2)
    return Probe(tuple(classes), mean, sd, weight, bias, l2)


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
    """Accuracy of a linear probe on new samples (the paper's material classification).

    Args:
        train: features with labels, and groups to choose ``l2``.
        test: features of the same encoder with labels, and groups for the interval.
        probe: a probe fitted to ``train`` before; None fits one.
        l2: see :func:`fit_probe`.
        balanced: see :func:`fit_probe`; also averages the accuracy over classes.
        seed: see :func:`fit_probe`.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.

    Returns:
        A score in [0, 1]; ``details`` holds chance (1 / classes), the accuracy of the majority
        class, recall by class, the penalty, and classes unseen in train (counted as wrong).

    Raises:
        PalpateError: without labels in both sets, or on features of two encoders.
    """
    if train.encoder != test.encoder:
        must = "Train and test features must come from one encoder"
        raise PalpateError(must, f"{train.encoder} and {test.encoder}", "Embed them again")
    probe = probe or fit_probe(train, l2=l2, balanced=balanced, seed=seed)
    x, labels, groups = _labeled(test, "test")
    hits = np.array(probe.predict(x)) == np.array(labels)
    counts = Counter(labels)
    majority = Counter(_labeled(train, "train")[1]).most_common(1)[0][0]
    share = counts[majority] / len(labels)
    if balanced:
        share = (majority in counts) / len(counts)
    details = {
        "chance": 1 / len(probe.classes),
        "majority": share,
        "recall": recall_by_class(hits, labels),
        "l2": probe.l2,
        "train_samples": len(train.ids),
        "unseen_classes": sorted(set(labels) - set(probe.classes)),
    }
    return mean_over_groups(
        "material accuracy (balanced)" if balanced else "material accuracy",
        hits,
        groups,
        weights=np.array([1 / counts[label] for label in labels]) if balanced else None,
        estimator="mean of class recalls" if balanced else "mean",
        subject=subject,
        split=split,
        encoder=test.encoder,
        seed=seed,
        settings={"probe": "logistic regression"},
        details=details,
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
        queries: n rows, e.g. vision embeddings of the test samples.
        keys: n rows with the same ids in the same order, e.g. tactile embeddings.
        top: the values of k.
        pool: rank among so many samples drawn at random instead of among all; chance is then
            k / pool whatever n.
        repeats: pools to average over.
        positives: (n, n), keys that also count for a query: equal texts.
        seed: of the pools.
        name: start of the metric's name (``"vision to tactile"``).
        subject: what is scored, kept in the scores.
        split: digest of the split, kept in the scores.

    Returns:
        One score a k, in [0, 1]; ``details`` holds the chance level.

    Raises:
        PalpateError: if ids differ, the pool is larger than the set, or n < 2.
    """
    n = len(queries.ids)
    _check_retrieval(queries, keys, pool)
    right = np.eye(n, dtype=bool) if positives is None else positives | np.eye(n, dtype=bool)
    draws = [np.arange(n)]
    if pool is not None:
        draws = [rng_for(seed, "pool", r).choice(n, pool, replace=False) for r in range(repeats)]
    hits, seen = {k: np.zeros(n) for k in top}, np.zeros(n)
    chance = dict.fromkeys(top, 0.0)
    a, b = _unit(queries.features), _unit(keys.features)
    for rows in draws:
        similar, good = a[rows] @ b[rows].T, right[np.ix_(rows, rows)]
        seen[rows] += 1
        for k in top:
            hits[k][rows] += _hit_probability(similar, good, k)
            chance[k] += _hit_probability(np.zeros_like(similar), good, k).mean() / len(draws)
    used = np.flatnonzero(seen)
    groups = queries.ids if queries.groups is None else queries.groups
    settings = {
        "pool": pool,
        "repeats": repeats if pool else None,
        "positives": "diagonal" if positives is None else "given",
    }
    return [
        mean_over_groups(
            f"{name} top-{k}",
            hits[k][used] / seen[used],
            [groups[int(i)] for i in used],
            weights=seen[used],
            estimator="mean over pools" if pool else "mean",
            subject=subject,
            split=split,
            encoder=queries.encoder,
            seed=seed if pool else None,
            settings=settings,
            details={"chance": float(chance[k]), "key_encoder": keys.encoder},
        )
        for k in top
    ]


def recall_by_class(hits: NDArray[Any], labels: Sequence[str]) -> dict[str, float]:
    """Share of hits (n,) of every class."""
    names = np.array(labels)
    return {str(name): float(hits[names == name].mean()) for name in np.unique(names)}


def mean_over_groups(
    metric: str,
    values: NDArray[Any],
    groups: Sequence[str],
    *,
    weights: Array | None = None,
    **fields: Any,
) -> Score:
    """Weighted mean of values in [0, 1] as a score with a leave-one-group-out interval.

    Args:
        metric: its name.
        values: (n,) one a sample.
        groups: n group names.
        weights: (n,); None weights all samples the same.
        **fields: further fields of the score.
    """
    weights = np.ones(len(values)) if weights is None else weights
    mean = float(weights @ values / weights.sum())
    _, group = np.unique(np.array(groups, dtype=str), return_inverse=True)
    above, below = np.bincount(group, weights * values), np.bincount(group, weights)
    interval, method, g = None, "", len(above)
    if g > 1:
        without = (above.sum() - above) / (below.sum() - below)
        error = float(jackknife_errors(without[:, None])[0])
        if error > 0:  # no change without any group is no evidence of certainty
            low, high = t_interval(mean, error, g - 1, 0.95)
            interval = (max(0.0, low), min(1.0, high))
            method = f"leave-one-group-out jackknife, t, {g - 1} df"
    fields |= {"interval": interval, "interval_method": method, "n": len(values)}
    return Score(metric, value=mean, higher_is_better=True, **fields)


def _unit(x: NDArray[Any]) -> Array:
    """Rows of length 1, float64; a row of zeros stays."""
    x = x.astype(np.float64)
    return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)


def _hit_probability(similar: Array, good: NDArray[np.bool_], k: int) -> Array:
    """(n,) probability that a positive is in the top k when ties are broken at random."""
    best = np.where(good, similar, -np.inf).max(axis=1, keepdims=True)
    tied = np.abs(similar - best) <= TIE
    above = ((similar > best) & ~tied).sum(axis=1)
    ties, wrong = tied.sum(axis=1), (tied & ~good).sum(axis=1)
    slots = np.clip(k - above, 0, ties)  # places in the top k that the ties share
    # C(wrong, slots) / C(ties, slots), only wrong ones in the slots; 0 where wrong < slots
    log_miss = gammaln(wrong + 1) - gammaln(wrong - slots + 1)
    return 1 - np.exp(log_miss - gammaln(ties + 1) + gammaln(ties - slots + 1))


def _check_retrieval(queries: FeatureSet, keys: FeatureSet, pool: int | None) -> None:
    n, widths = len(queries.ids), (queries.features.shape[1], keys.features.shape[1])
    if list(queries.ids) != list(keys.ids):
        must = "Queries and keys must have the same ids in the same order"
        raise PalpateError(must, "different ids", "Take the same ids from both")
    if n < 2 or widths[0] != widths[1]:
        must = "Retrieval needs at least two samples in one common space"
        got = f"{n} samples, widths {widths[0]} and {widths[1]}"
        raise PalpateError(must, got, "Embed both with one set of encoders")
    if pool is not None and not 2 <= pool <= n:
        must, fix = f"must lie in 2 to {n}, the number of samples", "Choose a smaller pool"
        raise PalpateError(must, f"{pool}", fix, argument="pool")


def _labeled(features: FeatureSet, part: str) -> tuple[Array, list[str], list[str]]:
    """Rows with a label: features as float64, labels, groups (the id where there is none)."""
    labels = features.labels or []
    keep = [k for k, label in enumerate(labels) if label]
    if not keep:
        must = f"The {part} features must have rows with a material"
        raise PalpateError(must, "none", "Check the split and the column material")
    groups = features.ids if features.groups is None else features.groups
    names = [groups[k] or features.ids[k] for k in keep]
    return features.features[keep].astype(np.float64), [labels[k] for k in keep], names


def _logistic(
    x: Array, y: NDArray[np.intp], weights: Array, classes: int, l2: float
) -> tuple[Array, Array]:
    """Weight (d, classes) and bias (classes,) of the regression at the top of this file."""
    n, d = x.shape
    design = np.hstack([x, np.ones((n, 1))])
    weights = weights / weights.sum()
    penalty = np.append(np.full(d, l2), 0)[:, None]  # none on the bias
    target = np.eye(classes)[y]

    def objective(flat: Array) -> tuple[float, Array]:
        w = flat.reshape(d + 1, classes)
        log_p = log_softmax(design @ w, axis=1)
        gradient = design.T @ ((np.exp(log_p) - target) * weights[:, None]) + 2 * penalty * w
        loss = (penalty * w**2).sum() - weights @ log_p[np.arange(n), y]
        return float(loss), gradient.ravel()

    start, options = np.zeros((d + 1) * classes), {"maxiter": 300}
    w = minimize(objective, start, jac=True, method="L-BFGS-B", options=options).x
    w = w.reshape(d + 1, classes)
    return w[:d], w[d]


def _folds(groups: Sequence[str], folds: int, seed: int) -> NDArray[np.intp] | None:
    """The fold of every row (n,), by whole groups; None with too few groups."""
    names, group = np.unique(np.array(groups, dtype=str), return_inverse=True)
    order = rng_for(seed, "probe folds").permutation(len(names))
    return np.argsort(order)[group] % folds if len(names) >= 2 * folds else None


def _choose_penalty(
    x: Array, y: NDArray[np.intp], weights: Array, fold: NDArray[np.intp] | None
) -> float:
    """The penalty with the best accuracy in cross-validation; the stronger one of two equals."""
    if fold is None:
        return 1e-2
    right = dict.fromkeys(GRID, 0.0)
    for inside in (fold != f for f in range(fold.max() + 1)):
        for l2 in GRID:
            w, b = _logistic(x[inside], y[inside], weights[inside], int(y.max()) + 1, l2)
            hits = (x[~inside] @ w + b).argmax(axis=1) == y[~inside]
            right[l2] += float(weights[~inside] @ hits)
    return max(GRID, key=lambda l2: (right[l2], l2))
