"""``palpate verify``: do the numbers of a results file come out again?"""

from __future__ import annotations

from typing import Any

from palpate.cli.terminal import Common, PathArgument, Switch, Terminal, option_group


@option_group
class Options(Common):
    """Make the numbers of a results file again from its inputs, and compare them.

    Each score, audit, table and input is the same, differs, or cannot be checked (an input is
    missing, or was never a file). The exit status is 0 if all is the same, 1 if something differs,
    3 (cannot tell) if nothing does, but not all could be checked.
    """

    results: PathArgument
    """The JSON of `palpate score -o`, `palpate probe -o`, `palpate audit -o`, of a page, or in the
    run folder of `palpate demo` or `palpate reproduce`. It may have been moved with what it was
    made of."""
    tolerance: float = 1e-6
    """Relative difference up to which two numbers are the same, if not to the sixth decimal:
    another machine adds in another order. Counts and digests must be equal."""
    trust_torchscript: Switch = False
    """Run the code in a TorchScript file (Inception) that the results name: a program, which runs
    with your rights and can write files."""


def run(options: Options, terminal: Terminal) -> Any:
    """Verify, print the counts and all that is not the same."""
    from palpate.studies.verifying import verify

    return terminal.run(verify, options.results, **options.keywords("results"))
