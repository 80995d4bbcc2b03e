"""A video of a surface -> a video of a touch that presses, slides and lets go.

The touch of each frame comes from a profile over time, or is that of the clip itself, where its
``gelsight.mp4`` lies beside it (the layout of Touch and Go). The noise is that of one image, for
all frames; a photo is the mean of those within half a second; the place, if it is not requested,
is drawn once; the area, if it is not, follows the strength as in training. So frames differ by
what the touch does. At strength 0 nothing touches: the gel is shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import isotonic_regression
from torch import Tensor, nn

from palpate.core import Note, Progress, atomic_path, quiet, require
from palpate.core.files import canonical_json
from palpate.data.contacts import find_reference
from palpate.data.images import read_image, square
from palpate.data.video import VideoReader, write_video
from palpate.diffusion.contact import ContactScale
from palpate.diffusion.generated import Generated
from palpate.diffusion.options import SamplerOptions
from palpate.diffusion.pipeline import EMBED, TactilePipeline
from palpate.diffusion.requested import Profile, Requested
from palpate.metrics.conditions import contact_conditions

#: The touch of a clip, in its folder.
TOUCH = "gelsight.mp4"
#: Photos are averaged within so many seconds.
AROUND = 0.5


def touch_video(  # noqa: PLR0913 - what generate was given
    clip: Path,
    output: Path,
    pipeline: TactilePipeline,
    *,
    requested: Requested,
    sampler: SamplerOptions,
    settings: dict[str, Any],
    profile: Profile | None = None,
    texts: Tensor | None = None,
    weight: float = 0.5,
    gel: Path | None = None,
    seed: int = 0,
    notes: Sequence[Note] = (),
    progress: Progress = quiet,
) -> Generated:
    """Write a tactile video, frame by frame of a clip.

    Args:
        clip: of the surface.
        output: the MP4.
        pipeline: one that knows contacts.
        requested: place and area for all frames; a shear where the profile has none.
        sampler: settings of the solver.
        settings: written into the file.
        profile: table of strength and shear over time; None: those of the clip's own touches.
        texts: embedding (1, d) of what is felt beside the photos.
        weight: share of the photos where both take one place.
        gel: image of the gel without contact; default: the stock gel.
        seed: of the noise.
        notes: what the caller must know.
        progress: called while the work goes on.

    Returns:
        The video, and how many frames it has.

    Raises:
        PalpateError: if the profile is too short, there is none and no touch of the clip, or the
            clip cannot be read.
    """
    picture = pipeline.gel if gel is None else square(read_image(gel), pipeline.size)
    assert picture is not None
    with VideoReader(clip) as reader:
        seconds = reader.seconds - reader.seconds[0]
        rows = own_touches(clip, seconds, pipeline) if profile is None else profile.at(seconds)
        progress("reading photos", 0, len(seconds))
        side, parts = pipeline.vision_size, list[Tensor]()
        for start in range(0, len(seconds), EMBED):
            numbers = range(start, min(start + EMBED, len(seconds)))
            some = [square(Image.fromarray(image), side) for _, image in reader.frames(numbers)]
            parts.append(pipeline.embed(np.stack(some)))
    photos = _steady(torch.cat(parts), seconds)
    rows = np.where(np.isfinite(rows), rows, requested.row(pipeline.contact))
    rows = _held(rows, pipeline, photos, clip.name, seed)
    n, size = len(rows), sampler.batch
    tags = {"comment": f"palpate.settings {canonical_json(settings)} {pipeline.notice}".strip()}

    def images() -> Any:
        for start in range(0, n, size):
            of = slice(start, min(start + size, n))
            made = pipeline.sample(
                photos[of],
                [clip.name] * len(rows[of]),
                seed=seed,
                texts=texts,
                weight=weight,
                sampler=sampler,
                background=np.broadcast_to(picture, (len(rows[of]), *picture.shape)),
                touches=rows[of],
            )
            progress("generating", of.stop, n)
            for row, image in zip(rows[of], made, strict=True):
                yield image if row[3] > 0 else picture

    step = np.median(np.diff(seconds)) if n > 1 else 1 / 30
    with atomic_path(output) as part:
        write_video(part, images(), Fraction(1 / float(step)).limit_denominator(1001), tags)
    files = {clip.name: str(output)}
    return Generated(None, files, settings, new=n, notice=pipeline.notice, notes=notes)


def own_touches(
    clip: Path, seconds: NDArray[np.float64], pipeline: TactilePipeline
) -> NDArray[np.float64]:
    """Touches (n, 6) of the tactile video beside a clip, at these times.

    Raises:
        PalpateError: if there is none.
    """
    beside = clip.with_name(TOUCH)
    must = f"must be given for a video without its own touches, {TOUCH} beside it"
    fix = "Write time_s,strength,shear_x,shear_y, a line a moment"
    require(beside.is_file(), "profile", must, "none", fix=fix)
    with VideoReader(beside) as reader:
        still = find_reference(reader.thumbnails())
        gel = square(Image.fromarray(reader[still]), pipeline.size)
        nearest = np.abs(reader.seconds - reader.seconds[0] - seconds[:, None]).argmin(axis=1)
        each, index = np.unique(nearest, return_inverse=True)
        measured = [
            contact_conditions(square(Image.fromarray(image), pipeline.size)[None], gel)[0]
            for _, image in reader.frames(each.tolist())
        ]
    rows = np.pad(np.array(measured), ((0, 0), (0, 2)), constant_values=np.nan)
    own = ContactScale.of(rows, [None] * len(rows))  # of another sensor: its own quantiles
    requested = own.requested(rows, [None] * len(rows)).astype(float)
    must = f"must be given where {TOUCH} shows no contact"
    require(bool(own.strength), "profile", must, f"{clip.parent.name}/{TOUCH}", fix=fix)
    return np.where(rows[:, 3:4] > 0, requested, np.array([np.nan, np.nan, np.nan, 0, 0, 0]))[index]


def _steady(photos: Tensor, seconds: NDArray[np.float64]) -> Tensor:
    """Embeddings of photos, each the mean of those around it."""
    near = np.abs(seconds[:, None] - seconds) <= AROUND
    weights = torch.from_numpy(near / near.sum(axis=1, keepdims=True)).to(photos)
    mean = torch.einsum("ij,j...->i...", weights, photos)
    return nn.functional.normalize(mean, dim=-1) if photos.ndim == 2 else mean


def _held(
    rows: NDArray[np.float64], pipeline: TactilePipeline, photos: Tensor, name: str, seed: int
) -> NDArray[np.float64]:
    """Touches of which place and area do not jump: what is not given is drawn once."""
    peak = int(rows[:, 3].argmax())
    drawn = pipeline.touches(rows[peak, None], photos[peak, None], None, [name], seed)[0]
    rows[:, :2] = np.where(np.isfinite(rows[:, :2]), rows[:, :2], drawn[:2])
    rows[:, 4:] = np.nan_to_num(rows[:, 4:])
    kept = pipeline.denoiser.touches.cpu().numpy()
    order = np.argsort(kept[:, 3])
    wide = isotonic_regression(kept[order, 2]).x
    area = np.interp(rows[:, 3], kept[order, 3], wide)
    rows[:, 2] = np.where(np.isfinite(rows[:, 2]), rows[:, 2], area)
    return rows
