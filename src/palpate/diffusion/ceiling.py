"""What survives an autoencoder: the ceiling of every generator that works in its latents.

PSNR and SSIM see pixels, most of them the gel's. Two judges see touch, both in the features of one
tactile encoder: TMMD between reconstructions and the real images, and a linear probe of the
material, which is fitted to real images of train, as the judge of generated images is.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from palpate.diffusion.autoencoder_training import measure_reconstruction, some_whole
from palpate.diffusion.no_contact import gels_of, has_gels
from palpate.encoders.embed import embed_images
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import pick_device
from palpate.encoders.rows import evenly
from palpate.metrics.probe import fit_probe, material_accuracy
from palpate.metrics.tactile import tmmd
from palpate.training.processes import place

#: Samples that are scored, and samples of train that a probe is fitted to, at most.
SCORED, FITTED = 1000, 4000


def judge_of(judge: EncoderSet | str | Path | None, device: str = "cpu") -> EncoderSet | None:
    """Load the encoders that judge, unless None or ``"none"``: before a training, not to lose it.

    Raises:
        PalpateError: if there are none of that name, or none of them is tactile.
    """
    if judge is None or judge == "none":
        return None
    judge = judge if isinstance(judge, EncoderSet) else EncoderSet.load(judge)
    if "tactile" not in judge.modalities:
        fix = "Choose others, palpate/mini, or none"
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
        The fields of :class:`~palpate.diffusion.autoencoder_training.Reconstruction`; with a judge
        its digest, ``tmmd`` with its 95 % interval, and ``accuracy_real`` and ``accuracy`` of the
        material. What the data cannot give, for want of materials or of samples, is left out.
        ``not_judged`` counts the images that the judge was trained on, which it leaves out, and
        ``not_measured`` says what was wrong with a file. None also on all processes but the first.
    """
    given = isinstance(autoencoder, BackgroundAutoencoder)
    train, others = manifest.part(split, "train"), manifest.part(split, "val", "test")
    needed = ["tactile", "background"] if given and has_gels(others) else ["tactile"]
    others = some_whole(others, needed, SCORED)
    if not len(others) or place()[0]:
        return None
    try:
        return _measured(autoencoder, train, others, size, judge, cache, progress)
    except PalpateError as error:  # of a file: no reason to lose the training
        return {"not_measured": str(error)}


def _measured(  # noqa: PLR0917 - the arguments of measure_ceiling
    autoencoder: AnyAutoencoder,
    train: Manifest,
    others: Manifest,
    size: int,
    judge: EncoderSet | None,
    cache: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    held = None
    if isinstance(autoencoder, BackgroundAutoencoder):
        gels = gels_of(train, size, cache, progress)  # the stock gel is that of the training
        held = gels_of(others, size, cache, progress, like=gels)
    images = np.asarray(cached_images(others, "tactile", size, cache, progress))
    found: dict[str, Any] = asdict(measure_reconstruction(autoencoder, images, held))
    if judge is None:
        return found
    found["judge"] = judge.digest("tactile")
    seen = judge.saw("tactile", others, progress=progress)
    if seen.any():
        found["not_judged"] = int(seen.sum())
        if seen.all():
            return found
        rest = [name for name, known in zip(others.ids, seen, strict=True) if not known]
        others, images = others.take(rest), images[~seen]
        held = None if held is None else held[~seen]

    def features(part: Manifest, pixels: NDArray[np.uint8]) -> FeatureSet:
        labels, groups = _words(part.column("material")), _words(part.column("video"))
        rows = embed_images(pixels, judge, progress=progress)
        return FeatureSet(part.ids, rows, labels, groups, found["judge"])

    given: tuple[Any, ...] = () if held is None else (held,)
    made = autoencoder.decode(autoencoder.encode(images, *given), *given)
    real, ours = features(others, images), features(others, made)
    with suppress(PalpateError):  # too few samples or videos
        score = tmmd(ours, real)
        found |= {"tmmd": score.value, "tmmd_interval": score.interval}
    if len({*train.column("material")} - {None}) > 1:
        some = evenly(len(train), FITTED)
        known = np.asarray(cached_images(train, "tactile", size, cache, progress)[some])
        with suppress(PalpateError):  # no material outside of train
            fitted = features(train.take([train.ids[k] for k in some]), known)
            probe = fit_probe(fitted)
            found["accuracy_real"] = material_accuracy(fitted, real, probe=probe).value
            found["accuracy"] = material_accuracy(fitted, ours, probe=probe).value
    return {name: value for name, value in found.items() if value is not None}


def _words(column: Sequence[Any]) -> list[str] | None:
    return None if all(v is None for v in column) else ["" if v is None else str(v) for v in column]
