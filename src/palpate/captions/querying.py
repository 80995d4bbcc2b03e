"""Ask a vision-language model about many photos at once.

Every reply goes to the log as it arrives; a photo whose answer is there already is not sent.
"""

from __future__ import annotations

import math
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
from palpate.core import PalpateError, Problem, Progress, image_bytes
from palpate.data.images import file_digest, in_threads, read_image
from palpate.data.manifest import Manifest

if TYPE_CHECKING:
    from palpate.captions.server import Server

#: Most requests about one photo: until a reply can be used.
ATTEMPTS = 3
#: Temperature of repeated requests; the first one has 0, and would give the same reply again.
RETRY_TEMPERATURE = 0.5
#: About so many photos, spread over all, are sent first: if all are rejected, the rest is not sent.
FIRST_PHOTOS = 16
#: Seconds between two looks for Ctrl-C: once polars has run, it does not interrupt a thread that
#: waits for a queue.
WAIT = 0.2
# Threads that decode photos at the same time take half as long again: one decodes at a time.
_DECODING = threading.Lock()
#: Key of a photo, and what is wrong with it or with the request about it.
Outcome = tuple[str, Problem | None]


@dataclass(frozen=True)
class Photo:
    """The photo of one unit, that is of the samples that share a caption.

    Attributes:
        sample: id of the sample whose photo it is; '' if no sample of the unit has one.
        path: the photo; None if there is none.
        key: key of the reply about it in the log; None if there is no photo that can be read.
    """

    sample: str
    path: Path | None
    key: str | None


def photos_of(
    manifest: Manifest, units: Units, question: Question, progress: Progress
) -> list[Photo]:
    """Return the photo of each unit; its key is made of its bytes and the question."""
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


def encode_photo(path: Path) -> bytes:
    """Return a photo as it is sent: a JPEG of at most 768 pixels a side, without metadata.

    Raises:
        PalpateError: if the photo is missing, truncated or no image.
    """
    with _DECODING:
        photo = read_image(path)
        photo.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
        return image_bytes(photo, "JPEG", quality=QUALITY, exif=b"", icc_profile=None)


def pending(photos: Sequence[Photo], log: ReplyLog) -> list[Photo]:
    """Return the readable photos without an answer, in order; of equal ones the first."""
    first: dict[str, Photo] = {}
    for photo in photos:
        if photo.key is not None and photo.key not in log.answers:
            first.setdefault(photo.key, photo)
    return list(first.values())


def describe_units(
    photos: Sequence[Photo], log: ReplyLog, prompt: Prompt, failed: Mapping[str, Problem]
) -> tuple[list[Description], list[Problem]]:
    """Read the description of each unit from the log.

    Args:
        photos: one a unit.
        log: the answers.
        prompt: the instruction that they answer.
        failed: key -> why a photo has no answer; of :func:`query_all`.

    Returns:
        A description a unit, flagged where there is none; the problems with photos, by path.
    """
    descriptions: list[Description] = []
    problems: dict[str, Problem] = {}
    for photo in photos:
        if photo.key in log.answers:
            descriptions.append(log.answers[photo.key].read(prompt))
        elif photo.path is None:
            descriptions.append(Description(None, flags=("no-photo",)))
        else:
            problem = failed.get(photo.key or "", Problem("", "bad-image", "cannot be read"))
            problem = replace(problem, where=str(photo.path))  # equal photos share one request
            problems[problem.where] = problem
            descriptions.append(Description(None, flags=(problem.kind,)))
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
    """Ask about every photo; replies go to the log as they arrive.

    Args:
        photos: of :func:`pending`.
        question: what to ask about each.
        server: the model server.
        log: where replies go.
        threads: requests at the same time.
        progress: called after each photo.
        answered: whether the log has an answer about another photo: the requests as such are then
            right, and these photos may all be rejected.

    Returns:
        Key -> what is wrong, of photos that cannot be read or that the server rejects.

    Raises:
        PalpateError: if the server fails, or rejects every request.
    """

    def ask(photo: Photo) -> Outcome:
        key, path = str(photo.key), str(photo.path)
        try:
            image = encode_photo(Path(path))
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
    done, step = 0, math.ceil(len(photos) / FIRST_PHOTOS) or 1
    progress("describing", done, len(photos))
    later = [photo for k, photo in enumerate(photos) if k % step]
    for part in (photos[::step], later):
        for result in in_daemons(ask, part, threads):
            if isinstance(result, BaseException):
                raise result
            key, problem = result
            if problem is None:
                answered = True
            else:
                failed[key] = problem
            done += 1
            progress("describing", done, len(photos))
        rejected = [problem.text for problem in failed.values() if problem.kind == "rejected"]
        if rejected and not answered:
            raise PalpateError(
                "The model must take the requests", rejected[0], "Check it and the further fields"
            )
    return failed


def _replies(image: bytes, question: Question, server: Server) -> Iterator[Reply]:
    """Ask until a reply can be used, at most ``ATTEMPTS`` times; yield every reply.

    All but the last are marked as ``unused``. A repeated request has another seed and temperature,
    and twice the room if the reply was cut.
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
            temperature=RETRY_TEMPERATURE,
            seed=question.seed + 1,
        )


def in_daemons(
    ask: Callable[[Photo], Outcome], photos: Iterable[Photo], threads: int
) -> Iterator[Outcome | BaseException]:
    """Yield what ``ask`` returned or raised, as it finishes.

    Its threads are daemons: a caller that stops (Ctrl-C, an error) does not wait for requests that
    may hang for minutes, as it would with :func:`palpate.data.images.in_threads`.
    """
    lock, stop, remaining = threading.Lock(), threading.Event(), iter(photos)
    results: SimpleQueue[Outcome | BaseException | None] = SimpleQueue()  # None: a thread ended

    def work() -> None:
        while not stop.is_set():
            with lock:  # an iterator serves one thread at a time
                photo = next(remaining, None)
            if photo is None:
                break
            try:
                results.put(ask(photo))
            except BaseException as error:
                results.put(error)
        results.put(None)

    for _ in range(threads):
        threading.Thread(target=work, daemon=True).start()
    running = threads
    try:
        while running:
            try:
                result = results.get(timeout=WAIT)
            except Empty:
                continue
            if result is None:
                running -= 1
            else:
                yield result
    finally:
        stop.set()
