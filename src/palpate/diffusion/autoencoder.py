"""The frozen VQ autoencoder: touches to latents and back (paper section 2: z = E(x), x_hat = D(z)).

A diffusers ``VQModel`` in its own folder format, so that any VQModel (e.g. latent diffusion's ``vq-f4``) loads
as it is. *Encode* gives the latents before quantization, *decode* quantizes first: the semantics of latent
diffusion's ``VQModelInterface``.

A patch stem makes a small model fast: patches of ``patch`` x ``patch`` pixels become channels (pixel unshuffle)
before the first convolution, so that the whole network runs at latent resolution. The VQModel then has
``3 patch^2`` input channels and one resolution level, and ``patch`` stands in ``palpate.json`` beside it; a
folder without that file has patch 1.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from diffusers.models.autoencoders.vq_model import VQModel
from diffusers.utils import logging as diffusers_logging
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from palpate.core import PalpateError, digest_json, read_record, write_json
from palpate.core.shipped import SHIPPED, is_hub_id, shipped_folder
from palpate.diffusion.pixels import architecture, digest_tensors, to_bytes, to_unit
from palpate.encoders.half import Rounding, round_to_half
from palpate.encoders.hub import fetch
from palpate.encoders.weights import UNREADABLE, save_weights
from palpate.training.cards import write_model_cards

FORMAT = "palpate-autoencoder/1"

# diffusers announces its fallbacks (no accelerate here) at each load.
diffusers_logging.set_verbosity(logging.ERROR)


class Autoencoder(nn.Module):
    """A VQModel with an optional patch stem.

    Attributes:
        vq: the diffusers model.
        patch: side of the pixel patches that become channels (1: none).
        card: JSON facts about how it was made and how well it reconstructs.
    """

    def __init__(self, vq: VQModel, patch: int = 1, card: dict[str, Any] | None = None) -> None:
        super().__init__()
        self.vq, self.patch, self.card = vq, patch, card or {}
        wanted = 3 * patch**2
        if vq.config["in_channels"] != wanted or vq.config["out_channels"] != wanted:
            raise PalpateError(
                f"A VQModel with patch {patch} must have {wanted} input and output channels",
                f"{vq.config['in_channels']} and {vq.config['out_channels']}",
                "Set patch in palpate.json to the one it was trained with",
            )

    @property
    def factor(self) -> int:
        """Pixels of the image a latent position covers, along one side."""
        return self.patch * 2 ** (len(self.vq.config["block_out_channels"]) - 1)

    @property
    def channels(self) -> int:
        """Channels of the latents."""
        return int(self.vq.config["vq_embed_dim"] or self.vq.config["latent_channels"])

    @property
    def digest(self) -> str:
        """SHA-256 of patch, architecture and weights."""
        return digest_json(
            [self.patch, architecture(self.vq.config), digest_tensors(self.vq.state_dict())]
        )

    def latents(self, unit: Tensor) -> Tensor:
        """Images (n, 3, h, w) in [-1, 1] -> latents before quantization (n, c, h / f, w / f); with gradients."""
        return cast(
            "Tensor", self.vq.encode(pixel_unshuffle(unit, self.patch), return_dict=False)[0]
        )

    def image(self, latents: Tensor, *, quantize: bool = True) -> tuple[Tensor, Tensor]:
        """Latents -> images (n, 3, h, w) near [-1, 1], and the codebook loss; with (straight-through) gradients."""
        image, loss = cast(
            "tuple[Tensor, Tensor]",
            self.vq.decode(latents, force_not_quantize=not quantize, return_dict=False),
        )
        return pixel_shuffle(image, self.patch), loss

    def codes(self, latents: Tensor) -> Tensor:
        """The index of the nearest code at each position: latents (n, c, h, w) -> int64 (n, h, w)."""
        _, _, (_, _, index) = self.vq.quantize(latents)
        return index.reshape(latents.shape[0], *latents.shape[2:])

    @torch.no_grad()
    def encode(self, images: np.ndarray | Tensor, batch: int = 32) -> Tensor:
        """Bytes (n, h, w, 3) -> float32 latents before quantization (n, c, h / f, w / f), on the CPU.

        Raises:
            PalpateError: if height or width is no multiple of the factor.
        """
        height, width = images.shape[1:3]
        if height % self.factor or width % self.factor:
            raise PalpateError(
                f"Images must have sides that are multiples of {self.factor}",
                f"{height} x {width} pixels",
                "Resize or crop them first",
            )
        device = next(self.parameters()).device
        parts = [
            self.latents(to_unit(images[k : k + batch]).to(device)).float().cpu()
            for k in range(0, len(images), batch)
        ]
        return (
            torch.cat(parts)
            if parts
            else torch.empty(0, self.channels, height // self.factor, width // self.factor)
        )

    @torch.no_grad()
    def decode(self, latents: Tensor, batch: int = 32) -> np.ndarray:
        """Latents (n, c, h, w), quantized first -> bytes (n, f h, f w, 3)."""
        device = next(self.parameters()).device
        parts = [
            to_bytes(self.image(latents[k : k + batch].to(device))[0])
            for k in range(0, len(latents), batch)
        ]
        side = (latents.shape[2] * self.factor, latents.shape[3] * self.factor)
        return np.concatenate(parts) if parts else np.empty((0, *side, 3), np.uint8)

    def halve(self) -> Rounding:
        """Rounds all weights, the codebook's too, to 16 bits, here and now; see :func:`palpate.encoders.half.round_to_half`."""
        return round_to_half({"vq": self.vq})

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Writes the VQModel's ``config.json`` and safetensors, ``palpate.json`` and ``README.md`` beside them.

        Args:
            folder: where to.
            half: :meth:`halve` first (this object too), and write 16-bit weights.

        Raises:
            PalpateError: if a weight is too large for 16 bits.
        """
        if half:
            self.halve()
        save_weights(self.vq, folder, half=half)
        write_json(
            Path(folder) / "palpate.json",
            {"format": FORMAT, "patch": self.patch, "digest": self.digest, "card": self.card},
        )
        write_model_cards(Path(folder))

    @classmethod
    def load(cls, source: str | Path) -> Autoencoder:
        """Loads a shipped autoencoder (``palpate/mini``), a VQModel folder, or a hub id; see :mod:`palpate.core.shipped`.

        safetensors are preferred; an old ``.bin`` is read as weights only, and refused if it holds any other object.
        Weights are float32 in memory.

        Raises:
            PalpateError: if there is no VQModel, ``palpate.json`` is of another kind or does not match the weights, or the hub cannot be
                reached.
        """
        place = shipped_folder(source, "autoencoder") or Path(source)
        fix = f"Name {', '.join(SHIPPED)}, a folder with config.json and plain weights, or a hub id that can be reached"
        remote = is_hub_id(source)
        if not remote and (
            not str(source) or not place.is_dir()
        ):  # an empty name is not the folder that one is in
            raise PalpateError(
                "The autoencoder must be a diffusers VQModel",
                f"no folder {source or repr('')}",
                fix,
            )
        note = (
            fetch(str(source), ("config.json", "palpate.json"), "autoencoder", fix)
            if remote
            else place
        ) / "palpate.json"
        try:
            vq = VQModel.from_pretrained(
                str(source) if remote else str(place),
                low_cpu_mem_usage=False,
                local_files_only=not remote,
            ).float()
        except (*UNREADABLE, AttributeError) as error:
            got = (str(error).splitlines() or [type(error).__name__])[0]
            raise PalpateError(
                "The autoencoder must be a diffusers VQModel", f"{source}: {got}", fix
            ) from None
        if not note.is_file():
            return cls(vq).eval().requires_grad_(requires_grad=False)
        about = read_record(note, "autoencoder card", form=FORMAT, keys=("patch", "digest", "card"))
        patch, card = about["patch"], about["card"]
        if type(patch) is not int or patch < 1 or not isinstance(card, dict):
            must = f"In {note}, patch must be a whole number from 1 on and card an object"
            raise PalpateError(
                must, f"{patch!r} and a {type(card).__name__}", "Copy the whole folder again"
            )
        model = cls(vq, patch, card)
        if model.digest != about["digest"]:
            raise PalpateError(
                f"The weights in {source} must match palpate.json",
                "other weights",
                "Copy the whole folder again",
            )
        return model.eval().requires_grad_(requires_grad=False)
