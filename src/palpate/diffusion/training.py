"""Training the denoiser (paper Eq. 1):

    L(theta) = E_{z, c, eps, t} || eps - eps_theta(z^t, t, c) ||^2,   t uniform on 1..T,
    z^t = sqrt(a_t) z + sqrt(1 - a_t) eps,   a_t = prod_{s<=t} (1 - beta_s),

with beta linear in its square root (latent diffusion's schedule). The condition c is dropped with probability p, which
trains the unconditional model that guidance needs (Ho & Salimans 2022). Latents and embeddings are read from caches.

Options beyond the paper: v-prediction (Salimans & Ho 2022), whose target is ``sqrt(a) eps - sqrt(1 - a) z``, and the
min-SNR weight (Hang et al. 2023): ``min(snr, g) / snr`` for eps and ``min(snr, g) / (snr + 1)`` for v.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from palpate.core import PalpateError, Progress, digest_json, quiet, seed_for
from palpate.diffusion.denoiser import (
    SOURCES,
    ConditionPolicy,
    Denoiser,
    Source,
    UNetOptions,
    build_unet,
)
from palpate.diffusion.latents import LatentStats
from palpate.diffusion.pixels import digest_tensors
from palpate.training.loop import LoopOptions, fit


@dataclass(frozen=True)
class Schedule:
    """The forward process and what the network predicts.

    Attributes:
        beta_start, beta_end: of the schedule linear in sqrt(beta).
        steps: T.
        prediction: ``epsilon`` (the paper) or ``v_prediction``.
        min_snr: g of the min-SNR weight, or None for Eq. 1's uniform weight.
    """

    beta_start: float = 0.0015
    beta_end: float = 0.0195
    steps: int = 1000
    prediction: Literal["epsilon", "v_prediction"] = "epsilon"
    min_snr: float | None = None

    def alphas(self) -> Tensor:
        """a_t for t = 1..T as float64 (T,)."""
        betas = (
            torch.linspace(
                self.beta_start**0.5, self.beta_end**0.5, self.steps, dtype=torch.float64
            )
            ** 2
        )
        return torch.cumprod(1 - betas, dim=0)


def train_denoiser(
    latents: Tensor | np.ndarray,
    conditions: Mapping[Source, Tensor | np.ndarray],
    *,
    stats: LatentStats,
    unet: UNetOptions,
    policy: ConditionPolicy,
    schedule: Schedule,
    loop: LoopOptions,
    folder: Path,
    background: Tensor | np.ndarray | None = None,
    start: Denoiser | None = None,
    key: str = "",
    device: str | torch.device = "cpu",
    progress: Progress = quiet,
) -> Denoiser:
    """Trains a denoiser; resumes if ``folder`` holds a checkpoint of the same run.

    Args:
        latents: (n, c, h, w) of the autoencoder, not normalized; a memory map will do.
        conditions: embeddings (n, d) by source; ``policy.sources`` are needed, others only give their mean.
        stats: normalize the latents, of touch and background alike.
        unet: geometry of the network.
        policy: how embeddings become tokens, and which train.
        schedule: the forward process and the target.
        loop: length, rate, averaging; its seed also seeds the weights.
        folder: for checkpoints and the log.
        background: latents (n, c, h, w) of the no-contact images, for the variant w/ BG.
        start: go on from these weights instead of random ones; the geometry must be the same. The modality means are those of
            ``conditions`` all the same.
        key: anything else that a checkpoint must match (latents and conditions are compared by digest anyway).
        device: where to train.
        progress: called after each step.

    Returns:
        The denoiser with averaged weights, frozen.

    Raises:
        PalpateError: if a source is missing, lengths differ, or ``start`` has another geometry.
    """
    n, channels, size = latents.shape[0], latents.shape[1], latents.shape[2]
    tables = {
        source: torch.as_tensor(np.asarray(table), dtype=torch.float32)
        for source, table in conditions.items()
    }
    if missing := [s for s in policy.sources if s not in tables]:
        raise PalpateError(
            f"source={policy.source!r} needs embeddings of {', '.join(policy.sources)}",
            f"none of {missing[0]}",
            "Embed them first",
        )
    lengths = {"latents": n, **{s: len(t) for s, t in tables.items()}} | (
        {} if background is None else {"background": len(background)}
    )
    if len(set(lengths.values())) > 1:
        raise PalpateError(
            "Latents, conditions and backgrounds must have one row a sample",
            str(lengths),
            "Cache them for the same ids",
        )
    means: dict[Source, Tensor] = {
        s: tables[s].double().mean(0).float() for s in SOURCES if s in tables
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(loop.seed, "denoiser"))
        net = build_unet(
            unet,
            channels=channels,
            size=size,
            width=policy.width,
            background=background is not None,
        )
        model = Denoiser(net, policy, means).to(device)
    if start is not None:
        _copy_weights(start, model)
    with torch.no_grad():
        tokens: dict[Source, Tensor] = {
            s: model.tokens(tables[s], s).to("cpu") for s in policy.sources
        }
    data = {f"tokens.{s}": value for s, value in tokens.items()} | {
        "latents": torch.tensor(np.asarray(latents))
    }
    if background is not None:
        data["background"] = torch.tensor(np.asarray(background))
    begin = [] if start is None else [digest_tensors(start.unet.state_dict())]
    key = digest_json(
        [
            key,
            asdict(stats),
            asdict(unet),
            asdict(policy),
            asdict(schedule),
            digest_tensors(data),
            *begin,
        ]
    )
    loss = DiffusionLoss(latents, tokens, background, stats, schedule)
    fit(model, loss, n, loop, folder, what="generator", key=key, progress=progress)
    return model.eval().requires_grad_(requires_grad=False)


def _copy_weights(source: Denoiser, target: Denoiser) -> None:
    """The U-Net, and the unconditional token if both have learned one; other shapes are refused."""
    shapes = [
        {name: tuple(v.shape) for name, v in d.unet.state_dict().items()} for d in (source, target)
    ]
    if shapes[0] != shapes[1]:
        raise PalpateError(
            "The denoiser to start from must have the geometry of the preset",
            "another geometry",
            "Leave it out",
        )
    target.unet.load_state_dict(source.unet.state_dict())
    if source.null is not None and target.null is not None:
        target.null.data.copy_(source.null.data)


class DiffusionLoss:
    """Eq. 1 for one batch; all draws come from the loop's generator of (seed, step)."""

    def __init__(
        self,
        latents: Tensor | np.ndarray,
        tokens: Mapping[Source, Tensor],
        background: Tensor | np.ndarray | None,
        stats: LatentStats,
        schedule: Schedule,
    ) -> None:
        self.latents, self.tokens, self.background, self.stats, self.schedule = (
            latents,
            dict(tokens),
            background,
            stats,
            schedule,
        )
        self.alphas = schedule.alphas()

    def __call__(
        self, module: nn.Module, rows: Tensor, generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        """The mean weighted squared error of a batch, and the unweighted one to log; see ``LossFunction``."""
        assert isinstance(module, Denoiser)
        policy, n = module.policy, len(rows)
        z = self.stats.normalize(_take(self.latents, rows))
        t = torch.randint(0, self.schedule.steps, (n,), generator=generator)
        noise = torch.randn(z.shape, generator=generator)
        tokens = self._tokens(rows, policy, generator)
        dropped = torch.rand(n, generator=generator) < policy.dropout
        a = self.alphas[t].float().reshape(-1, 1, 1, 1)
        noisy = a.sqrt() * z + (1 - a).sqrt() * noise
        target = (
            noise
            if self.schedule.prediction == "epsilon"
            else a.sqrt() * noise - (1 - a).sqrt() * z
        )
        device = module.device
        tokens = torch.where(
            dropped.reshape(-1, 1, 1).to(device), module.null_tokens(n), tokens.to(device)
        )
        ground = (
            None
            if self.background is None
            else self.stats.normalize(_take(self.background, rows)).to(device)
        )
        error = (
            (module(noisy.to(device), t.to(device), tokens, ground) - target.to(device))
            .square()
            .mean((1, 2, 3))
        )
        weight = self._weight(t).to(device)
        return (weight * error).mean(), {"mse": float(error.detach().mean())}

    def _tokens(self, rows: Tensor, policy: ConditionPolicy, generator: torch.Generator) -> Tensor:
        parts = [self.tokens[s][rows] for s in policy.sources]
        tokens = parts[0]
        if len(parts) == 2:
            tokens = torch.where(
                torch.rand(len(rows), 1, 1, generator=generator) < 0.5, parts[0], parts[1]
            )
        if policy.noise:
            # One draw a sample: the k tokens stay copies of each other.
            tokens = tokens + policy.noise * torch.randn(
                len(rows), 1, policy.width, generator=generator
            )
            tokens = nn.functional.normalize(tokens, dim=2) * policy.width**0.5
        return tokens

    def _weight(self, t: Tensor) -> Tensor:
        if self.schedule.min_snr is None:
            return torch.ones(len(t))
        snr = (self.alphas[t] / (1 - self.alphas[t])).float()
        return snr.clamp(max=self.schedule.min_snr) / (
            snr if self.schedule.prediction == "epsilon" else snr + 1
        )


def _take(table: Tensor | np.ndarray, rows: Tensor) -> Tensor:
    return (
        table[rows]
        if isinstance(table, Tensor)
        else torch.from_numpy(np.ascontiguousarray(table[rows.numpy()]))
    )
