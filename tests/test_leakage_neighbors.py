"""Nearest neighbors against brute force in float64."""

import numpy as np
import pytest

from palpate.leakage.neighbors import nearest, other_nearest


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


def test_rows_of_the_same_group_are_no_neighbors_and_an_unknown_group_excludes_nothing():
    rng = np.random.default_rng(3)
    x, y = unit(rng, 60), unit(rng, 80)
    of_x, of_y = rng.integers(-1, 4, 60), rng.integers(-1, 4, 80)
    index = nearest(x, y, 3, groups=(of_x, of_y))
    excluded = (of_x[:, None] == of_y) & (of_x[:, None] >= 0)
    np.testing.assert_array_equal(index, brute(x, y, 3, excluded))
    everything = nearest(x, y, 1, groups=(np.zeros(60, int), np.zeros(80, int)))
    assert (everything == -1).all()


def test_a_row_is_no_neighbor_of_itself_even_among_equal_rows():
    x = unit(np.random.default_rng(4), 50)
    expected = brute(x, x, 4, np.eye(50, dtype=bool))
    np.testing.assert_array_equal(other_nearest(x, 4), expected)
    equal = np.repeat(x[:2], 20, axis=0)
    index = other_nearest(equal, 3)
    assert (index != np.arange(40)[:, None]).all()
    assert (index // 20 == np.arange(40)[:, None] // 20).all()
