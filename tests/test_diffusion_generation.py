"""Generating to memory, one PNG, or a folder with an index; resuming; broken photos."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from forge.errors import fails
from forge.models import make_pipeline
from forge.pictures import write_photos
from palpate.core import PalpateError, Split, inside, read_json, sealed, write_json
from palpate.data.manifest import Manifest
from palpate.diffusion.generated import Generated, file_name
from palpate.diffusion.generation import generate, photo_ids


@pytest.fixture(scope="module")
def pipeline():
    return make_pipeline()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@settings(max_examples=50, deadline=None)
@given(st.text(min_size=1, max_size=300))
def test_file_names_stay_in_the_folder(sample_id):
    name = file_name(sample_id)
    assert not set(name) & set("/\\")
    assert not name.startswith(".")
    assert len(name.encode()) < 200
    assert inside(Path("/tmp/x"), name) == Path("/tmp/x").resolve() / name


def test_file_names_are_unique_to_the_id():
    ids = ["a/b", "a_b", "a.b", "A/B", "../../etc/passwd", "..", "", " ", "grün", "con", "a\x00b"]
    ids += ["x" * 400, "x" * 401]
    assert len({file_name(i).lower() for i in ids}) == len(ids)
    assert file_name("20220318_020752/0000012345.jpg").startswith("20220318_020752_0000012345_jpg-")


def test_a_folder_has_an_index_and_the_images_of_the_pipeline(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 5)
    made = generate(paths, model=pipeline, output=tmp_path / "out", seed=3)
    assert (made.ids, made.new) == ([p.name for p in paths], 5)
    index = json.loads((tmp_path / "out" / "index.json").read_text())
    assert index["complete"]
    assert (index["settings"]["pipeline"], index["settings"]["seed"]) == (pipeline.digest, 3)
    loaded = Generated.load(tmp_path / "out")
    assert loaded.files == made.files
    direct = pipeline(paths, seed=3).images
    memory = generate(paths, model=pipeline, seed=3)
    assert (memory.folder, memory.ids) == (None, made.ids)
    for file, a, b in zip(loaded.paths, direct, memory.images, strict=True):
        assert np.array_equal(np.asarray(Image.open(file)), np.asarray(a))
        assert np.array_equal(np.asarray(a), np.asarray(b))
    fails("must be generated", loaded.path, "nope")


def test_a_resumed_folder_equals_an_uninterrupted_one(pipeline, tmp_path):
    write_photos(tmp_path / "in", 7)
    common = {"model": pipeline, "batch": 2}
    whole = generate(tmp_path / "in", output=tmp_path / "a", **common)

    def stop(what, done, total, remark=""):
        if what == "generating" and done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path / "in", output=tmp_path / "b", progress=stop, **common)
    fails("half done", Generated.load, tmp_path / "b")
    there = len([*(tmp_path / "b" / "images").iterdir()])
    assert 4 <= there < 7  # writing is behind sampling
    resumed = generate(tmp_path / "in", output=tmp_path / "b", **common)
    assert (whole.new, resumed.new) == (7, 7 - there)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert generate(tmp_path / "in", output=tmp_path / "b", model=pipeline).new == 0


@pytest.mark.parametrize("change", [{}, {"guidance": 1.0}, {"high": 0.8}])
@pytest.mark.parametrize("method", ["dpm", "ddim"])
def test_evaluations_of_a_dry_run_are_those_of_the_call(tmp_path, change, method):
    files, base = write_photos(tmp_path / "photos", 20), make_pipeline()
    chosen = {"method": method, "steps": 6, "guidance": 2.0, "batch": 10} | change
    pipeline = replace(base, sampler=replace(base.sampler, **chosen))
    planned = generate(files, model=pipeline, dry_run=True)
    counts, forward = [], pipeline.unet.forward
    pipeline.unet.forward = lambda x, *args, **how: (
        counts.append(len(x)) or forward(x, *args, **how)
    )
    generate(files, model=pipeline)
    assert (planned.missing, planned.new, planned.evaluations) == (20, 0, sum(counts))


def test_more_photos_extend_the_folder_and_a_changed_one_is_made_again(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 4)
    common = {"model": pipeline, "output": tmp_path / "out"}
    generate(paths[:2], **common)
    more = generate([paths[3], paths[1]], **common)
    assert (more.new, set(more.ids)) == (1, {"0.png", "1.png", "3.png"})
    Image.new("RGB", (20, 20), "red").save(paths[1])
    assert generate(paths[1:2], **common).new == 1
    before = contents(tmp_path / "out")
    for change in ({"seed": 1}, {"guidance": 4.0}, {"steps": 3}):
        with pytest.raises(PalpateError, match="`output` must hold images of the same settings"):
            generate(paths[:1], **common, **change)
    assert contents(tmp_path / "out") == before


def test_broken_photos_are_reported_at_once_or_skipped(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 5)
    paths[1].write_bytes(paths[1].read_bytes()[:80])
    paths[3].write_text("no image")
    table = {f"v/{p.stem}": p for p in paths} | {"v/gone": tmp_path / "gone.png"}
    caught = fails("", generate, table, model=pipeline, output=tmp_path / "out")
    names = sorted(Path(p.where).name for p in caught.problems)
    assert names == ["1.png", "3.png", "gone.png"]
    assert not (tmp_path / "out").exists()
    bad = {i: p for i, p in table.items() if i in ("v/1", "v/gone")}
    caught = fails("No photo is left", generate, bad, model=pipeline, skip_bad=True)
    assert len(caught.problems) == 2
    made = generate(table, model=pipeline, output=tmp_path / "out", skip_bad=True)
    assert made.ids == ["v/0", "v/2", "v/4"]
    assert len(Generated.load(tmp_path / "out").skipped) == 3
    # A good image does not depend on the broken ones.
    alone = generate({"v/4": paths[4]}, model=pipeline, output=tmp_path / "alone")
    assert alone.path("v/4").read_bytes() == made.path("v/4").read_bytes()


def test_many_photos_are_read_while_others_are_sampled(pipeline, tmp_path):
    paths = write_photos(tmp_path / "in", 80)
    order = {f"{k:02}": path for k, path in enumerate(paths)}
    common = {"model": pipeline, "steps": 1, "output": tmp_path / "out"}
    good = [paths[k].read_bytes() for k in (60, 70)]
    for k in (60, 70):
        paths[k].write_text("broken")
    caught = fails("", generate, order, **common)
    assert [Path(p.where).name for p in caught.problems] == ["60.png", "70.png"]
    made = [*(tmp_path / "out" / "images").iterdir()]
    assert len(made) == 32, "those that were read before it"
    for k, content in zip((60, 70), good, strict=True):
        paths[k].write_bytes(content)
    whole = generate(order, **common)
    assert (whole.new, whole.ids) == (48, [*order])
    assert generate(order, **common).new == 0


def test_a_manifest_with_backgrounds(tmp_path):
    pipeline = make_pipeline(background=True)
    write_photos(tmp_path, 3)
    rows = [{"id": f"v/{k}", "vision": f"{k}.png", "background": "0.png"} for k in range(3)]
    manifest = Manifest.from_rows(rows, tmp_path)
    manifest.save(tmp_path / "manifest.parquet")
    split = Split.from_ids(train=["v/1"], test=["v/0", "v/2"])
    for source in (manifest, tmp_path, str(tmp_path / "manifest.parquet")):
        made = generate(source, model=pipeline, split=split)
        assert made.ids == ["v/0", "v/2"]
    bare = Manifest.from_rows([{k: row[k] for k in ("id", "vision")} for row in rows], tmp_path)
    fails("background", generate, bare, model=pipeline)
    fails("photos alone", generate, tmp_path / "0.png", model=pipeline)
    (tmp_path / "0.png").write_text("broken")
    caught = fails("", generate, manifest.take(["v/2"]), model=pipeline)
    assert Path(caught.problems[0].where).name == "0.png"


def test_one_photo_becomes_one_png_that_says_what_it_is(pipeline, tmp_path):
    (photo,) = write_photos(tmp_path / "in", 1)
    file = tmp_path / "new" / "tactile.png"
    synthetic = replace(pipeline, training={"synthetic": True, "materials": ["Wood", "Brick"]})
    common = {"model": synthetic, "seed": 3}
    assert generate(photo, output=file, **common).images[0].size == (32, 32)
    folder = generate(photo, output=tmp_path / "out", **common)
    with Image.open(file) as one, Image.open(folder.paths[0]) as other:
        assert np.abs(np.asarray(one).astype(int) - np.asarray(other)).max() <= 1
        assert one.info == other.info
        text = one.info
    assert set(text) == {f"palpate.{k}" for k in ("id", "settings", "input", "made-with", "notice")}
    assert json.loads(text["palpate.made-with"]) == folder.settings
    assert "synthetic data alone" in text["palpate.notice"]
    assert text["palpate.notice"].endswith("knows only these materials: Brick, Wood.")
    # Again: nothing to do; another seed or another photo: made again.
    assert generate(photo, output=file, **common).new == 0
    assert generate(photo, output=file, model=synthetic, seed=4).new == 1
    Image.new("RGB", (20, 20), "red").save(photo)
    assert generate(photo, output=file, model=synthetic, seed=4).new == 1
    assert list(file.parent.iterdir()) == [file]
    assert pipeline.notice == ""  # its record does not call the data synthetic


def test_wrong_inputs_and_outputs_are_explained(pipeline, tmp_path):
    """What the command line cannot be given; the others are in ``test_cli_generate``."""
    (photo,) = write_photos(tmp_path / "in", 1)
    (tmp_path / "empty").mkdir()
    for photos, message in (
        (tmp_path / "empty", "at least one photo"),
        ([Image.open(photo), photo], "must be files. Got images in memory"),
    ):
        fails(message, generate, photos, model=pipeline, output=tmp_path / "out")
    assert photo_ids([tmp_path / "in"]) == {"0.png": photo}


def test_an_index_that_points_outside_is_rejected(pipeline, tmp_path):
    made = generate(write_photos(tmp_path / "in", 1), model=pipeline, output=tmp_path / "out")
    index = read_json(tmp_path / "out" / "index.json", "index")
    index["images"][made.ids[0]] = "../../in/0.png"
    write_json(tmp_path / "out" / "index.json", sealed(index))
    fails("must lie in images/", Generated.load, tmp_path / "out")


def test_what_lies_in_an_unfinished_folder_is_not_believed(pipeline, tmp_path):
    photos, output = write_photos(tmp_path / "in", 1), tmp_path / "out"
    image = generate(photos, model=pipeline, output=output).paths[0]
    (tmp_path / "notes").write_text("of years")
    (tmp_path / "far").mkdir()
    for link, target in ((image, tmp_path / "notes"), (image.parent, tmp_path / "far")):
        shutil.rmtree(link) if link.is_dir() else link.unlink()
        link.symlink_to(target)
        words = f"{output} must hold no link out of it. Got {link}. Choose another folder"
        fails(words, generate, photos, model=pipeline, output=output)
    assert ((tmp_path / "notes").read_text(), [*(tmp_path / "far").iterdir()]) == ("of years", [])
    (output / "index.json").write_text('{"sealed": "x"}')
    words = f"{output}/index.json must be JSON. Got damaged.* make it again in another folder"
    fails(words, generate, photos, model=pipeline, output=output)


def test_photos_of_every_kind_give_the_image_of_what_they_show(pipeline, tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    plain = Image.fromarray(np.kron(pixels, np.ones((8, 8, 1), np.uint8)))
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees clockwise for display
    deep = Image.fromarray(np.asarray(plain.convert("L")).astype(np.uint16) * 257)
    opaque = plain.copy()
    opaque.putalpha(255)
    kinds = {
        "plain": (plain, "PNG", {}),
        "alpha": (opaque, "PNG", {}),
        "cmyk": (plain.convert("CMYK"), "TIFF", {}),
        "turned": (plain.rotate(90, expand=True), "PNG", {"exif": exif}),
        "deep": (deep, "PNG", {}),
        "gray": (plain.convert("L"), "PNG", {}),
        "dot": (Image.new("RGB", (1, 1), "red"), "PNG", {}),
    }
    made = {}
    for name, (image, form, options) in kinds.items():
        image.save(tmp_path / name, format=form, **options)
        single = generate({"same id": tmp_path / name}, model=pipeline).images[0]
        made[name] = np.asarray(single).astype(int)
    for a, b in (("alpha", "plain"), ("turned", "plain"), ("cmyk", "plain"), ("deep", "gray")):
        assert np.abs(made[a] - made[b]).max() <= 1, a
    assert np.abs(made["dot"] - made["plain"]).max() > 1
