"""The random numbers of a step.

They depend on (seed, step) and on the position in the *global* batch: each of several processes
draws the numbers of the whole batch and keeps those of its own rows, so N processes take the steps
of one.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from palpate.core import seed_for


class Step:
    """One step of one process: its rows, and its random numbers.

    Attributes:
        number: from 0.
        all_rows: of the global batch, (batch,).
        rows: those of this process.
    """

    def __init__(
        self, number: int, rows: NDArray[np.int64], seed: int, part: tuple[int, int] = (0, 1)
    ) -> None:
        """Take the global batch, and as ``part`` this process's place among how many."""
        size = len(rows) // part[1]
        self.number, self.all_rows = number, rows
        self.mine = slice(part[0] * size, (part[0] + 1) * size)
        self.rows = rows[self.mine]
        self.generator = torch.Generator().manual_seed(seed_for(seed, "step", number))

    def rand(self, *shape: int) -> Tensor:
        """Uniform numbers in [0, 1), (rows, *shape)."""
        return torch.rand(len(self.all_rows), *shape, generator=self.generator)[self.mine]

    def randn(self, *shape: int) -> Tensor:
        """Standard normal numbers, (rows, *shape)."""
        return torch.randn(len(self.all_rows), *shape, generator=self.generator)[self.mine]

    def randint(self, high: int, *shape: int) -> Tensor:
        """Integers from 0 to ``high - 1``, (rows, *shape)."""
        size = (len(self.all_rows), *shape)
        return torch.randint(0, high, size, generator=self.generator)[self.mine]


@contextmanager
def seeded(seed: int, purpose: str) -> Generator[None]:
    """Seed torch's CPU generator by (seed, purpose) inside and restore it afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(seed, purpose))
        yield
