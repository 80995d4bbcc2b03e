"""SSVTP (Kerr et al., 2022) as TVL distributes it: 4,587 single presses of a DIGIT on cloth and household things, worded by people.

::

    ssvtp/
      train.csv  test.csv                     url,tactile,caption
      images_rgb/image_437_rgb.jpg            the id is what stands between image_ and _rgb
      images_tac/image_437_tac.jpg
      text/labels_437.txt                     first line: the caption
      tac_background.png                      the gel untouched, if the user put it there; TVL ships it with its code
      finetune.json  synonyms.json            not read: captions as talk; words that an evaluation takes for equal

The source may be ``ssvtp/`` or a folder that holds it. Touch and text are found by the id of the photo, since the lists lack the column ``tactile`` or
misname files in places. A listed path that disagrees is reported, and stands in only where the derived file is absent. Without lists every
photo with its touch is a sample, and there is no part.

There is no recording, no object and no time in this set: ``video`` and ``frame`` are null, and near-duplicates are all that
tells which samples belong together. The caption is the text file's first line, else the list's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from palpate.core import PalpateError, Problem, Progress, Split, quiet
from palpate.data.formats import tvl
from palpate.data.formats.base import Facts, Found, Scan
from palpate.data.images import SUFFIXES
from palpate.data.manifest import CLIMBS, Manifest

FACTS = Facts(
    "SSVTP (Touch-Vision-Language)",
    "J. Kerr, H. Huang, A. Wilcox, R. Hoque, J. Ichnowski, R. Calandra, K. Goldberg: Self-Supervised Visuo-Tactile Pretraining to Locate and "
    "Follow Garment Features. 2022, arXiv 2209.13042. With captions: " + tvl.CITATION,
    "unknown",
    tvl.URL,
    "DIGIT",
    (240, 320),
    "4,587 by TVL's paper; 46 in the test list",
    "none is given: clusters of near-duplicates",
    tvl.NORMALIZATION,
)
FOLDERS = {"vision": ("images_rgb", "rgb"), "tactile": ("images_tac", "tac")}
NAME = re.compile(r"image_(.+?)(?:_rgb|_tac)?")
BACKGROUND = "tac_background.png"
COLUMNS = ("url", "tactile", "caption")
LOOKED_FOR = (
    "ssvtp/, or images_rgb/ with image_<id>_rgb.jpg and images_tac/ with image_<id>_tac.jpg"
)


def detect(source: Path) -> bool:
    """Whether a folder is SSVTP, or holds it in ``ssvtp/`` and no ``hct/`` beside it, which would be read instead."""
    root = find(source)
    return root is not None and (root == Path(source) or not (Path(source) / "hct").is_dir())


def find(source: Path) -> Path | None:
    """``ssvtp/``, from there or from the folder that holds it."""
    both = [name for name, _ in FOLDERS.values()]
    return next(
        (
            root
            for root in (Path(source), Path(source) / "ssvtp")
            if all((root / name).is_dir() for name in both)
        ),
        None,
    )


def scan(source: Path, *, lists: Path | None = None, progress: Progress = quiet) -> Scan:
    """Reads the lists, or the folders where there are none, and finds each sample's files by its id.

    Args:
        source: ``ssvtp/`` or the folder that holds it.
        lists: folder with lists to use instead of the data set's own.
        progress: told how many rows are read.

    Raises:
        PalpateError: if the two image folders are not there, or ``lists`` holds none.
    """
    root = find(source)
    if root is None:
        raise PalpateError(
            f"{source} must be SSVTP: {LOOKED_FOR}", "none of these", f"Unpack it from {tvl.URL}"
        )
    found = Scan([], root, facts={"layout": "ssvtp"})
    there = tvl.part_lists(lists if lists is not None else root)
    if lists is not None and not there:
        raise PalpateError(f"{lists} must hold train.csv or test.csv", "neither", "Check the path")
    work = _Work(root, found)
    for part, path in there.items():
        rows = tvl.read_csv(path, found.problems, COLUMNS)
        for done, (where, cells) in enumerate(rows, 1):
            if (row := work.row(where, cells)) is not None:
                found.rows.append((where, row | {"split": part}))
            progress(f"reading {path.name}", done, len(rows))
    used = {str(row[side]) for _, row in found.rows for side in FOLDERS}
    if not there:
        found.rows += work.unlisted()
    elif more := sorted(work.files["vision"] - used):
        found.suspicious.append(
            Problem(str(root / more[0]), "unlisted", f"{len(more)} photos stand in no list")
        )
    if there:
        found.own = name = "Orig" if lists is None else "Lists"
        found.rules[name] = {
            "method": "official" if lists is None else "lists",
            "files": [path.name for path in there.values()],
        }
    found.rows.sort(key=lambda row: _order(row[1]["id"]))
    work.finish()
    return found


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Writes ``<part>.csv`` with ``url,tactile,caption``, paths relative to ``ssvtp/``."""
    files: list[Path] = []
    for part in split.counts():
        rows = manifest.part(split, part).table.select("vision", "tactile", "text").rows()
        files.append(tvl.write_csv(Path(folder) / f"{part}.csv", COLUMNS, rows))
    return files


@dataclass
class _Work:
    """Makes rows, and remembers what disagreed.

    Attributes:
        root: ``ssvtp/``.
        found: what goes to the caller.
        files: the pictures on disk by side, relative to the root.
        misnamed, worded, wordless: places of rows with other paths than derived, with other words than the text file's, and without any.
        sources: where captions came from.
    """

    root: Path
    found: Scan
    files: dict[str, set[str]] = field(default_factory=dict)
    misnamed: list[str] = field(default_factory=list)
    worded: list[str] = field(default_factory=list)
    wordless: list[str] = field(default_factory=list)
    sources: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        for side, (folder, _) in FOLDERS.items():
            names = sorted(
                path.name
                for path in (self.root / folder).iterdir()
                if tvl.is_picture(path.name) and not path.name.startswith(".")
            )
            self.files[side] = {f"{folder}/{name}" for name in names}
        self.background = BACKGROUND if (self.root / BACKGROUND).is_file() else None

    def row(self, where: str, cells: Mapping[str, str | None]) -> dict[str, Any] | None:
        """The manifest row of a listed one, or None with a problem."""
        listed = {"vision": cells.get("url"), "tactile": cells.get("tactile")}
        if not listed["vision"]:
            self.found.problems.append(Problem(where, "empty-cell", "no url path"))
            return None
        for cell in listed.values():
            if cell and re.search(CLIMBS, cell):
                self.found.problems.append(
                    Problem(where, "outside-root", f"the path {cell!r} leaves the data set")
                )
                return None
        given = {
            side: PurePosixPath(cell).as_posix().removeprefix("ssvtp/") if cell else None
            for side, cell in listed.items()
        }
        path = PurePosixPath(str(given["vision"]))
        match = NAME.fullmatch(path.stem)
        if match is None:
            self.found.problems.append(
                Problem(where, "bad-path", f"{path.name!r} is not image_<id>_rgb.jpg")
            )
            return None
        derived = {side: self._derived(side, match[1], path.suffix) for side in FOLDERS}
        if any(cell and cell != derived[side] for side, cell in given.items()):
            self.misnamed.append(where)
        paths = {
            side: given[side]
            if name not in self.files[side] and given[side] in self.files[side]
            else name
            for side, name in derived.items()
        }
        return self._cells(where, match[1], paths, tvl.clean_caption(cells.get("caption")))

    def unlisted(self) -> list[Found]:
        """Rows of all photos that have a touch; single ones are problems."""
        by_id: dict[str, dict[str, str]] = {}
        for side, names in self.files.items():
            for name in sorted(names):
                match = re.fullmatch(rf"image_(.+)_{FOLDERS[side][1]}", PurePosixPath(name).stem)
                if match is None:
                    self.misnamed.append(str(self.root / name))
                else:
                    by_id.setdefault(match[1], {}).setdefault(side, name)
        rows: list[Found] = []
        for key, paths in by_id.items():
            if len(paths) < len(FOLDERS):
                (name,) = paths.values()
                self.found.problems.append(
                    Problem(
                        str(self.root / name),
                        "unpaired",
                        f"no picture of the id {key!r} on the other side",
                    )
                )
            else:
                rows.append(
                    (
                        str(self.root / paths["vision"]),
                        self._cells(str(self.root / paths["vision"]), key, paths, None),
                    )
                )
        return rows

    def finish(self) -> None:
        """Sums up what disagreed."""
        told = self.found.suspicious
        told += tvl.summed(
            self.misnamed, "misnamed-path", "other files are named than the photo's id tells"
        )
        told += tvl.summed(
            self.worded, "two-captions", "the text file has other words than the list, and counts"
        )
        told += tvl.summed(
            self.wordless, "no-text", "neither a text file nor a caption in the list"
        )
        self.found.facts["text_source"] = ", ".join(sorted(self.sources)) or "none"
        self.found.facts["backgrounds"] = (
            self.background or f"none: put {BACKGROUND} into ssvtp/ to have one"
        )

    def _derived(self, side: str, key: str, suffix: str) -> str:
        """The file of an id, with the listed suffix or, if only that is there, with another."""
        folder, tail = FOLDERS[side]
        names = [f"{folder}/image_{key}_{tail}{s}" for s in (suffix, *SUFFIXES)]
        return next((name for name in names if name in self.files[side]), names[0])

    def _cells(
        self, where: str, key: str, paths: Mapping[str, str | None], caption: str | None
    ) -> dict[str, Any]:
        file = self.root / "text" / f"labels_{key}.txt"
        text = None
        if file.is_file():
            lines = file.read_bytes().decode("utf-8-sig", errors="replace").splitlines()
            text = tvl.clean_caption(lines[0]) if lines else None
        if text and caption and text != caption:
            self.worded.append(where)
        if text or caption:
            self.sources.add("text/labels_<id>.txt" if text else "column caption")
        else:
            self.wordless.append(where)
        return {
            "id": f"ssvtp/{key}",
            **paths,
            "text": text or caption,
            "background": self.background,
            "sensor": FACTS.sensor,
        }


def _order(name: str) -> tuple[int, str]:
    """By number where the id is one."""
    key = name.removeprefix("ssvtp/")
    return (int(key), key) if re.fullmatch(r"[0-9]{1,18}", key) else (-1, key)
