"""A stage: a folder that is made by a call, kept under the digest of what the call read.

``run/NAME/stage.json`` marks a finished stage and holds its inputs, the digests of the files of
earlier stages that it read, its facts, the digest of its own files, time, date and
versions. A stage is built in ``run/NAME.partial``, with what it reads in ``run/NAME.partial.json``,
and renamed when complete. Running again with the same inputs and the same files of earlier stages
reuses it; with others, or where its own files are no longer those that it wrote, the stage, and so
every stage that read it, is built again. A killed stage finds its partial folder again if the
inputs are the same, and may resume from there. The digest holds an integer version of each stage,
raised by hand where the stage comes to write other bytes, and not the version of palpate: a release
does not build everything again.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from palpate._version import __version__
from palpate.core.files import (
    canonical_json,
    digest_folder,
    digest_json,
    read_json,
    sealed,
    write_json,
)
from palpate.core.messages import PalpateError

FORMAT = "palpate-stage/1"
#: Facts of a stage (JSON) for its record.
Facts = dict[str, Any]
PrintLine = Callable[[str], None]


@dataclass(frozen=True)
class Stage:
    """A finished stage.

    Attributes:
        folder: its files.
        record: its ``stage.json``.
    """

    folder: Path
    record: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """SHA-256 of its name and inputs; it is one of the inputs of later stages."""
        return self.record["digest"]

    @property
    def facts(self) -> Mapping[str, Any]:
        """What its call returned."""
        return self.record["facts"]

    @property
    def outputs(self) -> str:
        """SHA-256 of its files, as they were when it was finished."""
        return self.record["outputs"]

    @property
    def seconds(self) -> float:
        """How long the last call took."""
        return self.record["seconds"]


def run_stage(
    folder: Path,
    inputs: Mapping[str, Any],
    build: Callable[[Path], Mapping[str, Any] | None],
    *,
    version: int = 1,
    read: Mapping[str, str] | None = None,
    print_line: PrintLine = lambda line: None,
) -> Stage:
    """Return the stage of a folder; build it unless it is there for the same inputs.

    Args:
        folder: of the stage in its run folder; its name is the stage's.
        inputs: everything that the stage reads: options, digests of files and earlier stages.
        build: fills the folder that it is called with and returns facts (JSON).
        version: of what the stage does; raised by hand when it comes to write other bytes.
        read: name -> ``outputs`` of the earlier stages that it reads.
        print_line: called with one line when it is begun or reused, and one when it is done.

    Raises:
        PalpateError: if the run folder cannot be used.
    """
    name, read = folder.name, dict(read or {})
    digest = stage_digest(name, inputs, version)
    if (stage := finished_stage(folder, digest, read)) is not None:
        print_line(f"{name}: already done ({stage.seconds:.0f} s then)")
        return stage
    if folder.exists():
        print_line(f"{name}: it or what it reads has changed since it was done")
    print_line(f"{name}: ...")
    record = {"digest": digest, "version": version, "inputs": inputs, "read": read}
    stage = _build(folder, json.loads(canonical_json(record)), build)
    print_line(f"{name}: done in {stage.seconds:.0f} s")
    return stage


def stage_digest(name: str, inputs: Mapping[str, Any], version: int = 1) -> str:
    """Return the SHA-256 that names what a stage reads."""
    return digest_json([FORMAT, version, name, inputs])


def finished_stage(folder: Path, digest: str, read: Mapping[str, str]) -> Stage | None:
    """Return the stage in ``folder`` if it is finished, undamaged and read what ``digest`` and
    ``read`` name.

    The digest does not say which files earlier stages had: one that was made again may have others.
    """
    record = _record(folder / "stage.json")
    same = record.get("digest") == digest and record.get("read") == read
    whole = same and stage_outputs(folder) == record["outputs"]
    return Stage(folder, record) if whole else None


def stored_stage(folder: Path) -> Stage:
    """Return the finished stage in ``folder``, whatever it read.

    Raises:
        PalpateError: if there is none.
    """
    return Stage(folder, read_json(folder / "stage.json", "stage record"))


def record_of(stages: Mapping[str, Stage]) -> dict[str, Any]:
    """The record of a run for its results: every stage, the time, versions and machine."""
    records = {name: stage.record for name, stage in stages.items()}
    last = [*records.values()][-1]
    return {
        "stages": {
            name: {key: record[key] for key in ("digest", "outputs", "seconds", "date")}
            for name, record in records.items()
        },
        "seconds": {"all stages": round(sum(record["seconds"] for record in records.values()))},
        "versions": last["versions"],
        "machine": last["machine"],
    }


def stage_outputs(folder: Path) -> str:
    """Return the digest of a stage's files, without its record."""
    return digest_folder(folder, without="stage.json")


def _build(
    final: Path, record: dict[str, Any], build: Callable[[Path], Mapping[str, Any] | None]
) -> Stage:
    partial = final.with_name(f"{final.name}.partial")
    partial_record = final.with_name(f"{final.name}.partial.json")
    before = _record(partial_record)
    if any(before.get(key) != record[key] for key in ("digest", "read")):
        shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        must = f"The run folder {final.parent} must be writable"
        raise PalpateError(must, str(error), "Choose another folder") from None
    write_json(partial_record, record)
    start = time.monotonic()
    try:
        facts = dict(build(partial) or {})
    except PalpateError:
        if not any(partial.iterdir()):  # no work to resume from
            partial.rmdir()
            partial_record.unlink()
        raise
    record |= {"facts": facts, "outputs": stage_outputs(partial)}
    record["seconds"] = round(time.monotonic() - start, 2)
    record["date"] = datetime.datetime.now(datetime.UTC).date().isoformat()
    record["versions"] = {"palpate": __version__, "python": platform.python_version()}
    for package in ("numpy", "torch", "diffusers", "transformers", "polars", "pillow"):
        with suppress(metadata.PackageNotFoundError):
            record["versions"][package] = metadata.version(package)
    record["machine"] = f"{platform.machine()}, {os.cpu_count()} cores"
    write_json(partial / "stage.json", sealed(record))
    shutil.rmtree(final, ignore_errors=True)
    partial.replace(final)
    partial_record.unlink()
    return Stage(final, record)


def _record(path: Path) -> dict[str, Any]:
    with suppress(PalpateError):  # absent or damaged: the stage is built again
        return read_json(path, "stage record")
    return {}
