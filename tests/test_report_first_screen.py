"""The first screen: what it is about, three cards, and the best of each column of the verdict."""

import re

import pytest

from forge.results import Tree, clean_audit, full_audit, full_results, gallery, score
from palpate.core import Note
from palpate.report.first_screen import about, annotated, cards, caution, telling_columns
from palpate.report.page import render_page
from palpate.report.records import Claim, StudyTable
from palpate.report.results import Results
from palpate.report.tables import defined, families, grid


def measured(third="background only"):
    """Two methods, a control and the real images, under two presets."""
    accuracy = {"higher_is_better": True, "details": {"chance": 0.1}, "null": None, "floor": None}
    values = (("ours", 1.4, 0.5), ("theirs", 1.1, 0.6), (third, 7.0, 0.2))
    presets = [{"preset": name} for name in ("grouped", "paper")]
    scores = [score("TMMD", s, v, settings=p) for p in presets for s, v, _ in values]
    scores += [score("D-TMMD", s, v, higher_is_better=None) for s, v, _ in values]
    scores += [score("material accuracy", s, v, **accuracy) for s, _, v in values]
    return [*scores, score("material accuracy", "real", 0.9, **accuracy)]


def verdict(scores, controls=()):
    """Subject -> its cells, as they are laid out from the most telling columns."""
    rows = grid(telling_columns(families(scores, controls))).rows
    return {row.cells[0].value: row.cells[1:] for row in rows}


def best(cells):
    return [cell.best for cell in cells]


def test_the_verdict_has_each_metric_once_and_the_best_but_never_the_real_images():
    columns = telling_columns(families(measured()))
    assert [c.name for c in columns] == ["TMMD", "material accuracy", "D-TMMD"]
    rows = verdict(measured())
    assert list(rows) == ["ours", "theirs", "background only", "real images (floor)"]
    assert best(rows["theirs"]) == [True, True, True]
    others = ("ours", "background only", "real images (floor)")
    assert not any(mark for name in others for mark in best(rows[name]))
    (tmmd, accuracy, d_tmmd) = rows["real images (floor)"]
    assert (tmmd.value, accuracy.score.value, d_tmmd.value) == ("0.04", 0.9, "0.04")


def test_controls_of_a_study_follow_the_methods_and_are_never_the_best():
    rows = grid(telling_columns(families(measured("other"), ["theirs"]))).rows
    assert [(row.cells[0].value, row.control, row.rule) for row in rows] == [
        ("ours", False, False),
        ("other", False, False),
        ("theirs", True, True),
        ("real images (floor)", False, True),
    ]
    assert best(rows[0].cells[1:]) == [True, True, True]
    assert not any(mark for row in rows[1:] for mark in best(row.cells))


def test_a_ratio_that_is_not_known_is_never_the_best_and_has_its_note():
    note = Note("unstable-denominators", {"known_errors": True, "classes": ["Brick"]})
    wild = score("D-TMMD", "wild", 0.05, higher_is_better=None, notes=[note])
    others = [score("D-TMMD", s, v, higher_is_better=None) for s, v in (("a", 1.0), ("b", 2.0))]
    columns = telling_columns(families([wild, *others]))
    sheet = grid(columns)
    ((cell,), (a,), *_) = (row.cells[1:] for row in sheet.rows)
    assert (cell.best, a.best) == (False, True)
    assert note in [sheet.notes[k - 1] for k in sheet.footnotes(cell)]


def test_a_metric_that_is_undefined_is_not_filled_from_another_preset():
    presets = [{"preset": name} for name in ("grouped", "paper")]
    scores = [score("TMMD", s, 1.0, settings=p) for p in presets for s in ("a", "b")]
    d = {"higher_is_better": None, "interval": None}
    scores += [score("D-TMMD", s, None, settings=presets[0], **d) for s in ("a", "b")]
    scores += [score("D-TMMD", s, 0.5, settings=presets[1], **d) for s in ("a", "b")]
    column = telling_columns(families(scores))[1]
    assert (column.name, [defined(s) for s in column.scores]) == ("D-TMMD", [False, False])
    assert [c.title for c in cards(Results("T", scores=scores), [column])] == []


def test_cards_hold_the_leak_the_distance_and_the_material():
    results = Results("T", audits=[full_audit(), clean_audit()], scores=measured())
    columns = telling_columns(families(results.scores))
    leak, distance, material = cards(results, columns)
    assert [(r.label, r.text) for r in leak.rows] == [
        ("Orig", "leaks, 99.10 %"),
        ("NoLeak", "no leak found"),
    ]
    assert "image; median of Orig: 304 frames away." in leak.foot
    assert [r.text for r in distance.rows] == ["1.40", "1.10", "7.00"]
    assert re.search(r'class="null".*class="floor".*class="interval"', distance.strip)
    assert [r.text for r in material.rows] == ["50.0 %", "60.0 %", "20.0 %", "90.0 %"]
    assert "chance, 10.0 %" in material.foot


PHOTO = "real, nearest photo"


@pytest.mark.parametrize(
    ("distances", "shares", "controls", "labels"),
    [
        # The first method, the best other one, others as they come, and a control.
        (
            {"ours": 2.0, "variant": 3.0, "GVST": 1.0, "mean": 9.0, PHOTO: 0.5},
            {},
            ["mean", PHOTO],
            [["ours", "GVST", "variant", f"{PHOTO} (control)"]],
        ),
        # The card of the material always holds the real images.
        (
            {},
            {**{f"m{k}": k / 10 for k in range(6)}, "real": 0.9},
            [],
            [["m0", "m5", "m1", "real"]],
        ),
        # A method that is first by distance and knows no material does not vanish.
        (
            {"ours": 2.0, "near": 0.1, "other": 3.0, PHOTO: 0.5},
            {"ours": 0.5, "other": 0.7, "near": 0.1, PHOTO: 0.4, "real": 0.8},
            [PHOTO],
            [
                ["ours", "near", "other", f"{PHOTO} (control)"],
                ["ours", "near", f"{PHOTO} (control)", "real"],
            ],
        ),
        # A card never loses its method to controls.
        (
            dict.fromkeys(["ours", "a", "b", "c"], 1.0),
            dict.fromkeys(["ours", "a", "b", "c", "real"], 0.5),
            ["a", "b", "c"],
            [
                ["ours", "b (control)", "c (control)", "a (control)"],
                ["ours", "b (control)", "c (control)", "real"],
            ],
        ),
    ],
)
def test_cards_compare_the_same_subjects(distances, shares, controls, labels):
    more = {"higher_is_better": True, "null": None, "floor": None}
    scores = [score("TMMD", s, v) for s, v in distances.items()]
    scores += [score("material accuracy", s, v, **more) for s, v in shares.items()]
    drawn = cards(Results("T", scores=scores), telling_columns(families(scores)), controls)
    assert [[row.label for row in card.rows] for card in drawn] == labels
    assert [f"4 of {n} rows." in drawn[0].foot for n in (5, 7)] == [
        len(distances) == 5,
        not distances,
    ]
    assert all("interval" in row.drawing for row in drawn[0].rows[1:])


@pytest.mark.parametrize("low", [0.2, 0.3])
def test_a_probe_that_does_not_read_real_images_says_so(low):
    more = {"higher_is_better": True, "null": None, "floor": None, "details": {"chance": 0.25}}
    scores = [
        score("material accuracy", s, 0.5, interval=(low, 0.6), **more) for s in ("a", "real")
    ]
    made = cards(Results("T", scores=scores), telling_columns(families(scores)))[0]
    assert ("tell real images from chance, 25.0 % (dashed)" in made.foot) == (low < 0.25)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"details": {"p_value": 0.3}}, "p = 0.3: not shown to differ from real"),
        ({"details": {"p_value": 0.00001}}, "p < 0.001: differs from real"),
        ({}, ""),  # a mean over seeds
        # A collapsed generator: inside its null, which says nothing of real images.
        ({"metric": "CI-TMMD"}, "the interval is below the floor: images vary less than real ones"),
        ({"metric": "CI-TMMD", "floor": 0.001}, "the interval holds the floor"),
        ({"metric": "D-TMMD", "floor": -1.0}, "the interval is above the floor"),
    ],
)
def test_a_card_says_what_is_shown_against_real_images(values, words):
    values = {"metric": "TMMD", "floor": 1.858, **values}
    if values["metric"] != "TMMD":
        values["higher_is_better"] = None
    scores = [score(value=-0.001, interval=(-0.004, 0.002), null=(-0.1, 0.1), **values)]
    (card,) = cards(Results("T", scores=scores), telling_columns(families(scores)))
    assert words in card.foot
    assert "band" not in card.foot
    assert ("real" in card.foot.partition("dashed: real images")[2]) == ("real" in words)


def test_what_is_said_of_small_runs_of_clean_splits_and_of_the_drawings():
    assert "can decide nothing" in caution(Results("T", settings={"preset": "smoke"}))
    assert caution(Results("T", settings={"preset": "mini"})) == ""
    (card,) = cards(Results("T", audits=[clean_audit()]), [])[:1]
    assert (card.rows[0].text, card.foot) == ("no leak found", "")
    column, chosen = annotated(families([score("SSIM", null=None), score()]))
    assert (column.name, chosen.metric) == ("TMMD", "TMMD")
    assert annotated(families([score(null=None)])) is None


def test_what_a_page_is_about():
    results = Results("T", audits=[full_audit()], settings={"dataset": "Touch and Go"})
    facts = ["Touch and Go", "29,879 test samples of 106 videos", "91,982 train samples"]
    assert about(results, "2026-11-23", "1.0") == [*facts, "2026-11-23", "palpate 1.0"]
    assert about(Results("T", scores=[score()]), "today", "1.0")[0] == "240 samples"
    claims, notes = [Claim("c", "s", "holds", "")], [Note("synthetic-data")]
    study = Results("T", settings={"dataset": "W", "seeds": [0, 1]}, claims=claims, notes=notes)
    assert about(study, "today", "1.0")[:2] == ["W, all simulated", "2 seeds"]
    made = {"versions": {"palpate": "0.9"}, "stages": {"a": {"date": "2026-01-02"}, "b": {}}}
    assert about(Results("T", settings=made), "today", "1.0") == ["2026-01-02", "palpate 0.9"]


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
    assert re.findall(r"<h2[^>]*>([^<]*)", bare) == ["Cite"]
    scores = [score(metric, "Ours") for metric in ("TMMD", "SSIM", "FID")]
    tables = [StudyTable("T", "", ["", "v"], [["Ours", scores[0]]])]
    methods = {"methods": {"Ours": "By a photo."}}
    results = Results("T", scores=scores, tables=tables, settings=methods)
    assert "By a photo." in Tree(render_page(results, tmp_path, max_bytes=200_000)).text
