"""Scores and features: numbers that carry everything needed to believe or to compare them."""

from __future__ import annotations

import hashlib
import html
import json
import math
import mmap
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import PalpateError
from palpate.core.files import atomic_path
from palpate.core.notes import Note

#: Settings that must agree before two scores may stand in one column.
COMPARABLE = (
    "metric",
    "estimator",
    "bandwidth",
    "scale",
    "settings",
    "encoder",
    "reference",
    "split",
)


#: Rows of an array on disk that are looked at together.
SLAB = 8192
#: Arrow and words for ``Score.higher_is_better``.
ARROWS: Mapping[bool | None, str] = {True: "↑", False: "↓", None: "→"}
BETTER: Mapping[bool | None, str] = {
    True: "higher is better",
    False: "lower is better",
    None: "closer to the floor is better",
}


@dataclass(frozen=True)
class Score:
    """One number with its interval and its settings.

    Attributes:
        metric: e.g. ``"TMMD"``, ``"SSIM"``.
        subject: what was scored: ``"generated"``, ``"real"``, ``"background"``, a generator's name.
        value: the score, or None where it is undefined (``note`` says why).
        interval: (low, high), or None where none can be given.
        level: coverage the interval aims at.
        interval_method: how it was made (``"leave-one-video-out jackknife, t, 23 df"``).
        null: the range that a meaningless difference would fall into, or None.
        floor: the same metric on real touches, or None.
        estimator: ``"unbiased"``, ``"biased"``, ``"grouped"``, ``"per-image mean"``.
        bandwidth: kernel bandwidth sigma, or None.
        scale: factor that the raw value was multiplied by.
        n: samples scored; m: reference samples, or None.
        seed: seed of any random halving, or None.
        encoder, reference, split: digests of the encoder, of the real touches compared with, and of the split, or None.
        higher_is_better: direction; None where neither is: closer to the floor is better (the metrics without reference).
        settings: further settings that must agree for a comparison.
        details: anything else worth keeping (per class values, matrices as lists); not compared.
        notes: what a reader must know beside the number.
        note: superseded by ``notes``; '' or a sentence.
    """

    metric: str
    subject: str
    value: float | None
    interval: tuple[float, float] | None = None
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
    note: str = ""

    def __float__(self) -> float:
        """The value; NaN where it is undefined."""
        return math.nan if self.value is None else float(self.value)

    def __format__(self, spec: str) -> str:
        """The value in a number format; without one, the three lines of :meth:`__str__`."""
        return format(float(self), spec) if spec else str(self)

    def __round__(self, digits: int | None = None) -> float:
        """The value, rounded."""
        return round(float(self), digits) if digits is not None else round(float(self))

    def __str__(self) -> str:
        """Three lines: the number with its interval; how it was made; on what."""
        value = "undefined" if self.value is None else f"{self.value:.4g}"
        interval = ""
        if self.interval is not None:
            low, high = self.interval
            interval = f" [{low:.4g}, {high:.4g}] ({self.level:.0%}{_after(self.interval_method)})"
        bandwidth = f"sigma {self.bandwidth:g}" if self.bandwidth is not None else ""
        scale = f"scale {self.scale:g}" if self.scale != 1 else ""
        null = "null {:.4g} to {:.4g}".format(*self.null) if self.null is not None else ""
        floor = f"floor {self.floor:.4g}" if self.floor is not None else ""
        how = [self.estimator, bandwidth, scale, null, floor, BETTER[self.higher_is_better]]
        against = f"{self.n} samples" + (f" against {self.m}" if self.m is not None else "")
        names = ("encoder", "reference", "split")
        digests = [f"{name} {d[:12]}" for name in names if (d := getattr(self, name))]
        seed = f"seed {self.seed}" if self.seed is not None else ""
        lines = [filter(None, how), filter(None, [against, seed, *digests])]
        head = f"{self.metric} of {self.subject}: {value}{interval}"
        return "\n  ".join([head, *(", ".join(line) for line in lines)])

    def _repr_html_(self) -> str:
        """For notebooks: the three lines."""
        head, *rest = map(html.escape, str(self).split("\n"))
        return f"<div><b>{head}</b><br><small>{'<br>'.join(rest)}</small></div>"

    def to_json(self) -> dict[str, Any]:
        """A JSON object; NaN and infinity become null."""
        return _finite(asdict(self))

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Score:
        """The inverse of :meth:`to_json`."""
        pairs = {
            k: tuple(data[k]) if data.get(k) is not None else None for k in ("interval", "null")
        }
        fields: dict[str, Any] = {**data, **pairs}
        fields["notes"] = tuple(Note.from_json(note) for note in data.get("notes", ()))
        if not isinstance(fields.get("value"), int | float | None):
            raise TypeError(f"the value of a score must be a number, got {fields['value']!r}")
        return cls(**fields)


def _after(text: str) -> str:
    return f", {text}" if text else ""


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def require_comparable(scores: Sequence[Score]) -> None:
    """Refuses scores that may not stand in one column.

    Raises:
        PalpateError: naming the first setting in which two of them differ.
    """
    for name in COMPARABLE:
        # Running sums do not know what they were made from: references must agree where they are known.
        able = [s for s in scores if name != "reference" or s.reference is not None]
        for other in able[1:]:
            a, b = getattr(able[0], name), getattr(other, name)
            if _finite(a) != _finite(b):
                raise PalpateError(
                    f"Scores in one column must agree in {name}",
                    f"{a!r} for {able[0].subject!r} and {b!r} for {other.subject!r}",
                    "Score both again with the same settings, or put them into two tables",
                )


def columns(scores: Iterable[Score]) -> dict[str, list[Score]]:
    """Scores by metric, each list checked by :func:`require_comparable`; the order of first appearance is kept."""
    table: dict[str, list[Score]] = {}
    for score in scores:
        table.setdefault(score.metric, []).append(score)
    for column in table.values():
        require_comparable(column)
    return table


def _finite_rows(features: np.ndarray) -> np.ndarray:
    """(n,) whether all numbers of a row are finite; an array on disk is read in slabs, whose pages are given back."""
    out = np.ones(len(features), dtype=bool)
    for k in range(0, len(features), SLAB):
        out[k : k + SLAB] = np.isfinite(features[k : k + SLAB]).all(axis=1)
        _give_back(features)
    return out


def _give_back(features: np.ndarray) -> None:
    """Lets the system forget the pages of an array on disk that were read."""
    held = getattr(features, "_mmap", None)
    if (
        held is not None and hasattr(held, "madvise") and getattr(features, "mode", "c") != "c"
    ):  # own changes would be lost
        held.madvise(mmap.MADV_DONTNEED)


def is_missing(name: Any) -> bool:
    """Whether a label or group is none: None, an empty string, NaN, or what a table has in their place (pandas' NA and NaT)."""
    return (
        name is None
        or type(name).__name__ in ("NAType", "NaTType")
        or name == ""
        or bool(name != name)
    )


def _on_host(features: Any) -> np.ndarray:
    """A tensor without its graph, from any device; NumPy has no bfloat16."""
    try:
        if hasattr(features, "detach"):
            features = features.detach().cpu()
            if str(features.dtype).endswith("bfloat16"):
                warnings.warn(
                    "bfloat16 features were widened to float32; their rounding stays", stacklevel=4
                )
                features = features.float()
        return np.asarray(features)
    except (TypeError, ValueError, RuntimeError) as error:
        raise PalpateError(
            "Features must turn into an array (n, d)",
            str(error).splitlines()[0],
            "Pass rows of one width",
        ) from None


@dataclass(frozen=True)
class FeatureSet:
    """Features of samples, in one order.

    Attributes:
        ids: n sample ids.
        features: float32 array (n, d), or a tensor, which is copied to the host; encoders give L2-normalized rows.
        labels: n materials, or None.
        groups: n groups (videos, or touches), or None.
        encoder: digest of the encoder that made them.

    Raises:
        PalpateError: on unequal lengths, a wrong shape, or values that are not finite (the first such rows are named).
    """

    ids: Sequence[str]
    features: np.ndarray
    labels: Sequence[str] | None = None
    groups: Sequence[str] | None = None
    encoder: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.features, np.ndarray):  # a tensor, or a list of rows
            object.__setattr__(self, "features", _on_host(self.features))
        if self.features.dtype.kind not in "fiub":
            raise PalpateError(
                "Features must be numbers",
                f"dtype {self.features.dtype}",
                "Pass the encoder's output, one row an id",
            )
        shape = self.features.shape
        if len(shape) != 2 or shape[0] != len(self.ids):
            raise PalpateError(
                f"Features must have shape ({len(self.ids)}, d), one row an id",
                f"shape {shape}",
                "Pass one row per id",
            )
        for name in ("labels", "groups"):
            column = getattr(self, name)
            if column is not None and len(column) != shape[0]:
                raise PalpateError(
                    f"{name} must have one entry a row ({shape[0]})",
                    f"{len(column)}",
                    f"Pass {name} in the order of ids",
                )
        bad = np.flatnonzero(~_finite_rows(self.features))
        if bad.size:
            names = list(self.ids)  # a column of pandas may be numbered otherwise
            named = ", ".join(f"{int(k)}: {names[int(k)]!r}" for k in bad[:5]) + ", ..." * (
                bad.size > 5
            )
            got = f"NaN or infinity in {bad.size} row{'s' * (bad.size != 1)} ({named})"
            raise PalpateError(
                "Features must be finite", got, "Check what those rows were made from"
            )

    @cached_property
    def digest(self) -> str:
        """SHA-256 of ids and features as float32, in whatever order and type the rows are."""
        rows: list[tuple[str, bytes]] = []
        for k in range(0, len(self.features), SLAB):
            with np.errstate(over="ignore"):
                slab = np.ascontiguousarray(self.features[k : k + SLAB], dtype="<f4") + np.float32(
                    0
                )  # one zero: -0 equals it
            rows += [
                (str(i), hashlib.blake2b(row.tobytes(), digest_size=16).digest())
                for i, row in zip(self.ids[k:], slab, strict=False)
            ]
            _give_back(self.features)
        found = hashlib.sha256(str(self.features.shape[1]).encode())
        for name, row in sorted(rows):
            found.update(json.dumps(name).encode() + row)
        return found.hexdigest()

    def take(self, ids: Sequence[str]) -> FeatureSet:
        """The rows of ``ids``, in that order.

        Raises:
            PalpateError: if an id is missing.
        """
        row = {name: k for k, name in enumerate(self.ids)}
        missing = [i for i in ids if i not in row]
        if missing:
            raise PalpateError(
                "Every id asked for must have features",
                f"{len(missing)} without, first {missing[0]!r}",
                "Embed those samples as well",
            )
        at = [row[i] for i in ids]
        pick = lambda column: None if column is None else [column[k] for k in at]  # noqa: E731
        return FeatureSet(
            list(ids), self.features[at], pick(self.labels), pick(self.groups), self.encoder
        )

    def save(self, path: Path) -> None:
        """Writes an ``.npz`` of plain arrays (no pickles), atomically."""
        arrays: dict[str, np.ndarray] = {
            "ids": np.array(list(self.ids), dtype=str),
            "features": self.features,
        }
        for name in ("labels", "groups"):
            if (column := getattr(self, name)) is not None:
                arrays[name] = np.array(["" if is_missing(c) else c for c in column], dtype=str)
        if self.encoder:
            arrays["encoder"] = np.array(self.encoder)
        with atomic_path(Path(path)) as part, open(part, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path) -> FeatureSet:
        """Reads what :meth:`save` wrote; never a pickle."""
        with np.load(path, allow_pickle=False) as data:
            column = lambda name: [str(v) for v in data[name]] if name in data else None  # noqa: E731
            return cls(
                column("ids") or [],
                data["features"],
                column("labels"),
                column("groups"),
                str(data["encoder"]) if "encoder" in data else None,
            )
