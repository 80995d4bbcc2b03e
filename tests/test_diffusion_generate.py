"""From photos to a folder of touches: names, index, resuming, broken photos."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from diffusion_forge import make_pipeline
from palpate.core import PalpateError, ProblemsError, inside
from palpate.data.manifest import Manifest
from palpate.diffusion.generate import Generated, file_name, generate, generate_one, photo_ids


@pytest.fixture(scope="module")
def pipeline():
    return make_pipeline()


def write_photos(folder: Path, n: int) -> list[Path]:
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{k}.png" for k in range(n)]
    for path in paths:
        Image.fromarray(rng.integers(0, 256, (20, 24, 3), dtype=np.uint8)).save(path)
    return paths


def contents(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


@settings(max_examples=50, deadline=None)
@given(st.text(min_size=1, max_size=300))
def test_no_name_leaves_the_folder(sample_id):
    name = file_name(sample_id)
    assert "/" not in name
    assert "\\" not in name
    assert not name.startswith(".")
    assert len(name.encode()) < 200
    assert inside(Path("/tmp/x"), name) == Path("/tmp/x").resolve() / name


def test_names_are_unique_to_the_id():
    ids = [
        "a/b",
        "a_b",
        "a.b",
        "A/B",
        "../../etc/passwd",
        "..",
        "",
        " ",
        "x" * 400,
        "x" * 401,
        "grün",
        "con",
        "a\x00b",
    ]
    assert len({file_name(i).lower() for i in ids}) == len(ids)
    assert file_name("20220318_020752/0000012345.jpg").startswith("20220318_020752_0000012345_jpg-")


def test_a_list_of_photos(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 5)
    made = generate(pipeline, photos=paths, out=tmp_path / "out", seed=3)
    assert made.ids == [p.name for p in paths]
    assert made.made == 5
    index = json.loads((tmp_path / "out" / "index.json").read_text())
    assert index["complete"]
    assert index["settings"]["pipeline"] == pipeline.digest
    assert index["settings"]["seed"] == 3
    loaded = Generated.load(tmp_path / "out")
    assert loaded.files == made.files
    assert [p.is_file() for p in loaded.paths] == [True] * 5
    # The picture is the pipeline's own for that photo, seed and id.
    photo = np.asarray(
        Image.open(paths[2]).crop((2, 0, 22, 20)).resize((16, 16), Image.Resampling.BICUBIC)
    )
    direct = pipeline.touch(photo[None], [paths[2].name], seed=3)[0]
    assert np.array_equal(np.asarray(Image.open(loaded.path("2.png"))), direct)
    with pytest.raises(PalpateError, match="must have been generated"):
        loaded.path("nope")


def test_resumed_is_the_same_as_uninterrupted(pipeline, tmp_path):
    write_photos(tmp_path / "in", 7)
    whole = generate(pipeline, photos=tmp_path / "in", out=tmp_path / "a", batch=2)

    def stop(what, done, total, remark=""):
        if what == "generating touches" and done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(pipeline, photos=tmp_path / "in", out=tmp_path / "b", batch=2, progress=stop)
    with pytest.raises(PalpateError, match="half done"):
        Generated.load(tmp_path / "b")
    rest = generate(pipeline, photos=tmp_path / "in", out=tmp_path / "b", batch=2)
    assert (whole.made, rest.made) == (7, 3)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert generate(pipeline, photos=tmp_path / "in", out=tmp_path / "b").made == 0


def test_more_ids_extend_the_folder_and_a_changed_photo_is_made_again(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 4)
    generate(pipeline, photos=paths, ids=["0.png", "1.png"], out=tmp_path / "out")
    more = generate(pipeline, photos=paths, ids=["3.png", "1.png"], out=tmp_path / "out")
    assert (more.made, set(more.ids)) == (1, {"0.png", "1.png", "3.png"})
    Image.new("RGB", (20, 20), "red").save(paths[1])
    assert generate(pipeline, photos=paths, ids=["1.png"], out=tmp_path / "out").made == 1


def test_other_settings_or_foreign_files_are_refused(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 1)
    generate(pipeline, photos=paths, out=tmp_path / "out", seed=0)
    before = contents(tmp_path / "out")
    for change in ({"seed": 1}, {"guidance": 4.0}, {"steps": 5}):
        with pytest.raises(PalpateError, match="same settings"):
            generate(pipeline, photos=paths, out=tmp_path / "out", **{"seed": 0} | change)
    assert contents(tmp_path / "out") == before
    with pytest.raises(PalpateError, match="empty or hold generated"):
        generate(pipeline, photos=paths, out=tmp_path / "in")


def test_broken_photos_are_refused_or_listed(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 5)
    paths[1].write_bytes(paths[1].read_bytes()[:80])
    paths[3].write_text("no image")
    table = {f"v/{p.stem}": p for p in paths} | {"v/gone": tmp_path / "gone.png"}
    with pytest.raises(ProblemsError) as caught:
        generate(pipeline, photos=table, out=tmp_path / "out")
    assert sorted(Path(p.where).name for p in caught.value.problems) == [
        "1.png",
        "3.png",
        "gone.png",
    ]
    assert not (tmp_path / "out").exists()
    made = generate(pipeline, photos=table, out=tmp_path / "out", skip_bad=True)
    assert made.ids == ["v/0", "v/2", "v/4"]
    assert len(Generated.load(tmp_path / "out").skipped) == 3
    # A good neighbor's picture does not depend on the broken ones.
    alone = generate(pipeline, photos={"v/4": paths[4]}, out=tmp_path / "alone")
    assert alone.path("v/4").read_bytes() == made.path("v/4").read_bytes()


def test_a_manifest_with_backgrounds(tmp_path):
    pipeline = make_pipeline(background=True)
    write_photos(tmp_path, 3)
    rows = [{"id": f"v/{k}", "vision": f"{k}.png", "background": "0.png"} for k in range(3)]
    manifest = Manifest.from_rows(rows, tmp_path)
    made = generate(pipeline, manifest=manifest, out=tmp_path / "out", ids=["v/2", "v/0"])
    assert made.ids == ["v/2", "v/0"]
    bare = Manifest.from_rows(
        [{k: v for k, v in row.items() if k != "background"} for row in rows], tmp_path
    )
    with pytest.raises(PalpateError, match="background image"):
        generate(pipeline, manifest=bare, out=tmp_path / "other")
    with pytest.raises(PalpateError, match="photos alone"):
        generate(pipeline, photos=[tmp_path / "0.png"], out=tmp_path / "other")
    (tmp_path / "0.png").write_text("broken")
    with pytest.raises(ProblemsError) as caught:
        generate(pipeline, manifest=manifest, out=tmp_path / "third", ids=["v/2"])
    assert Path(caught.value.problems[0].where).name == "0.png"


def test_wrong_arguments(pipeline, tmp_path):
    with pytest.raises(PalpateError, match="manifest or for photos"):
        generate(pipeline, out=tmp_path / "out")
    with pytest.raises(PalpateError, match="at least one photo"):
        generate(pipeline, photos=tmp_path, out=tmp_path / "out")
    with pytest.raises(PalpateError, match="among the photos"):
        generate(pipeline, photos=write_photos(tmp_path / "in", 1), ids=["x"], out=tmp_path / "out")
    with pytest.raises(PalpateError, match="no such path"):
        photo_ids(tmp_path / "nowhere")
    with pytest.raises(PalpateError, match="twice"):
        photo_ids([tmp_path / "a" / "x.png", tmp_path / "b" / "x.png"])


def test_an_index_that_points_outside_is_refused(pipeline, tmp_path):
    made = generate(pipeline, photos=write_photos(tmp_path / "in", 1), out=tmp_path / "out")
    index = json.loads((tmp_path / "out" / "index.json").read_text())
    index["images"][made.ids[0]] = "../../in/0.png"
    (tmp_path / "out" / "index.json").write_text(json.dumps(index))
    with pytest.raises(PalpateError, match="must lie in images/"):
        Generated.load(tmp_path / "out")


def test_one_photo_is_one_picture_that_says_what_it_is(pipeline, tmp_path):
    (photo,) = write_photos(tmp_path / "in", 1)
    out = tmp_path / "new" / "touch.png"
    told = replace(pipeline, training={"synthetic": True, "materials": ["Wood", "Brick"]})
    assert generate_one(told, photo, out, seed=3)
    made = generate(told, photos=photo, out=tmp_path / "out", seed=3)
    with Image.open(out) as one, Image.open(made.paths[0]) as other:
        assert np.abs(np.asarray(one).astype(int) - np.asarray(other)).max() <= 1
        assert one.info == other.info
        text = one.info
    assert set(text) == {f"palpate.{k}" for k in ("id", "settings", "input", "made-with", "notice")}
    assert json.loads(text["palpate.made-with"]) == made.settings
    assert "synthetic data alone" in text["palpate.notice"]
    assert text["palpate.notice"].endswith("knows only these materials: Brick, Wood.")
    assert (
        json.loads((tmp_path / "out" / "index.json").read_text())["notice"]
        == text["palpate.notice"]
    )
    # Again: nothing to do; another seed or another photo: made again.
    before = out.read_bytes()
    assert not generate_one(told, photo, out, seed=3)
    assert generate_one(told, photo, out, seed=4)
    assert out.read_bytes() != before
    Image.new("RGB", (20, 20), "red").save(photo)
    assert generate_one(told, photo, out, seed=4)
    assert not [p for p in out.parent.iterdir() if p != out]
    assert (
        pipeline.notice == ""
    )  # nothing is said of a generator whose record does not call its data synthetic


def test_one_photo_that_cannot_be_read_leaves_no_picture(pipeline, tmp_path):
    (photo,) = write_photos(tmp_path / "in", 1)
    photo.write_bytes(photo.read_bytes()[:80])
    with pytest.raises(ProblemsError) as caught:
        generate_one(pipeline, photo, tmp_path / "touch.png")
    assert [p.kind for p in caught.value.problems] == ["bad-image"]
    with pytest.raises(PalpateError, match="no such path"):
        generate_one(pipeline, tmp_path / "gone.jpg", tmp_path / "touch.png")
    assert not (tmp_path / "touch.png").exists()


def odd_photos(folder: Path) -> dict[str, Path]:
    """The same picture in forms that cameras and editors write, and a few that hold next to nothing."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    pixels = np.kron(rng.integers(0, 256, (4, 6, 3), dtype=np.uint8), np.ones((8, 8, 1), np.uint8))
    plain = Image.fromarray(pixels)
    plain.save(folder / "plain.png")
    alpha = plain.copy()
    alpha.putalpha(255)
    alpha.save(folder / "alpha.png")
    plain.convert("CMYK").save(folder / "cmyk.tif")
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees clockwise for display
    plain.rotate(90, expand=True).save(folder / "turned.png", exif=exif)
    plain.convert("P", palette=Image.Palette.ADAPTIVE, colors=64).save(folder / "palette.png")
    Image.fromarray(np.asarray(plain.convert("L")).astype(np.uint16) * 257).save(
        folder / "deep.png"
    )
    plain.convert("L").save(folder / "gray.png")
    Image.new("RGB", (1, 1), "red").save(folder / "dot.png")
    Image.new("RGBA", (3, 200), (0, 0, 0, 0)).save(folder / "clear.png")
    return {p.stem: p for p in folder.iterdir()}


def test_photos_of_every_kind_give_the_touch_of_what_they_show(pipeline, tmp_path):
    paths = odd_photos(tmp_path / "in")
    touches = {}
    for name, path in paths.items():
        generate_one(pipeline, path, tmp_path / f"{name}.png")
        touches[name] = np.asarray(Image.open(tmp_path / f"{name}.png"))
        assert touches[name].shape == (32, 32, 3), name
    # The noise belongs to the name of the file; under one name, the same picture gives the same touch.
    same = {}
    for name, path in paths.items():
        twin = tmp_path / name / "photo.img"
        twin.parent.mkdir()
        twin.write_bytes(path.read_bytes())
        generate_one(pipeline, twin, twin.with_name("touch.png"))
        same[name] = np.asarray(Image.open(twin.with_name("touch.png"))).astype(int)
    for name, other, limit in (
        ("alpha", "plain", 0),
        ("turned", "plain", 0),
        ("palette", "plain", 0),
        ("cmyk", "plain", 1),
        ("deep", "gray", 1),
    ):
        assert np.abs(same[name] - same[other]).max() <= limit, name
    assert np.abs(same["dot"] - same["plain"]).max() > 1


def test_a_model_in_the_place_of_photos_is_told(pipeline, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "palpate.json").write_text("{}")
    with pytest.raises(PalpateError, match=r"a saved model\. Pass it as the model"):
        generate(pipeline, photos=tmp_path / "model", out=tmp_path / "out")
