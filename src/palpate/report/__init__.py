"""The report room: results as tables in the terminal, in Markdown and in LaTeX, and as a page.

Importing this package or :mod:`palpate.report.results` loads no template engine and no image
library.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name
from palpate.report.results import Audit, Results

if TYPE_CHECKING:
    from palpate.report.findings import summary_lines
    from palpate.report.page import write_report

__all__ = ["Audit", "Results", "summary_lines", "write_report"]
_MODULES = {"summary_lines": "findings", "write_report": "page"}

__getattr__ = partial(import_name, __name__, _MODULES)
