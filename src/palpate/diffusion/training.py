"""Training a generator: encode once, then train the denoiser (``denoiser_training``).

Only the train part of the split is read. Tactile images go through the frozen autoencoder and texts
and photos through the frozen encoders once, into caches; the training loop reads those.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from palpate._version import __version__
from palpate.core import PalpateError, Progress, Split, digest_json, digest_lines, quiet, require
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import CONTACT, Manifest
from palpate.diffusion.autoencoder import (
    AnyAutoencoder,
    BackgroundAutoencoder,
    LatentStats,
    load_autoencoder,
)
from palpate.diffusion.autoencoder_training import autoencoder_of, build_autoencoder
from palpate.diffusion.ceiling import judge_of, measure_ceiling, some_whole
from palpate.diffusion.contact import ContactScale, channels_of
from palpate.diffusion.denoiser import Denoiser, lengths_of
from palpate.diffusion.denoiser_training import Rows, new_unet, train_denoiser
from palpate.diffusion.encoding import encode_part
from palpate.diffusion.gels import gels_of, has_gels
from palpate.diffusion.options import AutoencoderOptions, ConditionPolicy, UNetOptions
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import DiffusionPreset, preset_of
from palpate.diffusion.training_range import TrainingRange
from palpate.diffusion.unet import find_unet
from palpate.encoders.embed import texts_of
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import is_hub_id, pick_device
from palpate.encoders.rows import load_samples, train_part
from palpate.training.options import Compute
from palpate.training.processes import connect, first_alone, place
from palpate.training.run import TrainingRun, estimate, finished, request_of, run_for

DRAWN = 8  # samples outside of train that are drawn while the denoiser trains


@dataclass(frozen=True)
class Parts:
    """What a generator is trained with.

    Attributes:
        preset: geometry, schedule, length, sampler.
        autoencoder: frozen.
        encoders: their text embeddings condition the training, their vision embeddings the
            sampling; None for a preset that conditions on photos alone (``resnet``).
        background: the variant w/ BG, which also sees the no-contact image.
        start: go on from this pipeline's denoiser instead of random weights. It must use the same
            autoencoder, vision encoder and schedule, gives its latent statistics, and its record
            goes into the new one, so that the data it was trained on stays declared.
        remember: also keep means and memory of ``start``, for more data of the same kind.
    """

    preset: DiffusionPreset
    autoencoder: AnyAutoencoder
    encoders: EncoderSet | None
    background: bool = False
    start: TactilePipeline | None = None
    remember: bool = False


def train_generator(  # noqa: PLR0913 - a public verb
    data: Manifest | str | Path,
    split: Split | str | Path | None,
    clip: EncoderSet | str | Path | None = None,
    *,
    preset: str | DiffusionPreset = "mini",
    autoencoder: AnyAutoencoder | str | Path | None = None,
    start: TactilePipeline | str | Path | None = None,
    output: Path | str | None = None,
    background: bool = False,
    judge: EncoderSet | str | Path | None = "palpate/mini",
    steps: int | None = None,
    seed: int = 0,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> TactilePipeline:
    """Train a generator on the train part of a split; run again with one ``output`` to resume
    or, once it is finished, to load.

    Args:
        data: a manifest, or anything that :func:`palpate.data.load` reads.
        split: a split or its file; its digest goes into the pipeline. None: the one that lies with
            the data.
        clip: vision and text encoders that condition the generator: a set of encoders, its folder,
            the folder or hub id of a CLIP, or ``palpate/mini``; a preset whose condition has the
            source ``resnet`` (GVST, the baseline without text) needs none.
        preset: geometry, schedule and length, or its name (:data:`palpate.diffusion.PRESETS`); with
            ``start`` its training loop alone. Its ``unet`` may name a trained one of diffusers to
            go on from: a folder or hub id of it or of its generator.
        autoencoder: any :class:`~palpate.diffusion.autoencoder.Autoencoder` or what its ``load``
            takes: folder, hub id, ``.ckpt`` or ``palpate/mini``. Default: a small one, trained
            first on the train part; the preset ``paper`` needs one.
        start: go on from this generator of palpate, its folder, or ``palpate/mini``. Geometry,
            condition, schedule and sampler stay as they are, its encoders and autoencoder stand for
            those that are not given, its record goes into the new one, and the memory is made of
            the new data alone.
        output: folder for the pipeline, new or empty; None keeps it in memory.
        background: the variant w/ BG, which also sees the no-contact image.
        judge: whose tactile encoder says what of the images outside of train survives the
            autoencoder (:mod:`palpate.diffusion.ceiling`); None: PSNR and SSIM alone.
        steps: optimizer steps; default: the preset's.
        seed: of weights, order, noise and condition dropout.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Raises:
        PalpateError: if the train part is empty, a sample of it lacks an image or words, models
            are missing, or ``start`` does not fit what is given beside it.
    """
    start = TactilePipeline.from_pretrained(start) if isinstance(start, str | Path) else start
    chosen = _preset(preset, start, steps)
    if start is not None:
        clip, autoencoder = clip or start.encoders, autoencoder or start.autoencoder
        background = background or start.denoiser.background
    options, must = chosen.autoencoder, f"must be given for the preset {chosen.name}"
    fits = autoencoder is not None or options is not None
    require(fits, "autoencoder", must, "none", fix="Pass a folder or a file")
    manifest, split = load_samples(data, split)
    models = (clip, autoencoder, start, judge)
    request = request_of(seed, manifest, split, chosen, background, *models)
    if finished(output, request):
        return TactilePipeline.from_pretrained(str(output))
    with run_for(output, request, seed, device=device, compute=compute, progress=progress) as run:
        judge = judge_of(judge, run.device)
        encoders = load_clip(clip) if isinstance(clip, str | Path) else clip
        needed = _policy(chosen, encoders).modalities
        missing = [m for m in needed if encoders is None or m not in encoders.modalities]
        must, got = f"must have {' and '.join(needed)}", f"no {' and no '.join(missing)}"
        require(not missing, "clip", must, got, fix="Pass a CLIP")
        if autoencoder is None:
            assert options is not None
            code = autoencoder_of(manifest, split, options, chosen.size, run.stage("autoencoder"))
        elif isinstance(autoencoder, AnyAutoencoder):
            code = autoencoder
        else:
            code = load_autoencoder(autoencoder)
        parts = Parts(chosen, code, encoders, background, start)
        pipeline = train_pipeline(manifest, split, parts, run, judge)
        run.keep(pipeline, output)
    return pipeline


def _preset(
    preset: str | DiffusionPreset, start: TactilePipeline | None, steps: int | None = None
) -> DiffusionPreset:
    """The preset, with so many steps; after ``start`` of the preset only its loop."""
    chosen = preset_of(preset).with_steps(steps)
    if isinstance(chosen.unet, str):
        must = "must be left out for a preset with a trained U-Net"
        require(start is None, "start", must, str(chosen.unet))
        find_unet(chosen.unet)
    if start is None:
        return chosen
    return replace(
        chosen,
        name=start.preset,
        size=start.size,
        schedule=start.schedule,
        condition=replace(start.denoiser.policy, contact=chosen.condition.contact),
        sampler=start.sampler,
    )


def _sees_contact(
    preset: DiffusionPreset,
    policy: ConditionPolicy,
    autoencoder: AnyAutoencoder,
    train: Manifest,
    start: TactilePipeline | None,
) -> bool:
    """Whether touches condition: data must show or name them, on gels that are given."""
    if start is not None and start.denoiser.policy.contact:
        return True
    known = has_gels(train) or {*CONTACT} & {*train.table.columns}
    given = isinstance(autoencoder, BackgroundAutoencoder) and not isinstance(preset.unet, str)
    return policy.contact and given and bool(known)


def _policy(preset: DiffusionPreset, encoders: EncoderSet | None) -> ConditionPolicy:
    return preset.condition_for(preset.condition.width if encoders is None else encoders.dim)


def plan_generator(
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    clip: str | Path | None = None,
    *,
    preset: str | DiffusionPreset = "mini",
    autoencoder: str | Path | None = None,
    start: str | Path | None = None,
    background: bool = False,
    device: str = "auto",
) -> dict[str, Any]:
    """What training the denoiser would take; of the data only the manifest is read.

    Without an autoencoder latents are those of the preset's, or of an f4 of three channels.

    Returns:
        see :func:`palpate.training.run.estimate`.
    """
    begin = None if start is None else TactilePipeline.from_pretrained(start)
    chosen = _preset(preset, begin)
    train = train_part(*load_samples(data, split))
    policy = _policy(chosen, None if clip is None else load_clip(clip))
    if autoencoder is not None:
        code = load_autoencoder(autoencoder)
    else:
        code = build_autoencoder(chosen.autoencoder or AutoencoderOptions())
    side = chosen.size // code.factor

    policy = replace(policy, contact=_sees_contact(chosen, policy, code, train, begin))

    def build() -> nn.Module:
        old = None if begin is None else begin.denoiser
        wide = code.gel_channels if background else 0
        wide += channels_of(code.channels) if policy.contact else 0
        unet = new_unet(old, chosen.unet, policy, side, channels=code.channels, background=wide)
        return Denoiser(unet, policy)

    def forward(model: nn.Module, rows: int, device: torch.device) -> Tensor:
        assert isinstance(model, Denoiser)
        z = torch.zeros(rows, model.unet.config["in_channels"], side, side, device=device)
        return model(z, torch.zeros(rows, device=device).long(), model.null_tokens(rows))

    loop = chosen.loop_for(len(train))
    return estimate(build, forward, loop, len(train), pick_device(device))


def train_pipeline(
    manifest: Manifest,
    split: Split,
    parts: Parts,
    run: TrainingRun,
    judge: EncoderSet | None = None,
) -> TactilePipeline:
    """Train the denoiser of a pipeline on the train part of a split; run again to resume.

    Args:
        manifest: samples with tactile image and photo, and a text or a material.
        split: its digest goes into the pipeline.
        parts: what is trained, and with what.
        run: where, and how.
        judge: of the ceiling, beside PSNR and SSIM.

    Raises:
        PalpateError: if the train part is empty, a sample lacks what is needed, or ``start`` does
            not fit.
    """
    preset, autoencoder, start = parts.preset, parts.autoencoder, parts.start
    train, held = train_part(manifest, split), manifest.part(split, "val")
    must = f"must reduce images of {preset.size} pixels, the preset's, by a divisor of it"
    fits, fix = preset.size % autoencoder.factor == 0, "Choose another, or another size"
    require(fits, "autoencoder", must, autoencoder.factor, fix=fix)
    policy = _policy(preset, parts.encoders)
    policy = replace(policy, contact=_sees_contact(preset, policy, autoencoder, train, start))
    if start is not None:
        _require_same(start, parts, policy)
    run = replace(run, device=pick_device(connect(str(run.device))))
    encoders = parts.encoders
    encoders = encoders.to(run.device) if encoders is not None and policy.sources else None
    nn.Module.to(autoencoder, pick_device(run.device))
    texts, text_source = texts_of(train) if "text" in policy.modalities else ([], None)
    given_gel = isinstance(autoencoder, BackgroundAutoencoder)
    gels = parts.background or (given_gel and has_gels(train))
    columns = ["tactile", "background"] if gels else ["tactile"]

    def encode(part: Manifest, like: NDArray[np.uint8] | None = None) -> Rows:
        return encode_part(
            part,
            policy,
            preset.size,
            run,
            encoders=encoders,
            autoencoder=autoencoder,
            columns=columns,
            background=parts.background,
            like=like,
        )

    with first_alone():
        rows = encode(train)
        held_rows = encode(held, rows.gels) if len(held) else None
        drawn = _drawn(manifest, split, preset.size, rows.gels)
    contact = None
    if rows.contacts is not None:
        contact = ContactScale.of(rows.contacts, train.column("sensor"))
        rows = replace(rows, requested=contact.requested(rows.contacts, train.column("sensor")))
    if held_rows is not None and held_rows.contacts is not None and contact is not None:
        requested = contact.requested(held_rows.contacts, held.column("sensor"))
        held_rows = replace(held_rows, requested=requested)
    key = [
        digest_lines(texts),
        *(image_stamp(train, column) for column in ("vision", *columns)),
        *(train.digest, held.digest if len(held) else "", autoencoder.digest),
        *(encoders.digest(modality) for modality in policy.modalities if encoders is not None),
    ]
    stats = LatentStats.of(rows.latents, preset.latent_scale) if start is None else start.stats
    loop = preset.loop_for(len(train), seed=run.seed)

    def samples(module: nn.Module) -> NDArray[np.uint8]:
        assert isinstance(module, Denoiser)
        assert drawn is not None
        names, photos, tactile, gels = drawn
        drawing = pipeline(module)
        images = drawing.sample(drawing.embed(photos), names, seed=run.seed, background=gels)
        return np.vstack([np.hstack(list(row)) for row in (photos, tactile, images)])

    def pipeline(denoiser: Denoiser, record: dict[str, Any] | None = None) -> TactilePipeline:
        return TactilePipeline(
            autoencoder,
            denoiser,
            stats,
            preset.schedule,
            preset.sampler,
            preset.size,
            # The tactile encoder scores, it does not generate.
            None if encoders is None else encoders.without_tactile(),
            preset.name,
            record or {},
            rows.gels[0] if given_gel and rows.gels is not None else None,
            contact=contact,
        )

    denoiser = train_denoiser(
        replace(rows, key=digest_json(key)),
        replace(preset, condition=policy, loop=loop),
        stats,
        run.stage("denoiser"),
        held_out=held_rows,
        start=start.denoiser if start else None,
        remember=parts.remember,
        samples=samples if drawn else None,
    )
    record = {
        "manifest": manifest.digest,
        "split": split.digest,
        "split_rule": dict(split.rule),
        "train_samples": len(train),
        "videos": train.table["video"].drop_nulls().n_unique(),
        "sensors": train.table["sensor"].drop_nulls().unique().sort().to_list(),
        "text_source": text_source,
        "autoencoder": autoencoder.digest,
        "ceiling": measure_ceiling(
            autoencoder,
            manifest,
            split,
            preset.size,
            judge=judge,
            cache=run.cache,
            progress=run.progress,
        ),
        **_digests(encoders),
        "source": policy.source,
        "background": parts.background,
        "gel": ("manifest" if gels else "median") if given_gel else None,
        "loop": asdict(loop),
        "unet": start.training.get("unet") if start else _geometry(preset.unet),
        "seed": run.seed,
        "processes": place()[1],
        "palpate": __version__,
        "parameters": sum(p.numel() for p in denoiser.parameters()),
        "synthetic": bool(manifest.synthetic),
        "materials": sorted({str(m) for m in train.column("material") if m}),
        "start": start.digest if start else None,
        "start_record": dict(start.training) if start else None,
    }
    made = pipeline(denoiser, record)
    return replace(made, seen=TrainingRange.of(made, train, texts, run))


def _geometry(unet: UNetOptions | str) -> dict[str, Any]:
    """The geometry of a U-Net, or whose it was."""
    if isinstance(unet, UNetOptions):
        return asdict(unet)
    return {"source": unet if is_hub_id(unet) else Path(unet).resolve().name}


def _digests(encoders: EncoderSet | None) -> dict[str, str | None]:
    return {
        s: encoders.digest(s) if encoders and s in encoders.modalities else None
        for s in ("vision", "text")
    }


def _drawn(
    manifest: Manifest, split: Split, size: int, like: NDArray[np.uint8] | None
) -> tuple[Sequence[str], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8] | None] | None:
    """Ids of samples of val, or of test, their photos, tactile images and gels, to be drawn."""
    held = manifest.part(split, "val")
    held = held if len(held) else manifest.part(split, "test")
    gel = ["background"] if like is not None and has_gels(held) else []
    some = some_whole(held, ["vision", "tactile", *gel], DRAWN)
    if not len(some):
        return None
    try:
        photos, tactile = (cached_images(some, column, size) for column in ("vision", "tactile"))
        gels = None if like is None else gels_of(some, size, like=like)
    except PalpateError:  # of a file: no reason to lose the training
        return None
    return some.ids, photos, tactile, gels


def _require_same(start: TactilePipeline, parts: Parts, policy: ConditionPolicy) -> None:
    """A denoiser goes on only in the space that it knows."""
    vision = start.encoders.digest("vision") if start.encoders else None
    policies = [(p.source, *lengths_of(p)) for p in (start.denoiser.policy, policy)]
    pairs = {
        "autoencoder": (start.autoencoder.digest, parts.autoencoder.digest),
        "vision encoder": (vision, _digests(parts.encoders)["vision"]),
        "schedule": (start.schedule, parts.preset.schedule),
        "source and tokens": policies,
        "background": (start.denoiser.background, parts.background),
    }
    different = [name for name, (old, new) in pairs.items() if old != new]
    must, got = f"must share {', '.join(pairs)}", f"another {', another '.join(different)}"
    require(not different, "start", must, got, fix="Leave out what differs, or start")
