"""The frozen autoencoder: z = E(x), x_hat = D(z) (paper section 2).

:class:`Autoencoder` is a ``VQModel`` of diffusers (e.g. ``vq-f4``), in its own folder format or
from a file of latent diffusion (:mod:`palpate.diffusion.compvis`): *encode* gives the latents
before quantization, *decode* quantizes first: the semantics of latent diffusion's
``VQModelInterface``. Its ``scaling_factor`` is not used, as there.

:class:`BackgroundAutoencoder` is ours: it is given the gel without contact, and codes the rest.

A patch stem makes a small model fast: patches of ``patch`` x ``patch`` pixels become channels
(pixel unshuffle) before the first convolution, so that the whole network runs at latent resolution.
``patch`` is recorded in ``palpate.json`` next to the model; a folder without that file has patch 1.

The denoiser sees latents normalized by the statistics of the training part:

    z' = (z - mean_c) / std_c  (``scale="std"``)     z' = z  (``scale="one"``, the paper's preset)
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.autoencoders.vq_model import VQModel
from diffusers.models.modeling_utils import ModelMixin
from diffusers.utils import logging as diffusers_logging
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle, silu

from palpate.core import (
    PalpateError,
    digest_file,
    digest_json,
    got_and_fix,
    read_json,
    read_record,
    require,
    write_json,
)
from palpate.diffusion.compvis import read_compvis
from palpate.encoders.models import (
    architecture,
    digest_tensors,
    find_single,
    is_hub_id,
    is_shipped,
    load_model,
    round_to_half,
    save_model,
    stated,
    to_unit,
)
from palpate.training.cards import write_model_cards

FORMAT = "palpate-autoencoder/1"
FIX = (
    "Name a shipped model, a .ckpt of latent diffusion, a folder with config.json and plain "
    "weights, or a hub id within reach"
)

# diffusers announces its fallbacks (no accelerate here) at each load.
diffusers_logging.set_verbosity(logging.ERROR)


class _Coder(nn.Module):
    """What both autoencoders share: bytes to latents and back in batches, and their files.

    Both have ``net``, the diffusers model; ``factor``, pixels of the image that a latent position
    covers along one side; ``channels`` of the latents; ``digest``; and ``card``, JSON facts about
    how it was trained and how well it reconstructs.
    """

    @torch.no_grad()
    def encode(
        self: Any,
        images: NDArray[np.uint8],
        background: NDArray[np.uint8] | None = None,
        batch: int = 32,
    ) -> Tensor:
        """Bytes (n, h, w, 3) -> float32 latents (n, c, h / f, w / f) on the CPU.

        Args:
            images: in memory or mapped.
            background: their gels, of one that is given them.
            batch: at once; changes the result by rounding only.

        Raises:
            PalpateError: if height or width is no multiple of the factor.
        """
        sides, factor = images.shape[1:3], self.factor
        must, got = f"must have sides that are multiples of {factor}", f"{sides[0]} x {sides[1]}"
        fits = not any(side % factor for side in sides)
        require(fits, "images", must, got, fix="Resize or crop them first")
        parts = [torch.empty(0, self.channels, *(side // factor for side in sides))]
        for start in range(0, len(images), batch):
            rows = slice(start, start + batch)
            ground = None if background is None else background[rows]
            parts.append(self.code(images[rows], ground).float().cpu())
        return torch.cat(parts)

    @torch.no_grad()
    def decode(
        self: Any, latents: Tensor, background: NDArray[np.uint8] | None = None, batch: int = 32
    ) -> NDArray[np.uint8]:
        """Latents (n, c, h, w) -> bytes (n, f h, f w, 3); see :meth:`encode`."""
        height, width = (self.factor * side for side in latents.shape[2:])
        parts = [np.empty((0, height, width, 3), np.uint8)]
        for start in range(0, len(latents), batch):
            rows = slice(start, start + batch)
            ground = None if background is None else background[rows]
            z = latents[rows].to(next(self.parameters()))
            parts.append(to_bytes(self.picture(z, ground)))
        return np.concatenate(parts)

    def halve(self: Any) -> None:
        """Round all weights to 16 bits in place; see ``models.round_to_half``."""
        round_to_half({"autoencoder": self.net})

    def save(self: Any, folder: Path, *, half: bool = False) -> None:
        """Write the diffusers model, ``palpate.json`` and ``README.md``.

        Args:
            folder: is created.
            half: :meth:`halve` first (this object too), and write 16-bit weights.

        Raises:
            PalpateError: if a weight is too large for 16 bits.
        """
        if half:
            self.halve()
        save_model(self.net, folder, half=half)
        about = {"patch": self.patch} if isinstance(self, Autoencoder) else {}
        about |= {"digest": self.digest, "card": self.card}
        write_json(Path(folder) / "palpate.json", {"format": FORMAT, **about})
        write_model_cards(Path(folder))


class Autoencoder(_Coder):
    """A VQModel with an optional patch stem.

    Attributes:
        patch: side of the pixel patches that become channels (1: none).
    """

    def __init__(self, net: VQModel, patch: int = 1, card: dict[str, Any] | None = None) -> None:
        super().__init__()
        self.net, self.patch, self.card = net, patch, card or {}
        channels = (net.config["in_channels"], net.config["out_channels"])
        if channels != (3 * patch**2, 3 * patch**2):
            must = f"An autoencoder with patch {patch} must have {3 * patch**2} channels in and out"
            fix = "Set patch in palpate.json to the one it was trained with"
            raise PalpateError(must, f"{channels[0]} and {channels[1]}", fix)

    @property
    def factor(self) -> int:
        """That of the stem times that of the network's levels."""
        return self.patch * 2 ** (len(self.net.config["block_out_channels"]) - 1)

    @property
    def channels(self) -> int:
        """Channels of the latents."""
        config = self.net.config
        return int(config["vq_embed_dim"] or config["latent_channels"])

    @property
    def gel_channels(self) -> int:
        """Channels that a denoiser w/ BG sees of the gel: those of its latent."""
        return self.channels

    @property
    def digest(self) -> str:
        """SHA-256 of patch, architecture and weights."""
        weights = digest_tensors(self.net.state_dict())
        return digest_json([self.patch, architecture(self.net.config), weights])

    def latents(self, unit: Tensor) -> Tensor:
        """Encode images (n, 3, h, w) in [-1, 1] to unquantized latents (n, c, h / f, w / f)."""
        encoded: Any = self.net.encode(pixel_unshuffle(unit, self.patch), return_dict=False)
        return encoded[0]

    def image(self, latents: Tensor, *, quantize: bool = True) -> tuple[Tensor, Tensor]:
        """Decode latents to images (n, 3, h, w) near [-1, 1]; return them and the codebook loss."""
        decode: Any = self.net.decode
        patches, loss = decode(latents, force_not_quantize=not quantize, return_dict=False)
        return pixel_shuffle(patches, self.patch), loss

    def code(self, images: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> Tensor:
        """Unquantized latents; the gels are not read."""
        return self.latents(to_unit(images, next(self.parameters()).device, signed=True))

    def picture(self, latents: Tensor, background: NDArray[np.uint8] | None) -> Tensor:
        """The image of latents, quantized first."""
        return self.image(latents)[0]


def _foreign(name: str, source: Any, terms: str) -> dict[str, Any]:
    """The card of an autoencoder that others trained."""
    return {"title": f"Autoencoder {name}, trained by others", "license": terms, "source": source}


#: Rows: luma, red - blue, green - magenta; orthonormal.
OPPONENT = [[3**-0.5] * 3, [2**-0.5, 0.0, -(2**-0.5)], [6**-0.5, -2 * 6**-0.5, 6**-0.5]]


class _Residual(nn.Module):
    """x + conv(silu(conv(silu(x)))); the identity at first."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.last = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # pyright: ignore[reportArgumentType]

    def forward(self, x: Tensor) -> Tensor:
        """(n, width, h, w) -> (n, width, h, w)."""
        return x + self.last(silu(self.first(silu(x))))


class BackgroundAutoencoder(_Coder, ModelMixin, ConfigMixin):
    """Codes the difference between a tactile image x and its gel without contact, b.

        z = E(x - b, b);   x_hat = b + D(z, b)

    Markers, gel color and lighting are given to both networks, so the latent holds the contact
    alone. In the paper, a variant whose *denoiser* is conditioned on the background scores worse
    (w/ BG). Here the background is the reference that an image is coded against.

    Colors are turned into luma and two opponents (an orthonormal basis): x - b is divided by its
    spread over the training part, b is standardized over the gels. There is no codebook, no KL
    term, no normalization layer and no attention; sides may be any multiple of 4.

    Attributes:
        spread: standard deviation of each color of x - b over the training part (3, 1, 1).
        mean, std: of each color of b over the gels (3, 1, 1).
    """

    factor = 4
    colors: Tensor
    spread: Tensor
    mean: Tensor
    std: Tensor

    @register_to_config
    def __init__(self, channels: int = 8, narrow: int = 48, wide: int = 96) -> None:
        super().__init__()
        self.card: dict[str, Any] = {}
        conv = partial(nn.Conv2d, kernel_size=3, padding=1)
        self.encode_fine = nn.Sequential(
            nn.PixelUnshuffle(2), conv(24, narrow), _Residual(narrow), nn.SiLU()
        )
        self.encode_coarse = nn.Sequential(
            nn.Conv2d(narrow, wide, 4, 2, 1),
            _Residual(wide),
            _Residual(wide),
            nn.SiLU(),
            conv(wide, channels),
        )
        self.background_fine = nn.Sequential(
            nn.PixelUnshuffle(2), conv(12, narrow), _Residual(narrow), nn.SiLU()
        )
        self.background_coarse = nn.Conv2d(narrow, wide, 4, 2, 1)
        self.decode_in = conv(channels, wide)
        self.decode_coarse = nn.Sequential(
            *(_Residual(wide) for _ in range(3)),
            nn.SiLU(),
            conv(wide, 4 * narrow),
            nn.PixelShuffle(2),
        )
        self.mix = nn.Conv2d(2 * narrow, narrow, 1)
        self.decode_fine = nn.Sequential(
            _Residual(narrow), _Residual(narrow), nn.SiLU(), conv(narrow, 12), nn.PixelShuffle(2)
        )
        self.register_buffer("colors", torch.tensor(OPPONENT))
        for name, fill in (("spread", 16.0), ("mean", 0.0), ("std", 64.0)):
            self.register_buffer(name, torch.full((3, 1, 1), fill))

    @property
    def net(self) -> BackgroundAutoencoder:
        """Itself: it is a diffusers model."""
        return self

    @property
    def channels(self) -> int:
        """Channels of the latents."""
        return int(self.config["channels"])

    @property
    def gel_channels(self) -> int:
        """Channels that a denoiser w/ BG sees of the gel, see :meth:`gel`."""
        return 3 * self.factor**2

    @property
    def digest(self) -> str:
        """SHA-256 of the weights."""
        return digest_tensors(self.state_dict())

    def inputs(self, images: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Gray levels (n, 3, h, w) -> scaled colors of x - b, and of b."""
        residual = self._turned(images.float() - background) / self.spread
        return residual, (self._turned(background.float()) - self.mean) / self.std

    def latents(self, residual: Tensor, background: Tensor) -> Tensor:
        """Scaled colors -> latents (n, c, h / 4, w / 4)."""
        return self.encode_coarse(self.encode_fine(torch.cat([residual, background], 1)))

    def residual(self, latents: Tensor, background: Tensor) -> Tensor:
        """Latents and scaled colors of b -> scaled colors of x - b (n, 3, h, w)."""
        fine = self.background_fine(background)
        coarse = self.decode_coarse(self.decode_in(latents) + self.background_coarse(fine))
        return self.decode_fine(self.mix(torch.cat([coarse, fine], 1)))

    def code(self, images: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> Tensor:
        """Latents of images and their gels, which are needed."""
        assert background is not None
        return self.latents(*self.inputs(*(_gray(a, self.device) for a in (images, background))))

    def picture(self, latents: Tensor, background: NDArray[np.uint8] | None) -> Tensor:
        """The image of latents on gels, which are needed."""
        assert background is not None
        gray = _gray(background, self.device)
        residual = self.residual(latents, self.inputs(gray, gray)[1])
        back = torch.einsum("ij,nihw->njhw", self.colors, residual.float() * self.spread)
        return (gray + back) / 127.5 - 1

    @torch.no_grad()
    def gel(self, background: NDArray[np.uint8]) -> Tensor:
        """What a denoiser is shown of gels (n, h, w, 3): every pixel of a position as a channel.

        Returns:
            float32 (n, 48, h / 4, w / 4) on the CPU.
        """
        gray = _gray(background, self.device)
        return pixel_unshuffle(self.inputs(gray, gray)[1], self.factor).cpu()

    @torch.no_grad()
    def measure(self, images: NDArray[np.uint8], background: NDArray[np.uint8]) -> None:
        """Set the buffers from up to 1,000 training images, evenly spread."""
        rows = np.linspace(0, len(images) - 1, min(len(images), 1000)).astype(int)
        x, b = (self._turned(_gray(a[rows], self.device)) for a in (images, background))
        self.mean.copy_(b.mean((0, 2, 3))[:, None, None])
        self.spread.copy_((x - b).std((0, 2, 3)).clamp(min=1.0)[:, None, None])
        self.std.copy_(b.std((0, 2, 3)).clamp(min=1.0)[:, None, None])

    def _turned(self, gray: Tensor) -> Tensor:
        return torch.einsum("ij,njhw->nihw", self.colors, gray)


def _gray(images: NDArray[np.uint8], device: torch.device) -> Tensor:
    return torch.from_numpy(np.array(images)).to(device).permute(0, 3, 1, 2).float()


AnyAutoencoder = Autoencoder | BackgroundAutoencoder
KINDS: dict[str, Any] = {"VQModel": VQModel, "BackgroundAutoencoder": BackgroundAutoencoder}


def load_autoencoder(source: str | Path) -> AnyAutoencoder:
    """Load a shipped autoencoder (``palpate/mini``), a folder, a hub id, or a file.

    A folder (a hub id) is that of a model of palpate or of a VQModel of diffusers; safetensors are
    preferred, an old ``.bin`` is read as weights only. For a file see
    :func:`~palpate.diffusion.compvis.read_compvis`. Weights are float32 in memory.

    Raises:
        PalpateError: if there is no such model, it does not match its ``palpate.json``, or the hub
            is out of reach.
    """
    if not is_shipped(source) and Path(source).is_file():
        path = Path(source)
        origin = {"file": path.name, "sha256": digest_file(path)}
        return Autoencoder(read_compvis(path), card=_foreign(path.name, origin, "unknown")).eval()
    name, root = find_single(source, "autoencoder", "autoencoder", FIX)
    config, note = root / "config.json", root / "palpate.json"
    about = read_json(config, "configuration of a model") if config.is_file() else {}
    kind = about.get("_class_name") if isinstance(about, dict) else None
    must = f"The autoencoder {source} must be a diffusers VQModel, or of palpate"
    if kind not in KINDS:
        got, fix = got_and_fix(root, f"{kind or 'no'} model in {config.name}", FIX)
        raise PalpateError(must, got, fix)
    local = name == str(root)
    net = load_model(KINDS[kind], name, must, FIX, low_cpu_mem_usage=False, local_files_only=local)
    if not note.is_file():
        called = str(source) if is_hub_id(source) else root.resolve().name
        return Autoencoder(net, card=_foreign(called, called, stated(root)["license"])).eval()
    own = isinstance(net, BackgroundAutoencoder)
    keys = ("digest", "card") if own else ("patch", "digest", "card")
    about = read_record(note, "autoencoder card", form=FORMAT, keys=keys)
    if own:
        model, net.card = net, about["card"]
    elif isinstance(about["patch"], int) and about["patch"] > 0:
        model = Autoencoder(net, about["patch"], about["card"]).eval()
    else:
        must, fix = f"patch in {note} must be a whole number from 1", "Copy the folder again"
        raise PalpateError(must, repr(about["patch"]), fix)
    must, fix = f"The weights in {source} must match palpate.json", "Copy the folder again"
    require(model.digest == about["digest"], None, must, "other weights", fix=fix)
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

    def scaled(self, differences: Tensor) -> Tensor:
        """Differences of latents (n, k c, h, w), k of them, on the scale of :meth:`normalize`."""
        if self.scale == "one":
            return differences
        times = differences.shape[1] // len(self.std)
        return differences / _column(self.std * times, differences)

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
