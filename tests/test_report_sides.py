"""Scores of different references stand apart, what has no reference stays with its subject, and every remark is said once."""

import dataclasses

import pytest

from palpate.cli import main
from palpate.core import Score
from palpate.report import render_markdown, render_page, summary_lines, tables
from palpate.report.remarks import (
    INDEPENDENT,
    NEARER,
    Footnotes,
    few,
    left_out,
    no_floor,
    reason,
    remarks,
)
from palpate.report.results import Results
from palpate.report.sides import sides
from palpate.report.tables import GEL, heat_tables, parts, score_tables, settings_of

ONE, TWO, THIRD = "1" * 64, "2" * 64, "3" * 64


def scored(metric, subject, reference=None, **more):
    fields = {
        "value": 1.0,
        "settings": {"preset": "grouped"} if "TMMD" in metric else {},
        "n": 10,
        **more,
    }
    return Score(metric, subject, reference=reference, **fields)


def four(subject, reference):
    """One generator against one reference: what has a reference first, or between."""
    return [
        scored("TMMD", subject, reference),
        scored("I-TMMD", subject),
        scored("D-TMMD", subject),
        scored("FID (touch)", subject, reference),
    ]


def shown(scores):
    """Title -> (subject, metric) of every cell."""
    return {
        t.title: {(s, m) for s, row in t.cells.items() for m in row} for t in score_tables(scores)
    }


def test_scores_of_two_references_have_two_tables_and_the_others_stay_with_their_subject():
    found = shown([*four("a", ONE), *four("b", TWO)])
    alike = "Touch features, grouped: whole groups kept together"
    assert found == {
        f"{alike}, reference 11111111": {("a", m) for m in ("TMMD", "I-TMMD", "D-TMMD")},
        f"{alike}, reference 22222222": {("b", m) for m in ("TMMD", "I-TMMD", "D-TMMD")},
        "Image distributions, reference 11111111": {("a", "FID (touch)")},
        "Image distributions, reference 22222222": {("b", "FID (touch)")},
    }


def test_one_generator_against_two_references_keeps_its_rows_in_the_order_of_the_files():
    first, second = four("a", ONE), [dataclasses.replace(s, floor=0.5) for s in four("a", TWO)]
    tables = [t for t in score_tables([*first, *second]) if "Touch" in t.title]
    assert [[len(c) for c in t.cells["a"].values()] for t in tables] == [[1, 1, 1], [1, 1, 1]]
    assert [t.cells["a"]["I-TMMD"][0].score.floor for t in tables] == [None, 0.5]


def test_rows_that_come_late_or_early_go_with_their_subject():
    tmmd, more = (
        [scored("TMMD", n, r) for n, r in (("a", ONE), ("b", TWO))],
        [scored("I-TMMD", n) for n in ("a", "b")],
    )
    for scores in ([*tmmd, *more], [*more, *tmmd], [*reversed(more), *tmmd]):
        assert {frozenset(cells) for cells in shown(scores).values()} == {
            frozenset({(n, "TMMD"), (n, "I-TMMD")}) for n in ("a", "b")
        }


def test_families_without_any_reference_are_not_torn():
    scores = [
        *four("a", ONE),
        scored("SSIM", "a"),
        *four("b", TWO),
        scored("SSIM", "b"),
        scored("material accuracy", "real"),
    ]
    assert shown(scores)["Image by image"] == {("a", "SSIM"), ("b", "SSIM")}


def test_features_of_several_networks_do_not_part_the_scores_of_one_run():
    def run(subject, touch, inception):
        return [
            scored("TMMD", subject, touch, encoder="e"),
            scored("I-TMMD", subject, encoder="e"),
            scored("KID (touch)", subject, touch, encoder="e"),
            scored("FID (Inception)", subject, inception, encoder="i"),
        ]

    one = run("a", ONE, "5" * 64)
    assert len(score_tables(one)) == 2
    assert shown([*one, *run("b", TWO, "6" * 64)])[
        "Image distributions, reference 22222222 and 66666666"
    ] == {("b", "KID (touch)"), ("b", "FID (Inception)")}
    again = sides([*one, *run("b", TWO, "6" * 64), *run("c", ONE, "5" * 64)])
    assert list(again.of) == [0] * 4 + [1] * 4 + [0] * 4


def test_a_file_that_does_not_name_its_reference_stands_apart():
    assert [
        t.title.rpartition(", ")[2]
        for t in score_tables([scored("TMMD", "a"), scored("TMMD", "b", ONE)])
    ] == ["reference not recorded", "reference 11111111"]
    assert len(score_tables([scored("TMMD", "a"), scored("TMMD", "b")])) == 1


def test_matrices_name_the_reference_that_their_table_names():
    def run(reference, **more):
        matrix = {"matrix": [[0.0, 1.0], [1.0, 0.0]]}
        return [
            scored("TMMD", "a", reference, **more),
            scored("D-TMMD", "a", details=matrix, **more),
        ]

    titles = [h.title for h in heat_tables([*run(ONE), *run(TWO)])]
    assert titles == [
        "D-TMMD, a, grouped, reference 11111111",
        "D-TMMD, a, grouped, reference 22222222",
    ]
    assert [h.title for h in heat_tables(run(ONE))] == ["D-TMMD, a, grouped"]
    assert [
        h.title[-14:] for h in heat_tables([*run(ONE, split="5" * 64), *run(ONE, split="6" * 64)])
    ] == ["split 55555555", "split 66666666"]


def test_differences_without_a_direction_are_said_to_be_of_distances_to_the_floor(tmp_path):
    gap = {
        "a": "a",
        "b": "b",
        "gap": 0.1,
        "gap_interval": (-0.2, 0.4),
        "better": "b",
        "p_better": 0.3,
    }
    plain = {"a": "a", "b": "b", "better": "b", "p_better": 0.3}
    scores = [
        scored("TMMD difference", "a - b", ONE, details=plain),
        scored("I-TMMD difference", "a - b", details=gap, higher_is_better=None),
        scored("CI-TMMD difference", "a - b", details=gap, higher_is_better=None),
        scored("D-TMMD difference", "a - b", details=plain, higher_is_better=None),
    ]
    (table,) = score_tables(scores)
    assert table.notes == [NEARER]
    assert [c[0].footnotes for c in table.cells["a - b"].values()] == [[], [1], [1], []]
    assert table.question.endswith(tables.NEARER)
    assert tables.NEARER not in score_tables(scores[:1])[0].question
    assert (
        render_markdown(Results("t", scores=scores)).count("|a - floor|") == 1
    )  # the note is escaped
    assert (
        render_page(Results("t", scores=scores), tmp_path, max_bytes=10**7).count(
            "confidence and p are of |a - floor| - |b - floor|"
        )
        == 2
    )


def test_differences_stand_with_their_reference():
    scores = []
    for reference in (ONE, TWO):
        scores += [*four("a", reference), *four("b", reference)]
        scores += [
            scored(f"{m} difference", "a - b", r)
            for m, r in (("TMMD", reference), ("I-TMMD", None))
        ]
    found = [p for p in parts(scores) if p.differences]
    assert [[s.reference for s in p.scores] for p in found] == [[ONE, None], [TWO, None]]
    assert [p.sides for p in found] == [{0}, {1}]


def test_pages_name_each_reference_and_the_summary_takes_one(tmp_path):
    results = Results(
        "t",
        scores=[*four("a", ONE), *four("b", TWO), scored("TMMD difference", "a - b", THIRD)],
        settings={"seed": 0},
    )
    assert settings_of(results) == {"seed": 0, "real touches compared with": {"a": ONE, "b": TWO}}
    assert settings_of(Results("t", settings={"seed": 0})) == {"seed": 0}
    text = render_markdown(results)
    assert f"- a: `{ONE}`" in text.partition("## Settings and digests")[2]
    assert (
        f"<b>{TWO[:12]}</b>{TWO[12:]}"
        in render_page(results, tmp_path, max_bytes=10**7).partition('id="settings"')[2]
    )
    assert summary_lines(results) == ["TMMD (lower is better): a 1.000."]
    for k, part in enumerate((results.scores[:4], results.scores[4:8])):
        Results(f"Scores {k}", scores=part).save(tmp_path / f"{k}.json")
    assert (
        main(
            [
                "report",
                str(tmp_path / "0.json"),
                str(tmp_path / "1.json"),
                "-o",
                str(tmp_path / "page.html"),
                "-q",
            ]
        )
        == 0
    )
    page = (tmp_path / "page.html").read_text()
    assert all(f"kept together, reference {r[:8]}</h3>" in page for r in (ONE, TWO))


def test_contact_scores_stand_beside_what_the_empty_gel_has(tmp_path):
    scores = [
        scored("contact PSNR", "a", value=20.0, details={"empty": 28.61}),
        scored("PSNR", "a", value=30.0),
    ]
    (table,) = score_tables(scores)
    assert [table.cells["a"][m][0].gel for m in ("contact PSNR", "PSNR")] == ["28.61", ""]
    assert GEL in table.question
    assert GEL not in score_tables(scores[1:])[0].question
    results = Results("t", scores=scores)
    assert "**20.00** gel 28.61" in render_markdown(results)
    assert '<span class="extra">gel 28.61</span>' in render_page(results, tmp_path, max_bytes=10**7)


def test_sentences_have_one_number_each(tmp_path):
    excluded = {"v0c": "all samples are of one group"}
    scores = [
        scored("TMMD", "a", note="Random. Seen"),
        scored("I-TMMD", "a", note="Seen"),
        scored("CI-TMMD", "a", details={"excluded": excluded}),
        scored(
            "D-TMMD",
            "a",
            value=None,
            note="Undefined: one class. Seen",
            details={"excluded": excluded},
        ),
    ]
    (table,) = score_tables(scores)
    cells = {m: c[0] for m, c in table.cells["a"].items()}
    assert table.notes == ["Random", "Seen", "Left out: v0c (all samples are of one group)"]
    assert {m: c.footnotes for m, c in cells.items()} == {
        "TMMD": [1, 2],
        "I-TMMD": [2],
        "CI-TMMD": [3],
        "D-TMMD": [2, 3],
    }
    assert [c.why for c in cells.values()] == ["", "", "", "one class"]
    results = Results("t", scores=scores)
    assert "undefined: one class (2)(3)" in render_markdown(results)
    page = render_page(results, tmp_path, max_bytes=10**7)
    assert '<span class="undefined">undefined<sup>2 3</sup></span>' in page
    assert "<sup>1 2</sup>" in page
    assert page.count("Left out: v0c") == 1


def test_remarks_of_intervals_over_frames_and_of_many_classes():
    per_image = scored(
        "Density",
        "a",
        interval=(0.0, 2.0),
        interval_method="per image, taken as independent, t, 9 df (10 images)",
    )
    assert remarks(per_image) == [INDEPENDENT]
    assert remarks(dataclasses.replace(per_image, note=INDEPENDENT)) == [INDEPENDENT]
    assert (
        remarks(
            dataclasses.replace(per_image, interval_method="cluster-robust over groups, t, 9 df")
        )
        == []
    )
    undefined = scored("TMMD", "a", value=None, note=f"Undefined: too few. {INDEPENDENT}")
    assert (reason(undefined), remarks(undefined)) == ("Undefined: too few", [])
    assert reason(scored("TMMD", "a", value=None)) == "Undefined: no reason recorded"
    names = [f"m{k}" for k in range(8)]
    unstable = scored(
        "D-TMMD", "a", note=f"Unreliable: {', '.join(names)}. More", details={"unstable": names}
    )
    assert remarks(unstable) == ["Unreliable: m0, m1, m2, m3, m4 and 3 more", "More"]
    assert few(names[:5]) == "m0, m1, m2, m3, m4"


@pytest.mark.parametrize(
    ("excluded", "value", "said"),
    [
        ({}, 1.0, ""),
        (None, 1.0, ""),
        ({"a": "x", "b": "y", "c": "x"}, 1.0, "Left out: a, c (x); b (y)"),
        ({"(no label)": "no label", "a": "x"}, 1.0, "Left out: samples without a label; a (x)"),
        ({"(no label)": "no label"}, None, ""),
        ({str(k): "x" for k in range(6)}, None, "Left out: 0, 1, 2, 3, 4 (x); and 1 more"),
    ],
)
def test_classes_left_out(excluded, value, said):
    assert left_out(scored("CI-TMMD", "a", value=value, details={"excluded": excluded})) == said


def test_a_lacking_floor_has_a_reason():
    assert "train part of a split" in no_floor(scored("TMMD (σ multi)", "a"))
    assert (
        no_floor(scored("TMMD", "a", floor=0.5))
        == no_floor(scored("FID (touch)", "a"))
        == no_floor(scored("TMMD", "a", value=None))
        == ""
    )
    assert no_floor(scored("CI-TMMD E", "a")) == no_floor(scored("D-TMMD", "a")) != ""
    assert no_floor(scored("CI-TMMD", "a", note="No floor: other groups. More")) == ""


def test_footnotes_number_in_the_order_of_first_use():
    notes = Footnotes()
    assert [notes.numbers(said) for said in (["a", "b"], [], ["c", "a", "a"], iter(["b"]))] == [
        [1, 2],
        [],
        [1, 3],
        [2],
    ]
    assert notes.texts == ["a", "b", "c"]
