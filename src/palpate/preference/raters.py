"""What each rater did: finished, caught, consistent, biased; and who is excluded by which rule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from palpate.preference.plan import COPY, Plan
from palpate.preference.votes import Vote, Votes

#: Votes for a side that the rule of one side needs.
FEWEST_SIDES = 10


@dataclass(frozen=True)
class RaterFacts:
    """One rater.

    Attributes:
        code: of the plan.
        votes: answered trials.
        finished: their share.
        catches: share of answered catches that are right, or None.
        repeats: number of answered repeats; ``consistent`` of them had the same answer.
        left, right: votes for a side.
        seconds: median time of a vote.
        undone: votes that were taken back.
        excluded: name of the rule by which the votes do not count, or ''.
    """

    code: str
    votes: int
    finished: float
    catches: float | None
    repeats: int
    consistent: int
    left: int
    right: int
    seconds: float
    undone: int
    excluded: str = ""

    @property
    def side(self) -> float:
        """Share of the commoner side among the votes for a side; 0 without any."""
        return max(self.left, self.right) / max(1, self.left + self.right)


def rater_facts(plan: Plan, votes: Votes) -> list[RaterFacts]:
    """Facts of every rater with votes, in the order of the plan."""
    codes = (rater.code for rater in plan.raters)
    return [_facts(plan, code, votes.by_rater[code]) for code in codes if votes.by_rater.get(code)]


def _facts(plan: Plan, code: str, votes: Mapping[str, Vote]) -> RaterFacts:
    truth = {item.id: item.material for item in plan.examples}
    caught = [
        vote.chosen == (truth[vote.trial.item] if plan.task == "sort" else COPY)
        for vote in votes.values()
        if vote.trial.kind == "catch"
    ]
    again = [
        vote.chosen == votes[vote.trial.repeats].chosen
        for vote in votes.values()
        if vote.trial.repeats in votes
    ]
    sides = [v.choice for v in votes.values() if v.trial.right and v.trial.kind != "catch"]
    left, right = sides.count("left"), sides.count("right")
    facts = RaterFacts(
        code=code,
        votes=len(votes),
        finished=len(votes) / len(plan.trials),
        catches=float(np.mean(caught)) if caught else None,
        repeats=len(again),
        consistent=sum(again),
        left=left,
        right=right,
        seconds=float(np.median([vote.ms for vote in votes.values()])) / 1000,
        undone=sum(vote.undone for vote in votes.values()),
    )
    broken = {
        "finished": facts.finished < plan.rule.finished,
        "catches": facts.catches is not None and facts.catches < plan.rule.catches,
        "side": left + right >= FEWEST_SIDES and facts.side > plan.rule.side,
    }
    return replace(facts, excluded=next((name for name, fails in broken.items() if fails), ""))
