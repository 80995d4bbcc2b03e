"""docs/concepts/metrics.md: snippets run, ranges are the study's, presets are the code's."""

import re
import shlex
from pathlib import Path

import pytest

from palpate.cli import main
from palpate.metrics import PRESETS

TOP = Path(__file__).resolve().parents[1]
DOCS = TOP / "docs"
PAGE = (DOCS / "concepts" / "metrics.md").read_text(encoding="utf-8")
COVERAGE = (DOCS / "studies" / "metric_coverage.md").read_text(encoding="utf-8")


def percents(*names):
    """Shares of the rows of these names in the study of coverage."""
    rows = [line.strip("| ").split(" | ") for line in COVERAGE.splitlines()]
    cells = [cell for name, *cells in rows for cell in cells if name in names]
    assert len(cells) == 3 * len(names), names
    return [float(cell.split(" %")[0]) for cell in cells]


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


def test_ranges_of_coverage_match_the_study():
    covered = [
        percents("TMMD, unpaired", "TMMD, paired"),
        percents("I-TMMD: E", "CI-TMMD: E"),
        percents("D: inter"),
        percents("difference of TMMD, paired"),
    ]
    rejected = [f"true null rejected at 5 %, videos, {kind}" for kind in ("unpaired", "paired")]
    for values in (*covered, percents(*rejected), percents("TMMD null, paired")):
        assert f"{min(values):.1f} to {max(values):.1f} %" in PAGE
    assert all(92 <= value <= 99 for values in covered for value in values)
    assert all(3 <= value <= 8 for value in percents(*rejected))
    # over frames both fail
    assert max(percents("TMMD, frames, unpaired", "TMMD null, frames, unpaired")) < 92
    assert min(percents(*(name.replace("videos", "frames") for name in rejected))) > 8


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
    assert len(links) >= 3
    assert [link for link in links if not (DOCS / "concepts" / link).is_file()] == []
