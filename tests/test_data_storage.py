"""One storage on both sides: equal images in two formats differ before, and not after it."""

import io
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from forge import commands
from forge.errors import fails
from forge.models import make_pipeline
from forge.pictures import write_photos
from palpate.core import Split
from palpate.data.manifest import Manifest
from palpate.data.samples import read_samples
from palpate.data.storage import alike, form_of, forms_of
from palpate.diffusion.generated import Generated
from palpate.diffusion.generation import generate
from palpate.evaluation.probing import probe
from palpate.evaluation.scoring import score
from palpate.report.notes import sentence
from palpate.sim.presets import PRESETS
from palpate.sim.world import World

QUALITIES = (95, 75)


def through_pillow(image, **options):
    image.save(file := io.BytesIO(), "JPEG", **options)
    return np.asarray(Image.open(file))


@pytest.fixture(scope="module")
def touches():
    """Tactile images of a small world, their gels and materials."""
    options = replace(PRESETS["tiny"], seed=951, objects_per_material=4, mixed=0.0)
    world = World(options)
    samples = [world[k] for k in range(len(world))]
    return [np.stack([s[n] for s in samples]) for n in ("tactile", "background")], [
        s["material"] for s in samples
    ]


@pytest.fixture(scope="module")
def folders(touches, tmp_path_factory):
    """Equal images as PNG and as JPEG of two qualities."""
    place = tmp_path_factory.mktemp("stored")
    ways = {"png": {}, **{f"{q}": {"quality": q} for q in QUALITIES}}
    for name, options in ways.items():
        (place / name).mkdir()
        for k, image in enumerate(touches[0][0]):
            suffix = "jpg" if options else "png"
            Image.fromarray(image).save(place / name / f"{k:03}.{suffix}", **options)
    return place


@pytest.mark.parametrize(
    "options", [{"quality": q, "subsampling": s} for q in (95, 60, 30) for s in (0, 2)]
)
def test_a_form_is_the_files_own_codec(tmp_path, touches, options):
    images = [Image.fromarray(image) for image in touches[0][0][:3]]
    images[0].save(tmp_path / "a.jpg", **options)
    form = form_of(tmp_path / "a.jpg")
    assert str(form) == f"JPEG of quality {options['quality']}"
    for image in images:
        np.testing.assert_array_equal(form.through(image), through_pillow(image, **options))
    assert form.through(images[0].resize((40, 30))).size == (40, 30)
    images[0].save(tmp_path / "a.png")
    assert form_of(tmp_path / "a.png") is None


@pytest.mark.parametrize("quality", QUALITIES)
def test_equal_images_differ_as_stored_and_not_after_the_round_trip(folders, quality):
    sides = {"generated": folders / "png", "reference": folders / f"{quality}"}
    asked = {"encoder": "palpate/mini", "companions": ["fid", "kid", "ssim"], "group": "frame"}
    after, before = (score(**sides, **asked, permutations=99, as_is=a) for a in (False, True))
    # Equal images, by the same scores: what is left after the round trip is nothing.
    equal = score(sides["reference"], sides["reference"], **asked, permutations=99)
    (note,) = [n for n in after.notes if n.code == "stored-otherwise"]
    assert f"reference JPEG of quality {quality}; png lossless" in sentence(note)
    assert not [n for n in before.notes if n.code == "stored-otherwise"]
    floor = {95: {"TMMD": 0.3, "FID": 0.02, "KID": 0.1}, 75: {"TMMD": 1.2, "FID": 0.1, "KID": 0.5}}
    for name, least in floor[quality].items():
        same, was, is_now = (
            next(s for s in r.scores if s.metric == name) for r in (equal, before, after)
        )
        assert float(is_now) == pytest.approx(float(same), abs=1e-6), name
        assert float(was) - float(is_now) > least, (name, float(was), float(is_now))
        assert float(was) == next(n for n in is_now.notes if n.code == "as-stored").params["value"]
    ssim = [next(s for s in r.scores if s.metric == "SSIM") for r in (before, after)]
    assert (float(ssim[0]) < {95: 0.99, 75: 0.95}[quality], float(ssim[1])) == (True, 1.0)
    # Digests and the gallery are of the files that were passed.
    assert after.settings["digests"] == before.settings["digests"]
    assert after.gallery == before.gallery


def test_the_judge_of_texture_sees_the_codec_and_not_after_the_round_trip(
    folders, touches, monkeypatch, tmp_path
):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    texture = __import__("texture")
    (images, gels), labels = touches
    judge = texture.TextureJudge(images, gels, labels)
    for quality in QUALITIES:
        sets = {n: [read_samples(folders / n, n)] for n in ("png", f"{quality}")}
        stored, _ = alike(sets, tmp_path / f"{quality}", 0)
        png, jpeg = (s.pixels(64, tmp_path, lambda *_: None) for (s,) in stored.values())
        np.testing.assert_array_equal(png, jpeg)
        was, now = (judge.names(x, gels) == np.array(labels) for x in (images, jpeg))
        assert was.mean() - now.mean() > 0.1, (quality, was.mean(), now.mean())
        assert (judge.names(png, gels) == judge.names(jpeg, gels)).all()
    sys.modules.pop("texture")


def test_mixed_forms_are_drawn_by_id_and_own_forms_stay(folders, tmp_path):
    mixed = [folders / ("75" if k % 2 else "95") / f"{k:03}.jpg" for k in range(20)]
    sets = {"png": [read_samples(folders / "png", "png")], "mixed": [read_samples(mixed, "mixed")]}
    one, forms = alike(sets, tmp_path / "a", 3)
    assert forms == {"png": ["lossless"], "mixed": ["JPEG of quality 75", "JPEG of quality 95"]}
    assert one["mixed"][0] is sets["mixed"][0]
    again, _ = alike(sets, tmp_path / "b", 3)
    assert one["png"][0].image_digest() == again["png"][0].image_digest()
    both = [through_pillow(Image.open(folders / "png" / "004.png"), quality=q) for q in QUALITIES]
    drawn = np.asarray(Image.open(one["png"][0].manifest.paths("tactile")[4]))
    assert any(np.array_equal(drawn, x) for x in both)
    # Both forms are drawn, about equally often.
    hits = [
        np.array_equal(np.asarray(Image.open(new)), through_pillow(Image.open(old), quality=95))
        for new, old in zip(
            *(s.manifest.paths("tactile") for s in (one["png"][0], sets["png"][0])), strict=True
        )
    ]
    assert 0.25 < np.mean(hits) < 0.75
    # Two lossy sides: each takes the other's form on top of its own.
    lossy = {n: [read_samples(folders / n, n)] for n in ("95", "75")}
    crossed, _ = alike(lossy, tmp_path / "c", 0)
    first = Image.open(folders / "75" / "000.jpg")
    got = np.asarray(Image.open(crossed["75"][0].manifest.paths("tactile")[0]))
    np.testing.assert_array_equal(got, through_pillow(first.convert("RGB"), quality=95))
    same = {n: [read_samples(folders / "95", n)] for n in ("a", "b")}
    assert alike(same, tmp_path / "d", 0) == (same, {})


def test_images_in_memory_count_as_lossless(folders, touches, tmp_path):
    sets = {
        "array": [read_samples(touches[0][0], "array")],
        "75": [read_samples(folders / "75", "75")],
    }
    stored, _ = alike(sets, tmp_path, 0)
    expected = through_pillow(Image.fromarray(touches[0][0][7]), quality=75)
    np.testing.assert_array_equal(stored["array"][0].rows[7], expected)


def test_a_probe_of_train_and_test_in_two_formats_says_so(folders, touches):
    labels = touches[1]
    names = [
        f"{'75' if k % 2 else 'png'}/{k:03}.{'jpg' if k % 2 else 'png'}" for k in range(len(labels))
    ]
    rows = [
        {"id": f"{k}", "video": f"v{k}", "material": labels[k], "tactile": name}
        for k, name in enumerate(names)
    ]
    manifest = Manifest.from_rows(rows, folders)
    ids = manifest.ids
    split = Split.from_ids(train=ids[::2], test=ids[1::2], rule={}, manifest=manifest.digest)
    probed = probe(manifest, split, encoder="palpate/mini", top=())
    (note,) = [n for n in probed.notes if n.code == "stored-otherwise"]
    assert "train lossless; test JPEG of quality 75" in sentence(note)


def test_generated_images_are_stored_like_the_data(folders, tmp_path, capsys):
    pipeline, photos = make_pipeline(), write_photos(tmp_path / "in", 6)
    common = {"model": pipeline, "output": tmp_path / "out", "like": folders / "75"}
    made = generate(photos, **common)
    forms = {replace(form_of(path), size=(0, 0)) for path in made.paths}
    assert forms == {replace(f, size=(0, 0)) for f in forms_of(read_samples(folders / "75", "75"))}
    assert {path.suffix for path in made.paths} == {".jpg"}
    plain = generate(photos, model=pipeline)
    for file, image in zip(made.paths, plain.images, strict=True):
        np.testing.assert_array_equal(Image.open(file), through_pillow(image, quality=75))
    memory = generate(photos, model=pipeline, like=folders / "75")
    np.testing.assert_array_equal(memory.images[2], Image.open(made.paths[2]))
    assert generate(photos, **common).new == 0
    made.paths[1].write_bytes(made.paths[1].read_bytes()[:-2])
    assert generate(photos, **common).new == 1
    assert Generated.load(tmp_path / "out").ids == [p.name for p in photos]
    fails("`output` must hold", generate, photos, **(common | {"like": folders / "95"}))
    assert {
        p.suffix
        for p in generate(
            photos, **(common | {"like": folders / "png", "output": tmp_path / "o"})
        ).paths
    } == {".png"}
    (tmp_path / "empty").mkdir()
    call = ("generate", photos[0], "-o", tmp_path / "x", "--like")
    for like, words in (
        ("empty", "There must be samples in"),
        ("gone", "--like must exist"),
        ("in/0.png", "--like must be a folder"),
    ):
        commands.mistake(capsys, words, *call, tmp_path / like)
    commands.mistake(
        capsys,
        "--like must go with",
        "generate",
        photos[0],
        "-o",
        tmp_path / "x.png",
        "--like",
        folders,
    )
