"""The saved pipeline: loads to the same pictures, says what it is, refuses what it cannot do."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import DPMSolverMultistepScheduler, UNet2DConditionModel, VQModel

from diffusion_forge import make_pipeline
from palpate.core import PalpateError
from palpate.diffusion.denoiser import ConditionPolicy
from palpate.diffusion.latents import LatentStats
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.contrastive import new_clip
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.presets import preset


def photos(n: int, size: int = 16) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (n, size, size, 3), dtype=np.uint8)


def without_encoders(pipeline: TactilePipeline) -> TactilePipeline:
    return replace(pipeline, encoders=None)


def test_photos_become_touches_of_the_right_form():
    pipeline = make_pipeline()
    out = pipeline.touch(photos(5), list("abcde"), seed=0)
    assert out.shape == (5, 32, 32, 3)
    assert out.dtype == np.uint8
    assert pipeline.touch(photos(0), [], seed=0).shape == (0, 32, 32, 3)


def test_pictures_depend_on_seed_id_photo_and_guidance_only():
    pipeline = make_pipeline()
    ids = list("abcdef")
    base = pipeline.touch(photos(6), ids, seed=0)
    order = [5, 2, 0]
    assert np.array_equal(
        pipeline.touch(photos(6)[order], [ids[k] for k in order], seed=0), base[order]
    )
    wide = replace(pipeline, sampler=replace(pipeline.sampler, batch=6))
    assert np.abs(wide.touch(photos(6), ids, seed=0).astype(int) - base).max() <= 1
    assert not np.array_equal(pipeline.touch(photos(6), ids, seed=1), base)
    assert not np.array_equal(pipeline.touch(photos(6), list("ABCDEF"), seed=0), base)
    assert not np.array_equal(pipeline.touch(photos(6)[::-1].copy(), ids, seed=0), base)
    assert not np.array_equal(pipeline.touch(photos(6), ids, seed=0, guidance=1.0), base)


def test_text_and_vision_embeddings_fill_the_same_slot():
    pipeline = make_pipeline()
    c = torch.randn(2, 6)
    a = pipeline.touch_from_embeddings(c, ["x", "y"], seed=0, source="text")
    b = pipeline.touch_from_embeddings(c, ["x", "y"], seed=0, source="vision")
    assert np.array_equal(a, b)  # gap="none": the paper's bridge


def test_progress_reaches_the_end():
    calls = []
    make_pipeline().touch(
        photos(5),
        list("abcde"),
        seed=0,
        progress=lambda what, done, total, remark="": calls.append((what, done, total)),
    )
    assert calls[-1] == ("generating", 5, 5)


def test_saved_pipeline_makes_the_same_pictures(tmp_path):
    pipeline = without_encoders(make_pipeline())
    pipeline.save(tmp_path / "p")
    again = TactilePipeline.load(tmp_path / "p")
    assert again.digest == pipeline.digest
    assert (again.preset, again.training, again.sampler, again.stats) == (
        "tiny",
        pipeline.training,
        pipeline.sampler,
        pipeline.stats,
    )
    c = torch.randn(3, 6)
    one, other = (p.touch_from_embeddings(c, list("abc"), seed=4) for p in (pipeline, again))
    assert np.array_equal(one, other)
    # The parts are diffusers' own folders.
    assert isinstance(
        UNet2DConditionModel.from_pretrained(tmp_path / "p" / "unet", low_cpu_mem_usage=False),
        UNet2DConditionModel,
    )
    assert isinstance(
        VQModel.from_pretrained(tmp_path / "p" / "autoencoder", low_cpu_mem_usage=False), VQModel
    )
    assert (
        DPMSolverMultistepScheduler.from_pretrained(tmp_path / "p" / "scheduler").config.beta_end
        == 0.0195
    )
    assert not [
        p for p in Path(tmp_path).rglob("*") if p.suffix in (".bin", ".pt", ".pkl", ".ckpt")
    ]
    with pytest.raises(PalpateError, match="absent or an empty folder"):
        pipeline.save(tmp_path / "p")


def test_real_encoders_travel_with_the_pipeline(tmp_path):
    encoders = EncoderSet(new_clip(preset("tiny"), ["a rough wall", "a soft cloth"], seed=0))
    pipeline = replace(make_pipeline(width=encoders.dim), encoders=encoders)
    pipeline.save(tmp_path / "p")
    again = TactilePipeline.load(tmp_path / "p")
    assert again.digest == pipeline.digest
    # Photos of any size; by hand: the encoder's own transform, then the embedding of each alone.
    images = photos(3, size=21)
    transform = encoders.preprocess("vision")
    unit = torch.from_numpy(transform.fit(images)).permute(0, 3, 1, 2) / 255
    with torch.no_grad():
        by_hand = torch.cat(
            [encoders.encode("vision", transform.normalize(transform.crop(u[None]))) for u in unit]
        )
    assert torch.allclose(again.embed(images), by_hand, atol=1e-5)
    assert np.array_equal(
        again.touch(images, list("abc"), seed=0), pipeline.touch(images, list("abc"), seed=0)
    )


def test_tampering_is_noticed(tmp_path):
    without_encoders(make_pipeline()).save(tmp_path / "p")
    file = tmp_path / "p" / "palpate.json"
    about = json.loads(file.read_text())
    for change in (
        {"condition": about["condition"] | {"dropout": 0.2}},
        {"latents": about["latents"] | {"std": [1, 1, 1]}},
    ):
        file.write_text(json.dumps(about | change))
        with pytest.raises(PalpateError, match="must match its palpate"):
            TactilePipeline.load(tmp_path / "p")
    file.write_text(json.dumps({"format": "other"}))
    with pytest.raises(PalpateError, match="must have the format palpate-pipeline"):
        TactilePipeline.load(tmp_path / "p")
    with pytest.raises(PalpateError, match="must exist"):
        TactilePipeline.load(tmp_path / "nowhere")


def test_digest_names_what_pictures_depend_on():
    base = make_pipeline()
    assert make_pipeline().digest == base.digest
    assert replace(base, sampler=replace(base.sampler, steps=7)).digest == base.digest
    assert replace(base, encoders=None).digest != base.digest
    assert replace(base, stats=LatentStats((0.0,) * 3, (1.0,) * 3)).digest != base.digest
    other = make_pipeline()
    next(other.denoiser.parameters()).data.add_(1e-3)
    assert other.digest != base.digest


def test_background_variant_uses_its_background():
    pipeline = make_pipeline(background=True)
    ground = np.random.default_rng(1).integers(0, 256, (2, 32, 32, 3), dtype=np.uint8)
    a = pipeline.touch(photos(2), ["a", "b"], seed=0, background=ground)
    b = pipeline.touch(photos(2), ["a", "b"], seed=0, background=ground[::-1].copy())
    assert not np.array_equal(a, b)
    with pytest.raises(PalpateError, match="w/ BG"):
        pipeline.touch(photos(2), ["a", "b"], seed=0)
    with pytest.raises(PalpateError, match="32 pixels square"):
        pipeline.touch(photos(2), ["a", "b"], seed=0, background=ground[:, :16, :16])


def test_what_cannot_be_done_is_refused():
    with pytest.raises(PalpateError, match="condition dropout"):
        make_pipeline(policy=ConditionPolicy(width=6, dropout=0.0)).touch(photos(1), ["a"], seed=0)
    with pytest.raises(PalpateError, match="vision encoder"):
        without_encoders(make_pipeline()).touch(photos(1), ["a"], seed=0)
    with pytest.raises(PalpateError, match="one condition"):
        make_pipeline().touch(photos(2), ["a"], seed=0)


def test_a_card_that_cannot_be_used_is_told_with_file_and_entry(tmp_path):
    without_encoders(make_pipeline()).save(tmp_path / "p")
    file = tmp_path / "p" / "palpate.json"
    about = json.loads(file.read_text())
    for key in (
        "digest",
        "preset",
        "size",
        "condition",
        "schedule",
        "sampler",
        "latents",
        "autoencoder",
        "encoders",
        "training",
    ):
        file.write_text(json.dumps({k: v for k, v in about.items() if k != key}))
        with pytest.raises(PalpateError, match="must have the keys") as told:
            TactilePipeline.load(tmp_path / "p")
        assert told.value.got == f"no {key}"
        assert str(file) in told.value.must
    bad = {
        "condition": [
            about["condition"] | {"extra": 1},
            [],
            {},
            None,
            about["condition"] | {"dropout": "x"},
        ],
        "schedule": [{"more": 1}, "x"],
        "sampler": [{"methods": "ddim"}, {"steps": "x"}, {"guidance": None}, 3],
        "latents": [
            {},
            {"mean": None, "std": [1], "scale": "std"},
            {"mean": ["x"], "std": [1], "scale": "std"},
            [],
        ],
        "size": ["x", None, [32]],
        "training": [[], None, "x"],
    }
    for key, values in bad.items():
        for value in values:
            file.write_text(json.dumps(about | {key: value}))
            with pytest.raises(
                PalpateError, match=f"^{key} in .*palpate.json must be as palpate writes it"
            ):
                TactilePipeline.load(tmp_path / "p")
    for value, word in (
        ({"method": "nope"}, "method must be ddim or dpm"),
        ({"guidance": -1.0}, "from 0 on"),
        ({"steps": 0}, "steps"),
    ):
        file.write_text(json.dumps(about | {"sampler": about["sampler"] | value}))
        with pytest.raises(PalpateError, match=word):
            TactilePipeline.load(tmp_path / "p")
    for text, word in (
        ("[]", "must be a JSON object"),
        (json.dumps(about | {"size": float("nan")}), "finite numbers"),
    ):
        file.write_text(text)
        with pytest.raises(PalpateError, match=word):
            TactilePipeline.load(tmp_path / "p")
    file.write_text(json.dumps(about))
    TactilePipeline.load(tmp_path / "p")
