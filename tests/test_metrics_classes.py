"""Metrics over classes: the null of halves, denominators near 0, floors over the same classes."""

import numpy as np
import pytest

from forge.scores import jackknife, without_each
from palpate.core import FeatureSet
from palpate.metrics import ci_tmmd, compare, d_tmmd, four_scores, i_tmmd
from palpate.report.labels import label_of, measured
from test_metrics_tactile import change, codes, keep, world

OFF_DIAGONAL = {"denominator": "mean_off_diagonal"}


def one_class(s, name):
    return keep(s, np.array(s.labels) == name)


PRESETS = [{"preset": name} for name in ("paper", "cmmd", "paper-tables")]


@pytest.mark.parametrize("options", [{}, *PRESETS, {"estimator": "biased"}])
def test_the_null_of_a_mean_over_classes_is_that_of_independent_classes(options):
    s = world(0, classes=4, videos=(3, 5, 4), frames=(3, 6, 4))
    nulls = [i_tmmd(one_class(s, f"m{c}"), **options).null for c in range(4)]
    sds = np.array([(high - low) / 2 / 1.96 for low, high in nulls])
    center, reach = np.mean(nulls), 1.96 * np.sqrt((sds**2).sum()) / 4
    score = ci_tmmd(s, **options)
    assert score.null == pytest.approx((center - reach, center + reach), abs=1e-9)
    assert score.details["z"] == pytest.approx((score.value - center) / reach * 1.96)


def mixed(seed, apart, classes=3, videos=4, frames=3):
    """Classes of videos that differ by no more than ``apart`` along an axis each."""
    s = world(seed, classes=1, videos=classes * videos, frames=frames)
    number = np.array([int(v.removeprefix("c0v")) for v in s.groups]) % classes
    x = s.features + apart * np.eye(6)[number]
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return change(s, features=x, labels=[f"m{c}" for c in number])


def means_off_diagonal(score):
    matrix = np.array(score.details["matrix"])
    return (matrix.sum(axis=1) - np.diagonal(matrix)) / (len(matrix) - 1)


def in_errors(s):
    """D-TMMD, and divergences (C,) of a class from the others in recomputed jackknife errors."""
    score = d_tmmd(s, **OFF_DIAGONAL)
    assert "leave-one-group-out" in score.interval_method
    left = [keep(s, np.array(s.groups) != v) for v in sorted(set(s.groups))]
    out = np.array([means_off_diagonal(d_tmmd(of, **OFF_DIAGONAL)) for of in left])
    means = means_off_diagonal(score)
    errors = [jackknife(0.0, column)[0] for column in out.T]
    return score, means / errors, means.mean() / jackknife(0.0, out.mean(axis=1))[0]


@pytest.mark.parametrize(
    ("seed", "apart", "low", "high"), [(1, 0.1, 1.0, 2.0), (0, 0.1, 2.0, 2.5), (5, 0.2, 4.0, 6.0)]
)
def test_classes_within_two_errors_of_the_others_are_unstable_and_have_no_excess_ratio(
    seed, apart, low, high
):
    s = mixed(seed, apart)
    score, each, inter = in_errors(s)
    assert score.details["inter"]["value"] == pytest.approx(means_off_diagonal(score).mean())
    assert score.details["unstable"] == [f"m{c}" for c in range(3) if each[c] <= 2]
    if seed < 2:
        assert ((each > 1) & (each <= 2)).any()  # else one error would do for two
    assert ("unstable-denominators" in codes(score)) == bool(score.details["unstable"])
    assert low < inter < high
    if inter <= 2:
        assert (score.details["E_ratio"], score.details["E_ratio_interval"]) == (None, None)
    else:
        excess = np.mean([i_tmmd(one_class(s, f"m{c}")).details["E"] for c in range(3)])
        assert score.details["E_ratio"] == pytest.approx(excess / score.details["inter"]["value"])
        bounds = score.details["E_ratio_interval"]
        assert bounds[0] < score.details["E_ratio"] < bounds[1]


@pytest.mark.parametrize("preset", [None, "paper"])
def test_a_generator_of_some_classes_has_the_floor_of_these(preset):
    r = world(0, classes=4, videos=4, frames=(3, 4))
    shown = np.isin(r.labels, ["m1", "m2"])
    g = keep(world(0, classes=4, videos=4, frames=(3, 4), draw=1), shown)
    excess = {c: i_tmmd(one_class(r, c)).details["E"] for c in ("m0", "m1", "m2", "m3")}
    _, own, ci, d = four_scores(g, r, floor=r, preset=preset, permutations=0)
    some = (excess["m1"] + excess["m2"]) / 2
    assert abs(some - np.mean(list(excess.values()))) > 0.05
    assert ci.details["E_floor"] == pytest.approx(some, abs=1e-9)
    assert own.details["E_floor"] == pytest.approx(i_tmmd(r).details["E"], abs=1e-9)
    for score in (ci, d):
        assert score.value is not None
        assert score.floor is None
        assert "no-floor:classes" in codes(score)
    assert d.details["E_ratio_floor"] is None
    whole = four_scores(r, r, floor=r, preset=preset, permutations=0)
    assert whole[2].details["E_floor"] == pytest.approx(np.mean(list(excess.values())), abs=1e-9)
    ci, d = ci_tmmd(r, preset=preset), d_tmmd(r, preset=preset)
    assert whole[3].details["E_ratio_floor"] == d.details["E_ratio"] is not None
    assert [s.floor for s in whole[2:]] == pytest.approx([ci.value, d.value])
    # and classes that no real image shows have none
    unknown = four_scores(r, g, floor=g, preset=preset, permutations=0)[2]
    assert (unknown.details["E_floor"], unknown.floor) == (None, None)


def floored(s, real, **options):
    """I-, CI- and D-TMMD with the floor of real samples."""
    return four_scores(s, real, floor=real, permutations=0, **options)[1:]


@pytest.mark.parametrize("preset", ["cmmd", "paper-tables"])
def test_biased_halves_have_a_floor_of_as_many_samples_alone(preset):
    rng = np.random.default_rng(5)

    def drawn(n, prefix):
        x = rng.normal(size=(n, 6)) + 2
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        return FeatureSet([f"{prefix}{k}" for k in range(n)], x, [f"m{k % 3}" for k in range(n)])

    few, many, equal = drawn(60, "a"), drawn(240, "b"), drawn(60, "c")
    for score in floored(few, many, preset=preset):
        assert score.floor is None
        assert "no-floor:sizes" in codes(score)
    for real, name in ((equal, preset), (many, "paper")):
        assert None not in [s.floor for s in floored(few, real, preset=name)]


def videos_of(per_video, *, videos=12, spread=0.5, draw=0, prefix="", classes=2):
    """Frames of videos whose centers are the same in every draw; ``per_video`` frames each."""
    centers = np.random.default_rng(99).normal(size=(videos, 8)) * 0.3 + 2
    number = np.repeat(np.arange(videos), per_video)
    x = centers[number] + spread * np.random.default_rng(draw).normal(size=(len(number), 8))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    ids = [f"{prefix}v{v:02d}/{k}" for k, v in enumerate(number)]
    return FeatureSet(ids, x, [f"m{v % classes}" for v in number], [f"v{v:02d}" for v in number])


@pytest.mark.parametrize("options", [{}, {"estimator": "biased"}])
def test_halves_of_whole_videos_have_a_floor_of_as_many_frames_alone(options):
    """Other numbers of frames have another share of pairs inside videos: another value, one E."""
    few, many, equal = (videos_of(n, draw=k, prefix=str(k)) for k, n in enumerate((2, 40, 2)))
    for score in floored(few, many, **options):
        assert score.floor is None
        assert "no-floor:group-sizes" in codes(score)
        assert score.metric == "D-TMMD" or score.details["E_floor"] is not None
    for score in floored(few, equal, **options):
        assert score.floor is not None
        assert not [c for c in codes(score) if c.startswith("no-floor")]
    whole = videos_of([200] * 12)
    one_less = whole.take([i for i in whole.ids if not i.endswith("/0")])
    near, exact = (floored(whole, s, **options)[0] for s in (one_less, whole))
    assert near.floor == pytest.approx(exact.floor, rel=0.02)  # a frame in 2,400 is nothing
    assert floored(whole, videos_of([190] * 12), estimator="biased")[0].floor is None  # 5 %
    lost = floored(whole, videos_of([150] * 12), **options)[0]
    # Unbiased values of many frames hardly depend on how many.
    assert (lost.floor is None) == ("estimator" in options)


def test_floors_over_classes_of_other_sizes_are_none():
    few = videos_of([4, 12] * 6, draw=0, prefix="0")
    other = videos_of([12, 4] * 6, draw=1, prefix="1")
    for preset in ("cmmd", "paper-tables"):
        own, *of_classes = floored(few, other, preset=preset)
        assert own.floor is not None
        assert [s.floor for s in of_classes] == [None, None]


@pytest.mark.parametrize("options", [{"preset": "cmmd"}, {"preset": "paper-tables"}, {}])
def test_no_generator_is_nearer_to_a_floor_that_is_none(options):
    right = videos_of(3, draw=1, prefix="a")
    sets = {"right": right, "collapsed": videos_of(3, draw=2, prefix="a", spread=0.1)}
    options = {**options, "permutations": 0}
    many, equal = videos_of(40, draw=3, prefix="b"), videos_of(3, draw=4, prefix="c")
    for real, known in ((many, False), (equal, True)):
        for d in compare(sets, real, floor=real, **options).differences:
            decides = known or d.kind == "excess"  # which does not depend on the number of frames
            if d.metric in ("I-TMMD", "CI-TMMD"):
                assert (d.details["better"] is not None) == ("gap" in d.details) == decides
                assert d.details["p_value"] is not None
    some = videos_of(3, draw=4, prefix="c", classes=3)  # and other classes
    found = compare(sets, some, floor=some, **options)
    gaps = {label_of(d): "gap" in d.details for d in found.differences if d.kind == "difference"}
    assert list(gaps.values()) == [False, True, False, False]


def test_where_classes_are_left_out_so_they_are_of_differences():
    """Two videos a class: none can be left out, but a class can, of both generators at once."""
    a, r = (world(9, classes=5, videos=2, frames=3, draw=k) for k in (1, 2))
    b = change(world(9, classes=5, videos=2, frames=3, draw=3), ids=a.ids)
    found = compare({"a": a, "b": b}, r, floor=r, permutations=0)
    one, two, real = (
        [v["value"] for v in ci_tmmd(s).details["per_class"].values()] for s in (a, b, r)
    )
    delta = np.subtract(one, two)
    of_metric = {measured(d): d for d in found.differences}
    d = of_metric["CI-TMMD"]
    assert (label_of(d), d.value) == ("CI-TMMD difference", pytest.approx(delta.mean(), abs=1e-9))
    assert d.interval == jackknife(delta.mean(), without_each(delta))[1]
    assert d.interval_method == "paired leave-one-class-out jackknife, t, 4 df"
    left_out = {label_of(s): s.details.get("left_out") for s in found.scores}
    assert left_out["CI-TMMD"] == left_out["CI-TMMD E"] == "class"
    gap = abs(np.mean(one) - np.mean(real)) - abs(np.mean(two) - np.mean(real))
    assert d.details["gap"] == pytest.approx(gap, abs=1e-9)
    assert d.details["gap_interval"] is not None
    assert of_metric["D-TMMD"].interval is not None
    assert of_metric["CI-TMMD E"].interval is not None
