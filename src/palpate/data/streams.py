"""Whether the streams of a recording can be trusted: what a person should look at.

All checks see thumbnails (:mod:`palpate.data.contacts`), so a difference is in gray levels.

* ``frozen-stream``: at least 15 frames in a row that differ by at most 0.05 each, while most of the
  stream differs by more; or all frames, within 0.2 of their median image (a codec that begins anew
  at a key frame changes it a little), while the other stream moves. Sensors and cameras have noise;
  only a stalled one repeats itself.
* ``dropped-frames``: places where the timestamps leap by over 1.5 times their median step. Streams
  of a variable rate (the middle half of the steps differs by over a quarter) are not judged.
* ``unequal-streams``: photo and tactile videos whose lengths differ by over 2 %, at least 3 frames,
  or whose rates do: frame k of one is not the instant of frame k of the other.
* ``lag``: the change between frames of both streams, less its slow part, is correlated at all
  shifts of up to a third of the recording, at most 2 s at 30 fps. A shift of at least 3 frames is
  reported where its correlation is at least 0.6, and 0.25 above that of every shift more than 5
  frames away, 0 included. Where photos do not show the press (the camera looks elsewhere, or is
  shaken by hand), no shift is distinct and nothing is reported.
* ``contact-rate``: the share of pairs (frame in contact, frame not) of which the first differs more
  from the untouched gel is at most 0.7 for the contacts as they are numbered, and at least 0.9 and
  0.25 more if all numbers are multiplied by the ratio of two usual rates: they were counted at
  another rate than the frames.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from palpate.data.contacts import Pixels, contact_energy, find_reference

#: (kind, text) of what looks wrong.
Finding = tuple[str, str]
FROZEN, STILL, STILL_STREAM = 15, 0.05, 0.2
LEAP, VARIABLE = 1.5, 0.25
SHORTER, FEWEST = 0.02, 3
LONGEST_LAG, LEAST_LAG, CORRELATION, MARGIN, NEAR = 60, 3, 0.6, 0.25, 5
#: Usual rates over each other.
RATES = (1.0, 0.5, 2.0, 1 / 3, 3.0, 25 / 30, 30 / 25, 24 / 30, 30 / 24, 0.25, 4.0)
AS_NUMBERED, RESCALED, GAIN, FEWEST_CONTACTS = 0.7, 0.9, 0.25, 10
#: Shorter recordings are not correlated.
LEAST_FRAMES = 60


def findings(
    thumbnails: Mapping[str, Pixels],
    seconds: Mapping[str, NDArray[np.float64]],
    in_contact: Collection[int] = (),
) -> list[Finding]:
    """What looks wrong with one recording.

    Args:
        thumbnails: ``vision``, ``tactile`` or both -> (n, 48, 64, 3) frames in order.
        seconds: of those that are videos -> (n,) when each frame is presented.
        in_contact: frames that a list says are in contact.
    """
    changes = {name: changes_of(images) for name, images in thumbnails.items()}
    still = [name for name, images in thumbnails.items() if _is_still(images)]
    still = still if len(still) == 1 < len(thumbnails) else []
    problems = [p for n, change in changes.items() for p in _frozen(n, change, n in still)]
    problems += [p for name, times in seconds.items() for p in _dropped(name, times)]
    if len(changes) == 2:
        problems += _unequal(thumbnails, seconds) or lag_of(changes["tactile"], changes["vision"])
    if "tactile" in thumbnails and in_contact:
        problems += _rate(thumbnails["tactile"], in_contact)
    return problems


def changes_of(images: Pixels) -> NDArray[np.float64]:
    """(n - 1,) root mean square of the change to the next frame."""
    pairs = zip(images[1:], images[:-1], strict=True)
    return np.sqrt(
        [np.square(np.subtract(after, before, dtype=np.float32)).mean() for after, before in pairs]
    )


def _is_still(images: Pixels) -> bool:
    """Whether (n, 48, 64, 3) frames are one image."""
    median = np.median(images, axis=0)
    away = (np.square(np.subtract(x, median, dtype=np.float32)).mean() for x in images)
    return all(square <= STILL_STREAM**2 for square in away)


def _frozen(name: str, changes: NDArray[np.float64], throughout: bool) -> list[Finding]:
    still = np.pad((changes <= STILL) | throughout, 1)
    edges = np.flatnonzero(still[1:] != still[:-1]).reshape(-1, 2)
    longest = edges[np.diff(edges)[:, 0].argmax()] if len(edges) else [0, 0]
    count = int(longest[1] - longest[0]) + 1
    if count < FROZEN or (np.median(changes) <= STILL and count < len(changes) + 1):
        return []
    text = f"frames {longest[0]} to {longest[1]} of {name} are the same image ({count} of "
    return [("frozen-stream", f"{text}{len(changes) + 1} frames)")]


def _dropped(name: str, seconds: NDArray[np.float64]) -> list[Finding]:
    steps = np.diff(seconds)
    if len(steps) < FEWEST:
        return []
    step, spread = float(np.median(steps)), float(np.subtract(*np.quantile(steps, [0.75, 0.25])))
    leaps = np.flatnonzero(steps > LEAP * step)
    if not len(leaps) or spread > VARIABLE * step:
        return []
    lost = int((steps[leaps] / step).round().sum()) - len(leaps)
    text = f"by its timestamps {name} lacks {lost} frame{'s' * (lost != 1)} at {len(leaps)} "
    text += f"place{'s' * (len(leaps) != 1)}, the first after frame {leaps[0]}"
    return [("dropped-frames", text)]


def _unequal(
    thumbnails: Mapping[str, Pixels], seconds: Mapping[str, NDArray[np.float64]]
) -> list[Finding]:
    lengths = {name: len(images) for name, images in thumbnails.items()}
    short, long = sorted(lengths.values())
    if long - short >= max(FEWEST, SHORTER * long):
        text = " and ".join(f"{count} frames of {name}" for name, count in lengths.items())
        return [("unequal-streams", f"{text}: frame k may not be one instant in both")]
    rates = {name: 1 / float(np.median(np.diff(t))) for name, t in seconds.items() if len(t) > 1}
    if len(rates) == 2 and max(rates.values()) > (1 + SHORTER) * min(rates.values()):
        text = " and ".join(f"{rate:.3g} frames a second in {name}" for name, rate in rates.items())
        return [("unequal-streams", f"{text}: frame k is not one instant in both")]
    return []


def _rate(touch: Pixels, in_contact: Collection[int]) -> list[Finding]:
    from scipy.stats import rankdata  # most of a second, which no other verb has to wait

    ranks = rankdata(contact_energy(touch, touch[find_reference(touch)]))
    frames, numbers = np.arange(len(touch)), np.array(sorted(in_contact))

    def agreement(factor: float) -> float:
        """The share of pairs by ranks (Mann and Whitney); NaN where too few frames are compared."""
        inside = np.isin((frames / factor).round(), numbers)
        count, others = int(inside.sum()), int((~inside).sum())
        if min(count, others) < FEWEST_CONTACTS:
            return np.nan
        return float(ranks[inside].sum() - count * (count + 1) / 2) / (count * others)

    last = np.quantile(numbers, RESCALED)
    values = {rate: agreement(rate) for rate in RATES if last * rate < len(touch)}
    as_is, best = agreement(1.0), max(values, key=lambda r: np.nan_to_num(values[r]), default=1.0)
    if not as_is <= AS_NUMBERED or values.get(best, 0) < max(RESCALED, as_is + GAIN):
        return []
    text = f"the listed contacts fit the gel at {best:.3g} times their frame numbers "
    text += f"({values[best]:.2f} of pairs; {as_is:.2f} as they are): another frame rate"
    return [("contact-rate", text)]


def lag_of(tactile: NDArray[np.float64], vision: NDArray[np.float64]) -> list[Finding]:
    """The lag between the changes (n,) of two streams, if one is distinct."""
    count = min(len(tactile), len(vision))
    if count < LEAST_FRAMES:
        return []
    from scipy.ndimage import gaussian_filter1d as smooth

    # Changes over a frame or two, without the level of the second around.
    quick = lambda changes: smooth(changes, 1.5) - smooth(changes, 20)
    x, y = (quick(changes[:count]) for changes in (tactile, vision))
    most = min(LONGEST_LAG, count // 3)
    lags = np.arange(-most, most + 1)
    values = np.array([_correlation(x, y, int(lag)) for lag in lags])
    best = int(values.argmax())
    lag, elsewhere = int(lags[best]), values[np.abs(lags - lags[best]) > NEAR]
    second = max(float(elsewhere.max(initial=-1)), float(values[most]))
    if abs(lag) < LEAST_LAG or values[best] < max(CORRELATION, second + MARGIN):
        return []
    text = f"tactile changes {abs(lag)} frames {'after' if lag > 0 else 'before'} vision does "
    return [("lag", f"{text}(correlation {values[best]:.2f}; {values[most]:.2f} as they are)")]


def _correlation(x: NDArray[np.float64], y: NDArray[np.float64], lag: int) -> float:
    """Of x, ``lag`` frames later, with y."""
    a, b = x[max(0, lag) : len(x) + min(0, lag)], y[max(0, -lag) : len(y) - max(0, lag)]
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / np.sqrt((a @ a) * (b @ b) + 1e-9))
