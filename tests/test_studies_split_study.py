"""Encoders trained on each split: what the leak is worth, resuming, and the command line."""

import json
import os
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from palpate.cli import main
from palpate.core import PalpateError, Split
from palpate.data import Manifest
from palpate.report.results import Results
from palpate.studies.split_study import compare_splits


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Twelve videos, each of one look, its material at random: only remembering a video helps."""
    top = tmp_path_factory.mktemp("splits")
    rng, rows = np.random.default_rng(0), []
    for v in range(12):
        look = rng.integers(0, 255, (4, 4, 3))
        for k in range(8):
            paths = {}
            for kind in ("vision", "tactile"):
                path = top / "root" / f"v{v}" / kind / f"{k}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                pixels = np.kron(look, np.ones((8, 8, 1))) + rng.normal(0, 8, (32, 32, 3))
                Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(path)
                paths[kind] = path.relative_to(top / "root").as_posix()
            row = {"id": f"v{v}/{k}", "video": f"v{v}", "frame": k, "contact": f"v{v}#{k // 2}"}
            rows.append({**row, "material": "ab"[v % 2], "text": f"look {v}", **paths})
    manifest = Manifest.from_rows(rows, top / "root")
    manifest.save(top / "tag" / "manifest.parquet")
    tests = {"orig": [i for i in manifest.ids if int(i[-1]) % 4 == 3]}
    tests["noleak"] = [i for i in manifest.ids if i.split("/")[0] in ("v8", "v9", "v10", "v11")]
    for name, test in tests.items():
        train = [i for i in manifest.ids if i not in test]
        split = Split.from_ids(train=train, test=test, rule={"group": "video"})
        split.save(top / f"{name}.json")
    return top


TRAIN = shlex.split("--train --preset tiny --seeds 0 1")
ARGS = ["probe", "tag", "--splits", "orig.json", "noleak.json", *TRAIN]


@pytest.fixture(scope="module")
def whole(data):
    """A run that nothing stopped, in ``data/run``."""
    torch.set_num_threads(1)  # as in the processes of their own
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(data)
        patch.setattr("palpate.metrics.probe.NEIGHBORS", 1)
        assert main([*ARGS, "--work", "run", "-o", "whole.json", "-q"]) == 0
    return Results.load(data / "whole.json")


@pytest.mark.slow
def test_a_planted_leak_costs_what_it_is_worth(data, whole, capsys, monkeypatch):
    monkeypatch.chdir(data)
    values = {(s.metric, s.a, s.b): s for s in whole.scores}
    orig, clean = (values["material accuracy, 1-NN", name, None] for name in ("orig", "noleak"))
    assert orig.value > 0.95  # a frame of every test video is in train
    assert clean.value < 0.8  # a new video says nothing of its material
    drop = values["material accuracy, 1-NN", "orig", "noleak"]
    assert drop.value == pytest.approx(orig.value - clean.value)
    assert len(orig.details["by_seed"]) == 2
    assert "2 seeds" in drop.interval_method
    assert any("material accuracy, orig - noleak" in fact for fact in whole.facts)
    # The same command again trains nothing; a page comes from it.
    stages = {p: p.stat().st_mtime_ns for p in (data / "run").rglob("model.safetensors")}
    assert len(stages) == 4 * 2
    assert main([*ARGS, "--work", "run", "-o", "drop.html"]) == 0
    assert "points" in capsys.readouterr().out
    assert {p: p.stat().st_mtime_ns for p in stages} == stages
    assert "noleak" in (data / "drop.html").read_text()


@pytest.mark.nightly
def test_a_killed_study_ends_as_one_that_was_not(data, whole):
    """Of one of the splits: the weights of each training, and what they score."""
    options = ["probe", "tag", "--splits", "orig.json", *TRAIN, "--work", "killed", "--json"]
    command, pipes = [sys.executable, "-m", "palpate", *options], {"text": True}
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    pipes |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": environment}
    with subprocess.Popen(command, cwd=data, **pipes) as process:
        for line in process.stderr:
            if line.startswith("orig-1: ..."):
                os.kill(process.pid, signal.SIGKILL)
                break
        process.wait()
    assert process.returncode == -signal.SIGKILL
    again = subprocess.run(command, cwd=data, check=True, **pipes)
    assert "orig-0: already done" in again.stderr
    results = json.loads(again.stdout)
    trainings = whole.settings["trainings"]
    for name, training in results["settings"]["trainings"].items():
        assert training["encoder"] == trainings[name]["encoder"]
    assert len(results["settings"]["trainings"]) == 2
    values = {s["metric"]: s["value"] for s in results["scores"]}
    assert values["material accuracy"] == whole["material accuracy", "orig"].value


def test_a_field_of_a_preset_is_switched_off_or_refused(capsys, monkeypatch, tmp_path):
    presets = []

    def stop(*_, preset, **options):
        presets.append(preset)
        raise PalpateError("Nothing must be trained", "a test", "")

    monkeypatch.setattr("palpate.encoders.contrastive.train_encoder", stop)
    train = ["train", "encoder", str(tmp_path), "-o", "none", "--preset", "tiny"]
    fields = ["tactile_course.clip_norm=none", "tactile_course.lr=0.5"]
    assert main([*train, "--set", *fields]) == 2
    course = presets[0].tactile_course
    assert (course.clip_norm, course.lr, course.patience) == (None, 0.5, None)
    for words, must in (
        ("tactile_course.warmup=1.5", "--set tactile_course.warmup must lie in [0, 1]"),
        (
            "tactile_course.augment.crop=5",
            "--set tactile_course.augment.crop must lie in [0, 0.99]",
        ),
    ):
        assert main([*train, "--set", words]) == 2
        assert must in capsys.readouterr().err


def test_a_study_needs_seeds_and_either_encoders_or_training(data, capsys, monkeypatch):
    monkeypatch.chdir(data)
    with pytest.raises(PalpateError, match="`seeds` must hold at least one"):
        compare_splits("tag", ["orig.json"], work="none", seeds=(0, 0))
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(PalpateError, match="must be begun by one process"):
        compare_splits("tag", ["orig.json"], work="none")
    monkeypatch.delenv("WORLD_SIZE")
    assert main(["probe", "tag", "--split", "orig.json"]) == 2
    assert "Either an encoder or training must be chosen" in capsys.readouterr().err
    assert main([*ARGS, "--encoder", "palpate/mini"]) == 2
    assert "both" in capsys.readouterr().err
