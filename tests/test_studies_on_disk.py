"""Studies to their page: forged trees of true layouts, real clips, the worlds."""

import pytest

from conftest import shared_data
from forge.studies import forge_clips, forge_hct, forge_touch_and_go
from palpate.cli import main
from palpate.report.results import Results
from palpate.studies.names import NOLEAK, ORIG
from palpate.studies.study import STUDIES


def clips(folder):
    place = shared_data()
    return forge_clips(folder) if place is None else place / "touch_and_go" / "clips"


def reaches_the_page(study, forge, rules, numbers, folder):
    """Run a study at ``smoke``; the rules of its splits, its tables, the paper's rows."""
    command = ["reproduce", study, "--preset", "smoke", "-o", str(folder / "run"), "-q"]
    command += [] if forge is None else ["--root", str(forge(folder))]
    assert main(command) == 0
    assert (folder / "run" / "page.html").stat().st_size > 0
    results = Results.load(folder / "run" / "results.json")
    for split, (field, value) in rules.items():
        assert results.settings["split rule"][split][field] == value
    assert results.audits[1].leaked_fraction == 0 < results.audits[0].leaked_fraction
    titles = [table.title.partition(":")[0] for table in results.tables]
    titles = [title for title in titles if title.startswith("Table")]
    assert titles == [f"Table {number}" for number in numbers]
    printed = {str(row[0]) for row in results.tables[0].rows if str(row[0]).startswith("paper")}
    paper = {f"paper, {ORIG}", f"paper, {NOLEAK}"}
    assert printed == (paper if STUDIES[study].paper else set())


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "forge", "rules", "numbers"),
    [
        ("tag", forge_touch_and_go, {NOLEAK: ("name", "TaG-NoLeak")}, (1, 3, 4)),
        ("hct", forge_hct, {NOLEAK: ("name", "HCT-NoLeak")}, (2, 4)),
        ("clips", clips, {ORIG: ("group", "contact"), NOLEAK: ("group", "video")}, (1, 3, 4)),
        ("world-gelsight", None, {}, (1, 3, 4)),
        ("world-digit", None, {}, (2, 4)),
    ],
)
def test_every_study_reaches_the_page_at_smoke(study, forge, rules, numbers, tmp_path):
    reaches_the_page(study, forge, rules, numbers, tmp_path)
