"""The denoiser eps_theta(z_t, t, condition), a diffusers U-Net with its condition, and sampling.

The condition is one *projected* embedding c of the shared space, so that text and vision embeddings
fit into the same slot (paper section 2):

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
autoencoder that is given the gel anyway, its pixels. Maps of what is known of the contact
(:mod:`palpate.diffusion.contact`) follow there.

Sampling takes z^T ~ N(0, 1) to z^0 by a solver of diffusers under classifier-free guidance,

    eps = eps_theta(z, t, null) + s (eps_theta(z, t, c) - eps_theta(z, t, null)),

both passes as one batch; s = 1 needs the conditional pass alone, s = 0 the unconditional one. The
solvers are DDIM without added noise (eta = 0; the paper's 200 steps) and second-order DPM-Solver++
for few steps. The starting noise of a sample comes from ``rng_for(seed, "noise", id)`` and batches
always have one size (the last is filled up), so that an image depends on (seed, id) and not on what
else is generated.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from diffusers.models.autoencoders.vae import Encoder
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from palpate.core import PalpateError, atomic_path, require, require_regular, rng_for
from palpate.diffusion.contact import channels_of, scale_of
from palpate.diffusion.options import (
    SOURCES,
    ConditionPolicy,
    Method,
    SamplerOptions,
    Schedule,
    Source,
)
from palpate.encoders.models import UNREADABLE, first_line, load_model, round_to_half, save_model

#: What ``pairs`` remembers: training texts, and the mean photo of each.
MEMORY = ("memory", "keys")
#: What ``contact`` remembers.
TOUCHES = ("touches", "likeness")
#: Temperature of its weights.
TAU = 0.02
#: Tokens of a photo: a map of 8 x 8.
PHOTO_TOKENS = 64
#: (z_t (n, c, h, w), t (n,), tokens (n, k, d), background or None) -> prediction (n, c, h, w).
Predictor = Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor]
#: (index of the step, t, latents after it) -> the latents to go on with.
OnStep = Callable[[int, Tensor, Tensor], Tensor]


def slots_of(policy: ConditionPolicy) -> int:
    """Embeddings that a sample is conditioned on at once: text and photo, one, or none."""
    return {"both": 2, "resnet": 0}.get(policy.source, 1)


def inputs_of(policy: ConditionPolicy) -> tuple[str, ...]:
    """What else tokens are made of: the ``photos``, or their ``patches``."""
    if policy.source == "resnet":
        return ("photos",)
    return ("patches",) if policy.patches and policy.source in ("vision", "both") else ()


def lengths_of(policy: ConditionPolicy) -> tuple[int, ...]:
    """Tokens of each embedding, then of each input."""
    tokens = {"photos": PHOTO_TOKENS, "patches": policy.patches}
    return (1,) * slots_of(policy) + tuple(tokens[name] for name in inputs_of(policy))


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
    touches: Tensor
    likeness: Tensor

    def __init__(  # noqa: PLR0917 - what the policy needs, in its order
        self,
        unet: UNet2DConditionModel,
        policy: ConditionPolicy,
        means: Mapping[Source, Tensor] | None = None,
        memory: tuple[Tensor, Tensor] | None = None,
        patch_width: int | None = None,
        touches: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        """Take what the policy's ``gap`` and ``contact`` need.

        Args:
            unet: the network.
            policy: how embeddings become tokens.
            means: the training mean (d,) of each source.
            memory: of ``gap="pairs"``: embeddings (m, d) of the different training texts, and the
                mean of the photos of each (m, d).
            patch_width: of the states of patches; default: that of the embeddings.
            touches: of ``contact``: training touches (m, 6) as they are requested, and the row of
                ``memory`` (m,) that each belongs to.
        """
        super().__init__()
        self.unet, self.policy = unet, policy
        self.background = self.gel_channels > 0
        self.pairs = policy.gap == "pairs"
        # A source without a mean is marked by NaN, and raises when it is used.
        fill = torch.full((policy.width,), float("nan") if self.pairs else 0.0)
        used = means if means is not None and self.pairs else {}
        self.register_buffer("means", torch.stack([used.get(s, fill).float() for s in SOURCES]))
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
        if policy.contact:
            rows, likeness = touches or (torch.zeros(1, 6), torch.zeros(1, dtype=torch.int64))
            self.register_buffer("touches", rows.float())
            self.register_buffer("likeness", likeness)

    def _remembered(self, rows: Tensor | None, source: Source) -> Tensor:
        """Unit embeddings (m, d); until load() fills it, one of zeros."""
        return torch.zeros(1, self.policy.width) if rows is None else self._unit(rows, source)

    @property
    def channels(self) -> int:
        """Latent channels."""
        return int(self.unet.config["out_channels"])

    @property
    def gel_channels(self) -> int:
        """Channels that show the gel."""
        maps = channels_of(self.channels) if self.policy.contact else 0
        return int(self.unet.config["in_channels"]) - self.channels - maps

    @property
    def touch_scale(self) -> tuple[Tensor, Tensor]:
        """Mean and deviation (6,) of the training touches, on the CPU."""
        return scale_of(self.touches.cpu())

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
        first = photo if slots_of(self.policy) == 1 else None  # of two slots the photo has its own
        if photo is not None and self.pairs:
            first, photo = self.recall(photo)
        if text is not None:
            mixed = text if first is None else weight * first + (1 - weight) * text
            first = nn.functional.normalize(mixed, dim=1)
        n = len(next(e for e in (photo, text) if e is not None))
        slots = (first,) if slots_of(self.policy) == 1 else (first, photo)
        parts = [None if e is None else self._token(e) for e in slots]
        parts += [patches for _ in inputs_of(self.policy)]
        null = self.null_tokens(n)
        lengths = zip(parts, lengths_of(self.policy), strict=True)
        return torch.cat([null[:, :k] if p is None else p for p, k in lengths], dim=1)

    def _map(self, photos: Tensor | None, texts: Tensor | None) -> Tensor:
        shape = (PHOTO_TOKENS, self.policy.width)
        must, fix = "must be left out for a generator that knows photos alone", "Pass a photo"
        require(texts is None and photos is not None, "text", must, "a text", fix=fix)
        assert photos is not None
        must, fix = (
            f"must be tokens of shape (n, {shape[0]}, {shape[1]})",
            "Use the pipeline's embed",
        )
        require(photos.shape[1:] == shape, "conditions", must, f"{photos.shape}", fix=fix)
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

    def similar(self, photos: Tensor | None, texts: Tensor | None = None) -> Tensor:
        """Cosines (n, m) of embeddings with the photos, else the texts, of the memory."""
        if photos is None:
            assert texts is not None
            return self._unit(texts.to(self.device), "text") @ self.memory.T
        photos = photos[:, 0] if photos.ndim == 3 else photos
        return self._unit(photos.to(self.device), "vision") @ self.keys.T

    def _unit(self, conditions: Tensor, source: Source) -> Tensor:
        width = self.policy.width
        must, fix = f"must be embeddings of shape (n, {width})", "Use the pipeline's encoders"
        fits = conditions.ndim == 2 and conditions.shape[1] == width
        require(fits, "conditions", must, tuple(conditions.shape), fix=fix)
        mean = self.means[SOURCES.index(source)]
        must = f"gap={self.policy.gap!r} needs the training mean of {source} embeddings"
        fix = f"Give training the {source} embeddings too"
        require(bool(torch.isfinite(mean).all()), None, must, "a checkpoint without it", fix=fix)
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
            background: of the no-contact images (n, g, h, w), for the variant w/ BG, then the maps
                of contacts.
        """
        x = x if background is None else torch.cat([x, background], dim=1)
        first = None
        if self.unet.config["class_embed_type"] == "projection":
            vectors = (
                tokens[:, : slots_of(self.policy)]
                if slots_of(self.policy)
                else tokens.mean(1, keepdim=True)
            )
            first = vectors.flatten(1)
        kind, unet = self.dtype, cast("Any", self.unet)
        return unet(
            x.to(kind),
            t,
            encoder_hidden_states=tokens.to(kind),
            class_labels=None if first is None else first.to(kind),
            return_dict=False,
        )[0].float()

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
        unet = load_model(
            UNet2DConditionModel,
            str(folder),
            must,
            fix,
            strict=True,
            low_cpu_mem_usage=False,
            use_safetensors=True,
            local_files_only=True,
        )
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
            kept |= {name: extra[name] for name in TOUCHES if name in wanted}
            for name, rows in kept.items():
                setattr(model, name, rows)
            model.load_state_dict(extra, strict=False)
        except UNREADABLE as error:
            raise PalpateError(must, first_line(error), fix) from None
        return model.eval().requires_grad_(False)


def build_scheduler(schedule: Schedule, method: Method) -> Any:
    """The diffusers scheduler for a trained model; latents are not clipped.

    Raises:
        PalpateError: if the method is not one for the schedule.
    """
    if schedule.prediction == "flow":
        must = "must be dpm for a model that predicts flow"
        require(method == "dpm", "method", must, method, fix="Choose it")
        return DPMSolverMultistepScheduler(
            num_train_timesteps=schedule.steps,
            use_flow_sigmas=True,
            prediction_type="flow_prediction",
        )
    if method == "ddim":
        return DDIMScheduler(clip_sample=False, set_alpha_to_one=True, **_forward(schedule))
    # Steps uniform in log(a / (1 - a)). Uniform in t, 20 steps leave one wide gap before t = 0
    # under this schedule, and Gaussian data of spread 0.4 (0.2) come out with 80 % (55 %) of it;
    # now with 100 % (99 %).
    return DPMSolverMultistepScheduler(
        algorithm_type="dpmsolver++", solver_order=2, use_lu_lambdas=True, **_forward(schedule)
    )


def _forward(schedule: Schedule) -> dict[str, Any]:
    return {
        "num_train_timesteps": schedule.steps,
        "beta_start": schedule.beta_start,
        "beta_end": schedule.beta_end,
        "beta_schedule": "scaled_linear",
        "prediction_type": "epsilon",
        # Trailing steps start at t = T, where the starting noise belongs, for any number of steps.
        "timestep_spacing": "trailing",
    }


def starting_noise(ids: Sequence[str], shape: tuple[int, int, int], seed: int) -> Tensor:
    """z^T of each sample: float32 (n, c, h, w), a function of (seed, id) alone."""
    draws = np.empty((len(ids), *shape), np.float32)
    for k, name in enumerate(ids):
        draws[k] = rng_for(seed, "noise", name).standard_normal(shape, dtype=np.float32)
    return torch.from_numpy(draws)


@torch.no_grad()
def sample(
    predict: Predictor,
    tokens: Tensor,
    noise: Tensor,
    options: SamplerOptions,
    scheduler: Any,
    *,
    generator: Callable[[int], torch.Generator] | None = None,
    background: Tensor | None = None,
    bare: Tensor | None = None,
    on_step: OnStep | None = None,
) -> Tensor:
    """Normalized latents (n, c, h, w), on the CPU.

    Args:
        predict: the network, or any function of its form.
        tokens: conditions (n, k, d), on the network's device.
        noise: to start from, (n, c, h, w).
        options: see :class:`SamplerOptions`.
        scheduler: of diffusers.
        generator: row -> a new generator of the noise that a scheduler adds while it samples.
        background: what the network sees of the gels and touches (n, g, h, w), or None.
        bare: the same without what is requested, of the unconditional pass; default: the same.
        on_step: called after each step of each batch.
    """
    parts = [noise[:0]]
    scales = hasattr(scheduler, "scale_model_input")  # not those of flows
    draws = generator and "generator" in inspect.signature(scheduler.step).parameters
    for rows, count in batches(len(noise), options.batch):
        step = scheduler.step
        if generator and draws:
            step = partial(step, generator=[generator(k) for k in rows])
        grounds = background if bare is None else bare, background
        ground = [None if g is None else g[rows].to(tokens.device) for g in grounds]
        conditions = tokens[rows]
        scheduler.set_timesteps(options.steps, device=tokens.device)
        z = noise[rows].to(tokens.device) * getattr(scheduler, "init_noise_sigma", 1.0)
        for k, t in enumerate(scheduler.timesteps):
            now = replace(options, guidance=scale_at(t, scheduler, options))
            scaled = scheduler.scale_model_input(z, t) if scales else z
            prediction = guided(predict, scaled, t.expand(len(z)), conditions, ground, now)
            z = step(prediction, t, z, return_dict=False)[0]
            z = z if on_step is None else on_step(k, t, z)
        parts.append(z[:count].cpu())
    return torch.cat(parts)


def scale_at(t: Any, scheduler: Any, options: SamplerOptions) -> float:
    """The scale of guidance at a time step: 1, none, above the share ``high`` of them."""
    inside = float(t) / scheduler.config.num_train_timesteps <= options.high
    return options.guidance if inside else 1.0


def guided(  # noqa: PLR0917 - in the order of the network's arguments
    predict: Predictor,
    z: Tensor,
    t: Tensor,
    tokens: Tensor,
    grounds: Sequence[Tensor | None],
    options: SamplerOptions,
) -> Tensor:
    """Return the guided prediction; the formula holds for a velocity as well.

    ``grounds``: what the network sees of the gel in the unconditional pass, and in the other.
    """
    s, null = options.guidance, torch.zeros_like(tokens)
    if s in (0.0, 1.0):
        return predict(z, t, tokens if s else null, grounds[int(s)])
    seen = [ground for ground in grounds if ground is not None]
    twice = torch.cat(seen) if seen else None
    both = predict(torch.cat([z, z]), torch.cat([t, t]), torch.cat([null, tokens]), twice)
    without, conditional = both.chunk(2)
    prediction = without + s * (conditional - without)
    if options.rescale:
        std = conditional.std((1, 2, 3), keepdim=True) / prediction.std((1, 2, 3), keepdim=True)
        prediction = options.rescale * prediction * std + (1 - options.rescale) * prediction
    return prediction


def batches(n: int, size: int) -> list[tuple[list[int], int]]:
    """Return the rows of each batch and how many count: the last batch repeats its last row."""
    starts = range(0, n, size)
    rows = [[min(k, n - 1) for k in range(start, start + size)] for start in starts]
    return [(row, min(size, n - start)) for row, start in zip(rows, starts, strict=True)]
