"""Conditions other than embeddings: the map of a photo that is trained with the denoiser (GVST),
and the patches of a photo.
"""

import json
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image

from forge.errors import fails
from forge.models import arrays, make_encoders, make_pipeline
from forge.pictures import photos
from forge.worlds import by_video
from palpate.cli import main
from palpate.core import PalpateError
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.denoiser import Denoiser, PhotoMap, inputs_of, lengths_of, slots_of
from palpate.diffusion.denoiser_training import DiffusionLoss, Rows, train_denoiser
from palpate.diffusion.generation import generate
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import TINY
from palpate.diffusion.training import train_generator
from palpate.training.options import LoopOptions
from palpate.training.run import TrainingRun
from palpate.training.steps import Step

GVST = ConditionPolicy(width=8, source="resnet", photo_size=16, photo_width=4)


@pytest.mark.parametrize(("size", "width"), [(16, 4), (64, 32), (256, 64)])
def test_a_photo_of_any_size_becomes_64_tokens_as_large_as_embeddings(size, width):
    torch.manual_seed(0)
    made = PhotoMap(replace(GVST, photo_size=size, photo_width=width))
    tokens = made(torch.from_numpy(photos(2, size)))
    assert tokens.shape == (2, 64, 8)
    assert torch.allclose(tokens.norm(dim=2), torch.tensor(8**0.5), atol=1e-2)
    # The rows of a batch do not see each other, so several processes take the steps of one.
    alone = made(torch.from_numpy(photos(2, size)[1:]))
    assert torch.allclose(alone, tokens[1:], atol=1e-4)


def learned(folder, policy=GVST, **changes):
    """A denoiser trained to make of a dark photo one latent, and of a bright one the opposite."""
    bright = np.arange(32) % 2 == 1
    images = np.where(bright, 230, 20).astype(np.uint8)[:, None, None, None]
    z = torch.from_numpy(np.where(bright, 1.0, -1.0)).float().reshape(-1, 1, 1, 1)
    rows = Rows(z.expand(-1, 3, 8, 8), {"photos": np.broadcast_to(images, (32, 16, 16, 3))})
    schedule, loop = replace(TINY.schedule, prediction="flow"), LoopOptions(60, 8, 3e-3, 5, ema=0.9)
    preset = replace(TINY, condition=policy, schedule=schedule, loop=loop)
    stats = LatentStats((0.0,) * 3, (1.0,) * 3, "one")
    return train_denoiser(rows, replace(preset, **changes), stats, TrainingRun(folder))


def test_the_map_is_trained_with_the_denoiser_and_decides_the_image(tmp_path):
    model = learned(tmp_path / "run")
    start = learned(tmp_path / "start", loop=LoopOptions(0, 8, 1e-3))
    pairs = zip(model.maps.parameters(), start.maps.parameters(), strict=True)
    assert not any(torch.equal(a, b) for a, b in pairs)
    shades = torch.tensor([20, 230], dtype=torch.uint8).reshape(2, 1, 1, 1).expand(2, 16, 16, 3)
    noise, late = torch.randn(1, 3, 8, 8).expand(2, -1, -1, -1), torch.full((2,), 990)
    with torch.no_grad():  # at the end of the path the network predicts noise - z
        made = noise - model(noise, late, model.condition(model.maps["photos"](shades)))
    assert made[0].mean() < -0.5
    assert made[1].mean() > 0.5


def test_photos_drive_it_without_encoders_and_it_comes_back_from_its_folder(tmp_path):
    pipeline = replace(make_pipeline(policy=GVST), encoders=None)
    assert pipeline.vision_size == 16
    images = photos(3, 20)
    made = arrays(pipeline(images))
    assert not np.array_equal(made, arrays(pipeline(images[::-1].copy())))
    pipeline.save(tmp_path / "p")
    again = TactilePipeline.from_pretrained(tmp_path / "p")
    assert again.digest == pipeline.digest
    assert np.array_equal(arrays(again(images)), made)
    for call, message in (
        (lambda: pipeline(text="rough"), "`text` must be left out for a generator without text"),
        (
            lambda: pipeline.sample(torch.randn(1, 8), ["a"], seed=0),
            r"tokens of shape \(n, 64, 8\)",
        ),
        (lambda: pipeline.denoiser.condition(None, torch.randn(1, 8)), "knows photos alone"),
        (lambda: learned(tmp_path / "n", ConditionPolicy(width=8)), "need conditions of text"),
    ):
        fails(message, call)


@pytest.mark.parametrize(
    "change", [{"photo_size": 48}, {"photo_size": 8}, {"photo_width": 6}, {"photo_width": 0}]
)
def test_sizes_that_do_not_halve_to_8_are_rejected(change):
    with pytest.raises(PalpateError, match=r"`condition.photo_(size|width)` must be a "):
        replace(TINY, condition=replace(GVST, **change))


def test_gvst_from_the_command_line_needs_no_text_and_no_encoder(tag, tmp_path, capsys):
    command = ["train", "generator", "tag", "--split", "split.json", "--preset", "tiny"]
    gvst = ["source=resnet", "photo_size=16", "photo_width=4"]
    small = ["--set", *(f"condition.{field}" for field in gvst), "--steps", "2"]
    assert main([*command, *small, "-o", "gvst", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["source"], facts["text_source"]) == ("resnet", None)
    assert not (tmp_path / "gvst" / "encoders").exists()
    photo = str(tag[0].paths("vision")[0])
    assert main(["generate", photo, "--model", "gvst", "-o", "t.png"]) == 0
    assert Image.open("t.png").size == (32, 32)
    capsys.readouterr()
    assert main(["generate", "--text", "rough", "--model", "gvst", "-o", "u.png"]) == 2
    assert "--text must be left out" in capsys.readouterr().err
    assert main([*command, "--set", "condition.source=text", "-o", "no"]) == 2
    assert "--clip must have text and vision" in capsys.readouterr().err


PATCHES = ConditionPolicy(width=12, source="both", patches=4, dropout=0.2)


def patch_pipeline():
    encoders = make_encoders()
    policy = replace(PATCHES, width=encoders.dim)
    base = make_pipeline(policy=replace(policy, patches=0))
    width = encoders.clip.config.vision_config.hidden_size
    denoiser = Denoiser(base.unet, policy, patch_width=width).eval()
    return replace(base, denoiser=denoiser, encoders=encoders.without_tactile())


def test_patches_are_those_of_the_last_layer_of_transformers():
    clip = make_encoders()
    pixels = torch.randn(2, 3, *[clip.preprocess("vision").size] * 2)
    with torch.no_grad():
        whole = clip.clip.vision_model(pixels).last_hidden_state[:, 1:]
        assert torch.allclose(clip.patches(pixels, whole.shape[1]), whole, atol=1e-6)
        mean = clip.patches(pixels, 1)
    assert torch.allclose(mean[:, 0], whole.mean(1), atol=1e-5)


def test_patches_follow_their_embedding_and_are_null_where_there_are_none():
    pipeline = patch_pipeline()
    photo, text = pipeline.embed(photos(2)), pipeline.embed_text("rough")
    assert photo.shape[1] == 1 + 4
    condition = pipeline.denoiser.condition
    both = condition(photo, text.expand(2, -1))
    assert both.shape[1] == 2 + 4  # two embeddings, patches
    assert torch.equal(both[:, 2:], photo[:, 1:])
    assert not condition(None, text)[:, 2:].any()
    # A bare embedding is known, too.
    assert torch.equal(condition(photo[:, 0])[:, 1], condition(photo)[:, 1])
    # A photo in the place of a text brings its embedding alone.
    assert not inputs_of(replace(PATCHES, source="text"))


@pytest.mark.parametrize("source", ["vision", "both"])
def test_patches_are_dropped_with_their_embedding_and_alone(source):
    policy, n = replace(PATCHES, source=source), 4000
    loss = DiffusionLoss(
        torch.zeros(n, 3, 2, 2),
        {s: torch.ones(n, 1, 12) for s in policy.sources},
        None,
        stats=LatentStats((0.0,) * 3, (1.0,) * 3),
        schedule=TINY.schedule,
        policy=policy,
        inputs={"patches": torch.ones(n, 4, 12)},
    )
    batch = loss.load(Step(0, np.arange(n), 0))
    dropped = batch["dropped"][:, :, 0]
    assert dropped.shape[1] == sum(lengths_of(policy))
    slots = slots_of(policy)
    photo, patches = dropped[:, slots - 1], dropped[:, slots:]
    assert bool((patches == patches[:, :1]).all())  # they go as a whole
    known = ~patches[:, 0]
    assert not (known & photo).any()
    assert float(known.float().mean()) == pytest.approx(0.8 * 0.5, abs=0.03)


def test_patches_from_training_to_a_saved_pipeline(small_manifest, tmp_path):
    condition = replace(TINY.condition, patches=4, source="both")
    preset = replace(TINY, condition=condition, loop=replace(TINY.loop, steps=2))
    encoders, split = make_encoders(), by_video(small_manifest)
    options = {"preset": preset, "device": "cpu"}
    made = train_generator(small_manifest, split, encoders, output=tmp_path / "m", **options)
    again = TactilePipeline.from_pretrained(tmp_path / "m", device="cpu")
    assert again.digest == made.digest
    assert [*again.denoiser.maps] == ["patches"]
    first = small_manifest.paths("vision")[:2]
    images = [arrays(again(first, text=text)) for text in (None, "rough", "smooth")]
    assert not any(np.array_equal(a, b) for a, b in pairwise(images))
    done = generate(first, text="rough", model=again)
    assert np.array_equal(np.stack([np.asarray(i) for i in done.images]), images[1])


def test_a_call_takes_the_names_of_diffusers():
    pipeline = patch_pipeline()
    two = photos(2, 20)
    call = partial(pipeline, image=two, prompt="rough", num_inference_steps=2, guidance_scale=2.0)
    made = call(output_type="np", num_images_per_prompt=2).images
    assert made.shape == (4, pipeline.size, pipeline.size, 3)
    assert made.dtype == np.float32
    assert 0 <= made.min() < made.max() <= 1
    plain = arrays(call())
    assert np.array_equal((made[::2] * 255).round(), plain)  # copies follow the first of each
    assert not np.array_equal(made[0], made[1])
    tensor = call(output_type="pt").images
    assert np.array_equal(tensor.permute(0, 2, 3, 1).mul(255).round().numpy(), plain)
    own = pipeline.generate(two, text="rough", steps=2, guidance=2.0)
    assert np.array_equal(own, plain)
    each = call(prompt=["rough", "soft"])
    assert np.array_equal(arrays(each)[0], plain[0])
    assert not np.array_equal(arrays(each)[1], plain[1])
    assert len(pipeline(prompt=["rough", "soft"], num_inference_steps=2).images) == 2
    draws = [torch.Generator().manual_seed(k) for k in range(4)]
    assert len(call(generator=draws, num_images_per_prompt=2).images) == 4
    fails("must be one of", lambda: call(output_type="latent"))
    fails("whole number from 1", lambda: call(num_images_per_prompt=0))
