"""``palpate report``: files of results become one page."""

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
#: Names of the figures that this command writes.
FIGURES = re.compile(r"(background|pairs|samples|strips)\b.*\.(png|svg)")


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
    """Further folders whose images the page may show; else those next to the results alone."""
    figures: Path | None = None
    """Folder for figures: scores (.svg), samples and pairs (.png)."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Merge the results and write the page."""
    if not options.results:
        example = {"results": "audit.json"}
        raise PalpateError("A report needs results", "no file", "Name some", example=example)
    from palpate.report import write_report

    if options.output.suffix == ".html":  # any other is refused below
        marks = (options.title.encode(), b"palpate")  # words in what an earlier report wrote there
        guard_output(options.output, options.results, marks)
        guard_output(options.output.with_suffix(".json"), options.results)
        guard_output(options.output.with_suffix(".md"), options.results, marks)
    _guard_folder(options.figures)
    results = merged([read(path, options.images) for path in options.results], options.title)
    for note in results.notes:
        if note.code == "images-outside":  # --images is the remedy; other notes are on the page
            terminal.note(note)
    files = terminal.run(write_report, results, options.output, base=Path())
    paths = files._asdict()
    if options.figures:
        results.save_figures(options.figures)
        paths["figures"] = options.figures
    return terminal.facts("Report", {name: str(paths[name]) for name in paths})


def merged(parts: Sequence[Results], title: str) -> Results:
    """Join results; a note names the splits of scores that no audit is of, if there are audits.

    Args:
        parts: the results; of settings with one name the last counts.
        title: the heading; while it is the default, the first other one of the parts is taken.
    """
    titles = (title, *(part.title for part in parts))
    lists = {field.name for field in fields(Results)} - {"title", "settings"}
    results = Results(
        title=next((name for name in titles if name not in ("", TITLE)), TITLE),
        settings={name: value for part in parts for name, value in part.settings.items()},
        **{name: [item for part in parts for item in getattr(part, name)] for name in lists},
    )
    unaudited = {score.split for score in results.scores if score.split}
    unaudited -= {audit.split for audit in results.audits}
    if results.audits and unaudited:
        note = Note("other-split", {"splits": ", ".join(map(short, sorted(unaudited)))})
        results = replace(results, notes=[*results.notes, note])
    return results


def _guard_folder(folder: Path | None) -> None:
    """Check that a folder for figures is new, or holds figures of this command alone.

    Raises:
        PalpateError: if it holds anything else, or is a file.
    """
    if folder is None or not folder.exists():
        return
    require(folder.is_dir(), "figures", "must be a folder", str(folder), fix="Name another")
    foreign = sorted(path.name for path in folder.iterdir() if not FIGURES.fullmatch(path.name))
    must = "must be a new folder, or hold nothing but files of this command"
    got = f"{folder} with {few(foreign)}"
    require(not foreign, "figures", must, got, fix="Choose another folder")


def read(path: Path, folders: Sequence[Path] = ()) -> Results:
    """Read results or an audit, with image paths from the working directory.

    Paths of images outside the file's folder and ``folders`` are removed, and a note counts them: a
    file from somebody else could name any image of this computer, and the page, which holds copies
    of its images, may go back to its author.

    Raises:
        PalpateError: if it is missing, of another format, or incomplete.
    """
    outside = set[str]()

    def keep(name: str) -> str | None:
        if any(inside(root, str(Path(name).absolute())) for root in (path.parent, *folders)):
            return name
        outside.add(name)
        return None

    results = Results.load(path).with_paths(keep)
    if not outside:
        return results
    note = Note("images-outside", {"count": len(outside), "file": str(path)})
    return replace(results, notes=[*results.notes, note])
