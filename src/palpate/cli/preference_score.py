"""``palpate preference score``: from votes to preferences with intervals."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Any

from palpate.cli.terminal import Common, Files, PathArgument, PathArguments, Terminal, option_group


@option_group
class Options(Common):
    """Score the votes of a study: preferences, strengths, agreement, and metrics that agree.

    Intervals resample items and raters. With two raters they resample items alone, and the result
    says that it is for these raters.
    """

    study: PathArgument
    """Folder of palpate preference make; votes that its server stored count as well."""
    votes: PathArguments = ()
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

    keywords = options.keywords(votes=options.votes, metrics=options.metrics)
    results = terminal.run(score, **keywords)
    return terminal.deliver(results, options.files)
