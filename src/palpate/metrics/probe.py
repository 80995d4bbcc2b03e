"""What embeddings encode: class accuracy of a linear probe and of the nearest neighbors.

Probe: multinomial logistic regression on standardized features,
``min_W -1/n sum_i log softmax(W x_i)_{y_i} + l2 ||W||^2``, solved by L-BFGS. l2 is chosen by
cross-validation over whole groups: with rows left out, frames of one video would pick it.

k-NN: the k train rows of highest cosine s vote with weight exp(s / 0.07) (Wu et al. 2018, as DINO);
rows tied with the k-th share the places that are left, so the order of rows does not matter.

Balanced accuracy is the mean over classes of their recall, of the same classifier.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from palpate.core import FeatureSet, Score, require, rng_for
from palpate.metrics.inputs import Array, check, require_one_encoder
from palpate.metrics.means import Mean, mean_of
from palpate.metrics.retrieval import TIE, blocks, unit_rows

#: Penalties that cross-validation chooses from.
GRID = (1e-4, 1e-3, 1e-2, 1e-1)
#: Folds of the cross-validation.
FOLDS = 3
#: Train rows that vote in k-NN.
NEIGHBORS = 20
#: Temperature of the votes of k-NN.
VOTE = 0.07


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


def fit_probe(train: FeatureSet, *, l2: float | None = None, seed: int = 0) -> Probe:
    """Fit a linear probe to labeled features.

    Args:
        train: features with labels; rows without a label are skipped.
        l2: the penalty; None chooses among 1e-4 to 1e-1 by cross-validation over groups.
        seed: of the folds of the cross-validation.

    Raises:
        PalpateError: without labels, or with fewer than two classes.
    """
    x, labels, groups = _labeled(train, "train")
    classes = sorted(set(labels))
    must = "A probe needs at least two classes in train"
    require(len(classes) > 1, None, must, len(classes), fix="Use another split")
    y = np.searchsorted(classes, labels)
    mean, sd = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-8)
    z = (x - mean) / sd
    if l2 is None:
        l2 = _choose_penalty(z, y, _folds(groups, seed))
    weight, bias = _logistic(z, y, len(classes), l2)
    return Probe(tuple(classes), mean, sd, weight, bias, l2)


def material_accuracy(
    train: FeatureSet,
    test: FeatureSet,
    *,
    probe: Probe | None = None,
    l2: float | None = None,
    subject: str = "real",
    split: str | None = None,
) -> Score:
    """Accuracy of a linear probe on new samples (the paper's material classification).

    Args:
        train: features with labels, and groups to choose ``l2``.
        test: features of the same encoder with labels, and groups for the interval.
        probe: a probe fitted to ``train`` before; None fits one.
        l2: see :func:`fit_probe`.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.

    Returns:
        A score in [0, 1]; ``details`` holds chance (1 / classes), the accuracy of the majority
        class, recall by class, the penalty, and classes unseen in train (counted as wrong).

    Raises:
        PalpateError: without labels in both sets, or on features of two encoders.
    """
    require_one_encoder(train, test, "Train and test")
    probe = probe or fit_probe(train, l2=l2)
    return _linear(probe, train, test, "material", seed=0, subject=subject, split=split)[0].score


def class_accuracies(
    train: FeatureSet, test: FeatureSet, *, label: str = "material", seed: int = 0, **fields: Any
) -> list[Mean]:
    """Accuracy and balanced accuracy of a linear probe and of k-NN, on new samples.

    Args:
        train: features with labels, and groups to choose the probe's penalty.
        test: features of the same encoder with labels, and groups for the intervals.
        label: what the labels are, for the names of the scores.
        seed: of the folds that choose the penalty.
        **fields: further fields of the scores.

    Returns:
        Four means; ``details`` holds chance and what always naming the commonest class of train
        scores, for the linear probe also the confusion matrix (rows: the true class; shares).

    Raises:
        PalpateError: as :func:`material_accuracy`.
    """
    require_one_encoder(train, test, "Train and test")
    probe = fit_probe(train, seed=seed)
    means = _linear(probe, train, test, label, seed=seed, **fields)
    x, labels, _ = _labeled(train, "train")
    z, truth, _ = _labeled(test, "test")
    hits = neighbor_hits(x, labels, z, truth, NEIGHBORS)
    return [
        *means,
        *_accuracies(f"{label} accuracy, {NEIGHBORS}-NN", hits, train, test, {}, **fields),
    ]


def neighbor_hits(
    train: NDArray[Any],
    train_labels: Sequence[str],
    test: NDArray[Any],
    test_labels: Sequence[str],
    neighbors: int,
) -> Array:
    """(m,) probability that weighted k-NN names each test row correctly, votes being tied or not.

    Of ``neighbors`` at most n count. A class that train lacks is never named.
    """
    names, code = np.unique(np.array(train_labels), return_inverse=True)
    one_hot = np.eye(len(names), dtype=np.float32)[code]
    base, queries = unit_rows(train), unit_rows(test)
    k, hits = min(neighbors, len(base)), np.zeros(len(queries))
    truth = np.array(test_labels)
    for rows in blocks(len(queries), len(base)):
        similar = queries[rows] @ base.T
        last = np.partition(similar, len(base) - k, axis=1)[:, len(base) - k, None]
        inside, tied = similar > last + TIE, np.abs(similar - last) <= TIE
        share = (k - inside.sum(axis=1)) / tied.sum(axis=1)
        counted = np.where(inside, 1, np.where(tied, share[:, None], 0))
        votes = (counted * np.exp((similar - 1) / VOTE)) @ one_hot
        best = votes >= votes.max(axis=1, keepdims=True) * (1 - 1e-5)
        right = best & (names == truth[rows, None])
        hits[rows] = right.any(axis=1) / best.sum(axis=1)
    return hits


def _linear(
    probe: Probe, train: FeatureSet, test: FeatureSet, label: str, **fields: Any
) -> list[Mean]:
    """Accuracy and balanced accuracy of a linear probe, the first with the confusion matrix."""
    x, truth, _ = _labeled(test, "test")
    named = probe.predict(x)
    classes = sorted({*probe.classes, *truth})
    counts = np.zeros((len(classes), len(classes)))
    np.add.at(counts, (np.searchsorted(classes, truth), np.searchsorted(classes, named)), 1)
    of_class = counts.sum(axis=1, keepdims=True)
    shares = np.divide(counts, of_class, where=of_class > 0, out=np.full(counts.shape, np.nan))
    details = {"l2": probe.l2, "train_samples": len(train.ids)}
    plain, balanced = _accuracies(
        f"{label} accuracy", np.array(named) == np.array(truth), train, test, details, **fields
    )
    confusion = {"matrix": shares.round(4).tolist(), "classes": classes}
    score = replace(plain.score, details={**plain.score.details, **confusion})
    return [replace(plain, score=score), balanced]


def _accuracies(
    name: str,
    hits: NDArray[Any],
    train: FeatureSet,
    test: FeatureSet,
    details: dict[str, Any],
    **fields: Any,
) -> list[Mean]:
    """A classifier's accuracy and balanced accuracy, next to chance and the commonest class."""
    _, trained, _ = _labeled(train, "train")
    _, truth, groups = _labeled(test, "test")
    counts, majority = Counter(truth), Counter(trained).most_common(1)[0][0]
    names = np.array(truth)
    details = {
        "chance": 1 / len(set(trained)),
        "recall": {label: float(hits[names == label].mean()) for label in sorted(counts)},
        "unseen_classes": sorted(set(truth) - set(trained)),
        **details,
    }
    weights = np.array([1 / counts[label] for label in truth])
    return [
        mean_of(
            metric,
            hits,
            groups,
            weights=weighted,
            estimator=estimator,
            details={**details, "majority": share},
            encoder=test.encoder,
            **fields,
        )
        for metric, weighted, estimator, share in (
            (name, None, "mean", counts[majority] / len(truth)),
            (
                f"{name}, balanced",
                weights,
                "mean of class recalls",
                (majority in counts) / len(counts),
            ),
        )
    ]


def _labeled(features: FeatureSet, part: str) -> tuple[Array, list[str], list[str]]:
    """Rows with a label: features as float64, labels, groups (the id where there is none)."""
    labels = features.labels or []
    keep = [k for k, label in enumerate(labels) if label]
    must, fix = "must have rows with a label", "Check the split, and the column of the labels"
    check(bool(keep), f"The {part} features", must, "none", fix)
    groups = features.ids if features.groups is None else features.groups
    names = [groups[k] or features.ids[k] for k in keep]
    return features.features[keep].astype(np.float64), [labels[k] for k in keep], names


def _logistic(x: Array, y: NDArray[np.intp], classes: int, l2: float) -> tuple[Array, Array]:
    """Weight (d, classes) and bias (classes,) of the regression at the top of this file."""
    n, d = x.shape
    design = np.hstack([x, np.ones((n, 1))])
    penalty = np.append(np.full(d, l2), 0)[:, None]  # none on the bias
    target = np.eye(classes)[y]

    def objective(flat: Array) -> tuple[float, Array]:
        w = flat.reshape(d + 1, classes)
        log_p = scipy.special.log_softmax(design @ w, axis=1)
        gradient = design.T @ ((np.exp(log_p) - target) / n) + 2 * penalty * w
        loss = (penalty * w**2).sum() - log_p[np.arange(n), y].mean()
        return float(loss), gradient.ravel()

    start, options = np.zeros((d + 1) * classes), {"maxiter": 300}
    w = scipy.optimize.minimize(objective, start, jac=True, method="L-BFGS-B", options=options).x
    w = w.reshape(d + 1, classes)
    return w[:d], w[d]


def _folds(groups: Sequence[str], seed: int) -> NDArray[np.intp] | None:
    """The fold of every row (n,), by whole groups; None with too few groups."""
    names, group = np.unique(np.array(groups, dtype=str), return_inverse=True)
    order = rng_for(seed, "probe folds").permutation(len(names))
    return np.argsort(order)[group] % FOLDS if len(names) >= 2 * FOLDS else None


def _choose_penalty(x: Array, y: NDArray[np.intp], fold: NDArray[np.intp] | None) -> float:
    """The penalty with the best accuracy in cross-validation; the stronger one of two equals."""
    if fold is None:
        return 1e-2
    right = dict.fromkeys(GRID, 0.0)
    for inside in (fold != f for f in range(fold.max() + 1)):
        for l2 in GRID:
            w, b = _logistic(x[inside], y[inside], int(y.max()) + 1, l2)
            hits = (x[~inside] @ w + b).argmax(axis=1) == y[~inside]
            right[l2] += float(hits.sum())
    return max(GRID, key=lambda l2: (right[l2], l2))
