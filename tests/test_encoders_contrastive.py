"""The loss against a slow loop; training of a tactile encoder and of a fresh CLIP."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from transformers import Dinov2Config, Dinov2Model

from forge.errors import fails
from palpate.core import PalpateError, Split, rng_for, seed_for
from palpate.data.manifest import Manifest
from palpate.diffusion.presets import TINY as DIFFUSION
from palpate.diffusion.training import train_generator
from palpate.encoders import contrastive
from palpate.encoders.contrastive import (
    TactileLoss,
    TactileModel,
    new_clip,
    train_clip,
    train_encoder,
    train_tactile,
)
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet, encode_tactile, new_tactile
from palpate.encoders.losses import clamped_scale, in_chunks, info_nce, soft_targets, three_way
from palpate.encoders.presets import Augment, preset_of
from palpate.encoders.rows import Rows
from palpate.training.engine import Task, fit
from palpate.training.options import Compute
from palpate.training.run import TrainingRun

TINY = preset_of("tiny")
FEELS = {
    "Wood": "grained, firm wood",
    "Metal": "cold, smooth metal",
    "Grass": "soft grass",
    "Brick": "coarse, gritty brick",
}


def make_world(root, videos=8, frames=3, size=16):
    """Videos of four materials; the material decides the pattern of photo and tactile image."""
    rows = []
    for v in range(videos):
        material = list(FEELS)[v % 4]
        for k in range(frames):
            rng = rng_for(0, material, v, k)
            wave = np.sin(np.arange(size) * (1 + v % 4))[:, None, None] * 60 + 128
            for suffix in ("v", "t"):
                image = np.clip(wave + rng.normal(0, 20, (size, size, 3)), 0, 255).astype(np.uint8)
                Image.fromarray(image).save(root / f"{v}_{k}_{suffix}.png")
            rows.append(
                {
                    "id": f"v{v}/{k}",
                    "video": f"v{v}",
                    "frame": k,
                    "material": material,
                    "text": FEELS[material],
                    "vision": f"{v}_{k}_v.png",
                    "tactile": f"{v}_{k}_t.png",
                }
            )
    return Manifest.from_rows(rows, root)


def by_video(manifest, train=6):
    side = {i: int(i[1:].split("/")[0]) < train for i in manifest.ids}
    return Split.from_ids(
        train=[i for i in manifest.ids if side[i]], test=[i for i in manifest.ids if not side[i]]
    )


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return make_world(tmp_path_factory.mktemp("world"))


def run(folder, **change):
    return TrainingRun(folder, device="cpu", **change)


def unit(*shape, seed=0):
    return torch.nn.functional.normalize(
        torch.randn(*shape, generator=torch.Generator().manual_seed(seed)), dim=-1
    )


def slow_nce(a, b, scale, target):
    """The formula of paper section 3, term by term, with any target distribution."""
    n, total = len(a), 0.0
    for x, y, t in ((a, b, target), (b, a, target.T)):
        for i in range(n):
            logits = [
                scale * sum(float(p) * float(q) for p, q in zip(x[i], y[j], strict=True))
                for j in range(n)
            ]
            log_sum = math.log(sum(math.exp(v) for v in logits))
            total -= sum(float(t[i][j]) * (logits[j] - log_sum) for j in range(n))
    return total / (2 * n)


def test_loss_equals_the_slow_loop():
    a, b, c = unit(6, 4, seed=1), unit(6, 4, seed=2), unit(6, 4, seed=3)
    words = torch.tensor([0, 1, 0, 2, 1, 0])
    same = [[float(words[i] == words[j]) for j in range(6)] for i in range(6)]
    soft = np.array([[value / sum(row) for value in row] for row in same])
    assert torch.allclose(soft_targets(words).double(), torch.tensor(soft), atol=1e-7)
    plain, shared = info_nce(a, b, 7.0), info_nce(a, b, 7.0, soft_targets(words))
    assert float(plain) == pytest.approx(slow_nce(a, b, 7.0, np.eye(6)), abs=1e-5)
    assert float(shared) == pytest.approx(slow_nce(a, b, 7.0, soft), abs=1e-5)
    # arguments in the order tactile, text, vision
    parts = {
        "tactile_text": slow_nce(a, b, 7.0, soft),
        "vision_text": slow_nce(c, b, 7.0, soft),
        "tactile_vision": slow_nce(a, c, 7.0, np.eye(6)),
    }
    total, logs = three_way(a, b, c, 7.0, words, targets="identical-text")
    assert {name: float(loss) for name, loss in logs.items()} == pytest.approx(parts, abs=1e-5)
    assert float(total) == pytest.approx(sum(parts.values()) / 3, abs=1e-5)


def test_soft_targets_of_distinct_texts_are_the_diagonal():
    a, b = unit(5, 3, seed=1), unit(5, 3, seed=2)
    assert float(info_nce(a, b, 3.0, soft_targets(torch.arange(5)))) == pytest.approx(
        float(info_nce(a, b, 3.0)), abs=1e-6
    )


def test_rows_without_a_photo_are_left_out_of_the_vision_pairs():
    a, b, c = unit(6, 4, seed=1), unit(6, 4, seed=2), unit(6, 4, seed=3)
    seen = torch.tensor([1, 1, 0, 1, 0, 1]).bool()
    _, logs = three_way(a, b, c, 7.0, torch.arange(6), photos=seen)
    _, some = three_way(a[seen], b[seen], c[seen], 7.0, torch.arange(4))
    _, every = three_way(a, b, c, 7.0, torch.arange(6))
    for name, expect in (("vision_text", some), ("tactile_vision", some), ("tactile_text", every)):
        assert float(logs[name]) == pytest.approx(float(expect[name]), abs=1e-6)


def test_soft_text_targets_are_tvl_s():
    a, b = unit(4, 3, seed=1), unit(4, 3, seed=2)
    soft = (b @ b.T / 0.05).softmax(1)
    expect = -(soft * (7 * a @ b.T).log_softmax(1)).sum(1).mean() / 2
    expect -= (soft * (7 * b @ a.T).log_softmax(1)).sum(1).mean() / 2
    total, _ = three_way(a, b, None, 7.0, torch.arange(4), targets="soft-text")
    assert float(total) == pytest.approx(float(expect), abs=1e-5)


@pytest.mark.parametrize("chunk", [1, 4, 7, 12, 99])
def test_cached_gradients_are_those_of_the_whole_batch(chunk):
    model = new_tactile(TINY.tactile_config(8), seed=1)
    pixels = torch.randn(12, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    text, vision = unit(12, 8, seed=2), unit(12, 8, seed=3)
    results = []
    for size in (None, chunk):
        model.zero_grad()
        rows = in_chunks(lambda x: encode_tactile(model, x), pixels, size)
        total, _ = three_way(rows, text, vision, 7.0, torch.arange(12))
        total.backward()
        results.append(
            [total.detach(), *(p.grad for p in model.parameters() if p.grad is not None)]
        )
    for a, b in zip(*results, strict=True):
        assert torch.allclose(a, b, atol=1e-5)


def test_photos_may_be_missing_and_videos_held_out(world, clip, tmp_path):
    rows = world.table.to_dicts()
    for row in rows[:5]:
        row["vision"] = None
    manifest, split = Manifest.from_rows(rows, world.root), with_val(world, 6)
    encoders = train_tactile(manifest, split, clip, quick(), run(tmp_path))
    assert encoders.card["without_photo"] == 5
    assert encoders.card["train_samples"] == 18
    lines = (tmp_path / "log.jsonl").read_text()
    assert lines.count("held_out") > 1


def with_val(manifest, rows):
    """Six videos of train, and so many samples of the others held out."""
    split = by_video(manifest)
    return Split.from_ids(train=split.ids("train"), val=split.ids("test")[:rows])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"split": Split.from_ids(test=["v0/0"])}, "train part"),
        ({"split": Split.from_ids(train=["nobody"])}, r"1 of 1 missing, first .nobody"),
        ({"split": Split.from_ids(train=["v0/0"])}, "must hold two samples"),
        ({"held_out": 1}, r"held-out part must hold two samples.*Got one, v6/0"),
        ({"row": {"tactile": None}}, r"tactile image.*v0/2"),
        ({"row": {"tactile": "gone.png"}}, "1 bad-image"),
        ({"course": {"batch": 1}}, "`tactile_course.batch` must be at least 2"),
        ({"course": {"batch": 0}}, "`tactile_course.batch` must be at least 1"),
        ({"course": {"patience": 2}}, "`tactile_course.patience` needs a part val"),
        ({"device": "abacus"}, "`device` must be auto"),
    ],
)
def test_a_training_of_the_tactile_encoder_that_cannot_be(world, clip, tmp_path, change, message):
    rows = world.table.to_dicts()
    rows[2].update(change.get("row", {}))
    held = with_val(world, change["held_out"]) if "held_out" in change else by_video(world)
    manifest, split = Manifest.from_rows(rows, world.root), change.get("split", held)
    preset = quick(tactile_course=replace(TINY.tactile_course, **change.get("course", {})))
    where = TrainingRun(tmp_path, device=change.get("device", "cpu"))
    fails(message, train_tactile, manifest, split, clip, preset, where)


def test_one_held_out_sample_is_enough_without_evaluations(world, clip, tmp_path):
    preset = quick(tactile_course=replace(TINY.tactile_course, evaluations=0))
    encoders = train_tactile(world, with_val(world, 1), clip, preset, run(tmp_path))
    assert not any("held_out" in line for line in encoders.card["loss"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"photos": 1}, r"must hold two photos.*Got one, v0/0"),
        ({"preset": preset_of("paper")}, "must describe a fresh CLIP"),
        ({"course": {"batch": 1}}, "`clip_course.batch` must be at least 2"),
        ({"course": {"patience": 1}}, "has no held-out part and must run to its end"),
    ],
)
def test_a_training_of_vision_and_text_that_cannot_be(world, tmp_path, change, message):
    photos = change.get("photos", len(world))
    rows = [
        {**r, "vision": r["vision"] if k < photos else None}
        for k, r in enumerate(world.table.to_dicts())
    ]
    course = replace(TINY.clip_course, **change.get("course", {}))
    chosen = change.get("preset", replace(TINY, clip_course=course))
    with pytest.raises(PalpateError, match=message):
        train_clip(Manifest.from_rows(rows, world.root), by_video(world), chosen, run(tmp_path))


def test_a_test_part_without_materials_or_tactile_images_costs_no_training(world, tmp_path):
    split = by_video(world)
    test = split.ids("test")
    for bare, count in ((test, 0), (test[:2], len(test) - 2)):
        for column in ("material", "tactile"):
            rows = [{**r, column: None} if r["id"] in bare else r for r in world.table.to_dicts()]
            manifest, how = Manifest.from_rows(rows, world.root), {"clip": "palpate/mini"}
            encoders = train_encoder(manifest, split, preset=TINY, device="cpu", epochs=0.1, **how)
            assert [row["n"] for row in encoders.card.get("scores", ())] == [count] * bool(count)


@pytest.mark.parametrize("change", [{"crop": 5}, {"crop": -1}, {"gain": -0.1}])
def test_views_out_of_range(change):
    fails(f"`{next(iter(change))}` must lie in", Augment, **change)


def test_gradient_goes_to_the_tactile_encoder_and_the_temperature_only(world):
    clip = new_clip(TINY, world.column("text"), seed=0)
    model = TactileModel(new_tactile(TINY.tactile_config(clip.dim), seed=1))
    text = clip.encode("text", world.column("text")[:6])
    noise = torch.randn(6, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    vision = clip.encode("vision", noise)
    assert not text.requires_grad
    assert not vision.requires_grad
    pixels = torch.randn(6, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    scale = clamped_scale(model.log_scale)
    embedded = encode_tactile(model.tactile, pixels)
    three_way(embedded, text, vision, scale, torch.arange(6))[0].backward()
    weights = dict(model.named_parameters())
    moved = {k for k, p in weights.items() if p.grad is not None and p.grad.abs().max() > 0}
    assert {"log_scale", "tactile.visual_projection.weight"} <= moved
    # A key bias cancels in the softmax.
    assert all("post_layernorm" in k or "k_proj.bias" in k for k in weights.keys() - moved)
    assert all(p.grad is None for p in clip.clip.parameters())
    assert float(scale.detach()) == pytest.approx(1 / 0.07, rel=1e-5)


def test_temperature_is_clamped_and_can_come_back():
    log_scale = torch.nn.Parameter(torch.tensor(9.0))
    scale = clamped_scale(log_scale)
    assert float(scale.detach()) == pytest.approx(100.0, rel=1e-5)
    scale.backward()
    assert log_scale.grad > 0
    assert float(log_scale.detach()) == pytest.approx(math.log(100))


def quick(**change):
    return replace(
        TINY, **{"tactile_course": replace(TINY.tactile_course, epochs=4.0, batch=6), **change}
    )


@pytest.fixture(scope="module")
def clip(world, tmp_path_factory):
    return train_clip(world, by_video(world), TINY, run(tmp_path_factory.mktemp("clip")))


def test_training_moves_the_tactile_encoder_alone_and_records_its_data(world, clip, tmp_path):
    split = by_video(world)
    before = clip.digest("vision"), clip.digest("text")
    encoders = train_tactile(world, split, clip, quick(), run(tmp_path / "a"))
    for each in (clip, encoders):
        assert (each.digest("vision"), each.digest("text")) == before
    start = new_tactile(TINY.tactile_config(clip.dim), seed=0).visual_projection.weight
    assert not torch.equal(start, encoders.tactile.visual_projection.weight)
    card = encoders.card
    assert card["split"] == split.digest
    assert card["train_manifest"] == world.part(split, "train").digest
    assert (card["train_samples"], card["steps"], card["text_source"]) == (18, 12, "manifest")
    losses = {"loss", "tactile_text", "vision_text", "tactile_vision"}
    assert set(card["loss"][0]) == {"step", "scale", *losses}
    assert card["targets"] == "identical-text"
    assert card["clip_card"]["split"] == split.digest
    encoders.save(tmp_path / "out")
    again = EncoderSet.load(tmp_path / "out")
    assert again.card == card
    assert again.digest("tactile") == encoders.digest("tactile")


def test_training_depends_on_the_seed_and_the_train_part_alone(world, clip, tmp_path):
    split = by_video(world)

    def digest(name, manifest=world, preset=None, **change):
        where = run(tmp_path / name, **change)
        return train_tactile(manifest, split, clip, preset or quick(), where).digest("tactile")

    base = digest("a")
    torch.manual_seed(99)
    state = torch.get_rng_state()
    rows = world.table.to_dicts()
    for row in rows:
        if split.parts[row["id"]] == "test":
            row.update(tactile="absent.png", vision="absent.png", text="other words")
    assert digest("b", Manifest.from_rows(rows, world.root), cache=tmp_path / "cache") == base
    assert torch.equal(torch.get_rng_state(), state)
    assert digest("b", seed=1) != base
    assert digest("c", preset=quick(targets="diagonal")) != base


def test_data_without_photos_train_against_words_alone(world, tmp_path):
    bare = [{**row, "vision": None, "text": None} for row in world.table.iter_rows(named=True)]
    bare = Manifest.from_rows(bare, world.root)
    encoders = train_encoder(bare, by_video(world), preset=TINY, device="cpu")
    assert encoders.clip_card["trained_on"] == "tactile images, not photos"
    assert set(encoders.card["loss"][0]) >= {"tactile_text"}
    assert not {"vision_text", "tactile_vision"} & set(encoders.card["loss"][0])
    assert encoders.card["text_source"] == "caption"


def test_fresh_clip_learns(world, tmp_path):
    course = replace(TINY.clip_course, epochs=40.0, batch=18, lr=1e-2)
    clip = train_clip(world, by_video(world), replace(TINY, clip_course=course), run(tmp_path))
    curve = clip.clip_card["loss"]
    assert curve[-1]["loss"] < curve[0]["loss"] - 0.5
    assert not any(p.requires_grad for p in clip.clip.parameters())


def test_vision_goes_on_against_the_text_encoder_as_it_is(world, clip, tmp_path):
    before = {m: clip.digest(m) for m in ("vision", "text")}
    on = train_clip(world, by_video(world), TINY, run(tmp_path / "on", seed=1), start=clip)
    assert {m: clip.digest(m) for m in before} == before  # the first one is not touched
    assert on.digest("text") == before["text"]
    assert on.digest("vision") != before["vision"]
    assert on.preprocesses == clip.preprocesses
    assert on.clip_card["start_card"] == clip.clip_card
    assert {m: on.clip_card[m] for m in before} == before
    assert not any(p.requires_grad for p in on.clip.parameters())
    assert set(clip.seen["vision"]) <= set(on.seen["vision"])
    assert not on.clip_card["seen_in_part"]
    again = train_clip(world, by_video(world), TINY, run(tmp_path / "again", seed=1), start=clip)
    assert again.digest("vision") == on.digest("vision")
    # Nobody knows what a public one saw, whatever it goes on with.
    public = replace(clip, seen={}, clip_card={"license": "cc-by-nc-4.0"})
    short = replace(TINY, clip_course=replace(TINY.clip_course, epochs=0.1))
    for name in ("once", "twice"):
        public = train_clip(world, by_video(world), short, run(tmp_path / name), start=public)
        assert not public.knows_seen("vision")
        assert public.clip_card["license"] == "cc-by-nc-4.0"
    dino = replace(clip, clip=SimpleNamespace(config=SimpleNamespace(model_type="dinov2")))
    with pytest.raises(PalpateError, match="must be a CLIP"):
        train_clip(world, by_video(world), TINY, run(tmp_path / "dino"), start=dino)


def test_paper_preset_is_the_paper():
    paper = preset_of("paper")
    course = paper.tactile_course
    assert (course.epochs, course.batch, paper.targets) == (200, 256, "diagonal")
    options = course.options(13_900, seed=0)
    assert (options.steps, options.warmup, options.lr) == (10860, 543, 1.5e-4)
    assert options.betas == (0.9, 0.95)
    with torch.device("meta"):
        tactile = contrastive.CLIPVisionModelWithProjection(paper.tactile_config(768))
    # ViT-L/14 at 224 px with a 768-wide projection
    assert sum(p.numel() for p in tactile.parameters()) == 303_966_208
    fails("tiny, mini, gel, self, tvl-tiny", preset_of, "huge")


def test_a_vision_encoder_without_text_is_a_partner(world, tmp_path):
    sizes = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    config = Dinov2Config(**sizes, mlp_ratio=2, image_size=32, patch_size=16)
    Dinov2Model(config).save_pretrained(tmp_path / "dino")
    crop = {"size": {"shortest_edge": 32}, "crop_size": {"height": 32, "width": 32}}
    facts = crop | {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "do_center_crop": True}
    (tmp_path / "dino" / "preprocessor_config.json").write_text(json.dumps(facts))
    options = {"preset": TINY, "clip": tmp_path / "dino", "device": "cpu"}
    rows = [{**r, "vision": None} if k else r for k, r in enumerate(world.table.to_dicts())]
    bare = Manifest.from_rows(rows, world.root)
    fails("must have two photos to teach", train_encoder, bare, by_video(world), **options)
    train_encoder(world, by_video(world), output=tmp_path / "e", **options)
    encoders = EncoderSet.load(tmp_path / "e")
    assert encoders.modalities == ["vision", "tactile"]
    with pytest.raises(PalpateError, match=r"`clip` must have text and vision\. Got no text"):
        train_generator(world, by_video(world), encoders, preset="tiny", steps=1)
    photos = replace(DIFFUSION, condition=replace(DIFFUSION.condition, source="vision"))
    alone = train_generator(world, by_video(world), encoders, preset=photos, steps=1)
    assert alone.training["text_source"] is None
    assert len(alone([str(p) for p in world.paths("vision")[:2]], gel=None).images) == 2
    vision, tactile = (embed(world, encoders, side).features for side in encoders.modalities)
    assert tactile.shape == vision.shape == (len(world), 32)


def plain_loop(model, images, text, vision, words, preprocess, options):
    """The training loop as it was before the engine, in float32 on one process.

    Returns:
        the loss of each step, and the averaged weights.
    """
    parameters = list(model.parameters())
    average = [p.detach().clone() for p in parameters]
    matrices, vectors = ([p for p in parameters if (p.ndim > 1) == wide] for wide in (True, False))
    groups = [{"params": matrices, "weight_decay": options.weight_decay}]
    groups += [{"params": vectors, "weight_decay": 0.0}]
    optimizer, losses = torch.optim.AdamW(groups, lr=options.lr, betas=options.betas), []
    for step in range(options.steps):
        generator = torch.Generator().manual_seed(seed_for(options.seed, "step", step))
        epoch, start = divmod(step * options.batch, len(images))
        rows = rng_for(options.seed, "order", epoch).permutation(len(images))
        rows = rows[start : start + options.batch]
        n = len(rows)
        zoom = 1 - 0.1 * torch.rand(n, generator=generator)
        shift = (2 * torch.rand(n, 2, generator=generator) - 1) * (1 - zoom)[:, None]
        for high, shape in ((4, (n,)), (2, (n, 2))):  # turns and flips, which are off
            torch.randint(0, high, shape, generator=generator)
        gain = torch.exp(0.1 * torch.randn(n, generator=generator))
        offset = 0.05 * torch.randn(n, generator=generator)
        window = torch.cat([torch.eye(2) * zoom[:, None, None], shift[:, :, None]], dim=2)
        x = torch.from_numpy(images[rows]).permute(0, 3, 1, 2) / 255
        grid = torch.nn.functional.affine_grid(window, list(x.shape), align_corners=False)
        x = torch.nn.functional.grid_sample(x, grid, align_corners=False, padding_mode="reflection")
        x = preprocess.normalize(x * gain.view(n, 1, 1, 1) + offset.view(n, 1, 1, 1))
        z = model.tactile(pixel_values=x).image_embeds
        z, t, v = z / z.norm(dim=1, keepdim=True), text[rows], vision[rows]
        same = (words[rows][:, None] == words[rows][None, :]).float()
        same = same / same.sum(dim=1, keepdim=True)
        loss = 0.0
        for a, b, target in ((z, t, same), (v, t, same), (z, v, torch.eye(n))):
            logits = model.log_scale.exp() * a @ b.T
            for each in (logits, logits.T):
                loss = loss - (target * each.log_softmax(dim=1)).sum(dim=1).mean() / 6
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, options.clip_norm)
        through = max(0, step - options.warmup) / (options.steps - options.warmup)
        rate = options.lr * (1 + math.cos(math.pi * through)) / 2
        for group in optimizer.param_groups:
            group["lr"] = min(1, (step + 1) / options.warmup) * rate
        optimizer.step()
        decay = min(options.ema, (1 + step) / (10 + step))
        with torch.no_grad():
            average = [
                decay * a + (1 - decay) * p for a, p in zip(average, parameters, strict=True)
            ]
        losses.append(float(loss.detach()))
    return losses, average


def test_losses_and_averaged_weights_are_those_of_the_loop_before_the_engine(world, clip, tmp_path):
    """The batch divides the rows, so that none crosses the border of two epochs: those changed."""
    train, course = world.part(by_video(world), "train"), replace(TINY.tactile_course, batch=6)
    options = replace(replace(course, epochs=7).options(len(train), seed=3), warmup=4, ema=0.9)
    rows = Rows(train, clip, TINY.preprocess)
    loss = TactileLoss(rows, TINY.preprocess, "identical-text")
    task = Task("training", len(train), lambda step: rows.load(step, course.augment), loss)
    engine, plain = (TactileModel(new_tactile(TINY.tactile_config(8), seed=3)) for _ in range(2))
    log = fit(engine, task, options, tmp_path)
    text = torch.from_numpy(embed(train, clip, "text").features)
    losses, average = plain_loop(
        plain, rows.images, text, rows.vision, rows.caption_ids, TINY.preprocess, options
    )
    assert [line["step"] for line in log] == [0, 10, 20]
    for line in log:
        assert line["loss"] == pytest.approx(losses[line["step"]], abs=1e-6)
    assert losses[-1] < losses[0] - 0.1
    for ours, theirs in zip(engine.parameters(), average, strict=True):
        assert torch.allclose(ours, theirs, atol=1e-5)


def test_two_processes_take_the_steps_of_one(world, clip, tmp_path, on_two_processes):
    train, course = world.part(by_video(world), "train"), replace(TINY.tactile_course, batch=6)
    rows, options = (
        Rows(train, clip, TINY.preprocess),
        replace(course, epochs=4).options(18, seed=3),
    )
    loss = TactileLoss(rows, TINY.preprocess, "identical-text")
    task = Task("training", 18, lambda step: rows.load(step, course.augment), loss)

    def losses(folder="two"):
        model = TactileModel(new_tactile(TINY.tactile_config(8), seed=3))
        return [line["loss"] for line in fit(model, task, options, tmp_path / folder)]

    one, two = losses("one"), on_two_processes(losses)
    assert two[0] == two[1] == pytest.approx(one, abs=1e-4)
    assert len(one) > 1


@pytest.mark.filterwarnings("error::FutureWarning")
def test_gradient_checkpointing_changes_nothing_and_warns_of_nothing(world, clip, tmp_path):
    digests = set()
    for again in (False, True):
        where = run(tmp_path / f"{again}", compute=Compute(gradient_checkpointing=again))
        encoders = train_tactile(world, by_video(world), clip, TINY, where)
        digests.add(encoders.digest("tactile"))
    assert len(digests) == 1
