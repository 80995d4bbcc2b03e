"""Training a generator (paper section 2): encode once, then train the denoiser, in the paper on
Eq. 1,

    L(theta) = E_{z, c, eps, t} || eps - eps_theta(z^t, t, c) ||^2,   t uniform on 1..T,
    z^t = sqrt(a_t) z + sqrt(1 - a_t) eps.

Only the train part of the split is read. Tactile images go through the frozen autoencoder and texts
and photos through the frozen encoders once, into caches; the training loop reads those. The
condition c is dropped with probability p, which trains the unconditional model that guidance needs
(Ho & Salimans 2022).

Beyond the paper: flow matching (Lipman et al. 2023) with logit-normal time, whose target is ``eps -
z``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from numpy.typing import NDArray
from torch import Tensor, nn

from palpate._version import __version__
from palpate.core import PalpateError, Progress, Split, digest_json, digest_lines, quiet, short
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.diffusion.autoencoder import (
    AnyAutoencoder,
    BackgroundAutoencoder,
    LatentStats,
    load_autoencoder,
)
from palpate.diffusion.autoencoder_training import build_autoencoder, some_whole
from palpate.diffusion.autoencoders import autoencoder_of
from palpate.diffusion.ceiling import judge_of, measure_ceiling
from palpate.diffusion.denoiser import (
    Denoiser,
    build_unet,
    find_unet,
    inputs_of,
    lengths_of,
    load_unet,
    slots_of,
)
from palpate.diffusion.encoding import encode_latents, encode_patches
from palpate.diffusion.no_contact import gels_of, has_gels
from palpate.diffusion.options import (
    SOURCES,
    AutoencoderOptions,
    ConditionPolicy,
    Schedule,
    Source,
    Sources,
    UNetOptions,
)
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import DiffusionPreset, preset_named
from palpate.encoders.contrastive import load_split, train_part
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import EncoderSet, load_clip, seeded
from palpate.encoders.models import digest_tensors, is_hub_id, pick_device
from palpate.training.engine import Batch, Losses, Task, fit
from palpate.training.estimate import estimate
from palpate.training.options import Compute, LoopOptions
from palpate.training.processes import connect, first_alone, keep_logs, place, work_folder
from palpate.training.steps import Step

#: Share of the rows that are trained without the patches of their photo, so that the embedding
#: alone is known, too.
DROP_PATCHES = 0.5
#: Mean of the logit of the time of flow matching.
TIME_MEAN = 0.5
SHOWN = 8  # samples outside of train that are drawn while the denoiser trains
Backgrounds = Callable[[NDArray[np.int64]], Tensor]


@dataclass(frozen=True)
class Encoded:
    """A part of the data as the denoiser's training reads it.

    Attributes:
        conditions: embeddings (n, d) by source; ``patches``, states (n, k, w); ``photos`` of GVST
            (n, s, s, 3).
        latents: (n, c, h, w), not normalized, in memory or mapped.
        gels: the no-contact images (n, s, s, 3), where they are needed.
        background_latents: of an autoencoder that codes the gel with the image.
    """

    conditions: Mapping[str, NDArray[Any]]
    latents: NDArray[np.float32]
    gels: NDArray[np.uint8] | None = None
    background_latents: NDArray[np.float32] | None = None

    def backgrounds(self, autoencoder: AnyAutoencoder, stats: LatentStats) -> Backgrounds:
        """What the denoiser of the variant w/ BG sees."""
        gels, codes = self.gels, self.background_latents
        if isinstance(autoencoder, BackgroundAutoencoder):
            return lambda rows: autoencoder.gel(cast("Any", gels)[rows])
        return lambda rows: stats.normalize(_take(cast("Any", codes), rows))


def train_generator(  # noqa: PLR0913 - a public verb
    data: Manifest | str | Path,
    split: Split | str | Path | None,
    clip: EncoderSet | str | Path | None = None,
    *,
    preset: str | DiffusionPreset = "mini",
    autoencoder: AnyAutoencoder | str | Path | None = None,
    unet: str | Path | None = None,
    start: TactilePipeline | str | Path | None = None,
    output: Path | str | None = None,
    source: Sources | None = None,
    background: bool = False,
    judge: EncoderSet | str | Path | None = "palpate/mini",
    steps: int | None = None,
    seed: int = 0,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> TactilePipeline:
    """Train a generator on the train part of a split; run again with one ``output`` to resume.

    Args:
        data: a manifest, or anything that :func:`palpate.data.load` reads.
        split: a split or its file; its digest goes into the pipeline. None: the one that lies with
            the data.
        clip: vision and text encoders that condition the generator: a set of encoders, its folder,
            the folder or hub id of a CLIP, or ``palpate/mini``; ``source="resnet"`` needs none.
        preset: geometry, schedule and length, or its name (:data:`palpate.diffusion.PRESETS`); with
            ``start`` its training loop alone.
        autoencoder: any :class:`~palpate.diffusion.autoencoder.Autoencoder` or what its ``load``
            takes: folder, hub id, ``.ckpt`` or ``palpate/mini``. Default: a small one, trained
            first on the train part; the preset ``paper`` needs one.
        unet: go on from this one of diffusers instead of random weights: a folder or hub id of it
            or of its generator.
        start: go on from this generator of palpate, its folder, or ``palpate/mini``. Geometry,
            condition, schedule and sampler stay as they are, its encoders and autoencoder stand for
            those that are not given, its record goes into the new one, and the memory is made of
            the new data alone.
        output: folder for the pipeline, new or empty; None keeps it in memory.
        source: what training conditions on; default: the preset's. ``resnet`` is GVST, the baseline
            without text; ``vision`` has the preset's encoder in its place.
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
    if steps is not None and steps < 1:
        fix = "Leave it out for the preset's length"
        raise PalpateError("must be at least 1", str(steps), fix, argument="steps")
    start = TactilePipeline.from_pretrained(start) if isinstance(start, str | Path) else start
    chosen = _chosen(preset, unet, start)
    if start is not None:
        clip, autoencoder = clip or start.encoders, autoencoder or start.autoencoder
        background = background or start.denoiser.background
    if autoencoder is None and chosen.autoencoder is None:
        must, fix = f"must be given for the preset {chosen.name}", "Pass a folder or a file"
        raise PalpateError(must, "none", fix, argument="autoencoder")
    device = connect(device)
    judges = judge_of(judge, device)
    manifest, split = load(data), load_split(data, split)
    encoders = EncoderSet(load_clip(clip)) if isinstance(clip, str | Path) else clip
    needed = _modalities(_policy(chosen, encoders, source))
    known = [] if encoders is None else encoders.modalities
    if missing := [modality for modality in needed if modality not in known]:
        must, got = f"must have {' and '.join(needed)}", f"no {' and no '.join(missing)}"
        raise PalpateError(must, got, "Pass a CLIP", argument="clip")
    output = None if output is None else Path(output)
    with work_folder(output) as work:
        cache = work / "cache"
        if autoencoder is None:
            assert chosen.autoencoder is not None
            autoencoder = autoencoder_of(
                manifest,
                split,
                chosen.autoencoder,
                chosen.size,
                work / "autoencoder",
                cache=cache,
                seed=seed,
                device=device,
                compute=compute,
                progress=progress,
            )
        elif not isinstance(autoencoder, AnyAutoencoder):
            autoencoder = load_autoencoder(autoencoder)
        pipeline = train_pipeline(
            manifest,
            split,
            encoders,
            autoencoder,
            chosen,
            work,
            seed=seed,
            steps=steps,
            source=source,
            background=background,
            start=start,
            judge=judges,
            cache=cache,
            device=device,
            compute=compute,
            progress=progress,
        )
        if output is not None and place()[0] == 0:
            pipeline.save(output)
            keep_logs(work, output)
    return pipeline


def _chosen(
    preset: str | DiffusionPreset, unet: str | Path | None, start: TactilePipeline | None = None
) -> DiffusionPreset:
    """The preset, with a trained U-Net where one is given; after ``start`` only its length."""
    chosen = preset if isinstance(preset, DiffusionPreset) else preset_named(preset)
    if start is not None:
        if unet is not None:
            raise PalpateError("must be left out with start", str(unet), "", argument="unet")
        same = {"name": start.preset, "size": start.size, "schedule": start.schedule}
        same |= {"condition": start.denoiser.policy, "sampler": start.sampler}
        return replace(chosen, **same)
    if unet is None:
        return chosen
    find_unet(unet)
    return replace(chosen, unet=str(unet))


def plan_generator(  # noqa: PLR0913 - one row per choice
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    clip: str | Path | None = None,
    *,
    preset: str | DiffusionPreset = "mini",
    autoencoder: str | Path | None = None,
    unet: str | Path | None = None,
    start: str | Path | None = None,
    source: Sources | None = None,
    background: bool = False,
    steps: int | None = None,
    device: str = "auto",
) -> dict[str, Any]:
    """What training the denoiser would take; of the data only the manifest is read.

    Without an autoencoder latents are those of the preset's, or of an f4 of three channels.

    Returns:
        see :func:`palpate.training.estimate.estimate`.
    """
    begin = None if start is None else TactilePipeline.from_pretrained(start)
    chosen = _chosen(preset, unet, begin)
    train = train_part(load(data), load_split(data, split))
    loop = chosen.loop_for(len(train))
    loop = loop if steps is None else replace(loop, steps=steps)
    encoders = None if clip is None else EncoderSet(load_clip(clip))
    options, policy = chosen.autoencoder or AutoencoderOptions(), _policy(chosen, encoders, source)
    if autoencoder is not None:
        code = load_autoencoder(autoencoder)
    elif isinstance(options, AutoencoderOptions):
        code = build_autoencoder(options)
    else:
        code = BackgroundAutoencoder(options.channels, options.narrow, options.wide)
    gel = 3 * code.factor**2 if isinstance(code, BackgroundAutoencoder) else code.channels
    how = {"channels": code.channels, "background": gel if background else 0}
    side = chosen.size // code.factor

    def build() -> nn.Module:
        known = None if begin is None else begin.denoiser
        return Denoiser(_new_unet(known, chosen.unet, policy, side, **how), policy)

    def forward(model: nn.Module, rows: int, where: torch.device) -> Tensor:
        assert isinstance(model, Denoiser)
        z = torch.zeros(rows, model.unet.config["in_channels"], side, side, device=where)
        return model(z, torch.zeros(rows, device=where).long(), model.null_tokens(rows))

    return estimate(build, forward, loop, len(train), pick_device(device))


def train_pipeline(  # noqa: PLR0913, PLR0917 - one row per choice of the training
    manifest: Manifest,
    split: Split,
    encoders: EncoderSet | None,
    autoencoder: AnyAutoencoder,
    preset: DiffusionPreset,
    folder: Path,
    *,
    seed: int = 0,
    steps: int | None = None,
    source: Sources | None = None,
    background: bool = False,
    start: TactilePipeline | None = None,
    judge: EncoderSet | None = None,
    cache: Path | None = None,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> TactilePipeline:
    """Train the denoiser of a pipeline on the train part of a split; run again to resume.

    Args:
        manifest: samples with tactile image and photo, and a text or a material.
        split: its digest goes into the pipeline.
        encoders: their text embeddings condition the training, their vision embeddings the
            sampling; None for ``source="resnet"``.
        autoencoder: frozen.
        preset: geometry, schedule, length, sampler.
        folder: for checkpoints and latents; nothing in it belongs to the pipeline.
        seed: of weights, order, noise and condition dropout.
        steps: default: the preset's length.
        source: default: the preset's.
        background: the variant w/ BG.
        start: go on from this pipeline's denoiser instead of random weights. It must use the same
            autoencoder, vision encoder and schedule, gives its latent statistics, and its record
            goes into the new one, so that the data it was trained on stays declared.
        judge: of the ceiling, beside PSNR and SSIM.
        cache: folder for decoded pixels and embeddings.
        device: see :func:`palpate.encoders.models.pick_device`.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Raises:
        PalpateError: if the train part is empty, a sample lacks what is needed, or ``start`` does
            not fit.
    """
    train = train_part(manifest, split)
    if preset.size % autoencoder.factor:
        must = f"must reduce images of {preset.size} pixels, the preset's, by a divisor of it"
        fix = "Choose another, or another size"
        raise PalpateError(must, str(autoencoder.factor), fix, argument="autoencoder")
    policy = _policy(preset, encoders, source)
    if start is not None:
        _require_same(start, encoders, autoencoder, preset.schedule, policy, background=background)
    where = pick_device(connect(device))
    encoders = encoders.to(where) if encoders is not None and policy.sources else None
    nn.Module.to(autoencoder, where)
    modalities = _modalities(policy)
    texts, text_source = texts_of(train) if "text" in modalities else ([], None)
    given_gel = isinstance(autoencoder, BackgroundAutoencoder)
    gels = background or (given_gel and has_gels(train))
    columns = ("vision", "tactile", *(("background",) if gels else ()))

    code = partial(
        _encoded,
        encoders=encoders,
        autoencoder=autoencoder,
        policy=policy,
        columns=columns[1:],
        size=preset.size,
        folder=folder,
        cache=cache,
        progress=progress,
    )
    with first_alone():
        rows, held = code(train), manifest.part(split, "val")
        others = code(held, like=rows.gels) if len(held) else None
        shown = _shown(manifest, split, preset.size, rows.gels)
    key = [digest_lines(texts), *(image_stamp(train, c) for c in columns)]
    key += [
        *(train.digest, held.digest if len(held) else "", autoencoder.digest),
        *(encoders.digest(modality) for modality in modalities if encoders is not None),
    ]
    stats = LatentStats.of(rows.latents, preset.latent_scale) if start is None else start.stats
    loop = preset.loop_for(len(train), seed=seed)
    loop = loop if steps is None else replace(loop, steps=steps)

    def backgrounds(encoded: Encoded) -> Backgrounds | None:
        return encoded.backgrounds(autoencoder, stats) if background else None

    def samples(module: nn.Module) -> NDArray[np.uint8]:
        assert isinstance(module, Denoiser)
        assert shown is not None
        names, photos, tactile, given = shown
        drawn = pipeline(module)
        made = drawn.sample(drawn.embed(photos), names, seed=seed, background=given)
        return np.vstack([np.hstack(list(row)) for row in (photos, tactile, made)])

    def pipeline(denoiser: Denoiser, record: dict[str, Any] | None = None) -> TactilePipeline:
        return TactilePipeline(
            autoencoder,
            denoiser,
            stats,
            preset.schedule,
            preset.sampler,
            preset.size,
            # The tactile encoder scores, it does not generate.
            None if encoders is None else EncoderSet(encoders.clip),
            preset.name,
            record or {},
            rows.gels[0] if given_gel and rows.gels is not None else None,
        )

    denoiser = train_denoiser(
        rows.latents,
        rows.conditions,
        stats=stats,
        unet=preset.unet,
        policy=policy,
        schedule=preset.schedule,
        loop=loop,
        folder=folder / "denoiser",
        background=backgrounds(rows),
        held_out=(others.conditions, others.latents, backgrounds(others)) if others else None,
        start=start.denoiser if start else None,
        key=digest_json(key),
        names=train.ids,
        samples=samples if shown else None,
        device=where,
        compute=compute,
        progress=progress,
    )
    measured = measure_ceiling(
        autoencoder, manifest, split, preset.size, judge=judge, cache=cache, progress=progress
    )
    record = {
        "manifest": manifest.digest,
        "split": split.digest,
        "split_rule": dict(split.rule),
        "train_samples": len(train),
        "text_source": text_source,
        "autoencoder": autoencoder.digest,
        "ceiling": measured,
        **_digests(encoders),
        "source": policy.source,
        "background": background,
        "gel": ("manifest" if gels else "median") if given_gel else None,
        "loop": asdict(loop),
        "unet": start.training.get("unet") if start else _geometry(preset.unet),
        "seed": seed,
        "processes": place()[1],
        "palpate": __version__,
        "parameters": sum(p.numel() for p in denoiser.parameters()),
        "synthetic": bool(manifest.synthetic),
        "materials": sorted({str(m) for m in train.column("material") if m}),
        "start": start.digest if start else None,
        "start_record": dict(start.training) if start else None,
    }
    return pipeline(denoiser, record)


def _geometry(unet: UNetOptions | str) -> dict[str, Any]:
    """The geometry of a U-Net, or whose it was."""
    if isinstance(unet, UNetOptions):
        return asdict(unet)
    return {"source": unet if is_hub_id(unet) else Path(unet).resolve().name}


def _digests(encoders: EncoderSet | None) -> dict[str, str | None]:
    known = [] if encoders is None else encoders.modalities
    return {s: encoders.digest(s) if encoders and s in known else None for s in ("vision", "text")}


def _policy(
    preset: DiffusionPreset, encoders: EncoderSet | None, source: Sources | None
) -> ConditionPolicy:
    """The preset's policy with another source; photos alone need no memory of texts."""
    width = preset.condition.width if encoders is None else encoders.dim
    policy = preset.condition_for(width)
    chosen = source or policy.source
    return replace(policy, source=chosen, gap=policy.gap if chosen in ("text", "both") else "none")


def _modalities(policy: ConditionPolicy) -> tuple[Source, ...]:
    """The encoders that training needs: vision for the samples that it draws, at least."""
    if not policy.sources:
        return ()
    return SOURCES if "text" in policy.sources else ("vision",)


def _encoded(
    part: Manifest,
    *,
    encoders: EncoderSet | None,
    autoencoder: AnyAutoencoder,
    policy: ConditionPolicy,
    columns: Sequence[str],
    size: int,
    folder: Path,
    cache: Path | None,
    like: NDArray[np.uint8] | None = None,
    progress: Progress = quiet,
) -> Encoded:
    """Encode a part, or find it in the cache."""
    given = isinstance(autoencoder, BackgroundAutoencoder)
    gels = None
    if given:
        gels = gels_of(part, size, cache, progress, like)
    elif "background" in columns:
        gels = cached_images(part, "background", size, cache, progress)
    images = cached_images(part, "tactile", size, cache, progress)
    stamps = [image_stamp(part, column) for column in columns]
    if given and gels is not None:  # the stock gel is that of train
        stamps.append(digest_tensors({"gel": torch.from_numpy(np.array(gels[0]))}))
    key = digest_json([part.digest, *stamps, size])
    place = (cache or folder) / f"latents-{short(digest_json([key, autoencoder.digest]))}"
    code = partial(encode_latents, autoencoder, ids=part.ids, key=key, progress=progress)
    conditions: dict[str, NDArray[Any]] = {}
    if encoders is not None:
        for s in _modalities(policy):
            conditions[s] = embed(part, encoders, s, cache=cache, progress=progress).features
        if "patches" in inputs_of(policy):
            conditions["patches"] = encode_patches(
                part, encoders, policy.patches, folder=cache or folder, progress=progress
            )
    if "photos" in inputs_of(policy):
        conditions["photos"] = cached_images(part, "vision", policy.photo_size, cache, progress)
    latents = code(images, gels if given else None, folder=place)
    if gels is None or given:
        return Encoded(conditions, latents, gels)
    return Encoded(conditions, latents, gels, code(gels, None, folder=place / "background"))


def _shown(
    manifest: Manifest, split: Split, size: int, like: NDArray[np.uint8] | None
) -> tuple[Sequence[str], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8] | None] | None:
    """Ids of samples of val, or of test, their photos, tactile images and gels, to be drawn."""
    held = manifest.part(split, "val")
    held = held if len(held) else manifest.part(split, "test")
    gel = ["background"] if like is not None and has_gels(held) else []
    some = some_whole(held, ["vision", "tactile", *gel], SHOWN)
    if not len(some):
        return None
    try:
        photos, tactile = (cached_images(some, column, size) for column in ("vision", "tactile"))
        gels = None if like is None else gels_of(some, size, like=like)
    except PalpateError:  # of a file: no reason to lose the training
        return None
    return some.ids, photos, tactile, gels


def _require_same(
    start: TactilePipeline,
    encoders: EncoderSet | None,
    autoencoder: AnyAutoencoder,
    schedule: Schedule,
    policy: ConditionPolicy,
    *,
    background: bool,
) -> None:
    """A denoiser goes on only in the space that it knows."""
    vision = start.encoders.digest("vision") if start.encoders else None
    seen = [(p.source, *lengths_of(p)) for p in (start.denoiser.policy, policy)]
    pairs = {
        "autoencoder": (start.autoencoder.digest, autoencoder.digest),
        "vision encoder": (vision, _digests(encoders)["vision"]),
        "schedule": (start.schedule, schedule),
        "source and tokens": tuple(seen),
        "background": (start.denoiser.background, background),
    }
    if different := [name for name, (a, b) in pairs.items() if a != b]:
        must, got = f"must share {', '.join(pairs)}", f"another {', another '.join(different)}"
        fix = "Leave out what differs, or start"
        raise PalpateError(must, got, fix, argument="start")


def train_denoiser(  # noqa: PLR0913 - one row per part of the model
    latents: Tensor | NDArray[Any],
    conditions: Mapping[str, Tensor | NDArray[Any]],
    *,
    stats: LatentStats,
    unet: UNetOptions | str,
    policy: ConditionPolicy,
    schedule: Schedule,
    loop: LoopOptions,
    folder: Path,
    background: Backgrounds | None = None,
    held_out: tuple[Mapping[str, Any], Any, Backgrounds | None] | None = None,
    start: Denoiser | None = None,
    key: str = "",
    names: Sequence[str] | None = None,
    samples: Callable[[nn.Module], NDArray[np.uint8]] | None = None,
    device: str | torch.device = "cpu",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> Denoiser:
    """Train a denoiser; resume if ``folder`` holds a checkpoint of the same run.

    Args:
        latents: (n, c, h, w) of the autoencoder, not normalized; a memory map will do.
        conditions: embeddings (n, d) by source; ``policy.sources`` are needed, others only give
            their mean. By name ``inputs_of(policy)``, arrays or memory maps.
        stats: normalize the latents of tactile and background images.
        unet: geometry of the network, or a trained one, see :func:`load_unet`; ``start`` has its
            own.
        policy: how embeddings become tokens, and which train.
        schedule: the forward process and the target.
        loop: length, rate, averaging; its seed also seeds the weights.
        folder: for checkpoints and the log.
        background: rows -> (n, g, h, w), see :meth:`Encoded.backgrounds`, for the variant w/ BG.
        held_out: conditions, latents and background of rows whose loss is measured in training.
        start: go on from these weights instead of random ones. The modality means are those of
            ``conditions`` all the same.
        key: digest of latents, conditions and background, which are not read for it.
        names: of the rows, for errors.
        samples: see :class:`~palpate.training.engine.Task`.
        device: where to train.
        compute: how to run it on the machine at hand.
        progress: called after each step.

    Returns:
        The denoiser with averaged weights, frozen.

    Raises:
        PalpateError: if a source is missing.
    """
    tables: dict[Source, Tensor] = {
        s: torch.as_tensor(np.asarray(conditions[s]), dtype=torch.float32)
        for s in SOURCES
        if s in conditions
    }
    _require_conditions(policy, conditions)
    channels, size = latents.shape[1], latents.shape[2]
    means: dict[Source, Tensor] = {
        s: tables[s].double().mean(0).float() for s in SOURCES if s in tables
    }
    with seeded(loop.seed, "denoiser"):
        wide = 0 if background is None else background(np.arange(1)).shape[1]
        net = _new_unet(start, unet, policy, size, channels=channels, background=wide)
        memory = _memory(tables) if policy.gap == "pairs" else None
        width = conditions["patches"].shape[2] if "patches" in inputs_of(policy) else None
        model = Denoiser(net, policy, means, memory, width)
        model.to(device)
    if start is not None:
        _copy_weights(start, model)
    with torch.no_grad():

        def loss_of(
            conditions: Mapping[str, Any], latents: Any, background: Backgrounds | None
        ) -> DiffusionLoss:
            tokens: dict[Source, Tensor] = {
                s: model.tokens(torch.as_tensor(conditions[s]), s).to("cpu") for s in policy.sources
            }
            return DiffusionLoss(
                latents,
                tokens,
                background,
                stats=stats,
                schedule=schedule,
                policy=policy,
                inputs={name: conditions[name] for name in inputs_of(policy)},
            )

        loss, others = loss_of({**conditions, **tables}, latents, background), None
        if held_out is not None:
            others = (len(held_out[1]), loss_of(*held_out).load)
    records = (stats, unet, policy, schedule)
    settings = [asdict(r) for r in records if not isinstance(r, str)]
    trained = start is not None or isinstance(unet, str)
    begin = [digest_tensors(model.state_dict())] if trained else []
    key = digest_json([key, background is not None, *settings, *begin])
    task = Task("generator", len(latents), loss.load, loss, key, names, others, samples)
    fit(model, task, loop, folder, compute=compute, progress=progress)
    return model.eval().requires_grad_(False)


def _new_unet(
    start: Denoiser | None, unet: UNetOptions | str, policy: ConditionPolicy, size: int, **how: int
) -> UNet2DConditionModel:
    """The network that trains: of the shape of ``start``, a trained one, or one of new weights."""
    if start is not None:
        return cast("Any", UNet2DConditionModel.from_config(start.unet.config))
    if isinstance(unet, str):
        return load_unet(unet, policy, **how)
    return build_unet(unet, policy, size=size, **how)


def _require_conditions(policy: ConditionPolicy, conditions: Mapping[str, Any]) -> None:
    if policy.gap == "pairs" and "text" not in policy.sources:
        must = "must be text or both with gap='pairs': other photos would find their own text"
        raise PalpateError(must, policy.source, "Take gap='none'", argument="source")
    needed = dict.fromkeys((*policy.sources, *inputs_of(policy)))
    if policy.gap == "pairs":
        needed |= dict.fromkeys(SOURCES)
    if missing := [name for name in needed if name not in conditions]:
        chosen = f"source={policy.source!r} and gap={policy.gap!r}"
        must, fix = f"{chosen} need conditions of {', '.join(needed)}", ""
        raise PalpateError(must, f"none of {missing[0]}", fix)


def _memory(tables: Mapping[Source, Tensor]) -> tuple[Tensor, Tensor]:
    """The different training texts (m, d), and the mean of the photos of each."""
    texts, which, counts = tables["text"].unique(dim=0, return_inverse=True, return_counts=True)
    photos = torch.zeros_like(texts).index_add_(0, which, tables["vision"])
    return texts, photos / counts[:, None]


def _copy_weights(source: Denoiser, target: Denoiser) -> None:
    """Copy the U-Net, and what else both have learned."""
    weights = dict(source.named_parameters())
    for name, own in target.named_parameters():
        if name in weights:
            own.data.copy_(weights[name].data)


class DiffusionLoss:
    """Eq. 1, or that of flow matching, for one batch; all draws are those of the step."""

    def __init__(
        self,
        latents: Tensor | NDArray[Any],
        tokens: Mapping[Source, Tensor],
        background: Backgrounds | None,
        *,
        stats: LatentStats,
        schedule: Schedule,
        policy: ConditionPolicy,
        inputs: Mapping[str, Any] | None = None,
    ) -> None:
        """Take latents (n, c, h, w), not normalized, tokens (n, k, d) by source, and inputs."""
        self.latents, self.tokens, self.background = latents, dict(tokens), background
        self.stats, self.schedule, self.policy = stats, schedule, policy
        self.inputs = dict(inputs or {})
        self.lengths = torch.tensor(lengths_of(policy))
        self.alphas = schedule.alphas()

    def load(self, step: Step) -> Batch:
        """Noisy latents, their targets, tokens, and which of these are dropped."""
        z = self.stats.normalize(_take(self.latents, step.rows))
        if self.schedule.prediction == "flow":
            time = torch.sigmoid(TIME_MEAN + step.randn())
            keep, spread, t = 1 - time, time, self.schedule.steps * time
        else:
            t = step.randint(self.schedule.steps)
            a = self.alphas[t].float()
            keep, spread = a.sqrt(), (1 - a).sqrt()
        keep, spread = keep.reshape(-1, 1, 1, 1), spread.reshape(-1, 1, 1, 1)
        noise = step.randn(*z.shape[1:])
        target = noise - z if self.schedule.prediction == "flow" else noise
        tokens = self._tokens(step)
        batch = {
            "noisy": keep * z + spread * noise,
            "target": target,
            "t": t,
            **({} if tokens is None else {"tokens": tokens}),
            **{name: _take(table, step.rows) for name, table in self.inputs.items()},
            "dropped": self._dropped(step).repeat_interleave(self.lengths, dim=1),
        }
        if self.background is not None:
            batch["background"] = self.background(step.rows)
        return batch

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        """Return the squared error of a batch."""
        assert isinstance(module, Denoiser)
        null = module.null_tokens(len(batch["t"]))
        parts = [batch["tokens"]] if "tokens" in batch else []
        parts += [make(batch[name].float()) for name, make in module.maps.items()]
        tokens = torch.where(batch["dropped"], null, torch.cat(parts, dim=1))
        prediction = module(batch["noisy"], batch["t"], tokens, batch.get("background"))
        error = (prediction.float() - batch["target"]).square().mean((1, 2, 3))
        total = error.mean()
        return Losses(total, {"mse": total.detach()}, error.detach())

    def _tokens(self, step: Step) -> Tensor | None:
        """Tokens of the embeddings, with noise."""
        if not self.policy.sources:
            return None
        tokens = torch.cat([self.tokens[s][step.rows] for s in self.policy.sources], dim=1)
        if self.policy.noise:
            noise = step.randn(slots_of(self.policy), self.policy.width)
            tokens = nn.functional.normalize(tokens + self.policy.noise * noise, dim=2)
            tokens = tokens * self.policy.width**0.5
        return tokens

    def _dropped(self, step: Step) -> Tensor:
        """Which embeddings and inputs (n, parts, 1) are dropped; patches also with their photo."""
        draws = step.rand(len(self.lengths), 1)
        dropped, slots = draws < self.policy.dropout, slots_of(self.policy)
        if "patches" in self.inputs:
            dropped[:, slots:] = dropped[:, slots - 1 : slots] | (draws[:, slots:] < DROP_PATCHES)
        return dropped


def _take(table: Tensor | NDArray[Any], rows: NDArray[np.int64]) -> Tensor:
    return torch.as_tensor(table[rows])
