"""The page of a study in a browser: widths, light, dark and print; screenshots as of the page."""

import dataclasses
import runpy
from pathlib import Path

import pytest

from palpate.report import write_report
from palpate.report.study import Claim, Curve, Line, StudyTable
from report_fixtures import score, study_results
from test_report_browser import OVERFLOW, UNFOLD, luminance, opened, screenshot

LONG = "a_method_with_a_name_that_no_line_of_a_phone_can_hold_2024_11_21_rig_b_second_run"

pytestmark = pytest.mark.browser

#: Text of claims, tables and curves that is cut: wider than its box, where that does not scroll.
CUT = """[...document.querySelectorAll('#claims, #study, #curves')]
    .flatMap(s => [...s.querySelectorAll('th, td, p, li, summary, h3')])
    .filter(e => e.checkVisibility() && !e.closest('.hidden')
        && e.getBoundingClientRect().right > (e.closest('.wide') ? 1e9 : innerWidth))
    .map(e => e.textContent.slice(0, 80))"""
#: Drawings whose words leave them.
OUTSIDE = """[...document.querySelectorAll('svg.drawing')].flatMap(s => {
    const box = s.getBoundingClientRect();
    return [...s.querySelectorAll('text')].filter(e => {
        const b = e.getBoundingClientRect();
        return b.left < box.left - 1 || b.right > box.right + 1 || b.bottom > box.bottom + 1;
    }).map(e => e.textContent);
})"""
#: Words of a drawing that lie on each other.
ONTO = """[...document.querySelectorAll('svg.drawing')].flatMap(s => {
    const all = [...s.querySelectorAll('text')]
        .map(e => [e.textContent, e.getBoundingClientRect()]);
    const apart = (a, b) => a.right <= b.left || b.right <= a.left
        || a.bottom - 3 <= b.top || b.bottom - 3 <= a.top;
    return all.flatMap(([t, a], k) => all.slice(k + 1)
        .filter(([, b]) => !apart(a, b)).map(([u]) => [t, u]));
})"""
#: Colors of lines and words of a drawing, on the paper.
INKS = """[...document.querySelectorAll('svg.drawing path, svg.drawing text')].map(e => {
    const style = getComputedStyle(e);
    const stroke = style.stroke !== 'none';
    return (e.tagName === 'text' ? 'text' : stroke ? 'line' : 'area') + '|'
        + (stroke ? style.stroke : style.fill) + '|'
        + getComputedStyle(document.body).backgroundColor;
})"""
SHOWN = """[...document.querySelectorAll('h3')]
    .filter(e => e.checkVisibility()).map(e => e.textContent)"""
FIRST_LINE = """getComputedStyle(
    document.querySelector('svg.drawing path[style*="stroke:var(--line1"]')).stroke"""
HEADS = "getComputedStyle(document.querySelector('.claims thead')).position"


def long_study(folder):
    """A study whose every name is too long, with 20 rows, many lines and lone points."""
    results = study_results(folder, 12)
    rows = [[f"{LONG} {k}", score(value=k / 7), LONG, score(value=None)] for k in range(20)]
    table = StudyTable(
        LONG, f"On {LONG}.", ["method", LONG, "words", "none"], rows, True, [], False
    )
    lines = [
        Line(f"{LONG} {k}", [(x, score(value=k + x / 3)) for x in range(1, 1 + 5 * (k % 3) or 2)])
        for k in range(9)
    ]
    many = Line("many", [(10.0**k, score(value=1e5 * k, interval=None)) for k in range(-4, 8)])
    curves = [
        Curve(LONG, f"Of {LONG}.", LONG, LONG, lines),
        Curve("Many", "", "x", "y", [many], log_x=True),
        Curve("Linear", "", "x", "y", [Line("a", [(k, score(value=k)) for k in range(40)])]),
    ]
    claims = [Claim(f"{LONG} {k}", LONG, "undecided", LONG, [score()]) for k in range(12)]
    return dataclasses.replace(
        results,
        tables=[*results.tables, table],
        curves=[*results.curves, *curves],
        claims=[*results.claims, *claims],
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


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["study", "long"])
def test_claims_tables_and_curves_fit_and_no_word_lies_on_another(
    chromium, pages, name, width, scheme
):
    with opened(chromium, pages[name], width, scheme) as page:
        for state in ("folded", "open"):
            if state == "open":
                page.evaluate(UNFOLD)
            else:
                screenshot(page, f"study-{name}-{width}-{scheme}")
            assert not page.evaluate(OVERFLOW), state
            assert page.evaluate(CUT) == []
        assert page.evaluate(OUTSIDE) == []
        assert page.evaluate(ONTO) == []
        if width == 390:  # claims become blocks, each value below its name
            assert page.evaluate(HEADS) == "absolute"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_lines_and_words_of_curves_have_the_contrast_of_wcag(chromium, pages, scheme):
    with opened(chromium, pages["long"], scheme=scheme) as page:
        inks = {tuple(ink.split("|")) for ink in page.evaluate(INKS)}
    lines = [ink for ink in inks if ink[0] == "line"]
    assert len(lines) >= 7
    gray = {"rgb(217, 222, 227)", "rgb(48, 54, 61)"}  # the grid may be faint
    for kind, color, paper in inks:
        a, b = sorted((luminance(color), luminance(paper)), reverse=True)
        if kind != "area" and color not in gray:
            assert (a + 0.05) / (b + 0.05) >= (4.5 if kind == "text" else 3), (kind, color)


def test_a_study_keeps_the_limits_of_a_page_and_prints_its_tables(chromium, pages, tmp_path):
    tool = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "page.py"))
    facts = tool["measure"](chromium, pages["study"], (1280, 800), None)
    assert tool["problems"](facts, (1280, 800)) == []
    assert facts["print pages"] <= 8
    with opened(chromium, pages["study"], 800, "dark") as page:
        page.emulate_media(media="print")
        assert {"Table 4: generators", "What generation is for"} <= set(page.evaluate(SHOWN))
        assert page.evaluate(FIRST_LINE) == "rgb(0, 114, 178)"  # as on paper, though it is dark
        screenshot(page, "study-print")
