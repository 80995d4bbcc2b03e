"""Recordings: raw videos decoded by a validation, stray numbers, backgrounds, custom classes."""

from forge.errors import fails
from forge.pictures import tree, write_image
from palpate.core import Split
from palpate.data.importing import import_dataset, validate, write_lists
from palpate.data.manifest import Manifest
from palpate.data.reading import read
from palpate.data.recordings import same_names
from test_data_touch_and_go import make_recordings, shown


def damage(path):
    """Overwrite images in the middle of a video, not its index."""
    data = bytearray(path.read_bytes())
    third = (len(data) - data.index(b"mdat")) // 3
    data[-2 * third : -third] = b"\xff" * third
    path.write_bytes(bytes(data))


def test_validation_decodes_raw_videos_as_an_import_does(tmp_path):
    root = make_recordings(tmp_path / "tag", raw=("a", "b"))
    assert validate(root).samples == 18
    damage(root / "dataset" / "b" / "gelsight.mp4")
    before = tree(root)
    validation = validate(root)
    assert [p.kind for p in validation.invalid] == ["bad-video"]
    error = fails("", import_dataset, root, tmp_path / "out", format="touch-and-go")
    assert list(error.problems) == list(validation.invalid)
    imported = import_dataset(root, tmp_path / "out", skip_bad=True, format="touch-and-go")
    assert validation.samples == len(imported.manifest) < 18
    assert validate(root, check="header").ok
    assert len(read(root).manifest) == 18  # who only wants the samples waits for no decoding
    assert tree(root) == before


def test_a_stray_number_costs_nothing_and_what_looks_wrong_reaches_the_user(tmp_path):
    lines = [f"a/{k:010d}.jpg,3" for k in range(3)]
    root = make_recordings(tmp_path / "tag", extracted=("a", "spare"), lines=lines)
    place = root / "dataset" / "a"
    expected = import_dataset(root, tmp_path / "expected", format="touch-and-go").manifest
    for side in ("gelsight_frame", "video_frame"):
        write_image(place / side / "999999999999.jpg", 3)
        write_image(place / side / "99999999999999999999.jpg", 3)
    write_image(place / "video_frame" / "000001.jpg", 77)
    write_image(place / "video_frame" / "1.png", 78)
    imported = import_dataset(root, tmp_path / "out", format="touch-and-go")
    assert imported.manifest.ids == expected.ids
    assert shown(imported.manifest, "vision") == [0, 1, 2]
    validation = validate(root)
    assert validation.ok
    assert sorted((p.kind, p.where.removeprefix(str(root))) for p in validation.suspicious) == [
        ("duplicate-frame", "/dataset/a/video_frame/000001.jpg"),
        ("duplicate-frame", "/dataset/a/video_frame/1.png"),
        ("no-background", "a#0001"),
        ("unlisted-video", ""),
    ]
    assert imported.suspicious == list(validation.suspicious)


def test_a_custom_table_of_classes_is_kept_for_the_lists_of_a_split(tmp_path):
    root = make_recordings(tmp_path / "tag", extracted=("a",))
    lines = sorted((root / "label.txt").read_text().splitlines())
    (root / "category_reference.txt").write_text("Mat 3: 3\nWood: 15\n")
    manifest = import_dataset(root, tmp_path / "out", format="touch-and-go").manifest
    assert set(manifest.column("material")) == {"Mat 3", "Wood"}
    split = Split(dict.fromkeys(manifest.ids, "train"))
    (path,) = write_lists(Manifest.load(tmp_path / "out"), split, tmp_path / "lists")
    assert sorted(path.read_text().splitlines()) == lines
    (root / "category_reference.txt").unlink()
    assert "classes" not in import_dataset(root, tmp_path / "plain", format="touch-and-go").facts


def test_parts_without_videos_share_the_names_that_they_declare_alone(tmp_path):
    rows = [{"id": str(k), "tactile": f"{k}.png", "session": "monday"} for k in range(4)]
    train, test, other = (Manifest.from_rows(rows, tmp_path / n) for n in ("train", "test", "b"))
    assert same_names(train, test) == same_names(train, other)
    of_videos = [{**row, "video": f"v{k}", "frame": k} for k, row in enumerate(rows)]
    train = Manifest.from_rows(of_videos, tmp_path / "train")
    test = Manifest.from_rows(
        [{**r, "frame": r["frame"] + 9} for r in of_videos], tmp_path / "test"
    )
    assert "session" in same_names(train, test)
