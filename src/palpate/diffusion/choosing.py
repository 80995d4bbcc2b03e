"""Best of n: of several images of one condition, the one that an encoder finds most similar to it.

    k* = argmax_k cos(tactile encoder(image_k), c),    k = 0 .. n - 1

``c`` is the embedding that the image was made from: of its photo, of the text, or of both. Image 0
is the one that is made without choosing; the noise of image k is that of (seed, id, k).

Whoever scores the images with the encoder that chose them measures the choosing, so its digest is
kept with the images, and :func:`palpate.score` rejects it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch.nn.functional import normalize

from palpate.core import PalpateError
from palpate.encoders.embed import embed_images
from palpate.encoders.encoder_set import EncoderSet

if TYPE_CHECKING:
    from torch import Tensor

    from palpate.diffusion.pipeline import TactilePipeline

FIX_ENCODER = "Train one with the generator's encoders as its CLIP, and score with another"


@dataclass(frozen=True)
class Chooser:
    """A tactile encoder that chooses one of n images.

    Attributes:
        encoders: with a tactile encoder.
        n: how many images it chooses from.
    """

    encoders: EncoderSet
    n: int

    @classmethod
    def load(
        cls, n: int, encoder: EncoderSet | str | Path | None, pipeline: TactilePipeline
    ) -> Chooser:
        """Load the encoder, on the device of the pipeline.

        Raises:
            PalpateError: if there is none, or it does not share the generator's embeddings.
        """
        if encoder is None:
            must = "must be given to choose the best of several images"
            raise PalpateError(must, "none", FIX_ENCODER, argument="best_by")
        if not isinstance(encoder, EncoderSet):
            encoder = EncoderSet.load(encoder, device=str(pipeline.device))
        sets = (encoder, pipeline.encoders)
        known = [s.digest("vision") if s and "vision" in s.modalities else None for s in sets]
        if "tactile" not in encoder.modalities or known[0] != known[1] or known[1] is None:
            must = (
                "must hold a tactile encoder that was trained with the generator's vision encoder"
            )
            raise PalpateError(must, "other encoders", FIX_ENCODER, argument="best_by")
        return cls(encoder, n)

    @property
    def settings(self) -> dict[str, Any]:
        """What is kept with the images."""
        return {"best_of": self.n, "chosen_by": self.encoders.digest("tactile")}

    def best(
        self,
        sample: Callable[[Sequence[str]], NDArray[np.uint8]],
        names: Sequence[str],
        photos: Tensor | None,
        text: Tensor | None,
        weight: float,
    ) -> NDArray[np.uint8]:
        """The best image (h, w, 3) of each name.

        Args:
            sample: the images (n, h, w, 3) of names, which decide their noise.
            names: of the samples.
            photos: what :meth:`TactilePipeline.embed` makes of them, or None.
            text: what ``embed_text`` makes of the text of all, or None.
            weight: with both, the share of the photo.
        """
        given = ((photos, weight), (text, 1 - weight))
        # Tokens may follow the embedding.
        parts = [w * (p if p.ndim == 2 else p[:, 0]) for p, w in given if p is not None]
        condition = normalize(sum(parts[1:], parts[0]), dim=1).numpy()
        chosen, most = sample(names), np.full(len(names), -np.inf)
        for k in range(self.n):
            images = sample([f"{name}\n{k}" for name in names]) if k else chosen
            similarity = (embed_images(images, self.encoders) * condition).sum(1)
            better = similarity > most
            chosen = np.where(better[:, None, None, None], images, chosen)
            most = np.maximum(most, similarity)
        return chosen
