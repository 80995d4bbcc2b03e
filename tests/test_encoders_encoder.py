"""`Encoder`: one encoder of a set, for images and texts in any form."""

import numpy as np
import pytest
import torch
from PIL import Image

import palpate as pp
from forge.models import make_encoders
from palpate.core import PalpateError
from palpate.data.manifest import Manifest
from palpate.encoders.encoder import Encoder


@pytest.fixture(scope="module")
def encoders():
    return make_encoders()


@pytest.fixture
def files(tmp_path):
    images = np.random.default_rng(0).integers(0, 256, (3, 16, 16, 3), dtype=np.uint8)
    for k, image in enumerate(images):
        Image.fromarray(image).save(tmp_path / f"{k}.png")
    return tmp_path, images


@pytest.mark.parametrize("modality", ["vision", "tactile"])
def test_images_in_any_form_give_the_same_embeddings(encoders, files, modality):
    folder, images = files
    encoder = Encoder(encoders, modality)
    base = encoder.encode(images)
    assert (base.shape, base.dtype, encoder.dim) == ((3, 8), np.float32, 8)
    assert np.allclose(np.linalg.norm(base, axis=1), 1, atol=1e-6)
    paths = sorted(folder.iterdir())
    channels_first = torch.from_numpy(images).permute(0, 3, 1, 2)
    rows = [{"id": p.stem, modality: p.name} for p in paths]
    for form in (
        folder,
        str(folder),
        paths,
        list(map(str, paths)),
        list(map(Image.open, paths)),
        [paths[0], Image.open(paths[1]), images[2]],
        torch.from_numpy(images),
        channels_first,
        channels_first / 255,
        Manifest.from_rows(rows, folder),
    ):
        assert np.allclose(encoder.encode(form), base, atol=1e-6)
    for one in (paths[1], images[1], Image.open(paths[1]), channels_first[1]):
        assert np.allclose(encoder.encode(one), base[1:2], atol=1e-6)
    assert np.allclose(encoder.encode(images, batch=2), base, atol=1e-5)
    assert encoder.encode([]).shape == (0, 8)
    assert encoder.digest == encoders.digest(modality)


def test_texts(encoders):
    encoder = Encoder(encoders, "text")
    both = encoder.encode(["a rough wall", "a soft cloth"])
    assert np.allclose(encoder.encode("a soft cloth"), both[1:], atol=1e-5)
    with torch.no_grad():
        assert np.allclose(both, encoders.encode("text", ["a rough wall", "a soft cloth"]))


def test_the_shipped_encoder_by_the_door(files):
    encoder = pp.Encoder.from_pretrained("palpate/mini", modality="tactile")
    assert encoder.encode(files[1]).shape == (3, 128)
    with pytest.raises(PalpateError, match=r"`modality` must be one of vision, text, tactile"):
        pp.Encoder.from_pretrained("palpate/mini", modality="touch")
    with pytest.raises(TypeError, match="modality"):
        pp.Encoder.from_pretrained("palpate/mini")


def test_mistakes_are_explained(encoders, files):
    encoder = Encoder(encoders, "tactile")
    for inputs, message in (
        (files[1] / 255.0, "`images` must be uint8"),
        (files[1][..., 0], "`images` must be uint8"),
        (torch.zeros(1, 3, 4, 4) + 2, "`images` must be uint8"),
        ({"a": 1}, "`images` must be files, PIL images"),
        (files[0] / "gone.png", "gone.png: "),
    ):
        with pytest.raises(PalpateError, match=message):
            encoder.encode(inputs)
    with pytest.raises(PalpateError, match=r"must be one of vision, text\."):
        Encoder(encoders.without_tactile(), "tactile")
