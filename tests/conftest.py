"""Fixtures for all tests: small trees in true layouts, and the shared real data where present."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from forge.worlds import by_video, six_videos
from palpate.cli import main, terminal
from palpate.data.manifest import Manifest

# A busy machine is no failure: how long an example takes is not tested.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

TOP = Path(__file__).resolve().parents[1]
CHROMIUM = Path(os.environ.get("PALPATE_CHROMIUM", "/usr/bin/chromium"))
ARGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Fast tests first: what is broken shows early."""
    items.sort(key=lambda item: any(map(item.get_closest_marker, ("slow", "browser", "nightly"))))


def shared_data() -> Path | None:
    """The folder of shared real data, or None."""
    place = Path(os.environ.get("PALPATE_SHARED_DATA", TOP.parent / "shared" / "data"))
    return place if place.is_dir() else None


@pytest.fixture(scope="session")
def real_data() -> Path:
    place = shared_data()
    if place is None:
        pytest.skip("no shared real data: set PALPATE_SHARED_DATA")
    return place


@pytest.fixture(autouse=True)
def next_commands(tmp_path_factory, monkeypatch):
    """Run, after a test, each command that palpate suggested in it: all of these must work."""
    suggested, write = [], terminal.Terminal.print_line
    complain = terminal._print_error

    def print_line(self, line):
        write(self, line)
        keep(line, "Next: palpate ")

    def print_error(line):
        complain(line)
        keep(line, "  palpate ")

    def keep(line, start):
        if line.startswith(start):
            words = shlex.split(line.removeprefix(start))
            choice = ["--overwrite"] * (words[0] == "import")  # several into one folder
            suggested.append((Path.cwd(), [*words, *choice]))

    monkeypatch.setattr(terminal.Terminal, "print_line", print_line)
    monkeypatch.setattr(terminal, "_print_error", print_error)
    yield suggested
    run, suggested[:] = suggested[:], []
    own = tmp_path_factory.mktemp("next") if run else TOP
    for folder, words in run:
        # Where a test did not choose a folder, what its commands write is no part of ours.
        with contextlib.chdir(own if folder == TOP else folder):
            status = main(words)
        assert status in (0, 1, 3), words


@pytest.fixture
def small_manifest(tmp_path: Path) -> Manifest:
    """Six videos of three materials, two touches of four frames each, with 32-pixel pictures."""
    return six_videos(tmp_path / "root")


@pytest.fixture
def tag(small_manifest, tmp_path, monkeypatch):
    """The small data set in `tag` and a split of it by video in `split.json`, where a test runs."""
    monkeypatch.chdir(tmp_path)
    split = by_video(small_manifest)
    small_manifest.save(tmp_path / "tag" / "manifest.parquet")
    split.save(tmp_path / "split.json")
    return small_manifest, split


@pytest.fixture(scope="session")
def rated(tmp_path_factory):
    """Folders of a reference and three methods, with materials and videos."""
    from forge.people import write_folders

    return write_folders(tmp_path_factory.mktemp("rated"))


@pytest.fixture(scope="session")
def chromium():
    """Debian's chromium, driven by playwright; tests that need it skip where it is absent."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM.is_file():
        pytest.skip(f"no chromium at {CHROMIUM}; install it or set PALPATE_CHROMIUM")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGS)
        yield browser
        browser.close()


@pytest.fixture
def on_two_processes(tmp_path: Path) -> Callable[[Callable[[], Any]], list[Any]]:
    """Call a function in two forked processes that train together; returns what each returned.

    They must not need polars, whose threads do not outlive a fork.
    """

    def child(rank: int, work: Callable[[], Any]) -> None:
        from torch import distributed

        from palpate.training.processes import connect

        place = {"RANK": f"{rank}", "LOCAL_RANK": f"{rank}", "MASTER_ADDR": "localhost"}
        os.environ |= {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", **place}
        meeting = f"file://{tmp_path}/meeting"
        distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=2)
        connect("cpu")
        (tmp_path / f"returned-{rank}").write_text(json.dumps(work()))

    def run(work: Callable[[], Any]) -> list[Any]:
        children = []
        for rank in range(2):
            if (pid := os.fork()) == 0:
                try:
                    child(rank, work)
                    os._exit(0)
                finally:  # nothing of pytest runs in a child
                    traceback.print_exc()
                    os._exit(1)
            children.append(pid)
        assert [os.waitpid(pid, 0)[1] for pid in children] == [0, 0]
        (tmp_path / "meeting").unlink(missing_ok=True)
        return [json.loads((tmp_path / f"returned-{rank}").read_text()) for rank in range(2)]

    return run
