"""What an audit asks, and what it can answer: one verdict a question, the worst for the whole.

===================  ============================================================================
question             answered by
===================  ============================================================================
shared recordings    the group of each sample: the same sample, the same video (object ...)
near in time         the frame numbers of one video
near-duplicates      images: the same bytes, nearly the same photo or tactile image
===================  ============================================================================

Each is *leaks* where a signal of its own that counts flags a sample; else *cannot tell* where more
than ``LARGEST`` of the samples cannot be judged; else *no leak found*. Equal names of unrelated
inputs, and samples of which nothing says what belongs together, are judged by their images where
these can be.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.core import Progress
from palpate.data.manifest import SIDES, Manifest
from palpate.leakage.content import shows_nothing
from palpate.leakage.signals import Flags, Gaps, leaking
from palpate.report.records import CANNOT_TELL, LEAKS, NO_LEAK, Question

#: In place of a group where none is known.
NO_GROUP = "none"
#: The share of samples that need not be judged.
LARGEST = 0.05


def questions(
    train: Manifest,
    test: Manifest,
    group: str,
    gaps: Gaps,
    flags: Sequence[Flags],
    *,
    equal: Collection[str],
    asked: bool,
    skipped: bool,
    progress: Progress,
) -> list[Question]:
    """Answer the three questions.

    Args:
        train: samples.
        test: those in question.
        group: what they must not share, or ``NO_GROUP``.
        gaps: the nearest train frames.
        flags: all signals.
        equal: columns in which names are equal that mean nothing.
        asked: whether images are to be compared.
        skipped: whether too many rows of the inputs were skipped to tell of any question.
        progress: callback.
    """
    near = [f for f in flags if f.kind.startswith("near-duplicate")]
    pictures = Question("near-duplicates", "", reason="no-images" if asked else "images-off")
    absent = [m for m in (train, test) if "images_absent" in m.facts]
    if asked and len(absent) == 1 and any(m.table[c].count() for m in (train, test) for c in SIDES):
        pictures = replace(pictures, verdict=CANNOT_TELL, of=len(test), reason="unreadable")
    if near:
        reason = next(filter(None, (_open_images(f, train, test, progress) for f in near)), "")
        files = [f for f in flags if f.kind == "identical bytes"]
        pictures = _judged("near-duplicates", [*files, *near], reason, len(test))
    names = ["identical sample", f"shared {group}"]
    recordings = _judged(
        "shared recordings",
        [f for f in flags if f.kind in names],
        _open_names(train, test, group, equal),
        len(test),
    )
    if recordings.verdict == CANNOT_TELL and recordings.reason in ("names", "ids"):
        if pictures.verdict == NO_LEAK:
            recordings = replace(recordings, verdict=NO_LEAK, reason="")
        elif pictures.reason in ("untouched", "similar", "unreadable"):
            recordings = replace(recordings, reason=pictures.reason)
    time = Question("near in time", "", reason="no-frames")
    if timed := [f for f in flags if f.kind == "time gap"]:
        unknown = _without_time(train, test, gaps)
        reason = "frames" if unknown > LARGEST * len(test) else ""
        time = _judged("near in time", timed, reason, len(test))
    return [
        replace(q, verdict=CANNOT_TELL, reason="skipped") if skipped and q.verdict == NO_LEAK else q
        for q in (recordings, time, pictures)
    ]


def _judged(name: str, flags: Sequence[Flags], reason: str, count: int) -> Question:
    """A question by its signals; ``reason``: why too many samples cannot be judged, or ''."""
    leaks = int(leaking(flags, count).sum())
    verdict = LEAKS if leaks else CANNOT_TELL if reason else NO_LEAK
    checked = max((f.checked for f in flags), default=0)
    return Question(name, verdict, leaks, checked, count, reason)


def _open_names(train: Manifest, test: Manifest, group: str, equal: Collection[str]) -> str:
    """Why shared recordings cannot be told by names; '' if they can."""
    if group == NO_GROUP:
        return "names" if equal else "ids"
    if group in equal:
        return "names"
    nulls = (m.table[group].null_count() > LARGEST * len(m) for m in (train, test))
    return "nulls" if any(nulls) else ""


def _without_time(train: Manifest, test: Manifest, gaps: Gaps) -> int:
    """Test samples of which nobody knows how far from train they are."""
    videos = test.table["video"]
    shared = videos.is_in(train.table["video"].drop_nulls().unique().implode())
    known: NDArray[np.bool_] = (~shared).fill_null(False).to_numpy() | (gaps.frames >= 0)
    return int((~known).sum())


def _open_images(flags: Flags, train: Manifest, test: Manifest, progress: Progress) -> str:
    """Why near-duplicates of one modality cannot be told; '' if they can."""
    column = flags.kind.split()[-1]
    codes = {note.code for note in flags.notes}
    if flags.unread > LARGEST:
        return "unreadable"
    if "cannot-tell-untouched" in codes or shows_nothing([train, test], column, progress):
        return "untouched" if column == "tactile" else "similar"
    if flags.verdict == CANNOT_TELL:
        return "chance"
    blank = len(test) - flags.checked
    return "untouched" if blank > LARGEST * len(test) else ""
