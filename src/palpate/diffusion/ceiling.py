"""What survives an autoencoder: the ceiling of every generator that works in its latents.

PSNR and SSIM see pixels, most of them the gel's. Two judges see touch, both in the features of one
tactile encoder: TMMD between reconstructions and the real images, and a linear probe of the
material, which is fitted to real images of train, as the judge of generated images is.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, Progress, Split, quiet, require
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import AnyAutoencoder, BackgroundAutoencoder
from palpate.diffusion.gels import gels_of, has_gels
from palpate.encoders.embed import embed_images, words_of
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import pick_device
from palpate.encoders.rows import evenly_spaced, with_values
from palpate.metrics.images import per_image
from palpate.metrics.probe import fit_probe, material_accuracy
from palpate.metrics.retrieval import standardized
from palpate.metrics.tactile import tmmd
from palpate.training.processes import place

#: Samples that are scored, and samples of train that a probe is fitted to, at most.
SCORED, FITTED = 1000, 4000
#: Images that are reconstructed at a time.
BATCH = 64


@dataclass(frozen=True)
class Reconstruction:
    """How well an autoencoder reconstructs images that it was not trained on.

    Attributes:
        n: images.
        psnr: mean over images of 10 log10(1 / MSE), values in [0, 1].
        ssim: mean structural similarity (Wang et al. 2004: Gaussian window of 11, sigma 1.5, range
            1).
    """

    n: int
    psnr: float
    ssim: float


@torch.no_grad()
def measure_reconstruction(
    autoencoder: AnyAutoencoder,
    images: NDArray[np.uint8],
    background: NDArray[np.uint8] | None = None,
) -> Reconstruction:
    """Score reconstructions of bytes (n, h, w, 3), a batch at a time.

    ``background`` holds the gel of each image, for an autoencoder that is given them.
    """
    rows: list[NDArray[np.float64]] = []
    for start in range(0, len(images), BATCH):
        part = slice(start, start + BATCH)
        pixels = np.asarray(images[part])
        gels = None if background is None else background[part]
        z = autoencoder.encode(pixels, gels, batch=BATCH)
        # Rounded to bytes first: what is scored is the image that a user gets.
        decoded = autoencoder.decode(z, gels, batch=BATCH)
        scored = [per_image(name, decoded, pixels) for name in ("PSNR", "SSIM")]
        rows.append(np.stack([score.values for score in scored]))
    psnr, ssim = map(float, np.concatenate(rows, axis=1).mean(axis=1))
    return Reconstruction(len(images), psnr, ssim)


def some_whole(part: Manifest, columns: Sequence[str], n: int) -> Manifest:
    """Up to ``n`` samples, evenly spaced, of those that have an image in each of these columns."""
    complete = with_values(part, *columns)
    return complete.take([complete.ids[k] for k in evenly_spaced(len(complete), n)])


def judge_of(
    judge: EncoderSet | str | Path | None, device: str | torch.device = "cpu"
) -> EncoderSet | None:
    """Load the encoders that judge, unless None or ``"none"``: before a training, not to lose it.

    Raises:
        PalpateError: if there are none of that name, or none of them is tactile.
    """
    if judge is None or judge == "none":
        return None
    judge = judge if isinstance(judge, EncoderSet) else EncoderSet.load(judge)
    fits, fix = "tactile" in judge.modalities, "Choose others, palpate/mini, or none"
    require(fits, "judge", "must have a tactile encoder", "none", fix=fix)
    return judge.to(pick_device(device))


def measure_ceiling(
    autoencoder: AnyAutoencoder,
    manifest: Manifest,
    split: Split,
    size: int,
    *,
    judge: EncoderSet | None = None,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> dict[str, Any] | None:
    """Score reconstructions of samples outside of train; None where there are none.

    Args:
        autoencoder: frozen.
        manifest: the samples.
        split: up to :data:`SCORED` samples of its other parts are scored, evenly; the probes are
            fitted to up to :data:`FITTED` of its train part.
        size: side of the images in pixels.
        judge: whose tactile encoder judges; None: PSNR and SSIM alone.
        cache: folder for decoded pixels.
        progress: called while the work goes on.

    Returns:
        The fields of :class:`Reconstruction`; with a judge
        its digest, ``tmmd`` with its 95 % interval, and ``accuracy_real`` and ``accuracy`` of the
        material. What the data cannot give, for want of materials or of samples, is left out.
        ``not_judged`` counts the images that the judge was trained on, which it leaves out, and
        ``not_measured`` says what was wrong with a file. None also on all processes but the first.
    """
    train, held = manifest.part(split, "train"), manifest.part(split, "val", "test")
    coded = isinstance(autoencoder, BackgroundAutoencoder)  # against the gels
    columns = ["tactile", "background"] if coded and has_gels(held) else ["tactile"]
    held = some_whole(held, columns, SCORED)
    if not len(held) or place()[0]:
        return None
    try:
        ground = None
        if coded:
            gels = gels_of(train, size, cache, progress)  # the stock gel is that of the training
            ground = gels_of(held, size, cache, progress, like=gels)
        images = np.asarray(cached_images(held, "tactile", size, cache, progress))
        scores: dict[str, Any] = asdict(measure_reconstruction(autoencoder, images, ground))
        if judge is None:
            return scores
        scores["judge"] = judge.digest("tactile")
        seen = judge.saw("tactile", held, progress=progress)
        if seen.any():
            scores["not_judged"] = int(seen.sum())
            if seen.all():
                return scores
            new = [name for name, old in zip(held.ids, seen, strict=True) if not old]
            held, images = held.take(new), images[~seen]
            ground = None if ground is None else ground[~seen]

        backed = not any(p.table["background"].null_count() for p in (train, held))
        if ruled := judge.preprocess("tactile").residual:
            scores["background_kind"] = "no contact" if backed else "low-pass"

        def numbers(part: Manifest, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
            empty = cached_images(part, "background", size, cache, progress) if backed else None
            return embed_images(pixels, judge, gels=empty, raw=ruled, progress=progress)

        of_real = numbers(held, images)

        def features(part: Manifest, rows: NDArray[np.float32]) -> FeatureSet:
            if ruled:  # as `score` does it
                (rows,), _ = standardized([rows], of_real)
            labels, groups = words_of(part, "material"), words_of(part, "video")
            return FeatureSet(part.ids, rows, labels, groups, scores["judge"])

        decoded = autoencoder.decode(autoencoder.encode(images, ground), ground)
        real, ours = features(held, of_real), features(held, numbers(held, decoded))
        with suppress(PalpateError):  # too few samples or videos
            score = tmmd(ours, real)
            # Where nobody knows the videos, nobody knows how much they differ.
            interval = score.interval if real.groups else None
            scores |= {"tmmd": score.value, "tmmd_interval": interval}
        if len({*train.column("material")} - {None}) > 1:
            some = evenly_spaced(len(train), FITTED)
            pixels = np.asarray(cached_images(train, "tactile", size, cache, progress)[some])
            with suppress(PalpateError):  # no material outside of train
                part = train.take([train.ids[k] for k in some])
                fitted = features(part, numbers(part, pixels))
                probe = fit_probe(fitted)
                scores["accuracy_real"] = material_accuracy(fitted, real, probe=probe).value
                scores["accuracy"] = material_accuracy(fitted, ours, probe=probe).value
        return {name: value for name, value in scores.items() if value is not None}
    except PalpateError as error:  # of a file: no reason to lose the training
        return {"not_measured": str(error)}
