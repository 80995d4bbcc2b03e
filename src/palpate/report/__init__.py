"""The report room: Results in, one self-contained page out, with the same facts as JSON and Markdown beside it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from palpate.core import PalpateError, Progress, quiet, write_json, write_text
from palpate.report.checks import check_results
from palpate.report.markdown import render_markdown
from palpate.report.page import render_page
from palpate.report.paths import with_paths
from palpate.report.results import Results
from palpate.report.sentences import summary_lines
from palpate.report.text import plain

__all__ = [
    "ReportFiles",
    "check_results",
    "render_markdown",
    "render_page",
    "summary_lines",
    "with_paths",
    "write_report",
]


@dataclass(frozen=True)
class ReportFiles:
    """What :func:`write_report` wrote."""

    page: Path
    json: Path
    markdown: Path


def _moved(results: Results, base: Path, folder: Path) -> Results:
    """The results with all picture paths counted from ``folder``: they stay right when the run folder moves, and name nobody's disk."""
    start, end = base.resolve(), folder.resolve()
    return with_paths(
        results, lambda name: Path(os.path.relpath(start / name, end)).as_posix()
    )  # an absolute name replaces the base


def write_report(
    results: Results,
    page: Path,
    *,
    base: Path | None = None,
    max_bytes: int = 10_000_000,
    progress: Progress = quiet,
) -> ReportFiles:
    """Writes ``page`` (HTML) and, beside it, the same results as ``.json`` and ``.md``; each file whole or not at all.

    Args:
        results: everything to show.
        page: the HTML file; its name must end in ``.html``.
        base: folder that relative picture paths of ``results`` start from; by default the folder of ``page``. The JSON
            counts them from its own folder, so that it can be read where it lies.
        max_bytes: largest size of the HTML file. Pictures shrink, then rows are left out, and the page says so.
        progress: told while pictures are made.

    Returns:
        The three paths.

    Raises:
        PalpateError: if ``page`` does not end in ``.html``, if scores of different settings would share a column (nothing
            is written then), or if ``max_bytes`` cannot even hold the text.
    """
    page = Path(page)
    if page.suffix != ".html":
        raise PalpateError(
            "The page's file name must end in .html", f"{page.name!r}", "Name it e.g. report.html"
        )
    here = page.parent
    results = _moved(results, base if base is not None else here, here)
    files = ReportFiles(page, page.with_suffix(".json"), page.with_suffix(".md"))
    text = render_markdown(results)
    write_json(files.json, plain(results.to_json()))
    write_text(files.markdown, text)
    write_text(
        page,
        render_page(
            results,
            here,
            max_bytes=max_bytes,
            names=(files.json.name, files.markdown.name),
            progress=progress,
        ),
    )
    return files
