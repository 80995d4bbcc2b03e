"""Slices: whole recordings of a data set that one process works on alone.

Slice i/n holds the recordings whose SHA-256, as a number, is i - 1 modulo n. So every process finds
the same slices without asking another, and an added recording changes its own slice alone. What a
slice makes has a folder, with a record that is written last and says what was read::

    OUT/part-3-of-16/part.json   {"format", "slice", "command", "settings", "read", "data", "rows",
                                  "notes", "facts", "files", "sealed"}
    OUT/part-3-of-16/...

A part whose ``read`` is what its slice would read now is finished, and never made again. Parts are
read together if all are there and were made of one state of the data (``data``).
"""

from __future__ import annotations

import hashlib
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import (
    PalpateError,
    digest_file,
    few,
    plain,
    read_record,
    reading_entry,
    require,
    sealed,
    write_json,
)
from palpate.core.records import from_plain
from palpate.data.manifest import Manifest

FORMAT, RECORD = "palpate-part/1", "part.json"
_NAME = re.compile(r"part-(\d+)-of-(\d+)")


@dataclass(frozen=True)
class Slice:
    """Slice ``number`` (from 1) of ``of``."""

    number: int = 1
    of: int = 1

    @classmethod
    def parse(cls, text: str | Slice | None) -> Slice:
        """``"3/16"``, a slice, or None for all.

        Raises:
            PalpateError: on another form, or a number beyond that of slices.
        """
        if text is None or isinstance(text, Slice):
            return text or cls()
        number, _, of = text.partition("/")
        whole = number.isdecimal() and of.isdecimal()
        holds = whole and 1 <= int(number) <= int(of)
        require(holds, "slice", "must be i/n, with i from 1 to n", text, "1/4")
        return cls(int(number), int(of))

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"part-{self.number}-of-{self.of}"

    def numbers(self, recordings: Sequence[str]) -> dict[str, int]:
        """The slice of each recording, from 1."""
        digests = {name: hashlib.sha256(name.encode()).digest() for name in recordings}
        return {name: int.from_bytes(d[:8], "big") % self.of + 1 for name, d in digests.items()}

    def rows(self, manifest: Manifest, by: str = "video") -> list[int]:
        """The rows of the slice; ``by`` is the column of recordings, ids where it is null."""
        return (self._of(manifest, by) == self.number).arg_true().to_list()

    def take(self, manifest: Manifest, by: str = "video") -> Manifest:
        """The samples of the slice, as :meth:`rows`."""
        return replace(manifest, table=manifest.table[self.rows(manifest, by)])

    def spread(self, manifest: Manifest, by: str = "video") -> str:
        """How many samples the smallest and the largest slice have, in words."""
        counts = Counter(self._of(manifest, by).to_list())
        least, most = (bound(counts[k + 1] for k in range(self.of)) for bound in (min, max))
        return f"{least:,} to {most:,} samples a slice"

    def _of(self, manifest: Manifest, by: str) -> pl.Series:
        names = manifest.table.select(pl.coalesce(by, "id")).to_series()
        numbers = self.numbers(names.unique().to_list())
        return names.replace_strict(numbers, return_dtype=pl.Int64)


@dataclass(frozen=True, kw_only=True)
class Part:
    """The record of a part.

    Attributes:
        slice: ``i/n``.
        command: that makes it, but for its slice.
        settings: what all parts of a folder share.
        read: digest of what the slice read.
        data: digest of all that the slices read together.
        rows: samples of the slice.
        notes: what a reader must know: code and parameters of each.
        facts: what else the parts say.
        files: digest of each file beside the record.
        format: of the record.
    """

    slice: str
    command: str
    settings: Mapping[str, Any]
    read: str
    data: str
    rows: int = 0
    notes: Sequence[Mapping[str, Any]] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    format: str = FORMAT

    @property
    def place(self) -> str:
        """Name of its folder."""
        return Slice.parse(self.slice).name

    def is_finished(self, folder: Path) -> bool:
        """Whether this part is in ``folder``, made of the same.

        Raises:
            PalpateError: if the folder holds other files, or parts of another number of slices or
                with other settings.
        """
        others = {p for p in folder.iterdir() if p.name[0] != "."} if folder.is_dir() else set()
        foreign = [p.name for p in others if not _NAME.fullmatch(p.name) and p.name not in KEPT]
        must, fix = f"{folder} must hold parts alone", "Choose another folder"
        require(not foreign, None, must, few(sorted(foreign)), fix=fix)
        parts = parts_in(folder)
        _require_alike(folder, [*parts, self])
        mine = next((p for p in parts if p.slice == self.slice), None)
        if mine is None or mine.read != self.read or mine.damaged(folder):
            return False
        if mine.data != self.data:  # other slices have changed
            replace(mine, data=self.data).save(folder / self.place)
        return True

    def damaged(self, folder: Path) -> list[str]:
        """Files in ``folder`` that are not those that were written, by name."""
        there = digests_below(folder / self.place).items() ^ self.files.items()
        return sorted({f"{self.place}/{name}" for name, _ in there})

    def save(self, place: Path) -> None:
        """Write the record: the part is finished."""
        write_json(place / RECORD, sealed(plain(replace(self, files=digests_below(place)))))


def digests_below(place: Path) -> dict[str, str]:
    """SHA-256 of each file of a part but its record, by path in it."""
    files = [p for p in sorted(place.rglob("*")) if p.is_file() and p != place / RECORD]
    return {p.relative_to(place).as_posix(): digest_file(p) for p in files}


#: What else may lie next to parts.
KEPT = ("medians", "logs")


def command_of(verb: str, *words: object, **options: object) -> str:
    """A command line, with those options that are given."""
    line = ["palpate", *verb.split(), *map(str, words)]
    for name, value in options.items():
        if value is not None and value is not False:
            values = () if value is True else value if isinstance(value, tuple) else (value,)
            line += [f"--{name.replace('_', '-')}", *map(str, values)]
    return shlex.join(line)


def parts_in(folder: Path) -> list[Part]:
    """The records of the finished parts of a folder, by number."""
    places = [p for p in folder.iterdir() if _NAME.fullmatch(p.name)] if folder.is_dir() else []
    parts: list[Part] = []
    for record in (place / RECORD for place in places):
        if record.is_file():
            content = read_record(record, "record of a part", form=FORMAT)
            with reading_entry(record, "The record"):
                parts.append(from_plain(Part, content))
    return sorted(parts, key=lambda part: Slice.parse(part.slice).number)


def whole_parts(folder: Path) -> list[Part]:
    """The parts of a folder, all of them.

    Raises:
        PalpateError: naming one that is missing or was made of other data, with the command that
            makes it; or if they do not belong together.
    """
    parts = parts_in(folder)
    _require_alike(folder, parts)
    first, there = parts[0], {part.slice for part in parts}
    of = Slice.parse(first.slice).of
    missing = [name for k in range(of) if (name := f"{k + 1}/{of}") not in there]
    current = Counter(part.data for part in parts).most_common(1)[0][0]
    stale = [part.slice for part in parts if part.data != current]
    damaged = {part.slice: names for part in parts if (names := part.damaged(folder))}
    files = few([name for names in damaged.values() for name in names])
    for names, got in (
        (missing, "without"),
        (stale, "where other data were read for"),
        (list(damaged), f"with a damaged {files} of"),
    ):
        must = f"All {of} parts of {folder} must be there, made of the same data"
        got = f"a folder {got} {few(names)}"
        fix = f"Run: {first.command} --slice {names[0] if names else ''}"
        require(not names, None, must, got, fix=fix)
    return parts


def is_parted(folder: Path) -> bool:
    """Whether a folder holds parts."""
    return folder.is_dir() and any(_NAME.fullmatch(p.name) for p in folder.iterdir())


def _require_alike(folder: Path, parts: Sequence[Part]) -> None:
    """Raise unless parts are of one number of slices, with the same settings."""
    if not parts:
        raise PalpateError(
            f"{folder} must hold finished parts", "none", "Run the slices that make them"
        )
    first, fix = parts[0], "Choose another folder, or remove the parts"
    for part in parts[1:]:
        must = f"The parts of {folder} must be of one number of slices"
        same = Slice.parse(part.slice).of == Slice.parse(first.slice).of
        require(same, None, must, f"{first.slice} and {part.slice}", fix=fix)
        a, b = dict(first.settings), dict(part.settings)
        differ = [name for name in {**a, **b} if a.get(name) != b.get(name)]
        must = f"The parts of {folder} must be made with the same settings"
        got = f"another {few(differ)} for {part.slice} than for {first.slice}"
        require(not differ, None, must, got, fix=fix)
