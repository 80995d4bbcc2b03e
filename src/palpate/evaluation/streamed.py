"""TMMD of embeddings that are too long to be held: rows pass by once, and only moments are kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from palpate import __version__
from palpate.core import PalpateError, Progress, Score, quiet
from palpate.evaluation.comparing import Asked, Outcome, named
from palpate.metrics import PRESETS, distance
from palpate.metrics.scored import TOLD


def stream_tmmd(
    generators: Mapping[str, NDArray[Any]],
    reference: NDArray[Any],
    asked: Asked,
    *,
    progress: Progress = quiet,
) -> Outcome:
    """TMMD of arrays that are too long to be held: rows pass by once, and only moments are kept.

    Args:
        generators: name -> (n, d), possibly mapped.
        reference: (m, d).
        asked: presets and bandwidths; ``backend="auto"`` is moments here.
        progress: told how many scores are done.

    Raises:
        PalpateError: for what would need all pairs or all rows in memory, or as :func:`palpate.metrics.distance`.
    """
    presets = asked.presets_for(grouped=False)
    if "grouped" in presets or asked.estimator == "grouped":
        raise PalpateError(
            "The grouped estimator must know the group of every row",
            "an array without",
            "Pass --groups, or --presets paper",
        )
    if "multi" in asked.sigmas and asked.backend != "blocked":
        got = f"{len(reference):,} rows"
        raise PalpateError(
            "--sigma multi must form all pairs",
            got,
            "Pass --sigma median or a number; or --backend blocked, and wait",
        )
    if asked.normalize is True:
        raise PalpateError(
            "Rows that are streamed must be L2-normalized already",
            "--normalize yes",
            "Normalize them when saving",
        )
    out = Outcome(
        remarks=[
            "Streamed, as there are too many rows to hold: TMMD alone, without interval, p-value or companions"
        ]
    )
    todo = [
        (name, x, preset, sigma)
        for name, x in generators.items()
        for preset in presets
        for sigma in asked.sigmas
    ]
    for k, (name, x, preset, sigma) in enumerate(todo):
        progress("streaming", k, len(todo))
        backend: Any = "moments" if asked.backend == "auto" else asked.backend
        estimator: Any = asked.estimator or PRESETS[preset].estimator
        try:
            d = distance(
                x,
                reference,
                sigma=sigma,
                estimator=estimator,
                normalize=asked.normalize,
                backend=backend,
                names=(f"The features of {name!r}", "The reference features"),
            )
        except PalpateError as error:
            if "normalize=True" not in error.fix:
                raise
            fix = "Divide the rows by their norm when saving them, or pass --normalize no"  # streamed rows are not copied
            raise PalpateError(error.must, error.got, fix) from None
        if d.bound > TOLD and asked.backend == "auto":
            must = "Streamed rows need a bandwidth that is wide against them"
            raise PalpateError(
                must,
                f"an error of up to {d.bound:.2g} at sigma {sigma}",
                "Pass --backend blocked and wait, or a larger --sigma",
            )
        if d.bound > TOLD:
            words = f"sigma {sigma}" if isinstance(sigma, str) else f"sigma {sigma:g}"
            out.remarks.append(
                f"TMMD of {name}, {words}: within {d.bound:.2g} of the exact value, as the bandwidth is narrow for moments"
            )
        score = Score(
            "TMMD",
            name,
            d.value,
            estimator=d.estimator,
            bandwidth=d.bandwidth,
            scale=d.scale,
            n=d.m,
            m=d.n,
            split=asked.split,
            settings={**d.kernel, "preset": preset, "normalize": asked.normalize},
            note="No interval: neither groups nor repeats are known"
            + (f"; within {d.bound:.2g} of the exact value" if d.bound > TOLD else ""),
            details={"backend": d.backend, "bound": d.bound, "version": __version__},
        )
        out.scores.append(named(score, preset, sigma, asked))
    progress("streaming", len(todo), len(todo))
    return out
