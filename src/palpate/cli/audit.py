"""``palpate audit``: does this split leak?"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import FAILED_CHECK, Common, Terminal, guard_output
from palpate.core import Audit, PalpateError, Split, write_json


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Tell whether a train/test split leaks: two bare list files, or a manifest with a split file."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """TRAIN and TEST list files (`video/frame.jpg,label` a line), or one manifest."""
    split: Path | None = None
    """Split file, with a manifest."""
    group: Literal["video", "touch", "object", "domain", "sensor"] = "video"
    """What must not be shared between train and test."""
    fail_over: float | None = None
    """Exit with status 1 if more than this fraction of the test samples leaks."""
    worst: int = 12
    """How many of the nearest pairs to keep."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the audit as JSON, for `palpate report`."""
    skip_bad: Annotated[bool, tyro.conf.arg(help="With list files: leave out bad lines and list them, instead of refusing.")] = False


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Runs the audit and prints it."""
    if options.fail_over is not None and not 0 <= options.fail_over <= 1:
        raise PalpateError("--fail-over must lie in [0, 1]", str(options.fail_over), "Pass a fraction, e.g. --fail-over 0.01")
    if options.worst < 0:
        raise PalpateError("--worst must be at least 0", str(options.worst), "Pass how many pairs to keep, e.g. --worst 12")
    if options.output:
        guard_output(options.output, [*options.paths, *([options.split] if options.split else [])])
    audit, skipped = _audit(options)
    data = {"format": "palpate-audit/1", **dataclasses.asdict(audit), "skipped": skipped}
    if options.output:
        write_json(options.output, data)
    failed = options.fail_over is not None and audit.leaked_fraction > options.fail_over
    show(audit, terminal)
    if skipped:
        terminal.say(f"Skipped {len(skipped)}:")
        for line in skipped[:40]:
            terminal.say(f"  {line}")
    if failed:
        terminal.say(f"FAIL: leaked fraction {audit.leaked_fraction} is over {options.fail_over}")
    return data | {"failed": failed}, FAILED_CHECK if failed else 0


def _audit(options: Options) -> tuple[Audit, list[str]]:
    from palpate.leakage import audit_lists, audit_split

    if options.split is not None and len(options.paths) == 1:
        from palpate.data.manifest import Manifest

        split = Split.load(options.split)
        found = audit_split(
            Manifest.load(options.paths[0]),
            split,
            group=options.group,
            name=str(split.rule.get("name", options.split.name)),
            worst=options.worst,
        )
        return found, []
    if options.split is None and len(options.paths) == 2:
        return audit_lists(options.paths[0], options.paths[1], group=options.group, worst=options.worst, skip_bad=options.skip_bad)
    raise PalpateError(
        "An audit takes TRAIN and TEST list files, or one manifest with --split",
        f"{len(options.paths)} path(s) {'with' if options.split else 'without'} --split",
        "E.g. palpate audit train.txt test.txt",
    )


COUNTS = (
    "train_samples", "test_samples", "groups_train", "groups_test", "groups_shared", "test_samples_in_shared_groups",
    "leaked_fraction", "gap_min", "gap_median", "gap_max", "identical_samples",
)  # fmt: skip


def show(audit: Audit, terminal: Terminal) -> None:
    """Prints the counts of an audit and what they mean."""
    terminal.facts(f"Audit of {audit.name} (group: {audit.group})", {name: getattr(audit, name) for name in COUNTS})
    for note in audit.notes:
        terminal.say(f"Note: {note}")
    if audit.leaked_fraction > 0 or audit.identical_samples:
        terminal.print(
            f"This split leaks: {audit.leaked_fraction:.3%} of the test samples share a {audit.group} with train. Make one that does not: palpate split",
        )
    else:
        terminal.print(f"No test sample shares a {audit.group} with train.")
