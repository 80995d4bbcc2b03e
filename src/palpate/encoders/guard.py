"""The encoders that judge, and the guard: none judges images that it was trained on."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import Note, PalpateError, Progress, Split, quiet
from palpate.encoders.models import find_encoder, parts_of

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest
    from palpate.encoders.encoder_set import EncoderSet, Modality


def load_encoders(encoder: Any, progress: Progress, *, alone: bool = False) -> Any:
    """An ``EncoderSet``, loaded where it is a name or a folder; ``alone`` as of its ``load``."""
    if encoder is None or not isinstance(encoder, str | Path):
        return encoder
    progress(f"loading {encoder}", 0, 0)
    for part in parts_of(encoder):
        find_encoder(part)  # a wrong name answers at once; torch takes seconds to import
    from palpate.encoders.encoder_set import EncoderSet

    encoders = EncoderSet.load(encoder, device="auto", alone=alone)
    progress(f"loading {encoder}", 1, 1)
    return encoders


@contextmanager
def backed(
    manifest: Manifest, encoders: EncoderSet | None, cache: str | Path | None
) -> Generator[tuple[Manifest, list[Note]]]:
    """Samples with backgrounds of one kind, where a ruler of ``encoders`` looks at their touches,
    and a note on the kind; others as they are.

    Args:
        manifest: the samples.
        encoders: what embeds them; None where no touch is embedded.
        cache: folder for medians; None: one that is gone after the statements inside.
    """
    seeing = encoders is not None and "tactile" in encoders.modalities
    ruled = encoders is not None and seeing and encoders.preprocess("tactile").residual
    if not (ruled and any(manifest.column("tactile"))):
        yield manifest, []
        return
    from palpate.data.residuals import with_gels

    with TemporaryDirectory() as folder:
        kind, (samples,) = with_gels(manifest, [], Path(cache or folder))
        yield samples, [Note("background-kind", {"kind": kind})]


def guard(
    encoders: EncoderSet,
    modality: Modality,
    images: Manifest | NDArray[Any],
    *,
    split: Split | None = None,
    allow_seen: bool = False,
    progress: Progress = quiet,
) -> list[Note]:
    """Raise if an encoder was trained on the images that it judges (paper, section 5).

    What it was trained on is known by the decoded pixels or, of public encoders, by the data sets
    that their authors name. Neither depends on the split: an encoder that was trained on another
    split of the same data may judge this one if it has seen none of its images.

    Args:
        encoders: the set.
        modality: whose encoder judges; of a text encoder no image is known.
        images: what is judged: a manifest, or (n, h, w, 3) uint8.
        split: of which ``images`` are the test part.
        allow_seen: add a note where the guard would raise.
        progress: called with the number of images compared.

    Returns:
        What readers must know of every score that the encoder makes of these images.

    Raises:
        PalpateError: if the encoder has seen some of the images, or declares their data set.
    """
    from PIL import Image

    judged: Any = [*map(Image.fromarray, images)] if isinstance(images, np.ndarray) else images
    origin, seen = encoders.origin(modality), encoders.saw(modality, judged, progress=progress)
    dataset = str(getattr(images, "facts", {}).get("dataset") or "").lower()
    declared = [name for name in (origin.trained_on if origin else ()) if name.lower() in dataset]
    notes, got = list[Note](), ""
    if count := int(seen.sum()):
        notes.append(Note("seen-images", {"modality": modality, "seen": count, "n": len(seen)}))
        got = f"{count:,} of {len(seen):,} that it was trained on"
    elif dataset := " and ".join(declared):
        notes.append(Note("seen-dataset", {"modality": modality, "dataset": dataset}))
        got = f"images of {dataset}, with which its authors trained it"
    if notes and not allow_seen:
        must = f"The {modality} encoder must judge images that it has not seen"
        fix = "Judge other images or use another encoder, or allow it: every score then says so"
        raise PalpateError(must, got, fix, example={"allow_seen": True})
    if origin:
        params = {"modality": modality, "name": origin.name, "license": origin.license}
        notes.append(Note("encoder-license", params))
        if origin.trained_on and not declared and not getattr(images, "synthetic", False):
            params = {"modality": modality, "sets": ", ".join(origin.trained_on)}
            notes.append(Note("pretraining-sets", params))
    if modality != "tactile":
        return notes
    card, simulated = encoders.card, getattr(images, "synthetic", None)
    if card.get("synthetic") and not simulated:
        notes.append(Note("synthetic-encoder", {"real": simulated is False}))
    unknown = origin is None and not encoders.knows_seen(modality)
    if split is not None and unknown and card.get("split") != split.digest:
        other = card.get("split") is not None
        notes.append(Note("encoder-of-other-split" if other else "encoder-without-split"))
    return notes
