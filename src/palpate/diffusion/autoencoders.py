"""An autoencoder of either kind, trained on a data set, with the gels that it is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from palpate.core import PalpateError, Progress, Split, digest_json, quiet
from palpate.data.images import cached_images, image_stamp
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.diffusion.autoencoder import (
    AnyAutoencoder,
    Autoencoder,
    BackgroundAutoencoder,
    load_autoencoder,
)
from palpate.diffusion.autoencoder_training import train_autoencoder as train_vq
from palpate.diffusion.background_training import train_background_autoencoder
from palpate.diffusion.ceiling import judge_of, measure_ceiling
from palpate.diffusion.no_contact import gels_of, has_gels
from palpate.diffusion.options import AutoencoderOptions, BackgroundOptions
from palpate.diffusion.presets import DiffusionPreset, preset_named
from palpate.encoders.contrastive import load_split, train_part
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import pick_device
from palpate.training.options import Compute
from palpate.training.processes import connect, first_alone, keep_logs, place, work_folder


def train_autoencoder(
    data: Manifest | str | Path,
    split: Split | str | Path | None = None,
    *,
    preset: str | DiffusionPreset = "mini",
    start: AnyAutoencoder | str | Path | None = None,
    judge: EncoderSet | str | Path | None = "palpate/mini",
    output: Path | str | None = None,
    seed: int = 0,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> AnyAutoencoder:
    """Train the autoencoder of a preset on the train part of a split; run again to resume.

    Args:
        data: a manifest, or anything that :func:`palpate.data.load` reads. The autoencoder of the
            preset ``mini`` codes the difference to the gel without contact: the column
            ``background``, or without it the median tactile image.
        split: a split or its file. None: the one that lies with the data.
        preset: gives kind, shape and length.
        start: fine-tune a copy of this one instead of starting from random weights.
        judge: whose tactile encoder says what of the images outside of train survives
            (:mod:`palpate.diffusion.ceiling`); None: PSNR and SSIM alone.
        output: folder for the autoencoder, new or empty; None keeps it in memory.
        seed: of weights, order, crops and noise.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        compute: how to run it on the machine at hand.
        progress: called while the work goes on.

    Returns:
        The autoencoder, frozen; ``card["ceiling"]`` says how well it reconstructs images outside
        of train.

    Raises:
        PalpateError: if the train part is empty, the preset has no autoencoder of its own,
            ``start`` is of another kind, or the judge has no tactile encoder.
    """
    chosen = preset if isinstance(preset, DiffusionPreset) else preset_named(preset)
    if chosen.autoencoder is None:
        must, fix = "must be one with an autoencoder of its own", "Choose mini, small or tiny"
        raise PalpateError(must, chosen.name, fix, argument="preset")
    device = connect(device)
    judges = judge_of(judge, device)
    manifest, split = load(data), load_split(data, split)
    if start is not None and not isinstance(start, AnyAutoencoder):
        start = load_autoencoder(start)
    output = None if output is None else Path(output)
    with work_folder(output) as work:
        model = autoencoder_of(
            manifest,
            split,
            chosen.autoencoder,
            chosen.size,
            work / "autoencoder",
            start=start,
            cache=work / "cache",
            seed=seed,
            device=device,
            compute=compute,
            progress=progress,
        )
        model.card |= {"manifest": manifest.digest, "split": split.digest}
        how: dict[str, Any] = {"judge": judges, "cache": work / "cache", "progress": progress}
        if measured := measure_ceiling(model, manifest, split, chosen.size, **how):
            model.card["ceiling"] = measured
        if output is not None and place()[0] == 0:
            model.save(output)
            keep_logs(work, output)
    return model


def autoencoder_of(  # noqa: PLR0913 - one row per choice of the training
    manifest: Manifest,
    split: Split,
    options: AutoencoderOptions | BackgroundOptions,
    size: int,
    folder: Path,
    *,
    start: AnyAutoencoder | None = None,
    cache: Path | None = None,
    seed: int = 0,
    device: str = "auto",
    compute: Compute | None = None,
    progress: Progress = quiet,
) -> AnyAutoencoder:
    """Train one on images of the train part, ``size`` pixels square; ``folder`` for checkpoints."""
    train = train_part(manifest, split)
    with first_alone():
        images = cached_images(train, "tactile", size, cache, progress)
    how: dict[str, Any] = {"seed": seed, "device": pick_device(device)}
    how |= {"compute": compute, "progress": progress}
    kind = Autoencoder if isinstance(options, AutoencoderOptions) else BackgroundAutoencoder
    if start is not None and not isinstance(start, kind):
        raise PalpateError("must be of the preset's kind", "another kind", "", argument="start")
    begin: Any = start
    if isinstance(options, AutoencoderOptions):
        key = image_stamp(train, "tactile")
        return train_vq(images, options, folder, start=begin, key=key, **how)
    with first_alone():
        gels = gels_of(train, size, cache, progress)
    columns = ("tactile", "background") if has_gels(train) else ("tactile",)
    how["key"] = digest_json([image_stamp(train, c) for c in columns])
    return train_background_autoencoder(images, gels, options, folder, start=begin, **how)
