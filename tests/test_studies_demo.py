"""The whole pipeline at its smallest: every verb by itself, the demo, and a demo that is killed."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from palpate.cli import main
from palpate.report.results import Results

pytestmark = pytest.mark.slow


def demo(out: Path, *args: str, kill_at: str | None = None) -> tuple[int, list[str]]:
    """Runs the tiny demo in a process of its own; with ``kill_at`` it gets SIGKILL as soon as that stage has begun."""
    command = [
        sys.executable,
        "-m",
        "palpate",
        "demo",
        "--preset",
        "tiny",
        "--out",
        str(out),
        *args,
    ]
    lines: list[str] = []
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            lines.append(line.strip())
            if kill_at is not None and line.startswith(f"{kill_at}: ..."):
                process.send_signal(signal.SIGKILL)
    return process.returncode, lines


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    status, lines = demo(out)
    assert status == 0, "\n".join(lines)
    return out


def outcome(out: Path) -> tuple[object, dict[str, bytes]]:
    """What a run is judged by: its scores and the bytes of its pictures."""
    results = json.loads((out / "page.json").read_text())
    pictures = {p.name: p.read_bytes() for p in (out / "generated").rglob("*.png")}
    return results["scores"], pictures


def test_the_demo_ends_in_a_page_with_everything_on_it(whole):
    results = Results.load(whole / "page.json")
    assert [a.name for a in results.audits] == ["Orig", "NoLeak"]
    assert results.audits[0].leaked_fraction > 0
    assert results.audits[1].leaked_fraction == 0
    assert len(results.facts) == 3
    assert "synthetic-data" in {note.code for note in results.notes}
    assert results.title == "From photo to touch on palpate's procedural world"
    assert {s.metric for s in results.scores} >= {
        "TMMD",
        "I-TMMD",
        "CI-TMMD",
        "D-TMMD",
        "SSIM",
        "PSNR",
    }
    assert {s.subject for s in results.scores} >= {
        "generated",
        "background only",
        "real, same material",
    }
    split, encoder = results.settings["digests"]["split"], results.settings["digests"]["encoders"]
    for score in results.scores:
        assert score.split == split
        assert score.metric in ("SSIM", "PSNR") or score.encoder == encoder
    page = (whole / "page.html").read_text()
    assert page.count("data:image/") >= 3 * len(results.gallery)


def test_the_worlds_known_leak_is_what_the_audit_finds(whole):
    leak = json.loads((whole / "world" / "tree" / "world.json").read_text())["leak"]
    orig = Results.load(whole / "page.json").audits[0]
    assert (orig.test_samples_in_shared_groups, orig.test_samples) == (
        leak["test_frames_in_shared_videos"],
        leak["test_frames"],
    )


@pytest.mark.parametrize("stage", ["autoencoder", "generated"])
def test_a_killed_demo_goes_on_from_its_last_finished_stage(whole, tmp_path, stage):
    out = tmp_path / "run"
    status, lines = demo(out, kill_at=stage)
    assert status == -signal.SIGKILL
    assert not (out / stage).exists()
    assert not (out / "page.html").exists()
    finished = [line.split(":")[0] for line in lines if ": done in" in line]
    assert "split" in finished
    status, lines = demo(out)
    assert status == 0, "\n".join(lines)
    assert [line.split(":")[0] for line in lines if "already done" in line] == finished
    assert outcome(out) == outcome(whole)


STAGES = (
    "world",
    "data",
    "split",
    "pretraining",
    "pretraining-data",
    "clip",
    "autoencoder",
    "encoders",
    "generator",
    "generated",
    "scores",
)


def test_a_demo_killed_between_a_stages_last_file_and_its_mark_heals(whole, tmp_path):
    out = tmp_path / "run"
    assert demo(out)[0] == 0
    for name in STAGES:  # the state of each stage just before it is marked as finished
        mark = out / name / "stage.json"
        record = json.loads(mark.read_text())
        (out / f"{name}.partial.json").write_text(
            json.dumps({"digest": record["digest"], "inputs": record["inputs"]})
        )
        mark.unlink()
        (out / name).rename(out / f"{name}.partial")
    # The data were read in place from the world's folder, which bears its name again before they are.
    status, lines = demo(out)
    assert status == 0, "\n".join(lines)
    assert not list(out.glob("*.partial"))
    assert outcome(out) == outcome(whole)


def test_pictures_that_change_in_place_redo_everything_that_saw_them(whole, tmp_path):
    data, out = tmp_path / "data", tmp_path / "run"
    assert main(["world", "-o", str(data), "--preset", "tiny", "--seed", "5", "-q"]) == 0
    assert demo(out, "--data", str(data))[0] == 0
    for path in data.rglob("*.jpg"):
        with Image.open(path) as image:
            turned = image.rotate(180)
        turned.save(path)
    status, lines = demo(out, "--data", str(data))
    assert status == 0, "\n".join(lines)
    reused = {line.split(":")[0] for line in lines if "already done" in line}
    assert reused <= {"split", "pretraining", "pretraining-data"}


def test_a_users_copy_of_the_pretraining_world_is_welcome(tmp_path):
    assert (
        main(
            [
                "world",
                "-o",
                str(tmp_path / "w"),
                "--preset",
                "tiny",
                "--seed",
                "1000",
                "--objects-per-material",
                "4",
                "-q",
            ]
        )
        == 0
    )
    status, lines = demo(tmp_path / "run", "--data", str(tmp_path / "w"))
    assert status == 0, "\n".join(lines)


def test_encoders_and_generators_of_another_split_are_told(whole, tmp_path):
    place = whole / "data"
    assert (
        main(
            [
                "split",
                str(place),
                "-o",
                str(tmp_path / "s.json"),
                "--seed",
                "9",
                "--train",
                "0.5",
                "-q",
            ]
        )
        == 0
    )
    model, encoders, made = (
        whole / "generator" / "model",
        whole / "encoders" / "encoders",
        tmp_path / "made",
    )
    assert (
        main(
            [
                "generate",
                "--model",
                str(model),
                "--manifest",
                str(place),
                "--split",
                str(tmp_path / "s.json"),
                "-o",
                str(made),
                "-q",
            ]
        )
        == 0
    )
    args = [
        "--generated",
        str(made),
        "--split",
        str(tmp_path / "s.json"),
        "--encoder",
        str(encoders),
        "-o",
        str(tmp_path / "x.json"),
        "-q",
    ]
    assert main(["score", "--reference", str(place), *args]) == 0
    notes = {
        s["metric"]: {note["code"] for note in s["notes"]}
        for s in json.loads((tmp_path / "x.json").read_text())["scores"]
        if s["subject"] == "made"
    }
    assert "encoder-of-other-split" in notes["TMMD"]
    assert "generator-of-other-split" in notes["SSIM"]
    notes = [n.code for s in Results.load(whole / "page.json").scores for n in s.notes]
    assert "encoder-of-other-split" not in notes


@pytest.mark.browser
def test_the_demos_own_page_opens_cleanly_in_a_browser(whole, chromium):
    for width in (1280, 360):
        page = chromium.new_page(viewport={"width": width, "height": 900})
        said, asked = [], []
        page.on("console", lambda message, said=said: said.append(message.text))
        page.on("request", lambda request, asked=asked: asked.append(request.url))
        page.goto((whole / "page.html").as_uri())
        assert said == []
        assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
        broken = "[...document.images].filter(i => !i.complete || !i.naturalWidth).length"
        assert page.evaluate(broken) == 0
        assert page.evaluate("document.images.length") > 20
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.close()


def test_a_finished_demo_does_nothing_again_and_another_seed_does(whole):
    status, lines = demo(whole)
    assert status == 0
    assert not [line for line in lines if ": done in" in line]
    status, lines = demo(whole, "--seed", "1", kill_at="clip")
    redone = {line.split(":")[0] for line in lines if ": ..." in line}
    assert "split" in redone
    assert "world" not in redone
    demo(whole)  # as it was, for tests that come later


def test_every_verb_by_itself(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for line in (
        "world -o world --preset tiny --workers 1 --layout videos",
        "import world -o tag",
        "split tag -o s.json --train 0.5",
        "audit tag --split s.json -o audit.json --fail-over 0",
        "train encoder tag --split s.json -o encoders --preset tiny",
        "train generator tag --split s.json --clip encoders -o model --preset tiny --background",
        "generate tag --split s.json --model model -o made",
        "score --generated made --reference tag --split s.json --encoder encoders -o scores.json --json",
        "report audit.json scores.json -o page.html",
    ):
        assert main([*line.split(), "-q"]) == 0, (line, capsys.readouterr())
    assert not list(tmp_path.glob(".*.work"))
    results = Results.load(tmp_path / "page.json")
    assert results.audits[0].leaked_fraction == 0
    assert results.scores
    assert results.gallery
    assert results.settings["digests"]["split"] == results.audits[0].split
    assert any(command.startswith("palpate score --generated made") for command in results.commands)


def test_photos_alone_are_enough_to_generate(whole, tmp_path):
    photos = next((whole / "world" / "tree" / "dataset").iterdir()) / "video_frame"
    model = whole / "generator" / "model"
    (tmp_path / "photos").mkdir()
    for path in sorted(photos.iterdir())[:3]:
        (tmp_path / "photos" / path.name).write_bytes(path.read_bytes())
    (tmp_path / "photos" / "broken.jpg").write_bytes(path.read_bytes()[:200])
    words = [
        "generate",
        str(tmp_path / "photos"),
        "--model",
        str(model),
        "-o",
        str(tmp_path / "a"),
        "-q",
    ]
    assert main(words) == 2
    assert not (tmp_path / "a").exists()
    assert main([*words, "--skip-bad"]) == 0
    assert len(list((tmp_path / "a" / "images").iterdir())) == 3


def test_real_clips_go_through_to_the_page(real_data, tmp_path):
    status, lines = demo(tmp_path / "run", "--data", str(real_data / "touch_and_go" / "clips"))
    assert status == 0, "\n".join(lines)
    results = Results.load(tmp_path / "run" / "page.json")
    assert results.settings["stages"]["data"]["samples"] == 436
    assert [a.name for a in results.audits] == ["NoLeak by touch", "NoLeak by touch, seen by video"]
    assert [a.group for a in results.audits] == ["touch", "video"]
    assert [a.leaked_fraction for a in results.audits] == [0.0, 1.0]
    codes = {note.code for note in results.notes}
    assert "group-materials" in codes
    assert "synthetic-data" not in codes
