"""``palpate run``: slices on datatrove's executors, and on a real Slurm on this machine."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from palpate.cli import main
from palpate.data.samples import read_samples
from palpate.encoders.embedded import embed_dataset
from test_slices import MINI, touches

pytest.importorskip("datatrove", reason="the extra scale is not installed")
SCRIPTS = Path(__file__).parent / "slurm"


@pytest.fixture
def data(tmp_path):
    data = touches(tmp_path / "data", videos=24, frames=16)
    data.save(tmp_path / "manifest.parquet")
    return data


def command(tmp_path, output="parts"):
    return f"embed {tmp_path}/manifest.parquet --encoder {MINI} -o {tmp_path}/{output}"


def whole(data, tmp_path):
    embed_dataset(data, MINI, tmp_path / "whole")
    return read_samples(tmp_path / "whole", "whole").rows


@pytest.mark.slow
def test_processes_make_all_slices_and_run_again_what_is_missing(data, tmp_path, capfd):
    run = f"run {command(tmp_path)} --slices 3 --workers 2".split()
    assert main(run) == 0
    files = sorted((tmp_path / "parts").glob("*/features.npy"))
    before = [file.stat().st_mtime_ns for file in files]
    assert np.array_equal(read_samples(tmp_path / "parts", "parts").rows, whole(data, tmp_path))
    shutil.rmtree(tmp_path / "parts" / "part-2-of-3")
    assert main(run) == 0
    after = [file.stat().st_mtime_ns for file in files]
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True]
    assert "3 slices are made" in capfd.readouterr().out


@pytest.mark.slow
def test_a_slice_that_fails_does_not_end_the_others(data, tmp_path, capfd):
    data.path(data.column("tactile")[0]).write_bytes(b"no image")
    assert main(f"run {command(tmp_path)} --slices 4 --workers 2".split()) == 1
    assert len([*(tmp_path / "parts").glob("part-*")]) == 3
    assert "Not made: " in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("run --slices 2", "VERB"),
        ("run score --slices 2", "VERB must be one of embed"),
        ("run embed {m} --encoder palpate/mini -o out --slices 0", "--slices must be at least 1"),
        ("run embed {m} --encoder palpate/mini -o out --slices 2 --workers 0", "--workers must be"),
        ("run embed {m} --encoder palpate/mini --slices 2", "must be given"),
        ("run embed {m} --encodr palpate/mini -o out --slices 2", "--encodr"),
        ("run embed {m} --encoder palpate/mini -o o --slices 2 --executor slurm", "--executor"),
        ("run embed {m} --encoder palpate/mini -o o --slices 2 --executor ray", "--executor"),
    ],
)
def test_mistakes_are_one_line(words, error, tmp_path, capsys, monkeypatch):
    touches(tmp_path / "data", videos=1).save(tmp_path / "manifest.parquet")
    monkeypatch.setenv("PATH", "/nowhere")
    assert main(words.format(m=tmp_path / "manifest.parquet").split()) == 2
    printed = capsys.readouterr().err
    assert error in printed
    assert len(printed.splitlines()) == 1


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    if shutil.which("slurmctld") is None or os.geteuid() != 0:
        pytest.skip("no Slurm to start here: apt-get install slurm-wlm munge, as root")
    started = subprocess.run(
        [SCRIPTS / "start.sh", tmp_path / "slurm"], capture_output=True, text=True, check=False
    )
    try:
        assert started.returncode == 0, started.stderr
        monkeypatch.setenv("SLURM_CONF", started.stdout.strip().partition("=")[2])
        yield
    finally:
        subprocess.run([SCRIPTS / "stop.sh", tmp_path / "slurm"], check=False)


def wait_for(holds, seconds=300):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.02)


def slurm_says(*words):
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


@pytest.mark.nightly
def test_slurm_runs_an_array_and_a_killed_task_is_requeued_and_loses_its_slice_alone(
    data, tmp_path, slurm
):
    line = f"{sys.executable} -m palpate {command(tmp_path)} -q --slice $SLURM_ARRAY_TASK_ID/4"
    log = f"--output={tmp_path}/log.%a"
    job = slurm_says("sbatch", "--parsable", "--array=1-4%2", log, "--wrap", line).strip()
    parts = tmp_path / "parts"
    wait_for((parts / ".part-1-of-4.part").exists)
    slurm_says("scancel", "--full", "--signal=KILL", f"{job}_1")
    wait_for(lambda: len([*parts.glob("part-*-of-4/part.json")]) == 3)
    assert not (parts / "part-1-of-4").exists()
    files = sorted(parts.glob("part-*/features.npy"))
    before = [file.stat().st_mtime_ns for file in files]
    slurm_says("scontrol", "requeue", f"{job}_1")
    wait_for((parts / "part-1-of-4").exists)
    assert before == [file.stat().st_mtime_ns for file in files]
    assert np.array_equal(read_samples(parts, "parts").rows, whole(data, tmp_path))


@pytest.mark.nightly
def test_slurm_runs_all_slices_of_a_command(data, tmp_path, slurm):
    words = f"run {command(tmp_path)} --slices 3 --executor slurm --partition p --time 0:10:00"
    assert main([*words.split(), "--workers", "2", "--mem", "1"]) == 0
    wait_for(lambda: len([*(tmp_path / "parts").glob("part-*-of-3/part.json")]) == 3)
    assert np.array_equal(read_samples(tmp_path / "parts", "parts").rows, whole(data, tmp_path))
    wait_for(lambda: len([*(tmp_path / "parts.logs").glob("*/completions/*")]) == 3)
    assert main([*words.split(), "--workers", "2", "--mem", "1"]) == 0
    assert not slurm_says("squeue", "-h", "-t", "R").strip()
