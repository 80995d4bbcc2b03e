"""Options, presets and plans of a world."""

import dataclasses
import json
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
    Video,
    WorldOptions,
    load_options,
    plan_world,
    seen_by_mini,
)
from palpate.sim.motion import make_contacts
from palpate.sim.objects import make_object
from palpate.sim.plan import ObjectRef, contact_frames, first_contact, written_frames

FIELDS = {field.name: field.metadata for field in dataclasses.fields(WorldOptions)}
#: Presets and their digests when the shipped models were trained.
#: Of the presets, and of the same with label captions, which were once the default.
DIGESTS = {
    "tiny": "b8337572e22d",
    "demo": "b2192b9672b6",
    "pretrain": "93b0208b0f78",
    "small": "38be6cd2b3a2",
    "full": "2bcc3fe740d5",
}


def named(kind):
    return [name for name, limits in FIELDS.items() if limits["kind"] == kind]


@pytest.mark.parametrize("name", named("number"))
def test_numbers_have_a_range(name):
    low, high = FIELDS[name]["low"], FIELDS[name]["high"]
    for value in (low - 1, high + 1, "many", None, True, float("nan"), 10**400):
        with pytest.raises(PalpateError, match=f"`{name}` must be a .*number from") as error:
            WorldOptions(**{name: value})
        assert len(str(error.value)) < 400
    extra = {"gel_mm": {"load_mm": (0.1, 0.2)}}.get(name, {})
    for value in (low, high):
        assert getattr(WorldOptions(**{**extra, name: value}), name) == value


@pytest.mark.parametrize("name", named("span"))
def test_spans_are_two_numbers_in_order(name):
    low, high = FIELDS[name]["low"], FIELDS[name]["high"]
    for value in ((high, low), (low - 1, high), (low,), (low, high, high), "wide", None, low):
        with pytest.raises(PalpateError, match=name):
            WorldOptions(**{name: value})
    middle = (low + high) / 2
    extra = {"pad_mm": 5.0} if name == "view_mm" else {}
    for value in ((low, middle), [low, middle]):
        assert getattr(WorldOptions(**{name: value, **extra}), name) == tuple(value)


@pytest.mark.parametrize("name", named("series"))
def test_series_are_a_few_numbers(name):
    low, high = FIELDS[name]["low"], FIELDS[name]["high"]
    for value in ((low - 1,), (low, high + 1), (low,) * 9, ("a",), None):
        with pytest.raises(PalpateError, match=name):
            WorldOptions(**{name: value})
    assert getattr(WorldOptions(**{name: (low, high)}), name) == (low, high)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gel_mm": 0.5, "load_mm": (0.1, 0.6)}, "`load_mm` must not exceed the gel"),
        ({"pad_mm": 20.0, "view_mm": (16.0, 40.0)}, "The pad must lie in the photo"),
        ({"leak": "some"}, "`leak` must be one of"),
        ({"look": np.array(["gelsight"])}, "`look` must be one of"),
        ({"materials": (1,)}, "must be names of materials"),
        ({"materials": True}, "a count from 1 to 20"),
        ({"materials": 21}, "a count from 1 to 20"),
        ({"materials": ()}, "must be names"),
        ({"materials": ("Wod",)}, "Did you mean 'Wood'"),
        ({"materials": ("Wood", "Wood")}, "each material once"),
        ({"layout": "videos", "size": 33}, r"must be even.*size=34"),
        ({"layout": "videos", "free_written": "background"}, "`free_written` must be 'all'"),
        ({"size": 257}, r"from 16 to 256\. Got 257\. E\.g\. size=256"),
        ({"size": 64.4}, r"whole number.*size=64"),
        ({"view_mm": (40.0, 30.0)}, r"lower end first.*view_mm=\(30.0, 40.0\)"),
    ],
)
def test_inconsistent_options_are_rejected_with_an_example(settings, message):
    with pytest.raises(PalpateError, match=message):
        WorldOptions(**settings)


def test_several_mistakes_are_listed_together():
    with pytest.raises(ProblemsError) as error:
        WorldOptions(size=3, hard=2.0)
    assert [p.kind for p in error.value.problems] == ["bad-option"] * 2
    assert pickle.loads(pickle.dumps(error.value)).to_json() == error.value.to_json()


def test_one_meaning_has_one_digest():
    names = ("Concrete", "Brick", "Rubber", "Rock")
    first = WorldOptions(gel_mm=2, view_mm=(30, 40), materials=4)
    second = WorldOptions(gel_mm=2.0, view_mm=[30.0, 40.0], materials=names)
    assert first == second
    assert first.digest == second.digest
    assert first.materials == names
    assert WorldOptions(tile=512).digest != WorldOptions().digest


def test_presets_keep_their_digests_and_lengths():
    assert {name: options.digest[:12] for name, options in PRESETS.items()} == DIGESTS
    frames = {
        name: len(plan_world(o)) * o.contacts_per_video * o.frames_per_contact
        for name, o in PRESETS.items()
    }
    assert frames == {"tiny": 32, "demo": 1200, "pretrain": 4000, "small": 8000, "full": 36000}
    assert DEFAULT in PRESETS
    assert not [name for name, options in PRESETS.items() if seen_by_mini(options)]
    assert seen_by_mini(WorldOptions(seed=MINI_SEEDS[0]))


def record_of(world, **changes):
    content = {"version": 2, "options": dataclasses.asdict(world), "options_digest": world.digest}
    return {"format": "palpate-world/3", **content, **changes}


def test_options_are_read_from_the_record_of_a_world(tmp_path):
    options = WorldOptions(seed=5, view_mm=(31, 40), materials=3, layout="hct", size=16)
    path = tmp_path / "world.json"
    path.write_text(json.dumps(record_of(options)))
    assert load_options(path) == load_options(tmp_path) == options
    old = record_of(options, format="palpate-world/2", options=options.format_2())
    assert {"touches_per_video", "frames_per_touch"} < set(old["options"])
    path.write_text(json.dumps(old))
    assert load_options(path) == options


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"options": {"sed": 5}}, "Did you mean 'seed'"),
        ({"options": {"qqqq": 5}}, "Known: seed, size"),
        ({"options": {"captions": "label"}}, "captions is 'felt'. Got 'label'"),
        ({"options": {"seed": 6}}, "digest in .* must match"),
        ({"options": [1]}, "must hold the options"),
        ({"format": "palpate-split/1"}, "must be the record of a world"),
        ({"version": 1}, "must be of version 2 of the world. Got version 1"),
        ({"options": {"size": 5}}, "`size` must be a whole number"),
        ({"options": {"size": 5, "hard": 7.0}}, "Every option of the world"),
    ],
)
def test_files_that_hold_no_options_are_rejected(changes, message, tmp_path):
    path = tmp_path / "world.json"
    path.write_text(json.dumps(record_of(WorldOptions(seed=5), **changes)))
    with pytest.raises(PalpateError, match=message):
        load_options(path)
    with pytest.raises(PalpateError, match="must exist"):
        load_options(tmp_path / "nowhere.json")


def test_a_quarter_of_the_objects_of_small_have_two_videos():
    videos = {}
    for plan in plan_world(PRESETS["small"]):
        videos[plan.objects[0]] = videos.get(plan.objects[0], 0) + 1
    assert set(videos.values()) == {1, 2}
    for material in MATERIALS:
        counts = [count for ref, count in videos.items() if ref.material == material]
        assert counts.count(2) == len(counts) // 4


def test_motion_and_camera_obey_their_options():
    off = ("revisit_mm", "jump", "tilt", "shear", "mixed", "hand", "shadow", "edge", "stains")
    fixed = {"slide_mm": (0.0,), "load_mm": (0.2, 0.2), "view_mm": (31.0, 32.0), "blur_px": (0.5,)}
    fixed |= {"curved": 1.0, "radius_mm": (40.0, 40.0), "hard": 1.0}
    calm = WorldOptions(**dict.fromkeys(off, 0.0), **fixed, materials=2, tile=64, size=16)
    for plan in plan_world(calm):
        video = Video(calm, plan)
        contacts = make_contacts(calm, plan)
        assert len({contact.place for contact in contacts}) == 1
        assert all(contact.load == pytest.approx(0.2) for contact in contacts)
        assert all(c.slide == c.tilt == c.shear == (0.0, 0.0) for c in contacts)
        camera, curvature = video.camera, video.object_of(0).curvature
        assert (camera.hand, camera.shadow, camera.edge, camera.blur) == (None, None, None, 0.5)
        assert 31.0 <= camera.view <= 32.0
        assert curvature in (pytest.approx(1 / 40), pytest.approx(-0.3 / 40))
    far = dataclasses.replace(calm, jump=1.0, slide_mm=(5.0,), hand=1.0)
    plans = plan_world(far)
    assert len({c.place for c in make_contacts(far, plans[0])}) == far.contacts_per_video
    assert any(Video(far, plan).camera.hand is not None for plan in plans)


def test_plans_are_unique_sorted_and_complete():
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
        assert list(plan.object_index) == sorted(plan.object_index)
        assert set(plan.object_index) == set(range(len(plan.objects)))
    guests = [ref for plan in mixed for ref in plan.objects[1:]]
    assert len(set(guests)) == len(guests)  # in no other video
    assert min(ref.number for ref in guests) >= options.objects_per_material
    for single in ({"objects_per_video": 1, "mixed": 1.0}, {"contacts_per_video": 1, "mixed": 1.0}):
        assert all(len(plan.objects) == 1 for plan in plan_world(WorldOptions(**single)))


def test_frames_are_numbered_as_in_a_recording():
    options = WorldOptions(contacts_per_video=2, frames_per_contact=3, free_frames=6)
    assert options.video_length == 18
    assert list(contact_frames(options, 1)) == [15, 16, 17]
    assert written_frames(options) == list(range(18))
    sparse = dataclasses.replace(options, free_written="background")
    assert written_frames(sparse) == [2, 6, 7, 8, 11, 15, 16, 17]
    assert first_contact(sparse, 0) - 4 == 2


def test_worlds_of_different_seeds_share_nothing():
    demo, pretrain = (dataclasses.replace(PRESETS[n], tile=64) for n in ("demo", "pretrain"))
    assert not {p.name for p in plan_world(demo)} & {p.name for p in plan_world(pretrain)}
    reliefs = [make_object(o, ObjectRef("Rock", 0)).surface.height for o in (demo, pretrain)]
    assert abs(np.corrcoef(reliefs[0].ravel(), reliefs[1].ravel())[0, 1]) < 0.5
