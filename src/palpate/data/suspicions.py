"""Whole recordings, side by side: which of them a person should look at.

A recording has up to ``FRAMES`` frames of each side (photos, tactile images), evenly spaced and
reduced to 16 x 12 pixels. What it usually shows is the median of these, and a difference is the
root mean square over pixels, in gray levels. The recordings of one rig (equal domain and sensor as
far as they are known) look alike in touch, since one gel looks the same between presses; so the
distance to a side is that to the nearest quarter of the other recordings.

* ``exchanged-sides``: what should be photos is nearer to the tactile images of the others than half
  as far as to their photos, and its tactile images are over twice as far from theirs; or the two
  sides have the sizes of the other side in most recordings.
* ``channel-order``: with its colors in another order one side is less than half as far away, and
  not farther than twice what is usual.
* ``another-gel``: within a session where one is known, else a rig, the tactile images are over six
  times as far away as is usual, and by over 15 gray levels, over 10 in most pixels, as no contact
  is; at most a fifth of the recordings.
* ``startup-frames``: the mean color of up to a twentieth of the frames, the first ones, is by over
  25 gray levels another one, and the step after them is four times every later one.
* ``other-clock``: both sides of a recording are numbered without gaps, as many from another first
  number, or from the same one at other rates (by a fifth), and no time stamp says what is together.
* ``frozen-stream``: all photos, of at least 15 files, are one image, while the gel moves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import Problem, Progress
from palpate.data.contacts import Pixels
from palpate.data.images import SMALL, Checked, check_image, in_threads
from palpate.data.manifest import SIDES

#: Frames of a recording that are looked at.
FRAMES = 32
#: Recordings that each is compared with, evenly chosen.
COMPARED = 200
NEARER, FARTHER, LEAST = 0.5, 2.0, 10.0
GEL_TIMES, GEL_LEAST, GEL_SHARE = 6.0, 15.0, 0.2
EARLY, JUMP, JUMP_TIMES = 0.05, 25.0, 4.0
STILL_FRAMES = 15
CLOCKED, RATES = 8, 1.2
EXCHANGED, CLOCK = "exchanged-sides", "other-clock"
#: Columns that name a recording, and that say which recordings are of one rig.
LEVELS, RIG = ("video", "object", "contact"), ("domain", "sensor")
Row = Mapping[str, Any]
Medians = NDArray[np.float64]


@dataclass(frozen=True)
class Look:
    """What a recording looks like.

    Attributes:
        frames: side -> (n, 12, 16, 3) frames in order.
        first: side -> its first frame: a file, or of a video (48, 64, 3).
        sizes: side -> (width, height) of its images, in pixels, where they are files.
        rig, session: what recordings that are compared have in common.
    """

    frames: Mapping[str, Pixels]
    first: Mapping[str, Path | Pixels]
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    rig: tuple[str | None, ...] = ()
    session: str | None = None

    @classmethod
    def of_video(cls, images: Mapping[str, Pixels]) -> Look:
        """Of side -> thumbnails (n, 48, 64, 3)."""
        cells = {side: x.reshape(len(x), SMALL[1], 4, SMALL[0], 4, 3) for side, x in images.items()}
        means = {side: x.mean(axis=(2, 4)).round().astype(np.uint8) for side, x in cells.items()}
        return cls(means, {side: x[0] for side, x in images.items()})


def evenly(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Recording -> some of its rows; a row that names none is a recording of its own."""
    recordings: dict[str, list[Row]] = {}
    for row in rows:
        path = row.get("tactile") or row.get("vision") or ""
        name = next((row[level] for level in LEVELS if row.get(level) is not None), path)
        recordings.setdefault(name, []).append(row)
    for name, own in recordings.items():
        own.sort(key=lambda row: row.get("frame") or 0)
        recordings[name] = [own[k] for k in _spread(len(own), FRAMES)]
    return recordings


def looks_of(
    recordings: Mapping[str, Sequence[Row]], root: Path | None, checked: Mapping[str, Checked]
) -> dict[str, Look]:
    """Recording -> what it looks like, of those with images among the checked ones.

    Without ``root``, the folder of the images, they are no files.
    """
    looks: dict[str, Look] = {}
    for name, rows in recordings.items():
        paths = {side: dict.fromkeys(str(row.get(side)) for row in rows) for side in SIDES}
        usable = {side: [path for path in paths[side] if path in checked] for side in SIDES}
        there = {side: [checked[path] for path in own] for side, own in usable.items() if own}
        if there:
            looks[name] = Look(
                {side: np.stack([one.small for one in own]) for side, own in there.items()},
                {s: root / usable[s][0] if root else own[0].small for s, own in there.items()},
                {side: own[0].size for side, own in there.items()},
                tuple(rows[0].get(column) for column in RIG),
                rows[0].get("session"),
            )
    return looks


def looked_at(rows: Iterable[Row], root: Path, progress: Progress) -> dict[str, Look]:
    """Recording -> what it looks like, from some of its images."""
    recordings = evenly(rows)
    paths = {row[side] for own in recordings.values() for row in own for side in SIDES}
    check = lambda path: check_image(root / path)
    checks = in_threads(check, paths, "looking at recordings", progress)
    return looks_of(recordings, root, {p: checked for p, checked in checks if not checked.problem})


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """At most so many places in ``count``, evenly chosen, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def suspicions(looks: Mapping[str, Look]) -> list[Problem]:
    """What looks wrong with some recordings, by name."""
    problems = exchanged_sides(looks)
    odd = {problem.where for problem in problems}
    right = {name: look for name, look in looks.items() if name not in odd}
    for side in SIDES:
        for names, medians in _groups(right, side, lambda look: look.rig):
            for k, order in _orders(medians):
                text = f"{side} is like that of the others with the channels {order}, not RGB"
                problems.append(Problem(names[k], "channel-order", text))
    odd |= {problem.where for problem in problems}
    right = {name: look for name, look in looks.items() if name not in odd}
    for names, medians in _groups(right, "tactile", lambda look: (look.rig, look.session)):
        problems += _other_gels(names, medians)
    for name, look in looks.items():
        for side, frames in look.frames.items():
            if count := startup_frames(frames):
                text = f"the first {count} of {len(frames)} frames of {side} that were looked at "
                text += "have another color than those after them: a channel or the light was off"
                problems.append(Problem(name, "startup-frames", text))
        if _still(look):
            count = len(look.frames["vision"])
            text = f"{count} files of vision are the same image, while the gel moves"
            problems.append(Problem(name, "frozen-stream", text))
    return problems


def exchanged_sides(looks: Mapping[str, Look]) -> list[Problem]:
    """Recordings whose photos are tactile images, and the reverse, with how that is seen."""
    both = {name: look for name, look in looks.items() if set(look.frames) >= set(SIDES)}
    problems: list[Problem] = []
    photos, gels = (_groups(both, side, lambda look: look.rig) for side in SIDES)
    for (names, scenes), (_, touches) in zip(photos, gels, strict=True):
        sizes = [tuple(both[name].sizes.get(side) for side in SIDES) for name in names]
        usual = Counter(sizes).most_common(1)[0][0]
        like_gel, like_photos = (_distances(scenes, medians) for medians in (touches, scenes))
        own = _distances(touches, touches)
        for k, name in enumerate(names):
            if usual[0] != usual[1] and sizes[k] == usual[::-1]:
                text = "its vision has the size of tactile images, and its tactile that of vision"
            elif like_photos[k] > LEAST and (
                like_gel[k] < min(NEARER * like_photos[k], own[k] / FARTHER)
            ):
                text = f"its vision is like the tactile images of the others ({like_gel[k]:.0f} "
                text += f"gray levels away), its tactile is not ({own[k]:.0f})"
            else:
                continue
            problems.append(Problem(name, EXCHANGED, f"{text}: its sides are exchanged"))
    return problems


def startup_frames(frames: Pixels) -> int:
    """How many of the first of (n, h, w, 3) frames have another color than all later ones."""
    means = frames.reshape(len(frames), -1, 3).mean(axis=1)
    steps = np.abs(np.diff(means, axis=0)).max(axis=1)
    most = max(1, int(EARLY * len(frames)))
    if len(frames) < 10:
        return 0
    count = int(steps[:most].argmax()) + 1
    away = np.abs(means[:count] - np.median(means, axis=0)).max(axis=1)
    later = float(steps[count:].max())
    sudden = steps[count - 1] > max(JUMP, JUMP_TIMES * later)
    return count if sudden and (away > JUMP).all() else 0


def other_clocks(sides: Mapping[str, Sequence[tuple[str, Mapping[str, str]]]]) -> list[Problem]:
    """Recordings whose frames of equal number are of other times, by side -> (path, fields)."""
    every = [{n for _, fields in sides.get(side, ()) for n in fields} for side in SIDES]
    keys = sorted(set.intersection(*every) - {"frame"})
    numbers: dict[str, list[set[int]]] = {}
    for k, side in enumerate(SIDES):
        for path, fields in sides.get(side, ()):
            if "frame" in fields:
                name = "/".join(fields[key] for key in keys if key in fields) or path.split("/")[0]
                numbers.setdefault(name, [set(), set()])[k].add(int(fields["frame"]))
    problems: list[Problem] = []
    for name, both in numbers.items():
        ordered = [*map(sorted, both)]
        steps = {b - a for own in ordered for a, b in pairwise(own)}
        few, many = sorted(map(len, ordered))
        if few < CLOCKED or len(steps) > 1:
            continue
        spans = " and ".join(
            f"{own[0]} to {own[-1]} ({s})" for s, own in zip(SIDES, ordered, strict=True)
        )
        shift = abs(ordered[0][0] - ordered[1][0])
        if shift and few == many:
            text = f"as many frames are numbered {spans}: equal numbers may be {shift} apart"
        elif shift <= 1 and many >= RATES * few:
            text = (
                f"frames are numbered {spans}: of other rates, or one side ends early, and equal "
            )
            text += "numbers may be of other times. Time stamps in the names pair them"
        else:
            continue
        problems.append(Problem(name, CLOCK, text))
    return problems


def _still(look: Look) -> bool:
    photos, gel = (look.frames.get(side) for side in SIDES)
    if photos is None or gel is None or len(photos) < STILL_FRAMES or not look.sizes:
        return False
    return bool((photos == photos[0]).all()) and bool((gel != gel[0]).any())


def _groups(
    looks: Mapping[str, Look], side: str, key: Callable[[Look], object]
) -> list[tuple[list[str], Medians]]:
    """The recordings of each group that have a side, and what they usually show, (n, 576)."""
    groups: dict[object, dict[str, Look]] = {}
    for name, look in looks.items():
        if side in look.frames:
            groups.setdefault(key(look), {})[name] = look
    return [
        (
            list(own),
            np.stack([np.median(look.frames[side], axis=0).ravel() for look in own.values()]),
        )
        for own in groups.values()
    ]


def _other_gels(names: Sequence[str], medians: Medians) -> list[Problem]:
    """Recordings whose gel differs from that of the others."""
    far = _distances(medians, medians)
    usual = float(np.median(far))
    most = np.median(np.abs(medians - np.median(medians, axis=0)), axis=1)
    strange = np.flatnonzero((far > max(GEL_LEAST, GEL_TIMES * usual)) & (most > LEAST))
    if len(strange) > GEL_SHARE * len(far):
        return []
    text = "its tactile images differ by {:.0f} gray levels from those of the others, which do by "
    text += f"{usual:.0f}: another gel or sensor"
    return [Problem(names[k], "another-gel", text.format(far[k])) for k in strange.tolist()]


def _orders(medians: Medians) -> list[tuple[int, str]]:
    """Rows that are like the others with their channels in another order, and that order."""
    if len(medians) < 3:
        return []
    as_is = _distances(medians, medians)
    limits = np.minimum(NEARER * as_is, max(LEAST, FARTHER * float(np.median(as_is))))
    pixels, orders = medians.reshape(len(medians), -1, 3), list(permutations(range(3)))
    turned = [_distances(pixels[..., o].reshape(medians.shape), medians) for o in orders]
    best = np.argmin(turned, axis=0)
    rows = np.flatnonzero((as_is > LEAST) & (np.min(turned, axis=0) < limits)).tolist()
    return [(k, "".join("RGB"[c] for c in orders[best[k]])) for k in rows]


def _distances(images: Medians, medians: Medians) -> NDArray[np.float64]:
    """(n,) from image k to the nearest quarter of the rows but k; infinite without others."""
    rows = _spread(len(medians), COMPARED)
    compared = medians[rows]
    products = np.square(images).sum(axis=1)[:, None] - 2 * images @ compared.T
    squares = (products + np.square(compared).sum(axis=1)).clip(0) / images.shape[1]
    squares[rows, np.arange(len(rows))] = np.inf
    nearest = max(0, (len(rows) - 2) // 4)
    return np.sqrt(np.partition(squares, nearest, axis=1)[:, nearest])
