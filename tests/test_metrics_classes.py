"""Metrics over classes: the null of their halves, what counts as a denominator near 0, and a floor over the same classes."""

import numpy as np
import pytest

from palpate.core import FeatureSet
from palpate.metrics import ci_tmmd, d_tmmd, four_scores, i_tmmd
from test_metrics_tactile import change, keep, world

OFF_DIAGONAL = {"denominator": "mean_off_diagonal"}


def one_class(s, name):
    return keep(s, np.array(s.labels) == name)


@pytest.mark.parametrize("options", [{}, {"preset": "paper"}, {"preset": "cmmd"}, {"preset": "paper-tables"}, {"estimator": "biased"}])
def test_the_null_of_a_mean_over_classes_is_that_of_independent_classes(options):
    s = world(0, classes=4, videos=(3, 5, 4), frames=(3, 6, 4))
    nulls = [i_tmmd(one_class(s, f"m{c}"), **options).null for c in range(4)]
    sds = np.array([(high - low) / 2 / 1.96 for low, high in nulls])
    centre, reach = np.mean([(low + high) / 2 for low, high in nulls]), 1.96 * np.sqrt((sds**2).sum()) / 4
    score = ci_tmmd(s, **options)
    assert score.null == pytest.approx((centre - reach, centre + reach), abs=1e-9)
    assert score.details["z"] == pytest.approx((score.value - centre) / reach * 1.96)


def mixed(seed, apart, classes=3, videos=4, frames=3):
    """Classes of videos that differ by no more than ``apart`` along an axis each."""
    s = world(seed, classes=1, videos=classes * videos, frames=frames)
    number = np.array([int(v.removeprefix("c0v")) for v in s.groups]) % classes
    x = s.features + apart * np.eye(6)[number]
    return change(s, features=x / np.linalg.norm(x, axis=1, keepdims=True), labels=[f"m{c}" for c in number])


def means_off_diagonal(score):
    matrix = np.array(score.details["matrix"])
    return (matrix.sum(axis=1) - np.diagonal(matrix)) / (len(matrix) - 1)


def in_errors(s):
    """D-TMMD, and its mean divergences (C,) of a class from the others in jackknife errors, each recomputed without each video."""
    score = d_tmmd(s, **OFF_DIAGONAL)
    assert "leave-one-group-out" in score.interval_method
    out = [means_off_diagonal(d_tmmd(keep(s, np.array(s.groups) != v), **OFF_DIAGONAL)) for v in sorted(set(s.groups))]
    found = [means_off_diagonal(score), np.array(out)]
    error = lambda v: np.sqrt((len(v) - 1) / len(v) * ((v - v.mean(axis=0)) ** 2).sum(axis=0))  # noqa: E731
    return score, found[0] / error(found[1]), found[0].mean() / error(found[1].mean(axis=1))


@pytest.mark.parametrize(("seed", "apart", "low", "high"), [(1, 0.1, 1.0, 2.0), (0, 0.1, 2.0, 2.5), (5, 0.2, 4.0, 6.0)])
def test_classes_within_two_errors_of_the_others_are_unstable_and_have_no_excess_ratio(seed, apart, low, high):
    s = mixed(seed, apart)
    score, each, inter = in_errors(s)
    assert score.details["inter"]["value"] == pytest.approx(means_off_diagonal(score).mean())
    assert score.details["unstable"] == [f"m{c}" for c in range(3) if each[c] <= 2]
    if seed < 2:
        assert ((each > 1) & (each <= 2)).any()  # else one error would do for two
    assert ("unreliable" in score.note) == bool(score.details["unstable"])
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
        assert "No floor: real touches of other classes" in score.note
    assert d.details["E_ratio_floor"] is None
    whole = four_scores(r, r, floor=r, preset=preset, permutations=0)
    assert whole[2].details["E_floor"] == pytest.approx(np.mean(list(excess.values())), abs=1e-9)
    assert whole[3].details["E_ratio_floor"] == d_tmmd(r, preset=preset).details["E_ratio"] is not None
    assert (whole[2].floor, whole[3].floor) == (
        pytest.approx(ci_tmmd(r, preset=preset).value),
        pytest.approx(d_tmmd(r, preset=preset).value),
    )
    unknown = four_scores(r, g, floor=g, preset=preset, permutations=0)  # and classes that no real touch shows have none
    assert unknown[2].details["E_floor"] is None
    assert unknown[2].floor is None


@pytest.mark.parametrize("preset", ["cmmd", "paper-tables"])
def test_biased_halves_have_a_floor_of_as_many_samples_alone(preset):
    rng = np.random.default_rng(5)

    def drawn(n, prefix):
        x = rng.normal(size=(n, 6)) + 2
        return FeatureSet([f"{prefix}{k}" for k in range(n)], x / np.linalg.norm(x, axis=1, keepdims=True), [f"m{k % 3}" for k in range(n)])

    few, many, equal = drawn(60, "a"), drawn(240, "b"), drawn(60, "c")
    for score in four_scores(few, many, floor=many, preset=preset, permutations=0)[1:]:
        assert score.floor is None
        assert "other numbers of samples" in score.note
    assert all(s.floor is not None for s in four_scores(few, equal, floor=equal, preset=preset, permutations=0)[1:])
    assert all(s.floor is not None for s in four_scores(few, many, floor=many, preset="paper", permutations=0)[1:])
