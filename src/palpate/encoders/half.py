"""Weights in 16 bits: rounded in the model first, so that what is scored and digested is what is written.

IEEE 754 half precision has 11 significant bits, so a weight of normal size changes by at most 2^-11 = 4.9e-4 of itself; below 6.1e-5 the
spacing is a constant 6.0e-8, and from 65,520 on there is only infinity. Everything is computed in 32 bits; only the file is half as large.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import nn

from palpate.core import PalpateError

M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class Rounding:
    """What rounding to 16 bits changed.

    Attributes:
        relative: ``||after - before|| / ||before||`` of the tensor in which it is largest; 0 where nothing changed.
        where: the name of that tensor, empty where nothing changed.
        lost: weights that were not zero and are now.
    """

    relative: float = 0.0
    where: str = ""
    lost: int = 0


def round_to_half(modules: Mapping[str, nn.Module]) -> Rounding:
    """Rounds the floating-point weights of modules to float16 values, in place; their type stays.

    Args:
        modules: by name; the names stand before those of the tensors.

    Raises:
        PalpateError: if a weight is not finite in 16 bits; nothing is changed then.
    """
    before = {
        f"{part}.{name}": v
        for part, m in modules.items()
        for name, v in m.state_dict().items()
        if v.is_floating_point()
    }
    after = {name: value.half().to(value.dtype) for name, value in before.items()}
    for name, value in after.items():
        if not bool(torch.isfinite(value).all()):
            got = f"{name} with values up to {float(before[name].abs().max()):.3g}"
            raise PalpateError(
                "Weights saved in 16 bits must be finite and below 65,520 in size",
                got,
                "Save them in 32 bits",
            )
    worst, lost = Rounding(), 0
    with torch.no_grad():
        for name, value in before.items():
            change = float(
                (after[name] - value).double().norm()
                / value.double().norm().clamp_min(torch.finfo(torch.float64).tiny)
            )
            lost += int(((value != 0) & (after[name] == 0)).sum())
            worst = Rounding(change, name) if change > worst.relative else worst
            value.copy_(after[name])  # the tensors of state_dict are the module's own
    return Rounding(worst.relative, worst.where, lost)


def half_copy(module: M) -> M:
    """A copy whose floating-point weights are float16, to be written to a file."""
    return copy.deepcopy(module).half()
