"""The report room: results as tables in the terminal, in Markdown and in LaTeX, and as a page.

Importing this package or :mod:`palpate.report.results` loads no template engine and no image
library.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from palpate.core import PalpateError, Progress, quiet, write_json, write_text
from palpate.report.results import Audit, Results

__all__ = ["Audit", "ReportFiles", "Results", "summary_lines", "write_report"]


class ReportFiles(NamedTuple):
    """What :func:`write_report` wrote."""

    page: Path
    json: Path
    markdown: Path


def summary_lines(results: Results) -> list[str]:
    """Return at most three headline facts."""
    from palpate.report import sentences

    return sentences.summary_lines(results)


def write_report(
    results: Results,
    page: Path,
    *,
    base: Path | None = None,
    max_bytes: int = 10_000_000,
    progress: Progress = quiet,
) -> ReportFiles:
    """Write ``page`` (HTML) and, next to it, the same results as ``.json`` and ``.md``.

    Args:
        results: everything to show.
        page: the HTML file; its name must end in ``.html``.
        base: folder that relative image paths of ``results`` start from; by default that of
            ``page``. The JSON counts them from its own folder.
        max_bytes: largest size of the HTML file. Images shrink, then rows are skipped, and the page
            says so.
        progress: called while images are made.

    Raises:
        PalpateError: if ``page`` does not end in ``.html``, if scores of different settings would
            share a column (nothing is written then), or if ``max_bytes`` cannot hold the text.
    """
    from palpate.report.page import render_page

    page = Path(page)
    if page.suffix != ".html":
        fix = "Name it e.g. report.html"
        raise PalpateError("The page's file name must end in .html", f"{page.name!r}", fix)
    folder = page.parent
    results = results.relative_to(folder, base=base or folder)
    files = ReportFiles(page, page.with_suffix(".json"), page.with_suffix(".md"))
    names = (files.json.name, files.markdown.name)
    markdown = results.to_markdown()
    html = render_page(results, folder, max_bytes=max_bytes, names=names, progress=progress)
    write_json(files.json, results.to_json())
    write_text(files.markdown, markdown)
    write_text(page, html)
    return files
