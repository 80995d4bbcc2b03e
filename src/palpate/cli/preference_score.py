"""``palpate preference score``: from votes to preferences with intervals."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Common, Files, Terminal


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
    files: Files = field(default_factory=Files)


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Score, print the tables, write."""
    inputs = [options.study, options.study / "plan.json", *options.votes, *options.metrics]
    options.files.guard(inputs)
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
    return terminal.deliver(results, options.files)
