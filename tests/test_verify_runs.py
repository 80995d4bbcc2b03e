"""Run folders verified: changed files, records and numbers are named; moved folders verify."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from palpate.cli import main
from palpate.core import Note, SampleRef, Score, read_json, write_json
from palpate.report.results import GalleryItem, Results
from palpate.report.study import Claim, Curve, Line, StudyTable
from palpate.studies import study as studies
from palpate.studies.methods import METHODS, OURS
from palpate.studies.reproduce import plan_of, run_study
from palpate.studies.stages import Run
from palpate.studies.study import NOLEAK, STUDIES
from palpate.studies.verifying import verify
from palpate.studies.verifying_runs import Remade, _settings_checks, _trained_steps

SCORE = Score(
    "TMMD", "Ours", 1.25, n=8, details={"stage": "results"}, notes=[Note("synthetic-data")]
)


@pytest.fixture
def forged(tmp_path) -> Path:
    """The results of a run of two stages of a study that palpate does not know."""
    run = Run(tmp_path / "run")

    def images(folder):
        (folder / "a.txt").write_text("an image")

    def results(folder):
        words = ("paper", "1.37")
        table = StudyTable(
            "Table 9", "Of 9 videos", ("", "TMMD"), [("Ours", SCORE), words], controls=["paper"]
        )
        curve = Curve("Curve", "", "x", "y", [Line("Ours", [(2.0, SCORE)])])
        claim = Claim("Claim", "paper", "holds", "1.25 is low", [SCORE])
        made = Results("Forged", ["Fact: 3 of 4"], scores=[SCORE], tables=[table])
        sample = SampleRef("s", "v", 1, "Wood", f"{folder.parent}/images/a.txt")
        more = {"gallery": [GalleryItem(sample, None)], "notes": [Note("synthetic-data")]}
        replace(made, curves=[curve], claims=[claim], **more).save(folder / "results.json")

    made = run.stage("images", {"seed": 0}, images)
    run.stage("results", {"after": {"images": made.digest}, "images": "no stage"}, results)
    records = {n: read_json(s.folder / "stage.json", "") for n, s in run.stages.items()}
    settings = {"study": "forged", "stages": {n: _stated(r) for n, r in records.items()}}
    whole = Results.load(run.folder / "results" / "results.json")
    replace(whole, settings=settings).save(run.folder / "results.json")
    return run.folder / "results.json"


def _stated(record):
    return {k: record[k] for k in ("digest", "outputs", "seconds")}


def differing(file):
    return {c.name: c.why for c in verify(file).checks if c.status == "differs"}


def edit(file, change):
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def test_an_unknown_study_is_checked_by_its_records_alone(forged):
    checked = verify(forged)
    by_status = {s: {c.name for c in checked.checks if c.status == s} for s in checked.counts}
    assert by_status["same"] == {"stage images", "stage results"}
    assert by_status["cannot check"] == {
        "TMMD of Ours",
        "Table 9: Ours, TMMD",
        "Curve: Ours at 2",
        "Claim: TMMD of Ours",
        "Claim: verdict",
        "Claim: why",
        "fact Fact",
        "Table 9: words",
        "Curve: words",
        "Claim: source",
        "title",
        "notes",
        "gallery, s",
        "settings: study",
        "settings: stages",
    }
    assert checked.ok
    assert "The study must be one of" in str(checked)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda d: d["scores"][0].update(value=1.0), "TMMD of Ours"),
        (lambda d: d["tables"][0]["rows"][0][1].update(value=1.0), "Table 9: Ours, TMMD"),
        (lambda d: d["curves"][0]["lines"][0]["points"][0][1].update(n=9), "Curve: Ours at 2"),
        (lambda d: d["claims"][0]["evidence"][0].update(value=1.0), "Claim: TMMD of Ours"),
        (lambda d: d["claims"][0].update(verdict="undecided"), "Claim: verdict"),
        (lambda d: d["claims"][0].update(why="1.2 is low"), "Claim: why"),
        (lambda d: d.update(facts=["Fact: 4 of 4"]), "fact Fact"),
        (lambda d: d["scores"][0].update(higher_is_better=True), "TMMD of Ours"),
        (lambda d: d["scores"][0].update(interval_method="by 3 seeds"), "TMMD of Ours"),
        (lambda d: d["scores"][0]["details"].update(p_value=1e-9), "TMMD of Ours"),
        (lambda d: d["scores"][0]["details"].update(probe="of all"), "TMMD of Ours"),
        (lambda d: d["scores"][0].update(notes=[]), "TMMD of Ours"),
        (lambda d: d["tables"][0]["rows"][0][1].update(subject="mine"), "Table 9: Ours, TMMD"),
        (lambda d: d["tables"][0].update(text="Of 8 videos"), "Table 9: words"),
        (lambda d: d["tables"][0].update(controls=[]), "Table 9: words"),
        (lambda d: d["tables"][0]["rows"][1].__setitem__(1, "1.38"), "Table 9: words"),
        (lambda d: d["curves"][0].update(text="gains"), "Curve: words"),
        (lambda d: d["curves"][0].update(log_x=True), "Curve: words"),
        (lambda d: d["claims"][0].update(source="ours"), "Claim: source"),
        (lambda d: d.update(notes=[]), "notes"),
        (lambda d: d.update(title="Real data"), "title"),
        (lambda d: d["gallery"][0]["sample"].update(vision="images/b.txt"), "gallery, s"),
        (lambda d: d["gallery"][0]["sample"].update(material="Sand"), "gallery, s"),
        (lambda d: d.update(gallery=[]), "gallery, s"),
        (lambda d: d["settings"]["stages"]["images"].update(outputs="0" * 64), "stage images"),
    ],
)
def test_an_edit_by_hand_is_named(forged, change, name):
    edit(forged, change)
    assert list(differing(forged)) == [name]


def test_an_edited_setting_is_named():
    known = {"digests": {"manifest": "a"}, "options": {"steps of a method": 5}, "machine": "m"}
    known |= {"stages": {"data": {}}, "versions": {"torch": "2.6"}}
    made = Remade(Results("", settings=known))
    assert {c.status for c in _settings_checks(Results("", settings=known), made)} == {"same"}
    for key, value in {
        "digests": {"manifest": "b"},
        "options": {"steps of a method": 6},
        "machine": "another",
        "versions": {"torch": "2.7"},
        "stages": {},
        "gpu": "H100",
    }.items():
        checks = _settings_checks(Results("", settings={**known, key: value}), made)
        assert [c.name for c in checks if c.status == "differs"] == [f"settings: {key}"]
    checks = _settings_checks(Results("", settings={}), made)
    assert {c.status for c in checks} == {"differs"}


def test_the_steps_of_a_study_are_those_of_its_trainings(tmp_path):
    run = Run(tmp_path)
    for name, facts in {"data": {}, "ours": {"steps": 8}, "ours-2-steps": {"steps": 2}}.items():
        run.stage(name, {}, lambda folder, facts=facts: facts)
    assert _trained_steps(tmp_path, run.stages) == 8
    assert _trained_steps(tmp_path, ["data", "absent"]) is None


def test_a_score_of_no_stage_is_untraced(forged):
    edit(forged, lambda data: data["scores"][0]["details"].pop("stage"))
    checked = verify(forged)
    assert [c.name for c in checked.checks if c.status == "untraced"] == ["TMMD of Ours"]
    assert not checked.ok


def test_a_score_that_is_not_of_the_run_is_untraced(forged):
    edit(forged, lambda data: data["scores"].append({**data["scores"][0], "subject": "mine"}))
    checked = verify(forged)
    assert [c.name for c in checked.checks if c.status == "untraced"] == ["TMMD of mine"]
    assert checked.counts["differs"] == 0


def test_a_changed_file_of_a_stage_is_found(forged):
    (forged.parent / "images" / "a.txt").write_text("an imagE")
    assert list(differing(forged)) == ["stage images"]
    assert differing(forged)["stage images"].startswith("files SHA-256 ")


def test_a_stage_that_was_made_again_of_other_inputs_is_found(forged):
    Run(forged.parent).stage("images", {"seed": 1}, lambda folder: None)
    changed = differing(forged)
    assert changed["stage results"] == "it read another images than the one that is there"
    assert "stage images" in changed


def test_an_edited_record_is_found(forged):
    record = forged.parent / "images" / "stage.json"
    write_json(record, {**read_json(record, ""), "inputs": {"seed": 7}})
    why = differing(forged)["stage images"]
    assert why == "its record does not have the digest of what it says it read"


def test_results_without_their_run_folder_cannot_be_checked(forged, tmp_path):
    shutil.copy(forged, tmp_path / "alone.json")
    checked = verify(tmp_path / "alone.json")
    assert {c.status for c in checked.checks} == {"cannot check"}
    assert checked.ok


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
    assert main(["verify", str(forged), "-q"]) in (0, 1)


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """A study of one method, run at ``smoke``, and its folder."""
    known = STUDIES["world-gelsight"]
    small = replace(known.presets["smoke"], steps=4, permutations=9)
    one = replace(known, name="toy", methods=[METHODS[OURS]], presets={"smoke": small})
    folder = tmp_path_factory.mktemp("toy") / "run"
    people = folder.parent / "people.json"
    Results("People", scores=[SCORE]).save(people)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studies, "STUDIES", {"toy": one})
        run_study(plan_of(one, preset="smoke", people=people), folder)
        people.unlink()
        yield folder


@pytest.fixture
def copied(toy, tmp_path):
    """A copy of the run folder elsewhere."""
    shutil.copytree(toy, tmp_path / "moved")
    return tmp_path / "moved"


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_run_that_was_moved_is_made_again_number_by_number(copied):
    checked = verify(copied / "results.json")
    names = {c.name for c in checked.checks}
    assert checked.counts["same"] == len(checked.checks) > 400
    assert {"stage scores-NoLeak-by-NoLeak-0, made again", "stage ours-NoLeak-0"} <= names
    assert {"settings: digests", "settings: options", "settings: machine"} <= names
    assert not (copied / ".verify").exists()


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_pixel_and_a_number_are_found_in_a_run(copied):
    file = next((copied / f"images-ours-{NOLEAK}-0").rglob("*.png"))
    with Image.open(file) as image:
        pixels = np.array(image)
    pixels[3, 3] ^= 128
    Image.fromarray(pixels).save(file)
    edit(copied / "results.json", lambda d: d["audits"][0].update(groups_shared=77))
    stated = {"steps of a method": 99}
    edit(copied / "results.json", lambda d: d["settings"]["options"].update(stated))
    changed = differing(copied / "results.json")
    assert changed["audit Orig: groups shared"].startswith("77 in the file")
    assert "settings: options" in changed
    assert f"stage images-ours-{NOLEAK}-0" in changed
    assert f"stage scores-{NOLEAK}-by-{NOLEAK}-0, made again" in changed
    assert "stage scores-Orig-by-Orig-0, made again" not in changed
    assert any(name.startswith("SSIM of Ours") for name in changed)
    assert not any(name.startswith("SSIM of mean image") for name in changed)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_swapped_encoder_and_an_edited_split_are_found_in_a_run(copied):
    place, other = (copied / f"encoder-{split}-0" / "encoders" for split in (NOLEAK, "Orig"))
    shutil.rmtree(place)
    shutil.copytree(other, place)
    changed = differing(copied / "results.json")
    assert "stage encoder-NoLeak-0" in changed
    assert "stage probe-NoLeak-0, made again" in changed
    assert "stage scores-NoLeak-by-NoLeak-0, made again" in changed
    split = copied / "split" / "NoLeak.json"
    shutil.copy(copied / "split" / "Orig.json", split)
    changed = differing(copied / "results.json")
    assert "stage split" in changed
    assert "stage split, made again" in changed
