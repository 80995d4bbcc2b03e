"""The leak that a world says it has is the one that an audit of its import finds, sample by sample."""

import csv
import dataclasses

import pytest

from palpate.data.importing import import_dataset
from palpate.leakage.audit import inspect_split
from palpate.sim import PRESETS, write_world

BASE = dataclasses.replace(
    PRESETS["tiny"], objects_per_material=4, two_videos=0.5, touches_per_video=3, frames_per_touch=3, mixed=0.3, size=32, tile=64
)


def truth(folder):
    return {row.pop("id"): row for row in csv.DictReader((folder / "leak.csv").read_text().splitlines())}


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
        assert audit.test_samples_in_shared_groups == sum(int(row[column]) for row in known.values())
        assert audit.groups_shared == told[f"{group}{'es' if group == 'touch' else 's'}_shared"]
        assert (audit.gap_min, audit.gap_median, audit.gap_max) == (told["gap_min"], told["gap_median"], told["gap_max"])
        gaps = dict(zip(found.table["id"], found.table["gap"], strict=True))
        assert gaps == {i: int(row["gap"]) if row["gap"] else None for i, row in known.items()}
    audit = inspect_split(imported.manifest, split).audit
    assert audit.test_samples_in_shared_groups == told["test_frames_in_shared_videos"]
    assert audit.leaked_fraction == pytest.approx(told["leaked_fraction"], abs=1e-5)
    expected = {"frame": (1, True, True), "touch": (6, True, False), "none": (None, False, False)}[leak]
    assert (told["gap_min"], told["videos_shared"] > 0, told["touches_shared"] > 0) == expected
    assert told["objects_shared"] > 0  # a quarter of the objects have two videos, so even a cut by video shares some


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
