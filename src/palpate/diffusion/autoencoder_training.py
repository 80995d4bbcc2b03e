"""Training of autoencoders, of both kinds.

A VQ model is trained in stages that leave no code unused:

1. *Free*: encoder and decoder without quantization, with Gaussian noise on the latents (relative to
   their spread), so that the decoder is smooth around each latent.
2. *Codebook*: k-means of encoder outputs (Lloyd's iterations; an empty cell moves to the point
   farthest from its center) becomes the codebook, so that every code starts in use.
3. *Quantized*: everything together with straight-through gradients (van den Oord et al. 2017).

Loss: ``0.25 L1 + 10 L2 + 10 L2 of the first differences`` (+ 0.25 the codebook loss of VQModel in
stage 3). Squares where the texture is: where a pattern is not yet known, an absolute error is least
for none at all. Stage 1 sees random crops: the network is convolutional, and crops give it more
steps a second. Stage 3 sees whole images, because group normalization takes its statistics over the
image: trained on crops alone, whole images come out too dark.

An autoencoder that is given the gel is trained in one stage, on crops of images and gels.
"""

from __future__ import annotations

import copy
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from diffusers.models.autoencoders.vq_model import VQModel
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate

from palpate.core import Progress, Split, digest_json, fields_of, quiet, require, rng_for
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import (
    AnyAutoencoder,
    Autoencoder,
    BackgroundAutoencoder,
    load_autoencoder,
)
from palpate.diffusion.ceiling import judge_of, measure_ceiling
from palpate.diffusion.gels import gels_of, has_gels
from palpate.diffusion.options import AutoencoderOptions, BackgroundOptions
from palpate.diffusion.presets import DiffusionPreset, preset_of
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import pick_device
from palpate.encoders.rows import load_samples, train_part
from palpate.training.engine import Batch, Losses, Task, fit
from palpate.training.options import Compute, LoopOptions
from palpate.training.processes import first_alone, gather_rows
from palpate.training.run import TrainingRun, finished, request_of, run_for
from palpate.training.steps import Step, seeded

Images = NDArray[np.uint8]
Options = AutoencoderOptions | BackgroundOptions
#: Of the latents of a VQ model in stage 1, as a share of their spread.
NOISE = 0.02
#: Of the k-means that makes the codebook: assignments and means.
ITERATIONS = 12
#: Of an autoencoder that is given the gel: largest random change of each color's gain, so that
#: other gels are no surprise; largest noise on the latents as a share of their spread; weight of
#: what a 2 x 2 average of the latents loses.
COLORS, LATENT_NOISE, SMOOTH = 0.2, 0.5, 0.1


def train_autoencoder(
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    *,
    preset: str | DiffusionPreset = "mini",
    start: AnyAutoencoder | str | Path | None = None,
    judge: EncoderSet | str | Path | None = "palpate/mini",
    output: Path | str | None = None,
    seed: int = 0,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> AnyAutoencoder:
    """Train the autoencoder of a preset on the train part of a split; run again to resume.

    Args:
        data: a manifest, or anything that :func:`palpate.data.load` reads. The autoencoder of the
            preset ``mini`` codes the difference to the gel without contact: the column
            ``background``, or without it the median tactile image.
        split: a split or its file. None: the one that lies with the data.
        preset: gives kind, shape and length.
        start: fine-tune a copy of this one instead of starting from random weights.
        judge: whose tactile encoder says what of the images outside of train survives
            (:mod:`palpate.diffusion.ceiling`); None: PSNR and SSIM alone.
        output: folder for the autoencoder, new or empty; None keeps it in memory.
        seed: of weights, order, crops and noise.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Returns:
        The autoencoder, frozen; ``card["ceiling"]`` says how well it reconstructs images outside
        of train.

    Raises:
        PalpateError: if the train part is empty, the preset has no autoencoder of its own,
            ``start`` is of another kind, or the judge has no tactile encoder.
    """
    preset = preset_of(preset)
    options, fix = preset.autoencoder, "Choose mini, small or tiny"
    must = "must be one with an autoencoder of its own"
    require(options is not None, "preset", must, preset.name, fix=fix)
    assert options is not None
    manifest, split = load_samples(data, split)
    request = request_of(seed, manifest, split, preset, start, judge)
    if finished(output, request):
        return load_autoencoder(str(output))
    with run_for(output, request, seed, device=device, compute=compute, progress=progress) as run:
        judge = judge_of(judge, run.device)
        if start is not None and not isinstance(start, AnyAutoencoder):
            start = load_autoencoder(start)
        model = autoencoder_of(
            manifest, split, options, preset.size, run.stage("autoencoder"), start=start
        )
        rule = {"split": split.digest, "split_rule": dict(split.rule)}
        model.card |= {"manifest": manifest.digest, **rule}
        if ceiling := measure_ceiling(
            model, manifest, split, preset.size, judge=judge, cache=run.cache, progress=run.progress
        ):
            model.card["ceiling"] = ceiling
        run.keep(model, output)
    return model


def autoencoder_of(
    manifest: Manifest,
    split: Split,
    options: Options,
    size: int,
    run: TrainingRun,
    *,
    start: AnyAutoencoder | None = None,
) -> AnyAutoencoder:
    """Train one on images of the train part, ``size`` pixels square."""
    train, columns, gels = train_part(manifest, split), ["tactile"], None
    with first_alone():
        images = cached_images(train, "tactile", size, run.cache, run.progress)
        if isinstance(options, BackgroundOptions):
            gels = gels_of(train, size, run.cache, run.progress)
            columns += ["background"] if has_gels(train) else []
    key = digest_json([image_stamp(train, column) for column in columns])
    return fit_autoencoder(images, gels, options, run, start=start, key=key)


def build_autoencoder(options: Options) -> AnyAutoencoder:
    """An untrained autoencoder; its weights come from torch's global generator."""
    if isinstance(options, BackgroundOptions):
        return BackgroundAutoencoder(options.channels, options.narrow, options.wide)
    levels = len(options.widths)
    vq = VQModel(
        in_channels=3 * options.patch**2,
        out_channels=3 * options.patch**2,
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
        block_out_channels=options.widths,
        layers_per_block=options.layers,
        latent_channels=options.channels,
        num_vq_embeddings=options.codes,
        norm_num_groups=options.groups,
        mid_block_add_attention=False,
    )
    return Autoencoder(vq, options.patch)


def fit_autoencoder(
    images: Images,
    gels: Images | None,
    options: Options,
    run: TrainingRun,
    *,
    start: AnyAutoencoder | None = None,
    key: str = "",
) -> AnyAutoencoder:
    """Train an autoencoder on images; resume if the run's folder holds a part of the same.

    Args:
        images: bytes (n, h, w, 3), an array or a memory map: the train part alone.
        gels: the no-contact image of each, of the same shape, for one that is given them.
        options: of either kind.
        run: where, and how.
        start: go on from a copy of this one in its own shape; of a VQ model with the last stage
            alone.
        key: digest of the images.

    Returns:
        The autoencoder, frozen; its card holds the options and the seed.

    Raises:
        PalpateError: if ``start`` is of another kind, or the crop does not fit.
    """
    kind = Autoencoder if isinstance(options, AutoencoderOptions) else BackgroundAutoencoder
    fits = start is None or isinstance(start, kind)
    require(fits, "start", "must be of the preset's kind", "another kind")
    side = options.crop or images.shape[1]
    must = f"must be a multiple of {options.factor} that fits into the images"
    fits = side % options.factor == 0 and side <= min(images.shape[1:3])
    require(fits, "autoencoder.crop", must, side)
    with seeded(run.seed, "autoencoder" if gels is None else "background autoencoder"):
        model = build_autoencoder(options) if start is None else copy.deepcopy(start)
    model.requires_grad_(True)
    begin = None if start is None else start.digest

    def stage(name: str, loss: VQLoss | GelLoss, loop: LoopOptions, folder: Path) -> None:
        nn.Module.to(model, pick_device(run.device))
        run_key = digest_json([key, asdict(options), run.seed, begin])
        task = Task(name, len(images), loss.load, loss, run_key)
        fit(model, task, loop, folder, compute=run.compute, progress=run.progress)

    if isinstance(options, BackgroundOptions):
        assert isinstance(model, BackgroundAutoencoder)
        assert gels is not None
        if start is None:
            model.measure(images, gels)
        config = model.config
        options = replace(
            options, channels=config["channels"], narrow=config["narrow"], wide=config["wide"]
        )
        with fields_of("autoencoder"):
            loop = LoopOptions(
                options.steps,
                options.batch,
                options.lr,
                warmup=min(100, options.steps),
                weight_decay=1e-4,
                betas=(0.9, 0.98),
                ema=0.995,
                seed=run.seed,
            )
        stage("autoencoder", GelLoss(images, gels, options), loop, run.folder)
    else:
        assert isinstance(model, Autoencoder)
        steps, batch, lr = options.steps_free, options.batch, options.lr
        with fields_of("autoencoder"):
            loop = LoopOptions(steps, batch, lr, weight_decay=1e-4, seed=run.seed)
        if start is None:
            loss = VQLoss(images, options, quantize=False)
            stage("autoencoder", loss, loop, run.folder / "free")
            _set_codebook(model, images, options, run.seed)
        loop = replace(loop, steps=options.steps_quantized, lr=lr / 2)
        loss = VQLoss(images, options, quantize=True)
        stage("codebook", loss, loop, run.folder / "quantized")
    facts = {"options": asdict(options), "seed": run.seed, "images": len(images)}
    model.card = {**facts, "start": begin}
    return model.eval().requires_grad_(False)


class VQLoss:
    """Of a VQ model in one step; see the module's docstring."""

    def __init__(self, images: Images, options: AutoencoderOptions, *, quantize: bool) -> None:
        self.images, self.options, self.quantize = images, options, quantize

    def load(self, step: Step) -> Batch:
        """Images, cropped in stage 1, and noise for their latents."""
        options = self.options
        x = torch.from_numpy(np.array(self.images[step.rows])).permute(0, 3, 1, 2)
        if self.quantize:
            return {"images": x}
        x = _crops(x, options.crop, step)
        sides = (side // options.factor for side in x.shape[2:])
        return {"images": x, "noise": step.randn(options.channels, *sides)}

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        """Return the loss of a batch."""
        assert isinstance(module, Autoencoder)
        x = batch["images"].float() / 127.5 - 1
        z = module.latents(x)
        if not self.quantize:
            z = z + NOISE * gather_rows(z.detach()).std() * batch["noise"]
        y, codebook = module.image(z, quantize=self.quantize)
        error = y.float() - x
        edges = torch.diff(error, dim=3).square().mean() + torch.diff(error, dim=2).square().mean()
        square = error.square().mean()
        loss = 0.25 * error.abs().mean() + 10 * square + 10 * edges
        if self.quantize:
            loss = loss + 0.25 * codebook
        errors = error.detach().square().mean((1, 2, 3))
        return Losses(loss, {"psnr": (10 * torch.log10(4 / errors)).mean()}, errors)


def _crops(x: Tensor, side: int, step: Step) -> Tensor:
    """A random square of ``side`` pixels from each image."""
    if not side or side == min(x.shape[2:]):
        return x
    height, width = x.shape[2:]
    top, left = step.randint(height - side + 1).tolist(), step.randint(width - side + 1).tolist()
    corners = zip(x, top, left, strict=True)
    return torch.stack([image[:, t : t + side, c : c + side] for image, t, c in corners])


class GelLoss:
    """Of an autoencoder that is given the gel: absolute and squared error, both again of what a
    2 x 2 average loses, and the latents' scale and smoothness.
    """

    def __init__(self, images: Images, gels: Images, options: BackgroundOptions) -> None:
        self.images, self.gels, self.options = images, gels, options

    def load(self, step: Step) -> Batch:
        """A crop of each image and of its gel, mirrored and with other colors of the light."""
        side = self.options.crop or self.images.shape[1]
        height, width = self.images.shape[1:3]
        top, left = (4 * step.randint((n - side) // 4 + 1) for n in (height, width))
        flip = step.rand(2) < 0.5
        gain = 1 + COLORS * (2 * step.rand(3, 1, 1) - 1)
        shift = 64 * COLORS * (2 * step.rand(3, 1, 1) - 1)
        pairs = zip(step.rows, top.tolist(), left.tolist(), flip.tolist(), strict=True)
        crops: list[Tensor] = []
        for row, t, c, (down, across) in pairs:
            window = np.s_[row, t : t + side, c : c + side]
            both = np.stack([self.images[window], self.gels[window]])
            both = both[:, :: -1 if down else 1, :: -1 if across else 1]
            crops.append(torch.from_numpy(both.copy()))
        both = torch.stack(crops).permute(1, 0, 4, 2, 3)
        x, b = (gain * (gray - 128.0) + 128.0 + shift for gray in both)
        share = LATENT_NOISE * step.rand(1, 1, 1)
        noise = share * step.randn(self.options.channels, side // 4, side // 4)
        return {"images": x, "background": b, "noise": noise}

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        """Return the loss of a batch."""
        assert isinstance(module, BackgroundAutoencoder)
        residual, background = module.inputs(batch["images"], batch["background"])
        z = module.latents(residual, background).float()
        std = z.std((0, 2, 3), keepdim=True)
        decoded = module.residual(z + std.detach() * batch["noise"], background).float()
        error = decoded - residual
        fine = _fine(error)
        rows = error.square().mean((1, 2, 3))
        image = error.abs().mean() + 2 * rows.mean()
        image = image + fine.abs().mean() + 6 * fine.square().mean()
        scale = (std - 1).square().mean() + z.mean((0, 2, 3)).square().mean()
        smooth = (_fine(z) / std).square().mean()
        total = image + 0.01 * scale + SMOOTH * smooth
        return Losses(total, {"error": rows.detach().mean()}, rows.detach())


def _fine(x: Tensor) -> Tensor:
    """What a 2 x 2 average does not keep."""
    return x - interpolate(avg_pool2d(x, 2), scale_factor=2.0, mode="bilinear")


def _set_codebook(
    model: Autoencoder, images: Images, options: AutoencoderOptions, seed: int
) -> None:
    """Make the centers of encoder outputs the codebook."""
    rng = rng_for(seed, "codebook")
    side = images.shape[1] // model.factor
    count = max(8, -(-options.codes * 32 // side**2))
    chosen = np.sort(rng.choice(len(images), size=min(len(images), count), replace=False))
    latents = model.encode(images[chosen]).permute(0, 2, 3, 1).reshape(-1, model.channels)
    centers = k_means(latents.double().numpy(), options.codes, rng)
    model.net.quantize.embedding.weight.data.copy_(torch.from_numpy(centers))


def k_means(points: NDArray[np.float64], k: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Lloyd's k-means in few dimensions.

    Args:
        points: (n, d).
        k: centers; more than n gives points twice, with a little noise.
        rng: draws the first centers.

    Returns:
        (k, d).
    """
    centers = points[rng.choice(len(points), size=k, replace=len(points) < k)].copy()
    centers += 1e-4 * points.std() * rng.standard_normal(centers.shape)
    for _ in range(ITERATIONS):
        distance, nearest = KDTree(centers).query(points)
        counts = np.bincount(nearest, minlength=k)
        sums = [np.bincount(nearest, weights=column, minlength=k) for column in points.T]
        used = counts > 0
        centers[used] = np.stack(sums, axis=1)[used] / counts[used, None]
        empty = np.flatnonzero(~used)
        farthest = np.argsort(-np.asarray(distance))[: len(empty)]
        centers[empty[: len(farthest)]] = points[farthest]
    return centers
