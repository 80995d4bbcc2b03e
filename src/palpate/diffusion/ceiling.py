"""What survives an autoencoder: the ceiling of every generator that works in its latents.

PSNR and SSIM see pixels, most of them the gel's. Two judges see touch, both in the features of one
tactile encoder: TMMD between reconstructions and the real images, and a linear probe of the
material. The *frozen* probe is fitted to real images of train, as the judge of generated images is;
the *refitted* one to reconstructions of train, and tells whether what the frozen one misses is gone
or only looks otherwise.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, Progress, Split, quiet
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import AnyAutoencoder, BackgroundAutoencoder
from palpate.diffusion.autoencoder_training import measure_reconstruction
from palpate.diffusion.no_contact import gels_of
from palpate.encoders.embed import embed_images
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import pick_device
from palpate.encoders.rows import evenly
from palpate.metrics.probe import fit_probe, material_accuracy
from palpate.metrics.tactile import tmmd

#: Samples that are scored, and samples of train that a probe is fitted to, at most.
SCORED, FITTED = 1000, 4000


def judge_of(judge: EncoderSet | str | Path | None, device: str = "cpu") -> EncoderSet | None:
    """Load the encoders that judge, if they are named: before a training, so that it is not lost.

    Raises:
        PalpateError: if there are none of that name, or none of them is tactile.
    """
    if judge is None:
        return None
    judge = judge if isinstance(judge, EncoderSet) else EncoderSet.load(judge)
    if "tactile" not in judge.modalities:
        fix = "Choose others, or palpate/mini"
        raise PalpateError("must have a tactile encoder", "none", fix, argument="judge")
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
        The fields of :class:`~palpate.diffusion.autoencoder_training.Reconstruction` that are not
        None; with a judge its digest, ``tmmd`` with its 95 % interval, and ``accuracy_real``,
        ``accuracy_frozen`` and ``accuracy_refitted`` of the material. What the data cannot give,
        for want of materials or of samples, is left out.
    """
    others = _some(manifest.part(split, "val", "test"), SCORED)
    if not len(others):
        return None
    train = _some(manifest.part(split, "train"), FITTED)
    gels = held = None
    if isinstance(autoencoder, BackgroundAutoencoder):
        gels = gels_of(train, size, cache, progress)
        held = gels_of(others, size, cache, progress, like=gels)
    images = np.asarray(cached_images(others, "tactile", size, cache, progress))
    pixels = asdict(measure_reconstruction(autoencoder, images, held))
    found = {name: value for name, value in pixels.items() if value is not None}
    if judge is None:
        return found

    def features(part: Manifest, pixels: NDArray[np.uint8]) -> FeatureSet:
        columns = (part.column(name) for name in ("material", "video"))
        labels, groups = ([*map(str, c)] if all(c) else None for c in columns)
        rows = embed_images(pixels, judge, progress=progress)
        return FeatureSet(part.ids, rows, labels, groups, found["judge"])

    def through(pixels: NDArray[np.uint8], gels: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        given: tuple[Any, ...] = () if gels is None else (gels,)
        return autoencoder.decode(autoencoder.encode(pixels, *given), *given)

    found["judge"] = judge.digest("tactile")
    real, ours = features(others, images), features(others, through(images, held))
    with suppress(PalpateError):  # too few videos
        score = tmmd(ours, real)
        found |= {"tmmd": score.value, "tmmd_interval": score.interval}
    with suppress(PalpateError):  # no materials, or one
        known = np.asarray(cached_images(train, "tactile", size, cache, progress))
        frozen, refitted = features(train, known), features(train, through(known, gels))
        probe = fit_probe(frozen)
        found["accuracy_real"] = material_accuracy(frozen, real, probe=probe).value
        found["accuracy_frozen"] = material_accuracy(frozen, ours, probe=probe).value
        found["accuracy_refitted"] = material_accuracy(refitted, ours).value
    return {name: value for name, value in found.items() if value is not None}


def _some(part: Manifest, most: int) -> Manifest:
    return part.take([part.ids[k] for k in evenly(len(part), most)])
