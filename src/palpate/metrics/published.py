"""KID and CMMD: published metrics that are TMMD with other settings.

KID (Binkowski et al., arXiv 1801.01401) is the unbiased MMD^2 with the kernel ``(x.y / d + 1)^3``
on features of Inception, CMMD (Jayasumana et al., arXiv 2401.09603) the biased one with a Gaussian
of bandwidth 10 on embeddings of CLIP; both here over all pairs instead of random subsets.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from palpate.core import Score
from palpate.metrics.kernels import Polynomial
from palpate.metrics.tactile import tmmd


def kid(generated: Any, reference: Any, **options: Any) -> Score:
    """KID between generated and real features, times 1000; lower is better.

    Args:
        generated: (n, d) features; as published, the 2048 pool features of Inception.
        reference: (m, d) features of real images.
        **options: of :func:`palpate.metrics.tmmd`, e.g. ``groups`` and ``reference_groups`` for an
            interval over whole groups, or ``scale=1`` for the plain value.

    Raises:
        PalpateError: as :func:`palpate.metrics.tmmd`.
    """
    settings: dict[str, Any] = {"normalize": False, "permutations": 0} | options
    score = tmmd(generated, reference, kernel=Polynomial(), preset="paper", **settings)
    return _named("KID", score)


def cmmd(generated: Any, reference: Any, **options: Any) -> Score:
    """CMMD between generated and real embeddings, times 1000; lower is better.

    Args:
        generated: (n, d) L2-normalized features; as published, image embeddings of CLIP.
        reference: (m, d) features of real images.
        **options: of :func:`palpate.metrics.tmmd`.

    Raises:
        PalpateError: as :func:`palpate.metrics.tmmd`.
    """
    settings: dict[str, Any] = {"permutations": 0} | options
    return _named("CMMD", tmmd(generated, reference, preset="cmmd", **settings))


def _named(name: str, score: Score) -> Score:
    settings = {k: v for k, v in score.settings.items() if k != "preset"}
    return replace(score, metric=name, settings=settings)
