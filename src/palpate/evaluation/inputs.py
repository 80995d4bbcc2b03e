"""The samples of one call of :func:`palpate.evaluation.score`, aligned: ids, labels, groups, split.

What a source lacks is completed from the keywords ``labels`` and ``groups`` (which also replace
what a source has), then, for a generator, from the reference, by id. What is known of a part of the
ids only is an error: scores of some of the samples would pass for scores of all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from palpate.core import Note, PalpateError, Split, short
from palpate.evaluation.embedding_files import (
    GROUPS,
    LABELS,
    as_polars,
    first_of,
    read_parquet,
    require_ids,
    text_column,
)
from palpate.evaluation.samples import (
    KINDS,
    Samples,
    Source,
    is_image_file,
    picked,
    read,
    without_suffix,
)

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
    groups: Source,
    group: str,
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
    sources = _named(generated, names, reserved)
    real = read(reference, REFERENCE, column)
    made = {name: read(source, name, column) for name, source in sources.items()}
    _require_one_kind([real, *made.values()])
    known = _keywords(labels, groups, column, exact=group != "auto")
    given = {i for keyword in known for i in keyword.values}
    real = _complete(real, known)
    made = {name: _complete(_with_ids(s, [*real.ids, *given]), known) for name, s in made.items()}
    if known and not any(given & {*samples.ids} for samples in (real, *made.values())):
        raise PalpateError(f"{known[0].source} must hold ids of the samples", "other ids", "")
    if real.numbered:  # row k of a generator is not row k of the reference
        real = replace(real, ids=[f"{REFERENCE} {i}" for i in real.ids])
    made = {name: _from_reference(samples, real) for name, samples in made.items()}
    widened = [s for s in (real, *made.values()) if s.widened]
    notes = [Note("widened", {"source": s.source, "type": s.widened}) for s in widened]
    train = None
    if split is not None:
        whole, real, train = real, *_parts(real, split)
        for name, samples in made.items():
            made[name], skipped = _test_part(name, samples, real, whole)
            notes += skipped
    if not len(real):
        fix = "Check the split: is its test part empty?"
        raise PalpateError("The reference must hold samples", "none", fix)
    return Inputs(made, real, train, _common_group([real, *made.values()], group) or column, notes)


def _named(
    generated: Source, names: Sequence[str] | None, reserved: Sequence[str]
) -> dict[str, Source]:
    """Name -> source of every generator; names must differ, and must not be those of a control."""
    if isinstance(generated, Mapping):
        sources = dict(cast("Mapping[str, Source]", generated))
    else:
        several = isinstance(generated, list | tuple) and not _is_image_list(generated)
        items: list[Source] = list(cast("Sequence[Source]", generated)) if several else [generated]
        if names and len(names) != len(items):
            must, got = "must name every generator", f"{len(names)} for {len(items)}"
            raise PalpateError(must, got, "Pass one name each", argument="names")
        chosen = list(names or [_name_of(item, k, len(items)) for k, item in enumerate(items)])
        if len(set(chosen)) < len(chosen) or "" in chosen:
            must, got = "must differ from generator to generator", ", ".join(map(repr, chosen))
            raise PalpateError(must, got, "Pass one name each", argument="names")
        sources = dict(zip(chosen, items, strict=True))
    if not sources:
        must = "must hold something to score"
        raise PalpateError(must, "nothing", f"Pass {KINDS}", argument="generated")
    if used := [name for name in sources if name in reserved]:
        must = f"must not be {' or '.join(map(repr, reserved))}, which the tables have already"
        got = f"{used[0]!r} for {sources[used[0]]}"
        raise PalpateError(must, got, "Pass another name", argument="names")
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
    path = Path(item).resolve()
    name = path.stem if path.is_file() else path.name
    name = path.parent.name if name in ("touches", "images") else name
    return name.encode(errors="surrogateescape").decode(errors="replace")


def _require_one_kind(sets: Sequence[Samples]) -> None:
    """Raise if images are mixed with embeddings, or embeddings of several widths or encoders."""
    if len({s.features is None for s in sets}) > 1:
        kinds = {True: "images", False: "embeddings"}
        got = ", ".join(f"{s.source} ({kinds[s.features is None]})" for s in sets)
        must = "Generated and reference must both be images, or both embeddings"
        raise PalpateError(must, got, "Embed the images first, or pass them all")
    real, fix = sets[0], "Embed both with the same encoder"
    for s in sets[1:]:
        if s.features is None or real.features is None:
            continue
        if s.features.shape[1] != real.features.shape[1]:
            must = f"{s.source} and the reference must have features of one width"
            got = f"{s.features.shape[1]} and {real.features.shape[1]}"
            raise PalpateError(must, got, fix)
        if s.encoder and real.encoder and s.encoder != real.encoder:
            got = f"digests {short(s.encoder)} and {short(real.encoder)}"
            raise PalpateError(f"{s.source} and the reference must come from one encoder", got, fix)


@dataclass(frozen=True)
class _Keyword:
    """Labels or groups by id: field of :class:`Samples`, column, origin."""

    field: str
    column: str
    values: Mapping[str, str]
    source: str


def _keywords(labels: Source, groups: Source, group: str, *, exact: bool) -> list[_Keyword]:
    """The columns of the keywords ``labels`` (which may hold groups as well) and ``groups``."""
    group_names = (group,) if exact else (group, *GROUPS)
    wanted = {"labels": LABELS} | ({} if groups is not None else {"groups": group_names})
    keywords = [] if labels is None else _read_keyword(labels, "labels", wanted)
    if groups is not None:
        keywords += _read_keyword(groups, "groups", {"groups": group_names})
    return keywords


def _read_keyword(source: Source, name: str, wanted: Mapping[str, Sequence[str]]) -> list[_Keyword]:
    table, where = _table(source, wanted[name][0], name)
    columns = {kind: first_of(table.columns, options) for kind, options in wanted.items()}
    if "id" not in table.columns or not any(columns.values()):
        must = f"{where} must have a column id, and {' or '.join(c[0] for c in wanted.values())}"
        got = f"the columns {', '.join(table.columns)}"
        raise PalpateError(must, got, "Add the column, or rename it")
    ids = text_column(table, "id", where)
    require_ids(ids, where)
    return [
        _Keyword(kind, c, dict(zip(ids, text_column(table, c, where), strict=True)), where)
        for kind, c in columns.items()
        if c
    ]


def _table(source: Source, column: str, argument: str) -> tuple[pl.DataFrame, str]:
    """A CSV or Parquet file, a frame, id -> value, or one value per row, with a column ``id``."""
    import polars as pl

    if isinstance(source, str | Path):
        path = Path(source)
        try:
            if path.suffix.lower() == ".parquet":
                return read_parquet(path)[1], str(path)
            return pl.read_csv(path, infer_schema=False, glob=False), str(path)  # 007 stays a name
        except Exception as error:  # polars raises many kinds
            got = str(error).splitlines()[0] if path.exists() else "no such file"
            fix = "Write one with the columns id, material, video"
            raise PalpateError(f"{path} must be a CSV or Parquet file", got, fix) from None
    if hasattr(source, "columns"):
        return as_polars(source), f"`{argument}`"
    values = source if isinstance(source, Mapping) else {str(k): v for k, v in enumerate(source)}
    return pl.DataFrame({"id": list(values), column: list(values.values())}), f"`{argument}`"


def _with_ids(samples: Samples, known: Sequence[str]) -> Samples:
    """Images whose ids are known ids but for the suffix take the known ids."""
    if samples.manifest is None:
        return samples
    exact, bare = {*known}, {without_suffix(i): i for i in reversed(known)}
    ids = [i if i in exact else bare.get(without_suffix(i), i) for i in samples.ids]
    if len(set(ids)) < len(ids):  # two names that one id could mean
        return samples
    import polars as pl

    table = samples.manifest.table.with_columns(pl.Series("id", ids, pl.String))
    return replace(samples, ids=ids, manifest=replace(samples.manifest, table=table))


def _complete(samples: Samples, keywords: Sequence[_Keyword]) -> Samples:
    """Samples with labels and groups of the keywords; those without any id in a keyword stay."""
    for keyword in keywords:
        values, where = keyword.values, keyword.source
        if samples.numbered:
            if len(values) != len(samples):
                must = f"{samples.source}, which has no ids, must have as many rows as {where}"
                raise PalpateError(must, f"{len(samples)} and {len(values)}", "Give them ids")
            samples = replace(samples, ids=list(values), numbered=False)
        missing = [i for i in samples.ids if i not in values]
        if len(missing) == len(samples):
            continue
        if missing:
            got = f"{len(missing)} of {len(samples)} of {samples.source} without, "
            got += f"first {missing[0]!r}"
            raise PalpateError(f"Every id must be in {where}", got, "Add these rows")
        kind = keyword.column if keyword.field == "groups" else samples.group
        column = [values[i] for i in samples.ids]
        samples = replace(samples, **{keyword.field: column}, group=kind)
    return samples


def _from_reference(samples: Samples, real: Samples) -> Samples:
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
    if unknown:
        what = " and ".join(lacking)
        must = f"{samples.source} must have ids of the reference alone, which gives {what} by id"
        got = f"{len(unknown)} of {len(samples)} without, first {unknown[0]!r}"
        fix = "Remove these, give them ids of the reference, or pass labels and groups for every id"
        raise PalpateError(must, got, fix)
    at = [row[i] for i in samples.ids]
    taken: dict[str, Any] = {name: picked(getattr(real, name), at) for name in lacking}
    group = real.group if "groups" in lacking else samples.group
    return replace(samples, **taken, group=group)


def _parts(real: Samples, split: Split) -> tuple[Samples, Samples | None]:
    """The test part of the reference, and its train part if it has all of it."""
    if real.numbered:
        must, fix = "must go with a reference that has ids", "Save it with ids"
        raise PalpateError(must, real.source, fix, argument="split")
    known = {*real.ids}
    real.take([i for i in split.ids("test") if i not in known])  # raises for missing ids
    test, train = ([i for i in real.ids if split.parts.get(i) == p] for p in ("test", "train"))
    whole = train and len(train) == len(split.ids("train"))
    return real.take(test), real.take(train) if whole else None


def _test_part(
    name: str, samples: Samples, real: Samples, whole: Samples
) -> tuple[Samples, list[Note]]:
    """The samples of the test part; all of them if the reference has none of their ids."""
    ids, wanted = {*samples.ids}, {*real.ids}
    if samples.numbered or ids.isdisjoint(whole.ids):
        return samples, []
    if missing := [i for i in real.ids if i not in ids]:
        must = f"{name!r} must have every sample of the split's test part"
        got = f"{len(missing)} of {len(wanted)} missing, first {missing[0]!r}"
        fix = "Generate these too, or pass the split it was generated for"
        raise PalpateError(must, got, fix)
    part = samples.take([i for i in samples.ids if i in wanted])
    skipped = {"name": name, "skipped": len(samples) - len(part), "n": len(samples)}
    return part, [Note("outside-test-part", skipped)] if skipped["skipped"] else []


def _common_group(sets: Sequence[Samples], requested: str) -> str | None:
    """What the groups are, the same for all; None where no set has groups."""
    kinds = {s.source: s.group if s.groups else None for s in sets}
    if requested != "auto":
        for source, kind in kinds.items():
            if kind != requested:
                got = f"{requested!r} and {kind or 'no groups'} in {source}"
                fix = "Pass groups with that column, or the default group"
                raise PalpateError("must be known for every input", got, fix, argument="group")
    known = {kind: source for source, kind in kinds.items() if kind}
    if len(known) > 1:
        got = " and ".join(f"{kind} in {source}" for kind, source in known.items())
        raise PalpateError("All groups must be of one kind", got, "Pass groups for every id")
    return next(iter(known), None)
