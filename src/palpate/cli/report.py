"""``palpate report``: results become a page."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Common, OutPath, Terminal, guard_output
from palpate.core import Note, PalpateError, read_json
from palpate.report.results import AUDIT_FORMATS, RESULTS_FORMATS, Audit, Results


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Write one self-contained page, with JSON and Markdown of the same results beside it."""

    results: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Any of: the JSON of `palpate audit -o`, of `palpate score -o`, or of an earlier page."""
    output: OutPath
    """The page to write (.html)."""
    title: str = "palpate report"
    """Heading of the page."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Merges the results and writes the page."""
    if not options.results:
        raise PalpateError(
            "A report needs results",
            "no file",
            "E.g. palpate audit train.txt test.txt -o audit.json",
        )
    from palpate.report import write_report

    if options.output.suffix == ".html":
        guard_output(options.output, options.results, (b"palpate",))
        guard_output(options.output.with_suffix(".json"), options.results)
        guard_output(
            options.output.with_suffix(".md"), options.results, (options.title.encode(), b"palpate")
        )
    merged = Results(title=options.title)
    for path in options.results:
        merged = _join(merged, _read(path))
    mismatch = [Note("text", {"text": text}) for text in _mismatch(merged)]
    merged = replace(merged, notes=[*merged.notes, *mismatch])
    with terminal.progress() as progress:
        files = write_report(merged, options.output, progress=progress)
    paths = {"page": str(files.page), "json": str(files.json), "markdown": str(files.markdown)}
    terminal.facts("Report", paths)
    return paths


def _read(path: Path) -> Results:
    """One file of results, checked, with absolute picture paths.

    Raises:
        PalpateError: if it is missing, not ours, or incomplete.
    """
    from palpate.report import with_paths

    data = read_json(path, "results file")
    kind = data.get("format") if isinstance(data, dict) else None
    try:
        match kind:
            case _ if kind in AUDIT_FORMATS:
                results = replace(Audit.from_json(data).to_results(), title="")
            case _ if kind in RESULTS_FORMATS:
                results = Results.from_json(data)
            case _:
                raise PalpateError(
                    f"{path} must hold results of palpate",
                    f"format {kind!r}",
                    "Pass the JSON of audit -o, score -o, or of a page",
                )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise PalpateError(
            f"{path} must hold complete results",
            f"a missing or unknown field ({error})",
            "Write it again with palpate",
        ) from None
    return with_paths(results, lambda name: str((path.parent / name).resolve()))


def _mismatch(results: Results) -> list[str]:
    """Says so if no audit on the page is of the split that the scores are on."""
    audited, scored = ({x.split for x in of if x.split} for of in (results.audits, results.scores))
    if results.audits and scored - audited:
        named = ", ".join(s[:8] for s in sorted(scored - audited))
        return [
            f"No audit on this page is of the split that these scores are on ({named}): what the audits say of leaks does not speak of them."
        ]
    return []


def _join(a: Results, b: Results) -> Results:
    """The two, one after the other; the first non-empty title stays."""
    return Results(
        title=a.title if a.title != "palpate report" or not b.title else b.title,
        facts=[*a.facts, *b.facts],
        audits=[*a.audits, *b.audits],
        scores=[*a.scores, *b.scores],
        gallery=[*a.gallery, *b.gallery],
        settings={**a.settings, **b.settings},
        notes=[*a.notes, *b.notes],
        commands=[*a.commands, *b.commands],
    )
