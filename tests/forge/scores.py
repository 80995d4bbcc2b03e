"""Sets and images that the tests of scoring share."""

import numpy as np
import pytest
from scipy import stats

from palpate.core import FeatureSet
from palpate.report.labels import label_of, subject_of

VIDEOS, FRAMES, DIM = 8, 6, 5
IDS = [f"v{v}/{k}" for v in range(VIDEOS) for k in range(FRAMES)]
GROUPS = [f"v{v}" for v in range(VIDEOS) for _ in range(FRAMES)]
LABELS = [["Wood", "Brick"][v % 2] for v in range(VIDEOS) for _ in range(FRAMES)]


def unit(x):
    """Rows of length 1, float32."""
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def features(seed: int, noise: float, shift: float) -> np.ndarray:
    """Features of the same 48 samples, with noise of their own."""
    rng = np.random.default_rng(0)
    real = 3 + np.repeat(rng.normal(size=(VIDEOS, DIM)), FRAMES, 0)
    real = real + 0.3 * rng.normal(size=(len(IDS), DIM))
    own = np.random.default_rng(seed)
    return unit(real + noise * own.normal(size=real.shape) + shift * own.normal(size=DIM))


def feature_sets() -> dict[str, FeatureSet]:
    """``real``, ``near`` and ``far``, with labels, groups and an encoder."""
    settings = {"real": (1, 0.1, 0), "near": (2, 0.2, 0.1), "far": (3, 0.5, 1.5)}
    return {n: FeatureSet(IDS, features(*s), LABELS, GROUPS, "e" * 64) for n, s in settings.items()}


def numbered(x, groups=None, encoder=None) -> FeatureSet:
    """Features of samples that are named by their numbers."""
    return FeatureSet([str(i) for i in range(len(x))], x, None, groups, encoder)


def by_key(results) -> dict:
    """Scores by (metric, subject, preset)."""
    return {(label_of(s), subject_of(s), s.settings.get("preset")): s for s in results}


def codes(results) -> list[str]:
    """Codes of the results' notes."""
    return [note.code for note in results.notes]


def jackknife(value, out, close=1e-9):
    """The standard error from the values without each unit, and the 95 % interval around one."""
    out = np.array(out)
    error = np.sqrt((len(out) - 1) / len(out) * ((out - out.mean()) ** 2).sum())
    reach = stats.t.ppf(0.975, len(out) - 1) * error
    return error, pytest.approx((value - reach, value + reach), abs=close)


def without_each(values):
    """The means without each value."""
    values = np.array(values)
    return (values.sum() - values) / (len(values) - 1)
