"""``palpate report``: results become a page."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, guard_output
from palpate.core import Note, PalpateError, few, inside, read_record, require, short
from palpate.report.results import AUDIT_FORMAT, RESULTS_FORMAT, Audit, Results

TITLE = "palpate report"
#: Names of the files that a folder of figures holds.
WRITTEN = re.compile(r"(background|pairs|samples|strips)\b.*\.(png|svg)")


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write one self-contained page, with JSON and Markdown of the same results next to it.

    Figures for a paper can be written as files, too.
    """

    results: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Any of: the JSON of `palpate audit -o`, of `palpate score -o`, or of an earlier page."""
    output: OutPath
    """The page to write (.html)."""
    title: str = TITLE
    """Heading of the page."""
    images: tuple[Path, ...] = ()
    """Folders whose images the page may show, next to those of the results."""
    figures: Path | None = None
    """Folder for figures: scores (.svg), samples and pairs (.png)."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Merge the results and write the page."""
    if not options.results:
        example = {"results": "audit.json"}
        raise PalpateError("A report needs results", "no file", "Name some", example=example)
    from palpate.report import write_report

    if options.output.suffix == ".html":
        marks = (options.title.encode(), b"palpate")
        guard_output(options.output, options.results, marks)
        guard_output(options.output.with_suffix(".json"), options.results)
        guard_output(options.output.with_suffix(".md"), options.results, marks)
    _guard_folder(options.figures)
    results = [read(path, options.images) for path in options.results]
    merged = reduce(join, results, Results(title=options.title))
    for note in merged.notes:
        if note.code == "images-outside":
            terminal.note(note)
    merged = replace(merged, notes=[*merged.notes, *_mismatch(merged)])
    with terminal.progress() as progress:
        files = write_report(merged, options.output, base=Path(), progress=progress)
    paths = {"page": str(files.page), "json": str(files.json), "markdown": str(files.markdown)}
    if options.figures:
        merged.save_figures(options.figures)
        paths["figures"] = str(options.figures)
    terminal.facts("Report", paths)
    return paths


def _guard_folder(folder: Path | None) -> None:
    """Check that a folder of figures holds no other files, which might be replaced.

    Raises:
        PalpateError: if it holds one, or is a file.
    """
    if folder is None or not folder.exists():
        return
    require(folder.is_dir(), "figures", "must be a folder", str(folder), fix="Name another")
    foreign = sorted(path.name for path in folder.iterdir() if not WRITTEN.fullmatch(path.name))
    must = "must be a new folder, or hold nothing but files of this command"
    got = f"{folder} with {few(foreign)}"
    require(not foreign, "figures", must, got, fix="Choose another folder")


def read(path: Path, folders: Sequence[Path] = ()) -> Results:
    """Read one file of results or an audit, with image paths from the working directory.

    Images outside its folder and ``folders`` are removed: a page of results from elsewhere must not
    show what their author may not see.

    Raises:
        PalpateError: if it is missing, of another format, or incomplete.
    """
    data = read_record(path, "results file", form=(RESULTS_FORMAT, AUDIT_FORMAT))
    try:
        if data["format"] == AUDIT_FORMAT:
            results = replace(Audit.from_json(data).to_results(), title="")
        else:
            results = Results.from_json(data)
    except ValueError as error:
        got = f"a missing, unknown or wrong field ({error})"
        fix = "Write it again with palpate"
        raise PalpateError(f"{path} must hold complete results", got, fix) from None
    outside: set[str] = set()

    def place(name: str) -> str | None:
        if any(
            inside(root, str(path.parent.absolute() / name)) for root in (path.parent, *folders)
        ):
            return os.path.normpath(path.parent / name)
        outside.add(name)
        return None

    results = results.with_paths(place)
    results = results.with_call_paths(lambda name: os.path.normpath(path.parent / name))
    note = Note("images-outside", {"count": len(outside), "file": str(path)})
    return replace(results, notes=[*results.notes, note]) if outside else results


def join(first: Results, second: Results) -> Results:
    """Return both, one after the other; the first title of its own stays."""
    names = (f.name for f in fields(Results) if f.name not in ("title", "settings"))
    title = second.title if first.title == TITLE and second.title else first.title
    return Results(
        title=title,
        settings={**first.settings, **second.settings},
        **{name: [*getattr(first, name), *getattr(second, name)] for name in names},
    )


def _mismatch(results: Results) -> list[Note]:
    """Return a note if no audit on the page is of the split that the scores are on."""
    audited, scored = ({x.split for x in of if x.split} for of in (results.audits, results.scores))
    if not results.audits or not scored - audited:
        return []
    return [Note("other-split", {"splits": ", ".join(map(short, sorted(scored - audited)))})]
