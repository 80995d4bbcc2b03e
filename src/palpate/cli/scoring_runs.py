"""The three ways of ``palpate score``: a split of a manifest, pictures of touches, embeddings. The last loads no torch."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.cli.terminal import Terminal, require_extra
from palpate.core import MissingExtraError, PalpateError, Progress, Split
from palpate.core.digest import digest_file
from palpate.evaluation.comparing import (
    BACKGROUND,
    ON_FEATURES,
    REAL,
    SAME_MATERIAL,
    Asked,
    Outcome,
    against,
    compare_features,
    feature_companions,
    left_out,
    part_of,
    require_one_encoder,
)
from palpate.evaluation.embeddings import (
    Columns,
    Embeddings,
    is_embeddings,
    known_to,
    read_columns,
    read_together,
)
from palpate.evaluation.streamed import stream_tmmd
from palpate.report.results import Results

if TYPE_CHECKING:
    from palpate.cli.score import Options
    from palpate.data.manifest import Manifest
    from palpate.encoders.encoder_set import EncoderSet

#: What a companion's features are called where they came as a file.
GIVEN = "embeddings"
#: What the real touches are called in the settings of a run.
REFERENCE = "reference"


def score(options: Options, terminal: Terminal, cache: Path | None, progress: Progress) -> Results:
    """Everything that was asked for, as results.

    Args:
        options: of the command.
        terminal: for its command line.
        cache: folder for embeddings and decoded pictures, or None.
        progress: told what is being done.

    Raises:
        PalpateError: on anything that cannot be scored or compared.
    """
    from palpate.cli.score import sigmas

    split = None if options.split is None else Split.load(options.split)
    asked = Asked(
        presets=tuple(dict.fromkeys(options.presets)) or None,
        sigmas=sigmas(options),
        estimator=options.estimator,
        backend=options.backend,
        permutations=options.permutations,
        normalize={"check": "check", "yes": True, "no": False}[options.normalize],
        seed=options.seed,
        split=split.digest if split else None,
    )
    paths = _named(options)
    group = (
        options.group
        if options.group != "auto"
        else str(split.rule.get("group", "video"))
        if split
        else "video"
    )
    if options.manifest is not None and split is not None:
        return _of_split(options, split, asked, paths, group, terminal, cache, progress)
    assert options.reference is not None
    kinds = {path: is_embeddings(path) for path in (*paths.values(), options.reference)}
    if len(set(kinds.values())) > 1:
        got = ", ".join(
            f"{path} ({'embeddings' if kind else 'pictures'})" for path, kind in kinds.items()
        )
        raise PalpateError(
            "Generated and reference must both be pictures, or both embeddings",
            got,
            "Embed the pictures first, or pass them all",
        )
    columns = _columns(options, group)
    if kinds[options.reference]:
        return _of_embeddings(options, split, asked, paths, columns, terminal, progress)
    return _of_pictures(options, split, asked, paths, columns, group, terminal, cache, progress)


def _named(options: Options) -> dict[str, Path]:
    """Name -> path of every generator."""
    own = [
        p.stem if p.is_file() else p.name if p.name != "touches" else p.resolve().parent.name
        for p in options.generated
    ]
    names = list(options.names) or [
        name or p.resolve().name for name, p in zip(own, options.generated, strict=True)
    ]
    if len(set(names)) < len(names) or "" in names:
        fix = "Pass --names, one for each entry of --generated: they stand in the tables"
        raise PalpateError("Generators must differ in name", ", ".join(map(repr, names)), fix)
    if odd := [name for name in names if name != _utf8(name)]:
        raise PalpateError(
            "Names of generators must be UTF-8",
            ascii(odd[0]),
            "Pass --names: they stand in the tables",
        )
    taken = (BACKGROUND, SAME_MATERIAL, REAL) if options.manifest is not None else (REFERENCE,)
    if clash := [name for name in names if name in taken]:
        must = f"No generator may be called {' or '.join(map(repr, taken))}: real touches or controls beside it bear that name"
        raise PalpateError(
            must,
            f"--generated {options.generated[names.index(clash[0])]} as {clash[0]!r}",
            "Pass --names with another name",
        )
    return dict(zip(names, options.generated, strict=True))


def _columns(options: Options, group: str) -> Columns | None:
    """Labels and groups from one or two files."""
    asked = options.group != "auto"
    labels = read_columns(options.labels, group, asked=asked) if options.labels else None
    groups = read_columns(options.groups, group, asked=asked) if options.groups else None
    if groups is not None and groups.groups is None:
        got = f"columns {', '.join(groups.names)}"
        raise PalpateError(
            f"{options.groups} must have a column {group}",
            got,
            "Add it, or pass the file as --labels",
        )
    if labels is None or groups is None or options.labels == options.groups:
        return labels or groups
    return replace(labels, groups=groups.of(labels.ids)[1], group=groups.group)


def _require_group(
    options: Options, columns: Columns | None, held: Mapping[Path, bool], what: str
) -> None:
    """Refuses a ``--group`` that neither a columns file nor every input itself (path -> whether it is ``held``) has."""
    bare = [path for path, own in held.items() if not own]
    if options.group == "auto" or not bare or (columns is not None and columns.groups is not None):
        return
    if len(bare) < len(held):
        got = f"--group {options.group} and none in {bare[0]}"
        raise PalpateError(
            "--group must be known of every file",
            got,
            "Leave it out, or pass a file with that column as --groups",
        )
    got = (
        f"{what} alone"
        if columns is None
        else f"{what} and {columns.path}, which has the columns {', '.join(columns.names)}"
    )
    must = "--group must have a file whose column it names: --groups or --labels"
    raise PalpateError(
        must, f"--group {options.group} with {got}", "Leave it out, or add the column"
    )


def _of_split(
    options: Options,
    split: Split,
    asked: Asked,
    paths: Mapping[str, Path],
    group: str,
    terminal: Terminal,
    cache: Path | None,
    progress: Progress,
) -> Results:
    """The test part of a split, beside controls."""
    require_extra("palpate score")
    from palpate.data.manifest import Manifest
    from palpate.diffusion.generation import Generated
    from palpate.evaluation.score_inputs import is_generated
    from palpate.evaluation.scoring import compare_generated
    from palpate.evaluation.touches import files_digest
    from palpate.studies.summary import gallery

    assert options.manifest is not None
    assert options.encoder is not None
    _refuse_normalize(options)
    _require_utf8((options.manifest, *paths.values()))
    if plain := next((path for path in paths.values() if not is_generated(path)), None):
        fix = f"Score other pictures with --reference {options.manifest} --split {options.split} --encoder {options.encoder}"
        raise PalpateError(
            "With MANIFEST, --generated must be folders of palpate generate",
            f"{plain}, which has no index of one",
            fix,
        )
    folders = {name: Generated.load(path) for name, path in paths.items()}
    manifest, encoders = Manifest.load(options.manifest), _encoders(options.encoder, terminal)
    empty = [
        part
        for part in ("test", "train")
        if len(one := manifest.part(split, part)) and not one.table[group].count()
    ]
    if options.group != "auto" and empty:
        got = f"--group {group} and no value in the {empty[0]} part of {options.manifest}"
        raise PalpateError(
            "--group must name a column with values",
            got,
            "Leave it out, or fill the column of the manifest",
        )
    found = compare_generated(
        manifest,
        split,
        folders,
        encoders,
        replace(asked, presets=asked.presets_for(grouped=True)),
        group=group,
        controls=options.controls,
        companions=options.companions,
        weights=_weights(options),
        cache=cache,
        progress=progress,
    )
    digests: dict[str, Any] = {
        "manifest": manifest.digest,
        "split": split.digest,
        "tactile encoder": encoders.digest("tactile"),
    }
    test = manifest.part(split, "test")
    digests |= {REFERENCE: files_digest(test.ids, test.paths("tactile"))}
    digests["generated"] = {name: files_digest(f.ids, f.paths) for name, f in folders.items()}
    settings = {
        "digests": digests,
        "split rule": dict(split.rule),
        "generated": {name: dict(f.settings) for name, f in folders.items()},
    }
    pictures = gallery(manifest, next(iter(folders.values())), options.seed)
    return _results(found, paths, settings | {"options": _said(asked, group)}, terminal, pictures)


def _of_pictures(
    options: Options,
    split: Split | None,
    asked: Asked,
    paths: Mapping[str, Path],
    columns: Columns | None,
    group: str,
    terminal: Terminal,
    cache: Path | None,
    progress: Progress,
) -> Results:
    """Folders of images, manifests, folders of ``palpate generate``."""
    from palpate.evaluation.score_inputs import completed, is_generated, read_touches, touch_gallery

    assert options.reference is not None
    _refuse_normalize(options)
    _require_utf8((options.reference, *paths.values()))
    if options.encoder is None and (
        options.companions is None or set(options.companions) <= {"none"}
    ):
        fix = "Pass --encoder palpate/mini, a folder of palpate encoder or a hub id; or ask for scores of pixels alone: --companions ssim psnr"
        raise PalpateError("Pictures must have an encoder to be scored with", "no --encoder", fix)
    if idle := [
        name for name in _unused(options) if getattr(options, name) != getattr(type(options), name)
    ]:  # not what it is by default
        fix = "Pass --encoder palpate/mini, or leave it out"
        raise PalpateError(f"--{idle[0]} must go with features", "pictures without --encoder", fix)
    if options.encoder is not None or set(options.companions or ()) & {*ON_FEATURES, "lpips"}:
        require_extra("palpate score with an encoder")
    elif (
        any(is_generated(p) for p in (*paths.values(), options.reference))
        and importlib.util.find_spec("torch") is None
    ):
        raise MissingExtraError("torch", "all", "Reading a folder of palpate generate")
    found_real, found_made = (
        read_touches(options.reference),
        {name: read_touches(p) for name, p in paths.items()},
    )
    _require_one_kind(
        {options.reference: found_real, **{paths[n]: one for n, one in found_made.items()}},
        group,
        columns,
    )
    whole = completed(found_real, group=group, columns=columns)
    reference, train = (
        (whole, None) if split is None else (whole.part(split, "test"), whole.part(split, "train"))
    )
    if not len(reference):
        raise PalpateError(
            "There must be reference touches", "none in the test part", "Check the split"
        )
    made = {
        name: completed(one, group=group, columns=columns, like=whole)
        for name, one in found_made.items()
    }
    remarks: list[str] = []
    for name, one in made.items() if split else ():
        if (part := part_of(name, one.ids, reference.ids, whole.ids)) is not None:
            made[name], remarks = one.take(part), [*remarks, *left_out(name, one.ids, part)]
    every = {options.reference: reference, **{paths[name]: one for name, one in made.items()}}
    _require_group(
        options,
        columns,
        {path: bool(one.table[group].count()) for path, one in every.items()},
        "pictures",
    )
    encoders, digests = None, dict[str, Any]({"split": split.digest} if split else {})
    if options.encoder is not None:
        encoders = _encoders(options.encoder, terminal)
        digests["tactile encoder"] = encoders.digest("tactile")
    from palpate.evaluation.touches import compare_touches, files_digest

    digests[REFERENCE] = files_digest(reference.ids, reference.paths("tactile"))
    digests["generated"] = {
        name: files_digest(one.ids, one.paths("tactile")) for name, one in made.items()
    }
    found = compare_touches(
        made,
        reference,
        encoders,
        asked,
        group=group,
        companions=options.companions,
        weights=_weights(options),
        train=train,
        cache=cache,
        progress=progress,
    )
    found.remarks += remarks
    filled = (
        columns.group if columns is not None and not found_real.table[group].count() else None
    )  # under auto by another name
    said = {
        name: v for name, v in _said(asked, filled or group).items() if name not in _unused(options)
    }
    settings = {"digests": digests, "encoder": options.encoder or "none", "options": said}
    return _results(
        found,
        paths,
        settings,
        terminal,
        touch_gallery(reference, next(iter(made.values())), options.seed),
    )


def _encoders(encoder: str, terminal: Terminal) -> EncoderSet:
    terminal.say(f"Loading {encoder} ...")  # torch and its friends take seconds to import
    from palpate.encoders.encoder_set import EncoderSet

    return EncoderSet.load(encoder)


def _require_one_kind(found: Mapping[Path, Manifest], group: str, columns: Columns | None) -> None:
    """Refuses touches with groups of their own beside others whose groups would be those of a column of another name."""
    own = [path for path, one in found.items() if one.table[group].count()]
    if columns is not None and columns.group not in (None, group) and 0 < len(own) < len(found):
        got = f"column {group} of {own[0]} and column {columns.group} of {columns.path}"
        raise PalpateError(
            "All groups must be of one kind",
            got,
            f"Call that column {group} if it means the same, or leave it out",
        )


def _unused(options: Options) -> tuple[str, ...]:
    """Options that pictures without an encoder have no use for; CMMD of a CLIP has a bandwidth of its own, but takes the last two."""
    if options.encoder is not None:
        return ()
    return (
        "presets",
        "estimator",
        "sigma",
        "normalize",
        *(() if "cmmd" in (options.companions or ()) else ("backend", "permutations")),
    )


def _of_embeddings(
    options: Options,
    split: Split | None,
    asked: Asked,
    paths: Mapping[str, Path],
    columns: Columns | None,
    terminal: Terminal,
    progress: Progress,
) -> Results:
    """Files of embeddings."""
    assert options.reference is not None
    _refuse(options)
    made = read_together({REFERENCE: options.reference, **paths}, columns)
    group = next(
        (one.column for one in made.values() if one.column), "video"
    )  # what a file has itself is videos
    reference = made.pop(REFERENCE)
    held = {
        one.path: group == options.group and _grouped(one, reference)
        for one in (reference, *made.values())
    }
    _require_group(options, columns, held, "embeddings")
    for name, one in made.items():
        if one.features.shape[1] != reference.features.shape[1]:
            got = f"{one.features.shape[1]} and {reference.features.shape[1]}"
            raise PalpateError(
                f"{name!r} and the reference must have features of one width",
                got,
                "Embed both with the same encoder",
            )
    said = _said(asked, group)
    if any(one.streamed for one in (*made.values(), reference)):
        if split is not None or options.companions not in (None, ("none",)):
            got = "--split" if split else "--companions"
            raise PalpateError(
                "So many rows without groups are streamed, for TMMD alone",
                got,
                "Pass --groups, or leave it out",
            )
        if options.permutations not in (0, type(options).permutations):
            got = f"{options.permutations} with so many rows without groups, which are streamed"
            raise PalpateError(
                "--permutations must go with rows that are held",
                got,
                "Leave it out, or pass --groups",
            )
        del said["permutations"]  # none are made
        found = stream_tmmd(
            {name: one.features for name, one in made.items()},
            reference.features,
            asked,
            progress=progress,
        )
        found = against(found, digest_file(reference.path))
    else:
        found = _compare_embeddings(options, split, asked, made, reference, progress)
    encoder = reference.encoder or next((one.encoder for one in made.values() if one.encoder), None)
    compared = next((s.reference for s in found.scores if s.reference), None)
    known = (
        ("encoder", encoder),
        ("split", split.digest if split else None),
        (REFERENCE, compared),
    )
    digests = {name: v for name, v in known if v}
    files = {
        name: {
            "file": _utf8(str(one.path)),
            "rows": len(one.features),
            "digest": digest_file(one.path),
        }
        for name, one in {**made, REFERENCE: reference}.items()
    }
    return _results(
        found, paths, {"digests": digests, "embeddings": files, "options": said}, terminal, []
    )


def _compare_embeddings(
    options: Options,
    split: Split | None,
    asked: Asked,
    made: Mapping[str, Embeddings],
    reference: Embeddings,
    progress: Progress,
) -> Outcome:
    # Rows without ids are numbered; a generated and a real row of one number are not taken for partners.
    real, train = reference.feature_set("reference "), None
    sets, remarks, whole = (
        {name: one.feature_set() for name, one in made.items()},
        list[str](),
        real,
    )
    if split is not None:
        if reference.ids is None:
            raise PalpateError(
                "A split must go with a reference that has ids",
                f"{reference.path}",
                "Save it with ids, or leave --split out",
            )
        known = set(whole.ids)
        real = whole.take(split.ids("test"))
        train = (
            whole.take(split.ids("train"))
            if known.issuperset(split.ids("train")) and split.ids("train")
            else None
        )
    for name, one in sets.items():
        require_one_encoder(name, one, real)
        if made[name].ids is None:
            continue
        theirs = {
            c: v
            for c in ("labels", "groups")
            if getattr(one, c) is None and (v := getattr(whole, c)) is not None
        }
        row = {i: k for k, i in enumerate(whole.ids)}
        if theirs and known_to(
            str(made[name].path), one.ids, row, " and ".join(theirs)
        ):  # it holds for the generated sample too
            sets[name] = replace(
                one, **{c: [v[row[i]] for i in one.ids] for c, v in theirs.items()}
            )
        if split is not None and (part := part_of(name, one.ids, real.ids, whole.ids)) is not None:
            sets[name], remarks = sets[name].take(part), [*remarks, *left_out(name, one.ids, part)]
    numbered = all(one.ids is None for one in made.values())
    paired = not numbered or len({len(one.ids) for one in sets.values()}) == 1
    found = compare_features(sets, real, asked, train=train, paired=paired, progress=progress)
    found.remarks += remarks
    if len(sets) > 1:
        why = "their files have no ids, and differ in rows" if not paired else ""
        found.remarks += [f"No differences between generators: {why}"] if why else []
        found.remarks += (
            ["Row k of every generator is taken for the same sample: their files have no ids"]
            if paired and numbered
            else []
        )
    kinds = options.companions if options.companions is not None else ("fid", "kid", "prdc")
    default = options.companions is None
    found.add(
        feature_companions(
            kinds, sets, real, asked, what=GIVEN, default=default, paired=paired, progress=progress
        )
    )
    return found


def _grouped(one: Embeddings, reference: Embeddings) -> bool:
    """Whether rows have groups: their own, or those of the reference by id."""
    return one.groups is not None or (
        reference.groups is not None and set(one.ids or ("",)) <= set(reference.ids or ())
    )


def _refuse_normalize(options: Options) -> None:
    if options.normalize != "check":
        must = "--normalize must go with embeddings"
        raise PalpateError(
            must,
            f"{options.normalize} with pictures, whose features have unit length",
            "Leave it out",
        )


def _refuse(options: Options) -> None:
    """Options that embeddings have no use for."""
    pixels = [c for c in options.companions or () if c not in (*ON_FEATURES, "none")]
    if pixels:
        raise PalpateError(
            f"{pixels[0]} must have pictures",
            "embeddings",
            "Pass folders of images, or leave it out",
        )
    for name in ("encoder", "inception", "clip", "lpips", "cache"):
        if getattr(options, name) is not None:
            raise PalpateError(
                f"--{name} must go with pictures",
                "embeddings, which were made already",
                "Leave it out",
            )


def _weights(options: Options) -> Any:
    from palpate.evaluation.companions import Weights

    return Weights(inception=options.inception, clip=options.clip, lpips=options.lpips)


def _said(asked: Asked, group: str) -> dict[str, Any]:
    """The options that every table shares."""
    normalize = {"check": "check", True: "yes", False: "no"}[asked.normalize]
    return {
        "group": group,
        "sigma": list(asked.sigmas),
        "backend": asked.backend,
        "permutations": asked.permutations,
        "normalize": normalize,
        "seed": asked.seed,
    }


def _utf8(text: str) -> str:
    """A path as it can be written down, whatever bytes it has."""
    return text.encode(errors="surrogateescape").decode(errors="replace")


def _require_utf8(paths: Iterable[Path]) -> None:
    """Refuses folders of pictures that the gallery could not name."""
    if odd := [path for path in paths if (full := str(path.resolve())) != _utf8(full)]:
        raise PalpateError(
            "Paths of pictures must be UTF-8",
            ascii(str(odd[0])),
            "Rename the folder: a report finds its pictures by it",
        )


def _results(
    found: Outcome,
    paths: Mapping[str, Path],
    settings: dict[str, Any],
    terminal: Terminal,
    gallery: Any,
) -> Results:
    found = found.said()
    scores = [
        replace(s, note=s.note.replace('pass backend="blocked"', "pass --backend blocked"))
        for s in (*found.scores, *found.differences)
    ]
    return Results(
        title=f"Scores of {', '.join(paths)}",
        scores=scores,
        gallery=gallery,
        settings=settings,
        notes=found.remarks,
        commands=[_utf8(terminal.command)],
    )
