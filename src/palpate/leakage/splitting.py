"""Leak-free splits: whole groups go to one part, and every material keeps its share.

Groups are connected components (:mod:`palpate.leakage.groups`). Of all assignments of groups to
parts, one with the smallest largest deviation of any material's share from the wanted one is taken
(:mod:`palpate.leakage.program`). Folds are parts of equal share. Materials in fewer groups than
there are parts are named and go along.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import polars as pl

from palpate.core import Note, PalpateError, Progress, Split, quiet, require
from palpate.data.manifest import SIDES, Manifest
from palpate.leakage.auditing import Options, compare
from palpate.leakage.groups import Ints, choose_group, components, nested_groups
from palpate.leakage.inputs import Data, read, read_all
from palpate.leakage.noleak import HCT_GROUPS, published
from palpate.leakage.program import EXACT, RESOLUTION, Optimum, Problem, draw, optimize
from palpate.report.records import NO_LEAK

RULE_VERSION = 3
#: The group in rules where near-duplicates alone are kept together.
LINKED = "near-duplicates"
#: The largest group must leave the other parts at least this fraction of what they want.
LEAST_FILL = 0.25


@overload
def split(  # pyright: ignore[reportOverlappingOverload]
    data: Data, *, folds: None = None, **options: Any
) -> Split: ...
@overload
def split(data: Data, *, folds: int | None = None, **options: Any) -> list[Split]: ...
def split(  # noqa: PLR0913  # pyright: ignore[reportInconsistentOverload]
    data: Data,
    *,
    by: str | Sequence[str] = "auto",
    train: float = 0.8,
    val: float = 0.0,
    seed: int = 0,
    folds: int | None = None,
    near: str | None = None,
    noleak: str | None = None,
    cache: str | Path | None = None,
    reading: Mapping[str, Any] | None = None,
    skip_bad: bool = False,
    progress: Progress = quiet,
) -> Split | list[Split]:
    """Make a split in which no group is in two parts and every material keeps its share.

    Args:
        data: a manifest, a path (manifest, list, table, folder), several lists, or a data frame;
            with ``noleak="touch-and-go"`` None splits the videos of the record.
        by: one or several columns to keep whole; samples that share any of them stay together.
            ``auto`` takes what the data set names, else the coarsest that is known: the object,
            the session, the video, the contact.
        train: wanted share of the train part, in (0, 1).
        val: wanted share of the validation part, in [0, 1); test gets the remainder.
        seed: another seed gives another split of the same quality.
        folds: make so many folds; split k tests fold k (and, with ``val``, validates on fold
            k + 1). The shares are then those of the folds.
        near: keep near-duplicate images together: ``vision``, ``tactile`` or ``both``.
        noleak: the published split of ``touch-and-go``, or the same rule for ``hct``.
        cache: folder that keeps decoded images for ``near``.
        reading: how the source is read, as in :func:`palpate.leakage.audit`.
        skip_bad: skip bad rows of lists and tables, and note them.
        progress: callback.

    Returns:
        A split; with ``folds`` a list. Its rule holds what was achieved:
        ``name`` (``NoLeak`` only if its own audit finds no leak, else what train and test share),
        ``audit`` (the verdict), ``deviation`` (the largest, in [0, 1]), ``bound`` (no split by
        these groups has a smaller one), ``status``, ``limiting`` (the
        material that deviates most), ``rare`` and ``missing`` (materials that are not
        in every part).

    Raises:
        PalpateError: on shares out of range, unknown or null groups, fewer groups than parts, or
            one group too large to be split off.
    """
    _check(train, val, folds, noleak)
    cache = None if cache is None else Path(cache)
    if noleak == "touch-and-go":
        source = None if data is None else read(data, skip_bad, progress)
        manifest, notes = (source.manifest, source.notes) if source else (None, [])
        return published(manifest, train, val, seed, notes)
    (source,) = read_all([data], skip_bad, progress, None, reading, arguments=["data"])
    manifest, notes = source.manifest, source.notes
    name = "NoLeak"
    if noleak == "hct":
        by, name = HCT_GROUPS, "HCT-NoLeak"
    links, near_facts = _near_links(manifest, near, cache, progress)
    shares = {"train": train, "val": val, "test": 1 - train - val}
    if folds is not None:
        shares = {f"fold {k}": 1 / folds for k in range(folds)}
    shares = {part: round(share, 12) for part, share in shares.items() if share > 1e-9}
    columns, reason = _columns(manifest, by, links, len(shares))
    groups = components(manifest, columns, links)
    kind = " and ".join([*columns, *[LINKED] * bool(links)])
    number, materials, problem = _problem(manifest, groups, kind, list(shares.values()))
    optimum = optimize(problem)
    rule = {
        "name": name,
        "method": "whole groups, smallest largest deviation of any material's share",
        "version": RULE_VERSION,
        "group": columns[0] if columns else LINKED,
        "by": list(columns),
        "near": near_facts,
        "groups": len(problem.counts),
        "shares": shares,
    }
    notes += reason
    part_names = [list(shares)]
    if folds is not None:  # for each split the part of each fold
        roles = ["test", "val" if val > 0 else "train", *["train"] * (folds - 2)]
        part_names = [np.roll(roles, fold).tolist() for fold in range(folds)]
    splits: list[Split] = []
    assignment = draw(problem, optimum, seed)
    facts = rule | {"seed": seed}
    facts |= _achieved(problem, optimum, assignment, [*materials, "all samples"], list(shares))
    for fold, parts in enumerate(part_names):
        if folds is not None:
            shares = {p: parts.count(p) / folds for p in dict.fromkeys(parts)}
            facts |= {"folds": folds, "fold": fold, "shares": shares}
        part_of = pl.Series(parts).gather(assignment[number])
        assigned = dict(zip(manifest.ids, part_of.to_list(), strict=True))
        more = [*notes, *_notes(manifest, facts)]
        fresh = Split(assigned, dict(facts), manifest.digest, more)
        fresh = _audited(manifest, fresh, part_of, cache)
        fold_name = f"{fresh.rule['name']}, fold {fold} of {folds}" if folds else fresh.rule["name"]
        splits.append(fresh.changed(rule={**fresh.rule, "name": fold_name}))
    return splits[0] if folds is None else splits


def _check(train: float, val: float, folds: int | None, noleak: str | None) -> None:
    if folds is None and not (0 < train < 1 and 0 <= val < 1 and 1 - train - val > 1e-9):
        must = "The shares of train and val must be positive and leave room for test"
        got = f"train {train}, val {val}"
        raise PalpateError(must, got, "Choose smaller shares", example={"train": 0.8, "val": 0.1})
    least = 2 + (val > 0)
    require(folds is None or folds >= least, "folds", f"must be at least {least}", folds, 5)
    accepted = noleak in (None, "touch-and-go", "hct")
    require(accepted, "noleak", "must be touch-and-go or hct", repr(noleak), "touch-and-go")


def _near_links(
    manifest: Manifest, near: str | None, cache: Path | None, progress: Progress
) -> tuple[list[Any], dict[str, Any] | None]:
    """Labels of near-duplicate clusters, and their description for the rule."""
    if near is None:
        return [], None
    accepted = near in (*SIDES, "both")
    require(accepted, "near", "must be vision, tactile or both", repr(near), "both")
    from palpate.leakage.near import near_groups

    modalities = [m for m in SIDES if near in (m, "both") and manifest.table[m].count()]
    must = f"Near-duplicates need {'' if near == 'both' else f'{near} '}images"
    fix = "Leave it out, or import the images"
    require(len(modalities) > 0, None, must, "samples without any", fix=fix)
    links = [near_groups(manifest, m, cache=cache, progress=progress) for m in modalities]
    return links, {"modalities": modalities}


def _columns(
    manifest: Manifest, by: str | Sequence[str], links: Sequence[Any], parts: int
) -> tuple[list[str], list[Note]]:
    """The columns to keep whole, and why."""
    if by != "auto":
        return list(dict.fromkeys([by] if isinstance(by, str) else by)), []
    complete = (not manifest.table[c].null_count() for c in ("video", "object", "contact"))
    if links and not any(complete):
        return [], [Note("group-near-only")]
    column, reason = choose_group(manifest, parts)
    return [column], [reason] if reason else []


def _problem(
    manifest: Manifest, groups: pl.Series, kind: str, target: Sequence[float]
) -> tuple[Ints, list[str], Problem]:
    """The number of each sample's group, the names of materials, and the samples by both with the
    wanted shares.
    """
    names = groups.unique().sort()
    if len(names) < len(target):
        must = f"A split into {len(target)} parts needs at least as many groups"
        got = f"{len(names)} {kind} group(s)"
        if LINKED in kind:
            raise PalpateError(must, got, "Leave near out: near-duplicates join most groups")
        raise PalpateError(must, got, "Choose a finer group", example={"by": "contact"})
    materials = manifest.table["material"].drop_nulls().unique().sort()
    row, column = (
        series.cast(pl.Enum(values)).to_physical().cast(pl.Int64).fill_null(-1).to_numpy()
        for series, values in ((groups, names), (manifest.table["material"], materials))
    )
    counts = np.zeros((len(names), len(materials) + 1), np.int64)
    np.add.at(counts[:, -1], row, 1)
    np.add.at(counts, (row[column >= 0], column[column >= 0]), 1)
    biggest = int(counts[:, -1].argmax())
    largest, wanted = float(counts[biggest, -1] / len(groups)), 1 - max(target)
    must = f"The smaller parts must get at least {LEAST_FILL:.0%} of their wanted {wanted:.1%}"
    got = f"{kind} {names[biggest]!r} with {largest:.1%} of all samples"
    got += f", which leaves them {1 - largest:.2%} at best"
    fix = "Choose a finer group, thin that group out, or choose a larger train share"
    require(1 - largest >= LEAST_FILL * wanted, None, must, got, fix=fix)
    return row, materials.to_list(), Problem(counts, np.array(target))


def _achieved(
    problem: Problem, optimum: Optimum, assignment: Ints, columns: list[str], parts: list[str]
) -> dict[str, Any]:
    """What an assignment achieves, recounted from whole samples."""
    deviations = problem.deviations(assignment)
    deviation = float(deviations.max())
    bound = min(optimum.bound, deviation)
    status = f"within {deviation - bound:.5f} of the optimum"
    if deviation - bound <= EXACT:
        status = "optimal"
    elif deviation <= RESOLUTION + EXACT:
        status = f"below the resolution of {RESOLUTION:g}"
    missing = np.argwhere(problem.missing(assignment)).tolist()
    return {
        "deviation": round(deviation, 6),
        "bound": round(bound, 6),
        "status": status,
        "limiting": columns[int(deviations.max(0).argmax())],
        "rare": [columns[m] for m in np.flatnonzero(~problem.possible[:-1])],
        "missing": [f"{columns[m]}: {parts[p]}" for p, m in missing],
    }


def _audited(manifest: Manifest, fresh: Split, part_of: pl.Series, cache: Path | None) -> Split:
    """The split with the verdict of its own audit, and a name that says what train and test share.

    The audit is by all that is known of the samples, and by the images that were kept together.
    """
    near = fresh.rule["near"]
    options = Options(near["modalities"] if near else (), cache)
    train, test = (
        replace(manifest, table=manifest.table.filter(part_of == part))
        for part in ("train", "test")
    )
    own = compare(train, test, options, "")
    facts = {**fresh.rule, "audit": own.verdict}
    notes = [*fresh.notes, *_question(manifest, own.shared)]
    if own.verdict != NO_LEAK:
        what = f"{own.group}s shared" if own.groups_shared else own.verdict
        facts["name"] = f"by {' and '.join(facts['by']) or LINKED}: {what}"
        notes.append(Note("not-noleak", {"name": facts["name"], "verdict": own.verdict}))
    return fresh.changed(rule=facts, notes=notes)


def _question(manifest: Manifest, shared: Mapping[str, Sequence[int]]) -> list[Note]:
    """Whether a split is for new objects or for known ones, and what makes the other."""
    coarse = next((c for c in ("object", "session") if c in shared), None)
    if coarse is None:
        return []
    nested = "object" in shared and "video" in nested_groups(manifest)[1:]
    other = coarse if shared[coarse][0] else "video" if nested else None
    return [Note("question", {"shared": shared, "other": other})]


def _notes(manifest: Manifest, facts: dict[str, Any]) -> list[Note]:
    """What a reader must know of a split with these facts."""
    notes: list[Note] = []
    if not manifest.table["material"].count():
        notes.append(Note("no-materials"))
    parts = facts.get("folds") or len(facts["shares"])
    if facts["rare"]:
        notes.append(Note("rare-materials", {"materials": facts["rare"], "parts": parts}))
    if facts["missing"]:
        notes.append(Note("missing-materials", {"materials": facts["missing"]}))
    return notes
