"""What a study makes, stage by stage: data, splits, encoders, autoencoders, generators, images.

Each function is the call of a node (:class:`palpate.studies.graph.Node`): it fills the folder of
its work, reads those of earlier nodes, and returns facts.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import Split, read_json, require, write_json
from palpate.data.manifest import Manifest
from palpate.data.samples import read_samples
from palpate.diffusion.autoencoder import BackgroundAutoencoder, load_autoencoder
from palpate.diffusion.autoencoder_training import autoencoder_of
from palpate.diffusion.ceiling import measure_reconstruction
from palpate.diffusion.generation import generate
from palpate.diffusion.options import AutoencoderOptions, BackgroundOptions
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import DiffusionPreset
from palpate.diffusion.training import Parts, train_pipeline
from palpate.encoders import train_encoder
from palpate.encoders.embed import texts_of
from palpate.encoders.encoder_set import load_clip
from palpate.encoders.models import pick_device
from palpate.leakage.auditing import audit
from palpate.leakage.splitting import split as leak_free_split
from palpate.sim.options import WorldOptions
from palpate.sim.presets import MINI_SEEDS
from palpate.sim.writer import write_world
from palpate.studies.files import cleared, data_of, write_images
from palpate.studies.graph import Work
from palpate.studies.methods import Images, Make, Rows, Setting
from palpate.studies.names import NOLEAK, ORIG, slug
from palpate.studies.stages import Facts
from palpate.training.options import Compute, Precision
from palpate.training.run import TrainingRun, keep_logs


def make_world(work: Work, *, options: WorldOptions) -> Facts:
    """The embedded world, in ``tree``."""
    record = write_world(work.folder / "tree", options, workers=2, progress=work.progress)
    return {"digest": record.digest}


def read_data(
    work: Work, *, read: Callable[..., None], root: Path | None, name: str, unseen: bool
) -> Facts:
    """The manifest of the data below ``root``, or of the embedded world.

    ``name``: of a data set that states none; ``unseen``: the shipped models must not know it.
    """
    source = root or work.after["world"] / "tree"
    if unseen:
        require_unseen(source)
    read(source, work.folder, work.progress)
    manifest = Manifest.load(work.folder)
    if unseen:  # images may lie elsewhere than the source
        require_unseen(manifest.root, manifest.facts)
    videos = len({*manifest.column("video")} - {None})
    dataset = str(manifest.facts.get("dataset", name))
    counts = {"samples": len(manifest), "videos": videos}
    return {"digest": manifest.digest, "dataset": dataset, **counts}


def require_unseen(source: Path, facts: Mapping[str, str] | None = None) -> None:
    """Raise for data that the shipped models were trained on: it cannot judge them.

    Args:
        source: a world, or any file or folder of one; the nearest ``world.json`` there or above
            decides.
        facts: of the manifest made of it; they hold the world's seed where ``world.json`` is out of
            sight.
    """
    path = Path(source).resolve()
    marks = (folder / "world.json" for folder in (path, *path.parents))
    mark = next((m for m in marks if m.is_file()), None)
    record = read_json(mark, "world record") if mark is not None else {}
    seen = isinstance(record, dict) and bool(record.get("seen_by_shipped_models"))
    seed = (facts or {}).get("world_seed", "")
    seen |= seed.isdecimal() and int(seed) in MINI_SEEDS
    must = "The shipped models must not have been trained on the data that they are judged on"
    require(not seen, None, must, f"{source}", fix="Write a world of another seed")


def make_splits(work: Work, *, noleak: str | None) -> Facts:
    """The data set's own split, one without leaks, and their audits.

    That is the published one of ``noleak``, or one by whole videos with as large a train part. A
    data set without a split of its own gets one by whole contacts in its place.
    """
    data = work.after["data"]
    manifest, own = Manifest.load(data), data / "splits" / f"{ORIG}.json"
    split_by = partial(leak_free_split, manifest, seed=0)
    original = Split.load(own) if own.is_file() else split_by(by="contact")
    counts = original.counts()
    share = counts["train"] / (counts["train"] + counts["test"])
    if noleak == "touch-and-go":
        share = 0.8  # of the record
    keep = partial(split_by, noleak=noleak) if noleak else partial(split_by, by="video")
    splits, audits = {ORIG: original, NOLEAK: keep(train=share)}, list[Any]()
    for name, split in splits.items():
        split.save(work.folder / f"{name}.json")
        audited = audit(
            manifest, split=split, name=name, by="video", cache=work.cache, progress=work.progress
        )
        audits.append(audited.to_json())
    write_json(work.folder / "audits.json", audits)
    return {name: {"digest": s.digest, **s.counts()} for name, s in splits.items()}


def make_encoders(
    work: Work,
    *,
    split: str,
    seed: int,
    preset: Any,
    clip: str | None,
    data: tuple[Manifest, Split] | None = None,
    epochs: float | None = None,
    compute: Compute | None = None,
) -> Facts:
    """A tactile encoder trained on the train part, with the frozen ones; in ``encoders``.

    ``data``: in the place of the stages before.
    """
    encoders = train_encoder(
        *(data or data_of(work, split)),
        preset=preset,
        clip=clip,
        output=cleared(work.folder / "encoders"),
        epochs=epochs,
        seed=seed,
        device=work.device,
        compute=compute,
        progress=work.progress,
    )
    return {"digest": encoders.digest("tactile"), "scores": encoders.card.get("scores")}


def make_autoencoder(
    work: Work, *, split: str, options: AutoencoderOptions | BackgroundOptions | str, size: int
) -> Facts:
    """An autoencoder trained on the train part, or a trained one; in ``autoencoder``."""
    manifest, parts = data_of(work, split)
    training = work.folder / "training"
    if isinstance(options, str):
        model = load_autoencoder(options)
    else:
        run = TrainingRun(training, cache=work.cache, device=work.device, progress=work.progress)
        model = autoencoder_of(manifest, parts, options, size, run)
    model.save(cleared(work.folder / "autoencoder"))
    setting = Setting(*_parts(manifest, parts), work, size)
    real, gels = setting.pixels(setting.test), None
    if isinstance(model, BackgroundAutoencoder):
        gels = setting.pixels(setting.test, "background")
    ceiling = measure_reconstruction(model, real, gels)
    shutil.rmtree(training, ignore_errors=True)
    # A codebook is reported only where there is one.
    scores = {k: float(v) for k, v in vars(ceiling).items() if v is not None}
    return {"digest": model.digest, "ceiling": scores}


def _parts(manifest: Manifest, split: Split) -> tuple[Manifest, Manifest]:
    return manifest.part(split, "train"), manifest.part(split, "test")


@dataclass(frozen=True)
class Training:
    """How a generator is trained."""

    diffusion: DiffusionPreset
    background: bool = False
    precision: Precision = "float32"


def make_generator(
    work: Work,
    *,
    split: str,
    seed: int,
    training: Training,
    clip: str,
    autoencoder: str,
    start: str | None = None,
) -> Facts:
    """A generator trained on the train part; in ``model``.

    ``autoencoder``: the node that trained it, or a trained one; ``start``: the generator that
    training goes on from, in the place of random weights.
    """
    folder, diffusion = work.folder / "training", training.diffusion
    trained = work.after.get(autoencoder)
    parts = Parts(
        diffusion,
        load_autoencoder(autoencoder if trained is None else trained / "autoencoder"),
        None if diffusion.condition.source == "resnet" else load_clip(clip, device=work.device),
        background=training.background,
        start=None if start is None else TactilePipeline.from_pretrained(start),
    )
    run = TrainingRun(
        folder,
        seed=seed,
        cache=work.cache,
        device=work.device,
        compute=Compute(precision=training.precision),
        progress=work.progress,
    )
    pipeline = train_pipeline(*data_of(work, split), parts, run)
    pipeline.save(cleared(work.folder / "model"))
    keep_logs(folder, work.folder / "model")
    shutil.rmtree(folder)
    loop = pipeline.training["loop"]
    return {
        "digest": pipeline.digest,
        "parameters": pipeline.training["parameters"],
        "steps": loop["steps"],
        "batch": loop["batch"],
        "background": pipeline.background,
    }


def make_images(
    work: Work, *, split: str, seed: int, generator: str, by_text: bool = False
) -> Facts:
    """A tactile image by the model of the node ``generator`` for each test sample; in ``images``.

    ``by_text``: each is driven by the sample's own text in the place of its photo.
    """
    manifest, parts = data_of(work, split)
    test, output = manifest.part(parts, "test"), work.folder / "images"
    pipeline = TactilePipeline.from_pretrained(work.after[generator] / "model")
    pipeline = pipeline.to(pick_device(work.device))
    if by_text:
        texts, gels = texts_of(test)[0], None
        if pipeline.background:
            setting = Setting(manifest.part(parts, "train"), test, work, pipeline.size)
            gels = setting.pixels(test, "background")
        each = {text: np.asarray(pipeline.embed_text(text)) for text in dict.fromkeys(texts)}
        words = np.concatenate([each[text] for text in texts])
        images = pipeline.sample(None, test.ids, texts=words, seed=seed, background=gels)
        write_images(output, test.ids, images)
    else:
        generate(
            test,
            model=pipeline,
            output=output,
            seed=seed,
            device=work.device,
            progress=work.progress,
        )
    return {"images": len(test), "pipeline": pipeline.digest}


def make_own_images(
    work: Work, *, split: str, seed: int, name: str, make: Make, size: int, steps: int, clip: str
) -> Facts:
    """The images of a method that is no diffusion model; in ``images``."""
    autoencoder = work.after.get(f"autoencoder-{split}")
    autoencoder = autoencoder and autoencoder / "autoencoder"
    setting = Setting(*_parts(*data_of(work, split)), work, size, seed, steps, clip, autoencoder)
    write_made(work.folder / "images", name, make(setting), setting)
    return {"images": len(setting.test)}


def make_controls(
    work: Work, *, split: str, controls: Mapping[str, Make], size: int, clip: str
) -> Facts:
    """The images of every control that the data allow, a folder each."""
    autoencoder = work.after[f"autoencoder-{split}"] / "autoencoder"
    parts = _parts(*data_of(work, split))
    setting = Setting(*parts, work, size, clip=clip, autoencoder=autoencoder)
    written: list[str] = []
    for done, (name, make) in enumerate(controls.items()):
        work.progress("controls", done, len(controls), name)
        if (made := make(setting)) is not None:
            write_made(work.folder / slug(name), name, made, setting)
            written.append(name)
    return {"controls": written}


def take_images(work: Work, *, split: str, folder: Path, size: int) -> Facts:
    """Images that another system made for the test part, as ours; in ``images``.

    Raises:
        PalpateError: if the image of a test sample is missing.
    """
    manifest, parts = data_of(work, split)
    ids = manifest.part(parts, "test").ids
    samples = read_samples(folder, str(folder)).take(ids)
    assert work.cache is not None  # every run of a study has one
    pixels = samples.pixels(size, work.cache, work.progress)
    write_images(work.folder / "images", ids, pixels)
    return {"images": len(ids), "digest": samples.image_digest()}


def write_made(folder: Path, name: str, made: Images | Rows | None, setting: Setting) -> None:
    """Write the images that a function made; real ones of train rows with the gels of these.

    Raises:
        PalpateError: if it returned another number of images, or another kind of array.
    """
    images, gels, train = np.asarray(made), None, setting.train
    if images.ndim == 1 and images.dtype.kind == "i":
        if not train.table["background"].null_count():
            gels = setting.pixels(train, "background")[images]
        images = setting.pixels(train)[images]
    shape = (len(setting.test), setting.size, setting.size, 3)
    must = f"{name} must make an array {shape} of uint8, an image a test sample"
    fits = images.shape == shape and images.dtype == np.uint8
    got = f"{images.shape} of {images.dtype}"
    require(fits, None, must, got, fix="Change its function")
    write_images(folder, setting.test.ids, images, gels)
