"""Options, presets and plans of a world."""

import dataclasses
import re

import numpy as np
import pytest

from forge.errors import fails
from palpate.core import digest_json
from palpate.sim import DEFAULT, MATERIALS, MINI_SEEDS, PRESETS, WorldOptions, plan_world
from palpate.sim.options import LATER, PAIRS, RANGES, VERSION
from palpate.sim.plan import ObjectRef, contact_frames, first_contact, written_frames
from palpate.sim.video import make_object


@pytest.mark.parametrize("name", RANGES)
def test_numbers_have_a_range(name):
    low, high = RANGES[name]
    good = [(low, high)] if name in PAIRS else [low, high]
    bad = [(high, low), (low, low, low), low, (low, "many")] if name in PAIRS else [(low, high)]
    for value in (low - 1, high + 1, "many", None, float("nan"), *bad):
        fails(f"`{name}` must be .*numbers? from", WorldOptions, **{name: value})
    for value in good:
        assert getattr(WorldOptions(**{name: value}), name) == value


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"leak": "some"}, "`leak` must be one of"),
        ({"materials": 21}, "a count from 1 to 20"),
        ({"materials": ()}, "must be different names"),
        ({"materials": ("Wod",)}, "must be names of materials. Got Wod. Names: Concrete"),
        ({"materials": ("Wood", "Wood")}, "must be different names"),
        ({"layout": "videos", "size": 33}, "must be even"),
        ({"size": 64.4}, "whole number"),
    ],
)
def test_inconsistent_options_are_rejected(settings, message):
    fails(message, WorldOptions, **settings)


def test_one_meaning_has_one_digest():
    names = ("Concrete", "Brick", "Rubber", "Rock")
    first, second = WorldOptions(hard=1, materials=4), WorldOptions(hard=1.0, materials=names)
    assert first == second
    assert first.digest == second.digest
    assert first.materials == names
    for other in ({"tile": 512}, {"pad_mm": 20}, {"load_mm": (0.03, 0.5)}, {"quality": 60}):
        assert WorldOptions(**other).digest != WorldOptions().digest
    # Fields that came later keep the digests of the worlds that there were.
    older = {k: v for k, v in dataclasses.asdict(WorldOptions()).items() if k not in LATER}
    named = digest_json({"version": VERSION, "options": older})
    assert WorldOptions(phases="spaced").digest == named != WorldOptions().digest


def test_presets_have_their_lengths_and_no_seed_of_the_shipped_models():
    frames = {
        name: len(plan_world(o)) * o.contacts_per_video * o.frames_per_contact
        for name, o in PRESETS.items()
    }
    assert frames == {"tiny": 32, "demo": 1200, "pretrain": 4000, "small": 8000, "full": 36000}
    assert DEFAULT in PRESETS
    assert not [name for name, options in PRESETS.items() if options.seed in MINI_SEEDS]


def test_a_quarter_of_the_objects_of_small_have_two_videos():
    videos = {}
    for plan in plan_world(PRESETS["small"]):
        videos[plan.objects[0]] = videos.get(plan.objects[0], 0) + 1
    assert set(videos.values()) == {1, 2}
    for material in MATERIALS:
        counts = [count for ref, count in videos.items() if ref.material == material]
        assert counts.count(2) == len(counts) // 4


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
    single = WorldOptions(contacts_per_video=1, mixed=1.0)
    assert all(len(plan.objects) == 1 for plan in plan_world(single))


def test_frames_are_numbered_as_in_a_recording():
    options = WorldOptions(contacts_per_video=2, frames_per_contact=3, free_frames=6)
    assert options.video_length == 18
    assert list(contact_frames(options, 1)) == [15, 16, 17]
    assert written_frames(options) == list(range(18))
    sparse = dataclasses.replace(options, free_written="background")
    assert written_frames(sparse) == [2, 6, 7, 8, 11, 15, 16, 17]
    assert first_contact(sparse, 0) - 4 == 2
    assert written_frames(dataclasses.replace(sparse, layout="videos")) == list(range(18))


def test_worlds_of_different_seeds_share_nothing():
    demo, pretrain = (dataclasses.replace(PRESETS[n], tile=64) for n in ("demo", "pretrain"))
    assert not {p.name for p in plan_world(demo)} & {p.name for p in plan_world(pretrain)}
    reliefs = [make_object(o, ObjectRef("Rock", 0)).height for o in (demo, pretrain)]
    assert abs(np.corrcoef(reliefs[0].ravel(), reliefs[1].ravel())[0, 1]) < 0.5
