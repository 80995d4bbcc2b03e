"""Data sets by name or by look: import one, look one over, write a split in its own form."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, Split, quiet
from palpate.data.formats import FORMATS, Format, Validation
from palpate.data.formats.base import WORLD, import_scanned, validation, world_facts
from palpate.data.images import Check
from palpate.data.imported import Imported
from palpate.data.listing import write_table
from palpate.data.manifest import Manifest


def import_dataset(
    source: Path,
    out: Path,
    *,
    format: str = "auto",  # noqa: A002 (the word that the command line uses)
    skip_bad: bool = False,
    check: Check = "decode",
    size: int | None = None,
    progress: Progress = quiet,
    **options: Any,
) -> Imported:
    """Reads a data set of any known format and writes ``out/manifest.parquet``.

    Args:
        source: folder or table.
        out: folder to write to.
        format: a name in ``FORMATS``, or ``auto`` to take the first that the source looks like.
        skip_bad: leave bad rows out and list them, instead of raising.
        check: how images are checked.
        size: shorter side of frames decoded from videos, in pixels; formats that decode none have no use for it.
        progress: told what is being done.
        options: the format's own options; None means its default.

    Raises:
        PalpateError: if the source is missing or looks like no known format, or an option does not belong to the format.
        ProblemsError: with every bad row and file at once; nothing is left behind.
    """
    name, found = _format(Path(source), format)
    given = _given(name, found, options)
    if found.run is not None:
        if size is not None and "size" in found.options:
            given["size"] = size
        return found.run(
            Path(source), Path(out), skip_bad=skip_bad, check=check, progress=progress, **given
        )
    facts = {**found.facts.of_manifest(), "format": name}
    scan = found.scan(Path(source), progress=progress, **given)
    return import_scanned(
        scan, Path(source), Path(out), facts, skip_bad=skip_bad, check=check, progress=progress
    )


def validate_dataset(
    source: Path,
    *,
    format: str = "auto",  # noqa: A002
    check: Check = "decode",
    progress: Progress = quiet,
    **options: Any,
) -> Validation:
    """Looks a data set over without writing anything: what is missing, invalid or suspicious.

    Args:
        source: folder or table.
        format: as in :func:`import_dataset`.
        check: how images are checked.
        progress: told what is being done.
        options: the format's own options; None means its default.

    Raises:
        PalpateError: as :func:`import_dataset`.
    """
    name, found = _format(Path(source), format)
    given = _given(name, found, options)
    taken = inspect.signature(found.scan).parameters
    given = {
        key: value for key, value in given.items() if key in taken
    }  # some options matter to an import alone
    if "check" in taken:
        given["check"] = check
    looked = validation(
        name,
        found,
        found.scan(Path(source), progress=progress, **given),
        check=check,
        progress=progress,
    )
    # palpate's own world comes in the layouts of real sets, and must not be introduced as one of them.
    return replace(looked, facts=WORLD) if world_facts(Path(source)) else looked


def write_lists(manifest: Manifest, split: Split, out: Path) -> list[Path]:
    """Writes a split in the form of the data set that the manifest came from; a CSV of the manifest's rows a part, where it has none.

    Returns:
        The files written.

    Raises:
        PalpateError: if the split's ids are not in the manifest, or a sample lacks what the lists need.
    """
    found = FORMATS.get(str(manifest.facts.get("format", "")))
    if found is not None and found.write_lists is not None:
        return found.write_lists(manifest, split, Path(out))
    return [
        write_table(Path(out) / f"{part}.csv", manifest.part(split, part))
        for part in split.counts()
    ]


def _format(source: Path, name: str) -> tuple[str, Format]:
    """The named or recognized format.

    Raises:
        PalpateError: if there is no source, no such format, or none that fits.
    """
    if name != "auto" and name not in FORMATS:
        raise PalpateError(
            f"The format must be auto or one of {', '.join(FORMATS)}",
            repr(name),
            "Choose one of these",
        )
    if not source.exists() and (name == "auto" or not FORMATS[name].remote):
        raise PalpateError(
            "The source of an import must exist",
            f"nothing at {source}",
            "Check the path; for a data set on the hub: --format hf",
        )
    if name == "auto":
        name = next((n for n, f in FORMATS.items() if f.detect(source)), "")
    if not name:
        wanted = "; ".join(f"{n}: {f.looks_for}" for n, f in FORMATS.items())
        raise PalpateError(
            f"{source} must look like a known data set. Looked for {wanted}",
            _contents(source),
            "Name the format: --format",
        )
    return name, FORMATS[name]


def _given(name: str, found: Format, options: dict[str, Any]) -> dict[str, Any]:
    """The options that were given, if they all belong to the format."""
    given = {key: value for key, value in options.items() if value is not None}
    if strange := sorted(set(given) - set(found.options)):
        raise PalpateError(
            f"The format {name} takes the options {', '.join(found.options)}",
            ", ".join(strange),
            "Leave the others out",
        )
    return given


def _contents(source: Path) -> str:
    """What lies in the source, shortly."""
    if source.is_file():
        return f"the file {source.name}"
    names = sorted(p.name + "/" * p.is_dir() for p in source.iterdir())
    return (
        "an empty folder"
        if not names
        else "a folder with " + ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")
    )
