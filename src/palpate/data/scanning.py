"""What a data-set format is: facts about it, a way to recognize it, and a scan of its files.

A format is one file with ``FACTS``, ``LOOKS_FOR``, ``detect``, ``scan`` and a ``FORMAT`` that joins
them, named in ``palpate.data.formats.FORMATS``. The scan reads lists and folders and returns every
row with everything that is wrong. An import and a validation share :func:`finished`, so both see
the same problems. A format whose frames must be decoded or written first takes ``into``.
"""

from __future__ import annotations

import inspect
import os
import posixpath
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

from palpate.core import (
    Problem,
    ProblemsError,
    Progress,
    Split,
    few,
    inside,
    quiet,
    read_json,
    require,
)
from palpate.data.images import Check, Checked, check_image, in_threads
from palpate.data.manifest import CLIMBS, FOLLOWED, IMAGE_COLUMNS, SIDES, Manifest
from palpate.data.suspicions import Look, evenly, looks_of, suspicions

#: Manifest column -> cell; ``split`` may hold the part of the data set's own split.
Cells = dict[str, Any]
#: (place, cells): where a row was read, ``file:line`` or a path, and its cells.
Row = tuple[str, Cells]
FIX = "Correct these, or skip the bad rows and list them"
#: Kinds of problems of files that are not there; every other kind means that a file or row is bad.
MISSING = ("missing-", "unpaired")


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What is known of a data set, from its publication and its public files."""

    name: str  # as its authors write it
    citation: str = "unknown"  # of the data; ``"unknown"`` where none is stated
    license: str = "unknown"
    url: str = "unknown"
    sensor: str = "unknown"  # tactile sensor
    #: (width, height) of the tactile images as released, in pixels, or None.
    image_size: tuple[int, int] | None = None
    samples: str  # how many there are, in words and with the source
    group: str  # what a split must keep whole, in words
    #: The manifest column of that group; the default of audits and splits.
    group_column: str = "video"

    def of_manifest(self) -> dict[str, str]:
        """The facts that a manifest keeps."""
        facts = {"dataset": self.name, "license": self.license}
        facts |= {"citation": self.citation, "url": self.url}
        return facts | ({} if self.group_column == "video" else {"group": self.group_column})


#: A tree that ``palpate world`` made, in whichever layout.
WORLD = Facts(
    name="palpate's procedural world (synthetic)",
    citation="none: made by palpate world",
    license="Apache-2.0",
    url="",
    sensor="simulated",
    samples="as world.json says",
    group="video",
)


def world_facts(folder: Path) -> dict[str, str]:
    """Facts of a tree that ``palpate world`` made, else ``{}``; it must not pass for real data.

    The blank entries replace the license, citation and address of the real set.
    """
    path = folder / "world.json"
    world = read_json(path, "world record") if path.is_file() else {}
    if not str(world.get("format", "")).startswith("palpate-world/"):
        return {}
    facts = {"dataset": "palpate's procedural world", "synthetic": "yes"}
    facts |= {"digest": str(world.get("digest", ""))}
    if "seed" in (options := world.get("options", {})):
        facts["world_seed"] = str(options["seed"])
    return facts | dict.fromkeys(("license", "citation", "url"), "")


@dataclass
class Scan:
    """What a source holds."""

    base: Path  # folder that the rows' paths are relative to
    #: Further facts for the manifest (``layout``, ``text_source`` ...).
    facts: dict[str, str] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)  # the readable rows
    #: Everything that makes a row or file unusable.
    problems: list[Problem] = field(default_factory=list)
    #: Usable, but a person should look (swapped folders, unexpected counts ...).
    suspicious: list[Problem] = field(default_factory=list)
    splits: dict[str, Split] = field(default_factory=dict)  # the data set's own splits, by name
    #: What says the split in the rows' cells ``split``: files, a column ...; empty without one.
    split_rule: dict[str, Any] = field(default_factory=dict)
    inconclusive: int = 0  # rows skipped because their label marks the material as unclear
    #: How many images were read as something else than upright 8-bit RGB, by how.
    taken: Counter[str] = field(default_factory=Counter[str])
    looks: dict[str, Look] = field(default_factory=dict)  # recording -> what it looks like
    more: tuple[str, ...] = ()  # columns beyond those of every manifest
    #: Whether the paths were met on the disk and not written by somebody: links are followed.
    met: bool = False

    def problem(self, where: object, kind: str, text: str) -> None:
        """Report something that makes a row or file unusable."""
        self.problems.append(Problem(str(where), kind, text))

    def state_texts(self, source: str) -> None:
        """Say where the texts of the rows are from, if they have any."""
        worded = any(row.get("text") for _, row in self.rows)
        self.facts["text_source"] = source if worded else "none"

    def suspect(
        self, where: object, kind: str, text: str, names: Iterable[object] | None = None
    ) -> None:
        """Report something to look at; with ``names`` only if there are any."""
        names = None if names is None else list(names)
        if names is None or names:
            text = text if names is None else f"{text}: {few(names)}"
            self.suspicious.append(Problem(str(where), kind, text))


@dataclass(frozen=True)
class Into:
    """Where an import writes images that are no files yet."""

    out: Path  # its folder
    created: list[Path]  # every new file is added here
    skip_bad: bool  # skip bad rows instead of raising before images are written


@dataclass(frozen=True)
class Format:
    """One data-set format."""

    facts: Facts  # about the data set; for formats of anyone's data, about the format
    #: Whether a source looks like it; must be quick and must not raise.
    detect: Callable[[Path], bool]
    looks_for: str  # what ``detect`` expects, for the error message
    #: ``scan(source, *, progress, ...) -> Scan``; further keywords are the format's options, or the
    #: second argument is their ``record``. A format that writes images has ``into: Into | None``,
    #: None where nothing is written, and ``check``.
    scan: Callable[..., Scan]
    #: ``write_lists(manifest, split, folder) -> files``: a split in the data set's own form, if it
    #: has one.
    write_lists: Callable[[Manifest, Split, Path], list[Path]] | None = None
    remote: bool = False  # the source may be a name instead of a path on disk
    record: type[Any] | None = None  # the options as one dataclass, where they are many

    @property
    def options(self) -> list[str]:
        """The format's own keywords and the common ones."""
        parameters = inspect.signature(self.scan).parameters.values()
        names = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name != "into"]
        names += [f.name for f in fields(self.record)] if self.record else []
        return list(dict.fromkeys([*names, "skip_bad", "check", "progress"]))

    def read(self, source: Path, values: Mapping[str, Any]) -> Scan:
        """Scan a source with those of the option values that the scan takes."""
        names, records = inspect.signature(self.scan).parameters, list[Any]()
        if self.record is not None:
            own = {f.name for f in fields(self.record)}
            records.append(self.record(**{k: v for k, v in values.items() if k in own}))
        return self.scan(source, *records, **{k: v for k, v in values.items() if k in names})

    @property
    def writes(self) -> bool:
        """Whether an import writes images, and does not point at those of the data set."""
        return "into" in inspect.signature(self.scan).parameters


def manifest_of(scan: Scan, rows: Iterable[Row]) -> Manifest:
    """The manifest of finished rows."""
    return Manifest.from_rows((row for _, row in rows), scan.base.resolve(), scan.facts, scan.more)


def finished(scan: Scan, check: Check, progress: Progress = quiet) -> list[Row]:
    """Rows with paths inside the root, whole images and unique ids; other rows become problems.

    The cells ``split`` of the rows that remain become the split ``Orig``.
    """
    rows = _unique(scan, _checked_images(scan, _checked_paths(scan), check, progress))
    scan.suspicious += suspicions(scan.looks)
    if scan.taken:
        counts = (f"{words} ({count})" for words, count in sorted(scan.taken.items()))
        scan.facts["images"] = ", ".join(counts)
    scan.problems.sort(key=Problem.sort_key)
    return rows


def _checked_paths(scan: Scan) -> list[Row]:
    """Rows whose images exist inside the root and are two, with paths relative to it."""
    root = scan.base.resolve()

    @cache
    def leaves(folder: str) -> bool:
        return inside(root, folder) is None

    @cache
    def files(folder: str) -> set[str]:
        """The files of a folder that are no links; none if it is not there."""
        with suppress(OSError), os.scandir(root / folder) as entries:
            return {entry.name for entry in entries if entry.is_file(follow_symlinks=False)}
        return set()

    @cache
    def checked(written: str) -> tuple[str, str]:
        """(path relative to the root, ""), or (kind of problem, its text)."""
        folder, _, name = written.rpartition("/")
        usual = posixpath.normpath(written) == written and "\\" not in name
        usual &= not written.startswith("/")
        if usual and not leaves(folder) and name in files(folder):
            return written, ""
        path = root / written
        # Paths are slow, so only unusual ones and links are resolved one by one.
        resolved = inside(root, written)
        if resolved is None or leaves(folder):
            if not scan.met or re.search(CLIMBS, written):
                return "outside-root", f"the path {written!r} leaves the root {scan.base}"
            scan.facts["links"] = FOLLOWED
            resolved = path
        try:
            if not path.is_file():
                return "missing-file", f"no file {written!r} in {scan.base}"
        except OSError as error:  # e.g. a name that is too long for the disk
            return "missing-file", f"{written!r} cannot be a file: {error.strerror}"
        return written if usual else resolved.relative_to(root).as_posix(), ""

    good: list[Row] = []
    for where, row in scan.rows:
        results = {c: checked(row[c]) for c in IMAGE_COLUMNS if row.get(c) is not None}
        for column, (path, text) in results.items():
            if text:
                scan.problem(where, path, f"{column}: {text}")
            row[column] = path
        path = row.get("vision")
        if any(text for _, text in results.values()):
            continue
        if path is not None and path == row.get("tactile"):
            scan.problem(where, "same-image", f"{path!r} is both its photo and its tactile image")
        else:
            good.append((where, row))
    return good


def _checked_images(scan: Scan, rows: list[Row], check: Check, progress: Progress) -> list[Row]:
    """Rows whose images are whole; each file is checked and reported once, at its first row."""
    if check == "none":
        return rows
    uses: Counter[str] = Counter()
    first: dict[str, str] = {}
    for where, row in rows:
        for path in filter(None, map(row.get, IMAGE_COLUMNS)):
            uses[path] += 1
            first.setdefault(path, where)
    bad: set[str] = set()
    recordings = evenly(row for _, row in rows)
    some = {row.get(side) for own in recordings.values() for row in own for side in SIDES}
    usable: dict[str, Checked] = {}
    looked_at = lambda path: check_image(scan.base / path, check)
    for path, checked in in_threads(looked_at, first, "checking images", progress):
        scan.taken.update(checked.taken)
        if checked.problem:
            bad.add(path)
            users = f" (used by {uses[path]} rows)" if uses[path] > 1 else ""
            name = "" if first[path] == path else f"{path}: "
            scan.problem(first[path], "bad-image", f"{name}{checked.problem}{users}")
        elif path in some and check == "decode":
            usable[path] = checked
    scan.looks |= looks_of(recordings, scan.base, usable)
    return [row for row in rows if bad.isdisjoint(map(row[1].get, IMAGE_COLUMNS))]


def _unique(scan: Scan, rows: list[Row]) -> list[Row]:
    """Rows with unique ids; the first row keeps an id, and an id in two parts is in neither.

    A missing id is made of video and frame, else of the path of the tactile or vision image.
    """
    seen: dict[str, tuple[str, str | None, Cells]] = {}
    in_two: set[str] = set()
    good: list[Row] = []
    for where, row in rows:
        part, hint = row.pop("split", None), ""
        if row.get("id") is None:
            row["id"], made_of = _default_id(where, row)
            hint = f", made of {made_of} since there is none: map a column to id"
        i = row["id"]
        if i not in seen:
            seen[i] = where, part, row
            good.append((where, row))
            continue
        before, other, first = seen[i]
        if part and other and part != other:
            in_two.add(i)
            text = f"{i} is in {part} here and in {other} at {before}, so in no part"
            scan.problem(where, "two-parts", text)
        else:
            hint = _difference(first, row) or hint
            scan.problem(where, "duplicate-id", f"the id {i!r} is at {before} already{hint}")
    parts = {i: part for i, (_, part, _) in seen.items() if part and i not in in_two}
    if scan.split_rule and parts:
        scan.splits["Orig"] = Split(parts, {"method": "official", **scan.split_rule})
    return good


def _difference(first: Cells, row: Cells) -> str:
    """In what rows of the same images differ, in words; empty for those of others."""
    if any(first.get(column) != row.get(column) for column in SIDES):
        return ""
    differing = [name for name in {**first, **row} if first.get(name) != row.get(name)]
    cells = (f"{name} ({row.get(name)!r} here, {first.get(name)!r} there)" for name in differing)
    other = f" and another {few(cells)}" if differing else ""
    return f", with the same images{other}: keep the row that is right"


def _default_id(where: str, row: Cells) -> tuple[str, str]:
    """The id of a row that has none, and what it is made of."""
    if row.get("video") is not None and row.get("frame") is not None:
        return f"{row['video']}/{row['frame']}", "video and frame"
    path = Path(row.get("tactile") or row.get("vision") or where)
    return path.with_suffix("").as_posix(), "the path"


def raise_if(problems: Sequence[Problem], skip_bad: bool) -> None:
    """Raise all problems at once unless they are to be skipped."""
    if not problems or skip_bad:
        return
    if any("leaves the root" in problem.text for problem in problems):
        fix = "Name the folder that the paths start in, or skip the bad rows"
        raise ProblemsError(problems, fix, example={"root": "FOLDER"})
    raise ProblemsError(problems, FIX, example={"skip_bad": True})


def require_some(samples: int, source: object, skipped: Sequence[Problem]) -> None:
    """Reject an import without samples."""
    if samples == 0 and skipped:
        raise ProblemsError(skipped, "No sample is left without these: correct the data set")
    must = f"{source} must hold at least one usable sample"
    require(samples != 0, None, must, "none", fix="Check the labels and the folder")
