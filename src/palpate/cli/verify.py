"""``palpate verify``: do the numbers of a results file come out again?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from palpate.cli.terminal import Common, Terminal
from palpate.cli.verbs import FAILED_CHECK


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Make the numbers of a results file again from its inputs, and compare them.

    Each score, audit, table and input is the same, differs, or cannot be checked (an input is
    missing, or was never a file). Exits with status 1 if something differs.
    """

    results: Annotated[Path, tyro.conf.Positional]
    """The JSON of `palpate score -o`, `palpate probe -o`, `palpate audit -o`, of a page, or in the
    run folder of `palpate demo` or `palpate reproduce`. It may have been moved with what it was
    made of."""
    tolerance: float = 1e-6
    """Relative difference up to which two numbers are the same, if not to the sixth decimal:
    another machine adds in another order. Counts and digests must be equal."""


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Verify, print the counts and all that is not the same, write."""
    from palpate.studies.verifying import verify

    with terminal.progress() as progress:
        checked = verify(options.results, tolerance=options.tolerance, progress=progress)
    terminal.print(str(checked))
    return checked.to_json(), 0 if checked.ok else FAILED_CHECK
