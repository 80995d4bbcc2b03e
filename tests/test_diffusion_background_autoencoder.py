"""The autoencoder that codes the difference to the gel without contact, and pipelines on it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from forge.errors import fails
from forge.models import StandInEncoders, arrays
from forge.pictures import photos
from palpate.core import PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import BackgroundAutoencoder, LatentStats, load_autoencoder
from palpate.diffusion.autoencoder_training import fit_autoencoder
from palpate.diffusion.denoiser import Denoiser
from palpate.diffusion.generation import generate
from palpate.diffusion.options import BackgroundOptions, SamplerOptions, Schedule
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import MINI, TINY
from palpate.diffusion.training import train_generator
from palpate.diffusion.unet import build_unet
from palpate.training.run import TrainingRun

SMALL = BackgroundOptions(channels=4, narrow=8, wide=16, steps=150, batch=8, crop=16)


def gels(n: int, side: int = 32) -> np.ndarray:
    """No-contact images of ``n`` gels: a color of the light, and a grid of dark markers."""
    rng = np.random.default_rng(3)
    made = np.empty((n, side, side, 3), np.uint8)
    for image in made:
        image[:] = rng.integers(90, 200, 3)
        top, left = rng.integers(0, 8, 2)
        image[top::8, left::8] = 30
    return made


def pressed(ground: np.ndarray) -> np.ndarray:
    """Each gel with a bright stripe at its own height."""
    made = ground.astype(int)
    for k, image in enumerate(made):
        image[(3 * k) % 24 : (3 * k) % 24 + 6] += np.array([40, -20, 10])
    return made.clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> BackgroundAutoencoder:
    ground = gels(24)
    folder = tmp_path_factory.mktemp("autoencoder")
    return fit_autoencoder(pressed(ground), ground, SMALL, TrainingRun(folder))


def error(model, images, ground) -> float:
    made = model.decode(model.encode(images, ground), ground)
    return float(np.abs(made.astype(float) - images).mean())


def test_it_learns_the_contact_and_is_given_the_gel(trained):
    ground = gels(30)[24:]  # gels that training has not seen
    images = pressed(ground)
    nothing = float(np.abs(ground.astype(float) - images).mean())
    assert error(trained, images, ground) < 0.75 * nothing
    # Decoded on other gels, an image has their markers.
    other = ground[::-1].copy()
    moved = trained.decode(trained.encode(images, ground), other).astype(float)
    assert np.abs(moved - other).mean() < np.abs(moved - ground).mean()


def test_sides_may_be_any_multiple_of_4(trained):
    ground = gels(2, 40)[:, :36]
    z = trained.encode(pressed(ground), ground)
    assert z.shape == (2, 4, 9, 10)
    assert trained.gel(ground).shape == (2, 48, 9, 10)
    assert trained.decode(z, ground).shape == ground.shape


def test_saved_and_loaded_it_is_the_same(trained, tmp_path):
    trained.save(tmp_path / "a")
    again = load_autoencoder(tmp_path / "a")
    assert isinstance(again, BackgroundAutoencoder)
    assert again.digest == trained.digest
    ground = gels(2)
    assert np.array_equal(
        again.decode(again.encode(ground, ground), ground),
        trained.decode(trained.encode(ground, ground), ground),
    )
    note = tmp_path / "a" / "palpate.json"
    note.write_text(json.dumps(json.loads(note.read_text()) | {"digest": "0" * 64}))
    fails("must match palpate", load_autoencoder, tmp_path / "a")


def test_it_goes_on_from_a_folder_in_its_own_shape(trained, tmp_path):
    trained.save(tmp_path / "a")
    start, ground = load_autoencoder(tmp_path / "a"), gels(8)
    other = replace(SMALL, channels=2, narrow=4, wide=8, steps=4)
    model = fit_autoencoder(
        pressed(ground), ground, other, TrainingRun(tmp_path / "b"), start=start
    )
    assert (model.channels, model.card["options"]["wide"]) == (4, 16)
    assert model.card["start"] == start.digest != model.digest
    assert error(model, pressed(ground), ground) < 1.5 * error(start, pressed(ground), ground)


def test_training_again_gives_the_same_weights(tmp_path):
    ground, options = gels(8), replace(SMALL, steps=4)
    a, b = (
        fit_autoencoder(pressed(ground), ground, options, TrainingRun(tmp_path / name))
        for name in "ab"
    )
    assert a.digest == b.digest
    with pytest.raises(PalpateError, match="multiple of 4"):
        fit_autoencoder(ground, ground, replace(options, crop=18), TrainingRun(tmp_path / "c"))


def pipeline(autoencoder, *, ground: int = 0) -> TactilePipeline:
    """An untrained flow on the latents of an autoencoder."""
    torch.manual_seed(0)
    policy = TINY.condition_for(6)
    unet = build_unet(TINY.unet, policy, channels=4, size=8, background=ground)
    return TactilePipeline(
        autoencoder,
        Denoiser(unet, policy).eval(),
        LatentStats((0.0,) * 4, (1.0,) * 4),
        Schedule(prediction="flow"),
        SamplerOptions("dpm", steps=3, guidance=2.0, batch=4),
        32,
        encoders=StandInEncoders(),
        preset="tiny",
        training={"split": None},
        gel=gels(1)[0],
    )


@pytest.mark.parametrize("seen", [0, 48])
def test_images_are_made_on_the_users_gel_or_the_stock_gel(trained, seen):
    made, mine = pipeline(trained, ground=seen), gels(5)[4]
    stock = arrays(made(photos(2)))
    assert np.array_equal(stock, arrays(made(photos(2), gel=Image.fromarray(made.gel))))
    own = arrays(made(photos(2), gel=mine)).astype(float)
    near, far = (
        np.abs(np.median(own, axis=(1, 2)) - np.median(g, axis=(0, 1))).mean()
        for g in (mine, made.gel)
    )
    assert near < far
    with pytest.raises(PalpateError, match="one image of 32 pixels"):
        made.sample(torch.randn(1, 6), ["a"], seed=0, background=gels(1, 16))


def test_the_stock_gel_is_saved_and_part_of_the_digest(trained, tmp_path):
    made = replace(pipeline(trained), encoders=None)
    made.save(tmp_path / "p")
    again = TactilePipeline.from_pretrained(tmp_path / "p")
    assert again.digest == made.digest != replace(made, gel=gels(2)[1]).digest
    assert np.array_equal(again.gel, made.gel)
    index = json.loads((tmp_path / "p" / "model_index.json").read_text())
    assert index["autoencoder"] == [BackgroundAutoencoder.__module__, "BackgroundAutoencoder"]
    assert type(again.autoencoder).from_pretrained(tmp_path / "p" / "autoencoder").channels == 4


def test_generate_takes_the_manifests_gels_the_users_or_the_stock_gel(trained, tmp_path):
    made, ground = pipeline(trained), gels(3)
    for k, (photo, gel) in enumerate(zip(photos(2), ground[1:], strict=True)):
        Image.fromarray(photo).save(tmp_path / f"{k}.png")
        Image.fromarray(gel).save(tmp_path / f"gel{k}.png")
    rows = [{"id": str(k), "vision": f"{k}.png", "background": f"gel{k}.png"} for k in range(2)]
    manifest = Manifest.from_rows(rows, tmp_path)
    colors = lambda images: [np.median(np.asarray(i), axis=(0, 1)) for i in images]
    theirs = colors(generate(manifest, model=made).images)
    one = colors(generate(manifest, model=made, gel=tmp_path / "gel1.png").images)
    assert np.array_equal(theirs[1], one[1])
    assert not np.array_equal(theirs[0], one[0])
    bare = Manifest.from_rows([{k: row[k] for k in ("id", "vision")} for row in rows], tmp_path)
    assert len(generate(bare, model=made).images) == 2
    (tmp_path / "gel1.png").write_text("broken")
    fails("`gel` must be an image", generate, bare, model=made, gel=tmp_path / "gel1.png")


def bare(folder, backgrounds: int) -> Manifest:
    """Six samples on one gel, of which so many name it."""
    ground = gels(6)
    ground[:] = ground[0]
    rows = []
    for k, images in enumerate(zip(photos(6), pressed(ground), ground, strict=True)):
        for name, image in zip(("vision", "tactile", "gel"), images, strict=True):
            Image.fromarray(image).save(folder / f"{name}{k}.png")
        row = {"id": str(k), "video": str(k), "material": "Wood", "text": "rough"}
        row |= {"vision": f"vision{k}.png", "tactile": f"tactile{k}.png"}
        rows.append(row | ({"background": f"gel{k}.png"} if k < backgrounds else {}))
    return Manifest.from_rows(rows, folder)


@pytest.mark.parametrize("backgrounds", [0, 4, 6])
def test_all_samples_name_their_gel_or_none(tmp_path, backgrounds):
    manifest = bare(tmp_path, backgrounds)
    split = Split.from_ids(train=["0", "1", "4"], test=["2", "3", "5"])
    preset = replace(
        MINI,
        size=32,
        autoencoder=replace(SMALL, steps=2),
        loop=replace(MINI.loop, steps=1, batch=2),
        sampler=replace(MINI.sampler, steps=2),
    )
    train = lambda: train_generator(manifest, split, "palpate/mini", preset=preset)
    if backgrounds == 4:
        fails("must have a background image", train)
        return
    made = train()
    assert made.training["gel"] == ("manifest" if backgrounds else "median")
    if not backgrounds:  # the median of the train part
        images = np.stack([np.asarray(Image.open(tmp_path / f"tactile{k}.png")) for k in (0, 1, 4)])
        assert np.array_equal(made.gel, np.median(images, axis=0).astype(np.uint8))
    assert len(generate(manifest, model=made).images) == 6
