"""Interval lists: the same samples as frame lists of the same contacts, and every bad line."""

import numpy as np
import polars as pl
import pytest

from data_fixtures import number, tree, write_frames, write_video
from palpate.core import PalpateError, ProblemsError, Split
from palpate.data.formats.touch_and_go import import_touch_and_go
from palpate.data.images import read_image
from palpate.data.importing import import_dataset, validate, write_lists
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
    frames = (
        [(k, 3) for k in range(10, 16)]
        + [(k, 15) for k in range(17, 20)]
        + [(k, -1) for k in range(30, 34)]
    )
    (root / "label.txt").write_text("\n".join(f"a/{k:010d}.jpg,{c}" for k, c in frames))
    (root / "classes.txt").write_text("Wood: 3\nRock: 15\n")
    result = import_dataset(
        root / "list.csv", tmp_path / "out", classes=root / "classes.txt", sensor="GelSight'17"
    )
    expected = import_touch_and_go(root, tmp_path / "tag_out")
    assert result.manifest.require_valid().digest == expected.manifest.digest
    assert result.inconclusive == 1  # intervals here, frames there
    assert (
        shown(result.manifest, "tactile")
        == shown(result.manifest, "vision")
        == [*range(10, 16), *range(17, 20)]
    )
    assert shown(result.manifest, "background") == [6] * 6 + [9] * 3
    assert result.facts["format"] == "intervals"
    report = validate(root / "list.csv", classes=root / "classes.txt")
    assert (report.ok, report.samples, report.format) == (True, 9, "intervals")


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("a,10,12,Wood\na,20,20,Rock", {}),  # no header
        ("Clip;First;Last;Class\na;10;12;Wood\na;20;20;Rock", {}),
        ("video,start,end,label\na,10,13,Wood\na,20,21,Rock", {"half_open": True}),
        (
            "file,from,to,what\nx/a.mp4,10,12,Wood\nx/a.mp4,20,20,Rock",
            {
                "columns": {
                    "video": "replace(split_part(file, '/', -1), '.mp4', '')",
                    "material": "what",
                }
            },
        ),
        ("label,end,start,video\nRock,20,20,a\nWood,12.0,10,a", {}),
    ],
)
def test_forms_of_the_same_list(tmp_path, text, options):
    root = recording(tmp_path / "d", "a")
    (root / "l.csv").write_text(text)
    manifest = import_dataset(
        root / "l.csv", tmp_path / "out", format="intervals", **options
    ).manifest
    assert manifest.ids == [f"a/{k:010d}" for k in (10, 11, 12, 20)]
    assert manifest.column("contact") == ["a#0001"] * 3 + ["a#0002"]
    assert manifest.column("material") == ["Wood"] * 3 + ["Rock"]
    assert manifest.column("sensor") == [None] * 4


def test_words_backgrounds_root_and_thinning(tmp_path):
    recording(tmp_path / "d", "a")
    (tmp_path / "l.csv").write_text(
        'video,start,end,object,text,background\na,10,16,chair,"soft, warm",2\na,20,22,,,\n'
    )
    manifest = import_dataset(
        tmp_path / "l.csv", tmp_path / "out", root=tmp_path / "d", every=3
    ).manifest
    assert manifest.column("frame") == [10, 13, 16, 20]
    assert manifest.column("object") == ["chair"] * 3 + [None]
    assert manifest.column("text") == ["soft, warm"] * 3 + [None]
    assert shown(manifest, "background") == [
        2,
        2,
        2,
        9,
    ]  # 4 before 20 is in the first touch, whole though thinned
    assert manifest.column("material") == [None] * 4


def test_what_looks_wrong_is_reported_by_import_and_validation(tmp_path):
    recording(tmp_path, "a")
    recording(tmp_path, "spare")
    (tmp_path / "l.csv").write_text("video,start,end,background\na,10,16,2\na,20,22,15\n")
    result = import_dataset(tmp_path / "l.csv", tmp_path / "out")
    reported = [(p.where, p.kind) for p in result.suspicious]
    assert reported == [
        (f"{tmp_path / 'l.csv'}:3", "background-in-touch"),
        (str(tmp_path), "unlisted-video"),
    ]
    assert "frame 15 of 'a'" in result.suspicious[0].text
    assert list(validate(tmp_path / "l.csv").suspicious) == result.suspicious


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
    with pytest.raises(ProblemsError) as caught:
        import_dataset(root / "l.csv", tmp_path / "out")
    assert list(caught.value.problems) == list(report.invalid)


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
    with pytest.raises(ProblemsError) as caught:
        import_dataset(root / "l.csv", tmp_path / "out")
    reported = [(p.where, p.kind) for p in caught.value.problems]
    assert sorted(reported) == sorted(
        (f"{root / 'l.csv'}:{n}", kind) for n, (_, kind) in enumerate(lines, 2) if kind
    )
    assert f"overlap with 8 to 12 at {root / 'l.csv'}:4" in next(
        p.text for p in caught.value.problems if p.where.endswith(":3")
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
            (int(a), int(a + n))
            for a, n in zip(rng.integers(0, 80, 9), rng.integers(0, 8, 9), strict=True)
        ]
        (root / "l.csv").write_text(
            "video,start,end,label\n"
            + "".join(f"a,{a},{b},{k}\n" for k, (a, b) in enumerate(spans))
        )
        slow = {
            k
            for k, (a, b) in enumerate(spans)
            for j, (c, d) in enumerate(spans)
            if j != k and a <= d and c <= b
        }
        report = validate(root / "l.csv", check="none")
        assert {int(p.where.rpartition(":")[2]) - 2 for p in report.invalid} == slow


def test_lists_of_a_split_hold_its_samples_and_come_back(tmp_path):
    root = recording(tmp_path / "d", "a")
    (root / "list.csv").write_text(LIST)
    manifest = import_dataset(root / "list.csv", tmp_path / "out").manifest
    split = Split({i: "test" if k in (2, 7) else "train" for k, i in enumerate(manifest.ids)})
    files = write_lists(manifest, split, tmp_path / "lists")
    assert files[1].read_text() == "video,start,end,label,object,text\na,12,12,3,,\na,18,18,15,,\n"
    for part, file in zip(("train", "test"), files, strict=True):
        again = import_dataset(file, tmp_path / part, root=root).manifest
        assert again.ids == manifest.part(split, part).ids
        assert again.column("material") == manifest.part(split, part).column("material")


def test_mistakes(tmp_path):
    root = recording(tmp_path / "d", "a")
    (root / "l.csv").write_text("video,start,label\na,1,x\n")
    for options, word in (
        ({}, "no end among video, start, label"),
        ({"every": 0, "columns": {"end": "start"}}, "`every` must be"),
        ({"root": tmp_path / "none"}, "no folder"),
        ({"size": 0}, "`size` must"),
    ):
        with pytest.raises(PalpateError, match=word):
            import_dataset(root / "l.csv", tmp_path / "out", format="intervals", **options)
    (tmp_path / "l.csv").write_text("video,start,end\na,1,2\n")
    (tmp_path / "bare").mkdir()
    with pytest.raises(PalpateError, match="must hold recordings"):
        import_dataset(tmp_path / "l.csv", tmp_path / "out", root=tmp_path / "bare")
    assert tree(tmp_path / "out") == set()


@pytest.mark.slow
def test_the_real_clips_by_intervals_are_those_by_frames(real_data, tmp_path):
    pytest.importorskip("av", reason="PyAV is not installed")
    root = real_data / "touch_and_go" / "clips"
    frame = pl.col("frame")
    contacts = (
        read_list(root / "label.txt")
        .manifest.table.group_by("contact", maintain_order=True)
        .agg(
            pl.col("video").first(),
            start=frame.min(),
            end=frame.max(),
            label=pl.col("material").first(),
        )
    )
    assert contacts.height == 17
    contacts.drop("contact").write_csv(tmp_path / "contacts.csv")
    result = import_dataset(
        tmp_path / "contacts.csv", tmp_path / "out", root=root, sensor="GelSight'17", size=64
    )
    assert len(result.manifest) == 436
    assert (
        result.manifest.digest
        == import_touch_and_go(root, tmp_path / "tag", size=64).manifest.digest
    )
