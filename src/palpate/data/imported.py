"""What every importer returns, and how it leaves nothing half-written behind."""

from __future__ import annotations

import shutil
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from palpate.core import PalpateError, Problem, ProblemsError, Split
from palpate.data.manifest import Manifest

FIX = "Mend these, or import again with --skip-bad to leave the rows out and list them"


@dataclass(frozen=True)
class Imported:
    """A data set that was read and written as a manifest.

    Attributes:
        manifest: the usable samples.
        skipped: everything that was left out because it is bad.
        splits: the data set's own splits by name (``"Orig"``), over ids of the manifest.
        inconclusive: rows left out because their label says that the material is unclear.
        suspicious: what was imported but looks wrong.
    """

    manifest: Manifest
    skipped: list[Problem] = field(default_factory=list)
    splits: Mapping[str, Split] = field(default_factory=dict)
    inconclusive: int = 0
    suspicious: list[Problem] = field(default_factory=list)

    @property
    def facts(self) -> Mapping[str, str]:
        """Facts about the source, as kept in the manifest."""
        return self.manifest.facts

    def save(self, out: Path, created: list[Path]) -> Imported:
        """Writes ``splits/<name>.json`` and, last, ``manifest.parquet`` into ``out``; new files are added to ``created``."""
        targets = {
            Path(out) / "splits" / f"{name}.json": split for name, split in self.splits.items()
        }
        for path, split in targets.items():
            created += [] if path.exists() else [path]
            split.save(path)
        path = Path(out) / "manifest.parquet"
        created += [] if path.exists() else [path]
        self.manifest.save(path)
        return self


def raise_if(problems: Sequence[Problem], skip_bad: bool) -> None:
    """Raises all problems at once unless they are to be skipped.

    Raises:
        ProblemsError: if there is a problem and not ``skip_bad``.
    """
    if problems and not skip_bad:
        raise ProblemsError(problems, FIX)


def require_some(samples: int, source: Path, skipped: Sequence[Problem]) -> None:
    """Refuses an import without samples.

    Raises:
        ProblemsError: with what was skipped, if that is why.
        PalpateError: if nothing was skipped either.
    """
    if samples == 0 and skipped:
        raise ProblemsError(skipped, "No sample is left without these: mend the data set")
    if samples == 0:
        raise PalpateError(
            f"{source} must hold at least one usable sample",
            "none",
            "Check the labels and the folder",
        )


@contextmanager
def removing_on_error(out: Path) -> Generator[list[Path]]:
    """Yields a list to enter every new file into; on an error, though not on Ctrl-C, those files and empty folders go away."""
    out = Path(out)
    existed = [p for p in (out, *out.parents) if p.exists()]
    created: list[Path] = []
    try:
        yield created
    except Exception:
        for path in created:
            path.unlink(missing_ok=True)
        for folder in sorted(
            {p for path in created for p in path.parents if p.is_relative_to(out)} | {out},
            reverse=True,
        ):
            if folder.is_dir() and folder not in existed and not any(folder.iterdir()):
                shutil.rmtree(folder)
        raise
