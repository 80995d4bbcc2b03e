"""Who is ahead: the gap to a floor that is left out along with the generators, and metrics of either direction."""

import numpy as np
import pytest
from scipy import stats

from palpate.core import Score
from palpate.metrics import ci_tmmd, compare, i_tmmd
from palpate.metrics.paired import difference
from palpate.metrics.scored import Scored
from test_metrics_tactile import change, keep, share, world


def error_of(values):
    return np.sqrt((len(values) - 1) / len(values) * ((values - values.mean()) ** 2).sum())


def test_the_gap_is_recomputed_without_each_video_in_all_three_sets():
    """Videos of equal size: the distance of two halves is E times a number of the whole set, with and without a video."""
    r, near = (
        world(0, classes=3, videos=5, frames=4),
        world(0, classes=3, videos=5, frames=4, draw=1),
    )
    x = 0.5 * near.features + 0.5 * near.features.mean(axis=0)
    sets = {
        "collapsed": change(near, features=x / np.linalg.norm(x, axis=1, keepdims=True)),
        "near": near,
    }
    found = {d.metric: d for d in compare(sets, r, floor=r, permutations=0).differences}
    groups, gaps = np.array(r.groups), {}
    for metric, function, factor in (
        ("I-TMMD", i_tmmd, share(r)),
        ("CI-TMMD", ci_tmmd, share(r, "m0")),
    ):
        a, b, floor = (
            factor
            * np.array([function(keep(s, groups != v)).details["E"] for v in sorted(set(groups))])
            for s in (*sets.values(), r)
        )
        whole = [function(s).value for s in (*sets.values(), r)]
        value = abs(whole[0] - whole[2]) - abs(whole[1] - whole[2])
        error, d = error_of(np.abs(a - floor) - np.abs(b - floor)), found[f"{metric} difference"]
        reach = stats.t.ppf(0.975, 14) * error
        assert d.details["gap"] == pytest.approx(value, abs=1e-9)
        assert d.details["gap_interval"] == pytest.approx((value - reach, value + reach), abs=1e-9)
        assert d.details["p_better"] == pytest.approx(stats.t.cdf(-value / error, 14), abs=1e-9)
        still = error_of(np.abs(a - whole[2]) - np.abs(b - whole[2]))
        gaps[metric] = abs(still / error - 1)
    assert min(gaps.values()) > 0.1  # with a floor that stays as it is the error is another


@pytest.mark.parametrize(("higher", "better", "sign"), [(True, "a", 1), (False, "b", -1)])
def test_the_better_of_two_follows_the_direction_of_the_metric(higher, better, sign):
    replicates = np.array([0.82, 0.78, 0.81, 0.80]), np.array([0.70, 0.72, 0.69, 0.71])
    units, details = ["p", "q", "r", "s"], {"unit": "group"}
    one, two = (
        Scored(Score("SSIM", name, value, higher_is_better=higher, details=details), rows, units)
        for name, value, rows in (("a", 0.80, replicates[0]), ("b", 0.70, replicates[1]))
    )
    error = error_of(replicates[0] - replicates[1])
    ahead = stats.t.cdf(sign * 0.1 / error, 3)
    found, turned = difference(one, two), difference(two, one)
    assert (found.details["better"], turned.details["better"]) == (better, better)
    assert found.details["p_better"] == pytest.approx(ahead, abs=1e-12)
    assert turned.details["p_better"] == pytest.approx(1 - ahead, abs=1e-12)
    assert found.details["p_value"] == pytest.approx(2 * stats.t.cdf(-0.1 / error, 3))
    assert (ahead > 0.5) == higher
    reach = stats.t.ppf(0.975, 3) * error
    assert found.interval == pytest.approx((0.1 - reach, 0.1 + reach))
    assert found.details["decided"] == (reach < 0.1)
