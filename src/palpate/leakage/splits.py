"""Leak-free splits: whole groups go to one part, and every material keeps its share.

With n_gm the samples of material m in group g and r_p the wanted share of part p, the assignment a(g)
is chosen to minimise a weighted sum of, heaviest first,

1. materials that could be in every part (they occur in enough groups) but are missing from one (weight 100),
2. the largest deviation ``max_{m, p} | sum_{g: a(g)=p} n_gm / n_m - r_p |`` of such a material, and that of the whole (1 each),
3. the mean squared deviation of all materials and of the whole (0.1),

by a seeded greedy construction (largest groups first) followed by moves and swaps until none improves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from palpate.core import PARTS, PalpateError, Split, rng_for
from palpate.data.manifest import Manifest
from palpate.leakage.audit import GROUPS

RULE_VERSION = 1
#: Swaps tried in one polishing round; beyond it the gain is below a tenth of a percent on Touch and Go.
SWAP_TRIES = 4000


@dataclass(frozen=True)
class SplitPlan:
    """A split with what the rule achieved.

    Attributes:
        split: the assignment, its rule and digest.
        group: the column kept whole; ``reason`` says why, if it was chosen by rule.
        deviation: largest deviation of any material's share from the wanted one, in [0, 1].
        rare: materials that occur in too few groups to be in every part.
    """

    split: Split
    group: str
    reason: str
    deviation: float
    rare: list[str]


def choose_group(manifest: Manifest, parts: int = 2) -> tuple[str, str]:
    """The column to keep whole, and why: the video, unless most materials occur in too few videos to be on both sides.

    Returns:
        (column, reason); the reason is '' for the normal case.

    Raises:
        PalpateError: if neither videos nor touches nor objects are known.
    """
    table = manifest.table
    known = [g for g in ("video", "object", "touch") if table[g].null_count() == 0 and table.height]
    if not known:
        raise PalpateError(
            "A leak-free split needs the video, object or touch of every sample",
            "nulls in each of these columns",
            "Import a table that has one: palpate import table.csv --map video=YOUR_COLUMN",
        )
    if known[0] == "touch":
        return "touch", "The manifest knows no videos: the touch is kept whole."
    if table[known[0]].n_unique() < parts and "touch" in known:
        return (
            "touch",
            f"There are fewer than {parts} {known[0]}s: whole touches are kept together instead, and train and test share a {known[0]}.",
        )
    videos = table.filter(pl.col("material").is_not_null()).group_by("material").agg(pl.col(known[0]).n_unique().alias("n"))
    if not videos.height:
        return known[0], ""
    enough = videos.filter(pl.col("n") >= parts).height
    if 2 * enough >= videos.height or "touch" not in known:
        return known[0], "" if known[0] == "video" else "The manifest knows no videos: the object is kept whole."
    return "touch", (
        f"Only {enough} of {videos.height} materials occur in {parts} or more videos, too few for the video to be the group: whole touches are "
        "kept together instead. Train and test then share videos, so scores are optimistic for new places."
    )


def leak_free_split(manifest: Manifest, *, train: float = 0.8, val: float = 0.0, group: str = "auto", seed: int = 0) -> SplitPlan:
    """A split in which no group stands in two parts, stratified by material.

    Args:
        manifest: the samples; materials may be null (then only the sizes are balanced).
        train: wanted share of the train part, in (0, 1).
        val: wanted share of the validation part, in [0, 1); test gets the rest.
        group: column kept whole, or ``auto`` (:func:`choose_group`).
        seed: another seed gives another split of about the same quality.

    Raises:
        PalpateError: on shares out of range, an unknown group, nulls in the group column, or fewer groups than parts.
    """
    shares = {"train": train, "val": val, "test": 1.0 - train - val}
    if not (0 < train < 1 and 0 <= val < 1 and shares["test"] > 1e-9):
        raise PalpateError(
            "The shares of train and val must be positive and leave room for test",
            f"train {train}, val {val}",
            "Pass e.g. --train 0.8 --val 0.0",
        )
    wanted = {part: share for part, share in shares.items() if share > 1e-9}
    if not len(manifest):
        raise PalpateError("A split needs samples", "an empty manifest", "Import the data again")
    column, reason = choose_group(manifest, len(wanted)) if group == "auto" else (group, "")
    if column not in GROUPS:
        raise PalpateError(f"The group must be auto or one of {', '.join(GROUPS)}", repr(column), "Pass e.g. --group video")
    if nulls := manifest.table[column].null_count():
        raise PalpateError(
            f"Every sample needs a {column} to be split by it", f"{nulls} samples without", "Fill the column, or choose another --group"
        )
    names, counts, materials = _count(manifest, column)
    if len(names) < len(wanted):
        raise PalpateError(
            f"A split into {len(wanted)} parts needs at least as many groups",
            f"{len(names)} {column} group(s)",
            "Choose a finer --group, e.g. touch",
        )
    target = np.array(list(wanted.values()))
    assignment = _assign(counts, target, seed)
    order = [p for p in PARTS if p in wanted]
    where = {name: order[a] for name, a in zip(names, assignment, strict=True)}
    parts = {i: where[g] for i, g in zip(manifest.ids, manifest.column(column), strict=True)}
    problem = _Problem(counts, target)
    rule: dict[str, Any] = {
        "name": "NoLeak", "method": "group, stratified by material", "version": RULE_VERSION, "group": column, "asked": group, "reason": reason,
        "shares": wanted, "seed": seed,
    }  # fmt: skip
    rare = [m for m, n in zip(materials, (counts[:, :-1] > 0).sum(0), strict=True) if n < len(wanted)]
    return SplitPlan(Split(parts, rule, manifest.digest), column, reason, problem.worst_deviation(assignment), rare)


def _count(manifest: Manifest, column: str) -> tuple[list[str], np.ndarray, list[str]]:
    """Groups, samples of each (group, material) with a last column for the whole group, and the materials."""
    table = manifest.table
    names = sorted(table[column].unique().to_list())
    materials = sorted(table["material"].drop_nulls().unique().to_list())
    row, col = {g: k for k, g in enumerate(names)}, {m: k for k, m in enumerate(materials)}
    counts = np.zeros((len(names), len(materials) + 1), np.int64)
    for g, m, n in table.group_by(column, "material").len().iter_rows():
        if m is not None:
            counts[row[g], col[m]] += n
        counts[row[g], -1] += n
    return names, counts, materials


class _Problem:
    """Cost of an assignment. ``counts`` (G, M + 1), ``target`` (P,): wanted shares."""

    def __init__(self, counts: np.ndarray, target: np.ndarray) -> None:
        self.counts, self.target = counts, target
        self.share = counts / np.maximum(counts.sum(0), 1)  # of each material, in each group
        self.possible = (counts > 0).sum(0) >= len(target)  # materials that can be in every part

    def sums(self, assignment: np.ndarray) -> np.ndarray:
        """Shares by part and material, (P, M + 1)."""
        out = np.zeros((len(self.target), self.counts.shape[1]))
        np.add.at(out, assignment, self.share)
        return out

    def cost(self, sums: np.ndarray) -> np.ndarray:
        """One number for ``sums`` (..., P, M + 1): missing materials weigh most, then the largest deviation, then the mean square."""
        off = np.abs(sums - self.target[:, None])
        missing = ((sums < 1e-12) & self.possible).sum((-2, -1))
        return 100.0 * missing + np.where(self.possible, off, 0).max((-2, -1)) + off[..., -1].max(-1) + 0.1 * np.square(off).mean((-2, -1))

    def worst_deviation(self, assignment: np.ndarray) -> float:
        """Largest deviation of a material's share, over materials that can be in every part (over the whole, if none can)."""
        off = np.abs(self.sums(assignment) - self.target[:, None])
        use = self.possible.copy()
        use[-1] = not self.possible[:-1].any()
        return float(off[:, use].max())


def _assign(counts: np.ndarray, target: np.ndarray, seed: int) -> np.ndarray:
    """Greedy construction and local search; deterministic in ``seed``."""
    problem, rng = _Problem(counts, target), rng_for(seed, "split")
    size = counts[:, -1] * np.exp(rng.normal(0, 0.3, len(counts)))
    assignment = np.full(len(counts), -1, np.int64)
    sums = np.zeros((len(target), counts.shape[1]))
    for g in np.argsort(-size, kind="stable"):
        # The part that is furthest behind in what this group brings.
        behind = ((target[:, None] - sums) * problem.share[g]).sum(1) / target
        assignment[g] = int(np.argmax(behind))
        sums[assignment[g]] += problem.share[g]
    for part in range(len(target)):  # no part may stay empty
        if not (assignment == part).any():
            crowded = np.flatnonzero(assignment == np.bincount(assignment, minlength=len(target)).argmax())
            assignment[crowded[np.argmin(counts[crowded, -1])]] = part
    return _polish(problem, assignment, rng)


def _polish(problem: _Problem, assignment: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Moves of one group and swaps of two, as long as one lowers the cost; a part is never emptied."""
    parts = len(problem.target)
    sums = problem.sums(assignment)
    cost = float(problem.cost(sums))
    improved = True
    while improved:
        improved = False
        for g in rng.permutation(len(assignment)):
            here = int(assignment[g])
            if (assignment == here).sum() == 1:
                continue
            for there in range(parts):
                if there != here and (new := float(problem.cost(trial := _moved(sums, problem.share[g], here, there)))) < cost - 1e-12:
                    assignment[g], sums, cost, here, improved = there, trial, new, there, True
        pairs = rng.integers(0, len(assignment), (SWAP_TRIES, 2))
        for g, h in pairs:
            a, b = int(assignment[g]), int(assignment[h])
            if a != b:
                trial = _moved(_moved(sums, problem.share[g], a, b), problem.share[h], b, a)
                if (new := float(problem.cost(trial))) < cost - 1e-12:
                    assignment[g], assignment[h], sums, cost, improved = b, a, trial, new, True
    return assignment


def _moved(sums: np.ndarray, share: np.ndarray, here: int, there: int) -> np.ndarray:
    out = sums.copy()
    out[here] -= share
    out[there] += share
    return out


def describe(plan: SplitPlan) -> Mapping[str, Any]:
    """The plan as JSON for terminals and reports."""
    return {
        "digest": plan.split.digest, "group": plan.group, "reason": plan.reason, "counts": plan.split.counts(),
        "largest_material_deviation": round(plan.deviation, 5), "materials_in_too_few_groups": plan.rare,
    }  # fmt: skip
