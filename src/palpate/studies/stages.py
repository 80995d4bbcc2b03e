"""Run folders: a pipeline as named stages, each kept under the digest of what it read.

``run/NAME/stage.json`` marks a finished stage and holds its inputs, the digests of the files of
earlier stages that it read, its facts, the digest of its own files, time, date and
versions. A stage is built in ``run/NAME.partial``, with what it reads in ``run/NAME.partial.json``,
and renamed when complete. Running again with the same inputs and the same files of earlier stages
reuses it; with others the stage, and so every stage that read it, is built again. A killed
stage finds its partial folder again if the inputs are the same, and may resume from there. The
digest holds an integer version of each stage, raised by hand where the stage comes to write other
bytes, and not the version of palpate: a release does not build everything again.
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
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from palpate._version import __version__
from palpate.core.digest import canonical_json, digest_folder, digest_json
from palpate.core.errors import PalpateError
from palpate.core.files import read_json, write_json

FORMAT = "palpate-stage/1"


@dataclass(frozen=True)
class Stage:
    """A finished stage.

    Attributes:
        folder: its files.
        digest: SHA-256 of its name and inputs; it is one of the inputs of later stages.
        facts: what the builder returned.
        outputs: SHA-256 of its files.
        seconds: how long the last call of the builder took.
        made_with: versions of packages, and the machine.
    """

    folder: Path
    digest: str
    facts: Mapping[str, Any]
    outputs: str
    seconds: float
    made_with: Mapping[str, Any]


@dataclass
class Run:
    """A run folder.

    Attributes:
        folder: where the stages lie; made if absent.
        print_line: called with one line for each stage begun or reused.
        stages: the finished stages of this run by name, in order.
    """

    folder: Path
    print_line: Callable[[str], None] = lambda line: None
    stages: dict[str, Stage] = field(default_factory=dict[str, Stage])

    def stage(
        self,
        name: str,
        inputs: Mapping[str, Any],
        build: Callable[[Path], Mapping[str, Any] | None],
        *,
        version: int = 1,
        read: Mapping[str, str] | None = None,
    ) -> Stage:
        """Return the stage; build it unless it exists for the same inputs.

        Args:
            name: folder name, unique in the run.
            inputs: everything that the stage reads: options, digests of files and earlier stages.
            build: fills the folder it is given and returns facts (JSON) for ``stage.json``.
            version: of what the stage does; raised by hand when it comes to write other bytes.
            read: name -> ``outputs`` of the earlier stages that it reads.

        Raises:
            PalpateError: if the run folder cannot be used.
        """
        digest, read = stage_digest(name, inputs, version), read or {}
        stage = finished_stage(self.folder / name, digest, read)
        if stage is not None:
            self.print_line(f"{name}: already done ({stage.seconds:.0f} s then)")
        else:
            self.print_line(f"{name}: ...")
            known = {"digest": digest, "version": version, "inputs": inputs, "read": read}
            stage = _build(self.folder / name, known, build)
            self.print_line(f"{name}: done in {stage.seconds:.0f} s")
        self.stages[name] = stage
        return stage


def stage_digest(name: str, inputs: Mapping[str, Any], version: int = 1) -> str:
    """Return the SHA-256 that names what a stage reads."""
    return digest_json([FORMAT, version, name, inputs])


def finished_stage(folder: Path, digest: str, read: Mapping[str, str]) -> Stage | None:
    """Return the stage in ``folder`` if it is finished and read what ``digest`` and ``read`` name.

    The digest does not say which files earlier stages had: one that was made again may have others.
    """
    record = _record(folder / "stage.json")
    same = record.get("digest") == digest and record.get("read") == read
    return stage_of(folder, record) if same else None


def _build(
    final: Path, known: Mapping[str, Any], build: Callable[[Path], Mapping[str, Any] | None]
) -> Stage:
    partial = final.with_name(f"{final.name}.partial")
    partial_record = final.with_name(f"{final.name}.partial.json")
    before = _record(partial_record)
    if any(before.get(key) != known[key] for key in ("digest", "read")):
        shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        must = f"The run folder {final.parent} must be writable"
        raise PalpateError(must, str(error), "Choose another folder") from None
    record = json.loads(canonical_json(known))
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
    record |= _made_with()
    write_json(partial / "stage.json", record)
    shutil.rmtree(final, ignore_errors=True)
    partial.replace(final)
    partial_record.unlink()
    return stage_of(final, record)


def stage_outputs(folder: Path) -> str:
    """Return the digest of a stage's files, without its record."""
    return digest_folder(folder, without="stage.json")


def stage_of(folder: Path, record: Mapping[str, Any]) -> Stage:
    """Return the finished stage in a folder that has this record."""
    digest, facts, outputs = record["digest"], record["facts"], record["outputs"]
    made_with = {key: record[key] for key in ("versions", "machine") if key in record}
    return Stage(folder, digest, facts, outputs, record["seconds"], made_with)


def _made_with() -> dict[str, Any]:
    """Versions of what is installed, and the machine."""
    versions = {"palpate": __version__, "python": platform.python_version()}
    for package in ("numpy", "torch", "diffusers", "transformers", "polars", "pillow"):
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return {"versions": versions, "machine": f"{platform.machine()}, {os.cpu_count()} cores"}


def _record(path: Path) -> dict[str, Any]:
    return read_json(path, "stage record") if path.is_file() else {}
