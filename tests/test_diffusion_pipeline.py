"""The pipeline: what its images depend on, its folder, its inputs."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import diffusers
import huggingface_hub
import numpy as np
import pytest
import torch
from diffusers import DiffusionPipeline, DPMSolverMultistepScheduler, UNet2DConditionModel, VQModel
from diffusers.utils import hub_utils
from huggingface_hub import ModelCard
from PIL import Image
from safetensors.torch import load_file, save_file

from forge.errors import fails
from forge.models import arrays, make_pipeline
from forge.pictures import photos
from palpate.core import PalpateError
from palpate.diffusion.autoencoder import BackgroundAutoencoder, LatentStats
from palpate.diffusion.autoencoder_training import build_autoencoder
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import TINY
from palpate.encoders.contrastive import new_clip
from palpate.encoders.presets import preset_of


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


def test_text_and_vision_embeddings_fill_the_same_slot():
    pipeline, c = make_pipeline(), torch.randn(2, 6)
    made = [pipeline.sample(a, ["x", "y"], seed=0, texts=b) for a, b in ((c, None), (None, c))]
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
    fails("absent or an empty folder", pipeline.save, tmp_path / "p")


def test_encoders_travel_with_the_pipeline(tmp_path):
    encoders = new_clip(preset_of("tiny"), ["a rough wall", "a soft cloth"], seed=0)
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
    a, b = (arrays(pipeline(photos(2), gel=g)) for g in (ground, ground[::-1].copy()))
    assert not np.array_equal(a, b)
    fails("`background` must be given for a generator that sees", pipeline, photos(2))
    fails("and only for one", make_pipeline(), photos(2), gel=ground)
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
        (lambda p: p(photos(2), generator=[torch.Generator()]), r"`generator` .*Got 1 for 2"),
        (lambda p: p(photos(1) / 100), r"`images` must be \(n, h, w, c\)"),
        (lambda p: p(7), "`images` must be files, PIL images"),
        (lambda p: p("nowhere.jpg"), "nowhere.jpg: no such file"),
        (lambda p: p([]), "at least one photo"),
        (lambda p: p(text=[7]), "`text` must be one string, for all images"),
        (lambda p: without_encoders(p)(photos(1)), "vision encoder"),
    ],
)
def test_mistakes_are_explained(call, message):
    fails(message, call, make_pipeline())


def test_guidance_needs_condition_dropout():
    pipeline = make_pipeline(policy=ConditionPolicy(width=6, dropout=0.0))
    fails("must be 1 for a generator trained without", pipeline, photos(1))
    assert len(pipeline(photos(1), guidance=1.0).images) == 1


def test_a_changed_folder_is_rejected(tmp_path):
    without_encoders(make_pipeline()).save(tmp_path / "p")
    unet, autoencoder = tmp_path / "p" / "unet", tmp_path / "p" / "autoencoder"
    (weights,) = unet.glob("diffusion*.safetensors")
    content = weights.read_bytes()
    save_file(load_file(weights) | {"extra.weight": torch.zeros(1)}, weights)
    with pytest.raises(PalpateError, match=r"1 unknown weights, first extra\.weight"):
        TactilePipeline.from_pretrained(tmp_path / "p")
    weights.write_bytes(content)
    autoencoder.rename(tmp_path / "own")
    build_autoencoder(replace(TINY.autoencoder, channels=4)).eval().save(autoencoder)
    with pytest.raises(PalpateError, match=r"one for the autoencoder: 4 channels .* Got \[3\]"):
        TactilePipeline.from_pretrained(tmp_path / "p")
    shutil.rmtree(autoencoder)
    (tmp_path / "own").rename(autoencoder)
    file = tmp_path / "p" / "palpate.json"
    about = json.loads(file.read_text())
    cases = [
        (about | {"condition": about["condition"] | {"dropout": 0.2}}, "must match its palpate"),
        (about | {"latents": about["latents"] | {"std": [1, 1, 1]}}, "must match its palpate"),
        ({"format": "other"}, "must have the format palpate-pipeline/1"),
        ({k: v for k, v in about.items() if k != "sampler"}, "no sampler"),
        (about | {"sampler": {"methods": "ddim"}}, "must be as palpate writes them"),
        (about | {"size": None}, "must be as palpate writes them"),
        (about | {"size": 30}, "must be one for the autoencoder"),
        (about | {"condition": about["condition"] | {"taus": 1}}, "unexpected .* 'taus'"),
        (about | {"format": "palpate-pipeline/2"}, "must have the format palpate-pipeline/1"),
        ([], "must be a JSON object"),
    ]
    for content, message in cases:
        file.write_text(json.dumps(content))
        fails(message, TactilePipeline.from_pretrained, tmp_path / "p")
    fails("no folder", TactilePipeline.from_pretrained, tmp_path / "nowhere")


@pytest.mark.parametrize("many", [False, True], ids=["one generator", "one each"])
def test_generators_decide_the_noise_instead_of_seed_and_ids(many):
    pipeline = make_pipeline()

    def images(seed=3, batch=4, **options):
        one = torch.Generator().manual_seed(seed)
        each = [torch.Generator().manual_seed(seed + k) for k in range(6)]
        made = replace(pipeline, sampler=replace(pipeline.sampler, batch=batch))
        return arrays(made(photos(6), generator=each if many else one, **options)).astype(int)

    base = images()
    assert np.array_equal(images(seed=3, ids=list("abcdef")), base)
    assert np.abs(images(batch=6) - base).max() <= 1
    assert not np.array_equal(images(seed=4), base)


def test_a_callback_sees_and_replaces_the_latents_of_each_step():
    pipeline, calls = make_pipeline(), []

    def callback(pipe, step, timestep, kwargs):
        calls.append((pipe is pipeline, step, float(timestep), kwargs["latents"].shape))
        return {"latents": torch.zeros_like(kwargs["latents"])}

    base = arrays(pipeline(photos(2), steps=3))
    zero = arrays(pipeline(photos(2), steps=3, callback_on_step_end=callback))
    assert [call[:2] for call in calls] == [(True, 0), (True, 1), (True, 2)]
    assert all(shape[1:] == (3, 8, 8) for *_, shape in calls)
    assert np.array_equal(zero[0], zero[1])
    assert not np.array_equal(zero, base)
    looks = arrays(pipeline(photos(2), steps=3, callback_on_step_end=lambda *_: {}))
    assert np.array_equal(looks, base)


def test_the_progress_bar_counts_steps_and_can_be_turned_off(capsys):
    pipeline = make_pipeline()
    pipeline(photos(5), steps=3)
    assert f"{3 * 2}/{3 * 2}" in capsys.readouterr().err  # two batches of 4
    pipeline.set_progress_bar_config(disable=True)
    pipeline(photos(1), steps=2)
    assert not capsys.readouterr().err


def test_it_is_a_pipeline_of_diffusers(tmp_path):
    pipeline = without_encoders(make_pipeline())
    assert isinstance(pipeline, DiffusionPipeline)
    assert sorted(pipeline.components) == ["autoencoder", "scheduler", "unet"]
    pipeline.save_pretrained(tmp_path / "p")
    index = json.loads((tmp_path / "p" / "model_index.json").read_text())
    assert index["_class_name"] == "TactilePipeline"
    parts = {k: tuple(v) for k, v in index.items() if not k.startswith("_")}
    assert parts == {
        "unet": ("diffusers", "UNet2DConditionModel"),
        "autoencoder": ("diffusers", "VQModel"),
        "scheduler": ("diffusers", type(pipeline.scheduler).__name__),
    }
    for name, (_, kind) in parts.items():  # each loads with diffusers alone
        getattr(diffusers, kind).from_pretrained(tmp_path / "p" / name)
    assert TactilePipeline.from_pretrained(tmp_path / "p").digest == pipeline.digest


def test_pushed_to_the_hub_with_its_own_card_it_comes_back(tmp_path, monkeypatch):
    pipeline, hub = without_encoders(make_pipeline()), tmp_path / "hub"
    name = SimpleNamespace(repo_id="me/touch")

    def upload(*, repo_id, folder_path, **_):
        assert repo_id == "me/touch"
        shutil.copytree(folder_path, hub)

    blank = ModelCard("---\nlibrary_name: diffusers\n---\nblank")
    monkeypatch.setattr(hub_utils, "create_repo", lambda *_, **__: name)
    monkeypatch.setattr(hub_utils, "upload_folder", upload)
    monkeypatch.setattr(hub_utils, "load_or_create_model_card", lambda *_, **__: blank)
    pipeline.push_to_hub("me/touch")
    card = (hub / "README.md").read_text()
    assert "TactilePipeline.from_pretrained" in card
    assert pipeline.digest in card
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda *_, **__: str(hub))
    assert TactilePipeline.from_pretrained("me/touch", device="cpu").digest == pipeline.digest


def test_another_scheduler_samples_and_belongs_to_the_settings(tmp_path):
    pipeline = without_encoders(make_pipeline())
    c, base = torch.randn(5, 6), pipeline.digest
    first = pipeline.sample(c, list("abcde"), seed=0)
    config = pipeline.scheduler.config
    for kind in (diffusers.UniPCMultistepScheduler, diffusers.EulerAncestralDiscreteScheduler):
        pipeline.scheduler = kind.from_config(config)
        made = pipeline.sample(c, list("abcde"), seed=0)
        assert not np.array_equal(made, first)
        # Noise that the scheduler adds belongs to the sample, too.
        alone = pipeline.sample(c[2:4], ["c", "d"], seed=0)
        assert np.abs(alone.astype(int) - made[2:4]).max() <= 1
        assert pipeline.other_scheduler["_class_name"] == kind.__name__
        fails("sampler's scheduler", pipeline.save, tmp_path / "p")
    assert pipeline.digest == base
    assert replace(pipeline).other_scheduler is None


def test_the_unet_computes_in_another_type_and_is_saved_in_32_bits(tmp_path):
    pipeline = without_encoders(make_pipeline())
    c, exact = torch.randn(2, 6), pipeline.digest
    base = pipeline.sample(c, ["a", "b"], seed=0).astype(int)
    assert pipeline.to(torch.bfloat16) is pipeline
    assert (pipeline.dtype, pipeline.device.type) == (torch.bfloat16, "cpu")
    made = pipeline.sample(c, ["a", "b"], seed=0)
    assert np.abs(made - base).mean() < 8
    assert pipeline.digest != exact  # weights are rounded
    pipeline.save(tmp_path / "p")
    again = TactilePipeline.from_pretrained(tmp_path / "p")
    assert (again.dtype, again.digest) == (torch.float32, pipeline.digest)
    assert np.array_equal(again.to("cpu", torch.bfloat16).sample(c, ["a", "b"], seed=0), made)


@pytest.mark.parametrize(
    ("parts", "got"),
    [
        ({"stats": LatentStats((0.0,) * 4, (1.0,) * 4)}, r"\[3, 4\] channels"),
        ({"size": 33}, "sides of 33"),
        ({"autoencoder": BackgroundAutoencoder(4, 8, 16)}, r"must be one for .* 4 channels"),
        ({"denoiser": make_pipeline(background=True).denoiser}, None),
    ],
)
def test_parts_that_do_not_fit_are_rejected(parts, got):
    if got is None:
        assert replace(make_pipeline(), **parts).background
        return
    fails(got, replace, make_pipeline(), **parts)


@pytest.mark.parametrize(
    ("record", "lines"),
    [
        ({}, ["license: unknown"]),
        ({"license": "mit", "ceiling": {"psnr": 21.5}}, ["license: mit", "| psnr |", "| 21.5 |"]),
        (
            {"split": "5" * 64, "manifest": "7" * 64, "train_samples": 12, "split_rule": {"by": 1}},
            ["- split: `" + "5" * 64, "- manifest: `" + "7" * 64, '| {"by": 1} | 12 |'],
        ),
        (
            {"data": [{"world": "w"}], "scores": [{"score": "TMMD", "value": 0.5}]},
            ["| w |", "| TMMD | 0.5 |"],
        ),
    ],
)
def test_the_card_says_what_is_known(tmp_path, record, lines):
    pipeline = replace(make_pipeline(), encoders=None, training=record)
    pipeline.save(tmp_path / "p")
    card = (tmp_path / "p" / "README.md").read_text()
    for line in [*lines, f"- model: `{pipeline.digest}`", "- autoencoder: `"]:
        assert line in card


@pytest.mark.parametrize("kind", ["gray", "rgba", "floats", "tensor", "gray tensor", "PIL RGBA"])
def test_photos_in_every_form_that_people_have_give_the_same_touch(kind):
    pipeline = make_pipeline()
    pixels = photos(1, 20)[0]
    if "gray" in kind:
        pixels = np.repeat(pixels[..., :1], 3, axis=2)
    alpha = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=2)
    form = {
        "gray": pixels[..., 0],
        "rgba": alpha,
        "floats": pixels / 255,
        "tensor": torch.from_numpy(pixels).permute(2, 0, 1).float() / 255,
        "gray tensor": torch.from_numpy(pixels[..., 0]),
        "PIL RGBA": Image.fromarray(alpha, "RGBA"),
    }[kind]
    plain = arrays(pipeline(pixels, num_inference_steps=2))
    assert np.array_equal(arrays(pipeline(form, num_inference_steps=2)), plain)


def test_four_threads_use_one_pipeline():
    pipeline = make_pipeline()
    pipeline.set_progress_bar_config(disable=True)
    jobs = [(photos(1, 20 + k), 2 + k % 3) for k in range(8)]
    make = lambda job: arrays(pipeline(job[0], num_inference_steps=job[1]))
    alone = [make(job) for job in jobs]
    with ThreadPoolExecutor(4) as pool:
        assert all(map(np.array_equal, pool.map(make, jobs), alone))
