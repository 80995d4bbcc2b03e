"""Squared MMD: both back ends, every kernel and input against double loops over pairs."""

import functools
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forge.errors import fails
from palpate.core import FeatureSet, Note, PalpateWarning
from palpate.metrics import Gaussian, Polynomial, distance, i_tmmd, kernels, tmmd
from palpate.metrics.kernels import (
    Kernel,
    blocked_sums,
    centered_squares,
    gaussian,
    median_distance,
)
from palpate.metrics.mmd import random_halves_sd
from palpate.metrics.moments import WIDEST, Moments, center_of, remainder_factor

LINEAR = Polynomial(degree=1, gamma=1.0, coef0=0.0)


def mmd2(x, y, **options):
    return distance(x, y, **options).value


def unit_rows(seed, n, d, spread=1.0):
    rng = np.random.default_rng(seed)
    x = np.ones(d) + spread * rng.normal(size=(n, d))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def loop_mmd(x, y, estimator, gx=None, gy=None, sigma=10.0, scale=1000.0):
    """Eq. 2 by its letter: every pair, in Python floats, with k itself (no k - 1, no centering)."""

    def mean(a, b, ga, gb, same_set):
        terms = []
        for i, j in itertools.product(range(len(a)), range(len(b))):
            if estimator == "unbiased" and same_set and i == j:
                continue
            if estimator == "grouped" and ga[i] == gb[j]:
                continue
            squares = sum((float(p) - float(q)) ** 2 for p, q in zip(a[i], b[j], strict=True))
            terms.append(math.exp(-squares / (2 * sigma**2)))
        return math.fsum(terms) / len(terms)

    inner = mean(x, x, gx, gx, True) + mean(y, y, gy, gy, True)
    return scale * (inner - 2 * mean(x, y, gx, gy, False))


def loop_sums(x, segment, unit, k):
    """Sums over pairs i != j by segment (3), all and inside units, one pair at a time."""
    sums, same = np.zeros((3, 3)), np.zeros((3, 3))
    for i, j in itertools.permutations(range(len(x)), 2):
        value = k(x[i].astype(np.float64), x[j].astype(np.float64))
        sums[segment[i], segment[j]] += value
        same[segment[i], segment[j]] += value * (unit[i] == unit[j])
    return sums, same


def layout(seed, n, units=5):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 3, n), rng.integers(0, units, n)


@given(
    seed=st.integers(0, 10**6),
    m=st.integers(3, 9),
    n=st.integers(3, 9),
    d=st.integers(1, 5),
    sigma=st.sampled_from([0.3, 1.0, 10.0]),
    estimator=st.sampled_from(["unbiased", "biased", "grouped"]),
    duplicates=st.booleans(),
    block=st.sampled_from([1, 2, 3, 2048]),
    dtype=st.sampled_from([np.float32, np.float64]),
)
@settings(max_examples=120)
def test_mmd_equals_the_double_loop(seed, m, n, d, sigma, estimator, duplicates, block, dtype):
    x, y = unit_rows(seed, m, d).astype(dtype), unit_rows(seed + 1, n, d).astype(dtype)
    if duplicates:
        x[1], y[0], y[2] = x[0], x[0], y[1]
    rng = np.random.default_rng(seed)
    gx, gy = [f"v{g}" for g in rng.integers(0, 3, m)], [f"v{g}" for g in rng.integers(0, 4, n)]
    gx[:2], gy[:2] = ["v0", "v1"], ["v2", "v0"]
    groups = {"groups": gx, "reference_groups": gy} if estimator == "grouped" else {}
    got = mmd2(x, y, sigma=sigma, estimator=estimator, block=block, **groups)
    close = 1e-9 if dtype == np.float64 else 1e-4
    assert got == pytest.approx(loop_mmd(x, y, estimator, gx, gy, sigma), abs=close)


class Shifted(Kernel):
    """A custom kernel: exp(-|x - y|^2 / 2), not shifted."""

    stationary = True

    def values(self, t, xp):
        return xp.exp(t)


def rbf(a, b, sigma):
    return np.expm1(-((a - b) ** 2).sum() / (2 * sigma**2))


KERNELS = {
    "gaussian": (Gaussian((2.0,)), lambda a, b: rbf(a, b, 2.0)),
    "several": (Gaussian((1.0, 3.0)), lambda a, b: np.mean([rbf(a, b, s) for s in (1, 3)])),
    "polynomial": (Polynomial(), lambda a, b: (a @ b / len(a) + 1) ** 3),
    "quadratic": (Polynomial(2, 0.5, 0.25), lambda a, b: (0.5 * a @ b + 0.25) ** 2),
    "linear": (LINEAR, lambda a, b: a @ b),
    "custom": (Shifted(), lambda a, b: np.exp(-((a - b) ** 2).sum() / 2)),
}


@functools.cache
def slow_sums(name, seed, n, units):
    """:func:`loop_sums` of a layout, of all and without each unit."""
    x, (segment, unit), k = unit_rows(seed, n, 4), layout(seed, n, units=units), KERNELS[name][1]
    parts = [unit == unit, *(unit != u for u in np.unique(unit))]
    return [loop_sums(x[part], segment[part], unit[part], k) for part in parts]


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("most_items", [0, 2048])
def test_sums_by_segment_and_unit_equal_the_double_loop(name, library, most_items, monkeypatch):
    xp = pytest.importorskip(library)
    monkeypatch.setattr(kernels, "MOST_ITEMS", most_items)
    kernel, k = KERNELS[name]
    for seed, n, units, block in [(0, 1, 3, 7), (1, 24, 3, 7), (2, 24, 30, 1024), (3, 50, 5, 16)]:
        x, (segment, unit) = unit_rows(seed, n, 4), layout(seed, n, units=units)
        options = {"segments": 3, "kernel": kernel, "block": block}
        swept = blocked_sums(xp.asarray(x), segment, unit, **options)
        (sums, same), *left_out = slow_sums(name, seed, n, units)
        np.testing.assert_allclose(swept.totals.sums, sums, atol=1e-10)
        np.testing.assert_allclose(swept.totals.same, same, atol=1e-10)
        diagonal = [sum(k(x[i], x[i]) for i in np.flatnonzero(segment == s)) for s in range(3)]
        np.testing.assert_allclose(swept.totals.diagonal, diagonal, atol=1e-10)
        assert (swept.units == np.unique(unit)).all()
        for (sums, same), without in zip(left_out, swept.leave_one_out(), strict=True):
            np.testing.assert_allclose(without.sums, sums, atol=1e-10)
            np.testing.assert_allclose(without.same, same, atol=1e-10)
        assert (swept.block is None) == (most_items == 0)
        merged = swept.merge(np.array([1, -1, 0]), 2).totals
        np.testing.assert_allclose(merged.sums, swept.totals.sums[np.ix_([2, 0], [2, 0])])
        inside = np.flatnonzero(segment < 2)
        if len(inside) > 1:
            values = [[k(x[i], x[j]) * (i != j) for j in inside] for i in inside]
            h = np.eye(len(inside)) - 1 / len(inside)
            centered = h @ np.array(values) @ h
            own = np.diagonal(centered)
            expected = ((centered**2).sum() - (own**2).sum(), own.sum(), (own**2).sum())
            got = centered_squares(xp.asarray(x), inside, kernel)
            assert got == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_the_spread_of_many_rows_is_that_of_some(monkeypatch):
    x, every = unit_rows(0, 900, 8), np.arange(900)
    whole = centered_squares(x, every, Gaussian())
    monkeypatch.setattr(kernels, "SPREAD_ROWS", 300)
    assert centered_squares(x, every, Gaussian()) == pytest.approx(whole, rel=0.1)


def test_the_result_does_not_depend_on_threads(monkeypatch):
    x, (segment, unit) = unit_rows(1, 700, 16), layout(1, 700, units=9)
    blocks = []
    for threads in (1, 5):
        monkeypatch.setattr("palpate.metrics.inputs.blas_threads", lambda n=threads: n)
        swept = blocked_sums(x, segment, unit, segments=3, kernel=Gaussian(), block=64)
        blocks.append(swept.block)
    np.testing.assert_array_equal(*blocks)


@pytest.mark.parametrize("estimator", ["unbiased", "biased"])
@pytest.mark.parametrize("sizes", [(2, 2), (4, 4), (5, 4)])
def test_the_sd_of_random_halves_is_that_of_all_halvings(estimator, sizes):
    n = sum(sizes)
    x = unit_rows(6, n, 8)
    x[0] = x[1]
    parts = [np.isin(np.arange(n), half) for half in itertools.combinations(range(n), sizes[0])]
    values = [mmd2(x[h], x[~h], estimator=estimator, backend="blocked") for h in parts]
    spread = np.array([centered_squares(x, np.arange(n), Gaussian())])
    sd = random_halves_sd(spread, np.array([n]), estimator, 1000.0)[0]
    assert sd == pytest.approx(np.std(values), rel=1e-6 if n % 2 == 0 else 0.03)
    if estimator == "unbiased":  # random halves carry no signal
        if sizes[0] == sizes[1]:
            assert np.mean(values) == pytest.approx(0, abs=1e-10)
    elif sizes[0] - sizes[1] < 2:
        score = i_tmmd(x, preset="cmmd")
        mean = np.mean(values)
        assert score.details["dispersion"] == pytest.approx(mean, abs=1e-9)
        assert score.null == pytest.approx((mean - 1.96 * sd, mean + 1.96 * sd))


def test_identical_sets_score_0_and_antipodal_ones_the_ceiling():
    x = unit_rows(9, 30, 6)
    assert mmd2(x, x, estimator="biased") == pytest.approx(0, abs=1e-10)
    one = np.tile(x[:1], (5, 1))
    assert mmd2(one, one[:3]) == 0
    assert mmd2(one, -one) == pytest.approx(2000 * (1 - math.exp(-4 / 200)), abs=1e-9)
    y = unit_rows(8, 400, 64) + 0.05 * np.arange(64) / 64
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    x = unit_rows(7, 400, 64)
    gap = ((x.mean(0) - y.mean(0)) ** 2).sum()
    assert mmd2(x, y, estimator="biased") == pytest.approx(9.90 * gap, rel=0.02)


def two_ends(rows, side, spread=0.1, d=64):
    """Two sets around e_0 and ``side``."""
    rng = np.random.default_rng(5)
    sets = (end + spread * rng.normal(size=(rows, d)) for end in (np.eye(d)[0], side))
    return [(v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32) for v in sets]


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("sigma", [1.0, 6.9, 10.0, (8.0, 10.0, 20.0)])
@pytest.mark.parametrize("case", ["antipodal", "orthogonal", "copies", "near copies", "one source"])
def test_float32_keeps_1e_minus_4_at_scale_1000(library, sigma, case):
    xp = pytest.importorskip(library)
    spread = 1e-4 if case == "near copies" else 0.1
    x, y = two_ends(1200, np.eye(64)[1] if case == "orthogonal" else -np.eye(64)[0], spread)
    if case == "copies":  # a generator that has collapsed to one image
        x[520:] = x[0]
    if case == "one source":
        x, y = unit_rows(0, 700, 256).astype(np.float32), unit_rows(1, 900, 256).astype(np.float32)
    got = mmd2(xp.asarray(x), xp.asarray(y), sigma=sigma, backend="blocked")
    wide = [v.astype(np.float64) for v in (x, y)]
    assert got == pytest.approx(
        mmd2(*wide, sigma=sigma, backend="blocked", normalize=False), abs=1e-4
    )


def spread_rows(seed, n, d, scale=0.4):
    x = 1 + scale * np.random.default_rng(seed).normal(size=(n, d))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@given(
    seed=st.integers(0, 10**6),
    m=st.integers(3, 40),
    n=st.integers(3, 40),
    d=st.integers(1, 9),
    sigma=st.sampled_from([1.0, 3.0, 10.0]),
    estimator=st.sampled_from(["unbiased", "biased", "grouped"]),
    scale=st.sampled_from([0.05, 1.0, 5.0]),
)
@settings(max_examples=60)
def test_moments_are_within_their_bound_of_the_loop(seed, m, n, d, sigma, estimator, scale):
    x, y = spread_rows(seed, m, d, scale), spread_rows(seed + 1, n, d, scale)
    gx, gy = [f"v{k % 3}" for k in range(m)], [f"v{k % 4}" for k in range(n)]
    groups = {"groups": gx, "reference_groups": gy} if estimator == "grouped" else {}
    got = distance(x, y, sigma=sigma, estimator=estimator, backend="moments", **groups)
    truth = loop_mmd(x, y, estimator, gx, gy, sigma)
    assert got.details["backend"] == "moments"
    assert abs(got.value - truth) <= got.details["bound"] + 1e-9


@pytest.mark.parametrize(("rho", "sigma"), [(0.01, 10.0), (0.7, 10.0), (6.0, 0.5), (29.9, 1.0)])
def test_the_bound_is_h_of_rho_times_the_pairs_of_different_samples(rho, sigma):
    x, item = np.random.default_rng(0).normal(size=(13, 4)), np.arange(13) % 3
    x -= x.mean(axis=0)
    x *= sigma * math.sqrt(rho / (x**2).sum(axis=1).max())
    moments = Moments.empty(x.mean(axis=0), sigma, 3)
    moments.add(x, item)
    z = (x - x.mean(axis=0)) / sigma
    u, rho = np.exp(-(z**2).sum(axis=1) / 2), (z**2).sum(axis=1).max()
    h = math.fsum(rho**p / math.factorial(p) for p in range(3, 150)) / rho**2
    slow, exact = np.zeros((2, 3, 3))
    for i, j in itertools.permutations(range(13), 2):
        slow[item[i], item[j]] += h * u[i] * u[j] * (z[i] @ z[j]) ** 2
        exact[item[i], item[j]] += rbf(x[i], x[j], sigma)
    sums, bound = moments.products()
    np.testing.assert_allclose(bound, slow, rtol=1e-9)
    assert (np.abs(sums - exact) <= bound + 1e-10).all()
    moments.rho = WIDEST
    assert moments.products()[1].max() < 1e20
    moments.rho = np.nextafter(WIDEST, np.inf)
    assert (moments.products()[1] > 1e20 * (exact != 0)).all()
    assert remainder_factor(1e-9) == pytest.approx(1e-9 / 6, rel=1e-6)
    assert remainder_factor(0) == 0


def test_moments_add_up_over_batches_and_devices():
    torch = pytest.importorskip("torch")
    x, item = spread_rows(0, 500, 8), np.random.default_rng(0).integers(0, 4, 500)
    whole, batched = (Moments.empty(center_of([x]), 10.0, 4) for _ in range(2))
    whole.add(x, item)
    for k, at in enumerate(np.array_split(np.random.default_rng(1).permutation(500), 7)):
        batched.add(torch.from_numpy(x[at]) if k % 2 else x[at], item[at])
    for a, b in zip(batched.products(), whole.products(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    assert batched.rho == pytest.approx(whole.rho)


@pytest.fixture
def small_moments(monkeypatch):
    monkeypatch.setattr(kernels, "LEAST_ROWS", 100)


def test_auto_takes_moments_where_they_are_cheaper_and_good_enough(small_moments, monkeypatch):
    x, y = spread_rows(0, 300, 8), spread_rows(1, 300, 8)
    exact, got = distance(x, y, backend="blocked"), distance(x, y)
    assert exact.details == {"backend": "blocked", "bound": 0}
    assert got.details["backend"] == "moments"
    assert abs(got.value - exact.value) <= got.details["bound"] <= 1e-4
    for options in ({"sigma": (5.0, 10.0)}, {"kernel": Polynomial()}):
        assert distance(x, y, **options).details["backend"] == "blocked"
    assert distance(x[:30], y[:30]).details["backend"] == "blocked"
    monkeypatch.setattr(kernels, "LONG", 100)
    with pytest.warns(PalpateWarning, match="takes long. Moments were not taken: their bound"):
        distance(x, y, sigma=0.5)


@pytest.mark.parametrize(("sigma", "scale"), [(0.3, 1.0), (0.03, 1.0), (0.003, 1.0), (10.0, 300.0)])
def test_a_bound_that_overflows_is_no_bound(small_moments, sigma, scale):
    centers, rng = unit_rows(0, 20, 8), np.random.default_rng(0)
    x = centers[np.arange(400) % 20] + 1e-3 * rng.normal(size=(400, 8))
    x = (scale * x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)
    options = {"sigma": sigma, "normalize": False}
    exact = distance(x[::2], x[1::2], backend="blocked", **options).value
    got = distance(x[::2], x[1::2], **options)
    assert (got.details["backend"], got.value) == ("blocked", exact)
    fails("wide against the features", distance, x[::2], x[1::2], backend="moments", **options)
    groups = [f"v{k % 20}" for k in range(400)]
    fails("wide against the features", i_tmmd, x, groups=groups, backend="moments", **options)


def test_arrays_on_disk_are_streamed(tmp_path, monkeypatch, small_moments):
    monkeypatch.setattr("palpate.metrics.moments.STREAM", 64)
    monkeypatch.setattr("palpate.metrics.inputs.SLAB", 70)
    x, y = spread_rows(0, 300, 8).astype(np.float32), spread_rows(1, 200, 8).astype(np.float32)
    for name, rows in (("x", x), ("y", y)):
        np.save(tmp_path / f"{name}.npy", rows)
    on_disk = [np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in "xy"]
    for backend in ("moments", "blocked"):
        got = distance(*on_disk, backend=backend)
        assert got.value == pytest.approx(distance(x, y, backend=backend).value, abs=1e-12)
    copies = distance(on_disk[0], x[::-1]).notes
    assert copies == [Note("copied-rows", {"count": 300, "n": 300})]
    private = np.load(tmp_path / "x.npy", mmap_mode="c")
    private[0] = -private[0]
    distance(private, y)
    np.testing.assert_array_equal(private[0], -x[0])  # changes survive


def test_tensors_are_multiplied_in_full_precision_whatever_the_loop_has_set(monkeypatch):
    torch = pytest.importorskip("torch")
    seen, values = [], Gaussian.values

    def watched(*args):
        if args[1].ndim == 2:
            seen.append(torch.get_float32_matmul_precision())
        return values(*args)

    monkeypatch.setattr(Gaussian, "values", watched)
    torch.set_float32_matmul_precision("high")
    try:
        x, one = torch.from_numpy(unit_rows(0, 30, 4)), np.zeros(30, int)
        blocked_sums(x, one, one, segments=1, kernel=Gaussian(), block=10)
        assert set(seen) == {"highest"}
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision("highest")


def test_bandwidths_by_name():
    x, y = unit_rows(0, 30, 5), unit_rows(1, 20, 5)
    middle = median_distance(y)
    upper = np.sqrt(((y[:, None] - y[None]) ** 2).sum(-1))[np.triu_indices(20, 1)]
    assert middle == pytest.approx(np.median(upper))
    assert distance(x, y, sigma="median").bandwidth == pytest.approx(middle)
    multi = distance(x, y, sigma="multi")
    assert multi.bandwidth is None
    assert multi.settings["sigmas"] == pytest.approx([middle * f for f in (0.25, 0.5, 1, 2, 4)])
    each = [mmd2(x, y, sigma=s) for s in multi.settings["sigmas"]]
    assert multi.value == pytest.approx(np.mean(each), abs=1e-9)
    apart = np.sqrt(((y[:10, None] - y[None, 10:]) ** 2).sum(-1))
    groups = ["a"] * 10 + ["b"] * 10
    assert gaussian("median", y, groups).bandwidth == pytest.approx(np.median(apart))
    linear = mmd2(x, y, kernel=LINEAR, estimator="biased", scale=1.0)
    assert linear == pytest.approx(((x.mean(0) - y.mean(0)) ** 2).sum())


X, Y = unit_rows(0, 8, 3), unit_rows(1, 8, 3)


def same_features(x):
    """The same rows as everything that the metrics take."""
    torch = pytest.importorskip("torch")
    ids = [f"generated {k}" for k in range(len(x))]
    tensor = torch.tensor(x, requires_grad=True)
    arrays = (x.astype(">f8"), np.asfortranarray(x))
    return [x.tolist(), list(x), tensor, *arrays, FeatureSet(ids, x)]


def test_arrays_tensors_and_lists_are_taken():
    torch = pytest.importorskip("torch")
    expected = tmmd(X, Y)
    for x in same_features(X):
        assert tmmd(x, Y, ids=range(8)).value == pytest.approx(expected.value, abs=1e-12)
        if not isinstance(x, FeatureSet):
            assert mmd2(x, Y) == pytest.approx(expected.value, abs=1e-12)
    groups = ["a", "a", "b", "b", "c", "c", "d", "d"]
    whole = FeatureSet([str(k) for k in range(8)], X, None, groups, "e" * 64)
    want = tmmd(whole, FeatureSet([f"r{k}" for k in range(8)], Y, None, groups, "e" * 64))
    kinds = (groups, np.array(groups), np.array(groups, dtype=object))
    for kind in kinds:
        got = tmmd(X, torch.tensor(Y), groups=kind, reference_groups=groups, encoder="e" * 64)
        assert (got.value, got.interval, got.details) == (want.value, want.interval, want.details)
    assert i_tmmd(X, groups=torch.arange(8) // 2).value == i_tmmd(X, groups=groups).value
    assert i_tmmd(whole, groups=["v"] * 8).value is None  # a keyword replaces a column
    for half in (X.astype(np.float16), torch.tensor(X).bfloat16()):
        with pytest.warns(PalpateWarning, match="float16 features were widened"):
            assert tmmd(half, Y, normalize=True).value == pytest.approx(expected.value, abs=0.5)
    assert mmd2(3 * X, 0.2 * Y, normalize=True) == pytest.approx(expected.value, abs=1e-9)
    assert mmd2(3 * X, 3 * Y, normalize=False, sigma=30) == pytest.approx(expected.value, abs=1e-9)
    assert mmd2(X * (1 + 5e-4), Y) == pytest.approx(expected.value, abs=0.1)
