"""Embeddings of a manifest: nothing is computed twice, nothing stale is used; and `Encoder`, one
encoder of a set, for images and texts in any form.
"""

import os

import numpy as np
import pytest
import torch
from PIL import Image

import palpate as pp
from forge.errors import fails
from palpate.core import PalpateError, PalpateWarning
from palpate.data.images import Preprocess
from palpate.data.manifest import Manifest
from palpate.encoders import embed as module
from palpate.encoders.contrastive import new_clip
from palpate.encoders.embed import embed, embed_images, embed_texts, texts_of
from palpate.encoders.encoder import Encoder
from palpate.encoders.encoder_set import EncoderSet, new_tactile
from palpate.encoders.presets import preset_of
from test_encoders_contrastive import make_world

TINY = preset_of("tiny")


@pytest.fixture
def world(tmp_path):
    (tmp_path / "data").mkdir()
    return make_world(tmp_path / "data", videos=4, frames=3)


@pytest.fixture
def encoders(world):
    tactile = new_tactile(TINY.tactile_config(8), 1).eval()
    alone = EncoderSet(tactile=tactile, preprocesses={"tactile": Preprocess(16, 16)})
    return new_clip(TINY, world.column("text"), 0).with_tactile(alone)


@pytest.fixture
def count(encoders, monkeypatch):
    """How many rows go through a encoder."""
    rows = []
    real = EncoderSet.encode
    monkeypatch.setattr(
        EncoderSet,
        "encode",
        lambda self, encoder, batch, *sensors: (
            rows.append(len(batch)),
            real(self, encoder, batch, *sensors),
        )[1],
    )
    return rows


@pytest.mark.parametrize("encoder", ["tactile", "vision", "text"])
@pytest.mark.parametrize("cached", [True, False])
def test_embedding_equals_the_encoder_image_by_image(world, encoders, encoder, cached, tmp_path):
    result = embed(world, encoders, encoder, cache=tmp_path / "cache" if cached else None, batch=5)
    column = {"tactile": "tactile", "vision": "vision"}.get(encoder)
    with torch.no_grad():
        for k in range(len(world)):
            if encoder == "text":
                expect = encoders.encode("text", [world.column("text")[k]])[0]
            else:
                image = np.asarray(Image.open(world.paths(column)[k]))
                pre = encoders.preprocess(encoder)
                pixels = (
                    torch.tensor(image).permute(2, 0, 1)[None] / 255
                    - torch.tensor(pre.mean).view(3, 1, 1)
                ) / torch.tensor(pre.std).view(3, 1, 1)
                model = encoders.clip if encoder == "vision" else encoders.tactile
                states = model.vision_model(pixel_values=pixels).pooler_output
                expect = torch.nn.functional.normalize(model.visual_projection(states), dim=-1)[0]
            assert np.allclose(result.features[k], expect, atol=1e-5)
    assert result.features.dtype == np.float32
    assert np.allclose(np.linalg.norm(result.features, axis=1), 1, atol=1e-5)
    assert (list(result.ids), list(result.labels), list(result.groups)) == (
        world.ids,
        world.column("material"),
        world.column("video"),
    )
    assert result.encoder == encoders.digest(encoder)


@pytest.mark.parametrize("encoder", ["tactile", "vision", "text"])
def test_batch_size_does_not_matter(world, encoders, encoder):
    whole = embed(world, encoders, encoder, batch=100).features
    for batch in (1, 5):
        assert np.abs(embed(world, encoders, encoder, batch=batch).features - whole).max() < 1e-5


@pytest.mark.parametrize("encoder", ["tactile", "vision", "text"])
def test_second_call_computes_nothing(world, encoders, encoder, tmp_path, count, monkeypatch):
    first = embed(world, encoders, encoder, cache=tmp_path / "cache")
    assert sum(count) == (4 if encoder == "text" else 12)  # equal texts are computed once
    count.clear()
    monkeypatch.setattr(module, "load_images", None)  # nor is an image decoded
    again = embed(world, encoders, encoder, cache=tmp_path / "cache")
    assert count == []
    assert np.array_equal(again.features, first.features)
    assert (list(again.ids), list(again.labels), again.encoder) == (
        list(first.ids),
        list(first.labels),
        first.encoder,
    )


def test_changed_image_weight_row_or_text_is_computed_again(world, encoders, tmp_path, count):
    cache = tmp_path / "cache"
    first = embed(world, encoders, "tactile", cache=cache)
    path = world.paths("tactile")[4]
    stat = path.stat()
    Image.fromarray(np.full((16, 16, 3), 200, np.uint8)).save(path)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    count.clear()
    second = embed(world, encoders, "tactile", cache=cache)
    assert sum(count) == 12
    assert [k for k in range(12) if not np.allclose(first.features[k], second.features[k])] == [4]
    with torch.no_grad():
        encoders.tactile.visual_projection.weight[0, 0] += 1
    count.clear()
    assert not np.allclose(embed(world, encoders, "tactile", cache=cache).features, second.features)
    assert sum(count) == 12
    count.clear()
    assert (
        embed(world.take(world.ids[::-1]), encoders, "tactile", cache=cache).ids == world.ids[::-1]
    )
    assert sum(count) == 12
    embed(world, encoders, "text", cache=cache)
    rows = world.table.to_dicts()
    rows[0]["text"] = "quite other words"
    count.clear()
    embed(Manifest.from_rows(rows, world.root), encoders, "text", cache=cache)
    assert sum(count) == 5


def test_same_data_elsewhere_and_broken_cache(world, encoders, tmp_path, count):
    cache = tmp_path / "cache"
    first = np.array(embed(world, encoders, "vision", cache=cache).features)  # mapped there
    moved = tmp_path / "moved"
    world.root.rename(moved)
    count.clear()
    assert np.array_equal(
        embed(Manifest(world.table, moved), encoders, "vision", cache=cache).features, first
    )
    assert count == []
    for file in cache.glob("vision-*.npy"):
        file.write_bytes(file.read_bytes()[:40])
    assert np.array_equal(
        embed(Manifest(world.table, moved), encoders, "vision", cache=cache).features, first
    )
    assert sum(count) == 12


def test_arrays_and_files_agree_also_when_resized(world, encoders):
    images = np.random.default_rng(0).integers(0, 256, (3, 24, 40, 3), dtype=np.uint8)
    rows = []
    for k, image in enumerate(images):
        Image.fromarray(image).save(world.root / f"wide{k}.png")
        rows.append({"id": str(k), "tactile": f"wide{k}.png"})
    result = embed(Manifest.from_rows(rows, world.root), encoders, "tactile")
    assert np.allclose(result.features, embed_images(images, encoders, "tactile"), atol=1e-6)
    assert (result.labels, result.groups) == (None, None)
    assert list(embed(world, encoders, "tactile", groups="id").groups) == world.ids


@pytest.mark.parametrize("cached", [True, False])
def test_mistakes_are_explained(world, encoders, tmp_path, cached):
    cache = tmp_path / "cache" if cached else None
    for manifest, of, modality, batch, words in (
        (world, encoders, "smell", 1, "vision, text, tactile"),
        (world.take([]), encoders, "tactile", 1, "must be samples"),
        (world, encoders, "tactile", 0, "`batch` must be at least 1"),
        (world, encoders.without_tactile(), "tactile", 1, "tactile encoder"),
    ):
        fails(words, embed, manifest, of, modality, batch=batch, cache=cache)
    for k in (1, 8):  # in two batches: both are named
        world.paths("tactile")[k].write_bytes(b"no image")
    caught = fails("", embed, world, encoders, "tactile", batch=3, cache=cache)
    assert [p.where for p in caught.problems] == [str(world.paths("tactile")[k]) for k in (1, 8)]


def test_texts_come_from_the_manifest_or_from_what_is_known(world):
    rows = world.table.to_dicts()
    assert texts_of(world) == ([r["text"] for r in rows], "manifest")
    assert texts_of(Manifest(world.table, world.root, {"text_source": "people"}))[1] == "people"
    bare = Manifest.from_rows([{**r, "text": None} for r in rows], world.root)
    captions, source = texts_of(bare)
    assert source == "caption"
    assert captions == texts_of(bare)[0]
    rows[0]["text"] = None
    mixed = texts_of(Manifest.from_rows(rows, world.root))
    assert mixed == ([captions[0], *[r["text"] for r in rows[1:]]], "manifest and caption")
    for known, source in (({"object": "cup"}, "object"), ({"video": "v"}, "video"), ({}, "id")):
        row = {"id": "x/7"} | known
        texts, made = texts_of(Manifest.from_rows([row], world.root))
        assert row.get(source) in texts[0]
        assert made == f"caption of the {source}"


def test_embed_texts_in_any_order(encoders):
    texts = ["soft", "rough and hard", "soft", "a"]
    result = embed_texts(texts, encoders, batch=2)
    assert np.array_equal(result[0], result[2])
    assert np.abs(result[[1]] - embed_texts(["rough and hard"], encoders)).max() < 1e-5


# --- one encoder


@pytest.fixture
def files(tmp_path):
    images = np.random.default_rng(0).integers(0, 256, (3, 16, 16, 3), dtype=np.uint8)
    (folder := tmp_path / "files").mkdir()
    for k, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{k}.png")
    return folder, images


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
    with pytest.warns(PalpateWarning, match="no-contact images"):
        plain = encoder.encode(files[1])
    assert plain.shape == (3, 256)
    one = encoder.encode(files[1], backgrounds=files[1][0])
    assert not np.allclose(plain, one, atol=1e-3)
    each = encoder.encode(files[1], backgrounds=[Image.fromarray(files[1][0])] * 3)
    assert np.allclose(one, each, atol=1e-5)
    with pytest.raises(PalpateError, match="one image, or one for each"):
        encoder.encode(files[1], backgrounds=files[1][:2])
    photos = Encoder(encoder.encoders, "vision")  # subtracts nothing
    gel = files[1][0]
    assert np.array_equal(photos.encode(files[1], backgrounds=gel), photos.encode(files[1]))
    with pytest.raises(PalpateError, match=r"`modality` must be one of vision, text, tactile"):
        pp.Encoder.from_pretrained("palpate/mini", modality="touch")
    with pytest.raises(TypeError, match="modality"):
        pp.Encoder.from_pretrained("palpate/mini")


def test_other_inputs_are_refused(encoders, files):
    encoder = Encoder(encoders, "tactile")
    for inputs, message in (
        (files[1] / 100.0, r"`images` must be \(n, h, w, c\)"),
        (files[1][..., 0], r"`images` must be \(n, h, w, c\)"),
        (torch.zeros(1, 3, 4, 4) + 2, r"`images` must be \(n, h, w, c\)"),
        ({"a": 1}, "`images` must be files, PIL images"),
        (files[0] / "gone.png", "gone.png: "),
    ):
        fails(message, encoder.encode, inputs)
    fails(r"must be one of vision, text\.", Encoder, encoders.without_tactile(), "tactile")
