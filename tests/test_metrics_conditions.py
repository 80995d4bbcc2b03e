"""Place, area, strength and shear of contacts, and displacements of markers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from palpate.core import PalpateError
from palpate.metrics.conditions import CONDITIONS, contact_conditions
from palpate.metrics.markers import marker_motion
from palpate.sim import PRESETS
from palpate.sim.world import World

SIDE = 64


def gel(side=SIDE, spots=True):
    """A gray gel with a grid of round markers, as bytes."""
    image = np.full((side, side, 3), 150.0)
    y, x = np.mgrid[:side, :side] + 0.5
    step = side / 8
    if spots:
        away = np.hypot((y - step / 2) % step - step / 2, (x - step / 2) % step - step / 2)
        image *= 1 - 0.6 * np.clip(1.7 * side / 64 - away, 0, 1)[..., None]
    return image


def pressed(at, radius, height, *, side=SIDE, shear=(0, 0), spots=True):
    """A gel that a disk of gray levels brightens, its markers moved in pixels."""
    image = ndimage.shift(gel(side, spots), (*shear[::-1], 0), order=1, mode="grid-wrap")
    y, x = (np.mgrid[:side, :side] + 0.5) / side
    disk = np.hypot(x - at[0], y - at[1]) < radius
    return np.clip(image + height * disk[..., None], 0, 255)


def measured(image, still):
    row = contact_conditions(image[None].round().astype(np.uint8), still.round().astype(np.uint8))
    return dict(zip(CONDITIONS, row[0], strict=True))


@pytest.mark.parametrize("side", [64, 128])
@pytest.mark.parametrize(("x", "y"), [(0.3, 0.6), (0.7, 0.4)])
def test_place_area_and_strength_of_a_disk(side, x, y):
    row = measured(pressed((x, y), 0.2, 20, side=side), gel(side))
    assert row["at_x"] == pytest.approx(x, abs=0.01)
    assert row["at_y"] == pytest.approx(y, abs=0.01)
    # 4 of 20 gray levels are 0.84 deviations of the blur outside, and the mask is dilated
    radius = 0.2 + 0.84 / 48 + 1 / 64
    assert row["area"] == pytest.approx(np.pi * radius**2, rel=0.05)
    assert 14 < row["strength"] < 20.5
    deeper = measured(pressed((x, y), 0.2, 40, side=side), gel(side))
    assert deeper["strength"] == pytest.approx(
        2 * row["strength"], rel=0.1
    )  # the mask grows with it
    assert deeper["area"] == pytest.approx(row["area"], rel=0.15)


def test_shear_is_the_movement_of_the_markers_in_percent_of_the_width():
    row = measured(pressed((0.5, 0.5), 0.2, 20, shear=(0.64, -1.28)), gel())
    assert row["shear_x"] == pytest.approx(1, abs=0.06)
    assert row["shear_y"] == pytest.approx(-2, abs=0.06)


def test_what_is_absent_is_none_and_no_contact_has_no_strength():
    still = gel(spots=False)
    row = measured(pressed((0.5, 0.5), 0.2, 20, spots=False), still)
    assert np.isnan(row["shear_x"])
    assert np.isnan(row["shear_y"])
    assert row["strength"] > 10
    row = measured(still, still)
    assert np.isnan(row["at_x"])
    assert np.isnan(row["at_y"])
    assert row["area"] == row["strength"] == 0
    assert marker_motion(gel() / 255, gel() / 255).moves == pytest.approx(0)


def test_markers_move_as_the_world_moves_them():
    options = replace(PRESETS["tiny"], seed=5, load_mm=(0.3, 0.42))
    world, own, true = World(options), [], []
    for row in world.rows[::3]:
        video, state = world.video(row.video), world.video(row.video).state(row.frame)
        motion = marker_motion(
            video.tactile(row.frame) / 255, video.background_of(row.contact) / 255
        )
        dy, dx = video.sensor.shift(video.membrane(state)[0], state.shear)
        pixels = options.size / 100
        x, y = np.rint(motion.at * pixels).astype(int).T
        own.append(motion.moves * pixels)
        true.append(np.stack([dx[y, x], dy[y, x]], 1))
    own, true = np.concatenate(own), np.concatenate(true)
    assert np.sqrt(((own - true) ** 2).sum(1).mean()) < 0.25 * np.sqrt((true**2).sum(1).mean())
    for k in range(2):
        assert np.corrcoef(own[:, k], true[:, k])[0, 1] > 0.95


def test_a_digit_has_no_markers():
    world = World(replace(PRESETS["tiny"], seed=5, look="digit"))
    sample = world[0]
    row = measured(sample["tactile"].astype(float), sample["background"].astype(float))
    assert np.isnan(row["shear_x"])


def test_images_of_other_shapes_are_rejected():
    with pytest.raises(PalpateError):
        contact_conditions(np.zeros((1, 64, 64, 3), np.uint8), np.zeros((32, 32, 3), np.uint8))
