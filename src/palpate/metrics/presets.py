"""Options of the four tactile metrics, and the presets that fix a whole column of them.

=============  ==========  ========  =================  ===============  ====================================================================
preset         estimator   halves    denominator        aggregate        what it is
=============  ==========  ========  =================  ===============  ====================================================================
paper          unbiased    random    sum                mean_of_ratios   Eq. 2-7 to the letter. Its I- and CI-TMMD have expectation 0 for any data.
paper-tables   biased      ordered   mean_off_diagonal  mean_of_ratios   the reading whose magnitudes fit the paper's printed tables
cmmd           biased      random    sum                mean_of_ratios   the estimator of CMMD's published code
grouped        grouped     group     sum                ratio_of_means   the default where groups are known: whole videos stay together
=============  ==========  ========  =================  ===============  ====================================================================
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypedDict

from palpate.core import PalpateError
from palpate.metrics.engine import BACKENDS, Backend
from palpate.metrics.inputs import (
    Normalize,
    checked_choice,
    checked_level,
    checked_number,
    checked_whole,
)
from palpate.metrics.kernels import Kernel, Sigma, checked_kernel
from palpate.metrics.mmd import ESTIMATORS, Estimator

Halves = Literal["group", "random", "ordered"]
Denominator = Literal["sum", "mean", "mean_off_diagonal"]
Aggregate = Literal["mean_of_ratios", "ratio_of_means"]
HALVES = ("group", "random", "ordered")
DENOMINATORS = ("sum", "mean", "mean_off_diagonal")
AGGREGATES = ("mean_of_ratios", "ratio_of_means")


class Options(TypedDict, total=False):
    """Options of ``tmmd``, ``i_tmmd``, ``ci_tmmd``, ``d_tmmd``; each metric records those that bear on it.

    Keys:
        preset: one of ``PRESETS``; default ``"grouped"`` where groups are known, else ``"paper"``.
        estimator, halves, denominator, aggregate: override one entry of the preset.
        sigma: kernel bandwidth, default 10; several are averaged; ``"median"``: the median distance of the reference; ``"multi"``: five
            bandwidths around it (:mod:`palpate.metrics.kernels`).
        kernel: another kernel than the Gaussian of ``sigma``, e.g. :class:`palpate.metrics.kernels.Polynomial`.
        scale: factor on the result, default 1000.
        normalize: ``"check"`` (default), True or False, see :func:`palpate.metrics.inputs.checked_features`.
        backend: ``"auto"`` (default), ``"blocked"`` or ``"moments"``, see :mod:`palpate.metrics.engine`.
        tolerance: largest bound with which ``auto`` takes moments, default 1e-4 at scale 1000.
        block: rows of a kernel block, default 1024.
        permutations: relabelings of the permutation test of TMMD, default 999; 0 for none.
        level: coverage of intervals, default 0.95.
        min_samples: a class with fewer is excluded, at least 4, default 4.
        seed: seed of random halves, default 0.
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
    "paper": Plan("paper", "unbiased", "random", "sum", "mean_of_ratios"),
    "paper-tables": Plan(
        "paper-tables", "biased", "ordered", "mean_off_diagonal", "mean_of_ratios"
    ),
    "cmmd": Plan("cmmd", "biased", "random", "sum", "mean_of_ratios"),
    "grouped": Plan("grouped", "grouped", "group", "sum", "ratio_of_means"),
}


def plan_for(options: Options, *, grouped: bool) -> Plan:
    """The options completed.

    Args:
        options: what the caller gave.
        grouped: whether groups are known.

    Raises:
        PalpateError: on an unknown word, a parameter out of range, or options that need groups where none are known.
    """
    preset = options.get("preset") or ("grouped" if grouped else "paper")
    checked_choice("preset", preset, tuple(PRESETS))
    given: dict[str, Any] = {k: v for k, v in options.items() if k != "preset"}
    if unknown := sorted(set(given) - set(Options.__annotations__)):
        must = f"Options must be among {', '.join(Options.__annotations__)}"
        raise PalpateError(must, ", ".join(unknown), "Check the spelling")
    plan = Plan(**{**PRESETS[preset].__dict__, **given})
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
    if not grouped and "grouped" in (plan.preset, plan.estimator):
        raise PalpateError(
            "The grouped estimator must know the group of every sample",
            "none",
            'Give groups, or preset="paper"',
        )
    if not grouped and plan.halves == "group":
        raise PalpateError(
            'halves="group" must know the group of every sample',
            "none",
            'Give groups, or halves="random"',
        )
    return plan
