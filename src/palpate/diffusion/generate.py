"""Checkpoint + photos or a manifest -> a folder of touches with an index, by id; or one photo -> one picture.

::

    OUT/images/<name>.png    one touch an id; the name is made from the id and cannot leave the folder
    OUT/index.json           {"format", "complete", "settings", "digest", "notice", "images": {id: name}, "skipped": [...]}

Each PNG carries as text its id, the settings as JSON, their digest, the digest of its photo, and the pipeline's notice, so a folder
that was left half done is continued: pictures of the same settings and photo are kept, and the result has the same bytes as one made
at a stretch; and a picture alone still says what it is. ``settings`` holds the pipeline's digest, seed, sampler and image size; a
folder made with others is refused.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, PngImagePlugin

from palpate.core import (
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    atomic_path,
    digest_file,
    digest_json,
    inside,
    quiet,
    read_json,
    short,
    write_json,
)
from palpate.core.digest import canonical_json
from palpate.data.images import load_images, read_image, square
from palpate.data.manifest import Manifest
from palpate.data.photos import MEND, photo_ids, require_some
from palpate.diffusion.card import SamplerOptions

if TYPE_CHECKING:  # torch takes seconds to import, and what is checked first needs none of it
    from torch import Tensor

    from palpate.diffusion.pipeline import TactilePipeline

FORMAT = "palpate-generated/1"


@dataclass(frozen=True)
class Generated:
    """A folder of generated touches.

    Attributes:
        folder: holds ``index.json`` and ``images``.
        files: id -> file name below ``images``.
        settings: what the pictures were made with.
        skipped: inputs that could not be used.
        made: how many pictures this call made (0 when loaded).
    """

    folder: Path
    files: Mapping[str, str]
    settings: Mapping[str, Any] = field(default_factory=dict)
    skipped: Sequence[Problem] = ()
    made: int = 0

    @property
    def ids(self) -> list[str]:
        """The ids, in the order of the index."""
        return list(self.files)

    @property
    def paths(self) -> list[Path]:
        """One image an id, in the order of :attr:`ids`."""
        return [self.folder / "images" / name for name in self.files.values()]

    def path(self, sample_id: str) -> Path:
        """The image of one id.

        Raises:
            PalpateError: if there is none.
        """
        if sample_id not in self.files:
            raise PalpateError(
                "Every id asked for must have been generated",
                repr(sample_id),
                "Generate it into the same folder",
            )
        return self.folder / "images" / self.files[sample_id]

    @classmethod
    def load(cls, folder: Path) -> Generated:
        """Reads a finished folder.

        Raises:
            PalpateError: if it has no index, was left half done, or names a file outside the folder or missing.
        """
        folder = Path(folder)
        index = _read_index(folder)
        if not index["complete"]:
            raise PalpateError(
                f"{folder} must be finished",
                "a folder that was left half done",
                "Run the same command again: it continues",
            )
        bad = [
            n
            for n in index["images"].values()
            if (p := inside(folder / "images", n)) is None or not p.is_file()
        ]
        if bad:
            raise PalpateError(
                f"Every image of {folder / 'index.json'} must lie in images/",
                f"{len(bad)} that do not, first {bad[0]!r}",
                "Generate again",
            )
        return cls(
            folder, index["images"], index["settings"], [Problem(**p) for p in index["skipped"]]
        )


@dataclass(frozen=True)
class _Input:
    """One touch to make."""

    sample: str
    vision: Path
    background: Path | None

    def digest(self) -> str:
        return digest_json([digest_file(p) if p else None for p in (self.vision, self.background)])


def generate(
    pipeline: TactilePipeline,
    *,
    out: Path,
    manifest: Manifest | None = None,
    photos: Path | Sequence[Path] | Mapping[str, Path] | None = None,
    ids: Sequence[str] | None = None,
    seed: int = 0,
    guidance: float | None = None,
    steps: int | None = None,
    batch: int | None = None,
    skip_bad: bool = False,
    progress: Progress = quiet,
) -> Generated:
    """Makes one touch for each photo; running it again continues a half-done folder.

    Args:
        pipeline: the generator, with its encoders.
        out: folder to fill.
        manifest: samples whose column ``vision`` (and ``background``, for a pipeline w/ BG) is used.
        photos: instead: a folder, files, or id -> file; ids are then paths below the folder, or file names.
        ids: which of them; default all.
        seed: of the noise of each sample.
        guidance: s; default: the sampler's of the pipeline.
        steps: of the solver; default: the sampler's.
        batch: pictures at once, which they do not depend on; default: the sampler's.
        skip_bad: list unreadable photos in the index instead of refusing.
        progress: told about embedding and generating.

    Returns:
        All pictures in the folder, with the unreadable inputs.

    Raises:
        PalpateError: on wrong arguments, or if the folder was made with other settings.
        ProblemsError: naming every unreadable photo, before any picture is made, unless ``skip_bad``.
    """
    import torch

    inputs = _inputs(pipeline, manifest, photos, ids)
    sampler = pipeline.sampler_with(guidance=guidance, steps=steps, batch=batch)
    settings = _settings(pipeline, sampler, seed)
    digest = digest_json(settings)
    out = Path(out)
    index: dict[str, Any] = _open_index(out, settings, digest) | {"notice": pipeline.notice}
    place = out / "images"
    stamps, bad = _stamps(inputs)
    todo = [
        i
        for i in inputs
        if i.sample in stamps
        and not _is_made(place / file_name(i.sample), i.sample, digest, stamps[i.sample])
    ]
    conditions, broken = _embed(pipeline, todo, progress)
    bad |= broken
    if bad and not skip_bad:
        raise ProblemsError(list(bad.values()), MEND)
    todo = [i for i in todo if i.sample in conditions]
    index["complete"] = False
    write_json(out / "index.json", index)
    for start in range(0, len(todo), sampler.batch):
        chunk = todo[start : start + sampler.batch]
        ground = (
            load_images([i.background for i in chunk if i.background], pipeline.size)
            if pipeline.background
            else None
        )
        rows = torch.stack([conditions[i.sample] for i in chunk])
        touches = pipeline.touch_from_embeddings(
            rows, [i.sample for i in chunk], seed=seed, sampler=sampler, background=ground
        )
        for item, touch in zip(chunk, touches, strict=True):
            text = _png_text(item.sample, settings, stamps[item.sample], pipeline.notice)
            _write(place / file_name(item.sample), touch, text)
        progress("generating touches", start + len(chunk), len(todo))
    images = index["images"] | {
        i.sample: file_name(i.sample) for i in inputs if i.sample not in bad
    }
    problems = list(bad.values())
    index |= {"complete": True, "images": images, "skipped": [asdict(p) for p in problems]}
    write_json(out / "index.json", index)
    return Generated(out, images, settings, problems, len(todo))


def generate_one(
    pipeline: TactilePipeline,
    photo: Path,
    out: Path,
    *,
    seed: int = 0,
    guidance: float | None = None,
    steps: int | None = None,
) -> bool:
    """Makes the touch of one photo as one PNG: the picture and text that :func:`generate` gives for ``photos=photo``.

    It is computed alone, not among the copies that fill a batch, so it takes a fraction of the time; other kernels may round a
    pixel to the next level.

    Args:
        pipeline: the generator, with its encoders; not the variant w/ BG.
        photo: an image file; its name is the id.
        out: the PNG to write, whole or not at all; what lies there is replaced.
        seed: of the noise.
        guidance: s; default: the sampler's of the pipeline.
        steps: of the solver; default: the sampler's.

    Returns:
        False if ``out`` was there already, made from the same photo with the same settings.

    Raises:
        PalpateError: on wrong arguments.
        ProblemsError: if the photo is missing or unreadable.
    """
    (item,) = _inputs(pipeline, None, Path(photo), None)
    sampler = pipeline.sampler_with(guidance=guidance, steps=steps, batch=1)
    settings = _settings(pipeline, sampler, seed)
    stamps, bad = _stamps([item])
    if not bad and _is_made(Path(out), item.sample, digest_json(settings), stamps[item.sample]):
        return False
    conditions, broken = _embed(pipeline, [item] if not bad else [], quiet)
    if bad | broken:
        raise ProblemsError([*(bad | broken).values()], "Choose another photo, or mend this one")
    touch = pipeline.touch_from_embeddings(
        conditions[item.sample][None], [item.sample], seed=seed, sampler=sampler
    )[0]
    _write(Path(out), touch, _png_text(item.sample, settings, stamps[item.sample], pipeline.notice))
    return True


def file_name(sample_id: str) -> str:
    """A file name that is unique to the id, on any file system: its harmless characters and a part of its SHA-256."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", sample_id).strip("_")[:80]
    return f"{plain or 'sample'}-{short(hashlib.sha256(sample_id.encode()).hexdigest())}.png"


def _settings(pipeline: TactilePipeline, sampler: SamplerOptions, seed: int) -> dict[str, Any]:
    """All that a picture depends on beside its photo; the batch is no part of it."""
    chosen = {k: v for k, v in asdict(sampler).items() if k != "batch"}
    return {
        "pipeline": pipeline.digest,
        "split": pipeline.training.get("split"),
        "preset": pipeline.preset,
        "seed": seed,
        "size": pipeline.size,
        "sampler": chosen,
    }


def _inputs(
    pipeline: TactilePipeline,
    manifest: Manifest | None,
    photos: Path | Sequence[Path] | Mapping[str, Path] | None,
    ids: Sequence[str] | None,
) -> list[_Input]:
    if (manifest is None) == (photos is None):
        raise PalpateError(
            "Touches are generated for a manifest or for photos",
            "both" if photos else "neither",
            "Pass one of the two",
        )
    if manifest is not None:
        chosen = manifest if ids is None else manifest.take(ids)
        grounds = chosen.paths("background") if pipeline.background else [None] * len(chosen)
        found = [
            _Input(*row) for row in zip(chosen.ids, chosen.paths("vision"), grounds, strict=True)
        ]
    else:
        if pipeline.background:
            raise PalpateError(
                "A generator w/ BG needs a background image a sample",
                "photos alone",
                "Use a manifest with backgrounds",
            )
        table = photo_ids(photos or {})
        if ids is not None and (missing := [i for i in ids if i not in table]):
            raise PalpateError(
                "Every id must be among the photos",
                f"{len(missing)} that are not, first {missing[0]!r}",
                "Check the names",
            )
        found = [_Input(i, table[i], None) for i in (table if ids is None else ids)]
    require_some(found)
    if len({i.sample for i in found}) < len(found):
        raise PalpateError("Ids must be unique", "an id that stands twice", "Name each id once")
    return found


def _read_index(folder: Path) -> dict[str, Any]:
    index = read_json(folder / "index.json", "index of generated touches")
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise PalpateError(
            f"{folder} must hold generated touches ({FORMAT})",
            "another kind of folder",
            "Make one with: palpate generate",
        )
    return index


def require_place(out: Path) -> dict[str, Any] | None:
    """The index of touches that were generated into ``out`` before; None where the folder is absent or empty.

    Raises:
        PalpateError: if something else is there.
    """
    if (out / "index.json").is_file():
        return _read_index(out)
    if out.exists() and not out.is_dir():
        raise PalpateError(
            f"{out} must be a folder, empty or with generated touches",
            "a file",
            "Choose another name",
        )
    if out.exists() and any(out.iterdir()):
        raise PalpateError(
            f"{out} must be empty or hold generated touches", "other files", "Choose another folder"
        )
    return None


def _open_index(out: Path, settings: Mapping[str, Any], digest: str) -> dict[str, Any]:
    """The index in ``out`` if it has these settings, else a new one for an empty folder."""
    index = require_place(out)
    if index is not None:
        if index["digest"] != digest:
            differ = [k for k, v in settings.items() if index["settings"].get(k) != v]
            got = f"another {', another '.join(differ)} there"
            raise PalpateError(
                f"{out} must hold touches of the same settings or nothing",
                got,
                "Choose another folder",
            )
        return index
    return {
        "format": FORMAT,
        "complete": False,
        "settings": dict(settings),
        "digest": digest,
        "images": {},
        "skipped": [],
    }


def _stamps(inputs: Sequence[_Input]) -> tuple[dict[str, str], dict[str, Problem]]:
    """By id: the digest of the files of each input, and what is wrong with those whose files cannot be opened."""
    stamps: dict[str, str] = {}
    bad: dict[str, Problem] = {}
    for item in inputs:
        try:
            stamps[item.sample] = item.digest()
        except OSError as error:
            bad[item.sample] = Problem(
                str(error.filename or item.vision),
                "missing-file",
                error.strerror or "cannot be opened",
            )
    return stamps, bad


def _is_made(file: Path, sample_id: str, digest: str, stamp: str) -> bool:
    try:
        with Image.open(file) as image:
            return [image.info.get(f"palpate.{k}") for k in ("id", "settings", "input")] == [
                sample_id,
                digest,
                stamp,
            ]
    except OSError:
        return False


def _png_text(
    sample_id: str, settings: Mapping[str, Any], stamp: str, notice: str
) -> PngImagePlugin.PngInfo:
    """What a touch says of itself; the order decides its bytes."""
    text = PngImagePlugin.PngInfo()
    said = {
        "id": sample_id,
        "settings": digest_json(settings),
        "input": stamp,
        "made-with": canonical_json(settings),
        "notice": notice,
    }
    for name, value in said.items():
        if value:
            text.add_itxt(f"palpate.{name}", value)
    return text


def _write(file: Path, touch: np.ndarray, text: PngImagePlugin.PngInfo) -> None:
    with atomic_path(file) as part:
        Image.fromarray(touch).save(part, format="PNG", pnginfo=text)


def _embed(
    pipeline: TactilePipeline, inputs: Sequence[_Input], progress: Progress
) -> tuple[dict[str, Tensor], dict[str, Problem]]:
    """By id: the vision embedding of each input whose files decode, and what is wrong with the others."""
    from palpate.diffusion.pipeline import EMBED

    found: dict[str, Tensor] = {}
    bad: dict[str, Problem] = {}
    for start in range(0, len(inputs), EMBED):
        pixels: dict[str, np.ndarray] = {}
        for item in inputs[start : start + EMBED]:
            file = item.vision
            try:
                photo = square(read_image(file), pipeline.vision_size)
                if (file := item.background) is not None:
                    read_image(file)
                pixels[item.sample] = photo
            except PalpateError as error:
                bad[item.sample] = Problem(str(file), "bad-image", error.got)
        if pixels:
            found |= dict(zip(pixels, pipeline.embed(np.stack(list(pixels.values()))), strict=True))
        progress("embedding photos", len(found) + len(bad), len(inputs))
    return found, bad
