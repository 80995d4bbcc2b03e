"""``palpate split``: a split that does not leak, several of them, folds, published ones, and the check of an existing one."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from palpate.cli.audit import show
from palpate.cli.terminal import FAILED_CHECK, Common, Terminal, guard_output
from palpate.core import (
    PalpateError,
    Problem,
    Split,
    atomic_folder,
    digest_file,
    write_json,
    write_text,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from palpate.data.manifest import Manifest
    from palpate.leakage.splits import SplitPlan

Column = Literal["video", "object", "session", "contact", "domain", "sensor"]


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Make a split in which no group stands in two parts and every material keeps its share, as nearly as any such split can.

    The largest deviation of any material's share is minimized and proven, or given with its gap. The same data, options and seed
    give the same split anywhere.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """A manifest (file, or folder of an import), or list files (`video/frame.jpg,label` a line), which are joined."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    """Split file to write; with --folds or --seeds a folder of them."""
    train: float = 0.8
    """Share of the train part."""
    val: float = 0.0
    """Share of the validation part; test gets the rest."""
    by: Annotated[tuple[Column, ...], tyro.conf.arg(metavar="COLUMN ...")] = ()
    """What to keep whole; samples that share any of these stay together. Default: what the data set names, or the video."""
    near: Annotated[
        Literal["vision", "tactile", "both"] | None, tyro.conf.arg(metavar="vision|tactile|both")
    ] = None
    """Keep near-duplicate pictures together as well."""
    cache: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """With --near: folder that keeps decoded picture features, so that a run that was stopped goes on."""
    nulls: Literal["refuse", "own"] = "refuse"
    """Samples without a value in a --by column: refuse them, or let each be a group of its own unless something else joins it."""
    seed: int = 0
    """Another seed gives another split of the same quality."""
    seeds: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Make this many splits, with the seeds from --seed on."""
    folds: Annotated[int | None, tyro.conf.arg(metavar="K")] = None
    """Make K folds: file k tests fold k. With --val over 0, fold k + 1 validates."""
    tolerance: float = 0.0
    """How much larger than the smallest possible the largest deviation may be; for splits that differ more."""
    lists: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Also write the split in the data set's own list format, with SHA256SUMS, into this new folder."""
    noleak: Annotated[tuple[Path, ...] | None, tyro.conf.arg(metavar="[SAMPLES ...]")] = None
    """The published split of a data set: `split touch-and-go --noleak` writes the record's video -> part, with a manifest or lists after it their
    split file; `split hct --noleak MANIFEST` applies the same rule to your tree."""
    verify: Annotated[Path | None, tyro.conf.arg(metavar="SPLITFILE")] = None
    """Check an existing split file against the samples instead; exit status 1 if it does not hold."""
    group: Annotated[Literal["auto"] | Column, tyro.conf.arg(metavar="auto|COLUMN")] = "auto"
    """One column to keep whole. `auto` falls back to touches where videos are too few, and says so."""
    skip_bad: Annotated[
        bool,
        tyro.conf.arg(
            help="Leave out bad rows of lists and tables and list them, instead of refusing."
        ),
    ] = False


def run(options: Options, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Makes, audits and writes splits, or checks one."""
    _check(options)
    if options.verify is not None:
        return _verify(options, options.verify, terminal)
    if options.noleak is not None:
        return _noleak(options, [*options.paths[1:], *options.noleak], terminal), 0
    manifest, skipped = _read(options.paths, options, terminal)
    from palpate.leakage.splits import leak_free_folds, leak_free_splits

    links, facts = _links(options, manifest, terminal)
    common: dict[str, Any] = {
        "by": options.by,
        "group": options.group,
        "links": links,
        "link_facts": facts,
        "nulls": options.nulls,
        "tolerance": options.tolerance,
    }
    if options.folds is not None:
        plans = leak_free_folds(
            manifest, options.folds, val=options.val > 0, seed=options.seed, **common
        )
        names = [f"fold-{k}" for k in range(options.folds)]
    else:
        seeds = range(options.seed, options.seed + (options.seeds or 1))
        plans = leak_free_splits(
            manifest, list(seeds), train=options.train, val=options.val, **common
        )
        names = [f"seed-{s}" for s in seeds]
    return _write(options, manifest, plans, names, skipped, terminal), 0


def _check(options: Options) -> None:
    """Refuses options that exclude each other and outputs in the way, before any work.

    Raises:
        PalpateError: saying which.
    """
    if not options.paths:
        raise PalpateError(
            "A split needs samples", "no path", "E.g. palpate split tag/ -o noleak.json"
        )
    several = [
        name
        for name, value in (("--seeds", options.seeds), ("--folds", options.folds))
        if value is not None
    ]
    asked = [
        name
        for name, value in (("--noleak", options.noleak), ("--verify", options.verify))
        if value is not None
    ]
    if len(several) > 1 or len(asked) > 1 or (several and asked):
        raise PalpateError(
            "--seeds, --folds, --noleak and --verify exclude each other",
            " and ".join(several + asked),
            "Choose one",
        )
    if options.seeds is not None and options.seeds < 1:
        raise PalpateError("--seeds must be at least 1", str(options.seeds), "Pass e.g. --seeds 5")
    if options.noleak is not None and (
        options.by or options.near or options.group != "auto" or options.tolerance
    ):
        raise PalpateError(
            "A published split has its own rule",
            "--by, --near, --group or --tolerance with --noleak",
            "Leave them out, or leave out --noleak",
        )
    if options.by and options.group != "auto":
        raise PalpateError("Groups are named by --by or by --group", "both", "Leave out --group")
    if options.verify is None and options.output is None:
        raise PalpateError("A split needs an output file", "no -o", "Pass e.g. -o noleak.json")
    if options.lists is not None and (several or options.verify is not None):
        raise PalpateError(
            "--lists goes with one split",
            f"{(several or ['--verify'])[0]}",
            "Make the split you want alone",
        )
    if (
        options.lists is not None
        and options.lists.exists()
        and (not options.lists.is_dir() or any(options.lists.iterdir()))
    ):
        raise PalpateError(
            "--lists must name a new or empty folder",
            f"something in {options.lists}",
            "Choose another folder",
        )
    if options.output is not None and not several:
        inputs = [*options.paths, *(options.noleak or ())]
        guard_output(
            options.output, inputs, (b'"format": "palpate-split/', b'"format": "palpate-noleak/')
        )


def _read(
    paths: Sequence[Path], options: Options, terminal: Terminal
) -> tuple[Manifest, list[Problem]]:
    """One manifest from one source, or from several lists joined, and what was skipped.

    Raises:
        PalpateError: if several paths are not all lists.
    """
    from palpate.data.listing import read_categories, read_lists
    from palpate.data.reading import is_list, read_samples

    if len(paths) == 1:
        with terminal.progress() as progress:
            manifest, skipped = read_samples(paths[0], skip_bad=options.skip_bad, progress=progress)
    else:
        for path in paths:
            if not path.is_file():
                raise PalpateError(
                    "Several paths must all be list files",
                    f"no file {path}",
                    "Name one manifest, or lists alone",
                )
            if not is_list(path):
                raise PalpateError(
                    "Several paths must all be list files",
                    f"{path}, which is none",
                    "Name one manifest, or lists alone",
                )
        table = paths[0].parent / "category_reference.txt"
        found = read_lists(
            paths,
            root=paths[0].parent,
            skip_bad=options.skip_bad,
            categories=read_categories(table) if table.is_file() else None,
        )
        manifest, skipped = found.manifest, found.skipped
    terminal.skipped(skipped)
    return manifest, skipped


def _links(
    options: Options, manifest: Manifest, terminal: Terminal
) -> tuple[list[NDArray[Any]], dict[str, Any] | None]:
    """Clusters of near-duplicates by modality, and how they were found.

    Raises:
        PalpateError: if there are no such pictures.
    """
    if options.near is None:
        return [], None
    from palpate.data.manifest import MODALITIES

    wanted = list(MODALITIES) if options.near == "both" else [options.near]
    for modality in wanted:
        if manifest.table[MODALITIES[modality]].null_count() == len(manifest):
            raise PalpateError(
                f"--near {options.near} needs {modality} pictures",
                "samples without any",
                "Import the data set first: palpate import",
            )
    from palpate.leakage.near import near_groups

    with terminal.progress() as progress:
        return [
            near_groups(manifest, modality, cache=options.cache, progress=progress)
            for modality in wanted
        ], {"modalities": wanted}


def _write(
    options: Options,
    manifest: Manifest,
    plans: Sequence[SplitPlan],
    names: Sequence[str],
    skipped: Sequence[Problem],
    terminal: Terminal,
) -> dict[str, Any]:
    """Writes one split file, or a folder of them with ``splits.json``; prints what was achieved."""
    from palpate.leakage.splits import describe

    assert options.output is not None
    for note in plans[0].notes:
        terminal.say(f"Note: {note}")
    extra = {
        "notes": plans[0].notes,
        "skipped": [str(p) for p in skipped],
        "path": str(options.output),
    }
    if options.seeds is None and options.folds is None:
        facts = dict(describe(plans[0]))
        plans[0].split.save(options.output)
        terminal.facts(f"Split {options.output}", facts)
        return facts | extra | _finish(options, manifest, plans[0].split, plans[0].group, terminal)
    rows = [
        {"file": f"{name}.json", **describe(plan)} for name, plan in zip(names, plans, strict=True)
    ]
    with atomic_folder(options.output) as folder:
        for name, plan in zip(names, plans, strict=True):
            plan.split.save(folder / f"{name}.json")
        write_json(
            folder / "splits.json",
            {"format": "palpate-splits/1", "manifest": manifest.digest, "splits": rows},
        )
    shown = {
        row[
            "file"
        ]: f"{row['counts']}, largest deviation {row['largest_material_deviation']}, {row['status']}, {row['digest']}"
        for row in rows
    }
    terminal.facts(f"Splits {options.output}", shown)
    different = len({row["digest"] for row in rows})
    if different < len(rows):
        terminal.say(
            f"Note: only {different} of {len(rows)} splits differ; so good ones are few. For more of them: --tolerance 0.02"
        )
    return {"splits": rows, "different": different, **extra}


def _finish(
    options: Options, manifest: Manifest, split: Split, group: str, terminal: Terminal
) -> dict[str, Any]:
    """Audits a new split by its table, and writes the data set's own lists if asked."""
    from palpate.leakage import audit_split

    column = group if group in manifest.table.columns else "auto"
    audit = audit_split(
        manifest, split, group=column, name=options.output.name if options.output else ""
    )
    show(audit, terminal)
    files: list[str] = []
    if options.lists is not None:
        files = write_own_lists(manifest, split, options.lists)
        terminal.print(f"Lists in {options.lists}: {', '.join(files)}")
    return {"lists": files, "audit": dataclasses.asdict(audit)}


def write_own_lists(manifest: Manifest, split: Split, folder: Path) -> list[str]:
    """Writes a split in the data set's own list format, with ``SHA256SUMS`` (as ``sha256sum -c`` reads) over the lists.

    Returns:
        Names of the files, relative to the folder.

    Raises:
        PalpateError: if the folder is not empty, or a sample lacks what the lists need.
    """
    from palpate.data.formats.touch_and_go import write_lists as write_frame_lists
    from palpate.data.importing import write_lists

    with atomic_folder(folder) as part:
        frames = (
            manifest.table.select("vision", "tactile").null_count().row(0) == (len(manifest),) * 2
            and not manifest.table["frame"].null_count()
        )
        # Samples without pictures come from bare frame lists, whose own form is a frame list.
        files = (write_frame_lists if frames and "format" not in manifest.facts else write_lists)(
            manifest, split, part
        )
        names = sorted(p.relative_to(part).as_posix() for p in files)
        write_text(
            part / "SHA256SUMS", "".join(f"{digest_file(part / name)}  {name}\n" for name in names)
        )
    return [*names, "SHA256SUMS"]


def _verify(options: Options, path: Path, terminal: Terminal) -> tuple[dict[str, Any], int]:
    """Checks an existing split file; status 1 if anything does not hold."""
    from palpate.leakage import audit_split
    from palpate.leakage.splits.recheck import Check, columns_of, recheck

    split = Split.load(path)
    manifest, _ = _read(options.paths, options, terminal)
    links, _ = _links(options, manifest, terminal)
    by = options.by or ((options.group,) if options.group != "auto" else ())
    checks = recheck(manifest, split, by=by, links=links)
    terminal.facts(
        f"Check of {path} against {len(manifest)} samples",
        {c.name: f"{'holds' if c.ok else 'FAILS'}: {c.text}" for c in checks},
    )
    audit = None
    ids = set(manifest.ids)
    known = Split(
        {i: part for i, part in split.parts.items() if i in ids}, split.rule, split.manifest
    )
    if {"train", "test"} <= set(known.counts()):
        group = (by or columns_of(split, manifest) or ("auto",))[0]
        audit = audit_split(manifest, known, group=group, name=path.name)
        show(audit, terminal)
        quiet = not audit.leaking_samples
        told = "none does" if quiet else f"{audit.leaking_samples} of {audit.test_samples} leak"
        checks.append(Check("no signal of the audit flags a test sample", quiet, told))
    failed = [c.name for c in checks if not c.ok]
    terminal.print(
        f"FAIL: {len(failed)} of {len(checks)} checks do not hold."
        if failed
        else f"All {len(checks)} checks hold."
    )
    result = {
        "path": str(path),
        "digest": split.digest,
        "checks": [dataclasses.asdict(c) for c in checks],
        "failed": failed,
        "audit": audit and dataclasses.asdict(audit),
    }
    return result, FAILED_CHECK if failed else 0


def _noleak(options: Options, samples: Sequence[Path], terminal: Terminal) -> dict[str, Any]:
    """The published split of the data set that the first path names."""
    from palpate.leakage.splits import noleak

    assert options.output is not None
    dataset = str(options.paths[0])
    if dataset == "hct":
        if not samples:
            raise PalpateError(
                "HCT-NoLeak is a rule for your own tree",
                "no manifest",
                "Pass it: palpate split hct --noleak hct/ -o noleak.json",
            )
        manifest, skipped = _read(samples, options, terminal)
        plans = noleak.hct_noleak(
            manifest, train=options.train, val=options.val, seeds=[options.seed]
        )
        return _write(options, manifest, plans, [""], skipped, terminal)
    record = noleak.load_record(dataset)
    chosen = noleak.entry(record, noleak.ratio_name(options.train, options.val), options.seed)
    if not samples:
        return _record_alone(options, chosen.parts, chosen.rule, chosen.digest, terminal)
    manifest, _ = _read(samples, options, terminal)
    split, absent = noleak.record_split(chosen, manifest)
    split.save(options.output)
    if absent:
        terminal.say(
            f"Note: {len(absent)} of the record's {len(chosen.parts)} videos have no sample here, first {absent[0]}."
        )
    facts = {
        "digest": split.digest,
        "record": record["sha256"],
        "group": "video",
        "counts": split.counts(),
        "videos_without_samples": absent,
    }
    terminal.facts(f"{record['name']} {options.output}", facts)
    return (
        facts
        | {"rule": dict(chosen.rule), "path": str(options.output)}
        | _finish(options, manifest, split, "video", terminal)
    )


def _record_alone(
    options: Options,
    parts: Mapping[str, str],
    rule: Mapping[str, Any],
    digest: str,
    terminal: Terminal,
) -> dict[str, Any]:
    """The record's video -> part as a file."""
    assert options.output is not None
    if options.lists is not None:
        raise PalpateError(
            "--lists needs samples",
            "a record of videos alone",
            "Name your manifest or lists after --noleak",
        )
    data = {
        "format": "palpate-noleak/1",
        "digest": digest,
        "rule": dict(rule),
        "videos": dict(sorted(parts.items())),
    }
    write_json(options.output, data)
    counts = {
        part: sum(p == part for p in parts.values()) for part in dict.fromkeys(parts.values())
    }
    terminal.facts(
        f"{rule['name']} {options.output}",
        {"digest": digest, "videos": counts, **rule["on_the_official_lists"]},
    )
    return data | {"path": str(options.output)}
