"""What the steps of a contrastive training read: decoded once, embedded once where frozen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from palpate.core import FeatureSet, Progress, atomic_path, digest_json, quiet, short
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed, embed_texts, texts_of
from palpate.encoders.encoder_set import ClipEncoders, EncoderSet
from palpate.encoders.preprocess import Preprocess, prepared_images
from palpate.encoders.presets import Augment
from palpate.training.engine import Batch
from palpate.training.steps import Step

PROBED = 2000  # rows that the probe in training sees, at most
MOST_WORDS = 6  # of a text whose subsets are taken: 63 phrases


class Rows:
    """The rows of one part of the data, by their number in the manifest.

    Attributes:
        manifest: the part.
        images: tactile images, bytes (n, s, s, 3), in memory or mapped.
        captions: the text of each row.
        text_source: see :func:`palpate.encoders.embed.texts_of`.
        texts, contacts: int64 (n,), equal where rows share the caption, or the contact.
        phrases: the distinct texts, or with ``subsets`` all parts of their lists of adjectives.
        without_photo: rows that have none, where others have.
    """

    def __init__(
        self,
        part: Manifest,
        clip: ClipEncoders,
        preprocess: Preprocess,
        *,
        subsets: bool = False,
        trainable: bool = False,
        cache: Path | None = None,
        progress: Progress = quiet,
    ) -> None:
        """Decode the images, and embed photos and texts unless ``clip`` is ``trainable``."""
        self.manifest, self.trainable = part, trainable
        self.images = prepared_images(part, "tactile", preprocess, cache, progress)
        self.captions, self.text_source = texts_of(part)
        self.texts = numbers(self.captions)
        lists = [subsets_of(t) if subsets else [t] for t in sorted(set(self.captions))]
        self.phrases = [phrase for each in lists for phrase in each]
        counts = torch.tensor([len(each) for each in lists])
        self.first, self.count = (counts.cumsum(0) - counts)[self.texts], counts[self.texts]
        columns = (part.column("video"), part.column("contact"), part.ids)
        # A row without a contact is one of its own.
        keys = [(v, "", i) if c is None else (v, c, "") for v, c, i in zip(*columns, strict=True)]
        self.contacts = numbers([repr(key) for key in keys])
        with_photo = torch.tensor([v is not None for v in part.column("vision")])
        self.without_photo = int((~with_photo).sum()) if with_photo.any() else 0
        self.photo = with_photo.cumsum(0) - 1
        self.photo[~with_photo] = -1
        pictured = part.take([i for i, has in zip(part.ids, with_photo, strict=True) if has])
        self.photos = self.text = self.vision = None
        if trainable:
            if len(pictured):
                how = clip.preprocess
                self.photos = prepared_images(pictured, "vision", how, cache, progress)
            return
        frozen = EncoderSet(clip)
        if clip.tokenizer is not None:
            self.text = torch.from_numpy(embed_phrases(self.phrases, frozen, cache, progress))
        if len(pictured):
            rows = embed(pictured, frozen, "vision", cache=cache, progress=progress)
            self.vision = torch.from_numpy(rows.features)

    def load(self, step: Step, augment: Augment | None = None) -> Batch:
        """The data of a step; without ``augment``, images and texts as they are.

        Images are those of this process; what is embedded already is that of the global batch.
        """
        batch = {"images": torch.from_numpy(np.array(self.images[step.rows]))}
        every = torch.from_numpy(step.all_rows)
        phrase = self.first[every]
        if augment is not None:
            batch |= draw(augment, step)
            if int(self.count.max()) > 1:
                phrase += (step.rand_all() * self.count[every]).long()
        batch |= {"texts": self.texts[every], "contacts": self.contacts[every]}
        photo = self.photo[every]
        if self.without_photo:
            batch["seen"] = photo >= 0
        photo = photo.clamp(min=0)
        if self.trainable:
            batch["phrase"] = phrase[step.mine]
            if self.photos is not None:
                batch["photos"] = torch.from_numpy(np.array(self.photos[photo[step.mine].numpy()]))
        if self.text is not None:
            batch["text"] = self.text[phrase]
        if self.vision is not None:
            batch["vision"] = self.vision[photo]
        return batch

    def features(self, encode: Callable[[Tensor], Tensor], device: torch.device) -> FeatureSet:
        """Embeddings of at most :data:`PROBED` evenly spaced tactile images, with materials."""
        some = evenly(len(self.images), PROBED)
        parts: list[Tensor] = []
        for start in range(0, len(some), 128):
            pixels = torch.from_numpy(np.array(self.images[some[start : start + 128]])).to(device)
            parts.append(encode(unit(pixels)).float().cpu())
        columns = (self.manifest.column("material"), self.manifest.column("video"))
        labels, groups = ([str(c[k] or "") for k in some] for c in columns)
        ids = [self.manifest.ids[k] for k in some]
        return FeatureSet(ids, torch.cat(parts).numpy(), labels, groups)


def draw(augment: Augment, step: Step) -> dict[str, Tensor]:
    """The random numbers of a batch: a window (b, 2, 3), and changes of color (b,) each."""
    scale = 1 - augment.crop * step.rand()
    shift = (2 * step.rand(2) - 1) * (1 - scale)[:, None]
    turns = step.randint(4) * augment.quarter_turns
    mirror = 1.0 - 2.0 * step.randint(2, 2) * augment.flips
    changes = {"gain": augment.gain * step.randn(), "offset": augment.offset * step.randn()}
    if augment.saturation or augment.hue:
        changes["saturation"] = augment.saturation * (2 * step.rand() - 1)
        changes["hue"] = augment.hue * (2 * step.rand() - 1)
    if augment.share < 1:
        changed = step.rand() < augment.share
        changes = {name: change * changed for name, change in changes.items()}
    angle = turns * (torch.pi / 2)
    cos, sin = scale * torch.cos(angle), scale * torch.sin(angle)
    rows = [torch.stack([cos, -sin, shift[:, 0]], 1), torch.stack([sin, cos, shift[:, 1]], 1)]
    window = torch.stack(rows, 1)
    window[:, :, :2] *= mirror[:, None]
    return {"window": window, **changes}


def augmented(images: Tensor, drawn: Mapping[str, Tensor]) -> Tensor:
    """Change images (b, 3, h, w) in [0, 1] as :func:`draw` says; not at all without draws.

    Values may leave [0, 1], as over-exposure would.
    """
    if "window" not in drawn:
        return images
    grid = affine_grid(drawn["window"], list(images.shape), align_corners=False)
    images = grid_sample(images, grid, align_corners=False, padding_mode="reflection")
    if "hue" in drawn:
        colors = color_matrices(drawn["saturation"], drawn["hue"])
        images = torch.einsum("bij,bjhw->bihw", colors, images)
    return images * drawn["gain"].exp().view(-1, 1, 1, 1) + drawn["offset"].view(-1, 1, 1, 1)


def color_matrices(saturation: Tensor, hue: Tensor) -> Tensor:
    """Matrices (b, 3, 3) that stretch colors by 1 + saturation and turn them by hue turns.

    In YIQ, whose first row is the luma, which stays; grays stay gray.
    """
    yiq = saturation.new_tensor(
        [[0.299, 0.587, 0.114], [0.596, -0.274, -0.322], [0.211, -0.523, 0.312]]
    )
    length, angle = 1 + saturation, 2 * torch.pi * hue
    cos, sin, zero = length * angle.cos(), length * angle.sin(), torch.zeros_like(hue)
    rows = [zero + 1, zero, zero, zero, cos, sin, zero, -sin, cos]
    return yiq.inverse() @ torch.stack(rows, 1).view(-1, 3, 3) @ yiq


def unit(images: Tensor) -> Tensor:
    """Bytes (b, h, w, 3) on any device as float32 (b, 3, h, w) in [0, 1]."""
    return images.permute(0, 3, 1, 2).float() / 255


def numbers(values: Sequence[str]) -> Tensor:
    """Each value's index among the sorted distinct values, (n,) int64."""
    return torch.from_numpy(np.unique(np.array(values, dtype=object), return_inverse=True)[1])


def evenly(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of ``n`` rows, evenly spaced."""
    return np.linspace(0, n - 1, min(n, most)).astype(np.int64)


def subsets_of(text: str) -> list[str]:
    """A list of adjectives and all its non-empty parts, the whole first (TVL's augmentation)."""
    words = [word.strip() for word in text.rstrip(".").split(",")]
    if not 1 < len(words) <= MOST_WORDS:
        return [text]
    sizes = range(len(words) - 1, 0, -1)
    return [text, *(", ".join(some) for size in sizes for some in combinations(words, size))]


def embed_phrases(
    phrases: Sequence[str], encoders: EncoderSet, cache: Path | None, progress: Progress
) -> np.ndarray:
    """Embeddings of distinct texts (p, d), kept in the cache."""
    key = short(digest_json(["palpate-phrases/1", encoders.digest("text"), list(phrases)]))
    file = None if cache is None else cache / f"phrases-{key}.npy"
    if file is not None and file.is_file():
        return np.load(file, allow_pickle=False)
    features = embed_texts(phrases, encoders, progress=progress)
    if file is not None:
        with atomic_path(file) as part, open(part, "wb") as out:
            np.save(out, features)
    return features
