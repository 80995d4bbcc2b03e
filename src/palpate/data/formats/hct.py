"""HCT, the human-collected half of TVL (Fu et al., 2024): a DIGIT and a camera held in one hand, pressed on things in the wild.

::

    hct/
      data1/ data2/ data3/                     one rig each: another gel, another framing (the column ``domain``)
        train.csv  test.csv                    url,tactile,tactile_background,caption
        contact.json  not_contact.json         {"tactile": [..], "vision": [..], "background": [..]}
        finetune.json                          captions again, as talk
        4-1702596295.70/vision/160-0.0207.jpg  folder: number, start in Unix seconds; file: frame, latency in seconds
        4-1702596295.70/tactile/160-0.0207.jpg
        digit_background.png                   here or in hct/: the gel where a trajectory has no picture of it

The source may be ``hct/``, one ``dataN/``, or the folder that holds ``hct/``. Lists lie in each ``dataN/`` or, for all of them, in ``hct/`` (read
only if no ``dataN/`` has one). Their paths start at ``dataN/`` or at ``hct/``; both are understood.

- **Samples** are the rows of the lists. A ``dataN/`` without lists gives those of ``contact.json``, worded by ``finetune.json``; beside lists, frames that only
  ``contact.json`` names are counted, and are samples without words and without part if ``contact`` is set. Frames of ``not_contact.json`` are none.
- **video** is the whole folder name, ``data2/4-1702596295.70``: the number before the dash is used again and again. **frame** is the integer before
  the dash of the file. **touch** is a run of consecutive frames in contact. **session** joins folders of one ``dataN`` of which each starts at most ``session_gap``
  seconds after the one before, since neighbors may hold the same object. Captions tell no object: frames of one folder are worded differently.
- **background**: the list's picture if it is there, else ``digit_background.png``, else of up to 15 frames of the trajectory that
  ``not_contact.json`` names the one nearest to their median, else null.
- Photos of ``data3`` show the touched spot lower: TVL crops them 200 pixels further down.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpate.core import PalpateError, Problem, Progress, Split, inside, quiet
from palpate.data.formats import tvl
from palpate.data.formats.base import WORLD, Facts, Scan, world_facts
from palpate.data.formats.hct_lists import RIG, TRAJECTORY, Reader, Row, Trajectory, located, order
from palpate.data.frames import nearest_to_median
from palpate.data.images import check_image
from palpate.data.listing import contact_names
from palpate.data.manifest import Manifest
from palpate.data.recordings import MEDIAN_OF

FACTS = Facts(
    "HCT (Touch-Vision-Language)",
    tvl.CITATION,
    "unknown",
    tvl.URL,
    "DIGIT",
    (240, 320),
    "39,154 in contact by contact.json, of which a user loaded 38,605 for training; 356 in the test lists",
    "trajectory folder; stricter: folders that follow each other in time (session)",
    tvl.NORMALIZATION,
)
FALLBACK = "digit_background.png"
COLUMNS = ("url", "tactile", "tactile_background", "caption")
LOOKED_FOR = (
    "hct/, or dataN/ folders, with trajectories such as 4-1702596295.70/vision/ and .../tactile/"
)
Swap = Literal["report", "mend"]


def detect(source: Path) -> bool:
    """Whether a folder is HCT, one of its rigs, or holds ``hct/``: a trajectory with frames, in its place."""
    root, rigs = find(source)
    return any(_has_trajectory(root / rig) for rig in rigs)


def find(source: Path) -> tuple[Path, list[str]]:
    """``hct/`` and the names of its rigs, from any of the three places that a user may name; no rigs if there are none."""
    source = Path(source)
    for root in (source, source / "hct"):
        if rigs := sorted(folder.name for folder in _folders(root) if _is_rig(folder)):
            return root, rigs
    if source.is_dir() and _is_rig(source):
        return source.absolute().parent, [source.absolute().name]
    return source, []


def scan(
    source: Path,
    *,
    lists: Path | None = None,
    contact: bool = False,
    session_gap: float = 60.0,
    swap: Swap = "report",
    progress: Progress = quiet,
) -> Scan:
    """Reads the lists and looks at the trajectories.

    Args:
        source: ``hct/``, one ``dataN/``, or the folder that holds ``hct/``.
        lists: folder with lists to use instead of the data set's own, laid out as it (``lists/data1/train.csv``).
        contact: take frames too that only ``contact.json`` names.
        session_gap: seconds between the starts of folders of one session.
        swap: what to do with trajectories whose vision and touch are exchanged: report them, or also exchange their paths back.
        progress: told how many trajectories are looked at.

    Raises:
        PalpateError: if there are no trajectories, or an option has a wrong value.
    """
    tvl.require_option("swap", swap, ("report", "mend"))
    if session_gap < 0:
        raise PalpateError(
            "session_gap must be 0 seconds or more", str(session_gap), "Leave it out for 60 seconds"
        )
    root, rigs = find(source)
    if not rigs:
        raise PalpateError(
            f"{source} must be HCT: {LOOKED_FOR}", "none of these", f"Unpack it from {tvl.URL}"
        )
    found = Scan([], root, facts={"layout": f"hct: {', '.join(rigs)}"})
    found.facts |= world_facts(root)
    sensor = WORLD.sensor if "synthetic" in found.facts else FACTS.sensor
    reader = Reader(root, rigs, found, contact)
    rows = reader.rows(lists)
    sessions = sessions_of({row.trajectory for row in rows}, session_gap)
    touch = _touches(rows, reader.contact_frames)
    rows = _present(root, rows, found.problems)
    evidence = _exchanged(root, rows, progress)
    mended = set(evidence) if swap == "mend" else set[Trajectory]()
    rows = [
        replace(row, vision=row.tactile, tactile=row.vision) if row.trajectory in mended else row
        for row in rows
    ]
    for trajectory, text in evidence.items():
        done = "; their paths were exchanged" if mended else "; --set swap=mend exchanges them back"
        found.suspicious.append(Problem("/".join(trajectory), "swapped-folders", text + done))
    backgrounds = _backgrounds(root, rows, reader.untouched, mended, found)
    for row, background in zip(rows, backgrounds, strict=True):
        video = "/".join(row.trajectory)
        cells: dict[str, Any] = {
            "id": f"{video}/{row.frame}",
            "video": video,
            "frame": row.frame,
            "contact": touch[row.key],
            "text": row.text,
        }
        cells |= {
            "session": sessions[row.trajectory],
            "vision": row.vision,
            "tactile": row.tactile,
            "background": background,
        }
        found.rows.append(
            (row.where, cells | {"sensor": sensor, "domain": row.trajectory[0], "split": row.part})
        )
    if any(row.part for row in rows):
        found.own = name = "Orig" if lists is None else "Lists"
        found.rules[name] = {
            "method": "official" if lists is None else "lists",
            "files": reader.files,
        }
    exchange = f"{len(evidence)}, {'mended' if mended else 'as they are'}" if evidence else "none"
    found.facts |= {"session_gap": f"{session_gap:g} s", "swapped_folders": exchange}
    worded = dict.fromkeys(f"{r.part}.csv" if r.part else "finetune.json" for r in rows if r.text)
    found.facts |= {"text_source": f"captions of {', '.join(sorted(worded))}" if worded else "none"}
    if root == Path(source) / "hct" and (Path(source) / "ssvtp").is_dir():
        found.suspicious.append(
            Problem(
                str(source),
                "other-half",
                "ssvtp/ lies beside hct/ and was not read: import it with --format ssvtp",
            )
        )
    return found


def sessions_of(trajectories: Iterable[Trajectory], gap: float) -> dict[Trajectory, str]:
    """Trajectory -> session, named by its first folder. A folder whose name tells no time is a session of its own."""
    found: dict[Trajectory, str] = {}
    last: dict[str, tuple[float, str]] = {}
    for rig, folder in sorted(trajectories, key=order):
        match = TRAJECTORY.fullmatch(folder)
        name = f"{rig}/{folder}"
        if match is not None:
            start = float(match[1])
            before, session = last.get(rig, (float("-inf"), name))
            name = session if start - before <= gap else name
            last[rig] = (start, name)
        found[rig, folder] = name
    return found


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Writes ``dataN/<part>.csv`` with ``url,tactile,tactile_background,caption``, paths relative to ``dataN``.

    A background outside ``dataN`` is written relative to ``hct/``.

    Raises:
        PalpateError: if a sample's images do not lie below the folder of its domain.
    """
    files: list[Path] = []
    for part in split.counts():
        rows: dict[str, list[list[str | None]]] = defaultdict(list)
        for row in manifest.part(split, part).table.iter_rows(named=True):
            prefix = f"{row['domain']}/"
            if row["domain"] is None or not all(
                str(row[name]).startswith(prefix) for name in ("vision", "tactile")
            ):
                got = f"{row['id']!r} with domain {row['domain']!r} and photo {row['vision']!r}"
                raise PalpateError(
                    "HCT's lists need every image below the folder of its domain",
                    got,
                    "Write the split file alone",
                )
            paths = [
                row[name] and row[name].removeprefix(prefix)
                for name in ("vision", "tactile", "background")
            ]
            rows[row["domain"]].append([*paths, row["text"]])
        files += [
            tvl.write_csv(Path(folder) / domain / f"{part}.csv", COLUMNS, listed)
            for domain, listed in sorted(rows.items())
        ]
    return files


def _touches(
    rows: Sequence[Row], contact: set[tuple[Trajectory, int]]
) -> dict[tuple[Trajectory, int], str]:
    """Frame -> touch: runs of consecutive frames over all that are known to touch something."""
    frames = sorted(contact | {row.key for row in rows})
    return dict(
        zip(
            frames,
            contact_names(["/".join(t) for t, _ in frames], [k for _, k in frames], None),
            strict=True,
        )
    )


def _present(root: Path, rows: Sequence[Row], problems: list[Problem]) -> list[Row]:
    """Rows whose folders are there; of the others one problem a folder, with the number of rows."""
    lost: dict[str, list[str]] = defaultdict(list)
    there: dict[str, bool] = {}

    def missing(path: str) -> str | None:
        folders = ["/".join(path.split("/")[:n]) for n in range(1, path.count("/") + 1)]
        return next((f for f in folders if not there.setdefault(f, (root / f).is_dir())), None)

    kept: list[Row] = []
    for row in rows:
        absent = missing(row.vision) or missing(row.tactile)
        if absent is None:
            kept.append(row)
        else:
            lost[absent].append(row.where)
    for folder, places in sorted(lost.items()):
        problems += tvl.summed(places, "missing-folder", f"no folder {folder!r} in {root}")
    return kept


def _exchanged(root: Path, rows: Sequence[Row], progress: Progress) -> dict[Trajectory, str]:
    """Trajectories whose sides are exchanged, with the evidence, from the first, middle and last row of each."""
    by: dict[Trajectory, list[Row]] = defaultdict(list)
    for row in rows:
        by[row.trajectory].append(row)
    files: dict[str, tuple[list[Path], list[Path]]] = {}
    for trajectory, own in by.items():
        chosen = [own[k] for k in sorted({0, len(own) // 2, len(own) - 1})]
        files["/".join(trajectory)] = (
            [root / r.vision for r in chosen],
            [root / r.tactile for r in chosen],
        )
    seen = tvl.looks(files, progress)
    found: dict[Trajectory, str] = {}
    for rig in sorted({rig for rig, _ in by}):
        own = {name: seen[name] for name in seen if name.startswith(f"{rig}/")}
        for name, text in tvl.exchanged(own, (240, 320)).items():
            found[rig, name.removeprefix(f"{rig}/")] = text
    return found


def _backgrounds(
    root: Path,
    rows: Sequence[Row],
    untouched: Mapping[Trajectory, Sequence[Row]],
    mended: Collection[Trajectory],
    found: Scan,
) -> list[str | None]:
    """Each row's background by the rule in the head of this file; how often each source served goes into the facts.

    Of a mended trajectory the listed picture does not count, as it was made of what its folder named touch held.
    """
    there: dict[str, bool] = {}
    typical: dict[Trajectory, str | None] = {}

    def first(*names: str) -> str | None:
        return next((n for n in names if there.setdefault(n, (root / n).is_file())), None)

    kinds: Counter[str] = Counter()
    chosen: list[str | None] = []
    bare: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        rig = row.trajectory[0]
        listed = row.background if row.trajectory not in mended else None
        name, kind = (first(located(listed, rig), listed) if listed else None), "as listed"
        if name is None:
            name, kind = first(f"{rig}/{FALLBACK}", FALLBACK), FALLBACK
        if name is None:
            if row.trajectory not in typical:
                side = "vision" if row.trajectory in mended else "tactile"
                typical[row.trajectory] = _typical(
                    root, [getattr(frame, side) for frame in untouched.get(row.trajectory, [])]
                )
            name, kind = typical[row.trajectory], "untouched frame"
        if name is None:
            kind = "none"
            bare[rig].append(row.where)
        kinds[kind] += 1
        chosen.append(name)
    for places in bare.values():
        found.suspicious += tvl.summed(
            places,
            "no-background",
            f"no picture of the gel untouched, as none is listed and there is no {FALLBACK}",
        )
    found.facts["backgrounds"] = ", ".join(f"{kind} {n}" for kind, n in sorted(kinds.items()))
    return chosen


@dataclass
class _Pictures:
    """Picture files as frames, numbered by their place."""

    source: Path
    files: Sequence[Path]
    raw: bool = False

    def __len__(self) -> int:
        return len(self.files)

    @property
    def numbers(self) -> Sequence[int]:
        return range(len(self.files))

    def has(self, k: int) -> bool:
        return k in self.numbers

    def path(self, k: int) -> Path:
        return self.files[k]


def _typical(root: Path, names: Sequence[str]) -> str | None:
    """Of up to 15 whole pictures, evenly spaced over those given in the order of frames, the one nearest to their median."""
    whole = [name for name in names if inside(root, name) and check_image(root / name) is None]
    if not whole:
        return None
    some = [
        whole[int(k)]
        for k in np.unique(np.linspace(0, len(whole) - 1, min(MEDIAN_OF, len(whole))).round())
    ]
    try:
        return some[
            nearest_to_median(_Pictures(root, [root / name for name in some]), range(len(some)))[0]
        ]
    except PalpateError:  # pictures of several sizes
        return None


def _folders(path: Path) -> list[Path]:
    """The folders in a folder; none if it cannot be read."""
    try:
        return [entry for entry in path.iterdir() if entry.is_dir()]
    except OSError:
        return []


def _is_rig(folder: Path) -> bool:
    """Whether a folder holds a trajectory, or lists under a name such as ``data1``."""
    return _has_trajectory(folder) or (
        RIG.fullmatch(folder.name) is not None and bool(tvl.part_lists(folder))
    )


def _has_trajectory(folder: Path) -> bool:
    """Whether a folder holds at least one trajectory with frames."""
    try:
        with os.scandir(folder) as entries:
            return any(
                TRAJECTORY.fullmatch(e.name)
                and any((folder / e.name / side).is_dir() for side in ("vision", "tactile"))
                for e in entries
            )
    except OSError:
        return False
