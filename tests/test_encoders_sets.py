"""Encoders, tokenizer and preprocessing: saved and loaded, they give the same embeddings."""

import json
import math
import types

import huggingface_hub
import numpy as np
import pytest
import torch
import transformers
from PIL import Image
from safetensors.torch import load_file, save_file
from transformers import AutoTokenizer, CLIPModel

from forge.errors import fails
from forge.pictures import photos
from palpate.core import PalpateError
from palpate.core.files import digest_folder
from palpate.data.images import CLIP_MEAN, CLIP_STD, Preprocess
from palpate.encoders.contrastive import new_clip
from palpate.encoders.embed import embed_images, embed_texts
from palpate.encoders.encoder_set import EncoderSet, load_clip, new_tactile, tokens
from palpate.encoders.models import pick_device, to_unit
from palpate.encoders.presets import Augment, preset_of
from palpate.encoders.rows import augmented, draw_augmentation
from palpate.encoders.tokenizer import train_tokenizer
from palpate.training.steps import Step

TINY = preset_of("tiny")
TEXTS = [
    "Rough, bumpy bark.",
    "smooth cold metal",
    "soft woven fabric",
    "x",
    "a very long description of a rough surface " * 5,
]


@pytest.fixture
def clip():
    return new_clip(TINY, TEXTS, seed=0)


@pytest.fixture
def encoders(clip):
    tactile = new_tactile(TINY.tactile_config(8), 1).eval()
    shape = {"tactile": Preprocess(16, 16, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4))}
    alone = EncoderSet(tactile=tactile, preprocesses=shape, card={"preset": "tiny"})
    return clip.with_tactile(alone)


def test_tokenizer_ids_cut_and_determinism():
    tokenizer = train_tokenizer(TEXTS, vocabulary=300, context=16)
    assert (tokenizer.pad_token_id, tokenizer.bos_token_id, tokenizer.eos_token_id) == (0, 1, 3)
    texts = [*TEXTS, "", "ünïcödé 触覚"]
    ids = tokenizer(texts, padding=True, truncation=True, max_length=16)["input_ids"]
    assert all(row[0] == 1 and row.count(3) == 1 and 2 not in row and len(row) <= 16 for row in ids)
    upper = tokenizer(["SMOOTH Cold METAL"], padding="max_length", max_length=len(ids[1]))
    assert upper["input_ids"] == [ids[1]]
    fresh, again = (
        train_tokenizer(texts, vocabulary=300, context=16).backend_tokenizer.to_str()
        for texts in (TEXTS, [*reversed(TEXTS), TEXTS[0]])
    )
    assert again == fresh
    for texts, size in (([" "], 300), (["a"], 100)):
        with pytest.raises(PalpateError):
            train_tokenizer(texts, vocabulary=size)


def test_text_is_pooled_at_the_first_end_token(clip):
    words = tokens(clip.clip, clip.tokenizer, TEXTS)
    states = clip.clip.text_model(**words).last_hidden_state
    for k, row in enumerate(words["input_ids"].tolist()):
        at = row.index(clip.tokenizer.eos_token_id)
        expect = torch.nn.functional.normalize(clip.clip.text_projection(states[k, at]), dim=-1)
        assert torch.allclose(clip.encode("text", TEXTS)[k], expect, atol=1e-6)


def test_saved_clip_is_a_standard_folder_with_equal_embeddings(clip, tmp_path):
    clip.save(tmp_path)
    plain = CLIPModel.from_pretrained(tmp_path / "clip").eval()
    tokenizer = AutoTokenizer.from_pretrained(tmp_path / "clip")
    pixels = clip.preprocess("vision").normalize(to_unit(photos(5)))
    tokens = tokenizer(TEXTS, padding=True, truncation=True, max_length=16, return_tensors="pt")
    with torch.no_grad():
        out = plain(**tokens, pixel_values=pixels)
    assert torch.equal(out.image_embeds, clip.encode("vision", pixels))
    assert torch.allclose(out.text_embeds, clip.encode("text", TEXTS), atol=1e-6)
    again = load_clip(tmp_path / "clip")
    assert (again.preprocesses, again.name, again.dim) == (clip.preprocesses, "tiny", 8)
    for modality, batch in (("vision", pixels), ("text", [*TEXTS, "rough " * 30])):
        assert again.digest(modality) == clip.digest(modality)
        assert torch.allclose(
            again.encode(modality, batch), clip.encode(modality, batch), atol=1e-6
        )
    assert torch.allclose(again.patches(pixels, 1), clip.patches(pixels, 1), atol=1e-6)
    assert again.length("rough") == clip.length("rough")
    again.save(tmp_path / "again")
    assert digest_folder(tmp_path / "again" / "clip") == digest_folder(tmp_path / "clip")
    config = json.loads((tmp_path / "clip" / "tokenizer_config.json").read_text())
    assert config["tokenizer_class"] == "PreTrainedTokenizerFast"


def test_tensor_of_transformers_4_and_output_of_5_are_both_read(clip):
    pixels = torch.zeros(2, 3, 16, 16)
    expect = clip.encode("vision", pixels)
    raw = clip.clip.visual_projection(clip.clip.vision_model(pixel_values=pixels).pooler_output)
    for output in (raw, types.SimpleNamespace(pooler_output=raw)):
        clip.clip.get_image_features = lambda pixel_values, output=output: output
        assert torch.allclose(clip.encode("vision", pixels), expect, atol=1e-6)


def test_encoders_survive_a_folder(encoders, tmp_path):
    encoders.save(tmp_path / "set")
    again = EncoderSet.load(tmp_path / "set")
    assert again.card == {"preset": "tiny"}
    assert again.preprocesses == encoders.preprocesses
    for modality in ("vision", "tactile"):
        first, second = (embed_images(photos(5), e, modality) for e in (again, encoders))
        assert np.array_equal(first, second)
    assert np.array_equal(embed_texts(TEXTS, again), embed_texts(TEXTS, encoders))
    assert not [p for p in (tmp_path / "set").rglob("*") if p.suffix in (".bin", ".pt", ".pkl")]
    fails("empty folder", encoders.save, tmp_path / "set")
    encoders.without_tactile().save(tmp_path / "two")
    assert EncoderSet.load(tmp_path / "two").tactile is None


def test_digest_changes_with_one_weight_and_with_preprocessing(encoders):
    before = {t: encoders.digest(t) for t in ("vision", "text", "tactile")}
    assert len(set(before.values())) == 3
    with torch.no_grad():
        encoders.tactile.visual_projection.weight[0, 0] += 1e-6
    changed = {m for m in before if encoders.digest(m) != before[m]}
    assert changed == {"tactile"}
    with torch.no_grad():
        encoders.clip.text_model.embeddings.token_embedding.weight[5, 0] += 1e-6
    assert encoders.digest("text") != before["text"]
    encoders.preprocesses["vision"] = Preprocess(16, 16)
    now = encoders.digest("vision")
    encoders.preprocesses["vision"] = Preprocess(16, 16, (0.0, 0.0, 0.0))
    assert encoders.digest("vision") != now


def test_changed_weights_on_disk_are_noticed(encoders, tmp_path):
    encoders.save(tmp_path / "set")
    file = tmp_path / "set" / "tactile" / "model.safetensors"
    tensors = load_file(file)
    tensors["visual_projection.weight"][0, 0] += 0.5
    save_file(tensors, file, metadata={"format": "pt"})
    fails(r"tactile encoder .* digest", EncoderSet.load, tmp_path / "set")


def test_folders_that_are_no_clip(clip, tmp_path, monkeypatch):
    clip.save(tmp_path / "clip")
    folder = tmp_path / "clip" / "clip"
    (folder / "preprocessor_config.json").unlink()
    fails(r"image processor must exist.*no file .*preprocessor_config\.json", load_clip, folder)
    clip.save(tmp_path / "cut")
    weights = tmp_path / "cut" / "clip" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:100])
    fails("must be a CLIP model", load_clip, tmp_path / "cut")
    clip.save(tmp_path / "hole")
    weights = tmp_path / "hole" / "clip" / "model.safetensors"
    tensors = load_file(weights)
    del tensors["visual_projection.weight"]
    save_file(tensors, weights, metadata={"format": "pt"})
    fails("1 weights are missing, first visual_projection", load_clip, tmp_path / "hole")
    (tmp_path / "cut" / "palpate.json").write_text("{}")
    fails("palpate-encoders", EncoderSet.load, tmp_path / "cut")
    fails("no folder", EncoderSet.load, tmp_path / "nothing")

    def unreachable(*args, **kwargs):
        raise OSError("We couldn't connect to the hub\nand many more lines")

    rejection = r"couldn't connect to the hub\. Pass a folder that holds config\.json, model\.safe"
    monkeypatch.setattr(huggingface_hub, "snapshot_download", unreachable)  # called first
    fails(rejection, load_clip, "openai/clip-vit-base-patch32")
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda *_, **__: folder)
    monkeypatch.setattr(transformers.CLIPModel, "from_pretrained", unreachable)
    fails(rejection, load_clip, "openai/clip-vit-base-patch32")


@pytest.mark.parametrize(
    ("modality", "kind", "words"),
    [
        ("taste", np.uint8, "vision, text, tactile"),
        ("", np.uint8, "vision, text, tactile"),
        ("text", np.uint8, "must be vision or tactile for images"),
        ("tactile", np.uint8, "include a tactile encoder"),
        ("vision", np.float32, "uint8"),
    ],
)
def test_unknown_and_missing_encoders(clip, modality, kind, words):
    fails(words, embed_images, photos(5).astype(kind), clip, modality)


def test_devices():
    fails("device", pick_device, "cuda:99")
    assert pick_device("cpu").type == "cpu"


def test_random_weights_belong_to_the_seed():
    torch.manual_seed(1)
    a = new_tactile(TINY.tactile_config(8), 5).state_dict()
    torch.manual_seed(2)
    b, c = (new_tactile(TINY.tactile_config(8), seed).state_dict() for seed in (5, 6))
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert not torch.equal(a["visual_projection.weight"], c["visual_projection.weight"])


def test_preprocess_equals_transformers_processor():
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    ours = Preprocess(16, 20, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    config = {k: v for k, v in ours.to_config().items() if k != "image_processor_type"}
    images = photos(1, 40)
    theirs = CLIPImageProcessorPil(**config)(Image.fromarray(images[0]), return_tensors="pt")
    assert torch.allclose(ours(to_unit(ours.fit(images))), theirs["pixel_values"], atol=1e-5)


def test_augmentation():
    images = torch.rand(6, 3, 16, 16, generator=torch.Generator().manual_seed(0))

    def changed(augment, seed):
        return augmented(images, draw_augmentation(augment, Step(0, np.arange(len(images)), seed)))

    nothing = Augment(crop=0, gain=0, offset=0)
    assert torch.allclose(changed(nothing, 1), images, atol=1e-5)
    some = Augment()
    assert torch.equal(changed(some, 1), changed(some, 1))
    assert not torch.equal(changed(some, 1), changed(some, 2))
    # only mirrors and turns: each result is one of the eight symmetries of its image
    symmetries = Augment(crop=0, gain=0, offset=0, flips=True, quarter_turns=True)
    turned = changed(symmetries, 3)
    seen = set()
    for image, result in zip(images, turned, strict=True):
        ways = [torch.rot90(p, k, (1, 2)) for p in (image, image.flip(2)) for k in range(4)]
        match = [k for k, way in enumerate(ways) if torch.allclose(way, result, atol=1e-4)]
        assert len(match) == 1
        seen.update(match)
    assert len(seen) > 1
    lit = changed(Augment(crop=0, gain=0.3, offset=0.2), 4)
    for image, result in zip(images.flatten(1).numpy(), lit.flatten(1).numpy(), strict=True):
        line = np.polyfit(image, result, 1)  # one straight line through all pixels
        assert np.allclose(np.polyval(line, image), result, atol=1e-4)


def test_preprocess_reads_both_spellings(tmp_path):
    def read(config, size):
        (tmp_path / "p.json").write_text(json.dumps(config))
        return Preprocess.from_config(tmp_path / "p.json", size)

    statistics = {"image_mean": list(CLIP_MEAN), "image_std": list(CLIP_STD)}
    old = {"size": 224, "crop_size": 224, "do_normalize": True, **statistics}
    sides = {"size": {"shortest_edge": 224}, "crop_size": {"height": 224, "width": 224}}
    assert read(old, 224) == Preprocess(224, 224)
    assert read({**sides, "image_mean": [0.5] * 3}, 224) == Preprocess(224, 224, (0.5,) * 3)
    assert read({"size": {"shortest_edge": 256}, "crop_size": 224}, 224).resize == 256
    assert read({}, 64) == Preprocess(64, 64)
    made = Preprocess(24, 32, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    assert read(made.to_config(), 24) == made


@pytest.mark.parametrize("place", ["", "clip"])
def test_a_card_that_cannot_be_used_is_named(encoders, tmp_path, place):
    encoders.save(tmp_path / "t")
    EncoderSet.load(tmp_path / "t")
    file = tmp_path / "t" / place / "palpate.json"
    about, other = json.loads(file.read_text()), "digests, card and seen in .* must be as palpate"
    for content, message in (
        ([], "must be a JSON object"),
        (about | {"format": "x"}, "must have the format palpate-"),
        ({k: v for k, v in about.items() if k != "digests"}, "no digests"),
        (about | {"digests": None}, other),
        (about | {"digests": ["a"]}, other),
        (about | {"card": 3}, other),
        (about | {"seen": []}, other),
        (about | {"seen": {"vision": "7"}}, other),
    ):
        file.write_text(json.dumps(content))
        caught = fails(message, EncoderSet.load, tmp_path / "t")
        assert str(file) in caught.must


@pytest.mark.parametrize(
    "change",
    [
        {"palpate": {"unknown": 1}},
        {"palpate": {"fitting": "stretch"}},
        {"palpate": {"lag": 5}},
        {"palpate": {"size": 3}},
        {"resample": 99, "palpate": {}},
        {"image_std": [0, 1, 1]},
        {"image_mean": [math.nan, 0, 0]},
        {"size": {"shortest_edge": 10**6}},
        {"size": "x"},
        {"image_mean": [1]},
        {"image_std": "abc"},
        {"size": 24, "crop_size": 24},
    ],
)
def test_an_image_processor_that_nobody_writes_is_refused(tmp_path, change):
    path = tmp_path / "preprocessor_config.json"
    good = Preprocess(16, 16, fitting="pad", turn="left", resample=0)
    path.write_text(json.dumps(good.to_config()))
    assert Preprocess.from_config(path, 16) == good  # 0 is the nearest pixel, not the default
    path.write_text(json.dumps(good.to_config() | change))
    fails(r"preprocessor_config\.json must", Preprocess.from_config, path, 16)
