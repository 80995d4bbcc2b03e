"""Contrastive training of the encoders (paper section 3). Rows of a, b are L2-normalized and belong together row by row:

    L_ab = -1/(2N) sum_i [ log softmax_j(a_i.b_j / tau)_i + log softmax_j(b_i.a_j / tau)_i ],
    L    = (w_tt L_touch,text + w_vt L_vision,text + w_tv L_touch,vision) / (w_tt + w_vt + w_tv),      w = 1: the mean of the three pairs.

1 / tau is learned, from 1 / 0.07, and kept at or below 100. Vision and text are frozen, so L_vision,text moves only the temperature; it
stays in the loss and in the log because the paper has it there.

Captions repeat: every frame of a video, and often every object of a kind, has the same one, so the plain diagonal calls equal texts
negatives. ``targets="identical-text"`` spreads the target mass of the two text pairs equally over rows with equal text. It is the
default of the mini preset (where captions come from templates); ``diagonal`` is the paper's and that of its preset.

The tactile encoder trains on the train part of a split only, against embeddings of the frozen encoders that are computed once. With one
process all negatives are in the loss; nothing here splits a batch over processes.
"""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import transformers
from torch import Tensor, nn
from transformers import CLIPModel, CLIPVisionModelWithProjection

from palpate import __version__
from palpate.core import PalpateError, Progress, Split, digest_json, digest_lines, quiet
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import (
    ClipEncoders,
    EncoderSet,
    encode_touch,
    move,
    new_touch,
    pick_device,
    seeded,
)
from palpate.encoders.preprocess import (
    CLIP_MEAN,
    CLIP_STD,
    Augment,
    Preprocess,
    statistics,
    to_unit,
)
from palpate.encoders.presets import EncoderPreset, Targets
from palpate.encoders.tokenizer import train_tokenizer
from palpate.training.loop import LoopOptions, fit

#: The learned parameter is the logarithm of 1 / tau.
LOG_SCALE_START = math.log(1 / 0.07)
LOG_SCALE_MAX = math.log(100.0)


def soft_targets(texts: Tensor) -> Tensor:
    """Targets (n, n) that spread each row's mass equally over the rows with the same text number (n,)."""
    same = (texts[:, None] == texts[None, :]).float()
    return same / same.sum(dim=1, keepdim=True)


def info_nce(a: Tensor, b: Tensor, scale: Tensor | float, targets: Tensor | None = None) -> Tensor:
    """Symmetric InfoNCE of one pair of modalities.

    Args:
        a: (n, d), L2-normalized.
        b: (n, d), L2-normalized; row i belongs to row i of ``a``.
        scale: 1 / tau.
        targets: symmetric (n, n) with rows that sum to 1, or None for the diagonal (paper section 3).

    Returns:
        The scalar loss in nats.
    """
    logits = scale * a @ b.T
    target = torch.arange(len(a), device=a.device) if targets is None else targets
    return (F.cross_entropy(logits, target) + F.cross_entropy(logits.T, target)) / 2


def three_way(
    touch: Tensor,
    text: Tensor,
    vision: Tensor,
    scale: Tensor | float,
    *,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    text_targets: Tensor | None = None,
) -> tuple[Tensor, dict[str, float]]:
    """The paper's loss over three pairs.

    Args:
        touch: (n, d), L2-normalized.
        text: (n, d), the same.
        vision: (n, d), the same.
        scale: 1 / tau.
        weights: of touch-text, vision-text, touch-vision; the total is their weighted mean.
        text_targets: for the two text pairs, see :func:`info_nce`.

    Returns:
        The total, and the three losses by name.

    Raises:
        PalpateError: on weights that are not three numbers of at least 0 with a positive sum.
    """
    if len(weights) != 3 or min(weights) < 0 or not sum(weights) > 0:
        raise PalpateError(
            "weights must be three numbers >= 0 with a positive sum",
            f"{tuple(weights)}",
            "Pass e.g. (1, 1, 1)",
        )
    pairs = {
        "touch_text": info_nce(touch, text, scale, text_targets),
        "vision_text": info_nce(vision, text, scale, text_targets),
        "touch_vision": info_nce(touch, vision, scale),
    }
    total = torch.stack(
        [w * loss for w, loss in zip(weights, pairs.values(), strict=True)]
    ).sum() / sum(weights)
    return total, {name: float(loss.detach()) for name, loss in pairs.items()}


class TouchModel(nn.Module):
    """What trains: the tactile encoder and the temperature."""

    def __init__(self, touch: CLIPVisionModelWithProjection) -> None:
        super().__init__()
        self.touch = touch
        self.log_scale = nn.Parameter(torch.tensor(LOG_SCALE_START))


def touch_loss(
    model: TouchModel,
    pixels: Tensor,
    text: Tensor,
    vision: Tensor,
    *,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    text_targets: Tensor | None = None,
) -> tuple[Tensor, dict[str, float]]:
    """One batch through the tactile encoder, against frozen text and vision embeddings; the temperature is clamped first."""
    scale = clamped_scale(model.log_scale)
    total, logs = three_way(
        encode_touch(model.touch, pixels),
        text,
        vision,
        scale,
        weights=weights,
        text_targets=text_targets,
    )
    return total, {**logs, "scale": float(scale.detach())}


def clamped_scale(log_scale: Tensor) -> Tensor:
    """1 / tau, after pulling the parameter itself back to log 100: a clamp of the value alone would end its gradient there."""
    with torch.no_grad():
        log_scale.clamp_(max=LOG_SCALE_MAX)
    return log_scale.exp()


def train_touch(
    manifest: Manifest,
    split: Split,
    clip: ClipEncoders,
    preset: EncoderPreset,
    folder: Path,
    *,
    epochs: float | None = None,
    seed: int = 0,
    targets: Targets | None = None,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    start: EncoderSet | None = None,
    cache: Path | None = None,
    device: str = "auto",
    progress: Progress = quiet,
) -> EncoderSet:
    """Trains a tactile encoder beside a frozen CLIP on the train part of a split. Run again to resume.

    Args:
        manifest: samples with tactile and vision images, and a text or a material.
        split: only its part ``train`` is read; its digest goes into the card.
        clip: the frozen encoders; moved to ``device``.
        preset: size and course.
        folder: of the checkpoint and the log.
        epochs: instead of the preset's.
        seed: of the initial weights, the order and the augmentation.
        targets: instead of the preset's.
        weights: of the pairs touch-text, vision-text, touch-vision.
        start: go on from this set's tactile encoder instead of random weights (which are the paper's); it must have the preset's
            size, keeps its own preprocessing, and its card goes into the new card, so that what it saw stays declared.
        cache: folder for decoded pixels and frozen embeddings.
        device: see :func:`palpate.encoders.encoder_set.pick_device`.
        progress: told each step.

    Returns:
        All three encoders with a card.

    Raises:
        PalpateError: if the train part is empty or has samples without a touch image, photo, or text and material.
    """
    place = pick_device(device)
    train = _train_part(manifest, split)
    move(clip.model, place)
    encoders = EncoderSet(clip)
    texts, text_source = texts_of(train)
    images = cached_images(train, "tactile", preset.image, cache, progress)
    frozen = {
        t: torch.from_numpy(embed(train, encoders, t, cache=cache, progress=progress).features).to(
            place
        )
        for t in ("text", "vision")
    }
    touch, preprocess = _start(preset, clip.dim, images, seed, start)
    options = preset.touch_course.options(len(train), seed, epochs)
    mode = targets or preset.targets
    numbers = _numbers(texts).to(place)

    def loss(
        module: nn.Module, rows: Tensor, generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        assert isinstance(module, TouchModel)
        pixels = _augmented(images, rows, preset.touch_course.augment, preprocess, generator, place)
        rows = rows.to(place)
        soft = soft_targets(numbers[rows]) if mode == "identical-text" else None
        return touch_loss(
            module,
            pixels,
            frozen["text"][rows],
            frozen["vision"][rows],
            weights=weights,
            text_targets=soft,
        )

    model = TouchModel(touch).to(place)
    facts = _facts(preset, train, split, texts, text_source, options, seed) | {
        "targets": mode,
        "weights": list(weights),
        "vision": clip.digest("vision"),
        "text": clip.digest("text"),
        "start": start.digest("tactile") if start else None,
    }
    log = fit(
        model,
        loss,
        len(train),
        options,
        folder,
        what="training the tactile encoder",
        key=digest_json([facts, _stamps(train)]),
        progress=progress,
    )
    touch = model.touch.eval().requires_grad_(False)
    card = _card(facts, options, log, place) | {
        "clip": clip.name,
        "clip_card": clip.card,
        "start_card": start.card if start else None,
    }
    return EncoderSet(clip, touch, preprocess, card)


def _start(
    preset: EncoderPreset, dim: int, images: np.ndarray, seed: int, start: EncoderSet | None
) -> tuple[CLIPVisionModelWithProjection, Preprocess]:
    """The tactile encoder to train, and its preprocessing: random weights, or a copy of another set's encoder."""
    touch = new_touch(preset.touch_config(dim), seed)
    if start is None:
        mean, std = statistics(images) if preset.own_statistics else (CLIP_MEAN, CLIP_STD)
        return touch, Preprocess.of_size(preset.image, mean, std)
    before = start.preprocess("tactile")
    state = start.touch.state_dict() if start.touch is not None else {}
    shapes = [{name: tuple(v.shape) for name, v in s.items()} for s in (state, touch.state_dict())]
    if shapes[0] != shapes[1] or before.size != preset.image or before.resize != preset.image:
        raise PalpateError(
            f"The tactile encoder to start from must have the size of the preset {preset.name}",
            "another size",
            "Leave it out",
        )
    touch.load_state_dict(state)
    return touch, before


def new_clip(
    preset: EncoderPreset, texts: Sequence[str], seed: int, preprocess: Preprocess | None = None
) -> ClipEncoders:
    """A CLIP with random weights and a tokenizer learned from ``texts``; still to be trained.

    Args:
        preset: one that describes a fresh CLIP.
        texts: what the tokenizer is learned from.
        seed: of the weights.
        preprocess: the vision encoder's transform; default: CLIP's constants at the preset's size.
    """
    tokenizer = train_tokenizer(texts, vocabulary=preset.vocabulary, context=preset.context)
    config = preset.clip_config(len(tokenizer))
    with seeded(seed, "clip"):
        model = CLIPModel(config)
    with torch.no_grad():
        model.logit_scale.fill_(LOG_SCALE_START)
    model.eval().requires_grad_(False)
    return ClipEncoders(
        model, tokenizer, preprocess or Preprocess.of_size(preset.image), preset.name
    )


def train_clip(
    manifest: Manifest,
    split: Split,
    preset: EncoderPreset,
    folder: Path,
    *,
    epochs: float | None = None,
    seed: int = 0,
    targets: Targets | None = None,
    cache: Path | None = None,
    device: str = "auto",
    progress: Progress = quiet,
) -> ClipEncoders:
    """Trains a fresh vision and text encoder on the train part of a split, by InfoNCE of that pair. Run again to resume.

    Arguments as :func:`train_touch`; ``manifest`` needs photos and a text or a material.

    Returns:
        The CLIP, frozen, with a card.

    Raises:
        PalpateError: if the train part is empty, or the preset takes a pretrained CLIP.
    """
    place = pick_device(device)
    train = _train_part(manifest, split)
    texts, text_source = texts_of(train)
    course = preset.clip_course
    if course is None:
        raise PalpateError(
            f"The preset {preset.name} must describe a fresh CLIP",
            f"it takes {preset.pretrained}",
            "Use the preset mini",
        )
    images = cached_images(train, "vision", preset.image, cache, progress)
    mean, std = statistics(images) if preset.own_statistics else (CLIP_MEAN, CLIP_STD)
    clip = new_clip(preset, texts, seed, Preprocess.of_size(preset.image, mean, std))
    move(clip.model, place)
    clip.model.requires_grad_(True)
    options = course.options(len(train), seed, epochs)
    mode = targets or preset.targets
    numbers = _numbers(texts)
    distinct = sorted(set(texts))

    def loss(
        module: nn.Module, rows: Tensor, generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        assert module is clip.model
        vision = clip.encode_vision(
            _augmented(images, rows, course.augment, clip.preprocess, generator, place)
        )
        here, back = torch.unique(
            numbers[rows], return_inverse=True
        )  # each distinct text goes through the encoder once
        text = clip.encode_text([distinct[int(k)] for k in here])[back.to(place)]
        scale = clamped_scale(clip.model.logit_scale)
        soft = soft_targets(back.to(place)) if mode == "identical-text" else None
        return info_nce(vision, text, scale, soft), {"scale": float(scale.detach())}

    facts = _facts(preset, train, split, texts, text_source, options, seed) | {"targets": mode}
    log = fit(
        clip.model,
        loss,
        len(train),
        options,
        folder,
        what="training vision and text",
        key=digest_json([facts, _stamps(train)]),
        progress=progress,
    )
    clip.model.eval().requires_grad_(False)
    clip.card = _card(facts, options, log, place)
    return clip


def _train_part(manifest: Manifest, split: Split) -> Manifest:
    train = manifest.part(split, "train")
    if not len(train):
        raise PalpateError(
            "The train part of the split must hold samples of this manifest",
            "none",
            "Make a split with: palpate split",
        )
    return train


def _stamps(train: Manifest) -> list[str]:
    """What must not have changed on disk for a checkpoint to be continued."""
    return [
        image_stamp(train, column)
        for column in ("vision", "tactile")
        if not train.table[column].null_count()
    ]


def _numbers(texts: Sequence[str]) -> Tensor:
    """Each text's place among the sorted distinct texts, (n,) int64."""
    place = {text: k for k, text in enumerate(sorted(set(texts)))}
    return torch.tensor([place[text] for text in texts], dtype=torch.int64)


def _augmented(
    images: np.ndarray,
    rows: Tensor,
    augment: Augment,
    preprocess: Preprocess,
    generator: torch.Generator,
    device: torch.device,
) -> Tensor:
    """The pixels of one training batch, (b, 3, size, size)."""
    return preprocess.normalize(augment(to_unit(images[rows.numpy()], device), generator))


def _facts(
    preset: EncoderPreset,
    train: Manifest,
    split: Split,
    texts: Sequence[str],
    source: str,
    options: LoopOptions,
    seed: int,
) -> dict[str, Any]:
    """What decides the result of a training run; also the run's key, so that another run's checkpoint is not continued."""
    settings = {k: v for k, v in asdict(preset).items() if k != "cost"}
    course = {k: v for k, v in asdict(options).items() if k != "checkpoint_seconds"}
    return {
        "preset": preset.name,
        "settings": settings,
        "options": course,
        "seed": seed,
        "train_manifest": train.digest,
        "train_samples": len(train),
        "split": split.digest,
        "split_rule": dict(split.rule),
        "texts": digest_lines(texts),
        "distinct_texts": len(set(texts)),
        "text_source": source,
    }


def _card(
    facts: dict[str, Any],
    options: LoopOptions,
    log: Sequence[dict[str, float]],
    device: torch.device,
) -> dict[str, Any]:
    """The facts, the versions, and at most 50 points of the loss curve."""
    keep = (
        sorted({round(k) for k in np.linspace(0, len(log) - 1, min(50, len(log)))}) if log else []
    )
    curve = [
        {k: round(v, 6) for k, v in log[at].items() if k not in ("seconds", "lr")} for at in keep
    ]
    versions = {
        "palpate": __version__,
        "torch": torch.__version__,
        "transformers": transformers.__version__,
        "python": platform.python_version(),
    }
    card = facts | {
        "steps": options.steps,
        "device": device.type,
        "versions": versions,
        "loss": curve,
    }
    return json.loads(json.dumps(card))  # as it will be read back: lists for tuples
