"""Embeddings of a manifest: the cache computes nothing twice and nothing stale; batches do not matter."""

import os

import numpy as np
import pytest
import torch
from PIL import Image

from palpate.core import PalpateError, ProblemsError
from palpate.data.manifest import Manifest
from palpate.encoders import embed as module
from palpate.encoders.contrastive import new_clip
from palpate.encoders.embed import embed, embed_images, embed_texts, texts_of
from palpate.encoders.preprocess import Preprocess
from palpate.encoders.presets import preset
from palpate.encoders.towers import Towers, new_touch
from test_encoders_contrastive import make_world

TINY = preset("tiny")


@pytest.fixture
def world(tmp_path):
    (tmp_path / "data").mkdir()
    return make_world(tmp_path / "data", videos=4, frames=3)


@pytest.fixture
def towers(world):
    return Towers(new_clip(TINY, world.column("text"), 0), new_touch(TINY.touch_config(8), 1).eval(), Preprocess.of_size(16))


@pytest.fixture
def count(towers, monkeypatch):
    """How many rows go through a tower."""
    rows = []
    real = Towers.encode
    monkeypatch.setattr(Towers, "encode", lambda self, tower, batch: (rows.append(len(batch)), real(self, tower, batch))[1])
    return rows


@pytest.mark.parametrize("tower", ["touch", "vision", "text"])
@pytest.mark.parametrize("cached", [True, False])
def test_embedding_equals_the_tower_picture_by_picture(world, towers, tower, cached, tmp_path):
    found = embed(world, towers, tower, cache=tmp_path / "cache" if cached else None, batch=5)
    column = {"touch": "tactile", "vision": "vision"}.get(tower)
    with torch.no_grad():
        for k in range(len(world)):
            if tower == "text":
                expect = towers.clip.encode_text([world.column("text")[k]])[0]
            else:
                picture = np.asarray(Image.open(world.paths(column)[k]))
                pre = towers.preprocess(tower)
                pixels = (torch.tensor(picture).permute(2, 0, 1)[None] / 255 - torch.tensor(pre.mean).view(3, 1, 1)) / torch.tensor(
                    pre.std
                ).view(3, 1, 1)
                model = towers.clip.model if tower == "vision" else towers.touch
                states = model.vision_model(pixel_values=pixels).pooler_output
                expect = torch.nn.functional.normalize(model.visual_projection(states), dim=-1)[0]
            assert np.allclose(found.features[k], expect, atol=1e-5)
    assert found.features.dtype == np.float32
    assert np.allclose(np.linalg.norm(found.features, axis=1), 1, atol=1e-5)
    assert (list(found.ids), list(found.labels), list(found.groups)) == (world.ids, world.column("material"), world.column("video"))
    assert found.encoder == towers.digest(tower)


@pytest.mark.parametrize("tower", ["touch", "vision", "text"])
def test_batch_size_does_not_matter(world, towers, tower):
    whole = embed(world, towers, tower, batch=100).features
    for batch in (1, 5):
        assert np.abs(embed(world, towers, tower, batch=batch).features - whole).max() < 1e-5


@pytest.mark.parametrize("tower", ["touch", "vision", "text"])
def test_second_call_computes_nothing(world, towers, tower, tmp_path, count, monkeypatch):
    first = embed(world, towers, tower, cache=tmp_path / "cache")
    assert sum(count) == (4 if tower == "text" else 12)  # equal texts are computed once
    count.clear()
    monkeypatch.setattr(module, "cached_images", None)  # nor is an image decoded
    again = embed(world, towers, tower, cache=tmp_path / "cache")
    assert count == []
    assert np.array_equal(again.features, first.features)
    assert (list(again.ids), list(again.labels), again.encoder) == (list(first.ids), list(first.labels), first.encoder)


def test_changed_image_weight_row_or_text_is_computed_again(world, towers, tmp_path, count):
    cache = tmp_path / "cache"
    first = embed(world, towers, "touch", cache=cache)
    path = world.paths("tactile")[4]
    stat = path.stat()
    Image.fromarray(np.full((16, 16, 3), 200, np.uint8)).save(path)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    count.clear()
    second = embed(world, towers, "touch", cache=cache)
    assert sum(count) == 12
    assert [k for k in range(12) if not np.allclose(first.features[k], second.features[k])] == [4]
    with torch.no_grad():
        towers.touch.visual_projection.weight[0, 0] += 1
    count.clear()
    assert not np.allclose(embed(world, towers, "touch", cache=cache).features, second.features)
    assert sum(count) == 12
    count.clear()
    assert embed(world.take(world.ids[::-1]), towers, "touch", cache=cache).ids == world.ids[::-1]
    assert sum(count) == 12
    embed(world, towers, "text", cache=cache)
    rows = world.table.to_dicts()
    rows[0]["text"] = "quite other words"
    count.clear()
    embed(Manifest.from_rows(rows, world.root), towers, "text", cache=cache)
    assert sum(count) == 5


def test_same_data_elsewhere_and_broken_cache(world, towers, tmp_path, count):
    cache = tmp_path / "cache"
    first = embed(world, towers, "vision", cache=cache)
    moved = tmp_path / "moved"
    world.root.rename(moved)
    count.clear()
    assert np.array_equal(embed(Manifest(world.table, moved), towers, "vision", cache=cache).features, first.features)
    assert count == []
    for file in cache.glob("vision-*.npz"):
        file.write_bytes(file.read_bytes()[:40])
    assert np.array_equal(embed(Manifest(world.table, moved), towers, "vision", cache=cache).features, first.features)
    assert sum(count) == 12


def test_arrays_and_files_agree_also_when_resized(world, towers):
    pictures = np.random.default_rng(0).integers(0, 256, (3, 24, 40, 3), dtype=np.uint8)
    rows = []
    for k, picture in enumerate(pictures):
        Image.fromarray(picture).save(world.root / f"wide{k}.png")
        rows.append({"id": str(k), "tactile": f"wide{k}.png"})
    found = embed(Manifest.from_rows(rows, world.root), towers, "touch")
    assert np.allclose(found.features, embed_images(pictures, towers, "touch"), atol=1e-6)
    assert found.labels is None
    assert found.groups is None


def test_other_columns(world, towers):
    background = Manifest.from_rows([{**r, "background": r["tactile"], "tactile": None} for r in world.table.to_dicts()], world.root)
    assert np.allclose(embed(background, towers, "touch", column="background").features, embed(world, towers, "touch").features, atol=1e-6)
    assert list(embed(world, towers, "touch", labels="video", groups="id").labels) == world.column("video")


@pytest.mark.parametrize("cached", [True, False])
def test_refusals(world, towers, tmp_path, cached):
    cache = tmp_path / "cache" if cached else None
    with pytest.raises(PalpateError, match="vision, text, touch"):
        embed(world, towers, "smell", cache=cache)
    with pytest.raises(PalpateError, match="must be samples"):
        embed(world.take([]), towers, "touch", cache=cache)
    with pytest.raises(PalpateError, match="--batch"):
        embed(world, towers, "touch", batch=0, cache=cache)
    with pytest.raises(PalpateError, match="touch tower"):
        embed(world, Towers(towers.clip), "touch", cache=cache)
    for k in (1, 8):  # in two batches: both are named
        world.paths("tactile")[k].write_bytes(b"no picture")
    with pytest.raises(ProblemsError) as caught:
        embed(world, towers, "touch", batch=3, cache=cache)
    assert [p.where for p in caught.value.problems] == [str(world.paths("tactile")[k]) for k in (1, 8)]


def test_texts_come_from_the_manifest_or_from_the_material(world):
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
    rows[3].update(text="", material=None)
    with pytest.raises(PalpateError, match=rows[3]["id"]):
        texts_of(Manifest.from_rows(rows, world.root))


def test_embed_texts_in_any_order(towers):
    texts = ["soft", "rough and hard", "soft", "a"]
    found = embed_texts(texts, towers, batch=2)
    assert np.array_equal(found[0], found[2])
    assert np.abs(found[[1]] - embed_texts(["rough and hard"], towers)).max() < 1e-5
