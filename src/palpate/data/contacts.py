"""Contacts in a tactile video: which frame shows the untouched gel, and when it is pressed.

1. Every frame becomes a *thumbnail* of 64 x 48, slightly blurred. The mean of each channel is
   subtracted, so that a change of brightness is no contact.
2. The *reference* is the frame of the untouched gel. The gel looks the same between presses, while
   no two presses do: so it is the frame most similar to frames at other times (at least a tenth of
   the video away; of at most 200 evenly spaced frames the one whose neighbor at the 5 % rank is
   nearest). A gel that is untouched for less than 5 % of the video, or pressed at rest for longer
   than it is free, must be given as an image.
3. The *contact energy* of a frame is the root mean square difference to the reference, in gray
   levels.
4. A *contact* is a peak of the energy (median over 5 frames). It must rise by three tenths of the
   98 % quantile, by 1 gray level, and by 4 times the change between frames of the quietest quarter.
   It lasts while the energy is above the middle between the peak and the lowest point on that side,
   so that a gel that recovers slowly does not join two presses.
5. The *background* of a contact is the last frame before it that is nearly at rest (within a tenth
   of the way up to the peak), or the reference if there is none.

Measured on five real clips of Touch and Go (``benchmarks/contacts.py``, commit 2254ad9).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]
#: (width, height) of a thumbnail.
SIZE = (64, 48)
#: Frames that are compared for the reference, how far apart, and which neighbor counts.
SAMPLED, APART, NEIGHBOR = 200, 0.1, 0.05
#: Least height of a contact: share of the strongest, gray levels, times the noise.
PROMINENCE, LEAST, TIMES_NOISE = 0.3, 1.0, 4.0
#: Frames that are worked on at once.
CHUNK = 512
#: Where a contact begins, and up to where the gel is at rest, from trough to peak.
HALF, REST = 0.5, 0.1


@dataclass(frozen=True)
class Contacts:
    """What :func:`find_contacts` found; frames are positions in the video."""

    energy: Floats  # (n,) contact energy, in gray levels
    reference: int  # the frame that shows the untouched gel
    runs: list[tuple[int, int]]  # (first, last) frame of each contact, both included
    backgrounds: list[int]  # for each contact the frame that shows the gel before it
    height: float  # how far a contact rises above the frames around it at least, in gray levels

    def why_none(self) -> str:
        """Why there is no contact, in words."""
        return (
            f"no contact was found: frames differ from frame {self.reference} by at most "
            f"{self.energy.max():.1f} gray levels, and a contact stands out by {self.height:.1f}"
        )


def thumbnail(image: Any) -> Pixels:
    """(48, 64, 3) of an image or (h, w, 3), each pixel the mean of those that it covers."""
    picture = image if isinstance(image, Image.Image) else Image.fromarray(image)
    return np.asarray(picture.convert("RGB").resize(SIZE, Image.Resampling.BOX))


def find_contacts(
    thumbnails: Pixels, reference: int | None = None, *, gel: Pixels | None = None
) -> Contacts:
    """Find the contacts of one video.

    Args:
        thumbnails: (n, 48, 64, 3) frames in order, 0 to 255; at least one.
        reference: the frame that shows the untouched gel, if it is known.
        gel: (48, 64, 3) the untouched gel, if there is an image of it; the reference is then the
            frame most like it.
    """
    if gel is not None:
        energy = contact_energy(thumbnails, gel)
        reference = int(energy.argmin())
    else:
        reference = find_reference(thumbnails) if reference is None else reference
        energy = contact_energy(thumbnails, thumbnails[reference])
    from scipy.ndimage import median_filter  # as below: no other verb has to wait for it

    smooth = median_filter(energy, 5, mode="nearest")
    strong = PROMINENCE * float(np.quantile(smooth, 0.98))
    height = max(strong, LEAST, TIMES_NOISE * _noise(thumbnails))
    runs, backgrounds = _contacts(smooth, height, reference)
    return Contacts(energy, reference, runs, backgrounds, height)


def contact_energy(thumbnails: Pixels, reference: Pixels) -> Floats:
    """(n,) contact energy of thumbnails (n, 48, 64, 3) against one of the untouched gel."""
    gel = _shapes(reference[None])
    parts = (thumbnails[k : k + CHUNK] for k in range(0, len(thumbnails), CHUNK))
    return np.concatenate([_distances(_shapes(part), gel) for part in parts])


def find_reference(thumbnails: Pixels) -> int:
    """The frame that most resembles frames at other times, of (n, 48, 64, 3)."""
    count = len(thumbnails)
    sampled = np.unique(np.linspace(0, count - 1, min(count, SAMPLED)).round().astype(np.int64))
    x = _shapes(thumbnails[sampled])
    squares = np.square(x).sum(axis=1)
    distances = squares[:, None] + squares - 2 * x @ x.T
    places = np.arange(len(x))
    distances[np.abs(places[:, None] - places) <= APART * len(x)] = np.inf
    nearest = np.sort(distances, axis=1)[:, max(0, int(NEIGHBOR * len(x)) - 1)]
    return int(sampled[nearest.argmin()])


def rest_before(energy: Floats, first: int, after: int, peak: float) -> int | None:
    """The last frame between ``after`` and ``first``, both excluded, that is at rest; or None.

    ``energy`` is (n,); the contact begins at ``first`` and rises to ``peak``; ``after`` is the last
    frame of the contact before it, -1 if there is none.
    """
    gap = energy[after + 1 : first]
    if not len(gap) or gap.min() > HALF * peak:
        return None
    level = gap.min() + REST * (peak - gap.min())
    return after + 1 + int(np.flatnonzero(gap <= level)[-1])


def _shapes(thumbnails: Pixels) -> Floats:
    """(n, 48 * 64 * 3): blurred, without the mean of each channel."""
    from scipy.ndimage import gaussian_filter

    blurred = gaussian_filter(thumbnails.astype(np.float32), (0, 1, 1, 0))
    return (blurred - blurred.mean(axis=(1, 2), keepdims=True)).reshape(len(blurred), -1)


def _distances(frames: Floats, reference: Floats) -> Floats:
    return np.sqrt(np.square(frames - reference).mean(axis=1))


def _noise(thumbnails: Pixels) -> float:
    """Change between frames in the quietest quarter of the video, of at most 200 pairs."""
    last = len(thumbnails) - 1
    k = np.unique(np.linspace(0, max(0, last - 1), min(last, SAMPLED)).round().astype(np.int64))
    changes = _distances(_shapes(thumbnails[k + 1]), _shapes(thumbnails[k])) if len(k) else [0]
    return float(np.quantile(changes, 0.25))


def _contacts(
    smooth: Floats, height: float, reference: int
) -> tuple[list[tuple[int, int]], list[int]]:
    """First and last frame of each contact, and its background, by the smooth energy."""
    from scipy.signal import find_peaks  # seconds, which no other verb has to wait

    # The gel is taken as untouched before the video and after it.
    peaks: list[int] = []
    for peak in (find_peaks(np.pad(smooth, 1), prominence=height)[0] - 1).tolist():
        # Equal peaks have no trough between them for scipy.
        if not peaks or smooth[peaks[-1] : peak].min() <= smooth[peak] - height:
            peaks.append(peak)
    troughs = [0, *(a + int(smooth[a:b].argmin()) for a, b in pairwise(peaks)), len(smooth) - 1]
    runs: list[tuple[int, int]] = []
    backgrounds: list[int] = []
    after = -1
    for peak, (low, high) in zip(peaks, pairwise(troughs), strict=False):
        first = peak - _reach(smooth[low : peak + 1][::-1], height)
        last = peak + _reach(smooth[peak : high + 1], height)
        quiet_frame = rest_before(smooth, first, after, float(smooth[peak]))
        runs.append((first, last))
        backgrounds.append(reference if quiet_frame is None else quiet_frame)
        after = last
    return runs, backgrounds


def _reach(slope: Floats, height: float) -> int:
    """How far a contact reaches from its peak, ``slope[0]``, down to the trough of that side.

    A video that begins or ends within a contact has no trough there: it is that of the reference.
    """
    trough = float(slope.min()) if slope[0] - slope.min() >= height else 0.0
    below = np.flatnonzero(slope < trough + HALF * (slope[0] - trough))
    return int(below[0]) - 1 if len(below) else len(slope) - 1
