"""Options, presets and plans."""

import dataclasses
import re

import numpy as np
import pytest

from palpate.core import PalpateError, ProblemsError
from palpate.sim import MATERIALS, PRESETS, WorldOptions, plan_world
from palpate.sim.objects import make_object
from palpate.sim.options import RANGES
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


@pytest.mark.parametrize(
    ("settings", "message"),
    [
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
    assert WorldOptions(materials=4).digest == WorldOptions(materials=("Concrete", "Brick", "Rubber", "Rock")).digest
    assert WorldOptions(tile=512).digest != WorldOptions().digest


def test_presets_have_the_frames_that_their_row_says():
    contact = {name: len(plan_world(o)) * o.touches_per_video * o.frames_per_touch for name, o in PRESETS.items()}
    assert contact == {"tiny": 32, "demo": 1200, "pretrain": 4000, "small": 8000}
    assert len(plan_world(PRESETS["demo"])) == 100
    assert PRESETS["demo"] == WorldOptions()


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
    for options in (WorldOptions(objects_per_video=1, mixed=1.0), WorldOptions(touches_per_video=1, mixed=1.0), WorldOptions(mixed=0.0)):
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
    first, second = (make_object(dataclasses.replace(PRESETS[name], tile=64), ObjectRef("Rock", 0)) for name in ("demo", "pretrain"))
    assert first.ref == second.ref
    assert np.abs(np.corrcoef(first.surface.height.ravel(), second.surface.height.ravel())[0, 1]) < 0.5
