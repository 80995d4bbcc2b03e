"""Groups to parts: the mixed-integer program of a split, solved by HiGHS.

With s_gm the share of material m that group g holds, r_p the wanted share of part p, and x_gp in
{0, 1} whether group g goes to part p, the deviations are

    d_mp = | sum_g s_gm x_gp - r_p |        sum_p x_gp = 1

over all samples and over the materials that occur in at least as many groups as there are parts.
Each of those materials has to be in every part: ``sum_{g: n_gm > 0} x_gp + u_pm >= 1``, where the
slack u_pm is so expensive that as few as possible are used.

*Optimum*: minimize ``max d_mp``. Deviations below ``RESOLUTION`` count as equal.
*Draw*: among the assignments that reach the optimum, minimize the mean deviation plus a seeded
random cost, so that every seed gives another split of the same quality.

Above ``WHOLE`` variables the program is solved without the integer constraints first. Nearly all
groups are whole in that solution; they stay where they are, and HiGHS assigns the others. Then it
assigns some groups of the worst materials anew, a few times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from palpate.core import rng_for

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Deviations below this share count as equal: 0.1 % of a material.
RESOLUTION = 0.001
#: HiGHS meets its constraints to 1e-6, so a smaller difference is none.
EXACT = 2e-6
#: Groups x parts up to which the whole program is solved; above it, how often and how many groups
#: are assigned anew (of the worst materials, and any).
WHOLE, ROUNDS, FREE = 1000, 12, (60, 40)
#: Branch-and-bound nodes for the optimum, and of a draw: this many divided by groups x parts.
NODES, DRAW_NODES = 600_000, 6000
#: Status of :func:`scipy.optimize.milp` for a program without a solution.
INFEASIBLE = 2
#: Groups x parts up to which an optimum is solved without presolve, which now and then cuts off the
#: optimum of a small program (in 2 of 691 drawn ones; without it in none) and takes no less time.
#: Of 193 drawn programs of 200 to 2,000 it cut off none, and proved more in less time.
SMALL = 100
#: How far from the best objective a draw may stop.
DRAW_GAP = 0.15
#: Weight of the random cost relative to the mean deviation; of a material that a part lacks.
RANDOM, MISSING = 0.1, 10.0
#: The optimum's objective is multiplied by this: with weights near 1 HiGHS 1.12 proves a wrong
#: optimum of a rare small program (tests/test_leakage_splits.py has one). A draw is checked against
#: the optimum and needs to be good, not best.
SCALE = 1000.0
#: Weight of a deviation above the limit, where the whole program is not solved.
ABOVE = 1000.0


class Problem:
    """Groups with their samples by material, and the wanted shares.

    Args:
        counts: (G, C) samples of each group by material; the last column counts all.
        target: (P,) wanted shares, summing to 1.

    Attributes:
        share: (G, C) ``counts`` over the column's sum.
        possible: (C,) whether a column occurs in at least P groups, so that it can be in every
            part.
        used: (C,) whether its deviation counts: the possible ones, and all samples.
    """

    def __init__(self, counts: Ints, target: Floats) -> None:
        self.counts, self.target = counts, target
        self.totals: Ints = counts.sum(0)
        self.share: Floats = counts / np.maximum(self.totals, 1)
        self.possible: NDArray[np.bool_] = (counts > 0).sum(0) >= len(target)
        self.used: NDArray[np.bool_] = self.possible.copy()
        self.used[-1] = True

    def parts(self, assignment: Ints) -> Ints:
        """(P, C) samples by part and column."""
        return np.stack([self.counts[assignment == p].sum(0) for p in range(len(self.target))])

    def deviations(self, assignment: Ints) -> Floats:
        """(P, C) ``d_mp`` by part and column, from whole numbers of samples; 0 where unused."""
        share = self.parts(assignment) / np.maximum(self.totals, 1)
        return np.abs(share - self.target[:, None]) * self.used

    def missing(self, assignment: Ints) -> NDArray[np.bool_]:
        """(P, C) columns that could be in a part but are not."""
        return (self.parts(assignment) == 0) & self.possible


@dataclass(frozen=True)
class Optimum:
    """The smallest largest deviation."""

    assignment: Ints  # (G,) part of each group
    deviation: float  # its largest deviation, recounted from whole samples
    bound: float  # no assignment that lacks as few materials has a smaller one


def optimize(problem: Problem) -> Optimum:
    """The assignment with the fewest missing materials, then the smallest largest deviation.

    Args:
        problem: at least as many groups as parts.
    """
    program = _Program(problem)
    objective = SCALE * program.objective(excess=1.0)
    assignment, value = program.solve(objective, (RESOLUTION, 1.0), NODES)
    if assignment is None:  # the node limit came first
        assignment = _greedy(problem)
    deviation = float(problem.deviations(assignment).max())
    bound = value / SCALE - MISSING * int(problem.missing(assignment).sum())
    if bound <= RESOLUTION + EXACT:  # the program looked no further down
        bound = 0.0
    return Optimum(assignment, deviation, min(bound, deviation))


def draw(problem: Problem, optimum: Optimum, seed: int) -> Ints:
    """The assignment of a seed, whose largest deviation is the optimum's."""
    limit = max(optimum.deviation, RESOLUTION)
    program = _Program(problem, limit)
    cost = rng_for(seed, "split").random((len(problem.counts), len(problem.target)))
    objective = program.objective(
        excess=ABOVE, mean=1.0, cost=RANDOM * cost * problem.share[:, -1:]
    )
    assignment, _ = program.solve(
        objective, (0.0, 0.0 if program.whole else 1.0), DRAW_NODES, DRAW_GAP, seed
    )
    if assignment is None or _rank(problem, assignment, limit) > _rank(
        problem, optimum.assignment, limit
    ):
        return optimum.assignment
    return assignment


def _rank(problem: Problem, assignment: Ints, limit: float) -> tuple[int, float]:
    """Missing materials, then the largest deviation where it is above the limit."""
    worst = float(problem.deviations(assignment).max())
    return int(problem.missing(assignment).sum()), worst if worst > limit + EXACT else 0.0


def _greedy(problem: Problem) -> Ints:
    """Largest groups first, each to the part that lacks most samples."""
    assignment = np.zeros(len(problem.counts), np.int64)
    lacking = problem.target.copy()
    for group in np.argsort(-problem.counts[:, -1], kind="stable"):
        assignment[group] = lacking.argmax()
        lacking[assignment[group]] -= problem.share[group, -1]
    return assignment


class _Program:
    """Variables x (group by group), d, the excess of the largest d over ``limit``, u.

    Without a limit there is no d: the excess is the largest deviation itself. (HiGHS 1.12 proves
    wrong optima of small programs in which d takes part in the minimum.)
    """

    def __init__(self, problem: Problem, limit: float | None = None) -> None:
        self.problem, self.limit = problem, limit or 0.0
        groups, parts = len(problem.counts), len(problem.target)
        eye = scipy.sparse.identity(parts)
        shares: Any = scipy.sparse.kron(problem.share[:, problem.used].T, eye)
        presence: Any = scipy.sparse.kron(
            (problem.counts > 0)[:, problem.possible].T.astype(float), eye
        )
        wanted = np.tile(problem.target, int(problem.used.sum()))
        count = len(wanted)
        self.x, self.d, self.u = groups * parts, 0 if limit is None else count, presence.shape[0]
        self.whole = self.x <= WHOLE
        once = scipy.sparse.kron(scipy.sparse.identity(groups), np.ones((1, parts)))
        d, excess = scipy.sparse.identity(count), np.ones((count, 1))
        rows: list[list[Any]] = [
            [once, None, None, None],
            [shares, -d, None, None],
            [shares, d, None, None],
            [None, d, -excess, None],
            [presence, None, None, scipy.sparse.identity(self.u)],
        ]
        if limit is None:
            rows[1:4] = [[shares, -excess, None], [shares, excess, None]]
            rows[0], rows[-1] = [once, None, None], [presence, None, scipy.sparse.identity(self.u)]
        least, most = np.full(count, -np.inf), np.full(count, np.inf)
        caps = [] if limit is None else [(least, np.full(count, limit))]
        one = (np.ones(groups), np.ones(groups))
        present = (np.ones(self.u), np.full(self.u, np.inf))
        limits = [one, (least, wanted), (wanted, most), *caps, present]
        low: Any = np.concatenate([low for low, _ in limits])
        high: Any = np.concatenate([high for _, high in limits])
        matrix: Any = scipy.sparse.block_array(rows, format="csr")
        self.constraints = scipy.optimize.LinearConstraint(matrix, low, high)

    def objective(self, *, excess: float, mean: float = 0.0, cost: Floats | float = 0.0) -> Floats:
        """Weights of the excess, of the mean deviation, and of each x."""
        x = np.broadcast_to(cost, (len(self.problem.counts), len(self.problem.target))).ravel()
        return np.concatenate(
            [x, np.full(self.d, mean / max(self.d, 1)), [excess], np.full(self.u, MISSING)]
        )

    def solve(
        self,
        objective: Floats,
        excess: tuple[float, float],
        nodes: int,
        gap: float = 0.0,
        seed: int = 0,
    ) -> tuple[Ints | None, float]:
        """Minimize the objective, with the excess in a range.

        ``nodes`` of branch and bound are divided by groups x parts; ``gap`` is the relative one at
        which to stop; the seed draws groups to assign anew where the whole program is not solved.

        Returns:
            The part of each group, None if no assignment came within the limits, and a lower bound.
        """
        low, high = np.zeros(len(objective)), np.ones(len(objective))
        low[self.x + self.d], high[self.x + self.d] = excess
        parts = len(self.problem.target)
        nodes = max(10, nodes // self.x)
        if self.whole:
            x, bound = self._highs(objective, (low, high), nodes, gap)
            return None if x is None else x.reshape(-1, parts).argmax(1), bound
        rng = rng_for(seed, "split", "anew")
        relaxed, bound = self._highs(objective, (low, high))
        if relaxed is None:
            return None, bound
        fixed = relaxed.reshape(-1, parts) > 1 - EXACT
        fixed[rng.permutation(len(fixed))[: FREE[1]]] = False
        best: Ints | None = None
        for _ in range(ROUNDS):
            low[: self.x] = fixed.ravel()
            x, _ = self._highs(objective, (low, high), nodes)
            if x is None:
                break
            best = assignment = x.reshape(-1, parts).argmax(1)
            worst = self.problem.deviations(assignment).max(0)
            if worst.max() <= self.limit + excess[0] + EXACT:
                break
            hot = np.flatnonzero(self.problem.counts[:, worst >= worst.max() / 2].any(1))
            fixed = np.eye(parts, dtype=bool)[assignment]
            fixed[rng.permutation(hot)[: FREE[0]]] = False
            fixed[rng.permutation(len(fixed))[: FREE[1]]] = False
        return best, bound

    def _highs(
        self, objective: Floats, limits: tuple[Floats, Floats], nodes: int = 0, gap: float = 0.0
    ) -> tuple[Floats | None, float]:
        """The x of a solution, or None, and a lower bound; without nodes the x are not integral."""
        integrality = np.zeros(len(objective))
        integrality[: self.x] = nodes > 0
        options: dict[str, Any] = {"node_limit": nodes, "mip_rel_gap": gap} if nodes else {}
        result: Any = None
        small = gap == 0 and self.x <= SMALL
        for presolve in (not small, small):  # HiGHS ends some small programs in "Solve error"
            result = scipy.optimize.milp(
                objective,
                constraints=self.constraints,
                bounds=scipy.optimize.Bounds(*limits),  # pyright: ignore[reportArgumentType]
                integrality=integrality,
                options=options | {"presolve": presolve},
            )
            if result.x is not None or result.status == INFEASIBLE:
                break
        bound = result.mip_dual_bound if nodes else result.fun
        x = None if result.x is None else result.x[: self.x]
        return x, -np.inf if bound is None else float(bound)
