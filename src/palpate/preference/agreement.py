"""Which metric agrees with people: Kendall's tau-b of metrics with votes, with intervals.

By image: the difference of a metric between the two methods of a trial, against the share of votes
for the first less that for the second. By method: the value of a method, its mean over the items of
the study where it is known by image, against its strength. Items and raters are resampled for both
at once. 1: the metric orders as people do; 0: no relation.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpate.core import Progress, Score, open_image, require, track
from palpate.metrics.images import per_image
from palpate.preference.arrays import FEWER, VoteArrays
from palpate.preference.plan import REFERENCE, Plan
from palpate.preference.statistics import Array, tau_b
from palpate.report.labels import measured
from palpate.report.results import Results

BY_IMAGE, BY_METHOD = "Kendall's tau with people, by image", "Kendall's tau with people, by method"


@dataclass(frozen=True)
class Metric:
    """Values of one metric, turned so that higher is better.

    Attributes:
        name: as in its source.
        images: (item, method) -> value.
        methods: method -> value.
    """

    name: str
    images: Mapping[tuple[str, str], float] = field(default_factory=dict)
    methods: Mapping[str, float] = field(default_factory=dict)

    def difference(self, item: str, a: str, b: str) -> float:
        """Value of ``a`` less that of ``b``; NaN where one is not known."""
        x, y = (self.images.get((item, method), np.nan) for method in (a, b))
        return 0.0 if x == y else x - y  # the PSNR of two perfect images is infinite


def shown_metrics(plan: Plan, progress: Progress) -> list[Metric]:
    """SSIM and PSNR of the images as raters saw them."""

    def pixels(item: str, slot: str) -> Any:
        data = base64.b64decode(plan.images[plan.name(item, slot)].partition(",")[2])
        with open_image(io.BytesIO(data)) as image:
            return np.asarray(image)

    keys = sorted({(t.item, m) for t in plan.trials if t.kind == "pair" for m in (t.left, t.right)})
    images: dict[Literal["SSIM", "PSNR"], dict[tuple[str, str], float]] = {"SSIM": {}, "PSNR": {}}
    for item, method in track(keys, "comparing images", progress):
        pair = pixels(item, method)[None], pixels(item, REFERENCE)[None]
        for name, values in images.items():
            values[item, method] = float(per_image(name, *pair).values[0])
    return [of_images(f"{name} (shown images)", values) for name, values in images.items()]


def of_images(name: str, images: Mapping[tuple[str, str], float]) -> Metric:
    """A metric by image, and by method its mean over images where it is finite."""
    of_method: dict[str, list[float]] = {}
    for (_, method), value in images.items():
        if np.isfinite(value):
            of_method.setdefault(method, []).append(value)
    return Metric(name, images, {m: float(np.mean(values)) for m, values in of_method.items()})


def metrics_of_files(plan: Plan, paths: Sequence[str | Path]) -> list[Metric]:
    """Metrics by method, of files of ``palpate score``.

    Raises:
        PalpateError: if one is another file, or knows none of the study's methods.
    """
    found: list[Metric] = []
    for path in paths:
        metrics = _of_results(plan, Results.load(path))
        got, fix = f"none of {', '.join(plan.methods)}", "Name methods as the study does"
        must = f"{path} must hold metrics of the study's methods"
        require(bool(metrics), None, must, got, fix=fix)
        found += metrics
    return found


def _of_results(plan: Plan, results: Results) -> list[Metric]:
    """Scores by method; of a metric whose target is the floor, the distance to it."""
    values: dict[str, dict[str, float]] = {}
    for s in results.scores:
        if s.a not in plan.methods or s.value is None or s.b is not None:
            continue
        name = ", ".join(filter(None, [measured(s), str(s.settings.get("preset", ""))]))
        if s.higher_is_better is not None:
            values.setdefault(name, {})[s.a] = s.value if s.higher_is_better else -s.value
        elif s.floor is not None:
            values.setdefault(name, {})[s.a] = -abs(s.value - s.floor)
    return [Metric(name, {}, of_method) for name, of_method in values.items()]


def agreement_scores(
    metrics: Sequence[Metric], arrays: VoteArrays, progress: Progress
) -> list[Score]:
    """Kendall's tau-b of every metric with the votes, by image and by method."""
    scores: list[Score] = []
    for metric in track(metrics, "comparing with people", progress):
        if metric.images:
            scores.append(_by_image(metric, arrays))
        if len(metric.methods) == len(arrays.plan.methods):
            scores.append(_by_method(metric, arrays))
    return scores


def _by_image(metric: Metric, arrays: VoteArrays) -> Score:
    """Over trials: difference of the metric against net share of votes."""
    items = [item.id for item in arrays.plan.items]
    x = np.array(
        [[metric.difference(i, a, b) for i in items] for a, b in arrays.columns], np.float64
    ).ravel()
    x = np.clip(x, -1e300, 1e300)  # infinite differences have an order too
    cells, weights = np.nan_to_num(arrays.values), np.isfinite(arrays.values)
    compared = np.isfinite(x) & weights.any(axis=0).ravel()

    def tau(of_raters: Array, of_items: Array) -> float:
        total = np.tensordot(of_raters, weights.astype(np.float64), 1).ravel()
        net = np.tensordot(of_raters, cells, 1).ravel() / np.maximum(total, 1e-12)
        keep = compared & (total > 0)
        each = np.tile(of_items, len(arrays.columns))[keep]
        return tau_b(x[keep], net[keep], each, mirrored=True)

    value = tau(arrays.once.raters[0], arrays.once.items[0])
    drawn = zip(arrays.resampled.raters[:FEWER], arrays.resampled.items[:FEWER], strict=True)
    replicates = np.array([tau(*weights) for weights in drawn])
    return arrays.score(BY_IMAGE, metric.name, value, replicates, compared.sum())


def _by_method(metric: Metric, arrays: VoteArrays) -> Score:
    """Over methods: value of the metric, over the same items where it is by image, and strength."""
    names, items = arrays.plan.methods, arrays.plan.items
    strength = [arrays.strength, *arrays.strength_replicates]
    x = np.tile([metric.methods[name] for name in names], (len(strength), 1))
    if metric.images:
        drawn = np.vstack([arrays.once.items, arrays.resampled.items[:FEWER]])
        cells = np.array([[metric.images.get((i.id, n), np.nan) for n in names] for i in items])
        finite = np.isfinite(cells)
        with np.errstate(invalid="ignore"):
            x = drawn @ np.where(finite, cells, 0) / (drawn @ finite)
    pairs = zip(x, strength, strict=True)
    value, *replicates = (tau_b(row, theta[:-1], np.ones(len(names))) for row, theta in pairs)
    return arrays.score(BY_METHOD, metric.name, value, np.array(replicates), len(names))
