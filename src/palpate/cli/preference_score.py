"""``palpate preference score``: from votes to preferences with intervals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Common, OptionalOutPath, Terminal, guard_results


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Score the votes of a study: preferences, strengths, agreement, and metrics that agree.

    Intervals resample items and raters. With two raters they resample items alone, and the result
    says that it is for these raters.
    """

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of palpate preference make; votes that its server stored count as well."""
    votes: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """What raters downloaded, or folders of that."""
    metrics: tuple[Path, ...] = ()
    """Which of these agree with people? The JSON of `palpate score -o` of the same methods."""
    replicates: int = 1000
    """Resamplings of an interval."""
    seed: int = 0
    """Of the resamplings."""
    output: OptionalOutPath = None
    """Write the scores as JSON, for `palpate report`, next to those of `palpate score`."""
    latex: Path | None = None
    """Write the tables as LaTeX (booktabs)."""
    page: Path | None = None
    """Write them as one self-contained page (.html)."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Score, print the tables, write."""
    inputs = [options.study, options.study / "plan.json", *options.votes, *options.metrics]
    guard_results(inputs, options.output, options.page, options.latex)
    from palpate.preference import score

    with terminal.progress() as progress:
        results = score(
            options.study,
            options.votes,
            metrics=options.metrics,
            replicates=options.replicates,
            seed=options.seed,
            progress=progress,
        )
    return terminal.deliver(results, output=options.output, page=options.page, latex=options.latex)
