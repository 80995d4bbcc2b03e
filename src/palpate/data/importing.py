"""Data sets of any known format: import one, validate one, write a split in its own form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, Split, locked, quiet
from palpate.data.formats import FORMATS, scanned
from palpate.data.images import Check
from palpate.data.imported import Imported, Validation, imported_of, removing_on_error, templates_of
from palpate.data.listing import write_table
from palpate.data.manifest import FOLLOWED, SCHEMA, Manifest, is_manifest
from palpate.data.mapping import LINE
from palpate.data.rows import records
from palpate.data.scanning import (
    MISSING,
    WORLD,
    Facts,
    Into,
    Scan,
    finished,
    manifest_of,
    world_facts,
)
from palpate.data.texts import read_texts, reimported, with_texts

#: All that an import writes.
WRITTEN = {"manifest.parquet", "splits", "images"}


def import_dataset(
    source: Path | str,
    output: Path | str,
    *,
    format: str = "auto",  # noqa: A002 (the word that the command line uses)
    skip_bad: bool = False,
    overwrite: bool = False,
    check: Check = "decode",
    text: Path | str | None = None,
    progress: Progress = quiet,
    **options: Any,
) -> Imported:
    """Read a data set of any known format and write ``output/manifest.parquet``.

    Args:
        source: folder or table, or a name on the hub with ``format="hf"``.
        output: folder to write to: new, empty, or an earlier import.
        format: a name in ``FORMATS``, or ``auto`` for the first that the source looks like.
        skip_bad: skip and list bad rows instead of raising.
        overwrite: replace the manifest of an earlier import.
        check: how images are checked.
        text: table of texts by sample id, or the folder of captions, to join; the source may then
            be an import as well.
        progress: progress callback.
        options: options of the format (``columns``, ``root``, ``size`` ...); None means the
            default.

    Raises:
        PalpateError: if the source is missing or looks like no known format, an option does not
            belong to the format, or the output holds a manifest or other files.
        ProblemsError: with every bad row and file at once; nothing is left behind.
    """
    source, output = Path(source), Path(output)
    foreign = {p.name for p in output.iterdir()} - WRITTEN if output.is_dir() else set[str]()
    if foreign:
        must = "must be a folder that is new, empty, or an earlier import"
        got = f"{output} with {min(foreign)}"
        raise PalpateError(must, got, "Choose another folder", argument="output")
    if (output / "manifest.parquet").exists() and not overwrite:
        must, fix = "must hold no manifest yet", "Choose another folder, or replace this one"
        example = {"overwrite": True}
        raise PalpateError(must, str(output), fix, argument="output", example=example)
    texts = None if text is None else read_texts(Path(text))
    with locked(output), removing_on_error(output) as created:
        if text is not None and format == "auto" and is_manifest(source):
            imported = reimported(source)
        else:
            options |= {"check": check, "progress": progress}
            options["into"] = Into(output, created, skip_bad)
            _, form, scan = scanned(source, format, options)
            check = "none" if form.writes else check  # they were checked on the way
            imported = imported_of(scan, source, skip_bad=skip_bad, check=check, progress=progress)
        if text is not None and texts is not None:
            imported = with_texts(imported, texts, Path(text))
        return imported.save(output, created)


def validate(
    source: Path | str,
    *,
    format: str = "auto",  # noqa: A002
    check: Check = "decode",
    progress: Progress = quiet,
    **options: Any,
) -> Validation:
    """Check a data set without writing anything: what is missing, invalid or suspicious.

    Args:
        source: folder or table, or a name on the hub with ``format="hf"``; an import is checked
            again.
        format: as in :func:`import_dataset`.
        check: how images are checked.
        progress: progress callback.
        options: options of the format, those of its import included; None means the default.

    Raises:
        PalpateError: as :func:`import_dataset`.
    """
    if not isinstance(source, (str, Path)):
        must, fix = "must be a folder or a table on disk", "Write it, or see palpate.load"
        raise PalpateError(must, type(source).__name__, fix, argument="source")
    source, world = Path(source), world_facts(Path(source))
    if format == "auto" and is_manifest(source):
        name, facts, scan = _scan_of(Manifest.load(source, options.get("root")))
    else:
        options |= {"check": check, "progress": progress}
        name, form, scan = scanned(source, format, options)
        # palpate's own world has the layouts of real sets and must not be shown as one of them.
        facts = WORLD if world else form.facts
    rows = finished(scan, check, progress)
    if not rows and not scan.problems:
        scan.problem(source, "empty", "no sample is usable")
    missing = [p for p in scan.problems if p.kind.startswith(MISSING)]
    invalid = [p for p in scan.problems if not p.kind.startswith(MISSING)]
    templated = any(fact.startswith(("template_", "images")) for fact in scan.facts)
    templates = templates_of(manifest_of(scan, rows)) if templated else {}
    odd = {problem.where for problem in scan.suspicious}
    looks = {recording: look for recording, look in scan.looks.items() if recording in odd}
    return Validation(name, facts, len(rows), missing, invalid, scan.suspicious, templates, looks)


def _scan_of(manifest: Manifest) -> tuple[str, Facts, Scan]:
    """The rows of an import, to be checked again."""
    fact = manifest.facts.get
    facts = Facts(
        name=fact("dataset", "an import"),
        license=fact("license", "unknown"),
        citation=fact("citation", "unknown"),
        url=fact("url", "unknown"),
        samples="as many as it has rows",
        group=fact("group", "video"),
    )
    scan = Scan(manifest.root, dict(manifest.facts), met=fact("links") == FOLLOWED)
    scan.rows = records(manifest.table.with_row_index(LINE, offset=1), "row {}".format)
    scan.more = tuple(manifest.table.columns[len(SCHEMA) :])
    return "manifest", facts, scan


def write_lists(manifest: Manifest, split: Split, output: Path) -> list[Path]:
    """Write a split as lists of the data set that the manifest came from, else a CSV per part.

    Samples without images that have videos and frames become frame lists, as those of Touch and Go.

    Returns:
        The files written.
    """
    form = FORMATS.get(manifest.facts.get("format", ""))
    bare = "format" not in manifest.facts and not manifest.table["frame"].null_count()
    if bare and not any(manifest.table[column].count() for column in ("vision", "tactile")):
        form = FORMATS["touch-and-go"]
    if form is not None and form.write_lists is not None:
        return form.write_lists(manifest, split, Path(output))
    parts = {part: manifest.part(split, part) for part in split.counts()}
    return [write_table(Path(output) / f"{part}.csv", rows) for part, rows in parts.items()]
