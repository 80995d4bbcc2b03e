"""Query a model about many photos at once; every reply is kept, and answers are asked for once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from palpate.captions.photos import QUALITY, SIDE, prepared
from palpate.captions.prompts import Description, Prompt
from palpate.captions.replies import RejectedError, Replies, Reply, ReplyLog, Request
from palpate.captions.server import Server
from palpate.captions.units import Units
from palpate.core import PalpateError, Problem, Progress, digest_json
from palpate.data.images import file_digest, in_threads
from palpate.data.manifest import Manifest

#: Requests until a reply can be used; from the second on the model samples.
ATTEMPTS = 3
AGAIN_TEMPERATURE = 0.5
#: So many photos, spread over all, are tried first: if the server takes none, others are not sent.
PROBES = 16
#: Seconds after which Ctrl-C is noticed: once polars has run, it interrupts no waiting.
CTRL_C = 0.2
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Question:
    """What is the same for all photos of a run.

    Attributes:
        model: its name, as it was requested.
        prompt: the instruction, with the schema of its reply.
        max_tokens: longest reply.
        seed: of the first try.
        body: further fields of every request to a server.
    """

    model: str
    prompt: Prompt
    max_tokens: int
    seed: int
    body: Mapping[str, Any]

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything next to model and prompt that a reply depends on."""
        sent = {"side": SIDE, "quality": QUALITY}
        return {"max_tokens": self.max_tokens, "seed": self.seed, "body": dict(self.body), **sent}

    def key(self, image: str) -> str:
        """Key of the reply about an image file with this digest."""
        return digest_json([self.model, self.prompt.digest, image, self.parameters])


@dataclass(frozen=True)
class Pending:
    """A photo without an answer: the answer's key, the sample's id, and the file."""

    key: str
    sample: str
    path: Path


@dataclass(frozen=True)
class Photos:
    """The photos of all units, and the keys of the replies about them.

    Attributes:
        samples: id of the described sample of every unit.
        paths: its photo; None without one.
        keys: key of the reply; None without a photo that can be read.
    """

    samples: Sequence[str]
    paths: Sequence[Path | None]
    keys: Sequence[str | None]

    @classmethod
    def of(cls, manifest: Manifest, units: Units, question: Question, progress: Progress) -> Photos:
        """Read the photos' bytes."""
        ids, vision = manifest.ids, manifest.column("vision")
        paths = [None if row is None else manifest.path(vision[row]) for row in units.described]
        distinct = list(dict.fromkeys(path for path in paths if path is not None))
        digests = dict(in_threads(file_digest, distinct, "reading photos", progress))
        of_paths = [None if path is None else digests[path] for path in paths]
        keys = [None if digest is None else question.key(digest) for digest in of_paths]
        samples = ["" if row is None else ids[row] for row in units.described]
        return cls(samples, paths, keys)

    def __len__(self) -> int:
        """The number of photos."""
        return sum(path is not None for path in self.paths)

    @property
    def distinct(self) -> list[str]:
        """The keys, each once, in a fixed order."""
        return sorted({key for key in self.keys if key is not None})

    def pending(self, replies: Replies) -> list[Pending]:
        """Photos without an answer, each once."""
        pending: dict[str, Pending] = {}
        for key, sample, path in zip(self.keys, self.samples, self.paths, strict=True):
            if key is not None and path is not None and key not in replies.answers:
                pending.setdefault(key, Pending(key, sample, path))
        return list(pending.values())

    def problems(self, queried: Sequence[Problem]) -> list[Problem]:
        """Photos whose files cannot be read, and those of requests with a problem or equal ones."""
        pairs = zip(self.paths, self.keys, strict=True)
        keys = {str(path): key for path, key in pairs if path is not None}
        of = {keys[problem.where]: problem for problem in queried}
        of |= {None: Problem("", "bad-image", "cannot be read")}
        return [replace(of[key], where=path) for path, key in sorted(keys.items()) if key in of]

    def descriptions(
        self, answers: Mapping[str, Reply], prompt: Prompt, problems: Iterable[Problem]
    ) -> list[Description]:
        """What the answers say of every unit."""
        kinds = {problem.where: problem.kind for problem in problems}
        result: list[Description] = []
        for path, key in zip(self.paths, self.keys, strict=True):
            if key is not None and key in answers:
                description = answers[key].read(prompt)
            else:
                kind = "no-photo" if path is None else kinds[str(path)]
                description = Description(None, flags=(kind,))
            result.append(description)
        return result


def query_all(
    pending: list[Pending],
    question: Question,
    server: Server,
    log: ReplyLog,
    *,
    threads: int,
    progress: Progress,
    answered: bool,
) -> list[Problem]:
    """Send a request for every photo; replies go to the log as they arrive.

    Where some photo is ``answered`` already, the server is not to blame if it takes none of these.

    Returns:
        The photos that cannot be read or that the server does not take.

    Raises:
        PalpateError: if the server fails, or takes no request at all.
    """

    def work(photo: Pending) -> Problem | None:
        try:
            image = prepared(photo.path)
        except PalpateError as error:
            return Problem(str(photo.path), "bad-image", error.got)
        try:
            for reply in _replies(image, question, server):
                log.append(photo.key, photo.sample, question.prompt.name, reply)
        except RejectedError as error:
            reply = Reply(str(error), question.model, finish="rejected", unused="rejected")
            log.append(photo.key, photo.sample, question.prompt.name, reply)
            return Problem(str(photo.path), "rejected", str(error))
        return None

    problems: list[Problem] = []
    done, step = 0, -(-len(pending) // PROBES) or 1
    progress("describing", done, len(pending))
    rest = [photo for k, photo in enumerate(pending) if k % step]
    for photos in (pending[::step], rest):
        for result in in_daemons(work, photos, threads):
            if isinstance(result, BaseException):
                raise result
            answered |= result is None
            problems += [] if result is None else [result]
            done += 1
            progress("describing", done, len(pending))
        rejected = [problem for problem in problems if problem.kind == "rejected"]
        if rejected and not answered:
            must, fix = "The model must take the requests", "Check it and the further fields"
            raise PalpateError(must, rejected[0].text, fix)
    return problems


def _replies(image: bytes, question: Question, server: Server) -> Iterator[Reply]:
    """Replies until one can be used or there were ``ATTEMPTS``; all but the last are ``unused``.

    The request after a reply that cannot be used samples, with more room if that was cut.
    """
    request = Request(image, question.prompt, question.max_tokens, 0.0, question.seed)
    for attempt in range(1, ATTEMPTS + 1):
        reply = server.describe(request)
        description = reply.read(question.prompt)
        if description.answered or attempt == ATTEMPTS:
            yield reply
            return
        yield replace(reply, unused=description.flags[0])
        room = request.max_tokens * (2 if reply.finish == "length" else 1)
        seed = request.seed + 1
        request = replace(request, max_tokens=room, temperature=AGAIN_TEMPERATURE, seed=seed)


def in_daemons(
    function: Callable[[T], R], items: Iterable[T], threads: int
) -> Iterator[R | BaseException]:
    """Yield results, or what was raised, as they finish; a caller that leaves waits for nothing.

    Other than :func:`palpate.data.images.in_threads`, which waits for its threads: a request may
    hang for minutes.
    """
    lock, stop, source = threading.Lock(), threading.Event(), iter(items)
    results: SimpleQueue[R | BaseException | _End] = SimpleQueue()

    def work() -> None:
        while not stop.is_set():
            with lock:
                item = next(source, _END)
            if isinstance(item, _End):
                break
            try:
                results.put(function(item))
            except BaseException as error:
                results.put(error)
        results.put(_END)

    for _ in range(threads):
        threading.Thread(target=work, daemon=True).start()
    running = threads
    try:
        while running:
            try:
                result = results.get(timeout=CTRL_C)
            except Empty:
                continue
            if isinstance(result, _End):
                running -= 1
            else:
                yield result
    finally:
        stop.set()


class _End:
    """The end of the items."""


_END = _End()
