"""``palpate audit``: does this split leak?"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate._version import __version__
from palpate.cli.importing import Reading
from palpate.cli.terminal import (
    Common,
    Files,
    OptionalOutPath,
    Switch,
    Terminal,
    guard_output,
    working_folder,
)
from palpate.cli.verbs import FAILED_CHECK, OK, UNKNOWN
from palpate.core import PalpateError, Split, require, write_text
from palpate.report.labels import percent
from palpate.report.records import LEAKS
from palpate.report.results import Audit

TABLE_FORMAT = "palpate-audit-table/1"
#: Options that are no arguments of the audit.
UNPASSED = ("paths", "output", "page", "fail_over")
#: The largest group of all samples that a split of four to one can keep whole.
MOST = 0.95
#: Samples up to which a split takes seconds.
TRIED = 5_000


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What is compared, and how."""

    by: Literal["auto", "video", "contact", "object", "session", "domain", "sensor"] = "auto"
    """What train and test must not share; `auto`: the video, or what is known instead of it."""
    near_frames: int = 30
    """A gap of up to this many frames within a video is a leak by itself."""
    identity: Literal["auto", "names", "images"] = "auto"
    """What equal names in train and test mean: `names` the same thing, `images` nothing, so that
    bytes and images decide; `auto`: names where both have one root, are of one published data set,
    or have them from columns of tables."""
    images: bool = True
    """Compare image files and their content, not only tables."""
    encoder: str | None = None
    """Trained encoders (a folder or an id), by which --impact is measured on embeddings."""
    impact: Switch = False
    """Also measure what leaking costs in material accuracy."""
    allow_seen: Switch = False
    """Measure it by an encoder that was trained on some of the samples; every output says so."""


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """What is written."""

    output: OptionalOutPath = None
    """The audit as JSON, for `palpate report`; ending in .parquet or .csv: every signal of every
    test sample, as a table."""
    page: Path | None = None
    """The audit as one self-contained page (.html)."""
    fail_over: float = 0.0
    """Allow leaks of up to this fraction of the test samples: the exit status is 1 only over it (1:
    never), and stays 3 for what cannot be told."""


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Check whether a train/test split leaks.

    Leaks are shared videos, near frames, equal files and near-duplicate images. The exit status is
    0 for no leak found, 1 for leaks, 3 for cannot tell.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """TRAIN and TEST, or all samples with a split: lists (`video/frame.jpg,label` or `video start
    end` per line), tables, JSON, manifests or folders. Images need not be at hand."""
    split: Path | None = None
    """Split file of the samples (default: the split that they come with)."""
    pretrain: Path | None = None
    """What an encoder was pretrained on: samples that the test part is compared with as well."""
    skip_bad: Switch = False
    """Skip bad rows of lists and tables, and list them."""
    cache: Path | None = None
    """Folder that keeps decoded images, so that another audit of them is quick."""
    reading: Reading = field(default_factory=Reading)
    comparison: Comparison = field(default_factory=Comparison)
    outputs: Outputs = field(default_factory=Outputs)


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Audit, print, write."""
    from palpate.evaluation.auditing import audit

    _check(options)
    outputs = options.outputs
    output = outputs.output or outputs.page
    with working_folder(options.cache, output) as cache:
        result = terminal.run(audit, *options.paths, **options.keywords(*UNPASSED, cache=cache))
        result = replace(result, commands=_next_commands(options, result))
        _write(outputs, result, terminal)
    terminal.show(result)
    for command in result.commands:
        terminal.print_line(f"Next: {command}")
    audits = (result, *result.others)
    leaked = max(a.leaked_fraction for a in audits)
    failed = leaked > outputs.fail_over
    if failed and outputs.fail_over:
        terminal.print_line(f"FAIL: leaked fraction {leaked} is over {outputs.fail_over}")
    elif leaked and not failed:
        terminal.print_line(f"{LEAKS}, {percent(leaked)}, allowed")
    unknown = UNKNOWN if any(a.open for a in audits) else OK
    return result.to_json() | {"failed": failed}, FAILED_CHECK if failed else unknown


def _check(options: Options) -> None:
    """Reject a number of paths that makes no audit and outputs in the way, before any work.

    Raises:
        PalpateError: saying which.
    """
    outputs = options.outputs
    require(
        len(options.paths) in ((1,) if options.split is not None else (1, 2)),
        None,
        "An audit takes TRAIN and TEST, or all samples with a split",
        f"{len(options.paths)} path(s) {'with' if options.split else 'without'} a split",
        fix="E.g. palpate audit train.txt test.txt",
    )
    require(0 <= outputs.fail_over <= 1, "fail_over", "must lie in [0, 1]", outputs.fail_over)
    inputs = [*options.paths, *(p for p in (options.split, options.pretrain) if p)]
    if outputs.output is not None and is_table(outputs.output):
        formats = (TABLE_FORMAT.encode(), b"id,video,frame,material,leaking")
        guard_output(outputs.output, inputs, formats)
    Files(output=None if is_table(outputs.output) else outputs.output, page=outputs.page).guard(
        inputs
    )
    if outputs.output and outputs.page:
        must, fix = "must not be a file that the page writes", "Choose another file"
        pages = map(outputs.page.with_suffix, (".html", ".md"))
        require(outputs.output not in pages, "output", must, str(outputs.output), fix=fix)


def is_table(path: Path | None) -> bool:
    """Whether an output is a table, by its ending."""
    return path is not None and path.suffix.lower() in (".parquet", ".csv")


def _next_commands(options: Options, audit: Audit) -> list[str]:
    """Commands that answer the finding, on the same data."""
    paths = options.paths
    joined = len(paths) == 1 or (all(p.is_file() for p in paths) and not audit.identical_samples)
    codes = {note.code for note in audit.notes}
    if not audit.leaked_fraction or not joined or "equal-names" in codes:
        return []
    if audit.groups_in_all == 1 or audit.largest_group > MOST:
        return []  # no split can keep these groups whole
    skip = ["--skip-bad"] * options.skip_bad
    source = shlex.join([*map(str, paths), *options.reading.arguments(), *skip])
    flagged = {s.kind: s.flagged for s in audit.signals if s.checked}
    checked = [kind.split()[-1] for kind in flagged if kind.startswith("near-duplicate")]
    no_group = audit.group == "none"
    sides = [m for m in checked if flagged[f"near-duplicate {m}"] or no_group]
    near = f" --near {'both' if len(sides) == 2 else sides[0]}" if sides else ""
    # Frames of one video in two groups may be near in time.
    wanted = (audit.group, *["video"] * bool(flagged.get("time gap")))
    columns = [] if no_group else list(dict.fromkeys(wanted))
    rule = {} if options.split is None else Split.load(options.split).rule
    kept = {*rule.get("by", ()), *(rule.get("near") or {}).get("modalities", ())}
    # What takes longer than seconds is offered untried, but for several columns at once.
    small = audit.train_samples + audit.test_samples <= TRIED
    trial: dict[str, Any] = {"by": columns} if columns and (small or columns[1:]) else {}
    if sides and small:
        trial["near"] = "both" if len(sides) == 2 else sides[0]
    if {*columns, *sides} <= kept or (trial and not _works(options, trial)):
        return []  # a split that keeps these whole cannot be made, or is what leaks
    by = "" if options.comparison.by == "auto" else f" --by {audit.group}"
    group = f" --by {' '.join(columns)}" if columns else ""
    commands = [f"palpate split {source}{group}{near} -o noleak.json"]
    if len(paths) == 1:
        commands.append(f"palpate audit {source}{by} --split noleak.json")
        several = [m for m in audit.materials if max(m["groups_train"], m["groups_test"]) > 1]
        if not options.comparison.impact and checked and len(several) > 1:
            split = f" --split {shlex.quote(str(options.split))}" if options.split else ""
            commands.append(f"palpate audit {source}{by}{split} --impact")
    return commands


def _works(options: Options, rule: Mapping[str, Any]) -> bool:
    """Whether a split by a rule can be made and does not leak."""
    from palpate.leakage import split

    reading = options.reading.keywords()
    try:
        result = split(list(options.paths), skip_bad=options.skip_bad, **reading, **rule)
    except PalpateError:
        return False
    return result.rule["audit"] != LEAKS


def _write(outputs: Outputs, audit: Audit, terminal: Terminal) -> None:
    if outputs.page:  # first: an output that has the name of the page's own JSON stays
        settings = {"version": __version__}
        results = replace(audit.to_results(), commands=[terminal.command], settings=settings)
        results.to_html(outputs.page)
    if outputs.output and outputs.output.suffix.lower() == ".csv":
        write_text(outputs.output, audit.to_frame().write_csv())
    elif outputs.output and is_table(outputs.output):
        from palpate.data.manifest import write_parquet

        write_parquet(audit.to_frame(), outputs.output, {"palpate.format": TABLE_FORMAT})
    elif outputs.output:
        audit.save(outputs.output)
