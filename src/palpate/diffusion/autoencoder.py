"""The frozen VQ autoencoder: z = E(x), x_hat = D(z) (paper section 2).

A diffusers ``VQModel`` in its own folder format, so that any VQModel (e.g. latent diffusion's
``vq-f4``) loads as it is. *Encode* gives the latents before quantization, *decode* quantizes first:
the semantics of latent diffusion's ``VQModelInterface``.

A patch stem makes a small model fast: patches of ``patch`` x ``patch`` pixels become channels
(pixel unshuffle) before the first convolution, so that the whole network runs at latent resolution.
``patch`` is recorded in ``palpate.json`` next to the VQModel; a folder without that file has patch
1.

The denoiser sees latents normalized by the statistics of the training part:

    z' = (z - mean_c) / std_c  (``scale="std"``)     z' = z  (``scale="one"``, the paper's preset)
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from diffusers.models.autoencoders.vq_model import VQModel
from diffusers.utils import logging as diffusers_logging
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from palpate.core import PalpateError, digest_json, read_record, write_json
from palpate.encoders.models import (
    architecture,
    digest_tensors,
    find_single,
    load_model,
    round_to_half,
    save_model,
)
from palpate.encoders.preprocess import to_unit
from palpate.training.cards import write_model_cards

FORMAT = "palpate-autoencoder/1"
FIX = "Name a shipped model, a folder with config.json and plain weights, or a hub id within reach"

# diffusers announces its fallbacks (no accelerate here) at each load.
diffusers_logging.set_verbosity(logging.ERROR)


class Autoencoder(nn.Module):
    """A VQModel with an optional patch stem.

    Attributes:
        vq: the diffusers model.
        patch: side of the pixel patches that become channels (1: none).
        card: JSON facts about how it was trained and how well it reconstructs.
    """

    def __init__(self, vq: VQModel, patch: int = 1, card: dict[str, Any] | None = None) -> None:
        super().__init__()
        self.vq, self.patch, self.card = vq, patch, card or {}
        channels = (vq.config["in_channels"], vq.config["out_channels"])
        if channels != (3 * patch**2, 3 * patch**2):
            must = f"A VQModel with patch {patch} must have {3 * patch**2} channels in and out"
            fix = "Set patch in palpate.json to the one it was trained with"
            raise PalpateError(must, f"{channels[0]} and {channels[1]}", fix)

    @property
    def factor(self) -> int:
        """Pixels of the image that a latent position covers, along one side."""
        return self.patch * 2 ** (len(self.vq.config["block_out_channels"]) - 1)

    @property
    def channels(self) -> int:
        """Channels of the latents."""
        return int(self.vq.config["vq_embed_dim"] or self.vq.config["latent_channels"])

    @property
    def digest(self) -> str:
        """SHA-256 of patch, architecture and weights."""
        weights = digest_tensors(self.vq.state_dict())
        return digest_json([self.patch, architecture(self.vq.config), weights])

    def latents(self, unit: Tensor) -> Tensor:
        """Encode images (n, 3, h, w) in [-1, 1] to unquantized latents (n, c, h / f, w / f)."""
        patches = pixel_unshuffle(unit, self.patch)
        return cast("Tensor", self.vq.encode(patches, return_dict=False)[0])

    def image(self, latents: Tensor, *, quantize: bool = True) -> tuple[Tensor, Tensor]:
        """Decode latents to images (n, 3, h, w) near [-1, 1]; return them and the codebook loss."""
        decoded: Any = self.vq.decode(latents, force_not_quantize=not quantize, return_dict=False)
        return pixel_shuffle(decoded[0], self.patch), decoded[1]

    def codes(self, latents: Tensor) -> Tensor:
        """Return the index of the nearest code at each position, int64 (n, h, w)."""
        _, _, (_, _, index) = self.vq.quantize(latents)
        return index.reshape(latents.shape[0], *latents.shape[2:])

    @torch.no_grad()
    def encode(self, images: NDArray[np.uint8], batch: int = 32) -> Tensor:
        """Encode bytes (n, h, w, 3) to float32 unquantized latents on the CPU.

        Raises:
            PalpateError: if height or width is no multiple of the factor.
        """
        height, width = images.shape[1:3]
        if height % self.factor or width % self.factor:
            must, got = (
                f"must have sides that are multiples of {self.factor}",
                f"{height} x {width}",
            )
            raise PalpateError(must, got, "Resize or crop them first", argument="images")
        device = next(self.parameters()).device
        parts = [torch.empty(0, self.channels, height // self.factor, width // self.factor)]
        for start in range(0, len(images), batch):
            unit = to_unit(images[start : start + batch], signed=True).to(device)
            parts.append(self.latents(unit).float().cpu())
        return torch.cat(parts)

    @torch.no_grad()
    def decode(self, latents: Tensor, batch: int = 32) -> NDArray[np.uint8]:
        """Latents (n, c, h, w), quantized first -> bytes (n, f h, f w, 3)."""
        device = next(self.parameters()).device
        height, width = (self.factor * side for side in latents.shape[2:])
        parts = [np.empty((0, height, width, 3), np.uint8)]
        for start in range(0, len(latents), batch):
            parts.append(to_bytes(self.image(latents[start : start + batch].to(device))[0]))
        return np.concatenate(parts)

    def halve(self) -> float:
        """Round all weights to 16 bits in place; see ``models.round_to_half``."""
        return round_to_half({"vq": self.vq})

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Write the VQModel, ``palpate.json`` and ``README.md``.

        Args:
            folder: is created.
            half: :meth:`halve` first (this object too), and write 16-bit weights.

        Raises:
            PalpateError: if a weight is too large for 16 bits.
        """
        if half:
            self.halve()
        save_model(self.vq, folder, half=half)
        about = {"format": FORMAT, "patch": self.patch, "digest": self.digest, "card": self.card}
        write_json(Path(folder) / "palpate.json", about)
        write_model_cards(Path(folder))

    @classmethod
    def load(cls, source: str | Path) -> Autoencoder:
        """Load a shipped autoencoder (``palpate/mini``), a VQModel folder, or a hub id.

        safetensors are preferred; an old ``.bin`` is read as weights only. Weights are float32 in
        memory.

        Raises:
            PalpateError: if there is no VQModel, it does not match its ``palpate.json``, or the hub
                is out of reach.
        """
        name, folder = find_single(source, "autoencoder", "autoencoder", FIX)
        must = f"The autoencoder {source} must be a diffusers VQModel"
        options = {"low_cpu_mem_usage": False, "local_files_only": name == str(folder)}
        vq = load_model(VQModel, name, must, FIX, **options)
        note = folder / "palpate.json"
        if not note.is_file():
            return cls(vq).eval()
        keys = ("patch", "digest", "card")
        about = read_record(note, "autoencoder card", form=FORMAT, keys=keys)
        if not isinstance(about["patch"], int) or about["patch"] < 1:
            must, fix = f"patch in {note} must be a whole number from 1", "Copy the folder again"
            raise PalpateError(must, repr(about["patch"]), fix)
        model = cls(vq, about["patch"], about["card"]).eval()
        if model.digest != about["digest"]:
            must, fix = f"The weights in {source} must match palpate.json", "Copy the folder again"
            raise PalpateError(must, "other weights", fix)
        return model


@dataclass(frozen=True)
class LatentStats:
    """Mean and standard deviation of each latent channel on the training part.

    Attributes:
        mean, std: one number per channel.
        scale: ``std`` applies them, ``one`` only records them.
    """

    mean: tuple[float, ...]
    std: tuple[float, ...]
    scale: Literal["std", "one"] = "std"

    @classmethod
    def of(
        cls, latents: Tensor | NDArray[Any], scale: Literal["std", "one"] = "std"
    ) -> LatentStats:
        """The statistics of latents (n, c, h, w), n >= 1, summed in double precision."""
        z = np.asarray(latents)
        mean = z.mean(axis=(0, 2, 3), dtype=np.float64)
        square = np.einsum("nchw,nchw->c", z, z, dtype=np.float64) / (z.size / z.shape[1])
        std = np.sqrt(np.maximum(square - mean**2, 1e-12))
        return cls(tuple(map(float, mean)), tuple(map(float, std)), scale)

    def normalize(self, latents: Tensor) -> Tensor:
        """Latents of the autoencoder -> what the denoiser sees."""
        if self.scale == "one":
            return latents
        return (latents - _column(self.mean, latents)) / _column(self.std, latents)

    def restore(self, latents: Tensor) -> Tensor:
        """The inverse of :meth:`normalize`."""
        if self.scale == "one":
            return latents
        return latents * _column(self.std, latents) + _column(self.mean, latents)


def _column(values: tuple[float, ...], like: Tensor) -> Tensor:
    return like.new_tensor(values).reshape(1, -1, 1, 1)


def to_bytes(unit: Tensor) -> NDArray[np.uint8]:
    """Round floats (n, 3, h, w) in [-1, 1] to uint8 (n, h, w, 3), clipped, halves to even."""
    pixels = unit.detach().clamp(-1.0, 1.0).add(1.0).mul(127.5).round().to(torch.uint8)
    return pixels.permute(0, 2, 3, 1).cpu().numpy()
