"""Studies at ``smoke`` to their page: forged trees of true layouts, real clips, the DIGIT world."""

import pytest

from conftest import shared_data
from forge.studies import forge_clips, forge_hct, forge_touch_and_go
from palpate.cli import main
from palpate.report.results import Results
from palpate.studies.study import NOLEAK, ORIG


def reproduced(study, root, run):
    """The results of a study, with its page."""
    command = ["reproduce", study, "--preset", "smoke", "-o", str(run), "-q"]
    command += [] if root is None else ["--root", str(root)]
    assert main(command) == 0
    assert (run / "page.html").stat().st_size > 0
    return Results.load(run / "results.json")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "forge", "rule", "tables"),
    [
        ("tag", forge_touch_and_go, "TaG-NoLeak", ["Table 1", "Table 3", "Table 4"]),
        pytest.param(
            "hct", forge_hct, "HCT-NoLeak", ["Table 2", "Table 4"], marks=pytest.mark.nightly
        ),
    ],
)
def test_the_papers_data_sets_reach_the_page(study, forge, rule, tables, tmp_path):
    results = reproduced(study, forge(tmp_path), tmp_path / "run")
    assert results.settings["split rule"][NOLEAK]["name"] == rule
    assert results.audits[1].leaked_fraction == 0 < results.audits[0].leaked_fraction
    titles = [table.title.partition(":")[0] for table in results.tables]
    assert [title for title in titles if title.startswith("Table")] == tables
    rows = [str(row[0]) for row in results.tables[0].rows]
    assert {f"paper, {ORIG}", f"paper, {NOLEAK}"} <= {*rows}


@pytest.mark.nightly
@pytest.mark.slow
def test_clips_reach_the_page(tmp_path):
    place = shared_data()
    clips = forge_clips(tmp_path) if place is None else place / "touch_and_go" / "clips"
    results = reproduced("clips", clips, tmp_path / "run")
    assert results.settings["split rule"][ORIG]["group"] == "contact"
    assert results.settings["split rule"][NOLEAK]["group"] == "video"
    assert results.audits[1].leaked_fraction == 0 < results.audits[0].leaked_fraction
    assert not any(str(row[0]).startswith("paper") for row in results.tables[0].rows)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_digit_world_reaches_the_page(tmp_path):
    results = reproduced("world-digit", None, tmp_path / "run")
    assert results.audits[1].leaked_fraction == 0 < results.audits[0].leaked_fraction
    titles = [table.title.partition(":")[0] for table in results.tables]
    assert [title for title in titles if title.startswith("Table")] == ["Table 2", "Table 4"]
