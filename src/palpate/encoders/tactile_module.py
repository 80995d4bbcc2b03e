"""What a tactile encoder of one file is: a module, and the format that it is recognized by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn.functional import normalize

from palpate.data.images import Preprocess
from palpate.encoders.models import Origin

State = Mapping[str, Tensor]


@dataclass(frozen=True)
class Format(Origin):
    """An encoder that is recognized by the names of its weights.

    Attributes:
        prefix: of the names of its weights; others are not read. '' reads all.
        signature: a name after the prefix by which it is recognized.
        build: makes the module for given weights.
    """

    prefix: str
    signature: str
    build: Callable[[State], TactileModule]


class TactileModule(nn.Module):
    """A frozen tactile encoder in one file: ``(pixels, sensors) -> (n, dim)``, not normalized.

    Attributes:
        dim: width of the features.
        preprocess: for its images.
        format: whose it is.
    """

    dim: int
    preprocess: Preprocess
    format: Format

    def encode(self, pixels: Tensor, sensors: Sequence[str] | None = None) -> Tensor:
        """Prepared pixels (n, channels, h, w), and names of sensors, to (n, dim), L2-normalized."""
        return normalize(self(pixels), dim=-1)
