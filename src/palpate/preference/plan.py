"""The plan of a study: what is compared, in which order every rater sees it, and the secret.

``plan.json`` holds everything and stays with the author. :meth:`Plan.public` is all that the page
and the server know: images, trials and answers under names that are HMACs of the secret, without a
method, an item or, where it is not the answer, a material.
"""

from __future__ import annotations

import datetime
import hmac
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from palpate.core import (
    Note,
    PalpateError,
    atomic_path,
    digest_json,
    plain,
    read_record,
    reading_entry,
    short,
)
from palpate.core.records import from_plain

FORMAT, PAGE_FORMAT = "palpate/preference@1", "palpate/preference-page@1"
#: Files in the folder of a study: the plan, the page.
PLAN, PAGE = "plan.json", "study.html"
#: Answers of a pair, in the order of the keys 1 2 3.
SAME = "same"
PAIR_CHOICES = ("left", "right", SAME)
#: Sides of a catch: the reference again, and the sensor without contact.
COPY, GEL = "copy", "gel"
#: Further slots of an item: the real image, and as an example of its material.
REFERENCE, EXAMPLE = "reference", "example"


@dataclass(frozen=True)
class Item:
    """A reference image: its id, and its material and video where they are known."""

    id: str
    material: str | None = None
    video: str | None = None


@dataclass(frozen=True)
class Trial:
    """One question.

    Attributes:
        id: name in the plan.
        kind: ``pair``; ``repeat`` of an earlier trial with its sides swapped; ``catch``, whose
            answer is known; ``sort``.
        item: id of the reference image.
        left, right: methods, of a catch ``copy`` and ``gel``; sides before a rater's swap. In the
            task ``sort`` there is ``left`` alone.
        repeats: id of the repeated trial; '' for other kinds.
    """

    id: str
    kind: str
    item: str
    left: str
    right: str = ""
    repeats: str = ""

    def sides(self, swapped: bool) -> tuple[str, str]:
        """Left and right as a rater sees them."""
        return (self.right, self.left) if swapped else (self.left, self.right)


@dataclass(frozen=True)
class Rater:
    """What one rater sees: ``order`` of trial ids, and in which the sides are ``swapped``."""

    code: str
    order: Sequence[str]
    swapped: Sequence[bool]


@dataclass(frozen=True)
class Rule:
    """When a rater is excluded, fixed before there are votes. All are shares in [0, 1].

    Attributes:
        catches: fewest catches answered right.
        finished: fewest trials answered.
        side: most votes for one side, of those for a side.
    """

    catches: float = 0.8
    finished: float = 0.5
    side: float = 0.95


@dataclass(frozen=True)
class Plan:
    """A study.

    Attributes:
        secret: hexadecimal key of all names in the page.
        task: ``pair`` (which of two images is closer to the reference) or ``sort`` (which material
            does an image show).
        question: code of the question, '' for a custom one; ``text`` is what raters read.
        title: heading of the page.
        methods: names of what is compared.
        items: the reference images.
        trials: all questions.
        raters: code, order and sides of each.
        rule: when a rater is excluded.
        seed: of the choice of items.
        expected: ``half_width`` of the interval of a preference, by simulation for these items and
            raters, and what it assumes; empty for ``sort``.
        until: ISO date after which no vote counts, or None.
        size: side of all images in pixels.
        images: name -> JPEG as a data URI.
        examples: reference images that show every material (``sort``).
        notes: what was left out, sampled or assumed.
    """

    secret: str = field(repr=False)
    task: str
    question: str
    text: str
    title: str
    methods: Sequence[str]
    items: Sequence[Item]
    trials: Sequence[Trial]
    raters: Sequence[Rater]
    rule: Rule = field(default_factory=Rule)
    seed: int = 0
    expected: Mapping[str, Any] = field(default_factory=dict)
    until: str | None = None
    size: int = 256
    images: Mapping[str, str] = field(default_factory=dict, repr=False)
    examples: Sequence[Item] = ()
    notes: Sequence[Note] = ()

    def name(self, *parts: str) -> str:
        """Name in the page of an image ``(item, slot)`` or of a trial ``(rater, trial)``."""
        message = "\x1f".join(parts).encode()
        return hmac.new(bytes.fromhex(self.secret), message, "sha256").hexdigest()[:20]

    @cached_property
    def digest(self) -> str:
        """SHA-256 over the whole plan."""
        return digest_json(plain(self))

    @property
    def study(self) -> str:
        """Name of the study in pages and votes: 12 digits of the digest."""
        return short(self.digest)

    @property
    def choices(self) -> list[str]:
        """The answers of a trial."""
        if self.task == "pair":
            return list(PAIR_CHOICES)
        return sorted({str(item.material) for item in self.examples})

    @cached_property
    def trial(self) -> Mapping[str, Trial]:
        """Id -> trial."""
        return {trial.id: trial for trial in self.trials}

    def shown(self, code: str) -> dict[str, tuple[Trial, bool]]:
        """Name in the page -> (trial, whether its sides are swapped), in the order of a rater."""
        rater = next(rater for rater in self.raters if rater.code == code)
        order = zip(rater.order, rater.swapped, strict=True)
        return {self.name(code, name): (self.trial[name], swapped) for name, swapped in order}

    def public(self) -> dict[str, Any]:
        """All that the page and the server know, as JSON."""
        page: dict[str, Any] = {
            "format": PAGE_FORMAT,
            "study": self.study,
            "task": self.task,
            "title": self.title,
            "question": self.text,
            "until": self.until,
            "images": {
                name: {"src": self.images[name], "w": self.size, "h": self.size}
                for name in sorted(self.images)  # the order of an HMAC says nothing
            },
            "raters": {rater.code: self._questions(rater.code) for rater in self.raters},
            "choices": self.choices,
        }
        if self.task == "sort":
            page["strips"] = [
                {
                    "answer": name,
                    "label": name,
                    "images": [
                        self.name(i.id, EXAMPLE) for i in self.examples if i.material == name
                    ],
                }
                for name in self.choices
            ]
        return page

    def _questions(self, code: str) -> list[dict[str, str]]:
        rows: list[dict[str, str]] = []
        for name, (trial, swapped) in self.shown(code).items():
            if self.task == "sort":
                rows.append({"trial": name, "image": self.name(trial.item, trial.left)})
                continue
            left, right = (self.name(trial.item, side) for side in trial.sides(swapped))
            reference = self.name(trial.item, REFERENCE)
            rows.append({"trial": name, "reference": reference, "left": left, "right": right})
        return rows

    def save(self, path: Path) -> None:
        """Write ``plan.json``, readable by its owner alone."""
        import json

        text = json.dumps({"format": FORMAT, **plain(self)}, indent=1, ensure_ascii=False)
        with atomic_path(path) as part:
            part.chmod(0o600)
            part.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def load(cls, study: str | Path) -> Plan:
        """Read the plan of a study.

        Args:
            study: its folder, or ``plan.json`` itself.

        Raises:
            PalpateError: if there is none, or it is not as it was written.
        """
        path = Path(study)
        path = path / PLAN if path.is_dir() or not path.suffix else path
        record = read_record(path, "plan of the study", form=FORMAT)
        with reading_entry(path, "The plan"):
            plan = from_plain(cls, {k: v for k, v in record.items() if k != "format"})
            for rater in plan.raters:
                plan.shown(rater.code)
            return plan


def last_day(until: str | None) -> str | None:
    """The last day of a study, if any, as ``2030-12-31``, so that texts compare as days do.

    Raises:
        PalpateError: if it is no ISO date.
    """
    try:
        return None if until is None else datetime.date.fromisoformat(until).isoformat()
    except ValueError:
        must, example = "must be a date", {"until": "2030-12-31"}
        raise PalpateError(must, repr(until), "", argument="until", example=example) from None
