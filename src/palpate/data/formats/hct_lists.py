"""The lists of HCT, read into rows; the format itself stands in ``hct.py``."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from palpate.core import PalpateError, Problem
from palpate.data.formats import tvl
from palpate.data.formats.base import Scan
from palpate.data.manifest import CLIMBS

#: A trajectory folder: a number that is used again, and the start in Unix seconds.
TRAJECTORY = re.compile(r"\d+-(\d+(?:\.\d+)?)")
RIG = re.compile(r"data\d+")
#: The stem of a frame's file: number and latency.
FRAME = re.compile(r"(\d{1,18})(?:-.*)?")
#: (rig, trajectory folder)
Trajectory = tuple[str, str]


@dataclass(frozen=True)
class Row:
    """One listed frame; paths are relative to the root, ``background`` is as listed.

    Attributes:
        where: its place in a list.
        part: train, val or test, or None where the list is no part.
        trajectory: rig and folder.
        frame: its number.
        vision, tactile, background: paths.
        text: the caption, cleaned.
    """

    where: str
    part: str | None
    trajectory: Trajectory
    frame: int
    vision: str
    tactile: str
    background: str | None
    text: str | None

    @property
    def key(self) -> tuple[Trajectory, int]:
        """What the frame is."""
        return (self.trajectory, self.frame)


def order(trajectory: Trajectory) -> tuple[str, float, str]:
    """Sorts trajectories by rig, then by time; those whose name tells no time stand first."""
    match = TRAJECTORY.fullmatch(trajectory[1])
    return trajectory[0], float(match[1]) if match else 0.0, trajectory[1]


class Reader:
    """Reads all lists of a tree into rows, and knows which frames touch something."""

    def __init__(self, root: Path, rigs: Sequence[str], found: Scan, contact: bool) -> None:
        self.root, self.rigs, self.found, self.contact = root, rigs, found, contact
        #: Lists that were read, relative to the folder they lie in.
        self.files: list[str] = []
        #: Every frame known to touch something, and the gel's pictures of frames known to touch nothing.
        self.contact_frames: set[tuple[Trajectory, int]] = set()
        self.untouched: dict[Trajectory, list[Row]] = defaultdict(list)

    def rows(self, lists: Path | None) -> list[Row]:
        """The samples, sorted by trajectory and frame; of equal ones the one listed first stands first."""
        place = Path(lists) if lists is not None else self.root
        listed = {rig: self._listed(place / rig, rig) for rig in self.rigs}
        if not any(rows is not None for rows in listed.values()):
            listed[""] = self._listed(place, None)
        if lists is not None and not any(listed.values()):
            raise PalpateError(
                f"{lists} must hold lists as HCT does (data1/train.csv ...)",
                "none with rows",
                "Check the path",
            )
        given = [row for rows in listed.values() for row in rows or []]
        known = {row.key for row in given}
        self.contact_frames |= known
        free = {
            rig
            for rig in self.rigs
            if lists is None and listed[rig] is None and listed.get("") is None
        }
        resting: set[tuple[Trajectory, int]] = set()
        for rig in self.rigs:
            for row in self._pairs(rig, "not_contact.json"):
                self.untouched[row.trajectory].append(row)
                resting.add(row.key)
        both = [row.where for row in given if row.key in resting]
        self.found.suspicious += tvl.summed(
            both, "contact-and-not", "listed, but not_contact.json calls them untouched"
        )
        for rig in self.rigs:
            given += self._touching(rig, rig in free, known, resting)
        odd = [
            r.where
            for r in given
            if PurePosixPath(r.vision).name != PurePosixPath(r.tactile).name
            or not r.tactile.startswith("/".join(r.trajectory) + "/")
        ]
        self.found.suspicious += tvl.summed(
            odd, "unequal-names", "photo and touch differ in trajectory or file name"
        )
        self.found.facts["not_contact"] = f"{len(resting)} frames, no samples"
        return sorted(given, key=lambda row: (order(row.trajectory), row.frame))

    def _touching(
        self,
        rig: str,
        free: bool,
        known: set[tuple[Trajectory, int]],
        resting: set[tuple[Trajectory, int]],
    ) -> list[Row]:
        """What ``contact.json`` adds: all its rows if the rig has no list, those that no list names if asked, else a note."""
        rows = self._pairs(rig, "contact.json")
        self.contact_frames |= {row.key for row in rows if row.key not in resting}
        more = [row for row in rows if row.key not in known]
        self.found.suspicious += tvl.summed(
            [row.where for row in more if row.key in resting],
            "contact-and-not",
            "in contact.json and in not_contact.json, so no samples",
        )
        more = [row for row in more if row.key not in resting]
        if free:
            words = {row.key: row.text for row in self._pairs(rig, "finetune.json")}
            return [replace(row, text=words.get(row.key)) for row in more]
        if self.contact:
            return more
        text = "in contact.json but in no list, so no samples; --set contact=yes takes them"
        self.found.suspicious += tvl.summed([row.where for row in more], "unlisted-contact", text)
        return []

    def _listed(self, folder: Path, rig: str | None) -> list[Row] | None:
        """The rows of the lists in a folder, or None if it has none."""
        there = tvl.part_lists(folder)
        self.files += [f"{rig}/{path.name}" if rig else path.name for path in there.values()]
        rows = [
            row
            for part, path in there.items()
            for row in self._parsed(tvl.read_csv(path, self.found.problems), rig, part)
        ]
        return rows if there else None

    def _pairs(self, rig: str, name: str) -> list[Row]:
        """The rows of a JSON file of a rig; none if it is not there."""
        path = self.root / rig / name
        read = tvl.read_conversations if name == "finetune.json" else tvl.read_pairs
        return self._parsed(read(path, self.found.problems), rig, None) if path.is_file() else []

    def _parsed(
        self,
        cells: Iterable[tuple[str, Mapping[str, str | None]]],
        rig: str | None,
        part: str | None,
    ) -> list[Row]:
        rows: list[Row] = []
        for where, row in cells:
            parsed = self._row(where, row, rig, part)
            if isinstance(parsed, Row):
                rows.append(parsed)
            else:
                self.found.problems.append(Problem(where, *parsed))
        return rows

    def _row(
        self, where: str, cells: Mapping[str, str | None], rig: str | None, part: str | None
    ) -> Row | tuple[str, str]:
        """One row, or what is wrong with it."""
        if lacking := [name for name in ("url", "tactile") if not cells.get(name)]:
            return "empty-cell", f"no {' and no '.join(lacking)} path"
        for cell in cells.values():
            if cell and tvl.is_picture(cell) and re.search(CLIMBS, cell):
                return "outside-root", f"the path {cell!r} leaves the data set"
        vision, tactile = (located(str(cells[name]), rig) for name in ("url", "tactile"))
        pieces = vision.split("/")
        if min(vision.count("/"), tactile.count("/")) < 3:
            return "bad-path", f"the path {cells['url']!r} is not trajectory/vision/frame.jpg"
        number = FRAME.fullmatch(PurePosixPath(pieces[-1]).stem)
        if number is None:
            return "bad-frame", f"{pieces[-1]!r} does not begin with a frame number and a dash"
        text = tvl.clean_caption(cells.get("caption"))
        return Row(
            where,
            part,
            (pieces[0], pieces[1]),
            int(number[1]),
            vision,
            tactile,
            cells.get("tactile_background"),
            text,
        )


def located(cell: str, rig: str | None) -> str:
    """A listed path relative to ``hct/``, whether it begins at the rig, at ``hct/`` or above it."""
    path = PurePosixPath(cell).as_posix().removeprefix("hct/")
    first = path.split("/", 1)[0]
    return path if rig is None or first == rig or RIG.fullmatch(first) else f"{rig}/{path}"
