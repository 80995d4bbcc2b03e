"""Backgrounds for samples that have none: images of the untouched gel, from the same video.

A sample in a contact gets the last frame at rest before that contact. A sample in no contact, and a
contact without such a frame, get the reference of the video: of its frames in no contact the one
that most resembles the others.

Contacts are those of the manifest, with all frames between their first and last; where it names
none, they are detected in the images (:mod:`palpate.data.contacts`). The frames of a video are the
tactile images of its samples, and where all names are frame numbers the other images in their
folder.

A video whose frames are all in contact has no background: nothing is made up.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from palpate.core import (
    PalpateError,
    Problem,
    Progress,
    fact_lines,
    locked,
    plain,
    problem_lines,
    quiet,
    require,
)
from palpate.core.shown import Shown
from palpate.data.contacts import (
    LEAST,
    SIZE,
    Pixels,
    contact_energy,
    find_contacts,
    find_reference,
    rest_before,
)
from palpate.data.frames import FolderFrames, thumbnail_of
from palpate.data.images import in_threads
from palpate.data.imported import Imported, removing_on_error, splits_of
from palpate.data.manifest import Manifest
from palpate.data.reading import load

#: (first, last) position of a contact, both included.
Run = tuple[int, int]


@dataclass(frozen=True)
class Backgrounds(Shown):
    """Proposed backgrounds, written as a manifest. Print it for a summary.

    Attributes:
        manifest: the samples, with the column ``background`` filled.
        path: the file.
        kept: samples that had a background.
        before: samples with the gel before their contact.
        reference: samples with the reference of their video.
        without: samples for which there is none.
        methods: video -> how its contacts were found.
        problems: videos without a background, unreadable images, weak contacts.
    """

    manifest: Manifest
    path: Path
    kept: int
    before: int
    reference: int
    without: int
    methods: dict[str, str]
    problems: list[Problem]

    def to_json(self) -> dict[str, Any]:
        """Counts, methods and problems as a JSON object."""
        names = ("kept", "before", "reference", "without", "methods", "problems")
        counts = {name: plain(getattr(self, name)) for name in names}
        return {"manifest": str(self.path), "digest": self.manifest.digest, **counts}

    def __str__(self) -> str:
        methods = list(self.methods.values())
        rows: dict[str, Any] = {
            "manifest": str(self.path),
            "samples": len(self.manifest),
            "background kept": self.kept,
            "gel before the contact": self.before,
            "reference of the video": self.reference,
            "without": self.without,
            "videos": len(methods),
        }
        rows |= {f"  {name}": methods.count(name) for name in dict.fromkeys(methods)}
        return "\n".join(["Backgrounds", *fact_lines(rows), *problem_lines(self.problems)])


def propose_backgrounds(
    source: Any, output: Path | str, *, progress: Progress = quiet, **options: Any
) -> Backgrounds:
    """Write ``output/manifest.parquet`` with a background for each sample that has none.

    Args:
        source: a manifest, or whatever :func:`palpate.load` reads, with its images as files.
        output: folder to write to, without a manifest; the images stay where they are.
        progress: progress callback.
        options: of :func:`palpate.load`.

    Raises:
        PalpateError: if the source cannot be read, has no tactile images without a background, or
            the output holds a manifest.
    """
    path = Path(output) / "manifest.parquet"
    fix = "Choose another folder"
    require(not path.exists(), "output", "must hold no manifest yet", str(output), fix=fix)
    manifest = load(source, progress=progress, **options)
    table = manifest.table
    recorded: list[str | None] = table["background"].to_list()
    got = "a background for every sample" if table["tactile"].count() else "no tactile images"
    must = "must have tactile images without a background"
    fix = "Nothing is to be done"
    require(table["tactile"].count() > 0 and None in recorded, "source", must, got, fix=fix)
    chosen, before, methods, problems = list(recorded), 0, dict[str, str](), list[Problem]()
    groups = _videos(table, recorded)
    for done, (name, rows) in enumerate(groups.items()):
        progress("finding backgrounds", done, len(groups), name)
        video = _Video.read(manifest, rows, problems)
        methods[name], backgrounds = video.backgrounds(name, problems)
        for k, source_path, before_contact in backgrounds:
            if recorded[k] is None:
                chosen[k] = os.path.relpath(source_path, manifest.root).replace(os.sep, "/")
                before += before_contact
    progress("finding backgrounds", len(groups), len(groups))
    facts = {**manifest.facts, "backgrounds": "proposed"}
    column = pl.Series("background", chosen, dtype=pl.String)
    proposed = Manifest(table.with_columns(column), manifest.root, facts)
    kept, without = len(recorded) - recorded.count(None), chosen.count(None)
    with locked(path.parent), removing_on_error(path.parent) as created:
        # Splits name samples, so those of an import hold for the new manifest, too.
        splits = splits_of(Path(source)) if isinstance(source, (str, Path)) else {}
        Imported(proposed, splits=splits).save(path.parent, created)
    reference = len(chosen) - kept - without - before
    return Backgrounds(proposed, path, kept, before, reference, without, methods, problems)


@dataclass(frozen=True)
class _Video:
    """The frames of a video in order."""

    paths: list[Path]  # (n,) of its readable frames
    thumbnails: Pixels  # (n, 48, 64, 3)
    #: (n,) rows of the table that show each frame; none for further images of the folder.
    rows_of: list[list[int]]
    contact_of: list[str | None]  # (n,) the manifest's contact of each frame, if it is a sample

    @classmethod
    def read(
        cls, manifest: Manifest, rows: Sequence[dict[str, Any]], problems: list[Problem]
    ) -> _Video:
        """Read the frames of the rows, and the other numbered images of their folder."""
        samples: dict[Path, list[dict[str, Any]]] = {}
        for row in rows:
            samples.setdefault(manifest.root / row["tactile"], []).append(row)
        paths = _with_siblings(samples, manifest.root)
        images = np.zeros((len(paths), SIZE[1], SIZE[0], 3), np.uint8)

        def decode(k: int) -> str | None:
            try:
                images[k] = thumbnail_of(paths[k])
            except PalpateError as error:
                return error.got
            return None

        failed = {k: text for k, text in in_threads(decode, range(len(paths))) if text}
        problems += [Problem(str(paths[k]), "bad-image", text) for k, text in failed.items()]
        good = [k for k in range(len(paths)) if k not in failed]
        kept = [paths[k] for k in good]
        samples_of = [samples.get(path, []) for path in kept]
        return cls(
            kept,
            images[good],
            [[row["row"] for row in some] for some in samples_of],
            [some[0]["contact"] if some else None for some in samples_of],
        )

    def backgrounds(
        self, name: str, problems: list[Problem]
    ) -> tuple[str, list[tuple[int, Path, bool]]]:
        """How they were found, and (row, its background, whether it is the gel before it)."""
        recorded = self._known()
        touched = {k for first, last in recorded for k in range(first, last + 1)}
        free = np.array([k for k in range(len(self.paths)) if k not in touched], np.int64)
        if not len(free):
            text = "all its images are in contact" if self.paths else "no image can be read"
            problems.append(Problem(name, "no-background", text))
            return "none", []
        reference = int(free[find_reference(self.thumbnails[free])])
        if recorded:
            energy = contact_energy(self.thumbnails, self.thumbnails[reference])
            runs, method = recorded, "contacts of the manifest"
        else:
            contacts = find_contacts(self.thumbnails, reference)
            energy, runs = contacts.energy, contacts.runs
            method = "contacts of the images"
        chosen, before = np.full(len(self.paths), reference), np.zeros(len(self.paths), bool)
        after = -1
        for first, last in runs:
            peak = float(energy[first : last + 1].max())
            quiet_frame = rest_before(energy, first, after, peak)
            if quiet_frame is not None:
                chosen[first : last + 1], before[first : last + 1] = quiet_frame, True
            after = max(after, last)
        strongest = max((float(energy[a : b + 1].max()) for a, b in runs), default=0.0)
        if strongest < LEAST:
            text = f"its strongest contact differs from the gel by {strongest:.1f} gray levels"
            problems.append(Problem(name, "no-contact", text if runs else "no contact was found"))
        return method, [
            (row, self.paths[chosen[k]], bool(before[k]))
            for k, rows in enumerate(self.rows_of)
            for row in rows
        ]

    def _known(self) -> list[Run]:
        """The contacts of the manifest, from the first to the last frame of each."""
        ends: dict[str, Run] = {}
        for k, contact in enumerate(self.contact_of):
            if contact is not None:
                ends[contact] = (ends.get(contact, (k, k))[0], k)
        return sorted(ends.values())


def _videos(table: pl.DataFrame, recorded: Sequence[str | None]) -> dict[str, list[dict[str, Any]]]:
    """Video -> its rows with a tactile image in the order of frames, if one lacks a background.

    Without a column of videos the folder of the images is one.
    """
    folder = pl.col("tactile").str.replace("/?[^/]*$", "")
    columns = ("video", "frame", "contact", "tactile")
    rows = (
        table.select(*columns)
        .with_row_index("row")
        .with_columns(video=pl.coalesce("video", folder), lacks=pl.Series(recorded).is_null())
        .filter(pl.col("tactile").is_not_null())
        .sort("video", "frame", "row", nulls_last=True)
    )
    parts = rows.partition_by("video", maintain_order=True)
    return {part["video"][0]: part.to_dicts() for part in parts if part["lacks"].any()}


def _with_siblings(samples: dict[Path, list[dict[str, Any]]], root: Path) -> list[Path]:
    """The images of a video in order, with those of its folder if the names are frame numbers."""
    folders = {path.parent for path in samples}
    if len(folders) > 1:
        return list(samples)
    frames = FolderFrames(folders.pop())
    numbers = [(path, rows[0]["frame"]) for path, rows in samples.items()]
    if any(k is None or not frames.has(k) or frames.path(k) != path for path, k in numbers):
        return list(samples)
    return [frames.path(k) for k in frames.numbers]
