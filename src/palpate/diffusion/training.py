"""Training a generator (paper section 2): encode once, then train the denoiser on Eq. 1,

    L(theta) = E_{z, c, eps, t} || eps - eps_theta(z^t, t, c) ||^2,   t uniform on 1..T,
    z^t = sqrt(a_t) z + sqrt(1 - a_t) eps.

Only the train part of the split is read. Tactile images go through the frozen autoencoder and texts
and photos through the frozen encoders once, into caches; the training loop reads those. The
condition c is dropped with probability p, which trains the unconditional model that guidance needs
(Ho & Salimans 2022).

Options beyond the paper: v-prediction (Salimans & Ho 2022), whose target is ``sqrt(a) eps - sqrt(1
- a) z``, and the min-SNR weight (Hang et al. 2023): ``min(snr, g) / snr`` for eps and ``min(snr, g)
/ (snr + 1)`` for v.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from palpate import __version__
from palpate.core import (
    PalpateError,
    Progress,
    Split,
    atomic_path,
    digest_json,
    digest_lines,
    quiet,
    read_json,
    write_json,
)
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.diffusion.autoencoder import Autoencoder, LatentStats
from palpate.diffusion.autoencoder_training import SHOWN, sheet, train_autoencoder
from palpate.diffusion.denoiser import Denoiser, build_unet
from palpate.diffusion.options import SOURCES, ConditionPolicy, Schedule, Source, UNetOptions
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import DiffusionPreset, preset_named
from palpate.encoders.contrastive import load_split, train_part
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import EncoderSet, load_clip, seeded
from palpate.encoders.models import digest_tensors, pick_device
from palpate.encoders.rows import evenly
from palpate.training.engine import Batch, Losses, Task, fit
from palpate.training.estimate import estimate
from palpate.training.options import Compute, LoopOptions
from palpate.training.processes import connect, first_alone, keep_logs, place, work_folder
from palpate.training.steps import Step

if TYPE_CHECKING:
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel

CACHE_FORMAT = "palpate-latents/1"
Sources = Literal["text", "vision", "mixed"]


@dataclass(frozen=True)
class Encoded:
    """A part of the data as the denoiser's training reads it.

    Attributes:
        conditions: embeddings (n, d) by source.
        latents, background: (n, c, h, w), not normalized, in memory or mapped.
    """

    conditions: Mapping[Source, NDArray[Any]]
    latents: NDArray[np.float32]
    background: NDArray[np.float32] | None = None


def train_generator(  # noqa: PLR0913 - a public verb
    data: Manifest | str | Path,
    split: Split | str | Path | None,
    clip: EncoderSet | str | Path,
    *,
    preset: str | DiffusionPreset = "mini",
    autoencoder: Autoencoder | str | Path | None = None,
    output: Path | str | None = None,
    source: Sources | None = None,
    background: bool = False,
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
            the folder or hub id of a CLIP, or ``palpate/mini``.
        preset: geometry, schedule and length: ``mini``, ``tiny`` or ``paper``, or a preset.
        autoencoder: a VQ model, its folder or hub id, or ``palpate/mini``. Default: a small one,
            trained first on the train part; the preset ``paper`` needs one.
        output: folder for the pipeline, new or empty; None keeps it in memory.
        source: what training conditions on; default: the preset's. ``vision`` is the baseline
            without text (GVST).
        background: the variant w/ BG, which also sees the no-contact image.
        steps: optimizer steps; default: the preset's.
        seed: of weights, order, noise and condition dropout.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Raises:
        PalpateError: if the train part is empty, a sample of it lacks an image or words, or models
            are missing.
    """
    if steps is not None and steps < 1:
        fix = "Leave it out for the preset's length"
        raise PalpateError("must be at least 1", str(steps), fix, argument="steps")
    chosen = preset if isinstance(preset, DiffusionPreset) else preset_named(preset)
    if autoencoder is None and chosen.autoencoder is None:
        must, fix = f"must be given for the preset {chosen.name}", "Pass a hub id or a folder"
        raise PalpateError(must, "none", fix, argument="autoencoder")
    device = connect(device)
    manifest, split = load(data), load_split(data, split)
    encoders = clip if isinstance(clip, EncoderSet) else EncoderSet(load_clip(clip))
    if missing := [source for source in SOURCES if source not in encoders.modalities]:
        must, got = "must have vision and text", f"no {' and no '.join(missing)}"
        raise PalpateError(must, got, "Pass a CLIP", argument="clip")
    output = None if output is None else Path(output)
    with work_folder(output) as work:
        cache = work / "cache"
        if autoencoder is None:
            train, others = train_part(manifest, split), manifest.part(split, "val", "test")
            with first_alone():
                images, held_out = (
                    cached_images(p, "tactile", chosen.size, cache, progress) if len(p) else None
                    for p in (train, others)
                )
            assert images is not None
            assert chosen.autoencoder is not None
            autoencoder = train_autoencoder(
                images,
                chosen.autoencoder,
                work / "autoencoder",
                held_out=held_out,
                seed=seed,
                key=image_stamp(train, "tactile"),
                device=pick_device(device),
                compute=compute,
                progress=progress,
            )
        elif not isinstance(autoencoder, Autoencoder):
            autoencoder = Autoencoder.load(autoencoder)
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
            cache=cache,
            device=device,
            compute=compute,
            progress=progress,
        )
        if output is not None and place()[0] == 0:
            pipeline.save(output)
            keep_logs(work, output)
    return pipeline


def plan_generator(
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    *,
    preset: str | DiffusionPreset = "mini",
    steps: int | None = None,
    background: bool = False,
    device: str = "auto",
) -> dict[str, Any]:
    """What training the denoiser would take; only the manifest is read.

    Latents are taken as those of the preset's autoencoder, or of an f4 of three channels.

    Returns:
        see :func:`palpate.training.estimate.estimate`.
    """
    chosen = preset if isinstance(preset, DiffusionPreset) else preset_named(preset)
    train = train_part(load(data), load_split(data, split))
    loop = chosen.loop_for(len(train))
    loop = loop if steps is None else replace(loop, steps=steps)
    vq, width = chosen.autoencoder, chosen.condition.width
    factor = vq.patch * 2 ** (len(vq.widths) - 1) if vq else 4
    channels, side = vq.channels if vq else 3, chosen.size // factor

    def build() -> nn.Module:
        shape: dict[str, Any] = {"channels": channels, "size": side, "width": width}
        return build_unet(chosen.unet, **shape, background=background)

    def forward(model: nn.Module, rows: int, where: torch.device) -> Tensor:
        denoiser = Denoiser(cast("UNet2DConditionModel", model), chosen.condition).to(where)
        z = torch.zeros(rows, channels * (2 if background else 1), side, side, device=where)
        tokens = torch.zeros(rows, chosen.condition.tokens, width, device=where)
        return denoiser(z, torch.zeros(rows, dtype=torch.long, device=where), tokens)

    plan = estimate(build, forward, loop, len(train), pick_device(device))
    return plan | {"learning_rate_if_the_batch_is_each_of_two_gpus": 2 * loop.lr}


def train_pipeline(  # noqa: PLR0913, PLR0917 - one row per choice of the training
    manifest: Manifest,
    split: Split,
    encoders: EncoderSet,
    autoencoder: Autoencoder,
    preset: DiffusionPreset,
    folder: Path,
    *,
    seed: int = 0,
    steps: int | None = None,
    source: Sources | None = None,
    background: bool = False,
    start: TactilePipeline | None = None,
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
            sampling.
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
        cache: folder for decoded pixels and embeddings.
        device: see :func:`palpate.encoders.models.pick_device`.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Raises:
        PalpateError: if the train part is empty, a sample lacks what is needed, or ``start`` does
            not fit.
    """
    train = train_part(manifest, split)
    if start is not None:
        _require_same(start, encoders, autoencoder, preset)
    where = pick_device(connect(device))
    encoders.to(where)
    autoencoder.to(where)
    texts, text_source = texts_of(train)
    columns = ("tactile", "background") if background else ("tactile",)

    def encoded(part: Manifest, name: str) -> Encoded:
        def latents(column: str) -> NDArray[np.float32]:
            images = cached_images(part, column, preset.size, cache, progress)
            key = digest_json([part.digest, image_stamp(part, column), preset.size])
            work = folder / f"latents-{name}{column}"
            return encode_latents(autoencoder, images, part.ids, work, key=key, progress=progress)

        conditions: dict[Source, NDArray[Any]] = {
            s: embed(part, encoders, s, cache=cache, progress=progress).features for s in SOURCES
        }
        return Encoded(conditions, *map(latents, columns))

    with first_alone():
        rows, held = encoded(train, ""), manifest.part(split, "val")
        others = encoded(held, "val-") if len(held) else None
        shown = _shown(manifest, split, columns, preset.size, encoders)
    key = [digest_lines(texts), *(image_stamp(train, c) for c in ("vision", *columns))]
    key += [train.digest, held.digest if len(held) else "", autoencoder.digest]
    key += [encoders.digest(source) for source in SOURCES]
    stats = LatentStats.of(rows.latents, preset.latent_scale) if start is None else start.stats
    policy = preset.condition_for(encoders.dim)
    policy = policy if source is None else replace(policy, source=source)
    loop = preset.loop_for(len(train), seed=seed)
    loop = loop if steps is None else replace(loop, steps=steps)

    def samples(module: nn.Module) -> NDArray[np.uint8]:
        assert isinstance(module, Denoiser)
        assert shown is not None
        parts = (autoencoder, module, stats, preset.schedule, preset.sampler, preset.size)
        ids, conditions, photos, tactile, *gel = shown
        made = TactilePipeline(*parts).sample(
            conditions, ids, seed=seed, background=gel[0] if gel else None
        )
        return sheet(photos, tactile, made)

    denoiser = train_denoiser(
        rows.latents,
        rows.conditions,
        stats=stats,
        unet=preset.unet,
        policy=policy,
        schedule=preset.schedule,
        loop=loop,
        folder=folder / "denoiser",
        background=rows.background,
        held_out=others,
        start=start.denoiser if start else None,
        key=digest_json(key),
        names=train.ids,
        samples=samples if shown else None,
        device=where,
        compute=compute,
        progress=progress,
    )
    record = {
        "manifest": manifest.digest,
        "split": split.digest,
        "split_rule": dict(split.rule),
        "train_samples": len(train),
        "text_source": text_source,
        "autoencoder": autoencoder.digest,
        "vision": encoders.digest("vision"),
        "text": encoders.digest("text"),
        "source": policy.source,
        "background": background,
        "loop": asdict(loop),
        "unet": asdict(preset.unet),
        "seed": seed,
        "processes": place()[1],
        "palpate": __version__,
        "parameters": sum(p.numel() for p in denoiser.unet.parameters()),
        "synthetic": bool(manifest.synthetic),
        "materials": sorted({str(m) for m in train.column("material") if m}),
        "start": start.digest if start else None,
        "start_record": dict(start.training) if start else None,
    }
    return TactilePipeline(
        autoencoder,
        denoiser,
        stats,
        preset.schedule,
        preset.sampler,
        preset.size,
        EncoderSet(encoders.clip),  # the tactile encoder scores, it does not generate
        preset.name,
        record,
    )


def _shown(
    manifest: Manifest, split: Split, columns: Sequence[str], size: int, encoders: EncoderSet
) -> tuple[Any, ...] | None:
    """Some samples outside of train: ids, vision embeddings, photos and images of ``columns``."""
    columns = ("vision", *columns)
    held = manifest.part(split, "val")
    held = held if len(held) else manifest.part(split, "test")
    cells = zip(held.ids, *(held.column(c) for c in columns), strict=True)
    whole = [name for name, *images in cells if all(images)]
    if not whole:
        return None
    some = held.take([whole[k] for k in evenly(len(whole), SHOWN)])
    return (
        some.ids,
        embed(some, encoders, "vision").features,
        *(cached_images(some, column, size) for column in columns),
    )


def _require_same(
    start: TactilePipeline, encoders: EncoderSet, autoencoder: Autoencoder, preset: DiffusionPreset
) -> None:
    """A denoiser goes on only in the space that it knows."""
    vision = start.encoders.digest("vision") if start.encoders else None
    pairs = {
        "autoencoder": (start.autoencoder.digest, autoencoder.digest),
        "vision encoder": (vision, encoders.digest("vision")),
        "schedule": (start.schedule, preset.schedule),
    }
    if different := [name for name, (a, b) in pairs.items() if a != b]:
        must, got = f"must share {', '.join(pairs)}", f"another {', another '.join(different)}"
        raise PalpateError(must, got, "Leave it out", argument="start")


def encode_latents(
    autoencoder: Autoencoder,
    images: NDArray[np.uint8],
    ids: Sequence[str],
    folder: Path,
    *,
    key: str = "",
    batch: int = 32,
    progress: Progress = quiet,
) -> NDArray[np.float32]:
    """Latents of all images, before quantization, as a read-only memory map; encoded once.

    Args:
        autoencoder: frozen; its digest is part of the cache's key.
        images: (n, h, w, 3) bytes, in the order of ``ids``; an array or a memory map.
        ids: sample ids.
        folder: holds ``latents.npy`` and ``latents.json``, the ids in order and a key.
        key: digest of what the images are (manifest, column, size).
        batch: images at once.
        progress: called after each batch.

    Returns:
        float32 (n, c, h / f, w / f).
    """
    data, note = folder / "latents.npy", folder / "latents.json"
    key = digest_json([key, autoencoder.digest])
    about = {"format": CACHE_FORMAT, "key": key, "ids": list(ids)}
    if not (data.is_file() and note.is_file() and read_json(note, "latent cache") == about):
        note.unlink(missing_ok=True)
        height, width = (side // autoencoder.factor for side in images.shape[1:3])
        shape = (len(ids), autoencoder.channels, height, width)
        with atomic_path(data) as part:
            store = np.lib.format.open_memmap(part, mode="w+", dtype=np.float32, shape=shape)
            for start in range(0, len(ids), batch):
                rows = slice(start, min(start + batch, len(ids)))
                store[rows] = autoencoder.encode(images[rows], batch).numpy()
                progress("encoding tactile images", rows.stop, len(ids))
            store.flush()
        write_json(note, about)
    return np.load(data, mmap_mode="r", allow_pickle=False)


def train_denoiser(  # noqa: PLR0913 - one row per part of the model
    latents: Tensor | NDArray[Any],
    conditions: Mapping[Source, Tensor | NDArray[Any]],
    *,
    stats: LatentStats,
    unet: UNetOptions,
    policy: ConditionPolicy,
    schedule: Schedule,
    loop: LoopOptions,
    folder: Path,
    background: Tensor | NDArray[Any] | None = None,
    held_out: Encoded | None = None,
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
            their mean.
        stats: normalize the latents of tactile and background images.
        unet: geometry of the network.
        policy: how embeddings become tokens, and which train.
        schedule: the forward process and the target.
        loop: length, rate, averaging; its seed also seeds the weights.
        folder: for checkpoints and the log.
        background: latents (n, c, h, w) of the no-contact images, for the variant w/ BG.
        held_out: rows whose loss is measured in training.
        start: go on from these weights instead of random ones, in the same geometry. The modality
            means are those of ``conditions`` all the same.
        key: digest of latents, conditions and background, which are not read for it.
        names: of the rows, for errors.
        samples: see :class:`~palpate.training.engine.Task`.
        device: where to train.
        compute: how to run it on the machine at hand.
        progress: called after each step.

    Returns:
        The denoiser with averaged weights, frozen.

    Raises:
        PalpateError: if a source is missing, or ``start`` has another geometry.
    """
    tables: dict[Source, Tensor] = {
        s: torch.as_tensor(np.asarray(t), dtype=torch.float32) for s, t in conditions.items()
    }
    if missing := [s for s in policy.sources if s not in tables]:
        must, fix = f"source={policy.source!r} needs embeddings of {', '.join(policy.sources)}", ""
        raise PalpateError(must, f"none of {missing[0]}", fix)
    channels, size = latents.shape[1], latents.shape[2]
    means: dict[Source, Tensor] = {
        s: tables[s].double().mean(0).float() for s in SOURCES if s in tables
    }
    with seeded(loop.seed, "denoiser"):
        shape: dict[str, Any] = {"channels": channels, "size": size, "width": policy.width}
        net = build_unet(unet, **shape, background=background is not None)
        model = Denoiser(net, policy, means).to(device)
    if start is not None:
        _copy_weights(start, model)
    with torch.no_grad():

        def loss_of(conditions: Mapping[Source, Tensor], *tables: Any) -> DiffusionLoss:
            tokens: dict[Source, Tensor] = {
                s: model.tokens(conditions[s], s).to("cpu") for s in policy.sources
            }
            how: dict[str, Any] = {"stats": stats, "schedule": schedule, "policy": policy}
            return DiffusionLoss(tables[0], tokens, tables[1], **how)

        loss, others = loss_of(tables, latents, background), None
        if held_out is not None:
            texts: dict[Source, Tensor] = {
                s: torch.as_tensor(held_out.conditions[s]) for s in policy.sources
            }
            held = loss_of(texts, held_out.latents, held_out.background)
            others = (len(held_out.latents), held.load)
    facts = [asdict(settings) for settings in (stats, unet, policy, schedule)]
    begin = [] if start is None else [digest_tensors(start.unet.state_dict())]
    key = digest_json([key, background is not None, *facts, *begin])
    task = Task("generator", len(latents), loss.load, loss, key, names, others, None, samples)
    fit(model, task, loop, folder, compute=compute, progress=progress)
    return model.eval().requires_grad_(False)


def _copy_weights(source: Denoiser, target: Denoiser) -> None:
    """Copy the U-Net, and the unconditional token if both have learned one."""
    shapes = [{k: v.shape for k, v in d.unet.state_dict().items()} for d in (source, target)]
    if shapes[0] != shapes[1]:
        must, got = "must have the geometry of the preset", "another geometry"
        raise PalpateError(must, got, "Leave it out", argument="start")
    target.unet.load_state_dict(source.unet.state_dict())
    if source.null is not None and target.null is not None:
        target.null.data.copy_(source.null.data)


class DiffusionLoss:
    """Eq. 1 for one batch; all draws are those of the step."""

    def __init__(
        self,
        latents: Tensor | NDArray[Any],
        tokens: Mapping[Source, Tensor],
        background: Tensor | NDArray[Any] | None,
        *,
        stats: LatentStats,
        schedule: Schedule,
        policy: ConditionPolicy,
    ) -> None:
        """Take latents and backgrounds (n, c, h, w), not normalized, and tokens (n, k, d)."""
        self.latents, self.tokens, self.background = latents, dict(tokens), background
        self.stats, self.schedule, self.policy = stats, schedule, policy
        self.alphas = schedule.alphas()

    def load(self, step: Step) -> Batch:
        """Noisy latents, their targets, tokens and which of these are dropped."""
        z = self.stats.normalize(_take(self.latents, step.rows))
        t = step.randint(self.schedule.steps)
        noise = step.randn(*z.shape[1:])
        tokens = self._tokens(step)
        dropped = step.rand() < self.policy.dropout
        a = self.alphas[t].float().reshape(-1, 1, 1, 1)
        epsilon = self.schedule.prediction == "epsilon"
        batch = {
            "noisy": a.sqrt() * z + (1 - a).sqrt() * noise,
            "target": noise if epsilon else a.sqrt() * noise - (1 - a).sqrt() * z,
            "t": t,
            "weight": self.weight(t),
            "tokens": tokens,
            "dropped": dropped.reshape(-1, 1, 1),
        }
        if self.background is not None:
            batch["background"] = self.stats.normalize(_take(self.background, step.rows))
        return batch

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        """Return the weighted error of a batch, and the unweighted to log."""
        assert isinstance(module, Denoiser)
        null = module.null_tokens(len(batch["t"]))
        tokens = torch.where(batch["dropped"], null, batch["tokens"])
        prediction = module(batch["noisy"], batch["t"], tokens, batch.get("background"))
        error = (prediction.float() - batch["target"]).square().mean((1, 2, 3))
        mse = error.detach().mean()
        return Losses((batch["weight"] * error).mean(), {"mse": mse}, error.detach())

    def _tokens(self, step: Step) -> Tensor:
        parts = [self.tokens[s][step.rows] for s in self.policy.sources]
        tokens = parts[0]
        if len(parts) == 2:
            tokens = torch.where(step.rand(1, 1) < 0.5, parts[0], parts[1])
        if self.policy.noise:
            # One draw per sample: the k tokens stay copies of each other.
            noise = step.randn(1, self.policy.width)
            tokens = nn.functional.normalize(tokens + self.policy.noise * noise, dim=2)
            tokens = tokens * self.policy.width**0.5
        return tokens

    def weight(self, t: Tensor) -> Tensor:
        """The min-SNR weight of each step."""
        if self.schedule.min_snr is None:
            return torch.ones(len(t))
        snr = (self.alphas[t] / (1 - self.alphas[t])).float()
        epsilon = self.schedule.prediction == "epsilon"
        return snr.clamp(max=self.schedule.min_snr) / (snr if epsilon else snr + 1)


def _take(table: Tensor | NDArray[Any], rows: NDArray[np.int64]) -> Tensor:
    return torch.as_tensor(table[rows])
