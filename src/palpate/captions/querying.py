"""Query a model about many photos at once; every reply is kept, and answers are asked for once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from PIL import Image

from palpate.captions.prompts import Description, Prompt
from palpate.captions.replies import QUALITY, SIDE, Question, RejectedError, Reply, ReplyLog
from palpate.captions.units import Units
from palpate.core import PalpateError, Problem, Progress, image_bytes, require
from palpate.data.images import file_digest, in_threads, read_image
from palpate.data.manifest import Manifest

if TYPE_CHECKING:
    from palpate.captions.server import Server

#: Requests until a reply can be used; from the second on the model samples.
ATTEMPTS = 3
AGAIN_TEMPERATURE = 0.5
#: So many photos, spread over all, are tried first: if the server takes none, others are not sent.
PROBES = 16
#: Seconds after which Ctrl-C is noticed: once polars has run, it interrupts no waiting.
CTRL_C = 0.2
# One photo at a time: a photo is read in many small steps, and threads that take turns after each
# of them need half as much time again.
_READING = threading.Lock()


@dataclass(frozen=True)
class Photo:
    """The photo of a unit.

    Attributes:
        sample: id of the described sample.
        path: its photo; None without one.
        key: of the reply about it; None without a photo that can be read.
    """

    sample: str
    path: Path | None
    key: str | None


def photos_of(
    manifest: Manifest, units: Units, question: Question, progress: Progress
) -> list[Photo]:
    """Read the photos' bytes; one photo a unit."""
    ids, vision = manifest.ids, manifest.column("vision")
    paths = [None if row is None else manifest.path(vision[row]) for row in units.described]
    distinct = list(dict.fromkeys(path for path in paths if path is not None))
    digests = dict(in_threads(file_digest, distinct, "reading photos", progress))
    photos: list[Photo] = []
    for row, path in zip(units.described, paths, strict=True):
        digest = None if path is None else digests[path]
        sample = "" if row is None else ids[row]
        photos.append(Photo(sample, path, None if digest is None else question.key(digest)))
    return photos


#: Of a request: the key of its photo, and what is wrong with it.
Ended = tuple[str, Problem | None]


def prepared(path: Path) -> bytes:
    """The file that is sent for a photo: a JPEG without metadata.

    Raises:
        PalpateError: if the photo is missing, truncated or none.
    """
    with _READING:
        photo = read_image(path)
        photo.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
        return image_bytes(photo, "JPEG", quality=QUALITY, exif=b"", icc_profile=None)


def pending(photos: Sequence[Photo], log: ReplyLog) -> list[Photo]:
    """Photos without an answer, each once."""
    first = {photo.key: photo for photo in reversed(photos) if photo.key is not None}
    return [photo for key, photo in reversed(first.items()) if key not in log.answers]


def outcomes(
    photos: Sequence[Photo], log: ReplyLog, prompt: Prompt, failed: Mapping[str, Problem]
) -> tuple[list[Description], list[Problem]]:
    """What the answers say of every unit, and what is wrong with photos, by path.

    Args:
        photos: one a unit.
        log: the answers.
        prompt: what they answer.
        failed: key -> what is wrong with the request.
    """
    descriptions: list[Description] = []
    problems: dict[str, Problem] = {}
    for photo in photos:
        if photo.key in log.answers:
            descriptions.append(log.answers[photo.key].read(prompt))
            continue
        kind, path = "no-photo", str(photo.path)
        if photo.path is not None:
            problem = failed.get(photo.key or "", Problem("", "bad-image", "cannot be read"))
            problems[path], kind = replace(problem, where=path), problem.kind
        descriptions.append(Description(None, flags=(kind,)))
    return descriptions, [problems[path] for path in sorted(problems)]


def query_all(
    photos: list[Photo],
    question: Question,
    server: Server,
    log: ReplyLog,
    *,
    threads: int,
    progress: Progress,
    answered: bool,
) -> dict[str, Problem]:
    """Send a request for every photo; replies go to the log as they arrive.

    Where some photo is ``answered`` already, the server is not to blame if it takes none of these.

    Returns:
        Key -> what is wrong, of photos that cannot be read or that the server does not take.

    Raises:
        PalpateError: if the server fails, or takes no request at all.
    """

    def work(photo: Photo) -> Ended:
        key, path = str(photo.key), str(photo.path)
        try:
            image = prepared(Path(path))
        except PalpateError as error:
            return key, Problem(path, "bad-image", error.got)
        try:
            for reply in _replies(image, question, server):
                log.append(key, photo.sample, question.prompt.name, reply)
        except RejectedError as error:
            reply = Reply(str(error), question.model, finish="rejected", unused="rejected")
            log.append(key, photo.sample, question.prompt.name, reply)
            return key, Problem(path, "rejected", str(error))
        return key, None

    failed: dict[str, Problem] = {}
    done, step = 0, -(-len(photos) // PROBES) or 1
    progress("describing", done, len(photos))
    later = [photo for k, photo in enumerate(photos) if k % step]
    for part in (photos[::step], later):
        for result in in_daemons(work, part, threads):
            if isinstance(result, BaseException):
                raise result
            key, problem = result
            answered |= problem is None
            failed |= {} if problem is None else {key: problem}
            done += 1
            progress("describing", done, len(photos))
        rejected = [problem.text for problem in failed.values() if problem.kind == "rejected"]
        must, fix = "The model must take the requests", "Check it and the further fields"
        require(answered or not rejected, None, must, "".join(rejected[:1]), fix=fix)
    return failed


def _replies(image: bytes, question: Question, server: Server) -> Iterator[Reply]:
    """Replies until one can be used or there were ``ATTEMPTS``; all but the last are ``unused``.

    The request after a reply that cannot be used samples, with more room if that was cut.
    """
    for attempt in range(1, ATTEMPTS + 1):
        reply = server.describe(image, question)
        description = reply.read(question.prompt)
        if description.answered or attempt == ATTEMPTS:
            yield reply
            return
        yield replace(reply, unused=description.flags[0])
        question = replace(
            question,
            max_tokens=question.max_tokens * (2 if reply.finish == "length" else 1),
            temperature=AGAIN_TEMPERATURE,
            seed=question.seed + 1,
        )


def in_daemons(
    function: Callable[[Photo], Ended], items: Iterable[Photo], threads: int
) -> Iterator[Ended | BaseException]:
    """Yield results, or what was raised, as they finish; a caller that leaves waits for nothing.

    Other than :func:`palpate.data.images.in_threads`, which waits for its threads: a request may
    hang for minutes. No item and no result is None.
    """
    lock, stop, source = threading.Lock(), threading.Event(), iter(items)
    results: SimpleQueue[Ended | BaseException | None] = SimpleQueue()  # None: a thread ended

    def work() -> None:
        while not stop.is_set():
            with lock:
                item = next(source, None)
            if item is None:
                break
            try:
                results.put(function(item))
            except BaseException as error:
                results.put(error)
        results.put(None)

    for _ in range(threads):
        threading.Thread(target=work, daemon=True).start()
    running = threads
    try:
        while running:
            try:
                result = results.get(timeout=CTRL_C)
            except Empty:
                continue
            if result is None:
                running -= 1
            else:
                yield result
    finally:
        stop.set()
