"""Scores by family: which metrics answer one question, and how they were made.

Scores of different settings raise instead of sharing a column. Scores of another family, preset,
split or reference, or on other features, are in tables of their own.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from palpate.core import Measure, Note, Score, plain, require_comparable, short
from palpate.core.score import BETTER
from palpate.report.labels import measured
from palpate.report.numbers import digits_of

#: Arrow for ``Score.higher_is_better``.
ARROWS: Mapping[bool | None, str] = {True: "↑", False: "↓", None: "→"}
#: Title, question, and words that are part of the names of metrics (lower case): the first family
#: whose words match takes a metric.
FAMILIES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "People",
        "Which images do people find closer to the real ones, ties as half a vote, and which "
        "materials do they recognize?",
        ("human ",),
    ),
    (
        "Agreement of metrics with people",
        "Kendall's tau-b: 1 orders images or methods as people do, 0 has nothing to do with it.",
        ("tau with people",),
    ),
    (
        "Tactile features",
        "Are generated and real images similar to a tactile encoder? I-, CI- and D-TMMD need no "
        "reference images.",
        ("tmmd",),
    ),
    (
        "Image distributions",
        "Are the sets of images similar to a general image encoder?",
        ("cmmd", "fid", "kid", "mmd", "precision", "recall ", "density", "coverage"),
    ),
    (
        "Image by image",
        "Does each generated image match its real image, pixel by pixel or patch by patch?",
        ("contact ", "ssim", "psnr", "lpips", "l1", "mse"),
    ),
    (
        "Captions",
        "Can they be used, and do they name what they should only describe? Those of a contact "
        "count once.",
        ("share of captions",),
    ),
    (
        "Material from captions",
        "How often is the material predicted from the text alone, on new videos? Text that only "
        "describes lies between the commonest material and 1.",
        ("from the text",),
    ),
    (
        "Recognition",
        "What can be read from the image, by a classifier trained on the train part?",
        ("acc", "probe", "@"),
    ),
    (
        "Retrieval",
        "Which text, photo or tactile image belongs to it? The share of samples for which a right "
        "one is among the k most similar, and the median of its rank.",
        ("top-", "median rank", "retriev"),
    ),
    ("Other metrics", "", ("",)),
)
#: Name of a baseline -> its key in the details of a score.
BASELINES = {"no contact": "empty", "chance": "chance", "majority": "majority"}
#: The ``a`` of scores of real images.
REAL = "real"
#: What a preset of the TMMD family means, for the head of its table.
PRESETS = {
    "paper": "the paper's formula to the letter, random halves",
    "paper-tables": "the reading that fits the paper's printed tables",
    "cmmd": "as CMMD's published code",
    "grouped": "whole groups, or both images of a scene, kept together",
}


@dataclass(frozen=True)
class Column:
    """The scores of one measure.

    Attributes:
        scores: of each generator, control ...
        compared: the generators of which there are differences; without any, all that is not of
            real images competes.
        winner: what is better than every other one by a decided paired difference, or None.
    """

    scores: Sequence[Score]
    compared: Collection[str] = ()
    winner: str | None = None

    @property
    def measure(self) -> Measure:
        """What is measured."""
        return self.scores[0].measure

    @property
    def name(self) -> str:
        """That in words."""
        return measured(self.scores[0])

    @property
    def label(self) -> str:
        """That without the features, which the title of its table has."""
        return measured(replace(self.scores[0], features=""))

    @property
    def arrow(self) -> str:
        """The better direction."""
        return ARROWS[self.scores[0].higher_is_better]

    @property
    def better(self) -> str:
        """The better direction in words."""
        return BETTER[self.scores[0].higher_is_better]

    @cached_property
    def digits(self) -> int:
        """Decimals of all its numbers."""
        return digits_of(self.scores)

    @property
    def size(self) -> str:
        """The sample sizes, if all of its scores share them."""
        sizes = {size_of(score) for score in self.scores}
        return sizes.pop() if len(sizes) == 1 else ""

    def best(self, controls: Collection[str] = ()) -> set[int]:
        """Return the places of the best scores by value, of those that compete."""
        free = [
            (s.a in self.compared if self.compared else s.a != REAL) and s.a not in controls
            for s in self.scores
        ]
        competing = [s if f else None for s, f in zip(self.scores, free, strict=True)]
        return best_by_value(competing, self.digits)

    @property
    def facts(self) -> list[tuple[str, str]]:
        """How its scores were made, by what."""
        first, each = self.scores[0], self.scores
        intervals = (interval_text(s) for s in each if s.interval is not None)
        facts = {
            "estimator": first.estimator,
            "bandwidth σ": "" if first.bandwidth is None else f"{first.bandwidth:g}",
            "scale": f"× {first.scale:g}" if first.scale != 1 else "",
            "interval": "; ".join(dict.fromkeys(intervals)),
            "seed": ", ".join(dict.fromkeys(str(s.seed) for s in each if s.seed is not None)),
            **{str(k).replace("_", " "): str(plain(v)) for k, v in first.settings.items()},
        }
        digests = {name: getattr(first, name) or "" for name in ("encoder", "reference", "split")}
        return [fact for fact in (*facts.items(), *digests.items()) if fact[1]]


@dataclass(frozen=True)
class Family:
    """Scores that share a table: its title, the question, the columns, paired differences."""

    title: str
    question: str
    columns: Sequence[Column]
    differences: Sequence[Score]

    @property
    def facts(self) -> list[tuple[str, str]]:
        """How the scores were made: what all columns share, then what is of one."""
        each = [column.facts for column in self.columns]
        shared = [fact for fact in each[0] if all(fact in own for own in each)] if each else []
        facts = [(f"{c.name}, size", c.size) for c in self.columns if c.size] + shared
        for column, own in zip(self.columns, each, strict=True):
            facts += [(f"{column.name}, {f}", text) for f, text in own if (f, text) not in shared]
        return facts


def defined(score: Score) -> bool:
    """Return whether a score has a value."""
    return score.value is not None


def size_of(score: Score) -> str:
    """Return ``"n = 240, m = 240"``."""
    sizes = {"n": score.n or None, "m": score.m}
    return ", ".join(f"{name} = {value:,}" for name, value in sizes.items() if value is not None)


def interval_text(score: Score) -> str:
    """Return what the interval of a score is: ``"95 %, jackknife, t, 9 df"``."""
    return ", ".join(filter(None, [f"{100 * score.level:g} %", score.interval_method]))


def baselines(score: Score) -> dict[str, float]:
    """Return what is scored without a look at the sample: chance, the commonest class ..."""
    values = {name: score.details.get(key) for name, key in BASELINES.items()}
    return {n: v for n, v in values.items() if isinstance(v, int | float) and math.isfinite(v)}


def family_of(score: Score) -> tuple[int, str]:
    """Return the place and the title of the family of a score's metric."""
    name = f"{score.metric.lower()} "
    return next(
        (k, title)
        for k, (title, _, words) in enumerate(FAMILIES)
        if any(word in name for word in words)
    )


def notes_of(score: Score) -> list[Note]:
    """Return what a reader must know of a score: its notes, and what follows from its fields."""
    notes = [*score.notes]
    if excluded := score.details.get("excluded"):
        notes.append(Note("excluded-classes", {"excluded": excluded}))
    if score.higher_is_better is None and score.details.get("gap") is not None:
        notes.append(Note("nearer-to-floor"))
    if "no contact" in baselines(score):
        notes.append(Note("no-contact-baseline"))
    lacks_floor = score.floor is None and score.b is None and defined(score)
    if lacks_floor and score.metric in ("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD"):
        code = "no-floor-of-tmmd" if score.metric == "TMMD" else "floor-unknown"
        notes += [] if any(note.code == "no-floor" for note in notes) else [Note(code)]
    return notes


def families(scores: Sequence[Score]) -> list[Family]:
    """Return all scores by family, in fixed order, metrics as they first appear.

    Raises:
        PalpateError: if two scores that share a column were not made with the same settings.
    """
    groups: dict[tuple[int, str, str, str, int], list[Score]] = {}
    for score, reference in zip(scores, _references(scores), strict=True):
        preset = str(score.settings.get("preset", ""))
        split = "" if score.settings.get("axis") == "split" else score.split or ""
        key = (family_of(score)[0], preset, split, score.features, reference)
        groups.setdefault(key, []).append(score)
    splits, references = (len({key[k] for key in groups} - {""}) > 1 for k in (2, 4))
    result: list[Family] = []
    for key, members in sorted(groups.items(), key=lambda item: item[0][0]):
        number, preset, split, features, _ = key
        title, question, _ = FAMILIES[number]
        parts = [title + (f" of {features}" if features else "")]
        parts += [f"{preset}: {PRESETS[preset]}" if preset in PRESETS else preset] * bool(preset)
        parts += [f"split {short(split)}"] if split and splits else []
        digests = dict.fromkeys(short(s.reference) for s in members if s.reference)
        parts += [f"reference {' and '.join(digests) or 'not recorded'}"] if references else []
        first = all(question != family.question for family in result)
        result.append(_family(", ".join(parts), question if first else "", members))
    return result


def _references(scores: Sequence[Score]) -> list[int]:
    """Return which reference each score was compared with: 0 for the first of its metric, 1 ...

    Different encoders make different features of the same images, so references are counted by
    measure. A score without one (I-, CI-, D-TMMD) goes with the last of its subject that has one,
    else with the first after it.
    """
    digests: dict[tuple[Measure, str | None], list[str]] = {}
    index: list[int | None] = []
    for score in scores:
        listed = digests.setdefault((score.measure, score.encoder), [])
        if score.reference is not None and score.reference not in listed:
            listed.append(score.reference)
        index.append(None if score.reference is None else listed.index(score.reference))
    rows = list(zip(((s.a, s.b) for s in scores), index, strict=True))
    last = {subject: k for subject, k in reversed(rows) if k is not None}
    result: list[int] = []
    for subject, k in rows:
        if k is not None:
            last[subject] = k
        result.append(last.get(subject, 0))
    return result


def columns(scores: Iterable[Score]) -> list[list[Score]]:
    """Return the scores of each measure and kind, in order of first appearance.

    Raises:
        PalpateError: if two scores of one column were not made with the same settings.
    """
    table: dict[tuple[Any, ...], list[Score]] = {}
    for score in scores:
        key = (score.measure, score.settings.get("pool"), score.kind, score.b is None)
        table.setdefault(key, []).append(score)
    for column in table.values():
        require_comparable(column)
    return [*table.values()]


def _family(title: str, question: str, scores: Sequence[Score]) -> Family:
    differences = [s for s in scores if s.b is not None]
    columns(differences)
    compared = dict.fromkeys(name for d in differences for name in (d.a, d.b or ""))
    heads = [
        Column(column, compared, best_of(column[0].measure, differences))
        for column in columns(s for s in scores if s.b is None)
    ]
    return Family(title, question, heads, [d for d in differences if defined(d)])


def best_of(measure: Measure, differences: Sequence[Score]) -> str | None:
    """Return what is better than every other one by a decided paired difference, or None.

    Subjects without a difference (controls) take no part.
    """
    wins: dict[str, bool] = {}
    for d in (d for d in differences if d.measure == measure):
        for name in (d.a, d.b or ""):
            won = bool(d.details.get("decided")) and d.details.get("better") == name
            wins[name] = wins.get(name, True) and won
    return next((name for name, won in wins.items() if won), None)


def best_by_value(column: Sequence[Score | None], digits: int) -> set[int]:
    """Return the places of the best scores, by the direction of the metric.

    They are compared as written with ``digits``, or with those of the narrowest interval if these
    are more. None where fewer than two compete. A score does not compete that is None, undefined,
    or a ratio whose denominators are not known (``unstable-denominators``); without a direction,
    also one without a floor.
    """
    competing = {
        k: score
        for k, score in enumerate(column)
        if score is not None
        and defined(score)
        and not (score.higher_is_better is None and score.floor is None)
        and all(note.code != "unstable-denominators" for note in score.notes)
    }
    directions = {score.higher_is_better for score in competing.values()}
    if len(competing) < 2 or len(directions) > 1:
        return set()
    digits = max(digits, digits_of(competing.values(), finest=True))
    worth: dict[int, float] = {}
    for k, score in competing.items():
        written = round(float(score), digits)
        distance = abs(written - round(score.floor or 0.0, digits))
        worth[k] = {True: -written, False: written, None: distance}[score.higher_is_better]
    least = min(worth.values()) + 0.5 * 10**-digits
    return {k for k, value in worth.items() if value < least}
