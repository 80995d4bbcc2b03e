"""The writers of the table model: terminal, Markdown and LaTeX hold the same numbers."""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from forge.results import (
    difference,
    full_audit,
    full_results,
    score,
    small_audit,
    study_results,
    text_note,
)
from palpate.core import Note, SampleRef
from palpate.report import notes
from palpate.report.audits import pair_lists
from palpate.report.latex import escape
from palpate.report.records import LeakPair, Signal
from palpate.report.results import Results
from palpate.report.terminal import as_text, audit_text, print_result

NASTY = r"100% & {x} $_#^~ <b> \input{a} | `c` [d]"


@pytest.fixture
def results():
    return Results(
        "T",
        scores=[
            score(subject="a", details={"p_value": 0.0312}, notes=(text_note("Seen"),)),
            score(subject="b", value=2.5, interval=(2.0, 3.0)),
            score("I-TMMD", "a", None, interval=None, null=None, floor=None),
            score("contact PSNR", "a", 18.2, interval=None, details={"empty": 28.6}, floor=None),
            difference("a", "b", better="a"),
        ],
        commands=["palpate score a/ --reference b/"],
    )


def test_every_front_end_has_every_number_and_note(results):
    ascii_minus = str(results)
    for text in (ascii_minus, results.to_markdown(), results.to_latex()):
        for part in ("1.37", "1.01, 1.75", "2.50", "18.2", "28.6", "0.04", "97.5"):
            assert part in text, part
        assert text.count("Seen") == 1
    assert "undefined" in ascii_minus
    assert "0.0312" in ascii_minus


def test_the_terminal_has_a_row_a_score(results):
    lines = str(results).splitlines()
    row = next(line for line in lines if line.startswith("TMMD ↓") and " a " in line)
    assert row.split() == [
        *("TMMD", "↓", "a", "1.37", "*", "†", "[1.01,", "1.75]", "[-0.05,", "0.06]"),
        *("0.0312", "0.04", "240", "(1)"),
    ]
    assert "(1) Seen" in lines


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_a_narrow_terminal_cuts_no_number(results, width):
    text = as_text(results, width)
    assert "[-0.05, 0.06]" in text
    assert "…" not in text
    table = text.split("(1)")[0]
    assert max(map(len, table.splitlines())) <= width


def test_every_note_that_a_room_makes_has_a_sentence(monkeypatch, capsys):
    template = "Pass {arg:sigma=multi}, {n:vote}, {files:few}"
    monkeypatch.setitem(notes.SENTENCES, "planted", template)
    planted = Note("planted", {"n": 2, "files": [*"abcdef"]})
    noted = Results("T", scores=[score(notes=(planted,))])
    assert "Pass sigma='multi', 2 votes, a, b, c, d, e and 1 more" in str(noted)
    print_result(noted, Console(width=100))
    assert "Pass --sigma multi, 2 votes" in capsys.readouterr().out
    source = Path(notes.__file__).parents[1]
    codes = {
        code
        for path in source.rglob("*.py")
        for code in re.findall(r'Note\(\s*"([a-z0-9-]+)"', path.read_text(encoding="utf-8"))
    }
    assert len(codes) > 50
    assert codes <= set(notes.SENTENCES)


def test_an_audit_is_a_readable_summary_with_a_line_for_a_note_of_several_signals():
    text = str(full_audit())
    assert text.startswith("Orig: leaks. 99.06 % of the test samples share a video with train; ")
    assert "29,611 of 29,879 test samples leak (99.10 %)." in text
    assert "  near-duplicate vision   5,210 of 29,879 (17.4 %), score 0.812" in text
    assert "2 test samples have no video." in text
    note = Note("cannot-tell-no-null", {"images": 87, "threshold": None})
    kinds = ("near-duplicate vision", "near-duplicate tactile")
    signals = [Signal(kind, 1, 0, 0.9, notes=[note]) for kind in kinds]
    audit = small_audit(signals=signals)
    (line,) = (line for line in str(audit).splitlines() if "Cannot tell" in line)
    assert line.startswith("  near-duplicate vision, near-duplicate tactile: ")
    for gap, title in ((3, "nearest in time: 1 pair"), (None, "same object: 1 pair")):
        pair = LeakPair(SampleRef("a"), SampleRef("b"), gap)
        assert pair_lists(small_audit([pair], group="object"))[0].title == title


def test_markdown_tables_are_rectangular_and_hold_every_section(tmp_path):
    text = full_results(tmp_path).to_markdown()
    for section in ("Scores", "Leakage audit", "Settings and digests", "Commands"):
        assert f"## {section}\n" in text
    for part in ("Synthetic data", "palpate audit x", audit_text(full_results(tmp_path).audits[0])):
        assert part in text
    tables = re.findall(r"(?:^\|.*\n)+", text, re.M)
    assert tables
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}) == 1
    assert "##" not in Results("T").to_markdown()


@given(st.text())
def test_no_text_is_a_latex_command(text):
    escaped = escape(text)
    commands = set(re.findall(r"\\[a-zA-Z]+|\\.", escaped))
    allowed = r"\textbackslash \textasciitilde \textasciicircum \textless \textgreater \textbar"
    allowed += (
        r" \char \textdagger \times \sigma \rightarrow \uparrow \downarrow \{ \} \$ \& \# \% \_ \`"
    )
    assert commands <= set(allowed.split())
    assert not re.search(r"(?<!\\)[%#&]", escaped)


def test_latex_captions_are_short_and_what_they_leave_out_is_above_the_table(tmp_path, results):
    measured = replace(score(), estimator="unbiased", bandwidth=10.0, seed=7, encoder="ab" * 32)
    one = Results("One", scores=[measured])
    for each in (results, study_results(tmp_path), full_results(tmp_path), one):
        text = each.to_latex()
        captions = re.findall(r"\\caption\{(.*)\}\n", text)
        assert len(captions) == text.count(r"\begin{table}") > 0
        for caption in captions:
            assert 0 < len(caption.split()) <= 40, caption
        for table in each.tables:  # whole
            assert f"% {table.text}\n" in text
    above = text[: text.index(r"\begin{table}")]
    for fact in ("% estimator: unbiased\n", "% seed: 7\n", f"% encoder: {'ab' * 6}\n"):
        assert fact in above
    assert "unbiased" not in text[len(above) :]


def test_latex_tables_have_bold_best_marks_and_floors(results):
    text = results.to_latex()
    assert r"a & $\mathbf{1.37}$$^\dagger$\textsuperscript{a} & --" in text
    assert r"{\scriptsize $[1.01, 1.75]$}" in text
    assert r"{\scriptsize p = 0.0312}" in text
    assert "real images (floor) & 0.04 & -- " in text
    assert "no contact & 28.60" in text
    assert r"\textsuperscript{a}~Seen" in text
    assert r"TMMD $\downarrow$ & a & b & $-1.00$ & 97.5 \% & 0.05 \\" in text
    assert r"{\scriptsize $[-1.50, -0.50]$}" in text
    labels = re.findall(r"\\label\{(tab:[a-z0-9-]+)\}", text)
    assert len(labels) == len(set(labels)) == 3
    assert text.count(r"\resizebox") == 3
    for begin, end in (("table", "table"), ("tabular", "tabular")):
        assert text.count(rf"\begin{{{begin}}}") == text.count(rf"\end{{{end}}}") == 3
    for table in re.findall(r"\\begin\{tabular\}\{(.*?)\}(.*?)\\end\{tabular\}", text, re.S):
        rows = [line for line in table[1].splitlines() if line.endswith(r"\\")]
        assert {row.count("&") for row in rows} == {len(table[0]) - 1}


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex")
def test_latex_compiles(results, tmp_path):
    preamble = r"\documentclass{article}\usepackage{booktabs,graphicx}\begin{document}"
    (tmp_path / "t.tex").write_text(f"{preamble}\n{results.to_latex()}\n\\end{{document}}\n")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
