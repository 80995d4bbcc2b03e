"""``palpate report``: results become a page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from palpate.cli.terminal import (
    Common,
    OutPath,
    PathArguments,
    Terminal,
    guard_output,
    option_group,
)
from palpate.core import Note, PalpateError, few, inside, require, short
from palpate.report.results import Results

TITLE = "palpate report"
#: Names of the files that a folder of figures holds.
WRITTEN = re.compile(r"(background|pairs|samples|strips)\b.*\.(png|svg)")


@option_group
class Options(Common):
    """Write one self-contained page, with JSON and Markdown of the same results next to it.

    Figures for a paper can be written as files, too.
    """

    results: PathArguments
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
    titles = (options.title, *(each.title for each in results))
    names = [f.name for f in fields(Results) if f.name not in ("title", "settings")]
    merged = Results(
        title=next((title for title in titles if title not in ("", TITLE)), TITLE),
        settings={name: value for each in results for name, value in each.settings.items()},
        **{name: [item for each in results for item in getattr(each, name)] for name in names},
    )
    for note in merged.notes:
        if note.code == "images-outside":
            terminal.note(note)
    audited, scored = (
        {x.split for x in items if x.split} for items in (merged.audits, merged.scores)
    )
    if merged.audits and (others := scored - audited):  # no audit is of the scores' split
        note = Note("other-split", {"splits": ", ".join(map(short, sorted(others)))})
        merged = replace(merged, notes=[*merged.notes, note])
    files = terminal.run(write_report, merged, options.output, base=Path())
    paths = {"page": str(files.page), "json": str(files.json), "markdown": str(files.markdown)}
    if options.figures:
        merged.save_figures(options.figures)
        paths["figures"] = str(options.figures)
    return terminal.facts("Report", paths)


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
    results, outside = Results.load(path), set[str]()

    def keep(name: str) -> str | None:
        if any(inside(root, str(Path(name).absolute())) for root in (path.parent, *folders)):
            return name
        outside.add(name)
        return None

    results = results.with_paths(keep)
    note = Note("images-outside", {"count": len(outside), "file": str(path)})
    return replace(results, notes=[*results.notes, note]) if outside else results
