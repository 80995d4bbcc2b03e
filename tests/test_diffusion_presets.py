"""Each preset of a generator takes a real step and samples; a trained U-Net goes on."""

import json
import shutil
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from diffusers import UNet2DConditionModel
from safetensors import safe_open

from forge.errors import fails
from palpate.cli import main
from palpate.core import PalpateError
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.denoiser import build_scheduler, sample, starting_noise
from palpate.diffusion.denoiser_training import Rows, train_denoiser
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import MINI, PAPER, SMALL
from palpate.diffusion.training import train_generator
from palpate.diffusion.unet import load_unet
from palpate.training.run import TrainingRun
from test_training_presets import memory

#: Weights, gradient, two moments, average; what a checkpoint copies; activations: of ``paper``.
MEMORY = 17e9
UNET = {"attention_head_dim": 8, "cross_attention_dim": 128, "sample_size": 16}


def write_unet(folder, **changes):
    """A tiny generator of diffusers with its U-Net, for latents of a VQ autoencoder."""
    torch.manual_seed(0)
    widths = {"block_out_channels": (32, 32, 64, 64), "layers_per_block": 1}
    shape = {"in_channels": 3, "out_channels": 3}
    unet = UNet2DConditionModel(**UNET | widths | shape | changes)
    unet.save_pretrained(folder / "unet")
    (folder / "model_index.json").write_text("{}")
    return unet


def step_and_sample(preset, folder, channels):
    """One step of a batch of 2 with checkpoint and average, then one step of the sampler."""
    side, width = preset.size // 4, preset.condition.width
    torch.manual_seed(0)
    both = {s: torch.randn(2, width) for s in ("text", "vision")}
    stats = LatentStats((0.0,) * channels, (1.0,) * channels, preset.latent_scale)
    rows = Rows(torch.randn(2, channels, side, side), both)
    short = replace(preset, loop=replace(preset.loop, steps=1, batch=2))
    model = train_denoiser(rows, short, stats, TrainingRun(folder))
    with safe_open(folder / "checkpoint.safetensors", "pt") as file:
        names = file.keys()
        kinds = {name.split(".")[0] for name in names}
        assert file.metadata()["step"] == "1"
    assert kinds >= {"model", "ema", "exp_avg", "exp_avg_sq"}
    shutil.rmtree(folder)  # gigabytes
    options = replace(preset.sampler, steps=1, batch=1)
    noise = starting_noise(["a"], (channels, side, side), 0)
    scheduler = build_scheduler(preset.schedule, options.method)
    made = sample(model, model.condition(both["vision"][:1]), noise, options, scheduler)
    assert made.shape == (1, channels, side, side)
    assert torch.isfinite(made).all()


@pytest.mark.nightly
@pytest.mark.parametrize(("preset", "channels"), [(SMALL, 8), (PAPER, 3)])
def test_a_preset_takes_a_real_step(preset, channels, tmp_path):
    with memory(MEMORY) if preset is PAPER else nullcontext():
        step_and_sample(preset, tmp_path / "run", channels)


def test_a_trained_unet_goes_on_from_its_folder(tag, tmp_path, capsys):
    start = write_unet(tmp_path / "ldm")
    command = ["train", "generator", "tag", "--split", "split.json", "--preset", "tiny"]
    small = ["--clip", "palpate/mini", "--set", "size=64", "unet=ldm", "loop.warmup=500"]
    assert main([*command, *small, "--steps", "1", "-o", "model", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 1
    pipeline = TactilePipeline.from_pretrained(tmp_path / "model", device="cpu")
    assert pipeline.training["unet"] == {"source": "ldm"}
    # It has gone on from these weights, a first step of the warm-up far.
    weights = start.requires_grad_(False).parameters()
    pairs = [*zip(weights, pipeline.unet.parameters(), strict=True)]
    assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-5
    assert any(not torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"out_channels": 8, "in_channels": 8}, "`autoencoder` must have 8 latent channels"),
        ({"cross_attention_dim": 32}, "`clip` must give embeddings of width 32"),
        ({"in_channels": 9}, "`unet` must see latents and tokens alone"),
    ],
)
def test_a_trained_unet_of_other_latents_or_tokens_is_rejected(tmp_path, changes, message):
    write_unet(tmp_path / "ldm", **changes)
    fails(message, load_unet, tmp_path / "ldm", ConditionPolicy(width=128), channels=3)


def test_what_is_no_trained_unet_is_rejected(tag, tmp_path):
    for unet, message in (
        ("nowhere", "no folder nowhere"),
        (tmp_path / "tag", "must hold a U-Net of diffusers"),
    ):
        preset = replace(MINI, unet=str(unet))
        with pytest.raises(PalpateError, match=message):
            train_generator(*tag, "palpate/mini", autoencoder="palpate/mini", preset=preset)
