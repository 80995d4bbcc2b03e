"""The heuristic for assigning groups to parts: a seeded greedy start, then moves and swaps until none helps.

With s_gm the share of material m that group g holds, r_p the wanted share of part p and
``e_pm = sum_{g in p} s_gm - r_p``, a state costs

    C_q = 1000 * |{(p, m): m could be in p but is not}| + sum_{p, m} w_m |e_pm|^q .

q = 2 spreads deviations evenly; q = 8 stands in for the largest one, which a search by ``max`` alone cannot follow because
most single moves leave it unchanged. ``w_m`` is 1, or 0.01 for a material in fewer groups than parts. Each step draws a batch of moves
(one group to another part) or of swaps (two groups exchange parts) and takes the best that lowers the cost. The search ends when
a whole pass over the groups and ``SWAP_BATCHES`` of swaps find nothing. Sums run over materials first and use no transcendental functions,
so that every machine takes the same path.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BATCH = 256
SWAP_BATCHES = 12
#: Passes after which a search ends even though it still improves; hundreds of times what was ever needed.
PASSES = 400
RARE_WEIGHT = 0.01
MISSING_COST = 1000.0
#: A change must lower the cost by this fraction, far above rounding, so that the search ends.
LEAST_GAIN = 1e-9


class Problem:
    """Groups with what they hold, and the shares that are wanted.

    Args:
        counts: (G, C) samples of each group in each column: the materials, then the whole.
        target: (P,) wanted shares, summing to 1.

    Attributes:
        share: (G, C) ``counts`` over the column's sum.
        possible: (C,) whether a column occurs in at least P groups, so that it can be in every part.
        used: (C,) whether its deviation counts: the possible ones, and the whole.
    """

    def __init__(self, counts: Ints, target: Floats) -> None:
        self.counts, self.target = counts, target
        self.totals: Ints = counts.sum(0)
        self.share: Floats = counts / np.maximum(self.totals, 1)
        self.has = counts > 0
        self.possible: NDArray[np.bool_] = self.has.sum(0) >= len(target)
        self.used: NDArray[np.bool_] = self.possible.copy()
        self.used[-1] = True
        self.weight: Floats = np.where(self.possible, 1.0, RARE_WEIGHT)

    def parts(self, assignment: Ints) -> Ints:
        """Samples by part and column, (P, C)."""
        out = np.zeros((len(self.target), self.counts.shape[1]), np.int64)
        np.add.at(out, assignment, self.counts)
        return out

    def present(self, assignment: Ints) -> Ints:
        """Groups by part and column, (P, C)."""
        out = np.zeros((len(self.target), self.counts.shape[1]), np.int64)
        np.add.at(out, assignment, self.has)
        return out

    def deviations(self, assignment: Ints) -> Floats:
        """``|e_pm|`` by part and column, (P, C), from whole numbers of samples."""
        return np.abs(self.parts(assignment) / np.maximum(self.totals, 1) - self.target[:, None])

    def worst(self, assignment: Ints) -> float:
        """Largest deviation over the columns that count."""
        return float(self.deviations(assignment)[:, self.used].max())

    def missing(self, assignment: Ints) -> int:
        """Pairs of a part and a column that could be in it but is not."""
        return int(((self.present(assignment) == 0) & self.possible).sum())


def greedy(problem: Problem, rng: np.random.Generator) -> Ints:
    """Groups by jittered size, largest first, each to the part that is furthest behind in what the group brings."""
    size = problem.counts[:, -1] * (0.6 + 0.8 * rng.random(len(problem.counts)))
    parts = len(problem.target)
    assignment = np.full(len(size), -1, np.int64)
    behind = np.repeat(problem.target[:, None], problem.counts.shape[1], 1)
    scale = problem.target[:, None]
    for g in np.argsort(-size, kind="stable"):
        part = int(np.argmax((behind / scale * problem.share[g]).sum(1)))
        assignment[g] = part
        behind[part] -= problem.share[g]
    for part in range(parts):  # no part may stay empty
        if not (assignment == part).any():
            crowded = np.flatnonzero(
                assignment == np.bincount(assignment, minlength=parts).argmax()
            )
            assignment[crowded[np.argmin(problem.counts[crowded, -1])]] = part
    return assignment


class Search:
    """Local search from one assignment; see the module. ``limit`` bounds the largest deviation of every state it goes to."""

    def __init__(
        self, problem: Problem, assignment: Ints, power: int, limit: float = np.inf
    ) -> None:
        self.problem, self.power, self.limit = problem, power, limit
        self.assignment = assignment.copy()
        self.sums = problem.parts(assignment).T.copy()  # (C, P)
        self.groups = problem.present(assignment).T.copy()
        self.rows, self.gone, self.high = self._rows(
            self.sums, self.groups, np.arange(len(problem.target))
        )

    def _rows(self, sums: Ints, groups: Ints, parts: Ints) -> tuple[Floats, Ints, Floats]:
        """Cost without missing columns, their number, and largest deviation of parts: ``sums``, ``groups`` (C, ...), ``parts`` (...) their numbers."""
        shape = (-1,) + (1,) * (sums.ndim - 1)
        problem = self.problem
        off = np.abs(sums / np.maximum(problem.totals, 1).reshape(shape) - problem.target[parts])
        square = off * off
        high = np.where(problem.possible.reshape(shape), off, 0).max(0)
        cost = square if self.power == 2 else (square * square) * (square * square)
        gone = ((groups == 0) & problem.possible.reshape(shape)).sum(0)
        return (cost * problem.weight.reshape(shape)).sum(0), gone, high

    def _apply(self, g: int, there: int) -> None:
        here = int(self.assignment[g])
        for part, sign in ((here, -1), (there, 1)):
            self.sums[:, part] += sign * self.problem.counts[g]
            self.groups[:, part] += sign * self.problem.has[g]
        self.assignment[g] = there
        both = np.array([here, there])
        self.rows[both], self.gone[both], self.high[both] = self._rows(
            self.sums[:, both], self.groups[:, both], both
        )

    def _change(self, cost: Floats, gone: Ints, high: Floats) -> Floats:
        """The change of C_q, infinite where it is not allowed or too small to be more than rounding."""
        change = cost + MISSING_COST * gone
        helps = (high <= max(self.limit, float(self.high.max()))) & (
            change < -LEAST_GAIN * float(self.rows.sum())
        )
        return np.where(helps, change, np.inf)

    def move(self, batch: Ints) -> bool:
        """The best move of one of these groups to another part, if it helps."""
        here, every = self.assignment[batch], np.arange(len(self.problem.target))
        counts, has = self.problem.counts[batch].T, self.problem.has[batch].T.astype(np.int64)
        left, left_gone, left_high = self._rows(
            self.sums[:, here] - counts, self.groups[:, here] - has, here
        )
        sums, groups = (
            self.sums[:, None, :] + counts[:, :, None],
            self.groups[:, None, :] + has[:, :, None],
        )
        new, new_gone, new_high = self._rows(
            sums, groups, np.broadcast_to(every, (len(batch), len(every)))
        )
        change = self._change(
            (left - self.rows[here])[:, None] + (new - self.rows),
            (left_gone - self.gone[here])[:, None] + (new_gone - self.gone),
            np.maximum(left_high[:, None], new_high),
        )
        change[np.arange(len(batch)), here] = np.inf
        g, there = divmod(int(np.argmin(change)), len(every))
        if change[g, there] == np.inf:
            return False
        self._apply(int(batch[g]), there)
        return True

    def swap(self, first: Ints, second: Ints) -> bool:
        """The best exchange of parts among these pairs, if it helps."""
        a, b = self.assignment[first], self.assignment[second]
        use = a != b
        if not use.any():
            return False
        first, second, a, b = first[use], second[use], a[use], b[use]
        counts = (self.problem.counts[second] - self.problem.counts[first]).T
        has = (self.problem.has[second].astype(np.int64) - self.problem.has[first]).T
        cost_a, gone_a, high_a = self._rows(self.sums[:, a] + counts, self.groups[:, a] + has, a)
        cost_b, gone_b, high_b = self._rows(self.sums[:, b] - counts, self.groups[:, b] - has, b)
        change = self._change(
            (cost_a - self.rows[a]) + (cost_b - self.rows[b]),
            (gone_a - self.gone[a]) + (gone_b - self.gone[b]),
            np.maximum(high_a, high_b),
        )
        best = int(np.argmin(change))
        if change[best] == np.inf:
            return False
        self._apply(int(first[best]), int(b[best]))
        self._apply(int(second[best]), int(a[best]))
        return True

    def run(self, rng: np.random.Generator) -> Ints:
        """Searches until nothing helps; returns the assignment."""
        count = len(self.assignment)
        for _ in range(PASSES):
            improved = False
            order = rng.permutation(count)
            for start in range(0, count, BATCH):
                while self.move(order[start : start + BATCH]):
                    improved = True
            for _ in range(SWAP_BATCHES):
                pairs = rng.integers(0, count, (2, 2 * BATCH))
                while self.swap(pairs[0], pairs[1]):
                    improved = True
            if not improved:
                break
        return self.assignment


def start(problem: Problem, rng: np.random.Generator) -> Ints:
    """A greedy start, spread evenly (q = 2), then with its largest deviation pressed down (q = 8)."""
    even = Search(problem, greedy(problem, rng), 2).run(rng)
    return Search(problem, even, 8).run(rng)
