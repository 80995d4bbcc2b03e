"""Generated tactile images, and the folder that holds them.

::

    OUT/images/<name>.png   one image per id; the name is made from the id (.jpg like such data)
    OUT/index.json          {"format", "complete", "settings", "digest", "notice",
                             "images": {id: name}, "unlike": {id: rate}, "skipped": [...],
                             "sealed"}

``unlike`` is the share of the training photos that are more like training than each photo.
``settings`` holds the pipeline's digest, seed, sampler and image size, of a text how unlike those
of the training it is, and its words that none of them has; a folder made with others is
rejected.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from PIL import Image

from palpate.core import (
    Note,
    PalpateError,
    Problem,
    fact_lines,
    read_record,
    reading_entry,
    require,
    short,
)
from palpate.core.records import from_plain
from palpate.core.shown import Shown
from palpate.data.images import read_image

FORMAT = "palpate-generated/1"
#: The share of the training from which a photo or a text is said to be out of range.
UNLIKE = 0.95


@dataclass(frozen=True)
class Generated(Shown):
    """Generated tactile images.

    Attributes:
        folder: holds ``index.json`` and ``images``; None for one PNG or images in memory.
        files: id -> file name below ``images``, or the path of one PNG; empty for images in memory.
        settings: what the images were made with.
        skipped: inputs that could not be used.
        new: how many images this call made (0 when loaded).
        notice: what everyone who looks at the images must know; often empty.
        unlike: id -> share of the training photos that are more like training than its photo is,
            where the pipeline knows them (:mod:`palpate.diffusion.training_range`).
        notes: what the caller must know: of the gel and the text that were given.
        memory: id -> image, where no output was given.
        missing: images that a dry run would make.
        evaluations: of the network, for these.
    """

    folder: Path | None
    files: Mapping[str, str]
    settings: Mapping[str, Any] = field(default_factory=dict)
    skipped: Sequence[Problem] = ()
    new: int = 0
    notice: str = ""
    unlike: Mapping[str, float] = field(default_factory=dict[str, float])
    notes: Sequence[Note] = ()
    memory: Mapping[str, Image.Image] = field(default_factory=dict[str, Image.Image], repr=False)
    missing: int = 0
    evaluations: int = 0

    def __str__(self) -> str:
        """Where the images are, how many, and what who looks at them must know."""
        facts = {"folder": self.folder, "images": len(self.ids), "made now": self.new}
        facts |= {"skipped": len(self.skipped)} if self.skipped else {}
        facts |= {"notice": self.notice} if self.notice else {}
        return "\n".join(["Tactile images", *fact_lines(facts)])

    @property
    def ids(self) -> list[str]:
        """The ids, in the order of the index."""
        return list(self.memory or self.files)

    @property
    def paths(self) -> list[Path]:
        """One file per id, in the order of :attr:`ids`."""
        return [self.path(i) for i in self.files]

    @property
    def images(self) -> list[Image.Image]:
        """One PIL image per id, in the order of :attr:`ids`."""
        return list(self.memory.values()) or [read_image(path) for path in self.paths]

    def path(self, sample_id: str) -> Path:
        """The file of one id.

        Raises:
            PalpateError: if there is none.
        """
        must, fix = "Every requested id must be generated", "Generate it into the same folder"
        require(sample_id in self.files, None, must, repr(sample_id), fix=fix)
        name = self.files[sample_id]
        return Path(name) if self.folder is None else self.folder / "images" / name

    @classmethod
    def load(cls, folder: Path) -> Generated:
        """Read a finished folder.

        Raises:
            PalpateError: if it has no index, was left half done, or names a file that is missing or
                outside.
        """
        from palpate.data.samples import generated_files

        folder = Path(folder)
        index = _read_index(folder)
        generated_files(folder, vars(index))  # checks them
        read = cls(folder, index.images, index.settings, index.skipped, notice=index.notice)
        return replace(read, unlike=index.unlike)


@dataclass(frozen=True, kw_only=True)
class Index:
    """What ``index.json`` holds; ``digest`` is that of the settings."""

    format: str = FORMAT
    complete: bool = False
    settings: Mapping[str, Any]
    digest: str
    images: Mapping[str, str] = field(default_factory=dict)
    unlike: Mapping[str, float] = field(default_factory=dict)
    skipped: Sequence[Problem] = ()
    notice: str = ""


def file_name(sample_id: str, suffix: str = ".png") -> str:
    """Return a safe file name: the plain characters of the id and a part of its SHA-256."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", sample_id).strip("_")[:80]
    return f"{plain or 'sample'}-{short(hashlib.sha256(sample_id.encode()).hexdigest())}{suffix}"


def _read_index(folder: Path) -> Index:
    index = read_record(folder / "index.json", "index of generated images", form=FORMAT)
    with reading_entry(folder / "index.json", "The index"):
        return from_plain(Index, index)


def old_index(
    output: Path, settings: Mapping[str, Any] | None = None, digest: str = ""
) -> Index | None:
    """Return the index of an earlier run in ``output``; None where it is absent or empty.

    Raises:
        PalpateError: if other files are there, or images of other settings than those given.
    """
    if (output / "index.json").is_file():
        index = _read_index(output)
        if settings is not None and index.digest != digest:
            old = index.settings
            differ = [k for k in {**settings, **old} if settings.get(k) != old.get(k)]
            must, got = "must hold images of the same settings", f"another {', '.join(differ)}"
            raise PalpateError(must, got, "Choose another folder", argument="output")
        return index
    empty = not output.exists() or (output.is_dir() and not any(output.iterdir()))
    must, got = "must be empty or hold generated images", f"other files in {output}"
    require(empty, "output", must, got, fix="Choose another folder")
    return None
