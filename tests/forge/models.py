"""Untrained models: pipelines, encoders, and weights in the formats that others publish."""

from __future__ import annotations

import atexit
import copy
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d, group_norm, interpolate, pad, silu

from palpate.data.images import Preprocess
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.autoencoder_training import build_autoencoder
from palpate.diffusion.denoiser import Denoiser
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import TINY
from palpate.diffusion.unet import build_unet
from palpate.encoders import models
from palpate.encoders.contrastive import new_clip
from palpate.encoders.encoder_set import EncoderSet, new_tactile
from palpate.encoders.presets import TINY as TINY_ENCODERS
from palpate.training.cards import write_model_cards

# --- a pipeline whose vision encoder is a few lines of arithmetic


class StandInEncoders:
    """A vision encoder that embeds a photo's mean color and contrast: 6 numbers, normalized."""

    dim, device = 6, torch.device("cpu")

    class _Preprocess:
        resize = 16

        def fit(self, images):
            return images

        def __call__(self, x):
            return x - 0.5

    def preprocess(self, modality):
        assert modality == "vision"
        return self._Preprocess()

    def encode(self, modality, pixels):
        values = torch.cat([pixels.mean((2, 3)), pixels.std((2, 3))], dim=1)
        return torch.nn.functional.normalize(values, dim=1)

    def digest(self, modality):
        return f"stand-in {modality}"

    def to(self, device):
        return self


def make_pipeline(
    *, background: bool = False, policy: ConditionPolicy | None = None, width: int = 6
) -> TactilePipeline:
    """An untrained pipeline of 32 px tactile images."""
    torch.manual_seed(0)
    assert TINY.autoencoder is not None
    policy = policy or TINY.condition_for(width)
    unet = build_unet(TINY.unet, policy, channels=3, size=8, background=3 if background else 0)
    # Make the condition matter in an untrained network.
    for name, p in unet.named_parameters():
        if "attn2" in name:
            p.data.mul_(4)
    return TactilePipeline(
        build_autoencoder(TINY.autoencoder).eval(),
        Denoiser(unet, policy).eval(),
        LatentStats((0.1, 0.0, -0.1), (0.5, 0.6, 0.7)),
        TINY.schedule,
        TINY.sampler,
        32,
        encoders=StandInEncoders(),
        preset="tiny",
        training={"steps": 0, "split": None},
    )


def arrays(images) -> np.ndarray:
    """The images of a pipeline's output as one array."""
    return np.stack([np.asarray(image) for image in images.images])


# --- models in the layout of the shipped ones


WORLD = [{"world": "made up", "seeds": "900000-900003", "version": 2, "frames": 12}]


def make_encoders(seed: int = 0) -> EncoderSet:
    """Untrained encoders of the preset tiny."""
    clip = new_clip(TINY_ENCODERS, ["a rough wall", "a soft cloth", "smooth cold metal"], seed=seed)
    tactile = new_tactile(TINY_ENCODERS.tactile_config(clip.dim), seed + 1).eval()
    preprocess = Preprocess(16, 16, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4))
    card = {"title": "Encoders", "data": WORLD}
    shape = {"tactile": preprocess}
    return clip.with_tactile(EncoderSet(tactile=tactile, preprocesses=shape, card=card))


def write_shipped(root: Path, monkeypatch) -> TactilePipeline:
    """Write ``root/mini``, make ``palpate/mini`` refer to it, and return the generator."""
    folder, pipeline = _shipped()
    shutil.copytree(folder, root, dirs_exist_ok=True)
    monkeypatch.setattr(models, "shipped_root", lambda: root)
    return copy.deepcopy(pipeline)


@cache
def _shipped() -> tuple[str, TactilePipeline]:
    """A folder like that of the package, written once a process, and its generator."""
    folder = TemporaryDirectory(prefix="palpate-shipped-")
    atexit.register(folder.cleanup)
    with pytest.MonkeyPatch.context() as patch:
        return folder.name, _build(Path(folder.name), patch)


def _build(root: Path, monkeypatch) -> TactilePipeline:
    monkeypatch.setattr(models, "shipped_root", lambda: root)
    encoders = make_encoders()
    encoders.save(root / "mini" / "encoders", half=True)
    made = make_pipeline(width=encoders.dim)
    made.autoencoder.card = {"data": WORLD, "scores": [{"score": "PSNR", "value": 12.5}]}
    made.autoencoder.save(root / "mini" / "autoencoder", half=True)
    training = {"synthetic": True, "materials": ["Wood", "Brick"], "data": WORLD, "split": None}
    pipeline = replace(made, encoders=encoders.without_tactile(), training=training)
    pipeline.save(root / "mini" / "generator", half=True, shared="palpate/mini")
    write_model_cards(root / "mini")
    return pipeline


# --- LPIPS in its published files


SHAPES = {
    0: (64, 3, 11, 11),
    3: (192, 64, 5, 5),
    6: (384, 192, 3, 3),
    8: (256, 384, 3, 3),
    10: (256, 256, 3, 3),
}


def random_states() -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Weights of backbone and heads by the names that torchvision and LPIPS v0.1 give them."""
    draw = torch.Generator().manual_seed(0)
    backbone = {"classifier.1.weight": torch.zeros(2, 2)}
    heads = {}
    for k, (place, shape) in enumerate(SHAPES.items()):
        fan = shape[1] * shape[2] * shape[3]
        backbone[f"features.{place}.weight"] = torch.randn(shape, generator=draw) * (2 / fan) ** 0.5
        backbone[f"features.{place}.bias"] = 0.1 * torch.randn(shape[0], generator=draw)
        heads[f"lin{k}.model.1.weight"] = torch.rand((1, shape[0], 1, 1), generator=draw)
    return backbone, heads


def save_states(
    states: tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]], folder: Path
) -> tuple[Path, Path]:
    """Backbone and heads as files."""
    places = folder / "alexnet-owt-7be5be79.pth", folder / "alex.pth"
    torch.save(states[0], places[0])
    torch.save(
        states[1], places[1], _use_new_zipfile_serialization=False
    )  # the published file is of the old format
    return places


# --- autoencoders by the names of latent diffusion, and their forward pass in a few lines
# Written from the published architecture (ldm/modules/diffusionmodules/model.py): GroupNorm of 32
# groups (eps 1e-6), swish, residual blocks, one attention of one head in the middle, downsampling
# with padding (0, 1, 0, 1), nearest upsampling; `decoder.up.0` is the finest level.


State = dict[str, Tensor]
VQ_F4 = {"mult": (1, 2, 4), "z": 3, "codes": 64}


def make_state(
    mult: tuple[int, ...], z: int, codes: int, *, middle: bool = True, levels: tuple = ()
) -> State:
    """Random weights of a model of 32 channels with two blocks a level; `levels` attend as well."""
    rng, state = torch.Generator().manual_seed(0), {}
    widths = [32 * m for m in mult]

    def weight(name: str, out: int, into: int, side: int) -> None:
        scale = (into * side**2) ** -0.5
        state[f"{name}.weight"] = scale * torch.randn(out, into, side, side, generator=rng)
        state[f"{name}.bias"] = 0.1 * torch.randn(out, generator=rng)

    def norm(name: str, width: int) -> None:
        state[f"{name}.weight"] = 1 + 0.1 * torch.randn(width, generator=rng)
        state[f"{name}.bias"] = 0.1 * torch.randn(width, generator=rng)

    def block(name: str, into: int, out: int) -> None:
        norm(f"{name}.norm1", into)
        weight(f"{name}.conv1", out, into, 3)
        norm(f"{name}.norm2", out)
        weight(f"{name}.conv2", out, out, 3)
        if into != out:
            weight(f"{name}.nin_shortcut", out, into, 1)

    def attention(name: str, width: int) -> None:
        norm(f"{name}.norm", width)
        for part in ("q", "k", "v", "proj_out"):
            weight(f"{name}.{part}", width, width, 1)

    def mid(name: str, width: int) -> None:
        block(f"{name}.block_1", width, width)
        if middle:
            attention(f"{name}.attn_1", width)
        block(f"{name}.block_2", width, width)

    weight("encoder.conv_in", 32, 3, 3)
    before = 32
    for i, width in enumerate(widths):
        for j in range(2):
            block(f"encoder.down.{i}.block.{j}", before, width)
            if i in levels:
                attention(f"encoder.down.{i}.attn.{j}", width)
            before = width
        if i < len(widths) - 1:
            weight(f"encoder.down.{i}.downsample.conv", width, width, 3)
    mid("encoder.mid", before)
    norm("encoder.norm_out", before)
    weight("encoder.conv_out", z, before, 3)
    weight("quant_conv", z, z, 1)
    state["quantize.embedding.weight"] = torch.randn(codes, z, generator=rng)
    weight("post_quant_conv", z, z, 1)
    weight("decoder.conv_in", before, z, 3)
    mid("decoder.mid", before)
    for i in reversed(range(len(widths))):
        for j in range(3):
            block(f"decoder.up.{i}.block.{j}", before, widths[i])
            if i in levels:
                attention(f"decoder.up.{i}.attn.{j}", widths[i])
            before = widths[i]
        if i:
            weight(f"decoder.up.{i}.upsample.conv", before, before, 3)
    norm("decoder.norm_out", before)
    weight("decoder.conv_out", 3, before, 3)
    return state


def encode(state: State, x: Tensor) -> Tensor:
    """What `quant_conv` gives: latents before quantization."""
    x = _conv(state, "encoder.conv_in", x)
    for i in range(_levels(state)):
        for j in range(2):
            x = _block(state, f"encoder.down.{i}.block.{j}", x)
            x = _attention(state, f"encoder.down.{i}.attn.{j}", x)
        down = f"encoder.down.{i}.downsample.conv"
        if f"{down}.weight" in state:
            x = conv2d(pad(x, (0, 1, 0, 1)), state[f"{down}.weight"], state[f"{down}.bias"], 2)
    x = silu(_norm(state, "encoder.norm_out", _middle(state, "encoder.mid", x)))
    return _conv(state, "quant_conv", _conv(state, "encoder.conv_out", x))


def decode(state: State, z: Tensor) -> Tensor:
    """The image of latents; they are replaced by the nearest code first."""
    codes = state["quantize.embedding.weight"]
    flat = z.permute(0, 2, 3, 1)
    nearest = (flat[..., None, :] - codes).square().sum(-1).argmin(-1)
    z = codes[nearest].permute(0, 3, 1, 2)
    x = _conv(state, "decoder.conv_in", _conv(state, "post_quant_conv", z))
    x = _middle(state, "decoder.mid", x)
    for i in reversed(range(_levels(state))):
        for j in range(3):
            x = _block(state, f"decoder.up.{i}.block.{j}", x)
            x = _attention(state, f"decoder.up.{i}.attn.{j}", x)
        if i:
            x = interpolate(x, scale_factor=2.0, mode="nearest")
            x = _conv(state, f"decoder.up.{i}.upsample.conv", x)
    return _conv(state, "decoder.conv_out", silu(_norm(state, "decoder.norm_out", x)))


def _levels(state: State) -> int:
    return 1 + max(int(name.split(".")[2]) for name in state if name.startswith("encoder.down."))


def _conv(state: State, name: str, x: Tensor) -> Tensor:
    weight = state[f"{name}.weight"]
    return conv2d(x, weight, state[f"{name}.bias"], padding=weight.shape[-1] // 2)


def _norm(state: State, name: str, x: Tensor) -> Tensor:
    return group_norm(x, 32, state[f"{name}.weight"], state[f"{name}.bias"], eps=1e-6)


def _block(state: State, name: str, x: Tensor) -> Tensor:
    h = _conv(state, f"{name}.conv1", silu(_norm(state, f"{name}.norm1", x)))
    h = _conv(state, f"{name}.conv2", silu(_norm(state, f"{name}.norm2", h)))
    short = f"{name}.nin_shortcut"
    return h + (_conv(state, short, x) if f"{short}.weight" in state else x)


def _attention(state: State, name: str, x: Tensor) -> Tensor:
    if f"{name}.q.weight" not in state:
        return x
    h = _norm(state, f"{name}.norm", x)
    q, k, v = (_conv(state, f"{name}.{part}", h).flatten(2) for part in "qkv")
    share = torch.softmax(q.transpose(1, 2) @ k * q.shape[1] ** -0.5, dim=2)
    return x + _conv(state, f"{name}.proj_out", (v @ share.transpose(1, 2)).reshape(x.shape))


def _middle(state: State, name: str, x: Tensor) -> Tensor:
    x = _attention(state, f"{name}.attn_1", _block(state, f"{name}.block_1", x))
    return _block(state, f"{name}.block_2", x)
