"""The plan of a preference study: which items and trials, what the page knows, what is said."""

import base64
import io
import json
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageFilter

from forge.errors import fails
from forge.people import write_folder
from palpate import preference
from palpate.core import PalpateError
from palpate.data.images import read_image, square
from palpate.preference import Plan
from palpate.preference.images import QUALITY, data_uri


@pytest.fixture(scope="module")
def study(rated, tmp_path_factory):
    output = tmp_path_factory.mktemp("study") / "study"
    rated.make(output, items=12, raters=4, size=32)
    return output


@pytest.fixture(scope="module")
def plan(study):
    return Plan.load(study)


def codes(plan):
    return {note.code: note.params for note in plan.notes}


def test_items_are_of_all_materials_and_no_two_of_a_video(plan):
    assert Counter(item.material for item in plan.items) == {"brick": 4, "grass": 4, "wood": 4}
    assert len({item.video for item in plan.items}) == 12
    assert codes(plan)["sampled-items"] == {"n": 12, "candidates": 60, "videos": 30}


def test_every_comparison_has_every_item_a_tenth_again_and_a_tenth_caught(plan):
    kinds = Counter(trial.kind for trial in plan.trials)
    assert kinds == {"pair": 3 * 12, "repeat": 5, "catch": 5}
    for trial in plan.trials:
        if trial.kind == "repeat":
            first = plan.trial[trial.repeats]
            assert (trial.item, trial.left, trial.right) == (first.item, first.right, first.left)


def test_order_and_sides_are_of_each_rater_and_balanced(plan):
    assert len({tuple(rater.order) for rater in plan.raters}) == 4
    for rater in plan.raters:
        swapped = dict(zip(rater.order, rater.swapped, strict=True))
        assert set(swapped) == set(plan.trial)
        for pair in {(t.left, t.right) for t in plan.trials if t.kind == "pair"}:
            sides = [swapped[t.id] for t in plan.trials if (t.left, t.right) == pair]
            assert abs(2 * sum(sides) - len(sides)) <= 2
        for trial in plan.trials:
            if trial.kind == "repeat":  # the rater sees the sides the other way round, later
                assert swapped[trial.id] == swapped[trial.repeats]
                assert rater.order.index(trial.id) > rater.order.index(trial.repeats) + 5


def test_the_page_knows_no_method_item_material_or_kind(plan):
    text = json.dumps({**plan.public(), "images": sorted(plan.public()["images"])})
    for word in ("ours", "gvst", "wbg", "v00", "brick", "catch", "repeat", "gel", plan.secret):
        assert word not in text.replace("images", "")
    rows = plan.public()["raters"]["r01"]
    assert len({row["trial"] for row in rows}) == len(plan.trials)
    others = {row["trial"] for row in plan.public()["raters"]["r02"]}
    assert not others & {row["trial"] for row in rows}  # a vote of one rater is no vote of another
    assert set(rows[0]) == {"trial", "reference", "left", "right"}


def test_images_are_of_one_size_and_without_metadata(plan):
    page = plan.public()
    for image in page["images"].values():
        data = base64.b64decode(image["src"].removeprefix("data:image/jpeg;base64,"))
        opened = Image.open(io.BytesIO(data))
        assert opened.size == (image["w"], image["h"]) == (32, 32)
        assert set(opened.info) <= {"jfif", "jfif_version", "jfif_unit", "jfif_density"}
        assert not opened.getexif()
    assert list(page["images"]) == sorted(page["images"])  # the order says nothing either
    used = {row[side] for rows in page["raters"].values() for row in rows for side in row}
    assert {n for n in used if n in page["images"]} == set(page["images"])


def test_a_catch_shows_the_reference_again_against_the_gel(plan):
    def pixels(name):
        data = base64.b64decode(plan.images[name].partition(",")[2])
        return np.asarray(Image.open(io.BytesIO(data)), np.float64)

    catch = next(trial for trial in plan.trials if trial.kind == "catch")
    real = pixels(plan.name(catch.item, "reference"))
    copy, gel = (pixels(plan.name(catch.item, slot)) for slot in ("copy", "gel"))
    assert np.abs(real - copy).mean() < 10 < np.abs(real - gel).mean()
    files = {plan.images[plan.name(catch.item, slot)] for slot in ("copy", "reference")}
    assert len(files) == 2  # the copy is another file


def test_the_plan_is_for_its_owner_and_reads_back(study, plan):
    assert (study / "plan.json").stat().st_mode & 0o777 == 0o600
    assert Plan.load(study / "plan.json").digest == plan.digest
    assert plan.study == plan.public()["study"] == plan.digest[:12]


def test_two_studies_have_two_secrets_and_one_choice_of_items(rated, plan):
    again = rated.make(items=12, raters=4)
    assert again.items == plan.items
    assert again.secret != plan.secret
    assert again.raters != plan.raters
    assert again.name("v00/f0", "ours") != plan.name("v00/f0", "ours")  # nobody can guess names


def test_design_of_the_paper(rated):
    plan = rated.make(design="paper")
    pairs = {(t.left, t.right) for t in plan.trials if t.kind == "pair"}
    assert pairs == {("ours", "gvst"), ("ours", "wbg")}
    assert len(plan.raters) == 2
    assert codes(plan)["fewer-items"]["wanted"] == 40


def test_sorting_shows_examples_of_other_videos(rated, tmp_path):
    plan = rated.make(tmp_path / "sort", 1, items=9, raters=2, task="sort", size=32)
    page = plan.public()
    assert page["choices"] == ["brick", "grass", "wood"]
    assert [strip["answer"] for strip in page["strips"]] == page["choices"]
    assert all(name in page["images"] for strip in page["strips"] for name in strip["images"])
    assert not {i.video for i in plan.items} & {i.video for i in plan.examples}
    assert {t.left for t in plan.trials if t.kind == "sort"} == {"reference", "ours"}
    assert all(set(row) == {"trial", "image"} for row in page["raters"]["r01"])


def test_what_a_method_lacks_is_left_out_and_counted(rated, tmp_path):
    ids = [f"v{v:02d}/f0" for v in range(20)]
    lacking = write_folder(tmp_path / "lacking", 4, [*ids, "stranger"], size=31, suffix=".jpg")
    plan = replace(rated, methods=[rated.methods[0], lacking]).make(items=40)
    said = codes(plan)
    assert said["items-left-out"] == {"name": "lacking", "missing": 40, "unknown": 1}
    assert said["fewer-items"] == {"n": 20, "wanted": 40, "candidates": 20, "videos": 20}


def test_folders_without_a_table_are_one_pile(rated):
    plan = rated.make(items=5, labels=None)
    assert "materials-unknown" in codes(plan)


def test_file_names_say_which_images_are_of_one_video(tmp_path):
    options = {"items": 10, "size": 32, "dry_run": True}
    for form, videos in (("clip{0}_{1:03d}", 6), ("image{2}", 10)):
        names = [form.format(k // 4, k % 4, chr(97 + k)) for k in range(24)]
        sources = [write_folder(tmp_path / form[0] / str(k), k, names) for k in range(3)]
        plan = preference.make(sources[0], sources[1:], **options)
        assert len(plan.items) == videos
        levels = dict(codes(plan)["recordings"]["levels"])
        assert ("video" in levels) == (videos == 6) == ("videos-unknown" not in codes(plan))
    assert codes(plan)["recordings"] == {"levels": []}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"count": 1}, "two methods"),
        ({"items": 1}, "2 .. 1000"),
        ({"question": " "}, "blank"),
        ({"names": ["image", "b", "c"]}, "must hold no word of the question"),
        ({"names": ["tactile", "b", "c"]}, "must hold no word of the title"),
        ({"names": ["a", "b", "c"], "question": "Is it b?"}, "question. must not name a method"),
        ({"names": ["a", "b", "C++"], "question": "Is C++ it?"}, "question. must not name a"),
        ({"seed": 2**63}, "seed. must lie between"),
        ({"raters": 1000}, "1 .. 999"),
        ({"task": "rank"}, "pair, sort"),
        ({"design": "ours"}, "paper"),
        ({"until": "tomorrow"}, "date"),
        ({"until": "2020-01-31"}, "must be today or later. Got 2020-01-31"),
        ({"task": "sort", "labels": None}, "two materials"),
        ({"labels": {"elsewhere/1": "wood"}}, "labels must hold ids .* 'elsewhere/1' instead of"),
        ({"output": None, "dry_run": False}, "folder"),
    ],
)
def test_what_cannot_be_made_is_said(rated, options, words):
    fails(words, rated.make, **options)


def test_no_common_image_is_said(rated, tmp_path):
    other = write_folder(tmp_path / "other", 5, ["a", "b"])
    with pytest.raises(PalpateError, match="of the 60 ours has 60, other has 0, and none"):
        replace(rated, methods=[rated.methods[0], other]).make(labels=None)


def test_a_material_of_one_video_gives_one_item_and_cannot_be_sorted(rated, tmp_path):
    labels = tmp_path / "labels.csv"
    lines = rated.labels.read_text().splitlines()
    labels.write_text("\n".join([*lines[:-2], *(x.replace("wood", "moss") for x in lines[-2:])]))
    pairs = rated.make(items=30, labels=labels)
    assert codes(pairs)["one-video-classes"] == {"materials": ["moss"]}
    assert sum(item.material == "moss" for item in pairs.items) == 1
    sort = rated.make(task="sort", items=15, labels=labels)
    assert codes(sort)["one-video-materials"] == {"materials": ["moss"]}
    assert sort.choices == ["brick", "grass", "wood"]


def test_of_many_images_a_sample_is_taken_and_said(tmp_path):
    file = write_folder(tmp_path / "one", 0, ["x"]) / "x.png"
    for name in ("real", "a", "b"):
        (tmp_path / name).mkdir()
        for k in range(1_000):
            (tmp_path / name / f"{k}.png").hardlink_to(file)
    plan = preference.make(tmp_path / "real", [tmp_path / "a", tmp_path / "b"], dry_run=True)
    assert codes(plan)["sampled-items"] == {"n": 40, "candidates": 1_000, "videos": 1_000}


def test_a_manifest_gives_materials_videos_and_the_gel_of_catches(small_manifest, tmp_path):
    small_manifest.save(tmp_path / "manifest.parquet")
    folder = tmp_path / "root"
    methods = {}
    for name in ("x", "y"):
        methods[name] = write_folder(tmp_path / name, len(methods), small_manifest.ids)
    plan = preference.make(tmp_path / "manifest.parquet", methods, tmp_path / "s", raters=1)
    assert {item.material for item in plan.items} == {"Wood", "Grass", "Brick"}
    assert len({item.video for item in plan.items}) == 6
    catch = next(trial for trial in plan.trials if trial.kind == "catch")
    row = small_manifest.take([catch.item])
    gel = square(read_image(folder / row.column("background")[0]), 256)
    assert plan.images[plan.name(catch.item, "gel")] == data_uri(gel, QUALITY - 1)


def test_a_broken_image_is_named_and_nothing_is_left(rated, tmp_path):
    ids = [f"v{v:02d}/f0" for v in range(3)]
    broken = write_folder(tmp_path / "broken", 1, ids)
    (broken / "v01" / "f0.png").write_bytes(b"")
    with pytest.raises(PalpateError, match=r"f0\.png must be whole and readable"):
        replace(rated, methods=[broken, rated.methods[0]]).make(tmp_path / "s", labels=None)
    assert not (tmp_path / "s").exists()


def test_an_image_looks_the_same_whatever_file_it_came_in(tmp_path):
    """A JPEG that is decoded at a fraction is sharper than a PNG that is resized."""
    noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8)
    image = Image.fromarray(noise).filter(ImageFilter.GaussianBlur(1))
    image.save(tmp_path / "a.png")
    image.save(tmp_path / "a.jpg", quality=98, subsampling=0)
    png, jpg = (square(read_image(tmp_path / f"a.{s}"), 64).astype(float) for s in ("png", "jpg"))
    assert np.abs(png - jpg).mean() < 0.5


def test_one_video_is_no_study(rated, tmp_path):
    labels = tmp_path / "labels.csv"
    labels.write_text(re.sub(r"v\d\d$", "v00", rated.labels.read_text(), flags=re.MULTILINE))
    fails("two items", rated.make, labels=labels)
