"""Pictures of touches from what a user has: a folder of images, a manifest, or a folder of ``palpate generate``.

All three become a :class:`palpate.data.manifest.Manifest` with the columns ``id`` and ``tactile``, and what is known of ``material``, ``video``
and ``background``. The id of an image in a folder is its path below the folder, with ``/`` and without the suffix; where the reference, or a
columns file, has the same name with a suffix, that is its id. Nothing outside the folder is looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import polars as pl

from palpate.core import PalpateError, ProblemsError, SampleRef, read_json, rng_for
from palpate.data.images import SUFFIXES
from palpate.data.manifest import Manifest
from palpate.evaluation.embeddings import KINDS, Columns, known_to
from palpate.report.results import GalleryItem

#: Rows of the gallery.
GALLERY = 40


def is_generated(path: Path) -> bool:
    """Whether a folder was made by ``palpate generate``."""
    index = path / "index.json"
    if not path.is_dir() or not index.is_file():
        return False
    about = read_json(index, "index of generated touches")
    return isinstance(about, dict) and str(about.get("format", "")).startswith("palpate-generated/")


def read_touches(path: Path) -> Manifest:
    """The touches at a path; see the head of this module.

    Raises:
        PalpateError: if there is nothing, no image, two images of one name, or a manifest that is refused.
        ProblemsError: for a manifest with missing files or files outside its root.
    """
    if path.is_file() or (path / "manifest.parquet").is_file():
        manifest = Manifest.load(path)
        missing = [
            p
            for p in manifest.problems()
            if "tactile" in p.text or p.kind in ("empty", "null-id", "duplicate-id")
        ]
        if missing:
            raise ProblemsError(missing, "Mend the rows, or import again with --skip-bad")
        return manifest
    if is_generated(path):
        from palpate.diffusion.generation import Generated  # needs torch

        made = Generated.load(path)
        rows = [{"id": i, "tactile": f"images/{name}"} for i, name in made.files.items()]
        return _named(Manifest.from_rows(rows, path, {"generated": "yes"}), path)
    if not path.is_dir():
        raise PalpateError("What is scored must exist", f"nothing at {path}", f"Pass {KINDS}")
    return _named(_folder(path), path)


def _named(manifest: Manifest, path: Path) -> Manifest:
    if not len(manifest):
        raise PalpateError(f"There must be images in {path}", "none", f"Pass {KINDS}")
    return manifest


def _folder(path: Path) -> Manifest:
    rows: dict[str, str] = {}
    for file in sorted(path.rglob("*")):
        relative = file.relative_to(path).as_posix()
        if (
            file.suffix.lower() not in SUFFIXES
            or any(part.startswith(".") for part in relative.split("/"))
            or not file.is_file()
        ):
            continue
        try:
            relative.encode()
        except UnicodeEncodeError:
            raise PalpateError(
                f"File names in {path} must be UTF-8", ascii(relative), "Rename the file"
            ) from None
        name = stem(relative)
        if name in rows:
            got = f"{rows[name]!r} and {relative!r}"
            raise PalpateError(
                f"Every image in {path} must have a name of its own, suffixes aside",
                got,
                "Rename one of them",
            )
        rows[name] = relative
    return Manifest.from_rows(
        ({"id": name, "tactile": relative} for name, relative in rows.items()), path
    )


def stem(name: str) -> str:
    """A relative path without the suffix of an image; another suffix is part of the name."""
    return (
        name[: -len(suffix)] if (suffix := PurePosixPath(name).suffix).lower() in SUFFIXES else name
    )


def completed(
    manifest: Manifest, *, group: str, columns: Columns | None = None, like: Manifest | None = None
) -> Manifest:
    """The touches with the ids, materials and groups that others know of them.

    Args:
        manifest: touches of :func:`read_touches`.
        group: column of the groups.
        columns: labels and groups by id; must then hold every id that has none of its own.
        like: the reference; a name that is one of its ids but for the suffix becomes that id, and an id that it has takes material and
            group from it.

    Raises:
        PalpateError: if an id is not in ``columns``, or if ``like`` has some of the ids alone, and something to give them.
    """
    known = [*(like.ids if like is not None else []), *(columns.ids if columns is not None else [])]
    exact, short = set(known), {stem(i): i for i in reversed(known)}
    ids = [i if i in exact else short.get(stem(i), i) for i in manifest.ids]
    if len(set(ids)) < len(ids):  # two names that one id could mean: better none than a wrong one
        ids = manifest.ids
    found: dict[str, list[Any]] = {name: manifest.column(name) for name in ("material", group)}
    if columns is not None and any(_empty(v) for v in found.values()):
        for name, column in zip(("material", group), columns.of(ids), strict=True):
            found[name] = column if column is not None and _empty(found[name]) else found[name]
    if like is not None:
        row = {i: k for k, i in enumerate(like.ids)}
        theirs = {
            name: column
            for name, values in found.items()
            if _empty(values) and not _empty(column := like.column(name))
        }
        if theirs and known_to(str(manifest.root), ids, row, " and ".join(theirs)):
            found |= {name: [column[row[i]] for i in ids] for name, column in theirs.items()}
    table = manifest.table.with_columns(
        pl.Series("id", ids, pl.String),
        *(pl.Series(n, [v or None for v in c], pl.String) for n, c in found.items()),
    )
    return Manifest(table, manifest.root, manifest.facts)


def _empty(values: Sequence[Any]) -> bool:
    return all(v is None for v in values)


def touch_gallery(reference: Manifest, made: Manifest, seed: int) -> list[GalleryItem]:
    """Some of the samples that both have, chosen by seed alone."""
    row, theirs = (
        {r["id"]: r for r in reference.table.iter_rows(named=True)},
        dict(zip(made.ids, made.column("tactile"), strict=True)),
    )
    both = sorted(
        (i for i in made.ids if i in row), key=lambda i: rng_for(seed, "gallery", i).random()
    )[:GALLERY]
    full = lambda m, path: str(m.path(path).resolve()) if path else None  # noqa: E731
    items: list[GalleryItem] = []
    for i in both:
        r = row[i]
        sample = SampleRef(
            i,
            r["video"],
            r["frame"],
            r["material"],
            full(reference, r["vision"]),
            full(reference, r["tactile"]),
        )
        items.append(
            GalleryItem(
                sample, str(made.path(theirs[i]).resolve()), full(reference, r["background"])
            )
        )
    return items
