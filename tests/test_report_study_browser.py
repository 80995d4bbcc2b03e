"""The page of a study in a browser: widths, light, dark and print; screenshots as of the page."""

import dataclasses
import runpy
from pathlib import Path

import pytest

from forge.results import score, study_results
from palpate.report import write_report
from palpate.report.study import Claim, StudyTable
from test_report_browser import OVERFLOW, UNFOLD, opened, screenshot

LONG = "a_method_with_a_name_that_no_line_of_a_phone_can_hold_2024_11_21_rig_b_second_run"

pytestmark = pytest.mark.browser

#: Text of claims and tables that is cut: wider than its box, where that does not scroll.
CUT = """[...document.querySelectorAll('#claims, #study')]
    .flatMap(s => [...s.querySelectorAll('th, td, p, li, summary, h3')])
    .filter(e => e.checkVisibility() && !e.closest('.hidden')
        && e.getBoundingClientRect().right > (e.closest('.wide') ? 1e9 : innerWidth))
    .map(e => e.textContent.slice(0, 80))"""
HEADS = "getComputedStyle(document.querySelector('.claims thead')).position"


def long_study(folder):
    """A study whose every name is too long, with 20 rows."""
    results = study_results(folder, 12)
    rows = [[f"{LONG} {k}", score(value=k / 7), LONG, score(value=None)] for k in range(20)]
    table = StudyTable(LONG, f"On {LONG}.", ["method", LONG, "words", "none"], rows, True, [])
    claims = [Claim(f"{LONG} {k}", LONG, "undecided", LONG, [score()]) for k in range(12)]
    return dataclasses.replace(
        results, tables=[*results.tables, table], claims=[*results.claims, *claims]
    )


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A page as studies write it, and one of names that are too long."""
    folder = tmp_path_factory.mktemp("study")
    made = {"study": study_results(folder, 40, 96), "long": long_study(folder)}
    return {
        name: write_report(results, folder / f"{name}.html", base=folder).page
        for name, results in made.items()
    }


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
@pytest.mark.parametrize("name", ["study", "long"])
def test_claims_and_tables_fit(chromium, pages, name, width, scheme):
    with opened(chromium, pages[name], width, scheme) as page:
        for state in ("folded", "open"):
            if state == "open":
                page.evaluate(UNFOLD)
            else:
                screenshot(page, f"study-{name}-{width}-{scheme}")
            assert not page.evaluate(OVERFLOW), state
            assert page.evaluate(CUT) == []
        if width == 390:  # claims become blocks, each value below its name
            assert page.evaluate(HEADS) == "absolute"


def test_a_study_keeps_the_limits_of_a_page_and_prints_its_tables(chromium, pages, tmp_path):
    tool = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "page.py"))
    facts = tool["measure"](chromium, pages["study"], (1280, 800), None)
    assert tool["problems"](facts, (1280, 800)) == []
    assert facts["print pages"] <= 8
    with opened(chromium, pages["study"], 800, "dark") as page:
        page.emulate_media(media="print")
        screenshot(page, "study-print")
