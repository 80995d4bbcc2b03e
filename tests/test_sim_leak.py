"""The leak that a world says it has is the one that an audit of its import finds, sample by sample."""

import csv
import dataclasses
from collections import Counter

import pytest

from palpate.data.importing import import_dataset
from palpate.leakage.audit import inspect_split
from palpate.sim import PRESETS, WorldOptions, plan_world, write_world
from palpate.sim.lists import cut
from palpate.sim.naming import contact_rows

BASE = dataclasses.replace(
    PRESETS["tiny"],
    objects_per_material=4,
    two_videos=0.5,
    touches_per_video=3,
    frames_per_touch=3,
    mixed=0.3,
    size=32,
    tile=64,
)


def truth(folder):
    return {
        row.pop("id"): row for row in csv.DictReader((folder / "leak.csv").read_text().splitlines())
    }


@pytest.mark.parametrize(("layout", "look"), [("frames", "gelsight"), ("hct", "digit")])
@pytest.mark.parametrize("leak", ["frame", "touch", "none"])
def test_the_audit_finds_exactly_the_leak_of_the_world(layout, look, leak, tmp_path):
    options = dataclasses.replace(BASE, layout=layout, look=look, leak=leak)
    record = write_world(tmp_path / "w", options)
    imported = import_dataset(tmp_path / "w", tmp_path / "i")
    split = imported.splits["Orig"]
    known, told = truth(tmp_path / "w"), record.leak
    assert set(known) == set(split.ids("test"))
    for group, column in (
        ("video", "video_in_train"),
        ("touch", "touch_in_train"),
        *([("object", "object_in_train")] * (layout == "frames")),
    ):
        found = inspect_split(imported.manifest, split, group=group)
        audit = found.audit
        assert audit.test_samples_in_shared_groups == sum(
            int(row[column]) for row in known.values()
        )
        assert audit.groups_shared == told[f"{group}{'es' if group == 'touch' else 's'}_shared"]
        assert (audit.gap_min, audit.gap_median, audit.gap_max) == (
            told["gap_min"],
            told["gap_median"],
            told["gap_max"],
        )
        gaps = dict(zip(found.table["id"], found.table["gap"], strict=True))
        assert gaps == {i: int(row["gap"]) if row["gap"] else None for i, row in known.items()}
    audit = inspect_split(imported.manifest, split).audit
    assert audit.test_samples_in_shared_groups == told["test_frames_in_shared_videos"]
    assert audit.leaked_fraction == pytest.approx(told["leaked_fraction"], abs=1e-5)
    expected = {"frame": (1, True, True), "touch": (6, True, False), "none": (None, False, False)}[
        leak
    ]
    assert (told["gap_min"], told["videos_shared"] > 0, told["touches_shared"] > 0) == expected
    assert (
        told["objects_shared"] > 0
    )  # a quarter of the objects have two videos, so even a cut by video shares some


def test_the_nearest_train_sample_is_named(tmp_path):
    options = dataclasses.replace(BASE, leak="frame", layout="raw", size=16)
    write_world(tmp_path / "w", options)
    from palpate.core import Split

    split = Split.load(tmp_path / "w" / "splits" / "Orig.json")
    place = lambda name: (name.rsplit("/", 1)[0], int(name.rsplit("/", 1)[1]))  # noqa: E731
    train = [place(name) for name in split.ids("train")]
    for name, row in truth(tmp_path / "w").items():
        video, frame = place(name)
        near = [(abs(frame - f), f) for v, f in train if v == video]
        assert (row["nearest"] == "") is (not near)
        if near:
            assert (int(row["gap"]), place(row["nearest"])[1]) == min(near)
            assert place(row["nearest"]) in train


def cut_of(options):
    plans = plan_world(options)
    return cut(options, plans, list(contact_rows(options, plans)))


@pytest.mark.parametrize("leak", ["frame", "touch", "none"])
def test_a_share_near_0_or_1_leaves_each_list_one_unit_and_the_other_the_rest(leak):
    options = WorldOptions(
        materials=2,
        objects_per_material=2,
        touches_per_video=1,
        frames_per_touch=1,
        leak=leak,
        mixed=0.0,
    )
    low, high = (cut_of(dataclasses.replace(options, test=share)) for share in (0.01, 0.99))
    assert (len(low[0]), len(low[1])) == (3, 1)
    assert (len(high[0]), len(high[1])) == (1, 3)


@pytest.mark.parametrize("seed", range(5))
def test_a_cut_by_video_takes_its_share_of_every_material(seed):
    options = WorldOptions(
        seed=seed, materials=5, objects_per_material=8, leak="none", test=0.25, mixed=0.0
    )
    taken = Counter(
        name
        for name, _ in {
            (row.video.objects[0].material, row.video.index) for row in cut_of(options)[1]
        }
    )
    assert taken == dict.fromkeys(options.names, 2)
