"""Permutations of whole videos, paired differences, and copies of reference rows."""

import itertools

import numpy as np
import pytest
from scipy import stats

from palpate.core import Measure, Note, Score
from palpate.metrics import ci_tmmd, compare, four_scores, i_tmmd, tmmd
from palpate.metrics.intervals import Scored, permutation_test
from palpate.metrics.kernels import Gaussian, blocked_sums
from palpate.metrics.paired import difference, holm
from palpate.report.labels import label_of, subject_of
from test_metrics_mmd import loop_mmd, mmd2, unit_rows
from test_metrics_tactile import change, codes, keep, share, world

ESTIMATORS = ["unbiased", "biased", "grouped"]


def relabeled(x, label, unit, estimator):
    """TMMD of a relabeling by the loop over pairs, over its leave-one-unit-out standard error."""
    names, units = unit.astype(str), np.unique(unit)

    def value(keep):
        a, b = keep & ~label, keep & label
        return loop_mmd(x[a], x[b], estimator, list(names[a]), list(names[b]))

    out = np.array([value(unit != u) for u in units])
    error = np.sqrt((len(units) - 1) / len(units) * ((out - out.mean()) ** 2).sum())
    return value(np.ones(len(unit), bool)) / error, error


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("shared", [True, False])
def test_relabeling_items_is_relabeling_samples(estimator, shared):
    """Values of the test are those of the loop on some relabeling of units; all of these occur."""
    frames = np.repeat(np.arange(4), [3, 2, 2, 4])
    unit = np.r_[frames, frames] if shared else np.r_[frames, frames + 4][:18]
    label = np.r_[np.zeros(11, bool), np.ones(11, bool)][: len(unit)]
    x = unit_rows(3, len(unit), 4)
    sums = blocked_sums(x, label.astype(int), unit, segments=2, kernel=Gaussian())
    p, null, counts = permutation_test(sums, estimator, 1000.0, count=400, seed=1)
    allowed = set()
    units = np.unique(unit)
    if shared:
        assert (counts["swapped"], counts["dealt"]) == (4, 0)
        for flips in itertools.product([False, True], repeat=4):
            allowed.add(round(relabeled(x, label ^ np.array(flips)[unit], unit, estimator)[0], 6))
    else:
        assert (counts["swapped"], counts["dealt"]) == (0, len(units))
        second = len(np.unique(unit[label]))
        for chosen in itertools.combinations(units, second):
            allowed.add(round(relabeled(x, np.isin(unit, chosen), unit, estimator)[0], 6))
    observed, error = relabeled(x, label, unit, estimator)
    seen = {round(v / error, 6) for v in null}
    defined = {v for v in allowed if np.isfinite(v)}
    assert seen == defined or (seen <= defined and len(seen) > 0.8 * len(defined))
    assert p == pytest.approx(
        (1 + sum(v / error >= observed - 1e-9 for v in null)) / (1 + len(null))
    )


def test_the_test_sees_a_shift_and_keeps_quiet_without_one(monkeypatch):
    g, r = (
        world(0, classes=1, videos=12, frames=3, draw=1),
        world(0, classes=1, videos=12, frames=3),
    )
    quiet = tmmd(g, r)
    moved = g.features + 0.2
    loud = tmmd(change(g, features=moved / np.linalg.norm(moved, axis=1, keepdims=True)), r)
    assert quiet.details["p_value"] > 0.05
    assert loud.details["p_value"] == pytest.approx(1 / 1000)
    assert loud.details["permutations"] == {"count": 999, "swapped": 12, "dealt": 0, "seed": 0}
    assert quiet.null[0] < quiet.value < quiet.null[1] < loud.value
    assert tmmd(g, r, permutations=0).details["p_value"] is None
    assert tmmd(g, r, permutations=0).null is None
    assert tmmd(g, r, seed=1).details["p_value"] != quiet.details["p_value"]
    monkeypatch.setattr("palpate.metrics.kernels.MOST_ITEMS", 20)
    assert tmmd(g, r).details["p_value"] is None  # sums of items with items were not kept


def draw(rng, sizes, videos=None, shift=0.0):
    videos = rng.normal(size=(len(sizes), 6)) if videos is None else videos
    video = np.repeat(np.arange(len(sizes)), sizes)
    x = 0.4 * videos[video] + np.eye(6)[0] + 0.2 * rng.normal(size=(len(video), 6))
    x = x / np.linalg.norm(x, axis=1, keepdims=True) + shift * np.eye(6)[1]
    return x / np.linalg.norm(x, axis=1, keepdims=True), video, videos


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mine", "theirs", "paired", "shift", "low", "high"),
    [
        ([1] * 6, [12] * 24, False, 0.0, 0.0, 0.09),
        ([12] * 6, [2] * 24, False, 0.0, 0.01, 0.09),
        ([2] * 12, [15] * 12, True, 0.0, 0.01, 0.09),
        ([2] * 12, [15] * 12, True, 0.2, 0.8, 1.0),
    ],
)
def test_unequal_numbers_of_frames_do_no_harm(mine, theirs, paired, shift, low, high):
    """TMMD itself, not studentized, rejects true nulls in up to a third of such sets, or never."""
    rng, hits = np.random.default_rng(3), []
    for seed in range(200):
        x, g, videos = draw(rng, mine, shift=shift)
        y, h, _ = draw(rng, theirs, videos if paired else None)
        unit = np.r_[g, h if paired else h + 100]
        sums = blocked_sums(
            np.r_[x, y],
            np.repeat([0, 1], [len(x), len(y)]),
            unit,
            segments=2,
            kernel=Gaussian((2.0,)),
        )
        hits.append(permutation_test(sums, "grouped", 1000.0, count=99, seed=seed)[0] <= 0.05)
    assert low <= np.mean(hits) <= high


def test_nothing_to_exchange_is_no_test():
    s = world(0, classes=1, videos=3, frames=2)
    one = blocked_sums(
        s.features, np.zeros(6, int), np.arange(6) // 2, segments=2, kernel=Gaussian()
    )
    assert permutation_test(one, "unbiased", 1.0) is None


def shifted(s, by):
    x = s.features.copy()
    x[:, 0] += by
    return change(s, features=x / np.linalg.norm(x, axis=1, keepdims=True))


@pytest.fixture(scope="module")
def three():
    r = world(0, classes=3, videos=5, frames=4)
    near = world(0, classes=3, videos=5, frames=4, draw=1)
    return r, {
        "near": near,
        "far": shifted(world(0, classes=3, videos=5, frames=4, draw=2), 0.3),
        "mid": shifted(near, 0.1),
    }


def test_differences_are_the_jackknife_of_the_difference(three):
    r, generators = three
    found = compare(generators, r, floor=r)
    assert [s.a for s in found.scores[::6]] == ["near", "far", "mid"]
    for name, of in generators.items():
        single = four_scores(of, r, floor=r, subject=name)
        of_four = [s for s in found.scores if s.a == name and s.kind == "value"]
        assert of_four == single
    of_four = [d for d in found.differences if d.kind == "difference"]
    assert len(of_four) == 12
    groups = sorted(set(r.groups))
    for d in of_four:
        a, b = generators[d.a], generators[d.b]
        each = [
            {x.metric: x.value for x in four_scores(s, r, permutations=0)}[d.metric] for s in (a, b)
        ]
        assert d.value == pytest.approx(each[0] - each[1], abs=1e-12)
        if d.metric == "TMMD":
            out = [[keep(s, np.array(s.groups) != g) for s in (a, b, r)] for g in groups]
            gaps = np.array([tmmd(x, z).value - tmmd(y, z).value for x, y, z in out])
            error = np.sqrt((len(gaps) - 1) / len(gaps) * ((gaps - gaps.mean()) ** 2).sum())
            reach = stats.t.ppf(0.975, len(gaps) - 1) * error
            assert d.interval == pytest.approx((d.value - reach, d.value + reach), abs=1e-9)
            assert d.details["p_better"] == pytest.approx(
                stats.t.cdf(-d.value / error, len(gaps) - 1), abs=1e-9
            )
            assert d.interval_method == "paired leave-one-group-out jackknife, t, 14 df"
    first = found.differences[0]
    assert (subject_of(first), first.details["better"]) == ("near - far", "near")
    assert first.details["p_better"] > 0.99
    width = lambda s: s.interval[1] - s.interval[0]
    ci = [s for s in found.scores if s.measure == Measure("CI-TMMD")]
    paired = next(
        d for d in found.differences if (d.metric, d.a, d.b) == ("CI-TMMD", "near", "mid")
    )
    assert width(paired) < 0.5 * min(width(s) for s in ci)  # what the videos have in common is gone


def test_order_of_ids_does_not_matter(three):
    r, generators = three
    near, far = generators["near"], generators["far"]
    turned = far.take(list(far.ids)[::-1])
    assert compare({"a": near, "b": turned}, r).differences[0].value == pytest.approx(
        compare({"a": near, "b": far}, r).differences[0].value
    )
    assert compare({"a": near}, r).differences == []


def test_undefined_scores_have_no_difference(three):
    r, generators = three
    no_labels = {name: change(s, labels=None) for name, s in generators.items()}
    found = {label_of(d): d for d in compare(no_labels, r).differences}
    assert found["D-TMMD difference"].value is None
    assert codes(found["D-TMMD difference"]) == ["undefined:score"]
    same = compare({"a": generators["near"], "b": generators["near"]}, r).differences[0]
    assert (same.value, same.interval, same.details["better"]) == (0, None, None)


def test_without_a_reference_the_nearer_to_the_floor_is_better(three):
    r, generators = three
    near = generators["near"]
    center = near.features.mean(axis=0)
    x = 0.2 * near.features + 0.8 * center
    collapsed = change(near, features=x / np.linalg.norm(x, axis=1, keepdims=True))
    sets = {"collapsed": collapsed, "near": near}
    for d in compare(sets, r).differences[1:]:
        assert d.value < 0
        assert (
            d.details["better"],
            d.details["p_better"],
            d.details["decided"],
            d.higher_is_better,
        ) == (None, None, False, None)
        assert d.details["p_value"] is not None
    found = {label_of(d): d for d in compare(sets, r, floor=r).differences}
    one = found["I-TMMD difference"]
    assert one.value < 0  # lower, and worse
    assert one.details["better"] == "near"
    assert one.details["decided"]
    assert one.details["p_better"] < 0.01
    value = lambda s: i_tmmd(s).value
    assert one.details["gap"] == pytest.approx(
        abs(value(collapsed) - value(r)) - abs(value(near) - value(r)), abs=1e-9
    )
    low, high = one.details["gap_interval"]
    assert 0 < low < one.details["gap"] < high
    assert "gap" not in found["TMMD difference"].details


def test_holm_by_hand(three):
    r, generators = three
    found = compare(generators, r).differences[:3]
    p = [d.details["p_value"] for d in found]
    order = np.argsort(p)
    by_hand = np.maximum.accumulate(np.minimum(1, np.array(p)[order] * [3, 2, 1]))
    np.testing.assert_allclose(
        np.array([d.details["p_adjusted"] for d in holm(found)])[order], by_hand
    )


def test_copies_of_reference_rows_are_told():
    r = world(0, classes=2, videos=3, frames=3)
    x = world(0, classes=2, videos=3, frames=3, draw=1)
    features = x.features.copy()
    features[[2, 5]] = r.features[[7, 7]]
    score = tmmd(change(x, features=features), r)
    assert score.details["copies"] == 2
    assert score.notes[0] == Note("copied-rows", {"count": 2, "n": 18})
    assert tmmd(x, r).details["copies"] == 0
    assert not tmmd(x, r).notes


def test_one_bandwidth_for_all_generators(three):
    r, generators = three
    found = compare(generators, r, floor=r, sigma="median", permutations=0)
    assert len({s.bandwidth for s in found.scores}) == 1
    near = generators["near"]
    assert found.scores[0].value == pytest.approx(
        mmd2(
            near.features,
            r.features,
            sigma="median",
            estimator="grouped",
            groups_x=near.groups,
            groups_y=r.groups,
        )
    )
    several = compare(generators, r, sigma="multi", permutations=0).scores[0]
    assert several.bandwidth is None
    assert len(several.settings["sigmas"]) == 5


def test_the_excess_of_two_generators_is_compared_on_the_same_videos(three):
    r, generators = three
    near = generators["near"]
    center = near.features.mean(axis=0)
    x = 0.2 * near.features + 0.8 * center
    sets = {
        "collapsed": change(near, features=x / np.linalg.norm(x, axis=1, keepdims=True)),
        "near": near,
    }
    found = compare(sets, r, floor=r, permutations=0)
    metrics = ["TMMD", "I-TMMD", "I-TMMD E", "CI-TMMD", "CI-TMMD E", "D-TMMD"]
    assert [(label_of(s), s.a) for s in found.scores] == [(m, s) for s in sets for m in metrics]
    groups = sorted(set(r.groups))
    for metric, function in (("I-TMMD E", i_tmmd), ("CI-TMMD E", ci_tmmd)):
        value = lambda s: function(s).details["E"]  # noqa: B023
        score = {s.a: s for s in found.scores if label_of(s) == metric}
        for name, s in sets.items():
            assert score[name].value == pytest.approx(value(s))
            assert score[name].interval == pytest.approx(function(s).details["E_interval"])
            assert score[name].floor == pytest.approx(value(r))
        (d,) = (d for d in found.differences if label_of(d) == f"{metric} difference")
        a, b, floor = (value(s) for s in (*sets.values(), r))
        out = np.array(
            [[value(keep(s, np.array(s.groups) != g)) for s in (*sets.values(), r)] for g in groups]
        )
        for got, interval, values in (
            (d.value, d.interval, out[:, 0] - out[:, 1]),
            (
                d.details["gap"],
                d.details["gap_interval"],
                np.abs(out[:, 0] - out[:, 2]) - np.abs(out[:, 1] - out[:, 2]),
            ),
        ):
            reach = stats.t.ppf(0.975, 14) * np.sqrt(
                14 / 15 * ((values - values.mean()) ** 2).sum()
            )
            assert interval == pytest.approx((got - reach, got + reach), abs=1e-9)
        assert d.value == pytest.approx(a - b)
        assert d.details["gap"] == pytest.approx(abs(a - floor) - abs(b - floor))
        assert d.details["better"] == "near"
    bare = {name: change(s, groups=None) for name, s in sets.items()}
    scores = compare(bare, change(r, groups=None), permutations=0).scores
    assert not [s for s in scores if s.kind == "excess"]


def test_the_p_value_of_a_metric_without_direction_is_that_of_the_gap_to_the_floor(three):
    r, generators = three
    sets = {"near": generators["near"], "far": generators["far"]}
    d = {label_of(x): x for x in compare(sets, r, floor=r, permutations=0).differences}[
        "I-TMMD difference"
    ]
    groups = sorted(set(r.groups))
    value = lambda s: i_tmmd(s).value
    design = (
        i_tmmd(r).value / i_tmmd(r).details["E"]
    )  # what E is multiplied by; leaving out a video keeps it
    out = np.array(
        [
            [
                design * i_tmmd(keep(s, np.array(s.groups) != g)).details["E"]
                for s in (*sets.values(), r)
            ]
            for g in groups
        ]
    )
    for name, got, values in (
        (
            "p_value",
            d.details["gap"],
            np.abs(out[:, 0] - out[:, 2]) - np.abs(out[:, 1] - out[:, 2]),
        ),
        ("p_difference", value(sets["near"]) - value(sets["far"]), out[:, 0] - out[:, 1]),
    ):
        error = np.sqrt(14 / 15 * ((values - values.mean()) ** 2).sum())
        assert d.details[name] == pytest.approx(2 * stats.t.sf(abs(got) / error, 14), rel=1e-6)
    assert d.details["p_adjusted"] == d.details["p_value"]
    assert d.details["p_value"] == pytest.approx(
        2 * min(d.details["p_better"], 1 - d.details["p_better"])
    )
    bare = next(x for x in compare(sets, r, permutations=0).differences if x.metric == "I-TMMD")
    assert bare.details["p_value"] == pytest.approx(d.details["p_difference"])


def error_of(values):
    return np.sqrt((len(values) - 1) / len(values) * ((values - values.mean()) ** 2).sum())


def test_the_gap_is_recomputed_without_each_video_in_all_three_sets():
    """With videos of equal size the distance of two halves is E times a number of the set."""
    r, near = (
        world(0, classes=3, videos=5, frames=4),
        world(0, classes=3, videos=5, frames=4, draw=1),
    )
    x = 0.5 * near.features + 0.5 * near.features.mean(axis=0)
    sets = {
        "collapsed": change(near, features=x / np.linalg.norm(x, axis=1, keepdims=True)),
        "near": near,
    }
    found = {label_of(d): d for d in compare(sets, r, floor=r, permutations=0).differences}
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
