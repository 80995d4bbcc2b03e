"""HCT's tree, raw arrays, and samples rendered without files: one world in every form."""

import csv
import dataclasses
import io
import itertools
import json
import pickle
import re

import numpy as np
import pytest
from PIL import Image

from palpate.core import PalpateError, Split, digest_folder
from palpate.data.importing import import_dataset, validate_dataset
from palpate.data.manifest import Manifest
from palpate.sim import PRESETS, World, WorldOptions, open_arrays, plan_world, write_world

TINY = dataclasses.replace(PRESETS["tiny"], size=32, tile=64, mixed=0.3, two_videos=0.25)
HCT = dataclasses.replace(TINY, layout="hct", look="digit", objects_per_material=3)
RAW = dataclasses.replace(TINY, layout="raw", size=16)
IMAGES = ("vision", "tactile", "background")


def kill_after(videos):
    def progress(what, done, total, remark=""):
        if done == videos:
            raise KeyboardInterrupt

    return progress


@pytest.fixture(scope="module")
def hct(tmp_path_factory):
    out = tmp_path_factory.mktemp("hct") / "w"
    return write_world(out, HCT)


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    out = tmp_path_factory.mktemp("raw") / "w"
    return write_world(out, RAW)


@pytest.mark.parametrize("place", [".", "hct"])
def test_hct_is_read_without_a_remark(hct, place):
    seen = validate_dataset(hct.folder / place)
    assert seen.format == "hct"
    assert (seen.samples, list(seen.missing), list(seen.invalid), list(seen.suspicious)) == (
        hct.counts["contact_frames"],
        [],
        [],
        [],
    )


@pytest.mark.parametrize("look", ["gelsight", "digit"])
def test_hct_of_either_look_shows_no_exchanged_folders(look, tmp_path):
    options = dataclasses.replace(
        HCT, look=look, materials=10, objects_per_material=4, sensors=2, touches_per_video=1
    )
    write_world(tmp_path / "w", options)
    assert list(validate_dataset(tmp_path / "w").suspicious) == []


def test_hct_has_the_layout_of_the_archive(hct):
    root = hct.folder / "hct"
    trajectories = sorted(p for p in root.glob("data*/*") if p.is_dir())
    assert len(trajectories) == hct.counts["videos"]
    assert all(
        re.fullmatch(r"data[1-3]/\d+-\d{10}\.\d\d", p.relative_to(root).as_posix())
        for p in trajectories
    )
    for folder in trajectories:
        frames = [
            sorted(p.name for p in (folder / side).iterdir()) for side in ("vision", "tactile")
        ]
        assert frames[0] == frames[1]
        assert all(re.fullmatch(r"\d+-0\.\d{4}\.jpg", name) for name in frames[0])
        assert sorted(int(name.split("-")[0]) for name in frames[0]) == list(
            range(HCT.video_length)
        )  # dense
        assert (folder / "background.png").is_file()
    for rig in {p.parent for p in trajectories}:
        pairs = {
            name: json.loads((rig / f"{name}.json").read_text())
            for name in ("contact", "not_contact")
        }
        touching, free = (
            list(zip(pairs[name]["vision"], pairs[name]["tactile"], strict=True))
            for name in ("contact", "not_contact")
        )
        assert len(touching) + len(free) == sum(1 for _ in rig.glob("*/vision/*"))
        assert all((rig / path).is_file() for pair in (*touching, *free) for path in pair)
        there = {
            part: rig / f"{part}.csv"
            for part in ("train", "test")
            if (rig / f"{part}.csv").is_file()
        }
        listed = {
            part: list(csv.DictReader(path.read_text().splitlines()))
            for part, path in there.items()
        }
        assert {(r["url"], r["tactile"]) for rows in listed.values() for r in rows} == set(touching)
        assert all(
            (rig / row["tactile_background"]).is_file() for rows in listed.values() for row in rows
        )
        assert all(
            row["caption"] == row["caption"].lower() and "." not in row["caption"]
            for rows in listed.values()
            for row in rows
        )
        talks = json.loads((rig / "finetune.json").read_text())
        assert [t["conversations"][-1]["value"] for t in talks] == [
            row["caption"] for row in listed["train"]
        ]
    numbers = [p.name.split("-")[0] for p in trajectories]
    assert len(set(numbers)) < len(numbers)  # the number is used again, as in the archive


@pytest.mark.parametrize("layout", ["frames", "hct"])
def test_the_worlds_own_manifest_is_that_of_an_import_and_knows_more(layout, tmp_path):
    options = dataclasses.replace(HCT, layout=layout)
    write_world(tmp_path / "w", options)
    own = Manifest.load(tmp_path / "w").require_valid()
    imported = import_dataset(tmp_path / "w", tmp_path / "i")
    found = imported.manifest.take(own.ids)
    assert len(found) == len(own) == len(imported.manifest)
    for name in (
        "video",
        "frame",
        "touch",
        "session",
        "text",
        "vision",
        "tactile",
        "background",
        "domain",
    ):
        assert own.column(name) == found.column(name), name
    assert own.root.resolve() == imported.manifest.root.resolve()
    assert not any(
        own.table[name].null_count() for name in ("object", "material", "sensor", "text")
    )
    split = Split.load(tmp_path / "w" / "splits" / "Orig.json")
    assert dict(split.parts) == dict(imported.splits["Orig"].parts)
    assert (
        split.manifest
        == own.digest
        == json.loads((tmp_path / "w" / "world.json").read_text())["manifest_digest"]
    )
    assert own.facts["synthetic"] == "yes"


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [HCT, RAW, dataclasses.replace(RAW, layout="frames")], ids=lambda o: o.layout
)
def test_two_workers_and_a_killed_run_give_the_same_bytes(options, tmp_path):
    write_world(tmp_path / "a", options)
    write_world(tmp_path / "b", options, workers=2)
    with pytest.raises(KeyboardInterrupt):
        write_world(tmp_path / "c", options, progress=kill_after(4))
    assert not (tmp_path / "c").exists()
    record = write_world(tmp_path / "c", options)
    assert record.rendered == record.counts["videos"] - 4
    assert (
        digest_folder(tmp_path / "a")
        == digest_folder(tmp_path / "b")
        == digest_folder(tmp_path / "c")
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b", "c"]


def test_a_video_that_was_half_rendered_into_arrays_is_rendered_again(raw, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_world(tmp_path / "w", RAW, progress=kill_after(3))
    (part,) = tmp_path.glob(".w.*.part")
    array = np.load(part / "tactile.npy", mmap_mode="r+")
    array[3 * 4 :] = 7  # of videos that are not marked as finished
    array.flush()
    write_world(tmp_path / "w", RAW)
    assert digest_folder(tmp_path / "w") == digest_folder(raw.folder)


def test_raw_rows_are_the_rows_of_the_manifest(raw):
    arrays = open_arrays(raw.folder)
    n = raw.counts["contact_frames"]
    assert (raw.folder / "ids.txt").read_text().splitlines() == arrays.manifest.ids
    assert arrays.vision.shape == arrays.tactile.shape == arrays.background.shape == (n, 16, 16, 3)
    assert isinstance(arrays.vision, np.memmap)
    assert not arrays.vision.flags.writeable
    assert arrays.manifest.table["vision"].null_count() == n
    videos, frames = arrays.manifest.column("video"), arrays.manifest.column("frame")
    assert list(zip(videos, frames, strict=True)) == sorted(zip(videos, frames, strict=True))
    touched = np.abs(arrays.tactile.astype(int) - arrays.background).mean((1, 2, 3))
    assert touched.min() > 1.0


def test_raw_arrays_that_do_not_fit_are_refused(raw, tmp_path):
    Manifest.load(raw.folder).save(tmp_path / "manifest.parquet")
    with pytest.raises(PalpateError, match=r"no file .*vision\.npy"):
        open_arrays(tmp_path)
    vision = (raw.folder / "vision.npy").read_bytes()
    for name in IMAGES:
        (tmp_path / f"{name}.npy").write_bytes(vision)
    open_arrays(tmp_path)
    (tmp_path / "tactile.npy").write_bytes(vision[:-100])
    with pytest.raises(PalpateError, match=r"tactile\.npy must be an array"):
        open_arrays(tmp_path)
    np.save(tmp_path / "tactile.npy", np.zeros((3, 16, 16, 3), np.uint8))
    with pytest.raises(PalpateError, match=r"Got uint8 of shape \(3, 16, 16, 3\)"):
        open_arrays(tmp_path)


def test_lazy_samples_equal_raw_rows(raw):
    arrays, world = open_arrays(raw.folder), World(RAW)
    assert len(world) == len(arrays.manifest)
    assert world.ids == arrays.manifest.ids
    for k, sample in enumerate(world):
        for name in IMAGES:
            np.testing.assert_array_equal(sample[name], getattr(arrays, name)[k])
    order = np.random.default_rng(0).permutation(len(world))[:12]
    for k in order:  # random access with a cache of one video
        np.testing.assert_array_equal(World(RAW, cache=1)[k]["tactile"], arrays.tactile[k])
    np.testing.assert_array_equal(world[-1]["vision"], arrays.vision[-1])


@pytest.mark.parametrize(
    "options",
    [
        dataclasses.replace(TINY, objects_per_material=1),
        dataclasses.replace(HCT, objects_per_material=1),
    ],
)
def test_lazy_samples_equal_written_files(options, tmp_path):
    write_world(tmp_path / "w", options)
    manifest, world = Manifest.load(tmp_path / "w"), World(options)
    assert world.ids == manifest.ids
    rows = list(manifest.table.iter_rows(named=True))
    for row, sample in zip(rows, world, strict=True):
        assert {
            name: sample[name]
            for name in ("id", "video", "frame", "touch", "object", "material", "text", "sensor")
        } == {
            name: row[name]
            for name in ("id", "video", "frame", "touch", "object", "material", "text", "sensor")
        }
        for name in IMAGES:
            path, file = manifest.path(row[name]), io.BytesIO()
            if path.suffix == ".png":
                np.testing.assert_array_equal(np.asarray(Image.open(path)), sample[name])
            else:
                Image.fromarray(sample[name]).save(file, "JPEG", quality=95, subsampling=0)
                assert path.read_bytes() == file.getvalue()


def test_a_world_has_the_manifest_and_split_that_are_written(raw):
    world = World(RAW)
    manifest = world.manifest()
    assert manifest.digest == Manifest.load(raw.folder).digest
    split = Split.load(raw.folder / "splits" / "Orig.json")
    assert world.split(manifest).digest == split.digest
    assert world.split(manifest).manifest == split.manifest
    assert world.split().manifest is None


def test_a_world_is_pickled_without_what_it_rendered():
    world = World(dataclasses.replace(RAW, two_videos=0.0))
    empty = len(pickle.dumps(world))
    first = world[0]
    assert len(pickle.dumps(world)) == empty < 3000
    copy = pickle.loads(pickle.dumps(world))
    np.testing.assert_array_equal(copy[0]["vision"], first["vision"])
    assert copy.ids == world.ids


def test_memory_does_not_grow_with_the_samples_rendered():
    world = World(WorldOptions(size=16, tile=64, objects_per_material=2), cache=2)
    for k in range(0, len(world), 12):
        world[k]
    assert len(world._videos) == 2
    assert len(world) == len(plan_world(world.options)) * 12


@pytest.mark.parametrize("k", [32, -33, 10**9])
def test_a_sample_that_is_not_there_is_refused(k):
    with pytest.raises(PalpateError, match="must be 0 to 31"):
        World(PRESETS["tiny"])[k]
    with pytest.raises(TypeError):
        World(PRESETS["tiny"])["first"]
    with pytest.raises(PalpateError, match="cache"):
        World(cache=0)


def test_a_world_feeds_a_loader_of_torch():
    data = pytest.importorskip("torch.utils.data")
    world = World(dataclasses.replace(RAW, two_videos=0.0))
    batches = list(data.DataLoader(world, batch_size=8, num_workers=0))
    assert [tuple(batch["vision"].shape) for batch in batches] == [(8, 16, 16, 3)] * 4
    assert list(itertools.chain(*(batch["id"] for batch in batches))) == world.ids


def test_the_room_needs_no_torch():
    import subprocess
    import sys

    code = "import sys, palpate.sim; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
