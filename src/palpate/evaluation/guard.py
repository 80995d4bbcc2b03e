"""The guard: an encoder does not judge images that it was trained on (paper, section 5).

What it was trained on is known by the decoded pixels (:mod:`palpate.encoders.seen`) or, of public
encoders, by the data sets that their authors name. Neither depends on the split: an encoder that
was trained on another split of the same data may judge this one if it has seen none of its images.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from palpate.core import Note, PalpateError, Progress, Split, quiet

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from palpate.data.manifest import Manifest
    from palpate.encoders.encoder_set import EncoderSet, Modality


def guard(
    encoders: EncoderSet,
    modality: Modality,
    images: Manifest | NDArray[Any],
    *,
    split: Split | None = None,
    allow_seen: bool = False,
    progress: Progress = quiet,
) -> list[Note]:
    """What readers must know of every score that an encoder made of these images.

    Args:
        encoders: the set.
        modality: whose encoder judges them, ``vision`` or ``tactile``.
        images: what is judged: a manifest, or (n, h, w, 3) uint8.
        split: of which ``images`` are the test part.
        allow_seen: add a note where the guard would raise.
        progress: called with the number of images compared.

    Raises:
        PalpateError: if the encoder has seen some of the images, or declares their data set.
    """
    from palpate.encoders.encoder import Encoder

    encoder, manifest = Encoder(encoders, modality), None if hasattr(images, "dtype") else images
    facts: Any = getattr(manifest, "facts", {})
    notes: list[Note] = []
    seen = encoder.saw(images, progress=progress)
    dataset = str(facts.get("dataset") or "")
    declared = [name for name in encoder.trained_on if name.lower() in dataset.lower()]
    if seen.any():
        params = {"modality": modality, "seen": int(seen.sum()), "n": len(seen)}
        notes.append(Note("seen-images", params))
    elif declared:
        notes.append(
            Note("seen-dataset", {"modality": modality, "dataset": " and ".join(declared)})
        )
    if notes and not allow_seen:
        got = f"{int(seen.sum()):,} of {len(seen):,} that it was trained on"
        if not seen.any():
            got = f"images of {' and '.join(declared)}, with which its authors trained it"
        raise PalpateError(
            f"The {modality} encoder must judge images that it has not seen",
            got,
            "Judge other images or use another encoder, or allow it: every score then says so",
            example={"allow_seen": True},
        )
    if public := encoders.public(modality):
        params = {"modality": modality, "name": public.name, "license": public.license}
        notes.append(Note("encoder-license", params))
    if modality != "tactile":
        return notes
    card, simulated = encoders.card, getattr(manifest, "synthetic", None)
    if card.get("synthetic") and not simulated:
        notes.append(Note("synthetic-encoder", {"real": simulated is False}))
    public = bool(encoder.trained_on)
    if (
        split is not None
        and not (encoder.knows_seen or public)
        and card.get("split") != split.digest
    ):
        known = card.get("split") is not None
        notes.append(Note("encoder-of-other-split" if known else "encoder-without-split"))
    return notes
