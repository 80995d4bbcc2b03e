"""The first screen: what it is about, three cards, and the best of each column of the verdict."""

import re

import pytest

from palpate.report.first_screen import about, annotated, cards, telling_columns, verdict
from palpate.report.page import render_page
from palpate.report.results import Results
from palpate.report.tables import score_tables
from report_fixtures import Tree, clean_audit, full_audit, full_results, gallery, score


def measured():
    """Two methods, a control and the real images, under two presets."""
    accuracy = {"higher_is_better": True, "details": {"chance": 0.1}, "null": None, "floor": None}
    values = (("ours", 1.4, 0.5), ("theirs", 1.1, 0.6), ("background only", 7.0, 0.2))
    presets = [{"preset": name} for name in ("grouped", "paper")]
    scores = [score("TMMD", s, v, settings=p) for p in presets for s, v, _ in values]
    scores += [score("D-TMMD", s, v, higher_is_better=None) for s, v, _ in values]
    scores += [score("material accuracy", s, v, **accuracy) for s, _, v in values]
    return [*scores, score("material accuracy", "real", 0.9, **accuracy)]


def test_the_verdict_has_each_metric_once_and_the_best_but_never_the_real_images():
    columns = telling_columns(score_tables(measured()))
    assert [c.metric for c in columns] == ["TMMD", "material accuracy", "D-TMMD"]
    rows = {row.subject: row.cells for row in verdict(columns)}
    assert list(rows) == ["ours", "theirs", "background only", "real images (floor)"]
    best = {subject: [cell.best for cell in cells] for subject, cells in rows.items()}
    assert best["theirs"] == [True, True, True]
    assert not any(best["ours"] + best["background only"] + best["real images (floor)"])
    assert [cell.text for cell in rows["real images (floor)"]] == ["0.042", "0.900", "0.042"]


def test_controls_of_a_study_follow_the_methods_and_are_never_the_best():
    columns = telling_columns(score_tables(measured()))
    rows = verdict(columns, ["theirs"])
    assert [(row.subject, row.control) for row in rows] == [
        ("ours", False),
        ("background only", False),
        ("theirs", True),
        ("real images (floor)", False),
    ]
    assert [cell.best for cell in rows[0].cells] == [True, True, True]
    assert not any(cell.best for row in rows[1:] for cell in row.cells)


def test_numbers_that_are_written_alike_are_equally_good():
    scores = [score("SSIM", s, v, higher_is_better=True) for s, v in (("a", 0.50004), ("b", 0.5))]
    rows = verdict(
        telling_columns(score_tables([*scores, score("SSIM", "c", 0.4, higher_is_better=True)]))
    )
    assert [row.cells[0].best for row in rows[:3]] == [True, True, False]


def test_one_method_alone_is_best_of_nothing():
    (row, floor) = verdict(telling_columns(score_tables([score()])))
    assert (row.cells, floor.subject) == (
        [("1.374", False, "[1.010, 1.750]")],
        "real images (floor)",
    )


def test_cards_hold_the_leak_the_distance_and_the_material():
    results = Results("T", audits=[full_audit(), clean_audit()], scores=measured())
    columns = telling_columns(score_tables(results.scores))
    leak, distance, material = cards(results, columns)
    assert [(r.label, r.text) for r in leak.rows] == [("Orig", "99.10 %"), ("NoLeak", "0 %")]
    assert "median of 304" in leak.foot
    assert [r.text for r in distance.rows] == ["1.400", "1.100", "7.000"]
    assert re.search(r'class="null".*class="floor".*class="interval"', distance.strip)
    assert distance.foot.endswith("outside the gray band: it differs from real.")
    assert [r.text for r in material.rows] == ["50.0 %", "60.0 %", "20.0 %", "90.0 %"]
    assert "chance, 10.0 %" in material.foot


def test_the_card_of_the_material_always_holds_the_real_images():
    accuracy = {"higher_is_better": True, "null": None, "floor": None}
    scores = [score("material accuracy", f"m{k}", k / 10, **accuracy) for k in range(6)]
    scores.append(score("material accuracy", "real", 0.9, **accuracy))
    (card,) = cards(Results("T", scores=scores), telling_columns(score_tables(scores)))
    assert [row.label for row in card.rows] == ["m0", "m1", "m2", "real"]


@pytest.mark.parametrize(
    ("value", "words"), [(0.05, "no difference from real is shown"), (0.07, "it differs from real")]
)
def test_a_card_says_what_the_null_says(value, words):
    scores = [score(value=value)]
    (card,) = cards(Results("T", scores=scores), telling_columns(score_tables(scores)))
    assert words in card.foot


def test_cards_of_an_audit_alone_say_what_gives_it_away_and_what_it_costs():
    titles = [card.title for card in cards(Results("T", audits=[full_audit()]), [])]
    assert titles == [
        "Test samples that leak from train",
        "What gives Orig away",
        "Material accuracy, 1-NN on tactile pixels",
    ]
    (*_, near) = cards(Results("T", audits=[full_audit(impact=None)]), [])
    assert [row.text for row in near.rows] == ["31", "304", "2,485"]
    assert cards(Results("T"), []) == []


def test_what_a_page_is_about():
    results = Results("T", audits=[full_audit()], settings={"dataset": "Touch and Go"})
    facts = ["Touch and Go", "29,879 test samples of 106 videos", "91,982 train samples"]
    assert about(results, "2026-11-23", "1.0") == [*facts, "2026-11-23", "palpate 1.0"]
    assert about(Results("T", scores=[score()]), "today", "1.0")[0] == "240 samples"


def test_strips_are_explained_on_a_score_with_interval_null_and_floor():
    column, chosen = annotated(score_tables([score("SSIM", null=None), score()]))
    assert (column.metric, chosen.metric) == ("TMMD", "TMMD")
    assert annotated(score_tables([score(null=None)])) is None


def test_a_page_opens_with_samples_and_cards_and_has_no_empty_heading(tmp_path):
    html = render_page(full_results(tmp_path), tmp_path, max_bytes=1_500_000)
    places = [html.index(part) for part in ('class="hero"', 'class="card"', 'id="scores"')]
    places += [html.index(part) for part in ('id="gallery"', 'id="leakage"', 'id="cite"')]
    assert places == sorted(places)
    assert 'loading="lazy"' in html
    assert "<code>cdcdcdcdcdcd</code>" in html
    assert "cd" * 7 not in html
    assert "@inproceedings{gungor2025towards" in Tree(html).text
    bare = render_page(Results("T", gallery=gallery(tmp_path, 1)), tmp_path, max_bytes=1_500_000)
    headings = re.findall(r"<h2[^>]*>([^<]*)", bare)
    assert headings == ["Cite"]
