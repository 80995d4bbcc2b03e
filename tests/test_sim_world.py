"""One world in every form: Touch and Go's tree, videos, and samples rendered without files."""

import csv
import dataclasses
import io
import itertools
import pickle
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from palpate.core import PalpateError, Split
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest
from palpate.leakage import audit
from palpate.sim import MATERIALS, PRESETS, Video, World, WorldOptions, plan_world, write_world
from palpate.sim.plan import contact_frames, contact_rows

TINY = dataclasses.replace(PRESETS["tiny"], size=32, tile=64, mixed=0.3, two_videos=0.25)
LEAKY = dataclasses.replace(
    TINY,
    size=16,
    objects_per_material=4,
    two_videos=0.5,
    contacts_per_video=3,
    frames_per_contact=3,
)
IMAGES = ("vision", "tactile", "background")
CELLS = ("id", "video", "frame", "contact", "object", "material", "text", "sensor")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("frames") / "w", TINY)


def read_list(path):
    rows = (line.split(",") for line in path.read_text().split("\n") if line)
    return [(path, int(label)) for path, label in rows]


def test_the_tree_has_the_layout_of_touch_and_go(frames):
    folder, plans = frames.folder, plan_world(TINY)
    assert sorted(p.name for p in (folder / "dataset").iterdir()) == [plan.name for plan in plans]
    label = read_list(folder / "label.txt")
    assert label == [
        (f"{row.video.name}/{row.frame:010d}.jpg", MATERIALS[row.object.material].label)
        for row in contact_rows(TINY, plans)
    ]
    parts = {part: read_list(folder / f"{part}.txt") for part in ("train", "test")}
    assert dict(parts["train"] + parts["test"]) == dict(label)
    assert all(rows != sorted(rows) for rows in parts.values())  # shuffled
    assert not (folder / "test.txt").read_text().endswith("\n")
    categories = (folder / "category_reference.txt").read_text().splitlines()
    assert "Synthetic Fabric: 8" in categories
    assert len(categories) == 20
    images = sorted(p.name for p in folder.glob(f"dataset/{plans[0].name}/gelsight_frame/*"))
    assert images == [f"{f:010d}.jpg" for f in range(TINY.video_length)]
    sparse = dataclasses.replace(TINY, free_written="background")
    assert len(World(sparse)) == len(label)


def test_the_manifest_is_that_of_an_import_and_more(frames, tmp_path):
    manifest = Manifest.load(frames.folder).require_valid()
    imported = import_dataset(frames.folder, tmp_path / "i")
    rows = imported.manifest.take(manifest.ids)
    assert len(rows) == len(imported.manifest)
    for name in ("video", "frame", "contact", "session", "text", "domain", *IMAGES):
        assert manifest.column(name) == rows.column(name), name
    assert not any(manifest.table[name].null_count() for name in ("object", "material", "sensor"))
    split = Split.load(frames.folder / "splits" / "Orig.json")
    assert dict(split.parts) == dict(imported.splits["Orig"].parts)
    assert split.manifest == manifest.digest
    assert manifest.facts["synthetic"] == "yes"


@pytest.mark.parametrize("leak", ["frame", "contact", "none"])
def test_an_audit_reports_exactly_the_leak_of_the_world(leak, tmp_path):
    options = dataclasses.replace(LEAKY, leak=leak)
    counts = write_world(tmp_path / "w", options).leak
    imported = import_dataset(tmp_path / "w", tmp_path / "i")
    split = imported.splits["Orig"]
    lines = (tmp_path / "w" / "leak.csv").read_text().splitlines()
    truth = {row.pop("id"): row for row in csv.DictReader(lines)}
    assert set(truth) == set(split.ids("test"))
    for group in ("video", "contact", "object"):
        result = audit(imported.manifest, split=split, by=group, images=False)
        shared = sum(int(row[f"{group}_in_train"]) for row in truth.values())
        assert result.test_samples_in_shared_groups == shared
        assert result.groups_shared == counts[f"{group}s_shared"]
        gaps = tuple(counts[f"gap_{name}"] for name in ("min", "median", "max"))
        assert (result.gap_min, result.gap_median, result.gap_max) == gaps
    shortest = {"frame": 1, "contact": 6, "none": None}[leak]
    assert counts["gap_min"] == shortest
    assert (counts["contacts_shared"] > 0) is (leak == "frame")
    assert counts["objects_shared"] > 0  # some objects have two videos
    train = [(i.rsplit("/", 1)[0], int(i.rsplit("/", 1)[1])) for i in split.ids("train")]
    for name, row in truth.items():
        video, frame = name.rsplit("/", 1)
        near = [(abs(int(frame) - f), f) for v, f in train if v == video]
        if near:
            assert (int(row["gap"]), int(row["nearest"].rsplit("/", 1)[1])) == min(near)
        else:
            assert (row["gap"], row["nearest"]) == ("", "")


def cut_of(options):
    return World(options).parts.values()


@pytest.mark.parametrize("leak", ["frame", "contact", "none"])
def test_a_share_near_0_or_1_leaves_each_list_one_unit(leak):
    few = {"materials": 2, "objects_per_material": 2, "contacts_per_video": 1}
    options = WorldOptions(**few, frames_per_contact=1, leak=leak, mixed=0.0)
    for share, sizes in ((0.01, [3, 1]), (0.99, [1, 3])):
        assert [len(part) for part in cut_of(dataclasses.replace(options, test=share))] == sizes


def test_a_cut_by_video_takes_its_share_of_every_material():
    options = WorldOptions(materials=5, objects_per_material=8, leak="none", mixed=0.0)
    videos = {(row.object.material, row.video.index) for row in list(cut_of(options))[1]}
    assert Counter(name for name, _ in videos) == dict.fromkeys(options.names, 2)


def test_videos_hold_the_same_frames(tmp_path):
    av = pytest.importorskip("av")
    options = dataclasses.replace(TINY, materials=("Brick",), layout="videos")
    write_world(tmp_path / "w", options)
    video = Video(options, 1)
    for name, render in (("video.mp4", video.vision), ("gelsight.mp4", video.tactile)):
        with av.open(str(tmp_path / "w" / "dataset" / video.plan.name / name)) as file:
            assert file.streams.video[0].average_rate == 30
            decoded = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        assert len(decoded) == options.video_length
        for k, frame in enumerate(decoded):
            assert np.abs(frame.astype(float) - render(k)).mean() < 14


@pytest.mark.parametrize("options", [TINY, dataclasses.replace(TINY, look="digit")])
def test_samples_rendered_alone_equal_written_files(options, tmp_path):
    write_world(tmp_path / "w", options)
    manifest, world = Manifest.load(tmp_path / "w"), World(options)
    assert world.ids == manifest.ids
    for row, sample in zip(manifest.table.iter_rows(named=True), world, strict=True):
        assert {name: sample[name] for name in CELLS} == {name: row[name] for name in CELLS}
        assert sample["label"] == MATERIALS[row["material"]].label
        for name in IMAGES:
            path, file = manifest.path(row[name]), io.BytesIO()
            Image.fromarray(sample[name]).save(file, "JPEG", quality=95, subsampling=0)
            assert path.read_bytes() == file.getvalue()
    for k in np.random.default_rng(0).permutation(len(world))[:8]:  # random access, small cache
        np.testing.assert_array_equal(World(options, cache=1)[k]["tactile"], world[k]["tactile"])
    assert world[-1]["id"] == world.ids[-1]


def test_captions_and_objects_follow_the_object_in_contact():
    options = dataclasses.replace(TINY, mixed=1.0, contacts_per_video=4)
    for plan in plan_world(options):
        video, names = Video(options, plan), {ref.name for ref in plan.objects}
        assert 2 <= len(names) <= 3
        assert video.text(0) != video.text(3)
        assert contact_frames(options, 3)[0] < options.video_length


def test_a_world_is_a_data_set_for_loaders():
    world = World(dataclasses.replace(PRESETS["tiny"], size=16, tile=64), cache=2)
    empty = len(pickle.dumps(world))
    first = world[0]
    assert len(pickle.dumps(world)) == empty < 3000  # without rendered videos
    copy = pickle.loads(pickle.dumps(world))
    np.testing.assert_array_equal(copy[0]["vision"], first["vision"])
    data = pytest.importorskip("torch.utils.data")
    batches = list(data.DataLoader(world, batch_size=8, num_workers=0))
    assert [tuple(batch["vision"].shape) for batch in batches] == [(8, 16, 16, 3)] * 4
    assert list(itertools.chain(*(batch["id"] for batch in batches))) == world.ids
    assert world.video.cache_info().currsize == 2


def test_missing_samples_frames_videos_and_presets_are_rejected():
    world = World("tiny")
    with pytest.raises(IndexError):
        world[32]
    for words, call in (
        *(("must be 0 to 31", lambda k=k: world[k]) for k in (32, -33, 10**9)),
        ("`cache` must be at least 1", lambda: World(cache=0)),
        ("one of tiny, demo", lambda: World("large")),
        ("0 to 13", lambda: Video(world.options, 0).vision(14)),
        ("0 to 7", lambda: Video(world.options, 8)),
    ):
        with pytest.raises(PalpateError, match=words):
            call()
