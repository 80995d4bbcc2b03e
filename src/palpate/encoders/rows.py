"""The training data of a contrastive encoder: images, captions, frozen embeddings, augmentation.

Tactile images are decoded once; photos and captions go through the frozen vision and text encoders
once. A step then only looks rows up, by their number in the part of the split.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from palpate.core import Progress, Split, quiet, require
from palpate.data.images import Preprocess, cached_images
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.data.recordings import described
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.presets import Augment
from palpate.training.engine import Batch
from palpate.training.steps import Step


def load_samples(
    data: Manifest | str | Path, split: Split | str | Path | None = None
) -> tuple[Manifest, Split]:
    """Load samples and a split of them.

    Args:
        data: the samples, or their folder or file.
        split: the split or its file; None is the only one in the folder ``splits`` of the data.

    Returns:
        The samples, and the split, whose rule says what train and test share; a trained model
        carries it.

    Raises:
        PalpateError: if ``split`` is None and the data have no split, or several.
    """
    if split is None:
        files = sorted(Path(data).glob("splits/*.json")) if isinstance(data, str | Path) else []
        must, fix = "must be given unless one lies with the data", "Make one with: palpate split"
        got = ", ".join(path.name for path in files) or "none there"
        require(len(files) == 1, "split", must, got, fix=fix)
        split = files[0]
    manifest = load(data)
    return manifest, described(manifest, Split.load(split))


def train_part(manifest: Manifest, split: Split) -> Manifest:
    """The train part of a split.

    Raises:
        PalpateError: if it is empty.
    """
    train = manifest.part(split, "train")
    must = "The train part of the split must hold samples of this manifest"
    require(len(train) > 0, None, must, "none", fix="Make a split with: palpate split")
    return train


def with_values(part: Manifest, *columns: str) -> Manifest:
    """The samples that have a value in each of these columns."""
    rows = zip(part.ids, *map(part.column, columns), strict=True)
    return part.take([name for name, *values in rows if all(values)])


class Rows:
    """The n samples of one part of a split, as training reads them.

    Attributes:
        manifest: the part.
        images: tactile images, uint8 (n, s, s, 3), in memory or mapped.
        captions: n texts.
        text_source: where they are from; see :func:`palpate.encoders.embed.texts_of`.
        caption_ids: int64 (n,), equal where rows share the caption.
        text: embeddings of the captions, float32 (n, d); None if ``clip`` has no text encoder.
        vision: embeddings of the photos, float32 (rows with a photo, d); None without photos.
        photo: int64 (n,), the row of ``vision`` of each sample; -1 without a photo.
        without_photo: number of samples without a photo; 0 also if no sample has one.
    """

    def __init__(
        self,
        part: Manifest,
        clip: EncoderSet | None,
        preprocess: Preprocess,
        cache: Path | None = None,
        progress: Progress = quiet,
    ) -> None:
        """Decode the tactile images, and embed photos and captions by ``clip``.

        Args:
            part: the samples.
            clip: frozen vision and text encoders; None embeds nothing.
            preprocess: how tactile images are prepared.
            cache: folder for decoded images and embeddings; None keeps them in memory.
            progress: progress callback.
        """
        self.manifest = part
        self.images = cached_images(part, "tactile", preprocess, cache, progress)
        self.captions, self.text_source = texts_of(part)
        self.caption_ids = factorize(self.captions)
        with_photo = torch.tensor([bool(v) for v in part.column("vision")])
        self.without_photo = int((~with_photo).sum()) if with_photo.any() else 0
        self.photo = torch.where(with_photo, with_photo.cumsum(0) - 1, -1)
        photographed = with_values(part, "vision")
        self.text = self.vision = None
        if clip is not None and clip.tokenizer is not None:
            rows = embed(part, clip, "text", cache=cache, progress=progress)
            self.text = torch.from_numpy(np.array(rows.features))
        if clip is not None and len(photographed):
            rows = embed(photographed, clip, "vision", cache=cache, progress=progress)
            self.vision = torch.from_numpy(np.array(rows.features))

    def load(self, step: Step, augment: Augment | None = None) -> Batch:
        """The batch of one step, for :class:`palpate.encoders.contrastive.TactileLoss`.

        The loss compares each image with the captions and photos of all processes: images and
        their augmentation are of this process's b rows, all else of the global batch of B.

        Args:
            step: which rows, and their random numbers.
            augment: how to change images at random; None leaves them as they are.

        Returns:
            ``images`` uint8 (b, s, s, 3), the arrays of :func:`draw_augmentation`, ``caption_ids``
            (B,), and what there is of: ``text`` and ``vision`` (B, d), ``has_photo`` bool (B,).
        """
        all_rows = torch.from_numpy(step.all_rows)
        batch = draw_augmentation(augment, step) if augment else {}
        batch["images"] = torch.from_numpy(np.array(self.images[step.rows]))
        batch["caption_ids"] = self.caption_ids[all_rows]
        photo = self.photo[all_rows]
        if self.without_photo:
            batch["has_photo"] = photo >= 0
        if self.text is not None:
            batch["text"] = self.text[all_rows]
        if self.vision is not None:
            batch["vision"] = self.vision[photo.clamp(min=0)]  # any row: the mask leaves it out
        return batch


def draw_augmentation(augment: Augment, step: Step) -> dict[str, Tensor]:
    """Draw the changes of b images; flips and turns are drawn even where they are switched off.

    Returns:
        ``window`` (b, 2, 3), the affine matrix [s R diag(m) | t] from coordinates of the result to
        those of the image, (x, y) in [-1, 1]: s is the window's side, R a turn, m = ±1 mirrors, t
        a shift that stays inside the image. ``gain`` (b,), the logarithm of the contrast factor.
        ``offset`` (b,), added brightness; white is 1.
    """
    scale = 1 - augment.crop * step.rand()
    shift = (2 * step.rand(2) - 1) * (1 - scale)[:, None]
    quarters = step.randint(4) * augment.quarter_turns
    mirror = 1.0 - 2.0 * step.randint(2, 2) * augment.flips
    changes = {"gain": augment.gain * step.randn(), "offset": augment.offset * step.randn()}
    angle = quarters * (torch.pi / 2)
    cos, sin = scale * torch.cos(angle), scale * torch.sin(angle)
    rows = [torch.stack([cos, -sin, shift[:, 0]], 1), torch.stack([sin, cos, shift[:, 1]], 1)]
    window = torch.stack(rows, 1)
    window[:, :, :2] *= mirror[:, None]
    return {"window": window, **changes}


def augmented(images: Tensor, drawn: Mapping[str, Tensor]) -> Tensor:
    """Change images (b, 3, h, w) in [0, 1] as :func:`draw_augmentation` drew, if it did.

    Values may leave [0, 1]; they are not clipped.
    """
    if "window" not in drawn:
        return images
    grid = affine_grid(drawn["window"], list(images.shape), align_corners=False)
    images = grid_sample(images, grid, align_corners=False, padding_mode="reflection")
    return images * drawn["gain"].exp().view(-1, 1, 1, 1) + drawn["offset"].view(-1, 1, 1, 1)


def bytes_to_unit(images: Tensor) -> Tensor:
    """Return images uint8 (b, h, w, 3), on any device, as float32 (b, 3, h, w) in [0, 1]."""
    return images.permute(0, 3, 1, 2).float() / 255


def factorize(values: Sequence[str]) -> Tensor:
    """Return each value's index among the sorted distinct values, int64 (n,)."""
    return torch.from_numpy(np.unique(np.array(values, dtype=object), return_inverse=True)[1])


def evenly_spaced(n: int, most: int) -> NDArray[np.int64]:
    """Return up to ``most`` row numbers from 0 to n - 1, evenly spaced."""
    return np.linspace(0, n - 1, min(n, most)).astype(np.int64)
