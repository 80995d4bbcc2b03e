"""Training a denoiser (paper section 2), in the paper on Eq. 1,

    L(theta) = E_{z, c, eps, t} || eps - eps_theta(z^t, t, c) ||^2,   t uniform on 1..T,
    z^t = sqrt(a_t) z + sqrt(1 - a_t) eps.

The condition c is dropped with probability p, which trains the unconditional model that guidance
needs (Ho & Salimans 2022).

Beyond the paper: flow matching (Lipman et al. 2023) with logit-normal time, whose target is ``eps -
z``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from numpy.typing import NDArray
from torch import Tensor, nn

from palpate.core import digest_json, require
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.contact import KEPT, PARTS, channels_of, dropped, maps_of
from palpate.diffusion.denoiser import Denoiser, inputs_of, lengths_of, slots_of
from palpate.diffusion.options import SOURCES, ConditionPolicy, Schedule, Source, UNetOptions
from palpate.diffusion.presets import DiffusionPreset
from palpate.diffusion.unet import build_unet, load_unet
from palpate.encoders.models import digest_tensors, pick_device
from palpate.encoders.rows import evenly_spaced
from palpate.training.engine import Batch, Losses, Task, fit
from palpate.training.run import TrainingRun
from palpate.training.steps import Step, seeded

#: Share of the rows that are trained without the patches of their photo, so that the embedding
#: alone is known, too.
DROP_PATCHES = 0.5
#: Mean of the logit of the time of flow matching.
TIME_MEAN = 0.5
Backgrounds = Callable[[NDArray[np.int64], LatentStats], Tensor]


@dataclass(frozen=True)
class Rows:
    """What a denoiser is trained on.

    Attributes:
        latents: (n, c, h, w) of the autoencoder, not normalized; a memory map will do.
        conditions: embeddings (n, d) by source; those of ``policy.sources`` are needed, others only
            give their mean. By name ``inputs_of(policy)``, arrays or memory maps: ``patches``,
            states (n, k, w), or ``photos`` of GVST (n, s, s, 3).
        background: rows -> (n, g, h, w), what the variant w/ BG sees of the gel, by the statistics
            of the latents.
        ids: of the rows, for errors.
        key: digest of all of this, which is not read for it.
        gels: the no-contact images (n, s, s, 3), where they are needed.
        contacts: of ``policy.contact``: what is known of the touches (n, 8), as the manifest's
            columns.
        marks: what their shears do to the markers (n, 3 c, h, w), in latents.
        requested: the touches (n, 6) as they are requested.
    """

    latents: Tensor | NDArray[Any]
    conditions: Mapping[str, Tensor | NDArray[Any]]
    background: Backgrounds | None = None
    ids: Sequence[str] | None = None
    key: str = ""
    gels: NDArray[np.uint8] | None = None
    contacts: NDArray[np.float64] | None = None
    marks: NDArray[Any] | None = None
    requested: NDArray[np.float32] | None = None


def train_denoiser(
    rows: Rows,
    preset: DiffusionPreset,
    stats: LatentStats,
    run: TrainingRun,
    *,
    held_out: Rows | None = None,
    start: Denoiser | None = None,
    remember: bool = False,
    samples: Callable[[nn.Module], NDArray[np.uint8]] | None = None,
) -> Denoiser:
    """Train a denoiser; resume if the run's folder holds a checkpoint of the same run.

    Args:
        rows: of the train part.
        preset: U-Net, condition, schedule and loop, whose seed also seeds the weights.
        stats: normalize the latents of tactile and background images.
        run: where, and how.
        held_out: rows whose loss is measured in training.
        start: go on from these weights and in their shape instead of random ones. The modality
            means are those of ``rows`` all the same.
        remember: keep means and memory of ``start``, for more data of the same kind.
        samples: see :class:`~palpate.training.engine.Task`.

    Returns:
        The denoiser with averaged weights, frozen.

    Raises:
        PalpateError: if a source is missing.
    """
    policy, conditions = preset.condition, rows.conditions
    _require_conditions(policy, conditions)
    tables: dict[Source, Tensor] = {s: _floats(conditions[s]) for s in SOURCES if s in conditions}
    means: dict[Source, Tensor] = {s: table.double().mean(0).float() for s, table in tables.items()}
    with seeded(preset.loop.seed, "denoiser"):
        gel = 0 if rows.background is None else rows.background(np.arange(1), stats).shape[1]
        channels, side = rows.latents.shape[1:3]
        gel += channels_of(channels) if policy.contact else 0
        net = new_unet(start, preset.unet, policy, side, channels=channels, background=gel)
        memory, which = _memory(tables) if policy.gap == "pairs" else (None, None)
        if start is not None and remember and start.pairs:
            means = dict(zip(SOURCES, start.means, strict=True))
            memory = start.memory + start.means[0], start.keys + start.means[1]
            which = start.similar(tables["vision"]).argmax(1)
        touches = None if rows.requested is None else _touches(rows.requested, which)
        width = conditions["patches"].shape[2] if "patches" in inputs_of(policy) else None
        model = Denoiser(net, policy, means, memory, width, touches)
        model.to(pick_device(run.device))
    trained = {} if start is None else dict(start.named_parameters())
    for name, own in model.named_parameters():  # of the U-Net, and what else both have learned
        if name in trained:  # inputs that are new have no effect at first
            known = trained[name].data
            own.data.zero_()[tuple(map(slice, known.shape))] = known

    def loss_of(part: Rows) -> DiffusionLoss:
        with torch.no_grad():
            tokens: dict[Source, Tensor] = {
                s: model.tokens(_floats(part.conditions[s]), s).to("cpu") for s in policy.sources
            }
        return DiffusionLoss(
            part.latents,
            tokens,
            part.background,
            stats=stats,
            schedule=preset.schedule,
            policy=policy,
            inputs={name: part.conditions[name] for name in inputs_of(policy)},
            contacts=None
            if part.requested is None
            else (part.requested, part.marks, model.touch_scale),
        )

    loss, held = loss_of(rows), None
    if held_out is not None:
        held = (len(held_out.latents), loss_of(held_out).load)
    records = (stats, preset.unet, policy, preset.schedule)
    settings = [asdict(record) for record in records if not isinstance(record, str)]
    fresh = start is None and not isinstance(preset.unet, str)
    begin = [] if fresh else [digest_tensors(model.state_dict())]
    key = digest_json([rows.key, rows.background is not None, *settings, *begin])
    n = len(rows.latents)
    task = Task("generator", n, loss.load, loss, key, rows.ids, held, samples)
    fit(model, task, preset.loop, run.folder, compute=run.compute, progress=run.progress)
    return model.eval().requires_grad_(False)


def new_unet(
    start: Denoiser | None,
    unet: UNetOptions | str,
    policy: ConditionPolicy,
    side: int,
    *,
    channels: int,
    background: int,
) -> UNet2DConditionModel:
    """The network that trains: of the shape of ``start``, a trained one, or one of new weights.

    Args:
        start: goes on.
        unet: geometry of the network, or a trained one, see :func:`load_unet`.
        policy: gives the tokens.
        side: of the latents.
        channels: of the latents.
        background: channels of the no-contact image and of contacts.
    """
    if start is not None:
        config = {**start.unet.config, "in_channels": channels + background}
        net: Any = UNet2DConditionModel.from_config(config)
        return net
    if isinstance(unet, str):
        return load_unet(unet, policy, channels=channels, background=background)
    return build_unet(unet, policy, size=side, channels=channels, background=background)


def _require_conditions(policy: ConditionPolicy, conditions: Mapping[str, Any]) -> None:
    pairs = policy.gap == "pairs"
    must = "must be text or both with gap='pairs': other photos would find their own text"
    fits = not pairs or "text" in policy.sources
    require(fits, "condition.source", must, policy.source, fix="Take gap='none'")
    needed = [*dict.fromkeys((*policy.sources, *inputs_of(policy), *(SOURCES if pairs else ())))]
    missing = [name for name in needed if name not in conditions]
    settings = f"source={policy.source!r} and gap={policy.gap!r}"
    must = f"{settings} need conditions of {', '.join(needed)}"
    require(not missing, None, must, f"none of {', '.join(missing[:1])}")


def _floats(table: Any) -> Tensor:
    return torch.as_tensor(np.asarray(table), dtype=torch.float32)


def _memory(tables: Mapping[Source, Tensor]) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """The different training texts (m, d), the mean of the photos of each; the text of each row."""
    texts, which, counts = tables["text"].unique(dim=0, return_inverse=True, return_counts=True)
    photos = torch.zeros_like(texts).index_add_(0, which, tables["vision"])
    return (texts, photos / counts[:, None]), which


def _touches(requested: NDArray[np.float32], which: Tensor | None) -> tuple[Tensor, Tensor]:
    """Training touches that are kept, evenly of those with a place; the memory's row of each."""
    placed = np.flatnonzero(np.isfinite(requested[:, 0]))
    kept = placed[evenly_spaced(len(placed), KEPT)] if len(placed) else np.arange(1)
    rows = torch.from_numpy(requested[kept])
    return rows, torch.zeros(len(kept), dtype=torch.int64) if which is None else which[kept].cpu()


class DiffusionLoss:
    """Eq. 1, or that of flow matching, for one batch; all draws are those of the step."""

    def __init__(
        self,
        latents: Tensor | NDArray[Any],
        tokens: Mapping[Source, Tensor],
        background: Backgrounds | None,
        *,
        stats: LatentStats,
        schedule: Schedule,
        policy: ConditionPolicy,
        inputs: Mapping[str, Any] | None = None,
        contacts: tuple[Any, Any, tuple[Tensor, Tensor]] | None = None,
    ) -> None:
        """Take latents (n, c, h, w), not normalized, tokens (n, k, d) by source, inputs, and of
        contacts what is requested (n, 6), the marks, and the scale.
        """
        self.latents, self.tokens, self.background = latents, dict(tokens), background
        self.stats, self.schedule, self.policy = stats, schedule, policy
        self.inputs, self.contacts = dict(inputs or {}), contacts
        self.lengths = torch.tensor(lengths_of(policy))
        self.alphas = schedule.alphas()

    def load(self, step: Step) -> Batch:
        """Noisy latents, their targets, tokens, and which of these are dropped."""
        z = self.stats.normalize(_take(self.latents, step.rows))
        if self.schedule.prediction == "flow":
            time = torch.sigmoid(TIME_MEAN + step.randn())
            keep, spread, t = 1 - time, time, self.schedule.steps * time
        else:
            t = step.randint(self.schedule.steps)
            a = self.alphas[t].float()
            keep, spread = a.sqrt(), (1 - a).sqrt()
        keep, spread = keep.reshape(-1, 1, 1, 1), spread.reshape(-1, 1, 1, 1)
        noise = step.randn(*z.shape[1:])
        target = noise - z if self.schedule.prediction == "flow" else noise
        tokens = self._tokens(step)
        batch = {
            "noisy": keep * z + spread * noise,
            "target": target,
            "t": t,
            **({} if tokens is None else {"tokens": tokens}),
            **{name: _take(table, step.rows) for name, table in self.inputs.items()},
            "dropped": self._dropped(step).repeat_interleave(self.lengths, dim=1),
        }
        seen = [] if self.background is None else [self.background(step.rows, self.stats)]
        if self.contacts is not None:
            requested, marks, scale = self.contacts
            given = dropped(_take(requested, step.rows), step.rand(1 + len(PARTS)))
            marks = self.stats.scaled(_take(marks, step.rows).float())
            seen.append(maps_of(given, marks, scale))
        if seen:
            batch["background"] = torch.cat(seen, dim=1)
        return batch

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        """Return the squared error of a batch."""
        assert isinstance(module, Denoiser)
        null = module.null_tokens(len(batch["t"]))
        parts = [batch["tokens"]] if "tokens" in batch else []
        parts += [make(batch[name].float()) for name, make in module.maps.items()]
        tokens = torch.where(batch["dropped"], null, torch.cat(parts, dim=1))
        prediction = module(batch["noisy"], batch["t"], tokens, batch.get("background"))
        error = (prediction.float() - batch["target"]).square().mean((1, 2, 3))
        total = error.mean()
        return Losses(total, {"mse": total.detach()}, error.detach())

    def _tokens(self, step: Step) -> Tensor | None:
        """Tokens of the embeddings, with noise."""
        if not self.policy.sources:
            return None
        tokens = torch.cat([self.tokens[s][step.rows] for s in self.policy.sources], dim=1)
        if self.policy.noise:
            noise = step.randn(slots_of(self.policy), self.policy.width)
            tokens = nn.functional.normalize(tokens + self.policy.noise * noise, dim=2)
            tokens = tokens * self.policy.width**0.5
        return tokens

    def _dropped(self, step: Step) -> Tensor:
        """Which embeddings and inputs (n, parts, 1) are dropped; patches also with their photo."""
        draws = step.rand(len(self.lengths), 1)
        dropped, slots = draws < self.policy.dropout, slots_of(self.policy)
        if "patches" in self.inputs:
            dropped[:, slots:] = dropped[:, slots - 1 : slots] | (draws[:, slots:] < DROP_PATCHES)
        return dropped


def _take(table: Tensor | NDArray[Any], rows: NDArray[np.int64]) -> Tensor:
    return torch.as_tensor(table[rows])
