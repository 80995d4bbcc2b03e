"""Importing by name or by look: a data-set format is one file with ``detect`` and an importer, and one row in ``FORMATS``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, quiet
from palpate.data import pairs, touch_and_go
from palpate.data.images import Check
from palpate.data.imported import Imported


@dataclass(frozen=True)
class Format:
    """One data-set format.

    Attributes:
        detect: whether a source looks like it; must be quick and must not raise.
        run: ``run(source, out, *, skip_bad, check, progress, ...) -> Imported``; further keywords are its own options.
        looks_for: what ``detect`` wants to see, for the error message.
    """

    detect: Callable[[Path], bool]
    run: Callable[..., Imported]
    looks_for: str

    @property
    def options(self) -> list[str]:
        """The keywords of ``run``."""
        return [p.name for p in inspect.signature(self.run).parameters.values() if p.kind is p.KEYWORD_ONLY]


#: Tried from first to last.
FORMATS: dict[str, Format] = {
    "touch-and-go": Format(touch_and_go.detect, touch_and_go.import_touch_and_go, touch_and_go.LOOKED_FOR),
    "pairs": Format(pairs.detect, pairs.import_pairs, pairs.LOOKED_FOR),
}


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
    source = Path(source)
    if format != "auto" and format not in FORMATS:
        raise PalpateError(f"The format must be auto or one of {', '.join(FORMATS)}", repr(format), "Choose one of these")
    if not source.exists():
        raise PalpateError("The source of an import must exist", f"nothing at {source}", "Check the path")
    name = format if format != "auto" else next((n for n, f in FORMATS.items() if f.detect(source)), None)
    if name is None:
        wanted = "; ".join(f"{n}: {f.looks_for}" for n, f in FORMATS.items())
        raise PalpateError(f"{source} must look like a known data set. Looked for {wanted}", _contents(source), "Name the format: --format")
    given = {key: value for key, value in options.items() if value is not None}
    if strange := sorted(set(given) - set(FORMATS[name].options)):
        raise PalpateError(
            f"The format {name} takes the options {', '.join(FORMATS[name].options)}", ", ".join(strange), "Leave the others out"
        )
    if size is not None and "size" in FORMATS[name].options:
        given["size"] = size
    return FORMATS[name].run(source, Path(out), skip_bad=skip_bad, check=check, progress=progress, **given)


def _contents(source: Path) -> str:
    """What lies in the source, shortly."""
    if source.is_file():
        return f"the file {source.name}"
    names = sorted(p.name + "/" * p.is_dir() for p in source.iterdir())
    return "an empty folder" if not names else "a folder with " + ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")
