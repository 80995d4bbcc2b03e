"""LaTeX tables: text stays text, the best is bold only where it is better, and the caption says how."""

import dataclasses
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core import Score
from palpate.report.latex import LONG, best_of, escape, latex_tables, number
from palpate.report.remarks import NEARER
from palpate.report.results import Results

ODD = r"a_b & 50% $x$ #1 {\input{/etc/passwd}} ~^ <b> [c]"


def make(metric, subject, value, interval=None, *, up=False, floor=None, preset="grouped", **rest):
    return Score(
        metric,
        subject,
        value,
        interval,
        higher_is_better=up,
        floor=floor,
        settings={"preset": preset} if preset else {},
        n=10,
        m=12,
        estimator="grouped",
        encoder="ab" * 32,
        split="cd" * 32,
        seed=7,
        bandwidth=10.0,
        scale=1000.0,
        details={"version": "1.2"},
        **rest,
    )


def delta(metric, a, b, value, interval, *, up=False, preset="grouped", better=None):
    settings = {"preset": preset} if preset else {}
    better = better or (a if ((value or 0) > 0) == up else b)
    decided = interval is not None and not interval[0] <= 0 <= interval[1]
    details = {
        "a": a,
        "b": b,
        "better": better,
        "decided": decided,
        "p_better": 0.9,
        "p_adjusted": 0.0001,
        "version": "1.2",
    }
    return Score(
        f"{metric} difference",
        f"{a} - {b}",
        value,
        interval,
        higher_is_better=up,
        settings=settings,
        split="cd" * 32,
        details=details,
    )


def bold(text):
    return re.findall(r"mathbf\{([^}]*)\}", text)


def cells(text):
    """The rows of all tables: lists of cells."""
    return [
        line.removesuffix(r" \\").split(" & ")
        for line in text.splitlines()
        if line.endswith(r" \\")
    ]


@given(st.text(max_size=60))
def test_no_text_is_a_command(text):
    out = escape(text)
    assert "\n" not in out
    known = r"\\(textbackslash|textasciitilde|textasciicircum|textless|textgreater|textbar|char34|`)\{\}|\\[{}$&#%_]"
    rest = re.sub(
        r"\$(-|\^2|\\(sigma|times|pm|cdot|rightarrow))\$|\{[\[\]]\}|-\{\}",
        "",
        re.sub(known, "", out),
    )
    assert not re.search(r"[\\{}$&#%_~^]", rest.replace("~", "" if "\u00a0" in text else "~"))


def test_odd_names_and_commands_stay_text():
    scores = [make("TMMD", ODD, 1.0), make("TMMD", "σ×", 2.0)]
    text = latex_tables(
        Results(title="t", scores=scores, commands=["palpate score --seed 1\n\\end{table}"])
    )
    assert (
        r"a\_b \& 50\% \$x\$ \#1 \{\textbackslash{}input\{/etc/passwd\}\} \textasciitilde{}\textasciicircum{}"
        in text
    )
    assert r"$\sigma$$\times$" in text
    assert [line for line in text.splitlines() if r"\end{table}" in line] == [
        r"% palpate score --seed 1 \end{table}",
        r"\end{table}",
    ]
    assert r"palpate score -{}-seed 1 \textbackslash{}end\{table\}" in text
    assert text.startswith("% palpate")


def test_text_compiles_in_the_fonts_that_latex_starts_with():
    """These commands are those that pdfLaTeX has in OT1 without any package, and before textcomp was part of it."""
    assert escape('"a" `b` <|> ±1 · 2² → x') == (
        r"\char34{}a\char34{} \`{}b\`{} \textless{}\textbar{}\textgreater{} $\pm$1 $\cdot$ 2$^2$ $\rightarrow$ x"
    )
    assert escape("cafe\u0301") == "café"
    assert escape("a\x85b") == "a b"


@pytest.mark.parametrize(
    ("name", "needs"),
    [
        ("Žluťoučký kůň, naïve Straße… “x” – ±2²σ", []),
        ("łąka «x»", [r"% Needs \usepackage[T1]{fontenc} for «, », ą, or LuaLaTeX or XeLaTeX."]),
        (
            "日本 ą",
            [
                "% pdfLaTeX does not have 日, 本: needs LuaLaTeX or XeLaTeX, and a font that has them."
            ],
        ),
        (
            "≤Ωабвг",
            [
                "% pdfLaTeX does not have Ω, а, б, в, г and 1 more: needs LuaLaTeX or XeLaTeX, and a font that has them."
            ],
        ),
    ],
)
def test_the_head_says_what_foreign_letters_need(name, needs):
    text = latex_tables(Results(title="t", scores=[make("TMMD", name, 1.0)]))
    assert text.splitlines()[1 : text.splitlines().index("")] == [
        r"% Needs \usepackage{booktabs}.",
        *needs,
    ]


@pytest.mark.parametrize(
    ("value", "digits", "wanted"),
    [(-1.25, 1, "$-1.2$"), (-0.0001, 2, "$0.00$"), (1234.5, 0, "$1234$"), (None, 2, "--")],
)
def test_numbers(value, digits, wanted):
    assert number(value, digits) == wanted


def test_bold_needs_an_interval_without_zero_against_everybody():
    column = [
        make("TMMD", name, v) for name, v in (("a", 1.0), ("b", 2.0), ("c", 3.0), ("real", 0.1))
    ]
    ab, ac, bc = (
        delta("TMMD", "a", "b", -1, (-2, -0.1)),
        delta("TMMD", "a", "c", -2, (-3, -1)),
        delta("TMMD", "b", "c", -1, (-2, 1)),
    )
    assert best_of(column, [ab, ac, bc]) == "a"  # a control that scores better takes no part
    assert best_of(column, [delta("TMMD", "a", "b", -1, (-2, 0.1)), ac, bc]) is None
    assert best_of(column, [delta("TMMD", "a", "b", -1, None), ac, bc]) is None
    assert best_of(column, [ab, bc]) == "a"
    assert best_of(column, [delta("TMMD", "a", "b", -1, (-2, -0.1), preset="paper")]) is None
    assert (
        best_of(
            [make("SSIM", "a", 1.0, up=True)], [delta("SSIM", "a", "b", -1, (-2, -0.1), up=True)]
        )
        == "b"
    )
    assert best_of([], []) is None


def test_without_a_reference_the_best_is_nearest_the_floor():
    column = [
        make("I-TMMD", "a", 0.2, floor=0.5, up=None),
        make("I-TMMD", "b", 0.6, floor=0.5, up=None),
    ]
    assert (
        best_of(column, [delta("I-TMMD", "a", "b", -0.4, (-0.5, -0.3), up=None, better="b")]) == "b"
    )
    text = latex_tables(
        Results(
            title="t",
            scores=[*column, delta("I-TMMD", "a", "b", -0.4, (-0.5, -0.3), up=None, better="b")],
        )
    )
    assert r"I-TMMD $\rightarrow$" in text
    assert [float(v) for v in bold(text)] == [0.6]


def test_a_table_has_values_intervals_floor_and_how_they_were_made():
    scores = [
        make("TMMD", "a", 1.0, (0.5, 1.5), floor=0.25, interval_method="jackknife, t, 3 df"),
        make("TMMD", "b", 12.0, (10.0, 14.0), floor=0.25),
        make("SSIM", "a", 0.75, up=True, preset=""),
        make("SSIM", "b", None, up=True, preset="", note="Undefined: why"),
    ]
    differences = [
        delta("TMMD", "a", "b", -11, (-13, -9)),
        delta("SSIM", "a", "b", None, None, up=True, preset=""),
    ]
    text = latex_tables(
        Results(title="t", scores=[*scores, *differences], commands=["palpate score x"])
    )
    rows = cells(text)
    assert ["", r"TMMD $\downarrow$"] in rows
    assert ["a", r"$\mathbf{1.00}$"] in rows
    assert ["", r"{\scriptsize $[0.50, 1.50]$}"] in rows
    assert ["b", "$12.00$"] in rows
    assert ["floor (real touches)", "$0.25$"] in rows
    assert ["", r"SSIM $\uparrow$"] in rows
    assert ["b", r"--\textsuperscript{a}"] in rows
    assert r"\textsuperscript{a}~Undefined: why.}" in text
    assert [
        r"TMMD $\downarrow$",
        "a",
        "b",
        "$-11.00$",
        "$[-13.00, -9.00]$",
        r"$90.0\,\%$",
        "$< 0.001$",
    ] in rows
    caption = next(line for line in text.splitlines() if "caption" in line)
    for fact in (
        "$n$ 10",
        "$m$ 12",
        r"$\sigma$ 10",
        "values times 1000",
        "jackknife, t, 3 df",
        r"encoder \texttt{abababababab}",
        r"split \texttt{cdcdcdcdcdcd}",
        "seed 7",
        "palpate 1.2",
        r"\texttt{palpate score x}",
    ):
        assert fact in caption, fact
    assert bold(text) == ["1.00"]
    for opened, closed in (
        (r"\begin{table}", r"\end{table}"),
        (r"\begin{tabular}", r"\end{tabular}"),
        ("{", "}"),
    ):
        assert text.count(opened) == text.count(closed)
    for block in text.split(r"\begin{tabular}{")[1:]:
        width = len(block.split("}", 1)[0])
        assert {len(row) for row in cells(block)} == {width}


def test_metrics_of_other_features_have_tables_of_their_own():
    scores = [
        make(f"{m} ({what})", "a", 1.0, preset="")
        for what in ("touch", "Inception")
        for m in ("FID", "KID")
    ]
    text = latex_tables(Results(title="t", scores=scores))
    assert cells(text).count(["", r"FID $\downarrow$", r"KID $\downarrow$"]) == 2
    captions = [line for line in text.splitlines() if "caption" in line]
    assert [re.search("distributions, (\\w+)", c).group(1) for c in captions] == [
        "touch",
        "Inception",
    ]
    mixed = [make("FID (touch)", "a", 1.0, preset=""), make("KID (touch)", "a", 1.0, preset="")]
    object.__setattr__(mixed[0], "scale", 1.0)
    assert "scaled: KID (touch) times 1000" in latex_tables(Results(title="t", scores=mixed))


def test_of_several_seeds_the_first_stands():
    scores = [
        make("I-TMMD", "a", v, up=None, preset="paper", interval_method=f"of {v}")
        for v in (1.0, 2.0)
    ]
    assert [
        row for row in cells(latex_tables(Results(title="t", scores=scores))) if row[0] == "a"
    ] == [["a", "$1.000$"]]


def excesses(a, b, floor, times, gap_interval, difference=None):
    """E of two generators, and the difference of what is ``times`` E."""
    column = [
        make("CI-TMMD E", "a", a, floor=floor, up=None),
        make("CI-TMMD E", "b", b, floor=floor, up=None),
    ]
    gap = (abs(a - floor) - abs(b - floor)) * times
    d = delta(
        "CI-TMMD",
        "a",
        "b",
        (a - b) * times if difference is None else difference,
        gap_interval,
        up=None,
        better="a" if gap < 0 else "b",
    )
    return column, dataclasses.replace(d, details={**d.details, "gap": gap})


def test_excess_is_bold_by_its_own_difference_or_by_one_that_says_the_same():
    column, d = excesses(2.1, 5.0, 2.0, 0.2, (-1, -0.5))
    assert best_of(column, [d]) == "a"
    text = latex_tables(Results(title="t", scores=[*column, d]))
    assert r"CI-TMMD E $\rightarrow$" in text
    assert bold(text) == ["2.100"]
    assert best_of(column, [excesses(2.1, 5.0, 2.0, 0.2, (-1, 0.5))[1]]) is None
    assert (
        best_of(column, [excesses(2.1, 5.0, 2.0, 0.2, (-1, -0.5), difference=-0.7)[1]]) is None
    )  # classes of unequal designs
    own = delta("CI-TMMD E", "a", "b", -2.9, (-3, -1), up=None, better="b")
    assert best_of(column, [d, own]) == "b"  # its own stands above that of CI-TMMD
    tagged = [dataclasses.replace(s, metric="CI-TMMD E (σ multi)") for s in column]
    assert best_of(tagged, [dataclasses.replace(d, metric="CI-TMMD (σ multi) difference")]) == "a"
    assert best_of(tagged, [d]) is None


def test_the_p_value_of_the_permutations_stands_below_the_interval():
    tested = make("TMMD", "a", 1.0, (0.5, 1.5))
    sure = make("TMMD", "b", 1.0)
    for score, p in ((tested, 0.0123), (sure, 0.0004)):
        score.details.update(p_value=p, permutations={"count": 9999})
    text = latex_tables(
        Results(title="t", scores=[tested, sure, make("I-TMMD", "a", 2.0, up=None)])
    )
    assert ["", r"{\scriptsize $p = 0.012$}", ""] in cells(text)
    assert ["", r"{\scriptsize $p < 0.001$}", ""] in cells(text)
    assert "$p$ by relabelings: 9,999" in text


def test_what_a_reader_must_know_has_letters_below_the_table():
    left = make("CI-TMMD", "a", 1.0, up=None, note="Of all. Of this & one")
    left.details["excluded"] = {f"c_{k}": "all samples are of one group" for k in range(7)} | {
        "(no label)": "no label"
    }
    text = latex_tables(Results(title="t", scores=[left, make("TMMD", "a", 2.0, note="Of all")]))
    below = next(line for line in text.splitlines() if "parbox" in line)
    assert (
        r"c\_0, c\_1, c\_2, c\_3, c\_4 (all samples are of one group); and 3 more. Of all.}"
        in below
    )
    assert r"\textsuperscript{a}~Of this \& one. \textsuperscript{b}~Left out: c" in below
    assert below.count("Of all") == 1
    assert ["a", r"$1.000$\textsuperscript{a,b}", "$2.000$"] in cells(text)
    assert not below.endswith(r"\\")
    many = [make(f"m{k}", "a", 1.0, preset="", note=f"Note {k}") for k in range(28)]
    marks = re.findall(r"superscript\{(\w+)\}~Note", latex_tables(Results(title="t", scores=many)))
    assert marks == [*"abcdefghijklmnopqrstuvwxyz", "aa", "bb"]


def test_the_empty_gel_has_a_row():
    score = make("contact PSNR", "a", 20.0, up=True, preset="")
    score.details["empty"] = 28.61
    text = latex_tables(
        Results(title="t", scores=[score, make("SSIM", "a", 0.5, up=True, preset="")])
    )
    assert ["empty gel", "$28.61$", "--"] in cells(text)


def test_scores_of_different_references_are_bold_by_their_own_differences():
    scores = []
    for reference, better in (("1" * 64, "a"), ("2" * 64, "b")):
        d = delta(
            "TMMD", "a", "b", -1 if better == "a" else 1, (-2, -0.1) if better == "a" else (0.1, 2)
        )
        own = [make("TMMD", "a", 1.0), make("TMMD", "b", 2.0), d]
        free = [make("I-TMMD", n, v, floor=0.5, up=None) for n, v in (("a", 0.2), ("b", 0.6))]
        gap = delta("I-TMMD", "a", "b", -0.4, (-0.5, -0.3), up=None, better=better)
        scores += [dataclasses.replace(s, reference=reference) for s in own] + [*free, gap]
    text = latex_tables(Results(title="t", scores=scores))
    assert bold(text) == ["1.000", "0.200", "2.000", "0.600"]
    assert text.count(r"\begin{table}") == 4
    assert r"reference \texttt{111111111111}" in text


def test_many_differences_break_over_pages():
    def text(count):
        return latex_tables(
            Results(
                title="t",
                scores=[delta("TMMD", "a", f"b_{k}", -1, (-2, -0.1)) for k in range(count)],
            )
        )

    short, long = text(LONG - 1), text(LONG)
    assert short.count(r"\begin{table}") == 1
    assert "longtable" not in short
    assert r"\begin{table}" not in long
    assert long.count(r"\begin{longtable}{lllrrrr}") == long.count(r"\end{longtable}") == 1
    assert r"% Needs \usepackage{booktabs,longtable}" in long
    assert [sum(row[0] == "metric" for row in cells(t)) for t in (short, long)] == [
        1,
        2,
    ]  # again on each page
    assert sum("b\\_" in row[2] for row in cells(long) if len(row) == 7) == LONG
    order = [
        long.index(t)
        for t in (
            r"\caption{",
            r"\endfirsthead",
            r"\endhead",
            r"\endfoot",
            r"b\_0 ",
            r"\end{longtable}",
        )
    ]
    assert order == sorted(order)
    assert next(line for line in long.splitlines() if "caption" in line).endswith(r".} \\")


@pytest.mark.parametrize("count", [1, LONG])
def test_differences_decided_by_the_floor_have_a_letter(count):
    gapped = [
        delta("I-TMMD", "a", f"b{k}", -1, (-2, -0.1), up=None, better="a") for k in range(count)
    ]
    for d in gapped:
        d.details["gap"] = 0.1
    text = latex_tables(
        Results(title="t", scores=[*gapped, delta("TMMD", "a", "b0", -1, (-2, -0.1))])
    )
    assert [row[5] for row in cells(text) if row[0].endswith("arrow$")] == [
        r"$90.0\,\%$\textsuperscript{a}"
    ] * count + [r"$90.0\,\%$"]
    assert text.count(r"\textsuperscript{a}~" + escape(NEARER)) == 1
