"""``palpate embed``: the embeddings of a data set in a folder, by slices, which are read as one.

::

    OUT/part-3-of-16/features.npy   (n, dim) float32, in the order of the ids; a ruler's are raw
    OUT/part-3-of-16/rows.parquet   the samples, and whether the encoder was trained on each
    OUT/part-3-of-16/part.json      the record (:mod:`palpate.data.slices`)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import Progress, atomic_folder, digest_file, digest_json, fact_lines, plain, quiet
from palpate.core.shown import Shown
from palpate.data.residuals import MEDIANS, of_one_kind, with_gels
from palpate.data.samples import PART_FEATURES, PART_ROWS, SEEN, files_of, with_recordings
from palpate.data.slices import Part, Slice, command_of
from palpate.encoders.embed import Task
from palpate.encoders.encoder_set import Modality
from palpate.encoders.guard import guard, load_encoders


@dataclass(frozen=True)
class Embedded(Shown):
    """A part that was written, or was there.

    Attributes:
        folder: of all parts.
        part: its record.
        spread: how many samples slices have, in words.
        new: whether it was made now.
    """

    folder: Path
    part: Part
    spread: str
    new: bool

    def to_json(self) -> dict[str, Any]:
        """The record and the rest as a JSON object."""
        own = {"folder": str(self.folder), "new": self.new, "spread": self.spread}
        return plain(self.part) | own

    def __str__(self) -> str:
        rows = {"slice": self.part.slice, "samples": self.part.rows, "spread": self.spread}
        rows |= {"encoder": self.part.settings["encoder"], "made now": "yes" if self.new else "no"}
        return "\n".join([f"Embeddings {self.folder / self.part.place}", *fact_lines(rows)])


def embed_dataset(
    data: Any,
    encoder: Any,
    output: str | Path,
    *,
    modality: Modality = "tactile",
    reference: Any = None,
    still: bool = False,
    slice: str | Slice | None = None,  # noqa: A002 (the word that the command line uses)
    batch: int = 128,
    progress: Progress = quiet,
) -> Embedded:
    """Embed a data set, or one slice of it, into a folder that scores and probes read.

    A slice that was made of the same samples, images and weights is not made again.

    Args:
        data: image files, as :func:`palpate.score` takes them.
        encoder: name or folder of a set of encoders, or an ``EncoderSet``.
        output: folder of the parts.
        modality: ``tactile``, ``vision`` or ``text``.
        reference: real samples that those of ``data`` will be compared with: a ruler then takes
            one kind of background for both, as :func:`palpate.score` does for images.
        still: take each image alone, as scores do, also for encoders that look at an earlier frame.
        slice: ``i/n``; default: all.
        batch: images at a time.
        progress: called while the work goes on.

    Raises:
        PalpateError: if the data or the encoder cannot be read, the folder holds something else, or
            another process makes the same slice.
        ProblemsError: naming every unreadable image of the slice.
    """
    own, output = Slice.parse(slice), Path(output)
    samples = files_of(data)
    (named,) = with_recordings([samples])
    at = own.rows(named.manifest)  # none where there are fewer recordings than slices
    encoders = load_encoders(encoder, progress)
    preprocess = None if modality == "text" else encoders.preprocess(modality)
    whole, kind = samples.manifest, None
    if modality == "tactile" and encoders.preprocess(modality).residual:
        sets = [] if reference is None else [files_of(reference).manifest, whole]
        kind, backed = with_gels((sets or [whole])[0], sets[1:], output / "medians")
        whole = of_one_kind(backed[-1])
    some = replace(whole, table=whole.table[at].sort("id"))
    rows = replace(some, table=samples.manifest.table[at].sort("id"))
    task = Task(some, encoders, modality, still=still, raw=True)
    settings = {
        "encoder": encoders.digest(modality),
        "features": task.encoder,
        "modality": modality,
        "background": kind,
        "frames": "alone" if still or not getattr(preprocess, "lag", 0) else "with earlier ones",
    }
    command = command_of(
        *("embed", data if isinstance(data, str | Path) else "DATA"),
        encoder=encoder if isinstance(encoder, str | Path) else encoders.name,
        output=output,
        modality=modality,
        reference=reference,
        still=still,
    )
    part = Part(
        slice=str(own),
        command=command,
        settings=settings,
        read=digest_json([task.key, rows.digest]),
        data=samples.manifest.digest,
        rows=len(rows),
    )
    new = not part.is_finished(output)
    if new:
        with atomic_folder(output / part.place, instead=True) as place:
            task.write(place / PART_FEATURES, batch, progress)
            seen = ["yes" if s else None for s in encoders.saw(modality, some, progress=progress)]
            table = rows.table.with_columns(pl.Series(SEEN, seen, pl.String))
            replace(rows, table=table).save(place / PART_ROWS)
            none = replace(some, table=some.table.clear())
            notes = guard(encoders, modality, none, allow_seen=True)
            gels = {*some.column("background")} if kind in MEDIANS else {}
            facts = {"gels": sorted(digest_file(some.path(gel)) for gel in gels if gel)}
            replace(part, facts=facts, notes=plain(notes)).save(place)
    return Embedded(output, part, own.spread(named.manifest), new)
