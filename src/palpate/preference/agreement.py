"""Which metric agrees with people: Kendall's tau-b of metrics with votes, with intervals.

By image: the difference of a metric between the two methods of a trial, against the share of votes
for the first less that for the second. By method: the value of a method, its mean over the items of
the study where it is known by image, against its strength. Items and raters are resampled for both
at once. 1: the metric orders as people do; 0: no relation.
"""

from __future__ import annotations

import base64
import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from PIL import Image

from palpate.core import PalpateError, Progress, Score, read_json, require_choice, track
from palpate.evaluation.inputs import without_suffix
from palpate.metrics.images import per_image
from palpate.preference.arrays import FEWER, VoteArrays
from palpate.preference.plan import REFERENCE, Plan
from palpate.preference.statistics import Array, tau_b
from palpate.report.results import RESULTS_FORMAT, Results

if TYPE_CHECKING:
    import polars as pl

BY_IMAGE, BY_METHOD = "Kendall's tau with people, by image", "Kendall's tau with people, by method"
#: How the names of metrics begin of which lower is better, besides the MMD family.
LOWER = "(lpips|r?mse|mae|l1|fid|kid|dists)(?![a-z])"
#: Columns of a table that are no metric.
WORDS = ("id", "method", "material", "video")


def lower_is_better(name: str) -> bool:
    """Whether it is, by a metric's name in lower case; ``i-tmmd`` is of the MMD family too."""
    return re.match(LOWER, name) is not None or "mmd" in name


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
        return np.asarray(Image.open(io.BytesIO(data)))

    keys = sorted({(t.item, m) for t in plan.trials if t.kind == "pair" for m in (t.left, t.right)})
    images: dict[Literal["SSIM", "PSNR"], dict[tuple[str, str], float]] = {"SSIM": {}, "PSNR": {}}
    for item, method in track(keys, "comparing images", progress):
        pair = pixels(item, method)[None], pixels(item, REFERENCE)[None]
        for name, values in images.items():
            values[item, method] = float(per_image(name, *pair).values[0])
    return [_of_images(f"{name} (shown images)", values) for name, values in images.items()]


def _of_images(name: str, images: Mapping[tuple[str, str], float]) -> Metric:
    of_method: dict[str, list[float]] = {}
    for (_, method), value in images.items():
        if np.isfinite(value):
            of_method.setdefault(method, []).append(value)
    return Metric(name, images, {m: float(np.mean(values)) for m, values in of_method.items()})


def table_metrics(plan: Plan, sources: Any, lower: Sequence[str]) -> list[Metric]:
    """Metrics of tables of images and of files of ``palpate score``.

    Raises:
        PalpateError: if a source is neither, or knows none of the study's methods, or no metric
            has a name of ``lower``.
    """
    several = isinstance(sources, list | tuple) and not (
        sources and isinstance(sources[0], Mapping)
    )
    metrics = [m for s in (sources if several else [sources]) for m in _metrics(plan, s, lower)]
    names = list(dict.fromkeys(m.name for m in metrics))
    for name in lower:
        require_choice("lower", name, names)
    return metrics


def _metrics(plan: Plan, source: Any, lower: Sequence[str]) -> list[Metric]:
    where = str(source) if isinstance(source, str | Path) else "the table of metrics"
    if isinstance(source, str | Path):
        path = Path(source)
        source = read_json(path, "file of metrics") if path.suffix.lower() == ".json" else path
        if isinstance(source, Mapping) and source.get("format") == RESULTS_FORMAT:
            source = Results.load(path)
    if isinstance(source, Results):
        metrics = _of_results(plan, source)
    else:
        metrics = _of_table(plan, _table(source, where), where, lower)
    if not metrics:
        got, fix = f"none of {', '.join(plan.methods)}", "Name methods as the study does"
        raise PalpateError(f"{where} must hold metrics of the study's methods", got, fix)
    return metrics


def _of_results(plan: Plan, results: Results) -> list[Metric]:
    """Scores by method; of a metric whose target is the floor, the distance to it."""
    values: dict[str, dict[str, float]] = {}
    for s in results.scores:
        if s.subject not in plan.methods or s.value is None or s.metric.endswith(" difference"):
            continue
        name = ", ".join(filter(None, [s.metric, str(s.settings.get("preset", ""))]))
        if s.higher_is_better is not None:
            values.setdefault(name, {})[s.subject] = s.value if s.higher_is_better else -s.value
        elif s.floor is not None:
            values.setdefault(name, {})[s.subject] = -abs(s.value - s.floor)
    return [Metric(name, {}, of_method) for name, of_method in values.items()]


def _table(source: Any, where: str) -> pl.DataFrame:
    import polars as pl

    try:
        if isinstance(source, Path):
            parquet = source.suffix.lower() == ".parquet"
            if parquet:
                return pl.read_parquet(source)
            text: dict[str, Any] = {"id": pl.String, "method": pl.String}  # 000123 is an id
            return pl.read_csv(source, glob=False, schema_overrides=text)
        return source if isinstance(source, pl.DataFrame) else pl.DataFrame(source)
    except Exception as error:  # polars raises many kinds
        got, fix = str(error).splitlines()[0], "Write one with the columns id, method, SSIM ..."
        raise PalpateError(
            f"{where} must be a table or a file of palpate score", got, fix
        ) from None


def _of_table(plan: Plan, table: pl.DataFrame, where: str, lower: Sequence[str]) -> list[Metric]:
    if not {"id", "method"} <= {*table.columns}:
        got, fix = f"the columns {', '.join(table.columns)}", "Add the columns, or rename them"
        raise PalpateError(f"{where} must have the columns id and method", got, fix)
    known = {item.id for item in plan.items}
    ids = [i if i in known else without_suffix(i) for i in map(str, table["id"])]
    if table.height and known.isdisjoint(ids):
        got, fix = f"none of them, but e.g. {ids[0]!r}", "Ids are those of the reference's images"
        raise PalpateError(f"{where} must hold values of the study's items", got, fix)
    keys = list(zip(ids, map(str, table["method"]), strict=True))
    if len(keys) > len({*keys}):
        item, method = Counter(keys).most_common(1)[0][0]
        got, fix = f"{item} of {method} twice", "Keep one row"
        raise PalpateError(f"{where} must have each image of a method once", got, fix)
    metrics: list[Metric] = []
    for name in table.columns:
        if name in WORDS or not table[name].dtype.is_numeric():
            continue
        sign = -1 if name in lower or lower_is_better(name.lower()) else 1
        cells = zip(keys, table[name].to_list(), strict=True)
        values = {
            (item, method): sign * float(v)
            for (item, method), v in cells
            if v is not None and item in known and method in plan.methods
        }
        metrics += [_of_images(name, values)] * bool(values)
    return metrics


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
    known = np.isfinite(x) & weights.any(axis=0).ravel()

    def tau(of_raters: Array, of_items: Array) -> float:
        total = np.tensordot(of_raters, weights.astype(np.float64), 1).ravel()
        net = np.tensordot(of_raters, cells, 1).ravel() / np.maximum(total, 1e-12)
        keep = known & (total > 0)
        each = np.tile(of_items, len(arrays.columns))[keep]
        return tau_b(x[keep], net[keep], each, mirrored=True)

    value = tau(arrays.once.raters[0], arrays.once.items[0])
    drawn = zip(arrays.resampled.raters[:FEWER], arrays.resampled.items[:FEWER], strict=True)
    replicates = np.array([tau(*weights) for weights in drawn])
    return arrays.score(BY_IMAGE, metric.name, value, replicates, known.sum())


def _by_method(metric: Metric, arrays: VoteArrays) -> Score:
    """Over methods: value of the metric, over the same items where it is by image, and strength."""
    names, items = arrays.plan.methods, arrays.plan.items
    strength = [arrays.strength, *arrays.strength_replicates]
    x = np.tile([metric.methods[name] for name in names], (len(strength), 1))
    if metric.images:
        drawn = np.vstack([arrays.once.items, arrays.resampled.items[:FEWER]])
        cells = np.array([[metric.images.get((i.id, n), np.nan) for n in names] for i in items])
        known = np.isfinite(cells)
        with np.errstate(invalid="ignore"):
            x = drawn @ np.where(known, cells, 0) / (drawn @ known)
    pairs = zip(x, strength, strict=True)
    value, *replicates = (tau_b(row, of[:-1], np.ones(len(names))) for row, of in pairs)
    return arrays.score(BY_METHOD, metric.name, value, np.array(replicates), len(names))
