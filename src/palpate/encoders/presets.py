"""Presets of the encoders: size and training course, complete and typed, with what they cost on the row.

``paper`` follows paper section 3 and, where that is silent, TVL's published recipe (recipes section 3): 200 epochs, batch 256, AdamW
(0.9, 0.95), weight decay 0.05, 10 epochs of warm-up, half a cosine to zero, learning rate 1.5e-4 x batch / 256 = 1.5e-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from transformers import CLIPConfig, CLIPVisionConfig

from palpate.core import PalpateError
from palpate.encoders.preprocess import Augment
from palpate.training.loop import LoopOptions

Targets = Literal["diagonal", "identical-text"]


@dataclass(frozen=True)
class Size:
    """A transformer: width, layers, attention heads; the feed-forward layer is four times as wide."""

    width: int
    layers: int
    heads: int


@dataclass(frozen=True)
class Course:
    """A training course; ``warmup`` is a fraction of all steps, everything else as in :class:`LoopOptions`."""

    epochs: float
    batch: int
    lr: float
    warmup: float = 0.05
    weight_decay: float = 0.05
    betas: tuple[float, float] = (0.9, 0.95)
    clip: float | None = 1.0
    augment: Augment = field(default_factory=Augment)

    def options(self, n: int, seed: int, epochs: float | None = None) -> LoopOptions:
        """The options for ``n`` training rows; a batch is never larger than the set, where rows would meet their own copies."""
        batch = max(1, min(self.batch, n))
        steps = max(1, math.ceil((self.epochs if epochs is None else epochs) * n / batch))
        return LoopOptions(
            steps,
            batch,
            self.lr,
            warmup=round(self.warmup * steps),
            weight_decay=self.weight_decay,
            clip=self.clip,
            seed=seed,
            betas=self.betas,
        )


@dataclass(frozen=True)
class EncoderPreset:
    """A complete set of encoders.

    Attributes:
        name: for ``--preset``.
        pretrained: hub id or folder of the frozen CLIP, or None: a fresh one is trained first.
        image, patch: sides in pixels of what the tactile encoder (and a fresh vision encoder) sees, and of its patches.
        touch: size of the tactile encoder.
        vision, text, dim, vocabulary, context: of a fresh CLIP; ``dim`` is the width of the common space, ``context`` in tokens.
        touch_course, clip_course: how each is trained; None without a fresh CLIP.
        targets: ``diagonal`` is the paper's loss; ``identical-text`` counts rows with equal captions as positives of each other in
            the two text pairs (see :func:`palpate.encoders.contrastive.soft_targets`).
        own_statistics: normalize pixels by the training side's mean and sd instead of CLIP's constants.
        cost: what it takes, and where that was measured.
    """

    name: str
    pretrained: str | None
    image: int
    patch: int
    touch: Size
    touch_course: Course
    cost: str
    vision: Size | None = None
    text: Size | None = None
    clip_course: Course | None = None
    dim: int = 128
    vocabulary: int = 1024
    context: int = 32
    targets: Targets = "identical-text"
    own_statistics: bool = True

    def touch_config(self, dim: int) -> CLIPVisionConfig:
        """The tactile encoder's configuration for a common space of width ``dim``."""
        return _vision(self.touch, self.image, self.patch, dim)

    def clip_config(self, vocabulary: int) -> CLIPConfig:
        """The fresh CLIP's configuration; ids of special tokens as in :mod:`palpate.encoders.tokenizer`.

        Raises:
            PalpateError: if the preset takes a pretrained CLIP.
        """
        if self.vision is None or self.text is None:
            raise PalpateError(
                f"The preset {self.name} must describe a fresh CLIP",
                f"it takes {self.pretrained}",
                "Load that one, or use the preset mini",
            )
        vision = _vision(self.vision, self.image, self.patch, self.dim)
        text = {
            "hidden_size": self.text.width,
            "intermediate_size": 4 * self.text.width,
            "num_hidden_layers": self.text.layers,
            "num_attention_heads": self.text.heads,
            "projection_dim": self.dim,
            "vocab_size": vocabulary,
            "max_position_embeddings": self.context,
            "pad_token_id": 0,
            "bos_token_id": 1,
            "eos_token_id": 3,
        }
        return CLIPConfig(text_config=text, vision_config=vision.to_dict(), projection_dim=self.dim)


def _vision(size: Size, image: int, patch: int, dim: int) -> CLIPVisionConfig:
    return CLIPVisionConfig(
        hidden_size=size.width,
        intermediate_size=4 * size.width,
        num_hidden_layers=size.layers,
        num_attention_heads=size.heads,
        image_size=image,
        patch_size=patch,
        projection_dim=dim,
    )


#: Photos of a surface have no up, and text does not care: turns and flips are free for the vision-text pair. For touch they stay off.
_MINI_VIEW = Augment(crop=0.2, gain=0.2, offset=0.1, flips=True, quarter_turns=True)
_MINI_CLIP = Course(epochs=6, batch=32, lr=1e-3, weight_decay=0.1, augment=_MINI_VIEW)
_MINI_TOUCH = Course(epochs=16, batch=128, lr=2e-3, weight_decay=0.1)
_TINY = Course(epochs=2, batch=8, lr=1e-3)
_TVL = Course(epochs=200, batch=256, lr=1.5e-4, clip=None)
_DATACOMP = "laion/CLIP-ViT-L-14-DataComp.XL-s13B-b90K"


PRESETS: dict[str, EncoderPreset] = {
    p.name: p
    for p in (
        #             name     pretrained  px  patch  tactile encoder        course        cost
        EncoderPreset(
            "tiny",
            None,
            16,
            8,
            Size(16, 1, 2),
            _TINY,
            "seconds; for tests",
            vision=Size(16, 1, 2),
            text=Size(16, 1, 2),
            clip_course=_TINY,
            dim=8,
            vocabulary=300,
            context=16,
        ),
        EncoderPreset(
            "mini",
            None,
            64,
            8,
            Size(96, 3, 3),
            _MINI_TOUCH,
            "4,000 + 900 frames: about 65 + 33 CPU-s on one x86-64 core (AVX2)",
            vision=Size(96, 3, 3),
            text=Size(96, 2, 3),
            clip_course=_MINI_CLIP,
            dim=128,
            vocabulary=1024,
            context=32,
        ),
        EncoderPreset(
            "paper",
            _DATACOMP,
            224,
            14,
            Size(1024, 24, 16),
            _TVL,
            "200 epochs on one A100 (the paper; hours not stated)",
            dim=768,
            targets="diagonal",
            own_statistics=False,
        ),
    )
}


def preset(name: str) -> EncoderPreset:
    """A preset by name.

    Raises:
        PalpateError: if there is none of that name.
    """
    if name not in PRESETS:
        raise PalpateError(
            f"A preset of the encoders must be one of {', '.join(PRESETS)}",
            repr(name),
            "Choose one of these",
        )
    return PRESETS[name]
