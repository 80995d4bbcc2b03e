"""The periodic toolbox and the twenty materials."""

import math

import numpy as np
import pytest

from palpate.core import rng_for
from palpate.sim.arrays import f32, hsv, resample, sample_periodic, smooth, smoothstep
from palpate.sim.materials import MATERIALS, Material, Surface, draw_surface
from palpate.sim.tile import TILE_MM, Tile


def tile(n=64, name="tile"):
    return Tile(n, rng_for(0, name))


def draw(name, k, n=64):
    rng = rng_for(0, "test", name, k)
    return MATERIALS[name].draw(Tile(n, rng), rng)


def seam(field):
    """Largest mean step across the two seams, and the largest between any neighboring rows or
    columns inside."""
    rows = [np.abs(field[0] - field[-1]).mean(), np.abs(field[:, 0] - field[:, -1]).mean()]
    inside = [
        np.abs(np.diff(field, axis=a))
        .mean(axis=tuple(b for b in range(field.ndim) if b != a))
        .max()
        for a in (0, 1)
    ]
    return max(rows), max(inside)


def test_the_seam_measure_can_fail():
    at = np.arange(64) / 64
    across, inside = seam(np.sin(2 * math.pi * 1.4 * at)[:, None] + np.zeros((64, 64)))
    assert across > 3 * inside


@pytest.mark.parametrize("name", MATERIALS)
def test_materials_are_float32_finite_periodic_tiles_with_words(name):
    for k in range(6):
        surface = draw(name, k)
        assert surface.height.shape == (64, 64)
        assert surface.albedo.shape == (64, 64, 3)
        assert surface.height.dtype == surface.albedo.dtype == np.float32
        assert np.isfinite(surface.height).all()
        assert np.isfinite(surface.albedo).all()
        assert surface.subtype in MATERIALS[name].subtypes
        assert 2 <= len(surface.words) <= 4
        assert len(set(surface.words)) == len(surface.words)
        for field in (surface.height, surface.albedo):
            across, inside = seam(field)
            assert across <= 1.3 * inside + 1e-6, (surface.subtype, across, inside)


@pytest.mark.parametrize("name", MATERIALS)
def test_every_subtype_is_drawn_and_none_else(name):
    assert {draw(name, k, 64).subtype for k in range(40)} == set(MATERIALS[name].subtypes)
    assert 2 <= len(MATERIALS[name].subtypes) <= 5


def test_twenty_materials_have_the_label_ids_of_touch_and_go():
    assert [m.label for m in MATERIALS.values()] == list(range(20))
    assert list(MATERIALS)[3] == "Wood"
    assert list(MATERIALS)[12] == "Tree"
    assert list(MATERIALS)[19] == "Others"


def flat(n=64):
    return np.zeros((n, n), np.float32), np.full((n, n, 3), 0.5, np.float32)


def test_float64_of_a_users_material_becomes_float32():
    material = Material(
        20,
        "cork",
        lambda tile, rng: Surface(
            np.ones((tile.n, tile.n)), np.ones((tile.n, tile.n, 3)), "x", ("odd", "new")
        ),
    )
    surface = draw_surface("Cork", material, 64, rng_for(0))
    assert surface.height.dtype == surface.albedo.dtype == np.float32
    assert surface.noun == "cork"


def test_cells_equal_brute_force_on_the_torus():
    cells = tile(32).cells(9.0)
    at = (np.arange(32) + 0.5) * TILE_MM / 32
    delta = [np.abs(at[:, None] - cells.seeds[:, k][None]) for k in (0, 1)]
    dy, dx = (np.minimum(d, TILE_MM - d) for d in delta)
    distance = np.sort(np.hypot(dy[:, None], dx[None]), axis=-1)
    np.testing.assert_allclose(cells.near, distance[..., 0], atol=1e-4)
    # The second seed may lie outside the 3 x 3 cells searched; then F2 is too large, never too
    # small.
    assert (cells.far >= distance[..., 1] - 1e-4).all()
    assert np.mean(np.abs(cells.far - distance[..., 1]) < 1e-3) > 0.98


def test_noise_is_band_limited_and_standard():
    z = tile().noise(2.0, 16.0)
    assert abs(float(z.mean())) < 1e-5
    assert float(z.std()) == pytest.approx(1.0, abs=1e-5)
    power = np.abs(np.fft.fft2(z)) ** 2
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(64, 1.0), np.fft.fftfreq(64, 1.0), indexing="ij"))
    assert power[f < 1 / 16.5].sum() < 1e-6 * power.sum()


def test_waves_have_whole_periods_and_stay_at_right_angles():
    t = tile()
    u, v = t.wave(7.3, 0.4), t.wave(7.3, 0.4 + math.pi / 2)
    steps = [
        (
            float((w[1, 0] - w[0, 0]) * 64 / (2 * math.pi)),
            float((w[0, 1] - w[0, 0]) * 64 / (2 * math.pi)),
        )
        for w in (u, v)
    ]
    for step in (*steps[0], *steps[1]):
        assert step == pytest.approx(round(step), abs=1e-2)
    assert steps[0][0] * steps[1][0] + steps[0][1] * steps[1][1] == pytest.approx(0.0, abs=0.2)


def test_strokes_cross_the_seam_as_any_other_line():
    z = tile().strokes(400, 12.0, 2.0, angle=0.0, spread=3.0, height=1.0)
    assert z.dtype == np.float32
    assert z.max() <= 1.0
    for edge in (z[0], z[-1], z[:, 0], z[:, -1]):
        assert 0.7 < edge.mean() / z.mean() < 1.4


def test_resample_is_the_area_mean_at_any_size():
    field = f32(np.random.default_rng(0).random((24, 24)))
    np.testing.assert_allclose(
        resample(field, 8), field.reshape(8, 3, 8, 3).mean((1, 3)), atol=1e-6
    )
    fine = np.repeat(np.repeat(field, 5, 0), 5, 1)  # 120 = 24 * 5 = 10 * 12
    np.testing.assert_allclose(
        resample(field, 10), fine.reshape(10, 12, 10, 12).mean((1, 3)), atol=1e-6
    )
    np.testing.assert_allclose(
        resample(field, 48), np.repeat(np.repeat(field, 2, 0), 2, 1), atol=1e-6
    )


def test_periodic_lookup_equals_the_wrapped_grid():
    for side in (8, 6):  # a power of two wraps by another way
        field = f32(np.random.default_rng(1).random((3, side, side)))
        y, x = np.meshgrid(np.arange(-9, 20), np.arange(-3, 12), indexing="ij")
        np.testing.assert_allclose(
            sample_periodic(field, f32(y), f32(x)), field[:, y % side, x % side], atol=1e-6
        )
        half = sample_periodic(field[0], f32([[-0.5]]), f32([[2.0]]))
        np.testing.assert_allclose(half, [[(field[0, -1, 2] + field[0, 0, 2]) / 2]], atol=1e-6)


def test_helpers_keep_float32():
    x = f32(np.linspace(-1, 1, 64 * 64)).reshape(64, 64)
    for result in (
        smoothstep(x, np.float64(0.2), 0.9),
        smooth(x, 1.0),
        smooth(x, 6.0),
        hsv(0.3, 0.5, 0.5),
        resample(x, 30),
    ):
        assert result.dtype == np.float32
    np.testing.assert_allclose(smoothstep(f32([0.0, 0.5, 1.0]), 1.0, 0.0), [1.0, 0.5, 0.0])
