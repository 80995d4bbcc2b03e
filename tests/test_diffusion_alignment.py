"""Alignment of the denoiser with an encoder, which may not score what it guided."""

import json
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import cosine_similarity

from diffusion_fixtures import make_pipeline
from mini_fixtures import make_encoders
from palpate.cli import main
from palpate.core import PalpateError, Split
from palpate.diffusion import TactilePipeline, generate, train_generator
from palpate.diffusion.alignment import Alignment, Guide
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.denoiser import Denoiser
from palpate.diffusion.generation import Generated
from palpate.diffusion.presets import TINY
from palpate.diffusion.training import train_denoiser
from palpate.encoders.encoder_set import EncoderSet
from palpate.evaluation import score
from palpate.training.options import LoopOptions


def by_video(manifest):
    train = [i for i in manifest.ids if i < "v4"]
    test = [i for i in manifest.ids if i not in train]
    return Split.from_ids(train=train, test=test, manifest=manifest.digest)


@pytest.mark.parametrize("side", [1, 2, 4])
def test_the_distance_is_the_cosine_of_averaged_features_and_states(side):
    pipeline = make_pipeline()
    guide = Guide(pipeline.unet, 7)
    x, states = torch.randn(3, 3, 8, 8), torch.randn(3, side**2, 7)
    condition = pipeline.denoiser.tokens(torch.randn(3, 6), "text")
    with torch.no_grad():
        pipeline.denoiser(x, torch.tensor([1, 500, 900]), condition)
        far = guide(states)
        assert guide.features.shape == (3, 32, 4, 4)
        blocks = guide.features.unflatten(3, (side, -1)).unflatten(2, (side, -1)).mean((3, 5))
        made = guide.head(blocks.permute(0, 2, 3, 1)).reshape(3, side**2, 7)
    assert torch.allclose(far, 1 - cosine_similarity(made, states, dim=2).mean(1), atol=1e-5)


def train(folder, steps=60, guided=True, **changes):
    torch.manual_seed(0)
    kinds = torch.arange(16) % 2
    states = torch.nn.functional.one_hot(kinds, 5).float()[:, None].expand(-1, 4, -1)
    how = {
        "stats": LatentStats((0.0,) * 3, (1.0,) * 3),
        "unet": TINY.unet,
        "policy": TINY.condition_for(6),
        "schedule": replace(TINY.schedule, prediction="flow"),
        "loop": LoopOptions(steps, 8, 3e-3, warmup=5, ema=0.9),
    }
    z = (2.0 * kinds - 1).reshape(-1, 1, 1, 1) + 0.1 * torch.randn(16, 3, 8, 8)
    conditions = {"text": torch.randn(16, 6)} | ({"guide": states.numpy()} if guided else {})
    return train_denoiser(z, conditions, folder=folder, **how | changes)


def test_the_middle_block_learns_what_the_encoder_sees_and_the_head_is_left(tmp_path):
    model = train(tmp_path / "run")
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert log[0]["align"] > 0.7
    assert log[-1]["align"] < 0.4
    assert model.guide is None
    assert not model.unet.mid_block._forward_hooks
    assert not any("guide" in name for name in model.state_dict())
    model.save(tmp_path / "unet")
    Denoiser.load(tmp_path / "unet", model.policy)
    # Without weight it is trained as without an encoder.
    no_clip = LoopOptions(2, 8, 1e-3, warmup=0, clip_norm=None)
    plain = train(tmp_path / "plain", guided=False, loop=no_clip)
    for weight in (0.0, 0.5):
        made = train(tmp_path / f"{weight}", align_weight=weight, loop=no_clip)
        pairs = zip(made.parameters(), plain.parameters(), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs) == (weight == 0)


def test_the_guide_stands_in_the_card_and_with_the_images_and_may_not_score(
    small_manifest, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    encoders, guide = make_encoders(), make_encoders(7)
    guide.save(tmp_path / "guide")
    encoders.save(tmp_path / "encoders")
    split = by_video(small_manifest)
    small_manifest.save(tmp_path / "tag" / "manifest.parquet")
    split.save(tmp_path / "split.json")
    command = ["train", "generator", "tag", "--split", "split.json", "--preset", "tiny"]
    options = ["--clip", "encoders", "--steps", "1", "--align", "guide", "--align-weight", "0.3"]
    assert main([*command, *options, "-o", "model"]) == 0
    model = TactilePipeline.from_pretrained(tmp_path / "model", device="cpu")
    digest = guide.digest("tactile")
    assert model.training["align"] == {"encoder": digest, "modality": "tactile", "weight": 0.3}
    assert digest in (tmp_path / "model" / "README.md").read_text()
    # A generator that goes on from it is guided, too.
    record = {"start_record": dict(model.training)}
    assert replace(model, training=record).guides == model.guides == [digest]
    generate(small_manifest, split=split, model=model, output="out")
    assert Generated.load(tmp_path / "out").settings["guides"] == [digest]
    how = {"split": split, "permutations": 0, "companions": []}
    with pytest.raises(PalpateError, match="'out', whose training followed this encoder"):
        score("out", small_manifest, encoder=guide, **how)
    for encoder, allow in ((guide, True), (encoders, False)):
        results = score("out", small_manifest, encoder=encoder, allow_seen=allow, **how)
        noted = {s.subject: any(n.code == "aligned" for n in s.notes) for s in results}
        assert noted["out"] == allow
    capsys.readouterr()
    paths = ["--generated", "out", "--reference", "tag", "--split", "split.json"]
    assert main(["score", *paths, "--encoder", "guide", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "not aligned with it" in error
    assert len(error.strip().splitlines()) == 1


def test_a_clip_guides_by_what_it_sees_in_tactile_images(small_manifest, tmp_path):
    clip = EncoderSet(make_encoders().clip)
    align = Alignment(clip, 0.5)
    assert align.about["encoder"] == clip.digest("vision")
    states = align.states(small_manifest, tmp_path, lambda *_: None)
    assert states.shape == (len(small_manifest), 64, 16)
    for weight in (-1.0, float("nan"), float("inf")):
        with pytest.raises(PalpateError, match="`align_weight` must be a finite number"):
            train_generator(
                small_manifest,
                by_video(small_manifest),
                clip,
                preset="tiny",
                align=clip,
                align_weight=weight,
            )
