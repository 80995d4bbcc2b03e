"""Options of the four tactile metrics, and the presets that fix a whole column of them.

=============  ==========  ========  =================  ===============
============================= preset         estimator   halves    denominator        aggregate
  what it is =============  ==========  ========  =================  ===============
  =============================
paper          unbiased    random    sum                mean_of_ratios   Eq. 2-7 to the letter: I-
and
                                                                         CI-TMMD have expectation 0
paper-tables   biased      ordered   mean_off_diagonal  mean_of_ratios   the reading whose
magnitudes
                                                                         fit the printed tables
cmmd           biased      random    sum                mean_of_ratios   as CMMD's published code
grouped        grouped     group     sum                ratio_of_means   the default where groups
are
                                                                         known: videos stay whole
=============  ==========  ========  =================  ===============
=============================
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, TypedDict

from palpate.metrics.inputs import (
    Normalize,
    checked_choice,
    checked_level,
    checked_number,
    checked_whole,
    invalid,
)
from palpate.metrics.kernels import Kernel, Sigma, checked_kernel
from palpate.metrics.mmd import ESTIMATORS, Estimator
from palpate.metrics.pairs import BACKENDS, Backend

Halves = Literal["group", "random", "ordered"]
Denominator = Literal["sum", "mean", "mean_off_diagonal"]
Aggregate = Literal["mean_of_ratios", "ratio_of_means"]
HALVES = ("group", "random", "ordered")
DENOMINATORS = ("sum", "mean", "mean_off_diagonal")
AGGREGATES = ("mean_of_ratios", "ratio_of_means")


class Options(TypedDict, total=False):
    """Options of ``tmmd``, ``i_tmmd``, ``ci_tmmd``, ``d_tmmd``; each records those that bear on it.

    Keys:
        preset: one of ``PRESETS``; default ``"grouped"`` where groups are known, else ``"paper"``.
        estimator, halves, denominator, aggregate: override one entry of the preset.
        sigma: kernel bandwidth, default 10; several are averaged; ``"median"``: the median distance
            of the reference; ``"multi"``: five bandwidths around it
            (:mod:`palpate.metrics.kernels`).
        kernel: instead of the Gaussian of ``sigma``, e.g. :class:`palpate.metrics.Polynomial`.
        scale: factor on the result, default 1000.
        normalize: rows that are not of unit length: ``"check"`` rejects them (default), True
            divides by the norm, False takes them as they are.
        backend: ``"auto"`` (default), ``"blocked"`` or ``"moments"``
            (:mod:`palpate.metrics.pairs`).
        tolerance: largest bound with which ``auto`` takes moments, default 1e-4 at scale 1000.
        block: rows of a kernel block, default 1024.
        permutations: relabelings of the permutation test of TMMD, default 999; 0 for none.
        level: coverage of intervals, default 0.95.
        min_samples: a class with fewer is excluded, at least 4, default 4.
        seed: of random halves, default 0.
        subject: what is scored, default ``"generated"``.
        split: digest of the split, kept with the score.
    """

    preset: str | None
    estimator: Estimator
    halves: Halves
    denominator: Denominator
    aggregate: Aggregate
    sigma: Sigma
    kernel: Kernel | None
    scale: float
    normalize: Normalize
    backend: Backend
    tolerance: float
    block: int
    permutations: int
    level: float
    min_samples: int
    seed: int
    subject: str
    split: str | None


@dataclass(frozen=True)
class Plan:
    """Options with nothing left open; the fields are those of :class:`Options`."""

    preset: str
    estimator: Estimator
    halves: Halves
    denominator: Denominator
    aggregate: Aggregate
    sigma: Sigma = 10.0
    kernel: Kernel | None = None
    scale: float = 1000.0
    normalize: Normalize = "check"
    backend: Backend = "auto"
    tolerance: float = 1e-4
    block: int = 1024
    permutations: int = 999
    level: float = 0.95
    min_samples: int = 4
    seed: int = 0
    subject: str = "generated"
    split: str | None = None


PRESETS: dict[str, Plan] = {
    plan.preset: plan
    for plan in (
        Plan("paper", "unbiased", "random", "sum", "mean_of_ratios"),
        Plan("paper-tables", "biased", "ordered", "mean_off_diagonal", "mean_of_ratios"),
        Plan("cmmd", "biased", "random", "sum", "mean_of_ratios"),
        Plan("grouped", "grouped", "group", "sum", "ratio_of_means"),
    )
}


def plan_for(options: Options, *, grouped: bool) -> Plan:
    """The options completed; ``grouped``: whether groups are known.

    Raises:
        PalpateError: on an unknown word, a parameter out of range, or options that need groups
            where none are known.
    """
    preset = options.get("preset") or ("grouped" if grouped else "paper")
    checked_choice("preset", preset, tuple(PRESETS))
    given: dict[str, Any] = {k: v for k, v in options.items() if k != "preset"}
    names = [f.name for f in fields(Plan)]
    if unknown := sorted(set(given) - set(names)):
        must = f"must not be given: options are {', '.join(names)}"
        raise invalid(unknown[0], must, ", ".join(unknown), "Check the spelling")
    plan = Plan(**{**asdict(PRESETS[preset]), **given})
    checked_choice("estimator", plan.estimator, ESTIMATORS)
    checked_choice("halves", plan.halves, HALVES)
    checked_choice("denominator", plan.denominator, DENOMINATORS)
    checked_choice("aggregate", plan.aggregate, AGGREGATES)
    checked_choice("backend", plan.backend, BACKENDS)
    checked_number(positive=True, scale=plan.scale)
    checked_number(tolerance=plan.tolerance)
    checked_whole(1, block=plan.block)
    checked_whole(0, permutations=plan.permutations, seed=plan.seed)
    checked_whole(4, min_samples=plan.min_samples)  # two for each half
    checked_level(plan.level)
    checked_kernel(plan.kernel)
    for name, value in (("estimator", "grouped"), ("halves", "group")):
        if not grouped and getattr(plan, name) == value:
            must = f"must know the group of every sample for {name}={value!r}"
            raise invalid("groups", must, "none", "Pass groups, or another preset", preset="paper")
    return plan
