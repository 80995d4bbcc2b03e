"""Writes a world as a tree in the layout of Touch and Go.

::

    world.json                          options, VERSION, counts, the known leak, digest; the mark of a finished world
    label.txt  category_reference.txt  train.txt  test.txt  captions.csv  objects.csv
    dataset/<video>/video_frame/0000000012.jpg      photo        (layout="frames")
    dataset/<video>/gelsight_frame/0000000012.jpg   touch
    dataset/<video>/video.mp4  gelsight.mp4         (layout="videos")

The tree grows in the hidden sibling ``.<name>.<digest>.part``, one finished video after another, and is renamed when whole. A run that was
killed is continued by the same call; the result is the same as without the interruption.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, atomic_folder, digest_json, digest_lines, quiet, read_json, short, write_json, write_text
from palpate.sim.encode import require_av, write_jpeg, write_mp4
from palpate.sim.lists import contact_rows, cut, list_files
from palpate.sim.materials import MATERIALS, Material
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import VideoPlan, plan_world, written_frames
from palpate.sim.video import Video

FORMAT = "palpate-world/1"
NOTE = "Synthetic: procedural surfaces and a simulated sensor. Shows mechanisms; never compare its numbers with those of real data sets."
_TEXTS = ".texts"


@dataclass(frozen=True)
class WorldRecord:
    """A finished world.

    Attributes:
        folder: the tree.
        digest: SHA-256 over options, VERSION and lists.
        counts: videos, mixed_videos, objects, touches, contact_frames, written_frames, train_frames, test_frames.
        leak: the rule of the cut, and what train.txt and test.txt share, see :func:`palpate.sim.lists.leak_of`.
        rendered: videos that this call rendered; the others were there already.
    """

    folder: Path
    digest: str
    counts: dict[str, int]
    leak: dict[str, Any]
    rendered: int


def write_world(out: Path, options: WorldOptions | None = None, *, workers: int = 1, progress: Progress = quiet) -> WorldRecord:
    """Writes a world, or goes on with one that was interrupted.

    Args:
        out: the folder to make; absent, empty, or the same world (then nothing is done).
        options: what to make, default ``WorldOptions()``.
        workers: processes; the bytes do not depend on it.
        progress: told after each video.

    Raises:
        PalpateError: if ``out`` holds something else, a material draws something invalid, or the world is too small for its cut.
        MissingExtraError: if videos are asked for and PyAV is not installed.
    """
    options, out = options or WorldOptions(), Path(out)
    if workers < 1:
        raise PalpateError("workers must be at least 1", str(workers), "Pass workers=1")
    if options.layout == "videos":
        require_av()
    if (out / "world.json").is_file():
        return _finished(out, options)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise PalpateError(f"{out} must be absent, empty or a finished world", "something else there", "Choose another folder or remove it")
    plans = plan_world(options)
    cut(options, plans, contact_rows(options, plans))  # refuses a world that is too small before anything is rendered
    part = out.absolute().parent / f".{out.absolute().name}.{short(options.digest)}.part"
    todo = [plan for plan in plans if not _done(part, plan)]
    if not (part / "world.json").is_file():
        progress("rendering videos", len(plans) - len(todo), len(plans))
        for count, name in enumerate(_render(options, todo, part, workers), len(plans) - len(todo) + 1):
            progress("rendering videos", count, len(plans), name)
        _finish(part, options, plans)
    shutil.rmtree(part / _TEXTS, ignore_errors=True)
    if out.exists():
        out.rmdir()
    part.replace(out)
    return dataclasses.replace(_finished(out, options), rendered=len(todo))


def _finished(out: Path, options: WorldOptions) -> WorldRecord:
    """The record of the finished world in ``out``."""
    data = read_json(out / "world.json", "world record")
    if not isinstance(data, dict) or data.get("format") != FORMAT or data.get("options_digest") != options.digest:
        raise PalpateError(
            f"{out} must hold the world that was asked for", "a world of other options", "Choose another folder or remove it"
        )
    return WorldRecord(out, data["digest"], data["counts"], data["leak"], 0)


def _done(part: Path, plan: VideoPlan) -> bool:
    return (part / "dataset" / plan.name).is_dir() and (part / _TEXTS / f"{plan.name}.json").is_file()


def _render(options: WorldOptions, plans: Sequence[VideoPlan], part: Path, workers: int) -> Iterator[str]:
    """Renders videos and yields their names, in order."""
    job = partial(_write_video, options, part)
    if min(workers, len(plans)) < 2:
        for plan in plans:
            yield job(plan)
        return
    context = multiprocessing.get_context("spawn")  # a forked copy of a process with threads may hang
    with ProcessPoolExecutor(workers, context, _start_worker, (dict(MATERIALS),)) as pool:
        try:
            for name, error in _started(pool, partial(_guarded, job), plans, chunk=max(1, min(4, len(plans) // (2 * workers)))):
                if error is not None:
                    raise PalpateError(*error)
                yield name
        except BrokenProcessPool:
            raise PalpateError(
                "The worker processes must be able to start",
                "one that died",
                "Pass workers=1, or call write_world under: if __name__ == '__main__'",
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _started(pool: ProcessPoolExecutor, job: Any, plans: Sequence[VideoPlan], chunk: int) -> Iterator[Any]:
    """``pool.map``, whose processes start deaf to Ctrl-C: a terminal sends it to all of them, and each would print a traceback."""
    if threading.current_thread() is not threading.main_thread():  # only there can signals be set
        return pool.map(job, plans, chunksize=chunk)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return pool.map(job, plans, chunksize=chunk)
    finally:
        signal.signal(signal.SIGINT, before)


def _start_worker(materials: dict[str, Material]) -> None:
    """Gives a new process the table of this one, so that materials which a user added are known there."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    MATERIALS.clear()
    MATERIALS.update(materials)


def _guarded(job: Any, plan: VideoPlan) -> tuple[str, tuple[str, str, str] | None]:
    """Runs ``job``; a user's mistake comes back as a value, since the exception does not survive pickling."""
    try:
        return job(plan), None
    except PalpateError as error:
        return plan.name, (error.must, error.got, error.fix)


def _write_video(options: WorldOptions, part: Path, plan: VideoPlan) -> str:
    """Renders one video into ``part``, whole or not at all; returns its name."""
    video = Video(options, plan)
    write_json(part / _TEXTS / f"{plan.name}.json", [video.text(touch) for touch in range(options.touches_per_video)])
    frames = written_frames(options)
    with atomic_folder(part / "dataset" / plan.name) as folder:
        if options.layout == "videos":
            write_mp4(folder / "video.mp4", map(video.vision, frames), options.size)
            write_mp4(folder / "gelsight.mp4", map(video.tactile, frames), options.size)
            return plan.name
        for kind, render in (("video_frame", video.vision), ("gelsight_frame", video.tactile)):
            (folder / kind).mkdir()
            for frame in frames:
                write_jpeg(folder / kind / f"{frame:010d}.jpg", render(frame))
    return plan.name


def _finish(part: Path, options: WorldOptions, plans: Sequence[VideoPlan]) -> None:
    """Writes the lists and, last, ``world.json``."""
    for stray in (part / "dataset").glob(".*"):  # left by a killed process
        shutil.rmtree(stray, ignore_errors=True)
    captions = {plan.name: read_json(part / _TEXTS / f"{plan.name}.json", "captions of a video") for plan in plans}
    files, leak = list_files(options, plans, captions)
    for name, text in files.items():
        write_text(part / name, text)
    settings = dataclasses.asdict(options)
    lists = {name: digest_lines(text.splitlines()) for name, text in files.items()}
    contact = len(plans) * options.touches_per_video * options.frames_per_touch
    counts = {
        "videos": len(plans),
        "mixed_videos": sum(len(plan.objects) > 1 for plan in plans),
        "objects": len({ref for plan in plans for ref in plan.objects}),
        "touches": len(plans) * options.touches_per_video,
        "contact_frames": contact,
        "written_frames": len(plans) * len(written_frames(options)),
        "train_frames": contact - int(leak["test_frames"]),
        "test_frames": int(leak["test_frames"]),
    }
    write_json(
        part / "world.json",
        {
            "format": FORMAT,
            "version": VERSION,
            "note": NOTE,
            "digest": digest_json({"version": VERSION, "options": settings, "lists": lists}),
            "options_digest": options.digest,
            "counts": counts,
            "leak": {"rule": options.leak, **leak},
            "options": settings,
        },
    )
