"""Leak-free splits: whole groups go to one part, and every material keeps its share as well as it can.

Groups are connected components (:mod:`palpate.leakage.splits.groups`); with n_gm the samples of material m in group g and r_p the wanted share of part p,
the assignment a(g) minimizes the largest deviation

    max_{m, p} | sum_{g: a(g)=p} n_gm / n_m - r_p |

over the materials that occur in at least as many groups as there are parts, and over all samples together, each present in every part
(:mod:`palpate.leakage.splits.assign`). Rarer materials are named and go along. Folds are parts of equal share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import PARTS, PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.leakage.splits.assign import RESOLUTION, Optimum, draw, optimize
from palpate.leakage.splits.groups import COLUMNS, Nulls, components
from palpate.leakage.splits.polish import Ints, Problem
from palpate.leakage.splits.program import EXACT

RULE_VERSION = 2
#: A split is refused if its largest group leaves the other parts less than this fraction of what they want.
LEAST_FILL = 0.25
#: How a group of linked samples without a common column is called in rules.
LINKED = "near-duplicates"


@dataclass(frozen=True)
class SplitPlan:
    """A split with what the rule achieved.

    Attributes:
        split: the assignment, its rule and digest.
        group: the first column kept whole (``near-duplicates`` if only links are); ``reason`` says why, if it was chosen by rule.
        deviation: largest deviation of any material's share, or of all samples', from the wanted one, in [0, 1], recounted.
        rare: materials that occur in too few groups to be in every part.
        by: all columns kept whole.
        bound: no split by these groups has a smaller largest deviation.
        status: ``proven optimal``, or how far from it at most.
        nodes: branch-and-bound nodes used.
        limiting: the material with the largest deviation (``all samples`` for the whole).
        missing: ``material: part`` for each material that could be in every part, but not together with the others.
        where: group -> part (in folds: the fold that tests it).
        notes: sentences for people.
    """

    split: Split
    group: str
    reason: str
    deviation: float
    rare: list[str]
    by: tuple[str, ...] = ("video",)
    bound: float = 0.0
    status: str = ""
    nodes: int = 0
    limiting: str = ""
    missing: list[str] = field(default_factory=list)
    where: Mapping[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def gap(self) -> float:
        """``deviation - bound``: how much smaller the largest deviation of another split can be at most."""
        return max(0.0, self.deviation - self.bound)


@dataclass(frozen=True)
class _Task:
    """A manifest cut into groups: everything that the optimizer and the rule need.

    ``counts`` (G, M + 1): samples of each group by material, then all; ``names`` (G) in its order; ``of`` the group of each sample.
    """

    manifest: Manifest
    by: tuple[str, ...]
    reason: str
    names: list[str]
    of: list[str]
    materials: list[str]
    counts: Ints
    rule: dict[str, Any]
    notes: list[str]

    @property
    def group(self) -> str:
        return self.by[0] if self.by else LINKED


def choose_group(manifest: Manifest, parts: int = 2) -> tuple[str, str]:
    """The column to keep whole, and why: what the data set names, else the video, unless most materials occur in too few videos.

    Returns:
        (column, reason); the reason is '' for the normal case.

    Raises:
        PalpateError: if neither videos nor touches nor objects are known.
    """
    table = manifest.table
    said = [manifest.facts["group"]] if manifest.facts.get("group") in COLUMNS else []
    known = [
        g
        for g in (*said, "video", "object", "contact")
        if table[g].null_count() == 0 and table.height
    ]
    if not known:
        raise PalpateError(
            "A leak-free split needs the video, object or touch of every sample",
            "nulls in each of these columns",
            "Import a table that has one (palpate import table.csv --map video=YOUR_COLUMN), or group by --near",
        )
    first = known[0]
    if first == "contact":
        return "contact", "The manifest knows no videos: the touch is kept whole."
    if table[first].n_unique() < parts and "contact" in known:
        return (
            "contact",
            f"There are fewer than {parts} {first}s: whole touches are kept together instead, and train and test share a {first}.",
        )
    normal = (
        ""
        if first == "video"
        else f"The data set says so: the {first} is kept whole."
        if said == [first]
        else ""
    )
    normal = normal or (
        "" if first == "video" else f"The manifest knows no videos: the {first} is kept whole."
    )
    groups = (
        table.filter(pl.col("material").is_not_null())
        .group_by("material")
        .agg(pl.col(first).n_unique().alias("n"))
    )
    if not groups.height:
        return first, normal
    enough = groups.filter(pl.col("n") >= parts).height
    if 2 * enough >= groups.height or "contact" not in known:
        return first, normal
    return "contact", (
        f"Only {enough} of {groups.height} materials occur in {parts} or more {first}s, too few for the {first} to be the group: whole touches are "
        f"kept together instead. Train and test then share {first}s, so scores are optimistic for new places."
    )


def leak_free_split(
    manifest: Manifest, *, train: float = 0.8, val: float = 0.0, seed: int = 0, **options: Any
) -> SplitPlan:
    """A split in which no group stands in two parts, stratified by material; see :func:`leak_free_splits`."""
    return leak_free_splits(manifest, [seed], train=train, val=val, **options)[0]


def leak_free_splits(
    manifest: Manifest,
    seeds: Sequence[int],
    *,
    train: float = 0.8,
    val: float = 0.0,
    group: str = "auto",
    by: Sequence[str] = (),
    links: Sequence[NDArray[np.integer]] = (),
    link_facts: Mapping[str, Any] | None = None,
    nulls: Nulls = "refuse",
    tolerance: float = 0.0,
    name: str = "NoLeak",
) -> list[SplitPlan]:
    """Several splits of the same quality, in each of which no group stands in two parts.

    Args:
        manifest: the samples; materials may be null (then only the sizes are balanced).
        seeds: one split a seed. The result depends on the manifest, the options and the seed, on no machine or clock.
        train: wanted share of the train part, in (0, 1).
        val: wanted share of the validation part, in [0, 1); test gets the rest.
        group: one column to keep whole, or ``auto`` (:func:`choose_group`); ``by`` goes before it.
        by: columns to keep whole together.
        links: labels of near-duplicate clusters, (n,) integers each, negative for none.
        link_facts: how they were found, for the rule.
        nulls: what a null in such a column means (:func:`palpate.leakage.splits.groups.components`).
        tolerance: how much larger than the smallest possible the largest deviation may be; more of it, more different splits.
        name: the name of the rule.

    Raises:
        PalpateError: on shares out of range, unknown or null groups, fewer groups than parts, or one group too large to be split off.
    """
    shares = {"train": train, "val": val, "test": 1.0 - train - val}
    if not (0 < train < 1 and 0 <= val < 1 and shares["test"] > 1e-9):
        raise PalpateError(
            "The shares of train and val must be positive and leave room for test",
            f"train {train}, val {val}",
            "Pass e.g. --train 0.8 --val 0.0",
        )
    if not 0 <= tolerance < 1:
        raise PalpateError("The tolerance must lie in [0, 1)", str(tolerance), "Pass e.g. 0.01")
    wanted = {part: round(share, 12) for part in PARTS if (share := shares[part]) > 1e-9}
    task = _task(manifest, len(wanted), group, by, links, link_facts, nulls)
    problem = _problem(task, np.array(list(wanted.values())))
    optimum, plans = optimize(problem), []
    for seed in seeds:
        assignment = draw(problem, optimum, seed, tolerance)
        where = {g: list(wanted)[a] for g, a in zip(task.names, assignment.tolist(), strict=True)}
        rule = {"name": name, **task.rule, "shares": wanted, "seed": seed, "tolerance": tolerance}
        plans.append(_plan(task, problem, optimum, assignment, list(wanted), where, where, rule))
    return plans


def leak_free_folds(
    manifest: Manifest,
    folds: int,
    *,
    val: bool = False,
    seed: int = 0,
    group: str = "auto",
    by: Sequence[str] = (),
    links: Sequence[NDArray[np.integer]] = (),
    link_facts: Mapping[str, Any] | None = None,
    nulls: Nulls = "refuse",
    tolerance: float = 0.0,
) -> list[SplitPlan]:
    """Cross-validation without leaks: ``folds`` parts of equal share, each of which is the test part once.

    Args:
        manifest: the samples.
        folds: at least 2; with ``val`` at least 3.
        val: let the next fold be the validation part; else all others are train.
        seed: as the other options, see :func:`leak_free_splits`.
        group: see there.
        by: see there.
        links: see there.
        link_facts: see there.
        nulls: see there.
        tolerance: see there.

    Returns:
        One plan a fold; deviations, bounds and rare materials are those of all folds together.

    Raises:
        PalpateError: as :func:`leak_free_splits`.
    """
    if folds < 2 + val:
        raise PalpateError(
            f"There must be at least {2 + val} folds" + " with a validation fold" * val,
            str(folds),
            "Pass e.g. --folds 5",
        )
    task = _task(manifest, folds, group, by, links, link_facts, nulls)
    problem = _problem(task, np.full(folds, 1 / folds))
    optimum = optimize(problem)
    assignment = draw(problem, optimum, seed, tolerance)
    plans: list[SplitPlan] = []
    for fold in range(folds):
        part = {
            k: "test" if k == fold else "val" if val and k == (fold + 1) % folds else "train"
            for k in range(folds)
        }
        where = {g: part[a] for g, a in zip(task.names, assignment.tolist(), strict=True)}
        fold_of = {g: f"fold {a}" for g, a in zip(task.names, assignment.tolist(), strict=True)}
        rule = {
            "name": f"NoLeak fold {fold} of {folds}",
            **task.rule,
            "folds": folds,
            "fold": fold,
            "seed": seed,
            "tolerance": tolerance,
        }
        rule["shares"] = {
            p: round(n / folds, 12) for p in PARTS if (n := list(part.values()).count(p))
        }
        plans.append(
            _plan(
                task,
                problem,
                optimum,
                assignment,
                [f"fold {k}" for k in range(folds)],
                where,
                fold_of,
                rule,
            )
        )
    return plans


def _task(
    manifest: Manifest,
    parts: int,
    group: str,
    by: Sequence[str],
    links: Sequence[NDArray[np.integer]],
    facts: Mapping[str, Any] | None,
    nulls: Nulls,
) -> _Task:
    """Cuts the manifest into groups.

    Raises:
        PalpateError: if there are no samples, or no such groups, or fewer groups than parts.
    """
    if not len(manifest):
        raise PalpateError("A split needs samples", "an empty manifest", "Import the data again")
    table, reason, columns = manifest.table, "", tuple(dict.fromkeys(by))
    if not columns and group != "auto":
        columns = (group,)
    elif not columns:
        if links and all(table[c].null_count() for c in ("video", "object", "contact")):
            reason = "The manifest knows no videos: near-duplicates alone are kept together."
        else:
            column, reason = choose_group(manifest, parts)
            columns = (column,)
    of = components(manifest, columns, links, nulls=nulls)
    notes = [reason] if reason else []
    for column in columns:
        if empty := table[column].null_count():
            notes.append(
                f"{empty} samples have no {column}: each is a group of its own unless another column or a near-duplicate joins it."
            )
    grouped = table.select("material").with_columns(pl.Series("group", of, dtype=pl.String))
    names = sorted(set(of))
    what = " and ".join(columns) + (" and near-duplicates" if links and columns else "") or LINKED
    if len(names) < parts:
        raise PalpateError(
            f"A split into {parts} parts needs at least as many groups",
            f"{len(names)} {what} group(s)",
            "Choose a finer group, e.g. --by touch",
        )
    materials = sorted(table["material"].drop_nulls().unique().to_list())
    row, col = {g: k for k, g in enumerate(names)}, {m: k for k, m in enumerate(materials)}
    counts = np.zeros((len(names), len(materials) + 1), np.int64)
    for g, m, n in grouped.group_by("group", "material").len().iter_rows():
        if m is not None:
            counts[row[g], col[m]] += n
        counts[row[g], -1] += n
    if not materials:
        notes.append("No sample has a material: only the sizes of the parts are balanced.")
    rule = {
        "method": "whole groups, smallest largest deviation of any material's share",
        "version": RULE_VERSION,
        "group": columns[0] if columns else LINKED,
        "by": list(columns),
        "near": dict(facts or {"labels": len(links)}) if links else None,
        "nulls": nulls,
        "asked": list(by) or group,
        "reason": reason,
        "groups": len(names),
    }
    return _Task(manifest, columns, reason, names, of, materials, counts, rule, notes)


def _problem(task: _Task, target: NDArray[np.float64]) -> Problem:
    """The problem, if its largest group can be split off.

    Raises:
        PalpateError: if it leaves the other parts less than ``LEAST_FILL`` of what they want.
    """
    sizes = task.counts[:, -1]
    biggest = int(np.argmax(sizes))
    held, wanted = float(sizes[biggest] / sizes.sum()), 1 - float(target.max())
    if 1 - held < LEAST_FILL * wanted:
        kind = task.group if task.group in COLUMNS else "group"
        raise PalpateError(
            f"These samples cannot be split as asked: the parts beside the largest must get at least {LEAST_FILL:.0%} of their wanted {wanted:.1%}",
            f"{kind} {task.names[biggest]!r} with {held:.1%} of all samples, which leaves them {1 - held:.2%} at best",
            "Choose a finer group (--by touch), thin that group out, or ask for a larger --train",
        )
    return Problem(task.counts, target)


def _plan(
    task: _Task,
    problem: Problem,
    optimum: Optimum,
    assignment: Ints,
    parts: Sequence[str],
    where: Mapping[str, str],
    shown: Mapping[str, str],
    rule: Mapping[str, Any],
) -> SplitPlan:
    """One assignment as a plan, everything recounted from it."""
    deviation = problem.worst(assignment)
    if optimum.bound > deviation + EXACT:  # a proof that is wrong must never pass for one
        raise RuntimeError(
            f"the lower bound {optimum.bound} lies above a deviation that was reached, {deviation}"
        )
    bound = min(optimum.bound, deviation)
    gap = deviation - bound
    status = f"within {gap:.5f} of the optimum"
    if gap <= EXACT:
        status = "proven optimal"
    elif deviation <= RESOLUTION + EXACT:
        status = f"below the resolution of {RESOLUTION:g}, {status}"
    columns = [*task.materials, "all samples"]
    off = problem.deviations(assignment).max(0) * problem.used
    gone = [
        f"{columns[m]}: {parts[p]}"
        for p, m in np.argwhere((problem.present(assignment) == 0) & problem.possible).tolist()
    ]
    rare = [
        m for m, possible in zip(task.materials, problem.possible, strict=False) if not possible
    ]
    notes = list(task.notes)
    if rare:
        notes.append(f"In fewer than {len(parts)} groups, so not in every part: {', '.join(rare)}.")
    if gone:
        notes.append(
            f"Could be in every part, but not together with the others: {', '.join(gone)}."
        )
    rule = {**rule, "deviation": round(deviation, 6), "bound": round(bound, 6), "status": status}
    parts_of = {i: where[g] for i, g in zip(task.manifest.ids, task.of, strict=True)}
    split = Split(parts_of, rule, task.manifest.digest)
    return SplitPlan(
        split,
        task.group,
        task.reason,
        deviation,
        rare,
        task.by,
        bound,
        status,
        optimum.nodes,
        columns[int(np.argmax(off))],
        gone,
        dict(shown),
        notes,
    )


def describe(plan: SplitPlan) -> Mapping[str, Any]:
    """The plan as JSON for terminals and reports."""
    return {
        "digest": plan.split.digest,
        "group": plan.group,
        "by": list(plan.by),
        "groups": len(plan.where),
        "reason": plan.reason,
        "counts": plan.split.counts(),
        "largest_material_deviation": round(plan.deviation, 5),
        "lower_bound": round(plan.bound, 5),
        "gap": round(plan.gap, 5),
        "status": plan.status,
        "limiting_material": plan.limiting,
        "nodes": plan.nodes,
        "materials_in_too_few_groups": plan.rare,
        "materials_left_out": plan.missing,
    }


def renamed(plan: SplitPlan, **rule: Any) -> SplitPlan:
    """The plan with more in its rule."""
    return replace(plan, split=replace(plan.split, rule={**plan.split.rule, **rule}))
