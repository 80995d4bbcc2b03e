"""docs/concepts/metrics.md is true: its snippets and commands run, its figures are the written tables', its presets are the code's."""

import importlib.util
import re
import shlex
import sys
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
STUDIES = {name: f"metric_{name}" for name in TABLES}


def rows(table, title):
    """Cells of the rows of the section ``title`` of a table, by line."""
    text = re.search(
        rf"^## {re.escape(title)}.*?\n(.*?)(?=^## |\Z)", TABLES[table], re.DOTALL | re.MULTILINE
    ).group(1)
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("| ")
    ]


def percent(cell):
    return float(cell.split(" %")[0])


def study(name):
    sys.path.insert(0, str(TOP / "benchmarks"))
    spec = importlib.util.spec_from_file_location(
        STUDIES[name], TOP / "benchmarks" / f"{STUDIES[name]}.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[STUDIES[name]] = module
    spec.loader.exec_module(module)
    return module


def test_the_snippets_and_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block, names)
    said = capsys.readouterr().out
    assert [line.split()[0] for line in said.splitlines()[:5]] == [
        "TMMD",
        "I-TMMD",
        "CI-TMMD",
        "D-TMMD",
        "TMMD,",
    ]
    assert re.search(
        r"^TMMD difference -.* ours ", said, re.MULTILINE
    )  # the nearer of the two is found
    commands = [
        shlex.split(line)
        for line in "\n".join(re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)).splitlines()
        if line
    ]
    assert len(commands) >= 2
    for words in commands:
        assert words[0] == "palpate"
        assert main([*words[1:], "-q"]) == 0, (words, capsys.readouterr().err)


def test_every_figure_stands_in_a_written_table():
    text = re.sub(r"```.*?```|`[^`]*`|^    .*?$", "", PAGE, flags=re.DOTALL | re.MULTILINE)
    tables = "".join(TABLES.values())
    figures = re.findall(r"[+-]?\d+\.\d+(?: ± \d+\.\d+)?", text)
    assert len(figures) > 60
    assert [
        f
        for f in figures
        if not re.search(rf"(?<![\d.]){re.escape(f.removeprefix('+'))}(?!\d)", tables)
    ] == []


def test_ranges_of_coverage_are_those_of_the_tables():
    found = rows("coverage", "Intervals that leave out whole videos")
    cells = lambda *names: [percent(r[6]) for r in found if r[0] in names]  # noqa: E731
    rejected = [
        percent(r[1]) for r in rows("coverage", "Permutation tests of a true null at 5 %")[1:]
    ]
    ranges = [
        cells("TMMD"),
        cells("I-TMMD: E", "CI-TMMD: E"),
        cells("D: mean inter-class"),
        rejected,
    ]
    ranges.append(
        [
            percent(r[6])
            for r in found
            if r[0] == "TMMD under the null" and r[1].endswith("paired") and "unpaired" not in r[1]
        ]
    )
    ranges.append(
        [percent(r[6]) for r in rows("coverage", "Two generators on the same videos")[1:]]
    )
    for values in ranges:
        assert f"{min(values):.1f} to {max(values):.1f} %" in PAGE
    for values in ranges[:3]:
        assert min(values) >= 92
        assert max(values) <= 99
    assert min(rejected) >= 3
    assert max(rejected) <= 8


def test_frames_fail_in_the_table():
    flat = rows("coverage", "Intervals that leave out frames (no groups given)")
    assert all(percent(r[6]) < 92 for r in flat if r[1].endswith("unpaired") or "inter" in r[0])
    assert all(
        percent(r[3]) > 8 for r in rows("coverage", "Permutation tests of a true null at 5 %")[1:]
    )


def test_the_verdicts_are_those_of_the_tables():
    found = {
        r[0]: dict(
            zip(
                ("yes", "mostly", "no", "reversed"),
                (set(c.split(", ")) for c in r[1:]),
                strict=True,
            )
        )
        for r in rows("degradations", "Verdict")[1:]
    }
    multi = found["TMMD, multi"]
    ranked = {
        "mean shift",
        "less spread",
        "unstable over videos",
        "empty gel",
        "faint contact",
        "blur",
        "full collapse",
    }
    assert ranked <= found["TMMD"]["yes"]
    assert ranked | {"class collapse"} <= multi["yes"]
    assert "memorized videos" in multi["yes"] | multi["mostly"]
    for name in ("TMMD", "TMMD, median", "TMMD, multi"):
        assert "wrong material" in found[name]["no"]
        assert "new videos" in found[name]["no"]
    for name in ("PSNR", "SSIM"):
        assert {"empty gel", "faint contact"} <= found[name]["reversed"]
    assert "wrong material" in found["contact SSIM"]["yes"]
    assert "empty gel" in found["contact SSIM"]["mostly"]
    assert {"empty gel", "faint contact"} <= found["contact PSNR"]["reversed"] & found["MS-SSIM"][
        "reversed"
    ]
    assert {"empty gel", "faint contact"} <= found["contact residual"]["yes"] & found[
        "contact IoU"
    ]["yes"]
    assert {"empty gel", "memorized videos", "wrong material"} <= found["CI: E"]["reversed"]
    assert {"wrong material", "memorized videos"} <= found["CI: E, off the floor"]["yes"]
    assert found["I, random"]["yes"] == {"-"}


def test_the_table_of_presets_is_that_of_the_code():
    told = re.findall(r"^\| `([\w-]+)` \| .*\|$", PAGE, re.MULTILINE)
    assert set(told) == set(PRESETS)
    for name, plan in PRESETS.items():
        row = re.search(rf"^\| `{name}` \| (.*?) \| (.*?) \| (.*?) \|", PAGE, re.MULTILINE).groups()
        assert {"grouped": "different videos", "unbiased": '"unbiased"', "biased": '"biased"'}[
            plan.estimator
        ] in row[0]
        assert {"group": "whole videos", "random": "random", "ordered": "order"}[
            plan.halves
        ] in row[1]
        assert plan.aggregate.replace("_", " ").replace("the ", "") in row[2]


def test_links_resolve_and_commands_name_scripts_and_flags():
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", PAGE)
    assert len(links) >= 5
    assert [link for link in links if not (DOCS / link).is_file()] == []
    for script, rest in re.findall(r"python (benchmarks/\S+\.py)(.*)", PAGE):
        text = (TOP / script).read_text(encoding="utf-8")
        for flag in re.findall(r"(?<!\S)--[a-z]+", rest):
            assert f'"{flag}"' in text, (script, flag)


@pytest.mark.parametrize("name", sorted(TABLES))
def test_a_table_says_how_it_was_made(name):
    module = study(name)
    head = TABLES[name].splitlines()[2]
    assert f"Written by `python benchmarks/metric_{name}.py" in head
    assert re.search(r"20\d\d-\d\d-\d\d", head)
    assert f"python benchmarks/metric_{name}.py" in module.__doc__
