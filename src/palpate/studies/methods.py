"""The generators that a study compares: name -> what differs, and what drives it.

All of them but :data:`SHIPPED` are trained from random weights with the same data, U-Net, schedule,
batch and number of steps; the row of :data:`METHODS` is all that differs. Another one is another
row, or a function that makes images (``Method.make``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import FeatureSet, Score
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.gels import gels_of
from palpate.diffusion.generation import generate
from palpate.diffusion.presets import DiffusionPreset
from palpate.studies.graph import Work
from palpate.studies.names import BACKGROUND, BEST, GVST, OURS, SHIPPED, VQ

Images = NDArray[np.uint8]
Rows = Sequence[int] | NDArray[np.intp]
#: Text conditions the training, with nothing that bridges to photos.
BARE: Mapping[str, Any] = {"source": "text", "gap": "none", "noise": 0.0}


@dataclass(frozen=True)
class Setting:
    """What makes images: a split of one data set.

    Attributes:
        train, test: its parts; one image is made for each sample of ``test``.
        work: cache, device, progress, and the stage's folder.
        size: side of the images in pixels.
        seed: of weights, order and noise.
        steps: optimizer steps of each compared method.
        clip: frozen vision and text encoders: a shipped name, hub id or folder.
        autoencoder: folder of the autoencoder of this split.
    """

    train: Manifest
    test: Manifest
    work: Work
    size: int
    seed: int = 0
    steps: int = 0
    clip: str = ""
    autoencoder: Path | None = None

    def pixels(self, part: Manifest, column: str = "tactile") -> Images:
        """One image column as squares (n, size, size, 3); gels that are absent are the stock gel.

        Raises:
            PalpateError: if a sample has no such image.
        """
        work = self.work
        if column == "background":
            like = gels_of(self.train, self.size, work.cache, work.progress)
            return gels_of(part, self.size, work.cache, work.progress, like=like)
        return cached_images(part, column, self.size, work.cache, work.progress)


#: Images (n, size, size, 3) of the samples of ``setting.test``, in their order, or rows (n,) of
#: ``setting.train`` whose real images stand for them; a control may be None where the data do not
#: allow it.
Make = Callable[[Setting], Images | Rows | None]


@dataclass(frozen=True)
class Judged:
    """What a metric sees: generated images of the test samples, and the real ones, in one order.

    Attributes:
        subject: name of the method or control.
        images, real: (n, size, size, 3) uint8.
        features, reference: their embeddings by the tactile encoder, with materials and videos.
        seed: of the training.
    """

    subject: str
    images: Images
    real: Images
    features: FeatureSet
    reference: FeatureSet
    seed: int


#: One score of the images of one subject; its ``metric`` is a further column of the tables.
Metric = Callable[[Judged], Score]


@dataclass(frozen=True)
class Method:
    """A generator.

    Attributes:
        name: in the tables.
        text: what it is, in one sentence.
        condition: fields of :class:`~palpate.diffusion.options.ConditionPolicy` that differ from
            the preset's.
        background: the denoiser sees the no-contact image.
        vq: behind the paper's kind of autoencoder, which codes the gel with the touch, instead of
            the one that is given the no-contact image.
        text_of: the method whose training it shares, driven by each sample's own text.
        make: makes the images in place of a diffusion model, in any way.
    """

    name: str
    text: str
    condition: Mapping[str, Any] = field(default_factory=dict[str, Any])
    background: bool = False
    vq: bool = False
    text_of: str = ""
    make: Make | None = None

    def preset(self, base: DiffusionPreset) -> DiffusionPreset:
        """The preset with what differs."""
        return replace(base, condition=replace(base.condition, **self.condition))


def shipped(setting: Setting) -> Images:
    """Images of the generator that ships, which is not trained in a study."""
    work = setting.work
    generated = generate(
        setting.test, model=SHIPPED, seed=setting.seed, device=work.device, progress=work.progress
    )
    side = (setting.size, setting.size)
    images = (i.resize(side, Image.Resampling.BOX) for i in generated.images)
    return np.stack([np.asarray(image) for image in images])


METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method(OURS, "Trained on texts, driven by the photo's embedding in their place.", BARE),
        Method("Ours, by text", "Ours, driven by each sample's own text.", BARE, text_of=OURS),
        Method(
            GVST,
            "The same token from photos in training, too: no text.",
            {**BARE, "source": "vision"},
        ),
        Method(
            "GVST as published",
            "A residual network, trained along, makes a map of 8 x 8 tokens of the photo.",
            {**BARE, "source": "resnet"},
        ),
        Method(
            BEST,
            "Preset mini: tokens of text and photo, both from the nearest training pairs; noise.",
        ),
        Method(VQ, "Ours, with an autoencoder that is not given the gel.", BARE, vq=True),
        Method(
            BACKGROUND,
            "Ours, VQ, whose denoiser also sees the no-contact image.",
            BARE,
            background=True,
            vq=True,
        ),
        Method(
            SHIPPED,
            "The generator that ships: as best, trained longer, on other synthetic worlds. Its "
            "training is not that of the others.",
            make=shipped,
        ),
    )
}
