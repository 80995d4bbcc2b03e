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
        kind = self.plan.task
        return list(dict.fromkeys((t.left, t.right) for t in self.plan.trials if t.kind == kind))

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """The comparisons as places in the methods."""
        at = {name: k for k, name in enumerate(self.plan.methods)}
        return [(at[a], at[b]) for a, b in self.columns]

    @property
    def slots(self) -> list[str]:
        """What can be chosen: the methods and ``SAME``; in the task ``sort`` the materials."""
        return [*self.plan.methods, SAME] if self.plan.task == "pair" else self.plan.choices

    @cached_property
    def codes(self) -> NDArray[np.intp]:
        """(R, C, N) the chosen slot as a number, -1 for none."""
        items, column, slot = (
            {name: k for k, name in enumerate(names)}
            for names in ((item.id for item in self.plan.items), self.columns, self.slots)
        )
        codes = np.full((len(self.raters), len(column), len(items)), -1)
        for r, rater in enumerate(self.raters):
            for vote in self.votes.by_rater[rater].values():
                trial = vote.trial
                if trial.kind == self.plan.task:
                    c = column[trial.left, trial.right]
                    codes[r, c, items[trial.item]] = slot[vote.chosen]
        return codes

    @cached_property
    def values(self) -> Array:
        """(R, C, N) votes as :mod:`palpate.preference.statistics` has them."""
        first, second = np.array(self.pairs).T[:, :, None]
        values = 1.0 * (self.codes == first) - (self.codes == second)
        return np.where(self.codes < 0, np.nan, values)

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
            few = len(self.raters) <= FEW_RATERS
            drawn = (
                "items resampled, for these raters alone" if few else "items and raters resampled"
            )
            return interval, drawn, ()
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
