"""Recordings looked at: raw videos decoded by a validation, stray and doubled numbers, untouched frames, classes of one's own."""

import numpy as np
import pytest

import palpate.data.recordings as recordings
from data_fixtures import tree, write_image
from palpate.core import ProblemsError, Split
from palpate.data.formats.touch_and_go import import_touch_and_go
from palpate.data.importing import validate, write_lists
from palpate.data.manifest import Manifest
from palpate.data.reading import read_samples
from test_data_touch_and_go import LINES, make_recordings, shown


def damage(path):
    """Breaks the pictures in the middle of a video, not its index."""
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    for k in range(start + (len(data) - start) // 3, start + 2 * (len(data) - start) // 3):
        data[k] = 0xFF
    path.write_bytes(bytes(data))


def test_validation_decodes_raw_videos_as_an_import_does(tmp_path):
    root = make_recordings(tmp_path / "tag", raw=("a", "b"))
    assert validate(root).samples == 18
    damage(root / "dataset" / "b" / "gelsight.mp4")
    before = tree(root)
    looked = validate(root)
    assert [p.kind for p in looked.invalid] == ["bad-video"]
    with pytest.raises(ProblemsError) as caught:
        import_touch_and_go(root, tmp_path / "out")
    assert list(caught.value.problems) == list(looked.invalid)
    assert (
        looked.samples
        == len(import_touch_and_go(root, tmp_path / "out", skip_bad=True).manifest)
        < 18
    )
    assert validate(root, check="header").ok
    assert len(read_samples(root)[0]) == 18  # who only wants the samples waits for no decoding
    assert tree(root) == before


def test_a_stray_number_costs_nothing_and_what_looks_wrong_reaches_the_user(tmp_path):
    root = make_recordings(
        tmp_path / "tag", extracted=("a", "spare"), lines=[f"a/{k:010d}.jpg,3" for k in range(3)]
    )
    place = root / "dataset" / "a"
    wanted = import_touch_and_go(root, tmp_path / "wanted").manifest
    for side in ("gelsight_frame", "video_frame"):
        write_image(place / side / "999999999999.jpg", 3)
        write_image(place / side / "99999999999999999999.jpg", 3)
    write_image(place / "video_frame" / "000001.jpg", 77)
    write_image(place / "video_frame" / "1.png", 78)
    found = import_touch_and_go(root, tmp_path / "out")
    assert found.manifest.ids == wanted.ids
    assert shown(found.manifest, "vision") == [0, 1, 2]
    looked = validate(root)
    assert looked.ok
    assert sorted((p.kind, p.where.removeprefix(str(root))) for p in looked.suspicious) == [
        ("duplicate-frame", "/dataset/a/video_frame/000001.jpg"),
        ("duplicate-frame", "/dataset/a/video_frame/1.png"),
        ("unlisted-video", ""),
    ]
    assert found.suspicious == list(looked.suspicious)


def test_without_contact_frames_are_those_of_a_slow_search(tmp_path):
    rng = np.random.default_rng(0)
    for trial in range(20):
        root = tmp_path / str(trial)
        there = sorted(rng.choice(60, 25, replace=False).tolist())
        contact = set(rng.choice(60, int(rng.integers(0, 30)), replace=False).tolist())
        for k in there:
            (root / "t").mkdir(parents=True, exist_ok=True)
            (root / "t" / f"{k}.jpg").write_bytes(b"")
        work = recordings.Recordings(root, root, {}, {"a": contact}, "jpg", None, [])
        work.frames["a"] = {"tactile": recordings.FolderFrames(root / "t", root)}
        far = [k for k in there if not any(abs(k - c) <= 4 for c in contact)] or [
            k for k in there if k not in contact
        ]
        found = work._without_contact("a")
        assert set(found) <= set(far)
        assert len(found) == min(len(far), 15)
        assert found[:1] == far[:1]


def test_a_table_of_classes_of_ones_own_is_kept_for_the_lists_of_a_split(tmp_path):
    root = make_recordings(tmp_path / "tag", extracted=("a",))
    (root / "category_reference.txt").write_text("Mat 3: 3\nWood: 15\n")
    manifest = import_touch_and_go(root, tmp_path / "out").manifest
    assert set(manifest.column("material")) == {"Mat 3", "Wood"}
    split = Split(dict.fromkeys(manifest.ids, "train"))
    (path,) = write_lists(Manifest.load(tmp_path / "out"), split, tmp_path / "lists")
    assert sorted(path.read_text().splitlines()) == sorted(line.format("a") for line in LINES)
    (root / "category_reference.txt").unlink()
    assert "classes" not in import_touch_and_go(root, tmp_path / "plain").facts
