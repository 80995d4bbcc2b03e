"""The report room: results as tables in the terminal, in Markdown and in LaTeX, and as a page.

Importing this package or :mod:`palpate.report.results` loads no template engine and no image
library.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from palpate.report.results import Audit, Results

if TYPE_CHECKING:
    from palpate.report.page import write_report
    from palpate.report.sentences import summary_lines

__all__ = ["Audit", "Results", "summary_lines", "write_report"]
_LAZY = {"summary_lines": "sentences", "write_report": "page"}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"palpate.report.{_LAZY[name]}"), name)
