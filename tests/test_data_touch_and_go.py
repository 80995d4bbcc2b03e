"""Touch and Go: every layout, every kind of bad input, resume, backgrounds, and the real clips."""

import numpy as np
import polars as pl
import pytest
from PIL import Image

import palpate.data.formats.recordings as recordings
from forge.errors import fails
from forge.pictures import number, tree, write_frames, write_image, write_video
from palpate.core import PalpateError, Split
from palpate.data.formats.layout import find_videos
from palpate.data.formats.touch_and_go import write_lists
from palpate.data.images import read_image
from palpate.data.importing import import_dataset
from palpate.data.listing import read_list
from palpate.data.manifest import Manifest

av = pytest.importorskip("av", reason="PyAV is not installed")

#: Contacts of every recording of 40 frames: label 3 from 10 to 15, label 15 from 17 to 19.
LABELS = {**dict.fromkeys(range(10, 16), 3), **dict.fromkeys(range(17, 20), 15)}


def import_touch_and_go(root, out, **options):
    return import_dataset(root, out, format="touch-and-go", overwrite=True, **options)


def lines_of(video, frames, label=3):
    return [f"{video}/{k:010d}.jpg,{label}" for k in frames]


def make_recordings(root, *, raw=(), extracted=(), place="dataset", lines=None):
    """A data set whose frames show their number; the sensor's show it too."""
    for name in raw:
        write_video(root / place / name / "video.mp4", 42)
        write_video(root / place / name / "gelsight.mp4", 40)
    for name in extracted:
        write_frames(root / place / name / "video_frame", 40)
        write_frames(root / place / name / "gelsight_frame", 40)
    if lines is None:
        lines = [
            row for v in (*raw, *extracted) for k in LABELS for row in lines_of(v, [k], LABELS[k])
        ]
    (root / "label.txt").write_text("\n".join(lines))
    return root


def shown(manifest, column):
    return [number(np.asarray(read_image(manifest.path(p)))) for p in manifest.column(column)]


@pytest.mark.parametrize("place", ["dataset", "final_dataset", "."])
@pytest.mark.parametrize("layout", ["raw", "extracted", "mixed"])
def test_every_layout_gives_the_same_samples(tmp_path, layout, place):
    names = {"raw": ("a",), "extracted": ("b",)} if layout == "mixed" else {layout: ("a", "b")}
    root = make_recordings(tmp_path / "tag", place=place, **names)
    result = import_touch_and_go(root, tmp_path / "out")
    manifest = result.manifest.require_valid()
    frames = [*LABELS, *LABELS]
    assert manifest.ids == [f"{v}/{k:010d}" for v in "ab" for k in LABELS]
    assert manifest.column("frame") == frames
    assert manifest.column("material") == (["Wood"] * 6 + ["Rock"] * 3) * 2
    assert manifest.column("contact") == [f"{v}#000{t}" for v in "ab" for t in [1] * 6 + [2] * 3]
    assert shown(manifest, "vision") == shown(manifest, "tactile") == frames
    # 4 before 10 is 6; 4 before 17 is 13, in a contact, so back to 9
    assert shown(manifest, "background") == ([6] * 6 + [9] * 3) * 2
    facts = {name: result.facts[name] for name in ("layout", "license", "text_source")}
    assert facts == {"layout": layout, "license": "CC BY 4.0", "text_source": "none"}
    assert manifest.column("text") == [None] * 18
    roots = {"extracted": root, "raw": tmp_path / "out", "mixed": tmp_path}
    assert manifest.root == roots[layout].resolve()
    again = Manifest.load(tmp_path / "out")
    assert again.digest == manifest.digest
    assert again.require_valid().root == manifest.root
    assert (tmp_path / "out" / "images").exists() == (layout != "extracted")


def test_extracted_frames_go_before_the_raw_video(tmp_path):
    root = make_recordings(tmp_path, extracted=("a",))
    (root / "dataset" / "a" / "video.mp4").write_bytes(b"")
    assert find_videos(root)["a"]["vision"] == root / "dataset" / "a" / "video_frame"
    assert import_touch_and_go(root, tmp_path / "out").facts["layout"] == "extracted"


#: Lines of ``label.txt`` in the tree of ``spoil``, what is wrong with each, and a word of its text.
BAD_LINES = [
    ("good/0000000010.jpg,3", "", ""),
    ("good/0000000041.jpg,3", "beyond-end", "40 frames"),  # of the sensor's video
    ("cut/0000000010.jpg,3", "bad-video", "gelsight.mp4"),
    ("cut/0000000011.jpg,3", "", ""),
    ("nomoov/0000000010.jpg,3", "bad-video", "video.mp4"),
    ("gone/0000000010.jpg,3", "missing-video", "3 rows"),
    ("gone/0000000011.jpg,3", "", ""),
    ("gone/0000000012.jpg,3", "", ""),
    ("ext/0000000011.jpg,3", "missing-file", "frame 11"),
    ("ext/0000000012.jpg,3", "bad-image", "0000000012.jpg"),
    ("ext/0000000013.jpg,3", "bad-image", "0000000013.jpg"),
    ("ext/0000000014.jpg,3", "", ""),
    ("ext/0000000090.jpg,3", "beyond-end", "90"),
    ("good/0000000012.jpg,77", "unknown-label", "77"),
    ("good/0000000013.jpg,-1", "", ""),
    ("oneside/0000000001.jpg,3", "missing-video", "no tactile frames"),
    ("good,3", "bad-path", "good"),
    ("good/0000000039.jpg,3", "", ""),  # the last frame of the sensor's video
    ("good/0000000040.jpg,3", "beyond-end", "frame 40"),
]


def spoil(root):
    """One of each kind of bad input; returns the expected problems."""
    make_recordings(root, raw=("good", "cut", "nomoov"), extracted=("ext",))
    cut = root / "dataset" / "cut" / "gelsight.mp4"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 2 // 3])
    nomoov = root / "dataset" / "nomoov" / "video.mp4"
    nomoov.write_bytes(nomoov.read_bytes()[:40])
    (root / "dataset" / "ext" / "gelsight_frame" / "0000000011.jpg").unlink()
    jpeg = root / "dataset" / "ext" / "video_frame" / "0000000012.jpg"
    jpeg.write_bytes(jpeg.read_bytes()[:-300])
    (root / "dataset" / "ext" / "gelsight_frame" / "0000000013.jpg").write_bytes(b"")
    write_video(root / "dataset" / "oneside" / "video.mp4", 5)
    (root / "label.txt").write_text("\n".join(line for line, _, _ in BAD_LINES))
    (root / "captions.csv").write_text("frame,text\ngood/0000000010.jpg,hard\nnonsense,hard\n")
    bad = [(f"{root}/label.txt:{n}", *p) for n, (_, *p) in enumerate(BAD_LINES, 1) if p[0]]
    return [(f"{root}/captions.csv:3", "bad-path", "nonsense"), *bad]


def test_everything_bad_is_reported_at_once_or_skipped_alone(tmp_path):
    expected = spoil(tmp_path / "tag")
    error = fails("", import_touch_and_go, tmp_path / "tag", tmp_path / "out")
    for problem, (where, kind, word) in zip(error.problems, expected, strict=True):
        assert (problem.where, problem.kind) == (where, kind)
        assert word in problem.text
    assert not (tmp_path / "out").exists()
    result = import_touch_and_go(tmp_path / "tag", tmp_path / "out", skip_bad=True)
    assert [(p.where, p.kind) for p in result.skipped] == [(w, kind) for w, kind, _ in expected]
    assert result.manifest.ids == ["ext/0000000014", "good/0000000010", "good/0000000039"]
    assert result.manifest.column("text") == [None, "hard", None]
    assert result.inconclusive == 1
    result.manifest.require_valid()


def test_failing_while_decoding_removes_what_this_run_wrote(tmp_path, monkeypatch):
    root = make_recordings(tmp_path / "tag", raw=("a", "b"))
    original = recordings.VideoFrames.extract

    def fail(self, expected, created, stop):
        broken = "b" in self.source.parts
        original(self, {10, 11} if broken else expected, created, stop)
        if broken:
            raise PalpateError("the video must be whole", "frame 12 of 40 is broken", "fetch it")

    monkeypatch.setattr(recordings.VideoFrames, "extract", fail)
    (tmp_path / "out").mkdir()
    error = fails("", import_touch_and_go, root, tmp_path / "out")
    places = {(p.where, p.kind) for p in error.problems}
    assert places == {(f"{root / 'label.txt'}:10", "bad-video")}
    assert tree(tmp_path / "out") == set()
    result = import_touch_and_go(root, tmp_path / "out", skip_bad=True)
    assert result.manifest.column("video") == ["a"] * 9 + ["b"] * 2
    result.manifest.require_valid()


def test_interrupted_import_keeps_frames_and_goes_on(tmp_path):
    root = make_recordings(tmp_path / "tag", raw=("a", "b", "c"))
    whole = import_touch_and_go(root, tmp_path / "whole")

    def stop(what, done, total, remark=""):
        if what == "extracting frames" and done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_touch_and_go(root, tmp_path / "out", progress=stop)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "out").rglob("*.jpg")}
    assert kept
    assert not (tmp_path / "out" / "manifest.parquet").exists()
    resumed = import_touch_and_go(root, tmp_path / "out")
    assert all(p.stat().st_mtime_ns == t for p, t in kept.items())
    assert resumed.manifest.digest == whole.manifest.digest
    for path in (tmp_path / "whole").rglob("*.jpg"):
        same = tmp_path / "out" / path.relative_to(tmp_path / "whole")
        assert path.read_bytes() == same.read_bytes()


def test_cached_frames_of_other_settings_are_rejected(tmp_path):
    root = make_recordings(tmp_path / "tag", raw=("a",))
    result = import_touch_and_go(root, tmp_path / "out", size=32)
    assert read_image(result.manifest.paths("tactile")[0]).size == (32, 32)
    assert result.manifest.column("tactile")[0].endswith("0000000010.jpg")
    before = tree(tmp_path / "out")
    fails("same settings", import_touch_and_go, root, tmp_path / "out")
    write_video(root / "dataset" / "a" / "gelsight.mp4", 41)
    fails("a/tactile", import_touch_and_go, root, tmp_path / "out", size=32)
    assert tree(tmp_path / "out") == before


def test_inconclusive_frames_and_other_lists_count_as_contact(tmp_path):
    lines = ["a/0000000020.jpg,3", "a/0000000016.jpg,-1", "a/0000000015.jpg,-1"]
    root = make_recordings(tmp_path / "tag", extracted=("a",), lines=lines)
    result = import_touch_and_go(root, tmp_path / "o1")
    assert shown(result.manifest, "background") == [14]
    (root / "only.txt").write_text("a/0000000020.jpg,3")
    result = import_touch_and_go(root, tmp_path / "o2", labels=root / "only.txt")
    assert shown(result.manifest, "background") == [14]
    assert result.inconclusive == 0


def test_official_split_captions_and_objects(tmp_path):
    root = make_recordings(tmp_path / "tag", extracted=("a", "b"))
    train = [*lines_of("a", range(10, 16)), "elsewhere/0000000001.jpg,3"]
    (root / "train.txt").write_text("\n".join(train))
    (root / "test.txt").write_text("b/17.jpg,15\nb/0000000018.jpg,15")
    strays = "c/0000000010.jpg,soft\na\0/0000000010.jpg,soft\n"
    (root / "captions.csv").write_text(f"a/0000000010.jpg,hard, cold\n{strays}")
    (root / "objects.csv").write_text("frame,object\nb/0000000019.jpg,wall\n")
    result = import_touch_and_go(root, tmp_path / "out")
    orig = result.splits["Orig"]
    assert orig.ids("train") == [f"a/{k:010d}" for k in range(10, 16)]
    assert orig.ids("test") == ["b/0000000017", "b/0000000018"]
    assert orig.manifest == result.manifest.digest
    assert Split.load(tmp_path / "out" / "splits" / "Orig.json").digest == orig.digest
    some = result.manifest.take(["a/0000000010", "a/0000000011", "b/0000000019"])
    assert some.column("text") == ["hard, cold", None, None]
    assert some.column("object") == [None, None, "wall"]
    assert result.facts["text_source"] == "captions.csv"
    (stray,) = [p for p in result.suspicious if p.kind == "no-sample"]
    assert (stray.where, stray.text[:28]) == (
        str(root / "captions.csv"),
        "2 lines are of no listed fra",
    )
    (root / "label.txt").unlink()
    # each problem once, although the lists are labels and split in one
    (root / "train.txt").write_text("a/0000000010.jpg,3\nx,3\na/0000000011.jpg,-2")
    result = import_touch_and_go(root, tmp_path / "out2", skip_bad=True)
    places = [(f"{root}/train.txt:2", "bad-path"), (f"{root}/train.txt:3", "unknown-label")]
    assert [(p.where, p.kind) for p in result.skipped] == places
    assert result.manifest.ids == ["a/0000000010", "b/17", "b/0000000018"]
    assert result.splits["Orig"].counts() == {"train": 1, "test": 2}


def test_max_per_contact_takes_evenly_spaced_frames(tmp_path):
    lines = lines_of("a", [*range(10, 30), 35])
    root = make_recordings(tmp_path / "tag", extracted=("a",), lines=lines)
    take = lambda **kw: import_touch_and_go(root, tmp_path / "out", **kw).manifest.column("frame")
    assert take(max_per_contact=1) == [20, 35]
    assert take(max_per_contact=4) == [12, 17, 22, 27, 35]
    assert take(max_per_contact=100) == [*range(10, 30), 35]
    fails("at least 1", take, max_per_contact=0)


def test_missing_root_list_and_recordings_are_named(tmp_path):
    fails("nothing at", import_touch_and_go, tmp_path / "none", tmp_path / "out")
    fails(r"nor in dataset/ or final_dataset/", import_touch_and_go, tmp_path, tmp_path / "out")
    write_image(tmp_path / "dataset" / "a" / "video_frame" / "0.jpg", 1)
    fails(r"label\.txt", import_touch_and_go, tmp_path, tmp_path / "out")
    (tmp_path / "label.txt").write_text("a/0.jpg,-1")
    write_image(tmp_path / "dataset" / "a" / "gelsight_frame" / "0.jpg", 1)
    fails("at least one usable sample", import_touch_and_go, tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("what", ["recording", "frame"])
def test_links_below_the_data_set_are_followed(tmp_path, what):
    root = make_recordings(tmp_path / "tag", extracted=("a",))
    path = root / "dataset" / "a"
    path = path / "gelsight_frame" / "0000000010.jpg" if what == "frame" else path
    path.rename(tmp_path / "outside")
    path.symlink_to(tmp_path / "outside")
    result = import_touch_and_go(root, tmp_path / "out")
    assert result.manifest.require_valid().root == root.resolve()
    assert result.manifest.table["tactile"].str.starts_with("dataset/a/gelsight_frame/").all()


@pytest.mark.nightly
def test_the_five_real_clips(real_data, tmp_path):
    result = import_touch_and_go(real_data / "touch_and_go" / "clips", tmp_path / "out")
    table = result.manifest.require_valid().table
    assert (table.height, table["contact"].n_unique(), table["video"].n_unique()) == (436, 17, 5)
    counts = dict(table["material"].value_counts().iter_rows())
    assert counts == {"Rock": 124, "Wood": 111, "Concrete": 88, "Brick": 58, "Grass": 55}
    assert table["background"].null_count() == 0
    assert result.facts["backgrounds"] == "frame 17"
    # The gel differs from its background more at the height of a contact than at its start.
    for (_,), group in table.sort("frame").group_by("contact"):
        gel = lambda p: np.asarray(Image.open(result.manifest.path(p)), np.float32)
        rest = gel(group["background"][0])
        change = [np.abs(gel(p) - rest).mean() for p in group["tactile"]]
        assert max(change) > change[0], group["contact"][0]
        assert (pl.Series(change) > 0).all()


def test_materials_of_ones_own_get_numbers_and_a_table_in_lists(tmp_path):
    materials = ["Wood", "oak bark", "felt: thin", None]
    rows = [
        {"id": f"v/{k}", "video": "v", "frame": k, "material": m} for k, m in enumerate(materials)
    ]
    manifest = Manifest.from_rows(rows, tmp_path)
    split = Split.from_ids(train=manifest.ids)
    files = write_lists(manifest, split, tmp_path / "lists")
    assert [path.name for path in files] == ["train.txt", "category_reference.txt"]
    again = read_list(files[0]).manifest
    assert dict(again.table.select("id", "material").iter_rows()) == {
        f"v/{k:010d}": name for k, name in enumerate(materials) if name
    }
