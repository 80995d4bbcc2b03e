"""Contrastive losses (paper section 3). Rows of a, b are L2-normalized and belong together:

    L_ab = -1/(2N) sum_i [ log softmax_j(a_i.b_j / tau)_i + log softmax_j(b_i.a_j / tau)_i ],
    L    = (w_1 L_tactile,text + w_2 L_vision,text + w_3 L_tactile,vision) / (w_1 + w_2 + w_3)

1 / tau is learned, from 1 / 0.07, and kept at or below 100.

Captions repeat: every frame of a video, and often every object of a kind, has the same one, so the
plain diagonal calls equal texts negatives. ``Targets`` says what is done about it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy
from torch.utils.checkpoint import checkpoint

from palpate.core import PalpateError
from palpate.encoders.presets import Targets

#: The learned parameter is the logarithm of 1 / tau.
LOG_SCALE_START, LOG_SCALE_MAX = math.log(1 / 0.07), math.log(100.0)
TEXT_TAU = 0.05  # of TVL's soft text targets (recipes, section 3)
PAIRS = ("tactile_text", "vision_text", "tactile_vision")
ALL_PAIRS = (1.0, 1.0, 1.0)


def require_weights(weights: Sequence[float]) -> None:
    """Raise unless ``weights`` are three numbers of at least 0 with a positive, finite sum."""
    if len(weights) != 3 or min(weights) < 0 or not 0 < sum(weights) < math.inf:
        must, got = "must be three numbers >= 0 with a positive sum", f"{tuple(weights)}"
        fix = "0 switches a pair off"
        raise PalpateError(must, got, fix, argument="weights", example={"weights": (1, 1, 1)})


def soft_targets(texts: Tensor) -> Tensor:
    """Spread each row's target mass equally over the rows with its text number: (n,) to (n, n)."""
    same = (texts[:, None] == texts[None, :]).float()
    return same / same.sum(dim=1, keepdim=True)


def info_nce(
    a: Tensor,
    b: Tensor,
    scale: Tensor | float,
    targets: Tensor | None = None,
    excluded: Tensor | None = None,
) -> Tensor:
    """Symmetric InfoNCE of one pair of modalities.

    Args:
        a: (n, d), L2-normalized.
        b: (n, d), L2-normalized; row i belongs to row i of ``a``.
        scale: 1 / tau.
        targets: (n, n) with rows that sum to 1, or None for the diagonal (paper section 3).
        excluded: symmetric (n, n), true where row j is no negative of row i.

    Returns:
        The scalar loss in nats.
    """
    logits = scale * a @ b.T
    if excluded is not None:
        logits = logits.masked_fill(excluded, -math.inf)
    target = torch.arange(len(a), device=a.device) if targets is None else targets
    return (cross_entropy(logits, target) + cross_entropy(logits.T, target)) / 2


@dataclass(frozen=True)
class Labels:
    """What the targets of a batch depend on.

    Attributes:
        texts: (n,) number of each row's caption.
        contacts: (n,) number of each row's contact.
        photos: (n,) whether the row has a photo; None: all have. Where it has none, its two vision
            pairs are left out.
    """

    texts: Tensor
    contacts: Tensor | None = None
    photos: Tensor | None = None

    def take(self, rows: Tensor) -> Labels:
        """Some of the rows, which all have a photo."""
        return Labels(self.texts[rows], None if self.contacts is None else self.contacts[rows])

    def targets(self, mode: Targets, text: Tensor) -> Tensor | None:
        """The targets of a text pair, (n, n), given the text embeddings; None: the diagonal."""
        if mode == "identical-text":
            return soft_targets(self.texts)
        return (text @ text.T / TEXT_TAU).softmax(dim=1).detach() if mode == "soft-text" else None

    def excluded(self, mode: Targets) -> Tensor | None:
        """Where rows are no negatives of each other, (n, n)."""
        if mode != "exclude":
            return None
        same = self.texts[:, None] == self.texts[None, :]
        if self.contacts is not None:
            same |= self.contacts[:, None] == self.contacts[None, :]
        return same.fill_diagonal_(False)


def three_way(
    tactile: Tensor,
    text: Tensor | None,
    vision: Tensor | None,
    scale: Tensor | float,
    labels: Labels,
    *,
    targets: Targets = "diagonal",
    weights: Sequence[float] = ALL_PAIRS,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The paper's loss over three pairs, in float32.

    Args:
        tactile: (n, d), L2-normalized.
        text: the same, or None for a vision encoder without text: the last pair alone.
        vision: the same, or None for data without photos: the first pair alone.
        scale: 1 / tau.
        labels: of the rows.
        targets: see :data:`~palpate.encoders.presets.Targets`.
        weights: of tactile-text, vision-text, tactile-vision; the total is their weighted mean; a
            pair of weight 0 is not computed.

    Returns:
        The total, and the losses of the pairs by name.

    Raises:
        PalpateError: see :func:`require_weights`.
    """
    require_weights(weights)
    with torch.autocast(tactile.device.type, enabled=False):
        tactile, text = tactile.float(), None if text is None else text.float()
        pair = {} if text is None else {"tactile_text": (tactile, text, labels)}
        if vision is not None:
            some, seen = slice(None), labels
            if labels.photos is not None:
                some = labels.photos.nonzero()[:, 0]
                seen = labels.take(some)
            vision = vision.float()[some]
            if text is not None:
                pair["vision_text"] = (vision, text[some], seen)
            pair["tactile_vision"] = (tactile[some], vision, seen)
        logs: dict[str, Tensor] = {}
        for name, weight in zip(PAIRS, weights, strict=True):
            if name in pair and weight:
                a, b, rows = pair[name]
                soft = rows.targets(targets, b) if "text" in name else None
                logs[name] = (
                    info_nce(a, b, scale, soft, rows.excluded(targets)) if len(a) else a.sum()
                )
        used = {name: w for name, w in zip(PAIRS, weights, strict=True) if name in logs}
        if not used:
            lacking = "photos" if vision is None else "texts"
            must, fix = "must leave a pair that there is", f"There are no {lacking}"
            raise PalpateError(must, f"{tuple(weights)}", fix, argument="weights")
        total = torch.stack([w * logs[name] for name, w in used.items()]).sum() / sum(used.values())
    return total, {name: loss.detach() for name, loss in logs.items()}


def clamped_scale(log_scale: Tensor) -> Tensor:
    """Return 1 / tau; the parameter is clamped, as clamping the value alone ends its gradient."""
    with torch.no_grad():
        log_scale.clamp_(max=LOG_SCALE_MAX)
    return log_scale.exp()


def in_chunks(
    encode: Callable[[Tensor], Tensor], inputs: Tensor, chunk: int | None = None
) -> Tensor:
    """Encode a batch ``chunk`` rows at a time, with the memory of one chunk.

    The activations of a chunk are dropped after its forward pass and computed again when the
    gradient of the whole batch's loss reaches it: cached gradients (Gao et al. 2021, "Scaling Deep
    Contrastive Learning Batch Size under Memory Limited Setup").
    """
    if chunk is None or chunk >= len(inputs):
        return encode(inputs)
    options: dict[str, Any] = {"use_reentrant": False, "preserve_rng_state": False}
    return torch.cat([checkpoint(encode, part, **options) for part in inputs.split(chunk)])
