"""The press, the light, the sensor family, and frames rendered alone."""

import copy
import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, label

from palpate.sim import Video, WorldOptions, plan_world
from palpate.sim.arrays import f32, to_bytes
from palpate.sim.gel import GEL_MM, GRIP_MM, OPTICAL_MM, RELAX_MM, make_sensor, solve_approach
from palpate.sim.plan import contact_frames, first_contact

SMALL = WorldOptions(
    materials=("Wood", "Brick", "Gravel", "Leather"), objects_per_material=1, tile=128, size=32
)


def bisect(gap, load):
    """Oracle: the approach by bisection."""
    low, high = -50.0, 50.0
    for _ in range(100):
        middle = (low + high) / 2
        mean = np.maximum(gap.astype(np.float64) + middle, 0).mean()
        low, high = (middle, high) if mean < load else (low, middle)
    return low


@pytest.mark.parametrize("load", [0.001, 0.1, 0.42, 3.0])
@pytest.mark.parametrize("shape", [(7, 7), (64, 64)])
def test_the_press_is_force_controlled(load, shape):
    gap = f32(np.random.default_rng(0).normal(0, 0.3, shape))
    d = solve_approach(gap, load)
    assert d == pytest.approx(bisect(gap, load), abs=1e-6)
    assert np.maximum(gap.astype(np.float64) + d, 0).mean() == pytest.approx(load, rel=1e-5)


def test_a_contact_presses_with_its_load_and_the_gel_is_never_exceeded():
    for plan in plan_world(SMALL):
        video = Video(SMALL, plan)
        for contact in range(SMALL.contacts_per_video):
            first = first_contact(SMALL, contact)
            assert not video.state(first - 4).in_contact
            assert not video.state(first - 1).in_contact
            assert all(video.state(f).in_contact for f in contact_frames(SMALL, contact))
            state = video.state(first + 1)
            membrane, mask = video.membrane(state)
            assert membrane.dtype == np.float32
            assert mask.any()
            assert membrane.min() >= 0.0
            assert membrane.max() <= 1.6
    stone = f32(np.where(np.hypot(*np.mgrid[-16:16, -16:16]) < 5, 0.5, -9.0))
    shallow, deep = (make_sensor(SMALL, 0).press(stone, load)[0] for load in (0.01, 0.03))
    assert shallow.max() < deep.max()


def blurred(field, sigma):
    """A Gaussian, or from 2.5 pixels on two boxes of the same variance, along both axes."""
    if sigma < 2.5:
        return gaussian_filter(field, sigma, truncate=3.0, mode="nearest")
    half = round(np.sqrt(6 * sigma * sigma + 1)) // 2
    for axis in (0, 1, 0, 1):
        padded = np.pad(field, [(half, half) if a == axis else (0, 0) for a in (0, 1)], "edge")
        boxes = [np.roll(padded, k, axis) for k in range(-half, half + 1)]
        field = np.mean(boxes, 0).take(range(half, half + field.shape[axis]), axis)
    return field


def test_the_membrane_is_that_of_the_docstring():
    """At 32 px, where no blur is a box but the first, written out in float64."""
    sensor = make_sensor(SMALL, 0)
    gap = np.random.default_rng(3).normal(0, 0.4, (32, 32))
    p = np.maximum(gap + bisect(gap, 0.2), 0)
    h, w = GEL_MM * np.tanh(p / GEL_MM), p / (p + GRIP_MM)
    expected = h
    for blur in RELAX_MM:
        s = blurred(expected, blur / sensor.px)
        expected = s + w * (h - s)
    expected = blurred(expected, OPTICAL_MM / sensor.px)
    membrane, contact = sensor.press(f32(gap), 0.2)
    np.testing.assert_allclose(membrane, expected, atol=1e-5)
    assert contact.mean() == pytest.approx((p > 0).mean(), abs=1e-3)


def test_a_contact_ends_softly():
    """A ball pressed into the gel: at the rim the slope changes less from pixel to pixel than in
    the bare foundation."""
    sensor = make_sensor(dataclasses.replace(SMALL, size=128), 0)
    y, x = (np.mgrid[:128, :128] - 63.5) * sensor.px
    gap = f32(-(x * x + y * y) / 40.0)
    bare = np.maximum(gap + solve_approach(gap, 0.1), 0)
    soft, contact = sensor.press(gap, 0.1)
    assert 0.1 < contact.mean() < 0.9
    kink = lambda m: np.abs(np.diff(m[64], 2)).max()
    assert kink(soft) < 0.5 * kink(bare)
    assert soft[~contact].max() > 0.01  # the gel is pulled along outside the contact


def test_the_background_is_the_shading_without_contact():
    video = Video(SMALL, 0)
    flat = video.sensor.shade(np.zeros((32, 32), np.float32), video.gain)
    np.testing.assert_array_equal(video.background(), to_bytes(flat))
    free = np.stack([video.tactile(f) for f in range(5)]).astype(float)
    assert np.abs(free.mean(0) - video.background()).mean() < 2.0  # noise alone
    assert np.abs(free[0] - free[1]).mean() > 0.1
    assert np.abs(video.tactile(6).astype(float) - video.background()).mean() > 3.0


def test_shading_is_the_photometric_formula():
    """A plane membrane of slope (a, b) without texture, against the formula written out in
    float64."""
    flat = np.zeros((32, 32), np.float32)
    sensor = copy.copy(make_sensor(SMALL, 1))
    sensor.ink, sensor.texture = None, flat
    row, column = np.mgrid[:32, :32]
    a, b = 0.2, -0.1
    membrane = (a * column + b * row) * sensor.px
    image = sensor.shade(f32(membrane), f32([1.1, 1.0, 0.9]))
    normal = np.array([a, b, 1.0]) / np.sqrt(a * a + b * b + 1.0)
    expected = np.zeros((32, 32, 3)) + sensor.ambient
    for k in range(3):
        light = sensor.field[k][..., None] * max(0.0, float(normal @ sensor.light[k]))
        expected += light * sensor.color[k]
    expected *= 1.0 - sensor.dim * membrane[..., None]
    expected = np.clip(expected * sensor.veil[..., None] * [1.1, 1.0, 0.9], 0, 1.2) ** sensor.gamma
    np.testing.assert_allclose(image, expected, atol=2e-3)


def test_a_unit_looks_the_same_at_every_size():
    big, small = (make_sensor(dataclasses.replace(SMALL, size=size), 2) for size in (128, 64))
    for name in ("veil", "ink", "dome", "texture"):
        mean = getattr(big, name).reshape(64, 2, 64, 2).mean((1, 3))
        np.testing.assert_allclose(getattr(small, name), mean, atol=1e-5)
    assert small.gamma == big.gamma


def test_digit_has_no_markers_and_one_family_many_units():
    digit = make_sensor(dataclasses.replace(SMALL, look="digit"), 0)
    assert digit.ink is None
    assert make_sensor(SMALL, 0).ink.max() > 0.5
    first = make_sensor(SMALL, 0)
    for unit in (make_sensor(SMALL, 1), make_sensor(dataclasses.replace(SMALL, seed=7), 0)):
        assert not np.array_equal(first.veil, unit.veil)
        assert np.abs(first.light - unit.light).max() < 0.4  # the lights stay nearly in place
    # A unit depends on no option of other things.
    other = make_sensor(dataclasses.replace(SMALL, hard=0.1, tile=512), 0)
    np.testing.assert_array_equal(other.veil, first.veil)
    assert make_sensor(dataclasses.replace(SMALL, markers=0), 0).ink is None


@pytest.mark.parametrize("rows", [8, 5, 12])
def test_a_pad_shows_its_rows_of_markers(rows):
    for unit in range(3):
        ink = make_sensor(dataclasses.replace(SMALL, size=256, markers=rows), unit).ink
        blobs = label(ink > 0.5)[0]
        areas = np.bincount(blobs.ravel())[1:]
        assert rows**2 - 3 <= (areas > 0.3 * np.median(areas)).sum() <= (rows + 2) ** 2


def test_markers_follow_the_shear_and_are_pushed_apart():
    """Above a round bump, without shear: displaced by 0.107 mm x the slope of the smoothed depth,
    outwards."""
    sensor = make_sensor(SMALL, 0)
    dy, dx = sensor.shift(np.full((32, 32), 0.5, np.float32), (0.7, -0.35))
    assert float(dx[16, 16]) == pytest.approx(0.5 * 0.7 / sensor.px, rel=1e-4)
    assert float(dy[16, 16]) == pytest.approx(-0.5 * 0.35 / sensor.px, rel=1e-4)
    y, x = (np.mgrid[:32, :32] - 15.5) * sensor.px
    bump = f32(0.8 * np.exp(-(x * x + y * y) / 8.0))
    dy, dx = sensor.shift(bump, (0.0, 0.0))
    np.testing.assert_allclose(dy, dx.T, atol=1e-4)
    depth = gaussian_filter(bump.astype(float), 3.2, mode="nearest")
    expected = -np.gradient(depth, axis=0) / sensor.px * 0.107 / sensor.px
    assert np.abs(expected).max() > 0.02
    inner, tolerance = np.s_[2:-2, 2:-2], 0.25 * np.abs(expected).max()
    np.testing.assert_allclose(dy[inner], expected[inner], atol=tolerance)
    assert dy[20, 16] > 0 > dy[11, 16]


@pytest.mark.parametrize("look", ["gelsight", "digit"])
def test_a_frame_alone_equals_the_frame_in_its_video(look):
    options = dataclasses.replace(SMALL, look=look)
    whole = Video(options, 2)
    frames = range(options.video_length)
    vision, tactile = [whole.vision(f) for f in frames], [whole.tactile(f) for f in frames]
    for f in (3, 7, 20, 31):
        np.testing.assert_array_equal(Video(options, 2).vision(f), vision[f])
        np.testing.assert_array_equal(Video(options, 2).tactile(f), tactile[f])
    assert vision[0].dtype == np.uint8
    assert vision[0].shape == tactile[0].shape == (32, 32, 3)


def test_neighboring_frames_are_similar_and_materials_are_not():
    first = Video(SMALL, 0).vision(5).astype(float)
    near, far = Video(SMALL, 0).vision(6), Video(SMALL, 1).vision(5)
    assert np.abs(first - near).mean() < np.abs(first - far).mean()


def test_a_larger_pad_shows_more_of_the_object_under_the_same_load():
    wide = dataclasses.replace(SMALL, pad_mm=28.0, load_mm=(0.2, 0.2), sensor_noise=(0.0, 0.0))
    sensor = make_sensor(wide, 0)
    assert (sensor.px, sensor.half, sensor.noise) == (28.0 / SMALL.size, 14.0, 0.0)
    loads = [contact.load for contact in Video(wide, 0).contacts]
    np.testing.assert_allclose(loads, 0.2)


def loads(phases, frames):
    """Loads of the contact frames of 600 contacts, as shares of the peak of each."""
    options = dataclasses.replace(
        SMALL, phases=phases, frames_per_contact=frames, contacts_per_video=100
    )
    options = dataclasses.replace(options, objects_per_material=2)
    videos = [Video(options, plan) for plan in plan_world(options)[:6]]
    return np.array(
        [
            [video.state(f).load / video.contacts[k].load for f in contact_frames(options, k)]
            for video in videos
            for k in range(100)
        ]
    )


def test_loads_are_distributed_alike_for_any_number_of_frames_a_contact():
    phase = (np.arange(1000) + 0.5) / 1000
    expected = (0.45 + 0.55 * np.sin(np.pi * (0.12 + 0.76 * phase))) ** 2
    quantiles = np.quantile(expected, (0.05, 0.25, 0.5, 0.75))
    for frames in (1, 2, 5):
        drawn = loads("drawn", frames)
        np.testing.assert_allclose(
            np.quantile(drawn, (0.05, 0.25, 0.5, 0.75)), quantiles, rtol=0.07
        )
        assert drawn.mean() == pytest.approx(expected.mean(), rel=0.03)
    one, two = (loads("spaced", frames).mean() for frames in (1, 2))
    assert one / two == pytest.approx(2.35, rel=0.01)
