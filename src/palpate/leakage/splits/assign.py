"""Groups to parts: the smallest largest deviation that exists, and how far from it the answer may be.

*Phase 1* (:func:`optimize`) looks for the smallest t* such that every material that can be in every part, and the whole, deviates by at most
t* from its wanted share, all present in every part. Upper bounds come from local search (:mod:`palpate.leakage.splits.polish`) and from solving small
programs exactly (:mod:`palpate.leakage.splits.program`, ``FREE`` groups at a time, those that hold the worst materials among them), then from HiGHS on the
whole program; lower bounds from each column alone (the subset sums of its groups, or whole numbers of samples) and from HiGHS. Deviations
under ``RESOLUTION`` count as equal: nobody can tell them apart, and no solver can prove one the smallest. If not all
materials can be in every part at once, as few as possible are given up.

*Phase 2* (:func:`draw`) turns a seed into one of the assignments that reach t*, or t* + tolerance (``RESOLUTION`` more where t* is not proven and
no random start comes to it): a random start, changed by small programs until it does or, in small problems, as little as possible
(``min sum_g c_g [a(g) != start(g)]`` with seeded weights c_g in [0.5, 1.5)). Then moves and swaps that keep the bound lower the mean square deviation.

Limits are numbers of rounds and of branch-and-bound nodes, never seconds: a slow machine gives the same split. Above ``MILP_GROUPS``
groups the whole program is not tried; with so many groups the others reach deviations of some 1e-4, and the bound is that of each
column alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from palpate.core import rng_for
from palpate.leakage.splits.polish import Ints, Problem, Search, start
from palpate.leakage.splits.program import EXACT, Program

#: Deviations below this share count as equal: 0.1 % of a material.
RESOLUTION = 0.001
#: Above this many groups the whole program is not tried.
MILP_GROUPS = 4000
#: Nodes of one search: this many divided by groups x parts, within the range.
NODE_BUDGET, NODE_RANGE = 600_000, (20, 4000)
#: Random starts of phase 1.
STARTS = 8
#: Free groups of a small program: those that hold the worst materials, and others; its nodes; rounds in all, and without gain.
FREE, FREE_NODES, ROUNDS, STALE = (60, 40), 50, 150, 30
#: Random starts that phase 2 tries; above this many groups x parts it does not look for the nearest assignment by the whole program.
TRIES, NEAREST_SIZE = 3, 700
#: Columns of at most this many groups get the bound by subset sums.
SUBSET_GROUPS = 400


@dataclass(frozen=True)
class Optimum:
    """What phase 1 found.

    Attributes:
        assignment: (G,) part of each group.
        deviation: its largest deviation, recounted from whole samples.
        bound: no assignment that leaves out as few materials has a smaller one.
        missing: pairs of a part and a material that had to be given up.
        nodes: branch-and-bound nodes of the whole program.
        solver: ``HiGHS`` if the whole program was solved or tried, else ``search``.
    """

    assignment: Ints
    deviation: float
    bound: float
    missing: int
    nodes: int
    solver: str

    @property
    def aim(self) -> float:
        """The largest deviation that phase 2 wants: t*, or ``RESOLUTION`` if that is larger."""
        return max(self.deviation, RESOLUTION)

    @property
    def limit(self) -> float:
        """The one that it allows: ``RESOLUTION`` more if t* is not proven, where few assignments reach it."""
        return self.aim + (0 if self.deviation <= self.bound + EXACT else RESOLUTION)


def optimize(problem: Problem) -> Optimum:
    """Phase 1: the smallest largest deviation, with a lower bound.

    Args:
        problem: at least as many groups as parts.
    """
    best = min(
        (start(problem, rng_for(0, "split bound", k)) for k in range(STARTS)),
        key=lambda a: _rank(problem, a),
    )
    bound = max(column_bound(problem, int(m)) for m in np.flatnonzero(problem.used))
    floor, nodes = max(bound, RESOLUTION), 0
    whole = len(problem.counts) <= MILP_GROUPS
    if problem.missing(best) and whole:
        best, nodes = _fewest_missing(problem, best)
    best = repair(problem, best, floor, rng_for(0, "split bound repair"))
    found = Optimum(best, problem.worst(best), bound, problem.missing(best), nodes, "search")
    if not whole or (not found.missing and found.deviation <= floor + EXACT):
        return found
    program = Program(problem, missing=found.missing)
    answer = program.smallest(
        min(floor, found.deviation), found.deviation + EXACT, _nodes(problem), symmetric=True
    )
    found = replace(found, nodes=nodes + answer.nodes, solver="HiGHS")
    if answer.assignment is not None and _rank(problem, answer.assignment) < _rank(problem, best):
        best = repair(problem, answer.assignment, floor, rng_for(0, "split bound polish"))
        found = replace(found, assignment=best, deviation=problem.worst(best))
    if answer.bound > floor + EXACT:  # at the floor HiGHS proves nothing
        found = replace(found, bound=min(answer.bound, found.deviation))
    return found


def draw(problem: Problem, optimum: Optimum, seed: int, tolerance: float = 0.0) -> Ints:
    """Phase 2: the assignment of a seed, with a largest deviation of at most ``optimum.limit + tolerance``."""
    rng = rng_for(seed, "split")
    chosen, small = optimum.assignment, len(problem.counts) * len(problem.target) <= NEAREST_SIZE
    for limit in (optimum.aim + tolerance, *[optimum.limit + tolerance] * (TRIES - 1)):
        allowed = (optimum.missing, limit + EXACT)
        begin, cost = start(problem, rng), 0.5 + rng.random(len(problem.counts))
        near: Ints | None = repair(problem, begin, limit, rng)
        if small and _rank(problem, near) > allowed:
            near = (
                Program(problem, missing=optimum.missing)
                .nearest(begin, cost, limit, _nodes(problem), 0.1)
                .assignment
            )
        if near is not None and _rank(problem, near) <= allowed:
            chosen = near
            break
    return Search(problem, chosen, 2, max(optimum.aim + tolerance, problem.worst(chosen))).run(rng)


def repair(problem: Problem, assignment: Ints, floor: float, rng: np.random.Generator) -> Ints:
    """Presses the largest deviation down to ``floor`` if it can: small programs, each solved exactly, the other groups fixed.

    A problem of no more groups than a small program frees is left to the whole program.
    """
    groups, stale = len(problem.counts), 0
    if groups <= sum(FREE):
        return assignment
    for _ in range(ROUNDS):
        worst = problem.worst(assignment)
        if stale >= STALE or worst <= floor + EXACT:
            break
        high = problem.deviations(assignment).max(0) * problem.used
        hot = np.flatnonzero(problem.has[:, high >= worst * (0.4 + 0.6 * rng.random())].any(1))
        hot = rng.choice(hot, min(FREE[0], len(hot)), replace=False)
        free = np.union1d(hot, rng.choice(groups, min(FREE[1], groups), replace=False))
        program = Program(problem, assignment, free, problem.missing(assignment))
        answer = program.smallest(min(floor, worst), worst + EXACT, FREE_NODES).assignment
        stale += 1
        if answer is not None and _rank(problem, answer) < (
            problem.missing(assignment),
            worst - EXACT,
        ):
            assignment, stale = answer, 0
    return assignment


def column_bound(problem: Problem, column: int) -> float:
    """The largest over parts of the smallest deviation that this column's groups allow, each part by itself."""
    counts = problem.counts[:, column]
    counts, total = counts[counts > 0], int(problem.totals[column])
    if not total:
        return 0.0
    sums = 1  # bit k is set if some of the groups hold k samples together
    if len(counts) <= SUBSET_GROUPS:
        for n in counts.tolist():
            sums |= sums << n
    else:  # taken to reach every number
        sums = (1 << (total + 1)) - 1
    worst = 0.0
    for wanted in problem.target.tolist():
        at = int(wanted * total)
        below = (sums & ((1 << (at + 1)) - 1)).bit_length() - 1
        above = sums >> (at + 1)
        near = [below] if not above else [below, at + (above & -above).bit_length()]
        worst = max(worst, min(abs(n / total - wanted) for n in near))
    return worst


def _fewest_missing(problem: Problem, assignment: Ints) -> tuple[Ints, int]:
    """An assignment that leaves as few materials out of parts as possible, and the nodes used."""
    answer = Program(problem, missing=None).fewest_missing(_nodes(problem))
    if answer.assignment is None or problem.missing(answer.assignment) >= problem.missing(
        assignment
    ):
        return assignment, answer.nodes
    return Search(problem, answer.assignment, 8).run(rng_for(0, "split presence")), answer.nodes


def _rank(problem: Problem, assignment: Ints) -> tuple[int, float]:
    return problem.missing(assignment), problem.worst(assignment)


def _nodes(problem: Problem) -> int:
    return int(np.clip(NODE_BUDGET // (len(problem.counts) * len(problem.target)), *NODE_RANGE))
