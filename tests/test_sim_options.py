"""Options, presets and plans."""

import dataclasses
import pickle
import re

import numpy as np
import pytest

from palpate.core import PalpateError, ProblemsError
from palpate.sim import (
    DEFAULT,
    MATERIALS,
    MINI_SEEDS,
    PRESETS,
    Material,
    Video,
    WorldOptions,
    plan_world,
    seen_by_mini,
)
from palpate.sim.balance import LEAST, TOUCH_AND_GO_FRAMES, objects_of
from palpate.sim.motion import make_touches
from palpate.sim.objects import make_object
from palpate.sim.options import CHOICES, PAIRS, RANGES, SERIES
from palpate.sim.plan import ObjectRef, contact_frames, first_contact, written_frames


@pytest.mark.parametrize("name", RANGES)
def test_values_out_of_range_are_refused(name):
    low, high = RANGES[name]
    for value in (low - 1, high + 1, "many", None):
        with pytest.raises(PalpateError, match=name):
            WorldOptions(**{name: value})
    extra = {"size": 16} if name == "size" else {}
    for value in (low, high):
        WorldOptions(**{**extra, name: value})


@pytest.mark.parametrize("name", PAIRS)
def test_ranges_must_be_in_order_and_within_bounds(name):
    low, high = PAIRS[name]
    for value in (
        (high, low),
        (low - 1, high),
        (low, high + 1),
        (low, float("nan")),
        (low,),
        (low, high, high),
        "wide",
        None,
        low,
        (True, high),
    ):
        with pytest.raises(PalpateError, match=name):
            WorldOptions(**{name: value})
    middle = (low + high) / 2
    extra = {"pad_mm": 5.0} if name == "view_mm" else {}
    for value in ((low, middle), (middle, middle), [low, middle]):
        assert getattr(WorldOptions(**{name: value, **extra}), name) == tuple(value)


@pytest.mark.parametrize("name", SERIES)
def test_series_must_be_numbers_within_bounds(name):
    low, high, least = SERIES[name]
    for value in (
        (low - 1,),
        (low, high + 1),
        (float("inf"),),
        (low,) * 9,
        ("a",),
        None,
        *([()] if least else []),
    ):
        with pytest.raises(PalpateError, match=name):
            WorldOptions(**{name: value})
    assert getattr(WorldOptions(**{name: (low, high)}), name) == (low, high)


def test_every_option_has_a_range_and_one_digest_per_meaning():
    tables = {*RANGES, *PAIRS, *SERIES, *CHOICES, "materials"}
    assert tables == {field.name for field in dataclasses.fields(WorldOptions)}
    assert all(name in WorldOptions.__doc__ for name in tables)
    assert (
        WorldOptions(gel_mm=2, view_mm=(30, 40)).digest
        == WorldOptions(gel_mm=2.0, view_mm=[30.0, 40.0]).digest
    )
    digests = {WorldOptions().digest}
    for name, (_, high) in {**RANGES, **PAIRS}.items():
        digests.add(
            WorldOptions(
                **{
                    name: high if name in RANGES else (high * 0.9, high * 0.9),
                    **({"load_mm": (0.1, 0.2)} if name == "gel_mm" else {}),
                }
            ).digest
        )
    assert len(digests) == 1 + len(RANGES) + len(PAIRS)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gel_mm": 0.5, "load_mm": (0.1, 0.6)}, "load_mm must not exceed gel_mm"),
        ({"pad_mm": 20.0, "view_mm": (16.0, 40.0)}, "pad must lie in the photo"),
        ({"balance": "touch-and-go", "objects_per_material": 1}, "2 objects a material"),
        ({"balance": "steep"}, "balance must be one of"),
        ({"materials": (1, 2)}, "names or a count"),
        ({"materials": True}, "materials must be 1 to"),
        ({"size": 257}, "size must be a whole number from 16 to 256"),
        ({"hard": float("nan")}, "hard must be a number"),
        ({"look": "taxim"}, "look must be one of"),
        ({"leak": "some"}, "leak must be one of"),
        ({"materials": 0}, "materials must be 1 to"),
        ({"materials": 21}, "materials must be 1 to"),
        ({"materials": ("Wod",)}, "Did you mean 'Wood'"),
        ({"materials": ()}, "at least one"),
        ({"materials": ("Wood", "Wood")}, "once"),
        ({"layout": "videos", "size": 33}, "even"),
        ({"layout": "videos", "free_written": "background"}, "all free frames"),
    ],
)
def test_bad_choices_are_refused(settings, message):
    with pytest.raises(PalpateError, match=message):
        WorldOptions(**settings)


def test_several_mistakes_are_told_at_once():
    with pytest.raises(ProblemsError) as error:
        WorldOptions(size=1, hard=2.0)
    assert len(error.value.problems) == 2


def test_a_count_of_materials_becomes_names():
    assert WorldOptions().materials == tuple(MATERIALS)
    assert WorldOptions(materials=4).materials == ("Concrete", "Brick", "Rubber", "Rock")
    assert (
        WorldOptions(materials=4).digest
        == WorldOptions(materials=("Concrete", "Brick", "Rubber", "Rock")).digest
    )
    assert WorldOptions(tile=512).digest != WorldOptions().digest


def test_presets_have_the_frames_that_their_row_says():
    contact = {
        name: len(plan_world(o)) * o.touches_per_video * o.frames_per_touch
        for name, o in PRESETS.items()
    }
    assert contact == {"tiny": 32, "demo": 1200, "pretrain": 4000, "small": 8000, "full": 36000}
    assert len(plan_world(PRESETS["demo"])) == 100
    assert DEFAULT == "small"
    assert PRESETS["demo"] == WorldOptions()


def test_no_preset_uses_a_seed_of_the_shipped_models():
    assert not [name for name, options in PRESETS.items() if seen_by_mini(options)]
    assert seen_by_mini(WorldOptions(seed=MINI_SEEDS[0]))
    assert seen_by_mini(WorldOptions(seed=MINI_SEEDS[-1]))
    assert not seen_by_mini(WorldOptions(seed=MINI_SEEDS[-1] + 1))


def test_a_quarter_of_the_objects_of_small_have_two_videos():
    for name in ("small", "full"):
        videos = {}
        for plan in plan_world(PRESETS[name]):
            videos[plan.objects[0]] = videos.get(plan.objects[0], 0) + 1
        assert set(videos.values()) == {1, 2}
        for material in MATERIALS:
            own = [count for ref, count in videos.items() if ref.material == material]
            assert sum(count == 2 for count in own) == len(own) // 4


def test_classes_are_as_unequal_as_in_touch_and_go():
    options = WorldOptions(balance="touch-and-go", objects_per_material=20)
    objects = objects_of(options)
    assert sum(objects.values()) == 400
    assert min(objects.values()) == LEAST == objects["Natural Fabric"] == objects["Sand"]
    assert sum(TOUCH_AND_GO_FRAMES.values()) == 121_861
    big = [name for name in MATERIALS if objects[name] > LEAST]
    shares = [TOUCH_AND_GO_FRAMES[name] / objects[name] for name in big]
    assert max(shares) / min(shares) < 1.5  # in proportion, up to whole numbers
    assert objects["Synthetic Fabric"] > 80
    planned = {}
    for plan in plan_world(options):
        planned[plan.objects[0].material] = planned.get(plan.objects[0].material, 0) + 1
    assert planned == objects
    assert set(
        objects_of(WorldOptions(balance="touch-and-go", objects_per_material=2)).values()
    ) == {2}
    assert set(
        objects_of(WorldOptions(materials=("Natural Fabric",), balance="touch-and-go")).values()
    ) == {5}


def test_the_shares_of_touch_and_go_are_those_of_its_lists(real_data):
    frames = dict.fromkeys(MATERIALS, 0)
    label = {material.label: name for name, material in MATERIALS.items()}
    for part in ("train", "test"):
        for line in (real_data / "touch_and_go" / "lists" / f"{part}.txt").read_text().splitlines():
            frames[label[int(line.rsplit(",", 1)[1])]] += 1
    assert frames == TOUCH_AND_GO_FRAMES


def test_a_users_material_has_the_mean_share(monkeypatch):
    monkeypatch.setitem(
        MATERIALS, "Cork", Material(20, "cork", MATERIALS["Wood"].draw, MATERIALS["Wood"].subtypes)
    )
    objects = objects_of(
        WorldOptions(
            materials=("Wood", "Sand", "Cork"), balance="touch-and-go", objects_per_material=20
        )
    )
    assert objects["Sand"] < objects["Cork"] < objects["Wood"]


def test_motion_and_camera_obey_their_options():
    calm = WorldOptions(
        materials=2,
        tile=64,
        size=16,
        revisit_mm=0.0,
        jump=0.0,
        slide_mm=(0.0,),
        tilt=0.0,
        shear=0.0,
        load_mm=(0.2, 0.2),
        mixed=0.0,
        hard=1.0,
        hand=0.0,
        shadow=0.0,
        edge=0.0,
        stains=0.0,
        view_mm=(31.0, 32.0),
        blur_px=(0.5,),
        curved=1.0,
        radius_mm=(40.0, 40.0),
    )
    for plan in plan_world(calm):
        video = Video(calm, plan)
        touches = make_touches(calm, plan)
        assert len({touch.place for touch in touches}) == 1
        assert all(touch.load == pytest.approx(0.2) for touch in touches)
        assert all(touch.slide == touch.tilt == touch.shear == (0.0, 0.0) for touch in touches)
        camera = video.camera
        assert (camera.hand, camera.shadow, camera.edge, camera.blur) == (None, None, None, 0.5)
        assert 31.0 <= camera.view <= 32.0
        assert abs(video.thing(0).curvature) == pytest.approx(1 / 40) or video.thing(
            0
        ).curvature == pytest.approx(-0.3 / 40)
    far = dataclasses.replace(calm, jump=1.0, slide_mm=(5.0,), hand=1.0)
    plan = plan_world(far)[0]
    assert len({touch.place for touch in make_touches(far, plan)}) == far.touches_per_video
    assert any(Video(far, plan).camera.hand is not None for plan in plan_world(far))


def test_views_never_show_the_tile_repeat():
    views = [
        Video(WorldOptions(tile=64, size=16, hard=hard), k).camera.view
        for hard in (0.0, 0.5, 1.0)
        for k in range(30)
    ]
    assert 30.0 <= min(views) < 32.0
    assert 43.0 < max(views) <= 45.0 < 64.0 / 2**0.5


def test_pretrain_and_demo_share_no_video_name():
    names = [{plan.name for plan in plan_world(PRESETS[name])} for name in ("demo", "pretrain")]
    assert not names[0] & names[1]


def test_plans_are_unique_sorted_and_whole():
    options = WorldOptions(objects_per_material=3, videos_per_object=2, mixed=0.5)
    plans = plan_world(options)
    assert plans == plan_world(options)
    names = [plan.name for plan in plans]
    assert names == sorted(set(names))
    assert all(re.fullmatch(r"\d{8}_\d{6}", name) for name in names)
    assert len(plans) == 20 * 3 * 2
    mixed = [plan for plan in plans if len(plan.objects) > 1]
    assert 0.3 < len(mixed) / len(plans) < 0.7
    for plan in plans:
        assert len({ref.material for ref in plan.objects}) == len(plan.objects) <= 3
        assert plan.touched[0] == 0
        assert set(plan.touched) == set(range(len(plan.objects)))
        assert list(plan.touched) == sorted(plan.touched)
    guests = [ref for plan in mixed for ref in plan.objects[1:]]
    assert len(set(guests)) == len(guests)  # in no other video
    assert min(ref.number for ref in guests) >= options.objects_per_material


def test_no_video_is_mixed_if_it_may_hold_one_object():
    for options in (
        WorldOptions(objects_per_video=1, mixed=1.0),
        WorldOptions(touches_per_video=1, mixed=1.0),
        WorldOptions(mixed=0.0),
    ):
        assert all(len(plan.objects) == 1 for plan in plan_world(options))


def test_frames_are_numbered_as_in_a_recording():
    options = WorldOptions(touches_per_video=2, frames_per_touch=3, free_frames=6)
    assert options.video_length == 18
    assert list(contact_frames(options, 1)) == [15, 16, 17]
    assert written_frames(options) == list(range(18))
    sparse = dataclasses.replace(options, free_written="background")
    assert written_frames(sparse) == [2, 6, 7, 8, 11, 15, 16, 17]
    assert first_contact(sparse, 0) - 4 == 2


def test_pretrain_and_demo_share_no_object():
    first, second = (
        make_object(dataclasses.replace(PRESETS[name], tile=64), ObjectRef("Rock", 0))
        for name in ("demo", "pretrain")
    )
    assert first.ref == second.ref
    assert (
        np.abs(np.corrcoef(first.surface.height.ravel(), second.surface.height.ravel())[0, 1]) < 0.5
    )


@pytest.mark.parametrize(
    ("given", "must", "fix"),
    [
        ({"seed": -1}, "from 0 to 2147483647", "seed=0."),
        ({"seed": 2**31}, "from 0 to 2147483647", "seed=2147483647."),
        ({"size": 257}, "from 16 to 256", "size=256."),
        ({"size": 3}, "from 16 to 256", "size=16."),
        ({"size": 64.4}, "whole number", "size=64."),
        ({"size": "large"}, "whole number", "size=16."),
        ({"hard": 1.5}, "from 0 to 1", "hard=1."),
        ({"view_mm": (30.0, 50.0)}, "from 15 to 45.25", "view_mm=(30, 45.25)."),
        ({"view_mm": 30.0}, "two numbers", "view_mm=(15, 45.25)."),
    ],
)
def test_a_value_out_of_range_is_told_the_nearest_that_is_in_it(given, must, fix):
    with pytest.raises(PalpateError) as error:
        WorldOptions(**given)
    assert must in error.value.must
    assert str(error.value).endswith(f"Pass e.g. {fix}")


def test_several_wrong_options_are_told_as_options():
    with pytest.raises(ProblemsError) as error:
        WorldOptions(size=3, hard=2.0)
    assert error.value.must == "Every option of the world must lie in its range and fit the others"
    assert [p.kind for p in error.value.problems] == ["bad-option"] * 2
    assert pickle.loads(pickle.dumps(error.value)).to_json() == error.value.to_json()
