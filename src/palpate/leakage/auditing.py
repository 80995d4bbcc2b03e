"""The audit of a split: which test samples are not new to a model that was trained on train.

For a test sample at frame f of video v, with F_v the train frames of v, the *gap* is ``min |f -
g|`` over ``g in F_v``. Frames of one contact are similar within about a second (30 frames at 30
fps), frames of one video within many, so a small gap means that the test image was almost seen in
training (paper, section 5).

Ids, videos and frame numbers are enough, so two bare list files can be audited; images show leaks
that no metadata reveals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Note, PalpateError, Progress, Split, few, quiet, require, require_choice
from palpate.data.manifest import SIDES, Manifest
from palpate.data.recordings import (
    Identity,
    is_sequence,
    number_contacts,
    published,
    same_names,
    shared_groups,
)
from palpate.leakage.groups import GROUPS
from palpate.leakage.inputs import Data, Source, read_all, rename_unrelated
from palpate.leakage.questions import LARGEST, NO_GROUP, questions
from palpate.leakage.signals import (
    WORST,
    Flags,
    Gaps,
    by_contact,
    identical_bytes,
    identical_samples,
    leaking,
    nearest_in_video,
    shared_group,
    signal_table,
    time_gap,
    varied,
)
from palpate.report.records import Impact, LeakPair
from palpate.report.results import MATRIX_ROWS, Audit

#: Right-open bins of the gap histogram, in frames; 30 frames are one second of Touch and Go.
GAP_EDGES = (0, 1, 3, 10, 30, 60, 90, 150, 300, 600, 900, 1800, 3600)

#: (samples, split, group, name of the split) -> what the leak costs.
MeasureImpact = Callable[[Manifest, Split, str, str], Impact]


@dataclass(frozen=True)
class Options:
    """How two parts are compared; see :func:`audit`."""

    modalities: Sequence[str]  # whose images are compared
    cache: Path | None = None
    by: str = "auto"
    near_frames: int = 30
    identity: Identity = "auto"
    false_positives: float = 0.001
    progress: Progress = quiet
    skipped: bool = False  # whether many rows of the inputs were


def audit(  # noqa: PLR0913
    train_or_data: Data,
    test: Data = None,
    *,
    split: Split | str | Path | None = None,
    pretrain: Data = None,
    by: str = "auto",
    near_frames: int = 30,
    identity: Identity = "auto",
    images: bool = True,
    modalities: Sequence[str] = ("vision", "tactile"),
    false_positives: float = 0.001,
    impact: MeasureImpact | None = None,
    name: str | None = None,
    cache: str | Path | None = None,
    root: str | Path | None = None,
    reading: Mapping[str, Any] | None = None,
    skip_bad: bool = False,
    progress: Progress = quiet,
) -> Audit:
    """Audit the test part of a split against its train part.

    Args:
        train_or_data: the train samples, or with ``split`` all samples: a manifest, a path (list of
            ``video/frame.jpg,label`` lines, table, manifest, folder), or a polars or pandas frame.
        test: the test samples, likewise.
        split: a split of ``train_or_data``, instead of ``test``; default: the one that the source
            states.
        pretrain: what an encoder was pretrained on, which the test part is compared with as well;
            its audit is in ``others``.
        by: what train and test must not share: a column, or ``auto`` for the video or what is known
            instead of it.
        near_frames: a gap of up to this many frames within a video is a leak by itself.
        identity: what equal names in train and test mean: ``names`` the same thing, ``images``
            nothing, so that bytes and images decide; ``auto`` names where both have one root, are
            of one published data set, or have the names from columns of tables.
        images: compare image files and their content, not only tables.
        modalities: the images to compare.
        false_positives: rate at which unrelated images may pass for near-duplicates, in (0, 0.1].
        impact: function (samples, split, group, name) -> :class:`Impact`; needs ``split``.
        name: heading; default: the names of the inputs, or of the split.
        cache: folder that keeps decoded images.
        root: where the paths of tables start; default: the folder of the table.
        reading: how sources are read, as in :func:`palpate.load`: ``columns``, ``names``,
            ``classes``, ``side``, and the templates ``vision`` and ``tactile``, also of paths in
            lists whose images are not at hand; a stated template whose only level is ``{frame}``
            says that the numbers of all samples are times of one sequence.
        skip_bad: skip bad rows of lists and tables, and note them.
        progress: callback.

    Returns:
        The audit; ``to_frame()`` is the table of all signals with a row for each test sample.

    Raises:
        PalpateError: on an option out of range, an unknown group, an id that the data lacks, or an
            empty part.
        ProblemsError: with every bad row of all inputs, unless ``skip_bad``.
    """
    must = "An audit takes train and test samples, or samples with a split"
    require(test is None or split is None, None, must, "both", fix="Pass one of them")
    require(by in (*GROUPS, "auto"), "by", f"must be auto or one of {', '.join(GROUPS)}", repr(by))
    require(near_frames >= 0, "near_frames", "must be at least 0", near_frames, 30)
    require_choice("identity", identity, ("auto", "names", "images"))
    accepted, must = set(modalities) <= {*SIDES}, "must be among vision, tactile"
    require(accepted, "modalities", must, list(modalities), ["vision"])
    accepted, must = 0 < false_positives <= 0.1, "must lie in (0, 0.1]"
    require(accepted, "false_positives", must, false_positives, 0.001)
    must, fix = "needs all samples and a split", "Import them, and audit them with a split"
    require(impact is None or test is None, "impact", must, "train and test apart", fix=fix)
    sources = [x for x in (train_or_data, test, pretrain) if x is not None]
    read = read_all(sources, skip_bad, progress, root, reading)
    parts = [source.manifest for source in read]
    notes = [note for source in read for note in source.notes]
    options = Options(
        modalities if images else (),
        None if cache is None else Path(cache),
        by,
        near_frames,
        identity,
        false_positives,
        progress,
        any(map(_skips_many, read)),
    )
    if by == "contact":
        parts = number_contacts(parts)
    if test is not None:
        title = name or f"{_name(train_or_data, 'train')} / {_name(test, 'test')}"
        result = compare(parts[0], parts[1], options, title)
        test_part = parts[1]
    else:
        samples = parts[0]
        parted = _stated(read[0].splits) if split is None else Split.load(split)
        test_part, val = samples.part(parted, "test"), samples.part(parted, "val")
        title = name or str(parted.rule.get("name") or _name(split, "split"))
        result = compare(samples.part(parted, "train"), test_part, options, title, val=val)
        notes += _split_notes(samples, parted, val, result.group)
        result = replace(result, split=parted.digest)
        nothing = {"untouched", "similar"} & {question.reason for question in result.questions}
        if impact is not None and nothing:
            notes.append(Note("impact-of-nothing"))
        elif impact is not None:
            try:
                result = replace(result, impact=impact(samples, parted, result.group, title))
            except PalpateError as error:  # the audit itself must not be lost
                bare = PalpateError(*error.args, argument=error.argument)
                example = {"by" if k == "group" else k: v for k, v in error.example.items()}
                notes.append(Note("impact-failed", {"reason": f"{bare}", "example": example}))
    if pretrain is not None:
        title = f"{_name(pretrain, 'pretraining')} / test"
        against = compare(parts[-1], test_part, options, title, against="pretraining")
        result = replace(result, others=[against])
    notes = [note for k, note in enumerate(notes) if note not in notes[:k]]  # of train and test
    return replace(result, notes=[*result.notes, *notes])


def _skips_many(source: Source) -> bool:
    """Whether so many rows of a source were skipped that nothing can be told of the samples."""
    counts = (n.params["count"] for n in source.notes if n.code == "rows-skipped")
    return any(count > LARGEST * (count + len(source.manifest)) for count in counts)


def _stated(splits: Mapping[str, Split]) -> Split:
    """The split that a source states."""
    if len(splits) != 1:
        raise PalpateError(
            "An audit takes train and test samples, or samples with a split",
            f"neither test samples nor a split; the source states {few(sorted(splits))}",
            "Pass test samples, or a split",
            example={"split": "split.json"},
        )
    return next(iter(splits.values()))


def _name(source: Any, default: str) -> str:
    if not isinstance(source, (str, Path)):
        return default
    return Path(source).stem if default == "split" else Path(source).name


def _split_notes(samples: Manifest, split: Split, val: Manifest, group: str) -> list[Note]:
    """What a reader must know of the split itself."""
    notes: list[Note] = []
    if split.manifest is not None and split.manifest != samples.digest:
        notes.append(Note("split-of-other-manifest"))
    if unused := len(samples) - len(split.parts):
        notes.append(Note("samples-in-no-part", {"count": unused, "of": len(samples)}))
    if len(val) and group != NO_GROUP:
        elsewhere = samples.part(split, "train", "test").table[group].unique()
        if shared := set(val.table[group].unique()) & set(elsewhere) - {None}:
            notes.append(Note("validation-leaks", {"count": len(shared), "group": group}))
    return notes


def known_group(train: Manifest, test: Manifest) -> str:
    """What the data set names, else the first of video, object, session and contact.

    Returns:
        A column of which both parts know some values, or ``NO_GROUP``.
    """
    named = [str(m.facts["group"]) for m in (test, train) if m.facts.get("group") in GROUPS]
    candidates = (*named, "video", "object", "session", "contact")
    return next((c for c in candidates if all(_knowing(train, test, c))), NO_GROUP)


def _knowing(train: Manifest, test: Manifest, column: str) -> list[bool]:
    """Which of both parts know some values of a column."""
    return [part.table[column].null_count() < len(part) for part in (train, test)]


def _compared(train: Manifest, test: Manifest, options: Options) -> list[str]:
    """The images that are compared: those that both parts have."""
    return [m for m in options.modalities if all(_knowing(train, test, m))]


def _group(train: Manifest, test: Manifest, options: Options) -> str:
    """The group to audit by."""
    for part, samples in (("train", train), ("test", test)):
        must, fix = f"The {part} part must hold samples", "Check the split or list file"
        require(len(samples) > 0, None, must, "none", fix=fix)
    if options.by == "auto":
        return known_group(train, test)
    must, got = f"Both parts must know the {options.by} of some samples", "a column of nulls"
    fix = "Audit by another group, or compare images, which needs no group"
    require(all(_knowing(train, test, options.by)), None, must, got, fix=fix)
    return options.by


def compare(
    train: Manifest,
    test: Manifest,
    options: Options,
    name: str,
    *,
    val: Manifest | None = None,
    against: str = "train",
) -> Audit:
    """Audit one part against another."""
    group = _group(train, test, options)
    shared = same_names(train, test, options.identity)
    test, equal = rename_unrelated(train, test, shared)
    a, b = train.table, test.table
    groups = [
        set(t[group].drop_nulls().unique()) if group != NO_GROUP else set[str]() for t in (a, b)
    ]
    in_both = sorted(groups[0] & groups[1])
    in_shared = int(b[group].is_in(in_both).fill_null(False).sum()) if in_both else 0
    timed_tables = [a, b]
    if is_sequence(train) and is_sequence(test):
        timed_tables = [t.with_columns(video=pl.lit("")) for t in timed_tables]
    gaps = nearest_in_video(*by_contact(*timed_tables))
    flags = _signals(train, test, group, gaps, options, named=shared)
    leaks = leaking(flags, len(test))
    answers = questions(
        train,
        test,
        group,
        gaps,
        flags,
        equal=equal,
        asked=bool(options.modalities),
        skipped=options.skipped,
        progress=options.progress,
    )
    timed = gaps.frames[gaps.frames >= 0]
    last = int(timed.max()) if timed.size else 0
    middle = float(np.median(timed)) if timed.size else None
    edges = [e for e in GAP_EDGES if e <= last] + [last + 1] if timed.size else []
    parts = {"train": a, "val": b.clear() if val is None else val.table, "test": b}
    rows = _rows(parts, group, leaks)
    compared = rows.filter(~pl.col("val"))
    named = compared["group"].drop_nulls()
    largest = int(named.value_counts()["count"].max() or 0)  # pyright: ignore[reportArgumentType]
    largest = len(compared) if 0 < len(named) < len(compared) else largest
    pairs = _worst_pairs(train, test, group, gaps)
    signals = [f.summary(train, test, gaps) for f in flags]
    return Audit(
        name=name,
        group=group,
        train_samples=a.height,
        test_samples=b.height,
        groups_train=len(groups[0]),
        groups_test=len(groups[1]),
        groups_shared=len(in_both),
        test_samples_in_shared_groups=in_shared,
        leaked_fraction=0.0,  # the class computes it from the signals
        identical_samples=int(flags[0].flag.sum()),
        gap_min=int(timed.min()) if timed.size else None,
        gap_median=int(middle) if middle is not None and middle.is_integer() else middle,
        gap_max=last if timed.size else None,
        gap_edges=edges,
        gap_counts=np.histogram(timed, edges)[0].tolist() if edges else [],
        worst=pairs,
        materials=_materials(compared),
        notes=_notes(train, test, group, equal, options),
        against=against,
        signals=[replace(s, worst=pairs) if s.kind == "time gap" else s for s in signals],
        leaking_samples=int(leaks.sum()),
        matrix=_matrix(rows),
        groups_in_all=len(groups[0] | groups[1]),
        shared={c: n for c, n in shared_groups(a, b).items() if c not in equal},
        questions=answers,
        largest_group=round(largest / len(compared), 5),
        table=signal_table(test, train, flags, gaps),
    )


def _notes(
    train: Manifest, test: Manifest, group: str, equal: Mapping[str, int], options: Options
) -> list[Note]:
    notes = [Note("no-group")] if group == NO_GROUP else []
    numbers = [m.table["frame"].drop_nulls() for m in (train, test)]
    if group == NO_GROUP and len(numbers[0]) and not is_sequence(train):
        beside = pl.concat([numbers[0] - 1, numbers[0], numbers[0] + 1]).unique()
        count = int(numbers[1].is_in(beside.implode()).sum())
        notes += [Note("numbers-next", {"count": count, "of": len(test)})] if count else []
    if equal:
        params = {"equal": dict(equal), "roots": [str(train.root), str(test.root)]}
        images = bool(_compared(train, test, options))
        notes.append(Note("equal-names", params | {"images": images}))
    for modality in options.modalities:
        if len({*_knowing(train, test, modality)}) > 1:
            notes.append(Note("images-of-one-part", {"modality": modality}))
    return notes


def _signals(
    train: Manifest,
    test: Manifest,
    group: str,
    gaps: Gaps,
    options: Options,
    *,
    named: Sequence[str],
) -> list[Flags]:
    """Every signal that can be checked, the exact ones first."""
    stated = options.identity == "names" or published(test)
    flags: list[Flags | None] = [identical_samples(train, test, gaps, named, stated=stated)]
    if options.modalities:
        flags.append(identical_bytes(train, test, options.progress))
    if group != NO_GROUP:
        columns = dict.fromkeys([group, "video", "object", "session"])
        flags += [shared_group(train, test, c, counts=c == group) for c in columns]
    flags.append(time_gap(gaps, options.near_frames))
    for modality in _compared(train, test, options):
        from palpate.leakage.near import near_duplicates

        rate, cache, progress = options.false_positives, options.cache, options.progress
        flags.append(
            near_duplicates(
                train, test, modality, false_positives=rate, cache=cache, progress=progress
            )
        )
    return [f for f in flags if f is not None]


def _rows(parts: Mapping[str, pl.DataFrame], group: str, leaks: NDArray[np.bool_]) -> pl.DataFrame:
    """A row for each sample of all parts: its group, material and part, and whether it leaks."""
    column = pl.lit(None, pl.String) if group == NO_GROUP else pl.col(group)
    flagged = {"test": pl.Series(leaks)}
    return pl.concat(
        t.select(
            "material",
            group=column,
            leaking=flagged.get(part, pl.lit(False)),
            **{p: pl.lit(p == part) for p in parts},
        )
        for part, t in parts.items()
    )


def _matrix(rows: pl.DataFrame) -> list[dict[str, Any]]:
    """Samples of each group by part, shared groups with most test samples first."""
    parts = ("train", "val", "test")
    matrix = (
        rows.drop_nulls("group")
        .group_by("group")
        .agg(pl.col(*parts, "leaking").sum())
        .with_columns(
            shared=(pl.col("train") > 0) & (pl.col("test") > 0), size=pl.sum_horizontal(*parts)
        )
        .sort("shared", "test", "size", "group", descending=[True, True, True, False])
        .head(MATRIX_ROWS)
    )
    return list(matrix.select("group", *parts, "leaking").iter_rows(named=True))


def _materials(rows: pl.DataFrame) -> list[dict[str, Any]]:
    """Samples and groups of each material in both parts."""
    groups = [
        pl.col("group").filter(part).drop_nulls().n_unique().alias(f"groups_{part}")
        for part in ("train", "test")
    ]
    materials = rows.drop_nulls("material").group_by("material")
    both = materials.agg(pl.col("train", "test").sum(), *groups).sort("material")
    return list(both.iter_rows(named=True))


def _worst_pairs(train: Manifest, test: Manifest, group: str, gaps: Gaps) -> list[LeakPair]:
    """The test samples nearest to train: the nearest of each video first, then others, by gap."""
    chosen = varied(np.flatnonzero(gaps.frames >= 0), -gaps.frames, test)
    pairs = [(k, int(gaps.row[k]), int(gaps.frames[k])) for k in chosen]
    if not pairs and group != NO_GROUP:  # no frames: a shared group is still a pair worth showing
        queries, base = (
            m.table.with_row_index("row").drop_nulls(group).group_by(group).agg(pl.first("row"))
            for m in (test, train)
        )
        shared = queries.join(base, on=group).sort(group)
        pairs = [(i, j, None) for _, i, j in shared.head(WORST).iter_rows()]
    row = lambda m, k: m.ref(m.table.row(k, named=True))
    return [LeakPair(row(test, k), row(train, j), gap) for k, j, gap in pairs]
