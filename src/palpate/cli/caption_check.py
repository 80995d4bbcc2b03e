"""``palpate caption check``: do captions give labels away, and can they be used?"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from palpate.cli.importing import Maps, columns_of
from palpate.cli.terminal import (
    Common,
    Files,
    OptionalOutPath,
    PathArgument,
    Terminal,
    option_group,
)
from palpate.cli.verbs import FAILED_CHECK
from palpate.core import require


@option_group
class Options(Common):
    """Check captions: labels in the text, material read from the text alone on new videos, text
    that train and test share, refusals, empty and overlong text, one text for many contacts, and
    words of color and shape that no finger feels.
    """

    captions: PathArgument
    """Folder of palpate caption, a table with the columns id and text, or without --data also
    samples with texts."""
    data: Path | None = None
    """The samples: their materials, videos and contacts."""
    split: Path | None = None
    """Split file: also look for texts that train and test share."""
    columns: Maps = ()
    """Columns of a table without --data: `--map text=label id=tactile_fp`."""
    fail_over: float | None = None
    """Exit with status 1 if more than this share of the captions is flagged: names its label, has
    visual words or digits, is a refusal, empty or overlong."""
    output: OptionalOutPath = None
    """Write the scores as JSON, for `palpate report`."""
    page: Path | None = None
    """Write them as one self-contained page (.html)."""
    seed: int = 0
    """Of the folds."""


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Check, print the table, write."""
    from palpate.captions import check_captions
    from palpate.captions.checking import FLAGGED, SHARE

    limit = options.fail_over
    require(limit is None or 0 <= limit <= 1, "fail_over", "must lie in [0, 1]", limit)
    inputs = [p for p in (options.captions, options.data, options.split) if p is not None]
    files = Files(output=options.output, page=options.page)
    files.guard(inputs)
    check = check_captions
    if columns := columns_of(options.columns):
        check = partial(check, columns=columns)
    results = terminal.run(
        check, options.captions, options.data, split=options.split, seed=options.seed
    )
    shown = terminal.deliver(results, files)
    flagged = float(results[SHARE, FLAGGED])
    failed = limit is not None and flagged > limit
    if failed:
        terminal.print_line(f"FAIL: share of flagged captions {round(flagged, 5)} is over {limit}")
    return shown | {"failed": failed}, FAILED_CHECK if failed else 0
