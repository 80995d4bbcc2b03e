"""TaRF, ObjectFolder-Real in both layouts, YCB-Slide: every row of a forged tree known by hand, and everything bad told."""

import json
from functools import partial

import pytest

from data_forge import write_image
from formats_forge import (
    drawn,
    forge_objectfolder,
    forge_objectfolder_generation,
    forge_tarf,
    forge_visgel,
    forge_visgel_recordings,
    forge_ycb_slide,
    imported,
    kinds,
    of_kind,
    row,
)
from palpate.core import PalpateError, ProblemsError, Split
from palpate.data.formats.numbered import few, natural, numbered
from palpate.data.importing import import_dataset, validate_dataset, write_lists

BOM = b"\xef\xbb\xbf"


# --- TaRF


def test_tarf_pairs_touch_with_the_view_of_its_number(tmp_path):
    found = imported(forge_tarf, tmp_path)
    assert found.facts["format"] == "tarf"
    assert found.facts["license"] == "no license found"
    assert found.manifest.ids == [f"bench/{k}" for k in range(5)] + [
        f"office_1/{k}" for k in range(9, 14)
    ]  # 9 before 10
    assert row(found, "office_1/10") == {
        "id": "office_1/10",
        "video": "office_1",
        "frame": 10,
        "vision": "vision/office_1_40_30/10.jpg",
        "tactile": "touch/office_1_40_30/10.jpg",
        "background": "touch_bg/office_1_40_30/bg.jpg",
        "sensor": "DIGIT",
    }
    assert row(found, "bench/0")["background"] == "touch_bg/bench_outdoor_1_colmap_40_50/bg.jpg"
    assert drawn(found, "tactile") == list(range(1, 11))
    assert drawn(found, "vision") == list(range(33, 43))
    assert found.splits["Orig"].counts() == {"train": 4, "val": 1, "test": 5}
    assert found.splits["Orig"].ids("val") == ["bench/4"]
    assert found.facts["depth"] == "1 folders of .npy files, not imported"
    assert found.facts["vision_scale"] == "40_30"
    assert found.suspicious == []


def test_tarf_views_of_another_scale(tmp_path):
    found = imported(forge_tarf, tmp_path, scale="80_60")
    assert drawn(found, "vision") == list(range(65, 75))
    assert found.facts["vision_scale"] == "80_60"
    with pytest.raises(PalpateError, match="Got 40_30, 80_60"):
        import_dataset(tmp_path / "data" / "tarf", tmp_path / "no", scale="1_1")
    root = tmp_path / "data" / "tarf"
    (root / "vision" / "bench_40_30").rename(root / "vision" / "bench_160_120")
    with pytest.raises(PalpateError, match="one must be named"):
        import_dataset(root, tmp_path / "no")


def test_tarf_list_goes_round_trip(tmp_path):
    found = imported(forge_tarf, tmp_path)
    (path,) = write_lists(found.manifest, found.splits["Orig"], tmp_path / "lists")
    assert path.name == "split_interval.json"
    assert json.loads(path.read_text()) == json.loads(
        (tmp_path / "data" / "tarf" / "split_interval.json").read_text()
    )


def test_tarf_tells_everything_bad(tmp_path):
    root = forge_tarf(tmp_path / "data").source
    (root / "vision" / "bench_40_30" / "1.jpg").unlink()
    (root / "touch" / "bench_40_30" / "2.jpg").unlink()
    (root / "touch" / "bench_40_30" / "3.jpg").write_bytes(b"")
    (root / "touch_bg" / "office_1_40_30" / "bg.jpg").unlink()
    write_image(root / "touch" / "bench_40_30" / "0004.jpg", 7)
    write_image(root / "touch" / "bench_40_30" / "last one.jpg", 7)
    for side in ("touch", "vision"):
        write_image(root / side / "Küche neu_40_30" / "1.jpg", 8)
    write_image(root / "vision" / "lounge_40_30" / "1.jpg", 8)
    lists = {
        "train": [
            ["bench_40_30", "0"],
            ["bench_40_30", 1],
            ["bench_40_30", "2"],
            ["snow_40_30", "1"],
            ["snow_40_30", "2"],
            ["bench_40_30"],
        ],
        "test": [
            ["bench_40_30", "0"],
            ["office_1_40_30", "0009"],
            ["office_1_40_30", "9"],
            ["../x_40_30", "1"],
            ["office_1_40_30", "x"],
        ],
        "extra": [],
    }
    (root / "split_interval.json").write_bytes(
        BOM + json.dumps(lists, indent=1).replace("\n", "\r\n").encode()
    )
    looked = validate_dataset(root)
    assert kinds(looked.missing) == {"unpaired": 2, "missing-folder": 2, "missing-file": 1}
    assert kinds(looked.invalid) == {
        "bad-image": 1,
        "duplicate-frame": 1,
        "unknown-part": 1,
        "bad-line": 1,
        "two-parts": 1,
        "duplicate-row": 1,
        "outside-root": 1,
        "bad-frame": 1,
    }
    assert kinds(looked.suspicious) == {
        "no-background": 2,
        "unknown-name": 1,
        "unknown-scene": 1,
        "unlisted": 1,
    }
    assert "1: Küche neu" in of_kind(looked.suspicious, "unknown-scene").text
    assert (
        "'snow', of which 2 entries"
        in next(p for p in looked.missing if p.kind == "missing-folder").text
    )
    assert "0 bytes" in of_kind(looked.invalid, "bad-image").text
    with pytest.raises(ProblemsError):
        import_dataset(root, tmp_path / "out")
    found = import_dataset(root, tmp_path / "out", skip_bad=True)
    assert found.manifest.ids == [
        "Küche neu/1",
        "bench/0",
        "bench/0004",
        *(f"office_1/{k}" for k in range(9, 14)),
    ]
    assert dict(found.splits["Orig"].parts) == {
        "office_1/9": "test"
    }  # bench/0 is in two parts, bench/1 has no view


def test_tarf_broken_lists_and_empty_trees(tmp_path):
    root = forge_tarf(tmp_path / "data").source
    for text in ("{", "[1]", '{"train": 3}'):
        (root / "split_interval.json").write_text(text)
        assert kinds(validate_dataset(root).invalid) == {"bad-list": 1}, text
    (tmp_path / "bare" / "touch").mkdir(parents=True)
    with pytest.raises(PalpateError, match="Got none"):
        import_dataset(tmp_path / "bare", tmp_path / "out", format="tarf")
    with pytest.raises(PalpateError, match="must be a folder"):
        import_dataset(root / "split_interval.json", tmp_path / "out", format="tarf")


# --- ObjectFolder-Real


def test_objectfolder_trials_in_the_order_of_numbers(tmp_path):
    found = imported(forge_objectfolder, tmp_path)
    assert found.facts["format"] == "objectfolder"
    assert found.facts["license"].startswith("unknown")
    frames = {"2/1": (1, 2, 3, 4), "2/2": (10, 11), "10/1": (1, 2), "17/3": (1,)}
    assert found.manifest.ids == [f"{trial}/{k}" for trial, those in frames.items() for k in those]
    assert row(found, "2/2/10") == {
        "id": "2/2/10",
        "video": "2/2",
        "frame": 10,
        "object": "2",
        "material": "Ceramic",
        "sensor": "GelSight",
        "tactile": "2/tactile_data/2/0/gelsight/10.png",
        "background": "2/tactile_data/2/0/gelsight/9.png",
    }
    assert found.manifest.column("material") == ["Ceramic"] * 8 + ["Iron"]
    assert drawn(found, "tactile") == [2, 3, 4, 5, 7, 8, 10, 11, 13]
    assert drawn(found, "background") == [1] * 4 + [6] * 2 + [9] * 2 + [12]
    assert found.splits == {}
    assert found.suspicious == []
    written = write_lists(
        found.manifest, Split(dict.fromkeys(found.manifest.ids, "test")), tmp_path / "lists"
    )
    assert [p.name for p in written] == ["test.csv"]


def test_objectfolder_without_a_table_has_no_materials(tmp_path):
    root = forge_objectfolder(tmp_path / "data").source
    table = tmp_path / "table.csv"
    (root / "objectfolder_real_metadata.csv").rename(table)
    assert set(import_dataset(root, tmp_path / "out").manifest.column("material")) == {None}
    assert (
        import_dataset(root, tmp_path / "out", metadata=table).manifest.column("material")[-1]
        == "Iron"
    )
    with pytest.raises(PalpateError, match=r"github\.com/alanzjl/t3"):
        import_dataset(root, tmp_path / "out", metadata=tmp_path / "none.csv")
    table.write_text("number,stuff\n1,Wood\n")
    with pytest.raises(PalpateError, match="Index, Name, Material"):
        import_dataset(root, tmp_path / "out", metadata=table)


def test_objectfolder_tells_everything_bad(tmp_path):
    root = forge_objectfolder(tmp_path / "data").source
    table = 'Index,Name,Material\r\n2,Bowl,Ceramic\r\n2,Bowl,Wood\r\nx,Cup,Glass\r\n10,Cup\r\n17,"Pan, big",Teflon\r\n'
    (root / "objectfolder_real_metadata.csv").write_bytes(BOM + table.encode())
    (root / "2" / "tactile_data" / "4").mkdir()  # no gelsight
    (root / "2" / "tactile_data" / "5" / "0" / "gelsight").mkdir(parents=True)  # empty
    (root / "2" / "tactile_data" / "notes").mkdir()
    (root / "3").mkdir()
    write_image(
        root / "101" / "tactile_data" / "1" / "0" / "gelsight" / "0.png", 70
    )  # unpublished, a single picture
    write_image(root / "2" / "tactile_data" / "1" / "0" / "gelsight" / "04.png", 71)
    write_image(root / "2" / "tactile_data" / "1" / "0" / "gelsight" / "reference.png", 71)
    (root / "meshes").mkdir()
    cut = root / "10" / "tactile_data" / "1" / "0" / "gelsight" / "1.png"
    cut.write_bytes(cut.read_bytes()[:-30])
    looked = validate_dataset(root)
    assert kinds(looked.missing) == {"missing-folder": 2, "missing-frames": 1}
    assert kinds(looked.invalid) == {
        "two-labels": 1,
        "bad-line": 1,
        "bad-row": 1,
        "duplicate-frame": 1,
        "bad-image": 1,
    }
    assert kinds(looked.suspicious) == {
        "unknown-folder": 2,
        "unknown-object": 1,
        "no-material": 1,
        "unknown-material": 1,
        "no-background": 1,
        "unknown-name": 1,
    }
    assert of_kind(looked.suspicious, "no-material").text.endswith("3: 3, 10, 101")
    assert "Teflon" in of_kind(looked.suspicious, "unknown-material").text
    found = import_dataset(root, tmp_path / "out", skip_bad=True)
    assert found.manifest.ids == [
        "2/1/1",
        "2/1/2",
        "2/1/3",
        "2/1/4",
        "2/2/10",
        "2/2/11",
        "10/1/2",
        "17/3/1",
        "101/1/0",
    ]
    assert row(found, "101/1/0").keys().isdisjoint({"background", "material"})


# --- the cross-generation benchmark


def test_generation_pairs_and_its_two_settings(tmp_path):
    found = imported(forge_objectfolder_generation, tmp_path)
    assert found.facts["format"] == "objectfolder-generation"
    assert found.manifest.ids == [f"{o}/{c}" for o in (1, 2, 10) for c in (0, 7, 12, 100)]
    assert row(found, "2/12") == {
        "id": "2/12",
        "object": "2",
        "vision": "vision/2/12.png",
        "tactile": "touch/2/12.png",
        "background": "touch_ref/touch_ref.png",
        "sensor": "GelSight",
    }
    assert drawn(found, "tactile") == list(range(1, 13))
    assert drawn(found, "vision") == list(range(33, 45))
    contact, thing = found.splits["cross_contact"], found.splits["cross_object"]
    assert contact.counts() == {"train": 6, "val": 3, "test": 3}
    assert thing.counts() == {"train": 4, "val": 4, "test": 4}
    shared = [
        {found.manifest.take([i]).column("object")[0] for i in s.ids("test")}
        & {i.split("/")[0] for i in s.ids("train")}
        for s in (contact, thing)
    ]
    assert shared == [{"1", "2", "10"}, set()]
    (path,) = write_lists(found.manifest, contact, tmp_path / "lists")
    theirs = json.loads((tmp_path / "data" / "generation" / "cross_contact.json").read_text())
    assert {part: sorted(rows) for part, rows in json.loads(path.read_text()).items()} == {
        part: sorted(rows) for part, rows in theirs.items()
    }


def test_generation_tells_everything_bad(tmp_path):
    root = forge_objectfolder_generation(tmp_path / "data").source
    (root / "cross_object.json").unlink()
    (root / "package.json").write_text('{"name": "x"}')
    (root / "broken.json").write_text("{")
    (root / "vision" / "1" / "7.png").unlink()
    (root / "touch" / "1" / "12.png").unlink()
    (root / "touch_ref" / "touch_ref.png").unlink()
    for path in (root / "vision" / "10").iterdir():
        path.unlink()
    (root / "vision" / "10").rmdir()
    for side in ("touch", "vision"):
        write_image(root / side / "tasse à thé, bleue" / "ein.png", 90)
    looked = validate_dataset(root)
    assert kinds(looked.missing) == {"unpaired": 2, "missing-folder": 1, "missing-file": 1}
    assert "for 4 contacts" in of_kind(looked.missing, "missing-folder").text
    assert kinds(looked.invalid) == {"bad-list": 1}
    assert kinds(looked.suspicious) == {"no-background": 1, "unknown-file": 1, "unlisted": 1}
    found = import_dataset(root, tmp_path / "out", skip_bad=True)
    assert found.manifest.ids == [
        "1/0",
        "1/100",
        "2/0",
        "2/7",
        "2/12",
        "2/100",
        "tasse à thé, bleue/ein",
    ]
    assert {name: split.counts() for name, split in found.splits.items()} == {
        "Orig": {"train": 3, "val": 1, "test": 2}
    }
    (path,) = write_lists(
        found.manifest,
        Split({"tasse à thé, bleue/ein": "test", "2/7": "train"}),
        tmp_path / "lists",
    )
    assert json.loads(path.read_text()) == {
        "train": [[2, 7]],
        "val": [],
        "test": [["tasse à thé, bleue", "ein"]],
    }


# --- YCB-Slide


def test_ycb_slide_real_logs_with_the_webcam(tmp_path):
    found = imported(forge_ycb_slide, tmp_path)
    assert found.facts["format"] == "ycb-slide"
    assert found.facts["layout"] == "real"
    logs = [f"{o}/dataset_{k}" for o in ("004_sugar_box", "055_baseball") for k in (0, 4)]
    assert found.manifest.ids == [f"{log}/{k}" for log in logs for k in range(3)]
    assert row(found, "055_baseball/dataset_4/2") == {
        "id": "055_baseball/dataset_4/2",
        "video": "055_baseball/dataset_4",
        "frame": 2,
        "object": "055_baseball",
        "sensor": "DIGIT",
        "vision": "real/055_baseball/dataset_4/webcam_frames/frame_0000002.jpg",
        "domain": "real",
        "tactile": "real/055_baseball/dataset_4/frames/frame_0000002.jpg",
    }
    assert drawn(found, "tactile") == list(range(1, 13))
    assert drawn(found, "vision") == list(range(33, 45))
    sparsh = found.splits["sparsh"]
    assert sparsh.ids("test") == [f"{log}/{k}" for log in logs[1::2] for k in range(3)]
    assert sparsh.counts() == {"train": 6, "test": 6}
    assert sparsh.rule["source"] == "facebookresearch/sparsh"
    objects = {part: {i.split("/")[0] for i in sparsh.ids(part)} for part in ("train", "test")}
    assert objects["train"] == objects["test"]  # its leak: every object is shared
    assert kinds(found.suspicious) == {"missing-object": 1, "missing-log": 2}


def test_ycb_slide_logs_0_to_3_train_and_log_4_tests(tmp_path):
    root = forge_ycb_slide(tmp_path / "data").source
    logs = root / "real" / "055_baseball"
    (logs / "dataset_0").rename(logs / "dataset_3")
    parts = import_dataset(root, tmp_path / "out").splits["sparsh"].parts
    assert {i.partition("/")[2].rpartition("/")[0]: part for i, part in parts.items()} == {
        "dataset_0": "train",
        "dataset_3": "train",
        "dataset_4": "test",
    }


def test_ycb_slide_simulated_part(tmp_path):
    found = imported(forge_ycb_slide, tmp_path, part="sim")
    assert found.manifest.ids == ["025_mug/03/0", "025_mug/03/1"]
    assert found.manifest.column("vision") == [None, None]
    assert drawn(found, "tactile") == [65, 66]
    assert found.facts["simulated"] == "yes"
    assert found.splits == {}
    with pytest.raises(PalpateError, match="real or sim"):
        import_dataset(tmp_path / "data" / "ycb", tmp_path / "out", part="both")


def test_ycb_slide_tells_everything_bad(tmp_path):
    root = forge_ycb_slide(tmp_path / "data").source
    first, second, third, fourth = (
        root / "real" / o / f"dataset_{k}"
        for o in ("004_sugar_box", "055_baseball")
        for k in (0, 4)
    )
    for k in (0, 2):
        (first / "webcam_frames" / f"frame_{k:07d}.jpg").unlink()
    write_image(first / "webcam_frames" / "frame_0000009.jpg", 9)
    for path in (second / "frames").iterdir():
        path.unlink()
    (second / "frames.mp4").write_bytes(b"video")
    for path in (third / "webcam_frames").iterdir():
        path.unlink()
    (fourth / "frames" / "frame_0000001.jpg").unlink()
    (fourth / "frames" / "frame_0000002.jpg").write_bytes(b"no picture")
    write_image(root / "real" / "my own cup" / "dataset_7" / "frames" / "frame_0000000.jpg", 9)
    looked = validate_dataset(root)
    assert kinds(looked.missing) == {"unpaired": 3, "missing-frames": 1}
    assert [
        p.text for p in looked.missing if p.where.startswith("real/004_sugar_box/dataset_0")
    ] == [
        "touch frames without a webcam frame, 2: 0, 2",
        "webcam frames without a touch frame, 1: 9",
    ]
    assert "ffmpeg -i frames.mp4" in of_kind(looked.missing, "missing-frames").text
    assert kinds(looked.invalid) == {"bad-image": 1}
    assert kinds(looked.suspicious) == {
        "no-vision": 2,
        "frame-gap": 1,
        "unknown-object": 1,
        "missing-object": 1,
        "missing-log": 3,
    }
    found = import_dataset(root, tmp_path / "out", skip_bad=True)
    assert found.manifest.ids == [
        "004_sugar_box/dataset_0/1",
        *(f"055_baseball/dataset_0/{k}" for k in range(3)),
        "055_baseball/dataset_4/0",
        "my own cup/dataset_7/0",
    ]
    assert found.manifest.column("vision").count(None) == 4
    assert (
        "my own cup/dataset_7/0" not in found.splits["sparsh"].parts
    )  # a log that Sparsh does not know


@pytest.mark.parametrize(
    ("forge", "name", "place", "stray"),
    [
        (forge_tarf, "tarf", "touch/bench_40_30", "99999999999999999999.jpg"),
        (forge_visgel_recordings, "visgel", "2/rec", "frame99999999999999999999.jpg"),
        (
            forge_objectfolder,
            "objectfolder",
            "2/tactile_data/1/0/gelsight",
            "99999999999999999999.png",
        ),
        (
            forge_ycb_slide,
            "ycb-slide",
            "real/055_baseball/dataset_0/frames",
            "frame_99999999999999999999.jpg",
        ),
    ],
)
def test_numbers_too_long_for_a_frame_are_told_and_left_out(tmp_path, forge, name, place, stray):
    forged = forge(tmp_path / "data")
    folder = next(forged.source.glob(place))
    write_image(folder / stray, 3)
    looked = validate_dataset(forged.source, format=name)
    assert looked.samples == forged.samples
    assert stray in of_kind(looked.suspicious, "unknown-name").text
    assert (
        len(import_dataset(forged.source, tmp_path / "out", format=name).manifest) == forged.samples
    )


# --- all of them


@pytest.mark.parametrize(
    ("forge", "name"),
    [
        (forge_tarf, "tarf"),
        (forge_visgel, "visgel"),
        (forge_visgel_recordings, "visgel"),
        (forge_objectfolder, "objectfolder"),
        (forge_objectfolder_generation, "objectfolder-generation"),
        (forge_ycb_slide, "ycb-slide"),
    ],
)
def test_links_out_of_the_tree_are_refused(tmp_path, forge, name):
    forged = forge(tmp_path / "data")
    take = partial(import_dataset, forged.source, tmp_path / "out", format=name)
    path = take().manifest.paths("tactile")[-1]
    path.rename(tmp_path / "outside.jpg")
    path.symlink_to(tmp_path / "outside.jpg")
    with pytest.raises(ProblemsError, match="outside-root"):
        take()
    (tmp_path / "outside.jpg").unlink()
    with pytest.raises(ProblemsError, match="outside-root"):
        take()


def test_numbers_are_integers_and_nothing_is_lost_in_silence(tmp_path):
    for name in ("2.jpg", "10.jpg", "9.PNG", "009.jpg", "x.jpg", ".3.jpg", "4.txt"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "5.jpg").mkdir()
    found = numbered(tmp_path)
    assert list(found.files.items()) == [(2, "2.jpg"), (9, "009.jpg"), (10, "10.jpg")]
    assert found.doubled == [("9.PNG", "009.jpg")]
    assert found.odd == ["x.jpg"]
    assert sorted(["10", "b", "9", "009", "a"], key=natural) == ["009", "9", "10", "a", "b"]
    assert numbered(tmp_path / "none").files == {}
    assert [few("abcd"), few([1]), few([])] == ["4: a, b, c ...", "1: 1", "none"]
