"""Write a world as a tree in the layout of Touch and Go.

::

    world.json                               options, counts, known leak, digest of a finished world
    manifest.parquet  splits/Orig.json       the world's samples, and its split
    leak.csv                                 what each test sample shares with train, exactly
    label.txt  train.txt  dataset/<video>/   see palpate.sim.layouts

The tree grows in the hidden sibling ``.<name>.<digest>.part``, one finished video after another,
and is renamed when whole. A run that was killed, or stopped by a full disk, is continued by the
same call with the same result. A single run at a time writes it: the lock is ``flock`` on a file
inside, which the system releases however the process ends (not on Windows).
"""

from __future__ import annotations

import dataclasses
import importlib.util
import shutil
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import (
    MissingExtraError,
    PalpateError,
    Progress,
    atomic_folder,
    digest_folder,
    digest_json,
    digest_lines,
    locked,
    quiet,
    read_json,
    require,
    require_new_folder,
    sealed,
    write_json,
    write_text,
)
from palpate.core.processes import worker_pool
from palpate.sim.layouts import list_files, write_video_files
from palpate.sim.leak import LEAK_COLUMNS, leak_counts, leak_table
from palpate.sim.materials import MATERIALS, Material
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import VideoPlan, written_frames
from palpate.sim.presets import MINI_SEEDS, SEEN_WARNING
from palpate.sim.scans import scan_notes
from palpate.sim.video import Video
from palpate.sim.world import World

WORLD_FORMAT = "palpate-world/1"
NOTE = (
    "Synthetic: procedural surfaces and a simulated sensor. Shows mechanisms; never compare its "
    "numbers with those of real data sets."
)
#: Folder within an unfinished world: captions of each finished video, and the digest of its files.
WORK = ".work"


@dataclass(frozen=True)
class WorldRecord:
    """A finished world.

    Attributes:
        folder: where it is.
        digest: of options and lists.
        counts: videos, mixed_videos, objects, contacts, contact_frames, written_frames,
            train_frames, test_frames.
        leak: the rule of the cut, and what train and test share
            (:func:`palpate.sim.leak.leak_counts`).
    """

    folder: Path
    digest: str
    counts: dict[str, int]
    leak: dict[str, Any]


def write_world(
    output: str | Path,
    options: WorldOptions | None = None,
    *,
    workers: int = 1,
    progress: Progress = quiet,
) -> WorldRecord:
    """Write a world, or continue an interrupted run.

    Args:
        output: the folder to make; absent, empty, or the same world (then nothing is done).
        options: what to make, default ``WorldOptions()``.
        workers: processes; the bytes do not depend on it.
        progress: called after each video.

    Raises:
        PalpateError: if ``output`` holds other content, is the current folder, is written by
            another run or holds another world, a material draws something invalid, or the world is
            too small for its cut.
        MissingExtraError: if videos are requested and PyAV is not installed.
        OSError: if the disk is full; finished videos stay, and the same call continues.
    """
    options, output = options or WorldOptions(), Path(output)
    require(workers >= 1, "workers", "must be at least 1", workers)
    if options.layout == "videos" and importlib.util.find_spec("av") is None:
        raise MissingExtraError("av", "video", "Writing a world as videos")
    folder = output.resolve()
    if (folder / "world.json").is_file():
        return _finished(output, options)
    require_new_folder(output)
    world = World(options)
    _ = world.parts  # raises for a world that is too small, before anything is rendered
    unfinished = folder.parent / f".{folder.name}.{options.digest[:12]}.part"
    with locked(unfinished, output):
        (unfinished / WORK).mkdir(exist_ok=True)
        if not (folder / "world.json").is_file():  # else an equal run ended meanwhile
            _render(unfinished, world, workers, progress)
            _finish(unfinished, world)
            if folder.exists():
                folder.rmdir()
            unfinished.replace(folder)
            shutil.rmtree(folder / WORK, ignore_errors=True)
    shutil.rmtree(unfinished, ignore_errors=True)
    return _finished(output, options)


def _finished(output: Path, options: WorldOptions) -> WorldRecord:
    """Return the record of the finished world in ``output``."""
    data = read_json(output / "world.json", "world record")
    same = (data.get("format"), data.get("options_digest")) == (WORLD_FORMAT, options.digest)
    must, fix = f"{output} must hold the requested world", "Choose another folder, or remove it"
    require(same, None, must, "a world of other options or of another version", fix=fix)
    return WorldRecord(output, data["digest"], data["counts"], data["leak"])


def _render(unfinished: Path, world: World, workers: int, progress: Progress) -> None:
    """Render the videos that are missing; materials that a user added go to the workers too."""
    plans = world.plans
    todo = [plan for plan in plans if not _is_whole(unfinished, plan)]
    for folder in (unfinished / "dataset" / plan.name for plan in todo):
        if folder.is_dir():
            progress(f"{folder} is damaged: making it again", 0, 0)
            shutil.rmtree(folder)
    finished = len(plans) - len(todo)
    progress("rendering videos", finished, len(plans))
    job = partial(_write_video, world.options, unfinished)
    alone = min(workers, len(todo)) < 2
    share = max(1, min(4, len(todo) // (2 * workers)))
    pool = nullcontext() if alone else worker_pool(workers, _set_materials, (dict(MATERIALS),))
    with pool as processes:
        names = map(job, todo) if processes is None else processes.map(job, todo, chunksize=share)
        for count, name in enumerate(names, finished + 1):
            progress("rendering videos", count, len(plans), name)


def _is_whole(unfinished: Path, plan: VideoPlan) -> bool:
    """Whether a video is there as it was written."""
    folder, record = unfinished / "dataset" / plan.name, unfinished / WORK / f"{plan.name}.json"
    with suppress(PalpateError, LookupError, TypeError):
        files = read_json(record, "record of a video")["files"]
        return folder.is_dir() and digest_folder(folder) == files
    return False


def _set_materials(materials: dict[str, Material]) -> None:
    MATERIALS.clear()
    MATERIALS.update(materials)


def _write_video(options: WorldOptions, unfinished: Path, plan: VideoPlan) -> str:
    """Render a video into ``unfinished``, whole or not at all; return its name."""
    video = Video(options, plan)
    captions = [video.text(contact) for contact in range(options.contacts_per_video)]
    with atomic_folder(unfinished / "dataset" / plan.name, flush=False) as folder:
        write_video_files(video, folder)
        record = {"captions": captions, "files": digest_folder(folder)}
        write_json(unfinished / WORK / f"{plan.name}.json", sealed(record))
    return plan.name


def _finish(unfinished: Path, world: World) -> None:
    """Write the lists of train and test and, last, ``world.json``."""
    for stray in (unfinished / "dataset").glob(".*"):  # unfinished videos of a killed process
        shutil.rmtree(stray, ignore_errors=True)
    options, leak = world.options, leak_table(world.parts)
    captions = {
        plan.name: read_json(unfinished / WORK / f"{plan.name}.json", "record of a video")[
            "captions"
        ]
        for plan in world.plans
    }
    manifest = world.manifest(captions, unfinished)
    files = list_files(world.rows, world.parts, captions)
    files = {"leak.csv": leak.select("id", *LEAK_COLUMNS).write_csv(), **files}
    for name, text in files.items():
        write_text(unfinished / name, text)
    world.split(manifest.digest).save(unfinished / "splits" / "Orig.json")
    manifest.save(unfinished / "manifest.parquet")
    lists = {name: digest_lines(text.splitlines()) for name, text in files.items()}
    record = {
        "format": WORLD_FORMAT,
        "version": VERSION,
        "note": NOTE,
        **({"seen_by_shipped_models": SEEN_WARNING} if options.seed in MINI_SEEDS else {}),
        **({"surfaces": scan_notes(options.scans)} if options.surfaces else {}),
        "digest": digest_json({"options": options.digest, "lists": lists}),
        "options_digest": options.digest,
        "manifest_digest": manifest.digest,
        "counts": {
            "videos": len(world.plans),
            "mixed_videos": sum(len(plan.objects) > 1 for plan in world.plans),
            "objects": len({ref for plan in world.plans for ref in plan.objects}),
            "contacts": len(world.plans) * options.contacts_per_video,
            "contact_frames": len(world),
            "written_frames": len(world.plans) * len(written_frames(options)),
            "train_frames": len(world.parts["train"]),
            "test_frames": len(world.parts["test"]),
        },
        "leak": {"rule": options.leak, **leak_counts(leak)},
        "options": dataclasses.asdict(options),
    }
    write_json(unfinished / "world.json", sealed(record))
