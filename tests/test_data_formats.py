"""Published layouts that are rows of templates, and tables beside anyone's images."""

import json

import pytest

from forge.errors import fails
from forge.formats import make_objectfolder, make_objectfolder_generation, make_tarf, make_ycb_slide
from forge.pictures import write_image, write_images
from palpate.data.importing import import_dataset, validate


def imported(make, folder, **options):
    source = make(folder / "data").source
    return import_dataset(source, folder / "out", **options)


def kinds(problems):
    return sorted({p.kind for p in problems})


def test_tarf_pairs_tactile_images_with_the_view_of_their_number(tmp_path):
    result = imported(make_tarf, tmp_path)
    table = result.manifest.table
    assert set(table["video"]) == {"bench", "office_1"}
    assert (table["vision"] == table["tactile"].str.replace("touch", "vision")).all()
    assert set(table["background"]) == {f"touch_bg/{v}_40_30/bg.jpg" for v in set(table["video"])}
    assert result.splits["Orig"].counts() == {"train": 4, "val": 1, "test": 5}
    assert kinds(result.suspicious) == ["joined-table", "unmatched"]  # views at another scale


def test_objectfolder_trials_with_the_table_of_materials(tmp_path):
    result = imported(make_objectfolder, tmp_path)
    table = result.manifest.table
    assert result.facts["group"] == "object"
    assert set(table["object"]) == {"2", "10", "17"}
    materials = dict(zip(table["object"], table["material"], strict=True))
    assert materials == {"2": "Ceramic", "10": "Ceramic", "17": "Iron"}
    trials = dict(zip(table["video"], table["background"], strict=True))
    assert trials["2/1"] == "2/tactile_data/1/0/gelsight/0.png"
    assert trials["2/2"] is None  # its numbers begin at 9
    assert 0 not in table.filter(table["video"] == "2/1")["frame"]


def test_the_benchmark_of_objectfolder_has_a_split_a_list(tmp_path):
    result = imported(make_objectfolder_generation, tmp_path)
    assert set(result.splits) == {"cross_contact", "cross_object"}
    by_object = result.splits["cross_object"]
    assert {i.partition("/")[0] for i in by_object.ids("train")} == {"1"}
    assert set(result.manifest.table["background"]) == {"touch_ref/touch_ref.png"}


def test_ycb_slide_logs_with_the_webcam(tmp_path):
    result = imported(make_ycb_slide, tmp_path)
    table = result.manifest.table
    assert set(table["video"]) == {
        f"{o}/dataset_{k}" for o in ("004_sugar_box", "055_baseball") for k in (0, 4)
    }
    assert result.facts["license"].startswith("CC BY-SA")


NAMES = [
    f"{side}/{o}/{k}.png" for side in ("photo", "touch") for o in ("cup", "mug") for k in (1, 2)
]
ROWS = [("cup", 1), ("cup", 2), ("mug", 1), ("mug", 2)]
#: Tables of materials: their text, with {o} and {k} for object and number.
BESIDE = {
    "paths": ("file,material\n", "touch/{o}/{k}.png,M{o}\n"),
    "paths without suffix": ("image;label\n", "photo/{o}/{k};M{o}\n"),
    "objects": ("name,weight,category\n", "{o},3,M{o}\n"),
    "ids": ("id\tclass\n", "{o}/{k}\tM{o}\n"),
}


@pytest.mark.parametrize("form", BESIDE)
@pytest.mark.parametrize("place", ["own/labels.csv", "own.csv"])
def test_a_table_beside_the_images_is_joined(tmp_path, form, place):
    head, row = BESIDE[form]
    write_images(tmp_path / "own", NAMES)
    (tmp_path / place).write_text(head + "".join(row.format(o=o, k=k) for o, k in ROWS))
    result = import_dataset(tmp_path / "own", tmp_path / "out")
    table = result.manifest.table
    column = "object" if table["object"].count() else "video"
    assert (table["material"] == "M" + table[column]).all()
    (said,) = (p.text for p in result.suspicious if p.kind == "joined-table")
    assert "material of 4 of 4 samples" in said


@pytest.mark.parametrize("name", ["{}.jpg", "{}", "{}.PNG", ".\\photo\\{}.png"])
def test_a_table_by_file_names_in_any_case_and_with_any_suffix(tmp_path, name):
    write_images(tmp_path / "own", [f"{s}/{n}.png" for s in ("photo", "touch") for n in "aBcd"])
    rows = [f"{name.format(n)},{label}" for n, label in (("A", "Wood"), ("b", "Rock"), ("x", "x"))]
    (tmp_path / "own" / "labels.csv").write_text("\n".join(["image,label", *rows]))
    result = import_dataset(tmp_path / "own", tmp_path / "out")
    assert sorted(result.manifest.table["material"].drop_nulls()) == ["Rock", "Wood"]


def test_a_table_by_the_names_of_folders(tmp_path):
    """The object of OBJ0 is 0."""
    names = [f"OBJ{o}/{s}/{k}.png" for o in range(3) for s in ("photo", "touch") for k in (1, 2)]
    write_images(tmp_path / "own", names)
    rows = [f"obj{o},M{o}" for o in range(3)]
    (tmp_path / "own" / "labels.csv").write_text("\n".join(["name,material", *rows]))
    table = import_dataset(tmp_path / "own", tmp_path / "out").manifest.table
    assert (table["material"] == "M" + table["object"]).all()


def test_a_table_that_names_nothing_is_reported(tmp_path):
    """So is one whose names several images have."""
    write_images(tmp_path / "own", ["touch/a/1.png", "touch/A/1.png", "touch/b/2.png"])
    for text in ("a,b\n8,9\n", "file,material\na/1.png,Wood\n1,Wood\n"):
        (tmp_path / "own" / "labels.csv").write_text(text)
        result = import_dataset(tmp_path / "own", tmp_path / "out", overwrite=True)
        assert kinds(result.suspicious) == ["unread-table"]
        assert result.manifest.table["material"].null_count() == 3


def test_parts_beside_the_images_are_their_split(tmp_path):
    write_images(tmp_path / "own", NAMES)
    parts = {"train": ["touch/cup/1.png", "touch/cup/2.png"], "test": ["touch/mug/1.png"]}
    (tmp_path / "own" / "split.json").write_text(json.dumps(parts))
    result = import_dataset(tmp_path / "own", tmp_path / "out")
    assert result.splits["Orig"].counts() == {"train": 2, "test": 1}


@pytest.mark.parametrize("absolute", ["", "/home/ann/own/"])
def test_a_table_of_pairs_beside_the_images_goes_first(tmp_path, absolute):
    write_images(tmp_path / "own", NAMES)
    rows = [f"{absolute}photo/{o}/{k}.png,{absolute}touch/{o}/{k}.png,{o}" for o, k in ROWS]
    for part, some in (("train", rows[:3]), ("test", rows[3:])):
        text = "\n".join(["vision,tactile,material", *some])
        (tmp_path / "own" / f"{part}.csv").write_text(text)
    result = import_dataset(tmp_path / "own", tmp_path / "out")
    assert sorted(result.manifest.column("material")) == ["cup", "cup", "mug", "mug"]
    assert result.splits["Orig"].counts() == {"train": 3, "test": 1}


def test_an_import_is_validated_again(tmp_path):
    write_images(tmp_path / "own", NAMES)
    import_dataset(tmp_path / "own", tmp_path / "out")
    assert validate(tmp_path / "out").ok
    (tmp_path / "own" / NAMES[0]).unlink()
    (tmp_path / "own" / NAMES[1]).write_bytes(b"")
    result = validate(tmp_path / "out")
    assert (result.format, result.samples) == ("manifest", 2)
    assert (kinds(result.missing), kinds(result.invalid)) == (["missing-file"], ["bad-image"])


def test_a_published_layout_of_another_tree_is_refused(tmp_path):
    write_image(tmp_path / "own" / "a.png", 1)
    fails("must match images", import_dataset, tmp_path / "own", tmp_path / "out", format="tarf")
