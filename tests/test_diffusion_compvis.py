"""Autoencoders of others: files of latent diffusion, and folders of whole generators."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, VQModel
from safetensors.torch import save_file

import palpate as pp
from forge.errors import Bomb, fails
from forge.models import VQ_F4, decode, encode, make_encoders, make_state
from forge.pictures import photos
from forge.worlds import by_video
from palpate.cli import main
from palpate.core import PalpateError
from palpate.diffusion.autoencoder import load_autoencoder, to_bytes
from palpate.diffusion.presets import PAPER, TINY
from palpate.encoders.models import to_unit


def small_vq(**options):
    torch.manual_seed(0)
    return VQModel(
        block_out_channels=(8,), norm_num_groups=4, num_vq_embeddings=16, **options
    ).eval()


def write(path, state, **others):
    """A checkpoint as PyTorch Lightning 1.4 writes it: the key of a callback is its class."""
    torch.save({"state_dict": state, "epoch": 3, "global_step": 7, **others}, path)
    return path


# --- the published architectures ---------------------------------------------------------------


@pytest.mark.parametrize(
    "shape",
    [
        VQ_F4,
        VQ_F4 | {"middle": False},  # vq-f4-noattn
        VQ_F4 | {"levels": (2,)},  # vq-f8 and f16 attend at some levels
    ],
)
def test_a_file_computes_what_the_published_architecture_computes(tmp_path, shape):
    state = make_state(**shape)
    loss = {"loss.discriminator.main.0.weight": torch.zeros(3), "loss.logvar": torch.zeros(())}
    model = load_autoencoder(write(tmp_path / "model.ckpt", state | loss))
    assert (model.factor, model.channels) == (2 ** (len(shape["mult"]) - 1), shape["z"])
    # In double precision: float32 adds rounding of 1e-5 where values are large.
    model, x = model.double(), to_unit(photos(2, 32), signed=True).double()
    state = {name: value.double() for name, value in state.items()}
    with torch.no_grad():
        z = model.latents(x)
        assert torch.allclose(z, encode(state, x), atol=1e-5, rtol=0)
        assert torch.allclose(model.image(z)[0], decode(state, z), atol=1e-5, rtol=0)
        assert np.array_equal(model.decode(z), to_bytes(model.image(z)[0]))


def test_a_whole_checkpoint_and_safetensors_give_the_same_model(tmp_path):
    state = make_state(**VQ_F4)
    alone = load_autoencoder(write(tmp_path / "alone.ckpt", state))
    whole = {f"first_stage_model.{name}": value for name, value in state.items()}
    whole |= {"model.diffusion_model.out.2.bias": torch.zeros(4), "betas": torch.zeros(10)}
    save_file({k: v.contiguous() for k, v in whole.items()}, tmp_path / "whole.safetensors")
    again = load_autoencoder(str(tmp_path / "whole.safetensors"))
    assert again.digest == alone.digest
    halves = {name: value.half() for name, value in state.items()}
    half = load_autoencoder(write(tmp_path / "half.ckpt", halves))
    assert {p.dtype for p in half.parameters()} == {torch.float32}


def test_a_file_that_names_lightnings_callback_is_read(tmp_path, monkeypatch):
    """`sd-v1-4.ckpt` and `vq-f4` key the state of a callback by its class."""
    import sys
    from types import ModuleType

    name = "pytorch_lightning.callbacks.model_checkpoint"
    for part in ("pytorch_lightning", "pytorch_lightning.callbacks", name):
        monkeypatch.setitem(sys.modules, part, ModuleType(part))
    callback = type("ModelCheckpoint", (), {"__module__": name})
    sys.modules[name].ModelCheckpoint = callback
    state = make_state(**VQ_F4)
    path = write(tmp_path / "model.ckpt", state, callbacks={callback: {"monitor": "val/rec_loss"}})
    monkeypatch.undo()
    assert load_autoencoder(path).digest == load_autoencoder(write(tmp_path / "b", state)).digest


def test_what_is_saved_is_a_diffusers_model_that_names_its_file(tmp_path):
    path = write(tmp_path / "vq-f4.ckpt", make_state(**VQ_F4))
    model = load_autoencoder(path)
    model.save(tmp_path / "saved")
    again = load_autoencoder(tmp_path / "saved")
    assert again.digest == model.digest
    assert np.array_equal(again.encode(photos(2, 32)), model.encode(photos(2, 32)))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert again.card["source"] == {"file": "vq-f4.ckpt", "sha256": digest}
    page = (tmp_path / "saved" / "README.md").read_text()
    assert digest in page
    assert "license: unknown" in page
    theirs = VQModel.from_pretrained(tmp_path / "saved").eval()
    with torch.no_grad():
        x = to_unit(photos(2, 32), signed=True)
        assert torch.equal(theirs.encode(x).latents, model.latents(x))


# --- files that do not fit ---------------------------------------------------------------------


def without(name):
    return lambda state: {k: v for k, v in state.items() if k != name}


def swapped(one, other):
    return lambda state: state | {one: state[other], other: state[one]}


def renamed(old, new):
    return lambda state: {k.replace(old, new): v for k, v in state.items()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("encoder.mid.attn_1.q.weight"), r"1 missing: encoder\.mid\.attn_1\.q\.weight"),
        (without("quantize.embedding.weight"), r"no weight quantize\.embedding\.weight"),
        (without("encoder.conv_in.weight"), r"no weight encoder\.conv_in\.weight"),
        (without("post_quant_conv.bias"), r"1 missing: post_quant_conv\.bias"),
        (without("encoder.down.1.block.0.conv1.weight"), "no weight encoder.down.1.block.0.conv1"),
        (lambda s: s | {"encoder.new": torch.zeros(1)}, r"1 not part of it: encoder\.new"),
        (
            swapped("decoder.up.1.block.2.conv1.weight", "decoder.up.0.block.2.conv1.weight"),
            r"2 of another shape: decoder\.up\.\d\.block\.2\.conv1\.weight \(",
        ),
        (renamed("decoder.up.0.", "decoder.up.7."), "missing: decoder.up.0.*; .*not part of it"),
        (renamed("encoder.down", "encoder.down_blocks"), "Pass the folder with its config.json"),
        (
            lambda s: s | {"encoder.down.0.block.0.conv1.weight": torch.zeros(33, 32, 3, 3)},
            "multiples of 32. Got 33",
        ),
        (lambda s: s | {"encoder.conv_in.weight": torch.zeros(32, 4, 3, 3)}, "3 channels in and"),
        (lambda s: {}, r"no weight encoder\.down\.0"),
    ],
)
def test_weights_that_do_not_fit_are_named(tmp_path, change, message):
    path = write(tmp_path / "x.ckpt", change(make_state(**VQ_F4)))
    fails(message, load_autoencoder, path)


def test_files_that_are_no_plain_weights_are_rejected(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    state = make_state(**VQ_F4)
    good = write(tmp_path / "good.ckpt", state).read_bytes()
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n"
    torch.save({"state_dict": state, "x": Bomb()}, "evil.ckpt")
    for name, content, message in (
        ("evil.ckpt", None, "could run any program. Save its state_dict as .safetensors"),
        ("cut.ckpt", good[: len(good) // 2], "cut.ckpt must hold weights"),
        ("cut.safetensors", good[:100], "cut.safetensors must hold weights"),
        ("empty.ckpt", b"", "empty.ckpt must hold weights"),
        ("photo.jpg", b"\xff\xd8\xff\xe0 photo", "nothing else. Got a file of another kind"),
        ("pointer.ckpt", pointer, r"pointer of Git LFS .* git lfs pull"),
        ("pointer.safetensors", pointer, r"pointer of Git LFS .* git lfs pull"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        fails(message, load_autoencoder, name)
    fails(r"no folder missing\. Name a .*\.ckpt of latent", load_autoencoder, "missing")


# --- diffusers folders -------------------------------------------------------------------------


def test_folders_of_other_models_are_rejected(tmp_path):
    AutoencoderKL(block_out_channels=(32,)).save_pretrained(tmp_path / "kl")
    small_vq().save_pretrained(tmp_path / "pointer")
    (weights,) = (tmp_path / "pointer").glob("*.safetensors")
    weights.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    small_vq().save_pretrained(tmp_path / "cut")
    (weights,) = (tmp_path / "cut").glob("*.safetensors")
    weights.write_bytes(weights.read_bytes()[:100])
    small_vq(in_channels=1, out_channels=1).save_pretrained(tmp_path / "gray")
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "config.json").write_text("{")
    for name, message in (
        ("kl", "diffusers VQModel, or of palpate. Got AutoencoderKL"),
        ("pointer", r"pointer of Git LFS .* git lfs pull"),
        ("cut", "diffusers VQModel"),
        ("gray", "3 channels in and out. Got 1 and 1"),
        ("empty", "Got no model in config.json"),
        ("text", r"config\.json"),
    ):
        fails(message, load_autoencoder, tmp_path / name)


# --- in a generator ----------------------------------------------------------------------------


def test_an_autoencoder_that_does_not_fit_the_preset_is_rejected(small_manifest, tmp_path):
    data, encoders = (small_manifest, by_video(small_manifest)), make_encoders()
    path = write(tmp_path / "f64.ckpt", make_state((1,) * 7, 4, 16))
    with pytest.raises(PalpateError, match=r"`autoencoder` must reduce images of 32 .* Got 64"):
        pp.train_generator(*data, encoders, preset=TINY, autoencoder=path)


@pytest.mark.slow
def test_the_papers_preset_runs_on_a_file(tag, tmp_path):
    write(tmp_path / "tiny-vq-f4.ckpt", make_state(**VQ_F4))
    (manifest, split), encoders = tag, make_encoders()
    unet = replace(PAPER.unet, widths=(32, 32, 64, 64), head_width=16, groups=16)
    tiny = replace(PAPER, size=32, unet=unet, epochs=1, loop=replace(PAPER.loop, batch=8))
    tiny = replace(tiny, sampler=replace(PAPER.sampler, steps=4))
    common = {"preset": tiny, "autoencoder": "tiny-vq-f4.ckpt", "device": "cpu"}
    made = pp.train_generator(manifest, split, encoders, output="model", **common)
    pipeline = pp.TactilePipeline.from_pretrained("model", device="cpu")
    assert pipeline.digest == made.digest
    assert pipeline.autoencoder.card["source"]["file"] == "tiny-vq-f4.ckpt"
    assert pipeline.stats.scale == "one"
    side = 32 // pipeline.autoencoder.factor
    assert pipeline.denoiser.unet.config["sample_size"] == side
    about = json.loads((tmp_path / "model" / "autoencoder" / "config.json").read_text())
    assert about["_class_name"] == type(made.autoencoder.net).__name__
    generated = pp.generate(manifest, split=split, model=pipeline, output="out")
    assert len(generated.ids) == len(split.ids("test"))
    encoders.save(tmp_path / "encoders")
    quick = {"presets": ["paper"], "permutations": 0, "companions": []}
    results = pp.score("out", manifest, encoder="encoders", split=split, **quick)
    assert any(score.metric == "TMMD" for score in results)
    # The command line takes the file as well; its preset is too large for this test.
    options = ["--clip", "encoders", "--autoencoder", "tiny-vq-f4.ckpt", "--steps", "1"]
    command = ["train", "generator", "tag", "--split", "split.json", "--preset", "tiny"]
    assert main([*command, *options, "-o", "small"]) == 0
    small = pp.TactilePipeline.from_pretrained("small", device="cpu")
    assert small.autoencoder.digest == pipeline.autoencoder.digest
