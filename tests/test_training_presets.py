"""Each preset takes a real step; the paper's from training to the probe; what a plan counts."""

import json
import shutil
import tempfile
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import torch
from filelock import FileLock
from torch import nn
from transformers import CLIPConfig, CLIPModel

from forge.worlds import by_video
from palpate.cli import main
from palpate.data.images import Preprocess
from palpate.encoders.contrastive import new_clip, plan_encoder, train_tactile
from palpate.encoders.encoder_set import EncoderSet, new_tactile
from palpate.encoders.presets import preset_of
from palpate.encoders.tokenizer import train_tokenizer
from palpate.training.options import Compute, LoopOptions
from palpate.training.run import TrainingRun, estimate

WORDS = ["rough, hard", "soft, warm", "smooth, cold"]
MEMORY = 14e9  # of the largest: weights, gradient, moments, their copies for the checkpoint


@pytest.fixture
def split(small_manifest):
    """Four videos of three materials to train on, two to test."""
    return by_video(small_manifest)


#: Take a minute or 15 GB; `paper` of the generator takes its step in test_diffusion_presets.
HEAVY = [pytest.param(name, marks=pytest.mark.nightly) for name in ("tvl-base", "paper")]


@contextmanager
def memory(needed):
    """Skip without so much of it available; tests of other processes that need as much wait."""
    with FileLock(Path(tempfile.gettempdir()) / "palpate-memory.lock"):
        if psutil.virtual_memory().available < needed:
            pytest.skip(f"needs {needed / 1e9:.0f} GB of memory")
        yield


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini", "tvl-tiny", "tvl-small", *HEAVY])
def test_a_preset_takes_a_real_step_of_what_its_plan_says(name, small_manifest, split, tmp_path):
    """With all its layers and pixels, on two samples, one at a time (cached gradients)."""
    chosen = preset_of(name)
    partners = new_clip(replace(preset_of("tiny"), dim=chosen.dim), WORDS, seed=0)
    chosen = replace(chosen, tactile_course=replace(chosen.tactile_course, batch=2, epochs=1e-9))
    run = TrainingRun(tmp_path / "run", device="cpu", compute=Compute(chunk=1))
    with memory(MEMORY) if name == "paper" else nullcontext():
        encoders = train_tactile(small_manifest, split, partners, chosen, run)
    shutil.rmtree(tmp_path / "run")  # gigabytes
    plan = plan_encoder(small_manifest, split, preset="tiny")
    assert plan["train_samples"] == encoders.card["train_samples"]
    assert encoders.card["steps"] == 1
    (line,) = encoders.card["loss"]
    assert 0 < line["loss"] < 10
    assert encoders.tactile is not None
    start = new_tactile(chosen.tactile_config(chosen.dim), 0).state_dict()
    moved = encoders.tactile.state_dict()
    assert start.keys() == moved.keys()
    still = [k for k in start if torch.equal(start[k], moved[k])]
    assert all("position_ids" in k or "k_proj.bias" in k for k in still)


def write_clip(folder):
    """A tiny CLIP as transformers saves it, that sees 224 pixels in patches of 14 as the L/14."""
    tokenizer = train_tokenizer(WORDS, vocabulary=300, context=77)
    size = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    ids = {"pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 3}
    text = {**size, **ids, "vocab_size": len(tokenizer), "max_position_embeddings": 77}
    vision = {**size, "image_size": 224, "patch_size": 14}
    config = CLIPConfig(text_config=text, vision_config=vision, projection_dim=768)
    shape = {"vision": Preprocess(224, 224)}
    EncoderSet(CLIPModel(config), tokenizer, preprocesses=shape, name="tiny L/14").save(folder)


@pytest.mark.slow
def test_the_paper_s_preset_from_training_to_the_probe(tag, tmp_path, capsys):
    write_clip(tmp_path / "clip")
    where = ["tag", "--split", "split.json"]
    size = ["--set", "tactile.width=32", "tactile.layers=2", "tactile.heads=2"]
    size += ["--set", "tactile_course.batch=8"]
    course = ["--clip", "clip", "--epochs", "1", "--chunk", "4", "-o", "out"]
    assert main(["train", "encoder", *where, "--preset", "paper", *size, *course]) == 0
    encoders = EncoderSet.load(tmp_path / "out")
    assert encoders.tactile.config.patch_size == 14
    assert (encoders.dim, encoders.card["targets"], encoders.card["steps"]) == (768, "diagonal", 4)
    assert len((tmp_path / "out" / "log-tactile.jsonl").read_text().splitlines()) == 2
    capsys.readouterr()
    assert main(["probe", *where, "--encoder", "out", "--json"]) == 0
    report = capsys.readouterr().out
    assert json.loads(report)
    assert "material" in report
    assert encoders.digest("tactile") in report


def test_a_plan_counts_parameters_and_steps():
    loop = LoopOptions(10, 4, 1e-3, ema=0.9)
    forward = lambda model, rows, device: model(torch.ones(rows, 5, device=device))
    plan = estimate(lambda: nn.Linear(5, 7), forward, loop, 100, torch.device("cpu"))
    assert (plan["parameters"], plan["steps"], plan["batch"]) == (5 * 7 + 7, 10, 4)
    assert 0 <= plan["seconds"] < 60
