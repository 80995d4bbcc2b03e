"""What the stages of a study keep in their folders, and what names things on disk in a digest."""

from __future__ import annotations

import hashlib
import inspect
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import (
    Score,
    Split,
    digest_file,
    digest_folder,
    digest_json,
    digest_lines,
    read_json,
    require,
    rng_for,
    save_image,
    write_json,
)
from palpate.data.manifest import Manifest
from palpate.diffusion.generated import Generated
from palpate.encoders.models import Part, shipped_folder
from palpate.evaluation.probing import Plan, Probed, plan_of
from palpate.metrics.means import Mean
from palpate.report.records import GalleryItem
from palpate.report.results import Audit
from palpate.sim.presets import MINI_SEEDS
from palpate.studies.graph import Work
from palpate.studies.names import NOLEAK, ORIG, slug


def fresh(folder: Path) -> Path:
    """The folder, without what a killed call left in it between saving and finishing its stage."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def data_of(work: Work, split: str = NOLEAK) -> tuple[Manifest, Split]:
    """The data and one of its splits."""
    return Manifest.load(work.after["data"]), Split.load(work.after["split"] / f"{split}.json")


def splits_of(work: Work) -> tuple[Manifest, dict[str, Split]]:
    """The data and both splits."""
    manifest, split = data_of(work)
    return manifest, {ORIG: data_of(work, ORIG)[1], NOLEAK: split}


def write_images(folder: Path, ids: Sequence[str], images: NDArray[np.uint8]) -> None:
    """Images as PNGs with the manifest that names their samples: what :func:`score` reads."""
    folder.mkdir(exist_ok=True)
    rows = [{"id": i, "tactile": f"{k}.png"} for k, i in enumerate(ids)]
    for row, image in zip(rows, images, strict=True):
        save_image(folder / row["tactile"], np.asarray(image))
    Manifest.from_rows(rows, folder).save(folder / "manifest.parquet")


def control_folders(work: Work, split: str, names: Sequence[str]) -> dict[str, Path]:
    """Folders of the images of those controls that the data allow, by name."""
    folders = {name: work.after[f"controls-{split}"] / slug(name) for name in names}
    return {name: folder for name, folder in folders.items() if folder.is_dir()}


def write_scores(folder: Path, scores: Sequence[Score]) -> None:
    """Scores of a stage."""
    write_json(folder / "scores.json", [score.to_json() for score in scores])


def read_scores(folder: Path) -> list[Score]:
    """What :func:`write_scores` wrote."""
    return [Score.from_json(s) for s in read_json(folder / "scores.json", "scores")]


def stamped(score: Score, stage: str) -> Score:
    """The score with the name of the stage that it was made in."""
    return replace(score, details={**score.details, "stage": stage})


_MEAN = ("values", "weights", "groups")


def write_probed(work: Work, probed: Probed) -> None:
    """What encoders score in probing, with the values of every sample."""
    write_scores(work.folder, [stamped(mean.score, work.stage) for mean in probed.means])
    means = enumerate(probed.means)
    arrays = ((f"{name}{k}", getattr(mean, name)) for k, mean in means for name in _MEAN)
    np.savez(work.folder / "means.npz", **dict(arrays))


def read_probed(folder: Path) -> Probed:
    """What :func:`write_probed` wrote."""
    scores = read_scores(folder)
    with np.load(folder / "means.npz", allow_pickle=False) as arrays:
        parts = [[arrays[f"{name}{k}"] for name in _MEAN] for k in range(len(scores))]
    return Probed([Mean(s, *part) for s, part in zip(scores, parts, strict=True)])


def probing_plan(manifest: Manifest, splits: Mapping[str, Split]) -> Plan:
    """What encoders are probed for: the paper's material accuracy and retrieval.

    A leaking split may hold a test image in train as well: that is what is measured.
    """
    plan = Plan(top=(1, 5), allow_seen=True, axis="split", trained=True)
    return plan_of(manifest, splits, plan)


def read_audits(work: Work) -> list[Audit]:
    """The audits of the splits."""
    audits = read_json(work.after["split"] / "audits.json", "audits")
    return [Audit.from_json(audit) for audit in audits]


#: Rows of a gallery; further ones would be collapsed.
GALLERY = 40
#: Rows per contact, whose frames are nearly equal.
PER_CONTACT = 2


def gallery(manifest: Manifest, generated: Generated, seed: int) -> list[GalleryItem]:
    """Test samples in turn from every material, one per contact first; chosen by seed alone."""
    table, number = manifest.take(generated.ids).table, pl.int_range(pl.len())
    order = pl.Series("order", [rng_for(seed, "gallery", i).random() for i in table["id"]])
    material = pl.col("material").fill_null("None")
    rows = (
        table.with_columns(order)
        .sort("order")
        .with_columns(of_contact=number.over("video", "contact"))
        .with_columns(of_material=number.over("material", "of_contact"))
        .filter(pl.col("of_contact") < PER_CONTACT)
        .sort("of_contact", "of_material", material, maintain_order=True)
    )
    items: list[GalleryItem] = []
    for row in rows.head(GALLERY).iter_rows(named=True):
        gel = row["background"] and str(manifest.path(row["background"]).resolve())
        path = str(generated.path(row["id"]).resolve())
        items.append(GalleryItem(manifest.ref(row), path, gel or None))
    return items


def model_stamp(part: Part, source: str | None) -> str | None:
    """What names a given model: the digest of its folder or file, or its hub id."""
    if source is None:
        return None
    if (shipped := shipped_folder(source, part)) is not None:
        record = read_json(shipped / "palpate.json", "model record")  # with digests of weights
        for card in {"card", "training"} & {*record}:  # what is trained from it carries the rest
            record[card] = {k: v for k, v in record[card].items() if k not in ("title", "summary")}
        return digest_json(record)
    if Path(source).is_file():
        return digest_file(Path(source))
    return digest_folder(Path(source)) if Path(source).is_dir() else source


def data_stamp(source: Path) -> str:
    """Names, sizes and modification times of the files of a data set: changes when it does."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return digest_lines(
        f"{p.relative_to(source)} {(s := p.stat()).st_size} {s.st_mtime_ns}" for p in files
    )


def function_stamp(function: Callable[..., Any]) -> str:
    """What names a function: its module, its name, and the digest of its source.

    Raises:
        PalpateError: if it has no source, or holds values of another function.
    """
    try:
        text = hashlib.sha256(inspect.getsource(function).encode()).hexdigest()
    except (OSError, TypeError):
        text = ""
    must = "What a study reads or makes its images with must be a function of a file"
    bare = bool(text) and not getattr(function, "__closure__", None)
    require(bare, None, must, f"{function!r}"[:200], fix="Write it in a module")
    return f"{function.__module__}.{function.__qualname__} {text}"


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
