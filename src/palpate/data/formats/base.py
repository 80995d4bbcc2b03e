"""What a data-set format is: facts about the data set, a way to recognize it, and a scan of what lies on disk.

A format is one file with ``FACTS``, ``detect`` and ``scan``, and one row in ``palpate.data.formats.FORMATS``. The scan reads
lists and folders and returns every row with everything that is wrong; :func:`import_scanned` makes a manifest of it
and :func:`validation` a report, so both see the same problems. A format whose frames must be decoded first (Touch and Go)
brings its own ``run``.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core import Problem, Progress, Split, inside, quiet, read_json
from palpate.data.images import Check, check_image, in_threads
from palpate.data.imported import Imported, raise_if, removing_on_error, require_some
from palpate.data.manifest import IMAGE_COLUMNS, Manifest

#: (place, manifest row): where a row was found, ``file:line`` or a path, and its cells by manifest column.
Found = tuple[str, dict[str, Any]]
#: Kinds of problems that say that something is not there; every other kind says that something is wrong.
MISSING = ("missing-", "unpaired")


@dataclass(frozen=True)
class Facts:
    """What is known of a data set, from its publication and its public files.

    Attributes:
        name: as its authors write it.
        citation, license, url: of the data; ``"unknown"`` where none is stated.
        sensor: tactile sensor.
        image_size: (width, height) of the tactile images as released, in pixels, or None.
        samples: how many there are, in words and with the source.
        group: what a split must keep whole, in words.
        group_column: the manifest column that says it; audits and splits take it by themselves.
        normalization: name -> (mean, std) of RGB in [0, 1] with what it is for; valid for the crop that the name says, no other.
    """

    name: str
    citation: str
    license: str
    url: str
    sensor: str
    image_size: tuple[int, int] | None
    samples: str
    group: str
    normalization: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = (
        field(default_factory=dict)
    )
    group_column: str = "video"

    def of_manifest(self) -> dict[str, str]:
        """The facts that a manifest keeps."""
        about = {
            "dataset": self.name,
            "license": self.license,
            "citation": self.citation,
            "url": self.url,
        }
        return about | ({} if self.group_column == "video" else {"group": self.group_column})


#: palpate's own world, in whichever layout.
WORLD = Facts(
    name="palpate's procedural world (synthetic)",
    citation="none: made by palpate world",
    license="Apache-2.0",
    url="",
    sensor="simulated",
    image_size=None,
    samples="as world.json says",
    group="video",
)


def world_facts(folder: Path) -> dict[str, str]:
    """What a tree of palpate's own world says of itself, ``{}`` for any other folder: it must never pass for the real set.

    The blank entries take the place of the real set's license, citation and address.
    """
    mark, up = folder / "world.json", folder.parent / "world.json"  # HCT's rigs lie one folder down
    about = (
        read_json(mark, "world record")
        if mark.is_file()
        else (read_json(up, "world record") if up.is_file() else {})
    )
    if not isinstance(about, dict) or not str(about.get("format", "")).startswith("palpate-world/"):
        return {}
    named = {
        "dataset": "palpate's procedural world",
        "synthetic": "yes",
        "digest": str(about.get("digest", "")),
    }
    options = about.get("options")
    named |= (
        {"world_seed": str(options["seed"])}
        if isinstance(options, dict) and "seed" in options
        else {}
    )
    return named | dict.fromkeys(("license", "citation", "url"), "")


@dataclass
class Scan:
    """What lies in a source.

    Attributes:
        rows: the readable rows.
        base: folder that their paths are relative to.
        problems: everything that makes a row or file unusable.
        suspicious: what looks wrong but can be used (swapped folders, counts that differ from the published ones ...).
        facts: further facts for the manifest (``layout``, ``text_source`` ...).
        parts: the data set's own splits: name -> id -> part.
        own: name of the split that the rows' cell ``split`` tells, or empty; :func:`finished` makes it of the rows that stay.
        rules: how each of the splits was found, for the split file.
        inconclusive: rows left out because their label says that the material is unclear.
    """

    rows: list[Found]
    base: Path
    problems: list[Problem] = field(default_factory=list)
    suspicious: list[Problem] = field(default_factory=list)
    facts: dict[str, str] = field(default_factory=dict)
    parts: dict[str, dict[str, str]] = field(default_factory=dict)
    own: str = ""
    rules: dict[str, dict[str, Any]] = field(default_factory=dict)
    inconclusive: int = 0


@dataclass(frozen=True)
class Validation:
    """A data set looked over without importing it.

    Attributes:
        format: the format's name.
        facts: about the data set.
        samples: usable rows.
        missing: listed but not there, or there without a partner.
        invalid: there but unusable.
        suspicious: usable, but a person should look.
    """

    format: str
    facts: Facts
    samples: int
    missing: Sequence[Problem]
    invalid: Sequence[Problem]
    suspicious: Sequence[Problem]

    @property
    def ok(self) -> bool:
        """Whether nothing is missing or invalid."""
        return not self.missing and not self.invalid


@dataclass(frozen=True)
class Format:
    """One data-set format.

    Attributes:
        facts: about the data set; for formats of anyone's data, about the format.
        detect: whether a source looks like it; must be quick and must not raise.
        looks_for: what ``detect`` wants to see, for the error message.
        scan: ``scan(source, *, progress, ...) -> Scan``; further keywords are the format's own options.
        run: ``run(source, out, *, skip_bad, check, progress, ...) -> Imported``, for formats that do more than point at images.
        write_lists: ``write_lists(manifest, split, folder) -> files``: a split in the data set's own form, if it has one.
        remote: the source may be a name instead of a path on disk.
    """

    facts: Facts
    detect: Callable[[Path], bool]
    looks_for: str
    scan: Callable[..., Scan]
    run: Callable[..., Imported] | None = None
    write_lists: Callable[[Manifest, Split, Path], list[Path]] | None = None
    remote: bool = False

    @property
    def options(self) -> list[str]:
        """The format's own keywords and the common ones."""
        own = [
            p.name
            for p in inspect.signature(self.run or self.scan).parameters.values()
            if p.kind is p.KEYWORD_ONLY
        ]
        return own if self.run else [*dict.fromkeys([*own, "skip_bad", "check", "progress"])]


def import_scanned(
    scan: Scan,
    source: Path,
    out: Path,
    facts: Mapping[str, str],
    *,
    skip_bad: bool,
    check: Check,
    progress: Progress = quiet,
) -> Imported:
    """Makes a manifest of a scan and writes it to ``out``; images stay where they are.

    Raises:
        ProblemsError: with every bad row and file at once, unless ``skip_bad``; nothing is written.
        PalpateError: if no usable row is left.
    """
    rows = finished(scan, check, progress)
    raise_if(scan.problems, skip_bad)
    require_some(len(rows), source, scan.problems)
    with removing_on_error(out) as created:
        manifest = Manifest.from_rows(
            (row for _, row in rows), scan.base.resolve(), {**facts, **scan.facts}
        )
        there = set(manifest.ids)
        splits = {
            name: Split(
                {i: part for i, part in parts.items() if i in there},
                scan.rules.get(name, {"method": "official"}),
                manifest.digest,
            )
            for name, parts in scan.parts.items()
            if there & set(parts)
        }
        return Imported(manifest, scan.problems, splits, scan.inconclusive, scan.suspicious).save(
            out, created
        )


def validation(
    name: str, format: Format, scan: Scan, *, check: Check, progress: Progress = quiet
) -> Validation:
    """Sorts what a scan found into missing, invalid and suspicious."""
    rows = finished(scan, check, progress)
    missing = [p for p in scan.problems if p.kind.startswith(MISSING)]
    invalid = [p for p in scan.problems if not p.kind.startswith(MISSING)]
    return Validation(name, format.facts, len(rows), missing, invalid, scan.suspicious)


def finished(scan: Scan, check: Check, progress: Progress = quiet) -> list[Found]:
    """The rows whose paths stay inside, whose images are whole and whose ids stand once; what is wrong with others joins the problems.

    Of the rows that stay their cells ``split`` become the split ``scan.own``.
    """
    rows = checked_paths(scan.rows, scan.base, scan.problems)
    rows = checked_images(rows, scan.base, check, scan.problems, progress)
    rows, parts = unique(rows, scan.problems)
    if scan.own and parts:
        scan.parts[scan.own] = parts
    scan.problems.sort(key=_place)
    return rows


def checked_paths(rows: Sequence[Found], base: Path, problems: list[Problem]) -> list[Found]:
    """Rows whose paths stay inside the root and exist, written relative to it."""
    known: dict[str, tuple[str, str] | None] = {}
    root = base.resolve()
    folders: dict[
        str, bool
    ] = {}  # resolving a path is slow: each folder once, and files only where they are links
    good: list[Found] = []

    def problem(given: str) -> tuple[str, str] | None:
        folder, _, name = given.rpartition("/")
        if folder not in folders:
            folders[folder] = (root / folder).resolve().is_relative_to(root)
        path = root / given
        leaves = (
            not folders[folder]
            or name in ("", "..")
            or "\\" in name
            or given.startswith("/")
            or path.is_symlink()
        )
        if leaves and inside(root, given) is None:
            return "outside-root", f"the path {given!r} leaves the root {base}"
        try:
            there = path.is_file()
        except OSError as error:  # e.g. a name that is too long for the disk
            return "missing-file", f"{given!r} cannot be a file: {error.strerror}"
        return None if there else ("missing-file", f"no file {given!r} in {base}")

    for where, row in rows:
        fine = True
        for name in IMAGE_COLUMNS:
            given = row.get(name)
            if given is None:
                continue
            if given not in known:
                known[given] = problem(given)
            if (found := known[given]) is not None:
                problems.append(Problem(where, found[0], f"{name}: {found[1]}"))
                fine = False
            elif (
                given.startswith(("/", "./"))
                or "//" in given
                or "/../" in given
                or Path(given).is_absolute()
            ):
                row[name] = (root / given).resolve().relative_to(root).as_posix()
        if fine:
            good.append((where, row))
    return good


def unique(rows: Sequence[Found], problems: list[Problem]) -> tuple[list[Found], dict[str, str]]:
    """Rows with their ids, each standing once; the first keeps it. An absent id is made of video and frame, else of the touch's path.

    Returns:
        The rows without their cell ``split``, and id -> that cell; an id that stands in two parts is in neither.
    """
    seen: dict[str, tuple[str, str | None]] = {}
    both: set[str] = set()
    good: list[Found] = []
    for where, row in rows:
        part = row.pop("split", None)
        made = ""
        if row.get("id") is None:
            named = row.get("video") is not None and row.get("frame") is not None
            path = row.get("tactile") or row.get("vision") or where
            row["id"] = (
                f"{row['video']}/{row['frame']}"
                if named
                else str(Path(path).with_suffix("").as_posix())
            )
            made = f", made of {'video and frame' if named else 'the path'} since there is none: map one (--map id=...)"
        i = row["id"]
        if i not in seen:
            seen[i] = where, part
            good.append((where, row))
            continue
        before, other = seen[i]
        if part and other and part != other:
            both.add(i)
            problems.append(
                Problem(
                    where,
                    "two-parts",
                    f"{i} is in {part} here and in {other} at {before}, so in no part",
                )
            )
        else:
            problems.append(
                Problem(where, "duplicate-id", f"the id {i!r} stands at {before} already{made}")
            )
    return good, {i: part for i, (_, part) in seen.items() if part and i not in both}


def checked_images(
    rows: Sequence[Found], base: Path, how: Check, problems: list[Problem], progress: Progress
) -> list[Found]:
    """Rows whose images are whole; a file in use by many rows is checked once and told once, with its first row."""
    if how == "none":
        return list(rows)
    first: dict[str, str] = {}
    uses: Counter[str] = Counter()
    for where, row in rows:
        for name in IMAGE_COLUMNS:
            if row.get(name) is not None:
                first.setdefault(row[name], where)
                uses[row[name]] += 1
    bad: set[str] = set()
    for done, (name, reason) in enumerate(
        in_threads(lambda n: check_image(base / n, how), first), 1
    ):
        if reason:
            bad.add(name)
            rest = f" (used by {uses[name]} rows)" if uses[name] > 1 else ""
            problems.append(Problem(first[name], "bad-image", f"{name}: {reason}{rest}"))
        progress("checking images", done, len(first))
    return [
        (where, row)
        for where, row in rows
        if not any(row.get(name) in bad for name in IMAGE_COLUMNS)
    ]


def _place(problem: Problem) -> tuple[str, int, str]:
    name, _, line = problem.where.rpartition(":")
    return (name, int(line), problem.kind) if line.isdecimal() else (problem.where, 0, problem.kind)
