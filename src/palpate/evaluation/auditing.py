"""The audit with what lies above it: embeddings of trained encoders, and what leaking costs."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any, cast

from palpate.core import FeatureSet, Progress, Split, quiet
from palpate.data.manifest import MODALITIES, Manifest
from palpate.leakage.auditing import audit as audit_leakage
from palpate.report.results import Audit, Impact


def audit(
    train_or_data: Any,
    test: Any = None,
    *,
    encoder: str | Path | None = None,
    impact: bool = False,
    cache: str | Path | None = None,
    progress: Progress = quiet,
    **options: Any,
) -> Audit:
    """Audit a split as :func:`palpate.leakage.audit` does, by ids of encoders and with its impact.

    Args:
        train_or_data: the train samples, or with ``split`` all samples.
        test: the test samples.
        encoder: an id, or a folder, of encoders whose embeddings replace the images.
        impact: measure what leaking costs in material accuracy, too; needs ``split``.
        cache: folder that keeps decoded images and embeddings.
        progress: callback.
        options: of :func:`palpate.leakage.audit`.

    Raises:
        PalpateError: as :func:`palpate.leakage.audit`, and if the encoders cannot be loaded.
    """
    folder = None if cache is None else Path(cache)

    def embed(samples: Manifest, modality: str) -> FeatureSet:
        from palpate.encoders.embed import embed as embed_samples
        from palpate.encoders.encoder_set import EncoderSet

        encoders = EncoderSet.load(str(encoder))
        return embed_samples(
            samples, encoders, cast("Any", modality), cache=folder, progress=progress
        )

    def measure(samples: Manifest, split: Split, group: str, name: str) -> Impact:
        from palpate.evaluation.impact import impact as measure_impact

        features: Any = "pixels"
        if encoder is not None:
            known = [m for m in MODALITIES if samples.table[m].null_count() < len(samples)]
            features = {f"{m} encoder": embed(samples, m) for m in known}
        return measure_impact(
            samples,
            split,
            group=group,
            features=features,
            name=name,
            cache=folder,
            progress=progress,
        )

    return audit_leakage(
        train_or_data,
        test,
        encoder=None if encoder is None else lambda samples, m: embed(samples, m).features,
        impact=measure if impact else None,
        cache=cache,
        progress=progress,
        **options,
    )


# In the order of leakage.audit, with the types of the two that differ.
_SIGNATURE = inspect.signature(audit_leakage)
_TYPED = inspect.signature(audit).parameters
audit.__signature__ = _SIGNATURE.replace(  # type: ignore[attr-defined]
    parameters=[_TYPED.get(name, p) for name, p in _SIGNATURE.parameters.items()]
)
