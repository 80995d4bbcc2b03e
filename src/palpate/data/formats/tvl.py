"""What the two halves of Touch-Vision-Language (TVL), HCT and SSVTP, share: their lists, their captions, and how exchanged folders show.

**Lists** are ``train.csv`` and ``test.csv`` (``val.csv`` too, as palpate writes one). Their readers disagree: one goes by position,
one by name, one takes the first column for an index. So a first row without any picture's name is a header; if it names a
known column, columns go by name, and a first column of pictures with a foreign name is the ``url``; else columns of
pictures are, in order, vision, touch and background, and the first other column that is not all numbers is the caption.

**Captions** are adjectives between commas; spaces are trimmed, letters made small, full stops dropped.

**Exchanged folders**: where the two sides of a recording differ in size and one has the sensor's, that one is the touch. Where
sizes say nothing, colors do: each side becomes an 8 x 8 thumbnail (the mean of a few frames, RGB in [0, 1]). Untouched
gel looks alike in every recording of one rig, so the side whose thumbnails ``x`` spread less around their median ``c`` is the gel's, if it spreads less than
half as much. With ``d(x) = sqrt(mean((x - c)^2))`` a recording is exchanged if its picture named vision has ``d`` under half that of its touch,
and no more than three spreads (plus 0.02, five gray levels).
"""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import PARTS, PalpateError, Problem, Progress, write_text
from palpate.data.formats.base import Found
from palpate.data.images import BROKEN, SUFFIXES, in_threads

NAMED = ("url", "tactile", "tactile_background", "caption")
#: Fewer recordings than this make no typical gel and no typical size.
FEWEST = 3
THUMBNAIL = 8
CITATION = (
    "L. Fu, G. Datta, H. Huang, W. C.-H. Panitch, J. Drake, J. Ortiz, M. Mukadam, M. Lambeta, R. Calandra, K. Goldberg: "
    "A Touch, Vision, and Language Dataset for Multimodal Alignment. 2024, arXiv 2402.13232"
)
URL = "https://huggingface.co/datasets/mlfu7/Touch-Vision-Language-Dataset"
#: Of touch images as the TVL encoders see them, and un-padded; valid for that crop alone.
NORMALIZATION = {
    "touch, zero-padded to a square and turned by 90 degrees (TVL)": (
        (0.29175, 0.29713, 0.29104),
        (0.18764, 0.19468, 0.21872),
    ),
    "touch minus background, signed and without offset (TVL)": (
        (-0.00809, -0.01887, -0.01843),
        (0.04535, 0.04403, 0.05333),
    ),
    "touch, not padded, 50 images (T3)": ((0.42094, 0.44041, 0.44151), (0.14661, 0.08972, 0.09041)),
}


def part_lists(folder: Path) -> dict[str, Path]:
    """Part -> its list, for the lists that lie in a folder."""
    return {part: path for part in PARTS if (path := Path(folder) / f"{part}.csv").is_file()}


def read_csv(path: Path, problems: list[Problem], columns: Sequence[str] = NAMED) -> list[Found]:
    """Reads one list, by name or by position.

    Args:
        path: the file; a byte-order mark, Windows line ends and an absent last newline do not matter.
        problems: what is wrong goes here: rows of another width, bytes that are no UTF-8, an empty file, no column of photos.
        columns: the names to look for.

    Returns:
        (``file:line``, cells by the names of ``columns``), where absent columns are absent and empty cells are None.
    """
    reader = csv.reader(
        io.StringIO(path.read_bytes().decode("utf-8-sig", errors="replace"), newline="")
    )
    rows: list[tuple[str, list[str]]] = []
    start = 1
    try:
        for cells in reader:
            where, start = f"{path}:{start}", reader.line_num + 1
            if any(cell.strip() for cell in cells):
                rows.append((where, [cell.strip() for cell in cells]))
    except csv.Error as error:
        problems.append(
            Problem(
                f"{path}:{start}", "bad-row", f"not CSV, and nothing after it was read: {error}"
            )
        )
    if not rows:
        problems.append(Problem(str(path), "empty-list", "the list has no lines"))
        return []
    header = None if any(map(is_picture, rows[0][1])) else [name.lower() for name in rows.pop(0)[1]]
    if not rows:
        return []
    names = _columns(header, [cells for _, cells in rows], columns)
    if "url" not in names:
        problems.append(
            Problem(
                str(path),
                "missing-column",
                f"no column of photos (url) among {', '.join(header or []) or 'its cells'}",
            )
        )
        return []
    found: list[Found] = []
    for where, cells in rows:
        if len(cells) != len(names):
            problems.append(
                Problem(where, "bad-row", f"{len(cells)} cells in a list of {len(names)} columns")
            )
        elif any("\ufffd" in cell for cell in cells):
            problems.append(Problem(where, "bad-encoding", "the line is not UTF-8"))
        else:
            found.append(
                (
                    where,
                    {name: cell or None for name, cell in zip(names, cells, strict=True) if name},
                )
            )
    return found


def read_pairs(path: Path, problems: list[Problem]) -> list[Found]:
    """Reads ``contact.json`` or ``not_contact.json``: lists of paths of one length under ``vision``, ``tactile`` and perhaps ``background``.

    Returns:
        (``file:number``, cells named as in the lists: ``url, tactile, tactile_background``), numbers counting from 1.
    """
    data = _json(path, problems)
    if data is None:
        return []
    keys = {"vision": "url", "tactile": "tactile", "background": "tactile_background"}
    lists: dict[str, Any] = (
        {theirs: data[key] for key, theirs in keys.items() if key in data}
        if isinstance(data, dict)
        else {}
    )
    if not {"url", "tactile"} <= set(lists) or not all(
        isinstance(v, list) and all(isinstance(p, str) for p in v) for v in lists.values()
    ):
        problems.append(
            Problem(
                str(path), "bad-json", "not an object with lists of paths under vision and tactile"
            )
        )
        return []
    if len({len(v) for v in lists.values()}) > 1:
        told = ", ".join(f"{len(data[key])} {key}" for key in keys if key in data)
        problems.append(
            Problem(
                str(path),
                "unequal-lists",
                f"its lists differ in length ({told}), so what belongs together is unknown",
            )
        )
        return []
    return [
        (f"{path}:{k}", dict(zip(lists, cells, strict=True)))
        for k, cells in enumerate(zip(*lists.values(), strict=True), 1)
    ]


def read_conversations(path: Path, problems: list[Problem]) -> list[Found]:
    """Reads ``finetune.json``, ``[{image, tactile, tactile_background, conversations}]``; the answer that comes last is the caption."""
    data = _json(path, problems)
    if data is None:
        return []
    if not isinstance(data, list) or not all(
        isinstance(item, dict) and isinstance(item.get("image"), str) for item in data
    ):
        problems.append(Problem(str(path), "bad-json", "not a list of objects with an image"))
        return []
    found: list[Found] = []
    for k, item in enumerate(data, 1):
        talk = [
            turn.get("value")
            for turn in item.get("conversations") or []
            if isinstance(turn, dict) and turn.get("from") != "human"
        ]
        caption = talk[-1] if talk and isinstance(talk[-1], str) else None
        given = {
            "url": item["image"],
            "tactile": item.get("tactile"),
            "tactile_background": item.get("tactile_background"),
        }
        found.append(
            (
                f"{path}:{k}",
                {
                    **{
                        name: cell for name, cell in given.items() if isinstance(cell, str) and cell
                    },
                    "caption": caption,
                },
            )
        )
    return found


def clean_caption(text: str | None) -> str | None:
    """Adjectives between commas: trimmed, small letters, no full stops, no empty ones; None if none is left."""
    words = (" ".join(word.split()) for word in (text or "").replace(".", "").lower().split(","))
    return ", ".join(word for word in words if word) or None


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str | None]]) -> Path:
    """Writes one list with a header, atomically; None becomes an empty cell."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([cell or "" for cell in row] for row in rows)
    write_text(Path(path), out.getvalue())
    return Path(path)


def is_picture(cell: str) -> bool:
    """Whether a cell is the name of a picture."""
    return cell.strip().lower().endswith(SUFFIXES)


def summed(places: Sequence[str], kind: str, text: str) -> list[Problem]:
    """One problem for many rows alike, told as ``3 rows: <text>`` at the first of them; none for no rows."""
    return (
        [Problem(places[0], kind, f"{len(places)} row{'s' * (len(places) != 1)}: {text}")]
        if places
        else []
    )


@dataclass(frozen=True)
class Look:
    """What one side of a recording looks like.

    Attributes:
        size: (width, height) of its frames, in pixels.
        thumbnail: (8, 8, 3), 0 to 1, the mean of its frames.
    """

    size: tuple[int, int]
    thumbnail: NDArray[np.float64]


def look(paths: Sequence[Path]) -> Look | None:
    """Looks at a few frames; None if none of them can be read. A frame of another size than the first is passed over."""
    size: tuple[int, int] | None = None
    thumbnails: list[NDArray[np.float64]] = []
    for path in paths:
        try:
            with Image.open(path) as image:
                if size is None or image.size == size:
                    this = image.size
                    image.draft("RGB", (max(THUMBNAIL, this[0] // 8), max(THUMBNAIL, this[1] // 8)))
                    small = image.convert("RGB").resize(
                        (THUMBNAIL, THUMBNAIL), Image.Resampling.BOX
                    )
                    size = this
                    thumbnails.append(np.asarray(small, np.float64) / 255)
        except BROKEN:
            continue
    return None if size is None else Look(size, np.mean(thumbnails, axis=0))


def looks(
    files: Mapping[str, tuple[Sequence[Path], Sequence[Path]]], progress: Progress
) -> dict[str, tuple[Look, Look]]:
    """Recording -> (vision, touch) looks, from the frames given for both sides; unreadable recordings are left out."""
    found: dict[str, tuple[Look, Look]] = {}
    pairs = in_threads(lambda name: (look(files[name][0]), look(files[name][1])), files)
    for done, (name, (vision, touch)) in enumerate(pairs, 1):
        if vision is not None and touch is not None:
            found[name] = (vision, touch)
        progress("looking for exchanged folders", done, len(files))
    return {name: found[name] for name in files if name in found}


def exchanged(
    sides: Mapping[str, tuple[Look, Look]], touch_size: tuple[int, int]
) -> dict[str, str]:
    """Recordings of one rig whose vision and touch are exchanged, with the evidence, by the rule in the head of this file.

    Args:
        sides: recording -> (what is named vision, what is named touch).
        touch_size: (width, height) of the sensor's pictures.
    """
    usual = (
        tuple(Counter(pair[k].size for pair in sides.values()).most_common(1)[0][0] for k in (0, 1))
        if len(sides) >= FEWEST
        else None
    )
    found: dict[str, str] = {}
    alike: dict[str, tuple[Look, Look]] = {}
    for name, (vision, touch) in sides.items():
        if vision.size == touch.size:
            alike[name] = (vision, touch)
        elif vision.size == touch_size or (
            touch.size != touch_size and (touch.size, vision.size) == usual
        ):
            text = (
                "frames named vision are {}x{} pixels as touch should be, those named touch {}x{}"
            )
            found[name] = text.format(*vision.size, *touch.size)
    return found | _by_color(alike)


def _by_color(sides: Mapping[str, tuple[Look, Look]]) -> dict[str, str]:
    """Exchanged recordings among those whose sides have one size."""
    if len(sides) < FEWEST:
        return {}
    stacks = [np.stack([pair[k].thumbnail for pair in sides.values()]) for k in (0, 1)]
    centers = [np.median(stack, axis=0) for stack in stacks]
    spreads = [
        float(np.median(_distance(stack, center)))
        for stack, center in zip(stacks, centers, strict=True)
    ]
    gel = int(np.argmin(spreads))
    if not min(spreads) < 0.5 * max(spreads):
        return {}
    far = [_distance(stack, centers[gel]) for stack in stacks]
    found: dict[str, str] = {}
    for k, name in enumerate(sides):
        vision, touch = float(far[0][k]), float(far[1][k])
        if vision < 0.5 * touch and vision <= 3 * spreads[gel] + 0.02:
            found[name] = (
                f"colors of frames named vision are {vision:.3f} from this rig's typical gel, those named touch {touch:.3f}"
            )
    return found


def _distance(stack: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square difference of each thumbnail to one: (n,)."""
    return np.sqrt(((stack - center) ** 2).mean(axis=(1, 2, 3)))


def _json(path: Path, problems: list[Problem]) -> Any:
    try:
        return json.loads(path.read_bytes().decode("utf-8-sig"))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        problems.append(Problem(str(path), "bad-json", f"not JSON: {error}"))
        return None


def _columns(
    header: Sequence[str] | None, rows: Sequence[Sequence[str]], known: Sequence[str]
) -> list[str | None]:
    """What each column holds, or None where it holds nothing of use."""
    width = len(header) if header is not None else Counter(map(len, rows)).most_common(1)[0][0]
    cells = [[row[k] for row in rows if len(row) == width and row[k]] for k in range(width)]
    pictures = [2 * sum(map(is_picture, column)) > len(column) for column in cells]
    names: list[str | None] = [None] * width
    if header is not None and {"url", "tactile"} & set(header):
        for k, name in enumerate(header):
            names[k] = name if name in known and name not in names else None
        if "url" not in names and (
            free := [k for k in range(width) if names[k] is None and pictures[k]]
        ):
            names[free[0]] = "url"
        return names
    paths = [name for name in known if name != "caption"]
    for k in range(width):
        if pictures[k]:
            names[k] = paths.pop(0) if paths else None
        elif "caption" not in names and any(not cell.isdecimal() for cell in cells[k]):
            names[k] = "caption"
    return names


def require_option(name: str, value: object, allowed: Sequence[str]) -> None:
    """Refuses an option's value that is none of the allowed.

    Raises:
        PalpateError: naming them.
    """
    if value not in allowed:
        raise PalpateError(
            f"{name} must be one of {', '.join(allowed)}", repr(value), "Choose one of these"
        )
