"""The report room: results as tables in the terminal, in Markdown and in LaTeX, and as a page.

Importing this package or :mod:`palpate.report.results` loads no template engine and no image library.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.core import PalpateError, Progress, quiet, write_json, write_text
from palpate.report.results import Audit, Results

if TYPE_CHECKING:
    from palpate.report.markdown import render_markdown
    from palpate.report.page import render_page
    from palpate.report.paths import with_paths
    from palpate.report.sentences import summary_lines

_LAZY = {
    "render_markdown": "markdown",
    "render_page": "page",
    "summary_lines": "sentences",
    "with_paths": "paths",
}
__all__ = [
    "Audit",
    "ReportFiles",
    "Results",
    "render_markdown",
    "render_page",
    "summary_lines",
    "with_paths",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"palpate.report.{_LAZY[name]}"), name)


@dataclass(frozen=True)
class ReportFiles:
    """What :func:`write_report` wrote."""

    page: Path
    json: Path
    markdown: Path


def _moved(results: Results, base: Path, folder: Path) -> Results:
    """The results with image paths relative to ``folder``: they stay right when the run folder moves."""
    import os

    from palpate.report.paths import with_paths

    start, end = base.resolve(), folder.resolve()
    return with_paths(results, lambda name: Path(os.path.relpath(start / name, end)).as_posix())


def write_report(
    results: Results,
    page: Path,
    *,
    base: Path | None = None,
    max_bytes: int = 10_000_000,
    progress: Progress = quiet,
) -> ReportFiles:
    """Write ``page`` (HTML) and, next to it, the same results as ``.json`` and ``.md``, each atomically.

    Args:
        results: everything to show.
        page: the HTML file; its name must end in ``.html``.
        base: folder that relative image paths of ``results`` start from; by default the folder of ``page``. The JSON
            counts them from its own folder.
        max_bytes: largest size of the HTML file. Images shrink, then rows are skipped, and the page says so.
        progress: called while images are made.

    Returns:
        The three paths.

    Raises:
        PalpateError: if ``page`` does not end in ``.html``, if scores of different settings would share a column (nothing
            is written then), or if ``max_bytes`` cannot even hold the text.
    """
    from palpate.report.markdown import render_markdown
    from palpate.report.page import render_page
    from palpate.report.text import plain

    page = Path(page)
    if page.suffix != ".html":
        raise PalpateError(
            "The page's file name must end in .html", f"{page.name!r}", "Name it e.g. report.html"
        )
    folder = page.parent
    results = _moved(results, base if base is not None else folder, folder)
    files = ReportFiles(page, page.with_suffix(".json"), page.with_suffix(".md"))
    text = render_markdown(results)
    write_json(files.json, plain(results.to_json()))
    write_text(files.markdown, text)
    names = (files.json.name, files.markdown.name)
    html = render_page(results, folder, max_bytes=max_bytes, names=names, progress=progress)
    write_text(page, html)
    return files
