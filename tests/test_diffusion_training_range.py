"""What is unlike the training is said, at the rate that is stated."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from forge import commands
from forge.errors import fails
from forge.models import make_pipeline, write_shipped
from forge.pictures import write_photos
from palpate.core import image_bytes
from palpate.data.images import square
from palpate.diffusion.generated import UNLIKE, Generated
from palpate.diffusion.generation import generate
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.training_range import Distances, TrainingRange, numbers_of
from palpate.sim.presets import PRESETS
from palpate.sim.world import World


def drawn(seed, count, objects=2_000, width=12):
    """Correlated rows of objects, a third of their variance shared within an object."""
    rng = np.random.default_rng(seed)
    mix = np.random.default_rng(7).normal(size=(width, width))
    of = rng.integers(0, objects, count)
    own = rng.normal(size=(objects, width))[of]
    rows = (own + 1.4 * rng.normal(size=(count, width))) @ mix
    return rows.astype(np.float32), [f"{seed}-{k}" for k in of]


def test_new_objects_are_unlike_at_the_stated_rate():
    fitted = Distances.fit(*drawn(0, 4_000))
    rates = np.array(fitted.rates(drawn(1, 4_000)[0]))
    for level in (0.5, 0.9, 0.99):
        assert abs((rates >= level).mean() - (1 - level)) < 0.05 * (1 - level) ** 0.5
    far = np.array(fitted.rates(2.5 * drawn(2, 200)[0]))
    assert (far >= UNLIKE).mean() > 0.95
    # By hand: the distance is Mahalanobis', ridged; ranks are those of units that were left out.
    rows = drawn(0, 4_000)[0]
    z = np.clip((rows - np.array(fitted.mean)) / fitted.spread, -4, 4)
    moments = z.T @ z / len(z)
    inverse = np.linalg.inv(
        moments + 0.01 * np.trace(moments) / len(moments) * np.eye(len(moments))
    )
    whiten = np.array(fitted.whiten)
    assert whiten @ whiten.T == pytest.approx(inverse, abs=2e-3)
    assert np.array(fitted.rates(rows)).mean() < 0.5  # the fit itself knows them
    assert Distances.fit(rows, [f"{k % 19}" for k in range(4_000)]) is None  # too few units


def ranged(width=6):
    """A pipeline with the range of photos of smooth noise, and of three words."""
    photos = np.stack([square(Image.fromarray(smooth(k)), 16) for k in range(400)])
    seen = Distances.fit(numbers_of(photos), [f"{k}" for k in range(400)])
    return replace(make_pipeline(width=width), seen=TrainingRange(seen, None, ["rough", "stone"]))


def smooth(k, size=64):
    rng = np.random.default_rng(k)
    small = Image.fromarray(rng.integers(0, 256, (8, 8, 3), dtype=np.uint8))
    return np.asarray(small.resize((size, size), Image.Resampling.BICUBIC))


@pytest.fixture(scope="module")
def pipeline():
    return ranged()


def test_photos_that_are_unlike_are_named_in_notes_index_and_image(pipeline, tmp_path):
    photos = tmp_path / "in"
    photos.mkdir()
    Image.fromarray(smooth(1_000)).save(photos / "like.png")
    Image.new("RGB", (90, 70), (120, 90, 60)).save(photos / "plain.png")
    made = generate(photos, model=pipeline, output=tmp_path / "out")
    assert made.unlike["plain.png"] == 1.0 > UNLIKE > made.unlike["like.png"]
    (note,) = made.notes
    assert (note.code, note.params["photos"]) == ("photos-unlike", ["plain.png"])
    index = json.loads((tmp_path / "out" / "index.json").read_text())
    assert index["unlike"] == made.unlike == Generated.load(tmp_path / "out").unlike
    with Image.open(made.path("plain.png")) as image:
        assert image.info["palpate.unlike"] == "1"
    again = generate(photos, model=pipeline, output=tmp_path / "out")  # nothing is made anew
    assert (again.new, again.unlike, again.notes) == (0, made.unlike, made.notes)
    memory = generate(photos, model=pipeline)
    assert (memory.unlike, memory.notes) == (made.unlike, made.notes)


def test_strict_refuses_before_anything_is_written(pipeline, tmp_path):
    photos = write_photos(tmp_path / "in", 2)
    Image.fromarray(smooth(1_001)).save(tmp_path / "in" / "like.png")
    common = {"model": pipeline, "output": tmp_path / "out", "strict": True}
    error = fails("2 unlike-training", generate, tmp_path / "in", **common)
    assert [p.where for p in error.problems] == [str(p) for p in photos]
    assert not (tmp_path / "out").exists()
    made = generate(tmp_path / "in", **common, skip_bad=True)
    assert (made.ids, len(made.skipped)) == (["like.png"], 2)
    fails("`output` must hold", generate, photos, model=pipeline, output=tmp_path / "out")
    plain = make_pipeline()
    fails("`strict` must go with a generator", generate, photos, model=plain, strict=True)


def test_a_range_is_saved_with_the_pipeline_and_checked(tmp_path, monkeypatch, capsys):
    small = write_shipped(tmp_path / "root", monkeypatch)
    folder = tmp_path / "root" / "mini" / "generator"
    seen = replace(ranged().seen, words=["rough", "stone"])
    seen.save(folder)
    assert TactilePipeline.from_pretrained("palpate/mini").seen == seen
    small = replace(small, seen=seen)
    assert small.digest == replace(small, seen=None).digest  # the images do not depend on it
    monkeypatch.chdir(tmp_path)
    write_photos(tmp_path, 1)
    call = ("generate", "0.png", "-o", "t.png", "--text", "rough Xqz,  stone")
    status, _, err = commands.call(capsys, *call)
    assert (status, "No text of the training has xqz" in err) == (0, True)
    commands.mistake(capsys, "the new words xqz", *call, "--strict")
    made = generate("0.png", text="rough stone", model=small)
    assert [note.code for note in made.notes if note.code != "photos-unlike"] == []
    text = (folder / "range.json").read_text()
    (folder / "range.json").write_text(text.replace("rough", "rouhg"))
    commands.mistake(capsys, "damaged", *call)


@pytest.fixture(scope="module")
def mini():
    return TactilePipeline.from_pretrained("palpate/mini")


def test_mini_says_what_is_no_photo_of_its_world(mini):
    rng = np.random.default_rng(0)
    world = World(replace(PRESETS["tiny"], seed=941))
    odd = [np.full((64, 64, 3), color, np.uint8) for color in (0, 128, 255)]
    odd += [np.full((64, 64, 3), color, np.uint8) for color in ((200, 30, 30), (120, 90, 60))]
    odd += [rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)]
    odd += [np.clip(rng.normal(128, 20, (64, 64, 3)), 0, 255).astype(np.uint8)]
    odd += [world[0]["tactile"], world[5]["tactile"]]
    assert min(mini.seen.photo_rates(np.stack(odd))) >= UNLIKE


def test_minis_own_new_photos_are_unlike_at_about_the_stated_rate(mini):
    options = replace(PRESETS["pretrain"], seed=942, objects_per_material=5, contacts_per_video=1)
    world = World(replace(options, frames_per_contact=1))
    photos = [world.video(row.video).vision(row.frame) for row in world.rows]
    files = [image_bytes(p, "JPEG", quality=95, subsampling=0) for p in photos]  # as it is written
    photos = [np.asarray(Image.open(io.BytesIO(file))) for file in files]
    rates = np.array(mini.seen.photo_rates(np.stack(photos)))
    assert len(rates) >= 100
    for level in (0.5, 0.9, UNLIKE):  # within three deviations
        expected = 1 - level
        assert abs((rates >= level).mean() - expected) < 3 * (expected * level / len(rates)) ** 0.5


def test_mini_names_words_and_texts_that_it_never_saw(mini):
    seen = mini.seen
    assert seen.unseen("Smooth, flat, HARD") == ["flat"]
    assert seen.unseen("xqzv blorf xqzv") == ["xqzv", "blorf"]
    assert seen.unseen("A surface that feels broad, soft and repeating.") == []
    texts = ("zzz", "xqzv blorf", "a cat on a sofa")
    rates = [seen.texts.rates(mini.embed_text(text).numpy())[0] for text in texts]
    assert min(rates) >= UNLIKE
    assert seen.texts.rates(mini.embed_text("Springy, grippy and rough.").numpy())[0] < 0.95
