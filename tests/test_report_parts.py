"""Numbers, drawings, tables and Markdown of the report."""

import dataclasses
import math
import re
import xml.etree.ElementTree as ET

import pytest

from palpate.core import PalpateError, SampleRef, Score
from palpate.report import render_markdown
from palpate.report.plots import (
    HEIGHT,
    PAD,
    WIDTH,
    axis_of,
    axis_row,
    gap_histogram,
    interval_bar,
    nice_step,
    uneven,
)
from palpate.report.results import Audit, GalleryItem, Results
from palpate.report.tables import family_of, heat_tables, score_tables
from palpate.report.text import decimals, number, percent, plural


def svg(markup):
    return ET.fromstring(str(markup))


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (1.374, 3, "1.374"),
        (-0.0501, 3, "−0.050"),
        (-0.0001, 2, "0.00"),
        (12345.6, 1, "12,345.6"),
        (None, 2, "–"),
        (math.nan, 2, "–"),
    ],
)
def test_number(value, digits, text):
    assert number(value, digits) == text


def test_decimals_follow_the_largest():
    assert [decimals([v]) for v in (12345.0, 123.4, 43.9, 1.37, 0.49, 0.042, 0.00214)] == [
        0,
        1,
        2,
        3,
        3,
        4,
        5,
    ]
    assert decimals([]) == 1


def test_percent_never_hides_a_leak():
    assert percent(0.0) == "0 %"
    assert percent(1.0) == "100 %"
    assert percent(1e-6) == "< 0.01 %"
    assert percent(1 - 1e-6) == "> 99.99 %"
    assert percent(29597 / 29879) == "99.06 %"
    assert percent(0.378) == "37.8 %"


def test_plural():
    assert [plural(n, "touch", "touches") for n in (0, 1, 1200)] == [
        "0 touches",
        "1 touch",
        "1,200 touches",
    ]


@pytest.mark.parametrize(
    ("span", "parts", "step"),
    [(10, 3, 5), (1, 3, 0.5), (5.3, 3, 2), (0.0008, 3, 0.0005), (29597, 3, 10000), (3, 3, 1)],
)
def test_nice_step(span, parts, step):
    assert nice_step(span, parts) == pytest.approx(step)


def scored(**changes):
    return dataclasses.replace(
        Score("TMMD", "generated", 2.0, (1.0, 3.0), null=(-0.5, 0.5), floor=0.25, n=10), **changes
    )


def test_interval_bar_places_everything_on_the_shared_axis():
    scores = [scored(), scored(subject="other", value=4.0, interval=(3.5, 4.5))]
    axis = axis_of(scores)
    assert axis is not None
    assert (axis.low, axis.high) == pytest.approx((-0.5 - 0.1, 4.5 + 0.1))
    at = lambda v: PAD + (v + 0.6) / 5.2 * (WIDTH - 2 * PAD)  # noqa: E731
    root = svg(interval_bar(scores[0], axis))
    kinds = {e.get("class"): e for e in root}
    assert float(kinds["value"].get("cx")) == pytest.approx(at(2.0), abs=0.01)
    assert float(kinds["floor"].get("x1")) == pytest.approx(at(0.25), abs=0.01)
    assert float(kinds["null"].get("x")) == pytest.approx(at(-0.5) - 0.75, abs=0.01)
    assert float(kinds["null"].get("width")) == pytest.approx(at(0.5) - at(-0.5) + 1.5, abs=0.01)
    left, right = re.match(r"M([\d.]+) [\d.]+H([\d.]+)", kinds["interval"].get("d")).groups()
    assert (float(left), float(right)) == pytest.approx((at(1.0), at(3.0)), abs=0.01)
    assert float(kinds["value"].get("cy")) == HEIGHT / 2
    ticks = [e.text for e in svg(axis_row(axis)) if e.tag == "text"]
    assert ticks == ["0", "2", "4"]


def test_axis_of_nothing_of_one_value_and_near_zero():
    empty = scored(value=None, interval=None, null=None, floor=None)
    assert axis_of([empty]) is None
    one = axis_of([dataclasses.replace(empty, value=5.0)])
    assert one is not None
    assert one.low < 5 < one.high
    zero = axis_of([dataclasses.replace(empty, value=v) for v in (0.5, 5.0)])
    assert zero is not None
    assert zero.low <= 0
    far = axis_of([dataclasses.replace(empty, value=v) for v in (15.0, 16.0)])
    assert far is not None
    assert far.low > 14


def audit(edges=(0, 10, 20, 30), counts=(4, 10, 6), median=14.0):
    return Audit("Orig", "video", 10, 20, 2, 2, 2, 20, 1.0, 0, 1, median, 30, edges, counts)


def test_histogram_heights_and_median():
    root = svg(gap_histogram(audit()))
    bars = [float(e.get("height")) for e in root if e.get("class") == "column"]
    assert bars == pytest.approx([0.4 * bars[1], bars[1], 0.6 * bars[1]], abs=0.11)
    middle = next(e for e in root if e.get("class") == "median")
    starts = [float(e.get("x1").rstrip("%")) for e in root if e.get("class") == "tick"]
    assert float(middle.get("x1").rstrip("%")) == pytest.approx(
        starts[0] + (starts[-1] - starts[0]) * 14 / 30, abs=0.01
    )
    titles = [e[0].text for e in root if e.get("class") == "column"]
    assert titles[0] == "0 to 10 frames (exclusive): 4"
    assert titles[-1] == "20 to 30 frames: 6"


def test_histogram_of_nothing_or_of_a_wrong_shape_is_not_drawn():
    assert not gap_histogram(audit((), ()))
    assert not gap_histogram(audit((0, 1), (0,)))
    assert not gap_histogram(audit((0, 1, 2), (3,)))
    assert gap_histogram(audit((5, 6), (3,), None))


def test_uneven_bins():
    assert not uneven((0, 10, 20, 25))
    assert uneven((0, 10, 40, 50))


@pytest.mark.parametrize(
    ("metric", "title"),
    [
        ("D-TMMD", "Touch features"),
        ("CMMD", "Image distributions"),
        ("FID", "Image distributions"),
        ("PSNR", "Image by image"),
        ("material accuracy", "Recognition"),
        ("tac-text top-5", "Recognition"),
        ("recall@5", "Recognition"),
        ("novel", "Other metrics"),
        ("contact residual", "Image by image"),
        ("contact IoU", "Image by image"),
        ("contact LPIPS", "Image by image"),
    ],
)
def test_families(metric, title):
    assert family_of(metric)[0] == title


def test_score_tables_share_what_is_shared():
    scores = [
        scored(metric="SSIM", estimator="per-image mean", null=None, settings={"window": 11}),
        scored(metric="TMMD", estimator="grouped", encoder="e" * 64, n=10),
        scored(
            metric="TMMD",
            subject="real",
            estimator="grouped",
            encoder="e" * 64,
            n=20,
            note="A note.",
        ),
        scored(metric="I-TMMD", estimator="grouped", encoder="e" * 64, seed=3, note="A note."),
    ]
    touch, images = score_tables(scores)
    assert (touch.title, images.title) == ("Touch features", "Image by image")
    assert touch.subjects == ["generated", "real"]
    assert ("estimator", "grouped") in touch.shared
    assert ("encoder", "e" * 64) in touch.shared
    assert touch.columns[1].made == [("seed", "3")]
    assert (touch.columns[0].size, touch.columns[1].size) == ("", "n = 10")
    assert [touch.cells[s]["TMMD"][0].size for s in touch.subjects] == ["n = 10", "n = 20"]
    assert touch.notes == ["A note."]
    assert [
        touch.cells["real"]["TMMD"][0].footnotes,
        touch.cells["generated"]["I-TMMD"][0].footnotes,
    ] == [[1], [1]]
    assert ("window", "11") in images.columns[0].made
    assert images.shared == []


def test_several_scores_of_one_subject_stand_in_one_cell():
    (table,) = score_tables([scored(seed=0), scored(seed=1, value=2.5)])
    assert [c.value for c in table.cells["generated"]["TMMD"]] == ["2.000", "2.500"]


def test_incomparable_scores_are_refused():
    for change in (
        {"estimator": "biased"},
        {"encoder": "other"},
        {"bandwidth": 5.0},
        {"settings": {"window": 7}},
    ):
        with pytest.raises(PalpateError, match="one column must agree in"):
            score_tables([scored(), scored(subject="other", **change)])
        with pytest.raises(PalpateError, match="one column must agree in"):
            render_markdown(Results("t", scores=[scored(), scored(subject="other", **change)]))


def test_other_presets_and_other_splits_stand_in_tables_of_their_own():
    alike = [
        scored(settings={"preset": "grouped"}),
        scored(subject="real", settings={"preset": "grouped"}),
    ]
    others = [
        scored(settings={"preset": "paper"}, estimator="unbiased"),
        scored(settings={"preset": "grouped"}, split="other"),
    ]
    tables = score_tables(alike + others)
    assert [len(t.subjects) for t in tables] == [2, 1, 1]
    assert len({t.title for t in tables}) == 3
    assert "grouped: whole groups kept together" in tables[0].title
    assert "the paper's formula to the letter" in tables[1].title


def test_heat_tables_take_only_squares():
    good = scored(details={"matrix": [[0.5, 2.0], [None, -1.0]], "classes": ["a", "b"]})
    (heat,) = heat_tables(
        [good, scored(details={"matrix": [[1, 2]]}), scored(details={"matrix": "no"}), scored()]
    )
    assert heat.labels == ["a", "b"]
    assert heat.values == [["0.500", "2.000"], ["–", "−1.000"]]
    assert heat.shares == [[0.25, 1.0], [0.0, 0.0]]
    (numbered,) = heat_tables([scored(details={"matrix": [[1.0]], "labels": ["too", "many"]})])
    assert numbered.labels == ["1"]


def test_markdown_holds_every_score_fact_and_command():
    scores = [
        scored(),
        scored(subject="real", value=0.25, interval=None),
        scored(subject="flat", value=None, interval=None, note="Undefined: no spread"),
        scored(
            metric="D-TMMD",
            value=0.44,
            details={"matrix": [[0.5, 2.0], [2.0, 0.75]], "classes": ["a|b", "c"]},
        ),
        scored(metric="SSIM", value=0.4901, interval=(0.47, 0.51), higher_is_better=True),
    ]
    item = GalleryItem(SampleRef("v/1", "v", 1, "wood", "v.png", "t_1.png"), "g.png")
    text = render_markdown(
        Results(
            "T",
            ["A fact."],
            [audit()],
            scores,
            [item],
            {"a": {"b": "c`d"}},
            ["A * warning."],
            ["palpate audit 'x y'"],
        )
    )
    for said in (
        "# T",
        "A fact.",
        "A \\* warning.",
        "**2.000** [1.000, 3.000]",
        "**0.250**",
        "undefined: no spread",
        "**0.440**",
        "**0.490** [0.470, 0.510]",
        "SSIM ↑",
        "TMMD ↓",
        "a\\|b",
        "`t_1.png`",
        "100 % leaked",
        "palpate audit 'x y'",
        "`` c`d ``",
        "median 14",
        "10 to 20",
    ):
        assert said in text, said
    tables = [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.M)]
    assert len(tables) >= 5
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table}) == 1


def test_markdown_of_nothing_says_what_to_run():
    text = render_markdown(Results("T"))
    assert all(f"`palpate {verb} --help`" in text for verb in ("generate", "score", "audit"))
