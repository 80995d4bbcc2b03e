"""HCT, the human-collected half of TVL (Fu et al., 2024): a DIGIT and a camera held in one hand.

::

    hct/
      data1/ data2/ data3/                     one rig each: another gel, another framing (domain)
        train.csv  test.csv                    url,tactile,tactile_background,caption
        contact.json  not_contact.json         not read: frames in contact, and others
        finetune.json                          not read: captions again, as talk
        4-1702596295.70/vision/160-0.0207.jpg  folder: number, start in Unix seconds;
        4-1702596295.70/tactile/160-0.0207.jpg file: frame, latency in seconds
        digit_background.png                   here or in hct/: the gel where a trajectory has no
                                               image of it

The source may be ``hct/``, one ``dataN/``, or the folder that holds ``hct/``. The paths of a list
are relative to its ``dataN/``, or start at ``dataN/`` or ``hct/``.

- **Samples** are the rows of the lists.
- **video** is a trajectory folder with its rig, ``data2/4-1702596295.70`` (numbers before the dash
  repeat). **frame** is the number at the start of the file name. **contact** is a run of
  consecutive listed frames. **session** joins folders of one rig that were started at most a
  minute after each other: they may show the same object. No column ``object`` is made of captions,
  since frames of one folder are worded differently.
- **background** is the image that the list names, else ``digit_background.png``.
- **Exchanged sides**: in some trajectories ``vision/`` holds the tactile images and ``tactile/``
  the photos (:mod:`palpate.data.suspicions`).
- Photos of ``data3`` show the touched spot lower: TVL crops them 200 pixels further down.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Literal

from palpate.core import Progress, Split, quiet, require, require_choice
from palpate.data.formats import tvl
from palpate.data.formats.layout import report_missing_folders, subfolders, suspect_rows
from palpate.data.manifest import CLIMBS, Manifest
from palpate.data.recordings import TRAJECTORY, contact_names, in_time, sessions_of
from palpate.data.scanning import WORLD, Cells, Facts, Format, Row, Scan, world_facts
from palpate.data.suspicions import exchanged_sides, looked_at

FACTS = Facts(
    name="HCT (Touch-Vision-Language)",
    citation=tvl.CITATION,
    url=tvl.URL,
    sensor="DIGIT",
    image_size=tvl.IMAGE_SIZE,
    samples="39,154 in contact by contact.json, of which a user loaded 38,605 for training; "
    "356 in the test lists",
    group="trajectory folder; stricter: folders that follow each other in time (session)",
)
LOOKS_FOR = (
    "hct/, or dataN/ folders, with trajectories such as 4-1702596295.70/vision/ and .../tactile/"
)
FALLBACK = "digit_background.png"
RIG = re.compile(r"data\d+")
#: The stem of a frame's file: number and latency.
FRAME = re.compile(r"(\d{1,18})(?:-.*)?")
Swap = Literal["report", "fix"]


def detect(source: Path) -> bool:
    """Whether a folder is HCT, one of its rigs, or holds ``hct/``, with frames of a trajectory."""
    root, rigs = find(source)
    return any(_has_trajectory(root / rig) for rig in rigs)


def find(source: Path) -> tuple[Path, list[str]]:
    """``hct/`` and the names of its rigs, from any of the three places; perhaps no rigs."""
    for root in (source, source / "hct"):
        if rigs := [name for name in subfolders(root) if _is_rig(root / name)]:
            return root, rigs
    source = source.absolute()
    return (source.parent, [source.name]) if _is_rig(source) else (source, [])


def scan(source: Path, *, swap: Swap = "report", progress: Progress = quiet) -> Scan:
    """Read the lists and look at the trajectories.

    Options:
        swap: ``report`` leaves trajectories whose vision and tactile folders are exchanged as they
            are, with the other suspicions; ``fix`` puts their paths back.
    """
    require_choice("swap", swap, ("report", "fix"))
    root, rigs = find(source)
    must = f"{source} must be HCT: {LOOKS_FOR}"
    require(bool(rigs), None, must, "none of these", fix=f"Unpack it from {tvl.URL}")
    result = Scan(root, {"layout": f"hct: {', '.join(rigs)}"} | world_facts(root))
    files = _read_lists(result, rigs)
    keys = sorted({_key(row) for _, row in result.rows})
    names = contact_names([video for video, _ in keys], [k for _, k in keys], None)
    contacts = dict(zip(keys, names, strict=True))
    sessions = sessions_of(row["video"] for _, row in result.rows)
    report_missing_folders(result)
    fixed = _put_back(result, progress) if swap == "fix" else set[str]()
    _choose_backgrounds(result, fixed)
    sensor = WORLD.sensor if "synthetic" in result.facts else FACTS.sensor
    for _, row in result.rows:
        row |= {"contact": contacts[_key(row)], "session": sessions[row["video"]], "sensor": sensor}
    result.split_rule = {"files": files}
    worded = sorted({f"{row['split']}.csv" for _, row in result.rows if row["text"]})
    result.facts["text_source"] = f"captions of {', '.join(worded)}" if worded else "none"
    if root == source / "hct" and (root.parent / "ssvtp").is_dir():
        text = "ssvtp/ is next to hct/ and was not read: import it as the format ssvtp"
        result.suspect(source, "other-half", text)
    return result


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Write ``dataN/<part>.csv`` with ``url,tactile,tactile_background,caption``.

    Paths are relative to ``dataN``; a background outside ``dataN`` is relative to ``hct/``.
    """
    files: list[Path] = []
    columns = ("domain", "vision", "tactile", "background", "text")
    for part in split.counts():
        rows: dict[str, list[list[str | None]]] = defaultdict(list)
        for domain, *paths, text in manifest.part(split, part).table.select(columns).iter_rows():
            cells = [path and path.removeprefix(f"{domain}/") for path in paths]
            rows[domain].append([*cells, text])
        for domain, cells in sorted(rows.items()):
            path = folder / domain / f"{part}.csv"
            files.append(tvl.write_list(path, tvl.COLUMNS, cells))
    return files


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan, write_lists)


def _is_rig(folder: Path) -> bool:
    """Whether a folder holds a trajectory, or lists under a name such as ``data1``."""
    lists = RIG.fullmatch(folder.name) is not None and bool(tvl.part_lists(folder))
    return lists or _has_trajectory(folder)


def _has_trajectory(folder: Path) -> bool:
    names = (name for name in subfolders(folder) if TRAJECTORY.fullmatch(name))
    return any({"vision", "tactile"} & set(subfolders(folder / name)) for name in names)


def _key(row: Cells) -> tuple[str, int]:
    return row["video"], row["frame"]


def _read_lists(result: Scan, rigs: Sequence[str]) -> list[str]:
    """Add the rows of all lists, by video (in order of time) and number; return their names."""
    samples, files = list[Row](), list[str]()
    for rig in rigs:
        for part, path in tvl.part_lists(result.base / rig).items():
            files.append(f"{rig}/{path.name}")
            samples += _frames(result, tvl.read_list(result, path), rig, part)
    partner = lambda row: f"{row['video']}/tactile/{PurePosixPath(row['vision']).name}"
    odd = [where for where, row in samples if row["tactile"] != partner(row)]
    text = "photo and tactile image differ in trajectory or file name"
    suspect_rows(result, odd, "unequal-names", text)
    samples.sort(key=lambda sample: (in_time(sample[1]["video"]), sample[1]["frame"]))
    result.rows = samples
    return files


def _frames(result: Scan, listed: Iterable[Row], rig: str, part: str) -> list[Row]:
    """The frames of listed rows; bad rows become problems."""
    rows: list[Row] = []
    for where, cells in listed:
        paths = [cells.get(name) for name in ("url", "tactile", "tactile_background")]
        url, tactile, background = paths
        if not url or not tactile:
            lacking = " and no ".join(name for name in ("url", "tactile") if not cells.get(name))
            result.problem(where, "empty-cell", f"no {lacking} path")
            continue
        pieces = _located(url, rig).split("/")
        number = FRAME.fullmatch(PurePosixPath(pieces[-1]).stem)
        if climbing := [path for path in paths if path and re.search(CLIMBS, path)]:
            text = f"the path {climbing[0]!r} leaves the data set"
            result.problem(where, "outside-root", text)
        elif len(pieces) != 4:
            text = f"the path {url!r} is not trajectory/vision/frame.jpg"
            result.problem(where, "bad-path", text)
        elif number is None:
            text = f"{pieces[-1]!r} does not begin with a frame number and a dash"
            result.problem(where, "bad-frame", text)
        else:
            video = "/".join(pieces[:2])
            row: Cells = {"id": f"{video}/{int(number[1])}", "video": video}
            row |= {"frame": int(number[1]), "text": tvl.clean_caption(cells.get("caption"))}
            row |= {"vision": "/".join(pieces), "tactile": _located(tactile, rig)}
            row |= {"background": background, "domain": pieces[0], "split": part}
            rows.append((where, row))
    return rows


def _located(cell: str, rig: str) -> str:
    """A path that starts at the trajectory, ``dataN/`` or ``hct/``, relative to ``hct/``."""
    path = PurePosixPath(cell).as_posix().removeprefix("hct/")
    first = path.partition("/")[0]
    return path if first == rig or RIG.fullmatch(first) else f"{rig}/{path}"


def _put_back(result: Scan, progress: Progress) -> set[str]:
    """Put the paths of trajectories with exchanged sides back; return their names."""
    looks = looked_at((row for _, row in result.rows), result.base, progress)
    exchanged = {problem.where for problem in exchanged_sides(looks)}
    for _, row in result.rows:
        if row["video"] in exchanged:
            row["vision"], row["tactile"] = row["tactile"], row["vision"]
    result.facts["exchanged_sides"] = f"put back in {len(exchanged)} trajectories"
    return exchanged


def _choose_backgrounds(result: Scan, fixed: Collection[str]) -> None:
    """The background of each row by the rule above; the facts count how often each source served.

    The listed image of a fixed trajectory does not count: it was made of its vision.
    """

    @cache
    def is_file(name: str) -> bool:
        return (result.base / name).is_file()

    def choose(row: Cells) -> tuple[str, str | None]:
        video, rig, listed = row["video"], row["domain"], row["background"]
        sources = [("as listed", _located(listed, rig)), ("as listed", listed)] if listed else []
        sources = [] if video in fixed else sources
        sources += [(FALLBACK, f"{rig}/{FALLBACK}"), (FALLBACK, FALLBACK)]
        return next((s for s in sources if is_file(s[1])), ("none", None))

    kinds: Counter[str] = Counter()
    bare: dict[str, list[str]] = defaultdict(list)
    for where, row in result.rows:
        kind, row["background"] = choose(row)
        kinds[kind] += 1
        if kind == "none":
            bare[row["domain"]].append(where)
    for places in bare.values():
        text = f"no image of the untouched gel, as none is listed and there is no {FALLBACK}"
        suspect_rows(result, places, "no-background", text)
    result.facts["backgrounds"] = ", ".join(f"{kind} {n}" for kind, n in sorted(kinds.items()))
