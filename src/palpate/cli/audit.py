"""``palpate audit``: does this split leak?"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from palpate import __version__
from palpate.cli.terminal import FAILED_CHECK, Common, Terminal, guard_output, require_extra
from palpate.core import (
    FeatureSet,
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    Split,
    write_json,
    write_text,
)
from palpate.report.notes import sentence
from palpate.report.results import Audit, Impact, ImpactRow, Results

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest
    from palpate.leakage.audit import Inspection, Pictures


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Tell whether a train/test split leaks: shared videos, near frames, equal files, and pictures that nearly repeat in vision or touch."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """TRAIN and TEST (each a list of `video/frame.jpg,label` lines, a table, a manifest or a folder), or one manifest with --split."""
    split: Path | None = None
    """Split file, with a manifest."""
    pretrain: Path | None = None
    """What an encoder was pretrained on: a further list, table, manifest or folder that the test part is compared with."""
    group: Literal["auto", "video", "contact", "object", "session", "domain", "sensor"] = "auto"
    """What must not be shared between train and test. `auto` takes the video, or what is known instead of it."""
    near_frames: int = 30
    """A gap of up to this many frames within a video is a leak of its own."""
    images: bool = True
    """Look at tables alone: compare neither files nor pictures. Bare lists have no pictures anyway."""
    false_positives: float = 0.001
    """Rate at which unrelated pictures may pass for near-duplicates; the threshold is calibrated to it on the data."""
    encoder: str | None = None
    """Trained encoders (a folder, a hub id, or palpate/mini) whose embeddings replace the built-in picture features."""
    impact: bool = False
    """Also measure what leaking costs: material accuracy under this split and under a leak-free one."""
    fail_over: float | None = None
    """Exit with status 1 if more than this fraction of the test samples leaks by any signal."""
    worst: int = 12
    """How many of the strongest pairs to keep for each signal."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the audit as JSON, for `palpate report`."""
    page: Path | None = None
    """Write the audit as one self-contained page (.html)."""
    table: Path | None = None
    """Write every signal of every test sample as a table (.parquet or .csv)."""
    cache: Path | None = None
    """Folder that keeps decoded picture features, so that another audit of the same pictures is quick."""
    root: Path | None = None
    """Where the paths of tables start (default: the folder of the table)."""
    processes: int | None = None
    """Processes that decode pictures (default: one a core)."""
    skip_bad: Annotated[
        bool, tyro.conf.arg(help="Leave out bad rows and list them, instead of refusing.")
    ] = False


@dataclass(frozen=True)
class _Sides:
    """What is compared: one manifest with a split, or two; what was skipped in reading them."""

    skipped: list[Problem]
    train: Manifest
    test: Manifest
    whole: Manifest | None = None
    split: Split | None = None
    pretrain: Manifest | None = None


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Runs the audit, prints it, and writes what was asked for."""
    _check(options)
    with terminal.progress() as progress:
        sides = _read(options, progress)
        cache = _cache(options)
        found = _audit(options, sides, cache, progress)
        others: list[Audit] = []
        if sides.pretrain is not None:
            others.append(
                _against_pretraining(options, sides.pretrain, sides.test, cache, progress)
            )
        audit = found.audit
        if options.images and (lone := sorted(_modalities(sides.train) ^ _modalities(sides.test))):
            audit = replace(
                audit,
                notes=[
                    *audit.notes,
                    f"Only one side has pictures of {' and '.join(lone)}: they were not compared.",
                ],
            )
        if options.impact and sides.whole is not None and sides.split is not None:
            try:
                audit = replace(
                    audit, impact=_impact(options, sides.whole, sides.split, audit, cache, progress)
                )
            except PalpateError as error:  # the audit itself is done, and must not be lost
                audit = replace(
                    audit,
                    notes=[*audit.notes, f"What leaking costs could not be measured: {error}"],
                )
        audit = replace(audit, commands=_next(options, audit))
    skipped = [str(p) for p in sides.skipped]
    data = {
        **replace(audit, others=others).to_json(),
        "skipped": skipped,
    }
    _write(options, [audit, *others], found, data, _digests(sides), terminal)
    if (
        options.cache is None and cache is not None
    ):  # a run that is stopped leaves it, to go on from
        shutil.rmtree(cache, ignore_errors=True)
    leaked = max(
        audit.leaked_fraction, *(a.leaking_samples / a.test_samples for a in (audit, *others))
    )
    failed = options.fail_over is not None and leaked > options.fail_over
    for one in (audit, *others):
        show(one, terminal)
    if skipped:
        terminal.say(f"Skipped {len(skipped)}:")
        for line in skipped[:40]:
            terminal.say(f"  {line}")
    for line in audit.commands:
        terminal.say(f"Next: {line}")
    if failed:
        terminal.say(f"FAIL: leaked fraction {round(leaked, 5)} is over {options.fail_over}")
    return data | {"failed": failed}, FAILED_CHECK if failed else 0


def _check(options: Options) -> None:
    """Refuses options out of range and outputs in the way, before any work.

    Raises:
        PalpateError: saying which.
    """
    if options.fail_over is not None and not 0 <= options.fail_over <= 1:
        raise PalpateError(
            "--fail-over must lie in [0, 1]",
            str(options.fail_over),
            "Pass a fraction, e.g. --fail-over 0.01",
        )
    if not 0 < options.false_positives <= 0.1:
        raise PalpateError(
            "--false-positives must lie in (0, 0.1]",
            str(options.false_positives),
            "Pass e.g. --false-positives 0.001",
        )
    for name, value, low in (
        ("--worst", options.worst, 0),
        ("--near-frames", options.near_frames, 0),
        ("--processes", 1 if options.processes is None else options.processes, 1),
    ):
        if value < low:
            raise PalpateError(
                f"{name} must be at least {low}", str(value), f"Pass e.g. {name} {max(low, 2)}"
            )
    if options.table is not None and options.table.suffix.lower() not in (".parquet", ".csv"):
        raise PalpateError(
            "--table must end in .parquet or .csv",
            options.table.name,
            "Pass e.g. --table signals.parquet",
        )
    if options.impact and options.split is None:
        raise PalpateError(
            "--impact needs a manifest with --split",
            "lists or no split",
            "Import the data set first: palpate import",
        )
    if options.encoder is not None:
        require_extra("palpate audit --encoder")
    inputs = [*options.paths, *(p for p in (options.split, options.pretrain) if p)]
    beside = [options.page.with_suffix(s) for s in (".json", ".md")] if options.page else []
    if options.page and (options.page.suffix != ".html" or options.output in beside):
        raise PalpateError(
            "--page must end in .html, and -o must not be the JSON beside it",
            f"--page {options.page}" + (f" with -o {options.output}" if options.output else ""),
            "Pass e.g. --page page.html -o audit.json",
        )
    for output, marks in (
        *((path, (b'"format": "palpate-', b"Audit of", b"palpate")) for path in beside),
        (options.output, (b'"format": "palpate-',)),
        (options.page, (b"palpate",)),
        (options.table, (b"PAR1", b"id,video,frame,material,leaking")),
    ):
        if output is not None:
            guard_output(output, inputs, marks)


def _read(options: Options, progress: Progress) -> _Sides:
    """Reads all inputs; what is wrong in several of them is told together.

    Raises:
        PalpateError: on a number of paths that makes no audit.
        ProblemsError: with every bad row, unless ``--skip-bad``.
    """
    from palpate.data.listing import number_together
    from palpate.data.reading import read_samples

    if len(options.paths) != (1 if options.split is not None else 2):
        raise PalpateError(
            "An audit takes TRAIN and TEST, or one manifest with --split",
            f"{len(options.paths)} path(s) {'with' if options.split else 'without'} --split",
            "E.g. palpate audit train.txt test.txt",
        )
    problems: list[Problem] = []
    skipped: list[Problem] = []
    read: list[Manifest] = []
    for path in (*options.paths, *([options.pretrain] if options.pretrain else [])):
        try:
            samples, bad = read_samples(
                path, skip_bad=options.skip_bad, root=options.root, progress=progress
            )
        except ProblemsError as error:  # told together with those of the other inputs
            problems += error.problems
        else:
            read.append(samples)
            skipped += bad
    if problems:
        raise ProblemsError(problems, "Mend the lines, or pass --skip-bad to go on without them")
    bare = [k for k, m in enumerate(read) if set(m.facts) == {"source"}]
    if options.split is None and len(bare) > 1:  # lists number their touches each from 1
        for k, m in zip(bare, number_together(*(read[k] for k in bare)), strict=True):
            read[k] = m
    pretrain = read.pop() if options.pretrain else None
    if options.split is None:
        return _Sides(skipped, read[0], read[1], pretrain=pretrain)
    split = Split.load(options.split)
    return _Sides(
        skipped, read[0].part(split, "train"), read[0].part(split, "test"), read[0], split, pretrain
    )


def _audit(options: Options, sides: _Sides, cache: Path | None, progress: Progress) -> Inspection:
    from palpate.leakage.audit import inspect_parts, inspect_split

    common: dict[str, Any] = {
        "group": options.group,
        "worst": options.worst,
        "near": options.near_frames,
        "progress": progress,
        "pictures": _pictures(options, sides.train, sides.test, cache, progress),
    }
    if sides.whole is not None and sides.split is not None and options.split is not None:
        return inspect_split(
            sides.whole,
            sides.split,
            name=str(sides.split.rule.get("name", options.split.stem)),
            **common,
        )
    return inspect_parts(
        sides.train, sides.test, name=f"{options.paths[0].name} / {options.paths[1].name}", **common
    )


def _against_pretraining(
    options: Options, pretrain: Manifest, test: Manifest, cache: Path | None, progress: Progress
) -> Audit:
    """The test part against what an encoder has seen."""
    from palpate.leakage.audit import inspect_parts

    name = f"{options.pretrain.name if options.pretrain else 'pretraining'} / test"
    pictures = _pictures(options, pretrain, test, cache, progress)
    return inspect_parts(
        pretrain,
        test,
        name=name,
        against="pretraining",
        group=options.group,
        worst=options.worst,
        near=options.near_frames,
        pictures=pictures,
        progress=progress,
    ).audit


def _pictures(
    options: Options, train: Manifest, test: Manifest, cache: Path | None, progress: Progress
) -> Pictures | None:
    """How pictures are compared; None if there are none on both sides, or none are wanted."""
    from palpate.leakage.audit import Pictures

    there = sorted(_modalities(train) & _modalities(test), reverse=True)  # vision first
    if not options.images or not there:
        return None
    features: dict[str, Any] = {}
    name = ""
    if options.encoder is not None:
        a, b = (_embedded(options.encoder, side, there, cache, progress) for side in (train, test))
        features = {m: (a[m].features, b[m].features) for m in there}
        name = f"encoders {Path(options.encoder).name}"
    return Pictures(there, options.false_positives, features, name, cache, options.processes)


def _modalities(samples: Manifest) -> set[str]:
    """The modalities of which some sample has a picture."""
    from palpate.data.manifest import MODALITIES

    return {m for m, c in MODALITIES.items() if samples.table[c].null_count() < len(samples)}


def _embedded(
    encoder: str,
    samples: Manifest,
    modalities: Sequence[str],
    cache: Path | None,
    progress: Progress,
) -> dict[str, FeatureSet]:
    """Embeddings of the samples by modality.

    Raises:
        PalpateError: if the encoders cannot be loaded, or a sample lacks a picture.
    """
    from palpate.encoders.embed import embed
    from palpate.encoders.encoder_set import EncoderSet

    encoders = EncoderSet.load(encoder)
    return {m: embed(samples, encoders, m, cache=cache, progress=progress) for m in modalities}


def _impact(
    options: Options,
    manifest: Manifest,
    split: Split,
    audit: Audit,
    cache: Path | None,
    progress: Progress,
) -> Impact:
    """What leaking costs, on raw pictures or on the encoders' embeddings."""
    from palpate.evaluation.impact import impact

    features: Any = "pixels"
    if options.encoder is not None:
        there = sorted(_modalities(manifest), reverse=True)
        features = {
            f"{m} encoder": f
            for m, f in _embedded(options.encoder, manifest, there, cache, progress).items()
        }
    return impact(
        manifest,
        split,
        group=audit.group,
        features=features,
        name=audit.name,
        cache=cache,
        progress=progress,
    )


def _cache(options: Options) -> Path | None:
    """The folder for picture features: the one named, else one beside the output that goes when the audit is done."""
    if options.cache is not None:
        return options.cache
    output = options.output or options.page or options.table
    return output.absolute().parent / f".{output.name}.work" if output else None


def _next(options: Options, audit: Audit) -> list[str]:
    """Command lines that say what to do about what was found."""
    from palpate.data.reading import is_list

    leaks = audit.leaking_samples or audit.leaked_fraction
    near = any(s.flagged for s in audit.signals if s.kind.startswith("near-duplicate"))
    twice = (
        any(s.flagged for s in audit.signals if s.kind == "identical sample") and not options.split
    )
    lines: list[str] = []
    source = shlex.join(map(str, options.paths[:1] if options.split else options.paths))
    if leaks and (options.split or all(p.is_file() and is_list(p) for p in options.paths)):
        by = "" if options.group == "auto" else f" --by {options.group}"
        lines.append(
            f"palpate split {source}{by}{' --near both' if near else ''}{' --skip-bad' if twice or options.skip_bad else ''} -o noleak.json"
        )
        if options.split:
            lines.append(f"palpate audit {source} --split noleak.json")
    if options.split and not options.impact and leaks:
        lines.append(f"palpate audit {source} --split {shlex.quote(str(options.split))} --impact")
    if not options.split and not audit.signals[-1].kind.startswith("near-duplicate"):
        lines.append(
            "palpate import DATA_SET -o data/ && palpate audit data/ --split data/splits/Orig.json   # pictures too"
        )
    return lines


def _digests(sides: _Sides) -> dict[str, str]:
    """Digests of everything that was compared."""
    named = (
        {"manifest": sides.whole, "pretraining": sides.pretrain}
        if sides.whole is not None
        else {"train": sides.train, "test": sides.test, "pretraining": sides.pretrain}
    )
    split = {"split": sides.split.digest} if sides.split is not None else {}
    return {name: m.digest for name, m in named.items() if m is not None} | split


def _write(
    options: Options,
    audits: Sequence[Audit],
    found: Inspection,
    data: dict[str, Any],
    digests: dict[str, str],
    terminal: Terminal,
) -> None:
    """The JSON, the page and the table, as asked."""
    if options.output:
        write_json(options.output, data)
    if options.table:
        if options.table.suffix.lower() == ".csv":
            write_text(options.table, found.table.write_csv())
        else:
            from palpate.data.manifest import write_parquet

            write_parquet(found.table, options.table)
    if options.page:
        from palpate.report import write_report

        results = Results(
            title=f"Audit of {audits[0].name}",
            audits=audits,
            commands=[terminal.command],
            settings={
                "digests": digests,
                "false positives": options.false_positives,
                "near frames": options.near_frames,
                "version": __version__,
            },
            notes=[f"{len(data['skipped'])} bad rows were left out."] if data["skipped"] else [],
        )
        with terminal.progress() as progress:
            write_report(results, options.page, progress=progress)


COUNTS = (
    "train_samples",
    "test_samples",
    "groups_train",
    "groups_test",
    "groups_shared",
    "test_samples_in_shared_groups",
    "leaked_fraction",
    "leaking_samples",
    "gap_min",
    "gap_median",
    "gap_max",
    "identical_samples",
)


def _row(row: ImpactRow) -> str:
    """One kind of feature and classifier in a line."""
    around = (
        f" [{100 * row.cost_interval[0]:.1f}, {100 * row.cost_interval[1]:.1f}]"
        if row.cost_interval
        else ""
    )
    return f"{row.given:.1%} given, {row.clean:.1%} leak-free: costs {100 * row.cost:.1f} points{around}; chance {row.chance:.1%}"


def show(audit: Audit, terminal: Terminal) -> None:
    """Prints the counts of an audit and what they mean."""
    terminal.facts(
        f"Audit of {audit.name} (group: {audit.group})",
        {name: getattr(audit, name) for name in COUNTS},
    )
    facts: dict[str, Any] = {}
    for s in audit.signals:
        at = (
            f", threshold {s.threshold:.3f} at a false-positive rate of {s.false_positives:g}"
            if s.false_positives is not None
            else ""
        )
        causes = (
            "; " + ", ".join(f"{cause} {n}" for cause, n in s.causes.items()) if s.causes else ""
        )
        facts[s.kind] = f"{s.flagged} of {s.checked} test samples ({s.fraction:.2%}){at}{causes}"
    if facts:
        terminal.facts("Signals", facts)
    for note in (*map(sentence, audit.notes), *(f"{s.kind}: {sentence(note)}" for s in audit.signals for note in s.notes)):
        terminal.say(f"Note: {note}")
    if audit.impact is not None:
        terminal.facts(
            "What leaking costs: material accuracy",
            {f"{r.features}, {r.classifier}": _row(r) for r in audit.impact.rows},
        )
        terminal.print(audit.impact.headline)
        for note in audit.impact.notes:
            terminal.say(f"Note: {sentence(note)}")
    other = "train" if audit.against == "train" else "the pretraining data"
    if audit.leaked_fraction > 0 or audit.leaking_samples:
        share = audit.leaking_samples / audit.test_samples
        more = (
            ""
            if audit.leaking_samples == audit.test_samples_in_shared_groups
            else f" {share:.3%} leak by one signal or another."
        )
        terminal.print(
            "This split leaks:"
            + (
                f" {audit.leaked_fraction:.3%} of the test samples share a {audit.group} with {other}."
                if audit.leaked_fraction > 0
                else ""
            )
            + more
            + (" Make one that does not: palpate split" if audit.against == "train" else "")
        )
    elif audit.group == "none":
        terminal.print(f"No test sample was found again in {other}.")
    else:
        terminal.print(
            f"No test sample shares a {audit.group} with {other}, and no other signal flags one."
        )
