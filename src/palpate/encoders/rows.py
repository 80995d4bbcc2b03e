"""What trainings read: a part of a split; its rows, decoded once and embedded where frozen."""

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
    """Samples, and a split of them: as it is, from its file, or the only one that lies with them.

    Returns:
        Both; the split's rule says what train and test share, so that every model carries it.

    Raises:
        PalpateError: if there is no split with the data, or several.
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


def with_cells(part: Manifest, *columns: str) -> Manifest:
    """The samples that have a value in each of these columns."""
    cells = zip(part.ids, *map(part.column, columns), strict=True)
    return part.take([name for name, *values in cells if all(values)])


class Rows:
    """The rows of one part of the data, by their number in the manifest.

    Attributes:
        manifest: the part.
        images: tactile images, bytes (n, s, s, 3), in memory or mapped.
        captions: the text of each row.
        text_source: see :func:`palpate.encoders.embed.texts_of`.
        texts: int64 (n,), equal where rows share the caption.
        without_photo: rows that have none, where others have.
    """

    def __init__(
        self,
        part: Manifest,
        clip: EncoderSet,
        preprocess: Preprocess,
        cache: Path | None = None,
        progress: Progress = quiet,
    ) -> None:
        """Decode the images, and embed photos and texts."""
        self.manifest = part
        self.images = cached_images(part, "tactile", preprocess, cache, progress)
        self.captions, self.text_source = texts_of(part)
        self.texts = numbers(self.captions)
        with_photo = torch.tensor([bool(v) for v in part.column("vision")])
        self.without_photo = int((~with_photo).sum()) if with_photo.any() else 0
        self.photo = with_photo.cumsum(0) - 1
        self.photo[~with_photo] = -1
        pictured = with_cells(part, "vision")
        self.text = self.vision = None
        if clip.tokenizer is not None:
            rows = embed(part, clip, "text", cache=cache, progress=progress)
            self.text = torch.from_numpy(rows.features)
        if len(pictured):
            rows = embed(pictured, clip, "vision", cache=cache, progress=progress)
            self.vision = torch.from_numpy(rows.features)

    def load(self, step: Step, augment: Augment | None = None) -> Batch:
        """The data of a step; without ``augment``, images as they are.

        Images are those of this process; what is embedded already is that of the global batch.
        """
        every = torch.from_numpy(step.all_rows)
        batch = {"images": torch.from_numpy(np.array(self.images[step.rows]))}
        batch |= {"texts": self.texts[every]} | (draw(augment, step) if augment else {})
        photo = self.photo[every]
        if self.without_photo:
            batch["photos"] = photo >= 0
        if self.text is not None:
            batch["text"] = self.text[every]
        if self.vision is not None:
            batch["vision"] = self.vision[photo.clamp(min=0)]
        return batch


def draw(augment: Augment, step: Step) -> dict[str, Tensor]:
    """The random numbers of a batch: a window (b, 2, 3), and changes of brightness (b,) each."""
    scale = 1 - augment.crop * step.rand()
    shift = (2 * step.rand(2) - 1) * (1 - scale)[:, None]
    turns = step.randint(4) * augment.quarter_turns
    mirror = 1.0 - 2.0 * step.randint(2, 2) * augment.flips
    changes = {"gain": augment.gain * step.randn(), "offset": augment.offset * step.randn()}
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
    return images * drawn["gain"].exp().view(-1, 1, 1, 1) + drawn["offset"].view(-1, 1, 1, 1)


def unit(images: Tensor) -> Tensor:
    """Bytes (b, h, w, 3) on any device as float32 (b, 3, h, w) in [0, 1]."""
    return images.permute(0, 3, 1, 2).float() / 255


def numbers(values: Sequence[str]) -> Tensor:
    """Each value's index among the sorted distinct values, (n,) int64."""
    return torch.from_numpy(np.unique(np.array(values, dtype=object), return_inverse=True)[1])


def evenly(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of ``n`` rows, evenly spaced."""
    return np.linspace(0, n - 1, min(n, most)).astype(np.int64)
