"""TaRF, ObjectFolder-Real in both layouts, YCB-Slide: rows known by hand, all problems reported."""

import json
import shutil

import pytest

from forge.errors import fails
from forge.formats import (
    drawn,
    imported,
    kinds,
    make_objectfolder,
    make_objectfolder_generation,
    make_tarf,
    make_ycb_slide,
    of_kind,
    row,
)
from forge.pictures import write_image
from palpate.core import PalpateError, Split, few
from palpate.data.formats.layout import natural, numbered
from palpate.data.importing import import_dataset, validate, write_lists
from palpate.data.scanning import Scan

BOM = b"\xef\xbb\xbf"


# --- The shared layout


def test_numbers_are_integers_and_nothing_is_skipped_silently(tmp_path):
    for name in ("2.jpg", "10.jpg", "9.PNG", "009.jpg", f"{10**19}.jpg", ".3.jpg", "4.txt"):
        (tmp_path / "a" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "a" / name).write_bytes(b"")
    (tmp_path / "a" / "5.jpg").mkdir()
    scan = Scan(tmp_path)
    assert list(numbered(scan, "a").files.items()) == [(2, "2.jpg"), (9, "009.jpg"), (10, "10.jpg")]
    assert [(p.where, p.kind) for p in scan.problems] == [("a/9.PNG", "duplicate-frame")]
    assert of_kind(scan.suspicious, "unknown-name").text.endswith(f": {10**19}.jpg")
    assert numbered(scan, "none").files == {}
    assert sorted(["10", "b", "9", "009", "a"], key=natural) == ["009", "9", "10", "a", "b"]
    assert [few("abcdefg"), few([1]), few([])] == ["a, b, c, d, e and 2 more", "1", "none"]


# --- TaRF


def test_tarf_pairs_tactile_images_with_the_view_of_their_number(tmp_path):
    result = imported(make_tarf, tmp_path)
    numbers = [f"office_1/{k}" for k in range(9, 14)]  # 9 before 10
    assert result.manifest.ids == [*(f"bench/{k}" for k in range(5)), *numbers]
    assert row(result, "office_1/10") == {
        "id": "office_1/10",
        "video": "office_1",
        "frame": 10,
        "vision": "vision/office_1_40_30/10.jpg",
        "tactile": "touch/office_1_40_30/10.jpg",
        "background": "touch_bg/office_1_40_30/bg.jpg",
        "sensor": "DIGIT",
    }
    assert row(result, "bench/0")["background"] == "touch_bg/bench_outdoor_1_colmap_40_50/bg.jpg"
    assert drawn(result, "tactile") == list(range(1, 11))
    assert drawn(result, "vision") == list(range(33, 43))
    assert result.splits["Orig"].counts() == {"train": 4, "val": 1, "test": 5}
    assert result.suspicious == []


def test_tarf_views_of_another_scale(tmp_path):
    root = make_tarf(tmp_path / "data").source
    for folder in (root / "vision").glob("*_40_30"):
        folder.rename(folder.with_name(folder.name.replace("40_30", "160_120")))
    fails(r"must have the scale 40_30\. Got 160_120, 80_60", import_dataset, root, tmp_path / "no")
    for folder in (root / "vision").glob("*_160_120"):
        shutil.rmtree(folder)
    result = import_dataset(root, tmp_path / "out")
    assert drawn(result, "vision") == list(range(65, 75))
    assert result.facts["vision_scale"] == "80_60"


def test_tarf_reports_everything_bad(tmp_path):
    root = make_tarf(tmp_path / "data").source
    (root / "vision" / "bench_40_30" / "1.jpg").unlink()
    (root / "touch" / "bench_40_30" / "2.jpg").unlink()
    (root / "touch" / "bench_40_30" / "3.jpg").write_bytes(b"")
    (root / "touch_bg" / "office_1_40_30" / "bg.jpg").unlink()
    extra = ["touch/bench_40_30/0004.jpg", "touch/bench_40_30/last one.jpg"]
    extra += ["touch/Küche neu_40_30/1.jpg", "vision/Küche neu_40_30/1.jpg"]
    for name in [*extra, "vision/lounge_40_30/1.jpg"]:
        write_image(root / name, 7)
    bench, office = "bench_40_30", "office_1_40_30"
    train = [[bench, "0"], [bench, 1], [bench, "2"], ["snow_40_30", "1"], ["snow_40_30", "2"]]
    test = [[bench, "0"], [office, "0009"], [office, "9"], ["../x_40_30", "1"], [office, "x"]]
    lists = json.dumps({"train": [*train, [bench]], "test": test, "extra": []}, indent=1)
    (root / "split_interval.json").write_bytes(BOM + lists.replace("\n", "\r\n").encode())
    result = validate(root)
    assert kinds(result.missing) == {"unpaired": 2, "missing-folder": 2, "missing-file": 1}
    wrong = ("bad-image", "duplicate-frame", "unknown-part", "bad-line", "two-parts")
    wrong += ("duplicate-row", "outside-root", "bad-frame")
    assert kinds(result.invalid) == dict.fromkeys(wrong, 1)
    odd = {"no-background": 2, "unknown-name": 1, "unlisted": 1}
    assert kinds(result.suspicious) == odd
    assert any("'snow_40_30', with 2 listed entries" in p.text for p in result.missing)
    assert "0 bytes" in of_kind(result.invalid, "bad-image").text
    result = import_dataset(root, tmp_path / "out", skip_bad=True)
    office_ids = [f"office_1/{k}" for k in range(9, 14)]
    assert result.manifest.ids == ["Küche neu/1", "bench/0", "bench/0004", *office_ids]
    # bench/0 is in two parts, bench/1 has no view
    assert dict(result.splits["Orig"].parts) == {"office_1/9": "test"}


def test_tarf_broken_lists_and_empty_trees(tmp_path):
    root = make_tarf(tmp_path / "data").source
    for text in ("{", "[1]", '{"train": 3}'):
        (root / "split_interval.json").write_text(text)
        assert kinds(validate(root).invalid) == {"bad-json": 1}, text
    (tmp_path / "bare" / "touch").mkdir(parents=True)
    with pytest.raises(PalpateError, match="must hold vision/ and touch/"):
        import_dataset(tmp_path / "bare", tmp_path / "out", format="tarf")
    with pytest.raises(PalpateError, match="must be a folder"):
        import_dataset(root / "split_interval.json", tmp_path / "out", format="tarf")


# --- ObjectFolder-Real


def test_objectfolder_trials_in_the_order_of_numbers(tmp_path):
    result = imported(make_objectfolder, tmp_path)
    frames = {"2/1": (1, 2, 3, 4), "2/2": (10, 11), "10/1": (1, 2), "17/3": (1,)}
    assert result.manifest.ids == [f"{trial}/{k}" for trial in frames for k in frames[trial]]
    assert row(result, "2/2/10") == {
        "id": "2/2/10",
        "video": "2/2",
        "frame": 10,
        "object": "2",
        "material": "Ceramic",
        "sensor": "GelSight",
        "tactile": "2/tactile_data/2/0/gelsight/10.png",
        "background": "2/tactile_data/2/0/gelsight/9.png",
    }
    assert result.manifest.column("material") == ["Ceramic"] * 8 + ["Iron"]
    assert drawn(result, "tactile") == [2, 3, 4, 5, 7, 8, 10, 11, 13]
    assert drawn(result, "background") == [1] * 4 + [6] * 2 + [9] * 2 + [12]
    assert (result.splits, result.suspicious) == ({}, [])
    split = Split(dict.fromkeys(result.manifest.ids, "test"))
    assert [p.name for p in write_lists(result.manifest, split, tmp_path / "l")] == ["test.csv"]


def test_objectfolder_table_of_materials(tmp_path):
    root = make_objectfolder(tmp_path / "data").source
    table = root / "objectfolder_real_metadata.csv"
    import_ = lambda name: import_dataset(root, tmp_path / name).manifest.column("material")
    assert import_("with")[-1] == "Iron"
    table.write_text("number,stuff\n1,Wood\n")
    fails("Index, Name, Material", import_, "other")
    table.unlink()
    assert set(import_("without")) == {None}


def test_objectfolder_reports_everything_bad(tmp_path):
    root = make_objectfolder(tmp_path / "data").source
    table = "Index,Name,Material\r\n2,Bowl,Ceramic\r\n2,Bowl,Wood\r\nx,Cup,Glass\r\n10,Cup\r\n"
    table += '17,"Pan, big",Teflon\r\n'
    (root / "objectfolder_real_metadata.csv").write_bytes(BOM + table.encode())
    for name in ("2/tactile_data/4", "2/tactile_data/5/0/gelsight", "2/tactile_data/notes", "3"):
        (root / name).mkdir(parents=True)
    (root / "meshes").mkdir()
    gelsight = root / "2/tactile_data/1/0/gelsight"
    unpublished = root / "101/tactile_data/1/0/gelsight/0.png"  # of a single image, too
    for path in (unpublished, gelsight / "04.png", gelsight / "reference.png"):
        write_image(path, 70)
    cut = root / "10" / "tactile_data" / "1" / "0" / "gelsight" / "1.png"
    cut.write_bytes(cut.read_bytes()[:-30])
    result = validate(root)
    assert kinds(result.missing) == {"missing-folder": 2, "missing-frames": 1}
    wrong = ("two-labels", "bad-line", "bad-row", "duplicate-frame", "bad-image")
    assert kinds(result.invalid) == dict.fromkeys(wrong, 1)
    odd = ("no-material", "no-background", "unknown-name")
    assert kinds(result.suspicious) == {"unknown-folder": 2, **dict.fromkeys(odd, 1)}
    assert of_kind(result.suspicious, "no-material").text.endswith(": 3, 10, 101")
    result = import_dataset(root, tmp_path / "out", skip_bad=True)
    ids = "2/1/1 2/1/2 2/1/3 2/1/4 2/2/10 2/2/11 10/1/2 17/3/1 101/1/0"
    assert result.manifest.ids == ids.split()
    assert row(result, "101/1/0").keys().isdisjoint({"background", "material"})


# --- The cross-generation benchmark


def test_generation_pairs_and_its_two_settings(tmp_path):
    result = imported(make_objectfolder_generation, tmp_path)
    assert result.manifest.ids == [f"{o}/{c}" for o in (1, 2, 10) for c in (0, 7, 12, 100)]
    assert row(result, "2/12") == {
        "id": "2/12",
        "object": "2",
        "vision": "vision/2/12.png",
        "tactile": "touch/2/12.png",
        "background": "touch_ref/touch_ref.png",
        "sensor": "GelSight",
    }
    assert drawn(result, "tactile") == list(range(1, 13))
    assert drawn(result, "vision") == list(range(33, 45))
    contact, by_object = result.splits["cross_contact"], result.splits["cross_object"]
    assert contact.counts() == {"train": 6, "val": 3, "test": 3}
    assert by_object.counts() == {"train": 4, "val": 4, "test": 4}
    objects = lambda split, part: {i.split("/")[0] for i in split.ids(part)}
    assert objects(contact, "train") == objects(contact, "test")
    assert objects(by_object, "train").isdisjoint(objects(by_object, "test"))


def test_generation_reports_everything_bad(tmp_path):
    root = make_objectfolder_generation(tmp_path / "data").source
    (root / "package.json").write_text('{"name": "x"}')
    (root / "broken.json").write_text("{")
    gone = ("cross_object.json", "vision/1/7.png", "touch/1/12.png", "touch_ref/touch_ref.png")
    for name in gone:
        (root / name).unlink()
    for path in (root / "vision" / "10").iterdir():
        path.unlink()
    (root / "vision" / "10").rmdir()
    strange = "tasse à thé, bleue/ein"
    for side in ("touch", "vision"):
        write_image(root / side / f"{strange}.png", 90)
    result = validate(root)
    assert kinds(result.missing) == {"unpaired": 2, "missing-folder": 1, "missing-file": 1}
    text = of_kind(result.missing, "missing-folder").text
    assert text == "no vision images here, for 4 in touch/10"
    assert kinds(result.invalid) == {"bad-json": 1}
    assert kinds(result.suspicious) == {"no-background": 1, "unknown-file": 1, "unlisted": 1}
    result = import_dataset(root, tmp_path / "out", skip_bad=True)
    assert result.manifest.ids == ["1/0", "1/100", "2/0", "2/7", "2/12", "2/100", strange]
    assert result.splits["Orig"].counts() == {"train": 3, "val": 1, "test": 2}


# --- YCB-Slide


def test_ycb_slide_real_logs_with_the_webcam(tmp_path):
    result = imported(make_ycb_slide, tmp_path)
    logs = [f"{o}/dataset_{k}" for o in ("004_sugar_box", "055_baseball") for k in (0, 4)]
    assert result.manifest.ids == [f"{log}/{k}" for log in logs for k in range(3)]
    assert row(result, "055_baseball/dataset_4/2") == {
        "id": "055_baseball/dataset_4/2",
        "video": "055_baseball/dataset_4",
        "frame": 2,
        "object": "055_baseball",
        "sensor": "DIGIT",
        "vision": "real/055_baseball/dataset_4/webcam_frames/frame_0000002.jpg",
        "domain": "real",
        "tactile": "real/055_baseball/dataset_4/frames/frame_0000002.jpg",
    }
    assert drawn(result, "tactile") == list(range(1, 13))
    assert drawn(result, "vision") == list(range(33, 45))
    assert result.suspicious == []


def test_ycb_slide_split_of_sparsh_shares_every_object(tmp_path):
    root = make_ycb_slide(tmp_path / "data").source
    logs = root / "real" / "055_baseball"
    (logs / "dataset_0").rename(logs / "dataset_3")
    split = import_dataset(root, tmp_path / "out").splits["sparsh"]
    parts = {i.rpartition("/")[0]: part for i, part in split.parts.items()}
    assert parts == {
        "004_sugar_box/dataset_0": "train",
        "004_sugar_box/dataset_4": "test",
        "055_baseball/dataset_3": "train",
        "055_baseball/dataset_4": "test",
    }
    assert split.rule["source"] == "facebookresearch/sparsh"


def test_ycb_slide_simulated_part(tmp_path):
    result = imported(make_ycb_slide, tmp_path, part="sim")
    assert result.manifest.ids == ["025_mug/03/0", "025_mug/03/1"]
    assert result.manifest.column("vision") == [None, None]
    assert drawn(result, "tactile") == [65, 66]
    assert result.facts["simulated"] == "yes"
    assert result.splits == {}
    fails("real or sim", import_dataset, tmp_path / "data" / "ycb", tmp_path / "bad", part="both")


def test_ycb_slide_reports_everything_bad(tmp_path):
    root = make_ycb_slide(tmp_path / "data").source
    names = ("004_sugar_box", "055_baseball")
    one, two, three, four = (root / "real" / o / f"dataset_{k}" for o in names for k in (0, 4))
    for k in (0, 2):
        (one / "webcam_frames" / f"frame_{k:07d}.jpg").unlink()
    write_image(one / "webcam_frames" / "frame_0000009.jpg", 9)
    for path in [*(two / "frames").iterdir(), *(three / "webcam_frames").iterdir()]:
        path.unlink()
    (two / "frames.mp4").write_bytes(b"video")
    (four / "frames" / "frame_0000001.jpg").unlink()
    (four / "frames" / "frame_0000002.jpg").write_bytes(b"no image")
    write_image(root / "real" / "my own cup" / "dataset_7" / "frames" / "frame_0000000.jpg", 9)
    result = validate(root)
    assert kinds(result.missing) == {"unpaired": 4, "missing-frames": 1}
    first = [p.where.rpartition("dataset_0/")[2] for p in result.missing if "004" in p.where]
    lone = (
        "frames/frame_0000000.jpg",
        "frames/frame_0000002.jpg",
        "webcam_frames/frame_0000009.jpg",
    )
    assert set(lone) < set(first)
    assert kinds(result.invalid) == {"bad-image": 1}
    assert kinds(result.suspicious) == {"no-vision": 2}
    result = import_dataset(root, tmp_path / "out", skip_bad=True)
    ids = ["004_sugar_box/dataset_0/1", *(f"055_baseball/dataset_0/{k}" for k in range(3))]
    strange = "my own cup/dataset_7/0"  # in no part, as Sparsh has no such log
    assert result.manifest.ids == [*ids, "055_baseball/dataset_4/0", strange]
    assert result.manifest.column("vision").count(None) == 4
    assert strange not in result.splits["sparsh"].parts
