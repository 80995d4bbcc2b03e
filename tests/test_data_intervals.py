"""Interval lists: the same samples as frame lists of the same contacts, and every bad line."""

import numpy as np
import polars as pl
import pytest

from forge.errors import fails
from forge.pictures import number, tree, write_frames, write_video
from palpate.data.images import read_image
from palpate.data.importing import import_dataset, validate
from palpate.data.listing import read_list


def recording(root, name, count=40, *, raw=False):
    if raw:
        pytest.importorskip("av", reason="PyAV is not installed")
        write_video(root / name / "video.mp4", count)
        write_video(root / name / "gelsight.mp4", count)
    else:
        write_frames(root / name / "video_frame", count)
        write_frames(root / name / "gelsight_frame", count)
    return root


LIST = "video,start,end,label\na,10,15,3\na,17,19,15\na,30,33,-1\n"


def shown(manifest, column):
    return [number(np.asarray(read_image(manifest.path(p)))) for p in manifest.column(column)]


@pytest.mark.parametrize("raw", [False, True])
def test_intervals_give_what_a_frame_list_of_the_same_contacts_gives(tmp_path, raw):
    root = recording(tmp_path / "tag", "a", raw=raw)
    (root / "list.csv").write_text(LIST)
    contacts = {3: range(10, 16), 15: range(17, 20), -1: range(30, 34)}
    lines = [f"a/{k:010d}.jpg,{label}" for label, frames in contacts.items() for k in frames]
    (root / "label.txt").write_text("\n".join(lines))
    (root / "classes.txt").write_text("Wood: 3\nRock: 15\n")
    options = {"classes": root / "classes.txt"}
    result = import_dataset(root / "list.csv", tmp_path / "out", sensor="GelSight'17", **options)
    expected = import_dataset(root, tmp_path / "tag_out", format="touch-and-go")
    assert result.manifest.require_valid().digest == expected.manifest.digest
    assert result.inconclusive == 1  # intervals here, frames there
    frames = [*range(10, 16), *range(17, 20)]
    assert shown(result.manifest, "tactile") == shown(result.manifest, "vision") == frames
    assert shown(result.manifest, "background") == [6] * 6 + [9] * 3
    report = validate(root / "list.csv", **options)
    assert (report.ok, report.samples, report.format) == (True, 9, "intervals")


FROM_FILE = {"video": "replace(split_part(file, '/', -1), '.mp4', '')", "material": "what"}


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("a,10,12,Wood\na,20,20,Rock", {}),  # no header
        ("video;start;end;material\na;10;12;Wood\na;20;20;Rock", {}),
        ("file,start,end,what\nx/a.mp4,10,12,Wood\nx/a.mp4,20,20,Rock", {"columns": FROM_FILE}),
        ("label,end,start,video\nRock,20,20,a\nWood,12.0,10,a", {}),
        ("a 10 12 Wood\na 20  20\tRock", {}),
    ],
)
def test_forms_of_the_same_list(tmp_path, text, options):
    root = recording(tmp_path / "d", "a")
    path = root / ("l.csv" if "," in text or ";" in text else "l.txt")
    path.write_text(text)
    result = import_dataset(path, tmp_path / "out", **({"format": "intervals"} | options))
    assert result.manifest.ids == [f"a/{k:010d}" for k in (10, 11, 12, 20)]
    assert result.manifest.column("contact") == ["a#0001"] * 3 + ["a#0002"]
    assert result.manifest.column("material") == ["Wood"] * 3 + ["Rock"]
    assert result.manifest.column("sensor") == [None] * 4


def test_words_root_thinning_and_recordings_without_contacts(tmp_path):
    recording(recording(tmp_path / "d", "a"), "spare")
    text = 'video,start,end,object,text\na,10,16,chair,"soft, warm"\na,20,22,,\n'
    (tmp_path / "l.csv").write_text(text)
    result = import_dataset(tmp_path / "l.csv", tmp_path / "out", root=tmp_path / "d", every=3)
    manifest = result.manifest
    assert manifest.column("frame") == [10, 13, 16, 20]
    assert manifest.column("object") == ["chair"] * 3 + [None]
    assert manifest.column("text") == ["soft, warm"] * 3 + [None]
    # 4 before 20 is in the first contact, which is whole though thinned
    assert shown(manifest, "background") == [6, 6, 6, 9]
    assert manifest.column("material") == [None] * 4
    (problem,) = result.suspicious
    assert (problem.where, problem.kind) == (str(tmp_path / "d"), "unlisted-video")
    assert validate(tmp_path / "l.csv", root=tmp_path / "d").suspicious == result.suspicious


def test_validation_decodes_raw_videos(tmp_path):
    root = recording(tmp_path / "d", "a", raw=True)
    (root / "l.csv").write_text(LIST)
    assert validate(root / "l.csv").samples == 9
    path = root / "a" / "gelsight.mp4"
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    third = (len(data) - start) // 3
    data[start + third : start + 2 * third] = b"\xff" * third
    path.write_bytes(bytes(data))
    report = validate(root / "l.csv")
    assert [p.kind for p in report.invalid] == ["bad-video"]
    error = fails("", import_dataset, root / "l.csv", tmp_path / "out")
    assert list(error.problems) == list(report.invalid)


def test_every_bad_interval_is_reported_by_its_line(tmp_path):
    root = recording(tmp_path / "d", "a")
    recording(root, "b")
    (root / "b" / "gelsight_frame" / "0000000031.jpg").unlink()
    (root / "b" / "video_frame" / "0000000035.jpg").write_bytes(b"")
    lines = [
        ("a,1,3,x", None),
        ("a,5,9,x", "overlap"),
        ("a,8,12,y", "overlap"),
        ("a,12,14,y", "overlap"),
        ("a,1,3,x", "duplicate-row"),
        ("a,20,19,x", "bad-interval"),
        ("none,1,2,x", "missing-video"),
        ("a,38,40,x", "beyond-end"),
        ("a,one,2,x", "bad-frame"),
        (",1,2,x", "empty-cell"),
        ("b,30,32,x", "missing-file"),
        ("b,34,36,x", "bad-image"),
        ("a,1,2", "bad-row"),
        ("a,16,,x", "empty-cell"),
        ("a,15,15,z", None),
        ("a,999999999999,9999999999999,x", "beyond-end"),
    ]
    (root / "l.csv").write_text("video,start,end,label\n" + "\n".join(line for line, _ in lines))
    error = fails("", import_dataset, root / "l.csv", tmp_path / "out")
    reported = [(p.where, p.kind) for p in error.problems]
    assert sorted(reported) == sorted(
        (f"{root / 'l.csv'}:{n}", kind) for n, (_, kind) in enumerate(lines, 2) if kind
    )
    assert f"overlap with 8 to 12 at {root / 'l.csv'}:4" in next(
        p.text for p in error.problems if p.where.endswith(":3")
    )
    assert not (tmp_path / "out").exists()
    report = validate(root / "l.csv")
    assert sorted((p.where, p.kind) for p in [*report.missing, *report.invalid]) == sorted(reported)
    result = import_dataset(root / "l.csv", tmp_path / "out", skip_bad=True)
    frames = result.manifest.table.select("video", "frame").rows()
    assert frames == [*(("a", k) for k in (1, 2, 3, 15)), *(("b", k) for k in (30, 32, 34, 36))]
    assert report.samples == len(result.manifest)


def test_overlaps_are_those_of_a_slow_search(tmp_path):
    rng = np.random.default_rng(0)
    root = recording(tmp_path / "d", "a", 90)
    for _ in range(12):
        spans = [
            (a, a + n) for a, n in zip(rng.integers(0, 80, 9), rng.integers(0, 8, 9), strict=True)
        ]
        lines = ["video,start,end,label", *(f"a,{a},{b},{k}" for k, (a, b) in enumerate(spans))]
        (root / "l.csv").write_text("\n".join(lines))
        share = lambda i, j: i != j and i[1][0] <= j[1][1] and j[1][0] <= i[1][1]
        slow = {i[0] for i in enumerate(spans) if any(share(i, j) for j in enumerate(spans))}
        report = validate(root / "l.csv", check="none")
        assert {int(p.where.rpartition(":")[2]) - 2 for p in report.invalid} == slow


def test_mistakes(tmp_path):
    root = recording(tmp_path / "d", "a")
    (root / "l.csv").write_text("video,start,label\na,1,x\n")
    (tmp_path / "bare").mkdir()
    end = {"columns": {"end": "start"}}
    for options, word in (
        ({}, "no end among video, start, label"),
        ({"every": 0, **end}, "`every` must be"),
        ({"root": tmp_path / "none"}, "no folder"),
        ({"size": 0}, "`size` must"),
        ({"root": tmp_path / "bare"}, "must hold recordings"),
    ):
        fails(word, import_dataset, root / "l.csv", tmp_path / "out", format="intervals", **options)
    assert tree(tmp_path / "out") == set()


@pytest.mark.nightly
def test_the_real_clips_by_intervals_are_those_by_frames(real_data, tmp_path):
    pytest.importorskip("av", reason="PyAV is not installed")
    root = real_data / "touch_and_go" / "clips"
    columns = {"video": pl.first("video"), "start": pl.min("frame"), "end": pl.max("frame")}
    columns["label"] = pl.first("material")
    listed = read_list(root / "label.txt").manifest.table
    contacts = listed.group_by("contact", maintain_order=True).agg(**columns)
    assert contacts.height == 17
    path = tmp_path / "contacts.csv"
    contacts.drop("contact").write_csv(path)
    result = import_dataset(path, tmp_path / "out", root=root, sensor="GelSight'17", size=64)
    assert len(result.manifest) == 436
    expected = import_dataset(root, tmp_path / "tag", size=64, format="touch-and-go")
    assert result.manifest.digest == expected.manifest.digest
