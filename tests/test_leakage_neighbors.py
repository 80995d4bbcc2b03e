"""Nearest neighbors against brute force in float64."""

import numpy as np
import pytest

from palpate.leakage import neighbors
from palpate.leakage.neighbors import Apart, nearest


def unit(rng, n, d=24):
    x = rng.normal(size=(n, d)) / np.arange(1, d + 1)
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def brute(x, y, k, excluded):
    distance = np.linalg.norm(x[:, None].astype(float) - y[None], axis=2)
    distance[excluded] = np.inf
    index = np.argsort(distance, axis=1, kind="stable")[:, :k]
    index = np.where(np.isfinite(np.take_along_axis(distance, index, axis=1)), index, -1)
    return np.pad(index, ((0, 0), (0, k - index.shape[1])), constant_values=-1)


@pytest.mark.parametrize("k", [1, 5])
@pytest.mark.parametrize("sizes", [(40, 300), (7, 3), (3, 0), (0, 5)])
def test_the_nearest_rows_are_those_of_brute_force(k, sizes):
    rng = np.random.default_rng(k)
    x, y = unit(rng, sizes[0]), unit(rng, sizes[1])
    expected = brute(x, y, k, np.zeros((len(x), len(y)), bool))
    np.testing.assert_array_equal(nearest(x, y, k), expected)


@pytest.mark.parametrize("most", [1, 100])
@pytest.mark.parametrize("videos", [4, 9])
def test_related_rows_are_no_neighbors(monkeypatch, videos, most):
    """Few of them or many."""
    monkeypatch.setattr(neighbors, "MOST", most)
    rng = np.random.default_rng(videos)
    x, y = unit(rng, 60), unit(rng, 80)
    of_x, of_y = rng.integers(0, videos, 60), rng.integers(0, videos, 80)
    index = nearest(x, y, 4, apart=Apart(of_x, of_y))
    np.testing.assert_array_equal(index, brute(x, y, 4, of_x[:, None] == of_y))
    assert (nearest(x, y, 1, apart=Apart(np.zeros(60, int), np.zeros(80, int))) == -1).all()
    turning = rng.normal(size=(60, 24)).cumsum(axis=0)  # the nearest are those next in time
    x = (turning / np.linalg.norm(turning, axis=1, keepdims=True)).astype(np.float32)
    index = nearest(x, x, 4, apart=Apart(np.arange(60), np.arange(60), 5))
    away = np.abs(np.arange(60)[:, None] - np.arange(60))
    np.testing.assert_array_equal(index, brute(x, x, 4, away <= 5))
