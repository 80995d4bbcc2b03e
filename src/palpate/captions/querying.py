"""Query a model about many photos at once; every reply is kept, and no request is repeated."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from palpate.captions.photos import QUALITY, SIDE, Crop, prepared
from palpate.captions.prompts import Description, Prompt
from palpate.captions.replies import Describer, RejectedError, Replies, Reply, ReplyLog, Request
from palpate.captions.units import Units
from palpate.core import PalpateError, Problem, Progress, digest_json
from palpate.data.images import file_digest, in_threads
from palpate.data.manifest import Manifest

#: Requests until a reply can be used; from the second on the model samples.
ATTEMPTS = 3
AGAIN_TEMPERATURE = 0.5
#: So many photos, spread over all, are tried first: if the server takes none, others are not sent.
PROBES = 16
#: Photos that a thread reads at a time: handing over one costs more than its digest.
AT_ONCE = 32
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
        crop: part of the photo that is sent as well.
        max_tokens: longest reply.
        seed: of the first try.
        body: further fields of every request to a server.
    """

    model: str
    prompt: Prompt
    crop: Crop | None
    max_tokens: int
    seed: int
    body: Mapping[str, Any]

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything next to model and prompt that a reply depends on."""
        sent = {"side": SIDE, "quality": QUALITY, "crop": self.crop}
        return {"max_tokens": self.max_tokens, "seed": self.seed, "body": dict(self.body), **sent}

    def key(self, image: str) -> str:
        """Key of the reply about an image file with this digest."""
        return digest_json([self.model, self.prompt.digest, image, self.parameters])


@dataclass(frozen=True)
class Pending:
    """A photo without an answer.

    Attributes:
        key: of the answer.
        sample: the sample's id.
        path: the file.
        tries: replies to it so far; no request is repeated.
    """

    key: str
    sample: str
    path: Path
    tries: tuple[Reply, ...]


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
        some = [tuple(distinct[k : k + AT_ONCE]) for k in range(0, len(distinct), AT_ONCE)]
        read = lambda files: {file: file_digest(file) for file in files}
        digests: dict[Path, str | None] = {}
        for k, (_, part) in enumerate(in_threads(read, some)):
            progress("reading photos", min(k * AT_ONCE, len(distinct)), len(distinct))
            digests |= part
        progress("reading photos", len(distinct), len(distinct))
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

    @property
    def first(self) -> Path:
        """One of the photos."""
        return next(path for path in self.paths if path is not None)

    def pending(self, replies: Replies, prompt: Prompt, *, again: bool = False) -> list[Pending]:
        """Photos without an answer, each once; with ``again`` also those without a usable one."""

        def open_(key: str) -> bool:
            answer = replies.answers.get(key)
            return answer is None or (again and answer.read(prompt).text is None)

        pending: dict[str, Pending] = {}
        for key, sample, path in zip(self.keys, self.samples, self.paths, strict=True):
            if key is not None and path is not None and key not in pending and open_(key):
                pending[key] = Pending(key, sample, path, replies.tries(key))
        return list(pending.values())

    def problems(self, queried: Sequence[Problem] = ()) -> list[Problem]:
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
    describer: Describer,
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
            images = prepared(photo.path, question.crop)
        except PalpateError as error:
            return Problem(str(photo.path), "bad-image", error.got)
        try:
            for reply in _replies(images, photo.tries, question, describer):
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


def _replies(
    images: tuple[bytes, ...], tries: Sequence[Reply], question: Question, describer: Describer
) -> Iterator[Reply]:
    """Replies until one can be used or there were ``ATTEMPTS``; all but the last are ``unused``."""
    request = Request(images, question.prompt, question.max_tokens, 0.0, question.seed)
    for reply in tries:
        request = _next(request, reply, question)
    for left in range(ATTEMPTS - 1 - len(tries) % ATTEMPTS, -1, -1):
        reply = describer.describe(request)
        description = reply.read(question.prompt)
        if description.answered or not left:
            yield reply
            break
        yield replace(reply, unused=description.flags[0])
        request = _next(request, reply, question)


def _next(request: Request, reply: Reply, question: Question) -> Request:
    """The request after a reply that cannot be used: sampled, with more room if that was cut."""
    room = request.max_tokens * (2 if reply.finish == "length" else 1)
    room = min(room, question.max_tokens * 2 ** (ATTEMPTS - 1))
    seed = request.seed + 1
    return replace(request, max_tokens=room, temperature=AGAIN_TEMPERATURE, seed=seed)


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
