"""Photos or a data set -> tactile images: in memory, as one PNG, or as a folder.

Each PNG carries as text its id, the settings as JSON, their digest, the digest of its photo, how
unlike those of the training the photo is, and the pipeline's notice; a JPEG has them as JSON in its
comment. So a folder that was left half
done is continued: images of the same settings and photo are kept, and the result has the same bytes
as one made at a stretch.
"""

from __future__ import annotations

import json
import os
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from palpate.core import (
    ImageError,
    Note,
    PalpateError,
    Problem,
    ProblemsError,
    Progress,
    Split,
    digest_file,
    digest_json,
    few,
    locked,
    open_image,
    plain,
    quiet,
    require,
    rng_for,
    save_image,
    sealed,
    write_json,
)
from palpate.core.files import canonical_json
from palpate.core.images import SUFFIXES
from palpate.data.images import check_image, file_stamp, images_below, read_image, square
from palpate.data.slices import Part, Slice, command_of
from palpate.diffusion.generated import UNLIKE, Generated, Index, file_name, old_index
from palpate.diffusion.requested import Profile, Requested
from palpate.encoders.models import FIX_MODEL, find_model

if TYPE_CHECKING:  # torch takes seconds to import, and what is checked first needs none of it
    from torch import Tensor

    from palpate.data.manifest import Manifest
    from palpate.data.storage import Form
    from palpate.diffusion.options import SamplerOptions
    from palpate.diffusion.pipeline import TactilePipeline

T = TypeVar("T")
R = TypeVar("R")
Photos = str | Path | Sequence[str | Path] | Mapping[str, Path]
FIX_PHOTOS = "Fix, remove or skip these photos"
WHOLE = "must go with a manifest, of which it names the parts"
#: Photos that are decoded before the model is loaded, so that a broken one is reported at once.
FEW = 64
#: Threads that read photos while others are sampled.
THREADS = max(2, min(16, os.cpu_count() or 1))
#: Suffixes of videos.
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm")
#: What whole files end with: PNG and JPEG.
ENDS = (b"\0\0\0\0IEND\xaeB`\x82", b"\xff\xd9")
#: Gels kept in memory.
GELS = 64


@dataclass(frozen=True)
class _Item:
    """One image to make; once its files have been read, their digest and pixels."""

    id: str
    vision: Path | None
    background: Path | None = None
    stamp: str = ""
    photo: NDArray[np.uint8] | None = None
    ground: NDArray[np.uint8] | None = None
    condition: Tensor | None = None
    unlike: float | None = None
    recording: str = ""
    sensor: str | None = None

    def digest(self) -> str:
        """Of the bytes of both files."""
        return digest_json([digest_file(p) if p else None for p in (self.vision, self.background)])


def generate(  # noqa: PLR0913 - a public verb, step by step
    photos: Manifest | Photos | None = None,
    *,
    text: str | None = None,
    weight: float | None = None,
    gel: str | Path | None = None,
    at: tuple[float, float] | None = None,
    area: float | None = None,
    strength: float | None = None,
    shear: tuple[float, float] | None = None,
    force: float | None = None,
    depth: float | None = None,
    profile: str | Path | None = None,
    like: str | Path | None = None,
    model: TactilePipeline | str | Path = "palpate/mini",
    output: str | Path | None = None,
    split: Split | str | Path | None = None,
    part: str = "test",
    seed: int = 0,
    guidance: float | None = None,
    steps: int | None = None,
    batch: int | None = None,
    skip_bad: bool = False,
    strict: bool = False,
    dry_run: bool = False,
    device: str = "auto",
    slice: str | Slice | None = None,  # noqa: A002 (the word that the command line uses)
    progress: Progress = quiet,
) -> Generated:
    """Make a tactile image for each photo; running it again continues a half-done folder.

    Args:
        photos: a photo, a folder of them, a list, id -> file, or a manifest (or its file, folder or
            frame), whose columns ``vision`` and, for a pipeline w/ BG, ``background`` are used.
            The ids, which with ``seed`` decide the noise, are paths below a folder, file names, or
            those of the manifest. None: one image of ``text`` alone, whose id is the text.
        text: what is felt, e.g. ``"rough, porous stone"``; next to photos, for all of them.
        weight: with photos and a text, the share of the photo where both take one place; default:
            0.5.
        gel: an image of the gel without contact, on which the images are made; default: the
            manifest's column ``background``, else the model's stock gel.
        at: place of the contact, in shares of the gel's width and height from the top left. This
            and what follows must be known to the model; what is not given is drawn among the
            training touches of surfaces like these, by the seed.
        area: share of the gel in contact.
        strength: of the contact, from 0 to 1: its quantile among the training contacts.
        shear: mean motion of the gel's markers, right and down [% of the width].
        force: in place of a strength, if training knew forces [N].
        depth: in place of a strength, if training knew depths [mm].
        profile: for a video: a table (CSV) of time_s, strength, shear_x, shear_y; default: those of
            the ``gelsight.mp4`` beside it.
        like: a folder of images or of a data set, in whose formats the images are stored: JPEG with
            the quantization tables of a random one of its tactile images, or PNG where that is
            lossless.
        model: a pipeline, a folder of ``palpate train generator``, a hub id, or the shipped
            ``palpate/mini``, which knows a synthetic world alone.
        output: a folder, or a ``.png`` for one photo, or an ``.mp4`` for a video of a surface; None
            keeps the images in memory.
        split: with a manifest: only one part of this split (or split file).
        part: which part.
        seed: of the noise of each sample.
        guidance: scale of classifier-free guidance, 1 is none; default: the pipeline's.
        steps: of the solver; default: the pipeline's.
        batch: images at once, which they do not depend on; default: the pipeline's.
        skip_bad: list unreadable photos in the result instead of raising.
        strict: raise for photos and texts that are unlike 95 % of those of the training, and for
            words that none of its texts has; ``skip_bad`` lists such photos.
        dry_run: write nothing; the result says what is missing, and has no images.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        slice: ``i/n``: make the images of whole recordings of that slice alone, in a folder of
            their own below ``output``, from which scores read all.
        progress: called while the work goes on.

    Returns:
        All images, with the unreadable inputs.

    Raises:
        PalpateError: on wrong arguments, or if the folder was made with other settings.
        ProblemsError: naming every unreadable photo, unless ``skip_bad``; of up to 32 photos before
            any image is made.
    """
    weight = _share(weight, photos is not None, text is not None)
    requested = Requested(at, area, strength, shear, force, depth)
    made_by = command_of(
        *("generate", *(photos if isinstance(photos, list | tuple) else [photos])),
        output=output,
        model=model if isinstance(model, str | Path) else "MODEL",
        split=split,
        part=None if split is None else part,
        text=text,
        weight=weight if text else None,
        gel=gel,
        seed=seed,
        guidance=guidance,
        steps=steps,
        strict=strict,
        **requested.given(),
        profile=profile,
    )
    folder, output = _places(output, slice)
    device, (rank, size), gathered = _process(device)
    require(split is None or photos is not None, "split", WHOLE, "a text alone", fix="Leave it out")
    items = [_Item(str(text), None)] if photos is None else _items(photos, split, part)
    paths = [item.vision or Path(item.id) for item in items]
    film = _is_film(output, paths, profile)
    curve = None if profile is None else Profile.load(profile)
    single = film or _is_single(output, paths)
    if photos is not None and not skip_bad and not film:
        _require_readable(paths)
    model = _loaded(model, device, progress)
    sampler = model.sampler_with(guidance=guidance, steps=steps, batch=batch)
    if single:  # not among the copies that fill a batch: a fraction of the time
        sampler = replace(sampler, batch=1)
    words = None if text is None else model.embed_text(text)
    settings = _settings(model, sampler, seed)
    settings |= {"text": text, "weight": None if photos is None else weight} if text else {}
    forms = _forms_like(like, "" if output is None else "a video" * film or "a .png" * single)
    settings |= (
        _range_of(model, text, words, strict)
        | ({"strict": True} if strict else {})
        | _touch_and_like(requested.given(), forms)
    )
    touches = {s: requested.row(model.contact, s) for s in {item.sensor for item in items}}
    items = _on_gels(items, model, gel)
    notes = [*_range_notes(settings), *_notes(model, text, gel), *_shear(model, requested, items)]
    if film and output is not None:
        from palpate.diffusion.touched_video import touch_video

        return touch_video(
            paths[0],
            output,
            model,
            requested=requested,
            sampler=model.sampler_with(guidance=guidance, steps=steps, batch=batch),
            settings=settings,
            profile=curve,
            texts=words,
            weight=weight,
            gel=items[0].background,
            seed=seed,
            notes=notes,
            progress=progress,
        )
    items, part_made = _sliced(items, slice, settings, folder, made_by)
    target = _Target(output, single, settings, model.notice, rank == 0, part=part_made, forms=forms)
    if dry_run:
        files = ((item, target.path(item.id)) for item in items)
        there = [item for item, path in files if path and path.is_file()]
        missing = len(items) - sum(target.has(item, item.digest()) for item in there)
        each = model.evaluations(sampler)
        return Generated(
            target.folder, {}, settings, notes=notes, missing=missing, evaluations=missing * each
        )

    outside: list[tuple[float, float]] = []

    def drawn(items: Iterator[_Item]) -> Generator[tuple[_Item, NDArray[np.uint8]]]:
        while chunk := [*islice(items, sampler.batch)]:
            rows: list[Any] = [item.condition for item in chunk if item.condition is not None]
            grounds = [item.ground for item in chunk if item.ground is not None]
            photos = np.stack(rows) if rows else None
            wanted = np.stack([touches[item.sensor] for item in chunk])
            outside.extend(model.unlikely(wanted[:, 3], photos, words))
            images = model.sample(
                photos,
                [item.id for item in chunk],
                seed=seed,
                texts=words,
                weight=weight,
                sampler=sampler,
                background=np.stack(grounds) if grounds else None,
                touches=wanted,
            )
            yield from zip(chunk, images, strict=True)

    reader = _Reader(model, items[rank::size], target, skip_bad, strict)
    ready = iter(reader)
    first = [*islice(ready, 1)]  # few photos are all read before anything is written
    bad = reader.checked(gathered(reader.bad))
    if items and len(bad) == len(items):
        raise ProblemsError([*bad.values()], "No photo is left: fix some, or pass others")
    new: dict[str, bool] = {}
    with target.writing():
        rows = drawn(chain(first, ready))
        for item in _ahead(lambda row: target.keep(*row), rows, sampler.batch, 1):
            new[item.id] = True
            done = len(new) + reader.there + len(reader.bad)
            progress("generating", done, len(reader.items))
        bad, new = reader.checked(gathered(bad | reader.bad)), gathered(new)
        ids = [item.id for item in items if item.id not in bad]
        notes += _strength_notes(outside, len(new))
        return target.finish(ids, [*bad.values()], len(new), notes)


def _places(output: str | Path | None, part: str | Slice | None) -> tuple[Path | None, Path | None]:
    """The folder of all parts, and what is written."""
    if output is None or part is None:
        must, got = "must go with a folder to write", "none"
        require(part is None, "slice", must, got, fix="Name one for all slices")
        return None, None if output is None else Path(output)
    return Path(output), Path(output) / Slice.parse(part).name


def _sliced(
    items: list[_Item],
    part: str | Slice | None,
    settings: Mapping[str, Any],
    folder: Path | None,
    command: str,
) -> tuple[list[_Item], Part | None]:
    """The items of a slice, and the record of its part; all, and none, without one.

    Raises:
        PalpateError: if other parts of the folder do not belong to it.
    """
    if folder is None:
        return items, None
    own = Slice.parse(part)
    numbers = own.numbers([item.recording for item in items])
    some = [item for item in items if numbers[item.recording] == own.number]
    files = [[f and [str(f), *file_stamp(f)] for f in (i.vision, i.background)] for i in some]
    record = Part(
        slice=str(own),
        command=command,
        settings={"generated": digest_json(settings)},
        read=digest_json([[item.id for item in some], files]),
        data=digest_json([[item.id, item.recording] for item in items]),
        rows=len(some),
    )
    record.is_finished(folder)
    return some, record


def _process(device: str) -> tuple[str, tuple[int, int], Callable[..., Any]]:
    """The device of this process, its place among how many, and what gathers their parts."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        from palpate.training import processes

        return processes.connect(device), processes.place(), processes.merged
    return device, (0, 1), dict


def _loaded(
    model: TactilePipeline | str | Path, device: str, progress: Progress
) -> TactilePipeline:
    if isinstance(model, str | Path):
        progress(f"loading {model}", 0, 0)
        model = find_model(model, "generator", "pipeline", FIX_MODEL)  # before torch is imported
    from palpate.diffusion.pipeline import TactilePipeline

    if isinstance(model, TactilePipeline):
        return model
    return TactilePipeline.from_pretrained(model, device=device)


def _ahead(
    function: Callable[[T], R], items: Iterable[T], depth: int, threads: int
) -> Generator[R]:
    """Yield ``function(item)`` in order, computed in threads up to ``depth`` items ahead."""
    waiting: deque[Future[R]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > depth:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


class _Target:
    """Where images go: memory, one PNG, or a folder with an index."""

    def __init__(
        self,
        output: Path | None,
        single: bool,
        settings: dict[str, Any],
        notice: str,
        first: bool,
        *,
        part: Part | None,
        forms: Sequence[Form | None],
    ) -> None:
        self.part = part
        self.forms = forms  # of the data that the images are stored like
        self.settings, self.digest, self.notice = settings, digest_json(settings), notice
        self.file = output if single else None
        self.folder = None if single else output
        self.memory: dict[str, Image.Image] = {}
        self.unlike: dict[str, float] = {}
        self.first = first  # of several processes
        self.index = Index(settings=settings, digest=self.digest)
        if self.folder is not None:
            index = old_index(self.folder, settings, self.digest) or self.index
            # Of an earlier state of a slice no sample stays.
            images = {} if part else index.images
            self.index = replace(index, notice=notice, complete=False, images=images)

    def path(self, sample_id: str) -> Path | None:
        """The file of an image; None in memory."""
        if self.folder is None:
            return self.file
        return (
            self.folder
            / "images"
            / file_name(sample_id, ".jpg" if self.form(sample_id) else ".png")
        )

    def form(self, sample_id: str) -> Form | None:
        """How an image is stored; None is PNG."""
        draw = rng_for(self.settings["seed"], "storage", sample_id)
        return self.forms[int(draw.integers(len(self.forms)))] if self.forms else None

    def has(self, item: _Item, stamp: str) -> bool:
        """Whether the image of this id, photo and settings is there, undamaged."""
        if (path := self.path(item.id)) is None:
            return False
        try:
            with open_image(path) as image:
                text = [_texts(image).get(f"palpate.{k}") for k in ("id", "settings", "input")]
                image.verify()  # the checksum of each chunk but the last
        except ImageError:
            return False
        whole = path.read_bytes().endswith(ENDS)
        return whole and text == [item.id, self.digest, stamp]

    @contextmanager
    def writing(self) -> Generator[None]:
        """Hold the folder, and mark it as unfinished; of several processes the first one."""
        folder = self.folder if self.first else None
        with nullcontext() if folder is None else locked(folder):
            if folder is not None:
                write_json(folder / "index.json", sealed(plain(self.index)))
            yield

    def keep(self, item: _Item, array: NDArray[np.uint8]) -> _Item:
        """Keep one image, as a PNG that says what it is."""
        image, form = Image.fromarray(array), self.form(item.id)
        if (path := self.path(item.id)) is None:
            self.memory[item.id] = replace(form, size=image.size).through(image) if form else image
            self.unlike |= {} if item.unlike is None else {item.id: item.unlike}
            return item
        text, texts = PngImagePlugin.PngInfo(), dict[str, str]()
        values = {"id": item.id, "settings": self.digest, "input": item.stamp}
        values |= {"made-with": canonical_json(self.settings), "notice": self.notice}
        values["unlike"] = "" if item.unlike is None else f"{item.unlike:g}"
        for name, value in values.items():  # their order decides the bytes
            if value:
                texts[f"palpate.{name}"] = value
                text.add_itxt(f"palpate.{name}", value)
        if form is None:
            save_image(path, image, pnginfo=text)
        else:
            save_image(path, image, "JPEG", comment=canonical_json(texts), **form.options)
        return item

    def finish(
        self, ids: Sequence[str], skipped: Sequence[Problem], new: int, notes: Sequence[Note]
    ) -> Generated:
        """Complete the index; all images of the target, earlier ones included."""
        paths = {i: path for i in ids if (path := self.path(i)) is not None}
        for i, path in paths.items():
            with open_image(path) as image:
                if (rate := _texts(image).get("palpate.unlike")) is not None:
                    self.unlike[i] = float(rate)
        files = {i: str(path) for i, path in paths.items()}
        if self.folder is not None:
            files = {**self.index.images, **{i: path.name for i, path in paths.items()}}
            index = replace(self.index, complete=True, images=files, skipped=skipped)
            index = replace(index, unlike={**index.unlike, **self.unlike})
            if self.first:
                write_json(self.folder / "index.json", sealed(plain(index)))
                if self.part is not None:
                    self.part.save(self.folder)
        out = [i for i in ids if self.unlike.get(i, 0.0) >= UNLIKE]
        facts = {"count": len(out), "of": len(ids), "photos": out, "least": UNLIKE}
        notes = [*notes, *([Note("photos-unlike", facts)] if out else [])]
        common = (self.settings, skipped, new, self.notice, self.unlike, notes, self.memory)
        return Generated(self.folder, files, *common)


def _texts(image: Image.Image) -> Mapping[str, Any]:
    """The texts of a PNG, or of a JPEG's comment."""
    texts: Any = image.info
    with suppress(ValueError):
        texts = json.loads(texts["comment"]) if "comment" in texts else texts
    return texts if isinstance(texts, dict) else {}


def _touch_and_like(
    touch: Mapping[str, Any], forms: Sequence[Form | None]
) -> dict[str, Mapping[str, Any] | str]:
    """What was requested, as settings."""
    like = digest_json([form and form.options for form in forms])
    return ({"touch": touch} if touch else {}) | ({"like": like} if forms else {})


def _forms_like(like: str | Path | None, one: str) -> list[Form | None]:
    """How the tactile images of a data set are stored, for images of another size.

    Raises:
        PalpateError: if it is no folder or holds no image, or ``one`` file is to be written.
    """
    if like is None:
        return []
    from palpate.data.samples import read_samples
    from palpate.data.storage import forms_of

    must, fix = "must be a folder of images or of a data set", "Name the folder of the real images"
    require(Path(like).is_dir(), "like", must, str(like), fix=fix)
    must, fix = "must go with an output that is a folder", "Name a folder, or leave it out"
    require(not one, "like", must, one, fix=fix)
    return forms_of(read_samples(like, "like"))


def photo_ids(photos: Photos) -> dict[str, Path]:
    """Ids of photos: paths below a folder (sorted), or file names.

    Raises:
        PalpateError: if a folder is missing or two files have one name.
    """
    if isinstance(photos, Mapping):
        return {i: Path(p) for i, p in photos.items()}
    if isinstance(photos, str | Path) and Path(photos).is_dir():
        folder = Path(photos)
        return {p.relative_to(folder).as_posix(): p for p in images_below(folder)}
    listed: Sequence[Any] = [photos] if isinstance(photos, str | Path) else list(photos)
    files = all(isinstance(photo, str | Path) for photo in listed)
    fix = "Pass images in memory to a TactilePipeline"
    require(files, "photos", "must be files", "images in memory", fix=fix)
    paths = [Path(photo) for photo in listed]
    if len(paths) == 1 and paths[0].is_dir():
        return photo_ids(paths[0])
    table = {path.name: path for path in paths}
    twice = [name for name, count in Counter(path.name for path in paths).items() if count > 1]
    must, fix = "must differ in name in a list", "Pass their common folder instead"
    require(not twice, "photos", must, f"{', '.join(map(repr, twice[:1]))} twice", fix=fix)
    return table


def _items(photos: Any, split: Split | str | Path | None, part: str) -> list[_Item]:
    """One image per photo, or per sample of a manifest, with its own no-contact image."""
    manifest: Manifest | None = None
    if isinstance(photos, str | Path):
        path = Path(photos)
        if path.suffix == ".parquet" or (path / "manifest.parquet").is_file():
            from palpate.data.manifest import Manifest

            manifest = Manifest.load(path)
    elif hasattr(photos, "columns"):
        from palpate.data.reading import load

        manifest = load(photos)
    elif not isinstance(photos, Sequence | Mapping):
        manifest = photos
    if manifest is None:
        fix = "Leave it out, or import the data set"
        require(split is None, "split", WHOLE, "photos", fix=fix)
        items = [_Item(i, path, recording=i) for i, path in photo_ids(photos).items()]
    else:
        manifest = manifest if split is None else manifest.part(Split.load(split), part)
        gels = (gel and manifest.path(gel) for gel in manifest.column("background"))
        rows = zip(manifest.ids, manifest.paths("vision"), gels, strict=True)
        levels = zip(manifest.column("video"), manifest.column("sensor"), strict=True)
        items = [
            _Item(*row, recording=video or row[0], sensor=sensor)
            for row, (video, sensor) in zip(rows, levels, strict=True)
        ]
    must, fix = "There must be at least one photo", "Check the folder, the split or the names"
    require(bool(items), None, must, "none", fix=fix)
    return items


def _share(weight: float | None, photos: bool, text: bool) -> float:
    """The share of the photo; checks what drives the images."""
    must, fix = "There must be at least one photo, or a text", "Pass one of them"
    require(photos or text, None, must, "none", fix=fix)
    must, got = "must go with photos and a text", "no photo" if text else "no text"
    require(weight is None or (photos and text), "weight", must, got, fix="Leave it out")
    share = 0.5 if weight is None else weight
    require(0 <= share <= 1, "weight", "must lie in [0, 1]", f"{share:g}", fix="1 is the photo")
    return share


def _on_gels(
    items: Sequence[_Item], pipeline: TactilePipeline, gel: str | Path | None
) -> list[_Item]:
    """The items with the gel that each is made on, where that is another than the stock gel."""
    if gel is not None:
        gel, must = Path(gel), "must be left out for a generator that codes the gel with the image"
        require(pipeline.background, "gel", must, str(gel), fix="Train one with the preset mini")
        _require_readable([gel], "gel")
    lacking = [item.id for item in items if item.background is None]
    stock = pipeline.gel is not None and len(lacking) == len(items)
    if gel is not None or stock or not pipeline.background:
        return [replace(item, background=gel) for item in items]
    must, fix = "must be given for a generator w/ BG", "Or pass a manifest with backgrounds"
    got = "photos alone" if len(lacking) == len(items) else f"no background of {lacking[:1]}"
    require(not lacking, "gel", must, got, fix=fix)
    return list(items)


def _notes(pipeline: TactilePipeline, text: str | None, gel: str | Path | None) -> list[Note]:
    """What the caller must know of the text and the gel."""
    notes: list[Note] = []
    if text is not None and pipeline.encoders is not None:
        length, most = pipeline.encoders.length(text)
        notes += [Note("text-cut", {"tokens": length, "most": most})] if length > most else []
    if gel is not None:
        from palpate.diffusion.gels import gel_notes

        notes += gel_notes(Path(gel), pipeline.gel)
    return notes


def _range_of(
    pipeline: TactilePipeline, text: str | None, words: Tensor | None, strict: bool
) -> dict[str, Any]:
    """How unlike the texts of the training one is, and its words that none of them has.

    Raises:
        PalpateError: with ``strict``, if it is out of range, or the pipeline knows no range.
    """
    seen, about = pipeline.seen, dict[str, Any]()
    must, fix = "must go with a generator that knows what it saw", "Train it anew, or leave it out"
    require(seen is not None or not strict, "strict", must, "one that does not", fix=fix)
    if seen is None or text is None or words is None:
        return about
    if seen.texts is not None:
        about["text_unlike"] = seen.texts.rates(words.numpy())[0]
    about |= {"unseen_words": unseen} if (unseen := seen.unseen(text)) else {}
    must, fix = "must be like those of the training", f"Its words are e.g. {few(seen.words)}"
    got = f"the new words {', '.join(unseen)}" if unseen else "one unlike 95 % of them"
    require(not (strict and _range_notes(about)), "text", must, got, fix=fix)
    return about


def _range_notes(settings: Mapping[str, Any]) -> list[Note]:
    """What is out of range in a text."""
    words, rate = settings.get("unseen_words"), settings.get("text_unlike", 0.0)
    notes = [Note("words-unseen", {"words": words})] if words else []
    return notes + ([Note("text-unlike", {"rate": rate})] if rate >= UNLIKE else [])


def _shear(pipeline: TactilePipeline, requested: Requested, items: Sequence[_Item]) -> list[Note]:
    """That a shear has no effect where the gel has no markers; of several the first is seen."""
    gel = items[0].background
    if requested.shear is None or (gel is None and pipeline.gel is None):
        return []
    from palpate.diffusion.contact import has_markers

    picture = pipeline.gel if gel is None else square(read_image(gel), pipeline.size)
    assert picture is not None
    return [] if has_markers(picture[None])[0] else [Note("shear-without-markers")]


def _strength_notes(outside: Sequence[tuple[float, float]], n: int) -> list[Note]:
    """That training knew no touches of such surfaces of the strength that is requested."""
    if not outside:
        return []
    low, high = (float(x) for x in np.median(outside, axis=0))
    return [Note("strength-unseen", {"count": len(outside), "n": n, "low": low, "high": high})]


def _is_film(output: Path | None, paths: Sequence[Path], profile: str | Path | None) -> bool:
    """Whether the output is a video of a touch, of a video of a surface; checks what goes along."""
    video = len(paths) == 1 and paths[0].suffix.lower() in VIDEOS
    fix = "E.g. palpate generate clip.mp4 -o touch.mp4 --profile profile.csv"
    got = f"{len(paths)} photos" if len(paths) > 1 else paths[0].name
    require(video or profile is None, "profile", "must go with a video of a surface", got, fix=fix)
    if output is None or output.suffix.lower() != ".mp4":
        name = "none" if output is None else str(output)
        require(not video, "output", "must be an .mp4 for a video", name, fix=fix)
        return False
    must, name = "with .mp4 must be the file of one video of a surface", str(output)
    require(video, "output", must, f"{name} for {got}", fix=fix)
    if output.exists():
        must = "must be new, or a video that palpate generated"
        own = output.is_file() and b"palpate.settings" in output.read_bytes()
        require(own, "output", must, name, fix="Choose another name")
    return True


def _is_single(output: Path | None, paths: Sequence[Path]) -> bool:
    """Return whether the output is one image, in memory or a PNG; check that it may be written."""
    if output is None or output.suffix.lower() not in SUFFIXES:
        if output is not None:
            old_index(output)
        return output is None and len(paths) == 1
    must, name, fix = "must be a .png or a folder", str(output), "PNG loses nothing"
    require(output.suffix.lower() == ".png", "output", must, name, fix=fix)
    got = f"the folder {output}" if output.is_dir() else f"{output} for {len(paths)} photos"
    must, fix = "with .png must be the file of one image", f"Name a folder, e.g. {output.stem}/"
    require(not output.is_dir() and len(paths) == 1, "output", must, got, fix=fix)
    if output.exists():
        fix, replaces = "Choose another name", paths[0].exists() and output.samefile(paths[0])
        require(not replaces, "output", "must not replace an input", name, fix=fix)
        with open(output, "rb") as file:
            own = b"palpate.settings" in file.read(4096)
        must = "must be new, or an image that palpate generated"
        require(own, "output", must, name, fix=fix)
    return True


def _require_readable(paths: Sequence[Path], argument: str = "photos") -> None:
    if len(paths) > FEW:
        return
    reasons = ((path, check_image(path).problem) for path in paths)
    if bad := [Problem(str(path), "bad-image", reason) for path, reason in reasons if reason]:
        fix = "Save it anew, smaller if it is large, or pass another"
        fix = fix if paths[0].is_file() else "Check the path"
        must, got = "must be an image that can be read", f"{paths[0]}: {bad[0].text}"
        require(len(paths) > 1, argument, must, got, fix=fix)
        raise ProblemsError(bad, FIX_PHOTOS, example={"skip_bad": True})


def _settings(pipeline: TactilePipeline, sampler: SamplerOptions, seed: int) -> dict[str, Any]:
    """All that an image depends on next to its photo; the batch is no part of it."""
    dtype, scheduler = str(pipeline.dtype), pipeline.other_scheduler
    return {
        **({"scheduler": scheduler} if scheduler else {}),
        **({} if dtype == "torch.float32" else {"dtype": dtype}),
        **({"earlier_splits": pipeline.earlier_splits} if pipeline.earlier_splits else {}),
        "pipeline": pipeline.digest,
        "split": pipeline.training.get("split"),
        "preset": pipeline.preset,
        "seed": seed,
        "size": pipeline.size,
        "sampler": {k: v for k, v in asdict(sampler).items() if k != "batch"},
    }


class _Reader:
    """Reads items in threads, ahead of the sampling; yields those that are still to be made.

    After an unreadable photo that may not be skipped it yields no more, and only looks for others.

    Attributes:
        bad: by id, what could not be read, or is refused as out of range.
        there: how many images are there already.
    """

    def __init__(
        self,
        pipeline: TactilePipeline,
        items: Sequence[_Item],
        target: _Target,
        skip_bad: bool,
        strict: bool,
    ) -> None:
        self.pipeline, self.items, self.target, self.skip_bad = pipeline, items, target, skip_bad
        self.strict = strict
        self.bad: dict[str, Problem] = {}
        self.there = 0
        self._gel = lru_cache(GELS)(self._square)  # many samples share one

    def checked(self, bad: dict[str, Problem]) -> dict[str, Problem]:
        """Raise ``ProblemsError`` for what could not be read and may not be skipped."""
        if bad and not self.skip_bad:
            raise ProblemsError([*bad.values()], FIX_PHOTOS, example={"skip_bad": True})
        return bad

    def __iter__(self) -> Generator[_Item]:
        from palpate.diffusion.pipeline import EMBED

        ready: list[_Item] = []
        for item, one in _ahead(self._read, self.items, EMBED, THREADS):
            if isinstance(one, Problem):
                self.bad[item.id] = one
            elif one is None:
                self.there += 1
            else:
                ready.append(one)
            if self.bad and not self.skip_bad:
                ready.clear()
            elif len(ready) == EMBED:
                yield from self._embedded(ready)
                ready = []
        yield from self._embedded(ready)

    def _read(self, item: _Item) -> tuple[_Item, _Item | Problem | None]:
        file = item.vision
        try:
            stamp = item.digest()
            if self.target.has(item, stamp):
                return item, None
            photo = None if file is None else self._square(file, self.pipeline.vision_size)
            file = item.background
            ground = None if file is None else self._gel(file, self.pipeline.size)
            return item, replace(item, stamp=stamp, photo=photo, ground=ground)
        except PalpateError as error:
            return item, Problem(str(file), "bad-image", error.got)
        except OSError as error:
            reason = error.strerror or "cannot be opened"
            return item, Problem(str(error.filename or item.vision), "missing-file", reason)

    @staticmethod
    def _square(file: Path, size: int) -> NDArray[np.uint8]:
        return square(read_image(file), size)

    def _embedded(self, ready: list[_Item]) -> Generator[_Item]:
        photos = [item.photo for item in ready if item.photo is not None]
        rows: Any = self.pipeline.embed(np.stack(photos)) if photos else [None] * len(ready)
        rates: Sequence[float | None] = [None] * len(ready)
        if photos and self.pipeline.seen is not None:
            rates = self.pipeline.seen.photo_rates(np.stack(photos))
        for item, rate in zip(ready, rates, strict=True):  # all, before any is made
            if self.strict and rate is not None and rate >= UNLIKE:
                text = f"unlike {rate:.1%} of the training photos".replace("%", " %")
                self.bad[item.id] = Problem(str(item.vision), "unlike-training", text)
        for item, row, rate in zip(ready, rows, rates, strict=True):
            if item.id not in self.bad:
                yield replace(item, condition=row, unlike=rate, photo=None)
