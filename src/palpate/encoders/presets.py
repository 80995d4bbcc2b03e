"""Presets of the encoders: size, training course and cost.

``paper`` follows paper section 3 and, where that is silent, TVL's published recipe (recipes section
3): 200 epochs, batch 256, AdamW (0.9, 0.95), weight decay 0.05, 10 epochs of warm-up, half a cosine
to zero, learning rate 1.5e-4 x batch / 256 = 1.5e-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from palpate.core import require, require_choice
from palpate.training.options import LoopOptions

if TYPE_CHECKING:
    from transformers import CLIPConfig, CLIPVisionConfig

    from palpate.data.images import Preprocess

#: ``diagonal``: the paper's, every other row is a negative. ``identical-text``: rows with equal
#: captions share the target mass of the two text pairs. ``soft-text``: TVL's target of the text
#: pairs, softmax(t_i.t_j / 0.05).
Targets = Literal["diagonal", "identical-text", "soft-text"]


@dataclass(frozen=True)
class Augment:
    """Random changes of training images; never used in evaluation (recipes, pitfall 5).

    A random window of the square, resampled bilinearly, then ``gain * x + offset`` per image.

    Attributes:
        crop: the window's side is 1 - ``crop`` to 1 of the image's.
        gain: standard deviation of the logarithm of the contrast factor.
        offset: standard deviation of the brightness offset; white is 1.
        flips: mirror each axis with probability 1/2. Off: a flip must hit both images of a pair or
            none, and it swaps the sides that a sensor's colored lights come from.
        quarter_turns: rotate by a random multiple of 90 degrees. Off, for the same reason.
    """

    crop: float = 0.1
    gain: float = 0.1
    offset: float = 0.05
    flips: bool = False
    quarter_turns: bool = False

    def __post_init__(self) -> None:
        for name, top in {"crop": 0.99, "gain": 10, "offset": 1}.items():
            value, must = getattr(self, name), f"must lie in [0, {top}]"
            require(0 <= value <= top, name, must, value, fix="Choose another value")


@dataclass(frozen=True)
class Size:
    """A transformer; its feed-forward layer is four times as wide.

    Attributes:
        width: of a token, a multiple of the heads [channels].
        layers: blocks of attention and feed-forward layer.
        heads: of attention.
    """

    width: int
    layers: int
    heads: int

    def __post_init__(self) -> None:
        possible = min(self.width, self.layers, self.heads) >= 1 and self.width % self.heads == 0
        got = f"width {self.width}, layers {self.layers}, heads {self.heads}"
        must = "The width of a transformer must be a multiple of its heads, all at least 1"
        require(possible, None, must, got, fix="Choose other numbers")


#: Layers of the learned ruler, and the least side of its images in pixels.
GEL_LAYERS, GEL_LEAST = 5, 32


@dataclass(frozen=True)
class Gel:
    """The learned ruler of residuals (:mod:`palpate.encoders.gel`).

    Attributes:
        widths: of its layers [channels].
    """

    widths: tuple[int, ...] = (16, 32, 64, 128, 128)


@dataclass(frozen=True)
class Course:
    """A training course.

    Attributes:
        epochs: passes over the train part; None where there are steps.
        batch: of a step, over all processes [rows].
        lr: peak learning rate; a cosine takes it to zero.
        warmup: share of the steps in which the learning rate rises.
        weight_decay: of AdamW.
        betas: decay rates of AdamW's two moments.
        clip_norm: largest gradient norm, or None.
        augment: see there.
        evaluations: how often the held-out part is evaluated, evenly spread over the steps.
        patience: stop after as many evaluations without a better held-out loss; None: never.
        keep: which weights become the result: those of the best held-out loss, where there is a
            held-out part, or the last.
        steps: without epochs, whatever the size of the train part [optimizer steps].
    """

    epochs: float | None
    batch: int
    lr: float
    warmup: float = 0.05
    weight_decay: float = 0.05
    betas: tuple[float, float] = (0.9, 0.95)
    clip_norm: float | None = 1.0
    augment: Augment = field(default_factory=Augment)
    evaluations: int = 10
    patience: int | None = None
    keep: Literal["last", "best"] = "best"
    steps: int = 0

    def __post_init__(self) -> None:
        must, fix = "must lie in [0, 1], as a share of the steps", "Choose another value"
        require(0 <= self.warmup <= 1, "warmup", must, self.warmup, fix=fix)
        must = "must be at least 1 where there are no epochs"
        require(self.steps >= 1 or self.epochs is not None, "steps", must, self.steps, fix=fix)

    def options(self, n: int, seed: int) -> LoopOptions:
        """Return the options for ``n`` rows; no batch is larger than the set."""
        batch = min(self.batch, n)
        steps = self.steps
        if self.epochs is not None:
            steps = max(1, math.ceil(self.epochs * n / max(1, batch)))
        return LoopOptions(
            steps,
            batch,
            self.lr,
            warmup=round(self.warmup * steps),
            weight_decay=self.weight_decay,
            clip_norm=self.clip_norm,
            seed=seed,
            betas=self.betas,
            evaluations=self.evaluations,
            patience=self.patience,
            keep=self.keep,
        )


@dataclass(frozen=True)
class EncoderPreset:
    """A complete set of encoders.

    Attributes:
        name: of the preset.
        pretrained: hub id or folder of the frozen CLIP, or None: a fresh one is trained first.
        image: side of what the tactile (and a fresh vision) encoder sees [px].
        patch: side of its patches [px].
        tactile: size of the tactile encoder; Gel is the learned ruler.
        vision, text, dim, vocabulary, context: of a fresh CLIP; ``dim`` is the width of the shared
            space, ``context`` in tokens.
        tactile_course, clip_course: how each is trained; None without a fresh CLIP.
        targets: what rows with equal captions are to each other: ``diagonal`` is the paper's loss,
            every other row is a negative; ``identical-text`` counts equal captions as positives;
            ``soft-text`` is TVL's.
        fitting: how tactile images become squares: ``crop`` takes the center, ``pad`` the whole
            between black borders, ``squash`` the whole.
        turn: ``left`` turns tactile images counterclockwise, ``portrait`` those that are wide.
        alone: learn from touches alone, without photos, texts and labels, starting from the
            encoder of ``pretrained``.
        data_statistics: normalize pixels by the training part's mean and deviation instead of
            CLIP's constants.
        cost: what it takes, and where that was measured.
        score: what it has reached, and where.
    """

    name: str
    pretrained: str | None
    image: int
    patch: int
    tactile: Size | Gel
    tactile_course: Course
    cost: str
    score: str
    vision: Size | None = None
    text: Size | None = None
    clip_course: Course | None = None
    dim: int = 128
    vocabulary: int = 1024
    context: int = 32
    targets: Targets = "identical-text"
    fitting: Literal["crop", "pad", "squash"] = "crop"
    turn: Literal["none", "left", "portrait"] = "none"
    alone: bool = False
    data_statistics: bool = True

    def __post_init__(self) -> None:
        fits = self.patch >= 1 and self.image >= 1 and self.image % self.patch == 0
        must, fix = f"must be a multiple of the patches, {self.patch}", "Choose other sides"
        require(fits, "image", must, self.image, fix=fix)
        ruler = not self.alone or (isinstance(self.tactile, Gel) and self.pretrained is not None)
        fix = "Change another preset"
        require(ruler, "alone", "needs a learned ruler to go on from", self.alone, fix=fix)
        if isinstance(self.tactile, Gel):
            layers = len(self.tactile.widths)
            require(layers == GEL_LAYERS, "widths", f"must be {GEL_LAYERS}", layers, fix=fix)
            least = f"must be {GEL_LEAST} or more for a ruler, which pools over positions"
            require(self.image >= GEL_LEAST, "image", least, self.image, 96)
            plain = (self.fitting, self.turn) == ("crop", "none")
            got, must = f"{self.fitting} and {self.turn}", "must be crop and none for a ruler"
            require(plain, "fitting", must, got, "crop")

    @property
    def preprocess(self) -> Preprocess:
        """How tactile images are prepared; their statistics are the training part's."""
        from palpate.data.images import Preprocess
        from palpate.data.residuals import Residual

        if isinstance(self.tactile, Gel):
            return Residual(self.image, self.image)
        return Preprocess(self.image, self.image, fitting=self.fitting, turn=self.turn)

    def tactile_config(self, dim: int) -> Any:
        """The tactile encoder's configuration for a shared space of width ``dim``."""
        assert isinstance(self.tactile, Size)
        return _vision(self.tactile, self.image, self.patch, dim)

    def clip_config(self, vocabulary: int) -> CLIPConfig:
        """Return the fresh CLIP's configuration; ids of special tokens as in ``tokenizer``."""
        from transformers import CLIPConfig

        assert self.vision is not None
        assert self.text is not None
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
    from transformers import CLIPVisionConfig

    return CLIPVisionConfig(
        hidden_size=size.width,
        intermediate_size=4 * size.width,
        num_hidden_layers=size.layers,
        num_attention_heads=size.heads,
        image_size=image,
        patch_size=patch,
        projection_dim=dim,
    )


# Photos of a surface have no up, and text does not care: turns and flips are free for the vision-
# text pair.
_MINI_VIEW = Augment(crop=0.2, gain=0.2, offset=0.1, flips=True, quarter_turns=True)
_MINI_CLIP = Course(epochs=6, batch=32, lr=1e-3, weight_decay=0.1, augment=_MINI_VIEW)
_MINI_TACTILE = Course(epochs=16, batch=128, lr=2e-3, weight_decay=0.1)
_TINY = Course(epochs=2, batch=8, lr=1e-3)
_TVL = Course(epochs=200, batch=256, lr=1.5e-4, clip_norm=None)

TINY = EncoderPreset(
    name="tiny",
    pretrained=None,
    image=16,
    patch=8,
    tactile=Size(16, 1, 2),
    tactile_course=_TINY,
    cost="seconds",
    score="for tests",
    vision=Size(16, 1, 2),
    text=Size(16, 1, 2),
    clip_course=_TINY,
    dim=8,
    vocabulary=300,
    context=16,
)
MINI = EncoderPreset(
    name="mini",
    pretrained=None,
    image=64,
    patch=8,
    tactile=Size(96, 3, 3),
    tactile_course=_MINI_TACTILE,
    cost="4,000 + 900 frames: about 65 + 33 CPU-s on one x86-64 core (AVX2)",
    score="on new worlds: linear probe of material 0.45 (chance 0.05)",
    vision=Size(96, 3, 3),
    text=Size(96, 2, 3),
    clip_course=_MINI_CLIP,
)
_GEL = Course(None, 32, 2e-3, weight_decay=0.02, clip_norm=2.0, steps=3_000)
GEL = EncoderPreset(
    name="gel",
    pretrained="palpate/mini",
    image=96,
    patch=1,
    tactile=Gel(),
    tactile_course=_GEL,
    cost="3,000 steps, 28,080 frames: about 25 CPU-min on one x86-64 core (AVX2)",
    score="palpate/mini on new worlds: linear probe of material 0.62 (chance 0.05)",
)
#: On from the shipped ruler, with touches alone; held-out recordings choose the length.
SELF = replace(
    GEL,
    name="self",
    alone=True,
    tactile_course=replace(_GEL, steps=700, evaluations=7),
    cost="700 steps: about 5 CPU-min on one x86-64 core (AVX2)",
    score="on real videos not measured here",
)
PAPER = EncoderPreset(
    name="paper",
    pretrained="laion/CLIP-ViT-L-14-DataComp.XL-s13B-b90K",
    image=224,
    patch=14,
    tactile=Size(1024, 24, 16),
    tactile_course=_TVL,
    cost="200 epochs on one A100 (the paper; hours not stated)",
    score="not measured here",
    dim=768,
    targets="diagonal",
    data_statistics=False,
)


def _tvl(name: str, size: Size, lr: float, cost: str) -> EncoderPreset:
    """TVL's training (recipes, section 3) but for its changes of color and parts of texts.

    Its brightness and contrast factors in [0.9, 1.1] have a deviation of 0.058 each: together a
    gain of 0.08; a contrast about the mean (0.3) is an offset of 0.02.
    """
    view = Augment(0.0, 0.08, 0.02, flips=True, quarter_turns=True)
    course = replace(_TVL, lr=lr, augment=view)
    return replace(
        PAPER,
        name=name,
        tactile=size,
        tactile_course=course,
        cost=cost,
        patch=16,
        targets="soft-text",
        fitting="pad",
        turn="left",
        data_statistics=True,
    )


_FLOP = "200 epochs of 13,900 pairs, arithmetic"
TVL = (
    _tvl("tvl-tiny", Size(192, 12, 3), 3e-4, f"{_FLOP}: 5.7 M parameters, 0.02 EFLOP"),
    _tvl("tvl-small", Size(384, 12, 6), 1.5e-4, f"{_FLOP}: 22 M parameters, 0.08 EFLOP"),
    _tvl("tvl-base", Size(768, 12, 12), 1.5e-4, f"{_FLOP}: 86 M parameters, 0.29 EFLOP"),
)
PRESETS = {preset.name: preset for preset in (TINY, MINI, GEL, SELF, *TVL, PAPER)}


def preset_of(preset: str | EncoderPreset, epochs: float | None = None) -> EncoderPreset:
    """A preset as it is, or by name; with so many epochs of the tactile encoder.

    Raises:
        PalpateError: if there is none of that name, or the epochs are no positive number.
    """
    if not isinstance(preset, EncoderPreset):
        require_choice("preset", preset, PRESETS)
        preset = PRESETS[preset]
    if epochs is None:
        return preset
    must, fix = "must be a positive number", "Leave it out for the preset's length"
    require(0 < epochs < math.inf, "epochs", must, epochs, fix=fix)
    return replace(preset, tactile_course=replace(preset.tactile_course, epochs=epochs))
