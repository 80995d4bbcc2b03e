"""Photos or a data set -> tactile images: in memory, as one PNG, or as a folder with an index.

::

    OUT/images/<name>.png   one image per id; the name is made from the id
    OUT/index.json          {"format", "complete", "settings", "digest", "notice",
                             "images": {id: name}, "skipped": [...]}

Each PNG carries as text its id, the settings as JSON, their digest, the digest of its photo, and
the pipeline's notice. So a folder that was left half done is continued: images of the same settings
and photo are kept, and the result has the same bytes as one made at a stretch. ``settings`` holds
the pipeline's digest, seed, sampler and image size; a folder made with others is rejected.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from palpate.core import (
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    Split,
    atomic_path,
    digest_file,
    digest_json,
    inside,
    locked,
    quiet,
    read_json,
    reading_entry,
    short,
    write_json,
)
from palpate.core.digest import canonical_json
from palpate.core.records import from_plain
from palpate.data.images import BROKEN, SUFFIXES, check_image, load_images, read_image, square
from palpate.encoders.models import FIX_MODEL, find_model

if TYPE_CHECKING:  # torch takes seconds to import, and what is checked first needs none of it
    from torch import Tensor

    from palpate.data.manifest import Manifest
    from palpate.diffusion.options import SamplerOptions
    from palpate.diffusion.pipeline import TactilePipeline

FORMAT = "palpate-generated/1"
Photos = str | Path | Sequence[str | Path] | Mapping[str, Path]
FIX_PHOTOS = "Fix, remove or skip these photos"
#: Photos that are decoded before the model is loaded, so that a broken one is reported at once.
FEW = 64


@dataclass(frozen=True)
class Generated:
    """Generated tactile images.

    Attributes:
        folder: holds ``index.json`` and ``images``; None for one PNG or images in memory.
        files: id -> file name below ``images``, or the path of one PNG; empty for images in memory.
        settings: what the images were made with.
        skipped: inputs that could not be used.
        made: how many images this call made (0 when loaded).
        notice: what everyone who looks at the images must know; often empty.
        memory: id -> image, where no output was given.
    """

    folder: Path | None
    files: Mapping[str, str]
    settings: Mapping[str, Any] = field(default_factory=dict)
    skipped: Sequence[Problem] = ()
    made: int = 0
    notice: str = ""
    memory: Mapping[str, Image.Image] = field(default_factory=dict[str, Image.Image], repr=False)

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
        if sample_id not in self.files:
            fix = "Generate it into the same folder"
            raise PalpateError("Every requested id must have been generated", repr(sample_id), fix)
        name = self.files[sample_id]
        return Path(name) if self.folder is None else self.folder / "images" / name

    @classmethod
    def load(cls, folder: Path) -> Generated:
        """Read a finished folder.

        Raises:
            PalpateError: if it has no index, was left half done, or names a file that is missing or
                outside.
        """
        folder = Path(folder)
        index = _read_index(folder)
        if not index["complete"]:
            fix = "Run the same command again: it continues"
            raise PalpateError(f"{folder} must be finished", "a folder left half done", fix)
        files = {name: inside(folder / "images", name) for name in index["images"].values()}
        if bad := [name for name, path in files.items() if path is None or not path.is_file()]:
            must = f"Every image of {folder / 'index.json'} must lie in images/"
            raise PalpateError(must, f"{len(bad)} that do not, first {bad[0]!r}", "Generate again")
        skipped = [Problem(**problem) for problem in index["skipped"]]
        notice = index.get("notice", "")
        return cls(folder, index["images"], index["settings"], skipped, notice=notice)


@dataclass(frozen=True)
class _Input:
    """One image to make."""

    id: str
    vision: Path
    background: Path | None = None

    def digest(self) -> str:
        return digest_json([digest_file(p) if p else None for p in (self.vision, self.background)])


def generate(  # noqa: PLR0913 - a public verb
    photos: Manifest | Photos,
    *,
    model: TactilePipeline | str | Path = "palpate/mini",
    output: str | Path | None = None,
    split: Split | str | Path | None = None,
    part: str = "test",
    seed: int = 0,
    guidance: float | None = None,
    steps: int | None = None,
    batch: int | None = None,
    skip_bad: bool = False,
    device: str = "auto",
    progress: Progress = quiet,
) -> Generated:
    """Make a tactile image for each photo; running it again continues a half-done folder.

    Args:
        photos: a photo, a folder of them, a list, id -> file, PIL images, a uint8 array
            (n, h, w, 3), a tensor (n, 3, h, w), or a manifest (or its file, folder or frame), whose
            columns ``vision`` and, for a pipeline w/ BG, ``background`` are used.
            The ids, which with ``seed`` decide the noise, are paths below a folder, file names, or
            those of the manifest.
        model: a pipeline, a folder of ``palpate train generator``, a hub id, or the shipped
            ``palpate/mini``, which knows a synthetic world alone.
        output: a folder, or a ``.png`` for one photo; None keeps the images in memory.
        split: with a manifest: only one part of this split (or split file).
        part: which part.
        seed: of the noise of each sample.
        guidance: scale of classifier-free guidance, 1 is none; default: the pipeline's.
        steps: of the solver; default: the pipeline's.
        batch: images at once, which they do not depend on; default: the pipeline's.
        skip_bad: list unreadable photos in the result instead of raising.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        progress: called while the work goes on.

    Returns:
        All images, with the unreadable inputs.

    Raises:
        PalpateError: on wrong arguments, or if the folder was made with other settings.
        ProblemsError: naming every unreadable photo, before any image is made, unless ``skip_bad``.
    """
    if _in_memory(photos):
        with tempfile.TemporaryDirectory() as folder:
            options: dict[str, Any] = {
                "seed": seed,
                "guidance": guidance,
                "steps": steps,
                "batch": batch,
            }
            options |= {"device": device, "progress": progress}
            return generate(_as_files(photos, Path(folder)), model=model, output=output, **options)
    manifest = _manifest(photos, split, part)
    table = {} if manifest is not None else photo_ids(cast("Photos", photos))
    paths = manifest.paths("vision") if manifest is not None else list(table.values())
    output = None if output is None else Path(output)
    single = _is_single(output, paths)
    if not paths:
        must, fix = "There must be at least one photo", "Check the folder, the split or the names"
        raise PalpateError(must, "none", fix)
    if not skip_bad and len(paths) <= FEW:
        _require_readable(paths)
    if isinstance(model, str | Path):
        progress(f"loading {model}", 0, 0)
        model = find_model(model, "generator", "pipeline", FIX_MODEL)
    from palpate.diffusion.pipeline import TactilePipeline

    if not isinstance(model, TactilePipeline):
        model = TactilePipeline.from_pretrained(model, device=device)
    sampler = model.sampler_with(guidance=guidance, steps=steps, batch=batch)
    if single:  # not among the copies that fill a batch: a fraction of the time
        sampler = replace(sampler, batch=1)
    target = _Target(output, single, _settings(model, sampler, seed), model.notice)
    inputs = _inputs(model, manifest, table)
    stamps, bad = _stamps(inputs)
    todo = [i for i in inputs if i.id in stamps and not target.has(i.id, stamps[i.id])]
    conditions, broken = _embed(model, todo, progress)
    bad |= broken
    if bad and not skip_bad:
        raise ProblemsError(list(bad.values()), FIX_PHOTOS, example={"skip_bad": True})
    todo = [i for i in todo if i.id in conditions]
    with target.writing():
        for start in range(0, len(todo), sampler.batch):
            chunk = todo[start : start + sampler.batch]
            files = [i.background for i in chunk if i.background]
            images = model.sample(
                np.stack([conditions[i.id] for i in chunk]),
                [i.id for i in chunk],
                seed=seed,
                sampler=sampler,
                background=load_images(files, model.size) if files else None,
            )
            for item, image in zip(chunk, images, strict=True):
                target.keep(item.id, image, stamps[item.id])
            progress("generating", start + len(chunk), len(todo))
        ids = [i.id for i in inputs if i.id not in bad]
        return target.finish(ids, list(bad.values()), len(todo))


@dataclass(frozen=True)
class _Index:
    """What ``index.json`` holds."""

    format: str
    complete: bool
    settings: Mapping[str, Any]
    digest: str
    images: Mapping[str, str]
    skipped: Sequence[Problem]
    notice: str = ""


class _Target:
    """Where images go: memory, one PNG, or a folder with an index."""

    def __init__(
        self, output: Path | None, single: bool, settings: dict[str, Any], notice: str
    ) -> None:
        self.settings, self.digest, self.notice = settings, digest_json(settings), notice
        self.file = output if single else None
        self.folder = None if single else output
        self.memory: dict[str, Image.Image] = {}
        self.index: dict[str, Any] = {}
        if self.folder is not None:
            index = _old_index(self.folder, settings, self.digest)
            head = {"format": FORMAT, "complete": False, "settings": settings}
            new = head | {"digest": self.digest, "images": {}, "skipped": []}
            self.index = (index or new) | {"notice": notice}

    def path(self, sample_id: str) -> Path | None:
        """The file of an image; None in memory."""
        return self.folder / "images" / file_name(sample_id) if self.folder else self.file

    def has(self, sample_id: str, stamp: str) -> bool:
        """Whether the image of this id, photo and settings is there."""
        if (path := self.path(sample_id)) is None:
            return False
        try:
            with Image.open(path) as image:
                text = [image.info.get(f"palpate.{k}") for k in ("id", "settings", "input")]
        except BROKEN:
            return False
        return text == [sample_id, self.digest, stamp]

    @contextmanager
    def writing(self) -> Generator[None]:
        """Hold the folder, and mark it as unfinished."""
        self.index["complete"] = False
        with nullcontext() if self.folder is None else locked(self.folder):
            if self.folder is not None:
                write_json(self.folder / "index.json", self.index)
            yield

    def keep(self, sample_id: str, array: NDArray[np.uint8], stamp: str) -> None:
        """Keep one image, as a PNG that says what it is."""
        image = Image.fromarray(array)
        if (path := self.path(sample_id)) is None:
            self.memory[sample_id] = image
            return
        text = PngImagePlugin.PngInfo()
        made_with = canonical_json(self.settings)
        values = {"id": sample_id, "settings": self.digest, "input": stamp}
        values |= {"made-with": made_with, "notice": self.notice}
        for name, value in values.items():  # their order decides the bytes
            if value:
                text.add_itxt(f"palpate.{name}", value)
        with atomic_path(path) as part:
            image.save(part, format="PNG", pnginfo=text)

    def finish(self, ids: Sequence[str], skipped: Sequence[Problem], made: int) -> Generated:
        """Complete the index; all images of the target, earlier ones included."""
        files = {} if self.file is None else {i: str(self.file) for i in ids}
        if self.folder is not None:
            files = self.index["images"] | {i: file_name(i) for i in ids}
            skips = [asdict(problem) for problem in skipped]
            self.index |= {"complete": True, "images": files, "skipped": skips}
            write_json(self.folder / "index.json", self.index)
        common = (self.settings, skipped, made, self.notice, self.memory)
        return Generated(self.folder, files, *common)


def photo_ids(photos: Photos) -> dict[str, Path]:
    """Ids of photos: paths below a folder (sorted), or file names.

    Raises:
        PalpateError: if a folder is missing or two files have one name.
    """
    if isinstance(photos, Mapping):
        return {i: Path(p) for i, p in photos.items()}
    if isinstance(photos, str | Path) and Path(photos).is_dir():
        folder = Path(photos)
        if (folder / "palpate.json").is_file():
            fix = "Pass models as the model"
            raise PalpateError("must be images", f"{folder}, a saved model", fix, argument="photos")
        files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
        return {p.relative_to(folder).as_posix(): p for p in files}
    paths = [Path(p) for p in ([photos] if isinstance(photos, str | Path) else photos)]
    if len(paths) == 1 and paths[0].is_dir():
        return photo_ids(paths[0])
    table = {path.name: path for path in paths}
    if len(table) < len(paths):
        names = [path.name for path in paths]
        twice = next(name for name in names if names.count(name) > 1)
        must, fix = "must differ in name in a list", "Pass their common folder instead"
        raise PalpateError(must, f"{twice!r} twice", fix, argument="photos")
    return table


def file_name(sample_id: str) -> str:
    """Return a safe file name: the plain characters of the id and a part of its SHA-256."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", sample_id).strip("_")[:80]
    return f"{plain or 'sample'}-{short(hashlib.sha256(sample_id.encode()).hexdigest())}.png"


def _in_memory(photos: Any) -> bool:
    """Return whether photos are images, arrays or tensors instead of files."""
    first = photos[0] if isinstance(photos, list | tuple) and photos else photos
    return isinstance(first, Image.Image | np.ndarray) or hasattr(first, "detach")


def _as_files(photos: Any, folder: Path) -> dict[str, Path]:
    """Write images in memory to ``folder`` without loss; their ids are their numbers."""
    from palpate.encoders.encoder import list_images

    files: dict[str, Path] = {}
    for k, image in enumerate(list_images(photos)):
        files[str(k)] = folder / f"{k}.png"
        cast("Image.Image", image).save(files[str(k)])
    return files


def _manifest(photos: Any, split: Split | str | Path | None, part: str) -> Manifest | None:
    """The part of the manifest that ``photos`` is or names, or None for photos."""
    manifest = _whole_manifest(photos)
    if manifest is None or split is None:
        return manifest
    return manifest.part(Split.load(split), part)


def _whole_manifest(photos: Any) -> Manifest | None:
    if hasattr(photos, "columns"):
        from palpate.data.reading import load

        return load(photos)
    if isinstance(photos, str | Path):
        path = Path(photos)
        if path.suffix != ".parquet" and not (path / "manifest.parquet").is_file():
            return None
        from palpate.data.manifest import Manifest

        return Manifest.load(path)
    return None if isinstance(photos, Sequence | Mapping) else photos


def _is_single(output: Path | None, paths: Sequence[Path]) -> bool:
    """Return whether the output is one image, in memory or a PNG; check that it may be written."""
    if output is None or output.suffix.lower() not in SUFFIXES:
        if output is not None:
            _old_index(output)
        return output is None and len(paths) == 1
    if output.suffix.lower() != ".png":
        fix = "PNG loses nothing"
        raise PalpateError("must be a .png or a folder", str(output), fix, argument="output")
    if output.is_dir() or len(paths) != 1:
        got = f"the folder {output}" if output.is_dir() else f"{output} for {len(paths)} photos"
        fix = f"Name a folder, e.g. {output.stem}/"
        raise PalpateError("with .png must be the file of one image", got, fix, argument="output")
    if output.exists():
        if paths[0].exists() and output.samefile(paths[0]):
            fix = "Choose another name"
            raise PalpateError("must not replace an input", str(output), fix, argument="output")
        with open(output, "rb") as file:
            if b"palpate.settings" not in file.read(4096):
                must, got = "must be new, or an image that palpate generated", f"{output}"
                raise PalpateError(must, got, "Choose another name", argument="output")
    return True


def _require_readable(paths: Sequence[Path]) -> None:
    reasons = ((path, check_image(path)) for path in paths)
    if bad := [Problem(str(path), "bad-image", reason) for path, reason in reasons if reason]:
        if len(paths) == 1:
            must, got = "must be an image that can be read", f"{paths[0]}: {bad[0].text}"
            raise PalpateError(must, got, "Check the path", argument="photos")
        raise ProblemsError(bad, FIX_PHOTOS, example={"skip_bad": True})


def _settings(pipeline: TactilePipeline, sampler: SamplerOptions, seed: int) -> dict[str, Any]:
    """All that an image depends on next to its photo; the batch is no part of it."""
    return {
        "pipeline": pipeline.digest,
        "split": pipeline.training.get("split"),
        "preset": pipeline.preset,
        "seed": seed,
        "size": pipeline.size,
        "sampler": {k: v for k, v in asdict(sampler).items() if k != "batch"},
    }


def _inputs(
    pipeline: TactilePipeline, manifest: Manifest | None, photos: Mapping[str, Path]
) -> list[_Input]:
    if manifest is None:
        if pipeline.background:
            must, got = "A generator w/ BG needs a background image per sample", "photos alone"
            raise PalpateError(must, got, "Use a manifest with backgrounds")
        return [_Input(i, path) for i, path in photos.items()]
    count = len(manifest)
    grounds = manifest.paths("background") if pipeline.background else [None] * count
    rows = zip(manifest.ids, manifest.paths("vision"), grounds, strict=True)
    return [_Input(*row) for row in rows]


def _read_index(folder: Path) -> dict[str, Any]:
    index = read_json(folder / "index.json", "index of generated images")
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        must, fix = f"{folder} must hold generated images ({FORMAT})", "Choose another folder"
        raise PalpateError(must, "another kind of folder", fix)
    with reading_entry(folder / "index.json", "The index"):
        from_plain(_Index, index)
    return index


def _old_index(
    output: Path, settings: Mapping[str, Any] | None = None, digest: str = ""
) -> dict[str, Any] | None:
    """Return the index of an earlier run in ``output``; None where it is absent or empty.

    Raises:
        PalpateError: if other files are there, or images of other settings than those given.
    """
    if (output / "index.json").is_file():
        index = _read_index(output)
        if settings is not None and index["digest"] != digest:
            differ = [k for k, v in settings.items() if index["settings"].get(k) != v]
            must, got = "must hold images of the same settings", f"another {', '.join(differ)}"
            raise PalpateError(must, got, "Choose another folder", argument="output")
        return index
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        must, got = "must be empty or hold generated images", f"other files in {output}"
        raise PalpateError(must, got, "Choose another folder", argument="output")
    return None


def _stamps(inputs: Sequence[_Input]) -> tuple[dict[str, str], dict[str, Problem]]:
    """Return, by id, the digest of each input's files, or a problem if they cannot be opened."""
    stamps: dict[str, str] = {}
    bad: dict[str, Problem] = {}
    for item in inputs:
        try:
            stamps[item.id] = item.digest()
        except OSError as error:
            reason = error.strerror or "cannot be opened"
            bad[item.id] = Problem(str(error.filename or item.vision), "missing-file", reason)
    return stamps, bad


def _embed(
    pipeline: TactilePipeline, inputs: Sequence[_Input], progress: Progress
) -> tuple[dict[str, Tensor], dict[str, Problem]]:
    """Return, by id, the vision embedding of each input, or a problem if it does not decode."""
    from palpate.diffusion.pipeline import EMBED

    embedded: dict[str, Tensor] = {}
    bad: dict[str, Problem] = {}
    for start in range(0, len(inputs), EMBED):
        pixels: dict[str, NDArray[np.uint8]] = {}
        for item in inputs[start : start + EMBED]:
            file = item.vision
            try:
                photo = square(read_image(file), pipeline.vision_size)
                if (file := item.background) is not None:
                    read_image(file)
                pixels[item.id] = photo
            except PalpateError as error:
                bad[item.id] = Problem(str(file), "bad-image", error.got)
        if pixels:
            rows = pipeline.embed(np.stack(list(pixels.values())))
            embedded |= dict(zip(pixels, rows, strict=True))
        progress("embedding photos", len(embedded) + len(bad), len(inputs))
    return embedded, bad
