"""Randomness belongs to the sample: a draw depends on (seed, purpose, sample), never on order."""

from __future__ import annotations

import hashlib

import numpy as np


def seed_for(seed: int, *names: str | int) -> int:
    """Return a 63-bit seed that depends on ``seed`` and ``names`` alone, on every machine."""
    text = "\x1f".join([str(int(seed)), *map(str, names)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Return a NumPy generator for (seed, names), e.g. ``rng_for(0, "noise", sample_id)``."""
    return np.random.default_rng(seed_for(seed, *names))
