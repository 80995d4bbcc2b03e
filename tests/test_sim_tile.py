"""The periodic toolbox and the twenty materials."""

import math

import numpy as np
import pytest

from palpate.core import rng_for
from palpate.data.formats.touch_and_go import CATEGORIES
from palpate.sim.arrays import f32, hsv, resample, sample_periodic, smooth, smoothstep
from palpate.sim.materials import MATERIALS
from palpate.sim.tile import TILE_MM, Tile


def tile(n=64, name="tile"):
    return Tile(n, rng_for(0, name))


def draw(name, k, n=64):
    return MATERIALS[name].draw(Tile(n, rng_for(0, "test", name, k)))


def seam(field):
    """Largest mean step across the two seams, and the largest between any neighboring rows or
    columns inside."""
    across, inside = [], []
    for rows in (field, field.swapaxes(0, 1)):
        step = np.abs(np.diff(rows, axis=0, append=rows[:1])).reshape(len(rows), -1).mean(1)
        across.append(step[-1])
        inside.append(step[:-1].max())
    return max(across), max(inside)


@pytest.mark.parametrize("name", MATERIALS)
def test_materials_are_float32_finite_periodic_tiles(name):
    surfaces = [draw(name, k) for k in range(25)]
    assert 2 <= len({surface.subtype for surface in surfaces}) <= 5
    for surface in surfaces[:6]:
        assert surface.height.shape == (64, 64)
        assert surface.albedo.shape == (64, 64, 3)
        assert surface.height.dtype == surface.albedo.dtype == np.float32
        assert np.isfinite(surface.height).all()
        assert np.isfinite(surface.albedo).all()
        for field in (surface.height, surface.albedo):
            across, inside = seam(field)
            assert across <= 1.3 * inside + 1e-6, (surface.subtype, across, inside)


def test_twenty_materials_have_the_label_ids_of_touch_and_go():
    assert {name: m.label for name, m in MATERIALS.items()} == {n: k for k, n in CATEGORIES.items()}


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
    steps = np.array([(w[1, 0] - w[0, 0], w[0, 1] - w[0, 0]) for w in (u, v)]) * 32 / math.pi
    np.testing.assert_allclose(steps, steps.round(), atol=1e-2)
    assert steps[0] @ steps[1] == pytest.approx(0.0, abs=0.2)


def test_strokes_cross_the_seam_as_any_other_line():
    z = tile().strokes(400, 12.0, 2.0, angle=0.0, spread=3.0, height=1.0)
    assert z.dtype == np.float32
    assert z.max() <= 1.0
    for edge in (z[0], z[-1], z[:, 0], z[:, -1]):
        assert 0.7 < edge.mean() / z.mean() < 1.4


def test_resample_is_the_area_mean_at_any_size():
    field = f32(np.random.default_rng(0).random((24, 24)))
    for size in (8, 10, 48):  # 240 = 24 * 10 is a multiple of each
        fine = np.kron(field, np.ones((10, 10))).reshape(size, 240 // size, size, 240 // size)
        np.testing.assert_allclose(resample(field, size), fine.mean((1, 3)), atol=1e-6)


def test_periodic_lookup_equals_the_wrapped_grid():
    for side in (8, 6):  # a power of two wraps by another way
        field = f32(np.random.default_rng(1).random((3, side, side)))
        y, x = np.meshgrid(np.arange(-9, 20), np.arange(-3, 12), indexing="ij")
        expected = field[:, y % side, x % side]
        np.testing.assert_allclose(sample_periodic(field, f32(y), f32(x)), expected, atol=1e-6)
        half = sample_periodic(field[0], f32([[-0.5]]), f32([[2.0]]))
        np.testing.assert_allclose(half, [[(field[0, -1, 2] + field[0, 0, 2]) / 2]], atol=1e-6)


def test_helpers_keep_float32():
    x = f32(np.linspace(-1, 1, 64 * 64)).reshape(64, 64)
    results = [smoothstep(x, np.float64(0.2), 0.9), hsv(0.3, 0.5, 0.5), resample(x, 30)]
    assert {r.dtype for r in (*results, smooth(x, 1.0), smooth(x, 6.0))} == {np.dtype("float32")}
    np.testing.assert_allclose(smoothstep(f32([0.0, 0.5, 1.0]), 1.0, 0.0), [1.0, 0.5, 0.0])
