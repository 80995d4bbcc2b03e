"""float32 keeps 1e-6 at scale 1000 where it is taken, and is not taken elsewhere: far sets, several bandwidths, other libraries, own kernels."""

import numpy as np
import pytest

from palpate.core import PalpateError
from palpate.metrics import Gaussian, Linear, Polynomial, blocked, distance, mmd2
from palpate.metrics.arrays import Ops, ops_of
from test_metrics_mmd import unit_rows


def two_ends(rows, side, spread, d=64):
    """Two sets in the directions e_0 and ``side``, with some spread."""
    rng = np.random.default_rng(5)
    sets = (end + spread * rng.normal(size=(rows, d)) for end in (np.eye(d)[0], side))
    return [(v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32) for v in sets]


def taken(monkeypatch):
    """Types that features have when they are multiplied."""
    types, centered = [], blocked.centered
    monkeypatch.setattr(
        blocked, "centered", lambda *args: (z := centered(*args), types.append(z.dtype))[0]
    )
    return types


@pytest.mark.parametrize("least", [0.004, 0.01, 0.02, 0.04, 0.08, 0.129])
def test_the_series_of_expm1_is_right_where_all_pairs_lie_at_its_end(least):
    """Most pairs of two sets that are far apart do: what is left out there does not average away."""
    x = (-least * (0.9 + 0.1 * np.random.default_rng(0).random((600, 900)))).astype(np.float32)
    found = Ops().expm1_(x.copy(), -least).astype(np.float64) - np.expm1(x.astype(np.float64))
    assert abs(found.mean()) < 6e-11


@pytest.mark.parametrize(("rows", "sigma"), [(1500, 6.9), (1500, 10.0), (800, 13.85), (1500, 25.0)])
@pytest.mark.parametrize("side", [-np.eye(64)[0], np.eye(64)[1]], ids=["antipodal", "orthogonal"])
def test_sets_that_are_as_far_apart_as_can_be(rows, sigma, side, monkeypatch):
    x, y = two_ends(rows, side, 0.1)
    types = taken(monkeypatch)
    got = mmd2(x, y, sigma=sigma, backend="blocked")
    exact = mmd2(
        x.astype(np.float64), y.astype(np.float64), sigma=sigma, backend="blocked", normalize=False
    )
    assert types == [np.float32, np.float64]
    assert exact > 1
    assert got == pytest.approx(exact, abs=4e-7)


@pytest.mark.parametrize(
    ("sigmas", "single"),
    [
        ((6.0, 12.0, 24.0), True),
        ((24.0, 6.0, 12.0), True),
        ((8.0, 16.0, 8.0), True),
        ((8.0, 10.0, 20.0), False),
    ],
)
def test_several_bandwidths_take_float32_where_it_holds_their_ratios(sigmas, single, monkeypatch):
    x, y = two_ends(1500, -np.eye(64)[0], 0.1)
    types = taken(monkeypatch)
    got = mmd2(x, y, sigma=sigmas, backend="blocked")
    assert types == [np.float32 if single else np.float64]
    wide = [v.astype(np.float64) for v in (x, y)]
    exact = np.mean([mmd2(*wide, sigma=s, backend="blocked", normalize=False) for s in sigmas])
    assert exact > 2
    assert got == pytest.approx(exact, abs=5e-7)


@pytest.mark.parametrize(
    ("sigma", "wanted"), [(10.0, "float32"), (3.9, "float64"), (0.5, "float64")]
)
def test_tensors_take_float32_under_the_same_rule(sigma, wanted):
    torch = pytest.importorskip("torch")
    x = np.concatenate(two_ends(600, -np.eye(64)[0], 0.1))
    kernel, order = Gaussian((sigma,)), np.arange(1200)
    for rows in (x, torch.from_numpy(x)):
        assert (
            str(
                blocked.centered(rows, order, kernel, ops_of(rows), order // 600).dtype
            ).removeprefix("torch.")
            == wanted
        )


def with_copies(x, distinct):
    """All other rows become copies of the first."""
    return x[np.where(np.arange(len(x)) < distinct, np.arange(len(x)), 0)]


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize(
    ("distinct", "sigma", "single"),
    [(1, 10.0, False), (1, 30.0, False), (520, 10.0, False), (1500, 10.0, True)],
)
def test_copies_of_few_rows_do_not_average_rounding_away(
    distinct, sigma, single, both, library, monkeypatch
):
    """A generator that has collapsed to an image, for all or most of its touches, beside real ones; and two of them."""
    xp = pytest.importorskip(library)
    x, y = two_ends(1500, -np.eye(64)[0], 0.1)
    x, y = with_copies(x, distinct), with_copies(y, distinct) if both else y
    types = taken(monkeypatch)
    got = mmd2(*(xp.asarray(v) for v in (x, y)), sigma=sigma, backend="blocked")
    exact = mmd2(
        x.astype(np.float64), y.astype(np.float64), sigma=sigma, backend="blocked", normalize=False
    )
    assert str(types[0]).removeprefix("torch.") == ("float32" if single else "float64")
    assert got == pytest.approx(exact, abs=4e-7)


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("spread", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("sigma", [6.0, 9.0])
def test_near_copies_are_summed_without_a_direction(spread, sigma, library, monkeypatch):
    """Sums of near-equal numbers in float32 are rounded in one direction here."""
    xp = pytest.importorskip(library)
    x, y = two_ends(3000, np.eye(768)[1], spread, d=768)
    types = taken(monkeypatch)
    got = mmd2(*(xp.asarray(v) for v in (x, y)), sigma=sigma, backend="blocked")
    assert "float32" in str(types[0])
    exact = mmd2(
        x.astype(np.float64), y.astype(np.float64), sigma=sigma, backend="blocked", normalize=False
    )
    assert got == pytest.approx(exact, abs=1e-6)


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_runs_of_near_equal_numbers_are_summed_in_float64(library):
    xp = pytest.importorskip(library)
    k = (0.1 + 1e-9 * np.random.default_rng(0).random((900, 1000))).astype(np.float32)
    starts, wide = np.array([0, 1, 400]), k.astype(np.float64)
    ops, given = ops_of(xp.asarray(k)), xp.asarray(k)
    np.testing.assert_allclose(
        ops.sum_rows(given, starts), np.add.reduceat(wide, starts, axis=0), rtol=1e-12
    )
    np.testing.assert_allclose(
        ops.sum_columns(given, starts), np.add.reduceat(wide, starts, axis=1), rtol=1e-12
    )


def test_copies_are_counted_in_every_segment():
    """Rows of one norm in two segments are no copies of one another; in one they are."""
    x = np.concatenate([np.eye(1200, dtype=np.float32)[:600]] * 2)
    kernel, order = Gaussian((30.0,)), np.arange(1200)
    spread = (
        x
        + 0.01 * np.random.default_rng(0).normal(size=x[:600].shape).astype(np.float32)[order % 600]
    )
    for rows, segment, wanted in (
        (spread, order // 600, np.float32),
        (spread[order % 20], order // 600, np.float32),
        (spread[order % 15], order // 600, np.float64),
    ):
        assert blocked.centered(rows, order, kernel, ops_of(rows), segment).dtype == wanted


class Scaled:
    """``x.y`` of rows in units of 2."""

    bandwidth, stationary, unit, single, radius_limit = None, False, 2.0, False, float("inf")
    factors, shift, values, diagonal, settings = (
        Linear().factors,
        Linear().shift,
        Linear().values,
        Linear().diagonal,
        Linear().settings,
    )


class Cauchy:
    """``1 / (1 + ||x - y||^2)``, of differences alone."""

    bandwidth, stationary, unit, single, radius_limit = None, True, 1.0, False, float("inf")
    factors, shift = Gaussian().factors, Gaussian().shift

    def values(self, product, ops, radius, shift):
        return 1 / (1 - 2 * ops.add_outer_(product, *shift))

    def diagonal(self, x, ops):
        return np.ones(len(x))

    def settings(self):
        return {"kernel": "cauchy"}


def test_a_kernel_of_ones_own():
    x, y = unit_rows(0, 30, 5), unit_rows(1, 20, 5)
    options = {"estimator": "biased", "normalize": False}
    assert distance(x, y, kernel=Scaled(), **options).value == pytest.approx(
        distance(x / 2, y / 2, kernel=Linear(), **options).value
    )
    k = lambda a, b: (1 / (1 + ((a[:, None] - b[None]) ** 2).sum(-1))).mean()  # noqa: E731
    want = 1000 * (k(x, x) + k(y, y) - 2 * k(x, y))
    for offset in (0.0, 1e6):  # centered: a common mean costs no digits
        found = distance(x + offset, y + offset, kernel=Cauchy(), **options)
        assert found.value == pytest.approx(want, abs=1e-9 if not offset else 1e-5)
        assert found.kernel == {"kernel": "cauchy"}


@pytest.mark.parametrize("name", [n for n in dir(Scaled) if not n.startswith("_")])
def test_a_kernel_without_something_is_refused(name):
    part = type(
        "Part",
        (),
        {n: getattr(Scaled, n) for n in dir(Scaled) if not n.startswith("_") and n != name},
    )
    with pytest.raises(PalpateError, match="kernel must be a kernel"):
        distance(unit_rows(0, 30, 5), unit_rows(1, 20, 5), kernel=part())


@pytest.mark.parametrize(
    "sigmas",
    [
        (),
        (0.0,),
        (-1.0,),
        (float("nan"),),
        (float("inf"),),
        ("ten",),
        "55",
        b"55",
        True,
        10**400,
        None,
    ],
)
def test_a_gaussian_without_bandwidths_is_refused(sigmas):
    with pytest.raises(PalpateError, match="sigma must be positive"):
        Gaussian(sigmas)


def test_the_class_of_a_kernel_is_no_kernel():
    for kernel in (Gaussian, Polynomial, Linear):
        with pytest.raises(PalpateError, match=r"kernel must be a kernel.*Gaussian\(\)"):
            distance(unit_rows(0, 30, 5), unit_rows(1, 20, 5), kernel=kernel)
