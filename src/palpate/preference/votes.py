"""Votes: read from what raters downloaded and from the server's file, and checked.

A download is ``{"format", "study", "rater", "viewport", "votes": [...], "digest"}``; its digest is
that of all else. Of several votes of one rater on one trial the last undone counts, then the later.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core import Note, PalpateError, digest_json, read_record, require
from palpate.preference.plan import PLAN, SAME, Plan, Trial
from palpate.preference.store import VoteStore, require_study

FORMAT = "palpate/preference-votes@1"
#: The server's file in the folder of a study.
DATABASE = "study.db"
AGAIN = "Let the rater download the votes again"
#: What a vote holds is below these.
LONGEST_MS, MOST_UNDONE = 2**31, 1000


@dataclass(frozen=True)
class Vote:
    """One answer.

    Attributes:
        rater: code.
        trial: the trial of the plan.
        swapped: whether its sides were swapped.
        choice: ``left``, ``right``, ``same`` as shown; in the task ``sort`` a material.
        ms: time from the first sight in milliseconds.
        at: when, by the rater's clock.
        undone: how often the rater took an answer to this trial back.
    """

    rater: str
    trial: Trial
    swapped: bool
    choice: str
    ms: int
    at: datetime.datetime
    undone: int

    @property
    def chosen(self) -> str:
        """The chosen slot: a method, ``copy``, ``gel``, a material, or ``same``."""
        if not self.trial.right or self.choice == SAME:
            return self.choice
        return self.trial.sides(self.swapped)[self.choice == "right"]


@dataclass(frozen=True)
class Votes:
    """Rater -> id of a trial -> vote, and what was skipped."""

    by_rater: Mapping[str, Mapping[str, Vote]]
    notes: list[Note] = field(default_factory=list)


def read_votes(plan: Plan, paths: Iterable[str | Path]) -> Votes:
    """Read votes of a study.

    Args:
        plan: the study.
        paths: downloads, folders of them (every ``.json`` but the plan), or the server's file.

    Raises:
        PalpateError: if a file is incomplete, edited, or of another study, or all votes are late.
    """
    files = _files(paths)
    downloaded = [v for path in files if path.suffix != ".db" for v in _of_download(plan, path)]
    last = datetime.date.fromisoformat(plan.until) if plan.until else None
    # By the clocks of raters, with a day for time zones; the server refused late votes by its own.
    in_time = [v for v in downloaded if last is None or (v.at.date() - last).days <= 1]
    late = len(downloaded) - len(in_time)
    running = 0
    for path in files:
        if path.suffix == ".db":
            with closing(VoteStore(path, plan.study, "ro")) as store:
                running += not store.ended()
                for rater in store.voters():
                    in_time += _checked(plan, rater, store.votes(rater), path)
    got = f"{late:,} after {plan.until}, the last day, by the clocks of the raters"
    fix = "Pass votes that were given in time"
    require(bool(in_time) or not late, None, "There must be votes to score", got, fix=fix)
    kept: dict[str, dict[str, Vote]] = {}
    twice = differing = 0
    for vote in sorted(in_time, key=lambda v: (v.undone, v.at)):
        earlier = kept.setdefault(vote.rater, {}).get(vote.trial.id)
        twice += earlier == vote
        differing += earlier not in (None, vote) and earlier.undone == vote.undone  # type: ignore[union-attr]
        kept[vote.rater][vote.trial.id] = vote
    facts = {"votes-twice": twice, "votes-differ": differing, "votes-late": late}
    notes = [Note(code, {"count": n}) for code, n in facts.items() if n]
    so_far = Note("votes-so-far", {"count": sum(map(len, kept.values()))})
    return Votes(kept, [*notes, *[so_far] * (running > 0)])


def _files(paths: Iterable[str | Path]) -> list[Path]:
    files: list[Path] = []
    for path in map(Path, paths):
        inside = sorted(p for p in path.glob("*.json") if p.name != PLAN) if path.is_dir() else []
        files += inside or [path]
    return files


def _of_download(plan: Plan, path: Path) -> list[Vote]:
    try:
        record = read_record(path, "votes file", form=FORMAT, keys=("study", "rater", "votes"))
    except PalpateError as error:
        raise PalpateError(error.must, error.got, AGAIN) from None
    rest = {name: value for name, value in record.items() if name != "digest"}
    require_study(path, plan.study, record["study"])
    must, got = f"The digest in {path} must match its votes", "edited votes, or a part of them"
    require(record.get("digest") == digest_json(rest), None, must, got, fix=AGAIN)
    rows = record["votes"] if isinstance(record["votes"], list) else [None]
    return _checked(plan, record["rater"], rows, path)


def _checked(plan: Plan, rater: str, rows: Sequence[Any], path: Path) -> list[Vote]:
    """Rows as votes of trials of the plan.

    Raises:
        PalpateError: for another rater, or naming the first that is none.
    """
    codes = [rater.code for rater in plan.raters]
    must = f"A rater of study {plan.study} must be one of {codes[0]} to {codes[-1]}"
    require(rater in codes, None, must, repr(rater), fix="Check the code")
    trials, votes = plan.shown(rater), list[Vote]()
    for row in rows:
        try:
            trial, swapped = trials[row["trial"]]
            at = datetime.datetime.fromisoformat(row["at"])
            at = at if at.tzinfo else at.replace(tzinfo=datetime.UTC)
            ms, undone = int(row["ms"]), int(row["undone"])
            in_range = 0 <= ms < LONGEST_MS and 0 <= undone < MOST_UNDONE
            if row["choice"] not in plan.choices or not in_range:
                raise ValueError
        except (KeyError, TypeError, ValueError):
            must = f"Every vote of {rater} in {path} must answer a trial of this rater"
            raise PalpateError(must, repr(row), AGAIN) from None
        votes.append(Vote(rater, trial, swapped, row["choice"], ms, at, undone))
    return votes
