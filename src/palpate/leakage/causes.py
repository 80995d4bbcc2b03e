"""Why two images are similar, if it is not what they show.

* :func:`blank_matches`: images that show nothing are compared among themselves, as they are, and
  never count as content.
* :func:`gel_similarity`: with b the background that was removed from a tactile image, and b'
another
  background of the same video, b' - b is what the passive gel has become at another time. An image
  that is as similar to such a difference as to its match owes the similarity to the gel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.leakage.background import planar, remove_background
from palpate.leakage.correlation import BLOCK, Floats, Ints, band_pass, similarities
from palpate.leakage.matches import Entries, Matches
from palpate.leakage.neighbors import nearest
from palpate.leakage.pool import Pool, quantized, small_images

#: Root mean square difference of two blank thumbnails at which their score is 0, in gray levels.
FAR = 32.0
#: Root mean square difference up to which two backgrounds show one gel at two times, in gray
#: levels.
ONE_GEL = 12.0
#: Backgrounds of a video that an image is compared with.
OTHERS = 16


def blank_matches(pool: Pool, base: Entries, queries: Entries, matches: Matches) -> Matches:
    """Replace the matches of blank test images by their nearest blank train image.

    Their score is 1 - (root mean square difference of the thumbnails) / 32 gray levels; 0 without a
    blank counterpart.
    """
    blank = np.flatnonzero(pool.blank[queries.item])
    others = np.flatnonzero(pool.blank[base.item])
    if not len(blank):
        return matches
    score, place, cause = matches.score.copy(), matches.place.copy(), matches.cause.copy()
    score[blank], cause[blank] = np.where(np.isnan(score[blank]), np.nan, 0), ""
    if len(others):
        x, y = (
            small_images(pool.pixels, pool.thumb[entries.item[rows]])
            for entries, rows in ((queries, blank), (base, others))
        )
        index = nearest(x, y)[:, 0]
        score[blank] = np.clip(1 - np.linalg.norm(x - y[index], axis=1) / FAR, 0, 1)
        place[blank] = others[index]
        over = score[blank] >= matches.calibration.threshold
        cause[blank] = np.where(over, "nothing touched", "")
    return replace(matches, score=score, place=place, cause=cause)


def gel_similarity(pool: Pool, entries: Entries) -> Floats:
    """(e,) the highest similarity of each image with a change of its gel; 0 where unknown."""
    highest = np.zeros(len(entries), np.float32)
    gel = pool.backgrounds
    if gel is None:
        return highest
    recorded = (pool.videos >= 0) & gel.recorded
    known = np.unique(np.stack([pool.videos, gel.row], axis=1)[recorded], axis=0)
    for start in range(0, len(entries), BLOCK // OTHERS):
        items = entries.item[start : start + BLOCK // OTHERS]
        videos, behind = entries.videos[start : start + len(items)], pool.behind[items]
        at, other = _other_backgrounds(known, videos, behind)
        change = small_images(gel.pixels, other) - small_images(gel.pixels, behind[at])
        near = np.linalg.norm(change, axis=1) <= ONE_GEL
        at, other = at[near], other[near]
        if not len(at):  # the camera or the light changed: no other background shows this gel
            continue
        later = remove_background(planar(gel.pixels[other]), planar(gel.pixels[behind[at]]))
        both = quantized(np.concatenate([band_pass(pool.planes(items)), band_pass(later)]))
        values = similarities(both, at, len(items) + np.arange(len(at)))
        np.maximum.at(highest, start + at, values)
    return highest


def _other_backgrounds(known: Ints, videos: Ints, behind: Ints) -> tuple[Ints, Ints]:
    """For each image up to ``OTHERS`` other backgrounds of its video: (image, background)."""
    at, other = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for k, (video, row) in enumerate(zip(videos.tolist(), behind.tolist(), strict=True)):
        low, high = np.searchsorted(known[:, 0], [video, video + 1]) if video >= 0 else (0, 0)
        rows = known[low:high, 1]
        rows = rows[rows != row]
        if len(rows) > OTHERS:
            rows = rows[np.linspace(0, len(rows) - 1, OTHERS).astype(np.int64)]
        at.append(np.full(len(rows), k, np.int64))
        other.append(rows)
    return np.concatenate(at), np.concatenate(other)
