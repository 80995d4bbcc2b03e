"""What stands around the metrics: who is ahead, what is remarked, names of presets, companions on features, digests of the reference."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.core import FeatureSet, PalpateError, Score
from palpate.core.score import require_comparable
from palpate.evaluation import comparing
from palpate.evaluation.comparing import (
    Asked,
    Outcome,
    against,
    compare_features,
    confidence,
    feature_companions,
    left_out,
    part_of,
)
from palpate.evaluation.embeddings import known_to
from palpate.metrics.intervals import mean_interval
from palpate.metrics.neighbors import prdc_rows
from palpate.metrics.paired import mean_differences

VIDEOS, FRAMES, D = 10, 4, 3
IDS = [f"v{v}/{k}" for v in range(VIDEOS) for k in range(FRAMES)]
GROUPS = [f"v{v}" for v in range(VIDEOS) for _ in range(FRAMES)]


def features(seed: int, shift: float, n: int = len(IDS)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = (
        2
        + rng.normal(size=(n, D))
        + np.repeat(rng.normal(size=(n // FRAMES, D)), FRAMES, 0)
        + shift * np.linspace(0, 1, n)[:, None]
    )
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def difference(**details) -> Score:
    return Score("TMMD difference", "a - b", 0.5, details={"a": "a", "b": "b", **details})


def test_the_confidence_is_that_of_the_one_that_is_ahead():
    assert (
        confidence(difference(better="a", p_better=0.973, p_adjusted=0.054))
        == "a is better with 97.3 % confidence, Holm p = 0.054"
    )
    assert (
        confidence(difference(better="b", p_better=0.03, p_adjusted=0.06))
        == "b is better with 97.0 % confidence, Holm p = 0.06"
    )
    assert confidence(difference(better=None, p_better=None)) == ""


def test_copies_are_told_once_a_subject_whatever_its_other_notes_say():
    tmmd = Score("TMMD", "g", 1.0, n=48, details={"copies": 5}, note="Something else. And 5 copies")
    kid = replace(
        tmmd,
        metric="KID (embeddings)",
        details={"copies": 4},
        note="The interval is that of whole groups left out",
    )
    clean = replace(tmmd, subject="h", details={"copies": 0})
    assert Outcome([tmmd, kid, clean]).said().remarks == [
        "g: 5 of 48 generated rows are bit for bit rows of the reference: a copy is not a generator"
    ]


def test_only_an_interval_wholly_below_the_floor_is_told():
    below = Score("I-TMMD E", "g", 1.0, interval=(0.5, 1.5), floor=2.0)
    astride = replace(below, subject="h", interval=(0.5, 2.5))
    remarks = Outcome([below, astride]).said().remarks
    assert len(remarks) == 1
    assert remarks[0].startswith("I-TMMD E, g: below the floor")


def test_a_preset_with_another_estimator_says_so_and_grouped_keeps_its_own():
    sets = {"g": FeatureSet(IDS, features(1, 0.5), None, GROUPS)}
    reference = FeatureSet(IDS, features(2, 0), None, GROUPS)
    run = lambda **how: compare_features(sets, reference, Asked(permutations=0, **how))  # noqa: E731
    shown = lambda **how: {
        (s.settings["preset"], s.estimator) for s in run(**how).scores if s.metric == "TMMD"
    }
    assert shown() == {("grouped", "grouped"), ("paper", "unbiased")}
    assert shown(estimator="biased") == {("paper, biased", "biased")}
    assert shown(estimator="biased", presets=("cmmd", "paper-tables")) == {
        ("cmmd", "biased"),
        ("paper-tables", "biased"),
    }
    assert shown(estimator="grouped") == {("grouped", "grouped"), ("paper, grouped", "grouped")}
    two = compare_features(
        {**sets, "h": reference}, reference, Asked(permutations=0, estimator="biased")
    )
    assert {d.settings["preset"] for d in two.differences} == {"paper, biased"}
    with pytest.raises(
        PalpateError,
        match=r"grouped must keep the grouped estimator\. Got the estimator biased\. Drop one of the two",
    ):
        Asked(presets=("paper", "grouped"), estimator="biased")


def test_of_many_rows_only_fid_is_made_unasked(monkeypatch):
    monkeypatch.setattr(comparing, "MANY", 10)
    sets, reference = {"g": FeatureSet(IDS, features(1, 0.5))}, FeatureSet(IDS, features(2, 0))
    found = feature_companions(
        ("fid", "kid", "prdc"), sets, reference, Asked(), what="x", default=True
    )
    assert {s.metric for s in found.scores} == {"FID (x)"}
    assert [r.split(" left out")[0] for r in found.remarks] == ["kid", "prdc"]
    found = feature_companions(("kid",), sets, reference, Asked(), what="x")
    assert ({s.metric for s in found.scores}, found.remarks) == ({"KID (x)"}, [])


def test_prdc_differences_pair_by_id_and_take_the_groups_of_whose_rows_they_average():
    a, b = (FeatureSet(IDS, features(seed, seed), None, GROUPS) for seed in (1, 3))
    few = IDS[: 6 * FRAMES]  # the reference has other videos, and fewer
    names = [f"w{v}" for v in range(6) for _ in range(FRAMES)]
    reference = FeatureSet([f"r{i}" for i in few], features(2, 0, len(few)), None, names)
    shuffled = b.take(list(np.random.default_rng(0).permutation(IDS)))
    run = lambda other: (
        feature_companions(
            ("prdc",), {"a": a, "b": other}, reference, Asked(), what="x"
        ).differences
    )
    rows = [prdc_rows(one, reference)[1] for one in (a, b)]
    found = {d.metric: d for d in run(shuffled)}
    for metric, own in (
        ("Precision", GROUPS),
        ("Density", GROUPS),
        ("Recall", names),
        ("Coverage", names),
    ):
        delta = rows[0][metric] - rows[1][metric]
        d = found[f"{metric} (x) difference"]
        assert np.ptp(delta) > 0
        assert d.value == pytest.approx(delta.mean(), abs=1e-12)
        assert d.interval == pytest.approx(mean_interval(delta, own, 0.95)[0], abs=1e-9)


def test_pairs_of_pictures_without_a_finite_value_are_left_out_of_a_difference():
    rng = np.random.default_rng(0)
    a, b = rng.normal(30, 1, 20), rng.normal(28, 1, 20)
    a[3], b[5] = np.inf, np.nan  # a perfect picture, and one without a value
    kept = [k for k in range(20) if k not in (3, 5)]
    scores = {name: Score("PSNR", name, 1.0, higher_is_better=True) for name in "ab"}
    [d] = mean_differences(scores, {"a": a, "b": b}, None)
    assert d.value == pytest.approx((a - b)[kept].mean(), rel=1e-12)
    assert d.interval is not None


def test_the_reference_is_kept_with_what_compares_with_it_alone():
    scores = [
        Score(m, "g", 1.0)
        for m in (
            "TMMD",
            "FID (touch)",
            "SSIM",
            "I-TMMD",
            "CI-TMMD E",
            "D-TMMD (σ = 1)",
            "material accuracy",
        )
    ]
    differences = [Score(f"{s.metric} difference", "a - b", 0.0) for s in scores]
    one, other = (against(Outcome(scores, differences), digest * 64) for digest in "12")
    assert [s.reference == "1" * 64 for s in one.scores] == [True] * 3 + [False] * 4
    assert [s.reference == "1" * 64 for s in one.differences] == [True] * 3 + [False] * 4
    with pytest.raises(PalpateError, match="must agree in reference"):
        require_comparable([one.scores[0], other.scores[0]])
    require_comparable([one.scores[3], other.scores[3]])


def test_ids_of_a_generator_against_those_of_the_reference():
    assert known_to("g", ["a", "b"], {"a", "b", "c"}, "video")
    assert not known_to("g", ["x", "y"], {"a", "b", "c"}, "video")
    with pytest.raises(
        PalpateError, match=r"which gives video by id\. Got 1 of 3 without, first 'x'"
    ):
        known_to("g", ["a", "x", "b"], {"a", "b", "c"}, "video")
    known = ["a", "b", "c", "d"]
    assert part_of("g", ["d", "c", "b", "x"], ["b", "c"], known) == ["c", "b"]
    assert part_of("g", ["x", "y"], ["b", "c"], known) is None
    assert left_out("g", ["d", "c", "b", "x"], ["c", "b"]) == [
        "g: 2 of 4 touches lie outside the split's test part, and were left out"
    ]
    assert left_out("g", ["c", "b"], ["c", "b"]) == []
    with pytest.raises(
        PalpateError,
        match=r"'g' must have every touch of the split's test part\. Got 1 of 2 missing, first 'c'",
    ):
        part_of("g", ["a", "b"], ["b", "c"], known)
