"""``palpate validate``: check a data set without writing anything."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from palpate.cli.importing import SourceOptions
from palpate.cli.terminal import Files, Switch, Terminal, option_group
from palpate.core import require
from palpate.core.messages import SHOWN_PROBLEMS

if TYPE_CHECKING:
    from palpate.data import Validation
    from palpate.report.results import Results


@option_group
class Options(SourceOptions):
    """Check a data set: facts, and what is missing, invalid or suspicious. Nothing is written.

    The exit status is 1 if something is missing or invalid.
    """

    source: Annotated[Path | None, tyro.conf.Positional] = None
    """Root of the data set, a table, or with `--format hf` a name on the hub."""
    page: Path | None = None
    """What is wrong or suspicious as one self-contained page (.html), with pictures of recordings
    that look wrong, and .json and .md next to it."""
    show_list: Annotated[Switch, tyro.conf.arg(name="list")] = False
    """Show the known formats, their facts and their options."""


def run(options: Options, terminal: Terminal) -> Any:
    """Validate and print the result."""
    from palpate.data import validate

    if options.show_list:
        return _formats(terminal)
    fix = "See the formats: palpate validate --list"
    require(options.source is not None, "source", "must be named", "none", fix=fix)
    files = Files(page=options.page)
    files.guard([options.source] if options.source else [])
    validation = terminal.run(validate, **options.keywords("show_list", "page"))
    if options.page is not None:
        _results(validation, options.page).to_html(options.page)
    return validation


def _results(validation: Validation, page: Path) -> Results:
    """A validation as a page shows it; first frames of videos become files next to it."""
    from palpate.core import SampleRef, save_image
    from palpate.report.records import GalleryItem, StudyTable
    from palpate.report.results import Results

    def picture(recording: str, side: str) -> str | None:
        first = validation.looks[recording].first.get(side)
        if first is None or isinstance(first, Path):
            return first and str(first.resolve())
        path = page.with_suffix("") / f"{recording.replace('/', '-')}-{side}.png"
        save_image(path, first)
        return str(path.resolve())

    lists = {kind: getattr(validation, kind) for kind in ("missing", "invalid", "suspicious")}
    gallery = [
        GalleryItem(
            SampleRef(
                problem.where,
                material=problem.kind,
                vision=picture(problem.where, "vision"),
                tactile=picture(problem.where, "tactile"),
            ),
            None,
        )
        for problem in validation.suspicious
        if problem.where in validation.looks
    ]
    tables = [
        StudyTable(
            f"{kind.capitalize()}: {len(problems)}",
            "Of each kind how many there are, and where.",
            ("where", "kind", "of this kind", "what"),
            [
                (p.where, p.kind, str(sum(q.kind == p.kind for q in problems)), p.text)
                for p in problems[:SHOWN_PROBLEMS]
            ],
        )
        for kind, problems in lists.items()
        if problems
    ]
    counts = ", ".join(f"{len(problems)} {kind}" for kind, problems in lists.items())
    fact = f"{validation.samples} samples of {validation.facts.name}: {counts}."
    return Results(f"Validated {validation.facts.name}", [fact], gallery=gallery, tables=tables)


def _formats(terminal: Terminal) -> dict[str, Any]:
    """Print facts and options of every format; return them."""
    from palpate.data.formats import FORMATS
    from palpate.data.imported import readable

    formats: dict[str, Any] = {}
    for name, form in FORMATS.items():
        options = [o for o in form.options if o not in ("skip_bad", "check", "progress")]
        about = {"looks for": form.looks_for, "options": ", ".join(options) or None}
        terminal.facts(name, readable(form.facts) | about)
        formats[name] = asdict(form.facts) | {"looks_for": form.looks_for, "options": options}
    return formats
