"""The pipeline: what its images depend on, its folder, its inputs."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import DPMSolverMultistepScheduler, UNet2DConditionModel, VQModel
from PIL import Image

from diffusion_fixtures import arrays, make_pipeline, photos
from palpate.core import PalpateError
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.contrastive import new_clip
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.presets import preset


def without_encoders(pipeline: TactilePipeline) -> TactilePipeline:
    return replace(pipeline, encoders=None)


def test_images_depend_on_seed_id_photo_and_guidance_only():
    pipeline, ids = make_pipeline(), list("abcdef")
    base = arrays(pipeline(photos(6), ids=ids, seed=0))
    assert (base.shape, base.dtype) == ((6, 32, 32, 3), np.uint8)
    order = [5, 2, 0]
    again = arrays(pipeline(photos(6)[order], ids=[ids[k] for k in order], seed=0))
    assert np.array_equal(again, base[order])
    wide = replace(pipeline, sampler=replace(pipeline.sampler, batch=6))
    assert np.abs(arrays(wide(photos(6), ids=ids)).astype(int) - base).max() <= 1
    for images, change in (
        (photos(6), {"seed": 1}),
        (photos(6), {"ids": list("ABCDEF")}),
        (photos(6)[::-1].copy(), {}),
        (photos(6), {"guidance": 1.0}),
        (photos(6), {"steps": 2}),
    ):
        assert not np.array_equal(arrays(pipeline(images, **{"ids": ids} | change)), base)


def test_photos_in_any_form_give_the_same_images(tmp_path):
    pipeline, rows = make_pipeline(), photos(2)
    files = [tmp_path / "0", tmp_path / "1"]
    for file, row in zip(files, rows, strict=True):
        Image.fromarray(row).save(file, format="PNG")
    base = arrays(pipeline(rows))  # named "0" and "1"
    for form in (
        files,
        list(map(str, files)),
        list(map(Image.fromarray, rows)),
        torch.from_numpy(rows).permute(0, 3, 1, 2),
        torch.from_numpy(rows).permute(0, 3, 1, 2) / 255,
    ):
        assert np.array_equal(arrays(pipeline(form)), base)
    one = arrays(pipeline(files[0]))
    assert np.abs(one.astype(int) - base[:1]).max() <= 1
    calls = []
    pipeline(rows, progress=lambda what, done, total, remark="": calls.append((done, total)))
    assert calls[-1] == (2, 2)


def test_text_and_vision_embeddings_fill_the_same_slot():
    pipeline, c = make_pipeline(), torch.randn(2, 6)
    made = [pipeline.sample(c, ["x", "y"], seed=0, source=s) for s in ("text", "vision")]
    assert np.array_equal(*made)  # gap="none": the paper's bridge


def test_a_saved_pipeline_makes_the_same_images(tmp_path):
    pipeline = without_encoders(make_pipeline())
    pipeline.save(tmp_path / "p")
    again = TactilePipeline.from_pretrained(tmp_path / "p")
    assert again.digest == pipeline.digest
    for name in ("preset", "training", "sampler", "stats", "schedule", "size"):
        assert getattr(again, name) == getattr(pipeline, name)
    c = torch.randn(3, 6)
    a, b = (p.sample(c, list("abc"), seed=4) for p in (pipeline, again))
    assert np.array_equal(a, b)
    # The parts are diffusers' own folders, and nothing is pickled.
    for part, kind in (("unet", UNet2DConditionModel), ("autoencoder", VQModel)):
        kind.from_pretrained(tmp_path / "p" / part, low_cpu_mem_usage=False)
    scheduler = DPMSolverMultistepScheduler.from_pretrained(tmp_path / "p" / "scheduler")
    assert scheduler.config.beta_end == 0.0195
    suffixes = {p.suffix for p in tmp_path.rglob("*") if p.is_file()}
    assert suffixes == {".json", ".md", ".safetensors"}
    with pytest.raises(PalpateError, match="absent or an empty folder"):
        pipeline.save(tmp_path / "p")


def test_encoders_travel_with_the_pipeline(tmp_path):
    encoders = EncoderSet(new_clip(preset("tiny"), ["a rough wall", "a soft cloth"], seed=0))
    pipeline = replace(make_pipeline(width=encoders.dim), encoders=encoders)
    pipeline.save(tmp_path / "p")
    again = TactilePipeline.from_pretrained(tmp_path / "p")
    assert again.digest == pipeline.digest
    # Photos of any size; by hand: the encoder's preprocessing, then the embedding of each alone.
    images = photos(3, size=21)
    preprocess = encoders.preprocess("vision")
    unit = torch.from_numpy(preprocess.fit(images)).permute(0, 3, 1, 2) / 255
    with torch.no_grad():
        by_hand = torch.cat([encoders.encode("vision", preprocess(u[None])) for u in unit])
    assert torch.allclose(again.embed(images), by_hand, atol=1e-5)
    assert np.array_equal(arrays(again(images)), arrays(pipeline(images)))


def test_the_digest_names_what_images_depend_on():
    base = make_pipeline()
    assert make_pipeline().digest == base.digest
    assert replace(base, sampler=replace(base.sampler, steps=7)).digest == base.digest
    assert replace(base, encoders=None).digest != base.digest
    assert replace(base, stats=LatentStats((0.0,) * 3, (1.0,) * 3)).digest != base.digest
    other = make_pipeline()
    next(other.denoiser.parameters()).data.add_(1e-3)
    assert other.digest != base.digest


def test_the_background_variant_uses_its_background():
    pipeline = make_pipeline(background=True)
    ground = photos(2, 32)
    a, b = (arrays(pipeline(photos(2), background=g)) for g in (ground, ground[::-1].copy()))
    assert not np.array_equal(a, b)
    with pytest.raises(PalpateError, match="`background` must be given for a generator w/ BG"):
        pipeline(photos(2))
    with pytest.raises(PalpateError, match="and only for one"):
        make_pipeline()(photos(2), background=ground)
    with pytest.raises(PalpateError, match="one image of 32 pixels square per photo"):
        pipeline.sample(torch.randn(2, 6), ["a", "b"], seed=0, background=ground[:, :16])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: p(photos(1), guidance=-1.0), "`guidance` must be a finite number from 0 on"),
        (lambda p: p(photos(1), guidance=float("nan")), "`guidance` must be a finite number"),
        (lambda p: p(photos(1), steps=0), r"`steps` must lie in 1 to 1000\. Got 0"),
        (lambda p: p(photos(1), steps=1001), "`steps` must lie in 1 to 1000"),
        (lambda p: p.sampler_with(batch=0), "`batch` must be at least 1"),
        (lambda p: p(photos(2), ids=["a"]), "Every id needs one condition"),
        (lambda p: p(photos(1) / 255), "`images` must be uint8"),
        (lambda p: p(7), "`images` must be files, PIL images"),
        (lambda p: p("nowhere.jpg"), "nowhere.jpg: no such file"),
        (lambda p: without_encoders(p)(photos(1)), "vision encoder"),
    ],
)
def test_mistakes_are_explained(call, message):
    with pytest.raises(PalpateError, match=message):
        call(make_pipeline())


def test_guidance_needs_condition_dropout():
    pipeline = make_pipeline(policy=ConditionPolicy(width=6, dropout=0.0))
    with pytest.raises(PalpateError, match="must be 1 for a generator trained without"):
        pipeline(photos(1))
    assert len(pipeline(photos(1), guidance=1.0).images) == 1


def test_a_changed_folder_is_rejected(tmp_path):
    without_encoders(make_pipeline()).save(tmp_path / "p")
    file = tmp_path / "p" / "palpate.json"
    about = json.loads(file.read_text())
    cases = [
        (about | {"condition": about["condition"] | {"dropout": 0.2}}, "must match its palpate"),
        (about | {"latents": about["latents"] | {"std": [1, 1, 1]}}, "must match its palpate"),
        ({"format": "other"}, "must have the format palpate-pipeline/2"),
        ({k: v for k, v in about.items() if k != "sampler"}, "no sampler"),
        (about | {"sampler": {"methods": "ddim"}}, "must be as palpate writes them"),
        (about | {"size": None}, "must be as palpate writes them"),
        ([], "must be a JSON object"),
    ]
    for content, message in cases:
        file.write_text(json.dumps(content))
        with pytest.raises(PalpateError, match=message):
            TactilePipeline.from_pretrained(tmp_path / "p")
    with pytest.raises(PalpateError, match="no folder"):
        TactilePipeline.from_pretrained(tmp_path / "nowhere")
