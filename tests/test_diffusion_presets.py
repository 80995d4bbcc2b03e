"""Each preset of a generator takes a real step and samples; Stable Diffusion's parts go on."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from PIL import Image
from safetensors import safe_open

from palpate.cli import main
from palpate.core import PalpateError, Split
from palpate.diffusion.autoencoder import Autoencoder, LatentStats
from palpate.diffusion.denoiser import Denoiser, lengths_of, load_unet
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline, sample
from palpate.diffusion.presets import PAPER, SD15, SMALL
from palpate.diffusion.training import plan_generator, train_denoiser, train_generator
from test_training_presets import memory, write_clip

#: Weights, gradient, two moments, average; what a checkpoint copies; activations: of ``paper``.
MEMORY = 17e9
SD_UNET = {"attention_head_dim": 8, "cross_attention_dim": 768, "sample_size": 64}


@pytest.fixture
def tag(small_manifest, tmp_path, monkeypatch):
    """A data set and a split of it by video, saved in the working directory."""
    monkeypatch.chdir(tmp_path)
    train = [i for i in small_manifest.ids if i < "v4"]
    test = [i for i in small_manifest.ids if i not in train]
    split = Split.from_ids(train=train, test=test, manifest=small_manifest.digest)
    small_manifest.save(tmp_path / "tag" / "manifest.parquet")
    split.save(tmp_path / "split.json")
    return small_manifest, split


def write_sd(folder, **changes):
    """A tiny generator in the layout, with the names and the settings of Stable Diffusion 1.5."""
    torch.manual_seed(0)
    widths = {"block_out_channels": (32, 32, 64, 64), "layers_per_block": 1}
    unet = UNet2DConditionModel(**SD_UNET | widths | changes)
    unet.save_pretrained(folder / "unet")
    AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=(32,) * 4,
    ).save_pretrained(folder / "vae")
    (folder / "model_index.json").write_text("{}")
    (folder / "README.md").write_text("---\nlicense: creativeml-openrail-m\n---\n")
    return unet


def step_and_sample(preset, folder, channels):
    """One step of a batch of 2 with checkpoint and average, then one step of the sampler."""
    side, width = preset.size // 4, preset.condition.width
    torch.manual_seed(0)
    both = {s: torch.randn(2, width) for s in ("text", "vision")}
    model = train_denoiser(
        torch.randn(2, channels, side, side),
        both,
        stats=LatentStats((0.0,) * channels, (1.0,) * channels, preset.latent_scale),
        unet=preset.unet,
        policy=preset.condition,
        schedule=preset.schedule,
        loop=replace(preset.loop, steps=1, batch=2),
        folder=folder,
    )
    with safe_open(folder / "checkpoint.safetensors", "pt") as file:
        names = file.keys()
        kinds = {name.split(".")[0] for name in names}
        assert file.metadata()["step"] == "1"
    assert kinds >= {"model", "ema", "exp_avg", "exp_avg_sq"}
    shutil.rmtree(folder)  # gigabytes
    options = replace(preset.sampler, steps=1, batch=1)
    made = sample(
        model,
        model.condition(both["vision"][:1]),
        model.null_tokens(1),
        ["a"],
        shape=(channels, side, side),
        schedule=preset.schedule,
        options=options,
        seed=0,
    )
    assert made.shape == (1, channels, side, side)
    assert torch.isfinite(made).all()
    return model


@pytest.mark.slow
def test_small_takes_a_real_step(tmp_path):
    model = step_and_sample(SMALL, tmp_path / "run", 8)
    assert 63e6 < sum(p.numel() for p in model.unet.parameters()) < 65e6


@pytest.mark.slow
def test_paper_takes_a_real_step(tmp_path):
    with memory(MEMORY):
        model = step_and_sample(PAPER, tmp_path / "run", 3)
    assert round(sum(p.numel() for p in model.unet.parameters()) / 1e6, 1) == 406.3


@pytest.mark.slow
def test_sd15_goes_on_from_a_folder_by_text_and_by_photo(tag, tmp_path, capsys):
    start = write_sd(tmp_path / "sd")
    write_clip(tmp_path / "clip")
    command = ["train", "generator", "tag", "--split", "split.json", "--preset", "sd15"]
    small = ["--size", "64", "--batch-size", "4", "--steps", "1", "--sampler-steps", "2"]
    given = ["--unet", "sd", "--clip", "clip"]
    assert main([*command, *small, *given, "-o", "model", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 1
    pipeline = TactilePipeline.from_pretrained(tmp_path / "model", device="cpu")
    known = {"source": "sd", "license": "creativeml-openrail-m"}
    assert pipeline.training["unet"] == known
    assert pipeline.autoencoder.digest == Autoencoder.load(tmp_path / "sd").digest
    assert (pipeline.stats.scale, lengths_of(pipeline.denoiser.policy)) == ("one", (1, 77))
    # It has gone on from these weights, a first step of the warm-up far.
    weights = start.requires_grad_(False).parameters()
    pairs = [*zip(weights, pipeline.unet.parameters(), strict=True)]
    assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-5
    assert any(not torch.equal(a, b) for a, b in pairs)
    # A text drives it by its words, which enter as Stable Diffusion's text encoder gives them.
    clip = pipeline.encoders.clip
    text = pipeline.embed_text("rough stone")[0]
    ids = clip.tokenizer(["rough stone"], padding="max_length", max_length=77)["input_ids"]
    with torch.no_grad():
        states = clip.model.text_model(torch.tensor(ids)).last_hidden_state[0]
        states = pipeline.denoiser.maps["words"](states)
    assert torch.allclose(text[1:], states, atol=1e-5)
    assert main(["generate", "--text", "rough stone", "--model", "model", "-o", "text.png"]) == 0
    photo = str(tag[0].paths("vision")[0])
    assert main(["generate", photo, "--model", "model", "-o", "photo.png"]) == 0
    images = [np.asarray(Image.open(f"{name}.png")) for name in ("text", "photo")]
    assert images[0].shape == (64, 64, 3)
    assert not np.array_equal(*images)


def test_a_trained_unet_sees_the_gel_without_effect_at_first(tmp_path):
    write_sd(tmp_path / "sd")
    policy = replace(SD15.condition, words=0)
    plain, wide = (
        Denoiser(load_unet(tmp_path / "sd", policy, channels=4, background=n), policy).eval()
        for n in (0, 4)
    )
    assert (plain.background, wide.background) == (False, True)
    x, t = torch.randn(1, 4, 8, 8), torch.tensor([500])
    tokens = plain.tokens(torch.randn(1, 768), "text")
    with torch.no_grad():
        made = [plain(x, t, tokens), wide(x, t, tokens, torch.randn(1, 4, 8, 8))]
    assert torch.allclose(*made, atol=1e-5)
    assert all(p.requires_grad for p in wide.unet.parameters())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"out_channels": 8, "in_channels": 8}, "`autoencoder` must have 8 latent channels"),
        ({"cross_attention_dim": 32}, "`clip` must give embeddings of width 32"),
        ({"in_channels": 9}, "`unet` must see latents and tokens alone"),
    ],
)
def test_a_trained_unet_of_other_latents_or_tokens_is_rejected(tmp_path, changes, message):
    write_sd(tmp_path / "sd", **changes)
    with pytest.raises(PalpateError, match=message):
        load_unet(tmp_path / "sd", ConditionPolicy(width=768), channels=4)


def test_what_a_preset_is_given_must_be_given(tag, tmp_path):
    for options, message in (
        ({}, "`unet` must be given for the preset sd15"),
        ({"unet": "nowhere"}, "no folder nowhere"),
        ({"unet": tmp_path / "tag"}, "must hold a U-Net of diffusers"),
    ):
        with pytest.raises(PalpateError, match=message):
            train_generator(
                *tag, "palpate/mini", preset="sd15", autoencoder="palpate/mini", **options
            )
    write_sd(tmp_path / "sd")
    plan = plan_generator(*tag, preset=replace(SD15, size=64), unet=tmp_path / "sd", steps=3)
    unet = UNet2DConditionModel.from_pretrained(tmp_path / "sd" / "unet")
    assert plan["parameters"] == sum(p.numel() for p in unet.parameters())
    assert plan["steps"] == 3
