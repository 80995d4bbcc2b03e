"""FID against the definition at every rank; intervals, bad input."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg, stats

from forge.scores import codes, jackknife
from forge.scores import numbered as features
from palpate.core import FeatureSet, Note, Score
from palpate.metrics import blocks
from palpate.metrics.distributions import compare_fid, fid


def definition(x, y):
    """Covariances in full; the root by the eigenvalues of their product, real but for rounding."""
    x, y = x.astype(np.float64), y.astype(np.float64)
    one, two = np.cov(x.T).reshape(x.shape[1], -1), np.cov(y.T).reshape(y.shape[1], -1)
    values = linalg.eigvals(one @ two).real
    roots = np.sqrt(np.where(values > 1e-12 * np.abs(values).max(), values, 0)).sum()
    return (
        ((x.mean(axis=0) - y.mean(axis=0)) ** 2).sum() + np.trace(one) + np.trace(two) - 2 * roots
    )


@settings(max_examples=40)
@given(
    n=st.integers(2, 40),
    m=st.integers(2, 40),
    d=st.integers(1, 20),
    seed=st.integers(0, 99),
    shift=st.sampled_from([0.0, 3.0, 100.0]),
)
def test_fid_is_the_definition_at_every_rank(n, m, d, seed, shift):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(n, d)) @ rng.normal(size=(d, d)) + shift, 2 * rng.normal(size=(m, d))
    score = fid(features(x), features(y))
    scale = (
        shift**2 * d + np.trace(np.atleast_2d(np.cov(x.T))) + np.trace(np.atleast_2d(np.cov(y.T)))
    )
    assert score.value == pytest.approx(definition(x, y), abs=1e-6 * scale)
    assert score.value >= 0
    assert ("fid-mostly-bias" in codes(score)) == (min(n, m) <= d)


def test_singular_covariances_are_never_complex():
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(12, 64)), rng.normal(size=(300, 64))
    y[:, 7] = 0.5  # a dead feature
    score = fid(features(x), features(y))
    assert score.value == pytest.approx(definition(x, y), rel=1e-7)
    assert fid(features(y), features(y)).value == pytest.approx(0, abs=1e-9)


def test_float32_and_a_common_mean_far_away_cost_nothing():
    rng = np.random.default_rng(4)
    x = rng.normal(size=(400, 6)).astype(np.float32)
    y = (1.1 * rng.normal(size=(500, 6))).astype(np.float32)
    near = fid(features(x), features(y)).value
    far = fid(features(x.astype(np.float64) + 1e6), features(y.astype(np.float64) + 1e6)).value
    assert near == pytest.approx(definition(x, y), rel=1e-10)
    assert far == pytest.approx(near, rel=1e-6)


@pytest.mark.parametrize("width", [3, 40])
def test_the_interval_is_the_leave_one_group_out_jackknife_over_both_sets(width):
    rng = np.random.default_rng(6)
    x, y = rng.normal(size=(60, width)), 1.5 * rng.normal(size=(48, width))
    a, b = [f"v{i % 7}" for i in range(60)], [f"v{i % 6}" for i in range(48)]
    score = fid(features(x, a), features(y, b))
    names = sorted({*a, *b})
    out = [definition(x[np.array(a) != g], y[np.array(b) != g]) for g in names]
    assert score.interval == jackknife(score.value, out, close=1e-6 * score.value)[1]
    assert score.interval_method == "leave-one-group-out jackknife, t, 6 df"
    assert (score.details["units"], score.details["unit"]) == (7, "group")


def test_many_groups_are_left_out_in_blocks_of_whole_groups_of_about_equal_size():
    rng = np.random.default_rng(7)
    x = rng.normal(size=(400, 3))
    groups = [f"v{int(g)}" for g in np.sort(rng.integers(0, 50, 400))]
    parts = blocks.draw_blocks(400, 400, [groups, groups], 0)
    assert len(parts.names) == 20
    assert all(
        len({int(parts.x[i]) for i in range(400) if groups[i] == g}) == 1 for g in set(groups)
    )
    sizes = np.bincount(parts.x)
    assert len(sizes) == 20
    assert sizes.max() - sizes.min() <= 10
    score = fid(features(x, groups), features(1.2 * x[::-1], groups))
    assert (
        f"19 df, random blocks of whole groups ({len(set(groups))} groups)" in score.interval_method
    )
    again = fid(features(x, groups), features(1.2 * x[::-1], groups))
    assert score == again
    assert Score.from_json(score.to_json()) == score


def test_intervals_over_rows_say_so_and_one_unit_gives_none():
    one, two = np.random.default_rng(8).normal(size=(2, 90, 3))
    video = ["v"] * 90
    for n, a, b in [(90, None, None), (90, video, None), (2, None, None), (90, video, video)]:
        score = fid(features(one[:n], a), features(two[:n], b))
        if n == 90 and b is None:
            assert score.interval is not None
            assert "rows, taken as independent" in score.interval_method
        else:  # one row is left, or none
            assert (score.interval, score.interval_method) == (None, "")
            assert "no-interval-few-units" in codes(score)


@pytest.mark.slow
def test_the_interval_covers_what_is_expected_at_this_size():
    """Groups deviate as a whole: intervals over groups hold the mean, those over rows do not."""
    rng = np.random.default_rng(11)
    by_group, by_row, values = [], [], []
    for draw in range(300):
        sets = [
            (s * (rng.normal(size=(30, 1, 3)) + 0.7 * rng.normal(size=(30, 10, 3))) + mu).reshape(
                -1, 3
            )
            for s, mu in ((1, 0.0), (1.3, 1.0))
        ]
        names = [[f"{s}{i // 10}" for i in range(300)] for s in "ab"]
        score = fid(features(sets[0], names[0]), features(sets[1], names[1]))
        values.append(score.value)
        by_group.append(score.interval)
        if draw % 3 == 0:
            by_row.append(fid(features(sets[0]), features(sets[1])).interval)
    cover = [
        np.mean([low <= np.mean(values) <= high for low, high in found])
        for found in (by_group, by_row)
    ]
    assert 0.90 <= cover[0] <= 0.99
    assert cover[1] < 0.7


def test_half_precision_is_widened_and_copies_are_counted():
    rng = np.random.default_rng(13)
    x, y = rng.normal(size=(2, 50, 4)).astype(np.float16)
    with pytest.warns(UserWarning, match="float16 features were widened"):
        score = fid(features(x), features(y))
    assert score.value == pytest.approx(definition(x, y), rel=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        half = np.asfortranarray(x.astype(np.float32))[::2]
        strided = fid(features(half), features(y.astype(np.float32)[::-1]))
    assert strided.value == pytest.approx(definition(x[::2], y), rel=1e-6)
    both = np.concatenate([y[:3], x]).astype(np.float32)
    score = fid(features(both), features(y.astype(np.float32)))
    assert Note("copied-rows", {"count": 3, "n": 53}) in score.notes


def trio(n=84, width=3, videos=7, seed=9):
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(n, width))
    return 1.4 * rng.normal(size=(n, width)), 1.1 * y + 0.3, y, [f"v{i % videos}" for i in range(n)]


@pytest.mark.parametrize("width", [3, 90])
def test_the_difference_of_two_fids_is_left_one_out_as_a_whole(width):
    x, z, y, groups = trio(width=width)
    found = compare_fid({"a": features(x, groups), "b": features(z, groups)}, features(y, groups))
    real = features(y, groups)
    singles = [fid(features(v, groups), real, subject=n) for n, v in (("a", x), ("b", z))]
    assert found.scores == singles
    (one,) = found.differences
    kept = [np.array(groups) != f"v{k}" for k in range(7)]
    out = [definition(x[k], y[k]) - definition(z[k], y[k]) for k in kept]
    value = definition(x, y) - definition(z, y)
    error, interval = jackknife(value, out, close=1e-5)
    assert one.value == pytest.approx(value, rel=1e-6)
    assert one.interval == interval
    assert one.details["p_better"] == pytest.approx(stats.t.cdf(-value / error, 6), rel=1e-4)
    assert one.details["better"] == ("b" if value > 0 else "a")
    assert one.interval_method == "paired leave-one-group-out jackknife, t, 6 df"
    assert codes(one) == ["fid-difference-biased"]


def test_paired_fids_share_their_blocks_and_the_order_of_rows_does_not_matter():
    x, z, y, _ = trio(n=240, seed=10)
    groups, order = [f"v{i % 60}" for i in range(240)], np.random.default_rng(0).permutation(240)
    ids = [str(i) for i in range(240)]
    one, real = FeatureSet(ids, x, None, groups), FeatureSet(ids, y, None, groups)
    here = compare_fid({"a": one, "b": FeatureSet(ids, z, None, groups)}, real)
    other = FeatureSet([ids[i] for i in order], z[order], None, [groups[i] for i in order])
    there = compare_fid({"a": one, "b": other}, real)
    assert here.differences[0].value == pytest.approx(there.differences[0].value)
    assert here.differences[0].interval == pytest.approx(there.differences[0].interval)
    assert here.differences[0].interval_method == "paired leave-one-block-out jackknife, t, 19 df"
    same = compare_fid({"a": one, "b": one}, real).differences[0]
    assert (same.value, same.interval, same.details["better"]) == (0, None, None)


@pytest.mark.slow
def test_intervals_of_paired_fids_cover_the_expected_difference_over_videos():
    """Frames of a video share a draw; the truth is the mean difference at this size."""
    rng, videos, frames, width, replicates = np.random.default_rng(11), 20, 6, 4, 300
    groups = [f"v{i // frames}" for i in range(videos * frames)]
    differences = []
    for _ in range(replicates):
        shared, mine, yours = (
            np.repeat(rng.normal(size=(videos, width)), frames, axis=0) for _ in range(3)
        )
        noise = lambda: 0.5 * rng.normal(size=(videos * frames, width))
        sets = {
            "a": features(shared + 0.6 * mine + noise(), groups),
            "b": features(1.2 * shared + 0.4 * yours + noise() + 0.2, groups),
        }
        differences.append(compare_fid(sets, features(shared + noise(), groups)).differences[0])
    truth = np.mean([d.value for d in differences])
    covered = np.mean([d.interval[0] <= truth <= d.interval[1] for d in differences])
    assert 0.92 <= covered <= 0.99
