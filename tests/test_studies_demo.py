"""The demo at its smallest: its page, kill and resume, other data; and every verb by itself."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from forge.errors import fails
from palpate.cli import main
from palpate.core import PalpateError, read_json, write_json
from palpate.data.importing import import_dataset
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders import models
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import shipped_folder
from palpate.report.results import Results
from palpate.sim import MINI_SEEDS, write_world
from palpate.studies.demo import PRESETS, Demo
from palpate.studies.graph import digests_of
from palpate.studies.making import require_unseen
from palpate.studies.reproduce import run_study
from palpate.studies.running import plan_graph
from palpate.studies.verifying import verify

pytestmark = pytest.mark.slow
DEMO = Demo(preset="tiny", device="cpu")


def demo(output: Path, *args: str, kill_at: str | None = None) -> list[str]:
    """The lines of the tiny demo in its own process, killed when the stage ``kill_at`` begins."""
    command = [sys.executable, "-m", "palpate", "demo", "--preset", "tiny", "--output", str(output)]
    lines, environment = [], os.environ | {"OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, *args], **pipes, env=environment) as process:
        for line in process.stderr:
            lines.append(line.strip())
            if kill_at is not None and line.startswith(f"{kill_at}: ..."):
                process.send_signal(signal.SIGKILL)
    assert process.returncode == (-signal.SIGKILL if kill_at else 0), "\n".join(lines)
    return lines


STAGES = ["world", "data", "split", "encoders", "generator", "generated", "scores"]


def reused(lines: list[str]) -> set[str]:
    return {line.split(":")[0] for line in lines if "already done" in line}


def outcome(run: Path) -> tuple[object, dict[str, bytes]]:
    """What a run is judged by: its scores and the bytes of its images."""
    scores = json.loads((run / "page.json").read_text())["scores"]
    return scores, {p.name: p.read_bytes() for p in (run / "generated").rglob("*.png")}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("whole") / "run"
    torch.set_num_threads(1)  # as in the processes of their own
    assert main(["demo", "--preset", "tiny", "-o", str(run), "-q"]) == 0
    return run


@pytest.mark.nightly
def test_the_page_is_made_again_number_by_number_where_the_run_was_moved(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "moved")
    checked = verify(tmp_path / "moved" / "page.json")
    assert checked.counts["same"] == len(checked.checks) > 50
    image = next((tmp_path / "moved" / "generated").rglob("*.png"))
    Image.effect_noise(Image.open(image).size, 64).convert("RGB").save(image)
    changed = {c.name for c in verify(tmp_path / "moved" / "page.json").checks if c.why}
    assert {"stage generated", "TMMD of generated (grouped)"} <= changed
    assert "stage split" not in changed


def test_the_demo_ends_in_a_page_with_everything_on_it(whole):
    results = Results.load(whole / "page.json")
    assert [a.name for a in results.audits] == ["Orig", "NoLeak"]
    assert results.audits[0].leaked_fraction > 0
    assert results.audits[1].leaked_fraction == 0
    assert len(results.facts) == 3
    assert {"synthetic-data", "models-shipped"} <= {note.code for note in results.notes}
    metrics = {"TMMD", "I-TMMD", "CI-TMMD", "D-TMMD", "SSIM", "PSNR", "material accuracy"}
    assert {s.metric for s in results} >= metrics
    assert {s.a for s in results} >= {
        "generated",
        "real, nearest photo",
        "background only",
        "real, same material",
    }
    digests = results.settings["digests"]
    for score in results:
        assert score.split == digests["split"]
        assert score.metric in ("SSIM", "PSNR") or score.encoder == digests["encoders"]
    page = (whole / "page.html").read_text()
    assert page.count("data:image/") >= 3 * len(results.gallery)


@pytest.mark.parametrize(
    "stage", ["generator", pytest.param("generated", marks=pytest.mark.nightly)]
)
def test_a_killed_demo_resumes_from_its_last_finished_stage(whole, tmp_path, stage, capsys):
    run = shutil.copytree(whole, tmp_path / "run")
    for name in STAGES[STAGES.index(stage) :]:
        shutil.rmtree(run / name)
    demo(run, kill_at=stage)
    assert not (run / stage).exists()
    assert main(["demo", "--preset", "tiny", "-o", str(run)]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert reused(lines) == {*STAGES[: STAGES.index(stage)]}
    assert outcome(run) == outcome(whole)


def finished(run: Path, **changes: object) -> set[str]:
    """The stages of a run that are done for a demo of other options."""
    return {
        name for name, done in plan_graph(replace(DEMO, **changes).nodes(), run).items() if done
    }


def test_another_seed_keeps_the_data_and_images_that_change_in_place_nothing(whole, tmp_path):
    assert finished(whole, seed=1) == {"world", "data"}
    write_world(tmp_path / "data", PRESETS["tiny"].world)
    nodes = replace(DEMO, data=tmp_path / "data").nodes
    before, path = digests_of(nodes()), next((tmp_path / "data").rglob("*.jpg"))
    path.write_bytes(path.read_bytes())
    assert not {*before.items()} & {*digests_of(nodes()).items()}


def test_an_encoder_and_a_generator_of_another_split_are_noted(whole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data, encoders = whole / "data", whole / "encoders" / "encoders"
    score = f"score --generated made --reference {data} --split s.json --encoder {encoders}"
    for status, line in (
        (0, f"split {data} -o s.json --seed 9 --train 0.5"),
        (0, f"generate {data} --model {whole / 'generator' / 'model'} --split s.json -o made"),
        (2, f"{score} -o x.json"),
        (0, f"{score} -o x.json --allow-seen"),
    ):
        assert main([*line.split(), "-q"]) == status, line
    codes = {s.metric: [n.code for n in s.notes] for s in Results.load(Path("x.json"))["TMMD"]}
    assert "seen-images" in codes["TMMD"]
    made = Results.load(Path("x.json"))["SSIM", "made"]
    assert "generator-of-other-split" in [n.code for n in made.notes]
    own = Results.load(whole / "page.json")
    assert not [n for s in own for n in s.notes if n.code.endswith("-of-other-split")]


@pytest.mark.nightly
def test_real_clips_become_a_page(real_data, tmp_path):
    demo(tmp_path / "run", "--data", str(real_data / "touch_and_go" / "clips"))
    results = Results.load(tmp_path / "run" / "page.json")
    assert results.settings["facts"]["data"]["samples"] == 436
    assert [a.group for a in results.audits] == ["contact", "video"]
    assert [a.groups_shared > 0 for a in results.audits] == [False, True]
    # Photos of one video are similar, whatever contact they belong to.
    assert results.audits[0].leaked_fraction < results.audits[1].leaked_fraction == 1.0
    assert "synthetic-data" not in {note.code for note in results.notes}


@pytest.mark.browser
def test_the_page_of_the_demo_opens_cleanly_in_a_browser(whole, chromium):
    for width in (1280, 360):
        page = chromium.new_page(viewport={"width": width, "height": 900})
        messages, urls = [], []
        page.on("console", lambda message, messages=messages: messages.append(message.text))
        page.on("request", lambda request, urls=urls: urls.append(request.url))
        page.goto((whole / "page.html").as_uri())
        assert messages == []
        assert [url for url in urls if not url.startswith(("file:", "data:"))] == []
        every = (
            "Promise.all([...document.images].map(i => { i.loading = 'eager'; return i.decode() }))"
        )
        page.evaluate(every)  # fails if one is broken
        assert page.evaluate("document.images.length") > 20
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.close()


# --- on shipped models: which stages fall away, what training starts from


def test_no_preset_uses_a_world_that_the_shipped_models_saw():
    assert not {p.world.seed for p in PRESETS.values()} & {*MINI_SEEDS}


def test_training_goes_on_from_the_shipped_models(whole, tmp_path, monkeypatch):
    demo = Results.load(whole / "results.json")
    assert [*demo.settings["stages"]] == STAGES
    encoders = EncoderSet.load(whole / "encoders" / "encoders")
    model = TactilePipeline.from_pretrained(whole / "generator" / "model")
    ready = EncoderSet.load("palpate/mini")
    shipped = TactilePipeline.from_pretrained("palpate/mini")
    assert encoders.digest("vision") == ready.digest("vision")
    assert encoders.digest("tactile") != ready.digest("tactile")
    assert (model.training["start"], model.stats) == (shipped.digest, shipped.stats)
    assert {s.encoder for s in demo.scores if s.metric == "TMMD"} == {encoders.digest("tactile")}
    notes = {note.code: note.params for note in demo.notes}
    assert notes["models-shipped"]["name"] == "palpate/mini"
    # Other words change nothing; another license changes everything that carries the card.
    shutil.copytree(models.shipped_root(), tmp_path / "models")
    monkeypatch.setattr(models, "shipped_root", lambda: tmp_path / "models")
    file = shipped_folder("palpate/mini", "clip") / "palpate.json"
    record = json.loads(file.read_text())
    for key, stages in {"summary": {*STAGES}, "license": {"world", "data", "split"}}.items():
        record["card"][key] = "other"
        file.write_text(json.dumps(record))
        assert finished(whole) == stages


def test_a_world_that_the_shipped_models_saw_is_an_error(tmp_path):
    seen = replace(PRESETS["tiny"].world, seed=MINI_SEEDS[3])
    write_world(tmp_path / "seen", seen, workers=1)
    assert read_json(tmp_path / "seen" / "world.json", "world")["seen_by_shipped_models"]
    words = "must not have been trained on the data"
    (tmp_path / "link").symlink_to(tmp_path / "seen" / "manifest.parquet")
    for part in ("seen", "seen/manifest.parquet", "seen/dataset", "link"):
        fails(words, run_study, replace(DEMO, data=tmp_path / part), tmp_path / "run")
    manifest = import_dataset(tmp_path / "seen", tmp_path / "import").manifest
    (tmp_path / "seen").rename(tmp_path / "gone")
    with pytest.raises(PalpateError, match=words):
        require_unseen(tmp_path, manifest.facts)  # a manifest names the seed of its world
    require_unseen(tmp_path, manifest.facts | {"world_seed": "7"})
    # The nearest world decides: a new one inside the folder of a seen one is unseen.
    write_json(tmp_path / "gone" / "new" / "world.json", {"format": "palpate-world/1"})
    require_unseen(tmp_path / "gone" / "new" / "manifest.parquet")


def test_absent_models_are_reported_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(models, "shipped_root", lambda: tmp_path)
    fails("installed package", run_study, DEMO, tmp_path / "run")
    assert not list((tmp_path / "run").glob("*"))
