"""The pass over the pairs: both back ends, every kernel and every layout against loops over pairs."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core import FeatureSet, PalpateError
from palpate.metrics import Gaussian, Linear, Polynomial, distance, four_scores, i_tmmd, mmd2
from palpate.metrics import blocked as blocked_module
from palpate.metrics import engine as engine_module
from palpate.metrics.arrays import ArrayApiOps, Ops, ops_of
from palpate.metrics.blocked import blocked_sums, centered_squares
from palpate.metrics.engine import kernel_sums
from palpate.metrics.kernels import gaussian, median_distance
from palpate.metrics.moments import Moments, center_of, rest_factor
from palpate.metrics.sums import PairSums
from test_metrics_mmd import loop_mmd, unit_rows


def loop_sums(x, segment, unit, segments, k):
    """Sums over pairs i != j by segment, all and inside units, one pair at a time."""
    rows, same = np.zeros((segments, segments)), np.zeros((segments, segments))
    for i in range(len(x)):
        for j in range(len(x)):
            if i != j:
                value = k(x[i].astype(np.float64), x[j].astype(np.float64))
                rows[segment[i], segment[j]] += value
                same[segment[i], segment[j]] += value * (unit[i] == unit[j])
    return rows, same


def layout(seed, n, segments=3, units=5):
    rng = np.random.default_rng(seed)
    return rng.integers(0, segments, n), rng.integers(0, units, n)


KERNELS = {
    "gaussian": (Gaussian((2.0,)), lambda a, b: np.expm1(-((a - b) ** 2).sum() / 8)),
    "several": (
        Gaussian((1.0, 3.0)),
        lambda a, b: np.mean([np.expm1(-((a - b) ** 2).sum() / (2 * s * s)) for s in (1, 3)]),
    ),
    "polynomial": (Polynomial(), lambda a, b: (a @ b / len(a) + 1) ** 3),
    "quadratic": (Polynomial(2, 0.5, 0.25), lambda a, b: (0.5 * a @ b + 0.25) ** 2),
    "linear": (Linear(), lambda a, b: a @ b),
}


@pytest.mark.parametrize("name", KERNELS)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 24),
    units=st.sampled_from([1, 3, 30]),
    block=st.sampled_from([3, 1024]),
)
@settings(max_examples=15, deadline=None)
def test_sums_equal_the_double_loop(name, seed, n, units, block):
    kernel, k = KERNELS[name]
    x, (segment, unit) = unit_rows(seed, n, 4), layout(seed, n, units=units)
    found = blocked_sums(x, segment, unit, segments=3, kernel=kernel, block=block).sums
    rows, same = loop_sums(x, segment, unit, 3, k)
    np.testing.assert_allclose(found.totals.sums, rows, atol=1e-10)
    np.testing.assert_allclose(found.totals.same, same, atol=1e-10)
    np.testing.assert_allclose(
        found.totals.own,
        [sum(k(x[i], x[i]) for i in np.flatnonzero(segment == s)) for s in range(3)],
        atol=1e-10,
    )
    if found.block is not None:
        item = found.segment * 1000 + found.unit
        at = [np.flatnonzero(segment * 1000 + unit == one) for one in item]
        slow = [[sum(k(x[i], x[j]) for i in a for j in b if i != j) for b in at] for a in at]
        np.testing.assert_allclose(found.block, slow, atol=1e-10)


@pytest.mark.parametrize(("most", "expected"), [(0, None), (2048, (15, 15))])
def test_items_and_rows_give_the_same_sums(most, expected, monkeypatch):
    monkeypatch.setattr(blocked_module, "MOST_ITEMS", most)
    x, (segment, unit) = unit_rows(0, 90, 6), layout(0, 90)
    found = blocked_sums(x, segment, unit, segments=3, kernel=Gaussian(), block=20).sums
    assert (None if found.block is None else found.block.shape) == expected
    rows, same = loop_sums(x, segment, unit, 3, lambda a, b: np.expm1(-((a - b) ** 2).sum() / 200))
    np.testing.assert_allclose(found.totals.sums, rows, atol=1e-12)
    np.testing.assert_allclose(found.totals.same, same, atol=1e-12)
    left = list(found.leave_one_out())
    for u, without in zip(found.unit_order, left, strict=True):
        keep = unit != u
        rows, same = loop_sums(
            x[keep],
            segment[keep],
            unit[keep],
            3,
            lambda a, b: np.expm1(-((a - b) ** 2).sum() / 200),
        )
        np.testing.assert_allclose(without.sums, rows, atol=1e-12)
        np.testing.assert_allclose(without.same, same, atol=1e-12)
        np.testing.assert_array_equal(without.n, np.bincount(segment[keep], minlength=3))


def test_the_result_does_not_depend_on_threads(monkeypatch):
    x, (segment, unit) = unit_rows(1, 700, 16), layout(1, 700, units=9)
    run = lambda: blocked_sums(x, segment, unit, segments=3, kernel=Gaussian(), block=64).sums.block  # noqa: E731
    monkeypatch.setattr("palpate.metrics.arrays.blas_threads", lambda: 1)
    one = run()
    monkeypatch.setattr("palpate.metrics.arrays.blas_threads", lambda: 5)
    np.testing.assert_array_equal(run(), one)


def test_centered_squares_are_those_of_the_centered_matrix():
    x = unit_rows(2, 40, 5)
    k = np.expm1(-((x[:, None] - x[None]) ** 2).sum(-1) / 2)
    h = np.eye(40) - 1 / 40
    slow = h @ k @ h
    own = np.diagonal(slow)
    expect = ((slow**2).sum() - (own**2).sum(), own.sum(), (own**2).sum())
    assert centered_squares((k**2).sum(), k.sum(axis=1)) == pytest.approx(expect, rel=1e-10)
    got = blocked_sums(
        x,
        np.zeros(40, int),
        np.arange(40) % 7,
        segments=1,
        kernel=Gaussian((1.0,)),
        block=9,
        spread=[np.arange(1)],
    )
    assert got.spread[0] == pytest.approx(expect, rel=1e-10)


def spread_rows(seed, n, d, scale=0.4):
    x = 1 + scale * np.random.default_rng(seed).normal(size=(n, d))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@given(
    seed=st.integers(0, 10**6),
    m=st.integers(3, 60),
    n=st.integers(3, 60),
    d=st.integers(1, 9),
    sigma=st.sampled_from([1.0, 3.0, 10.0]),
    estimator=st.sampled_from(["unbiased", "biased", "grouped"]),
    scale=st.sampled_from([0.05, 1.0, 5.0]),
)
@settings(max_examples=80, deadline=None)
def test_moments_are_within_their_bound_of_the_loop(seed, m, n, d, sigma, estimator, scale):
    x, y = spread_rows(seed, m, d, scale), spread_rows(seed + 1, n, d, scale)
    gx, gy = [f"v{k % 3}" for k in range(m)], [f"v{k % 4}" for k in range(n)]
    groups = {"groups_x": gx, "groups_y": gy} if estimator == "grouped" else {}
    got = distance(x, y, sigma=sigma, estimator=estimator, backend="moments", **groups)
    truth = loop_mmd(x, y, estimator, gx, gy, sigma)
    assert got.backend == "moments"
    assert abs(got.value - truth) <= got.bound + 1e-9
    assert distance(x, y, sigma=sigma, estimator=estimator, backend="blocked", **groups).bound == 0


def test_the_bound_is_tight_enough_to_be_of_use():
    x, y = spread_rows(0, 400, 24), spread_rows(1, 300, 24) + 0.02
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    exact, got = distance(x, y, backend="blocked"), distance(x, y, backend="moments")
    error = abs(got.value - exact.value)
    assert error <= got.bound < 1e-4
    assert rest_factor(0.01) == pytest.approx((np.exp(0.01) - 1 - 0.01 - 5e-5) / 1e-4, rel=1e-6)
    assert rest_factor(1e-9) == pytest.approx(1e-9 / 6, rel=1e-6)
    assert rest_factor(0) == 0


def test_float32_moments_keep_1e_minus_6_beside_their_bound():
    x, y = spread_rows(0, 3000, 64).astype(np.float32), spread_rows(1, 2000, 64).astype(np.float32)
    y += np.float32(0.01)
    got = distance(x, y, normalize=True, backend="moments")
    assert (
        abs(
            got.value
            - distance(
                x.astype(np.float64), y.astype(np.float64), normalize=True, backend="blocked"
            ).value
        )
        <= got.bound + 1e-6
    )


def test_moments_add_up_over_batches_and_processes():
    x, item = spread_rows(0, 500, 8), np.random.default_rng(0).integers(0, 4, 500)
    whole = Moments.empty(center_of([x]), 10.0, 4)
    whole.add(x, item)
    parts = []
    for at in np.array_split(np.random.default_rng(1).permutation(500), 7):
        part = Moments.empty(whole.center, 10.0, 4)
        part.add(x[at], item[at])
        parts.append(part)
    merged = parts[0].merge(parts[1:])
    for a, b in zip(merged.products(), whole.products(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    assert merged.rho == whole.rho
    with pytest.raises(PalpateError, match="share center"):
        whole.merge([Moments.empty(whole.center, 5.0, 4)])
    exact = blocked_sums(x, item, item, segments=4, kernel=Gaussian()).sums
    sums = merged.sums(np.arange(4), np.arange(4), 4)
    assert (np.abs(sums.totals.sums - exact.totals.sums) <= sums.bound.totals.sums + 1e-12).all()
    assert sums.bound.totals.sums.max() > 0


def test_spread_from_moments_is_right_to_leading_order():
    x = spread_rows(3, 300, 12)
    exact = blocked_sums(
        x, np.zeros(300, int), np.arange(300), segments=1, kernel=Gaussian(), spread=[np.arange(1)]
    ).spread[0]
    moments = Moments.empty(
        np.zeros(12), 10.0, 1
    )  # a poor center: only the leading order is lost, not the value
    moments.add(x)
    found = moments.spread(np.arange(1))
    assert found[:2] == pytest.approx(tuple(exact[:2]), rel=0.03)
    assert found[2] == pytest.approx(exact[2], rel=0.2)  # it counts a hundredth of the others here


@pytest.fixture
def calls(monkeypatch):
    """Names of the back ends that were tried."""
    tried = []
    for name in ("_moments", "blocked_sums"):
        real = getattr(engine_module, name)
        monkeypatch.setattr(
            engine_module,
            name,
            lambda *a, _n=name, _r=real, **k: (tried.append(_n), _r(*a, **k))[1],
        )
    monkeypatch.setattr(engine_module, "LEAST_ROWS", 100)
    return tried


def test_auto_takes_moments_where_they_are_cheaper_and_good_enough(calls, monkeypatch):
    x, y = spread_rows(0, 300, 8), spread_rows(1, 300, 8)
    assert (distance(x, y).backend, calls) == ("moments", ["_moments"])
    calls.clear()
    assert (distance(x, y, tolerance=0).backend, calls) == ("blocked", ["_moments", "blocked_sums"])
    for options in ({"sigma": (5.0, 10.0)}, {"kernel": Polynomial()}, {"backend": "blocked"}):
        calls.clear()
        assert (distance(x, y, **options).backend, calls) == ("blocked", ["blocked_sums"])
    calls.clear()
    assert distance(x[:30], y[:30]).backend == "blocked"
    assert calls == ["blocked_sums"]
    monkeypatch.setattr(engine_module, "LONG", 100)
    with pytest.warns(UserWarning, match="takes long. Moments were not taken: they would leave"):
        distance(x, y, tolerance=0)
    with pytest.warns(UserWarning, match="takes long. Moments were not taken: the kernel is"):
        distance(x, y, sigma=(5.0, 10.0))


def features_of(x, prefix, videos=10):
    names = [f"{prefix}{k}" for k in range(len(x))]
    return FeatureSet(
        names,
        x,
        [f"c{k % 3}" for k in range(len(x))],
        [f"{prefix}v{k % videos}" for k in range(len(x))],
    )


def test_the_four_metrics_take_moments_within_the_tolerance_and_blocks_beyond(calls):
    g, r = (
        features_of(spread_rows(0, 240, 8), "a", 12),
        features_of(spread_rows(1, 240, 8), "b", 12),
    )
    easy = four_scores(g, r, permutations=0)
    assert set(calls) == {"_moments"}
    assert {s.details["backend"] for s in easy} == {"moments"}
    worst = max(s.details["bound"] for s in easy)
    assert 0 < worst <= 1e-4
    calls.clear()
    hard = four_scores(g, r, permutations=0, tolerance=easy[0].details["bound"] / 2)
    assert calls == ["_moments", "blocked_sums"]
    assert {s.details["backend"] for s in hard} == {"blocked"}
    for a, b in zip(easy, hard, strict=True):
        assert abs(a.value - b.value) <= a.details["bound"] + 1e-9
    one = easy[1].details
    assert abs(one["E"] - hard[1].details["E"]) <= one["E_bound"] + 1e-9
    calls.clear()
    assert (
        four_scores(g, r, permutations=0, scale=1.0, tolerance=1e-4)[0].details["backend"]
        == "moments"
    )
    assert (
        four_scores(g, r, permutations=0, scale=1.0, tolerance=easy[0].details["bound"] / 2)[
            0
        ].details["backend"]
        == "blocked"
    )  # tolerances are at scale 1000


@pytest.mark.parametrize(
    ("sigma", "scale"), [(0.3, 1.0), (0.05, 1.0), (0.03, 1.0), (0.003, 1.0), (10.0, 300.0)]
)
def test_a_bound_that_overflows_is_no_bound(calls, sigma, scale):
    rng = np.random.default_rng(0)
    centers = unit_rows(0, 20, 8)
    x = centers[np.arange(400) % 20] + 1e-3 * rng.normal(size=(400, 8))
    x = scale * x / np.linalg.norm(x, axis=1, keepdims=True)
    options = {"sigma": sigma, "normalize": False}
    got = distance(x[::2], x[1::2], **options)
    assert got.backend == "blocked"
    assert got.value == pytest.approx(distance(x[::2], x[1::2], backend="blocked", **options).value)
    with pytest.raises(PalpateError, match="wide against the features"):
        distance(x[::2], x[1::2], backend="moments", **options)
    one = features_of(x, "a", 20)
    exact, forced = (
        i_tmmd(one, backend="blocked", **options),
        i_tmmd(one, backend="moments", **options),
    )
    assert i_tmmd(one, **options).value == exact.value
    assert forced.value is None
    assert "do not bound" in forced.note


@pytest.mark.parametrize("sigma", ["median", "multi"])
def test_the_median_is_that_of_the_rows_that_are_scored(sigma):
    g, r = features_of(spread_rows(0, 60, 5), "a"), features_of(spread_rows(1, 60, 5), "b")
    far = [dataclasses.replace(s, features=30 * s.features) for s in (g, r)]
    plain, scaled = (
        four_scores(*sets, floor=sets[1], sigma=sigma, normalize=True, permutations=0)
        for sets in ((g, r), far)
    )
    for a, b in zip(plain, scaled, strict=True):
        assert (a.value, a.floor) == (
            pytest.approx(b.value, abs=1e-9),
            pytest.approx(b.floor, abs=1e-9) if b.floor is not None else None,
        )


def test_more_refusals():
    x = unit_rows(0, 12, 3)
    for options, words in (
        ({"tolerance": -1}, "tolerance"),
        ({"tolerance": float("nan")}, "tolerance"),
        ({"sigma": None}, "sigma"),
        ({"block": 1.5}, "block"),
        ({"groups_x": ["a"]}, "groups_x"),
        ({"groups_y": ["a"] * 3, "sigma": "median"}, "groups_y"),
    ):
        with pytest.raises(PalpateError, match=words):
            distance(x, x[::-1], **options)
    one = features_of(x, "a", 3)
    for options, words in (
        ({"permutations": 1.5}, "whole number"),
        ({"sigmaa": 3}, "sigmaa"),
        ({"tolerance": -1}, "tolerance"),
        ({"seed": "a"}, "seed"),
    ):
        with pytest.raises(PalpateError, match=words):
            i_tmmd(one, **options)
    assert mmd2(x.astype(">f8"), x[:5]) == mmd2(x, x[:5])
    assert mmd2(np.asfortranarray(x), x[::-1][:5]) == pytest.approx(
        mmd2(x, x[::-1][:5].copy()), abs=1e-12
    )
    assert mmd2(x, x[:5], sigma=np.array(10.0)) == mmd2(x, x[:5])
    slack = x * (1 + 5e-3)
    with pytest.raises(PalpateError, match="L2-normalized"):
        mmd2(slack, x)
    assert np.isfinite(mmd2(x * (1 + 5e-4), x))


def test_copies_are_found_on_disk_and_in_large_sets(tmp_path, monkeypatch):
    monkeypatch.setattr("palpate.metrics.inputs.SLAB", 7)
    x = unit_rows(0, 40, 3)
    np.save(tmp_path / "x.npy", x)
    with pytest.warns(UserWarning, match="40 rows of x"):
        distance(np.load(tmp_path / "x.npy", mmap_mode="r"), x[::-1])


def test_changes_in_a_private_map_survive(tmp_path):
    x = unit_rows(0, 40, 3)
    np.save(tmp_path / "x.npy", x)
    mapped = np.load(tmp_path / "x.npy", mmap_mode="c")
    mapped[0] = -mapped[0]
    FeatureSet([str(k) for k in range(40)], mapped)
    distance(mapped, x[5:])
    np.testing.assert_array_equal(mapped[0], -x[0])


@pytest.mark.parametrize(
    "options",
    [
        {"sigma": (5.0, 10.0)},
        {"kernel": Linear()},
        {"groups_x": range(40), "groups_y": range(40), "estimator": "grouped"},
    ],
)
def test_moments_are_refused_where_there_are_none(options, monkeypatch):
    monkeypatch.setattr(engine_module, "MOMENT_BYTES", 1000)
    x = spread_rows(0, 40, 8)
    with pytest.raises(PalpateError, match="one Gaussian"):
        distance(x, x[::-1], backend="moments", **options)


def test_arrays_on_disk_are_streamed(tmp_path, monkeypatch):
    monkeypatch.setattr(engine_module, "LEAST_ROWS", 100)
    monkeypatch.setattr(engine_module, "STREAM", 64)
    x, y = spread_rows(0, 300, 8).astype(np.float32), spread_rows(1, 200, 8).astype(np.float32)
    for name, rows in (("x", x), ("y", y)):
        np.save(tmp_path / f"{name}.npy", rows)
    on_disk = [np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in "xy"]
    assert all(isinstance(a, np.memmap) for a in on_disk)
    got = distance(*on_disk)
    assert got.backend == "moments"
    assert got.value == pytest.approx(distance(x, y).value, abs=1e-12)
    assert distance(*on_disk, backend="blocked").value == pytest.approx(
        distance(x, y, backend="blocked").value, abs=1e-12
    )


@pytest.mark.parametrize("kernel", [Gaussian(), Gaussian((1.0, 4.0)), Polynomial(), Linear()])
def test_another_array_library_gives_the_same_sums(kernel):
    torch = pytest.importorskip("torch")
    pytest.importorskip("array_api_compat")
    x, (segment, unit) = unit_rows(0, 80, 6), layout(0, 80)
    assert isinstance(ops_of(torch.from_numpy(x)), ArrayApiOps)
    assert type(ops_of(x)) is Ops
    run = lambda a: blocked_sums(
        a, segment, unit, segments=3, kernel=kernel, block=30, spread=[np.arange(2)]
    )
    one, other = run(x), run(torch.from_numpy(x))
    np.testing.assert_allclose(other.sums.block, one.sums.block, atol=1e-10)
    np.testing.assert_allclose(other.sums.own, one.sums.own, atol=1e-10)
    np.testing.assert_allclose(other.spread, one.spread, rtol=1e-9)
    if kernel == Gaussian():
        found = []
        for a in (x, torch.from_numpy(x)):
            moments = Moments.empty(x.mean(axis=0), 10.0, 3)
            moments.add(a, segment)
            found.append(moments.products()[0])
        np.testing.assert_allclose(found[1], found[0], atol=1e-10)


def test_tensors_are_multiplied_in_full_precision_whatever_the_loop_has_set(monkeypatch):
    torch = pytest.importorskip("torch")
    pytest.importorskip("array_api_compat")
    seen = []
    values = Gaussian.values
    monkeypatch.setattr(
        Gaussian,
        "values",
        lambda *args: (seen.append(torch.get_float32_matmul_precision()), values(*args))[1],
    )
    x = torch.from_numpy(unit_rows(0, 30, 4))
    torch.set_float32_matmul_precision("high")
    try:
        blocked_sums(
            x, np.zeros(30, int), np.zeros(30, int), segments=1, kernel=Gaussian(), block=10
        )
        assert set(seen) == {"highest"}
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision("highest")


def test_kernels_of_other_names():
    x, y = unit_rows(0, 30, 5), unit_rows(1, 20, 5)
    middle = median_distance(y)
    upper = np.sqrt(((y[:, None] - y[None]) ** 2).sum(-1))[np.triu_indices(20, 1)]
    assert middle == pytest.approx(np.median(upper))
    assert distance(x, y, sigma="median").bandwidth == pytest.approx(middle)
    multi = distance(x, y, sigma="multi")
    assert multi.bandwidth is None
    assert multi.kernel["sigmas"] == pytest.approx([middle * f for f in (0.25, 0.5, 1, 2, 4)])
    assert multi.value == pytest.approx(
        np.mean([mmd2(x, y, sigma=s) for s in multi.kernel["sigmas"]]), abs=1e-9
    )
    groups = ["a"] * 10 + ["b"] * 10
    apart = np.sqrt(((y[:10, None] - y[None, 10:]) ** 2).sum(-1))
    assert gaussian("median", y, groups).bandwidth == pytest.approx(np.median(apart))
    assert mmd2(x, y, kernel=Linear(), estimator="biased", scale=1.0) == pytest.approx(
        ((x.mean(0) - y.mean(0)) ** 2).sum()
    )
    for wrong in ("mean", (), (1.0, -1.0)):
        with pytest.raises(PalpateError, match="sigma must be"):
            mmd2(x, y, sigma=wrong)
    with pytest.raises(PalpateError, match="rows that differ"):
        mmd2(x, np.tile(y[:1], (20, 1)), sigma="median")


def test_kid_is_the_polynomial_of_float32_features_to_many_digits():
    x, y = np.random.default_rng(0).normal(size=(2, 600, 64)).astype(np.float32)
    a, b = x.astype(np.float64), y.astype(np.float64)
    k = lambda p, q: (p @ q.T / 64 + 1) ** 3  # noqa: E731
    off = lambda m: (m.sum() - np.trace(m)) / (600 * 599)  # noqa: E731
    truth = off(k(a, a)) + off(k(b, b)) - 2 * k(a, b).mean()
    assert mmd2(x, y, kernel=Polynomial(), scale=1.0, normalize=False) == pytest.approx(
        truth, rel=1e-9
    )


def test_merging_segments_merges_everything():
    x, (segment, unit) = unit_rows(5, 60, 4), layout(5, 60)
    found = blocked_sums(x, segment, unit, segments=3, kernel=Polynomial()).sums
    to = np.array([1, -1, 0])
    keep = segment != 1
    direct = blocked_sums(
        x[keep], to[segment[keep]], unit[keep], segments=2, kernel=Polynomial()
    ).sums
    merged = found.merge(to, 2)
    for name in ("n", "sums", "same", "pairs", "own"):
        np.testing.assert_allclose(
            getattr(merged.totals, name), getattr(direct.totals, name), atol=1e-9
        )
    np.testing.assert_allclose(found.totals.merge(to, 2).sums, direct.totals.sums, atol=1e-9)
    assert isinstance(merged, PairSums)


def test_too_few_rows_for_a_kernel_sum_are_no_error():
    empty = kernel_sums(
        [unit_rows(0, 1, 3)],
        np.zeros(1, int),
        np.zeros(1, int),
        segments=2,
        kernel=Gaussian(),
        bound=lambda _: 0.0,
    )
    assert not empty.sums.rows.any()
