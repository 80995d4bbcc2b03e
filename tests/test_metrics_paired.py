"""Permutations of whole videos, paired differences, and copies of reference rows."""

import itertools

import numpy as np
import pytest
from scipy import stats

from forge.scores import jackknife
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

    error, _ = jackknife(0.0, [value(unit != u) for u in units])
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


def collapsed(s):
    """The set drawn together to a fifth of its spread."""
    x = 0.2 * s.features + 0.8 * s.features.mean(axis=0)
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
            error, interval = jackknife(d.value, gaps)
            assert d.interval == interval
            p_better = stats.t.cdf(-d.value / error, 14)
            assert d.details["p_better"] == pytest.approx(p_better, abs=1e-9)
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
    near, drawn = generators["near"], collapsed(generators["near"])
    sets = {"collapsed": drawn, "near": near}
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
            groups=near.groups,
            reference_groups=r.groups,
        )
    )
    several = compare(generators, r, sigma="multi", permutations=0).scores[0]
    assert several.bandwidth is None
    assert len(several.settings["sigmas"]) == 5


@pytest.mark.parametrize("kind", ["difference", "excess"])
@pytest.mark.parametrize("function", [i_tmmd, ci_tmmd])
def test_differences_without_a_reference_lose_a_video_of_all_three_sets(three, function, kind):
    """Of dist^2 between halves and of E; with videos of equal size the one is a multiple of the
    other that the sizes of the set give.
    """
    r, generators = three
    sets = {"collapsed": collapsed(generators["near"]), "near": generators["near"], "real": r}
    metric, whole_set = function(r).metric, function is i_tmmd
    factor = 1 if kind == "excess" else share(r, None if whole_set else "m0")
    value = lambda s: factor * function(s).details["E"]
    each = np.array([value(s) for s in sets.values()])
    groups = np.array(r.groups)
    out = np.array(
        [[value(keep(s, groups != v)) for s in sets.values()] for v in sorted(set(groups))]
    )
    compared = compare({n: sets[n] for n in ("collapsed", "near")}, r, floor=r, permutations=0)
    (d,) = (d for d in compared.differences if (d.metric, d.kind) == (metric, kind))
    difference = each[0] - each[1]
    error, interval = jackknife(difference, out[:, 0] - out[:, 1])
    p_difference = 2 * stats.t.sf(abs(difference) / error, 14)
    assert (d.value, d.interval) == (pytest.approx(difference, abs=1e-9), interval)
    assert d.details["p_difference"] == pytest.approx(p_difference, rel=1e-6)
    far = lambda v, floor: np.abs(v[..., 0] - floor) - np.abs(v[..., 1] - floor)
    gap = far(each, each[2])
    error, interval = jackknife(gap, far(out, out[:, 2]))
    assert (d.details["gap"], d.details["gap_interval"]) == (pytest.approx(gap, abs=1e-9), interval)
    assert d.details["p_better"] == pytest.approx(stats.t.cdf(-gap / error, 14), abs=1e-9)
    p_value = 2 * min(d.details["p_better"], 1 - d.details["p_better"])
    assert d.details["p_value"] == d.details["p_adjusted"] == pytest.approx(p_value)
    assert d.details["better"] == "near"
    still, _ = jackknife(gap, far(out, each[2]))
    assert abs(still / error - 1) > 0.1  # with a floor that stays as it is the error is another
    bare = compare({n: sets[n] for n in ("collapsed", "near")}, r, permutations=0).differences
    (d,) = (d for d in bare if (d.metric, d.kind) == (metric, kind))
    assert d.details["p_value"] == pytest.approx(p_difference)
    if kind == "excess":
        for score in (s for s in compared.scores if (s.metric, s.kind) == (metric, kind)):
            details = function(sets[score.a]).details
            assert score.value == pytest.approx(details["E"])
            assert score.interval == pytest.approx(details["E_interval"])
            assert score.floor == pytest.approx(each[2])


def test_scores_of_excess_follow_their_metric_where_there_are_groups(three):
    r, generators = three
    metrics = ["TMMD", "I-TMMD", "I-TMMD E", "CI-TMMD", "CI-TMMD E", "D-TMMD"]
    scores = compare(generators, r, permutations=0).scores
    assert [(label_of(s), s.a) for s in scores] == [(m, s) for s in generators for m in metrics]
    bare = {name: change(s, groups=None) for name, s in generators.items()}
    scores = compare(bare, change(r, groups=None), permutations=0).scores
    assert {s.kind for s in scores} == {"value"}


@pytest.mark.parametrize(("higher", "better", "sign"), [(True, "a", 1), (False, "b", -1)])
def test_the_better_of_two_follows_the_direction_of_the_metric(higher, better, sign):
    replicates = np.array([0.82, 0.78, 0.81, 0.80]), np.array([0.70, 0.72, 0.69, 0.71])
    units, details = ["p", "q", "r", "s"], {"unit": "group"}
    one, two = (
        Scored(Score("SSIM", name, value, higher_is_better=higher, details=details), rows, units)
        for name, value, rows in (("a", 0.80, replicates[0]), ("b", 0.70, replicates[1]))
    )
    error, interval = jackknife(0.1, replicates[0] - replicates[1])
    ahead = stats.t.cdf(sign * 0.1 / error, 3)
    found, turned = difference(one, two), difference(two, one)
    assert (found.details["better"], turned.details["better"]) == (better, better)
    assert found.details["p_better"] == pytest.approx(ahead, abs=1e-12)
    assert turned.details["p_better"] == pytest.approx(1 - ahead, abs=1e-12)
    assert found.details["p_value"] == pytest.approx(2 * stats.t.cdf(-0.1 / error, 3))
    assert (ahead > 0.5) == higher
    assert found.interval == interval
    assert found.details["decided"] == (found.interval[0] > 0)
