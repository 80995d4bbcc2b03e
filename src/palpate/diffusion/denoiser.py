"""The denoiser eps_theta(z_t, t, condition): a diffusers U-Net, its condition, its schedule.

The condition is one *projected* embedding c of the shared space, so that text and vision embeddings
fit into the same slot (paper section 2; section 9, "token type"):

    token = sqrt(d) * (c - m_source) / ||c - m_source||

with m_source = 0 (``gap="none"``, the paper's reading) or the mean of that modality on the train
part (``"pairs"``, which closes the constant part of the gap between text and vision embeddings).
``"pairs"`` also keeps the training texts and the photos that they were given for, and gives a photo
in the place of a text by the texts of the training photos near it. The unconditional token of
classifier-free guidance is all zeros. All of this is part of the checkpoint.

The patches of a photo may follow as tokens, through a trained matrix. The baseline GVST
(``source="resnet"``) has no embedding: its tokens are the map that a residual network, part of the
denoiser, makes of the photo.

With ``UNetOptions.modulate`` the token is also added, through two layers, to the embedding of the
time step, which shifts every residual block. That is not in the paper; a small network trains
faster with it than with cross-attention to one token. The paper's variant with background ("w/ BG")
concatenates the latent of the no-contact image to the noisy latent along channels; behind an
autoencoder that is given the gel anyway, its pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from diffusers.models.autoencoders.vae import Encoder
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from palpate.core import PalpateError, atomic_path, require, require_regular
from palpate.diffusion.options import PHOTO_TOKENS, SOURCES, ConditionPolicy, Source, UNetOptions
from palpate.encoders.models import (
    UNREADABLE,
    find_single,
    first_line,
    is_hub_id,
    load_model,
    round_to_half,
    save_model,
)

#: What ``pairs`` remembers: training texts, and the mean photo of each.
MEMORY = ("memory", "keys")
#: Temperature of its weights.
TAU = 0.02
FIX_UNET = "Pass a folder or hub id, e.g. of Stable Diffusion 1.5"


def build_unet(
    options: UNetOptions, policy: ConditionPolicy, *, channels: int, size: int, background: int = 0
) -> UNet2DConditionModel:
    """Build an untrained U-Net for latents (channels, size, size) and the tokens of a policy.

    ``background`` channels of the no-contact image follow those of the noisy latent.
    """
    down = ["CrossAttnDownBlock2D" if a else "DownBlock2D" for a in options.attention]
    up = ["CrossAttnUpBlock2D" if a else "UpBlock2D" for a in reversed(options.attention)]
    # diffusers keeps the number of heads under this name.
    heads: Any = tuple(max(1, w // options.head_width) for w in options.widths)
    return UNet2DConditionModel(
        sample_size=size,
        in_channels=channels + background,
        out_channels=channels,
        down_block_types=tuple(down),
        up_block_types=tuple(up),
        block_out_channels=options.widths,
        layers_per_block=options.layers,
        cross_attention_dim=policy.width,
        norm_num_groups=options.groups,
        class_embed_type="projection" if options.modulate else None,
        projection_class_embeddings_input_dim=(
            max(1, slots_of(policy)) * policy.width if options.modulate else None
        ),
        attention_head_dim=heads,
    )


def slots_of(policy: ConditionPolicy) -> int:
    """Embeddings that a sample is conditioned on at once: text and photo, one, or none."""
    return {"both": 2, "resnet": 0}.get(policy.source, 1)


def inputs_of(policy: ConditionPolicy) -> tuple[str, ...]:
    """What else tokens are made of: the ``photos``, or their ``patches``."""
    if policy.source == "resnet":
        return ("photos",)
    return ("patches",) if policy.patches and "vision" in policy.sources else ()


def lengths_of(policy: ConditionPolicy) -> tuple[int, ...]:
    """Tokens of each embedding, then of each input."""
    tokens = {"photos": PHOTO_TOKENS, "patches": policy.patches}
    return (1,) * slots_of(policy) + tuple(tokens[name] for name in inputs_of(policy))


def find_unet(source: str | Path) -> tuple[str, Path, str]:
    """Return what ``from_pretrained`` takes, the folder of ``config.json``, and its subfolder.

    Args:
        source: a folder or hub id of a U-Net, or of a generator that has one as ``unet``.

    Raises:
        PalpateError: if there is none, or the hub is out of reach.
    """
    name, root = find_single(source, "generator", "U-Net", FIX_UNET, ("unet",))
    inside = "" if (root / "config.json").is_file() else "unet"
    if not (root / inside / "config.json").is_file():
        raise PalpateError(f"{source} must hold a U-Net of diffusers", "no config.json", FIX_UNET)
    return name, root / inside, inside


def load_unet(
    source: str | Path, policy: ConditionPolicy, *, channels: int, background: int = 0
) -> UNet2DConditionModel:
    """Load a trained U-Net to go on from.

    Raises:
        PalpateError: if it is none of diffusers, or made for other latents or tokens.
    """
    name, root, inside = find_unet(source)
    must = f"{source} must hold a UNet2DConditionModel of diffusers"
    options: dict[str, Any] = {"strict": True, "low_cpu_mem_usage": False}
    options["subfolder"] = inside or None
    options["local_files_only"] = not is_hub_id(source)
    unet = load_model(UNet2DConditionModel, name, must, FIX_UNET, **options)
    config = unet.config
    must = f"must have {config['out_channels']} latent channels, as the U-Net"
    require(channels == config["out_channels"], "autoencoder", must, channels)
    must = f"must give embeddings of width {config['cross_attention_dim']}, as the U-Net knows"
    require(policy.width == config["cross_attention_dim"], "clip", must, policy.width)
    known = config["class_embed_type"] is None and config["in_channels"] == channels + background
    require(known, "unet", "must see latents and tokens alone", repr(root.name))
    return unet.requires_grad_(True)


class PhotoMap(nn.Module):
    """Makes 8 x 8 tokens of a photo: the residual encoder of diffusers' autoencoders.

    It has group normalization, by which the rows of a batch do not see each other.
    """

    def __init__(self, policy: ConditionPolicy) -> None:
        super().__init__()
        # Half the size by the stem, and again by each level but the last.
        levels = (policy.photo_size // 8).bit_length() - 1
        self.net = Encoder(
            in_channels=12,
            out_channels=policy.width,
            down_block_types=("DownEncoderBlock2D",) * levels,
            block_out_channels=tuple(policy.photo_width * min(8, 2**k) for k in range(levels)),
            norm_num_groups=min(32, policy.photo_width // 4),
            double_z=False,
            mid_block_add_attention=False,
        )
        self.norm = nn.LayerNorm(policy.width, elementwise_affine=False)

    def forward(self, photos: Tensor) -> Tensor:
        """Bytes (n, size, size, 3) -> tokens (n, 64, d) with the entries of an embedding's."""
        x = nn.functional.pixel_unshuffle(photos.permute(0, 3, 1, 2) / 127.5 - 1, 2)
        return self.norm(self.net(x).flatten(2).transpose(1, 2))


class Denoiser(nn.Module):
    """U-Net, condition policy, and what makes tokens of a sample's condition.

    Attributes:
        unet: the diffusers model.
        policy: see :class:`ConditionPolicy`.
        background: whether a background latent is expected.
    """

    means: Tensor
    memory: Tensor
    keys: Tensor

    def __init__(
        self,
        unet: UNet2DConditionModel,
        policy: ConditionPolicy,
        means: Mapping[Source, Tensor] | None = None,
        memory: tuple[Tensor, Tensor] | None = None,
        patch_width: int | None = None,
    ) -> None:
        """Take what the policy's ``gap`` needs.

        Args:
            unet: the network.
            policy: how embeddings become tokens.
            means: the training mean (d,) of each source.
            memory: of ``gap="pairs"``: embeddings (m, d) of the different training texts, and the
                mean of the photos of each (m, d).
            patch_width: of the states of patches; default: that of the embeddings.
        """
        super().__init__()
        self.unet, self.policy, self.slots = unet, policy, slots_of(policy)
        self.background = unet.config["in_channels"] > unet.config["out_channels"]
        self.pairs = policy.gap == "pairs"
        # A source without a mean is marked by NaN, and raises when it is used.
        fill = torch.full((policy.width,), float("nan") if self.pairs else 0.0)
        known = means if means is not None and self.pairs else {}
        self.register_buffer("means", torch.stack([known.get(s, fill).float() for s in SOURCES]))
        self.maps = nn.ModuleDict()
        if "photos" in inputs_of(policy):
            self.maps["photos"] = PhotoMap(policy)
        if "patches" in inputs_of(policy):
            width = patch_width or policy.width
            parts = nn.LayerNorm(width), nn.Linear(width, policy.width)
            self.maps["patches"] = nn.Sequential(*parts)
        if self.pairs:
            texts, photos = memory or (None, None)
            self.register_buffer("memory", self._remembered(texts, "text"))
            self.register_buffer("keys", self._remembered(photos, "vision"))

    def _remembered(self, rows: Tensor | None, source: Source) -> Tensor:
        """Unit embeddings (m, d); until load() fills it, one of zeros."""
        return torch.zeros(1, self.policy.width) if rows is None else self._unit(rows, source)

    @property
    def channels(self) -> int:
        """Latent channels."""
        return int(self.unet.config["out_channels"])

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        """The type that the U-Net computes in; tokens and latents are float32."""
        return next(self.unet.parameters()).dtype

    def tokens(self, conditions: Tensor, source: Source) -> Tensor:
        """Embeddings (n, d) of one source -> tokens (n, 1, d) in its own place.

        Raises:
            PalpateError: for another width, or a source whose training mean is unknown.
        """
        return self._token(self._unit(conditions.to(self.device), source))

    def condition(
        self, photos: Tensor | None, texts: Tensor | None = None, weight: float = 0.5
    ) -> Tensor:
        """The tokens (n, k, d) of samples described by photos, by texts, or by both.

        Args:
            photos: embeddings (n, d), with tokens of their patches (n, 1 + p, d), of GVST tokens
                (n, 64, d), or None.
            texts: embeddings (n, d), or None; at least one of the two.
            weight: with both, the share of the photo where the two take one place.

        Raises:
            PalpateError: for another width, an unknown mean, or texts without a place.
        """
        if "photos" in self.maps:
            return self._map(photos, texts)
        photo = patches = text = None
        if photos is not None:
            photos = photos.to(self.device)
            if photos.ndim == 3:
                photos, patches = photos[:, 0], photos[:, 1:]
            photo = self._unit(photos, "vision")
        if texts is not None:
            text = self._unit(texts.to(self.device), "text")
        place = photo if self.slots == 1 else None  # of two slots the photo has its own
        if photo is not None and self.pairs:
            place, photo = self.recall(photo)
        if text is not None:
            mixed = text if place is None else weight * place + (1 - weight) * text
            place = nn.functional.normalize(mixed, dim=1)
        n = len(next(e for e in (photo, text) if e is not None))
        slots = (place,) if self.slots == 1 else (place, photo)
        parts = [None if e is None else self._token(e) for e in slots]
        parts += [patches for _ in inputs_of(self.policy)]
        null = self.null_tokens(n)
        lengths = zip(parts, lengths_of(self.policy), strict=True)
        return torch.cat([null[:, :k] if p is None else p for p, k in lengths], dim=1)

    def _map(self, photos: Tensor | None, texts: Tensor | None) -> Tensor:
        shape = (PHOTO_TOKENS, self.policy.width)
        if texts is not None or photos is None:
            must, fix = "must be left out for a generator that knows photos alone", "Pass a photo"
            raise PalpateError(must, "a text", fix, argument="text")
        if photos.shape[1:] != shape:
            must, got = f"must be tokens of shape (n, {shape[0]}, {shape[1]})", f"{photos.shape}"
            raise PalpateError(must, got, "Use the pipeline's embed", argument="conditions")
        return photos.to(self.device)

    def recall(self, photos: Tensor) -> tuple[Tensor, Tensor]:
        """Means of texts and of photos, near these in training, as unit embeddings (n, d)."""
        texts, near = [], []
        for rows in photos.split(1024):
            weights = torch.softmax(rows @ self.keys.T / TAU, dim=1)
            texts.append(weights @ self.memory)
            near.append(weights @ self.keys)
        unit = nn.functional.normalize
        return unit(torch.cat(texts), dim=1), unit(torch.cat(near), dim=1)

    def _unit(self, conditions: Tensor, source: Source) -> Tensor:
        width = self.policy.width
        if conditions.ndim != 2 or conditions.shape[1] != width:
            must, got = f"must be embeddings of shape (n, {width})", str(tuple(conditions.shape))
            fix = "Use the pipeline's encoders"
            raise PalpateError(must, got, fix, argument="conditions")
        mean = self.means[SOURCES.index(source)]
        if not torch.isfinite(mean).all():
            must = f"gap={self.policy.gap!r} needs the training mean of {source} embeddings"
            fix = f"Give training the {source} embeddings too"
            raise PalpateError(must, "a checkpoint without it", fix)
        return nn.functional.normalize(conditions.float() - mean.to(conditions.device), dim=1)

    def _token(self, unit: Tensor) -> Tensor:
        return (unit * self.policy.width**0.5).unsqueeze(1)

    def null_tokens(self, n: int) -> Tensor:
        """The unconditional tokens (n, k, d), zeros: of all embeddings and inputs."""
        shape = (n, sum(lengths_of(self.policy)), self.policy.width)
        return torch.zeros(shape, device=self.device)

    def forward(
        self, x: Tensor, t: Tensor, tokens: Tensor, background: Tensor | None = None
    ) -> Tensor:
        """The network's output (n, c, h, w): noise or velocity, as the schedule says.

        Args:
            x: noisy normalized latents (n, c, h, w).
            t: steps (n,) in 0..T-1 (the paper's 1..T).
            tokens: (n, k, d), of all embeddings and inputs.
            background: of the no-contact images (n, g, h, w), for the variant w/ BG.
        """
        x = x if background is None else torch.cat([x, background], dim=1)
        first = None
        if self.unet.config["class_embed_type"] == "projection":
            vectors = tokens[:, : self.slots] if self.slots else tokens.mean(1, keepdim=True)
            first = vectors.flatten(1)
        kind = self.dtype
        options: Any = {"encoder_hidden_states": tokens.to(kind)}
        options["class_labels"] = None if first is None else first.to(kind)
        return cast("Tensor", self.unet(x.to(kind), t, return_dict=False, **options)[0]).float()

    def halve(self) -> None:
        """Round the U-Net's weights and the memory to 16 bits in place."""
        for kept in (b for name, b in self.named_buffers(recurse=False) if name in MEMORY):
            kept.copy_(kept.half())
        round_to_half({"unet": self.unet})

    def save(self, folder: Path, *, half: bool = False) -> None:
        """Write the U-Net and ``condition.safetensors`` (means, memory, trained maps).

        With ``half``, :meth:`halve` first (this object too), and the U-Net's weights and the memory
        are 16-bit; the few others stay float32.
        """
        if half:
            self.halve()
        save_model(self.unet, folder, half=half)
        extra = {k: v for k, v in self.state_dict().items() if not k.startswith("unet.")}
        if half:
            extra |= {name: extra[name].half() for name in MEMORY if name in extra}
        with atomic_path(Path(folder) / "condition.safetensors") as part:
            save_file({k: v.detach().cpu().contiguous() for k, v in extra.items()}, part)

    @classmethod
    def load(cls, folder: Path, policy: ConditionPolicy) -> Denoiser:
        """Read what :meth:`save` wrote.

        Raises:
            PalpateError: if a file is missing, unreadable, incomplete, or of another policy.
        """
        must, fix = f"The denoiser {folder} must be as palpate writes it", "Copy the folder again"
        options = {"low_cpu_mem_usage": False, "use_safetensors": True, "local_files_only": True}
        unet = load_model(UNet2DConditionModel, str(folder), must, fix, strict=True, **options)
        require_regular(Path(folder) / "condition.safetensors")
        try:
            extra = load_file(Path(folder) / "condition.safetensors")
            patches = "patches" in inputs_of(policy)
            width = extra["maps.patches.1.weight"].shape[1] if patches else None
            model = cls(unet, policy, patch_width=width)
            wanted = {k for k in model.state_dict() if not k.startswith("unet.")}
            if wanted != set(extra):
                raise KeyError(f"other entries than {', '.join(sorted(wanted))}")
            kept = {name: extra[name].float() for name in MEMORY if name in wanted}
            shapes = {rows.shape for rows in kept.values()}
            if len(shapes) > 1 or any(shape[1:] != (policy.width,) for shape in shapes):
                raise KeyError("a memory of another shape")
            for name, rows in kept.items():
                setattr(model, name, rows)
            model.load_state_dict(extra, strict=False)
        except UNREADABLE as error:
            raise PalpateError(must, first_line(error), fix) from None
        return model.eval().requires_grad_(False)
