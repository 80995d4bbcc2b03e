"""Run folders verified: changed files, records and numbers are named; moved folders verify."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from forge import studies as small_study
from forge.results import edit
from palpate.cli import main
from palpate.core import Score
from palpate.preference.scoring import PREFERENCE
from palpate.report.records import Claim, StudyTable
from palpate.report.results import Results
from palpate.studies import reproduce
from palpate.studies.names import NOLEAK
from palpate.studies.reproduce import run_study
from palpate.studies.stages import record_of, run_stage
from palpate.studies.study import STUDIES
from palpate.studies.verifying import verify

SCORE = Score("TMMD", "Ours", 1.25, n=8, details={"stage": "results"})


@pytest.fixture
def forged(tmp_path) -> Path:
    """The results of a run of two stages of a study that palpate does not know."""
    run = tmp_path / "run"

    def images(folder):
        (folder / "a.txt").write_text("an image")

    def results(folder):
        words = ("paper", "1.37")
        table = StudyTable(
            "Table 9", "Of 9 videos", ("", "TMMD"), [("Ours", SCORE), words], controls=["paper"]
        )
        claim = Claim("Claim", "paper", "holds", "1.25 is low", [SCORE])
        made = Results("Forged", ["Fact: 3 of 4"], scores=[SCORE], tables=[table])
        replace(made, claims=[claim]).save(folder / "results.json")

    stages = {"images": run_stage(run / "images", {"seed": 0}, images)}
    stages["results"] = run_stage(run / "results", {"images": stages["images"].digest}, results)
    settings = {"study": "forged", "digests": {"manifest": "m"}, **record_of(stages)}
    plain = Results.load(run / "results" / "results.json")
    replace(plain, settings=settings).save(run / "results.json")
    return run / "results.json"


def same_again(file, monkeypatch):
    """A study that is run again has the results of today's file."""
    results = Results.load(file)
    plan = SimpleNamespace(nodes=list, results=lambda stages: results)
    monkeypatch.setattr(reproduce, "plan_again", lambda settings, folder, trusted: plan)


def differing(file):
    return {c.name: c.why for c in verify(file).checks if c.status == "differs"}


def test_an_unknown_study_is_checked_by_its_records_alone(forged):
    checked = verify(forged)
    by_status = {s: {c.name for c in checked.checks if c.status == s} for s in checked.counts}
    assert by_status["same"] == {"stage images", "stage results"}
    assert by_status["cannot check"] == {
        "TMMD of Ours",
        "table Table 9",
        "claim Claim",
        "fact 'Fact: 3 of 4'",
        "digests",
    }
    assert checked.ok is None
    assert "The study must be one of" in str(checked)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda d: d["scores"][0].update(value=1.0), "TMMD of Ours"),
        (lambda d: d["scores"][0].update(higher_is_better=True), "TMMD of Ours"),
        (lambda d: d["scores"][0]["details"].update(p_value=1e-9), "TMMD of Ours"),
        (lambda d: d["tables"][0]["rows"][0][1].update(value=1.0), "table Table 9"),
        (lambda d: d["tables"][0]["rows"][1].__setitem__(1, "1.38"), "table Table 9"),
        (lambda d: d["claims"][0]["evidence"][0].update(value=1.0), "claim Claim"),
        (lambda d: d["claims"][0].update(verdict="undecided"), "claim Claim"),
        (lambda d: d["settings"]["digests"].update(manifest="n"), "digests"),
        (lambda d: d["settings"]["stages"]["images"].update(outputs="0" * 64), "stage images"),
    ],
)
def test_an_edit_by_hand_is_named(forged, monkeypatch, change, name):
    """Of a study that is made again as it was."""
    same_again(forged, monkeypatch)
    assert differing(forged) == {}
    edit(forged, change)
    assert list(differing(forged)) == [name]


def test_what_is_not_of_the_run_is_named(forged, monkeypatch):
    same_again(forged, monkeypatch)
    edit(forged, lambda data: data["scores"].append({**data["scores"][0], "a": "mine"}))
    edit(forged, lambda data: data.update(facts=[]))
    assert differing(forged) == {
        "TMMD of mine": "in the file, not made again",
        "fact 'Fact: 3 of 4'": "not in the file",
    }


def test_a_changed_file_of_a_stage_is_found(forged):
    (forged.parent / "images" / "a.txt").write_text("an imagE")
    assert list(differing(forged)) == ["stage images"]


def test_results_without_their_run_folder_cannot_be_checked(forged, tmp_path):
    shutil.copy(forged, tmp_path / "alone.json")
    checked = verify(tmp_path / "alone.json")
    assert {c.status for c in checked.checks} == {"cannot check"}
    assert checked.ok is None


@pytest.mark.parametrize(
    "settings",
    [
        {"stages": {}},
        {"stages": {"images": 3}},
        {"stages": {"../..": {}}},
        {"stages": {"images": {}}, "study": "world-gelsight"},
        {"stages": {"images": {}}, "study": "world-gelsight", "options": 3},
        {"stages": {"images": {}}, "options": {}},
        {"stages": {"images": {}}, "options": {"data": 3}},
        {"stages": {"images": {}}, "options": {"preset": 3, "data": None}},
        {"stages": {"images": {}}, "study": "world-gelsight", "options": {"root": 3}},
    ],
)
def test_edited_settings_give_a_reason(forged, settings):
    edit(forged, lambda data: data.update(settings=settings))
    assert main(["verify", str(forged), "-q"]) in (1, 3)


def nightly(test):
    return pytest.mark.nightly(pytest.mark.slow(pytest.mark.timeout(900)(test)))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The folder of a small study."""
    folder = tmp_path_factory.mktemp("small") / "run"
    people = folder.parent / "people.json"
    Results("People", scores=[Score(PREFERENCE, "Ours", 0.6)]).save(people)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STUDIES, small_study.STUDY.name, small_study.STUDY)
        run_study(replace(small_study.plan(), people=people), folder)
        people.unlink()
        yield folder


@pytest.fixture
def copied(small, tmp_path):
    """A copy of the run folder elsewhere."""
    return shutil.copytree(small, tmp_path / "moved")


@nightly
def test_a_run_that_was_moved_is_made_again_number_by_number(copied):
    checked = verify(copied / "results.json")
    names = {c.name for c in checked.checks}
    assert checked.counts["same"] == len(checked.checks) > 100
    assert {"stage scores-NoLeak-by-NoLeak-0", "stage ours-NoLeak-0", "digests"} <= names


@nightly
def test_a_pixel_and_a_number_are_found_in_a_run(copied):
    file = next((copied / f"images-ours-{NOLEAK}-0").rglob("*.png"))
    with Image.open(file) as image:
        pixels = np.array(image)
    pixels[3, 3] ^= 128
    Image.fromarray(pixels).save(file)
    edit(copied / "results.json", lambda d: d["audits"][0].update(groups_shared=77))
    changed = differing(copied / "results.json")
    assert changed["audit Orig"].startswith("groups shared 77 in the file")
    assert f"stage images-ours-{NOLEAK}-0" in changed
    assert any(name.startswith("SSIM of Ours") for name in changed)
    assert not any(name.startswith("SSIM of mean image") for name in changed)


@nightly
def test_a_swapped_encoder_and_an_edited_split_are_found_in_a_run(copied):
    place, other = (copied / f"encoder-{split}-0" / "encoders" for split in (NOLEAK, "Orig"))
    shutil.rmtree(place)
    shutil.copytree(other, place)
    changed = differing(copied / "results.json")
    assert "stage encoder-NoLeak-0" in changed
    assert "TMMD of Ours (grouped)" in changed
    split = copied / "split" / "NoLeak.json"
    shutil.copy(copied / "split" / "Orig.json", split)
    changed = differing(copied / "results.json")
    assert "stage split" in changed
