"""A small study, and raters who answer it with planted preferences.

Imported by tests and benchmarks: one place says what a simulated rater is.
"""

import datetime
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from palpate.core import digest_json, rng_for
from palpate.preference.votes import Vote, Votes


def write_folder(folder, seed, ids, size=24, suffix=".png"):
    """A folder of random images, one an id; the color is that of ``seed``."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for name in ids:
        path = folder / f"{name}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (size, size, 3), np.uint8)).save(path)
    return folder


@dataclass(frozen=True)
class Folders:
    """A reference, three methods, and a table of materials and videos."""

    reference: Path
    methods: list[Path]
    labels: Path


def write_folders(top, videos=30, frames=2, materials=("brick", "grass", "wood")):
    """``videos`` videos of ``frames`` images each, materials in turn."""
    rows = [
        (f"v{v:02d}/f{f}", materials[v % len(materials)], f"v{v:02d}")
        for v in range(videos)
        for f in range(frames)
    ]
    ids = [row[0] for row in rows]
    labels = top / "labels.csv"
    reference = write_folder(top / "real", 0, ids)
    methods = [write_folder(top / n, k, ids) for k, n in enumerate(("ours", "gvst", "wbg"), 1)]
    labels.write_text("\n".join(["id,material,video", *(",".join(row) for row in rows)]) + "\n")
    return Folders(reference, methods, labels)


@dataclass(frozen=True)
class Crowd:
    """Simulated raters: what they find closer, and how carelessly they answer.

    A method has a strength in logits, which varies between items and between raters: the difference
    of two methods has the standard deviations ``item_sd`` and ``rater_sd``. A difference felt below
    ``tie_band`` is a tie; ``left_bias`` is added for the left image; a share ``lapses`` of the
    answers is random. A sorter names the material with probability ``skill``.
    """

    strengths: dict[str, float]
    item_sd: float = 1.5
    rater_sd: float = 0.7
    tie_band: float = 0.5
    left_bias: float = 0.0
    lapses: float = 0.0
    skill: float = 0.7
    seed: int = 0

    def _rng(self, *names):
        return rng_for(self.seed, *names)

    def strength(self, rater, item, method):
        """Strength that one rater feels in one image."""
        of_item = self._rng("item", item, method).standard_normal() * self.item_sd / np.sqrt(2)
        return self.strengths[method] + of_item + self._of_rater(rater, method)

    def choice(self, plan, rater, trial, swapped):
        """The answer to one trial, as shown."""
        rng = self._rng("vote", rater, trial.id)
        if rng.random() < self.lapses:
            return plan.choices[rng.integers(len(plan.choices))]
        if plan.task == "sort":
            truth = {item.id: item.material for item in [*plan.items, *plan.examples]}[trial.item]
            others = [name for name in plan.choices if name != truth]
            sure = trial.kind == "catch" or rng.random() < self.skill
            return truth if sure else others[rng.integers(len(others))]
        left, right = (trial.right, trial.left) if swapped else (trial.left, trial.right)
        if trial.kind == "catch":
            return "left" if left == "copy" else "right"
        felt = self.strength(rater, trial.item, left) - self.strength(rater, trial.item, right)
        felt += self.left_bias + rng.logistic()
        return "same" if abs(felt) < self.tie_band else "left" if felt > 0 else "right"

    def preference(self, a, b, raters=None, draws=400_000):
        """The planted truth: preference of a over b among all items, sides, and people.

        Or among the named ``raters`` instead of all people.
        """
        rng, mean = np.random.default_rng(0), self.strengths[a] - self.strengths[b]
        if raters is None:
            mean = mean + self.rater_sd * rng.standard_normal(draws)
        else:
            own = [self._of_rater(r, a) - self._of_rater(r, b) for r in raters]
            mean = mean + rng.choice(own, draws)
        felt = mean + self.item_sd * rng.standard_normal(draws)
        felt += self.left_bias * rng.choice([-1, 1], draws) + rng.logistic(size=draws)
        same = np.abs(felt) < self.tie_band
        share = float(((felt > 0) & ~same).mean() + same.mean() / 2)
        return (1 - self.lapses) * share + self.lapses / 2

    def _of_rater(self, rater, method):
        return self._rng("rater", rater, method).standard_normal() * self.rater_sd / np.sqrt(2)

    def vote(self, plan, rater, trial, swapped):
        """The answer as it is read from a download."""
        at = datetime.datetime(2026, 11, 1, tzinfo=datetime.UTC)
        return Vote(rater, trial, swapped, self.choice(plan, rater, trial, swapped), 2500, at, 0)

    def votes(self, plan):
        """The votes of all raters, as they are read from their downloads."""
        of_rater = {}
        for rater in plan.raters:
            shown = ((plan.trial[n], s) for n, s in zip(rater.order, rater.swapped, strict=True))
            of_rater[rater.code] = {t.id: self.vote(plan, rater.code, t, s) for t, s in shown}
        return Votes(of_rater)

    def download(self, plan, rater):
        """What the page of one rater downloads."""
        rows = [
            {
                "trial": name,
                "choice": self.choice(plan, rater, trial, swapped),
                "ms": 2500,
                "at": f"2026-11-01T{10 + k // 3600:02d}:{k // 60 % 60:02d}:{k % 60:02d}.000Z",
                "undone": 0,
            }
            for k, (name, (trial, swapped)) in enumerate(plan.shown(rater).items())
        ]
        return signed(
            {
                "format": "palpate/preference-votes@1",
                "study": plan.study,
                "rater": rater,
                "viewport": [1280, 800],
                "votes": rows,
            }
        )

    def write(self, plan, folder, raters=None):
        """Downloads of all raters, or of some, in a folder."""
        folder.mkdir(exist_ok=True)
        for rater in raters or [rater.code for rater in plan.raters]:
            path = folder / f"votes-{plan.study}-{rater}.json"
            path.write_text(json.dumps(self.download(plan, rater)))
        return folder


def signed(download):
    """A download with the digest of its content."""
    rest = {name: value for name, value in download.items() if name != "digest"}
    return rest | {"digest": digest_json(rest)}
