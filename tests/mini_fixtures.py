"""Small models in the layout of the shipped ones, untrained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from diffusion_fixtures import make_pipeline
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders import models
from palpate.encoders.contrastive import new_clip
from palpate.encoders.encoder_set import EncoderSet, Preprocess, new_tactile
from palpate.encoders.presets import TINY
from palpate.training.cards import write_model_cards

WORLD = [{"world": "made up", "seeds": "900000-900003", "version": 2, "frames": 12}]


def make_encoders(seed: int = 0) -> EncoderSet:
    """Untrained encoders of the preset tiny."""
    clip = new_clip(TINY, ["a rough wall", "a soft cloth", "smooth cold metal"], seed=seed)
    tactile = new_tactile(TINY.tactile_config(clip.dim), seed + 1).eval()
    preprocess = Preprocess(16, 16, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4))
    return EncoderSet(clip, tactile, preprocess, {"title": "Encoders", "data": WORLD})


def write_shipped(root: Path, monkeypatch) -> TactilePipeline:
    """Write ``root/mini``, make ``palpate/mini`` refer to it, and return the generator."""
    monkeypatch.setattr(models, "shipped_root", lambda: root)
    encoders = make_encoders()
    encoders.save(root / "mini" / "encoders", half=True)
    made = make_pipeline(width=encoders.dim)
    made.autoencoder.card = {"data": WORLD, "scores": [{"score": "PSNR", "value": 12.5}]}
    made.autoencoder.save(root / "mini" / "autoencoder", half=True)
    training = {"synthetic": True, "materials": ["Wood", "Brick"], "data": WORLD, "split": None}
    pipeline = replace(made, encoders=EncoderSet(encoders.clip), training=training)
    pipeline.save(root / "mini" / "generator", half=True, shared="palpate/mini")
    write_model_cards(root / "mini")
    return pipeline
