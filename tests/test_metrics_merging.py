"""Merging and resetting streaming metrics, plain and of torchmetrics: other options are refused, and bounds survive."""

import numpy as np
import pytest

from palpate.core import PalpateError
from palpate.metrics import distance, streaming
from test_metrics_streaming import CLASSES, both, feed, sets
from test_metrics_tactile import change

SUMS = {"keep": "sums", "classes": CLASSES, "center": np.full(6, 0.4)}


@pytest.fixture(params=["plain", "torch"])
def metrics(request):
    """The module with the four classes."""
    if request.param == "plain":
        return streaming
    pytest.importorskip("torch")
    pytest.importorskip("torchmetrics")
    from palpate.metrics import torch_metric

    return torch_metric


def score_of(metric):
    return metric.score() if hasattr(metric, "score") else metric.compute()


@pytest.mark.parametrize(
    ("mine", "other"),
    [
        ({}, {"sigma": 5.0}),
        ({"sigma": 5.0}, {"sigma": (5.0, 10.0)}),
        ({}, {"scale": 1.0}),
        ({"preset": "paper"}, {"preset": "cmmd"}),
        ({}, {"preset": "paper"}),
        (SUMS, {**SUMS, "scale": 1.0}),
        (SUMS, {**SUMS, "preset": "cmmd"}),
    ],
)
@pytest.mark.parametrize("name", ["TMMD", "DTMMD"])
def test_metrics_of_other_options_are_not_merged(metrics, name, mine, other):
    g, r = sets()
    of = getattr(metrics, name)
    real = {} if name == "TMMD" or "keep" not in mine else {"floor": True}
    a, b, same = (both(of(**options, **real), g, r) for options in (mine, other, mine))
    before = score_of(a)
    for call in (a.merge_state, a.merge):
        with pytest.raises(PalpateError, match="must be of one class with the same settings"):
            call(b)
    assert score_of(a) == before  # a refusal changes nothing
    assert score_of(a.merge(same)).n == 2 * len(g.ids)


@pytest.mark.parametrize("options", [{}, SUMS])
def test_a_metric_is_not_merged_with_itself(metrics, options):
    metric = feed(metrics.CITMMD(**options), sets()[0])
    before = score_of(metric)
    with pytest.raises(PalpateError, match=r"merged with another one. Got itself"):
        metric.merge_state(metric)
    assert score_of(metric) == before
    with pytest.raises(PalpateError, match="one class"):
        metric.merge_state(metrics.ITMMD(**{k: v for k, v in options.items() if k != "classes"}))


def test_bandwidths_in_an_array_are_settings_too(metrics):
    g, r = sets()
    make = lambda *sigma: both(metrics.TMMD(sigma=np.array(sigma)), g, r)  # noqa: E731
    assert score_of(make(5.0, 10.0).merge(make(5.0, 10.0))).n == 2 * len(g.ids)
    with pytest.raises(PalpateError, match="same settings"):
        make(5.0, 10.0).merge(make(5.0, 20.0))


def test_the_bound_still_holds_for_real_touches_that_a_reset_has_kept(metrics):
    """Real touches far from the center, generated ones near it: the bound of the latter alone would be too small."""
    g, r = sets()
    center = g.features.mean(axis=0)
    near = 0.02 * g.features + 0.98 * center
    g = change(g, features=near / np.linalg.norm(near, axis=1, keepdims=True))
    options = {"keep": "sums", "center": g.features.mean(axis=0), "sigma": 1.0}
    metric = metrics.TMMD(reset_real_features=False, **options)
    feed(metric, r, real=True)
    metric.reset()
    feed(metric, g)
    kept, fresh = score_of(metric), both(streaming.TMMD(**options), g, r).compute()
    assert kept.value == pytest.approx(fresh.value, abs=1e-12)
    assert kept.details["bound"] == pytest.approx(fresh.details["bound"], rel=1e-9)
    error = abs(kept.value - distance(g.features, r.features, sigma=1.0, backend="blocked").value)
    alone = both(streaming.TMMD(**options), g, g).compute().details["bound"]
    assert alone < error <= kept.details["bound"]
