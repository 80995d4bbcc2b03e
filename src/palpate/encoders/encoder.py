"""One encoder of a set, for images or texts in any form that people have them in."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateWarning, Progress, quiet, require, require_choice
from palpate.core.hub import PushOptions, at_revision, push
from palpate.data.images import Frames, Preprocess
from palpate.data.manifest import Manifest
from palpate.data.residuals import kind_of
from palpate.encoders.embed import embed, embed_frames, embed_texts, list_images
from palpate.encoders.encoder_set import EncoderSet, Modality
from palpate.encoders.models import pick_device


@dataclass(frozen=True)
class Encoder:
    """The vision, text or tactile encoder of a set: images or texts to embeddings.

    ::

        encoder = Encoder.from_pretrained("palpate/mini", modality="tactile")
        features = encoder.encode("touches/", backgrounds="gel.png")  # (n, 256), L2-normalized
        encoder.saw("test/")  # whether it was trained on these images

    Attributes:
        encoders: the set.
        modality: ``vision``, ``text`` or ``tactile``.
    """

    encoders: EncoderSet
    modality: Modality

    def __post_init__(self) -> None:
        require_choice("modality", self.modality, self.encoders.modalities)

    @classmethod
    def from_pretrained(
        cls,
        source: str | Path,
        *,
        modality: Modality,
        device: str = "auto",
        revision: str | None = None,
    ) -> Encoder:
        """Load one encoder of a saved set.

        Args:
            source: a shipped name (``palpate/mini``), a folder of ``palpate train encoder`` or of
                transformers, a file of a public tactile encoder, or a hub id; see
                :meth:`EncoderSet.load`.
            modality: ``vision``, ``text`` or ``tactile``.
            device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
            revision: branch, tag or commit of a hub id; ``owner/name@revision`` is the same.

        Raises:
            PalpateError: if there is no such set, or it has no such encoder.
        """
        source = at_revision(source, revision)
        return cls(EncoderSet.load(source, device=str(pick_device(device))), modality)

    def push_to_hub(self, repo_id: str, **options: Unpack[PushOptions]) -> str:
        """Put the whole set on the hub, with its cards; return the address.

        Args:
            repo_id: ``owner/name``; made if it is not there.
            options: ``private``, ``revision`` (a branch), ``token``.

        Raises:
            PalpateError: if the hub is out of reach or rejects it, or the encoder is a public one.
        """
        return push(self.encoders.save, repo_id, **options)

    @property
    def dim(self) -> int:
        """Width of the embeddings."""
        return self.encoders.width(self.modality)

    @property
    def digest(self) -> str:
        """SHA-256 of weights, architecture and preprocessing."""
        return self.encoders.digest(self.modality)

    @property
    def preprocess(self) -> Preprocess:
        """How it prepares images; not of a text encoder."""
        return self.encoders.preprocess(self.modality)

    @property
    def license(self) -> str | None:
        """The license of its weights: ``unknown`` if others state none, None if you state none."""
        origin, encoders = self.encoders.origin(self.modality), self.encoders
        card = encoders.card if self.modality == "tactile" else encoders.clip_card
        return origin.license if origin else card.get("license")

    @property
    def trained_on(self) -> tuple[str, ...]:
        """Data sets that the encoder's authors trained it on."""
        origin = self.encoders.origin(self.modality)
        return origin.trained_on if origin else ()

    def saw(
        self, inputs: Any, *, batch: int = 128, progress: Progress = quiet
    ) -> NDArray[np.bool_]:
        """Whether the encoder was trained on images, by their decoded pixels, whatever their names.

        Returns:
            (n,) booleans; all false where the encoder's images are not known (public ones).
        """
        images = inputs if isinstance(inputs, Manifest) else list_images(inputs)
        return self.encoders.saw(self.modality, images, batch=batch, progress=progress)

    def encode(
        self, inputs: Any, *, backgrounds: Any = None, batch: int = 128, progress: Progress = quiet
    ) -> NDArray[np.float32]:
        """Embeddings of images or texts.

        Args:
            inputs: for images: a file or a folder of them, a PIL image, a list of files or PIL
                images, a uint8 array (n, h, w, 3), a tensor (n, 3, h, w) of bytes or of floats in
                [0, 1], or a manifest. For text: a string, a list of strings, or a manifest.
            backgrounds: no-contact images in any of these forms, one for all or one each, for a
                ruler, or another encoder that subtracts them; without, a ruler takes off low
                frequencies, and warns. A manifest has its own.
            batch: images or texts at a time; changes the result by rounding only (1e-5).
            progress: called with the number of inputs done.

        Returns:
            (n, dim) float32, L2-normalized, in the order of the inputs; a folder in the order of
            its paths.

        Raises:
            PalpateError: if an image is unreadable, the inputs are of another kind, or backgrounds
                are neither one nor one each.
        """
        ruled = self.modality == "tactile" and self.preprocess.residual
        if isinstance(inputs, Manifest):
            _warn(ruled and kind_of(inputs) == "low-pass")
            return np.asarray(embed(inputs, self.encoders, self.modality, batch=batch).features)
        if self.modality == "text":
            texts = [inputs] if isinstance(inputs, str) else list(inputs)
            return embed_texts(texts, self.encoders, batch=batch, progress=progress)
        images = list_images(inputs)
        gels = [] if backgrounds is None else list_images(backgrounds)
        gels = gels * len(images) if len(gels) == 1 else gels
        must, got = "must be one image, or one for each", f"{len(gels)} for {len(images)}"
        require(len(gels) in (0, len(images)), "backgrounds", must, got)
        _warn(ruled and not gels)
        frames = Frames.alone(images, gels if self.preprocess.subtract else [])
        return embed_frames(frames, self.encoders, self.modality, batch, progress)


def _warn(low_pass: bool) -> None:
    if low_pass:
        text = "A ruler without no-contact images reads faint contacts badly: pass backgrounds"
        warnings.warn(text, PalpateWarning, stacklevel=3)
