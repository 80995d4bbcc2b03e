"""Writing a world: equal bytes, resuming, kill -9, full disks, folders that hold something else."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from forge.errors import fails
from palpate.cli import main
from palpate.core import digest_folder, sealed, write_json
from palpate.sim import MINI_SEEDS, PRESETS, WorldOptions, write_world

TINY = dataclasses.replace(PRESETS["tiny"], size=16, tile=64)
RUN = ["world", "--preset", "tiny", "--size", "16", "--workers", "1", "-q", "-o"]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("world") / "w", TINY)


def kill_after(videos):
    def progress(what, done, total, remark=""):
        if done == videos:
            raise KeyboardInterrupt

    return progress


def never(*_):
    pytest.fail("rendered")


def test_workers_and_interrupted_runs_give_the_same_bytes(tmp_path):
    whole = write_world(tmp_path / "a", TINY)
    write_world(tmp_path / "b", TINY, workers=2)
    with pytest.raises(KeyboardInterrupt):
        write_world(tmp_path / "c", TINY, progress=kill_after(3))
    assert not (tmp_path / "c").exists()
    (part,) = tmp_path.glob(".c.*.part")
    (part / "dataset" / ".left-by-a-kill").mkdir()
    done = []
    record = write_world(tmp_path / "c", TINY, progress=lambda *args: done.append(args[1]))
    assert (done[0], record.digest) == (3, whole.digest)
    digests = {digest_folder(tmp_path / name, "[!.]*/**/*.jpg") for name in "abc"}
    assert len(digests) == 1
    assert [(tmp_path / n / "leak.csv").read_bytes() for n in "ab"] == [
        (tmp_path / "c" / "leak.csv").read_bytes()
    ] * 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b", "c"]


def test_a_finished_world_is_kept_and_another_rejected(world):
    before = {p: p.stat().st_mtime_ns for p in world.folder.rglob("*")}
    again = write_world(world.folder, TINY, progress=never)
    assert again.digest == world.digest
    assert before == {p: p.stat().st_mtime_ns for p in world.folder.rglob("*")}
    fails("other options", write_world, world.folder, dataclasses.replace(TINY, seed=1))
    path = world.folder / "world.json"
    path.write_text(path.read_text().replace("palpate-world/1", "palpate-world/0"))
    fails("damaged", write_world, world.folder, TINY)
    record = json.loads(path.read_text())
    del record["sealed"]
    write_json(path, sealed(record))
    fails("of another version", write_world, world.folder, TINY)


def test_folders_that_cannot_become_a_world_are_rejected_before_rendering(tmp_path, monkeypatch):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("mine")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    here = [(Path(), "current folder"), (Path("../here"), "current folder")]
    for output, message in ((tmp_path / "notes", "absent or an empty"), *here):
        fails(message, write_world, output, TINY, progress=never)
    single = WorldOptions(materials=1, objects_per_material=1, leak="none", size=16, tile=64)
    fails("at least two videos", write_world, tmp_path / "w", single, progress=never)
    fails("`workers` must be at least 1", write_world, tmp_path / "w", TINY, workers=0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["here", "notes"]


def test_a_second_run_of_the_same_world_is_rejected(tmp_path):
    pytest.importorskip("fcntl")

    def second(what, done, total, remark=""):
        fails("another run writes there", write_world, tmp_path / "w", TINY)

    write_world(tmp_path / "w", TINY, progress=second)
    assert [p.name for p in tmp_path.iterdir()] == ["w"]


def processes():
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = stat.read_text().rsplit(")", 1)[1].split()[:2]
        except OSError:
            continue
        if state != "Z":
            yield int(stat.parent.name), int(parent)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_workers_end_with_a_killed_parent_and_the_lock_is_free(tmp_path):
    command = [sys.executable, "-m", "palpate", "world", "-o", str(tmp_path / "w")]
    run = subprocess.Popen([*command, "--preset", "small", "--workers", "2", "-q"])
    try:
        until = time.monotonic() + 120
        while not list(tmp_path.glob(".w.*.part/dataset/2*")):
            assert time.monotonic() < until
            assert run.poll() is None
            time.sleep(0.1)
        workers = {pid for pid, parent in processes() if parent == run.pid}
        assert len(workers) >= 2
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    until = time.monotonic() + 60
    while workers & {pid for pid, _ in processes()}:
        assert time.monotonic() < until
        time.sleep(0.1)
    videos = len(list(tmp_path.glob(".w.*.part/dataset/2*")))
    with pytest.raises(KeyboardInterrupt):  # past the lock
        write_world(tmp_path / "w", PRESETS["small"], progress=kill_after(videos))


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 256 KB and a function that makes it large; only where one may be mounted."""
    place = tmp_path / "disk"
    place.mkdir()

    def mount(*options):
        command = ["mount", *options, str(place)]
        return subprocess.run(command, capture_output=True, check=False).returncode

    if sys.platform != "linux" or os.geteuid() or mount("-t", "tmpfs", "-o", "size=256k", "tmpfs"):
        pytest.skip("no rights to mount a small file system")
    yield place, lambda: mount("-o", "remount,size=20m")
    subprocess.run(["umount", str(place)], check=False)


@pytest.mark.parametrize("layout", ["frames", "videos"])
def test_a_full_disk_is_one_line_and_the_same_command_continues(
    layout, small_disk, tmp_path, capsys
):
    place, enlarge = small_disk
    args = ["world", "--preset", "tiny", "--objects-per-material", "4", "--layout", layout, "-q"]
    args += ["--workers", "1", "-o"]
    assert main([*args, str(place / "w")]) == 2
    message = capsys.readouterr().err
    assert "No space left" in message
    assert "Traceback" not in message
    assert not (place / "w").exists()
    assert enlarge() == 0
    assert main([*args, str(place / "w")]) == 0
    assert main([*args, str(tmp_path / "whole")]) == 0
    assert digest_folder(place / "w") == digest_folder(tmp_path / "whole")


def test_videos_without_pyav_say_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    fails("video", write_world, tmp_path / "w", dataclasses.replace(TINY, layout="videos"))


def test_a_world_of_the_shipped_models_says_so(tmp_path, capsys):
    assert main([*RUN, str(tmp_path / "w"), "--seed", str(MINI_SEEDS[3])]) == 0
    assert "may have been trained on this world" in capsys.readouterr().out
    record = json.loads((tmp_path / "w" / "world.json").read_text())
    assert "trained on this world" in record["seen_by_shipped_models"]
