"""HCT, the human-collected half of TVL (Fu et al., 2024): a DIGIT and a camera held in one hand.

::

    hct/
      data1/ data2/ data3/                     one rig each: another gel, another framing (domain)
        train.csv  test.csv                    url,tactile,tactile_background,caption
        contact.json  not_contact.json         {"tactile": [..], "vision": [..], "background": [..]}
        finetune.json                          not read: captions again, as talk
        4-1702596295.70/vision/160-0.0207.jpg  folder: number, start in Unix seconds;
        4-1702596295.70/tactile/160-0.0207.jpg file: frame, latency in seconds
        digit_background.png                   here or in hct/: the gel where a trajectory has no
                                               image of it

The source may be ``hct/``, one ``dataN/``, or the folder that holds ``hct/``. The paths of a list
are relative to its ``dataN/``, or start at ``dataN/`` or ``hct/``.

- **Samples** are the rows of the lists. Frames that only ``contact.json`` names are counted, and
  are samples without words and part with ``contact``. Frames of ``not_contact.json`` are none.
- **video** is the whole folder name, ``data2/4-1702596295.70``: the number before the dash is used
  again and again. **frame** is the integer before the dash of the file. **contact** is a run of
  consecutive frames in contact. **session** joins folders of one ``dataN`` of which each starts at
  most ``session_gap`` seconds after the one before, since neighbors may hold the same object.
  Captions are no object labels: frames of one folder are worded differently.
- **background**: the list's image if it is there, else ``digit_background.png``, else of up to 15
  frames of the trajectory in ``not_contact.json`` the one nearest to their median, else null.
- **Swapped folders**: some trajectories have ``vision/`` and ``tactile/`` exchanged
  (:mod:`palpate.data.formats.swapped`).
- Photos of ``data3`` show the touched spot lower: TVL crops them 200 pixels further down.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from palpate.core import PalpateError, Progress, Split, inside, quiet
from palpate.data.formats import tvl
from palpate.data.formats.base import WORLD, Cells, Facts, Format, Row, Scan, world_facts
from palpate.data.formats.layout import read_json_file, report_missing_folders, subfolders
from palpate.data.formats.swapped import looks, swapped
from palpate.data.images import check_image, read_image
from palpate.data.listing import contact_names
from palpate.data.manifest import CLIMBS, Manifest
from palpate.data.recordings import MEDIAN_OF

FACTS = Facts(
    name="HCT (Touch-Vision-Language)",
    citation=tvl.CITATION,
    url=tvl.URL,
    sensor="DIGIT",
    image_size=tvl.IMAGE_SIZE,
    samples="39,154 in contact by contact.json, of which a user loaded 38,605 for training; "
    "356 in the test lists",
    group="trajectory folder; stricter: folders that follow each other in time (session)",
    normalization=tvl.NORMALIZATION,
)
LOOKS_FOR = (
    "hct/, or dataN/ folders, with trajectories such as 4-1702596295.70/vision/ and .../tactile/"
)
FALLBACK = "digit_background.png"
#: A trajectory folder: a number that is used again, and the start in Unix seconds.
TRAJECTORY = re.compile(r"\d+-(\d+(?:\.\d+)?)")
RIG = re.compile(r"data\d+")
#: The stem of a frame's file: number and latency.
FRAME = re.compile(r"(\d{1,18})(?:-.*)?")
Swap = Literal["report", "fix"]


@dataclass(frozen=True)
class Frame:
    """One listed frame; paths are relative to the root, ``background`` is as listed."""

    where: str
    part: str | None
    rig: str
    video: str
    number: int
    vision: str
    tactile: str
    background: str | None
    text: str | None

    @property
    def key(self) -> tuple[str, int]:
        """Video and number."""
        return self.video, self.number


@dataclass
class Lists:
    """The lists of a tree.

    Attributes:
        samples: the frames that are samples, by video (in order of time) and number.
        contact: every frame known to be in contact.
        untouched: video -> its frames in ``not_contact.json``.
        files: the lists read.
    """

    samples: list[Frame]
    contact: set[tuple[str, int]]
    untouched: dict[str, list[Frame]]
    files: list[str]


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


def scan(
    source: Path,
    *,
    lists: Path | None = None,
    contact: bool = False,
    session_gap: float = 60.0,
    swap: Swap = "report",
    progress: Progress = quiet,
) -> Scan:
    """Read the lists and look at the trajectories.

    Args:
        source: ``hct/``, one ``dataN/``, or the folder that holds ``hct/``.
        lists: folder with lists to use instead of the data set's own (``lists/data1/train.csv``).
        contact: include frames that only ``contact.json`` names.
        session_gap: seconds between the starts of folders of one session.
        swap: trajectories whose vision and tactile folders are swapped are reported, or ``fix``
            also swaps their paths back.
        progress: called with the number of trajectories looked at.

    Raises:
        PalpateError: if there are no trajectories, or an option has a wrong value.
    """
    if swap not in ("report", "fix"):
        raise PalpateError("must be report or fix", repr(swap), "", argument="swap")
    if session_gap < 0:
        got = f"{session_gap}"
        raise PalpateError("must be 0 seconds or more", got, "", argument="session_gap")
    root, rigs = find(Path(source))
    if not rigs:
        must = f"{source} must be HCT: {LOOKS_FOR}"
        raise PalpateError(must, "none of these", f"Unpack it from {tvl.URL}")
    result = Scan(root, {"layout": f"hct: {', '.join(rigs)}"} | world_facts(root))
    listed = _read_lists(result, rigs, lists, contact)
    keys = sorted(listed.contact)
    names = contact_names([video for video, _ in keys], [k for _, k in keys], None)
    contacts = dict(zip(keys, names, strict=True))
    sessions = sessions_of({frame.video for frame in listed.samples}, session_gap)
    result.rows = [(f.where, {"vision": f.vision, "tactile": f.tactile}) for f in listed.samples]
    report_missing_folders(result)
    present = {where for where, _ in result.rows}
    frames = [frame for frame in listed.samples if frame.where in present]
    frames, fixed = _swap(result, frames, swap, progress)
    backgrounds = _backgrounds(result, frames, listed.untouched, fixed)
    sensor = WORLD.sensor if "synthetic" in result.facts else FACTS.sensor
    result.rows = []
    for frame, background in zip(frames, backgrounds, strict=True):
        row: Cells = {
            "id": f"{frame.video}/{frame.number}",
            "video": frame.video,
            "frame": frame.number,
            "contact": contacts[frame.key],
            "session": sessions[frame.video],
            "text": frame.text,
            "vision": frame.vision,
            "tactile": frame.tactile,
            "background": background,
            "sensor": sensor,
            "domain": frame.rig,
            "split": frame.part,
        }
        result.rows.append((frame.where, row))
    result.split_name = "Orig" if lists is None else "Lists"
    method = "official" if lists is None else "lists"
    result.split_rule = {"method": method, "files": listed.files}
    worded = sorted({f"{frame.part}.csv" for frame in frames if frame.text})
    result.facts["text_source"] = f"captions of {', '.join(worded)}" if worded else "none"
    result.facts["session_gap"] = f"{session_gap:g} s"
    if root == Path(source) / "hct" and (root.parent / "ssvtp").is_dir():
        text = "ssvtp/ is next to hct/ and was not read: import it as the format ssvtp"
        result.suspect(source, "other-half", text)
    return result


def sessions_of(videos: Iterable[str], gap: float) -> dict[str, str]:
    """Video -> session, named by its first video; a name without a time is its own session."""
    sessions: dict[str, str] = {}
    last: dict[str, tuple[float, str]] = {}
    for video in sorted(videos, key=_in_time):
        rig, start, _ = _in_time(video)
        if start >= 0:
            before, session = last.get(rig, (float("-inf"), ""))
            sessions[video] = session if start - before <= gap else video
            last[rig] = (start, sessions[video])
        else:
            sessions[video] = video
    return sessions


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Write ``dataN/<part>.csv`` with ``url,tactile,tactile_background,caption``.

    Paths are relative to ``dataN``; a background outside ``dataN`` is relative to ``hct/``.

    Raises:
        PalpateError: if a sample's images are not below the folder of its domain.
    """
    files: list[Path] = []
    for part in split.counts():
        rows: dict[str, list[list[str | None]]] = defaultdict(list)
        for row in manifest.part(split, part).table.iter_rows(named=True):
            prefix = f"{row['domain']}/"
            if not all(str(row[name]).startswith(prefix) for name in ("vision", "tactile")):
                must = "HCT's lists need every image below the folder of its domain"
                got = f"{row['id']!r} with domain {row['domain']!r} and photo {row['vision']!r}"
                raise PalpateError(must, got, "Write the split file alone")
            paths = [row[name] for name in ("vision", "tactile", "background")]
            cells = [path and path.removeprefix(prefix) for path in paths]
            rows[row["domain"]].append([*cells, row["text"]])
        for domain, cells in sorted(rows.items()):
            path = Path(folder) / domain / f"{part}.csv"
            files.append(tvl.write_list(path, tvl.COLUMNS, cells))
    return files


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan, write_lists=write_lists)


def _is_rig(folder: Path) -> bool:
    """Whether a folder holds a trajectory, or lists under a name such as ``data1``."""
    lists = RIG.fullmatch(folder.name) is not None and bool(tvl.part_lists(folder))
    return lists or _has_trajectory(folder)


def _has_trajectory(folder: Path) -> bool:
    names = (name for name in subfolders(folder) if TRAJECTORY.fullmatch(name))
    return any({"vision", "tactile"} & set(subfolders(folder / name)) for name in names)


def _in_time(video: str) -> tuple[str, float, str]:
    """Sort key: rig, start (-1 if the name has none), name."""
    rig, _, folder = video.partition("/")
    match = TRAJECTORY.fullmatch(folder)
    return rig, float(match[1]) if match else -1.0, folder


def _read_lists(result: Scan, rigs: Sequence[str], lists: Path | None, contact: bool) -> Lists:
    """The samples of all lists, and what the two JSON files add."""
    samples, unlisted, untouched = list[Frame](), list[Frame](), list[Frame]()
    files: list[str] = []
    for rig in rigs:
        for part, path in tvl.part_lists((lists or result.base) / rig).items():
            files.append(f"{rig}/{path.name}")
            samples += _frames(result, tvl.read_list(result, path), rig, part)
        untouched += _frames(result, _json_rows(result, rig, "not_contact"), rig, None)
        unlisted += _frames(result, _json_rows(result, rig, "contact"), rig, None)
    if lists is not None and not samples:
        must = "must hold lists such as data1/train.csv"
        raise PalpateError(must, str(lists), "", argument="lists")
    known, resting = {frame.key for frame in samples}, {frame.key for frame in untouched}
    in_contact = known | {frame.key for frame in unlisted if frame.key not in resting}
    unlisted = [frame for frame in unlisted if frame.key not in known]
    both = [frame.where for frame in [*samples, *unlisted] if frame.key in resting]
    text = "not_contact.json calls them untouched; samples only where a list has them"
    tvl.suspect_rows(result, both, "contact-and-not", text)
    unlisted = [frame for frame in unlisted if frame.key not in resting]
    if contact:
        samples += unlisted
    else:
        text = "in contact.json but in no list, so no samples; contact=True includes them"
        tvl.suspect_rows(result, [f.where for f in unlisted], "unlisted-contact", text)
    pairs = [(f, f"{f.video}/tactile/{PurePosixPath(f.vision).name}") for f in samples]
    odd = [frame.where for frame, tactile in pairs if frame.tactile != tactile]
    text = "photo and tactile image differ in trajectory or file name"
    tvl.suspect_rows(result, odd, "unequal-names", text)
    result.facts["not_contact"] = f"{len(resting)} frames, no samples"
    samples.sort(key=lambda frame: (_in_time(frame.video), frame.number))
    return Lists(samples, in_contact, _by_video(untouched), files)


def _by_video(frames: Iterable[Frame]) -> dict[str, list[Frame]]:
    by_video: dict[str, list[Frame]] = defaultdict(list)
    for frame in frames:
        by_video[frame.video].append(frame)
    return by_video


def _json_rows(result: Scan, rig: str, name: str) -> list[Row]:
    """The rows of ``contact.json`` or ``not_contact.json``, with cells named as in the lists."""
    path = result.base / rig / f"{name}.json"
    data = read_json_file(result, path) if path.is_file() else {"vision": [], "tactile": []}
    if data is None:
        return []
    names = {"vision": "url", "tactile": "tactile", "background": "tactile_background"}
    lists = {names[k]: v for k, v in data.items() if k in names} if isinstance(data, dict) else {}
    is_list = [isinstance(v, list) and all(isinstance(p, str) for p in v) for v in lists.values()]
    if not {"url", "tactile"} <= set(lists) or not all(is_list):
        text = "not an object with lists of paths under vision and tactile"
        result.problem(path, "bad-json", text)
        return []
    if len({len(paths) for paths in lists.values()}) > 1:
        lengths = ", ".join(f"{len(paths)} {name}" for name, paths in lists.items())
        text = f"its lists differ in length ({lengths}), so what belongs together is unknown"
        result.problem(path, "unequal-lists", text)
        return []
    rows = zip(*lists.values(), strict=True)
    return [(f"{path}:{k}", dict(zip(lists, row, strict=True))) for k, row in enumerate(rows, 1)]


def _frames(result: Scan, rows: Iterable[Row], rig: str, part: str | None) -> list[Frame]:
    """The frames of rows; bad rows become problems."""
    frames: list[Frame] = []
    for where, cells in rows:
        url, tactile, background = (cells.get(n) for n in ("url", "tactile", "tactile_background"))
        if not url or not tactile:
            lacking = " and no ".join(name for name in ("url", "tactile") if not cells.get(name))
            result.problem(where, "empty-cell", f"no {lacking} path")
            continue
        pieces = _located(url, rig).split("/")
        number = FRAME.fullmatch(PurePosixPath(pieces[-1]).stem)
        if climbing := [p for p in (url, tactile, background) if p and re.search(CLIMBS, p)]:
            text = f"the path {climbing[0]!r} leaves the data set"
            result.problem(where, "outside-root", text)
        elif len(pieces) != 4:
            text = f"the path {url!r} is not trajectory/vision/frame.jpg"
            result.problem(where, "bad-path", text)
        elif number is None:
            text = f"{pieces[-1]!r} does not begin with a frame number and a dash"
            result.problem(where, "bad-frame", text)
        else:
            rig_name, folder = pieces[:2]
            paths = "/".join(pieces), _located(tactile, rig), background
            text = tvl.clean_caption(cells.get("caption"))
            video = f"{rig_name}/{folder}"
            frames.append(Frame(where, part, rig_name, video, int(number[1]), *paths, text))
    return frames


def _located(cell: str, rig: str) -> str:
    """A path that starts at the trajectory, ``dataN/`` or ``hct/``, relative to ``hct/``."""
    path = PurePosixPath(cell).as_posix().removeprefix("hct/")
    first = path.partition("/")[0]
    return path if first == rig or RIG.fullmatch(first) else f"{rig}/{path}"


def _swap(
    result: Scan, frames: Sequence[Frame], swap: Swap, progress: Progress
) -> tuple[list[Frame], set[str]]:
    """Report swapped trajectories; with ``fix`` their frames have their paths swapped back.

    Returns:
        The frames, and the videos that were fixed.
    """
    files: dict[str, tuple[list[Path], list[Path]]] = {}
    for video, group in _by_video(frames).items():
        some = [group[k] for k in sorted({0, len(group) // 2, len(group) - 1})]
        sides = [[result.base / getattr(f, side) for f in some] for side in ("vision", "tactile")]
        files[video] = sides[0], sides[1]
    seen = looks(files, progress)
    evidence: dict[str, str] = {}
    for rig in sorted({frame.rig for frame in frames}):
        of_rig = {video: pair for video, pair in seen.items() if video.startswith(f"{rig}/")}
        evidence |= swapped(of_rig, tvl.IMAGE_SIZE)
    done = "their paths were swapped back" if swap == "fix" else "swap='fix' swaps them back"
    for video, text in evidence.items():
        result.suspect(video, "swapped-folders", f"{text}; {done}")
    fixed = set(evidence) if swap == "fix" else set[str]()
    state = "fixed" if fixed else "as they are"
    result.facts["swapped_folders"] = f"{len(evidence)}, {state}" if evidence else "none"
    back = {f.where: replace(f, vision=f.tactile, tactile=f.vision) for f in frames}
    return [back[f.where] if f.video in fixed else f for f in frames], fixed


def _backgrounds(
    result: Scan,
    frames: Sequence[Frame],
    untouched: Mapping[str, Sequence[Frame]],
    fixed: Collection[str],
) -> list[str | None]:
    """The background of each frame by the rule above; the facts count how often each source served.

    The listed image of a fixed trajectory does not count: it was made of its vision.
    """

    @cache
    def is_file(name: str) -> bool:
        return (result.base / name).is_file()

    @cache
    def typical(video: str) -> str | None:
        side = "vision" if video in fixed else "tactile"
        return _typical(result.base, [getattr(f, side) for f in untouched.get(video, [])])

    def choose(frame: Frame) -> tuple[str, str | None]:
        listed = frame.background if frame.video not in fixed else None
        sources = [("as listed", name) for name in (listed and _located(listed, frame.rig), listed)]
        sources += [(FALLBACK, name) for name in (f"{frame.rig}/{FALLBACK}", FALLBACK)]
        for kind, name in sources:
            if name and is_file(name):
                return kind, name
        return ("untouched frame" if typical(frame.video) else "none"), typical(frame.video)

    chosen = [choose(frame) for frame in frames]
    for rig in sorted({frame.rig for frame in frames}):
        pairs = zip(frames, chosen, strict=True)
        bare = [frame.where for frame, (_, name) in pairs if frame.rig == rig and name is None]
        text = f"no image of the untouched gel, as none is listed and there is no {FALLBACK}"
        tvl.suspect_rows(result, bare, "no-background", text)
    kinds = sorted(Counter(kind for kind, _ in chosen).items())
    result.facts["backgrounds"] = ", ".join(f"{kind} {n}" for kind, n in kinds)
    return [name for _, name in chosen]


def _typical(root: Path, names: Sequence[str]) -> str | None:
    """Of up to 15 evenly spaced whole images the one nearest to their median, or None."""
    whole = [name for name in names if inside(root, name) and check_image(root / name) is None]
    places = np.linspace(0, len(whole) - 1, min(MEDIAN_OF, len(whole))).round().astype(int)
    some = [whole[k] for k in np.unique(places)]
    images = [np.asarray(read_image(root / name)) for name in some]
    if len({image.shape for image in images}) != 1:
        return None
    median = np.median(images, axis=0).astype(np.float32)
    return some[int(np.argmin([np.abs(image - median).mean() for image in images]))]
