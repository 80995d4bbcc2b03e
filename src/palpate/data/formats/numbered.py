"""What several formats share: folders of numbered pictures, and lists of ``{part: [[folder, name], ..]}`` in JSON.

A picture's number is an integer, so ``frame10.jpg`` comes after ``frame9.jpg``, and ``7.jpg`` and ``0007.jpg`` are one frame.
Nothing is left out in silence: doubled numbers and pictures of another name are handed back to be reported.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core import PARTS, PalpateError, Problem
from palpate.data.images import SUFFIXES
from palpate.data.manifest import CLIMBS

FEW = 3
#: A manifest's frames have 64 bits, so a longer number is none.
DIGITS = 18


@dataclass
class Numbered:
    """The pictures of one folder.

    Attributes:
        files: number -> file name, in the order of the numbers.
        doubled: (name, name that has its number already).
        odd: names of pictures that carry no number in the expected form.
    """

    files: dict[int, str] = field(default_factory=dict)
    doubled: list[tuple[str, str]] = field(default_factory=list)
    odd: list[str] = field(default_factory=list)


def numbered(
    folder: Path, pattern: str = r"([0-9]+)", suffixes: Sequence[str] = SUFFIXES
) -> Numbered:
    """Lists the pictures of a folder by their number; an absent or locked folder has none.

    Args:
        folder: looked at without its subfolders.
        pattern: of the whole stem, with one group: the number, which has 18 digits at most.
        suffixes: of pictures, in lower case; other files are not pictures.
    """
    out = Numbered()
    found: dict[int, str] = {}
    try:
        with os.scandir(folder) as entries:
            names = sorted(e.name for e in entries if not e.name.startswith(".") and not e.is_dir())
    except OSError:
        return out
    for name in names:
        stem, suffix = os.path.splitext(name)  # noqa: PTH122 (a data set has millions of these)
        if suffix.lower() not in suffixes:
            continue
        match = re.fullmatch(pattern, stem)
        if match is None or len(match[1]) > DIGITS:
            out.odd.append(name)
        elif (before := found.setdefault(int(match[1]), name)) != name:
            out.doubled.append((name, before))
    out.files = {k: found[k] for k in sorted(found)}
    return out


def tell(
    found: Numbered,
    where: str,
    problems: list[Problem],
    suspicious: list[Problem],
    *,
    steady: bool = False,
) -> None:
    """Reports doubled numbers one by one, and pictures of another name in one line a folder.

    With ``steady`` also holes in the numbering, unless most numbers are holes: then the set was thinned.
    """
    problems += [
        Problem(f"{where}/{name}", "duplicate-frame", f"{before} has the same number")
        for name, before in found.doubled
    ]
    if found.odd:
        suspicious.append(
            Problem(where, "unknown-name", f"pictures that carry no frame number: {few(found.odd)}")
        )
    if steady and len(found.files) > 1:
        first, *_, last = found.files
        holes = last - first + 1 - len(found.files)
        if 0 < holes < len(found.files):
            lost = few(k for k in range(first, last) if k not in found.files)
            suspicious.append(
                Problem(
                    where,
                    "frame-gap",
                    f"numbers that are missing between {first} and {last}: {lost}",
                )
            )


def subfolders(folder: Path) -> list[str]:
    """Names of the folders in a folder, integers first and by value; hidden ones are left out, an absent or locked folder has none."""
    try:
        with os.scandir(folder) as entries:
            return sorted(
                (e.name for e in entries if e.is_dir() and not e.name.startswith(".")), key=natural
            )
    except OSError:
        return []


def natural(name: str) -> tuple[int, int, str]:
    """Sorts integers by value, before other names."""
    return (0, int(name), name) if re.fullmatch("[0-9]+", name) else (1, 0, name)


def few(names: Iterable[object]) -> str:
    """How many there are, and the first of them: ``"12: a, b, c ..."``, or ``"none"``."""
    every = [str(n) for n in names]
    return (
        f"{len(every)}: {', '.join(every[:FEW])}{' ...' if len(every) > FEW else ''}"
        if every
        else "none"
    )


def require_folder(root: Path, name: str) -> None:
    """Refuses a source that is no folder.

    Raises:
        PalpateError: if it is missing or a file.
    """
    if not root.is_dir():
        got = f"the file {root}" if root.exists() else f"nothing at {root}"
        raise PalpateError(
            f"The source of an import of {name} must be a folder", got, "Check the path"
        )


@dataclass(frozen=True)
class Entry:
    """One pair of a JSON list: where it stands, its part, and its two names."""

    where: str
    part: str
    first: str
    second: str


def read_pairs(path: Path, problems: list[Problem]) -> list[Entry] | None:
    """Reads ``{"train": [[folder, name], ..], "val": .., "test": ..}``; names may be integers.

    Returns:
        The well-formed entries; None if the file is JSON of another shape.
    """
    try:
        data: Any = json.loads(path.read_bytes().decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        problems.append(Problem(str(path), "bad-list", f"not JSON: {error}"))
        return None
    if (
        not isinstance(data, dict)
        or not set(data) & set(PARTS)
        or not all(isinstance(rows, list) for rows in data.values())
    ):
        return None
    entries: list[Entry] = []
    for part, rows in data.items():
        if part not in PARTS:
            problems.append(
                Problem(
                    str(path),
                    "unknown-part",
                    f"the part {part!r} ({len(rows)} entries) is none of {', '.join(PARTS)}",
                )
            )
            continue
        for k, row in enumerate(rows):
            where = f"{path} {part}[{k}]"
            names = (
                [
                    str(n).strip()
                    for n in row
                    if isinstance(n, (str, int)) and not isinstance(n, bool)
                ]
                if isinstance(row, list)
                else []
            )
            if len(names) != 2 or len(row) != 2 or not all(names):
                problems.append(
                    Problem(
                        where,
                        "bad-line",
                        f"{json.dumps(row, ensure_ascii=False)[:80]} is no pair of names",
                    )
                )
            elif any(re.search(CLIMBS, n) or "/" in n or "\\" in n for n in names):
                problems.append(Problem(where, "outside-root", f"{names!r} are no plain names"))
            else:
                entries.append(Entry(where, part, *names))
    return entries


def assign(
    path: Path,
    entries: Sequence[tuple[Entry, Hashable]],
    ids: Mapping[Any, str],
    problems: list[Problem],
) -> dict[str, str]:
    """The part of every listed sample.

    Entries without a sample, doubled ones and samples in two parts are problems; the last are in no part.
    A folder that is not there at all is told once, with its count.

    Args:
        path: the list, for the report.
        entries: with the key of the sample that each names.
        ids: key -> id of every sample on disk, whether usable or not.
        problems: told here.

    Returns:
        id -> part.
    """
    folders = {i.rpartition("/")[0] for i in ids.values()}
    lost: Counter[str] = Counter()
    seen: dict[str, Entry] = {}
    both: set[str] = set()
    for entry, key in entries:
        i = ids.get(key)
        if i is None and isinstance(key, tuple) and key[0] not in folders:
            lost[str(key[0])] += 1
        elif i is None:
            problems.append(
                Problem(
                    entry.where,
                    "missing-file",
                    f"{entry.first}/{entry.second} is listed but not there",
                )
            )
        elif (before := seen.setdefault(i, entry)) is not entry:
            if before.part != entry.part:
                both.add(i)
            kind, text = (
                ("duplicate-row", "listed twice")
                if before.part == entry.part
                else ("two-parts", f"in {before.part}, too")
            )
            problems.append(Problem(entry.where, kind, f"{entry.first}/{entry.second} is {text}"))
    problems += [
        Problem(str(path), "missing-folder", f"no folder {name!r}, of which {n} entries are listed")
        for name, n in lost.items()
    ]
    return {i: entry.part for i, entry in seen.items() if i not in both}
