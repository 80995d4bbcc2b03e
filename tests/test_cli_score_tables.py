"""What ``palpate score`` prints: what stands in the tables, the notes below them, and both in narrow terminals."""

import io
import re
from collections import Counter

import pytest
from rich.console import Console

from palpate.cli.scoring_tables import GEL, show
from palpate.cli.terminal import Common, Terminal
from palpate.core import Note, Score
from palpate.report.remarks import INDEPENDENT, NEARER
from palpate.report.results import Results

SEEN = "The tactile encoder was trained on another split: it may have seen test touches"


def scored(metric, subject, value=1.0, *, preset="grouped", **more):
    return Score(
        metric, subject, value, settings={"preset": preset} if preset else {}, n=120, **more
    )


def delta(metric, a, b, **more):
    details = {"a": a, "b": b, "p_better": 0.975, "better": a, "p_adjusted": 0.05}
    return scored(f"{metric} difference", f"{a} - {b}", -1.0, details=details, **more)


def printed(scores, width=200, said=(), **more):
    terminal, text = Terminal(Common()), io.StringIO()
    terminal.out = Console(file=text, width=width, highlight=False)
    show(Results("t", scores=scores, **more), terminal, said)
    return text.getvalue()


def notes(text):
    """Number -> sentence, and first word of the metric -> numbers of each row."""
    below = dict(re.findall(r"^(\d+)  (.*?) *$", text, re.M))
    rows = [
        (line.split()[0], re.findall(r"(?<=120  ).*", line))
        for line in text.splitlines()
        if "grouped" in line
    ]
    return below, [(name, (found[0] if found else "").split()) for name, found in rows]


def test_notes_of_scores_with_a_value_stand_below_once():
    excluded = {"excluded": {"v0c": "all samples are of one group"}}
    text = printed(
        [
            scored("TMMD", "a", floor=0.1, note=SEEN),
            scored("TMMD", "b", floor=0.1, note=SEEN),
            scored("CI-TMMD", "a", details=excluded, floor=0.1),
            scored(
                "D-TMMD",
                "a",
                floor=0.1,
                note=f"Denominators near 0, so the ratio is unreliable: m0, m1. {SEEN}",
            ),
            scored(
                "Recall",
                "a",
                interval=(0.0, 1.0),
                interval_method="per image, taken as independent, t, 9 df",
            ),
        ]
    )
    below, rows = notes(text)
    assert below == {
        "1": SEEN,
        "2": "Left out: v0c (all samples are of one group)",
        "3": "Denominators near 0, so the ratio is unreliable: m0, m1",
        "4": INDEPENDENT,
    }
    assert rows == [
        ("TMMD", ["1"]),
        ("TMMD", ["1"]),
        ("CI-TMMD", ["2"]),
        ("D-TMMD", ["1", "3"]),
        ("Recall", ["4"]),
    ]
    assert "note" in text.splitlines()[0]


def test_without_remarks_there_is_no_column_for_them():
    text = printed([scored("TMMD", "a", floor=0.1)])
    assert "note" not in text
    assert text.count("\n") == 2


def test_a_lacking_floor_is_explained():
    below, rows = notes(
        printed(
            [
                scored("TMMD", "a"),
                scored("I-TMMD", "a", note="No floor: real touches of other groups"),
                scored("FID", "a"),
            ]
        )
    )
    assert [numbers for _, numbers in rows] == [["1"], ["2"], []]
    assert below["1"].startswith("No floor: that of TMMD")
    assert below["2"] == "No floor: real touches of other groups"


def test_what_the_remarks_say_of_a_subject_is_not_said_again():
    copied = (
        "5 of 120 generated rows are bit for bit rows of the reference: a copy is not a generator"
    )
    text = printed(
        [scored("TMMD", "a", floor=0.1, note=f"{copied}. {SEEN}")],
        notes=[f"a: {copied}", "Other"],
        said=["Other"],
    )
    assert text.count(copied) == 1
    assert f"a: {copied}" in text.splitlines()
    assert "Other" not in text


def test_undefined_scores_are_told_by_what_is_known_of_their_column():
    left = {"excluded": {"m1": "fewer than 4 samples"}}
    text = printed(
        [
            scored("TMMD", "a", floor=0.1, note=SEEN),
            scored("TMMD", "b", None, note=f"Undefined: too few. {SEEN}"),
            scored("CI-TMMD", "a", None, note="Undefined: no class", details=left),
            scored("CI-TMMD", "b", None, note="Undefined: no class", details=left),
        ]
    )
    lines = text.splitlines()
    assert "TMMD (grouped) of b: Undefined: too few" in lines
    assert "CI-TMMD (grouped): Undefined: no class. Left out: m1 (fewer than 4 samples)" in lines
    assert "CI-TMMD →" not in text  # a column without any value is no row
    assert sum("undefined" in line for line in lines) == 1
    assert text.count(SEEN) == 1


def test_undefined_scores_are_told_with_their_preset_if_any():
    none = {"value": None, "note": "Undefined: no class"}
    text = printed(
        [
            scored("CI-TMMD", "a", preset="paper"),
            *(scored("CI-TMMD", "a", preset=p, **none) for p in ("grouped", "cmmd")),
        ]
    )
    assert text.splitlines()[-1] == "CI-TMMD (grouped), CI-TMMD (cmmd): Undefined: no class"
    assert "\nFID (touch): Undefined" in printed(
        [scored("TMMD", "a", floor=0.1), scored("FID (touch)", "a", preset="", **none)]
    )


def test_a_difference_decided_by_the_distances_to_the_floor_says_so_once():
    gapped = [delta("I-TMMD", *pair, higher_is_better=None) for pair in ("ab", "ac")]
    for s in gapped:
        s.details.update(gap=0.1, gap_interval=(-0.2, 0.4))
    text = printed(
        [delta("TMMD", "a", "b"), *gapped, delta("D-TMMD", "a", "b", higher_is_better=None)]
    )
    rows = [line.split() for line in text.splitlines() if "grouped" in line]
    assert [row[-1] for row in rows] == ["0.05", "1", "1", "0.05"]
    assert text.count(NEARER) == 1
    assert text.splitlines()[-1].split(maxsplit=1) == ["1", NEARER]


def test_contact_scores_show_what_the_empty_gel_has():
    text = printed(
        [scored("contact PSNR", "a", 18.2, details={"empty": 28.6}), scored("PSNR", "a", 17.0)]
    )
    row = next(line for line in text.splitlines() if line.startswith("contact PSNR"))
    assert "gel 28.6 " in row
    assert text.splitlines()[-1] == GEL
    assert "gel" not in printed([scored("PSNR", "a", 17.0)])


def test_differences_of_intervals_over_frames_say_so():
    frames = {
        "interval": (-2.0, 0.0),
        "interval_method": "leave-one-sample-out jackknife, t, 239 df, samples taken as independent",
    }
    paired = {
        "interval": (-2.0, 0.0),
        "interval_method": "paired leave-one-sample-out jackknife, t, 239 df",
    }
    scores = [
        *(scored("TMMD", n, floor=0.1, **frames) for n in "ab"),
        *(scored("SSIM", n, preset="") for n in "ab"),
    ]
    ahead = Note("ahead", {"better": "a", "confidence": 0.975, "p_adjusted": 0.05})
    text = printed(
        [
            *scores,
            delta("TMMD", "a", "b", **paired, notes=[ahead]),
            delta("SSIM", "a", "b", preset="", notes=[ahead], note="Of this size"),
        ]
    )
    tail = text.partition("Differences on the same samples")[2]
    assert re.search(r"^TMMD .* 0\.05  1 *$", tail, re.M)
    assert re.search(r"^SSIM .* 0\.05  2 *$", tail, re.M)
    assert re.findall(r"^\d+  (.*?) *$", tail, re.M) == [INDEPENDENT, "Of this size"]


@pytest.mark.parametrize("width", [60, 80, 100, 120, 160])
def test_tables_stay_readable_in_narrow_terminals(width):
    wide = {"interval": (-0.007656, 0.08971), "null": (-0.6496, -0.01584), "floor": 0.25}
    names = ("generated", "real, same material")
    scores = [
        scored(m, n, -0.02058, note=SEEN, **wide)
        for m in ("TMMD", "Precision (embeddings)")
        for n in names
    ]
    text = printed(
        [
            *scores,
            *(
                delta(m, *names, interval=(-1.102, -0.9051))
                for m in ("TMMD", "Precision (embeddings)")
            ),
        ],
        width,
    )
    lines = text.splitlines()
    assert "…" not in text
    kept = [line for line in lines if not line.startswith("Left out in this width")]
    assert max(map(len, kept)) <= width
    assert text.count("[-0.007656, 0.08971]") == 4
    assert text.count("-0.02058") == 4
    assert text.count("97.5 %") == 2
    assert text.count("[-0.6496, -0.01584]") == (4 if width >= 100 else 0)
    assert ("Left out in this width: null and n." in text) == (width < 100)
    assert any(line.startswith("TMMD ↓, grouped") for line in lines) == (width < 160)
    assert " ".join(text.split()).count(SEEN) == 1


@pytest.mark.parametrize("width", [40, 50, 58])
def test_a_narrow_terminal_keeps_the_names_of_a_difference_whole(width):
    pairs = [("generated", "real, same material"), ("generated", "[b] other")]
    text = printed(
        [delta(m, *p, interval=(-1.102, -0.9051)) for m in ("TMMD", "FID") for p in pairs], width
    )
    lines = [line.rstrip() for line in text.splitlines()]
    assert max(map(len, lines[:13])) <= width
    assert [k for k, line in enumerate(lines) if line == "generated - real, same material"] == [
        4,
        9,
    ]
    assert [k for k, line in enumerate(lines) if line == "generated - [b] other"] == [6, 11]
    assert all(
        "[-1.102, -0.9051]" in lines[k + 1] and "97.5 %" in lines[k + 1] for k in (4, 6, 9, 11)
    )
    assert [lines[3], lines[8]] == ["TMMD ↓, grouped", "FID ↓, grouped"]
    left = "Left out in this width: Holm p. It is in the results of -o"
    assert (left in " ".join(text.split())) == ("0.05" not in text) == (width == 40)


def test_names_of_a_difference_stay_columns_where_there_is_room():
    text = printed([delta("TMMD", "a", "b", interval=(-1.102, -0.9051))], 58)
    assert re.search(r"^a +b +-1 ", text, re.M)


@pytest.mark.parametrize("width", range(24, 130))
def test_no_number_and_no_heading_is_ever_cut(width):
    """Whatever the width: the numbers are those of the wide tables, and only columns that are named are missing."""
    more = {
        "interval": (-0.05023, 0.06412),
        "null": (-0.1118, 0.03005),
        "floor": 0.05706,
        "details": {"p_value": 0.0123},
        "note": SEEN,
    }
    scores = [
        scored("TMMD", name, value, **more)
        for name, value in (("ours", 0.7319), ("real, same material", 0.2753))
    ]
    scores.append(
        delta("TMMD", "ours", "real, same material", interval=(-0.004784, -0.002442), note=SEEN)
    )
    text, wide = (
        " ".join(printed(scores, w).split()).replace("95 % interval", "interval")
        for w in (width, 250)
    )
    spared: list[str] = []
    for heads, numbers in {"null and n": ["-0.1118", "0.03005", "120"], "Holm p": ["0.05"]}.items():
        spared += numbers if f"Left out in this width: {heads}." in text else []
    found, wanted = (Counter(re.findall(r"-?\d[\d.]*", t)) for t in (text, wide))
    assert found == Counter(
        {number: count for number, count in wanted.items() if number not in spared}
    )
    heads = (
        "value",
        "interval",
        "p",
        "floor",
        "note",
        "a - b",
        *(() if spared else ("null", "n", "Holm p")),
    )
    assert [head for head in heads if not re.search(rf"(?<!\w){head}(?!\w)", text)] == []
    assert "…" not in text
    assert width > 40 or text.count("note: 1") == 3  # a mark is not taken for a size


def test_a_subject_stands_above_its_numbers_where_there_is_no_room_beside_them():
    score = scored("TMMD", "real, same material", floor=0.1, interval=(-0.05023, 0.06412))
    wide, narrow = (
        [line.split("  ")[0].rstrip() for line in printed([score], width).splitlines()]
        for width in (60, 50)
    )
    assert wide[:3] == ["subject", "TMMD ↓, grouped", "real, same material"]
    assert narrow[1:3] == ["TMMD ↓, grouped", "real, same material"]
    assert "subject" not in narrow
    assert "  value: 1" in printed([score], 30).splitlines()


def test_differences_of_a_metric_stand_together():
    pairs = [("a", "b"), ("a", "c"), ("b", "c")]
    text = printed(
        [delta(metric, *pair) for pair in pairs for metric in ("I-TMMD", "I-TMMD E", "SSIM")], 70
    )
    lines = [line.split() for line in text.splitlines()]
    assert [line[0] for line in lines if line[-1:] == ["grouped"]] == ["I-TMMD", "I-TMMD", "SSIM"]
    assert [tuple(line[:2]) for line in lines if "97.5" in line] == pairs * 3


def test_a_note_loses_no_letter_in_the_narrowest_terminal():
    text = printed([scored("TMMD", "a", floor=0.1, note="Denominators near 0")], 10)
    assert "…" not in text
    assert "".join(text.split()).endswith("1Denominatorsnear0")
