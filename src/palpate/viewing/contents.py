"""What there is to look at: the samples of a data set or of results, by recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core import Progress, Split, quiet, require
from palpate.data import load
from palpate.data.suspicions import looked_at, suspicions
from palpate.report.results import Results

#: The kinds of images of a sample, in the order in which they are shown.
KINDS = ("vision", "tactile", "generated", "background")


@dataclass(frozen=True)
class Entry:
    """One sample: its id, recording, part of the split ('' without one), and images by kind."""

    id: str
    recording: str
    part: str
    material: str
    images: Mapping[str, Path]


@dataclass(frozen=True)
class Contents:
    """What a page shows.

    Attributes:
        title: what was opened.
        entries: the samples, those of one recording next to each other.
        suspicious: recording -> what looks wrong with it.
    """

    title: str
    entries: Sequence[Entry]
    suspicious: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])

    def to_json(self) -> dict[str, Any]:
        """Everything but the paths of the images."""
        recordings: dict[str, list[dict[str, Any]]] = {}
        for k, entry in enumerate(self.entries):
            row = {"k": k, "id": entry.id, "part": entry.part, "material": entry.material}
            own = recordings.setdefault(entry.recording, [])
            own.append(row | {"kinds": [kind for kind in KINDS if kind in entry.images]})
        rows = [
            {"name": name, "suspicious": list(self.suspicious.get(name, ())), "samples": own}
            for name, own in recordings.items()
        ]
        return {"title": self.title, "recordings": rows}


def contents(
    source: Any, *, split: Split | str | Path | None = None, progress: Progress = quiet
) -> Contents:
    """Read what there is to look at.

    Args:
        source: a file of results, or a data set as :func:`palpate.load` takes it.
        split: whose parts color the samples of a data set.
        progress: called while recordings are looked at.

    Raises:
        PalpateError: if it is neither, or no sample has an image.
    """
    title = str(source)
    if isinstance(source, str | Path) and Path(source).suffix == ".json":
        results = Results.load(source)
        entries, wrong = list(_of_results(results)), dict[str, list[str]]()
    else:
        manifest = load(source)
        parts = {} if split is None else Split.load(split).parts
        entries, wrong = [], {}
        columns = {c: manifest.column(c) for c in ("video", "material", *KINDS[:2], KINDS[3])}
        for k, name in enumerate(manifest.ids):
            row = {c: values[k] for c, values in columns.items()}
            images = {c: manifest.path(row[c]) for c in KINDS if row.get(c)}
            recording = row["video"] or name
            part = parts.get(name, "")
            entries.append(Entry(name, recording, part, row["material"] or "", images))
        looks = looked_at(manifest.table.iter_rows(named=True), manifest.root, progress)
        for problem in suspicions(looks):
            wrong.setdefault(problem.where, []).append(problem.text)
    entries = [entry for entry in entries if entry.images]
    require(bool(entries), None, "There must be images to look at", f"none in {title}")
    return Contents(title, entries, wrong)


def _of_results(results: Results) -> Iterable[Entry]:
    for item in results.gallery:
        sample = item.sample
        paths = {
            "vision": sample.vision,
            "tactile": sample.tactile,
            "generated": item.generated,
            "background": item.background or sample.background,
        }
        images = {kind: Path(path) for kind, path in paths.items() if path}
        recording = sample.video or item.method or "samples"
        yield Entry(sample.id, recording, item.method, sample.material or "", images)
