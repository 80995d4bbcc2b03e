"""The table model of scores: tables, columns, best marks, footnotes, differences and matrices."""

from dataclasses import replace

import pytest

from forge.results import difference, score, text_note
from palpate.core import Note, PalpateError
from palpate.report.labels import (
    decimals,
    label_of,
    number,
    percent,
    plural,
    score_text,
    subject_of,
)
from palpate.report.page import matrices
from palpate.report.results import Results
from palpate.report.tables import columns, families, family_of, grids, listing, of_differences
from palpate.report.terminal import rankings


@pytest.mark.parametrize(
    ("function", "args", "text"),
    [
        (number, (None,), "–"),
        (number, (float("nan"),), "–"),
        (number, (-0.0001, 2), "0.00"),
        (number, (-1234.5, 1), "−1,234.5"),
        (number, (0.000123,), "0.000123"),
        (percent, (0.0,), "0 %"),
        (percent, (1e-6,), "< 0.01 %"),
        (percent, (0.005,), "0.50 %"),
        (percent, (0.99056,), "99.06 %"),
        (percent, (0.99999,), "> 99.99 %"),
        (percent, (1.0,), "100 %"),
        (score_text, (1.0,), "1.000"),
        (score_text, (0.99996,), "0.99996"),
        *((decimals, ([v],), d) for v, d in ((1234.0, 0), (12.0, 2), (0.5, 3), (0.0123, 4))),
        (decimals, ([],), 1),
        (plural, (1, "video"), "1 video"),
    ],
)
def test_numbers_are_written_for_people(function, args, text):
    assert function(*args) == text


@pytest.mark.parametrize(
    ("metric", "title"),
    [
        ("CI-TMMD", "Tactile features"),
        ("CMMD", "Image distributions"),
        ("recall", "Image distributions"),
        ("contact SSIM", "Image by image"),
        ("recall@5", "Recognition"),
        ("novel", "Other metrics"),
    ],
)
def test_families(metric, title):
    assert family_of(score(metric))[1] == title


def test_scores_of_a_family_are_one_table_with_what_they_share():
    scores = [
        score("TMMD", "a", seed=1),
        score("TMMD", "b", seed=2),
        score("I-TMMD", "a", n=100),
        score("I-TMMD", "b", n=200),
    ]
    (table,) = families(scores)
    assert [(c.name, c.size) for c in table.columns] == [("TMMD", "n = 240"), ("I-TMMD", "")]
    assert [row.cells[2].below[-1] for row in grids(table)[0].rows[:2]] == ["n = 100", "n = 200"]
    assert (table.facts["bandwidth σ"], table.facts["TMMD, seed"]) == ("10", "1, 2")
    (laid,) = grids(*families([score(seed=1), score(seed=2)]))
    assert [row.cells[0].value for row in laid.rows] == ["a", "a", "real images (floor)"]


@pytest.mark.parametrize(
    ("changes", "titles"),
    [
        (
            [{"settings": {"preset": "paper"}}, {"settings": {"preset": "grouped"}}],
            ["paper: the paper's formula", "grouped: whole groups"],
        ),
        ([{"split": "a" * 64}, {"split": "b" * 64}], ["split aaaa", "split bbbb"]),
        ([{"reference": "a" * 64}, {"reference": "b" * 64}], ["reference aaaa", "reference bbbb"]),
        ([{"features": "tactile"}, {"features": "CLIP (v2) vision"}], ["tactile", "(v2) vision"]),
    ],
)
def test_other_presets_splits_references_and_features_have_their_own_tables(changes, titles):
    tables = families([score(**change) for change in changes])
    assert len(tables) == len(titles)
    assert all(title in table.title for title, table in zip(titles, tables, strict=True))
    assert [bool(t.question) for t in tables] == [True, False]


def test_scores_without_reference_go_with_their_subject():
    scores = [
        score("TMMD", "a", reference="r1"),
        score("I-TMMD", "a"),
        score("TMMD", "b", reference="r2"),
        score("I-TMMD", "b"),
    ]
    first, second = families(scores)
    subjects = [{s.a for c in t.columns for s in c.scores} for t in (first, second)]
    assert subjects == [{"a"}, {"b"}]
    assert [c.name for c in second.columns] == ["TMMD", "I-TMMD"]
    networks = [score("KID", "a", reference="r1", encoder="e"), score("CMMD", "a", reference="r2")]
    assert len(families(networks)) == 1  # features of several networks, of one run
    for change in ({"bandwidth": 5.0}, {"encoder": "e"}, {"scale": 1.0}):
        with pytest.raises(PalpateError, match="must agree in"):
            families([score(), score(subject="b", **change)])


@pytest.mark.parametrize(
    ("differences", "best"),
    [
        ([difference("a", "b", better="a"), difference("a", "c", better="a")], "a"),
        ([difference("a", "b", better="a"), difference("a", "c")], None),
        ([difference("a", "b", metric="I-TMMD", better="a")], None),
        ([], None),
    ],
)
def test_the_dagger_needs_a_decided_difference_against_every_other(differences, best):
    (family,) = families([*(score(subject=s) for s in "abc"), *differences])
    assert family.columns[0].winner == best


def test_the_best_by_value_is_among_those_that_are_compared():
    scores = [score(subject=s, value=v) for s, v in (("a", 2.0), ("b", 3.0), ("photo", 1.0))]
    best = [
        [cell.value.a for cell in column.cells if cell.best]
        for all_scores in (scores, [*scores, difference("a", "b")])
        for column in families(all_scores)[0].columns[:1]
    ]
    assert best == [["photo"], ["a"]]


@pytest.mark.parametrize("control", ["background only", "nearest photo"])
def test_no_mark_falls_on_a_control_and_none_where_one_method_is_left(control):
    scores = [score(subject=s, value=v) for s, v in (("a", 2.0), ("b", 3.0), (control, 1.0))]
    for several, best in ((scores, ["a"]), (scores[1:], [])):
        (family,) = families(several, ["nearest photo"])
        for table in (listing(family), *grids(family)):
            marked = [row for row in table.rows if any(cell.best for cell in row.cells)]
            assert [
                next(c.value for c in r.cells if c.value in ("a", "b", control)) for r in marked
            ] == best


def test_a_floor_has_the_decimals_of_its_first_digit():
    scores = [
        score(subject="a", value=123.4, interval=(110.0, 140.0), floor=0.05, null=(-0.3, 4.0))
    ]
    (family,) = families(scores)
    assert listing(family).plain()[1][0][2:7] == ["123", "[110, 140]", "[-0.3, 4]", "0.05", "240"]


def test_more_than_two_generators_are_ranked():
    def pair(a, b, p_better, p):
        d = difference(a, b)
        return replace(d, details={**d.details, "p_better": p_better, "p_adjusted": p})

    pairs = [pair("a", "b", 0.01, 0.02), pair("a", "c", 0.3, 0.6), pair("b", "c", 0.9, 0.2)]
    few = families([score(subject="a"), score(subject="b"), difference("a", "b")])[0]
    assert rankings(few) is None
    (row,) = of_differences(few).plain()[1]
    assert row == ["TMMD ↓", "a", "b", "-1.00 [-1.50, -0.50]", "97.5 %", "0.05"]
    results = Results("Scores", scores=[*(score(subject=s) for s in "abc"), *pairs])
    (table,) = families(results.scores)
    assert rankings(table).plain()[1] == [["TMMD ↓", "b ~ c ~ a"]]  # b and a are no neighbors
    assert "b ~ c ~ a" in str(results)
    assert "a - b" not in str(results)
    decided = [pairs[0], pair("a", "c", 0.01, 0.001), pairs[2]]
    (other,) = families([*results.scores[:3], *decided])
    assert rankings(other).plain()[1] == [["TMMD ↓", "b ~ c > a"]]


def test_pools_of_different_sizes_have_a_column_each():
    scores = [score("top-1", settings={"pool": pool}) for pool in (24, 100)]
    assert [[s.settings["pool"] for s in column] for column in columns(scores)] == [[24], [100]]


def test_a_table_is_headed_by_the_features_and_a_column_by_the_kernel():
    fields = {"features": "CLIP (v2) vision", "kernel": "σ (wide)"}
    (table,) = families([score("CMMD", **fields), score("CMMD", features="CLIP (v2) vision")])
    assert table.title == "Image distributions of CLIP (v2) vision"
    assert [c.label for c in table.columns] == ["CMMD (σ (wide))", "CMMD"]
    assert table.columns[0].name == "CMMD (CLIP (v2) vision) (σ (wide))"


@pytest.mark.parametrize(
    ("fields", "names"),
    [
        ({}, ("TMMD", "ours")),
        ({"features": "CLIP", "kernel": "σ = 5"}, ("TMMD (CLIP) (σ = 5)", "ours")),
        ({"settings": {"pool": 24}, "features": "a by b"}, ("TMMD of 24 (a by b)", "ours")),
        ({"kind": "excess"}, ("TMMD E", "ours")),
        ({"kind": "excess", "b": "theirs"}, ("TMMD E difference", "ours - theirs")),
        ({"kind": "difference", "b": "theirs"}, ("TMMD difference", "ours - theirs")),
        ({"kind": "lead", "b": "theirs"}, ("TMMD, ahead", "ours against theirs")),
        ({"kind": "effect size", "b": "theirs"}, ("effect size of TMMD", "ours - theirs")),
    ],
)
def test_the_label_joins_the_fields(fields, names):
    s = score(subject="ours", **fields)
    assert (label_of(s), subject_of(s)) == names


def test_equal_notes_have_one_number():
    copied = Note("copied-rows", {"count": 1, "n": 5})
    other = Note("copied-rows", {"count": 2, "n": 5})
    scores = [
        score(subject="a", notes=(copied, text_note("Seen."))),
        score(subject="b", notes=(other, Note("copied-rows", {"count": 1, "n": 5}))),
    ]
    (table,) = families(scores)
    written = listing(table)
    assert [written.footnotes(row.cells[-1]) for row in written.rows] == [[1, 2], [1, 3]]
    assert written.notes == [copied, text_note("Seen."), other]


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"floor": None}, "no-floor-of-tmmd"),
        ({"metric": "I-TMMD", "floor": None}, "floor-unknown"),
        ({"details": {"excluded": {"a": "few"}}}, "excluded-classes"),
        ({"metric": "contact SSIM", "details": {"empty": 28.6}}, "no-contact-baseline"),
    ],
)
def test_what_follows_from_the_fields_of_a_score_is_a_note(changes, code):
    assert [note.code for note in listing(families([score(**changes)])[0]).notes] == [code]
    assert listing(families([score("FID", floor=None)])[0]).notes == []


def test_only_square_matrices_of_numbers_are_drawn():
    grids_of_numbers = [[[0.1, 2.0], [2.0, None]], [[1.0, 2.0]], "text"]
    scores = [
        score("D-TMMD", details={"matrix": m, "classes": ["x", "y"]}) for m in grids_of_numbers
    ]
    (heat,) = matrices(Results("T", scores=scores))
    assert [head.label for head in heat.heads] == ["", "x", "y"]
    assert [[(cell.value, cell.share) for cell in row.cells] for row in heat.rows] == [
        [("x", 0.0), ("0.100", 0.05), ("2.000", 1.0)],
        [("y", 0.0), ("2.000", 1.0), ("–", 0.0)],
    ]
