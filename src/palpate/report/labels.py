"""The printed names of scores: nothing else joins their fields, and nothing takes a name apart."""

from __future__ import annotations

from palpate.core import Measure, Score


def measured(score: Score | Measure) -> str:
    """Return what is measured, as the head of a column says it; of a difference what both are.

    ``FID (Inception)``, ``TMMD (σ median)``, ``I-TMMD E``, ``top-5 of 480 (text by tactile)``.
    """
    measure = score.measure if isinstance(score, Score) else score
    pool = score.settings.get("pool") if isinstance(score, Score) else None
    name = measure.metric + (f" of {pool}" if pool else "") + " E" * measure.excess
    return name + "".join(f" ({field})" for field in (measure.features, measure.kernel) if field)


def label_of(score: Score) -> str:
    """Return what a score is: of a comparison ``TMMD difference``, ``effect size of TMMD``."""
    name = measured(score)
    if score.b is None:
        return name
    if score.kind == "effect size":
        return f"effect size of {name}"
    return f"{name}, ahead" if score.kind == "lead" else f"{name} difference"


def subject_of(score: Score) -> str:
    """Return what was scored, as the head of its row says it: ``ours``, ``ours - GVST``."""
    if score.b is None:
        return score.a
    return f"{score.a} {'against' if score.kind == 'lead' else '-'} {score.b}"
