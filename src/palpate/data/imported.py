"""What importing and validating return, and how a failed import leaves nothing half-written."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import Problem, Progress, Split, fact_lines, plain, problem_lines, quiet
from palpate.core.shown import Shown
from palpate.data.captions import NAMED
from palpate.data.images import Check
from palpate.data.manifest import IMAGE_COLUMNS, Manifest
from palpate.data.scanning import Facts, Scan, finished, manifest_of, raise_if, require_some
from palpate.data.suspicions import CLOCK, Look

#: Rows that an import shows of a folder.
EXAMPLES = 3
#: Manifest column -> what its distinct values are called in a summary.
COUNTED = {"video": "videos", "contact": "contacts", "material": "materials"}


@dataclass(frozen=True)
class Imported(Shown):
    """A data set that was read and written as a manifest. Print it for a summary.

    Attributes:
        manifest: the usable samples.
        skipped: everything that was skipped because it is bad.
        splits: the data set's own splits by name (``"Orig"``), over ids of the manifest.
        inconclusive: rows skipped because their label marks the material as unclear.
        suspicious: what was imported but looks wrong.
        path: the manifest file.
    """

    manifest: Manifest
    skipped: list[Problem] = field(default_factory=list)
    splits: Mapping[str, Split] = field(default_factory=dict)
    inconclusive: int = 0
    suspicious: list[Problem] = field(default_factory=list)
    path: Path | None = None

    @property
    def facts(self) -> Mapping[str, str]:
        """Facts about the source, as kept in the manifest."""
        return self.manifest.facts

    def save(self, output: Path, created: list[Path]) -> Imported:
        """Write the splits and, last, ``manifest.parquet``; new files are added to ``created``.

        Splits of an earlier import into the same folder that this one lacks are removed.
        """
        splits, path = output / "splits", output / "manifest.parquet"
        items = {splits / f"{name}.json": split for name, split in self.splits.items()}
        for stale in set(splits.glob("*.json")) - set(items):
            stale.unlink()
        for file, item in {**items, path: self.manifest}.items():
            created += [] if file.exists() else [file]
            item.save(file)
        return replace(self, path=path)

    def summary(self) -> dict[str, Any]:
        """What was imported, in numbers."""
        table = self.manifest.table
        return {
            "manifest": str(self.path),
            "digest": self.manifest.digest,
            "samples": len(self.manifest),
            **{many: table[one].drop_nulls().n_unique() for one, many in COUNTED.items()},
            "with_background": table["background"].count(),
            "with_text": table["text"].count(),
            "inconclusive": self.inconclusive,
            "splits": {name: split.counts() for name, split in self.splits.items()},
        }

    def to_json(self) -> dict[str, Any]:
        """The summary, all problems and the facts as a JSON object."""
        lists = {"skipped": plain(self.skipped), "suspicious": plain(self.suspicious)}
        return self.summary() | lists | {"facts": dict(self.facts)}

    def __str__(self) -> str:
        lists = {"Skipped": self.skipped, "Suspicious, but imported": self.suspicious}
        words = words_of(self.manifest.table)
        rows = self.summary() | templates_of(self.manifest) | ({"captions": words} if words else {})
        return _text(f"Imported {self.facts.get('dataset', '')}", rows, lists)


def imported_of(
    scan: Scan, source: object, *, skip_bad: bool, check: Check, progress: Progress = quiet
) -> Imported:
    """A scan as an import that is not written yet.

    Raises:
        ProblemsError: with every bad row and file, unless ``skip_bad``.
        PalpateError: if no usable row is left.
    """
    rows = finished(scan, check, progress)
    clocks = [problem for problem in scan.suspicious if problem.kind == CLOCK]  # why some are alone
    raise_if([*clocks, *scan.problems] if scan.problems else [], skip_bad)
    require_some(len(rows), source, scan.problems)
    manifest = manifest_of(scan, rows)
    ids = set(manifest.ids)
    splits: dict[str, Split] = {}
    for name, split in scan.splits.items():
        if parts := {i: part for i, part in split.parts.items() if i in ids}:
            splits[name] = Split(parts, split.rule, manifest.digest)
    return Imported(manifest, scan.problems, splits, scan.inconclusive, scan.suspicious)


@dataclass(frozen=True)
class Validation(Shown):
    """A data set checked without importing it. Print it for a report.

    Attributes:
        format: the format's name.
        facts: about the data set.
        samples: usable rows.
        missing: listed but not there, or there without a partner.
        invalid: there but unusable.
        suspicious: usable, but a person should look.
        templates: those of a folder, with three rows of what they give.
        looks: what suspicious recordings look like.
    """

    format: str
    facts: Facts
    samples: int
    missing: Sequence[Problem]
    invalid: Sequence[Problem]
    suspicious: Sequence[Problem]
    templates: Mapping[str, str] = field(default_factory=dict)
    looks: Mapping[str, Look] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether nothing is missing or invalid."""
        return not self.missing and not self.invalid

    def to_json(self) -> dict[str, Any]:
        """Facts, counts and all problems as a JSON object."""
        kinds = ("format", "samples", "ok", "missing", "invalid", "suspicious", "facts")
        return {kind: plain(getattr(self, kind)) for kind in (*kinds, "templates")}

    def __str__(self) -> str:
        lists = {k: getattr(self, k.lower()) for k in ("Missing", "Invalid", "Suspicious")}
        counts = {kind.lower(): len(problems) for kind, problems in lists.items()}
        rows: dict[str, Any] = {"format": self.format, "samples": self.samples, **counts}
        rows |= {**self.templates, **readable(self.facts)}
        verdict = "Complete." if self.ok else "Not complete."
        return f"{_text('Validated ' + self.facts.name, rows, lists)}\n{verdict}"


def templates_of(manifest: Manifest) -> dict[str, str]:
    """The templates of a folder, with three rows of what they gave, and how images were read."""
    table, facts = manifest.filled(), manifest.facts
    rows = {c: facts[f"template_{c}"] for c in IMAGE_COLUMNS if f"template_{c}" in facts}
    step = max(1, (len(table) - 1) // (EXAMPLES - 1))
    for k, row in enumerate(table.gather_every(step).head(EXAMPLES).iter_rows(named=True), 1):
        cells = (f"{name}={cell}" for name, cell in row.items() if name not in IMAGE_COLUMNS)
        rows |= {f"example {k}": ", ".join(cells)} if rows else {}
    return rows | ({"images read as": facts["images"]} if "images" in facts else {})


def words_of(table: pl.DataFrame) -> str:
    """How many samples have no text, and what their captions will be made of, in words."""
    without = table.filter(pl.col("text").is_null())
    names = pl.coalesce(*(pl.when(pl.col(c).is_not_null()).then(pl.lit(c)) for c in NAMED))
    counts = without.select(names.alias("of")).group_by("of", maintain_order=True).len().iter_rows()
    sources = ", ".join(f"{count} of the {'sample' if c == 'id' else c}" for c, count in counts)
    return f"made from the name: {sources}" if sources else ""


def readable(facts: Facts) -> dict[str, Any]:
    """Facts of a data set as rows of a printed table."""
    rows = asdict(facts)
    size = rows.pop("image_size")
    rows["published"] = rows.pop("samples")
    return rows | {"image_size": f"{size[0]} x {size[1]}" if size else None}


def splits_of(folder: Path) -> dict[str, Split]:
    """The splits in the folder of an import, by name."""
    return {path.stem: Split.load(path) for path in sorted(folder.glob("splits/*.json"))}


@contextmanager
def removing_on_error(output: Path) -> Generator[list[Path]]:
    """Yield a list for new files, which are removed on an error, though not on Ctrl-C."""
    existed = {p for p in (output, *output.parents) if p.exists()}
    created: list[Path] = []
    try:
        yield created
    except Exception:
        for path in created:
            path.unlink(missing_ok=True)
        folders = {p for path in created for p in path.parents if p.is_relative_to(output)}
        for folder in sorted({*folders, output} - existed, reverse=True):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        raise


def _text(title: str, rows: Mapping[str, Any], lists: Mapping[str, Sequence[Problem]]) -> str:
    """A table of names and values, and lists of problems, as text."""
    lines = [title, *fact_lines(rows)]
    for name, problems in lists.items():
        if problems:
            lines += [f"{name}: {len(problems)}", *problem_lines(problems)]
    return "\n".join(lines)
