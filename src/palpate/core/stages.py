"""Run folders: a pipeline as named stages, each kept under the digest of what it read.

``run/NAME/stage.json`` marks a finished stage and holds its inputs, facts and time. A stage is built in
``run/NAME.partial`` and renamed when whole, so whatever bears its name is complete. Running again with the
same inputs uses what is there; with other inputs the stage, and so every stage that read it, is built anew.
A killed stage finds its own partial folder again, if the inputs are the same, and may go on from there.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate import __version__
from palpate.core.digest import canonical_json, digest_json
from palpate.core.errors import PalpateError
from palpate.core.files import read_json, write_json

#: Part of every stage's digest, as is the version of palpate: other code may write other bytes from the same inputs.
FORMAT = "palpate-stage/1"


@dataclass(frozen=True)
class Stage:
    """A finished stage.

    Attributes:
        folder: its files.
        digest: of its name and inputs; downstream stages put it among theirs.
        facts: what the builder returned.
        seconds: how long the last, finishing call of the builder took.
        reused: True if it was there already.
    """

    folder: Path
    digest: str
    facts: Mapping[str, Any]
    seconds: float
    reused: bool


@dataclass
class Run:
    """A run folder.

    Attributes:
        folder: where the stages lie; made if absent.
        say: called with one line for each stage begun or reused.
        stages: the finished stages of this run by name, in order.
    """

    folder: Path
    say: Callable[[str], None] = lambda line: None
    stages: dict[str, Stage] = field(default_factory=dict[str, Stage])

    def stage(
        self,
        name: str,
        inputs: Mapping[str, Any],
        build: Callable[[Path], Mapping[str, Any] | None],
    ) -> Stage:
        """Returns the stage, building it unless it is there for the same inputs.

        Args:
            name: folder name, unique in the run.
            inputs: everything that the stage reads: options, digests of files, digests of earlier stages.
            build: fills the folder it is given and returns facts (JSON) for ``stage.json``.

        Raises:
            PalpateError: if the run folder cannot be used.
        """
        digest = digest_json([FORMAT, __version__, name, inputs])
        final, part = self.folder / name, self.folder / f"{name}.partial"
        mark = final / "stage.json"
        if mark.is_file() and (done := read_json(mark, "stage record")).get("digest") == digest:
            self.say(f"{name}: already done ({done['seconds']:.0f} s then)")
            stage = Stage(final, digest, done["facts"], done["seconds"], reused=True)
        else:
            begun = part / "inputs.json"
            if part.exists() and (
                not begun.is_file() or read_json(begun, "stage record").get("digest") != digest
            ):
                shutil.rmtree(part)
            try:
                part.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise PalpateError(
                    f"The run folder {self.folder} must be writable",
                    str(error),
                    "Choose another folder with --out",
                ) from None
            if not begun.is_file():
                write_json(begun, {"digest": digest, "inputs": json.loads(canonical_json(inputs))})
            self.say(f"{name}: ...")
            start = time.monotonic()
            try:
                facts = dict(build(part) or {})
            except (
                PalpateError
            ):  # a refused input leaves nothing behind, unless there is work to go on from
                if [p.name for p in part.iterdir()] == [begun.name]:
                    shutil.rmtree(part)
                raise
            seconds = time.monotonic() - start
            write_json(
                part / "stage.json",
                {**read_json(begun, "stage record"), "facts": facts, "seconds": round(seconds, 2)},
            )
            begun.unlink()
            shutil.rmtree(final, ignore_errors=True)
            part.replace(final)
            self.say(f"{name}: done in {seconds:.0f} s")
            stage = Stage(final, digest, facts, seconds, reused=False)
        self.stages[name] = stage
        return stage
