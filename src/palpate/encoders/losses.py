"""Contrastive losses (paper section 3). Rows of a, b are L2-normalized and belong together:

    L_ab = -1/(2N) sum_i [ log softmax_j(a_i.b_j / tau)_i + log softmax_j(b_i.a_j / tau)_i ],
    L    = (L_tactile,text + L_vision,text + L_tactile,vision) / 3

1 / tau is learned, from 1 / 0.07, and kept at or below 100.

Captions repeat: every frame of a video, and often every object of a kind, has the same one, so the
plain diagonal calls equal texts negatives. ``Targets`` says what is done about it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy
from torch.utils.checkpoint import checkpoint

from palpate.encoders.presets import Targets

#: The learned parameter is the logarithm of 1 / tau.
LOG_SCALE_START, LOG_SCALE_MAX = math.log(1 / 0.07), math.log(100.0)
TEXT_TAU = 0.05  # of TVL's soft text targets (recipes, section 3)


def soft_targets(texts: Tensor) -> Tensor:
    """Spread each row's target mass equally over the rows with its text number: (n,) to (n, n)."""
    same = (texts[:, None] == texts[None, :]).float()
    return same / same.sum(dim=1, keepdim=True)


def text_targets(mode: Targets, texts: Tensor, embedded: Tensor) -> Tensor | None:
    """The targets of a text pair, (n, n), given numbers and embeddings of the texts.

    None is the diagonal.
    """
    if mode == "identical-text":
        return soft_targets(texts)
    if mode == "soft-text":
        return (embedded @ embedded.T / TEXT_TAU).softmax(dim=1).detach()
    return None


def info_nce(a: Tensor, b: Tensor, scale: Tensor | float, targets: Tensor | None = None) -> Tensor:
    """Symmetric InfoNCE of one pair of modalities.

    Args:
        a: (n, d), L2-normalized.
        b: (n, d), L2-normalized; row i belongs to row i of ``a``.
        scale: 1 / tau.
        targets: (n, n) with rows that sum to 1, or None for the diagonal (paper section 3).

    Returns:
        The scalar loss in nats; 0 of no rows.
    """
    if not len(a):
        return a.sum()
    logits = scale * a @ b.T
    target = torch.arange(len(a), device=a.device) if targets is None else targets
    return (cross_entropy(logits, target) + cross_entropy(logits.T, target)) / 2


def three_way(
    tactile: Tensor,
    text: Tensor | None,
    vision: Tensor | None,
    scale: Tensor | float,
    texts: Tensor,
    *,
    photos: Tensor | None = None,
    targets: Targets = "diagonal",
) -> tuple[Tensor, dict[str, Tensor]]:
    """The paper's loss over three pairs, in float32.

    Args:
        tactile: (n, d), L2-normalized.
        text: the same, or None for a vision encoder without text: the last pair alone.
        vision: the same, or None for data without photos: the first pair alone.
        scale: 1 / tau.
        texts: (n,) number of each row's caption.
        photos: (n,) whether the row has a photo; None: all have. Where it has none, its two vision
            pairs are left out.
        targets: see :data:`~palpate.encoders.presets.Targets`.

    Returns:
        The mean of the pairs that there are, and their losses by name.
    """
    with torch.autocast(tactile.device.type, enabled=False):
        tactile, losses = tactile.float(), dict[str, Tensor]()
        some = slice(None) if photos is None else photos.nonzero()[:, 0]
        if text is not None:
            text = text.float()
            soft = text_targets(targets, texts, text)
            losses["tactile_text"] = info_nce(tactile, text, scale, soft)
        if vision is not None:
            vision = vision.float()[some]
            if text is not None:
                soft = text_targets(targets, texts[some], text[some])
                losses["vision_text"] = info_nce(vision, text[some], scale, soft)
            losses["tactile_vision"] = info_nce(tactile[some], vision, scale)
        total = torch.stack([*losses.values()]).sum() / len(losses)
    return total, {name: loss.detach() for name, loss in losses.items()}


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
    parts = [
        checkpoint(encode, part, use_reentrant=False, preserve_rng_state=False)
        for part in inputs.split(chunk)
    ]
    return torch.cat(parts)
