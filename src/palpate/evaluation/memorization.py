"""Memorization: is a generated image a train image in disguise?

``d(x)`` is the distance of an image to its nearest train image, ``d_i`` of generated images,
``r_j`` of real test images, in one of two spaces:

- *contact pixels*: image minus its no-contact image (without one, minus the mean train image),
  averaged to 32 x 32, root mean square;
- *tactile features*: Euclidean, of an encoder's L2-normalized features.

Two scores for each. **memorized share**: share of d_i below the p-quantile of r_j; real images have
p by construction, which is its floor. **nearness to train**: ``P(d < r) + P(d = r) / 2``, an AUC;
1/2 is what real images score, 1 means that every generated image is nearer to train than every real
one, 0 that none is (noise). Closer to the floor is better for both. Intervals leave out one video
at a time, from both sets, so the quantile's error is in them.

Real test images of a leaking split lie near train as well: the same copies then count for less,
which is the leak and no virtue of the generator. A smooth generator is nearer in pixels to anything
than a real image with its noise: read its score next to the autoencoder's reconstruction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Score, require
from palpate.leakage.neighbors import nearest
from palpate.metrics.inputs import Array, require_one_encoder
from palpate.metrics.intervals import Spread, jackknife_error

if TYPE_CHECKING:
    from palpate.data.samples import Samples
    from palpate.evaluation.scorers import Bench

#: Side that contact pixels are averaged to.
SIDE = 32
#: Quantile of real distances under which a generated image counts as memorized.
QUANTILE = 0.05
PIXELS, FEATURES = "contact pixels", "tactile features"
SHARE, NEARNESS = "memorized share", "nearness to train"


def memorized(bench: Bench) -> list[Score]:
    """How near each generator's images lie to its train images, in every space there is."""
    real, train, scores = bench.reference, bench.seen, list[Score]()
    assert train is not None  # `score` calls this where it is known
    if bench.encoders is not None or real.embedded:
        sets, base = bench.tactile, bench.features(train)
        for name, x in sets.generators.items():
            scores += memorization(x, sets.reference, base, subject=name, split=bench.split)
    if real.embedded:
        return scores
    train = replace(train, gel=real.gel if train.gel is None else train.gel)
    paired = all({*samples.ids} <= {*real.ids} for samples in bench.generators.values())
    gels = real.has_background and train.has_background and paired
    mean = None if gels else np.mean(bench.pixels(train), axis=0, dtype=np.float64)
    base, test = (_contact_rows(bench, samples, samples, mean) for samples in (train, real))
    for name, samples in bench.generators.items():
        scores += memorization(
            _contact_rows(bench, samples, real, mean),
            test,
            base,
            space=PIXELS,
            subject=name,
            split=bench.split,
            settings={"ground": "no-contact images" if gels else "mean train image"},
        )
    return scores


def _contact_rows(bench: Bench, samples: Samples, real: Samples, mean: Any) -> FeatureSet:
    """Pixels without what is there before contact: no-contact images of ``real``, or a mean."""
    if mean is None:
        mean = bench.pixels(real if samples is real else real.take(samples.ids), "background")
    return samples.feature_set(contact_rows(bench.pixels(samples), mean), None)


def contact_rows(images: NDArray[np.uint8], ground: NDArray[Any]) -> NDArray[np.float32]:
    """Rows (n, d) of which Euclidean distance is the root mean square of contact pixels.

    Args:
        images: (n, h, w, 3), square.
        ground: what is subtracted: (n, h, w, 3), or one (h, w, 3) for all; 0 to 255.
    """
    side = min(SIDE, images.shape[1])
    edges = np.array([k * images.shape[1] // side for k in range(side + 1)])
    size = (edges[1:] - edges[:-1]).astype(np.float64)
    area = np.outer(size, size)[..., None]
    rows = np.empty((len(images), side * side * images.shape[3]), np.float32)
    for k, image in enumerate(images):
        gel = ground if ground.ndim == 3 else ground[k]
        change = (image.astype(np.float32) - gel) / 255
        total = np.add.reduceat(np.add.reduceat(change, edges[:-1], axis=0), edges[:-1], axis=1)
        rows[k] = (total / area).ravel()
    return rows / np.float32(np.sqrt(rows.shape[1]))


def nearest_train(queries: NDArray[Any], train: NDArray[Any]) -> tuple[Array, NDArray[np.intp]]:
    """Distance (n,) of each query (n, d) to its nearest train row (m, d), and which that is."""
    base = np.ascontiguousarray(train, np.float32)
    at = nearest(np.ascontiguousarray(queries, np.float32), base)[:, 0]
    change = np.asarray(queries, np.float64) - base[at]
    return np.sqrt((change**2).sum(axis=1)), at


def memorization(
    generated: FeatureSet,
    real: FeatureSet,
    train: FeatureSet,
    *,
    space: str = FEATURES,
    subject: str = "generated",
    split: str | None = None,
    settings: dict[str, Any] | None = None,
) -> list[Score]:
    """Memorized share and nearness to train of generated images; see the head of this module.

    Args:
        generated: rows of the space, with groups (videos) for the interval.
        real: rows of real test images, with groups.
        train: rows of the train images of the generator.
        space: what the rows are, kept in the name of the scores.
        subject: what is scored, kept in the scores.
        split: digest of the split, kept in the scores.
        settings: more to keep in the scores.

    Returns:
        Two scores; ``details`` holds the distances' medians and quantile, and the ten generated
        images that are nearest to train, with the train image.

    Raises:
        PalpateError: if one of the three is empty, or widths or encoders differ.
    """
    for name, features in (("generated", generated), ("real test", real), ("train", train)):
        must, fix = f"There must be {name} images", "Check the folder or the split"
        require(len(features.ids) > 0, None, must, "none", fix=fix)
    for other, pair in ((generated, "Generated and train"), (real, "Real and train")):
        require_one_encoder(other, train, f"{pair} images")
        widths = other.features.shape[1], train.features.shape[1]
        must, got = f"{pair} images must have rows of one width", f"{widths[0]} and {widths[1]}"
        require(widths[0] == widths[1], None, must, got, fix="Describe both in one way")
    drawn, at = nearest_train(generated.features, train.features)
    test, _ = nearest_train(real.features, train.features)
    groups = _units(generated), _units(real)
    threshold = float(np.quantile(test, QUANTILE))
    first = [int(k) for k in np.argsort(drawn, kind="stable")[:10]]
    details: dict[str, Any] = {
        "quantile distance": threshold,
        "median generated": float(np.median(drawn)),
        "median real": float(np.median(test)),
        "nearest": [
            {"id": generated.ids[k], "train": train.ids[at[k]], "distance": float(drawn[k])}
            for k in first
        ],
    }
    settings = {"space": space, "train": len(train.ids), **(settings or {})}
    share = _spread(lambda d, r: (d < np.quantile(r, QUANTILE)).mean(), drawn, test, groups)
    area = _spread(_nearness, drawn, test, groups)
    return [
        Score(
            metric,
            value=spread.value,
            interval=(interval := spread.interval(0.0, 1.0)),
            interval_method=spread.method if interval else "",
            floor=floor,
            settings=more,
            a=subject,
            features=space,
            n=len(drawn),
            m=len(test),
            split=split,
            encoder=train.encoder,
            higher_is_better=None,
            details=details,
        )
        for metric, spread, floor, more in (
            (SHARE, share, QUANTILE, settings | {"quantile": QUANTILE}),
            (NEARNESS, area, 0.5, settings),
        )
    ]


def _units(features: FeatureSet) -> NDArray[np.str_]:
    """The group of each row; the id where there is none."""
    groups: Sequence[Any] = features.groups or [None] * len(features.ids)
    return np.array([g or i for g, i in zip(groups, features.ids, strict=True)], dtype=str)


def _spread(
    statistic: Callable[[Array, Array], float],
    drawn: Array,
    test: Array,
    groups: tuple[NDArray[np.str_], NDArray[np.str_]],
) -> Spread:
    """A statistic of generated and real distances, left without one video after the other."""
    names = np.unique(np.concatenate(groups))
    kept = [(drawn[groups[0] != g], test[groups[1] != g]) for g in names]
    replicates = np.array([statistic(*pair) for pair in kept if min(map(len, pair))])
    error, df = jackknife_error(replicates), len(names) - 1
    method = f"leave-one-video-out jackknife, t, {df} df"
    return Spread(statistic(drawn, test), error, df, method)


def _nearness(drawn: Array, test: Array) -> float:
    """``P(d < r) + P(d = r) / 2``."""
    order = np.sort(test)
    above = len(test) - np.searchsorted(order, drawn, "right")
    equal = np.searchsorted(order, drawn, "right") - np.searchsorted(order, drawn, "left")
    return float((above + equal / 2).mean() / len(test))
