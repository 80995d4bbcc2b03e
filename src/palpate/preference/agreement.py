"""Which metric agrees with people: Kendall's tau-b of metrics with votes, with intervals.

By image: the difference of a metric between the two methods of a trial, against the share of votes
for the first less that for the second. By method: the value of a method, against its strength. Both
are resampled as the votes are. 1: the metric orders as people do; 0: no relation.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from PIL import Image

from palpate.core import PalpateError, Progress, Score, read_json, track
from palpate.evaluation.inputs import without_suffix
from palpate.metrics.images import per_image
from palpate.preference.arrays import FEWER, VoteArrays
from palpate.preference.plan import REFERENCE, Plan
from palpate.preference.statistics import Array, tau_b
from palpate.report.results import RESULTS_FORMATS, Results

if TYPE_CHECKING:
    import polars as pl

BY_IMAGE, BY_METHOD = "Kendall's tau with people, by image", "Kendall's tau with people, by method"
#: Beginnings of the names of metrics of which lower is better, besides the MMD family.
LOWER = ("lpips", "mse", "rmse", "mae", "l1", "fid", "kid", "dists")
#: Columns of a table that are no metric.
WORDS = ("id", "method", "material", "video")


def lower_is_better(name: str) -> bool:
    """Whether it is, by a metric's name in lower case; ``i-tmmd`` is of the MMD family too."""
    return name.startswith(LOWER) or "mmd" in name


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
        """Value of ``a`` less that of ``b``; NaN where one is not known or both are infinite."""
        x, y = (self.images.get((item, method), np.nan) for method in (a, b))
        return np.nan if x == y == np.inf else x - y


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
        PalpateError: if a source is neither, or knows none of the study's methods.
    """
    several = isinstance(sources, list | tuple) and not (
        sources and isinstance(sources[0], Mapping)
    )
    return [
        metric for s in (sources if several else [sources]) for metric in _metrics(plan, s, lower)
    ]


def _metrics(plan: Plan, source: Any, lower: Sequence[str]) -> list[Metric]:
    where = str(source) if isinstance(source, str | Path) else "the table of metrics"
    if isinstance(source, str | Path):
        path = Path(source)
        source = read_json(path, "file of metrics") if path.suffix.lower() == ".json" else path
        if isinstance(source, Mapping) and source.get("format") in RESULTS_FORMATS:
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
            return pl.read_parquet(source) if parquet else pl.read_csv(source, glob=False)
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
    keys = list(zip(ids, table["method"].to_list(), strict=True))
    metrics: list[Metric] = []
    for name in table.columns:
        if name in WORDS or not table[name].dtype.is_numeric():
            continue
        sign = -1 if name in lower or lower_is_better(name.lower()) else 1
        cells = zip(keys, table[name].to_list(), strict=True)
        values = {k: sign * float(v) for k, v in cells if v is not None and k[1] in plan.methods}
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

    def tau(of_raters: Array, of_items: Array) -> float:
        cells, weights = np.nan_to_num(arrays.values), np.isfinite(arrays.values)
        total = np.tensordot(of_raters, weights.astype(np.float64), 1).ravel()
        net = np.tensordot(of_raters, cells, 1).ravel() / np.maximum(total, 1e-12)
        keep = np.isfinite(x) & (total > 0)
        each = np.tile(of_items, len(arrays.columns))[keep]
        return tau_b(x[keep], net[keep], each, mirrored=True)

    value = tau(arrays.once.raters[0], arrays.once.items[0])
    drawn = zip(arrays.resampled.raters[:FEWER], arrays.resampled.items[:FEWER], strict=True)
    replicates = np.array([tau(*weights) for weights in drawn])
    return arrays.score(BY_IMAGE, metric.name, value, replicates, np.isfinite(x).sum())


def _by_method(metric: Metric, arrays: VoteArrays) -> Score:
    """Over methods: value of the metric against strength."""
    x = np.array([metric.methods[name] for name in arrays.plan.methods])
    rows = [arrays.strength, *arrays.strength_replicates]
    value, *replicates = (tau_b(x, row[:-1], np.ones(len(x))) for row in rows)
    return arrays.score(BY_METHOD, metric.name, value, np.array(replicates), len(x))
