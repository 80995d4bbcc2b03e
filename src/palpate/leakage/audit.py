"""The audit of a split: which test samples share a group with train, and how near in time they lie to it.

For a test sample at frame f of video v, with F_v the train frames of v, the *gap* is ``min |f - g|`` over
``g in F_v``. Frames of one touch are alike within about a second (30 frames at 30 fps), frames of one video
within many, so a small gap means that the test picture was almost seen in training (paper, section 5).

Needs no pictures: ids, videos and frame numbers are enough, so two bare list files can be audited.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from palpate.core import Audit, LeakPair, PalpateError, Problem, ProblemsError, Split
from palpate.data.listing import FrameList, read_list
from palpate.data.manifest import Manifest

GROUPS = ("video", "touch", "object", "session", "domain", "sensor")
#: Right-open bins of the gap histogram, in frames; 30 frames are one second of Touch and Go.
GAP_EDGES = (0, 1, 3, 10, 30, 60, 90, 150, 300, 600, 900, 1800, 3600)


def audit_split(manifest: Manifest, split: Split, *, group: str = "video", name: str = "", worst: int = 12) -> Audit:
    """Audits the test part of a split against its train part.

    Args:
        manifest: the samples; the split's ids must be in it.
        split: the split.
        group: column that must not be shared (one of ``GROUPS``).
        name: heading for reports.
        worst: how many of the nearest pairs to keep.

    Raises:
        PalpateError: on an unknown group, an id that the manifest lacks, or an empty train or test part.
    """
    result = audit_parts(manifest.part(split, "train"), manifest.part(split, "test"), group=group, name=name, worst=worst)
    notes = list(result.notes)
    if split.manifest is not None and split.manifest != manifest.digest:
        notes.append("The split was made for another manifest (the digests differ).")
    if unused := len(manifest) - len(split.parts):
        notes.append(f"{unused} of {len(manifest)} samples of the manifest are in no part of the split.")
    if (val := manifest.part(split, "val")).table.height:
        shared = set(val.column(group)) & set(manifest.part(split, "train", "test").column(group)) - {None}
        if shared:
            notes.append(
                f"{len(shared)} {group} groups of the validation part occur in train or test as well: choosing a checkpoint on it leaks."
            )
    return replace(result, split=split.digest, notes=notes)


def audit_parts(train: Manifest, test: Manifest, *, group: str = "video", name: str = "", worst: int = 12) -> Audit:
    """Audits test samples against train samples, given as two manifests (see :func:`audit_split`)."""
    if group not in GROUPS:
        raise PalpateError(f"The group must be one of {', '.join(GROUPS)}", repr(group), "Pass e.g. --group video")
    for part, rows in (("train", train), ("test", test)):
        if not len(rows):
            raise PalpateError(f"The {part} part must hold samples", "none", "Check the split or list file")
    a, b = train.table, test.table
    known = a[group].drop_nulls(), b[group].drop_nulls()
    if not len(known[0]) or not len(known[1]):
        raise PalpateError(
            f"Both parts must know the {group} of some samples",
            f"a {group} column of nulls",
            f"Audit by another group: --group {'|'.join(GROUPS)}",
        )
    groups_a, groups_b = set(known[0].unique()), set(known[1].unique())
    shared = sorted(groups_a & groups_b)
    in_shared = int(b[group].is_in(shared).fill_null(False).sum())
    nearest, gaps = nearest_in_video(a, b)
    found = gaps[gaps >= 0]
    last = int(found.max()) if found.size else 0
    edges = [e for e in GAP_EDGES if e <= last] + [last + 1] if found.size else []
    notes = [
        f"{count} {part} samples have no {group}: they cannot be audited by group and count as not shared."
        for part, table in (("train", a), ("test", b))
        if (count := table[group].null_count())
    ]
    return Audit(
        name=name, group=group, train_samples=a.height, test_samples=b.height, groups_train=len(groups_a), groups_test=len(groups_b),
        groups_shared=len(shared), test_samples_in_shared_groups=in_shared, leaked_fraction=round(in_shared / b.height, 5),
        identical_samples=int((b["id"].is_in(a["id"].implode()).to_numpy() | (gaps == 0)).sum()),
        gap_min=int(found.min()) if found.size else None,
        gap_median=_plain(np.median(found)) if found.size else None,
        gap_max=last if found.size else None,
        gap_edges=edges, gap_counts=[int(n) for n in np.histogram(found, edges)[0]] if edges else [],
        worst=_worst_pairs(train, test, group, shared, nearest, gaps, worst),
        materials=_materials(a, b, group), notes=notes,
    )  # fmt: skip


def nearest_in_video(train: pl.DataFrame, test: pl.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """For each test row the nearest train row of the same video.

    Returns:
        (row, gap): int64 arrays (test rows,); row number in ``train`` and distance in frames, both -1 where
        the video or the frame is unknown or train has none of that video.
    """
    row, gap = np.full(test.height, -1, np.int64), np.full(test.height, -1, np.int64)
    videos = pl.concat([train["video"], test["video"]]).unique().drop_nulls().sort()
    code = {v: k for k, v in enumerate(videos.to_list())}
    place: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for table in (train, test):
        use = table["video"].is_not_null() & table["frame"].is_not_null()
        at = np.flatnonzero(use.to_numpy())
        part = table.filter(use)
        place.append((at, np.array([code[v] for v in part["video"].to_list()], np.int64), part["frame"].to_numpy().astype(np.int64)))
    (at_a, video_a, frame_a), (at_b, video_b, frame_b) = place
    if not at_a.size or not at_b.size:
        return row, gap
    # One sorted axis for all videos: the stride keeps the frames of two videos apart.
    low = min(int(frame_a.min()), int(frame_b.min()))
    stride = max(int(frame_a.max()), int(frame_b.max())) - low + 1
    key_a, key_b = video_a * stride + frame_a - low, video_b * stride + frame_b - low
    order = np.argsort(key_a, kind="stable")
    right = np.searchsorted(key_a[order], key_b)
    best = np.full(at_b.size, np.iinfo(np.int64).max)
    for step in (right - 1, right):
        inside = (step >= 0) & (step < order.size)
        candidate = order[np.clip(step, 0, order.size - 1)]
        distance = np.where(inside & (video_a[candidate] == video_b), np.abs(frame_a[candidate] - frame_b), np.iinfo(np.int64).max)
        better = distance < best
        best = np.where(better, distance, best)
        row[at_b[better]] = at_a[candidate[better]]
    gap[at_b] = np.where(best == np.iinfo(np.int64).max, -1, best)
    return row, gap


def _plain(value: Any) -> float | int:
    """A whole median as an int, so that 304.0 reads 304."""
    return int(value) if float(value).is_integer() else float(value)


def _worst_pairs(
    train: Manifest, test: Manifest, group: str, shared: Sequence[str], nearest: np.ndarray, gaps: np.ndarray, count: int
) -> list[LeakPair]:
    """The test samples nearest to train: the worst of each video first, then the rest, by gap."""
    order = np.flatnonzero(gaps >= 0)
    order = order[np.argsort(gaps[order], kind="stable")]
    videos = test.table["video"].to_list()
    first: dict[str, int] = {}
    for k in order:
        first.setdefault(videos[int(k)], int(k))
    chosen = [*first.values(), *(int(k) for k in order if first[videos[int(k)]] != int(k))][:count]
    pairs = [(k, int(nearest[k]), int(gaps[k])) for k in chosen]
    if not pairs and shared:  # no frame numbers: a shared group is still a pair worth seeing
        in_train = {g: k for k, g in reversed(list(enumerate(train.table[group].to_list())))}
        in_test = {g: k for k, g in reversed(list(enumerate(test.table[group].to_list())))}
        pairs = [(in_test[g], in_train[g], None) for g in shared[:count]]
    return [LeakPair(test.ref(test.table.row(k, named=True)), train.ref(train.table.row(j, named=True)), gap) for k, j, gap in pairs]


def _materials(train: pl.DataFrame, test: pl.DataFrame, group: str) -> list[Mapping[str, Any]]:
    """Samples and groups of each material on both sides."""
    names = sorted(set(train["material"].drop_nulls()) | set(test["material"].drop_nulls()))
    rows: list[Mapping[str, Any]] = []
    for name in names:
        a, b = train.filter(pl.col("material") == name), test.filter(pl.col("material") == name)
        rows.append({
            "material": name, "train": a.height, "test": b.height,
            "groups_train": a[group].drop_nulls().n_unique(), "groups_test": b[group].drop_nulls().n_unique(),
        })  # fmt: skip
    return rows


def audit_lists(train: Path, test: Path, *, group: str = "video", worst: int = 12, skip_bad: bool = False) -> tuple[Audit, list[str]]:
    """Audits two bare list files (``video/frame.jpg,label`` a line); no pictures are needed.

    Returns:
        The audit, and a line for each row that ``skip_bad`` left out.

    Raises:
        ProblemsError: every bad line of both files, unless ``skip_bad``.
    """
    problems: list[Problem] = []
    lists: list[FrameList] = []
    for path in (train, test):
        try:
            lists.append(read_list(path, skip_bad=skip_bad))
        except ProblemsError as error:  # told together with those of the other file
            problems += error.problems
    if problems:
        raise ProblemsError(problems, "Mend the lines, or pass --skip-bad to go on without them")
    result = audit_parts(lists[0].manifest, lists[1].manifest, group=group, name=f"{train.name} / {test.name}", worst=worst)
    return result, [str(p) for found in lists for p in found.skipped]
