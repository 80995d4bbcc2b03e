"""Shipped models as tests write them: untrained, in the true layout, under a root of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from diffusion_forge import make_pipeline
from palpate.core import shipped
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.contrastive import new_clip
from palpate.encoders.encoder_set import EncoderSet, new_touch
from palpate.encoders.preprocess import Preprocess
from palpate.encoders.presets import preset
from palpate.training.cards import write_model_cards

TINY = preset("tiny")
WORLD = [{"world": "made up", "seeds": "900000-900003", "version": 2, "frames": 12}]


def make_encoders(seed: int = 0) -> EncoderSet:
    """Untrained encoders of the preset tiny."""
    clip = new_clip(TINY, ["a rough wall", "a soft cloth", "smooth cold metal"], seed=seed)
    touch = new_touch(TINY.touch_config(clip.dim), seed + 1).eval()
    return EncoderSet(
        clip,
        touch,
        Preprocess.of_size(16, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4)),
        {"title": "EncoderSet", "data": WORLD},
    )


def write_shipped(root: Path, monkeypatch) -> TactilePipeline:
    """Writes ``root/mini`` as the package holds it and makes ``palpate/mini`` mean it; returns the generator."""
    monkeypatch.setattr(shipped, "shipped_root", lambda: root)
    encoders = make_encoders()
    encoders.save(root / "mini" / "encoders", half=True)
    made = make_pipeline(width=encoders.dim)
    made.autoencoder.card = {"data": WORLD, "scores": [{"score": "PSNR", "value": 12.5}]}
    made.autoencoder.save(root / "mini" / "autoencoder", half=True)
    training = {
        "synthetic": True,
        "materials": ["Wood", "Brick"],
        "data": WORLD,
        "split": None,
        "recipe": "python recipes/x.py",
    }
    pipeline = replace(made, encoders=EncoderSet(encoders.clip), training=training)
    pipeline.save(root / "mini" / "generator", half=True, shared="palpate/mini")
    write_model_cards(root / "mini")
    return pipeline
