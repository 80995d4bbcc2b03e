"""Simulated raters behave as planted, and intervals of studies with people cover; all rows are in
``docs/studies/preference_coverage.md``.
"""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import preference_coverage as coverage


@pytest.fixture(scope="module")
def votes():
    plan = coverage.study(60, 40, 0)
    return plan, coverage.CROWD.votes(plan)


def test_raters_vote_as_planted(votes):
    plan, of = votes
    cells = [v for rater in of.of.values() for v in rater.values() if v.trial.kind == "pair"]
    share = sum((v.chosen == "a") + (v.chosen == "same") / 2 for v in cells) / len(cells)
    codes = [rater.code for rater in plan.raters]
    assert share == pytest.approx(coverage.CROWD.preference("a", "b", codes), abs=0.05)


def test_ten_raters_cover_and_two_do_not(capsys):
    truth = coverage.CROWD.preference("a", "b")
    ten, _, _ = coverage.row((40, 10), 30, 200, truth)
    two, _, _ = coverage.row((40, 2), 30, 200, truth)
    assert ten["palpate"] >= 26 > two["palpate"] >= 15
    assert two["these"] >= 25
    assert ten["Wilson"] < 26
