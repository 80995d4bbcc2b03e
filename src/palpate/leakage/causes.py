"""Why two pictures look alike, if it is not what they show.

* :func:`blank_matches`: pictures that show nothing are compared among themselves, as they are, and never count as content.
* :func:`gel_at_other_times`: with b the background that was taken off a touch, and b' another background of the same video, b' - b is what the passive gel
  has become at another time. A touch that is as like such a difference as it is like its match owes the likeness to the gel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.leakage.background import planar, remove_background
from palpate.leakage.pool import Pool, quantized, small_pictures
from palpate.leakage.search import nearest
from palpate.leakage.verify import BLOCK, Floats, Ints, band_pass, similarities

#: Root mean square difference of two blank thumbnails at which their score is 0, in gray levels.
FAR = 32.0
#: Root mean square difference up to which two backgrounds show one gel at two times, in gray levels.
ONE_GEL = 12.0
#: Backgrounds of a video that a touch is compared with.
OTHERS = 16


def blank_matches(
    pool: Pool,
    queries: Ints,
    base: Ints,
    score: Floats,
    place: Ints,
    cause: NDArray[np.str_],
    threshold: float,
) -> tuple[Floats, Ints, NDArray[np.str_]]:
    """Replaces the results of blank test pictures by their nearest blank train picture.

    Args:
        pool: the pictures.
        queries: (q,) pictures of test.
        base: (m,) pictures of train.
        score: (q,) scores of content.
        place: (q,) matches among ``base``.
        cause: (q,) causes so far.
        threshold: score from which a cause is named.

    Returns:
        score, place and cause; a blank picture without a blank counterpart keeps its match with score 0.
    """
    blank, others = np.flatnonzero(pool.blank[queries]), np.flatnonzero(pool.blank[base])
    if not len(blank):
        return score, place, cause
    score, place, cause = score.copy(), place.copy(), cause.copy()
    score[blank], cause[blank] = np.where(np.isnan(score[blank]), np.nan, 0), ""
    if len(others):
        pixels = pool.thumbs.pixels
        found = nearest(
            small_pictures(pixels, pool.thumb[queries[blank]]),
            small_pictures(pixels, pool.thumb[base[others]]),
            1,
        )
        alike = np.clip(1 - found.distance[:, 0] / FAR, 0, 1)
        score[blank], place[blank] = alike, others[found.index[:, 0]]
        cause[blank] = np.where(alike >= threshold, "nothing touched", "")
    return score, place, cause


def gel_at_other_times(pool: Pool, items: Ints, videos: Ints) -> Floats:
    """The highest similarity of each touch with the difference of its background from another one of its video; 0 where no other is known.

    Args:
        pool: the pictures, with backgrounds.
        items: (n,) touches.
        videos: (n,) their videos; -1 where unknown.
    """
    out = np.zeros(len(items), np.float32)
    if pool.background is None:
        return out
    found, row = pool.background
    known = np.unique(
        np.stack([pool.videos, found.row], axis=1)[(pool.videos >= 0) & found.own], axis=0
    )
    for start in range(0, len(items), BLOCK // OTHERS):
        block = items[start : start + BLOCK // OTHERS]
        at, other = _others(known, videos[start : start + len(block)], row[block])
        if not len(at):
            continue
        mine = row[block[at]]
        near = (
            np.linalg.norm(
                small_pictures(found.pixels, other) - small_pictures(found.pixels, mine), axis=1
            )
            <= ONE_GEL
        )
        at, other = at[near], other[near]
        if not len(at):  # the camera or the light changed: no other background shows this gel
            continue
        touches = band_pass(pool.planes(block))
        gel = band_pass(
            remove_background(planar(found.pixels[other]), planar(found.pixels[row[block[at]]]))
        )
        both = quantized(np.concatenate([touches, gel]))
        values = similarities(both, at, len(block) + np.arange(len(at)))
        np.maximum.at(out, start + at, values)
    return out


def _others(known: Ints, videos: Ints, own: Ints) -> tuple[Ints, Ints]:
    """For each touch up to ``OTHERS`` different backgrounds of its video: (number of the touch, background), touch by touch."""
    at: list[Ints] = []
    other: list[Ints] = []
    for k, (video, mine) in enumerate(zip(videos.tolist(), own.tolist(), strict=True)):
        low, high = np.searchsorted(known[:, 0], [video, video + 1]) if video >= 0 else (0, 0)
        rows = known[low:high, 1]
        rows = rows[rows != mine]
        if len(rows) > OTHERS:
            rows = rows[np.linspace(0, len(rows) - 1, OTHERS).astype(np.int64)]
        at.append(np.full(len(rows), k, np.int64))
        other.append(rows.astype(np.int64))
    return (
        (np.concatenate(at), np.concatenate(other))
        if at
        else (np.zeros(0, np.int64), np.zeros(0, np.int64))
    )
