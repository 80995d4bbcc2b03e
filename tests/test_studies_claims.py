"""Claims follow the numbers: planted differences decide, flip, and stay undecided."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from forge.errors import fails
from palpate.core import Note, Score
from palpate.metrics.intervals import spread_of_values
from palpate.report.labels import label_of
from palpate.studies.claims import (
    FAMILY,
    TRADITIONAL,
    discrimination_claim,
    effect_size,
    effect_table,
    leak_claims,
    paper_claims,
    preference_claims,
    ranking_claims,
)
from palpate.studies.evidence import ahead, difference_between, over_seeds
from palpate.studies.study_tables import Scores

HIGHER = {"SSIM": True, "PSNR": True, "human preference": True}


def difference(metric, value, reach=0.1, pair=("Ours", "GVST"), **details):
    """A paired difference with a symmetric interval."""
    up = HIGHER.get(metric, None if metric in FAMILY[1:] else False)
    return Score(
        metric,
        pair[0],
        value,
        None if reach is None else (value - reach, value + reach),
        kind="difference",
        b=pair[1],
        higher_is_better=up,
        details=details,
    )


def verdicts(claims):
    return {c.claim: c.verdict for c in claims}


def test_seeds_add_their_deviation_to_the_interval_of_videos():
    values, reaches = [1.0, 1.4, 1.2], [0.3, 0.2, 0.4]
    made = over_seeds([difference("TMMD", v, r) for v, r in zip(values, reaches, strict=True)])
    between = stats.t.ppf(0.975, 2) * np.std(values, ddof=1) / np.sqrt(3)
    reach = np.sqrt(np.mean(np.square(reaches)) + between**2)
    assert made.value == pytest.approx(1.2)
    assert made.interval == pytest.approx((1.2 - reach, 1.2 + reach))
    assert made.details["by_seed"] == values
    assert over_seeds([difference("TMMD", 1.0, None)] * 2).interval is None
    for value, reach in ((1.0, 0.5), (1.0, None), (None, None)):
        by = [replace(difference("TMMD", value, reach), encoder=name) for name in ("e0", "e1")]
        assert [over_seeds(by).encoder, over_seeds(by[:1] * 2).encoder] == [None, "e0"]
    fails("one metric and subject", over_seeds, [difference("TMMD", 1.0), difference("SSIM", 1.0)])


def test_of_several_seeds_no_p_value_or_verdict_of_one_remains():
    one = {"p_value": 1e-6, "decided": True, "better": "Ours", "p_better": 1.0, "kind": "same"}
    one |= {"matrix": [[1.0, 2.0], [2.0, 3.0]], "classes": ["Wood", "Brick"], "unstable": ["Wood"]}
    notes = [Note("no-contact-baseline")]
    a = replace(difference("TMMD", -0.9, 0.1, **one), null=(-0.1, 0.1), notes=notes)
    b = difference("TMMD", 0.9, 0.1, **one | {"matrix": [[3, 0], [0, 1]], "unstable": []})
    made = over_seeds([a, b])
    assert (made.value, made.null) == (0, None)
    assert [*over_seeds([a, b, a]).notes] == [*over_seeds([b, a]).notes] == notes
    kept = {"kind": "same", "classes": ["Wood", "Brick"]}
    assert made.details == {**kept, "matrix": [[2, 1], [1, 2]], "by_seed": [-0.9, 0.9]}
    assert over_seeds([a]).details["p_value"] == 1e-6


def test_leaks_are_measured_by_the_distance_to_the_floor_where_lower_is_not_better():
    """Orig is on its floor, NoLeak has collapsed to 0: that is no deflation."""

    def scores(value, floor, half):
        interval = (value - half, value + 2 * half)
        return [Score("I-TMMD", "Ours", value, interval, floor=floor, higher_is_better=None)]

    made = difference_between(scores(0.4, 0.4, 0.05), scores(0.1, 0.5, 0.03), ("Orig", "NoLeak"))
    assert made.details["gap"] == pytest.approx(-0.4)
    # |0.4 - 0.4| has reaches (.05, .1), |0.1 - 0.5| from below (.06, .03).
    limits = (-0.4 - np.hypot(0.05, 0.03), -0.4 + np.hypot(0.1, 0.06))
    assert made.details["gap_interval"] == pytest.approx(limits)
    accuracy = difference("accuracy", 0.2, pair=("Orig", "NoLeak"))
    tasks = {"I-TMMD": made, "accuracy": replace(accuracy, higher_is_better=True)}
    claims = verdicts(leak_claims(tasks))
    assert claims["Leakage inflates I-TMMD"] == "holds"
    tasks["I-TMMD"] = replace(made, details=made.details | {"gap": 0.4, "gap_interval": [0.3, 0.5]})
    claims = leak_claims(tasks)
    assert verdicts(claims)["Leakage inflates I-TMMD"] == "does not hold"
    assert claims[0].verdict == "holds"
    assert claims[0].why.startswith("1 of 1 tasks inflated")


def test_intervals_of_two_splits_cover_their_difference():
    """In 400 draws of two independent means the interval holds the true difference at its level."""
    rng, hits = np.random.default_rng(0), 0
    for _ in range(400):
        scores = []
        for mean in (0.7, 0.5):
            spread = spread_of_values(rng.normal(mean, 0.1, 20), None)
            scores.append(
                Score("accuracy", "real", spread.value, spread.interval(), higher_is_better=True)
            )
        low, high = difference_between([scores[0]], [scores[1]], ("Orig", "NoLeak")).interval
        hits += low <= 0.2 <= high
    assert 0.93 <= hits / 400 <= 0.98


def test_ahead_is_oriented_by_the_metric_and_the_floor():
    assert ahead(difference("TMMD", -0.5), "Ours").interval == pytest.approx((0.4, 0.6))
    assert ahead(difference("TMMD", -0.5), "GVST").value == -0.5
    assert ahead(difference("SSIM", -0.5), "Ours").value == -0.5
    # Collapsed: lower than the other, and further from the floor.
    collapsed = difference("I-TMMD", -0.5, gap=0.4, gap_interval=[0.3, 0.5])
    assert ahead(collapsed, "Ours").interval == pytest.approx((-0.5, -0.3))
    assert ahead(difference("I-TMMD", -0.5), "Ours").value == 0.5  # no floor: as in the paper
    fails("'Theirs' and another", ahead, difference("TMMD", 1), "Theirs")


def test_leaks_inflate_where_orig_is_better_and_the_verdict_flips_with_the_numbers():
    pair = ("Orig", "NoLeak")
    tasks = {
        "material classification": replace(
            difference("material accuracy", 0.2, pair=pair), higher_is_better=True
        ),
        "generation": difference("TMMD", -1.0, pair=pair),
    }
    made = verdicts(leak_claims(tasks))
    assert made["Leakage inflates every task"] == "holds"
    assert made["Leakage inflates generation"] == "holds"
    tasks["generation"] = difference("TMMD", 1.0, pair=pair)
    made = verdicts(leak_claims(tasks))
    assert made["Leakage inflates every task"] == "does not hold"
    assert made["Leakage inflates material classification"] == "holds"
    tasks["generation"] = difference("TMMD", -1.0, 1.5, pair=pair)
    claims = leak_claims(tasks)
    assert verdicts(claims)["Leakage inflates every task"] == "undecided"
    assert "1 of 2 tasks inflated" in claims[0].why
    assert claims[2].why == "Lead of Orig over NoLeak in TMMD (below 0: behind): 1.0 [−0.5, 2.5]."


def study(tmmd, ssim):
    """Differences of three methods as in the paper's table 3, if both are positive."""
    return [
        difference("TMMD", -tmmd),
        difference("TMMD", -2 * tmmd, pair=("Ours", "Ours w/ BG")),
        difference("SSIM", 0.0, 0.01),
        difference("SSIM", -ssim, 0.01, pair=("Ours", "Ours w/ BG")),
    ]


PEOPLE = [
    difference("human preference", 0.5, 0.3),
    difference("human preference", 0.65, 0.3, pair=("Ours", "Ours w/ BG")),
]


def test_metrics_are_held_against_people():
    made = verdicts(preference_claims(study(1, 0.05), PEOPLE))
    assert made["SSIM prefers what people do not"] == "holds"
    assert made["TMMD prefers what people prefer"] == "holds"
    assert made["LPIPS prefers what people do not"] == "undecided"
    assert len(made) == len(TRADITIONAL) + len(FAMILY)
    flipped = verdicts(preference_claims(study(-1, -0.05), PEOPLE))
    assert flipped["SSIM prefers what people do not"] == "does not hold"
    assert flipped["TMMD prefers what people prefer"] == "does not hold"
    alone = {c.claim: c for c in preference_claims(study(1, 0.05), [])}
    assert {c.verdict for c in alone.values()} == {"undecided"}
    assert "no human study was given" in alone["SSIM prefers what people do not"].why
    assert "weights may be missing" in alone["LPIPS prefers what people do not"].why
    strangers = [difference("human preference", 0.5, pair=("x", "y"))]
    made = {c.claim: c.why for c in preference_claims(study(1, 0.05), strangers)}
    assert "the human study compared other methods" in made["TMMD prefers what people prefer"]
    assert made["TMMD prefers what people prefer"].startswith(
        "Lead by TMMD (below 0: behind): of Ours over GVST 1.00 [0.90, 1.10], over Ours w/ BG 2.00"
    )


def test_features_of_a_tactile_encoder_are_no_fid_of_the_paper():
    tactile, shipped = (
        replace(difference("FID", 5, pair=("Ours", "Ours w/ BG")), features=features)
        for features in ("tactile", "palpate/mini vision")
    )
    claim = "FID prefers what people do not"
    assert verdicts(preference_claims([tactile], PEOPLE))[claim] == "undecided"
    made = {c.claim: c for c in preference_claims([shipped], PEOPLE)}[claim]
    assert made.verdict == "holds"
    assert "FID (palpate/mini vision)" in made.why


def test_rankings_flip_and_contradictions_are_undecided():
    bridge, background = (c.verdict for c in ranking_claims(study(1, 0.05), PEOPLE))
    assert (bridge, background) == ("holds", "holds")
    bridge, background = (c.verdict for c in ranking_claims(study(-1, 0.05)))
    assert (bridge, background) == ("does not hold", "does not hold")
    assert ranking_claims(study(-1, 0.05), PEOPLE)[0].verdict == "undecided"  # people object
    assert ranking_claims(study(0.05, 0.05))[0].verdict == "undecided"  # holds 0
    assert ranking_claims([])[0].why == "GVST was not compared with Ours."
    why = ranking_claims([*study(1, 0.05), difference("D-TMMD", None, None)])[0].why
    assert why == (
        "Lead of Ours over GVST (below 0: behind): TMMD 1.00 [0.90, 1.10], D-TMMD undefined. "
        "TMMD decides."
    )


def test_effect_sizes_are_differences_over_errors_and_decide_who_discriminates():
    made = effect_size(difference("TMMD", -1.0, 0.49))
    assert made.value == pytest.approx(1.0 / (0.49 / 1.959964), rel=1e-5)
    assert effect_size(difference("TMMD", -1.0, None)) is None
    both = study(1, 0.005)
    assert discrimination_claim(both).verdict == "holds"
    strong = [difference("SSIM", 1.0), difference("TMMD", 0.01)]
    assert discrimination_claim(strong).verdict == "does not hold"
    alike = [difference("SSIM", 0.1), difference("TMMD", 0.15)]
    assert discrimination_claim(alike).verdict == "undecided"
    assert discrimination_claim([difference("SSIM", 1.0)]).verdict == "undecided"
    control = ("Ours", "empty background")  # a control is no method
    apart = [difference("SSIM", 9.0, pair=control), difference("TMMD", 0.0, pair=control)]
    assert discrimination_claim(apart).evidence == []
    table = effect_table(both)
    assert table.columns == ["metric", "Ours against GVST", "Ours against Ours w/ BG"]
    assert [row[0] for row in table.rows] == ["SSIM", "TMMD"]
    assert float(table.rows[1][2]) == pytest.approx(2 * float(table.rows[1][1]))


def test_differences_of_seeds_are_joined_by_metric_pair_and_preset():
    paper = replace(difference("TMMD", 9.0, stage="s"), settings={"preset": "paper"})
    runs = [
        [
            paper,
            replace(difference("TMMD", v, stage="s"), settings={"preset": "grouped"}),
            Score("TMMD", "x", 1, details={"stage": "s"}),
        ]
        for v in (-1.0, -2.0)
    ]
    runs[0].append(difference("SSIM", 1.0))  # one seed alone
    made = Scores.over_seeds(runs, "results").differences
    assert [(label_of(d), d.value) for d in made] == [("TMMD difference", -1.5)]
    gap = difference("I-TMMD", -0.5, gap=0.4, gap_interval=[0.3, 0.5])
    joined = over_seeds([gap, replace(gap, details={"gap": 0.6, "gap_interval": [0.5, 0.7]})])
    assert joined.details["gap"] == pytest.approx(0.5)
    reach = np.hypot(0.1, stats.t.ppf(0.975, 1) * 0.1)
    assert joined.details["gap_interval"] == pytest.approx((0.5 - reach, 0.5 + reach))
    claims = paper_claims(study(1, 0.005), tasks={}, people=PEOPLE)
    assert len({c.claim for c in claims}) == len(claims) == 1 + 2 + 9 + 1
    assert claims[0].verdict == "undecided"  # no task was measured
