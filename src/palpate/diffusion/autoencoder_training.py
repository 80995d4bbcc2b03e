"""Training of a small VQ autoencoder, in stages that leave no code unused.

1. *Free*: encoder and decoder without quantization, with Gaussian noise on the latents (relative to
their
   spread), so that the decoder is smooth around each latent.
2. *Codebook*: k-means of encoder outputs (Lloyd's iterations; an empty cell moves to the point
farthest from
   its center) becomes the codebook, so that every code starts in use.
3. *Quantized*: everything together with straight-through gradients (van den Oord et al. 2017).

Loss: ``0.25 L1 + 10 L2 + 10 L2 of the first differences`` (+ 0.25 the codebook loss of VQModel in
stage 3). Squares where the texture is: where a pattern is not yet known, an absolute error is least
for none at all. Stage 1 sees random crops: the network is convolutional, and crops give it more
steps a second. Stage 3 sees whole images, because group normalization takes its statistics over the
image: trained on crops alone, whole images come out too dark.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from diffusers.models.autoencoders.vq_model import VQModel
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor, nn

from palpate.core import PalpateError, Progress, digest_json, quiet, rng_for
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import Autoencoder, BackgroundAutoencoder
from palpate.diffusion.options import AutoencoderOptions
from palpate.encoders.encoder_set import seeded
from palpate.encoders.rows import evenly
from palpate.metrics.images import per_image
from palpate.training.engine import Batch, Losses, Task, fit
from palpate.training.options import Compute, LoopOptions
from palpate.training.processes import gather_rows
from palpate.training.steps import Step

#: Of the latents in stage 1, as a share of their spread.
NOISE = 0.02


def build_autoencoder(options: AutoencoderOptions) -> Autoencoder:
    """An untrained autoencoder; its weights come from torch's global generator."""
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


def train_autoencoder(
    images: NDArray[np.uint8],
    options: AutoencoderOptions,
    folder: Path,
    *,
    start: Autoencoder | None = None,
    seed: int = 0,
    key: str = "",
    device: str | torch.device = "cpu",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> Autoencoder:
    """Trains an autoencoder; resumes if ``folder`` holds a part of the same run.

    Args:
        images: bytes (n, h, w, 3), an array or a memory map: the train part alone.
        options: see :class:`AutoencoderOptions`.
        folder: for checkpoints.
        start: fine-tune a copy of this one, in its own shape: the last stage alone.
        seed: of weights, order, crops and noise.
        key: digest of the images.
        device: where to train.
        compute: how to run it on the machine at hand.
        progress: called after each step.

    Returns:
        The frozen autoencoder, on ``device``; its card holds the options and the seed.
    """
    side = options.crop or images.shape[1]
    factor = options.patch * 2 ** (len(options.widths) - 1)
    if side % factor or side > min(images.shape[1:3]):
        must, got = f"must be a multiple of {factor} that fits into the images", f"{side}"
        raise PalpateError(must, got, "Choose another", argument="autoencoder.crop")
    with seeded(seed, "autoencoder"):
        model = copy.deepcopy(start) if start is not None else build_autoencoder(options)
    model.requires_grad_(True).to(device)
    key = digest_json([key, asdict(options), seed, *([] if start is None else [start.digest])])
    free = LoopOptions(options.steps_free, options.batch, options.lr, weight_decay=1e-4, seed=seed)
    last = replace(free, steps=options.steps_quantized, lr=options.lr / 2)

    def run(what: str, course: LoopOptions, stage: str, *, quantize: bool) -> None:
        loss = _Loss(images, options, quantize=quantize)
        task = Task(what, len(images), loss.load, loss, key)
        fit(model, task, course, folder / stage, compute=compute, progress=progress)

    if start is None:
        run("autoencoder", free, "free", quantize=False)
        _set_codebook(model, images, options, seed)
    run("codebook", last, "quantized", quantize=True)
    model.card = {"options": asdict(options), "seed": seed, "images": len(images), "key": key}
    model.card |= {} if start is None else {"start": start.digest}
    return model.eval().requires_grad_(False)


def some_whole(part: Manifest, columns: Sequence[str], n: int) -> Manifest:
    """Up to ``n`` samples, evenly, of those that have an image in each of these columns."""
    cells = zip(part.ids, *(part.column(name) for name in columns), strict=True)
    whole = [name for name, *images in cells if all(images)]
    return part.take([whole[k] for k in evenly(len(whole), n)])


class _Loss:
    """The loss of one step; see the module's docstring."""

    def __init__(
        self, images: NDArray[np.uint8], options: AutoencoderOptions, *, quantize: bool
    ) -> None:
        self.images, self.options, self.quantize = images, options, quantize

    def load(self, step: Step) -> Batch:
        """Images, cropped in stage 1, and noise for their latents."""
        options = self.options
        x = torch.from_numpy(np.array(self.images[step.rows])).permute(0, 3, 1, 2)
        if self.quantize:
            return {"images": x}
        x = _crops(x, options.crop, step)
        factor = options.patch * 2 ** (len(options.widths) - 1)
        sides = (side // factor for side in x.shape[2:])
        return {"images": x, "noise": step.randn(options.channels, *sides)}

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
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


def _set_codebook(
    model: Autoencoder, images: NDArray[np.uint8], options: AutoencoderOptions, seed: int
) -> None:
    """Make the centers of encoder outputs the codebook."""
    rng = rng_for(seed, "codebook")
    side = images.shape[1] // model.factor
    count = max(8, -(-options.codes * 32 // side**2))
    chosen = np.sort(rng.choice(len(images), size=min(len(images), count), replace=False))
    latents = model.encode(images[chosen]).permute(0, 2, 3, 1).reshape(-1, model.channels)
    centers = k_means(latents.double().numpy(), options.codes, rng)
    model.net.quantize.embedding.weight.data.copy_(torch.from_numpy(centers))


def k_means(
    points: NDArray[np.float64], k: int, rng: np.random.Generator, iterations: int = 12
) -> NDArray[np.float64]:
    """Lloyd's k-means in few dimensions.

    Args:
        points: (n, d).
        k: centers; more than n gives points twice, with a little noise.
        rng: draws the first centers.
        iterations: of assignment and mean.

    Returns:
        (k, d).
    """
    centers = points[rng.choice(len(points), size=k, replace=len(points) < k)].copy()
    centers += 1e-4 * points.std() * rng.standard_normal(centers.shape)
    for _ in range(iterations):
        distance, nearest = KDTree(centers).query(points)
        counts = np.bincount(nearest, minlength=k)
        sums = [np.bincount(nearest, weights=column, minlength=k) for column in points.T]
        used = counts > 0
        centers[used] = np.stack(sums, axis=1)[used] / counts[used, None]
        empty = np.flatnonzero(~used)
        farthest = np.argsort(-np.asarray(distance))[: len(empty)]
        centers[empty[: len(farthest)]] = points[farthest]
    return centers


@dataclass(frozen=True)
class Reconstruction:
    """How well an autoencoder reconstructs images that it was not trained on.

    Attributes:
        n: images.
        psnr: mean over images of 10 log10(1 / MSE), values in [0, 1].
        ssim: mean structural similarity (Wang et al. 2004: Gaussian window of 11, sigma 1.5, range
            1).
    """

    n: int
    psnr: float
    ssim: float


@torch.no_grad()
def measure_reconstruction(
    autoencoder: Autoencoder | BackgroundAutoencoder,
    images: NDArray[np.uint8],
    background: NDArray[np.uint8] | None = None,
    batch: int = 64,
) -> Reconstruction:
    """Score reconstructions of bytes (n, h, w, 3), a batch at a time.

    ``background`` holds the gel of each image, for an autoencoder that is given them.
    """
    rows: list[NDArray[np.float64]] = []
    for start in range(0, len(images), batch):
        part = slice(start, start + batch)
        pixels = np.asarray(images[part])
        gels = () if background is None else (background[part],)
        z = autoencoder.encode(pixels, *gels, batch=batch)
        # Rounded to bytes first: what is scored is the image that a user gets.
        made = autoencoder.decode(z, *gels, batch=batch)
        scored = [per_image("PSNR", made, pixels), per_image("SSIM", made, pixels)]
        rows.append(np.stack([score.values for score in scored]))
    psnr, ssim = map(float, np.concatenate(rows, axis=1).mean(axis=1))
    return Reconstruction(len(images), psnr, ssim)
