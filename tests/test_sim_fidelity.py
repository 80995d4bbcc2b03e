"""Statistics of tactile images with known answers, and the world against the real clips."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from world_statistics import (
    BANDS,
    PAD_MM,
    change,
    color_grid,
    contact_area,
    contrast,
    difference,
    luma,
    marker_mask,
    marker_statistics,
    noise_level,
    spectrum,
    to_size,
)

from palpate.sim import Video, WorldOptions, plan_world
from palpate.sim.plan import contact_frames, first_contact


def plain(value=150.0, n=64):
    return np.full((n, n, 3), value, np.float32)


def dotted(n=64, step=8, side=2, value=20.0):
    """Draw a pad with n²/step² dark squares."""
    image = plain(n=n)
    for i, j in ((i, j) for i in range(step // 2, n, step) for j in range(step // 2, n, step)):
        image[i : i + side, j : j + side] = value
    return image


def wave(cycles, n=64, amplitude=10.0):
    """Draw a gray wave of that many cycles on the pad, around 0."""
    along = amplitude * np.sin(2 * math.pi * cycles * (np.arange(n) + 0.5) / n)
    return np.broadcast_to(along[None, :, None], (n, n, 3)).astype(np.float32)


def test_markers_are_dark_blobs():
    values = marker_statistics(dotted())
    assert values["count"] == 64
    assert values["area"] == pytest.approx(64 * 4 / 64**2)
    assert values["largest"] == pytest.approx(4 / 64**2)
    assert marker_statistics(plain()) == {"count": 0.0, "area": 0.0, "largest": 0.0}
    assert marker_statistics(dotted(value=0.83 * 150))["count"] == 0  # not dark enough
    assert marker_statistics(dotted(value=0.81 * 150))["count"] == 64
    shade = np.linspace(60, 200, 64, dtype=np.float32)[None, :, None]
    assert not marker_mask(np.broadcast_to(shade, (64, 64, 3))).any()  # dark is relative


def test_the_color_grid_excludes_the_markers():
    image = dotted() * np.float32([1.0, 0.5, 2.0])
    expected = np.broadcast_to([150.0, 75.0, 300.0], (3, 3, 3))
    np.testing.assert_allclose(color_grid(image), expected, rtol=1e-5)
    image[:, 40:] = 90.0
    assert color_grid(image)[1, 2] == pytest.approx([90.0] * 3, rel=0.05)


def test_luma_by_hand():
    np.testing.assert_allclose(luma(plain(100.0)), 100.0, rtol=1e-5)
    assert luma(np.float32([[[255, 0, 0]]]))[0, 0] == pytest.approx(76.245)


@pytest.mark.parametrize(
    ("step", "chroma"), [((6.0, 6.0, 6.0), 0.0), ((6.0, -6.0, 0.0), 1.0), ((6.0, 0.0, 0.0), 2 / 3)]
)
def test_contrast_by_hand(step, chroma):
    values = contrast(dotted() + np.float32(step), dotted())
    assert [values[f"rms_{c}"] for c in "rgb"] == pytest.approx(np.abs(step))
    assert [values[f"p95_{c}"] for c in "rgb"] == pytest.approx(np.abs(step))
    assert values["rms"] == pytest.approx(math.sqrt(np.mean(np.square(step))))
    assert values["chroma"] == pytest.approx(chroma, abs=1e-6)


def test_moved_markers_and_equal_images_are_no_contact():
    background, contact = dotted(), np.roll(dotted(), 2, 1)
    d, keep = difference(contact, background)
    assert np.abs(d).max() > 100
    assert contrast(contact, background)["rms"] == 0.0
    assert keep.mean() > 0.5
    assert contact_area(contact, background, 1.0) == 0.0
    assert contrast(dotted(), dotted())["chroma"] == spectrum(dotted(), dotted())["band_0"] == 0.0


@pytest.mark.parametrize(("cycles", "band"), [(5, 1), (10, 2), (20, 3)])
def test_a_wave_lies_in_its_band_with_its_strength(cycles, band):
    low, high = BANDS[band : band + 2]
    assert low < cycles / PAD_MM < high
    values = spectrum(plain() + wave(cycles), plain())
    assert values[f"band_{band}"] == pytest.approx(10 / math.sqrt(2), rel=0.05)
    assert all(values[f"band_{k}"] < 1.0 for k in range(4) if k != band)


@pytest.mark.parametrize("n", [64, 128])
def test_the_slope_is_that_of_a_power_law(n):
    axis = np.fft.fftfreq(n, PAD_MM / n)
    radius = np.hypot(axis[:, None], axis[None])
    radius[0, 0] = 1.0
    white = np.random.default_rng(n).normal(size=(n, n))
    noise = np.fft.ifft2(np.fft.fft2(white) / radius).real  # amplitude ~ 1 / f, power ~ f^-2
    slope = spectrum(plain(n=n) + np.float32(3 * noise)[..., None], plain(n=n))["slope"]
    assert slope == pytest.approx(-2.0, abs=0.35)


def test_the_contact_area_is_that_of_the_patch():
    contact = dotted(128, 16, 3)
    contact[32:96, 32:96] += np.float32([20.0, -20.0, 0.0]) * (contact[32:96, 32:96] > 100)
    area = contact_area(contact, dotted(128, 16, 3), 0.5 * 20 * math.sqrt(2 / 3))
    assert area == pytest.approx(0.25, abs=0.03)
    assert change(contact, dotted(128, 16, 3)).shape == (128, 128)


def test_the_noise_is_measured_as_documented():
    rng = np.random.default_rng(0)
    noisy = dotted(128, 16, 3) + rng.normal(0, 3, (128, 128, 3)).astype(np.float32)
    assert noise_level(noisy) == pytest.approx(3 * 0.58, rel=0.06)
    assert noise_level(plain()) == pytest.approx(0.0, abs=1e-3)


def test_sizes_are_means_over_areas():
    image = np.arange(16 * 16 * 3, dtype=np.float32).reshape(16, 16, 3)
    mean = image.reshape(4, 4, 4, 4, 3).mean((1, 3))
    np.testing.assert_allclose(to_size(image, 4), mean, rtol=1e-5)


@pytest.mark.slow
def test_the_world_lies_within_the_spread_of_the_real_clips(real_data):
    """Compare medians over a few contacts with the spread, slightly widened, of five real clips."""
    av = pytest.importorskip("av")
    folder, clips = real_data / "touch_and_go" / "clips", {}
    for line in (folder / "label.txt").read_text().split():
        clip, file = line.split(",")[0].split("/")
        clips.setdefault(clip, []).append(int(file[:-4]))
    medians = []
    for clip, numbers in clips.items():
        first = min(numbers)
        with av.open(str(folder / "dataset" / clip / "gelsight.mp4")) as file:
            decoded = zip(range(first + 30), file.decode(video=0), strict=False)
            images = [f.to_ndarray(format="rgb24")[:, 80:560] for _, f in decoded]
        used = [f for f in sorted(numbers) if f - first < 30 and f < len(images)][::6]
        background = to_size(images[max(0, first - 4)], 64)
        medians.append(describe([(to_size(images[f], 64), background) for f in used]))
    options, pairs = WorldOptions(objects_per_material=3), []
    for plan in plan_world(options)[::2]:
        video = Video(options, plan)
        frames = (contact_frames(options, 1)[1], first_contact(options, 1) - 4)
        pairs.append([video.tactile(frame) for frame in frames])
    for name, value in describe(pairs).items():
        low, high = (end(m[name] for m in medians) for end in (min, max))
        margin = 0.25 * (high - low)
        message = f"{name}: world {value:.2f}, real {low:.2f} .. {high:.2f}"
        assert low - margin <= value <= high + margin, message


def describe(pairs):
    """Return the median of each statistic over (contact, background) pairs."""
    rows = []
    for contact, background in pairs:
        row = contrast(contact, background) | spectrum(contact, background)
        row |= {f"mean_{k}": v for k, v in enumerate(color_grid(background).mean((0, 1)))}
        row["area"] = contact_area(contact, background, 6.0)
        rows.append(row | {"count": marker_statistics(background)["count"]})
    return {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
