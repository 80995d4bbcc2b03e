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
import math
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from numpy.typing import NDArray
from torch import Tensor, nn
from transformers import CLIPModel, CLIPVisionModelWithProjection

from palpate._version import __version__
from palpate.core import PalpateError, Progress, Split, digest_json, digest_lines, quiet
from palpate.data.images import image_stamp
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import (
    ClipEncoders,
    EncoderSet,
    Preprocess,
    encode_tactile,
    load_clip,
    new_tactile,
    seeded,
)
from palpate.encoders.losses import (
    LOG_SCALE_START,
    clamped_scale,
    in_chunks,
    info_nce,
    text_targets,
    three_way,
)
from palpate.encoders.models import digest_tensors, move, pick_device
from palpate.encoders.preprocess import CLIP_MEAN, CLIP_STD, digest_images, prepared_images, union
from palpate.encoders.presets import Course, EncoderPreset, Targets, preset
from palpate.encoders.rows import Rows, augmented, draw, numbers, unit
from palpate.encoders.tokenizer import train_tokenizer
from palpate.metrics.probe import material_accuracy
from palpate.training.engine import Batch, Losses, Task, fit
from palpate.training.estimate import estimate
from palpate.training.options import Compute, LoopOptions
from palpate.training.processes import connect, first_alone, gather_rows, place, shared
from palpate.training.run import keep_logs, work_folder
from palpate.training.steps import Step


def train_encoder(  # noqa: PLR0913 - a public verb
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    *,
    preset: str | EncoderPreset = "mini",
    clip: str | Path | ClipEncoders | None = None,
    output: Path | str | None = None,
    epochs: float | None = None,
    targets: Targets | None = None,
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
        preset: ``mini``, ``tiny``, ``tvl-tiny``, ``tvl-small``, ``tvl-base`` or ``paper``, or a
            preset.
        clip: hub id or folder of a frozen CLIP, or ``palpate/mini``; a DINO, which teaches without
            texts. Default: the preset's, or a small one that is trained first on the same train
            part.
        output: folder for the encoders, new or empty; None keeps them in memory.
        epochs: of the tactile encoder; default: the preset's.
        targets: see :data:`~palpate.encoders.presets.Targets`; default: the preset's.
        seed: of weights, order and augmentation.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Returns:
        All three encoders, with a card.

    Raises:
        PalpateError: if the train part is empty, or a sample of it lacks an image.
    """
    if epochs is not None and not 0 < epochs < math.inf:
        fix = "Leave it out for the preset's length"
        raise PalpateError("must be a positive number", str(epochs), fix, argument="epochs")
    chosen, device = preset_of(preset), connect(device)
    manifest, split = load(data), load_split(data, split)
    output = None if output is None else Path(output)
    with work_folder(output) as work:
        common: dict[str, Any] = {"seed": seed, "targets": targets, "cache": work / "cache"}
        common |= {"device": device, "compute": compute, "progress": progress}
        source = clip or chosen.pretrained
        if source is None:
            source = train_clip(manifest, split, chosen, work / "clip", **common)
        elif not isinstance(source, ClipEncoders):
            source = load_clip(source, device=device)
        encoders = train_tactile(
            manifest, split, source, chosen, work / "tactile", epochs=epochs, **common
        )
        parts = [_labeled(manifest.part(split, part)) for part in ("train", "test")]
        if len(parts[1]) and len(set(parts[0].column("material"))) > 1:
            cache = work / "cache"
            with first_alone():
                features = [embed(p, encoders, cache=cache, progress=progress) for p in parts]
            score = material_accuracy(features[0], features[1], split=split.digest)
            row = {"score": "linear probe of material, tactile", "value": score.value}
            row |= {"interval": score.interval, "chance": score.details.get("chance"), "n": score.n}
            encoders.card["scores"] = json.loads(json.dumps([row]))
        if output is not None and place()[0] == 0:
            encoders.save(output)
            keep_logs(work, output)
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
        see :func:`palpate.training.estimate.estimate`.
    """
    chosen, split = preset_of(preset), load_split(data, split)
    train = train_part(load(data), split)

    def forward(model: nn.Module, rows: int, where: torch.device) -> Tensor:
        return encode_tactile(model, torch.zeros(rows, 3, chosen.image, chosen.image, device=where))

    def build() -> nn.Module:
        return CLIPVisionModelWithProjection(chosen.tactile_config(chosen.dim))

    options = chosen.tactile_course.options(len(train), 0, epochs)
    return estimate(build, forward, options, len(train), pick_device(device))


def _labeled(part: Manifest) -> Manifest:
    """The samples that have a tactile image and a material."""
    columns = (part.ids, part.column("tactile"), part.column("material"))
    return part.take([i for i, image, name in zip(*columns, strict=True) if image and name])


def load_split(data: Manifest | str | Path, split: Split | str | Path | None = None) -> Split:
    """A split as it is, or from its file, or the only one that lies with the data.

    Raises:
        PalpateError: if there is none with the data, or several.
    """
    if split is not None:
        return Split.load(split)
    stated = sorted(Path(data).glob("splits/*.json")) if isinstance(data, str | Path) else []
    if len(stated) != 1:
        must, fix = "must be given unless one lies with the data", "Make one with: palpate split"
        got = ", ".join(path.name for path in stated) or "none there"
        raise PalpateError(must, got, fix, argument="split")
    return Split.load(stated[0])


def preset_of(name: str | EncoderPreset) -> EncoderPreset:
    """A preset as it is, or by name."""
    return name if isinstance(name, EncoderPreset) else preset(name)


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
        images = augmented(unit(batch["images"]), batch)
        tactile = in_chunks(partial(self.encode, module), images, self.chunk)
        whole = gather_rows(tactile, batch=len(batch["texts"]))
        partners = batch.get("text"), batch.get("vision"), scale, batch["texts"]
        how: dict[str, Any] = {"photos": batch.get("photos"), "targets": self.targets}
        total, logs = three_way(whole, *partners, **how)
        return Losses(total, {**logs, "scale": scale.detach()}, tactile.sum(dim=1))


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
    start: EncoderSet | None = None,
    cache: Path | None = None,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> EncoderSet:
    """Train a tactile encoder against a CLIP; run again to resume.

    Args:
        manifest: samples with tactile images; rows without a photo are left out of the vision
            pairs.
        split: its parts ``train`` and ``val`` are read; its digest goes into the card.
        clip: the encoders to learn from; moved to ``device``.
        preset: size and course.
        folder: of the checkpoint and the log.
        epochs: default: the preset's.
        seed: of the initial weights, the order and the augmentation.
        targets: default: the preset's.
        start: go on from this set's tactile encoder instead of random weights (the paper's); it
            must have the preset's size. Its card goes into the new card, so that the data it was
            trained on stays declared.
        cache: folder for decoded pixels and frozen embeddings.
        device: see :func:`palpate.encoders.models.pick_device`.
        compute: how to run it on the machine at hand.
        progress: called after each step.

    Returns:
        All three encoders with a card.

    Raises:
        PalpateError: if the train part is empty, or a sample lacks a tactile image.
    """
    where = pick_device(connect(device))
    compute = compute or Compute()
    train, held = train_part(manifest, split), manifest.part(split, "val")
    move(clip.model, where)
    read = partial(Rows, clip=clip, preprocess=preset.preprocess, cache=cache, progress=progress)
    with first_alone():
        rows, others = read(train), read(held) if len(held) else None
    tactile, preprocess = _first_weights(preset, clip.dim, rows.images, seed, start)
    course, mode = preset.tactile_course, targets or preset.targets
    options = course.options(len(train), seed, epochs)
    _require_rows(train, options)
    if clip.tokenizer is None and int((rows.photo >= 0).sum()) < 2:
        must = "A vision encoder without text must have two photos to teach"
        raise shared(PalpateError(must, "fewer in the train part", "Choose a CLIP"))
    _require_held_out(held, options)
    facts = _facts(preset, train, split, (rows.captions, rows.text_source), options) | {
        "targets": mode,
        "vision": clip.digest("vision"),
        "text": clip.digest("text") if clip.tokenizer is not None else None,
        "start": start.digest("tactile") if start else None,
    }
    facts |= {"held_out": held.digest} if len(held) else {}
    facts |= {"without_photo": rows.without_photo} if rows.without_photo else {}

    loss = TactileLoss(rows, preprocess, mode, compute.chunk)
    model = TactileModel(tactile).to(where)
    task = Task(
        "training the tactile encoder",
        len(train),
        lambda step: rows.load(step, course.augment),
        loss,
        digest_json([facts, _stamps(train)]),
        train.ids,
        None if others is None else (len(held), others.load),
    )
    log = fit(model, task, options, folder, compute=compute, progress=progress)
    card = _card(facts, options, log, where) | {"clip": clip.name, "clip_card": clip.card}
    card["start_card"] = start.card if start else None
    card["synthetic"] = train.synthetic if not start or start.card.get("synthetic") else False
    card["seen_in_part"] = start is not None and not start.knows_seen("tactile")
    seen = union(digest_images(rows.images), start.seen if start else None)
    return EncoderSet(clip, model.tactile.eval().requires_grad_(False), preprocess, card, seen)


def _require_rows(
    train: Manifest,
    options: LoopOptions,
    what: str = "samples",
    argument: str = "tactile_course.batch",
) -> None:
    if len(train) == 1:
        must = f"The train part must hold two {what}: the loss compares them with each other"
        got, fix = f"one, {train.ids[0]}", "Make another split: palpate split"
        raise shared(PalpateError(must, got, fix))
    if options.batch == 1:
        must, fix = "must be at least 2: the loss compares rows", "Pass a larger one"
        raise shared(PalpateError(must, "1", fix, argument=argument))


def _require_held_out(held: Manifest, options: LoopOptions) -> None:
    if not len(held) and (options.keep == "best" or options.patience):
        name = f"tactile_course.{'keep' if options.keep == 'best' else 'patience'}"
        must, fix = "needs a part val of the split", "Make one: palpate split --val 0.1"
        raise shared(PalpateError(must, "none", fix, argument=name))
    if len(held) == 1 and options.evaluations:
        must = "The held-out part must hold two samples: the loss compares them with each other"
        raise shared(PalpateError(must, f"one, {held.ids[0]}", "Make another split: palpate split"))


def _encode_phrases(clip: ClipEncoders, phrases: Sequence[str], which: Tensor) -> Tensor:
    """Embed the phrases of these numbers, each distinct one once: (n,) to (n, d)."""
    some, inverse = torch.unique(which, return_inverse=True)
    return clip.encode_text([phrases[int(k)] for k in some])[inverse]


def _first_weights(
    preset: EncoderPreset, dim: int, images: NDArray[np.uint8], seed: int, start: EncoderSet | None
) -> tuple[CLIPVisionModelWithProjection, Preprocess]:
    """Return the encoder to train and its preprocessing: random, or a copy of ``start``'s."""
    tactile = new_tactile(preset.tactile_config(dim), seed)
    if start is None:
        return tactile, _preprocess(preset, images, preset.preprocess)
    before = start.preprocess("tactile")
    state = start.tactile.state_dict() if start.tactile is not None else {}
    shapes = [{k: v.shape for k, v in s.items()} for s in (state, tactile.state_dict())]
    same = replace(before, mean=CLIP_MEAN, std=CLIP_STD) == preset.preprocess
    if shapes[0] != shapes[1] or not same:
        must = f"must have the preprocessing and size of the preset {preset.name}"
        raise PalpateError(must, "another", "Leave it out", argument="start")
    tactile.load_state_dict(state)
    return tactile, before


def _preprocess(
    preset: EncoderPreset, images: NDArray[np.uint8], geometry: Preprocess
) -> Preprocess:
    """CLIP's constants, or mean and deviation per channel of at most 2,000 evenly spaced images."""
    if not preset.data_statistics:
        return geometry
    some = np.asarray(images[:: max(1, len(images) // 2000)], dtype=np.float64).reshape(-1, 3) / 255
    mean, std = some.mean(axis=0), np.maximum(some.std(axis=0), 1 / 255)
    statistics = (tuple(float(v) for v in values.round(6)) for values in (mean, std))
    mean, std = statistics
    return replace(geometry, mean=mean, std=std)


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


def train_clip(  # noqa: PLR0913 - as train_tactile
    manifest: Manifest,
    split: Split,
    preset: EncoderPreset,
    folder: Path,
    *,
    epochs: float | None = None,
    seed: int = 0,
    targets: Targets | None = None,
    start: ClipEncoders | None = None,
    cache: Path | None = None,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> ClipEncoders:
    """Train a fresh vision and text encoder on the train part of a split, by InfoNCE of that pair.

    Arguments as :func:`train_tactile`. Without photos the vision
    encoder is trained on the tactile images, as the text encoder needs a partner; the card says so.
    Run again to resume.

    With ``start`` its vision encoder goes on, against its text encoder as it is (LiT, Zhai et al.
    2022): what was trained in the space of its texts stays valid. Its size is its own.

    Returns:
        The CLIP, frozen, with a card.

    Raises:
        PalpateError: if the train part is empty or has one photo, ``start`` is no CLIP, or the
            preset takes a pretrained CLIP, or has this course keep the best weights or stop early.
    """
    where, compute = pick_device(connect(device)), compute or Compute()
    train, side, missing = _pictured(train_part(manifest, split))
    course, words = _clip_course(preset), "photos" if side == "vision" else "samples"
    options = course.options(len(train), seed, epochs)
    _require_rows(train, options, words, "clip_course.batch")
    texts, source = texts_of(train)
    how = Preprocess(preset.image, preset.image) if start is None else start.preprocess
    with first_alone():
        images = prepared_images(train, side, how, cache, progress)
    if start is None:
        clip = new_clip(preset, texts, seed, _preprocess(preset, images, how))
        clip.model.requires_grad_(True)
    else:
        clip = _copy_that_sees(start)
    move(clip.model, where)
    mode, words, distinct = targets or preset.targets, numbers(texts), sorted(set(texts))

    def load(step: Step) -> Batch:
        pixels = torch.from_numpy(np.array(images[step.rows]))
        every = words[torch.from_numpy(step.all_rows)]
        batch = {"images": pixels, "phrase": every[step.mine], **draw(course.augment, step)}
        return {**batch, "texts": every}

    def loss(module: nn.Module, batch: Batch) -> Losses:
        pixels = clip.preprocess(augmented(unit(batch["images"]), batch))
        encoded = in_chunks(clip.encode_vision, pixels, compute.chunk)
        text = gather_rows(_encode_phrases(clip, distinct, batch["phrase"]))
        scale = clamped_scale(clip.model.logit_scale)
        with torch.autocast(encoded.device.type, enabled=False):
            vision, text = gather_rows(encoded).float(), text.float()
            total = info_nce(vision, text, scale, text_targets(mode, batch["texts"], text))
        return Losses(total, {"scale": scale.detach()}, encoded.sum(dim=1))

    known = {m: start.digest(m) for m in ("vision", "text")} if start else {}
    known |= {"start": digest_tensors(start.model.state_dict())} if start else {}
    facts = _facts(preset, train, split, (texts, source), options) | {"targets": mode} | known
    facts |= {} if side == "vision" else {"trained_on": "tactile images, not photos"}
    facts |= {"without_photo": missing} if missing else {}
    key = digest_json([facts, image_stamp(train, side)])
    task = Task("training vision and text", len(train), load, loss, key, train.ids)
    log = fit(clip.model, task, options, folder, compute=compute, progress=progress)
    clip.model.eval().requires_grad_(False)
    clip.card = _card(facts, options, log, where) | clip.card
    clip.seen = union(digest_images(images), start.seen if start else None)
    return clip


def _copy_that_sees(clip: ClipEncoders) -> ClipEncoders:
    """A copy whose text encoder stays as it is; its card says what it was."""
    if clip.family != "clip":
        must, got = "must be a CLIP, whose vision encoder goes on", f"a {clip.family}"
        raise PalpateError(must, got, "Pass another, or leave it out", argument="start")
    card = {"start_card": clip.card, "seen_in_part": not EncoderSet(clip).knows_seen("vision")}
    card |= {"license": clip.card["license"]} if "license" in clip.card else {}
    copied = replace(clip, model=copy.deepcopy(clip.model), card=card)
    copied.model.requires_grad_(True)
    for part in (copied.model.text_model, copied.model.text_projection):
        part.requires_grad_(False)
    return copied


def _clip_course(preset: EncoderPreset) -> Course:
    course = preset.clip_course
    if course is None:
        must, got = "must describe a fresh CLIP", f"{preset.name}, which takes {preset.pretrained}"
        raise PalpateError(must, got, "Pass a clip, or use the preset mini", argument="preset")
    if course.keep == "best" or course.patience:
        must = "The course of vision and text must keep its last weights and run to its end"
        raise shared(PalpateError(must, f"keep {course.keep}, patience {course.patience}", ""))
    return course


def train_part(manifest: Manifest, split: Split) -> Manifest:
    """The train part of a split, which must not be empty."""
    train = manifest.part(split, "train")
    if not len(train):
        must = "The train part of the split must hold samples of this manifest"
        raise PalpateError(must, "none", "Make a split with: palpate split")
    return train


def _pictured(train: Manifest) -> tuple[Manifest, str, int]:
    """The rows with a photo, or of data without photos a tactile image; which; how many lack it."""
    side = _sides(train)[0]
    has = zip(train.ids, train.column(side), strict=True)
    some = train.take([i for i, image in has if image is not None])
    return some, side, len(train) - len(some)


def _sides(train: Manifest) -> list[str]:
    """The image columns that training uses: without a single photo, the tactile images alone."""
    sides = ["vision", "tactile"]
    return [side for side in sides if train.table[side].count()] or sides


def _stamps(train: Manifest) -> list[str]:
    """What must not have changed on disk for a checkpoint to be continued."""
    stamps: list[str] = []
    for side in [*_sides(train), "background"]:
        cells = zip(train.ids, train.column(side), strict=True)
        stamps.append(image_stamp(train.take([i for i, image in cells if image]), side))
    return stamps


def _facts(
    preset: EncoderPreset,
    train: Manifest,
    split: Split,
    texts: tuple[Sequence[str], str],
    options: LoopOptions,
) -> dict[str, Any]:
    """What decides the result of a training run; also the run's key."""
    return {
        "preset": preset.name,
        "settings": {k: v for k, v in asdict(preset).items() if k not in ("cost", "score")},
        "options": options.facts,
        "seed": options.seed,
        "train_manifest": train.digest,
        "train_samples": len(train),
        "split": split.digest,
        "split_rule": dict(split.rule),
        "texts": digest_lines(texts[0]),
        "distinct_texts": len(set(texts[0])),
        "text_source": texts[1],
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
    card["processes"] = place()[1]
    return json.loads(json.dumps(card | {"loss": curve}))  # as it will be read back
