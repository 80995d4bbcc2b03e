"""Worlds at the scale of real photos: what is seen is of true size, and felt where it is seen."""

import math
from dataclasses import replace

import numpy as np
import pytest

from palpate.sim import MATERIALS, Video, WorldOptions
from palpate.sim.arrays import f32, grid
from palpate.sim.ground import GROUND_MM, TOUCHES, touch_of
from palpate.sim.plan import ObjectRef, VideoPlan, first_contact
from palpate.sim.video import make_object

OPTIONS = WorldOptions(scale="real", size=64, tile=128, phases="spaced", hard=0.0)


def video(material="Sand", index=0, options=OPTIONS, number=0):
    return Video(options, VideoPlan(index, "v", 0, (ObjectRef(material, number),), (0, 0, 0, 0)))


def test_a_place_of_the_ground_is_seen_where_it_is():
    """A black spot at the contact, and one 40 mm beside it along a side of the view."""
    made = next(v for v in map(video, ["Sand"] * 9, range(9)) if max(v.camera.at) < 0.4)
    frame, camera = first_contact(OPTIONS, 0), made.camera
    camera.tilt, camera.blur, camera.noise = (0.0, 0.0), 0.0, 0.0
    camera.hand = camera.edge = camera.shadow = None
    ground, state = made.surface(0).ground, made.state(frame)
    at = f32((np.arange(len(ground.height))) * ground.px)
    beside = 40 * math.cos(camera.turn), 40 * math.sin(camera.turn)
    found = []
    for x, y in (state.position, np.add(state.position, beside)):
        wrap = lambda a: (a + GROUND_MM / 2) % GROUND_MM - GROUND_MM / 2
        far = np.hypot(wrap(at[:, None] - y), wrap(at[None] - x))
        black = np.where(far[..., None] < 6, 0.0, 0.9)
        spot = replace(ground, albedo=f32(black) * np.ones(3, np.float32), height=0 * far)
        made.surface = lambda contact, g=spot: replace(
            make_object(OPTIONS, made.plan.objects[0]), ground=g
        )
        made._lit.clear()
        dark = 255.0 - made.vision(frame).mean(2)
        dark = np.maximum(dark - np.median(dark) - 20, 0)
        y_px, x_px = grid(64)
        found.append([float((dark * a).sum() / dark.sum()) for a in (y_px, x_px)])
    assert np.allclose(found[0], camera.at, atol=0.04)
    step = np.subtract(found[1], found[0])
    assert np.allclose(step, [0, 80 / camera.view], atol=0.05)
    assert 150 <= camera.view <= 400


def test_views_have_the_width_that_is_asked_for():
    views = [
        video(index=k, options=replace(OPTIONS, view_mm=(60, 80))).camera.view for k in range(9)
    ]
    assert 60 <= min(views) < max(views) <= 80


@pytest.mark.parametrize(
    ("material", "high"), [("Brick", (62, 78)), ("Tile", (40, 300))], ids=["brick", "tile"]
)
def test_joints_are_of_true_size(material, high):
    """The height of courses, by the strongest period of the ground's mean profile."""
    ground = make_object(OPTIONS, ObjectRef(material, 1)).ground
    assert ground.side_mm == GROUND_MM
    assert ground.height.shape == ground.albedo.shape[:2] == (256, 256)
    power = np.abs(np.fft.rfft(ground.height.mean(1)))[2:]
    courses = 2 + int(power.argmax())
    assert GROUND_MM / high[1] - 0.5 <= courses <= GROUND_MM / high[0] + 0.5


def test_the_pad_lies_flat_and_feels_the_ground():
    made = video("Grass")
    state = made.state(first_contact(OPTIONS, 0))
    relief = made.relief(state)
    for axis in grid(64):
        assert abs(float((relief * axis).mean())) < 1e-4
    body = made.surface(0)
    made.surface = lambda contact: replace(
        body, ground=replace(body.ground, height=0 * body.ground.height)
    )
    assert np.abs(made.relief(state) - relief).max() > 0.05


def test_the_relief_of_a_material_is_scaled_once(monkeypatch):
    """What the ground holds of the fine relief, and the rest of it, add up to the whole."""
    deviations = []
    for factor in (0.5, 1.0):
        monkeypatch.setitem(TOUCHES, "Sand", touch_of("Sand")._replace(relief=factor, waves=0.0))
        made = video("Sand", options=replace(OPTIONS, seed=int(2 * factor), tile=256))
        monkeypatch.setattr("palpate.sim.ground.WAVES", {"Sand": 0.0})
        state = replace(made.state(first_contact(OPTIONS, 0)), load=0.2)
        deviations.append(float(made.relief(state).std()))
    whole = make_object(replace(OPTIONS, scale="near", seed=2, tile=256), ObjectRef("Sand", 0))
    assert deviations[1] == pytest.approx(float(whole.height.std()), rel=0.5)
    assert 0.25 < deviations[0] / deviations[1] < 0.9


def test_loads_belong_to_materials():
    loads = {}
    for name in ("Rock", "Brick"):
        near = video(name, options=replace(OPTIONS, scale="near")).contacts
        real = video(name).contacts
        loads[name] = np.array([r.load / n.load for r, n in zip(real, near, strict=True)])
        assert (loads[name] <= touch_of(name).load * 1.0001).all()
    assert loads["Brick"].mean() > 1.5 * loads["Rock"].mean()


def test_every_material_has_a_ground_and_the_fitted_ones_are_named():
    assert {*TOUCHES} == {*MATERIALS}
    assert {m for m, t in TOUCHES.items() if t.fitted} == {
        *("Rock", "Grass", "Brick", "Natural Fabric", "Wood")
    }
    for k, name in enumerate(MATERIALS):
        made = video(name, k)
        photo, touch = made.vision(6), made.tactile(6)
        assert photo.std() > 3
        assert np.abs(touch.astype(int) - made.background()).max() > 10
