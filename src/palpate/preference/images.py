"""Images of a study: all of one size, encoded anew, so that no file gives its method away.

The center square of every image, as generators see it, is resized to ``size`` pixels and written as
JPEG without metadata.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from palpate.core import Note, Progress, image_bytes, require, track
from palpate.core.messages import require_joined
from palpate.data.images import read_image, square
from palpate.data.recordings import recordings_note
from palpate.data.samples import (
    Samples,
    labeled,
    named_sources,
    read_labels,
    read_samples,
    with_full_ids,
    with_recordings,
)
from palpate.preference.plan import COPY, EXAMPLE, GEL, REFERENCE, SAME, Item, Plan

QUALITY = 92


@dataclass(frozen=True)
class Sources:
    """Images by id: of the reference, its gel where known, and the methods."""

    items: list[Item]
    paths: Mapping[str, Mapping[str, Path]]
    notes: list[Note]

    def path(self, item: str, slot: str) -> Path | None:
        """File of an image of the study; None for a gel that is not known."""
        slot = REFERENCE if slot in (COPY, EXAMPLE) else slot
        return self.paths.get(slot, {}).get(item)


def read_sources(
    reference: Any, generated: Any, names: Sequence[str] | None, labels: Any
) -> Sources:
    """Read reference and methods; items are the ids that all have.

    Raises:
        PalpateError: if one has no image files, or no id is common.
    """
    real, table = _files(read_samples(reference, REFERENCE)), read_labels(labels)
    if table is not None:
        require_joined(real.ids, table["id"], "The labels")
    real = labeled(real, table)
    reserved = (REFERENCE, GEL, COPY, EXAMPLE, SAME)
    sources = named_sources(generated, names, reserved).items()
    methods = {name: with_full_ids(_files(read_samples(s, name)), real.ids) for name, s in sources}
    real, *named = with_recordings([real, *methods.values()])
    methods = dict(zip(methods, named, strict=True))
    ids = {name: {*samples.ids} for name, samples in methods.items()}
    every = {*real.ids}
    common = every.intersection(*ids.values())
    counts = ", ".join(f"{name} has {len(every & own):,}" for name, own in ids.items())
    got = f"of the {len(real):,} {counts}, and none is in all"
    fix = "Ids are paths below each folder, without suffix: give them equal names"
    must = "Methods must have images of the reference's ids"
    require(bool(common), None, must, got, fix=fix)
    notes = [recordings_note(real.manifest)]
    notes += [
        Note("items-left-out", {"name": n, "missing": len(every - i), "unknown": len(i - every)})
        for n, i in ids.items()
        if i != every
    ]
    columns = (real.labels or [""] * len(real), real.groups or [""] * len(real))
    rows = zip(real.ids, *columns, strict=True)
    items = [Item(i, label or None, group or None) for i, label, group in rows if i in common]
    notes += [Note("videos-unknown")] * (not any(item.video for item in items))
    paths = {
        name: dict(zip(samples.ids, samples.manifest.paths("tactile"), strict=True))
        for name, samples in [(REFERENCE, real), *methods.items()]
    }
    if real.has_background:
        paths[GEL] = dict(zip(real.ids, real.manifest.paths("background"), strict=True))
    return Sources(items, paths, notes)


def _files(samples: Samples) -> Samples:
    """Samples that are image files.

    Raises:
        PalpateError: if they are embeddings or arrays.
    """
    got = f"{samples.source}, {'embeddings' if samples.embedded else 'arrays'}"
    fix = "Pass a folder of images or a manifest"
    require(samples.rows is None, None, "People look at image files", got, fix=fix)
    return samples


def encoded(plan: Plan, sources: Sources, progress: Progress) -> dict[str, str]:
    """Name -> data URI of every image that a trial or strip shows.

    Raises:
        PalpateError: if one is broken.
    """
    wanted = {(t.item, side) for t in plan.trials for side in (t.left, t.right) if side}
    if plan.task == "pair":
        wanted |= {(item.id, REFERENCE) for item in plan.items}
    wanted |= {(item.id, EXAMPLE) for item in plan.examples}
    files = {key: path for key in sorted(wanted) if (path := sources.path(*key)) is not None}
    read_files = track(list(files.items()), "reading images", progress)
    images = {key: square(read_image(path), plan.size) for key, path in read_files}
    if missing := wanted - set(images):  # no background is known
        paths = (sources.paths[REFERENCE][item.id] for item in plan.items)
        reference = [square(read_image(path), plan.size) for path in paths]
        gel = estimated_gel(np.stack(reference))
        images |= dict.fromkeys(missing, gel)
    # The copy in a catch is another file than the reference above it.
    return {
        plan.name(*key): data_uri(image, QUALITY - (key[1] in (COPY, GEL)))
        for key, image in images.items()
    }


def data_uri(image: NDArray[np.uint8], quality: int = QUALITY) -> str:
    """Encode an image (h, w, 3) as JPEG without metadata, as a data URI."""
    data = image_bytes(image, "JPEG", quality=quality, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()


def estimated_gel(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The sensor without contact: the mean of (n, h, w, 3) images without any detail."""
    mean = Image.fromarray(images.mean(axis=0).round().astype(np.uint8))
    return np.asarray(mean.filter(ImageFilter.GaussianBlur(images.shape[1] / 8)))
