"""The votes that count as arrays, with the replicates of their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from palpate.core import Note, Score, rng_for
from palpate.preference.plan import SAME, Plan
from palpate.preference.statistics import (
    FEW_RATERS,
    Array,
    Interval,
    Weights,
    davidson,
    outcome_counts,
    percentiles,
    unanimous_bound,
)
from palpate.preference.votes import Votes

#: Replicates of what is fitted or sorted in each, which takes longer.
FEWER = 300


@dataclass(frozen=True)
class VoteArrays:
    """Votes of some raters.

    Attributes:
        plan: the study.
        votes: of all raters.
        raters: codes of those that count.
        seed: of the replicates.
        replicates: how many.
    """

    plan: Plan
    votes: Votes
    raters: Sequence[str]
    seed: int
    replicates: int

    @cached_property
    def columns(self) -> list[tuple[str, str]]:
        """The comparisons; in the task ``sort`` the shown methods."""
        kinds = ("pair", "sort")
        return list(dict.fromkeys((t.left, t.right) for t in self.plan.trials if t.kind in kinds))

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """The comparisons as places in the methods."""
        at = {name: k for k, name in enumerate(self.plan.methods)}
        return [(at[a], at[b]) for a, b in self.columns]

    @cached_property
    def chosen(self) -> NDArray[np.object_]:
        """(R, C, N) the chosen slot, or None."""
        items = {item.id: k for k, item in enumerate(self.plan.items)}
        column = {pair: k for k, pair in enumerate(self.columns)}
        cells = np.full((len(self.raters), len(column), len(items)), None, dtype=object)
        for r, rater in enumerate(self.raters):
            for vote in self.votes.of[rater].values():
                if vote.trial.kind in ("pair", "sort"):
                    place = column[vote.trial.left, vote.trial.right], items[vote.trial.item]
                    cells[r, *place] = vote.chosen
        return cells

    @cached_property
    def codes(self) -> NDArray[np.intp]:
        """(R, C, N) the chosen slot as a number, -1 for none."""
        names = dict.fromkeys(name for name in self.chosen.ravel() if name is not None)
        codes = np.full(self.chosen.shape, -1)
        for k, name in enumerate(names):
            codes[self.chosen == name] = k
        return codes

    @cached_property
    def values(self) -> Array:
        """(R, C, N) votes as :mod:`palpate.preference.statistics` has them."""
        cells = np.full(self.chosen.shape, np.nan)
        for c, (a, b) in enumerate(self.columns):
            for name, value in ((a, 1.0), (SAME, 0.0), (b, -1.0)):
                cells[:, c][self.chosen[:, c] == name] = value
        return cells

    @cached_property
    def once(self) -> Weights:
        """Everything once."""
        return Weights.once(len(self.raters), len(self.plan.items))

    @cached_property
    def resampled(self) -> Weights:
        """The replicates."""
        rng = rng_for(self.seed, "preference", self.plan.study)
        return Weights.draw(len(self.raters), len(self.plan.items), rng, self.replicates)

    @cached_property
    def counts(self) -> Array:
        """(C, 3) wins, ties and losses."""
        return outcome_counts(self.values, self.once)[0]

    @cached_property
    def replicated(self) -> Array:
        """(B, C, 3) wins, ties and losses of every replicate."""
        return outcome_counts(self.values, self.resampled)

    @property
    def method(self) -> str:
        """How intervals are made, in words."""
        if len(self.raters) <= FEW_RATERS:
            return "items resampled, for these raters alone"
        return "items and raters resampled"

    @cached_property
    def strength(self) -> Array:
        """(methods + 1,) of :func:`davidson`."""
        return davidson(self.counts, self.pairs, len(self.plan.methods))

    @cached_property
    def strength_replicates(self) -> Array:
        """(FEWER, methods + 1)."""
        k, start = len(self.plan.methods), self.strength
        return np.array([davidson(c, self.pairs, k, start) for c in self.replicated[:FEWER]])

    def answered(self, *columns: int) -> int:
        """Items with a vote in one of some comparisons."""
        return int((self.codes[:, list(columns)] >= 0).any(axis=(0, 1)).sum())

    def interval(
        self, value: float, replicates: Array, items: int = 0
    ) -> tuple[Interval | None, str, Sequence[Note]]:
        """The interval of replicates, how it was made, and what to say.

        One item is no sample of items. Replicates of a share of more ``items`` that do not vary
        have a bound from their number.
        """
        if not np.isfinite(value):
            return None, "", ()
        if items == 1:
            return None, "", (Note("one-item"),)
        if interval := percentiles(replicates):
            return interval, self.method, ()
        if not items:
            return None, "", ()
        method = f"Clopper-Pearson, items as the sample, n = {items}"
        return unanimous_bound(value, items), method, (Note("votes-agree", {"items": items}),)

    def score(
        self,
        metric: str,
        subject: str,
        value: float,
        replicates: Array,
        n: float,
        *,
        items: int = 0,
    ) -> Score:
        """A score with its :meth:`interval`."""
        interval, method, notes = self.interval(value, replicates, items)
        return Score(
            metric,
            subject,
            float(value) if np.isfinite(value) else None,
            interval=interval,
            interval_method=method,
            n=int(n),
            seed=self.seed,
            higher_is_better=True,
            settings={"items": len(self.plan.items), "raters": len(self.raters)},
            notes=notes,
        )
