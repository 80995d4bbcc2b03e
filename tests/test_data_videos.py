"""Videos and stacks of frames by path templates: what becomes a sample, and what is told."""

import numpy as np
import pytest
from PIL import Image

import palpate.data.frames as frames
from forge.errors import fails
from forge.pictures import write_image
from palpate.cli import main
from palpate.core import PalpateError
from palpate.data.importing import import_dataset, validate
from palpate.data.stacks import StackReader
from test_data_contacts import EVENTS, gel_video, photos

PRESSES = ((20, 30), (45, 55))


def test_a_gel_that_never_moves_says_why_it_has_no_contact(tmp_path, capsys):
    save(tmp_path / "own" / "a.npy", gel_video(70, ()))
    command = [str(tmp_path / "own"), "--tactile", "{video}.npy"]
    assert main(["import", *command, "-o", str(tmp_path / "m")]) == 2
    error = capsys.readouterr().err
    assert "a: no contact was found: frames differ from frame" in error
    assert "--every 10" in error
    assert main(["validate", *command]) == 1
    assert "no sample is usable" in capsys.readouterr().out
    save(tmp_path / "own" / "b.npy", gel_video(70, PRESSES))
    assert main(["import", *command, "-o", str(tmp_path / "m")]) == 0
    assert "a: no contact was found" in capsys.readouterr().out


def save(path, images, times=None):
    """A stack, or a video of another suffix whose frames are presented at ``times``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, images)
        return
    av = pytest.importorskip("av", reason="PyAV is not installed")
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=30, options={"crf": "12"})
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = k if times is None else times[k]
            out.mux(stream.encode(frame))
        out.mux(stream.encode())


def gel(seed=0, length=70):
    return gel_video(length, PRESSES, seed=seed)


@pytest.fixture
def layouts(tmp_path):
    """Folders of two objects with two recordings of 70 frames each."""
    for v, (thing, take) in enumerate((o, t) for o in ("cup", "big_mug") for t in (1, 2)):
        touch, scene = gel(v), photos(70, PRESSES, v)
        save(tmp_path / "flat" / f"{thing}_{take}.mov", touch)
        save(tmp_path / "paired" / thing / f"take{take}" / "touch.mp4", touch)
        save(tmp_path / "paired" / thing / f"take{take}" / "camera.mkv", scene)
        save(tmp_path / "stacks" / f"{thing}_{take}_gel.npy", touch)
        save(tmp_path / "stacks" / f"{thing}_{take}_rgb.npy", (scene / 255).astype(np.float32))
        save(tmp_path / "photo" / f"{thing}_{take}.npy", touch)
        write_image(tmp_path / "photo" / f"{thing}.jpg", v)
    return tmp_path


TEMPLATES = {
    "flat": {"tactile": "{object}_{video}.mov"},
    "paired": {
        "vision": "{object}/take{video}/camera.mkv",
        "tactile": "{object}/take{video}/touch.mp4",
    },
    "stacks": {"vision": "{object}_{video}_rgb.npy", "tactile": "{object}_{video}_gel.npy"},
    "photo": {"vision": "{object}.jpg", "tactile": "{object}_{video}.npy"},
}


@pytest.mark.parametrize("name", TEMPLATES)
def test_contacts_of_videos_become_samples(layouts, tmp_path, name):
    imported = import_dataset(layouts / name, tmp_path / "out", **TEMPLATES[name])
    manifest = imported.manifest.require_valid()
    table = manifest.table
    assert sorted(set(table["object"])) == ["big_mug", "cup"]
    assert sorted(set(table["video"])) == ["big_mug/1", "big_mug/2", "cup/1", "cup/2"]
    assert table["contact"].n_unique() == 8
    assert set(table["contact"].str.slice(-5)) == {"#0001", "#0002"}
    assert all(17 <= k <= 33 or 42 <= k <= 58 for k in table["frame"])
    assert table["background"].null_count() == 0
    assert table["vision"].null_count() == (len(table) if name == "flat" else 0)
    assert imported.facts["frames"] == "in contact"
    assert validate(layouts / name, **TEMPLATES[name]).samples == len(manifest)
    row = table.filter(video="cup/1").row(0, named=True)
    image = np.asarray(Image.open(manifest.root / row["tactile"]).convert("RGB"))
    assert np.abs(image - gel(0)[row["frame"]].astype(int)).mean() < 6


@pytest.mark.parametrize("name", ["paired", "stacks"])
def test_the_layout_of_two_sides_is_found(layouts, tmp_path, name):
    imported = import_dataset(layouts / name, tmp_path / "out")
    assert imported.manifest.table["vision"].null_count() == 0
    assert imported.manifest.table["video"].n_unique() == 4


def test_videos_without_a_word_for_what_they_show_are_a_choice(layouts, tmp_path):
    error = fails("must say what they show", import_dataset, layouts / "flat", tmp_path / "out")
    assert {"tactile": "{object}_{video}.mov"} in error.choices
    imported = import_dataset(layouts / "flat", tmp_path / "out", side="tactile")
    assert imported.manifest.table["video"].n_unique() == 4


def test_every_takes_whole_videos_and_contacts_are_thinned(layouts, tmp_path):
    table = import_dataset(
        layouts / "stacks", tmp_path / "a", every=10, **TEMPLATES["stacks"]
    ).manifest.table
    assert table.filter(video="cup/1")["frame"].to_list() == list(range(0, 70, 10))
    contacts = table.filter(video="cup/1")["contact"].to_list()
    assert [contact is not None for contact in contacts] == [0, 0, 1, 1, 0, 1, 0]
    assert table["background"].null_count() == 0
    few = import_dataset(
        layouts / "stacks", tmp_path / "b", max_per_contact=2, **TEMPLATES["stacks"]
    ).manifest.table
    assert few.group_by("contact").len()["len"].to_list() == [2] * 8


def test_videos_of_the_scene_alone_need_a_step(layouts, tmp_path):
    scene = {"vision": "{object}_{video}_rgb.npy"}
    fails("every", import_dataset, layouts / "stacks", tmp_path / "out", **scene)
    table = import_dataset(layouts / "stacks", tmp_path / "out", every=35, **scene).manifest.table
    assert len(table) == 8
    assert table["tactile"].null_count() == table["contact"].null_count() == 8


def test_a_declared_background_and_further_fields(layouts, tmp_path):
    Image.fromarray(gel()[0]).save(layouts / "stacks" / "empty_gel.png")
    imported = import_dataset(
        layouts / "stacks",
        tmp_path / "out",
        tactile="{brand}_{take}_gel.npy",
        background="empty_gel.png",
        sensor="mini",
        size=24,
    )
    table = imported.manifest.require_valid().table
    assert set(table["background"].str.split("/").list.last()) == {"empty_gel.png"}
    assert table.filter(video="cup/1")["contact"].n_unique() == 2  # seen against that image
    assert set(table["brand"]) == {"cup", "big_mug"}
    assert set(table["video"]) == {"cup/1", "cup/2", "big_mug/1", "big_mug/2"}
    assert set(table["sensor"]) == {"mini"}
    assert Image.open(imported.manifest.paths("tactile")[0]).size == (32, 24)
    assert [p.kind for p in imported.suspicious] == ["unmatched"]


def test_an_interrupted_import_continues(layouts, tmp_path, monkeypatch):
    written, original = [], frames.save_frame

    def interrupted(path, *args):
        if len(written) == 30:
            raise KeyboardInterrupt
        written.append(path)
        original(path, *args)

    monkeypatch.setattr(frames, "save_frame", interrupted)
    with pytest.raises(KeyboardInterrupt):
        import_dataset(layouts / "stacks", tmp_path / "out", **TEMPLATES["stacks"])
    assert not (tmp_path / "out" / "manifest.parquet").exists()
    kept = {path: path.stat().st_mtime_ns for path in written}
    monkeypatch.setattr(frames, "save_frame", original)
    again = import_dataset(layouts / "stacks", tmp_path / "out", **TEMPLATES["stacks"])
    assert {path: path.stat().st_mtime_ns for path in written} == kept
    fresh = import_dataset(layouts / "stacks", tmp_path / "fresh", **TEMPLATES["stacks"])
    assert again.manifest.digest == fresh.manifest.digest


def test_what_is_wrong_with_videos_is_told(layouts, tmp_path):
    root = layouts / "stacks"
    (root / "cup_1_gel.npy").write_bytes((root / "cup_1_gel.npy").read_bytes()[:-999])
    (root / "cup_2_rgb.npy").unlink()
    frozen = photos(120, EVENTS)
    frozen[40:80] = frozen[40]
    save(root / "pot_1_rgb.npy", frozen)
    save(root / "pot_1_gel.npy", gel_video(120, ()))
    options = TEMPLATES["stacks"]
    report = validate(root, **options)
    assert [p.kind for p in report.missing] == ["unpaired"]
    assert [p.kind for p in report.invalid] == ["bad-video"]
    kinds = {(p.where, p.kind) for p in report.suspicious}
    assert kinds == {("pot/1", "no-contact"), ("pot/1", "frozen-stream")}
    fails("", import_dataset, root, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
    imported = import_dataset(root, tmp_path / "out", skip_bad=True, **options)
    assert sorted(set(imported.manifest.table["video"])) == ["big_mug/1", "big_mug/2"]


def test_validation_tells_lag_and_dropped_frames(tmp_path):
    touch, scene = gel_video(200, EVENTS), photos(200, EVENTS)
    late = np.concatenate([np.repeat(scene[:1], 12, 0), scene[:-12]])
    leaps = [k + 4 * (k > 80) for k in range(200)]
    recordings = {"sound": (touch, scene), "late": (touch, late)}
    for name, (tactile, vision) in {**recordings, "gaps": (touch, scene)}.items():
        save(tmp_path / name / "gel.mp4", tactile, leaps if name == "gaps" else None)
        save(tmp_path / name / "camera.mp4", vision)
    report = validate(tmp_path)
    assert {(p.where, p.kind) for p in report.suspicious} == {
        ("late", "lag"),
        ("gaps", "dropped-frames"),
        ("gaps", "paired-by-time"),
    }
    texts = {p.kind: p.text for p in report.suspicious}
    assert "12 frames before" in texts["lag"]
    assert "lacks 4 frames at 1 place, the first after frame 80" in texts["dropped-frames"]
    assert report.ok


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"tactile": "{object}_{video}.mp4"}, "matches none"),
        ({"tactile": "{object}_{frame}_gel.npy"}, "Name it video"),
        ({"tactile": "{object}_{video}_gel.npy", "every": 0}, "at least 1"),
        ({"tactile": "{object}_{video}_gel.npy", "every": 2, "max_per_contact": 2}, "Choose one"),
    ],
)
def test_options_that_cannot_be_met_are_errors(layouts, tmp_path, options, text):
    fails(text, import_dataset, layouts / "stacks", tmp_path / "out", **options)


def test_one_file_is_not_both_sides(layouts, tmp_path):
    same = dict.fromkeys(("vision", "tactile"), "{object}_{video}_gel.npy")
    fails("4 same-image", import_dataset, layouts / "stacks", tmp_path / "out", **same)


@pytest.mark.parametrize(
    ("images", "frame"),
    [
        (np.full((2, 4, 5, 3), 7, np.uint8), 7),
        (np.full((2, 4, 5), 7, np.uint8), 7),
        (np.full((2, 4, 5, 1), 0.5, np.float32), 128),
        (np.full((2, 4, 5, 3), 1.0), 255),
    ],
)
def test_stacks_are_bytes_or_floats(tmp_path, images, frame):
    np.save(tmp_path / "x.npy", images)
    reader = StackReader(tmp_path / "x.npy")
    assert len(reader) == 2
    assert (reader[1] == np.full((4, 5, 3), frame)).all()


@pytest.mark.parametrize(
    "images",
    [
        np.zeros((4, 5)),
        np.zeros((2, 4, 5, 4), np.uint8),
        np.zeros((0, 4, 5, 3), np.uint8),
        np.zeros((2, 4, 5, 3), np.int64),
        np.zeros((2, 4, 5, 3), np.uint16),
        np.full((2, 4, 5), 1.5),
        np.full((2, 4, 5), np.nan),
        np.array([{}], object),
    ],
)
def test_other_stacks_are_errors(tmp_path, images):
    np.save(tmp_path / "x.npy", images)
    with pytest.raises(PalpateError, match=r"The stack .*x.npy must be"):
        StackReader(tmp_path / "x.npy")[0]


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04zip", b"\x93NUMPY\x01\x00v\x00{'descr'"])
def test_files_that_are_no_stacks_are_errors(tmp_path, data):
    (tmp_path / "x.npy").write_bytes(data)
    fails("The stack", StackReader, tmp_path / "x.npy")


#: When the frames of a camera are presented, in ticks of the 70 frames of the gel.
CAMERAS = {
    "half the rate": [2 * k for k in range(35)],
    "three quarters": [round(4 * k / 3) for k in range(53)],
    "a gap": [k for k in range(70) if not 30 <= k < 42],
    "in step": list(range(70)),
    "shorter": list(range(60)),
}


@pytest.mark.parametrize("camera", CAMERAS)
def test_frames_of_two_rates_are_paired_by_time(tmp_path, camera):
    times = CAMERAS[camera]
    save(tmp_path / "own" / "cup" / "gel.mov", gel())
    save(tmp_path / "own" / "cup" / "rgb.mov", photos(70, PRESSES)[times], times)
    result = import_dataset(tmp_path / "own", tmp_path / "m", every=1)
    by_number = camera in ("in step", "shorter")
    said = [p for p in result.suspicious if p.kind == "paired-by-time"]
    assert len(said) == (not by_number)
    paths = result.manifest.table["vision"].str.extract(r"(\d+)\.jpg$").cast(int).to_list()
    expected = {}
    for k in range(70):
        nearest = min(range(len(times)), key=lambda j: (abs(times[j] - k), j))
        step = sorted(np.diff(times))[len(times) // 2]
        if abs(times[nearest] - k) <= step / 2 + 0.01:
            expected[k] = nearest
    assert dict(zip(result.manifest.column("frame"), paths, strict=True)) == expected
    numbers = import_dataset(tmp_path / "own", tmp_path / "n", every=1, pairing="number")
    table = numbers.manifest.table
    assert table["vision"].str.extract(r"(\d+)\.jpg$").cast(int).to_list() == [*range(len(times))]


def test_stacks_of_two_lengths_are_refused_in_one_line(tmp_path):
    save(tmp_path / "own" / "cup" / "gel.npy", gel())
    save(tmp_path / "own" / "cup" / "rgb.npy", photos(70, PRESSES)[::2])
    error = fails("", import_dataset, tmp_path / "own", tmp_path / "m", every=1)
    assert [p.kind for p in error.problems] == ["unequal-streams"]
    assert "35 frames of vision and 70 of tactile" in str(error)
    result = import_dataset(tmp_path / "own", tmp_path / "m", every=1, pairing="number")
    assert len(result.manifest) == 35
