"""Vision and text of SigLIP, SigLIP 2 and DINO, from tiny folders as transformers writes them."""

import json

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image
from torch.nn.functional import normalize
from transformers import (
    Dinov2Config,
    Dinov2Model,
    DINOv3ViTConfig,
    DINOv3ViTModel,
    Siglip2Config,
    Siglip2Model,
    SiglipConfig,
    SiglipModel,
)

from forge.errors import fails
from forge.worlds import by_video
from palpate import probe
from palpate.data.manifest import Manifest
from palpate.encoders import Encoder, EncoderSet
from palpate.encoders.tokenizer import save_tokenizer, train_tokenizer
from palpate.report.notes import sentence

SIZE = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2}
SIZE |= {"num_attention_heads": 2}
HALF = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
TEXT = SIZE | {"vocab_size": 300, "max_position_embeddings": 16, "projection_size": 32}


def siglip():
    vision = SIZE | {"image_size": 32, "patch_size": 8}
    config = {"size": {"height": 32, "width": 32}, "resample": 3, **HALF}
    return SiglipModel(SiglipConfig(text_config=TEXT, vision_config=vision)), config


def siglip2():
    vision = SIZE | {"patch_size": 8, "num_patches": 16}
    config = {"max_num_patches": 16, "patch_size": 8, "resample": 2, **HALF}
    return Siglip2Model(Siglip2Config(text_config=TEXT, vision_config=vision)), config


def dinov2():
    more = {"num_hidden_layers": 2, "mlp_ratio": 2, "image_size": 56, "patch_size": 14}
    sizes = {k: v for k, v in SIZE.items() if k != "intermediate_size"}
    config = {"size": {"shortest_edge": 48}, "crop_size": {"height": 42, "width": 42}}
    config |= {"do_center_crop": True, "resample": 3, **IMAGENET}
    return Dinov2Model(Dinov2Config(**(sizes | more))), config


def dinov3():
    config = {"size": {"height": 32, "width": 32}, "resample": 2, "do_center_crop": None}
    model = DINOv3ViTModel(DINOv3ViTConfig(**SIZE, image_size=32, patch_size=8))
    return model, config | {"crop_size": None, **IMAGENET}


FAMILIES = {"siglip": siglip, "siglip2": siglip2, "dinov2": dinov2, "dinov3": dinov3}


def write(name, folder):
    torch.manual_seed(0)
    model, config = FAMILIES[name]()
    model.eval().save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(config))
    if name.startswith("siglip"):
        save_tokenizer(train_tokenizer(["rough wood", "soft cloth"], vocabulary=300), folder)
    return model, config


def by_hand(name, model, config, image):
    """The features of one image, prepared by Pillow and NumPy."""
    filters = Image.Resampling(config["resample"])
    if name == "dinov2":
        (width, height), side = image.size, min(image.size)
        left, top = (width - side) // 2, (height - side) // 2
        square = image.crop((left, top, left + side, top + side)).resize((48, 48), filters)
        image = square.crop((3, 3, 45, 45))
    else:
        image = image.resize((32, 32), filters)
    x = (np.asarray(image) / 255 - config["image_mean"]) / config["image_std"]
    more = {}
    if name == "siglip2":
        rows = x.reshape(4, 8, 4, 8, 3).transpose(0, 2, 1, 3, 4).reshape(16, 192)
        pixels = torch.tensor(rows[None], dtype=torch.float32)
        more = {"pixel_attention_mask": torch.ones(1, 16), "spatial_shapes": torch.tensor([[4, 4]])}
    else:
        pixels = torch.tensor(x.transpose(2, 0, 1)[None], dtype=torch.float32)
    with torch.no_grad():
        if name.startswith("siglip"):
            made = model.get_image_features(pixel_values=pixels, **more)
        else:
            made = model(pixel_values=pixels)
    return normalize(made if isinstance(made, torch.Tensor) else made.pooler_output, dim=-1)


@pytest.mark.parametrize("name", FAMILIES)
def test_a_folder_of_transformers_gives_its_own_features(tmp_path, name):
    model, config = write(name, tmp_path / "model")
    pixels = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    encoders = EncoderSet.load(tmp_path / "model")
    encoder = Encoder(encoders, "vision")
    made = encoder.encode(Image.fromarray(pixels))
    assert made.shape == (1, encoder.dim) == (1, 32)
    assert np.allclose(made, by_hand(name, model, config, Image.fromarray(pixels)), atol=1e-5)
    encoders.save(tmp_path / "saved")
    again = EncoderSet.load(tmp_path / "saved")
    text = ["text"] if name.startswith("siglip") else []
    assert again.modalities == encoders.modalities == ["vision", *text]
    assert [again.digest(m) for m in again.modalities] == [
        encoders.digest(m) for m in encoders.modalities
    ]
    assert np.allclose(Encoder(again, "vision").encode(Image.fromarray(pixels)), made, atol=1e-6)


@pytest.mark.parametrize("name", ["siglip", "siglip2"])
def test_texts_of_siglip_are_lower_case_and_padded_without_a_mask(tmp_path, name):
    model, _ = write(name, tmp_path / "model")
    encoders = EncoderSet.load(tmp_path / "model")
    ids = encoders.tokenizer(
        ["rough wood"], padding="max_length", max_length=16, return_tensors="pt"
    )["input_ids"]
    with torch.no_grad():
        made = model.get_text_features(input_ids=ids)
    want = normalize(made if isinstance(made, torch.Tensor) else made.pooler_output, dim=-1)
    assert np.allclose(Encoder(encoders, "text").encode("ROUGH wood"), want, atol=1e-5)


def test_other_models_are_named(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "bert"}))
    fails(r"must be one of clip, siglip, .*'bert'", EncoderSet.load, tmp_path)


CARDS = {
    "license: mit\ndatasets: [HCT, a/b]": ("mit", ("HCT", "a/b")),
    "license: other\nlicense_name: dinov3-license\ndatasets: HCT": ("dinov3-license", ("HCT",)),
    "tags: [vision]": ("unknown", ()),
    "license: [": ("unknown", ()),
    None: ("unknown", ()),
}


@pytest.mark.parametrize(("head", "facts"), CARDS.items())
def test_license_and_data_sets_are_those_of_the_models_card(tmp_path, head, facts):
    write("siglip", tmp_path / "model")
    if head is not None:
        (tmp_path / "model" / "README.md").write_text(f"---\n{head}\n---\n# A model\n")
    encoders = EncoderSet.load(tmp_path / "model")
    encoders.save(tmp_path / "saved")  # as part of what is trained with it
    for each in (encoders, EncoderSet.load(tmp_path / "saved")):
        for modality in ("vision", "text"):
            encoder = Encoder(each, modality)
            assert (encoder.license, encoder.trained_on) == facts
    assert f"license: {facts[0]}\n" in (tmp_path / "saved" / "clip" / "README.md").read_text()


def test_a_probe_prints_the_license_and_refuses_data_of_the_models_card(tmp_path, small_manifest):
    write("siglip", tmp_path / "model")
    (tmp_path / "model" / "README.md").write_text("---\nlicense: mit\ndatasets: [HCT]\n---\n")
    table = small_manifest.table.with_columns(text=pl.col("id"))
    split = by_video(small_manifest, "v0", "v1", "v2")
    options = {"encoder": str(tmp_path / "model"), "modality": "vision"}
    results = probe(Manifest(table, small_manifest.root), split, **options)
    noted = (n for s in results for n in s.notes if n.code == "encoder-license")
    notes = {n.params["modality"]: n for n in noted}
    assert notes.keys() == {"vision", "text"}
    assert "whose license is mit" in sentence(notes["vision"])
    seen = Manifest(table, small_manifest.root, {"dataset": "HCT"})
    fails("images of HCT, with which its authors trained it", probe, seen, split, **options)
    assert Encoder.from_pretrained("palpate/mini", modality="text").license == "apache-2.0"
