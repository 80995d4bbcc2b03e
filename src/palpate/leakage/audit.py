"""The audit of a split: which test samples share a group with train, and how near in time they lie to it.

For a test sample at frame f of video v, with F_v the train frames of v, the *gap* is ``min |f - g|`` over
``g in F_v``. Frames of one touch are alike within about a second (30 frames at 30 fps), frames of one video
within many, so a small gap means that the test picture was almost seen in training (paper, section 5).

Ids, videos and frame numbers are enough, so two bare list files can be audited; pictures, where they are at hand, show
leaks that no metadata reveals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import PalpateError, Problem, ProblemsError, Progress, Split, quiet
from palpate.data.listing import FrameList, number_together, read_list
from palpate.data.manifest import MODALITIES, Manifest
from palpate.leakage.signals import (
    NEAR_FRAMES,
    Flags,
    identical_bytes,
    identical_samples,
    leaking,
    shared_group,
    signal_table,
    time_gap,
)
from palpate.report.results import MATRIX_ROWS, Audit, LeakPair

GROUPS = ("video", "contact", "object", "session", "domain", "sensor")
#: In place of a group where none is known and pictures alone are compared.
NO_GROUP = "none"
#: Right-open bins of the gap histogram, in frames; 30 frames are one second of Touch and Go.
GAP_EDGES = (0, 1, 3, 10, 30, 60, 90, 150, 300, 600, 900, 1800, 3600)


@dataclass(frozen=True)
class Pictures:
    """How the pictures of an audit are compared.

    Attributes:
        modalities: which of ``vision`` and ``touch``; those without pictures are left out.
        false_positives: rate at which the thresholds let unrelated samples be flagged.
        features: modality -> embeddings of (train, test) in row order, instead of the built-in descriptors.
        feature_name: names them in notes, e.g. an encoder's digest.
        cache: folder for descriptors, or None.
        processes: that decode; None takes one a core.
    """

    modalities: Sequence[str] = ("vision", "tactile")
    false_positives: float = 0.001
    features: Mapping[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = field(
        default_factory=dict
    )
    feature_name: str = ""
    cache: Path | None = None
    processes: int | None = None


@dataclass(frozen=True)
class Inspection:
    """An audit, and its table of all signals with a row a test sample (see :func:`palpate.leakage.signals.signal_table`)."""

    audit: Audit
    table: pl.DataFrame


def audit_split(
    manifest: Manifest,
    split: Split,
    *,
    group: str = "video",
    name: str = "",
    worst: int = 12,
    near: int = NEAR_FRAMES,
    pictures: Pictures | None = None,
    progress: Progress = quiet,
) -> Audit:
    """Audits the test part of a split against its train part.

    Args:
        manifest: the samples; the split's ids must be in it.
        split: the split.
        group: column that must not be shared (one of ``GROUPS``), or ``auto`` (:func:`known_group`).
        name: heading for reports.
        worst: how many of the nearest pairs to keep.
        near: a gap of up to so many frames within a video is a leak of its own.
        pictures: compare pictures as well; None looks at the table alone.
        progress: told what is being done.

    Raises:
        PalpateError: on an unknown group, an id that the manifest lacks, or an empty train or test part.
    """
    return inspect_split(
        manifest,
        split,
        group=group,
        name=name,
        worst=worst,
        near=near,
        pictures=pictures,
        progress=progress,
    ).audit


def inspect_split(manifest: Manifest, split: Split, **options: Any) -> Inspection:
    """:func:`audit_split` with the table of all signals."""
    val = manifest.part(split, "val")
    found = inspect_parts(
        manifest.part(split, "train"), manifest.part(split, "test"), val=val, **options
    )
    notes, group = list(found.audit.notes), found.audit.group
    if split.manifest is not None and split.manifest != manifest.digest:
        notes.append("The split was made for another manifest (the digests differ).")
    if unused := len(manifest) - len(split.parts):
        notes.append(
            f"{unused} of {len(manifest)} samples of the manifest are in no part of the split."
        )
    if len(val) and group != NO_GROUP:
        shared = set(val.column(group)) & set(
            manifest.part(split, "train", "test").column(group)
        ) - {None}
        if shared:
            notes.append(
                f"{len(shared)} {group} groups of the validation part occur in train or test as well: choosing a checkpoint on it leaks."
            )
    return replace(found, audit=replace(found.audit, split=split.digest, notes=notes))


def audit_parts(
    train: Manifest,
    test: Manifest,
    *,
    group: str = "video",
    name: str = "",
    worst: int = 12,
    near: int = NEAR_FRAMES,
    pictures: Pictures | None = None,
    against: str = "train",
    progress: Progress = quiet,
) -> Audit:
    """Audits test samples against train samples, given as two manifests (see :func:`audit_split`).

    ``against`` names what the first manifest is: ``train``, or ``pretraining`` for data that an encoder has seen.
    """
    return inspect_parts(
        train,
        test,
        group=group,
        name=name,
        worst=worst,
        near=near,
        pictures=pictures,
        against=against,
        progress=progress,
    ).audit


def known_group(train: Manifest, test: Manifest) -> str:
    """What the data set says must be kept whole, else the first of video, object, session and touch that both sides know of some samples.

    Returns:
        A column, or ``NO_GROUP`` if none is known.
    """
    said = [str(m.facts["group"]) for m in (test, train) if m.facts.get("group") in GROUPS]
    known = (
        g
        for g in (*said, "video", "object", "session", "contact")
        if all(m.table[g].null_count() < len(m) for m in (train, test))
    )
    return next(known, NO_GROUP)


def inspect_parts(
    train: Manifest,
    test: Manifest,
    *,
    val: Manifest | None = None,
    group: str = "video",
    name: str = "",
    worst: int = 12,
    near: int = NEAR_FRAMES,
    pictures: Pictures | None = None,
    against: str = "train",
    progress: Progress = quiet,
) -> Inspection:
    """:func:`audit_parts` with the table of all signals."""
    group = _require(train, test, group, pictures is not None)
    a, b = train.table, test.table
    groups = [
        set(t[group].drop_nulls().unique()) if group != NO_GROUP else set[str]() for t in (a, b)
    ]
    shared = sorted(groups[0] & groups[1])
    in_shared = int(b[group].is_in(shared).fill_null(False).sum()) if shared else 0
    rows, gaps = nearest_in_video(a, b)
    found = _signals(train, test, group, rows, gaps, near, pictures, progress)
    leaks = leaking(found, len(test))
    timed = gaps[gaps >= 0]
    last = int(timed.max()) if timed.size else 0
    edges = [e for e in GAP_EDGES if e <= last] + [last + 1] if timed.size else []
    notes = [
        f"{count} {part} samples have no {group}: they cannot be audited by group and count as not shared."
        for part, t in (("train", a), ("test", b))
        if group != NO_GROUP and (count := t[group].null_count())
    ]
    if group == NO_GROUP:
        notes.append(
            "Neither videos nor objects, sessions or touches are known: only samples and pictures were compared."
        )
    pairs = _worst_pairs(train, test, group, shared, rows, gaps, worst)
    signals = [
        replace(
            f.summary(train, test, gaps, rows, worst),
            **({"worst": pairs} if f.kind == "time gap" else {}),
        )
        for f in found
    ]
    audit = Audit(
        name=name,
        group=group,
        train_samples=a.height,
        test_samples=b.height,
        groups_train=len(groups[0]),
        groups_test=len(groups[1]),
        groups_shared=len(shared),
        test_samples_in_shared_groups=in_shared,
        leaked_fraction=round(in_shared / b.height, 5),
        identical_samples=int(found[0].flag.sum()),
        gap_min=int(timed.min()) if timed.size else None,
        gap_median=_plain(np.median(timed)) if timed.size else None,
        gap_max=last if timed.size else None,
        gap_edges=edges,
        gap_counts=[int(n) for n in np.histogram(timed, edges)[0]] if edges else [],
        worst=pairs,
        materials=_materials(a, b, group),
        notes=notes,
        against=against,
        signals=signals,
        leaking_samples=int(leaks.sum()),
        matrix=_matrix(train, val, test, group, leaks),
        groups_in_all=len(groups[0] | groups[1]),
    )
    return Inspection(audit, signal_table(test, train, found, gaps))


def _require(train: Manifest, test: Manifest, group: str, pictures: bool) -> str:
    """The group to audit by.

    Raises:
        PalpateError: on an unknown group, an empty part, or a group that a part does not know at all.
    """
    if group not in (*GROUPS, "auto"):
        raise PalpateError(
            f"The group must be auto or one of {', '.join(GROUPS)}",
            repr(group),
            "Pass e.g. --group video",
        )
    for part, rows in (("train", train), ("test", test)):
        if not len(rows):
            raise PalpateError(
                f"The {part} part must hold samples", "none", "Check the split or list file"
            )
    if group == "auto":
        group = known_group(train, test)
        if group != NO_GROUP or pictures:
            return group
        group = "video"
    if any(m.table[group].null_count() == len(m) for m in (train, test)):
        raise PalpateError(
            f"Both parts must know the {group} of some samples",
            f"a {group} column of nulls",
            f"Audit by another group: --group {'|'.join(GROUPS)}; or compare pictures, which needs no group: --group auto",
        )
    return group


def _signals(
    train: Manifest,
    test: Manifest,
    group: str,
    rows: NDArray[np.int64],
    gaps: NDArray[np.int64],
    near: int,
    pictures: Pictures | None,
    progress: Progress,
) -> list[Flags]:
    """Every signal that can be looked at, the exact ones first."""
    columns = (
        [group, *(g for g in ("video", "object", "session") if g != group)]
        if group != NO_GROUP
        else []
    )
    found: list[Flags | None] = [identical_samples(train, test, gaps, rows)]
    if pictures is not None:
        found.append(identical_bytes(train, test, progress))
    found += [shared_group(train, test, column, counts=column == group) for column in columns]
    found.append(time_gap(gaps, rows, near))
    if pictures is not None:
        from palpate.leakage.near import near_duplicates

        for modality in pictures.modalities:
            column = MODALITIES[modality]
            if modality not in pictures.features and any(
                m.table[column].null_count() == len(m) for m in (train, test)
            ):
                continue
            matches = near_duplicates(
                train,
                test,
                modality,
                false_positives=pictures.false_positives,
                features=pictures.features.get(modality),
                feature_name=pictures.feature_name,
                cache=pictures.cache,
                processes=pictures.processes,
                progress=progress,
            )
            found.append(
                Flags(
                    f"near-duplicate {modality}",
                    matches.score,
                    matches.flag,
                    matches.nearest,
                    matches.threshold,
                    false_positives=matches.false_positives,
                    edges=matches.edges,
                    unrelated=matches.unrelated,
                    found=matches.found,
                    cause=matches.cause,
                    notes=list(matches.notes),
                )
            )
    return [f for f in found if f is not None]


def _matrix(
    train: Manifest, val: Manifest | None, test: Manifest, group: str, leaks: NDArray[np.bool_]
) -> list[dict[str, Any]]:
    """Samples of each group by part, shared groups with most test samples first."""
    if group == NO_GROUP:
        return []
    parts = {"train": train.table, "test": test.table} | (
        {"val": val.table} if val is not None else {}
    )
    long = pl.concat(
        [
            t.select(
                pl.col(group).alias("group"),
                pl.lit(part).alias("part"),
                pl.lit(False).alias("leak"),
            )
            for part, t in parts.items()
            if part != "test"
        ]
        + [
            test.table.select(
                pl.col(group).alias("group"), pl.lit("test").alias("part"), pl.Series("leak", leaks)
            )
        ]
    ).drop_nulls("group")
    count = lambda part: (pl.col("part") == part).sum().alias(part)  # noqa: E731
    rows = long.group_by("group").agg(
        count("train"), count("val"), count("test"), pl.col("leak").sum().alias("leaking")
    )
    rows = rows.with_columns(
        shared=(pl.col("train") > 0) & (pl.col("test") > 0),
        size=pl.col("train") + pl.col("val") + pl.col("test"),
    )
    rows = rows.sort(
        ["shared", "test", "size", "group"], descending=[True, True, True, False]
    ).head(MATRIX_ROWS)
    return list(rows.select("group", "train", "val", "test", "leaking").iter_rows(named=True))


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
        place.append(
            (
                at,
                np.array([code[v] for v in part["video"].to_list()], np.int64),
                part["frame"].to_numpy().astype(np.int64),
            )
        )
    (at_a, video_a, frame_a), (at_b, video_b, frame_b) = place
    if not at_a.size or not at_b.size:
        return row, gap
    # One sorted axis for all videos: the stride keeps the frames of two videos apart. Ranks of frames keep their order and cannot
    # overflow, as frames that are time stamps in nanoseconds would.
    rank = np.unique(np.concatenate([frame_a, frame_b]), return_inverse=True)[1].astype(np.int64)
    stride = int(rank.max()) + 1
    key_a, key_b = video_a * stride + rank[: frame_a.size], video_b * stride + rank[frame_a.size :]
    order = np.argsort(key_a, kind="stable")
    right = np.searchsorted(key_a[order], key_b)
    best = np.full(at_b.size, np.iinfo(np.int64).max)
    for step in (right - 1, right):
        inside = (step >= 0) & (step < order.size)
        candidate = order[np.clip(step, 0, order.size - 1)]
        distance = np.where(
            inside & (video_a[candidate] == video_b),
            np.abs(frame_a[candidate] - frame_b),
            np.iinfo(np.int64).max,
        )
        better = distance < best
        best = np.where(better, distance, best)
        row[at_b[better]] = at_a[candidate[better]]
    gap[at_b] = np.where(best == np.iinfo(np.int64).max, -1, best)
    return row, gap


def _plain(value: Any) -> float | int:
    """A whole median as an int, so that 304.0 reads 304."""
    return int(value) if float(value).is_integer() else float(value)


def _worst_pairs(
    train: Manifest,
    test: Manifest,
    group: str,
    shared: Sequence[str],
    nearest: np.ndarray,
    gaps: np.ndarray,
    count: int,
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
    return [
        LeakPair(
            test.ref(test.table.row(k, named=True)), train.ref(train.table.row(j, named=True)), gap
        )
        for k, j, gap in pairs
    ]


def _materials(train: pl.DataFrame, test: pl.DataFrame, group: str) -> list[Mapping[str, Any]]:
    """Samples and groups of each material on both sides."""
    names = sorted(set(train["material"].drop_nulls()) | set(test["material"].drop_nulls()))
    rows: list[Mapping[str, Any]] = []
    for name in names:
        a, b = train.filter(pl.col("material") == name), test.filter(pl.col("material") == name)
        groups = [t[group].drop_nulls().n_unique() if group != NO_GROUP else 0 for t in (a, b)]
        rows.append(
            {
                "material": name,
                "train": a.height,
                "test": b.height,
                "groups_train": groups[0],
                "groups_test": groups[1],
            }
        )
    return rows


def audit_lists(
    train: Path, test: Path, *, group: str = "video", worst: int = 12, skip_bad: bool = False
) -> tuple[Audit, list[str]]:
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
    train_rows, test_rows = number_together(lists[0].manifest, lists[1].manifest)
    result = audit_parts(
        train_rows, test_rows, group=group, name=f"{train.name} / {test.name}", worst=worst
    )
    return result, [str(p) for found in lists for p in found.skipped]
