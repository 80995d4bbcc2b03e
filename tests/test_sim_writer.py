"""The tree on disk: layout, equal bytes, resumption, known leaks."""

import csv
import dataclasses
import io
import json

import numpy as np
import pytest
from PIL import Image

from palpate.core import PalpateError, digest_folder
from palpate.sim import (
    MATERIALS,
    PRESETS,
    Material,
    Surface,
    Video,
    WorldOptions,
    plan_world,
    render_contact_sheet,
    write_world,
)
from palpate.sim.plan import contact_frames

TINY = dataclasses.replace(PRESETS["tiny"], size=16, tile=64)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    out = tmp_path_factory.mktemp("world") / "w"
    return out, write_world(out, TINY)


def read_list(path):
    text = path.read_text()
    rows = [line.split(",") for line in text.split("\n") if line]
    return text, [(path, int(label)) for path, label in rows]


def test_the_tree_has_the_layout_of_touch_and_go(world):
    out, record = world
    assert sorted(p.name for p in out.iterdir()) == sorted(
        [
            "label.txt",
            "category_reference.txt",
            "train.txt",
            "test.txt",
            "captions.csv",
            "objects.csv",
            "world.json",
            "dataset",
            "manifest.parquet",
            "splits",
            "leak.csv",
        ]
    )
    plans = plan_world(TINY)
    assert sorted(p.name for p in (out / "dataset").iterdir()) == [plan.name for plan in plans]
    _, label = read_list(out / "label.txt")
    expected = [
        (f"{plan.name}/{frame:010d}.jpg", MATERIALS[plan.object_of(touch).material].label)
        for plan in plans
        for touch in range(2)
        for frame in contact_frames(TINY, touch)
    ]
    assert label == expected
    listed = {}
    for part in ("train", "test"):
        text, rows = read_list(out / f"{part}.txt")
        assert not text.endswith("\n")
        listed |= dict(rows)
        assert rows != sorted(rows)
    assert listed == dict(label)
    categories = dict(
        line.split(": ") for line in (out / "category_reference.txt").read_text().splitlines()
    )
    assert categories["Synthetic Fabric"] == "8"
    assert len(categories) == 20
    assert record.counts["written_frames"] == sum(
        1 for _ in out.glob("dataset/*/video_frame/*.jpg")
    )
    for kind in ("video_frame", "gelsight_frame"):
        frames = sorted(p.name for p in (out / "dataset" / plans[0].name / kind).iterdir())
        assert frames == [f"{f:010d}.jpg" for f in range(14)]


def test_written_frames_are_the_frames_rendered_alone(world):
    out, _ = world
    for index, frame in ((0, 0), (3, 6), (7, 13)):
        video = Video(TINY, index)
        for kind, image in (
            ("video_frame", video.vision(frame)),
            ("gelsight_frame", video.tactile(frame)),
        ):
            path = out / "dataset" / video.plan.name / kind / f"{frame:010d}.jpg"
            file = io.BytesIO()
            Image.fromarray(image).save(file, "JPEG", quality=95, subsampling=0)
            assert path.read_bytes() == file.getvalue()
            assert np.abs(np.asarray(Image.open(path)).astype(float) - image).mean() < 5


def test_captions_and_objects_follow_the_touched_object(tmp_path):
    options = dataclasses.replace(TINY, mixed=1.0, touches_per_video=4)
    write_world(tmp_path / "w", options)
    objects, captions = (
        dict(csv.reader((tmp_path / "w" / f"{name}.csv").read_text().splitlines()))
        for name in ("objects", "captions")
    )
    assert objects.pop("frame") == "object"
    assert captions.pop("frame") == "text"
    label = dict(read_list(tmp_path / "w" / "label.txt")[1])
    assert set(objects) == set(captions) == set(label)
    slugs = {m.label: name.lower().replace(" ", "_") for name, m in MATERIALS.items()}
    assert all(objects[frame].startswith(f"{slugs[label[frame]]}_") for frame in label)
    by_video = {}
    for frame, material in label.items():
        by_video.setdefault(frame.split("/")[0], set()).add(material)
    assert all(2 <= len(materials) <= 3 for materials in by_video.values())
    for plan in plan_world(options):
        assert captions[f"{plan.name}/{contact_frames(options, 3)[1]:010d}.jpg"] == Video(
            options, plan
        ).text(3)


@pytest.mark.parametrize("leak", ["frame", "contact", "none"])
def test_the_known_leak_equals_a_recount_from_the_lists(leak, tmp_path):
    options = WorldOptions(
        materials=4,
        objects_per_material=3,
        touches_per_video=3,
        frames_per_touch=2,
        size=16,
        tile=64,
        leak=leak,
    )
    record = write_world(tmp_path / "w", options)
    train, test = (
        [path for path, _ in read_list(tmp_path / "w" / f"{part}.txt")[1]]
        for part in ("train", "test")
    )
    videos = {path.split("/")[0] for path in train}
    leaked = sum(path.split("/")[0] in videos for path in test)
    data = json.loads((tmp_path / "w" / "world.json").read_text())
    assert (
        data["leak"]["test_frames_in_shared_videos"]
        == leaked
        == record.leak["test_frames_in_shared_videos"]
    )
    assert data["leak"]["test_frames"] == len(test) == data["counts"]["test_frames"]
    assert data["leak"]["leaked_fraction"] == leaked / len(test)
    touch = lambda path: (path.split("/")[0], int(path.split("/")[1][:10]) // 7)  # noqa: E731
    shared = {touch(p) for p in train} & {touch(p) for p in test}
    assert data["leak"]["touches_shared"] == len(shared)
    assert len(test) / (len(train) + len(test)) == pytest.approx(0.25, abs=0.02)
    if leak == "none":
        assert leaked == 0
        assert len({label for _, label in read_list(tmp_path / "w" / "test.txt")[1]}) >= 3
    else:
        assert leaked > 0
        assert bool(shared) is (leak == "frame")


def test_two_workers_write_the_same_bytes(world, tmp_path):
    out, record = world
    again = write_world(tmp_path / "w", TINY, workers=2)
    assert again.digest == record.digest
    assert digest_folder(tmp_path / "w") == digest_folder(out)


def test_a_killed_run_goes_on_where_it_stopped(world, tmp_path):
    out, _ = world

    def kill(what, done, total, remark=""):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_world(tmp_path / "w", TINY, progress=kill)
    assert not (tmp_path / "w").exists()
    (part,) = tmp_path.glob(".w.*.part")
    assert len(list((part / "dataset").iterdir())) == 3
    stray = part / "dataset" / ".20990101_000000.abc"  # what a kill -9 leaves behind
    stray.mkdir()
    (stray / "half.jpg").write_bytes(b"half")
    record = write_world(tmp_path / "w", TINY)
    assert record.rendered == 5
    assert digest_folder(tmp_path / "w") == digest_folder(out)
    assert [p.name for p in tmp_path.iterdir()] == ["w"]


def test_a_finished_world_is_left_alone_and_another_refused(world):
    out, record = world
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    again = write_world(out, TINY)
    assert (again.digest, again.rendered) == (record.digest, 0)
    assert before == {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    with pytest.raises(PalpateError, match="other options"):
        write_world(out, dataclasses.replace(TINY, seed=1))


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(PalpateError, match="absent, empty"):
        write_world(tmp_path, TINY)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    (tmp_path / "empty").mkdir()
    write_world(tmp_path / "empty", TINY)


def test_a_world_too_small_to_cut_is_refused_before_rendering(tmp_path):
    one = WorldOptions(materials=1, objects_per_material=1, leak="none", size=16, tile=64)
    with pytest.raises(PalpateError, match="at least two videos"):
        write_world(tmp_path / "w", one)
    assert not list(tmp_path.iterdir())


def test_a_users_broken_material_is_named(tmp_path, monkeypatch):
    def broken(tile, rng):
        return Surface(
            tile.zeros() * np.nan, np.ones((tile.n, tile.n, 3), np.float32), "only", ("odd", "new")
        )

    monkeypatch.setitem(MATERIALS, "Cork", Material(20, "cork", broken, ("only",)))
    with pytest.raises(PalpateError, match="'Cork' must return a finite height"):
        write_world(tmp_path / "w", dataclasses.replace(TINY, materials=("Wood", "Cork")))


def test_a_users_material_enters_the_lists(tmp_path, monkeypatch):
    def fine(tile, rng):
        return Surface(
            tile.noise(1.0, 8.0) * 0.1,
            np.ones((tile.n, tile.n, 3), np.float32) * 0.5,
            "only",
            ("springy", "dry"),
        )

    monkeypatch.setitem(MATERIALS, "Cork", Material(20, "cork", fine, ("only",)))
    write_world(tmp_path / "w", dataclasses.replace(TINY, materials=("Wood", "Cork")))
    assert "Cork: 20" in (tmp_path / "w" / "category_reference.txt").read_text().splitlines()
    assert {label for _, label in read_list(tmp_path / "w" / "label.txt")[1]} == {3, 20}


def test_videos_hold_the_same_frames(tmp_path):
    av = pytest.importorskip("av")
    options = dataclasses.replace(TINY, materials=("Brick",), size=32, layout="videos")
    write_world(tmp_path / "w", options)
    video = Video(options, 1)
    for name, render in (("video.mp4", video.vision), ("gelsight.mp4", video.tactile)):
        with av.open(str(tmp_path / "w" / "dataset" / video.plan.name / name)) as file:
            assert file.streams.video[0].average_rate == 30
            assert file.streams.video[0].codec_context.name == "h264"
            frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        assert len(frames) == options.video_length
        for f, frame in enumerate(frames):
            assert np.abs(frame.astype(float) - render(f)).mean() < 14


def test_videos_without_pyav_say_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(PalpateError, match=r"palpate\[video\]"):
        write_world(tmp_path / "w", dataclasses.replace(TINY, layout="videos"))


def test_sparse_worlds_write_contact_and_background_frames_alone(tmp_path):
    write_world(
        tmp_path / "w", dataclasses.replace(TINY, materials=("Brick",), free_written="background")
    )
    name = plan_world(dataclasses.replace(TINY, materials=("Brick",)))[0].name
    frames = sorted(
        int(p.stem) for p in (tmp_path / "w" / "dataset" / name / "gelsight_frame").iterdir()
    )
    assert frames == [1, 5, 6, 8, 12, 13]


def test_the_contact_sheet_is_a_picture(tmp_path):
    render_contact_sheet(WorldOptions(materials=3, size=16, tile=64), tmp_path / "sheet.png")
    image = Image.open(tmp_path / "sheet.png")
    assert image.size == (2 * (104 + 6 * 16), 2 * 16)
    assert np.asarray(image)[:16, 104:200].std() > 10
