"""The blocked MMD against a double loop over pairs, its identities, its float32 error, and what it refuses."""

import itertools
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core import FeatureSet, PalpateError
from palpate.metrics import blocked, i_tmmd, mmd2
from palpate.metrics.arrays import Ops
from palpate.metrics.blocked import blocked_sums
from palpate.metrics.intervals import random_halves_sd
from palpate.metrics.kernels import Gaussian


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
            terms.append(
                math.exp(
                    -sum((float(p) - float(q)) ** 2 for p, q in zip(a[i], b[j], strict=True))
                    / (2 * sigma**2)
                )
            )
        return math.fsum(terms) / len(terms)

    return scale * (
        mean(x, x, gx, gx, True) + mean(y, y, gy, gy, True) - 2 * mean(x, y, gx, gy, False)
    )


def cdist_mmd(x, y, sigma=10.0, scale=1000.0):
    """Unbiased, float64, differences formed explicitly."""
    x, y = x.astype(np.float64), y.astype(np.float64)

    def k(a, b):
        return np.expm1(-np.array([((row - b) ** 2).sum(axis=1) for row in a]) / (2 * sigma**2))

    m, n = len(x), len(y)
    return scale * (
        k(x, x).sum() / (m * (m - 1)) + k(y, y).sum() / (n * (n - 1)) - 2 * k(x, y).mean()
    )


@given(
    seed=st.integers(0, 10**6),
    m=st.integers(3, 9),
    n=st.integers(3, 9),
    d=st.integers(1, 5),
    sigma=st.sampled_from([0.3, 1.0, 10.0]),
    estimator=st.sampled_from(["unbiased", "biased", "grouped"]),
    duplicates=st.booleans(),
    block=st.sampled_from([1, 2, 3, 2048]),
)
@settings(max_examples=120, deadline=None)
def test_equals_the_double_loop(seed, m, n, d, sigma, estimator, duplicates, block):
    x, y = unit_rows(seed, m, d), unit_rows(seed + 1, n, d)
    if duplicates:
        x[1], y[0], y[2] = x[0], x[0], y[1]
    rng = np.random.default_rng(seed)
    gx, gy = [f"v{g}" for g in rng.integers(0, 3, m)], [f"v{g}" for g in rng.integers(0, 4, n)]
    gx[:2], gy[:2] = ["v0", "v1"], ["v2", "v0"]
    groups = {"groups_x": gx, "groups_y": gy} if estimator == "grouped" else {}
    got = mmd2(x, y, sigma=sigma, estimator=estimator, block=block, **groups)
    assert got == pytest.approx(loop_mmd(x, y, estimator, gx, gy, sigma), abs=1e-9)


@given(seed=st.integers(0, 10**6), m=st.integers(2, 12), n=st.integers(2, 12))
@settings(max_examples=40, deadline=None)
def test_small_float32_sets_are_computed_in_float64(seed, m, n):
    x, y = unit_rows(seed, m, 16).astype(np.float32), unit_rows(seed + 1, n, 16).astype(np.float32)
    assert mmd2(x, y) == pytest.approx(loop_mmd(x, y, "unbiased"), abs=1e-9)


@pytest.mark.parametrize(
    ("sigma", "m", "n", "spread"),
    [(10.0, 700, 600, 0.5), (10.0, 1100, 300, 3.0), (4.0, 800, 700, 0.5)],
)
def test_float32_error_is_below_1e_minus_6(sigma, m, n, spread, monkeypatch):
    x, y = (
        unit_rows(1, m, 256, spread).astype(np.float32),
        unit_rows(2, n, 256, spread).astype(np.float32),
    )
    assert m + n > blocked.FLOAT64_BELOW
    dtypes = []
    centered = blocked.centered
    monkeypatch.setattr(
        blocked, "centered", lambda *args: (z := centered(*args), dtypes.append(z.dtype))[0]
    )
    got = mmd2(x, y, sigma=sigma, block=512, backend="blocked")
    assert dtypes == [np.float32]
    truth = cdist_mmd(x, y, sigma)
    assert abs(got - truth) < 1e-6
    k32 = lambda a, b: np.exp(
        -((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * a @ b.T) / np.float32(2 * sigma**2)
    )
    plain = 1000 * (
        (k32(x, x).sum() - m) / (m * (m - 1))
        + (k32(y, y).sum() - n) / (n * (n - 1))
        - 2 * k32(x, y).mean()
    )
    assert abs(plain - truth) > 10 * abs(
        got - truth
    )  # the usual float32 route is worse: the test can tell


def row_sums(x, segment, segments, block=1024):
    return blocked_sums(
        x, segment, np.arange(len(x)), segments=segments, kernel=Gaussian(), block=block
    ).sums


def test_float32_row_sums_keep_their_digits_when_k_is_almost_one():
    x = unit_rows(3, 1100, 64, spread=0.02).astype(
        np.float32
    )  # k - 1 is about -4e-6: exp() in float32 has 5 % error here
    sums = row_sums(x, np.zeros(1100, dtype=int), 1, block=300)
    wide = x.astype(np.float64)
    expected = [np.expm1(-((row - wide) ** 2).sum(axis=1) / 200).sum() for row in wide]
    np.testing.assert_allclose(sums.rows[:, 0], expected, rtol=1e-6)


def test_a_sample_adds_exactly_nothing_against_itself():
    x = unit_rows(4, 1100, 64).astype(np.float32)
    alone = np.minimum(np.arange(1100), 8)  # eight segments of one sample each
    rows = row_sums(x, alone, 9).rows
    assert not rows[np.arange(8), np.arange(8)].any()


def test_a_narrow_kernel_leaves_float32():
    x, y = unit_rows(1, 700, 32).astype(np.float32), unit_rows(2, 700, 32).astype(np.float32)
    assert mmd2(x, y, sigma=0.5) == pytest.approx(cdist_mmd(x, y, 0.5), abs=1e-6)


def test_random_halves_average_to_zero_and_the_biased_form_to_the_dispersion():
    x = unit_rows(3, 8, 5)
    halves = [np.isin(np.arange(8), half) for half in itertools.combinations(range(8), 4)]
    assert len(halves) == 70
    assert np.mean([mmd2(x[h], x[~h]) for h in halves]) == pytest.approx(0, abs=1e-11)
    k = np.exp(-((x[:, None] - x[None]) ** 2).sum(-1) / 200)
    kbar = (k.sum() - 8) / 56
    assert np.mean([mmd2(x[h], x[~h], estimator="biased") for h in halves]) == pytest.approx(
        4 / 8 * 1000 * (1 - kbar), abs=1e-10
    )


def test_biased_minus_unbiased_is_the_published_gap():
    x, y = unit_rows(4, 12, 6), unit_rows(5, 7, 6)
    mean_k = lambda a: (
        (np.exp(-((a[:, None] - a[None]) ** 2).sum(-1) / 200).sum() - len(a))
        / (len(a) * (len(a) - 1))
    )
    gap = 1000 * ((1 - mean_k(x)) / 12 + (1 - mean_k(y)) / 7)
    assert mmd2(x, y, estimator="biased") - mmd2(x, y) == pytest.approx(gap, abs=1e-9)


@pytest.mark.parametrize("estimator", ["unbiased", "biased"])
@pytest.mark.parametrize("sizes", [(2, 2), (3, 2), (3, 3), (4, 4), (5, 4), (5, 3), (5, 5)])
def test_closed_form_sd_of_random_halves_is_that_of_all_halvings(estimator, sizes):
    n = sum(sizes)
    x = unit_rows(6, n, 8)
    x[0] = x[1]
    parts = [np.isin(np.arange(n), half) for half in itertools.combinations(range(n), sizes[0])]
    values = [mmd2(x[h], x[~h], estimator=estimator) for h in parts]
    one = np.zeros(n, dtype=int)
    spread = blocked_sums(
        x, one, np.arange(n), segments=1, kernel=Gaussian(), block=7, spread=[np.arange(1)]
    ).spread
    found = random_halves_sd(spread, np.array([sizes]), estimator, 1000.0)[0]
    assert found == pytest.approx(np.std(values), rel=1e-9)
    if estimator == "biased":  # and what they average
        score = i_tmmd(FeatureSet([str(i) for i in range(n)], x), preset="cmmd")
        if sizes[0] - sizes[1] < 2:
            assert score.details["dispersion"] == pytest.approx(np.mean(values), abs=1e-9)
            assert score.null == pytest.approx(
                (np.mean(values) - 1.96 * found, np.mean(values) + 1.96 * found)
            )


@pytest.mark.parametrize("sigma", [2.1, 2.5, 5.0, 10.0])
@pytest.mark.parametrize("m", [2, 5, 20, 512])
def test_float32_keeps_its_promise_in_a_small_set_beside_a_large_one(sigma, m):
    rng = np.random.default_rng(m)
    x, y = rng.normal(size=(m, 64)) + 0.3 * rng.normal(size=64), rng.normal(size=(1500, 64))
    x, y = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (x, y))
    x, y = x.astype(np.float32), y.astype(np.float32)
    exact = mmd2(
        x.astype(np.float64), y.astype(np.float64), sigma=sigma, backend="blocked", normalize=False
    )
    assert mmd2(x, y, sigma=sigma, backend="blocked") == pytest.approx(exact, abs=1e-6)


def test_is_about_ten_times_the_squared_distance_of_the_means():
    x, y = unit_rows(7, 400, 64), unit_rows(8, 300, 64)
    y += 0.05 * np.arange(64) / 64
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    gap = ((x.mean(0) - y.mean(0)) ** 2).sum()
    assert mmd2(x, y, estimator="biased") == pytest.approx(9.90 * gap, rel=0.02)


def test_identical_sets_and_the_antipodal_ceiling():
    x = unit_rows(9, 30, 6)
    assert mmd2(x, x, estimator="biased") == pytest.approx(0, abs=1e-10)
    one = np.tile(x[:1], (5, 1))
    assert mmd2(one, one[:3]) == 0
    assert mmd2(one, -one) == pytest.approx(2000 * (1 - math.exp(-4 / 200)), abs=1e-9)


def test_normalize_true_equals_normalized_rows():
    x, y = unit_rows(1, 10, 4), unit_rows(2, 10, 4)
    assert mmd2(3 * x, 0.2 * y, normalize=True) == pytest.approx(mmd2(x, y), abs=1e-9)
    assert mmd2(3 * x, 3 * y, normalize=False, sigma=30.0) == pytest.approx(mmd2(x, y), abs=1e-9)


def test_float16_is_widened_with_a_warning_and_lists_are_taken():
    x, y = unit_rows(1, 40, 4), unit_rows(2, 40, 4)
    with pytest.warns(UserWarning, match="float16"):
        got = mmd2(x.astype(np.float16), y.astype(np.float16))
    assert got == pytest.approx(mmd2(x, y), abs=5e-3)
    assert got != 0
    assert mmd2(x.tolist(), y.tolist()) == mmd2(x, y)


def bad(x, **change):
    x = x.copy()
    for row, value in change.items():
        x[int(row[1:])] = value
    return x


X = unit_rows(0, 8, 3)


@pytest.mark.parametrize(
    ("x", "y", "options", "words"),
    [
        (bad(X, r3=np.nan), X, {}, ["finite", "1 row (3)"]),
        (X, bad(X, r1=np.inf, r6=-np.inf), {}, ["finite", "2 rows (1, 6)"]),
        (X[:1], X, {}, ["at least 2 rows", "1"]),
        (X[:0], X, {"estimator": "biased"}, ["at least 1 rows"]),
        (X, X[:, :2], {}, ["same width", "3 and 2"]),
        (np.ones((5, 3), dtype=int), X, {}, ["floating-point", "int64"]),
        (X.astype(bool), X, {}, ["floating-point", "bool"]),
        (X[0], X, {}, ["shape (n, d)", "(3,)"]),
        (bad(X, r2=0.0), X, {}, ["zero vector", "1 row (2)"]),
        (bad(X, r2=0.0), X, {"normalize": True}, ["zero vector"]),
        (2 * X, X, {}, ["L2-normalized", "norm 2", "8 rows"]),
        ([[1.0, 0.0], [1.0]], X, {}, ["`x` must turn into an array"]),
        (X, X, {"normalize": "yes"}, ["normalize"]),
        (X, X, {"estimator": "grouped"}, ["groups of both sets"]),
        (
            X,
            X,
            {"estimator": "grouped", "groups_x": ["a"] * 8, "groups_y": ["b"] * 8},
            ["two groups", "1 and 1"],
        ),
        (
            X,
            X,
            {"estimator": "grouped", "groups_x": ["a"] * 7, "groups_y": ["b"] * 8},
            ["groups_x", "8", "7"],
        ),
        (
            X,
            X,
            {"estimator": "grouped", "groups_x": ["a"] * 7 + [None], "groups_y": ["b"] * 8},
            ["groups_x", "1 row (7)"],
        ),
        (X, X, {"estimator": "best"}, ["estimator", "best"]),
        (X, X, {"sigma": 0.0}, ["sigma", "positive"]),
        (X, X, {"scale": math.nan}, ["scale", "positive"]),
    ],
)
def test_refuses_bad_input_and_says_where(x, y, options, words):
    with pytest.raises(PalpateError) as caught:
        mmd2(x, y, **options)
    for word in words:
        assert word in str(caught.value)


def test_cpu_tensors_are_taken():
    torch = pytest.importorskip("torch")
    x = torch.from_numpy(X)
    assert mmd2(x, torch.from_numpy(X[:5])) == mmd2(X, X[:5])
    assert mmd2(x.requires_grad_(), X[:5]) == mmd2(X, X[:5])
    with pytest.warns(UserWarning, match="bfloat16"):
        assert mmd2(x.bfloat16(), X[:5], normalize=True) == pytest.approx(mmd2(X, X[:5]), abs=0.5)


def test_import_needs_no_torch():
    code = "import sys, palpate.metrics; sys.exit(any(m in sys.modules for m in ('torch', 'polars', 'PIL')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("least", [0.01, 0.02, 0.1, 0.13])
def test_the_series_of_expm1_has_no_direction(least):
    x = (-least * np.random.default_rng(0).random((300, 700))).astype(np.float32)
    exact = np.expm1(x.astype(np.float64))
    found = Ops().expm1_(x.copy(), -least)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, exact, rtol=3e-7, atol=3e-11)
    assert (
        abs((found - exact).mean()) < 2e-10 + 2e-9 * least
    )  # NumPy's own errs by 5e-10 on some machines
    x[0, 0] = -3
    np.testing.assert_allclose(Ops().expm1_(x.copy(), -3.0), np.expm1(x), rtol=1e-6)


@pytest.mark.parametrize("sigma", [8.0, 10.0])
@pytest.mark.parametrize("rows", [(3000, 3000), (600, 1100)])
def test_float32_keeps_its_promise_where_two_sets_are_far_apart(sigma, rows):
    rng = np.random.default_rng(3)
    x, y = (
        rng.normal(size=(n, 64)) + side * np.eye(64)[0] * 4
        for n, side in zip(rows, (1, -1), strict=True)
    )
    x, y = ((v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32) for v in (x, y))
    exact = mmd2(
        x.astype(np.float64), y.astype(np.float64), sigma=sigma, backend="blocked", normalize=False
    )
    assert exact > 5
    assert mmd2(x, y, sigma=sigma, backend="blocked") == pytest.approx(exact, abs=1e-6)
