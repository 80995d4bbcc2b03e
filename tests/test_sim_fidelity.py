"""Statistics of tactile images with known answers, and the world against the real clips."""

import math

import numpy as np
import pytest
from world_statistics import change, contact_area, contrast, difference, marker_count, marker_mask

from palpate.sim import Video, WorldOptions, plan_world
from palpate.sim.arrays import f32, resample
from palpate.sim.plan import contact_frames, first_contact


def plain(value=150.0, n=64):
    return np.full((n, n, 3), value, np.float32)


def dotted(n=64, step=8, side=2, value=20.0):
    """Draw a pad with n²/step² dark squares."""
    image = plain(n=n)
    for i, j in ((i, j) for i in range(step // 2, n, step) for j in range(step // 2, n, step)):
        image[i : i + side, j : j + side] = value
    return image


def test_markers_are_dark_blobs():
    assert marker_count(dotted()) == 64
    assert marker_count(plain()) == 0
    assert marker_count(dotted(value=0.83 * 150)) == 0  # not dark enough
    assert marker_count(dotted(value=0.81 * 150)) == 64
    shade = np.linspace(60, 200, 64, dtype=np.float32)[None, :, None]
    assert not marker_mask(np.broadcast_to(shade, (64, 64, 3))).any()  # dark is relative


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
    assert contrast(dotted(), dotted())["chroma"] == 0.0


def test_the_contact_area_is_that_of_the_patch():
    contact = dotted(128, 16, 3)
    contact[32:96, 32:96] += np.float32([20.0, -20.0, 0.0]) * (contact[32:96, 32:96] > 100)
    area = contact_area(contact, dotted(128, 16, 3), 0.5 * 20 * math.sqrt(2 / 3))
    assert area == pytest.approx(0.25, abs=0.03)
    assert change(contact, dotted(128, 16, 3)).shape == (128, 128)


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
        background = resample(f32(images[max(0, first - 4)]), 64)
        medians.append(describe([(resample(f32(images[f]), 64), background) for f in used]))
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
        row = contrast(contact, background)
        row["area"] = contact_area(contact, background, 6.0)
        rows.append(row | {"count": marker_count(background)})
    return {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
