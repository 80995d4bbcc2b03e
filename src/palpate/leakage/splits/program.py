"""The mixed-integer program of a split, for HiGHS by :func:`scipy.optimize.milp`.

``x_gp`` in {0, 1} puts a *free* group g into part p; the others stay where they are and only count. With the notation of
:mod:`palpate.leakage.splits.polish`, ``b_pm`` the share of material m that the fixed groups bring to part p, and C the columns that occur in at least as
many groups as there are parts, and the whole:

    sum_p x_gp = 1,    | b_pm + sum_g s_gm x_gp - r_p | <= t    for m in C,
    sum_{g: n_gm > 0} x_gp + u_pm >= 1                          for m in C that the fixed groups do not bring to p already.

The slack ``u_pm`` in {0, 1} exists only if some presence constraints have to be given up. Variables are ordered x (group-major), t, u.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp

from palpate.leakage.splits.polish import Floats, Ints, Problem

#: HiGHS meets its constraints to 1e-6, so a smaller difference is none.
EXACT = 2e-6


@dataclass(frozen=True)
class Answer:
    """What HiGHS found: all groups' parts or None, a lower bound of the objective, and the nodes used."""

    assignment: Ints | None
    bound: float
    nodes: int


class Program:
    """The constraints of the module's text.

    Args:
        problem: groups and wanted shares.
        assignment: (G,) where the fixed groups stand; None if all are free.
        free: (F,) numbers of the free groups; None for all.
        missing: presence constraints that may be given up: 0 for none, None for any number.
    """

    def __init__(
        self,
        problem: Problem,
        assignment: Ints | None = None,
        free: Ints | None = None,
        missing: int | None = 0,
    ) -> None:
        self.problem = problem
        groups, parts = len(problem.counts), len(problem.target)
        self.free: Ints = np.arange(groups) if free is None else free
        self.assignment: Ints = np.full(groups, -1, np.int64) if assignment is None else assignment
        fixed = np.ones(groups, bool)
        fixed[self.free] = False
        self.binaries = len(self.free) * parts
        self.t = self.binaries
        base, there = (
            np.zeros((parts, problem.counts.shape[1])),
            np.zeros((parts, problem.counts.shape[1]), np.int64),
        )
        np.add.at(base, self.assignment[fixed], problem.share[fixed])
        np.add.at(there, self.assignment[fixed], problem.has[fixed])

        eye, used = sparse.identity(parts, format="csr"), problem.used
        shares = sparse.kron(sparse.csr_matrix(problem.share[np.ix_(self.free, used)].T), eye)
        minus = sparse.csr_matrix(-np.ones((int(used.sum()) * parts, 1)))
        wanted: Any = (problem.target[:, None] - base[:, used]).T.ravel()
        every: Any = sparse.kron(
            sparse.csr_matrix(problem.has[np.ix_(self.free, problem.possible)].T.astype(float)), eye
        )
        presence: Any = sparse.csr_matrix(every)[
            np.flatnonzero((there[:, problem.possible] == 0).T.ravel())
        ]
        self.slacks = 0 if missing == 0 else presence.shape[0]
        self.size = self.binaries + 1 + self.slacks
        one = sparse.kron(sparse.identity(len(self.free)), np.ones((1, parts)))
        self.constraints = [
            LinearConstraint(self._wide(one), 1, 1),
            LinearConstraint(self._wide(shares, minus), -np.inf, wanted),
            LinearConstraint(self._wide(shares, -minus), wanted, np.inf),
        ]
        if presence.shape[0]:
            slack = sparse.identity(presence.shape[0]) if self.slacks else None
            self.constraints.append(LinearConstraint(self._wide(presence, None, slack), 1, np.inf))
        if self.slacks and missing is not None:
            row = np.append(np.zeros(self.binaries + 1), np.ones(self.slacks))
            self.constraints.append(LinearConstraint(row[None], -np.inf, missing))

    def _wide(self, x: Any, t: Any = None, slack: Any = None) -> Any:
        """Rows over all variables from their three blocks; None is zero."""
        rows = x.shape[0]
        blocks = [x, sparse.csr_matrix((rows, 1)) if t is None else t]
        if self.slacks:
            blocks.append(sparse.csr_matrix((rows, self.slacks)) if slack is None else slack)
        return sparse.hstack(blocks).tocsr()

    def smallest(self, low: float, high: float, nodes: int, *, symmetric: bool = False) -> Answer:
        """Minimizes t within [low, high]; ``symmetric`` breaks the symmetry of parts of equal share (all groups free only)."""
        objective = np.zeros(self.size)
        objective[self.t] = 1
        most = self._ones(high)
        if symmetric:
            most[self._without_loss()] = 0
        return self._solve(objective, low, most, nodes)

    def nearest(self, start: Ints, cost: Floats, high: float, nodes: int, within: float) -> Answer:
        """Moves groups away from ``start`` at the least cost (G,) such that t <= ``high``; stops ``within`` a relative gap of the least."""
        objective = np.zeros(self.size)
        objective[: self.binaries] = np.repeat(
            cost[self.free] / cost[self.free].sum(), len(self.problem.target)
        )
        objective[np.arange(len(self.free)) * len(self.problem.target) + start[self.free]] = 0
        return self._solve(objective, 0.0, self._ones(high), nodes, within)

    def fewest_missing(self, nodes: int) -> Answer:
        """Gives up as few presence constraints as possible."""
        objective = np.zeros(self.size)
        objective[self.t + 1 :] = 1
        return self._solve(objective, 0.0, self._ones(1.0), nodes)

    def _ones(self, t: float) -> Floats:
        """Upper bounds: 1, and ``t`` for t."""
        most = np.ones(self.size)
        most[self.t] = t
        return most

    def _without_loss(self) -> Ints:
        """Variables that may be 0: number the parts of equal share by the order in which large groups first use them."""
        parts = len(self.problem.target)
        order = np.argsort(-self.problem.counts[:, -1], kind="stable")
        zero: list[int] = []
        for share in np.unique(self.problem.target):
            same = np.flatnonzero(self.problem.target == share)
            for k, g in enumerate(order[: len(same) - 1]):
                zero += [int(g) * parts + int(p) for p in same[k + 1 :]]
        return np.array(zero, np.int64)

    def _solve(
        self, objective: Floats, low: float, most: Floats, nodes: int, within: float = 0.0
    ) -> Answer:
        least: Any = np.zeros(self.size)
        bounds: Any = most
        integral = np.ones(self.size)
        least[self.t], integral[self.t] = low, 0
        result = milp(
            objective,
            constraints=self.constraints,
            bounds=Bounds(least, bounds),
            integrality=integral,
            options={"node_limit": nodes, "mip_rel_gap": within},
        )
        assignment = None
        if result.x is not None:
            assignment = self.assignment.copy()
            assignment[self.free] = result.x[: self.binaries].reshape(len(self.free), -1).argmax(1)
        bound = -np.inf if result.mip_dual_bound is None else float(result.mip_dual_bound)
        return Answer(assignment, bound, int(result.mip_node_count or 0))
