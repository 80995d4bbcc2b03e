"""What a study makes, stage by stage: data, splits, encoders, autoencoders, generators, images.

Each function is the body of a node (:class:`palpate.studies.graph.Node`): it fills ``place``, reads
the folders of earlier nodes (``after``, by name), and returns facts. Caches lie in ``cache`` of the
run folder; nothing depends on what they hold.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from palpate.core import PalpateError, Progress, Split, write_json
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import BackgroundAutoencoder
from palpate.diffusion.autoencoder_training import measure_reconstruction
from palpate.diffusion.autoencoders import autoencoder_of, load_autoencoder
from palpate.diffusion.generation import generate
from palpate.diffusion.options import AutoencoderOptions, BackgroundOptions
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.training import train_pipeline
from palpate.encoders import train_encoder
from palpate.encoders.embed import texts_of
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import pick_device
from palpate.evaluation.inputs import read as read_samples
from palpate.leakage.auditing import audit
from palpate.leakage.splitting import split as leak_free_split
from palpate.sim import WorldOptions, write_world
from palpate.studies.methods import Images, Make, Method, Setting
from palpate.studies.study import NOLEAK, ORIG, Preset, Study
from palpate.training.options import Compute
from palpate.training.processes import keep_logs

Facts = dict[str, Any]
After = Mapping[str, Path]


def slug(name: str) -> str:
    """A name as part of a folder's name: ``Ours w/ BG`` -> ``ours-w-bg``."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def cache_of(place: Path) -> Path:
    """The folder of caches of the run that a stage belongs to."""
    return place.parent / "cache"


def data_of(after: After, name: str) -> tuple[Manifest, Split]:
    """The data and one of its splits."""
    return Manifest.load(after["data"]), Split.load(after["split"] / f"{name}.json")


def fresh(folder: Path) -> Path:
    """The folder, without what a killed call left in it between saving and finishing its stage."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def make_world(place: Path, after: After, progress: Progress, *, options: WorldOptions) -> Facts:
    """The embedded world, in ``tree``."""
    record = write_world(place / "tree", options, workers=2, progress=progress)
    return {"digest": record.digest}


def read_data(
    place: Path, after: After, progress: Progress, *, study: Study, root: Path | None
) -> Facts:
    """The manifest."""
    source = after["world"] / "tree" if "world" in after else root
    assert source is not None
    study.read(source, place, progress)
    manifest = Manifest.load(place)
    videos = len({*manifest.column("video")} - {None})
    dataset = str(manifest.facts.get("dataset", study.name))
    counts = {"samples": len(manifest), "videos": videos}
    return {"digest": manifest.digest, "dataset": dataset, **counts}


def make_splits(
    place: Path, after: After, progress: Progress, *, noleak: str | None = None
) -> Facts:
    """The data set's own split, one without leaks, and their audits.

    That is the published one of ``noleak``, or one by whole videos with as large a train part. A
    data set without a split of its own gets one by whole contacts in its place.
    """
    manifest, own = Manifest.load(after["data"]), after["data"] / "splits" / f"{ORIG}.json"
    made = partial(leak_free_split, manifest, seed=0)
    original = Split.load(own) if own.is_file() else made(by="contact")
    counts = original.counts()
    share = counts["train"] / (counts["train"] + counts["test"])
    if noleak == "touch-and-go":
        share = 0.8  # of the record
    clean = made(by="video", train=share) if noleak is None else made(noleak=noleak, train=share)
    splits, audits = {ORIG: original, NOLEAK: clean}, list[Any]()
    for name, split in splits.items():
        split.save(place / f"{name}.json")
        how: Facts = {"cache": cache_of(place), "progress": progress}
        audits.append(audit(manifest, split=split, name=name, by="video", **how).to_json())
    write_json(place / "audits.json", audits)
    return {name: {"digest": s.digest, **s.counts()} for name, s in splits.items()}


def make_encoders(
    place: Path, after: After, progress: Progress, *, split: str, seed: int, **how: Any
) -> Facts:
    """A tactile encoder trained on the train part, with the frozen ones; in ``encoders``.

    ``how``: clip, preset and device, as of :func:`palpate.train_encoder`.
    """
    manifest, parts = data_of(after, split)
    folder = fresh(place / "encoders")
    encoders = train_encoder(manifest, parts, output=folder, seed=seed, progress=progress, **how)
    return {"digest": encoders.digest("tactile"), "scores": encoders.card.get("scores")}


def make_autoencoder(
    place: Path,
    after: After,
    progress: Progress,
    *,
    split: str,
    options: AutoencoderOptions | BackgroundOptions | str,
    size: int,
    device: str,
) -> Facts:
    """An autoencoder trained on the train part, or a trained one; in ``autoencoder``."""
    manifest, parts = data_of(after, split)
    cache = cache_of(place)
    common: Facts = {"cache": cache, "device": device, "progress": progress}
    if isinstance(options, str):
        model = load_autoencoder(options)
    else:
        model = autoencoder_of(manifest, parts, options, size, place / "training", **common)
    model.save(fresh(place / "autoencoder"))
    setting = setting_of(manifest, parts, place, size=size, device=device, progress=progress)
    real, gels = setting.pixels(setting.test), None
    if isinstance(model, BackgroundAutoencoder):
        gels = setting.pixels(setting.test, "background")
    ceiling = measure_reconstruction(model, real, gels)
    shutil.rmtree(place / "training", ignore_errors=True)
    # Without a codebook nothing is known of it.
    known = {k: float(v) for k, v in vars(ceiling).items() if v is not None}
    return {"digest": model.digest, "ceiling": known}


def make_generator(
    place: Path,
    after: After,
    progress: Progress,
    *,
    split: str,
    seed: int,
    method: Method,
    preset: Preset,
    autoencoder: str,
    device: str,
) -> Facts:
    """A method's generator trained from random weights on the train part; in ``model``.

    ``autoencoder``: the node that trained it.
    """
    manifest, parts = data_of(after, split)
    diffusion = method.preset(preset.diffusion)
    encoders = EncoderSet(load_clip(preset.clip, device=device))
    pipeline = train_pipeline(
        manifest,
        parts,
        None if diffusion.condition.source == "resnet" else encoders,
        load_autoencoder(after[autoencoder] / "autoencoder"),
        diffusion,
        place / "training",
        seed=seed,
        steps=preset.steps,
        background=method.background,
        cache=cache_of(place),
        device=device,
        compute=Compute(precision=preset.precision),
        progress=progress,
    )
    pipeline.save(fresh(place / "model"))
    keep_logs(place / "training", place / "model")
    shutil.rmtree(place / "training")
    loop = pipeline.training["loop"]
    facts = {"digest": pipeline.digest, "parameters": pipeline.training["parameters"]}
    return {**facts, "steps": loop["steps"], "batch": loop["batch"]}


def make_images(
    place: Path,
    after: After,
    progress: Progress,
    *,
    split: str,
    seed: int,
    method: Method,
    generator: str,
    preset: Preset,
    device: str,
) -> Facts:
    """A tactile image for each sample of the test part; in ``images``.

    ``generator``: the node that trained it; '' for a method that makes its images itself.
    """
    manifest, parts = data_of(after, split)
    output = place / "images"
    if method.make is not None:
        autoencoder = after.get(f"autoencoder-{split}")
        setting = setting_of(
            manifest,
            parts,
            place,
            size=preset.diffusion.size,
            seed=seed,
            steps=preset.steps,
            clip=preset.clip,
            device=device,
            autoencoder=autoencoder and autoencoder / "autoencoder",
            progress=progress,
        )
        made = _checked(method.name, method.make(setting), setting)
        write_images(output, setting.test.ids, made)
        return {"images": len(setting.test)}
    pipeline = TactilePipeline.from_pretrained(after[generator] / "model").to(pick_device(device))
    test = manifest.part(parts, "test")
    if method.text_of:
        texts, gels = texts_of(test)[0], None
        if pipeline.background:
            given = setting_of(manifest, parts, place, size=pipeline.size, progress=progress)
            gels = given.pixels(test, "background")
        each = {text: np.asarray(pipeline.embed_text(text)) for text in dict.fromkeys(texts)}
        words = np.concatenate([each[text] for text in texts])
        images = pipeline.sample(None, test.ids, texts=words, seed=seed, background=gels)
        write_images(output, test.ids, images)
    else:
        how: Facts = {"seed": seed, "device": device, "progress": progress}
        generate(test, model=pipeline, output=output, **how)
    return {"images": len(test), "pipeline": pipeline.digest}


def make_controls(
    place: Path,
    after: After,
    progress: Progress,
    *,
    split: str,
    controls: Mapping[str, Make],
    preset: Preset,
    device: str,
) -> Facts:
    """The images of every control that the data allow, a folder each."""
    manifest, parts = data_of(after, split)
    setting = setting_of(
        manifest,
        parts,
        place,
        size=preset.diffusion.size,
        steps=preset.steps,
        clip=preset.clip,
        device=device,
        autoencoder=after[f"autoencoder-{split}"] / "autoencoder",
        progress=progress,
    )
    made: list[str] = []
    for done, (name, make) in enumerate(controls.items()):
        progress("controls", done, len(controls), name)
        if (images := make(setting)) is not None:
            write_images(place / slug(name), setting.test.ids, _checked(name, images, setting))
            made.append(name)
    return {"controls": made}


def control_folders(after: After, split: str, names: Sequence[str]) -> dict[str, Path]:
    """Folders of the images of those controls that the data allow, by name."""
    folders = {name: after[f"controls-{split}"] / slug(name) for name in names}
    return {name: folder for name, folder in folders.items() if folder.is_dir()}


def take_images(
    place: Path, after: After, progress: Progress, *, split: str, folder: Path, size: int
) -> Facts:
    """Images that another system made for the test part, as ours; in ``images``.

    Raises:
        PalpateError: if the image of a test sample is missing.
    """
    manifest, parts = data_of(after, split)
    ids = manifest.part(parts, "test").ids
    samples = read_samples(folder, str(folder)).take(ids)
    write_images(place / "images", ids, samples.pixels(size, cache_of(place), progress))
    return {"images": len(ids), "digest": samples.image_digest()}


def write_images(folder: Path, ids: Sequence[str], images: Images) -> None:
    """Images as PNGs with the manifest that names their samples: what :func:`score` reads."""
    folder.mkdir(exist_ok=True)
    rows = [{"id": i, "tactile": f"{k}.png"} for k, i in enumerate(ids)]
    for row, image in zip(rows, images, strict=True):
        Image.fromarray(np.asarray(image)).save(folder / row["tactile"])
    Manifest.from_rows(rows, folder).save(folder / "manifest.parquet")


def _checked(name: str, made: Images | None, setting: Setting) -> Images:
    """The images that a function made.

    Raises:
        PalpateError: if it returned another number of images, or another kind of array.
    """
    images = np.asarray(made)
    shape = (len(setting.test), setting.size, setting.size, 3)
    if images.shape != shape or images.dtype != np.uint8:
        must = f"{name} must make an array {shape} of uint8, an image a test sample"
        raise PalpateError(must, f"{images.shape} of {images.dtype}", "Change its function")
    return images


def setting_of(
    manifest: Manifest,
    split: Split,
    place: Path,
    *,
    size: int,
    progress: Progress,
    seed: int = 0,
    steps: int = 0,
    clip: str = "",
    device: str = "auto",
    autoencoder: Path | None = None,
) -> Setting:
    """What makes images in a stage: the parts of a split, and where its files lie."""
    train, test = (manifest.part(split, part) for part in ("train", "test"))
    folder = place / "work"
    cache = cache_of(place)
    return Setting(
        train, test, size, seed, steps, clip, cache, folder, device, autoencoder, progress
    )
