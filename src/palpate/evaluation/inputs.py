"""What a call of :func:`palpate.evaluation.score` reads, aligned.

What a source (:mod:`palpate.evaluation.sources`) lacks is completed from the keyword ``labels``
(which also replaces what a source has), then, for a generator, from the reference, by id. What is
known of a part of the ids only is an error: scores of some of the samples would pass for scores of
all.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from palpate.core import Note, PalpateError, Split, require
from palpate.core.messages import require_rows
from palpate.evaluation.embedding_files import GROUPS, LABELS, first_of, require_ids, text_column
from palpate.evaluation.samples import Samples, picked
from palpate.evaluation.sources import KINDS, Source, is_image_file, read, without_suffix

if TYPE_CHECKING:
    import polars as pl

#: Name of the reference in tables and errors.
REFERENCE = "reference"


@dataclass(frozen=True)
class Inputs:
    """Aligned samples.

    Attributes:
        generators: name -> samples.
        reference: the real samples; of a split, its test part.
        train: the train part of the reference, if there is a split and the reference has all of it.
        group: what groups are.
        notes: what was assumed or skipped.
    """

    generators: dict[str, Samples]
    reference: Samples
    train: Samples | None
    group: str
    notes: list[Note] = field(default_factory=list)


def read_inputs(
    generated: Source,
    reference: Source,
    *,
    names: Sequence[str] | None,
    labels: Source,
    group: str,
    background: Source,
    split: Split | None,
    reserved: Sequence[str],
) -> Inputs:
    """Read and align everything that is scored; arguments as :func:`palpate.evaluation.score`.

    Raises:
        PalpateError: if a source is not readable, images are mixed with embeddings, or ids, labels
            or groups are known for a part of the samples only.
    """
    auto = str(split.rule.get("group", "video")) if split else "video"
    column = auto if group == "auto" else group
    sources = named_sources(generated, names, reserved)
    real = read(reference, REFERENCE, column)
    generators = {name: read(source, name, column) for name, source in sources.items()}
    _require_one_kind([real, *generators.values()])
    if background is not None:
        embedded = real.features is not None
        require(not embedded, "background", "must go with images", "embeddings", fix="Drop it")
        real = replace(real, background=read([background], "background"))
    keywords = keywords_of(labels, column, exact=group != "auto")
    ids = {i for keyword in keywords for i in keyword.values}
    real = complete(real, keywords)
    for name, samples in generators.items():
        generators[name] = complete(with_full_ids(samples, [*real.ids, *ids]), keywords)
    shared = [ids & {*samples.ids} for samples in (real, *generators.values())]
    must = f"{keywords[0].source if keywords else ''} must hold ids of the samples"
    require(not keywords or any(shared), None, must, "other ids")
    if real.numbered:  # row k of a generator is not row k of the reference
        real = replace(real, ids=[f"{REFERENCE} {i}" for i in real.ids])
    generators = {name: from_reference(samples, real) for name, samples in generators.items()}
    notes: list[Note] = []
    train = None
    if split is not None:
        everything, real, train = real, *_parts(real, split)
        for name, samples in generators.items():
            generators[name], skipped = _test_part(name, samples, real, everything)
            notes += skipped
    fix = "Check the split: is its test part empty?"
    require(len(real) > 0, None, "The reference must hold samples", "none", fix=fix)
    shared_group = _common_group([real, *generators.values()], group)
    return Inputs(generators, real, train, shared_group or column, notes)


def named_sources(
    generated: Source, names: Sequence[str] | None, reserved: Sequence[str]
) -> dict[str, Source]:
    """Name -> source of every generator; names must differ, and must not be those of a control."""
    if isinstance(generated, Mapping):
        sources = dict(cast("Mapping[str, Source]", generated))
    else:
        several = isinstance(generated, list | tuple) and not _is_image_list(generated)
        items: list[Source] = list(cast("Sequence[Source]", generated)) if several else [generated]
        got, fix = f"{len(names or ())} for {len(items)}", "Pass one name each"
        complete = not names or len(names) == len(items)
        require(complete, "names", "must name every generator", got, fix=fix)
        chosen = list(names or [_name_of(item, k, len(items)) for k, item in enumerate(items)])
        must, got = "must differ from generator to generator", ", ".join(map(repr, chosen))
        distinct = len(set(chosen)) == len(chosen) and "" not in chosen
        require(distinct, "names", must, got, fix=fix)
        sources = dict(zip(chosen, items, strict=True))
    must = "must hold something to score"
    require(len(sources) > 0, "generated", must, "nothing", fix=f"Pass {KINDS}")
    must = f"must not be {' or '.join(map(repr, reserved))}, which the tables have already"
    for name, source in sources.items():
        got, fix = f"{name!r} for {source}", "Pass another name"
        require(name not in reserved, "names", must, got, fix=fix)
    return sources


def _is_image_list(items: Sequence[Any]) -> bool:
    """Whether a list holds images of one generator: PIL images, arrays (h, w, c), files."""
    return bool(items) and all(
        is_image_file(item)
        if isinstance(item, str | Path)
        else hasattr(item, "getbands") or getattr(item, "ndim", 0) == 3
        for item in items
    )


def _name_of(item: Source, k: int, count: int) -> str:
    if not isinstance(item, str | Path):
        return "generated" if count == 1 else f"generated {k + 1}"
    path = Path(os.path.realpath(item))
    name = path.stem if path.is_file() else path.name
    name = path.parent.name if name in ("touches", "images") else name
    return name.encode(errors="surrogateescape").decode(errors="replace")


def _require_one_kind(sets: Sequence[Samples]) -> None:
    """Raise if images are mixed with embeddings."""
    kinds = ["images" if s.features is None else "embeddings" for s in sets]
    got = ", ".join(f"{s.source} ({kind})" for s, kind in zip(sets, kinds, strict=True))
    must = "Generated and reference must both be images, or both embeddings"
    fix = "Embed the images first, or pass them all"
    require(len({*kinds}) == 1, None, must, got, fix=fix)


@dataclass(frozen=True)
class _Keyword:
    """Labels or groups by id: field of :class:`Samples`, column, origin."""

    field: str
    column: str
    values: Mapping[str, str]
    source: str


def keywords_of(source: Source, group: str, *, exact: bool) -> list[_Keyword]:
    """The columns of the keyword ``labels``, which may hold groups as well."""
    if source is None:
        return []
    wanted = {"labels": LABELS, "groups": (group,) if exact else (group, *GROUPS)}
    table, where = _table(source)
    columns = {kind: first_of(table.columns, options) for kind, options in wanted.items()}
    usable = "id" in table.columns and any(columns.values())
    must = f"{where} must have a column id, and {' or '.join(c[0] for c in wanted.values())}"
    got = f"the columns {', '.join(table.columns)}"
    require(usable, None, must, got, fix="Add the column, or rename it")
    ids = text_column(table, "id", where)
    require_ids(ids, where)
    return [
        _Keyword(kind, c, dict(zip(ids, text_column(table, c, where), strict=True)), where)
        for kind, c in columns.items()
        if c
    ]


def _table(source: Source) -> tuple[pl.DataFrame, str]:
    """A CSV or Parquet file, a frame, id -> material, or one material per row, as a table."""
    import polars as pl

    from palpate.data.manifest import reading_parquet

    if isinstance(source, str | Path):
        path = Path(source)
        try:
            if path.suffix.lower() == ".parquet":
                with reading_parquet():
                    return pl.read_parquet(path, glob=False), str(path)
            return pl.read_csv(path, infer_schema=False, glob=False), str(path)  # 007 stays a name
        except Exception as error:  # polars raises many kinds
            got = str(error).splitlines()[0] if path.exists() else "no such file"
            fix = "Write one with the columns id, material, video"
            raise PalpateError(f"{path} must be a CSV or Parquet file", got, fix) from None
    if isinstance(source, pl.DataFrame):
        return source, "`labels`"
    values = source if isinstance(source, Mapping) else {str(k): v for k, v in enumerate(source)}
    columns = {"id": list(values), LABELS[0]: list(values.values())}
    return pl.DataFrame(columns), "`labels`"


def with_full_ids(samples: Samples, full: Sequence[str]) -> Samples:
    """Images whose ids are full ids but for the suffix take the full ids."""
    if samples.manifest is None:
        return samples
    exact, bare = {*full}, {without_suffix(i): i for i in reversed(full)}
    ids = [i if i in exact else bare.get(without_suffix(i), i) for i in samples.ids]
    if len(set(ids)) < len(ids):  # two names that one id could mean
        return samples
    import polars as pl

    table = samples.manifest.table.with_columns(pl.Series("id", ids, pl.String))
    return replace(samples, ids=ids, manifest=replace(samples.manifest, table=table))


def complete(samples: Samples, keywords: Sequence[_Keyword]) -> Samples:
    """Samples with labels and groups of the keywords; those without any id in a keyword stay."""
    for keyword in keywords:
        values, where = keyword.values, keyword.source
        if samples.numbered:
            must = f"{samples.source}, which has no ids, must have as many rows as {where}"
            got = f"{len(samples)} and {len(values)}"
            require(len(values) == len(samples), None, must, got, fix="Give them ids")
            samples = replace(samples, ids=list(values), numbered=False)
        missing = [i for i in samples.ids if i not in values]
        if len(missing) == len(samples):
            continue
        got = f"{len(missing)} of {len(samples)} of {samples.source} without, "
        got += f"first {next(iter(missing), '')!r}"
        require(not missing, None, f"Every id must be in {where}", got, fix="Add these rows")
        kind = keyword.column if keyword.field == "groups" else samples.group
        column = [values[i] for i in samples.ids]
        samples = replace(samples, **{keyword.field: column}, group=kind)
    return samples


def from_reference(samples: Samples, real: Samples) -> Samples:
    """Samples with labels and groups of the reference, which hold for images of the same ids."""
    lacking = [
        name
        for name in ("labels", "groups")
        if getattr(samples, name) is None and getattr(real, name) is not None
    ]
    row = {i: k for k, i in enumerate(real.ids)}
    unknown = [i for i in samples.ids if i not in row]
    if samples.numbered or not lacking or len(unknown) == len(samples):
        return samples
    columns = " and ".join(lacking)
    must = f"{samples.source} must have ids of the reference alone, which gives {columns} by id"
    got = f"{len(unknown)} of {len(samples)} without, first {next(iter(unknown), '')!r}"
    fix = "Remove these, give them ids of the reference, or pass labels and groups for every id"
    require(not unknown, None, must, got, fix=fix)
    at = [row[i] for i in samples.ids]
    labels = picked(real.labels, at) if "labels" in lacking else samples.labels
    if "groups" not in lacking:
        return replace(samples, labels=labels)
    return replace(samples, labels=labels, groups=picked(real.groups, at), group=real.group)


def _parts(real: Samples, split: Split) -> tuple[Samples, Samples | None]:
    """The test part of the reference, and its train part if it has all of it."""
    must = "must go with a reference that has ids"
    require(not real.numbered, "split", must, real.source, fix="Save it with ids")
    ids = {*real.ids}
    real.take([i for i in split.ids("test") if i not in ids])  # raises for missing ids
    test, train = ([i for i in real.ids if split.parts.get(i) == p] for p in ("test", "train"))
    complete = train and len(train) == len(split.ids("train"))
    return real.take(test), real.take(train) if complete else None


def _test_part(
    name: str, samples: Samples, real: Samples, everything: Samples
) -> tuple[Samples, list[Note]]:
    """The samples of the test part; all of them if the reference has none of their ids."""
    ids, wanted = {*samples.ids}, {*real.ids}
    if samples.numbered or ids.isdisjoint(everything.ids):
        return samples, []
    must = f"{name!r} must have every sample of the split's test part"
    fix = "Generate these too, or pass the split it was generated for"
    require_rows(samples.ids, real.ids, must, fix)
    part = samples.take([i for i in samples.ids if i in wanted])
    skipped = {"name": name, "skipped": len(samples) - len(part), "n": len(samples)}
    return part, [Note("outside-test-part", skipped)] if skipped["skipped"] else []


def _common_group(sets: Sequence[Samples], requested: str) -> str | None:
    """What the groups are, the same for all; None where no set has groups."""
    kinds = {s.source: s.group if s.groups else None for s in sets}
    if requested != "auto":
        for source, kind in kinds.items():
            must, got = "must be known for every input", f"{requested!r} and {kind or 'no groups'}"
            fix = "Pass groups with that column, or the default group"
            require(kind == requested, "group", must, f"{got} in {source}", fix=fix)
    sources = {kind: source for source, kind in kinds.items() if kind}
    got = " and ".join(f"{kind} in {source}" for kind, source in sources.items())
    must, fix = "All groups must be of one kind", "Pass groups for every id"
    require(len(sources) <= 1, None, must, got, fix=fix)
    return next(iter(sources), None)
