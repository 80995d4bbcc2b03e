"""Scores: numbers that carry everything needed to believe or to compare them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from palpate.core.files import plain, short
from palpate.core.messages import Note, PalpateError
from palpate.core.records import from_plain
from palpate.core.shown import Shown

#: Settings that must agree before two scores may share a column.
COMPARABLE = (
    "measure",
    "kind",
    "estimator",
    "bandwidth",
    "scale",
    "settings",
    "encoder",
    "reference",
    "split",
)
#: Words for ``Score.higher_is_better``.
BETTER: Mapping[bool | None, str] = {
    True: "higher is better",
    False: "lower is better",
    None: "closer to the floor is better",
}


Kind = Literal["value", "difference", "excess", "lead", "effect size"]


class Measure(NamedTuple):
    """What a number measures, whatever it was measured on: see the same fields of :class:`Score`.

    ``excess`` distinguishes the between-group excess E from the metric itself.
    """

    metric: str
    features: str = ""
    kernel: str = ""
    excess: bool = False


@dataclass(frozen=True)
class Score(Shown):
    """One number with its interval and its settings.

    What it is of are fields; no name is ever taken apart (``palpate.report.labels`` joins them).

    Attributes:
        metric: the bare name: ``"TMMD"``, ``"SSIM"``, ``"material accuracy"``, ``"top-5"``.
        a: what was scored: ``"generated"``, ``"real"``, ``"background"``, a generator's name.
        value: the score, or None where it is undefined (``notes`` say why); never NaN or infinite.
        interval: (low, high), or None where none can be given.
        features: what the metric compares, where it is computed on several kinds: ``"Inception"``,
            ``"tactile"``, ``"pixels"``; of retrieval what is found by what (``"text by tactile"``).
            '' where the metric has its own: TMMD and its relatives the ruler features.
        kernel: the kernel of MMD where it is not the default, e.g. ``"σ median"``; else ''.
        kind: ``value``, of ``a``; ``difference``: the value of ``a`` minus that of ``b``;
            ``excess``: the between-group excess E of I- or CI-TMMD, of ``a`` or, with ``b``, the
            difference of two. In the claims of a study also ``lead``, by how much ``a`` is better
            than ``b``, and ``effect size``, a difference in units of its error.
        b: what ``a`` is compared with; None where nothing is.
        level: coverage the interval aims at.
        interval_method: e.g. ``"leave-one-video-out jackknife, t, 23 df"``.
        null: the range that the score falls into if generated and real images do not differ, or
            None.
        floor: the same metric on real images, or None: of TMMD, train images of other videos of
            the same materials; of I-, CI- and D-TMMD, the test part itself.
        estimator: ``"unbiased"``, ``"biased"``, ``"grouped"``, ``"per-image mean"``.
        bandwidth: kernel bandwidth sigma, or None.
        scale: factor that the raw value was multiplied by.
        n: samples scored; m: reference samples, or None.
        seed: seed of any random halving, or None.
        encoder, reference, split: digests of the encoder, the reference images and the split, or
            None.
        higher_is_better: direction; None: closer to the floor is better (I-, CI- and D-TMMD).
        settings: further settings that must agree for a comparison.
        details: anything else worth keeping (values by class, matrices as lists); not compared.
        notes: what a reader must know.
    """

    metric: str
    a: str
    value: float | None
    interval: tuple[float, float] | None = None
    features: str = ""
    kernel: str = ""
    kind: Kind = "value"
    b: str | None = None
    level: float = 0.95
    interval_method: str = ""
    null: tuple[float, float] | None = None
    floor: float | None = None
    estimator: str = ""
    bandwidth: float | None = None
    scale: float = 1.0
    n: int = 0
    m: int | None = None
    seed: int | None = None
    encoder: str | None = None
    reference: str | None = None
    split: str | None = None
    higher_is_better: bool | None = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[Note] = ()

    def __post_init__(self) -> None:
        """Drop what is not finite, as JSON does: value and floor become None, pairs as a whole."""
        for name in ("value", "floor", "interval", "null"):
            numbers = getattr(self, name)
            pair = numbers if isinstance(numbers, Sequence) else (numbers,)
            if not all(v is None or math.isfinite(v) for v in pair):
                object.__setattr__(self, name, None)

    @property
    def measure(self) -> Measure:
        """What is measured; of a difference, what its two sides are."""
        return Measure(self.metric, self.features, self.kernel, self.kind == "excess")

    def __float__(self) -> float:
        """Return the value; NaN where it is undefined."""
        return math.nan if self.value is None else float(self.value)

    def __lt__(self, other: Score | float) -> bool:
        """Compare values; False where one is undefined. So scores can be sorted."""
        return float(self) < float(other)

    def __gt__(self, other: Score | float) -> bool:
        """Compare values; False where one is undefined."""
        return float(self) > float(other)

    def __format__(self, spec: str) -> str:
        """Return the value in a number format; without one, the three lines of :meth:`__str__`."""
        return format(float(self), spec) if spec else str(self)

    def __round__(self, digits: int | None = None) -> float:
        """Return the value, rounded."""
        return round(float(self), digits)

    def __str__(self) -> str:
        """Return three lines: the number with its interval; how it was made; on what."""
        value = "undefined" if self.value is None else f"{self.value:.4g}"
        if self.interval:
            method = ", ".join(filter(None, [f"{self.level:.0%}", self.interval_method]))
            value += " [{:.4g}, {:.4g}] ({})".format(*self.interval, method)
        setting = [
            self.estimator,
            f"sigma {self.bandwidth:g}" if self.bandwidth is not None else "",
            f"scale {self.scale:g}" if self.scale != 1 else "",
            "null {:.4g} to {:.4g}".format(*self.null) if self.null else "",
            f"floor {self.floor:.4g}" if self.floor is not None else "",
            BETTER[self.higher_is_better],
        ]
        names = ("encoder", "reference", "split")
        data = [
            f"{self.n} samples" + (f" against {self.m}" if self.m is not None else ""),
            f"seed {self.seed}" if self.seed is not None else "",
            *(f"{name} {short(d)}" for name in names if (d := getattr(self, name))),
        ]
        kind = self.kind * (self.kind != "value")
        name = ", ".join(filter(None, (self.metric, self.features, self.kernel, kind)))
        head = f"{name} of {self.a}{f' against {self.b}' if self.b else ''}: {value}"
        return "\n  ".join([head, *(", ".join(filter(None, line)) for line in (setting, data))])

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object; NaN and infinity become null."""
        return plain(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Score:
        """Return the inverse of :meth:`to_json`."""
        score = from_plain(cls, data)
        return replace(score, notes=tuple(score.notes))


def require_comparable(scores: Sequence[Score]) -> None:
    """Check that scores may share a column.

    ``settings["axis"]``, the same in all of them, names what a column compares: it may differ.

    Raises:
        PalpateError: naming the first setting in which two of them differ.
    """
    axis = scores[0].settings.get("axis") if scores else None
    for name in (name for name in COMPARABLE if name != axis):
        # Running sums do not know their reference: it must agree where it is known.
        compared = [s for s in scores if name != "reference" or s.reference is not None]
        for score in compared[1:]:
            a, b = getattr(compared[0], name), getattr(score, name)
            if plain(a) != plain(b):
                raise PalpateError(
                    f"Scores in one column must agree in {name}",
                    f"{a!r} for {compared[0].a!r} and {b!r} for {score.a!r}",
                    "Score both again with the same settings, or put them into two tables",
                )
