"""Training of a :class:`~palpate.diffusion.autoencoder.BackgroundAutoencoder`."""

from __future__ import annotations

import copy
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate

from palpate.core import PalpateError, Progress, digest_json, quiet
from palpate.diffusion.autoencoder import BackgroundAutoencoder
from palpate.diffusion.options import BackgroundOptions
from palpate.encoders.encoder_set import seeded
from palpate.training.engine import Batch, Losses, Task, fit
from palpate.training.options import Compute, LoopOptions
from palpate.training.steps import Step

#: Largest random change of each color's gain, so that other gels are no surprise.
COLORS = 0.2
#: The noise on the latents is a random share of their spread up to this.
NOISE = 0.5
#: Weight of what a 2 x 2 average of the latents loses.
SMOOTH = 0.1


def train_background_autoencoder(
    images: NDArray[np.uint8],
    background: NDArray[np.uint8],
    options: BackgroundOptions,
    folder: Path,
    *,
    start: BackgroundAutoencoder | None = None,
    seed: int = 0,
    key: str = "",
    device: str | torch.device = "cpu",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> BackgroundAutoencoder:
    """Train on images and the no-contact images of their gels; run again to resume.

    Args:
        images: bytes (n, h, w, 3), an array or a memory map: the train part alone.
        background: the no-contact image of each one's gel, of the same shape.
        options: see :class:`BackgroundOptions`.
        folder: for checkpoints.
        start: go on from a copy of this one, in its own shape, instead of random weights.
        seed: of weights, order, crops, colors and noise.
        key: digest of both.
        device: where to train.
        compute: how to run it on the machine at hand.
        progress: called after each step.

    Raises:
        PalpateError: if the crop is no multiple of 4 or larger than the images.
    """
    side = options.crop or images.shape[1]
    if side % 4 or side > min(images.shape[1:3]):
        must = "must be a multiple of 4 that fits into the images"
        raise PalpateError(must, f"{side}", "Choose another", argument="autoencoder.crop")
    if start is None:
        with seeded(seed, "background autoencoder"):
            model = BackgroundAutoencoder(options.channels, options.narrow, options.wide)
        model.measure(images, background)
    else:
        model = copy.deepcopy(start).requires_grad_(True)
        shape = {name: start.config[name] for name in ("channels", "narrow", "wide")}
        options = replace(options, **shape)
    begin = None if start is None else start.digest
    loop = LoopOptions(
        options.steps,
        options.batch,
        options.lr,
        warmup=min(100, options.steps),
        weight_decay=1e-4,
        betas=(0.9, 0.98),
        ema=0.995,
        seed=seed,
    )
    loss = _Loss(images, background, options)
    key = digest_json([key, asdict(options), begin])

    task = Task("autoencoder", len(images), loss.load, loss, key)
    nn.Module.to(model, device)
    fit(model, task, loop, folder, compute=compute, progress=progress)
    model.card = {"options": asdict(options), "seed": seed, "images": len(images), "start": begin}
    return model.eval().requires_grad_(False)


class _Loss:
    """Absolute and squared error, both again of what a 2 x 2 average loses, and of the latents."""

    def __init__(
        self, images: NDArray[np.uint8], background: NDArray[np.uint8], options: BackgroundOptions
    ) -> None:
        self.images, self.background, self.options = images, background, options

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
            both = np.stack([self.images[window], self.background[window]])
            both = both[:, :: -1 if down else 1, :: -1 if across else 1]
            crops.append(torch.from_numpy(both.copy()))
        both = torch.stack(crops).permute(1, 0, 4, 2, 3)
        x, b = (gain * (gray - 128.0) + 128.0 + shift for gray in both)
        share = NOISE * step.rand(1, 1, 1)
        noise = share * step.randn(self.options.channels, side // 4, side // 4)
        return {"images": x, "background": b, "noise": noise}

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        assert isinstance(module, BackgroundAutoencoder)
        residual, background = module.inputs(batch["images"], batch["background"])
        z = module.latents(residual, background).float()
        std = z.std((0, 2, 3), keepdim=True)
        made = module.residual(z + std.detach() * batch["noise"], background).float()
        error = made - residual
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
