"""What stages keep in their folders, and read of each other's: data, splits, images, scores."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Score, Split, read_json, rng_for, save_image, write_json
from palpate.data.manifest import Manifest
from palpate.diffusion.generated import Generated
from palpate.evaluation.probing import Plan, Probed, plan_of
from palpate.metrics.means import Mean
from palpate.report.records import GalleryItem
from palpate.report.results import Audit
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


def with_stage(score: Score, stage: str) -> Score:
    """The score with the name of the stage that it was made in."""
    return replace(score, details={**score.details, "stage": stage})


_MEAN = ("values", "weights", "groups")


def write_probed(work: Work, probed: Probed) -> None:
    """What encoders score in probing, with the values of every sample."""
    write_scores(work.folder, [with_stage(mean.score, work.stage) for mean in probed.means])
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
