"""Streams that end, are closed, full or lack letters change neither exit status nor files."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.cli import main
from palpate.core import FeatureSet
from palpate.report.results import Results

NOPE = ("score", "--generated", "nope.npy", "--reference", "nope.npy")
AUDIT = ("audit", "train.txt", "test.txt", "--fail-over", "0.01")
QUICK = ("--companions", "none", "--permutations", "0")
SCORE = ("score", "--generated", "g.npz", "--reference", "r.npz", *QUICK)
NAMED = ("score", "--generated", "grün=g.npz", "--reference", "r.npz", *QUICK)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Two files of embeddings, and two lists that share a video, in the working directory."""
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate("gr"):
        x = np.random.default_rng(seed).normal(size=(12, 4)) + 2
        unit = (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)
        ids, videos = [str(k) for k in range(12)], [f"v{k // 3}" for k in range(12)]
        FeatureSet(ids, unit, groups=videos).save(Path(f"{name}.npz"))
    for name in ("train", "test"):
        Path(f"{name}.txt").write_text("a/0000000001.jpg,3\n")
    return tmp_path


@pytest.fixture
def unread():
    """A pipe that nobody reads."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


def palpate(*args, closed=None, **how):
    """Run a process; ``closed`` is a stream that the shell closes before the start."""
    env = {name: v for name, v in os.environ.items() if name != "PYTHONUNBUFFERED"}
    env |= how.pop("env", {})
    command = [sys.executable, "-m", "palpate", *args]
    if closed is not None:
        command = ["sh", "-c", f'exec "$@" {closed}>&-', "sh", *command]
    return subprocess.run(command, check=False, env=env, **how)


@pytest.mark.parametrize(
    ("args", "status"),
    [((*AUDIT, "--json"), 1), (NOPE, 2), ((*NOPE, "--json"), 2), (("--help",), 0)],
)
def test_readers_that_go_away_leave_the_status(here, unread, args, status):
    assert palpate(*args, stdout=unread, stderr=unread).returncode == status


def test_a_reader_that_goes_away_loses_no_file_and_no_status(here, unread):
    how = {"stdout": unread, "stderr": subprocess.PIPE, "text": True}
    done = palpate(*SCORE, "-o", "o.json", "--page", "o.html", "-q", **how)
    assert (done.returncode, done.stderr) == (0, "")
    assert Results.load(Path("o.json")).scores
    assert Path("o.html").is_file()
    assert not Path(".o.json.work").exists()
    done = palpate(*AUDIT, **how)
    assert (done.returncode, "Traceback" in done.stderr) == (1, False)
    assert "FAIL: leaked fraction" in done.stderr


def test_streams_that_are_closed_leave_status_and_files(here):
    assert palpate(*NOPE, closed=2, stdout=subprocess.DEVNULL).returncode == 2
    done = palpate(*SCORE, "-o", "o.json", closed=1, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    assert Results.load(Path("o.json")).scores


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize(
    "args",
    [(*SCORE, "-o", "o.json"), (*SCORE, "-o", "o.json", "--json"), (*NOPE, "--json"), ("--help",)],
)
def test_a_full_disk_behind_standard_output_is_an_error_and_the_file_is_written(here, args):
    with open("/dev/full", "w") as full:
        done = palpate(*args, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
    assert "No space left on device" in done.stderr
    assert Path("o.json").is_file() == ("-o" in args)


def test_letters_that_a_stream_lacks_are_question_marks_and_json_stays_whole(here):
    pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    ascii_only = {"env": {"PYTHONIOENCODING": "ascii"}, **pipes}
    done = palpate(*NAMED, **ascii_only)
    assert done.returncode == 0, done.stderr
    row = next(line for line in done.stdout.decode("ascii").splitlines() if line.startswith("TMMD"))
    assert row.split()[:3] == ["TMMD", "?", "gr?n"]
    done = palpate(*NAMED, "--json", **ascii_only)
    assert (
        done.returncode,
        {s["a"] for s in json.loads(done.stdout.decode("ascii"))["scores"]},
    ) == (0, {"grün"})


class Plain:
    """A stream in place of standard output, with neither an encoding nor a file."""

    def __init__(self, error=None):
        self.text, self.error = "", error

    def write(self, text):
        if self.error is not None:
            raise self.error
        self.text += text

    def flush(self):
        pass

    def isatty(self):
        return False


def test_a_stream_need_not_be_a_file(monkeypatch, capsys):
    out = Plain()
    monkeypatch.setattr("sys.stdout", out)
    assert main(["score", "--generated", "nope.npy", "--reference", "nope.npy", "--json"]) == 2
    assert json.loads(out.text)["must"]
    monkeypatch.setattr("sys.stdout", Plain(OSError(5, "Input/output error")))
    assert main(["--help"]) == 2
    assert "Got Input/output error" in capsys.readouterr().err
