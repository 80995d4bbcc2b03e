"""Runs beside each other, runs that are killed, and folders that are not what they seem."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from palpate.cli import main
from palpate.core import PalpateError, digest_folder
from palpate.sim import PRESETS, write_world
from palpate.sim.unfinished import LOCK

TINY = dataclasses.replace(PRESETS["tiny"], size=16, tile=64)
RUN = ["world", "--preset", "tiny", "--size", "16", "--tile", "64", "--workers", "1", "-q"]


def test_a_second_equal_run_is_refused_and_the_first_unharmed(tmp_path):
    pytest.importorskip("fcntl")
    refused = []

    def second(what, done, total, remark=""):
        with pytest.raises(PalpateError, match="another run is writing this world") as error:
            write_world(tmp_path / "w", TINY)
        refused.append(error.value)
        write_world(tmp_path / "other", TINY)  # of no concern to it

    write_world(tmp_path / "w", TINY, progress=second)
    assert len(refused) > 2
    assert digest_folder(tmp_path / "w") == digest_folder(tmp_path / "other")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other", "w"]


def test_a_run_that_waited_for_an_equal_one_takes_its_world(tmp_path, monkeypatch):
    """The other run ends between the look at the folder and the lock."""
    import palpate.sim.writer as writer

    real, begun = writer.locked, []

    def late(part, out):
        if not begun:
            begun.append(part)
            write_world(tmp_path / "w", TINY)
        return real(part, out)

    monkeypatch.setattr(writer, "locked", late)
    assert write_world(tmp_path / "w", TINY).rendered == 0
    assert [p.name for p in tmp_path.iterdir()] == ["w"]


def children(pid):
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_workers_follow_a_killed_parent(tmp_path):
    command = [
        sys.executable,
        "-m",
        "palpate",
        "world",
        "-o",
        str(tmp_path / "w"),
        "--preset",
        "small",
        "--workers",
        "2",
        "-q",
    ]
    run = subprocess.Popen(command)
    try:
        until = time.monotonic() + 120
        while not list(tmp_path.glob(".w.*.part/dataset/2*")):
            assert time.monotonic() < until
            assert run.poll() is None
            time.sleep(0.1)
        workers = children(run.pid)
        assert len(workers) >= 2
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    until = time.monotonic() + 60
    while any(map(alive, workers)):
        assert time.monotonic() < until
        time.sleep(0.1)
    assert list(
        tmp_path.glob(f".w.*.part/.work/{LOCK}")
    )  # and the lock is free again: see the next test


def test_the_lock_of_a_run_that_was_stopped_is_free(tmp_path):
    def stop(what, done, total, remark=""):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_world(tmp_path / "w", TINY, progress=stop)
    assert list(tmp_path.glob(f".w.*.part/.work/{LOCK}"))
    assert write_world(tmp_path / "w", TINY).rendered == 6


def never(*_):
    pytest.fail("rendered")


def test_the_folder_one_is_in_is_refused_before_rendering(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for out in (Path(), tmp_path / "here", Path("../here")):
        with pytest.raises(PalpateError, match="must not be the folder that you are in"):
            write_world(out, TINY, progress=never)
    assert [p.name for p in tmp_path.iterdir()] == ["here"]
    assert main([*RUN, "-o", "."]) == 2


def test_a_link_to_an_empty_folder_is_followed(tmp_path):
    (tmp_path / "disk" / "real").mkdir(parents=True)
    (tmp_path / "w").symlink_to(tmp_path / "disk" / "real")
    record = write_world(tmp_path / "w", TINY)
    assert record.folder == tmp_path / "w"
    assert (tmp_path / "w").is_symlink()
    assert (tmp_path / "disk" / "real" / "world.json").is_file()
    assert [p.name for p in (tmp_path / "disk").iterdir()] == ["real"]
    assert write_world(tmp_path / "w", TINY).rendered == 0


def test_links_to_nothing_are_refused_before_rendering(tmp_path):
    (tmp_path / "w").symlink_to(tmp_path / "nowhere")
    (tmp_path / "round").symlink_to(tmp_path / "round")
    for name in ("w", "round"):
        with pytest.raises(PalpateError, match="a link to nothing"):
            write_world(tmp_path / name, TINY, progress=never)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["round", "w"]


@pytest.mark.parametrize("sheet", ["folder", "notes.txt/sheet.png", "w"])
def test_a_sheet_that_cannot_be_written_is_told_before_rendering(
    sheet, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    assert main([*RUN, "-o", "w", "--sheet", sheet]) == 2
    assert "The contact sheet" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "notes.txt"]


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere"
)
def test_a_sheet_in_a_folder_without_rights_is_told(tmp_path, capsys):
    (tmp_path / "shut").mkdir(mode=0o500)
    assert main([*RUN, "-o", str(tmp_path / "w"), "--sheet", str(tmp_path / "shut" / "s.png")]) == 2
    assert "writable" in capsys.readouterr().err


def test_a_sheet_within_the_world_is_drawn(tmp_path):
    assert (
        main([*RUN, "-o", str(tmp_path / "w"), "--sheet", str(tmp_path / "w" / "sheet.png")]) == 0
    )
    assert (tmp_path / "w" / "sheet.png").is_file()


@pytest.mark.parametrize("workers", [0, 1.5, True, "a", None])
def test_workers_must_be_a_whole_number(workers, tmp_path):
    with pytest.raises(PalpateError, match="workers must be a whole number"):
        write_world(tmp_path / "w", TINY, workers=workers)
