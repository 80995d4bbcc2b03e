"""Samples for an audit or a split, from whatever names them.

A name is no identity: ``0001.jpg`` of two folders are two files. What equal names mean is said by
:mod:`palpate.data.recordings`; where they mean nothing, bytes and images decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import Note, PalpateError, Problem, ProblemsError, Progress, Split, quiet, require
from palpate.data.listing import categories_in, is_list, read_lists
from palpate.data.manifest import Manifest, is_manifest
from palpate.data.reading import read as read_samples
from palpate.data.recordings import NAMES, name_recordings, recordings_note

#: A manifest, a path, several frame lists that are joined, or a polars or pandas frame.
Data = Any
FIX = "Correct the lines, or skip the bad ones"
#: Problems that a note names.
SHOWN = 40


@dataclass(frozen=True)
class Source:
    """What a source holds: samples, the splits that it states by name, and notes."""

    manifest: Manifest
    splits: Mapping[str, Split]
    notes: list[Note]


def read(
    data: Data,
    skip_bad: bool = False,
    progress: Progress = quiet,
    root: str | Path | None = None,
    reading: Mapping[str, Any] | None = None,
) -> Source:
    """Read samples; ``root`` and ``reading`` as in :func:`palpate.leakage.audit`."""
    root = (reading or {}).get("root") or root
    several = data if isinstance(data, list | tuple) else ()
    paths = [path for path in several if isinstance(path, str | Path)]
    if len(paths) == len(several) > 1:
        manifest, skipped = _join([Path(path) for path in paths], skip_bad, root, reading)
        return Source(manifest, {}, _notes(skipped))
    source = paths[0] if len(paths) == len(several) == 1 else data
    samples = read_samples(
        source, skip_bad=skip_bad, root=root, progress=progress, **_options(reading)
    )
    manifest, notes = samples.manifest, _notes(samples.skipped)
    if "side_assumed" in manifest.facts:
        notes.append(Note("photos-assumed", {"name": manifest.facts.get("dataset", "")}))
    if column := manifest.facts.get("path_column"):
        notes.append(Note("path-column", {"column": column}))
    if "images_absent" in manifest.facts:
        notes.append(Note("images-not-found", {"root": str(manifest.root)}))
    return Source(manifest, samples.splits, notes)


def _options(reading: Mapping[str, Any] | None) -> dict[str, Any]:
    """What is stated of how to read, but the root."""
    return {k: v for k, v in (reading or {}).items() if v and k != "root"}


def _notes(skipped: Sequence[Problem]) -> list[Note]:
    lines = [str(problem) for problem in skipped[:SHOWN]]
    return [Note("rows-skipped", {"count": len(skipped), "problems": lines})] if skipped else []


def read_all(
    sources: Sequence[Data],
    skip_bad: bool,
    progress: Progress,
    root: str | Path | None,
    reading: Mapping[str, Any] | None = None,
    *,
    arguments: Sequence[str] = ("train_or_data", "test", "pretrain"),
) -> list[Source]:
    """Several sources, those of ``arguments``: their problems are raised together, and their names
    read together.
    """
    parts: list[Source] = []
    problems: list[Problem] = []
    saved = [isinstance(s, str | Path) and is_manifest(Path(s)) for s in sources]
    for source, name, is_saved in zip(sources, arguments, saved, strict=False):
        alone = is_saved and not all(saved)  # what else is stated is for the others
        own = {"root": (reading or {}).get("root")} if alone else reading
        try:
            parts.append(read(source, skip_bad, progress, root, own))
        except ProblemsError as error:
            problems += error.problems
        except PalpateError as error:
            error.argument = name if error.argument == "source" else error.argument
            raise
    if problems:
        raise ProblemsError(problems, FIX)
    stated = next((t for t in map((reading or {}).get, ("tactile", "vision")) if t), None)
    named = name_recordings([part.manifest for part in parts], stated)
    notes = [recordings_note(*named)]
    return [
        Source(
            manifest,
            {name: s.changed(manifest=manifest.digest) for name, s in part.splits.items()}
            if manifest is not part.manifest
            else part.splits,
            [*part.notes, *(notes if k == 0 else [])],
        )
        for k, (part, manifest) in enumerate(zip(parts, named, strict=True))
    ]


def rename_unrelated(
    train: Manifest, test: Manifest, shared: Sequence[str]
) -> tuple[Manifest, dict[str, int]]:
    """Rename what has the same name in train without being the same thing.

    Args:
        train: samples.
        test: the samples to distinguish from them.
        shared: columns whose names mean the same thing in both.

    Returns:
        The test samples (ids stay as they are), and how many names of which column are equal.
    """
    equal: dict[str, int] = {}
    for column in (c for c in NAMES if c not in shared):
        name = pl.col(column)
        both = name.is_in(train.table[column].drop_nulls().unique().implode())
        if count := test.table.filter(both)[column].n_unique():
            equal[column] = count
            other = pl.when(both).then(pl.format("test: {}", name)).otherwise(name).alias(column)
            test = replace(test, table=test.table.with_columns(name if column == "id" else other))
    return test, equal


def _join(
    paths: list[Path], skip_bad: bool, root: str | Path | None, reading: Mapping[str, Any] | None
) -> tuple[Manifest, list[Problem]]:
    """Several lists as one manifest."""
    for path in paths:
        must, listed = "Several paths must all be lists", path.is_file() and not is_manifest(path)
        got = f"{path}, which is none" if path.exists() else f"no file {path}"
        require(listed, None, must, got, fix="Name one manifest, or lists alone")
    if _options(reading) or not all(map(is_list, paths)):
        parts = read_all(paths, skip_bad, quiet, root, reading)
        return Manifest.join(*(part.manifest for part in parts)), []
    root = paths[0].parent
    joined = read_lists(paths, root=root, skip_bad=skip_bad, categories=categories_in(root))
    return joined.manifest, joined.skipped
