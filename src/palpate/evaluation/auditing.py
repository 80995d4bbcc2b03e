"""The audit with what lies above it: embeddings of trained encoders, and what leaking costs."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core import FeatureSet, Note, Progress, Split, quiet, require
from palpate.data.manifest import SIDES, Manifest
from palpate.leakage.auditing import audit as audit_leakage
from palpate.report.records import Impact
from palpate.report.results import Audit, Call


def audit(
    train_or_data: Any,
    test: Any = None,
    *,
    encoder: str | Path | None = None,
    impact: bool = False,
    allow_seen: bool = False,
    cache: str | Path | None = None,
    progress: Progress = quiet,
    **options: Any,
) -> Audit:
    """Audit a split as :func:`palpate.leakage.audit` does, by ids of encoders and with its impact.

    Args:
        train_or_data: the train samples, or with ``split`` all samples.
        test: the test samples.
        split: a split of ``train_or_data``, instead of ``test``.
        by: what train and test must not share: a column, or ``auto`` for the video or what is known
            instead of it.
        images: compare image files and their content, not only tables.
        false_positives: rate at which unrelated images may pass for near-duplicates, in (0, 0.1].
        encoder: an id or folder of encoders, by which the impact is measured in place of pixels.
        impact: measure what leaking costs in material accuracy, too; needs ``split``.
        allow_seen: measure it by embeddings of an encoder that was trained on some of the samples;
            every output says so.
        cache: folder that keeps decoded images and embeddings.
        progress: callback.
        options: all others are those of :func:`palpate.leakage.audit`.

    Returns:
        The audit: print it, or ``.to_html(path)``, ``.to_frame()``, ``.to_json()``.

    Raises:
        PalpateError: as :func:`palpate.leakage.audit`, and if the encoders cannot be loaded.
    """
    require(impact or encoder is None, "encoder", "must come with the impact", encoder)
    arguments = {"train_or_data": train_or_data, "test": test, "encoder": encoder}
    arguments |= {"impact": impact, "allow_seen": allow_seen, **options}
    call = Call.of("audit", audit, arguments)
    folder = None if cache is None else Path(cache)
    encoders: Any = None
    if encoder is not None:  # a failure within the impact is a note: the audit itself is not lost
        from palpate.encoders.guard import load_encoders

        encoders = load_encoders(encoder, progress)

    def measure(samples: Manifest, split: Split, group: str, name: str) -> Impact:
        from palpate.evaluation.impact import impact as measure_impact

        features: Any = "pixels"
        notes: list[Note] = []
        seen: list[str] = []
        if encoders is not None:
            from palpate.encoders.embed import embed
            from palpate.encoders.guard import backed, guard

            features = dict[str, FeatureSet]()
            # every sample is in the test part of some leak-free split
            judged = samples.part(split, "train", "test")
            with backed(samples, encoders, folder) as (ruled, notes):
                for m in encoders.modalities:
                    if m not in SIDES or not judged.table[m].count():
                        continue
                    new = guard(encoders, m, judged, allow_seen=allow_seen, progress=progress)
                    notes += new
                    if any(note.code in ("seen-images", "seen-dataset") for note in new):
                        seen.append(f"{m} encoder")
                    rows = embed(ruled, encoders, m, cache=folder, progress=progress)
                    features[f"{m} encoder"] = rows
        result = measure_impact(
            samples,
            split,
            group=group,
            features=features,
            name=name,
            seen=seen,
            cache=folder,
            progress=progress,
        )
        return replace(result, notes=[*notes, *result.notes])

    result = audit_leakage(
        train_or_data,
        test,
        impact=measure if impact else None,
        cache=cache,
        progress=progress,
        **options,
    )
    return replace(result, call=call)


# In the order of leakage.audit, with the type of the one that differs, and the two more.
_SIGNATURE = inspect.signature(audit_leakage)
_TYPED = inspect.signature(audit).parameters
_ALL = {**_SIGNATURE.parameters, **{name: _TYPED[name] for name in ("encoder", "allow_seen")}}
audit.__signature__ = _SIGNATURE.replace(  # type: ignore[attr-defined]
    parameters=[_TYPED.get(name, p) for name, p in _ALL.items()]
)
