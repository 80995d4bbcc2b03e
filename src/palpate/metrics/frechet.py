"""FID: the Fréchet distance between two sets of features, each taken as a Gaussian (Heusel et al., arXiv 1706.08500).

The distance itself, in float64 and without a matrix root, is in :mod:`palpate.metrics.gaussians`.

**Bias.** FID is biased upwards, by about c / n with a c that depends on the generator (Chong and Forsyth, arXiv 1911.07023): compare
values of equal n alone. ``details["infinity"]`` is the intercept of a line in 1 / n fitted to FID of parts of both sets, made of whole blocks
of groups, so that frames of one video do not pass for so many samples; it has less bias and somewhat more noise. With n <= d the value is
bias mostly, and the note says so.

**Interval.** A jackknife leaves out one block of whole groups from both sets at a time. It is an interval for the FID expected at
this n, bias included, not for FID at infinity. The difference of two generators on the same samples is left-one-out as a whole, with the same
blocks (:func:`compare_fid`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate import __version__
from palpate.core import FeatureSet, PalpateError, Score, rng_for
from palpate.metrics.gaussians import Array, Moments, distance_of_features, distance_of_moments
from palpate.metrics.inputs import (
    Floats,
    checked_level,
    checked_names,
    checked_whole,
    copies_across,
)
from palpate.metrics.intervals import jackknife_errors, t_interval
from palpate.metrics.neighbors import checked_sets, copies_note
from palpate.metrics.paired import Comparison, difference, holm, same_samples
from palpate.metrics.scored import Scored

Index = NDArray[np.intp]


class FidOptions(TypedDict, total=False):
    """Options of :func:`compare_fid`; see :func:`fid`."""

    normalize: bool
    blocks: int
    seed: int
    split: str | None
    level: float


def compare_fid(
    generators: Mapping[str, FeatureSet], reference: FeatureSet, **options: Unpack[FidOptions]
) -> Comparison:
    """FID of several generators on the same samples, with paired differences.

    Args:
        generators: name -> features of its touches; all with the same ids (any order), labels and groups.
        reference: features of the real touches.
        **options: of :func:`fid`.

    Returns:
        The differences are of FID at this n, in which the biases of the two need not be equal; ``details["infinity"]`` is the difference of the
        two extrapolations, or None.

    Raises:
        PalpateError: if generators differ in ids, labels, groups or encoder, or as :func:`fid`.
    """
    if unknown := sorted(set(options) - set(FidOptions.__annotations__)):
        raise PalpateError(
            f"Options must be among {', '.join(FidOptions.__annotations__)}",
            ", ".join(unknown),
            "Check the spelling",
        )
    found = {
        name: _fid(one, reference, subject=name, **options)
        for name, one in same_samples(generators).items()
    }
    differences: list[Score] = []
    for a, b in combinations(found.values(), 2):
        one, limits = difference(a, b), [v.score.details["infinity"] for v in (a, b)]
        limit = None if None in limits else limits[0] - limits[1]
        differences.append(
            replace(one, note=one.note or _BIASED, details={**one.details, "infinity": limit})
        )
    return Comparison([one.score for one in found.values()], holm(differences))


_BIASED = "Of FID at this size, whose biases need not be equal"


def fid(
    generated: FeatureSet,
    reference: FeatureSet,
    *,
    normalize: bool = False,
    interval: bool = True,
    blocks: int = 20,
    seed: int = 0,
    subject: str = "generated",
    split: str | None = None,
    level: float = 0.95,
) -> Score:
    """FID between generated and real touches; lower is better.

    Args:
        generated: (n, d) features, n >= 2; FID as published takes the 2048 pool features of Inception.
        reference: (m, d) features, m >= 2.
        normalize: divide every row by its norm first; FID as published does not.
        interval: make the interval and ``details["infinity"]``, which cost about ``blocks + 11`` times the distance itself.
        blocks: the most blocks that the jackknife leaves out. With no more groups than that it leaves one group out at a time; else
            groups are drawn into blocks of about equal size. Groups count only if both sets have them; the same name is the same group.
        seed: of that draw.
        subject: what is scored, kept in the score.
        split: digest of the split, kept in the score.
        level: coverage of the interval.

    Returns:
        Value, interval; ``details["infinity"]`` (None where half of a set has no more than d rows, or there are fewer than 8 blocks) and
        ``details["mean_term"]``, the part ``|mu1 - mu2|^2``.

    Raises:
        PalpateError: on features that are refused, unequal widths, fewer than two rows, or encoders of different digests.
    """
    options: dict[str, Any] = {
        "normalize": normalize,
        "blocks": blocks,
        "seed": seed,
        "split": split,
        "level": level,
    }
    return _fid(generated, reference, subject=subject, interval=interval, **options).score


def _fid(
    generated: FeatureSet,
    reference: FeatureSet,
    *,
    subject: str,
    interval: bool = True,
    normalize: bool = False,
    blocks: int = 20,
    seed: int = 0,
    split: str | None = None,
    level: float = 0.95,
) -> Scored:
    """FID, and its value without each block."""
    checked_whole(2, blocks=blocks)
    checked_whole(0, seed=seed)
    checked_level(level)
    x, y = checked_sets(generated, reference, normalize=normalize, least=2)
    whole = Moments.of(x), Moments.of(y)
    value = (
        distance_of_moments(*whole)
        if min(len(x), len(y)) > x.shape[1]
        else distance_of_features(x, y)
    )
    details: dict[str, Any] = {
        "mean_term": float(((whole[0].mean - whole[1].mean) ** 2).sum()),
        "infinity": None,
        "version": __version__,
    }
    note, found, method = copies_note(copies_across(x, y), len(x)), None, ""
    replicates, units = np.zeros(0), []
    if interval:
        parts = _draw_parts(generated, reference, (x, y), blocks, seed)
        replicates = parts.replicates(whole)
        units = parts.names if len(replicates) else []
        error = float(jackknife_errors(replicates[:, None])[0])
        if error > 0:  # false for NaN as well
            low, high = t_interval(value, error, parts.count - 1, level)
            found, method = (max(0.0, low), high), parts.method
        details |= {
            "infinity": parts.infinity(value, seed),
            "units": parts.units,
            "unit": parts.unit,
            "left_out": parts.left_out,
        }
    score = Score(
        "FID",
        subject,
        value,
        found,
        level=level,
        interval_method=method,
        estimator="plug-in",
        n=len(x),
        m=len(y),
        seed=seed if interval else None,
        encoder=generated.encoder,
        reference=reference.digest,
        split=split,
        details=details,
        settings={"normalize": normalize, "covariance": "n - 1"},
        note=". ".join(
            filter(
                None,
                [
                    note,
                    _note(
                        min(len(x), len(y)),
                        x.shape[1],
                        value,
                        details["infinity"],
                        interval and found is None,
                    ),
                ],
            )
        ),
    )
    return Scored(score, replicates, units)


def _note(n: int, d: int, value: float, limit: float | None, lacking: bool) -> str:
    if n <= d:
        text = f"Not meaningful: {n} samples do not span the {d} dimensions, so the value is mostly bias"
    elif limit is not None:
        text = "Biased upwards at this size; its details have the extrapolation to infinitely many samples (infinity)"
    else:
        text = "Biased upwards, the more the fewer samples: compare at equal sizes alone"
    return text + ". No interval: too few groups or samples to leave some out" * lacking


@dataclass(frozen=True)
class _Parts:
    """Rows of both sets in ``count`` blocks of whole units.

    Attributes:
        sets: the features, (n, d) and (m, d).
        block: the block of every row, (n,) and (m,).
        count: number of blocks.
        unit: ``"group"`` or ``"row"``.
        units: how many of them there are.
        names: of the blocks; a block that is one group has its name.
    """

    sets: tuple[Floats, Floats]
    block: tuple[Index, Index]
    count: int
    unit: str
    units: int
    names: Sequence[str]

    @property
    def left_out(self) -> str:
        """What the jackknife leaves out at a time: a ``"group"``, or a ``"block"`` of groups or rows."""
        return "group" if self.unit == "group" and self.count == self.units else "block"

    @property
    def method(self) -> str:
        """What the interval is of, in words."""
        what = f"leave-one-{self.left_out}-out jackknife"
        if self.unit == "row":
            what += f", {self.count} random blocks of rows, taken as independent"
        elif self.left_out == "block":
            what += f", {self.count} random blocks of whole groups ({self.units} groups)"
        return f"{what}, t, {self.count - 1} df"

    def rows(self, b: int) -> list[Floats]:
        """The rows of one block, by set."""
        return [x[block == b] for x, block in zip(self.sets, self.block, strict=True)]

    def replicates(self, whole: Sequence[Moments]) -> Array:
        """The distance (count,) without one block at a time; empty where what is left is no set."""
        values: list[float] = []
        for b in range(self.count):
            kept = [
                len(x) - int((block == b).sum())
                for x, block in zip(self.sets, self.block, strict=True)
            ]
            if min(kept) < 2:
                return np.zeros(0)
            if min(kept) > self.sets[0].shape[1]:
                values.append(
                    distance_of_moments(
                        *(
                            w.without(Moments.of(rows))
                            for w, rows in zip(whole, self.rows(b), strict=True)
                        )
                    )
                )
            else:
                values.append(
                    distance_of_features(
                        *(x[block != b] for x, block in zip(self.sets, self.block, strict=True))
                    )
                )
        return np.array(values)

    def infinity(self, value: float, seed: int) -> float | None:
        """FID extrapolated to infinitely many rows in both sets, or None where there is too little to fit a line to."""
        d, full = self.sets[0].shape[1], [len(x) for x in self.sets]
        if self.count < 8 or min(full) <= 2 * d:
            return None
        order = rng_for(seed, "fid infinity").permutation(self.count)
        ask = {int(np.ceil(self.count * share)) for share in (0.5, 0.6, 0.7, 0.8, 0.9)}
        points = [(1.0, value)]
        for start in (0, self.count // 2):  # the halves of the two runs are disjoint
            grown = Moments(), Moments()
            for k, b in enumerate(np.roll(order, -start), 1):
                for moments, rows in zip(grown, self.rows(int(b)), strict=True):
                    moments.add(rows)
                if k in ask and min(m.n for m in grown) > d:
                    # The bias is a / n + b / m; both shrink together along these points.
                    inverse = sum(n / m.n for n, m in zip(full, grown, strict=True)) / 2
                    points.append((inverse, distance_of_moments(*grown)))
        if len({inverse for inverse, _ in points}) < 3:
            return None
        at, values = np.array(points).T
        return float(np.polynomial.polynomial.polyfit(at, values, 1)[0])


def _draw_parts(
    generated: FeatureSet, reference: FeatureSet, sets: tuple[Floats, Floats], most: int, seed: int
) -> _Parts:
    n, m = len(sets[0]), len(sets[1])
    rng = rng_for(seed, "fid blocks")
    names = [
        checked_names("groups", s.groups, len(x))
        for s, x in zip((generated, reference), sets, strict=True)
    ]
    if names[0] is None or names[1] is None:
        count = min(most, n, m)
        return _Parts(
            sets,
            (rng.permutation(n) % count, rng.permutation(m) % count),
            count,
            "row",
            n + m,
            _numbered(count),
        )
    called, unit = np.unique(np.array(names[0] + names[1], dtype=str), return_inverse=True)
    units = len(called)
    block = np.arange(units)
    if units > most:
        # The largest group first into the block that holds least, ties at random: blocks of nearly equal size.
        size = (
            np.bincount(unit[:n], minlength=units) / n + np.bincount(unit[n:], minlength=units) / m
        )
        load = np.zeros(most)
        order = rng.permutation(units)
        for u in order[np.argsort(-size[order], kind="stable")]:
            block[u] = int(load.argmin())
            load[block[u]] += size[u]
    blocks = [str(name) for name in called] if units <= most else _numbered(most)
    return _Parts(
        sets, (block[unit[:n]], block[unit[n:]]), min(units, most), "group", units, blocks
    )


def _numbered(count: int) -> list[str]:
    return [f"block {b}" for b in range(count)]
