"""Contrastive training (paper section 3). Rows of a, b are L2-normalized and belong together:

    L_ab = -1/(2N) sum_i [ log softmax_j(a_i.b_j / tau)_i + log softmax_j(b_i.a_j / tau)_i ],
    L    = (w_1 L_tactile,text + w_2 L_vision,text + w_3 L_tactile,vision) / (w_1 + w_2 + w_3)

1 / tau is learned, from 1 / 0.07, and kept at or below 100. Vision and text are frozen, so
L_vision,text moves only the temperature; it stays in the loss and in the log because the paper has
it there.

Captions repeat: every frame of a video, and often every object of a kind, has the same one, so the
plain diagonal calls equal texts negatives. ``targets="identical-text"`` spreads the target mass of
the two text pairs equally over rows with equal text: the default of the preset mini; ``diagonal``
is the paper's.

The tactile encoder trains on the train part of a split only, against embeddings of the frozen
encoders that are computed once. With one process all negatives are in the loss.
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
import transformers
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import cross_entropy
from transformers import CLIPModel, CLIPVisionModelWithProjection

from palpate import __version__
from palpate.core import PalpateError, Progress, Split, digest_json, digest_lines, quiet
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import (
    ClipEncoders,
    EncoderSet,
    Modality,
    Preprocess,
    encode_tactile,
    load_clip,
    new_tactile,
    seeded,
    to_unit,
)
from palpate.encoders.models import move, pick_device
from palpate.encoders.presets import Augment, EncoderPreset, Targets, preset
from palpate.encoders.seen import digest_images, union
from palpate.encoders.tokenizer import train_tokenizer
from palpate.metrics.probe import material_accuracy
from palpate.training.loop import LoopOptions, fit, work_folder

#: The learned parameter is the logarithm of 1 / tau.
LOG_SCALE_START, LOG_SCALE_MAX = math.log(1 / 0.07), math.log(100.0)


def train_encoder(
    data: Manifest | str | Path,
    split: Split | str | Path,
    *,
    preset: str | EncoderPreset = "mini",
    clip: str | Path | ClipEncoders | None = None,
    output: Path | str | None = None,
    epochs: float | None = None,
    targets: Targets | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: Progress = quiet,
) -> EncoderSet:
    """Train a tactile encoder on the train part of a split, against frozen vision and text.

    The accuracy of a linear material probe on the test part goes into the card
    (``card["scores"]``). Run again with the same ``output`` to resume.

    Args:
        data: a manifest, or anything that :func:`palpate.data.load` reads.
        split: a split or its file; its digest goes into the card.
        preset: ``mini``, ``tiny`` or ``paper``, or a preset.
        clip: hub id or folder of a frozen CLIP, or ``palpate/mini``. Default: the preset's, or a
            small one that is trained first on the same train part.
        output: folder for the encoders, new or empty; None keeps them in memory.
        epochs: of the tactile encoder; default: the preset's.
        targets: ``diagonal`` or ``identical-text``; default: the preset's.
        seed: of weights, order and augmentation.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        progress: called while the work goes on.

    Returns:
        All three encoders, with a card.

    Raises:
        PalpateError: if the train part is empty, or a sample of it lacks an image.
    """
    if epochs is not None and not 0 < epochs < math.inf:
        fix = "Leave it out for the preset's length"
        raise PalpateError("must be a positive number", str(epochs), fix, argument="epochs")
    chosen = preset_of(preset)
    manifest, split = load_manifest(data), Split.load(split)
    output = None if output is None else Path(output)
    with work_folder(output) as work:
        common: dict[str, Any] = {"seed": seed, "targets": targets, "cache": work / "cache"}
        common |= {"device": device, "progress": progress}
        source = clip or chosen.pretrained
        if source is None:
            source = train_clip(manifest, split, chosen, work / "clip", **common)
        elif not isinstance(source, ClipEncoders):
            source = load_clip(source, device=device)
        encoders = train_tactile(
            manifest, split, source, chosen, work / "tactile", epochs=epochs, **common
        )
        parts = [manifest.part(split, part) for part in ("train", "test")]
        if len(parts[1]) and len(set(parts[0].column("material")) - {None}) > 1:
            cache = work / "cache"
            features = [embed(p, encoders, cache=cache, progress=progress) for p in parts]
            score = material_accuracy(features[0], features[1], split=split.digest)
            row = {"score": "linear probe of material, tactile", "value": score.value}
            row |= {"interval": score.interval, "chance": score.details.get("chance"), "n": score.n}
            encoders.card["scores"] = json.loads(json.dumps([row]))
        if output is not None:
            encoders.save(output)
    return encoders


def load_manifest(data: Manifest | str | Path) -> Manifest:
    """A manifest as it is, or read from where it lies."""
    if isinstance(data, Manifest):
        return data
    from palpate.data import load

    return load(data)


def preset_of(name: str | EncoderPreset) -> EncoderPreset:
    """A preset as it is, or by name."""
    return name if isinstance(name, EncoderPreset) else preset(name)


def soft_targets(texts: Tensor) -> Tensor:
    """Spread each row's target mass equally over the rows with its text number: (n,) to (n, n)."""
    same = (texts[:, None] == texts[None, :]).float()
    return same / same.sum(dim=1, keepdim=True)


def info_nce(a: Tensor, b: Tensor, scale: Tensor | float, targets: Tensor | None = None) -> Tensor:
    """Symmetric InfoNCE of one pair of modalities.

    Args:
        a: (n, d), L2-normalized.
        b: (n, d), L2-normalized; row i belongs to row i of ``a``.
        scale: 1 / tau.
        targets: symmetric (n, n) with rows that sum to 1, or None for the diagonal (paper section
            3).

    Returns:
        The scalar loss in nats.
    """
    logits = scale * a @ b.T
    target = torch.arange(len(a), device=a.device) if targets is None else targets
    return (cross_entropy(logits, target) + cross_entropy(logits.T, target)) / 2


def three_way(
    tactile: Tensor,
    text: Tensor,
    vision: Tensor | None,
    scale: Tensor | float,
    *,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    text_targets: Tensor | None = None,
) -> tuple[Tensor, dict[str, float]]:
    """The paper's loss over three pairs.

    Args:
        tactile: (n, d), L2-normalized.
        text: the same.
        vision: the same, or None for data without photos: the first pair alone.
        scale: 1 / tau.
        weights: of tactile-text, vision-text, tactile-vision; the total is their weighted mean.
        text_targets: for the two text pairs, see :func:`info_nce`.

    Returns:
        The total, and the three losses by name.

    Raises:
        PalpateError: on weights that are not three numbers of at least 0 with a positive sum.
    """
    if len(weights) != 3 or min(weights) < 0 or not sum(weights) > 0:
        must, got = "must be three numbers >= 0 with a positive sum", f"{tuple(weights)}"
        raise PalpateError(must, got, "", argument="weights", example={"weights": (1, 1, 1)})
    pairs = {"tactile_text": info_nce(tactile, text, scale, text_targets)}
    if vision is None:
        return pairs["tactile_text"], {k: float(loss.detach()) for k, loss in pairs.items()}
    pairs["vision_text"] = info_nce(vision, text, scale, text_targets)
    pairs["tactile_vision"] = info_nce(tactile, vision, scale)
    weighted = [w * loss for w, loss in zip(weights, pairs.values(), strict=True)]
    total = torch.stack(weighted).sum() / sum(weights)
    return total, {name: float(loss.detach()) for name, loss in pairs.items()}


class TactileModel(nn.Module):
    """What trains: the tactile encoder and the temperature."""

    def __init__(self, tactile: CLIPVisionModelWithProjection) -> None:
        super().__init__()
        self.tactile = tactile
        self.log_scale = nn.Parameter(torch.tensor(LOG_SCALE_START))


def clamped_scale(log_scale: Tensor) -> Tensor:
    """Return 1 / tau; the parameter is clamped, as clamping the value alone ends its gradient."""
    with torch.no_grad():
        log_scale.clamp_(max=LOG_SCALE_MAX)
    return log_scale.exp()


def train_tactile(  # noqa: PLR0913 - one row per choice of the training
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
    """Train a tactile encoder against a frozen CLIP; run again to resume.

    Args:
        manifest: samples with tactile images, and photos for all or for none.
        split: only its part ``train`` is read; its digest goes into the card.
        clip: the frozen encoders; moved to ``device``.
        preset: size and course.
        folder: of the checkpoint and the log.
        epochs: default: the preset's.
        seed: of the initial weights, the order and the augmentation.
        targets: default: the preset's.
        weights: of the pairs tactile-text, vision-text, tactile-vision.
        start: go on from this set's tactile encoder instead of random weights (the paper's); it
            must have the preset's size. Its card goes into the new card, so that the data it was
            trained on stays declared.
        cache: folder for decoded pixels and frozen embeddings.
        device: see :func:`palpate.encoders.models.pick_device`.
        progress: called after each step.

    Returns:
        All three encoders with a card.

    Raises:
        PalpateError: if the train part is empty, or a sample lacks an image.
    """
    place = pick_device(device)
    train = train_part(manifest, split)
    move(clip.model, place)
    frozen = EncoderSet(clip)
    texts, text_source = texts_of(train)
    images = cached_images(train, "tactile", preset.image, cache, progress)
    modalities: list[Modality] = ["text", *(["vision"] if _sides(train)[0] == "vision" else [])]
    text, *photos = (
        torch.from_numpy(embed(train, frozen, m, cache=cache, progress=progress).features).to(place)
        for m in modalities
    )
    tactile, preprocess = _first_weights(preset, clip.dim, images, seed, start)
    course = preset.tactile_course
    options = course.options(len(train), seed, epochs)
    mode, numbers = targets or preset.targets, _numbers(texts).to(place)

    def loss(
        module: nn.Module, rows: Tensor, generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        assert isinstance(module, TactileModel)
        pixels = _augmented(images, rows, course.augment, preprocess, generator, place)
        rows = rows.to(place)
        soft = soft_targets(numbers[rows]) if mode == "identical-text" else None
        scale = clamped_scale(module.log_scale)
        embedded = encode_tactile(module.tactile, pixels)
        vision = photos[0][rows] if photos else None
        total, logs = three_way(
            embedded, text[rows], vision, scale, weights=weights, text_targets=soft
        )
        return total, {**logs, "scale": float(scale.detach())}

    model = TactileModel(tactile).to(place)
    facts = _facts(preset, train, split, texts, text_source, options) | {
        "targets": mode,
        "weights": list(weights),
        "vision": clip.digest("vision"),
        "text": clip.digest("text"),
        "start": start.digest("tactile") if start else None,
    }
    key, what = digest_json([facts, _stamps(train)]), "training the tactile encoder"
    log = fit(model, loss, len(train), options, folder, what=what, key=key, progress=progress)
    card = _card(facts, options, log, place) | {"clip": clip.name, "clip_card": clip.card}
    card["start_card"] = start.card if start else None
    card["synthetic"] = train.synthetic if not start or start.card.get("synthetic") else False
    card["seen_in_part"] = start is not None and start.seen is None
    seen = union(digest_images(images), start.seen if start else None)
    return EncoderSet(clip, model.tactile.eval().requires_grad_(False), preprocess, card, seen)


def _first_weights(
    preset: EncoderPreset, dim: int, images: NDArray[np.uint8], seed: int, start: EncoderSet | None
) -> tuple[CLIPVisionModelWithProjection, Preprocess]:
    """Return the encoder to train and its preprocessing: random, or a copy of ``start``'s."""
    tactile = new_tactile(preset.tactile_config(dim), seed)
    if start is None:
        return tactile, _preprocess(preset, images)
    before = start.preprocess("tactile")
    state = start.tactile.state_dict() if start.tactile is not None else {}
    shapes = [{k: v.shape for k, v in s.items()} for s in (state, tactile.state_dict())]
    if shapes[0] != shapes[1] or before.size != preset.image or before.resize != preset.image:
        must, fix = f"must have the size of the preset {preset.name}", "Leave it out"
        raise PalpateError(must, "another size", fix, argument="start")
    tactile.load_state_dict(state)
    return tactile, before


def _preprocess(preset: EncoderPreset, images: NDArray[np.uint8]) -> Preprocess:
    """CLIP's constants, or mean and deviation per channel of at most 2,000 evenly spaced images."""
    if not preset.data_statistics:
        return Preprocess(preset.image, preset.image)
    some = np.asarray(images[:: max(1, len(images) // 2000)], dtype=np.float64).reshape(-1, 3) / 255
    mean, std = some.mean(axis=0), np.maximum(some.std(axis=0), 1 / 255)
    statistics = (tuple(float(v) for v in values.round(6)) for values in (mean, std))
    return Preprocess(preset.image, preset.image, *statistics)


def new_clip(
    preset: EncoderPreset, texts: Sequence[str], seed: int, preprocess: Preprocess | None = None
) -> ClipEncoders:
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
    return ClipEncoders(model, tokenizer, preprocess, preset.name)


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
    """Train a fresh vision and text encoder on the train part of a split, by InfoNCE of that pair.

    Arguments as :func:`train_tactile`. Without photos the vision encoder is trained on the tactile
    images, as the text encoder needs a partner; the card says so. Run again to resume.

    Returns:
        The CLIP, frozen, with a card.

    Raises:
        PalpateError: if the train part is empty, or the preset takes a pretrained CLIP.
    """
    place = pick_device(device)
    train = train_part(manifest, split)
    texts, text_source = texts_of(train)
    course = preset.clip_course
    if course is None:
        must, got = "must describe a fresh CLIP", f"{preset.name}, which takes {preset.pretrained}"
        raise PalpateError(must, got, "Pass a clip, or use the preset mini", argument="preset")
    images = cached_images(train, _sides(train)[0], preset.image, cache, progress)
    clip = new_clip(preset, texts, seed, _preprocess(preset, images))
    move(clip.model, place)
    clip.model.requires_grad_(True)
    options = course.options(len(train), seed, epochs)
    mode, numbers, distinct = targets or preset.targets, _numbers(texts), sorted(set(texts))

    def loss(
        module: nn.Module, rows: Tensor, generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        pixels = _augmented(images, rows, course.augment, clip.preprocess, generator, place)
        vision = clip.encode_vision(pixels)
        # Each distinct text goes through the encoder once.
        some, inverse = torch.unique(numbers[rows], return_inverse=True)
        text = clip.encode_text([distinct[int(k)] for k in some])[inverse.to(place)]
        scale = clamped_scale(clip.model.logit_scale)
        soft = soft_targets(inverse.to(place)) if mode == "identical-text" else None
        return info_nce(vision, text, scale, soft), {"scale": float(scale.detach())}

    facts = _facts(preset, train, split, texts, text_source, options) | {"targets": mode}
    facts |= {} if _sides(train)[0] == "vision" else {"trained_on": "tactile images, not photos"}
    key, what = digest_json([facts, _stamps(train)]), "training vision and text"
    log = fit(clip.model, loss, len(train), options, folder, what=what, key=key, progress=progress)
    clip.model.eval().requires_grad_(False)
    clip.card = _card(facts, options, log, place)
    clip.seen = union(digest_images(images))
    return clip


def train_part(manifest: Manifest, split: Split) -> Manifest:
    """The train part of a split, which must not be empty."""
    train = manifest.part(split, "train")
    if not len(train):
        must = "The train part of the split must hold samples of this manifest"
        raise PalpateError(must, "none", "Make a split with: palpate split")
    return train


def _sides(train: Manifest) -> list[str]:
    """The image columns that training uses: without a single photo, the tactile images alone."""
    sides = ["vision", "tactile"]
    return [side for side in sides if train.table[side].count()] or sides


def _stamps(train: Manifest) -> list[str]:
    """What must not have changed on disk for a checkpoint to be continued."""
    return [image_stamp(train, column) for column in _sides(train)]


def _numbers(texts: Sequence[str]) -> Tensor:
    """Each text's index among the sorted distinct texts, (n,) int64."""
    return torch.from_numpy(np.unique(np.array(texts, dtype=object), return_inverse=True)[1])


def _augmented(  # noqa: PLR0917
    images: NDArray[np.uint8],
    rows: Tensor,
    augment: Augment,
    preprocess: Preprocess,
    generator: torch.Generator,
    device: torch.device,
) -> Tensor:
    """The pixels of one training batch, (b, 3, size, size)."""
    return preprocess.normalize(augment(to_unit(images[rows.numpy()], device), generator))


def _facts(  # noqa: PLR0917
    preset: EncoderPreset,
    train: Manifest,
    split: Split,
    texts: Sequence[str],
    source: str,
    options: LoopOptions,
) -> dict[str, Any]:
    """What decides the result of a training run; also the run's key."""
    return {
        "preset": preset.name,
        "settings": {k: v for k, v in asdict(preset).items() if k != "cost"},
        "options": options.facts,
        "seed": options.seed,
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
    rows = sorted({round(k) for k in np.linspace(0, len(log) - 1, min(50, len(log)))})
    hidden = ("seconds", "lr")
    curve = [{k: round(v, 6) for k, v in log[row].items() if k not in hidden} for row in rows]
    versions = {
        "palpate": __version__,
        "torch": torch.__version__,
        "transformers": transformers.__version__,
        "python": platform.python_version(),
    }
    card = {**facts, "steps": options.steps, "device": device.type, "versions": versions}
    return json.loads(json.dumps(card | {"loss": curve}))  # as it will be read back
