"""Tables and claims of a study: on the page, in text, in LaTeX and as figures."""

import dataclasses
import json
import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from forge.results import Tree, images, score, study_results
from palpate.cli import main
from palpate.core import SampleRef
from palpate.report import write_report
from palpate.report.figures import Panel, panels_of, strips_svg
from palpate.report.first_screen import telling_columns
from palpate.report.labels import file_names
from palpate.report.page import OPEN_CLAIMS, render_page
from palpate.report.records import Claim, GalleryItem, StudyTable
from palpate.report.results import Results
from palpate.report.study import brief, of_study, tally
from palpate.report.tables import families, grid
from palpate.report.terminal import as_text
from palpate.studies.evidence import in_words

LONG = "a_method_with_a_name_that_no_line_of_a_phone_can_hold_2024_11_21_rig_b_second_run"


def up(subject, value, **changes):
    """A score that is better when higher."""
    return score("accuracy", subject, value, **({"higher_is_better": True} | changes))


def best_of(table):
    return [
        {head.label for head, cell in zip(laid.heads, row.cells, strict=True) if cell.best}
        for laid in [of_study(table)]
        for row in laid.rows
    ]


def page_text(results, folder):
    html = render_page(results, folder, max_bytes=1_500_000)
    return html, Tree(html).text


# --- tables ---------------------------------------------------------------------------------


def test_the_best_of_a_column_follows_its_direction_and_is_no_control():
    rows = [
        ["a", score(value=2.0), up("a", 0.6), score("D-TMMD", "a", 0.3, higher_is_better=None)],
        ["b", score(value=1.0), up("b", 0.4), score("D-TMMD", "b", -0.5, higher_is_better=None)],
        ["photo", score(value=0.1), up("photo", 0.9), score("D-TMMD", higher_is_better=None)],
    ]
    table = StudyTable("T", "", ["method", "TMMD", "accuracy", "D"], rows, True, ["photo"])
    assert best_of(table) == [{"accuracy", "D"}, {"TMMD"}, set()]
    assert best_of(dataclasses.replace(table, best=False)) == [set()] * 3
    assert best_of(dataclasses.replace(table, controls=["photo", "b"])) == [set()] * 3
    directed = dataclasses.replace(table, best=False)  # controls are compared with
    assert [h.arrow for h in of_study(directed).heads] == ["", "↓", "↑", "→"]
    neither = dataclasses.replace(directed, controls=[])
    assert [h.arrow for h in of_study(neither).heads] == [""] * 4
    heads = [(head.arrow, head.scores) for head in of_study(table).heads]
    assert heads == [("", False), ("↓", True), ("↑", True), ("→", True)]


def test_equal_numbers_are_equally_good_and_what_cannot_be_compared_is_never_best():
    def table(*scores):
        rows = [[str(k), s] for k, s in enumerate(scores)]
        return StudyTable("T", "", ["", "value"], rows, best=True)

    assert best_of(table(up("a", 0.5004), up("b", 0.5001), up("c", 0.4))) == [
        {"value"},
        {"value"},
        set(),
    ]
    for scores in (
        (up("a", 0.5), None, up("b", None)),
        (up("a", 0.5), up("b", math.nan)),
        (up("a", 0.5), score("TMMD", "b", 1.0)),
        (
            score("D", "a", 1.0, higher_is_better=None),
            score("D", "b", 2.0, higher_is_better=None, floor=None),
        ),
        (up("a", 0.5), "not run"),
    ):
        assert best_of(table(*scores)) == [set()] * len(scores)


def test_a_column_has_one_number_of_decimals_and_a_table_of_metrics_one_a_row():
    column = [
        ["a", score(value=12.3456, interval=None)],
        ["b", score(value=0.01234, interval=None)],
    ]
    text = str(Results("T", tables=[StudyTable("T", "", ["", "v"], column)]))
    assert re.findall(r"\d+\.\d+", text) == ["12.35", "0.01"]
    metrics = [["FID", score("FID", value=123.456)], ["SSIM", score("SSIM", value=0.45678)]]
    text = str(Results("T", tables=[StudyTable("T", "", ["", "v"], metrics)]))
    assert "123.5" in text.replace("123.46", "123.5")
    assert "0.46 [" in text


def test_ranks_have_no_decimals_and_empty_columns_stand_with_the_scores():
    rows = [
        [name, score("rank", name, value, interval=None), None]
        for name, value in (("a", 2.0), ("b", 1.0))
    ]
    laid = of_study(StudyTable("T", "", ["", "rank", "k = 8"], rows))
    assert [row.cells[1].digits for row in laid.rows] == [0, 0]
    assert [head.scores for head in laid.heads] == [False, True, True]
    table = StudyTable("T", "", ["", "a", "b"], [["x", up("x", 0.5)], ["y"]])  # rows may be short
    assert [len(row.cells) for row in of_study(table).rows] == [3, 3]
    lost = [["a", score("rank", "a", math.nan, interval=None)], *rows]
    assert of_study(StudyTable("T", "", ["", "rank"], lost)).rows[1].cells[1].digits == 0
    shares = [["a", up("a", 1.0, interval=None)], ["b", up("b", 0.0, interval=None)]]
    assert of_study(StudyTable("T", "", ["", "share"], shares)).rows[0].cells[1].digits == 3


def test_how_a_table_was_made_names_stages_sizes_and_intervals():
    rows = [["a", up("a", 0.5, n=40, details={"stage": "probe-0"})]]
    how = "jackknife, t, 14.8 df"
    more = {"n": 1200, "details": {"stage": "probe-1"}, "seed": 3, "interval_method": how}
    rows.append(["b", up("b", 0.6, **more)])
    made = dict(of_study(StudyTable("T", "", ["", "v"], rows)).facts)
    assert made == {
        "n": "40 to 1,200",
        "interval": "95 %, jackknife, t, 9-14.8 df",
        "estimator": "unbiased",
        "seed": "3",
        "stages": "probe-0, probe-1",
    }


# --- every front end ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return study_results(folder, 6), folder


def test_every_front_end_has_every_number_verdict_and_reason(study):
    results, folder = study
    _html, shown = page_text(results, folder)
    texts = [str(results), results.to_markdown(), results.to_latex(), shown]
    for text in texts:
        text = text.replace("\u00a0", " ").replace("−", "-").replace("\\", "")
        for part in ("2.60", "2.34, 2.86", "nearest photo", "0.340"):
            assert part in text, part
        for part in ("does not hold", "undecided", "No weights of Inception", "paper, table 1"):
            assert part in text, part
        assert "Table 4: generators" in text
        assert "1 holds, 1 does not hold, 1 undecided" in text
    again = Results.from_json(json.loads(json.dumps(results.to_json())))
    assert again.to_json() == results.to_json()
    assert "The 4 scores behind them" in str(results)
    assert "1.37" not in str(results)  # the tables of a study instead of every score
    assert "1.37" in str(dataclasses.replace(results, tables=[]))


@pytest.mark.parametrize("width", [70, 90, 140])
def test_wide_tables_cut_no_number(study, width):
    results, _ = study
    text = as_text(Results("T", tables=results.tables), width)
    assert max(map(len, text.splitlines())) <= width
    for row in results.tables[0].rows:
        for s in row[1:]:
            if s is not None and s.value is not None and s.interval:
                low, high = s.interval
                assert re.search(rf"{s.value:.2f}\d? \[{low:.2f}\d?, {high:.2f}\d?\]", text)
    names = as_text(
        Results("T", tables=[StudyTable("T", "", ["", "v"], [[LONG, up("a", 0.5)]])]), 40
    )
    assert names.splitlines()[1:3] == [LONG, "  v: 0.50 [1.01, 1.75]"]


def test_the_page_has_its_sections_in_order_and_folds_tables(study):
    results, folder = study
    html, _ = page_text(results, folder)
    parts = ['class="card"', 'id="claims"', 'id="scores"', 'id="study"']
    places = [html.index(part) for part in [*parts, 'id="gallery"', 'id="leakage"', 'id="cite"']]
    assert places == sorted(places)
    for title in ("Table 4: generators", "Compute"):
        assert f"<details><summary>{title}</summary>" in html
    for mark, verdict in (("✓", "holds"), ("✗", "does not hold"), ("?", "undecided")):
        assert f'aria-hidden="true">{mark}</span> {verdict}' in html
    tree = Tree(html)
    assert html.count("<b>1.20</b>") == 1
    rows = [attrs.get("class") for attrs in tree.all("tr") if "control" in attrs.get("class", "")]
    assert rows == ["control rule", "control", "control"]
    assert not re.findall(r"<h[1-4][^>]*>\s*</h", html)


def test_the_first_claims_are_open_and_the_others_are_folded(tmp_path):
    claims = [Claim(f"Claim {k}", "table 1", "holds", "Why.") for k in range(OPEN_CLAIMS)]
    claims += [Claim(f"Claim {k}", "table 3", "undecided", "Why.") for k in (20, 21)]
    html, text = page_text(Results("T", claims=claims), tmp_path)
    assert "2 more claims: 2 undecided" in text
    assert [int(k) for k in re.findall(r"Claim (\d+)<", html)] == [*range(OPEN_CLAIMS), 20, 21]
    assert "Which claims hold?" in text
    assert tally(claims[:1]) == "1 holds"


def drawn(panels, name):
    """The elements of a kind in a drawing of strips: tag, class and text or position."""
    tree = ET.fromstring(strips_svg("T", panels))
    return [e for e in tree.iter() if (e.get("class") or "").split()[-1:] == [name]]


def texts(panels):
    return [e.text for e in ET.fromstring(strips_svg("T", panels)).iter() if e.tag.endswith("text")]


def test_the_axis_of_strips_is_that_of_the_methods_and_a_control_beyond_it_an_arrow():
    close = {"null": None, "floor": 0.1, "interval": None}
    rows = [("a", up("a", 0.1, **close), False), ("b", up("b", 0.2, **close), False)]
    far = [Panel("accuracy", [*rows, ("x", up("x", 9.0, **close), True)])]
    ticks = [{*texts(panels)} for panels in ([Panel("accuracy", rows)], far)]
    assert ticks[0] - {"dot: score; dashed: floor"} <= ticks[1]
    assert [e.tag.rpartition("}")[2] for e in drawn(far, "value")] == ["circle", "circle", "path"]
    assert "9.000" in ticks[1]


def test_a_long_reason_is_cut_where_a_clause_ends_and_is_whole_in_the_evidence(tmp_path):
    why = "; ".join(f"metric {k} puts Ours ahead by 0.0{k}" for k in range(20))
    claim = Claim("C", "paper", "holds", why, [up("a", 0.5)])
    scores = [up("a", 0.123456, interval=(0.12, 0.13)), up("b", 0.5, interval=(0.1, 0.9))]
    short = f"Ours {in_words(scores[0])}, GVST {in_words(scores[1])}."
    text = page_text(Results("T", claims=[Claim("C", "s", "holds", short, scores)]), tmp_path)[1]
    for number in ("0.1235 [0.1200, 0.1300]", "0.50 [0.10, 0.90]"):
        assert text.count(number) == 2  # in the reason and in its evidence
    many = dataclasses.replace(claim, evidence=[up(f"a{k}", 0.5) for k in range(600)])
    assert "576 more in the JSON" in page_text(Results("T", claims=[many]), tmp_path)[1]
    assert brief(why) == f"{why[: why.index('; metric 6')]} …"
    assert len(brief("x" * 500)) == 222
    assert brief("Short.") == "Short."
    html, text = page_text(Results("T", claims=[claim]), tmp_path)
    assert html.index(brief(why)) < html.index("Evidence (1)") < html.index(why)
    assert why in Results("T", claims=[claim]).to_markdown().replace("\\", "")
    assert why in text


def test_files_are_named_by_kind_and_title_and_differ():
    titles = ["Table 3: methods", "Table 3: methods!", "中", "x" * 90]
    names = file_names("table", titles)
    assert names == ["table-3-methods", "table-3-methods-2", "table", f"table-{'x' * 48}"]
    assert len({*file_names("tab", ["a", "a 2", "a", "a"])}) == 4


def test_many_rows_long_words_and_empty_things_are_drawn(tmp_path):
    rows = [[f"{LONG} {k}", up("a", 0.01 * k, interval=None), LONG, None] for k in range(20)]
    tables = [
        StudyTable(LONG, LONG, ["method", LONG, "words", "nothing"], rows, True, [rows[-1][0]]),
        StudyTable("No rows", "", ["method", "value"], []),
    ]
    claims = [Claim(LONG, LONG, "undecided", LONG, [up(LONG, None)])]
    results = Results("T", tables=tables, claims=claims)
    _html, text = page_text(results, tmp_path)
    assert text.count("undefined") == 1
    for text in (str(results), results.to_markdown(), results.to_latex()):
        assert (
            text.count(
                f"{LONG}".replace("_", r"\_") if "toprule" in text or "###" in text else LONG
            )
            > 20
        )
    assert results.save_figures(tmp_path / "figures") == []


# --- drawings as files ----------------------------------------------------------------------


def test_strips_draw_value_interval_null_and_floor_and_hollow_controls(study):
    results, _ = study
    panels = panels_of(of_study(results.tables[0]))
    assert [p.title for p in panels] == ["TMMD ↓", "material accuracy ↑", "D-TMMD →", "LPIPS ↓"]
    scores = [score("TMMD", name) for name in ("ours", "photo", "real")]
    (known,) = panels_of(grid(telling_columns(families(scores, {"photo"}))))
    assert [control for *_, control in known.rows] == [False, True, True]
    cells = [["Ours", split, up("a", 0.5), "note"] for split in ("Orig", "NoLeak")]
    names = ["method", "split", "accuracy", "why"]
    (named,) = panels_of(of_study(StudyTable("T", "", names, cells)))
    assert [label for label, *_ in named.rows] == ["Ours, Orig", "Ours, NoLeak"]
    rows = [(label, s, False) for label, s, _ in panels[0].rows]  # all are on the axis
    rows.append(("inside " * 9, dataclasses.replace(rows[0][1], interval=None), True))
    panel = [Panel("TMMD", rows)]
    dots = [float(e.get("cx")) for name in ("value", "hollow") for e in drawn(panel, name)]
    assert len(drawn(panel, "hollow")) == 1
    values = [s.value for _, s, _ in rows]
    slope, start = np.polyfit(values, dots, 1)
    assert dots == pytest.approx([start + slope * v for v in values], abs=0.02)
    ends = [re.findall(r"M([\d.]+) 11.0v?", e.get("d"))[0] for e in drawn(panel, "interval")]
    lows = [row[1].interval[0] for row in results.tables[0].rows]
    assert [float(x) for x in ends] == pytest.approx([start + slope * v for v in lows], abs=0.02)
    words = texts(panel)
    assert words.count("nearest photo") == 1
    assert "1.20 [1.08, 1.32]" in words
    assert "inside inside inside in..." in words
    assert "undefined" in texts(panels[2:3])


# --- figures of images ----------------------------------------------------------------------


def test_figures_hold_samples_pairs_and_the_background(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = study_results(Path(), 4)
    names = images(Path(), 2)
    Image.new("RGB", (64, 64), (10, 20, 30)).save("flat.png")
    Image.new("RGB", (64, 64), (200, 20, 30)).save("real.png")
    sample = SampleRef("s", "v", 1, "gold", "real.png", "real.png", background="flat.png")
    gallery = [GalleryItem(sample, "absent.png"), *results.gallery]
    results = dataclasses.replace(results, gallery=gallery)
    files = {path.name: path for path in results.save_figures("figures")}
    assert {"samples.png", "background.png", "pairs-orig.png"} <= set(files)
    assert {path.suffix for name, path in files.items() if "strips" in name} == {".svg"}
    samples = np.asarray(Image.open(files["samples.png"]).convert("RGB"))
    assert (samples == (200, 20, 30)).all(axis=-1).sum() == 2 * 256 * 256
    background = np.asarray(Image.open(files["background.png"]).convert("RGB"))
    assert (background == (10, 20, 30)).all(axis=-1).sum() == 256 * 256
    assert names


# --- the command ----------------------------------------------------------------------------


def test_the_command_writes_figures_and_replaces_no_other_file(tmp_path, capsys):
    results = study_results(tmp_path, 2)
    results = dataclasses.replace(results, audits=results.audits[1:])
    page = write_report(results, tmp_path / "first.html", base=tmp_path).page
    given = [str(page.with_suffix(".json")), "-o", str(tmp_path / "page.html"), "-q"]
    folder = tmp_path / "figures"
    for _ in range(2):  # its own files are replaced
        assert main(["report", *given, "--figures", str(folder)]) == 0
    again = Results.load(tmp_path / "page.json")
    assert [len(getattr(again, n)) for n in ("tables", "claims")] == [2, 3]
    assert {p.suffix for p in folder.iterdir()} == {".svg", ".png"}
    (folder / "thesis.csv").touch()
    capsys.readouterr()
    assert main(["report", *given, "--figures", str(folder)]) == 2
    assert "--figures must be a new folder" in capsys.readouterr().err
    assert main(["report", *given, "--figures", str(page)]) == 2
    assert "--figures must be a folder" in capsys.readouterr().err


def test_figures_have_two_schemes_and_say_their_numbers_to_those_who_do_not_see_them(tmp_path):
    files = study_results(tmp_path, 2).save_figures(tmp_path / "figures")
    drawn = [path.read_text() for path in files if path.suffix == ".svg"]
    assert drawn
    for text in drawn:
        light, dark = text.split("@media (prefers-color-scheme: dark)")
        assert ".paper { fill: #ffffff }" in light
        assert ".paper { fill: #111418 }" in dark
        (said,) = re.findall("<desc>(.*)</desc>", text)
        labels = re.findall(r'class="ink" x="0"[^>]*>([^<]*)<', text)
        assert labels
        # Labels are cut where they are too wide; their alternative is whole.
        assert all(f" of {label.removesuffix('...')}" in said for label in labels)
        assert len(re.findall(r"\d", said)) > len(labels)


def test_a_study_opens_with_its_claims(tmp_path):
    page = write_report(study_results(tmp_path, 2), tmp_path / "p.html", base=tmp_path).page
    text = page.read_text()
    (lede,) = re.findall(r'<p class="lede">(.*)</p>', text)
    assert lede.endswith('<a href="#claims">1 holds, 1 does not hold, 1 undecided</a>.')
    tables = text[text.index('id="study"') :]
    assert "<details open>" not in tables[: tables.index("</section>")]
