"""Training of encoders by contrast (paper section 3; the losses are in ``losses``).

Vision and text are frozen, so L_vision,text moves only the temperature; it stays in the loss and in
the log because the paper has it there.

The tactile encoder trains on the train part of a split only, against embeddings of the frozen
encoders that are computed once. The batch stays whole on any number of processes and however many
rows the encoder sees at a time: every row is compared with all others of the batch.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from transformers import CLIPModel, CLIPVisionModelWithProjection

from palpate.core import Progress, Split, digest_json, fields_of, quiet, require
from palpate.data.images import Preprocess, cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.data.recordings import resampled_by
from palpate.data.residuals import with_gels
from palpate.encoders.courses import facts_of, fitted, require_held_out, require_rows, sides, stamps
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import (
    EncoderSet,
    encode_tactile,
    encode_text,
    encode_vision,
    family_of,
    load_clip,
    new_tactile,
)
from palpate.encoders.gel import GelEncoder
from palpate.encoders.losses import (
    LOG_SCALE_START,
    clamped_scale,
    in_chunks,
    info_nce,
    text_targets,
    three_way,
)
from palpate.encoders.models import digest_images, digest_tensors, pick_device, union
from palpate.encoders.presets import Course, EncoderPreset, Gel, Targets, preset_of
from palpate.encoders.rows import (
    Rows,
    augmented,
    bytes_to_unit,
    draw_augmentation,
    factorize,
    load_samples,
    train_part,
    with_values,
)
from palpate.encoders.tokenizer import train_tokenizer
from palpate.metrics.probe import material_accuracy
from palpate.training.engine import Batch, Losses, Task
from palpate.training.options import Compute
from palpate.training.processes import agreed, connect, first_alone, gather_rows
from palpate.training.run import TrainingRun, estimate, finished, request_of, run_for
from palpate.training.steps import Step, seeded


def train_encoder(
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    *,
    preset: str | EncoderPreset = "mini",
    clip: str | Path | EncoderSet | None = None,
    output: Path | str | None = None,
    epochs: float | None = None,
    seed: int = 0,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> EncoderSet:
    """Train a tactile encoder on the train part of a split, against vision and text.

    The loss of the part ``val``, where the split has one, is measured while it trains.

    The accuracy of a linear material probe on the test part goes into the card
    (``card["scores"]``). Run again with the same ``output`` to resume. Under ``torchrun`` every
    process calls this; the first one writes.

    Args:
        data: a manifest, or anything that :func:`palpate.data.load` reads.
        split: a split or its file; its digest goes into the card. Default: the one that lies with
            the data.
        preset: ``mini``, ``tiny``, ``tvl-tiny``, ``tvl-small``, ``tvl-base`` or ``paper``; ``gel``
            or ``self``, the learned ruler (:mod:`palpate.encoders.gel`), by all that the data say
            or by touches alone; or a preset.
        clip: hub id or folder of a frozen CLIP, or ``palpate/mini``; a DINO, which teaches without
            texts. Default: the preset's, or a small one that is trained first on the same train
            part.
        output: folder for the encoders, new or empty; None keeps them in memory.
        epochs: of the tactile encoder; default: the preset's.
        seed: of weights, order and augmentation.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Returns:
        All three encoders, or by touches alone the ruler, with a card.

    Raises:
        PalpateError: if the train part is empty, or a sample of it lacks an image.
    """
    chosen = preset_of(preset, epochs)
    manifest, split = load_samples(data, split)
    request = request_of(seed, manifest, split, chosen, clip)
    if finished(output, request):
        return EncoderSet.load(str(output))
    with run_for(output, request, seed, device=device, compute=compute, progress=progress) as run:
        source = clip or chosen.pretrained
        if source is None:
            source = train_clip(manifest, split, chosen, run.stage("clip"))
        elif not isinstance(source, EncoderSet):
            source = (EncoderSet.load if chosen.alone else load_clip)(source)
        train, gel = train_tactile, isinstance(chosen.tactile, Gel)
        if gel:
            from palpate.encoders.gel_training import train_ruler

            train = train_ruler
        encoders = train(manifest, split, source, chosen, run.stage("tactile"))
        if gel:
            with first_alone():
                _, (manifest,) = with_gels(manifest, [], run.folder / "gels")
        parts = [
            with_values(manifest.part(split, part), "tactile", "material")
            for part in ("train", "test")
        ]
        if len(parts[1]) and len(set(parts[0].column("material"))) > 1:
            tables, kept = [p.table for p in parts], str(split.rule.get("group"))
            level, doubt, _ = resampled_by(tables, "auto", kept, paired=True)
            groups = "id" if level == "frame" else level
            with first_alone():
                embedded = partial(embed, groups=groups, cache=run.cache, progress=progress)
                features = [embedded(part, encoders) for part in parts]
            score = material_accuracy(features[0], features[1], split=split.digest)
            row = {
                "score": "linear probe of material, tactile",
                "value": score.value,
                "interval": None if doubt else score.interval,
                "chance": score.details.get("chance"),
                "n": score.n,
            }
            encoders.card["scores"] = json.loads(json.dumps([row]))
        run.keep(encoders, output)
    return encoders


def plan_encoder(
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    *,
    preset: str | EncoderPreset = "mini",
    epochs: float | None = None,
    device: str = "auto",
) -> dict[str, Any]:
    """What :func:`train_encoder` would take; only the manifest is read.

    Returns:
        see :func:`palpate.training.run.estimate`.
    """
    chosen = preset_of(preset, epochs)
    train = train_part(*load_samples(data, split))

    gel = isinstance(chosen.tactile, Gel)

    def forward(model: Any, rows: int, where: torch.device) -> Tensor:
        pixels = torch.zeros((1 + gel) * rows, 3, chosen.image, chosen.image, device=where)
        return model.shared(model(pixels)) if gel else encode_tactile(model, pixels)

    def build() -> nn.Module:
        if isinstance(chosen.tactile, Gel):
            return GelEncoder(chosen.tactile.widths, chosen.dim, chosen.image)
        return CLIPVisionModelWithProjection(chosen.tactile_config(chosen.dim))

    options = chosen.tactile_course.options(len(train), 0)
    return estimate(build, forward, options, len(train), pick_device(device))


class TactileModel(nn.Module):
    """What trains: the tactile encoder and the temperature."""

    def __init__(self, tactile: CLIPVisionModelWithProjection) -> None:
        super().__init__()
        self.tactile = tactile
        self.log_scale = nn.Parameter(torch.tensor(LOG_SCALE_START))


@dataclass
class TactileLoss:
    """The loss of a batch of :class:`~palpate.encoders.rows.Rows`."""

    rows: Rows
    preprocess: Preprocess
    targets: Targets
    chunk: int | None = None

    def encode(self, module: nn.Module, unit_images: Tensor) -> Tensor:
        """Tactile images (b, 3, h, w) in [0, 1] to embeddings."""
        assert isinstance(module, TactileModel)
        return encode_tactile(module.tactile, self.preprocess.normalize(unit_images))

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        """Return the loss of the three pairs, and each of them to log."""
        assert isinstance(module, TactileModel)
        scale = clamped_scale(module.log_scale)
        images = augmented(bytes_to_unit(batch["images"]), batch)
        tactile = in_chunks(partial(self.encode, module), images, self.chunk)
        total, logs = three_way(
            gather_rows(tactile, batch=len(batch["caption_ids"])),
            batch.get("text"),
            batch.get("vision"),
            scale,
            batch["caption_ids"],
            photos=batch.get("has_photo"),
            targets=self.targets,
        )
        return Losses(total, {**logs, "scale": scale.detach()}, tactile.sum(dim=1))


def train_tactile(
    manifest: Manifest, split: Split, clip: EncoderSet, preset: EncoderPreset, run: TrainingRun
) -> EncoderSet:
    """Train a tactile encoder against vision and text; run again to resume.

    Args:
        manifest: samples with tactile images; rows without a photo are left out of the vision
            pairs.
        split: its parts ``train`` and ``val`` are read; its digest goes into the card.
        clip: vision and text to learn from; moved to the run's device.
        preset: size and course.
        run: folders, seed and machine.

    Returns:
        All three encoders with a card.

    Raises:
        PalpateError: if the train part is empty, or a sample lacks a tactile image.
    """
    where = pick_device(connect(str(run.device)))
    train, held = train_part(manifest, split), manifest.part(split, "val")
    clip.to(where)
    with first_alone():
        rows, held_rows = (
            Rows(part, clip, preset.preprocess, run.cache, run.progress) if len(part) else None
            for part in (train, held)
        )
    assert rows is not None
    tactile = new_tactile(preset.tactile_config(clip.dim), run.seed)
    preprocess = _with_statistics(preset, rows.images, preset.preprocess)
    course = preset.tactile_course
    with fields_of("tactile_course"):
        options = course.options(len(train), run.seed)
    with agreed():
        require_rows(train, options.batch)
        must = "A vision encoder without text must have two photos to teach"
        taught = clip.tokenizer is not None or int((rows.photo >= 0).sum()) > 1
        require(taught, None, must, "fewer in the train part", fix="Choose a CLIP")
        require_held_out(held, options)
    texts = rows.captions, rows.text_source
    facts = facts_of(preset, train, split, texts, options)
    facts |= {m: clip.digest(m) if m in clip.modalities else None for m in ("vision", "text")}
    facts |= {"held_out": held.digest} if len(held) else {}
    facts |= {"without_photo": rows.without_photo} if rows.without_photo else {}
    model = TactileModel(tactile).to(where)
    task = Task(
        "training the tactile encoder",
        len(train),
        lambda step: rows.load(step, course.augment),
        TactileLoss(rows, preprocess, preset.targets, run.compute.chunk),
        digest_json([facts, stamps(train)]),
        train.ids,
        None if held_rows is None else (len(held), held_rows.load),
    )
    card = fitted(model, task, options, facts, run) | {
        "clip": clip.name,
        "clip_card": clip.clip_card,
    }
    card["synthetic"] = train.synthetic
    seen = union(digest_images(rows.images))
    return replace(
        clip,
        tactile=model.tactile,
        sensor=None,
        preprocesses={**clip.preprocesses, "tactile": preprocess},
        card=card,
        seen={**clip.seen, "tactile": seen},
    )


def _with_statistics(
    preset: EncoderPreset, images: NDArray[np.uint8], geometry: Preprocess
) -> Preprocess:
    """CLIP's constants, or mean and deviation per channel of at most 2,000 evenly spaced images."""
    if not preset.data_statistics:
        return geometry
    some = np.asarray(images[:: max(1, len(images) // 2000)], dtype=np.float64).reshape(-1, 3) / 255
    mean, std = some.mean(axis=0), np.maximum(some.std(axis=0), 1 / 255)
    mean, std = (tuple(float(v) for v in values.round(6)) for values in (mean, std))
    return replace(geometry, mean=mean, std=std)


def new_clip(
    preset: EncoderPreset, texts: Sequence[str], seed: int, preprocess: Preprocess | None = None
) -> EncoderSet:
    """A CLIP with random weights and a tokenizer learned from ``texts``, to be trained.

    Args:
        preset: one that describes a fresh CLIP.
        texts: what the tokenizer is learned from.
        seed: of the weights.
        preprocess: for the vision encoder; default: CLIP's constants at the preset's size.
    """
    tokenizer = train_tokenizer(texts, vocabulary=preset.vocabulary, context=preset.context)
    config = preset.clip_config(len(tokenizer))
    with seeded(seed, "clip"):
        model = CLIPModel(config)
    with torch.no_grad():
        model.logit_scale.fill_(LOG_SCALE_START)
    model.eval().requires_grad_(False)
    preprocess = preprocess or Preprocess(preset.image, preset.image)
    return EncoderSet(model, tokenizer, preprocesses={"vision": preprocess}, name=preset.name)


def train_clip(
    manifest: Manifest,
    split: Split,
    preset: EncoderPreset,
    run: TrainingRun,
    *,
    start: EncoderSet | None = None,
) -> EncoderSet:
    """Train a fresh vision and text encoder on the train part of a split, by InfoNCE of that pair.

    Arguments as :func:`train_tactile`. Without photos the vision encoder is trained on the tactile
    images, as the text encoder needs a partner; the card says so. Run again to resume.

    With ``start`` its vision encoder goes on, against its text encoder as it is (LiT, Zhai et al.
    2022): what was trained in the space of its texts stays valid. Its size is its own.

    Returns:
        Vision and text, frozen, with a card.

    Raises:
        PalpateError: if the train part is empty or has one photo, ``start`` is no CLIP, or the
            preset takes a pretrained CLIP, or has this course keep the best weights or stop early.
    """
    where = pick_device(connect(str(run.device)))
    train = train_part(manifest, split)
    side = sides(train)[0]
    pictured, course = with_values(train, side), _clip_course(preset)
    with fields_of("clip_course"):
        options = course.options(len(pictured), run.seed)
    with agreed():
        noun = "photos" if side == "vision" else "samples"
        require_rows(pictured, options.batch, noun, "clip_course")
    texts, source = texts_of(pictured)
    geometry = (
        Preprocess(preset.image, preset.image) if start is None else start.preprocess("vision")
    )
    with first_alone():
        images = cached_images(pictured, side, geometry, run.cache, run.progress)
    if start is None:
        clip = new_clip(preset, texts, run.seed, _with_statistics(preset, images, geometry))
        clip.clip.requires_grad_(True)
    else:
        clip = _copy_that_sees(start)
    clip.to(where)
    preprocess = clip.preprocess("vision")
    caption_ids, distinct = factorize(texts), sorted(set(texts))

    def load(step: Step) -> Batch:
        batch = draw_augmentation(course.augment, step)
        batch["images"] = torch.from_numpy(np.array(images[step.rows]))
        batch["caption_ids"] = caption_ids[torch.from_numpy(step.all_rows)]
        batch["phrase"] = batch["caption_ids"][step.mine]
        return batch

    def loss(module: nn.Module, batch: Batch) -> Losses:
        pixels = preprocess(augmented(bytes_to_unit(batch["images"]), batch))
        encoded = in_chunks(partial(encode_vision, module), pixels, run.compute.chunk)
        some, inverse = torch.unique(batch["phrase"], return_inverse=True)  # each text once
        text = encode_text(module, clip.tokenizer, [distinct[int(k)] for k in some])[inverse]
        text, scale = gather_rows(text), clamped_scale(clip.clip.logit_scale)
        with torch.autocast(encoded.device.type, enabled=False):
            vision, text = gather_rows(encoded).float(), text.float()
            targets = text_targets(preset.targets, batch["caption_ids"], text)
            total = info_nce(vision, text, scale, targets)
        return Losses(total, {"scale": scale.detach()}, encoded.sum(dim=1))

    facts = facts_of(preset, pictured, split, (texts, source), options)
    if start is not None:
        facts |= {m: start.digest(m) for m in ("vision", "text")}
        facts |= {"start": digest_tensors(start.clip.state_dict())}
    facts |= {} if side == "vision" else {"trained_on": "tactile images, not photos"}
    if missing := len(train) - len(pictured):
        facts["without_photo"] = missing
    key = digest_json([facts, image_stamp(pictured, side)])
    task = Task("training vision and text", len(pictured), load, loss, key, pictured.ids)
    clip.clip_card = fitted(clip.clip, task, options, facts, run) | clip.clip_card
    clip.seen = {
        "vision": union(digest_images(images), start.seen.get("vision") if start else None)
    }
    return clip


def _copy_that_sees(start: EncoderSet) -> EncoderSet:
    """A copy whose text encoder stays as it is; its card says what it was."""
    family = "nothing" if start.clip is None else family_of(start.clip)
    must, fix = "must be a CLIP, whose vision encoder goes on", "Pass another, or leave it out"
    require(family == "clip", "start", must, f"a {family}", fix=fix)
    card = {"start_card": start.clip_card, "seen_in_part": not start.knows_seen("vision")}
    card |= {k: v for k, v in start.clip_card.items() if k == "license"}
    copied = replace(start.without_tactile(), clip=copy.deepcopy(start.clip), clip_card=card)
    copied.clip.requires_grad_(True)
    for part in (copied.clip.text_model, copied.clip.text_projection):
        part.requires_grad_(False)
    return copied


def _clip_course(preset: EncoderPreset) -> Course:
    course = preset.clip_course
    got, fix = f"{preset.name}, which takes {preset.pretrained}", "Pass a clip, or the preset mini"
    require(course is not None, "preset", "must describe a fresh CLIP", got, fix=fix)
    assert course is not None
    with agreed():
        must = "The course of vision and text has no held-out part and must run to its end"
        require(not course.patience, None, must, f"patience {course.patience}")
    return course
