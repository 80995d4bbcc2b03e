"""A generator that goes on from another one, in the same space only."""

from dataclasses import replace
from pathlib import Path

import torch

from forge.errors import fails
from forge.models import make_encoders, make_pipeline
from palpate.core import Split
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.denoiser_training import Rows, train_denoiser
from palpate.diffusion.options import Schedule, UNetOptions
from palpate.diffusion.presets import TINY
from palpate.diffusion.training import Parts, train_pipeline
from palpate.training.options import LoopOptions
from palpate.training.run import TrainingRun

PLAIN = LatentStats((0.0,) * 3, (1.0,) * 3)


def train(folder: Path, steps: int, start=None, **changes):
    torch.manual_seed(3)
    loop = LoopOptions(steps=steps, batch=2, lr=1e-2, warmup=0)
    preset = replace(TINY, condition=TINY.condition_for(6), loop=loop, **changes)
    rows = Rows(torch.randn(4, 3, 8, 8), {"text": torch.randn(4, 6)})
    return train_denoiser(rows, preset, PLAIN, TrainingRun(folder), start=start)


def same(a, b) -> bool:
    return all(
        torch.equal(x, y) for x, y in zip(a.unet.parameters(), b.unet.parameters(), strict=True)
    )


def test_it_begins_with_the_given_weights_and_leaves_those_alone(tmp_path):
    start = make_pipeline().denoiser
    kept = [p.clone() for p in start.unet.parameters()]
    assert same(train(tmp_path / "a", 0, start), start)
    assert not same(train(tmp_path / "b", 0), start)
    moved = train(tmp_path / "c", 2, start)
    assert not same(moved, start)
    assert all(torch.equal(a, b) for a, b in zip(kept, start.unet.parameters(), strict=True))
    # A checkpoint of a run from random weights is not continued by one that starts elsewhere.
    train(tmp_path / "d", 2)
    assert same(train(tmp_path / "d", 2, start), moved)

    # Its geometry is its own.
    wide = UNetOptions(widths=(16, 16), attention=(False, True), layers=1, head_width=16, groups=8)
    assert same(train(tmp_path / "e", 0, start, unet=wide), start)


def test_other_encoders_autoencoders_and_schedules_are_rejected(small_manifest, tmp_path):
    encoders = make_encoders()
    start = replace(make_pipeline(width=encoders.dim), encoders=encoders.without_tactile())
    manifest = Manifest(small_manifest.table, small_manifest.root, {"synthetic": "yes"})
    split = Split.from_ids(
        train=manifest.ids[:8], test=manifest.ids[8:], rule={"name": "t"}, manifest=manifest.digest
    )
    preset = replace(TINY, loop=replace(TINY.loop, steps=1))

    def run(encoders=encoders, autoencoder=start.autoencoder, preset=preset):
        parts = Parts(preset, autoencoder, encoders, start=start)
        return train_pipeline(manifest, split, parts, TrainingRun(tmp_path / "work"))

    other = make_pipeline().autoencoder
    other.net.quantize.embedding.weight.data.add_(1)
    for change, word in (
        ({"encoders": make_encoders(seed=4)}, "another vision encoder"),
        ({"autoencoder": other}, "another autoencoder"),
        ({"preset": replace(preset, schedule=Schedule(prediction="flow"))}, "another schedule"),
    ):
        fails(word, run, **change)
    made = run()
    assert made.stats == start.stats
    assert made.training["start"] == start.digest
    assert made.training["start_record"] == dict(start.training)
    assert made.training["synthetic"] is True
    assert made.training["materials"] == sorted(
        set(manifest.part(split, "train").column("material"))
    )
    assert all(name in made.notice for name in made.training["materials"])
    # What it goes on from was trained on another split of these data, further back on real ones.
    first = {"manifest": manifest.digest, "split": "a", "materials": ["Felt"], "synthetic": True}
    between = {**first, "split": "b", "materials": [], "start_record": first}
    start.training = between
    on = run()
    assert on.earlier_splits == ["a", "b"]
    assert "Felt" in on.notice
    start.training = {**between, "start_record": {**first, "synthetic": False}}
    assert not run().notice
