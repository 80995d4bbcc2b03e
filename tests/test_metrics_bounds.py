"""Bounds of the moments: what they are, where there are none, and where another back end or a refusal takes over."""

import math

import numpy as np
import pytest

from palpate.core import FeatureSet, PalpateError
from palpate.metrics import CITMMD, DTMMD, ITMMD, TMMD, Polynomial, ci_tmmd, d_tmmd, distance
from palpate.metrics import engine as engine_module
from palpate.metrics.moments import WIDEST, Moments
from test_metrics_mmd import cdist_mmd, unit_rows


def moments_of(x, item, sigma, items=3):
    found = Moments.empty(x.mean(axis=0), sigma, items)
    found.add(x, item)
    return found


def scaled(seed, n, rho, sigma=1.0):
    """Rows whose farthest has ``||z||^2 = rho`` about their mean."""
    x = np.random.default_rng(seed).normal(size=(n, 4))
    x -= x.mean(axis=0)
    return x * sigma * math.sqrt(rho / (x**2).sum(axis=1).max())


@pytest.mark.parametrize(("rho", "sigma"), [(0.01, 10.0), (0.7, 10.0), (6.0, 0.5), (29.9, 1.0)])
def test_the_bound_is_h_of_rho_times_the_pairs_of_different_samples(rho, sigma):
    x, item = scaled(0, 13, rho, sigma), np.arange(13) % 3
    z = (x - x.mean(axis=0)) / sigma
    u, rho = np.exp(-(z**2).sum(axis=1) / 2), (z**2).sum(axis=1).max()
    h = math.fsum(rho**p / math.factorial(p) for p in range(3, 150)) / rho**2
    slow = np.zeros((3, 3))
    for i in range(13):
        for j in range(13):
            if i != j:
                slow[item[i], item[j]] += h * u[i] * u[j] * (z[i] @ z[j]) ** 2
    sums, rest = moments_of(x, item, sigma).products()
    np.testing.assert_allclose(rest, slow, rtol=1e-9)
    exact = np.array(
        [
            [
                sum(
                    np.expm1(-((x[i] - x[j]) ** 2).sum() / (2 * sigma**2))
                    for i in np.flatnonzero(item == a)
                    for j in np.flatnonzero(item == b)
                    if i != j
                )
                for b in range(3)
            ]
            for a in range(3)
        ]
    )
    assert (np.abs(sums - exact) <= rest + 1e-10).all()


@pytest.mark.parametrize("rho", [1.01 * WIDEST, 300.0, 1e5])
def test_no_bound_is_claimed_of_features_too_wide_for_the_bandwidth(rho):
    item = np.arange(13) % 3
    pairs = np.outer(np.bincount(item), np.bincount(item)) - np.diag(np.bincount(item))
    assert (
        moments_of(scaled(1, 13, rho), item, 1.0).products()[1] > 1e20 * pairs
    ).all()  # no sum of k - 1 is larger than the pairs


def test_weights_that_vanish_in_float32_are_no_evidence(monkeypatch):
    """With ||z||^2 about 400 all u are 0 in float32, and with them whatever a bound could be a multiple of."""
    monkeypatch.setattr(engine_module, "LEAST_ROWS", 100)
    rng = np.random.default_rng(0)
    ends = rng.normal(size=(16, 8))
    ends = np.concatenate([ends, -ends]) / np.linalg.norm(
        np.concatenate([ends, ends]), axis=1, keepdims=True
    )
    x, y = (ends[np.arange(n) % 32] + 1e-2 * rng.normal(size=(n, 8)) for n in (320, 288))
    x[::2] += 0.03
    x, y = (v.astype(np.float32) for v in (x, y))
    options = {"sigma": 0.05, "normalize": False}
    truth = cdist_mmd(x, y, 0.05)
    assert abs(truth) > 1
    got = distance(x, y, **options)
    assert (got.backend, got.bound) == ("blocked", 0)
    assert got.value == pytest.approx(truth, abs=1e-6)
    with pytest.raises(PalpateError, match="wide against the features"):
        distance(x, y, backend="moments", **options)


def test_a_ratio_of_classes_that_overlap_falls_back_to_blocks():
    """The distances are known to 1e-5 and CI-TMMD is theirs, but D-TMMD divides by what is near 0."""
    rng, n = np.random.default_rng(0), engine_module.LEAST_ROWS
    video = np.arange(n) // 32
    x = 1 + rng.normal(size=(n // 32, 16))[video] + 0.02 * rng.normal(size=(n, 16))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    s = FeatureSet(
        [f"{k:05d}" for k in range(n)],
        x,
        [f"m{v % 6}" for v in video],
        [f"v{v:03d}" for v in video],
    )
    easy, got, exact, forced = (
        ci_tmmd(s),
        d_tmmd(s),
        d_tmmd(s, backend="blocked"),
        d_tmmd(s, backend="moments"),
    )
    assert easy.details["backend"] == "moments"
    assert 0 < easy.details["bound"] < 1e-4
    assert (got.details["backend"], got.details["bound"], got.value) == ("blocked", 0, exact.value)
    assert forced.details["bound"] > 1e-4
    assert abs(forced.value - exact.value) <= forced.details["bound"]


def clusters(apart, n=40):
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, n, 3))
    x[n // 2 :, 0] += apart
    y[n // 4 :, 0] += apart
    return x, y


def test_clusters_far_apart_are_right_or_refused():
    x, y = clusters(1e3)
    assert distance(x, y, sigma=1.0, normalize=False).value == pytest.approx(
        cdist_mmd(x, y, 1.0), abs=1e-6
    )
    for backend in ("auto", "blocked"):
        with pytest.raises(
            PalpateError, match=r"bandwidth must be wide enough.*from the mean.*wider sigma"
        ):
            distance(*clusters(1e8), sigma=1.0, normalize=False, backend=backend)
    wide = distance(*clusters(1e8), sigma=1e8, normalize=False).value
    assert wide == pytest.approx(cdist_mmd(*clusters(1e8), 1e8), abs=1e-6)


@pytest.mark.filterwarnings(
    "ignore:overflow encountered:RuntimeWarning", "ignore:invalid value:RuntimeWarning"
)
def test_an_infinite_kernel_is_named():
    x, y = unit_rows(0, 12, 3), unit_rows(1, 9, 3)
    with pytest.raises(PalpateError, match=r"Kernel values must be finite.*Normalize the rows"):
        distance(x * 1e152, y * 1e152, kernel=Polynomial(), normalize=False)
    assert math.isfinite(distance(x * 1e30, y * 1e30, kernel=Polynomial(), normalize=False).value)


def two_classes(apart, n=80):
    """Rows of two classes well apart, their ids and labels."""
    number = np.arange(n) % 2
    x = (
        np.eye(4)[0]
        + apart * np.eye(4)[1 + number]
        + 0.05 * np.random.default_rng(0).normal(size=(n, 4))
    )
    return (
        x / np.linalg.norm(x, axis=1, keepdims=True),
        [f"{k}" for k in range(n)],
        ["ab"[c] for c in number],
    )


@pytest.mark.parametrize(
    ("cls", "apart", "sigma"),
    [
        (TMMD, 0.3, 0.02),
        (ITMMD, 0.3, 0.02),
        (CITMMD, 0.3, 0.02),
        (DTMMD, 0.3, 0.2),
        (DTMMD, 1.0, 0.05),
    ],
)
def test_sums_whose_bound_is_too_large_name_the_way_out_that_they_have(cls, apart, sigma):
    x, ids, labels = two_classes(apart)
    metric = cls(keep="sums", sigma=sigma, classes=["a", "b"], center=x.mean(axis=0))
    for real in (False,) if metric.of_halves else (False, True):
        metric.update(x, real=real, ids=ids, labels=labels)
    score = metric.compute()
    assert (score.value, score.details["bound"]) == (None, None)
    assert "do not bound" in score.note
    assert 'keep="features"' in score.note
    assert "backend" not in score.note
    assert (
        d_tmmd(FeatureSet(ids, x, labels), sigma=sigma).value is not None
    )  # it is the sums that do not know
