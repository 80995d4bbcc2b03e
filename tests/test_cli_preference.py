"""From folders to a row of a table on the command line: make, serve, score."""

import json
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from PIL import Image

from forge import commands
from forge.people import Crowd
from palpate.cli import main
from palpate.data.manifest import Manifest
from palpate.preference import Plan
from palpate.report.results import Results
from palpate.sim import WorldOptions, write_world


def call(capsys, *args):
    return commands.call(capsys, "preference", *args)


def make(rated, output, *more):
    sources = ("--reference", rated.reference, "--generated", *rated.methods)
    options = ("--labels", rated.labels, "--size", "32", "--items", "12", "--raters", "6")
    return ("make", *sources, *options, "-o", output, *more)


@pytest.fixture(scope="module")
def study(rated, tmp_path_factory):
    output = tmp_path_factory.mktemp("cli") / "study"
    assert main(["preference", *map(str, make(rated, output, "-q"))]) == 0
    return output


def test_from_folders_to_a_row(capsys, rated, tmp_path):
    study = tmp_path / "study"
    status, out, err = call(capsys, *make(rated, study))
    assert status == 0
    assert re.search(r"methods +ours, gvst, wbg", out)
    assert "at most one a video" in err
    assert "to each side, by simulation" in err
    page = re.sub('base64,[^"]+', "", (study / "study.html").read_text())
    assert not re.search(r"\b(ours|gvst|wbg|brick|grass|wood)\b", page, re.IGNORECASE)
    crowd = Crowd({"ours": 2.0, "gvst": 0.0, "wbg": -1.0})
    votes = crowd.write(Plan.load(study), tmp_path / "votes")
    outputs = [tmp_path / name for name in ("people.json", "people.tex", "raters.html")]
    options = ("-o", outputs[0], "--latex", outputs[1], "--page", outputs[2])
    status, out, _ = call(capsys, "score", study, votes, *options, "--replicates", "200")
    assert status == 0
    assert "human preference" in out
    assert re.search(r"^ours & \S*0\.\d+", outputs[1].read_text(), re.MULTILINE)
    assert json.loads(outputs[0].read_text())["format"] == "palpate-results/1"
    assert main(["report", str(outputs[0]), "-o", str(tmp_path / "page.html"), "-q"]) == 0
    assert "human preference" in (tmp_path / "page.html").read_text()


def test_dry_run_writes_nothing_and_says_how_wide_intervals_are(capsys, rated, tmp_path):
    status, out, _ = call(capsys, *make(rated, tmp_path / "no", "--dry-run", "--json"))
    assert status == 0
    facts = json.loads(out)
    assert 0.05 < facts["half_width"] < 0.3
    assert facts["trials"] == 36 + 5 + 5
    assert not (tmp_path / "no").exists()


def test_the_smallest_study_is_expected_to_say_little(capsys, rated, tmp_path):
    few = ("--items", "2", "--raters", "1", "--dry-run", "--json")
    status, out, _ = call(capsys, *make(rated, tmp_path / "no", *few))
    assert status == 0
    assert json.loads(out)["half_width"] > 0.3


def test_two_raters_are_told_from_people_before_the_study(capsys, rated, tmp_path):
    options = ("--design", "paper", "--dry-run")
    sources = ("--reference", rated.reference, "--generated", *rated.methods)
    status, _, err = call(capsys, "make", *sources, *options)
    assert status == 0
    assert "For these 2 raters only" in err


def test_mistakes_of_make_are_one_line(capsys, rated, tmp_path):
    for args, words in (
        (("--title", "Is GVST good?"), "--title must not name a method"),
        (("--names", "a"), "--names must name every generator"),
    ):
        commands.mistake(capsys, words, "preference", *make(rated, tmp_path / "s", *args))
    assert not (tmp_path / "s").exists()


def test_a_study_is_not_replaced(capsys, rated, study):
    words = "must be absent or an empty folder"
    commands.mistake(capsys, words, "preference", *make(rated, study))
    plan = ("score", study, "-o", study / "plan.json")
    commands.mistake(capsys, "must not replace an input", "preference", *plan)


def test_serve_prints_each_link_once_and_stops_by_ctrl_c(study):
    command = [sys.executable, "-u", "-m", "palpate", "preference", "serve", str(study)]
    options = ["--port", "0", "--invite", "2"]
    process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)
    try:
        lines = [process.stdout.readline() for _ in range(3)]
        url = re.search(r"http://127.0.0.1:\d+/", lines[0])[0]
        links = [line.split()[-1] for line in lines[1:]]
        with urllib.request.urlopen(links[0], timeout=10) as page:
            assert page.status == 200
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"{url}?token=guess", timeout=10)
    finally:
        process.send_signal(signal.SIGINT)
        status = process.wait(timeout=20)
    assert status == 0
    assert links[0].partition("=")[2] not in (study / "study.db").read_bytes().decode("latin-1")


@pytest.mark.nightly
@pytest.mark.slow
def test_three_methods_on_the_world_and_50_raters(capsys, tmp_path):
    """From folders to a LaTeX row, with the planted preferences in their intervals."""
    start = time.monotonic()
    options = WorldOptions(materials=10, objects_per_material=4, contacts_per_video=2, size=32)
    write_world(tmp_path / "world", options)
    assert main(["import", str(tmp_path / "world"), "-o", str(tmp_path / "tag"), "-q"]) == 0
    manifest = Manifest.load(tmp_path / "tag")
    folders = [tmp_path / name for name in ("ours", "gvst", "wbg")]
    rng = np.random.default_rng(0)
    for folder, noise in zip(folders, (5, 20, 40), strict=True):
        for name, path in zip(manifest.ids, manifest.paths("tactile"), strict=True):
            image = np.asarray(Image.open(path)) + noise * rng.normal(size=(32, 32, 3))
            file = folder / f"{name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image.clip(0, 255).astype(np.uint8)).save(file)
    study = tmp_path / "study"
    sources = ("--reference", tmp_path / "tag", "--generated", *folders)
    assert call(capsys, "make", *sources, "--raters", "50", "-o", study)[0] == 0
    plan = Plan.load(study)
    assert len(plan.items) == len({item.video for item in plan.items}) == 40
    assert len({item.material for item in plan.items}) == 10
    crowd = Crowd({"ours": 1.0, "gvst": 0.2, "wbg": -0.8}, left_bias=0.2, lapses=0.02)
    votes = crowd.write(plan, tmp_path / "votes")
    outputs = ("-o", tmp_path / "people.json", "--latex", tmp_path / "people.tex")
    assert call(capsys, "score", study, votes, *outputs)[0] == 0
    people = Results.load(tmp_path / "people.json")
    for row in people.settings["preference"]["comparisons"]:
        low, high = row["interval"]
        assert low <= crowd.preference(row["a"], row["b"]) <= high
    assert (tmp_path / "people.tex").read_text().count("human preference") > 2
    assert time.monotonic() - start < 600
