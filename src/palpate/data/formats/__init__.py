"""Data-set formats, one file each, tried from first to last when a source is to be recognized."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, few, require, require_choice, require_regular
from palpate.data.foreign import copied_links, counted, foreign, require_native
from palpate.data.formats import (
    hct,
    huggingface,
    intervals,
    pairs,
    published,
    ssvtp,
    touch_and_go,
    videos,
)
from palpate.data.formats.videos import is_templated
from palpate.data.manifest import IMAGE_COLUMNS
from palpate.data.scanning import Facts, Format, Row, Scan

FORMATS: dict[str, Format] = {
    "touch-and-go": touch_and_go.FORMAT,
    "hct": hct.FORMAT,
    "ssvtp": ssvtp.FORMAT,
    **{name: pairs.format_of(layout) for name, layout in published.LAYOUTS.items()},
    "intervals": intervals.FORMAT,
    "hf": huggingface.FORMAT,
    "videos": videos.FORMAT,
    "pairs": pairs.FORMAT,
}

__all__ = ["FORMATS", "Facts", "Format", "Row", "Scan", "require_source", "scanned"]


def require_source(source: Path) -> None:
    """Raise ``PalpateError`` if there is nothing at the path of a data set."""
    fix = "Check the path; a data set on the hub needs the format hf"
    require(source.exists(), "source", "must exist", f"nothing at {source}", fix=fix)


def _recognized(source: Path, name: str, options: Mapping[str, Any]) -> tuple[str, Format]:
    """The named format, or the first that the source looks like; templates give pairs or videos."""
    require_choice("format", name, ("auto", *FORMATS))
    require_regular(source)
    if name == "auto" or not FORMATS[name].remote:
        require_source(source)
        require_native(source)
    if name == "auto":
        templates = {c: text for c in IMAGE_COLUMNS if (text := options.get(c))}
        looks = (n for n, form in FORMATS.items() if form.detect(source))
        templated = "videos" if templates and is_templated(source, templates) else "pairs"
        name = templated if templates else next(looks, "")
    if not name:
        must = f"must hold images, videos, a table or a known data set ({', '.join(FORMATS)})"
        fix = "Check the path, or write a table of its images"
        inner = sorted(source.iterdir()) if source.is_dir() else ()
        fix = next((ways[1] for path in inner if (ways := foreign(path))), fix)
        if source.is_dir() and (source / "manifest.parquet").is_file():
            fix = "This is an import: name the data set that it was made from"
        raise PalpateError(must, _contents(source), fix, argument="source")
    return name, FORMATS[name]


def scanned(source: Path, name: str, options: Mapping[str, Any]) -> tuple[str, Format, Scan]:
    """Read a source by the named format, or by the one that it looks like.

    Args:
        source: a path, or a name on the hub.
        name: of the format, or ``auto``.
        options: of the format, and ``check``, ``progress`` and ``into``; None is the default.

    Returns:
        The name of the format, the format, and what it reads, with their facts.

    Raises:
        PalpateError: if there is no such source or format, or an option does not belong to it.
    """
    name, form = _recognized(source, name, options)
    values = {key: value for key, value in options.items() if value is not None}
    for unknown in sorted(set(values) - {*form.options, "into"}):
        common = ("skip_bad", "check", "progress")
        takes = ", ".join(f"`{option}`" for option in form.options if option not in common)
        must, got = f"must be left out for the format {name}", repr(values[unknown])
        fix = f"This format takes {takes or 'no options'}"
        raise PalpateError(must, got, fix, argument=unknown)
    scan = form.read(source, values)
    scan.facts = {**form.facts.of_manifest(), "format": name, **scan.facts}
    return name, form, scan


def _contents(source: Path) -> str:
    """What a source holds, in short."""
    if source.is_file():
        return f"the file {source.name}"
    if links := copied_links(source):
        return f"files that were links to folders, which a copy did not keep: {links}"
    names = sorted(p.name + "/" * p.is_dir() for p in source.iterdir())
    if unread := counted(names):
        return f"a folder with {few(unread)}"
    return f"a folder with {few(names)}" if names else "an empty folder"
