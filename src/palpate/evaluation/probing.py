"""What an encoder's embeddings know: a linear probe of the material, and retrieval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from palpate.core import PalpateError, Progress, Score, Split, quiet
from palpate.evaluation.guard import guard
from palpate.evaluation.scoring import load_encoders
from palpate.metrics.probe import fit_probe, material_accuracy, retrieval
from palpate.report.results import Results

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

Modality = Literal["vision", "tactile"]


def probe(  # noqa: PLR0913
    data: Manifest | str | Path,
    split: Split | str | Path,
    *,
    encoder: Any,
    modality: Modality = "tactile",
    group: str = "auto",
    balanced: bool = False,
    top: Sequence[int] = (1, 5),
    seed: int = 0,
    allow_seen: bool = False,
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Results:
    """Score how well embeddings name the material and find the other modality's image.

    Args:
        data: a manifest with materials and images of the modality, or its file or folder.
        split: a split or its file; the probe is fitted to its train part and scored on its test
            part.
        encoder: name or folder of a set of encoders, or an ``EncoderSet``.
        modality: whose encoder.
        group: column whose values stay together in cross-validation and intervals; ``auto`` takes
            what the split kept whole, else the video.
        balanced: average the accuracy over materials instead of samples, and weight the probe's
            rows so.
        top: ranks within which retrieval must find the image of the same sample in the other
            modality (vision for tactile and the other way round); skipped where the data lack it,
            or if empty.
        seed: of the folds of the cross-validation.
        allow_seen: probe an encoder that was trained on some of the test images; every score says
            so.
        cache: folder for embeddings, which an interrupted run finds again.
        progress: called with what is done.

    Returns:
        Material accuracy on the test part, with chance in its ``details``, and retrieval top-k.

    Raises:
        PalpateError: if train has fewer than two materials, images are missing or unreadable, or
            the encoder was trained on test images.
    """
    from palpate.data.manifest import Manifest
    from palpate.encoders.embed import embed

    manifest = Manifest.load(Path(data)) if isinstance(data, str | Path) else data
    split = Split.load(split)
    encoders = load_encoders(encoder, progress)
    if modality not in ("vision", "tactile"):
        fix = "Choose one of the two"
        raise PalpateError("must be vision or tactile", repr(modality), fix, argument="modality")
    column = str(split.rule.get("group", "video")) if group == "auto" else group
    options: dict[str, Any] = {
        "groups": column,
        "cache": None if cache is None else Path(cache),
        "progress": progress,
    }
    train, test = (manifest.part(split, part) for part in ("train", "test"))
    other = "vision" if modality == "tactile" else "tactile"
    retrieves = top and len(test) > 1 and not test.table[other].null_count()
    how: dict[str, Any] = {"split": split, "allow_seen": allow_seen, "progress": progress}
    notes = guard(encoders, modality, test, **how)
    notes += guard(encoders, other, test, **how) if retrieves else []
    train_set, test_set = (embed(part, encoders, modality, **options) for part in (train, test))
    fitted = fit_probe(train_set, balanced=balanced, seed=seed)
    scores: list[Score] = [
        material_accuracy(
            train_set, test_set, probe=fitted, balanced=balanced, seed=seed, split=split.digest
        )
    ]
    if retrieves:
        keys = embed(test, encoders, other, **options)
        name = f"{modality} to {other}"
        scores += retrieval(test_set, keys, top=top, name=name, split=split.digest)
    return Results(
        title=f"Probe of the {modality} encoder",
        scores=[replace(s, notes=[*s.notes, *notes]) for s in scores],
        settings={
            "digests": {
                "manifest": manifest.digest,
                "split": split.digest,
                f"{modality} encoder": encoders.digest(modality),
            },
            "split rule": dict(split.rule),
            "options": {"group": column, "balanced": balanced, "seed": seed},
        },
    )
