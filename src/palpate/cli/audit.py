"""``palpate audit``: does this split leak?"""

from __future__ import annotations

import shlex
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
    require_extra,
    working_folder,
)
from palpate.cli.verbs import FAILED_CHECK
from palpate.core import require, write_text
from palpate.report.results import Audit

TABLE_FORMAT = "palpate-audit-table/1"
Modality = Literal["vision", "tactile"]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What is compared, and how."""

    by: Literal["auto", "video", "contact", "object", "session", "domain", "sensor"] = "auto"
    """What train and test must not share; `auto`: the video, or what is known instead of it."""
    near_frames: int = 30
    """A gap of up to this many frames within a video is a leak by itself."""
    ids_in_time: Switch = False
    """The last number of an id or path is a time: samples without a video and frame are as near as
    these numbers."""
    identity: Literal["auto", "names", "images"] = "auto"
    """What equal names in train and test mean: `names` the same thing, `images` nothing, so that
    bytes and images decide; `auto`: names where both have one root, are of one published data set,
    or have them from columns of tables."""
    images: bool = True
    """Compare image files and their content, not only tables."""
    modalities: tuple[Modality, ...] = ("vision", "tactile")
    """The images to compare."""
    false_positives: float = 0.001
    """Rate at which unrelated images may pass for near-duplicates."""
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
    """The audit as JSON, for `palpate report`."""
    page: Path | None = None
    """The audit as one self-contained page (.html)."""
    table: Path | None = None
    """Every signal of every test sample (.parquet or .csv)."""
    worst: int = 12
    """How many of the strongest pairs to keep for each signal."""
    fail_over: float = 0.0
    """Exit with status 1 if more than this fraction of the test samples leaks (1: never)."""

    def keywords(self) -> dict[str, Any]:
        """As arguments of the audit."""
        return {"worst": self.worst}


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Check whether a train/test split leaks.

    Leaks are shared videos, near frames, equal files and near-duplicate images.
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
    output = outputs.output or outputs.page or outputs.table
    with working_folder(options.cache, output) as cache:
        with terminal.progress() as progress:
            result = audit(
                *options.paths, progress=progress, **options.keywords("paths", cache=cache)
            )
        result = replace(result, commands=_next_commands(options, result))
        _write(outputs, result, terminal)
    terminal.show(result)
    for command in result.commands:
        terminal.print_line(f"Next: {command}")
    leaked = max(a.leaked_fraction for a in (result, *result.others))
    failed = leaked > outputs.fail_over
    if failed and outputs.fail_over:
        terminal.print_line(f"FAIL: leaked fraction {leaked} is over {outputs.fail_over}")
    return result.to_json() | {"failed": failed}, FAILED_CHECK if failed else 0


def _check(options: Options) -> None:
    """Reject a number of paths that makes no audit and outputs in the way, before any work.

    Raises:
        PalpateError: saying which.
    """
    outputs, table = options.outputs, options.outputs.table
    require(
        len(options.paths) in ((1,) if options.split is not None else (1, 2)),
        None,
        "An audit takes TRAIN and TEST, or all samples with a split",
        f"{len(options.paths)} path(s) {'with' if options.split else 'without'} a split",
        fix="E.g. palpate audit train.txt test.txt",
    )
    require(0 <= outputs.fail_over <= 1, "fail_over", "must lie in [0, 1]", outputs.fail_over)
    if options.comparison.encoder is not None:
        require_extra("palpate audit --encoder")
    inputs = [*options.paths, *(p for p in (options.split, options.pretrain) if p)]
    Files(output=outputs.output, page=outputs.page).guard(inputs)
    if outputs.output and outputs.page:
        must, fix = "must not be a file that the page writes", "Choose another file"
        pages = map(outputs.page.with_suffix, (".html", ".json", ".md"))
        require(outputs.output not in pages, "output", must, str(outputs.output), fix=fix)
    if table is not None:
        is_table = table.suffix.lower() in (".parquet", ".csv")
        require(is_table, "table", "must end in .parquet or .csv", table.name)
        guard_output(table, inputs, (TABLE_FORMAT.encode(), b"id,video,frame,material,leaking"))


def _next_commands(options: Options, audit: Audit) -> list[str]:
    """Commands that answer the finding, on the same data."""
    paths = options.paths
    joined = len(paths) == 1 or (all(p.is_file() for p in paths) and not audit.identical_samples)
    codes = {note.code for note in audit.notes}
    if not audit.leaked_fraction or not joined or "equal-names" in codes:
        return []
    source = shlex.join([*map(str, paths), *options.reading.arguments()])
    checked = {s.kind: s for s in audit.signals if s.checked and s.kind.startswith("near-dup")}
    sides = [kind.split()[-1] for kind, s in checked.items() if s.flagged or audit.group == "none"]
    near = f" --near {'both' if len(sides) == 2 else sides[0]}" if sides else ""
    if audit.group == "none" and not near:
        return []
    by = "" if options.comparison.by == "auto" else f" --by {options.comparison.by}"
    commands = [f"palpate split {source}{by}{near} -o noleak.json"]
    if len(paths) == 1:
        commands.append(f"palpate audit {source} --split noleak.json")
        if not options.comparison.impact and checked and len(audit.materials) > 1:
            split = f" --split {shlex.quote(str(options.split))}" if options.split else ""
            commands.append(f"palpate audit {source}{split} --impact")
    return commands


def _write(outputs: Outputs, audit: Audit, terminal: Terminal) -> None:
    if outputs.output:
        audit.save(outputs.output)
    if outputs.table and outputs.table.suffix.lower() == ".csv":
        write_text(outputs.table, audit.to_frame().write_csv())
    elif outputs.table:
        from palpate.data.manifest import write_parquet

        write_parquet(audit.to_frame(), outputs.table, {"palpate.format": TABLE_FORMAT})
    if outputs.page:
        settings = {"version": __version__}
        results = replace(audit.to_results(), commands=[terminal.command], settings=settings)
        results.to_html(outputs.page)
