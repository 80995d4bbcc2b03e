"""The files that the stages of a study write, and read from the folders of earlier stages.

``work.after`` has the folder of each earlier stage by name: ``data`` holds a manifest, ``split`` a
file for each split and ``audits.json``, ``controls-<split>`` a folder of images for each control.
"""

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


def cleared(folder: Path) -> Path:
    """Delete a folder, which a run killed before the end of its stage may have left; return it."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def data_of(work: Work, split: str = NOLEAK) -> tuple[Manifest, Split]:
    """Load the data and the split of that name, from the stages before."""
    return Manifest.load(work.after["data"]), Split.load(work.after["split"] / f"{split}.json")


def splits_of(work: Work) -> tuple[Manifest, dict[str, Split]]:
    """Load the data and both splits by name."""
    manifest, noleak = data_of(work)
    return manifest, {ORIG: data_of(work, ORIG)[1], NOLEAK: noleak}


def write_images(
    folder: Path,
    ids: Sequence[str],
    images: NDArray[np.uint8],
    gels: NDArray[np.uint8] | None = None,
) -> None:
    """Write images (n, h, w, 3) as PNGs, and a manifest with the n ids of their samples.

    :func:`palpate.score` reads such a folder as generated images. ``gels`` are their no-contact
    images, where these are not those of the samples.
    """
    folder.mkdir(exist_ok=True)
    rows = [{"id": sample, "tactile": f"{k}.png"} for k, sample in enumerate(ids)]
    for row, image in zip(rows, images, strict=True):
        save_image(folder / row["tactile"], np.asarray(image))
    files: dict[bytes, str] = {}
    for row, gel in zip(rows, () if gels is None else gels, strict=gels is not None):
        row["background"] = files.setdefault(gel.tobytes(), f"gel {len(files)}.png")
        save_image(folder / row["background"], gel)
    Manifest.from_rows(rows, folder).save(folder / "manifest.parquet")


def control_folders(work: Work, split: str, names: Sequence[str]) -> dict[str, Path]:
    """Return name -> folder of images, of those controls that were made from this data set.

    Others need what it lacks, as materials or backgrounds.
    """
    folders = {name: work.after[f"controls-{split}"] / slug(name) for name in names}
    return {name: folder for name, folder in folders.items() if folder.is_dir()}


def write_scores(folder: Path, scores: Sequence[Score]) -> None:
    """Write the scores of a stage to ``scores.json``."""
    write_json(folder / "scores.json", [score.to_json() for score in scores])


def read_scores(folder: Path) -> list[Score]:
    """Read what :func:`write_scores` wrote."""
    return [Score.from_json(score) for score in read_json(folder / "scores.json", "scores")]


def with_stage(score: Score, stage: str) -> Score:
    """Return the score with the name of the stage that made it in its details."""
    return replace(score, details={**score.details, "stage": stage})


#: The arrays of a :class:`Mean`, in the order of its fields: a value for every sample.
_ARRAYS = ("values", "weights", "groups")


def write_probed(work: Work, probed: Probed) -> None:
    """Write the scores of probed encoders, and the values of every sample behind them.

    The arrays of the k-th score are ``values<k>``, ``weights<k>`` and ``groups<k>`` in
    ``means.npz``.
    """
    write_scores(work.folder, [with_stage(mean.score, work.stage) for mean in probed.means])
    means = [(str(k), mean) for k, mean in enumerate(probed.means)]
    np.savez(
        work.folder / "means.npz",
        **{name + k: getattr(mean, name) for k, mean in means for name in _ARRAYS},
    )


def read_probed(folder: Path) -> Probed:
    """Read what :func:`write_probed` wrote."""
    scores = enumerate(read_scores(folder))
    with np.load(folder / "means.npz", allow_pickle=False) as arrays:
        return Probed([Mean(s, *(arrays[f"{name}{k}"] for name in _ARRAYS)) for k, s in scores])


def probing_plan(manifest: Manifest, splits: Mapping[str, Split]) -> Plan:
    """Return the plan to probe encoders for the paper's material accuracy and recall at 1 and 5.

    ``allow_seen``: a leaking split may have test images that train has too; that is what the study
    measures.
    """
    plan = Plan(top=(1, 5), allow_seen=True, axis="split", trained=True)
    return plan_of(manifest, splits, plan)


def read_audits(work: Work) -> list[Audit]:
    """Read the audits of the splits."""
    audits = read_json(work.after["split"] / "audits.json", "audits")
    return [Audit.from_json(audit) for audit in audits]


#: Most rows of a gallery; the page would fold further ones.
GALLERY = 40
#: Most rows of one contact: its frames are nearly equal.
PER_CONTACT = 2


def gallery(manifest: Manifest, generated: Generated, seed: int) -> list[GalleryItem]:
    """Choose generated samples for the page: random ones, from every material in turn.

    First comes one frame of every contact, then a second one. The choice depends on ``seed`` and
    the ids alone.
    """
    table, rank = manifest.take(generated.ids).table, pl.int_range(pl.len())
    draws = pl.Series("draw", [rng_for(seed, "gallery", name).random() for name in table["id"]])
    rows = (
        table.with_columns(draws)
        .sort("draw")
        .with_columns(in_contact=rank.over("video", "contact"))
        .with_columns(in_material=rank.over("material", "in_contact"))
        .filter(pl.col("in_contact") < PER_CONTACT)
        .sort(
            "in_contact", "in_material", pl.col("material").fill_null("None"), maintain_order=True
        )
    )
    items: list[GalleryItem] = []
    for row in rows.head(GALLERY).iter_rows(named=True):
        background = None
        if row["background"]:
            background = str(manifest.path(row["background"]).resolve())
        path = str(generated.path(row["id"]).resolve())
        items.append(GalleryItem(manifest.ref(row), path, background))
    return items
