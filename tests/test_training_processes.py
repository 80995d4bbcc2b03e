"""Several processes, kills and flags: `palpate train` as users start it."""

import hashlib
import io
import json
import os
import subprocess
import sys
import time
from contextlib import chdir, redirect_stdout
from pathlib import Path

import numpy as np
import psutil
import pytest

from palpate.cli import main
from palpate.core import Split
from palpate.encoders import EncoderSet

ENV = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
PYTHON = [sys.executable, "-m"]


@pytest.fixture
def place(small_manifest, tmp_path):
    """A saved data set of six videos with a split by video, three samples of it held out; a data
    set as users have one.
    """
    videos = small_manifest.column("video")
    chosen = set(videos[:16] + videos[-16:])
    parts = {"train": [], "val": [], "test": []}
    for name, video in zip(small_manifest.ids, videos, strict=True):
        side = "val" if len(parts["val"]) < 3 else "test"
        parts["train" if video in chosen else side].append(name)
    small_manifest.save(tmp_path / "tag" / "manifest.parquet")
    Split.from_ids(**parts, manifest=small_manifest.digest).save(tmp_path / "split.json")
    return tmp_path


def command(kind, output, *more, processes=1):
    launch = [f"--nproc_per_node={processes}", "--standalone", "-m"]
    start = [*PYTHON, "torch.distributed.run", *launch] if processes > 1 else PYTHON
    where = ["tag", "--split", "split.json", "--preset", "tiny", "-o", output]
    return [*start, "palpate", "train", kind, *where, "--checkpoint-minutes", "0", *more]


def run(place, *args, processes=1):
    """What a training prints; one process is this one."""
    words = command(*args, processes=processes)
    if processes == 1:
        with chdir(place), redirect_stdout(io.StringIO()) as out:
            assert main(words[words.index("train") :]) == 0
        return out.getvalue()
    done = subprocess.run(words, cwd=place, env=ENV, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def logs(folder):
    lines = [f.read_text().splitlines() for f in sorted(folder.glob("log-*"))]
    rows = [json.loads(line) for each in lines for line in each]
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


def close(one, two):
    assert len(one) == len(two) > 0
    for a, b in zip(one, two, strict=True):
        assert a == pytest.approx(b, abs=1e-4)


@pytest.mark.nightly
@pytest.mark.slow
def test_two_processes_take_the_steps_of_one(place):
    """By their launcher; forked, they are in ``test_encoders_contrastive`` every day."""
    keep = ["--set", "tactile_course.evaluations=2", "tactile_course.keep=best"]
    run(place, "encoder", "one", *keep)
    out = run(place, "encoder", "two", *keep, processes=2)
    assert "processes" in out
    assert out.count("Encoders two") == 1  # the first process alone prints
    assert EncoderSet.load(place / "two").card["processes"] == 2
    close(logs(place / "one"), logs(place / "two"))
    assert sum("held_out" in row for row in logs(place / "two")) == 2


@pytest.mark.nightly
@pytest.mark.slow
def test_two_processes_train_the_generator_of_one(place):
    more = ("--clip", "palpate/mini", "--steps", "6")
    run(place, "generator", "one", *more)
    out = run(place, "generator", "two", *more, "--json", processes=2)
    assert json.loads(out)["processes"] == 2
    close(logs(place / "one"), logs(place / "two"))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("processes", "most"), [(1, 3), (2, 1)])
def test_killed_again_and_again_it_ends_in_the_same_bytes(place, processes, most):
    more = ("--clip", "palpate/mini", "--epochs", "8")
    run(place, "encoder", "whole", *more, processes=processes)
    rng, log = np.random.default_rng(0), place / ".killed.work" / "tactile" / "log.jsonl"
    kills = 0
    for _ in range(most):
        words = command("encoder", "killed", *more, processes=processes)
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = psutil.Popen(words, cwd=place, env=ENV, **quiet)
        while process.poll() is None and not log.exists():
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 0.3))
        family = [*process.children(recursive=True), process] if process.is_running() else []
        for each in family:
            each.kill()
        psutil.wait_procs(family)
        if process.wait() == 0:
            break
        kills += 1
        log.unlink(missing_ok=True)
    assert kills > 0
    if not (place / "killed").exists():
        run(place, "encoder", "killed", *more, processes=processes)
    digests = [hashlib.sha256(weights(place / name)).hexdigest() for name in ("whole", "killed")]
    assert digests[0] == digests[1]


def weights(folder: Path) -> bytes:
    return b"".join(p.read_bytes() for p in sorted((folder / "tactile").glob("*.safetensors")))


DYING = """
import os, sys
from palpate.training import engine
real = engine._Run.update
def update(run, batch):
    if run.part[0] == 1 and run.step == 2:
        os._exit(9)
    return real(run, batch)
engine._Run.update = update
from palpate.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.nightly
def test_when_a_process_dies_the_others_end_without_a_traceback_and_the_run_can_go_on(place):
    (place / "dying.py").write_text(DYING)
    more = ("--clip", "palpate/mini")
    parts = command("encoder", "out", *more, processes=2)
    script = [*parts[: parts.index("--standalone") + 1], "dying.py", *parts[parts.index("train") :]]
    done = subprocess.run(script, cwd=place, env=ENV, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    lines = [line for line in done.stderr.splitlines() if line.startswith("palpate train")]
    assert len(lines) == 1
    assert "All processes must stay alive. Got one has ended" in lines[0]
    assert not any("bug in palpate" in line for line in done.stderr.splitlines())
    run(place, "encoder", "out", *more)  # in one process, from the checkpoint of two
    run(place, "encoder", "whole", *more)
    close(logs(place / "whole"), logs(place / "out"))


@pytest.mark.nightly
@pytest.mark.slow
def test_what_all_processes_raise_is_printed_once(place):
    def stderr(*more):
        parts = command("encoder", "out", "--clip", "palpate/mini", *more, processes=2)
        done = subprocess.run(parts, cwd=place, env=ENV, capture_output=True, text=True)
        assert done.returncode != 0
        return [line for line in done.stderr.splitlines() if line.startswith("palpate train")]

    (line,) = stderr("--set", "tactile_course.lr=1e30")
    assert "must be finite" in line
    (line,) = stderr("--set", "tactile_course.batch=7")
    assert "--set tactile_course.batch must be a multiple of the 2 processes. Got 7. " in line
