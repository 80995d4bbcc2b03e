"""Writes a world as a tree in the layout of Touch and Go or of HCT, or as arrays.

::

    world.json                          options, VERSION, counts, the known leak, digest; the mark of a finished world
    manifest.parquet  splits/Orig.json  the world's own table and cut
    leak.csv                            what each test sample shares with train, exactly
    label.txt  category_reference.txt  train.txt  test.txt  captions.csv  objects.csv      (layout="frames", "videos")
    dataset/<video>/video_frame/0000000012.jpg      photo        (layout="frames")
    dataset/<video>/gelsight_frame/0000000012.jpg   touch
    dataset/<video>/video.mp4  gelsight.mp4         (layout="videos")
    hct/data1/ ...                                  (layout="hct", see palpate.sim.lists_hct and palpate.sim.naming)
    vision.npy  tactile.npy  background.npy  ids.txt             (layout="raw", see palpate.sim.raw)

The tree grows in the hidden sibling ``.<name>.<digest>.part``, one finished video after another, and is renamed when whole; one run at a time. A run that was
killed, or stopped by a full disk, is continued by the same call; the result is the same as without the interruption.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import (
    PalpateError,
    Progress,
    digest_json,
    digest_lines,
    quiet,
    read_json,
    write_json,
    write_text,
)
from palpate.sim.encode import require_av
from palpate.sim.lists import cut, leak_counts, leak_file, list_files
from palpate.sim.lists_hct import hct_list_files
from palpate.sim.materials.entries import added_materials
from palpate.sim.naming import contact_rows, manifest_root
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import VideoPlan, plan_world, written_frames
from palpate.sim.presets import SEEN, seen_by_mini
from palpate.sim.ranges import is_number, shown
from palpate.sim.raw import ARRAYS, allocate_arrays
from palpate.sim.saved import WORLD_FORMAT, require_version
from palpate.sim.table import world_manifest, world_split
from palpate.sim.trees import WORK, captions_path, disk_error, is_written, place, write_video
from palpate.sim.unfinished import locked, part_of, real_folder, require_free, require_same_version
from palpate.sim.workers import render_all

NOTE = "Synthetic: procedural surfaces and a simulated sensor. Shows mechanisms; never compare its numbers with those of real data sets."


@dataclass(frozen=True)
class WorldRecord:
    """A finished world.

    Attributes:
        folder: the tree.
        digest: SHA-256 over options, VERSION and lists.
        counts: videos, mixed_videos, objects, touches, contact_frames, written_frames, train_frames, test_frames.
        leak: the rule of the cut, and what train and test share, see :func:`palpate.sim.lists.leak_counts`.
        rendered: videos that this call rendered; the others were there already.
    """

    folder: Path
    digest: str
    counts: dict[str, int]
    leak: dict[str, Any]
    rendered: int


def write_world(
    out: Path, options: WorldOptions | None = None, *, workers: int = 1, progress: Progress = quiet
) -> WorldRecord:
    """Writes a world, or goes on with one that was interrupted.

    Args:
        out: the folder to make; absent, empty, or the same world (then nothing is done).
        options: what to make, default ``WorldOptions()``.
        workers: processes; the bytes do not depend on it.
        progress: told after each video.

    Raises:
        PalpateError: if ``out`` holds something else, is the working folder, is being written by another run, or holds a world of another version, a material draws something invalid, the world is too small
            for its cut, or the disk is full; what was finished by then is kept, and the same call goes on.
        MissingExtraError: if videos are asked for and PyAV is not installed.
    """
    options, out = options or WorldOptions(), Path(out)
    if not is_number(workers, whole=True) or workers < 1:
        raise PalpateError(
            "workers must be a whole number, at least 1", shown(workers), "Pass workers=1"
        )
    if options.layout == "videos":
        require_av()
    folder = real_folder(out)
    if (folder / "world.json").is_file():
        return _finished(out, options)
    require_free(out, folder)
    plans = plan_world(options)
    cut(
        options, plans, list(contact_rows(options, plans))
    )  # refuses a world that is too small before anything is rendered
    part = part_of(folder, options)
    require_same_version(part)
    try:
        with locked(part, out):
            if (folder / "world.json").is_file():  # an equal run ended meanwhile
                shutil.rmtree(part, ignore_errors=True)
                return _finished(out, options)
            rendered = _write(part, folder, options, plans, workers, progress)
        return dataclasses.replace(_finished(out, options), rendered=rendered)
    except OSError as error:
        raise disk_error(error, folder.parent) from error


def _write(
    part: Path,
    folder: Path,
    options: WorldOptions,
    plans: list[VideoPlan],
    workers: int,
    progress: Progress,
) -> int:
    """Fills ``part`` and renames it to ``folder``; returns how many videos were rendered."""
    todo: list[VideoPlan] = []
    if not (part / "world.json").is_file():
        state = {"version": VERSION, "options_digest": options.digest, **_materials(options)}
        write_json(part / WORK / "state.json", state)
        if options.layout == "raw":
            allocate_arrays(
                part, options, len(plans) * options.touches_per_video * options.frames_per_touch
            )
        todo = [plan for plan in plans if not is_written(options, part, plan)]
        progress("rendering videos", len(plans) - len(todo), len(plans))
        job = partial(write_video, options, part)
        for count, name in enumerate(render_all(job, todo, workers), len(plans) - len(todo) + 1):
            progress("rendering videos", count, len(plans), name)
        _finish(part, options, plans)
    shutil.rmtree(part / WORK, ignore_errors=True)
    if folder.exists():
        folder.rmdir()
    part.replace(folder)
    return len(todo)


def _materials(options: WorldOptions) -> dict[str, Any]:
    """What the record tells of materials that were added; nothing in a world of built-in ones."""
    added = added_materials(options.names)
    return {"materials": added} if added else {}


def _finished(out: Path, options: WorldOptions) -> WorldRecord:
    """The record of the finished world in ``out``.

    Raises:
        PalpateError: if it is of another version or format, of other options, or of added materials whose functions were edited since.
    """
    data = read_json(out / "world.json", "world record")
    if not isinstance(data, dict) or not str(data.get("format", "")).startswith("palpate-world/"):
        raise PalpateError(
            f"{out} must hold a world", "another world.json", "Choose another folder or remove it"
        )
    require_version(data, f"The world in {out}")
    if data["format"] != WORLD_FORMAT:
        raise PalpateError(
            f"{out} must hold a world of the format {WORLD_FORMAT}",
            repr(data["format"]),
            "Choose another folder or remove it",
        )
    if data.get("options_digest") != options.digest:
        must = f"{out} must hold the world that was asked for"
        raise PalpateError(must, "a world of other options", "Choose another folder or remove it")
    if data.get("materials", {}) != _materials(options).get("materials", {}):
        must = f"{out} must hold the world that was asked for"
        raise PalpateError(
            must,
            "a world of materials that were edited since",
            "Choose another folder or remove it",
        )
    return WorldRecord(out, data["digest"], data["counts"], data["leak"], 0)


def _finish(part: Path, options: WorldOptions, plans: list[VideoPlan]) -> None:
    """Writes the lists and, last, ``world.json``."""
    if options.layout != "raw":
        for folder in {place(options, part, plan).parent for plan in plans}:
            for stray in folder.glob(".*"):  # left by a killed process
                shutil.rmtree(stray, ignore_errors=True)
    captions = {
        plan.name: read_json(captions_path(part, plan), "captions of a video") for plan in plans
    }
    rows = list(contact_rows(options, plans))
    train, test = cut(options, plans, rows)
    manifest = world_manifest(options, plans, captions, part)
    files = {"leak.csv": leak_file(options, train, test)}
    if options.layout == "hct":
        own = hct_list_files(options, plans, train, test, captions)
        files |= {f"hct/{name}": text for name, text in own.items()}
    elif options.layout == "raw":
        files["ids.txt"] = "".join(f"{name}\n" for name in manifest.ids)
    else:
        files |= list_files(rows, train, test, captions)
    for name, text in files.items():
        write_text(part / name, text)
    world_split(options, train, test, manifest.digest).save(part / "splits" / "Orig.json")
    manifest.save(part / "manifest.parquet")
    settings = dataclasses.asdict(options)
    lists = {name: digest_lines(text.splitlines()) for name, text in files.items()}
    arrays = {
        name: {
            "file": f"{name}.npy",
            "dtype": "uint8",
            "shape": [len(rows), options.size, options.size, 3],
        }
        for name in ARRAYS
    }
    write_json(
        part / "world.json",
        {
            "format": WORLD_FORMAT,
            "version": VERSION,
            "note": NOTE,
            **({"seen_by_shipped_models": SEEN} if seen_by_mini(options) else {}),
            "digest": digest_json(
                {"version": VERSION, "options": settings, "lists": lists, **_materials(options)}
            ),
            "options_digest": options.digest,
            "manifest_digest": manifest.digest,
            "manifest_root": manifest_root(options, Path()).as_posix(),
            "counts": _counts(options, plans, len(rows), len(test)),
            "leak": {"rule": options.leak, **leak_counts(train, test)},
            **({"arrays": arrays} if options.layout == "raw" else {}),
            "options": settings,
            **_materials(options),
        },
    )


def _counts(
    options: WorldOptions, plans: Sequence[VideoPlan], contact: int, test: int
) -> dict[str, int]:
    written = contact if options.layout == "raw" else len(plans) * len(written_frames(options))
    return {
        "videos": len(plans),
        "mixed_videos": sum(len(plan.objects) > 1 for plan in plans),
        "objects": len({ref for plan in plans for ref in plan.objects}),
        "touches": len(plans) * options.touches_per_video,
        "contact_frames": contact,
        "written_frames": written,
        "train_frames": contact - test,
        "test_frames": test,
    }
