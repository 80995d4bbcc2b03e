"""Precision, recall, density and coverage against whole matrices; ties, groups, bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forge.scores import numbered as features
from palpate.core import Note, Score
from palpate.metrics import distributions, prdc
from palpate.metrics.intervals import spread_of_values

NAMES = ["Precision", "Recall", "Density", "Coverage"]


def by_matrices(generated, real, k, unit_g=None, unit_r=None):
    """Rows of all four from whole matrices of distances and sorted rows of other units."""

    def distances(a, b):
        return np.sqrt(((a[:, None].astype(np.float64) - b[None]) ** 2).sum(axis=2))

    def radii(a, unit):
        unit = np.arange(len(a)) if unit is None else np.asarray(unit)
        return np.array(
            [np.sort(distances(a[[i]], a)[0][unit != unit[i]])[k - 1] for i in range(len(a))]
        )

    between = distances(real, generated)
    in_real = between < radii(real, unit_r)[:, None]
    in_generated = between < radii(generated, unit_g)[None]
    precision, density, coverage = in_real.any(axis=0), in_real.sum(axis=0) / k, in_real.any(axis=1)
    return precision, in_generated.any(axis=1), density, coverage


@settings(max_examples=40)
@given(
    n=st.integers(8, 40),
    m=st.integers(8, 40),
    d=st.integers(1, 6),
    k=st.integers(1, 6),
    seed=st.integers(0, 99),
    block=st.sampled_from([1, 100, 1 << 23]),
    far=st.sampled_from([0.0, 1000.0]),
)
def test_all_four_are_those_of_the_matrices(n, m, d, k, seed, block, far):
    rng = np.random.default_rng(seed)
    x, y = 1.3 * rng.normal(size=(n, d)) + far, rng.normal(size=(m, d)) + far
    old, distributions.BLOCK = distributions.BLOCK, block
    try:
        scores = prdc(features(x), features(y), k)
    finally:
        distributions.BLOCK = old
    assert [s.metric for s in scores] == NAMES
    for score, rows in zip(scores, by_matrices(x, y, k), strict=True):
        assert score.value == pytest.approx(rows.mean(), abs=1e-12)
        assert (score.n, score.m, score.higher_is_better) == (n, m, True)
        assert score.interval == (expected_interval(score.metric, rows, None))


def expected_interval(metric, rows, groups):
    interval = spread_of_values(rows.astype(np.float64), groups).interval()
    most = np.inf if metric == "Density" else 1.0
    return interval and (max(0.0, interval[0]), min(most, interval[1]))


def test_the_values_of_the_package_prdc():
    """Its rule: the (k+1)-th smallest of a row with itself in it, strictly nearer."""
    rng = np.random.default_rng(1)
    x, y, k = rng.normal(size=(120, 5)), 0.7 * rng.normal(size=(90, 5)), 5
    gap = lambda a, b: np.linalg.norm(a[:, None] - b[None], axis=2)
    kth = lambda a: np.partition(gap(a, a), k, axis=1)[:, k]
    between, real, made = gap(y, x), kth(y), kth(x)
    inside = between < real[:, None]
    expect = [inside.any(axis=0).mean(), (between < made[None]).any(axis=1).mean()]
    expect += [inside.sum(axis=0).mean() / k, (between.min(axis=1) < real).mean()]
    scores = prdc(features(x), features(y), k, grouped=False)
    assert [s.value for s in scores] == pytest.approx(expect, abs=1e-12)


@pytest.mark.parametrize("block", [100, 1 << 23])
def test_grouped_radii_skip_the_same_group(block, monkeypatch):
    monkeypatch.setattr(distributions, "BLOCK", block)
    rng = np.random.default_rng(2)
    a, b = [f"v{i // 5}" for i in range(40)], [f"w{i // 6}" for i in range(48)]
    centers = rng.normal(size=(8, 3))
    x, y = (
        np.repeat(centers, 5, axis=0) + 0.05 * rng.normal(size=(40, 3)),
        np.repeat(rng.normal(size=(8, 3)), 6, axis=0),
    )
    y = y + 0.05 * rng.normal(size=(48, 3))
    for score, rows, groups in zip(
        prdc(features(x, a), features(y, b), 3),
        by_matrices(x, y, 3, a, b),
        [a, b, a, b],
        strict=True,
    ):
        assert score.value == pytest.approx(rows.mean(), abs=1e-12)
        assert score.settings["grouped"] is True
        assert score.interval == (expected_interval(score.metric, rows, groups))
    # The default holds where both have groups alone.
    assert [s.settings["grouped"] for s in prdc(features(x, a), features(y), 3)] == [False] * 4
    plain = prdc(features(x, a), features(y, b), 3, grouped=False)
    assert [s.value for s in plain] == pytest.approx(
        [r.mean() for r in by_matrices(x, y, 3)], abs=1e-12
    )
    assert plain[0].interval == expected_interval("Precision", by_matrices(x, y, 3)[0], a)


def test_as_many_rows_outside_a_group_as_neighbors_are_enough():
    x, groups = np.random.default_rng(6).normal(size=(6, 3)), list("aaabbb")
    scores = prdc(features(x, groups), features(x + 1, groups), 3)
    for score, rows in zip(scores, by_matrices(x, x + 1, 3, groups, groups), strict=True):
        assert score.value == pytest.approx(rows.mean())


def test_without_groups_the_radii_measure_the_frame_rate():
    """Other videos against videos: the more frames, the worse they score without groups."""
    rng = np.random.default_rng(3)

    def videos(frames):
        centers = rng.normal(size=(40, 2))
        return (centers[:, None] + 0.02 * rng.normal(size=(40, frames, 2))).reshape(-1, 2), [
            f"{i // frames}" for i in range(40 * frames)
        ]

    for frames in (8, 20):
        (x, a), (y, b) = videos(frames), videos(frames)
        sets = features(x, a), features(y, b)
        assert prdc(*sets)[0].value > 0.7
        assert prdc(*sets, grouped=False)[0].value < 0.3


def test_equal_rows_are_ties_whatever_the_block(monkeypatch):
    rng = np.random.default_rng(4)
    base = rng.normal(size=(6, 7)).astype(np.float32)
    y = np.repeat(base, 4, axis=0)  # 4 copies: the third neighbor is at 0
    for block in [1, 60, 1 << 23]:
        monkeypatch.setattr(distributions, "BLOCK", block)
        scores = prdc(features(y), features(y), 3)
        assert [s.value for s in scores] == [0, 0, 0, 0]
        assert scores[0].details["empty_balls"] == 24
        notes = {note.code: note.params for note in scores[0].notes}
        assert notes["empty-balls"] == {"count": 24, "n": 24, "of": "real"}
        assert notes["copied-rows"] == {"count": 24, "n": 24}
        four = prdc(features(y), features(y), 4)
        assert [s.value for s in four] == [1, 1, 1, 1]  # 4 copies in a ball of k = 4
    # A generated sample exactly at the radius is outside.
    line = np.arange(5.0)[:, None]
    assert prdc(features(np.array([[5.0], [50.0], [60.0]])), features(line), 1)[0].value == 0


def test_the_same_set_is_inside_itself_and_a_far_one_is_not():
    rng = np.random.default_rng(5)
    x = rng.normal(size=(50, 4)).astype(np.float32)
    assert [s.value for s in prdc(features(x), features(x))] == [1, 1, 1, 1]
    far = prdc(features(x), features(x + 100))
    assert [s.value for s in far] == [0, 0, 0, 0]
    assert far[0].interval is None
    assert far[0].notes[-1] == Note("no-interval-over-groups")
    assert Score.from_json(far[2].to_json()) == far[2]


@pytest.mark.parametrize("factor", [2.0**-24, 2.0**24])
def test_the_scale_of_the_features_changes_nothing(factor):
    """Ties are a share of the squared norms; a power of two is no rounding."""
    x, y = np.random.default_rng(6).normal(size=(2, 40, 3))
    scaled = prdc(features(factor * x), features(factor * y))
    assert [s.value for s in scaled] == [s.value for s in prdc(features(x), features(y))]
    assert [s.details["empty_balls"] for s in scaled] == [0] * 4


@pytest.mark.parametrize("seed", range(12, 22))
def test_a_row_exactly_at_the_radius_is_outside_whichever_way_its_norm_is_rounded(seed):
    """q is as far from the origin as p, the radius of the ball there, its numbers permuted.

    The origin is the center of all rows, so that all rounding is that of |q|^2 and of |p|^2.
    """
    p = np.random.default_rng(seed).normal(size=9)
    q = np.roll(p, 1) * np.resize([1, -1], 9)
    assert min((p - q) @ (p - q), (p + q) @ (p + q)) > 1.1 * p @ p  # in no other ball either
    ball, points = features(np.array([0 * p, p, -p])), features(np.array([q, -q]))
    assert prdc(points, ball, 1)[0].value == 0  # no generated row inside a real ball
    assert prdc(points, ball, 1)[2].value == 0
    assert prdc(ball, points, 1)[1].value == 0  # and no real row inside a generated one
