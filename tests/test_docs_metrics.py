"""docs/concepts/metrics.md: snippets run, figures are in the studies, presets are the code's."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from palpate.cli import main
from palpate.metrics import PRESETS

TOP = Path(__file__).resolve().parents[1]
DOCS = TOP / "docs"
PAGE = (DOCS / "concepts" / "metrics.md").read_text(encoding="utf-8")
TABLES = {
    name: (DOCS / "studies" / f"metric_{name}.md").read_text(encoding="utf-8")
    for name in ("responses", "degradations", "coverage")
}


def rows(table, title):
    """Cells of the rows below the header, in the section ``title`` of a study."""
    section = rf"^## {re.escape(title)}.*?\n(.*?)(?=^## |\Z)"
    text = re.search(section, TABLES[table], re.DOTALL | re.MULTILINE).group(1)
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def percent(cell):
    return float(cell.split(" %")[0])


def test_snippets_and_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block, names)
    printed = capsys.readouterr().out
    for metric in ("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD"):
        assert re.search(rf"^{metric} -?[\d.]+ \(", printed, re.MULTILINE), metric
    assert re.search(r"^TMMD difference -.* ours$", printed, re.MULTILINE)
    commands = "".join(re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)).splitlines()
    assert len(commands) >= 2
    for name, *words in map(shlex.split, commands):
        assert name == "palpate"
        assert main([*words, "-q"]) == 0, (words, capsys.readouterr().err)


def test_every_figure_is_in_a_study_table():
    text = re.sub(r"```.*?```|`[^`]*`|^    .*?$", "", PAGE, flags=re.DOTALL | re.MULTILINE)
    figures = re.findall(r"[+-]?\d+\.\d+(?: ± \d+\.\d+)?", text)
    known = lambda f: rf"(?<![\d.]){re.escape(f.removeprefix('+'))}(?!\d)"
    tables = "".join(TABLES.values())
    assert len(figures) > 60
    assert [f for f in figures if not re.search(known(f), tables)] == []


def test_ranges_of_coverage_match_the_study():
    table = rows("coverage", "Intervals that leave out whole videos")
    covered = lambda *names: [percent(r[6]) for r in table if r[0] in names]
    tests = rows("coverage", "Permutation tests of a true null at 5 %")
    paired = [r for r in table if r[0] == "TMMD under the null" and r[1].endswith(", paired")]
    intervals = [covered("TMMD"), covered("I-TMMD: E", "CI-TMMD: E")]
    intervals.append(covered("D: mean inter-class"))
    rejected = [percent(r[1]) for r in tests]
    two = [percent(r[6]) for r in rows("coverage", "Two generators on the same videos")]
    for values in (*intervals, rejected, [percent(r[6]) for r in paired], two):
        assert f"{min(values):.1f} to {max(values):.1f} %" in PAGE
    assert all(92 <= value <= 99 for values in intervals for value in values)
    assert all(3 <= value <= 8 for value in rejected)
    # over frames both fail
    flat = rows("coverage", "Intervals that leave out frames (no groups given)")
    assert all(percent(r[6]) < 92 for r in flat if r[1].endswith("unpaired") or "inter" in r[0])
    assert all(percent(r[3]) > 8 for r in tests)


RANKED = {"mean shift", "less spread", "unstable over videos", "blur", "full collapse"}
GEL = {"empty gel", "faint contact"}
NO, YES, REVERSED = 3, 1, 4


@pytest.mark.parametrize(
    ("metric", "column", "degradations"),
    [
        ("TMMD", YES, RANKED | GEL),
        ("TMMD", NO, {"wrong material", "new videos"}),
        ("TMMD, median", NO, {"wrong material", "new videos"}),
        ("TMMD, multi", YES, RANKED | GEL | {"class collapse"}),
        ("TMMD, multi", 2, {"memorized videos"}),
        ("TMMD, multi", NO, {"wrong material", "new videos"}),
        ("PSNR", REVERSED, GEL),
        ("SSIM", REVERSED, GEL),
        ("MS-SSIM", REVERSED, GEL),
        ("contact PSNR", REVERSED, GEL),
        ("contact SSIM", YES, {"wrong material"}),
        ("contact SSIM", 2, {"empty gel"}),
        ("contact residual", YES, GEL),
        ("contact IoU", YES, GEL),
        ("CI: E", REVERSED, {"empty gel", "memorized videos", "wrong material"}),
        ("CI: E, off the floor", YES, {"wrong material", "memorized videos"}),
        ("I, random", YES, {"-"}),
    ],
)
def test_verdicts_match_the_study(metric, column, degradations):
    (row,) = [r for r in rows("degradations", "Verdict") if r[0] == metric]
    assert degradations <= set(row[column].split(", "))


@pytest.mark.parametrize("name", PRESETS)
def test_the_table_of_presets_matches_the_code(name):
    plan = PRESETS[name]
    pairs, halves, ratio = re.search(
        rf"^\| `{name}` \| (.*?) \| (.*?) \| (.*?) \|", PAGE, re.MULTILINE
    ).groups()
    words = {"grouped": "different videos", "unbiased": '"unbiased"', "biased": '"biased"'}
    assert words[plan.estimator] in pairs
    words = {"group": "whole videos", "random": "random", "ordered": "order"}
    assert words[plan.halves] in halves
    assert plan.aggregate.replace("_", " ").replace("the ", "") in ratio


def test_the_table_of_presets_is_complete():
    assert set(re.findall(r"^\| `([\w-]+)` \| .*\|$", PAGE, re.MULTILINE)) == set(PRESETS)


def test_links_resolve():
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", PAGE)
    assert len(links) >= 5
    assert [link for link in links if not (DOCS / "concepts" / link).is_file()] == []


@pytest.mark.parametrize("name", sorted(TABLES))
def test_a_study_page_names_its_command(name):
    script = TOP / "benchmarks" / f"metric_{name}.py"
    source = script.read_text(encoding="utf-8")
    command = f"python benchmarks/metric_{name}.py"
    assert re.search(rf"Written by `{command}.*20\d\d-\d\d-\d\d", TABLES[name].splitlines()[2])
    assert command in ast.get_docstring(ast.parse(source))
    assert f"{command} --write" in PAGE
    assert '"--write"' in source
