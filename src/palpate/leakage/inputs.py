"""Samples for an audit or a split, from whatever names them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from palpate.core import Note, PalpateError, Problem, ProblemsError, Progress, quiet
from palpate.data.listing import number_together, read_categories, read_lists
from palpate.data.manifest import Manifest
from palpate.data.reading import is_list, read_samples

#: A manifest, a path, several frame lists that are joined, or a polars or pandas frame.
Data = Any
#: Problems that a note names.
SHOWN = 40


def require(ok: bool, argument: str, must: str, got: Any, example: Any = None) -> None:
    """Raise unless an option is as it must be.

    Raises:
        PalpateError: naming the argument, with an example that would do.
    """
    if not ok:
        shown = {} if example is None else {argument: example}
        raise PalpateError(must, repr(got), "", argument=argument, example=shown)


def read(
    data: Data, skip_bad: bool = False, progress: Progress = quiet, root: str | Path | None = None
) -> tuple[Manifest, list[Note]]:
    """The samples, with a note on rows that were skipped.

    Raises:
        ProblemsError: with every bad row, unless ``skip_bad``.
    """
    paths = data if isinstance(data, (list, tuple)) else ()
    if len(paths) > 1 and all(isinstance(path, (str, Path)) for path in paths):
        manifest, skipped = _join([Path(path) for path in paths], skip_bad)
    else:
        source = paths[0] if len(paths) == 1 and not isinstance(paths[0], dict) else data
        manifest, skipped = read_samples(source, skip_bad=skip_bad, root=root, progress=progress)
    shown = [str(problem) for problem in skipped[:SHOWN]]
    notes = [Note("rows-skipped", {"count": len(skipped), "problems": shown})] if skipped else []
    return manifest, notes


def read_all(
    sources: Sequence[Data], skip_bad: bool, progress: Progress, root: str | Path | None
) -> tuple[list[Manifest], list[Note]]:
    """Several sources; the problems of all are raised together."""
    manifests: list[Manifest] = []
    problems: list[Problem] = []
    notes: list[Note] = []
    for source, name in zip(sources, ("train_or_data", "test", "pretrain"), strict=False):
        try:
            manifest, more = read(source, skip_bad, progress, root)
        except ProblemsError as error:
            problems += error.problems
        except PalpateError as error:
            error.argument = name if error.argument == "source" else error.argument
            raise
        else:
            manifests.append(manifest)
            notes += more
    if problems:
        raise ProblemsError(problems, "Correct the lines, or skip the bad ones")
    return manifests, notes


def number_contacts(manifests: list[Manifest]) -> list[Manifest]:
    """Number the contacts of bare frame lists over all of them."""
    bare = [k for k, manifest in enumerate(manifests) if set(manifest.facts) == {"source"}]
    numbered = iter(number_together(*(manifests[k] for k in bare)) if len(bare) > 1 else ())
    return [next(numbered, m) if k in bare else m for k, m in enumerate(manifests)]


def _join(paths: list[Path], skip_bad: bool) -> tuple[Manifest, list[Problem]]:
    """Several frame lists as one manifest."""
    for path in paths:
        if not path.is_file() or not is_list(path):
            raise PalpateError(
                "Several paths must all be frame lists",
                f"{path}, which is none" if path.exists() else f"no file {path}",
                "Name one manifest, or lists alone",
            )
    table = paths[0].parent / "category_reference.txt"
    joined = read_lists(
        paths,
        root=paths[0].parent,
        skip_bad=skip_bad,
        categories=read_categories(table) if table.is_file() else None,
    )
    return joined.manifest, joined.skipped
