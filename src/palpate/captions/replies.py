"""Requests to a model, its replies, and the log that keeps them.

The log is ``replies.jsonl``: one JSON object a line for every finished request, appended as it
arrives and never changed::

    {"key": "<sha256>", "id": "video/frame", "prompt": "touch-adjectives/1", "model": "...",
     "raw": "{...}", "refused": false, "finish": "stop", "tokens": [812, 31], "unused": null,
     "sealed": "<sha256>"}

``key`` is SHA-256 over the model, the digest of the prompt, the bytes of the image file and the
parameters. The same request finds its answer there; a killed run loses what was in flight. A reply
after which the request was repeated says why under ``unused`` (``invalid``, ``truncated``), and so
does the error of a request that the server does not take (``rejected``): these are no answers, but
their tokens count. A last line without its end was cut by a kill or a full disk and is dropped; a
line whose digest under ``sealed`` is of another content is refused.
"""

from __future__ import annotations

import json
import threading
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from palpate.captions.prompts import Description, Prompt
from palpate.core import PalpateError, digest_json, sealed, unsealed
from palpate.core.files import LARGEST

#: Photos are sent at most so many pixels a side, as JPEG of this quality.
SIDE, QUALITY = 768, 90


@dataclass(frozen=True)
class Question:
    """What a model is asked about a photo; the same for all photos of a run, until it is repeated.

    Attributes:
        model: its name, as it was requested.
        prompt: the instruction, with the schema of its reply.
        max_tokens: longest reply.
        seed, temperature: of the sampling.
        body: further fields of the request to a server; null removes a default one.
    """

    model: str
    prompt: Prompt
    max_tokens: int
    seed: int
    body: Mapping[str, Any]
    temperature: float = 0.0

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything next to model and prompt that the reply to the first request depends on."""
        sent = {"side": SIDE, "quality": QUALITY}
        return {"max_tokens": self.max_tokens, "seed": self.seed, "body": dict(self.body), **sent}

    def key(self, image: str) -> str:
        """Key of the reply about an image file with this digest."""
        return digest_json([self.model, self.prompt.digest, image, self.parameters])


@dataclass(frozen=True)
class Reply:
    """What a model answered.

    Attributes:
        raw: the text as it came.
        model: the model as the server names it.
        refused: the server itself calls the reply a refusal.
        finish: why it ended: ``stop``, or ``length`` where it was cut.
        tokens: of the request and of the reply.
        unused: why it is not the answer; None where it is.
    """

    raw: str
    model: str
    refused: bool = False
    finish: str = "stop"
    tokens: tuple[int, int] = (0, 0)
    unused: str | None = None

    def read(self, prompt: Prompt) -> Description:
        """What it says."""
        description = prompt.read(self.raw, refused=self.refused)
        if description.text is None and self.finish == "length":
            return replace(description, flags=("truncated",))
        return description


class RejectedError(Exception):
    """The server does not take this one request (too large, no valid image ...)."""


class ReplyLog:
    """The replies of an output folder; its file begins with the first one that is appended.

    Attributes:
        answers: key -> the reply that counts.
        unused: key -> those that came before it.
        answered: how many answers were appended.

    Raises:
        PalpateError: if the file is another program's.
    """

    def __init__(self, path: Path) -> None:
        self.answers: dict[str, Reply] = {}
        self.unused: defaultdict[str, list[Reply]] = defaultdict(list)
        self.answered = self._end = 0
        self._path, self._lock, self._open = path, threading.Lock(), True
        self._file: BinaryIO | None = None
        if path.exists():
            with open(path, "rb") as file:
                for number, line in enumerate(iter(partial(file.readline, LARGEST), b""), 1):
                    if line.endswith(b"\n"):
                        self._end += len(line)
                        self._read(line, number)

    def _read(self, line: bytes, number: int) -> None:
        try:
            row = unsealed(json.loads(line))
            self._add(row["key"], Reply(*(row[each.name] for each in fields(Reply))))
        except (ValueError, TypeError, LookupError):
            must, got = f"{self._path} must hold replies only", f"another line {number}"
            fix = "Choose another folder, or remove the line"
            raise PalpateError(must, got, fix) from None

    def _add(self, key: str, reply: Reply) -> None:
        if reply.unused is None:
            self.answers[key] = reply
        else:
            self.unused[key].append(reply)

    def append(self, key: str, sample: str, prompt: str, reply: Reply) -> None:
        """Keep a reply, on disk before anything else happens; does nothing once closed."""
        row = {"key": key, "id": sample, "prompt": prompt, **asdict(reply)}
        row = json.loads(json.dumps(row, ensure_ascii=False).encode("utf-8", "replace"))
        line = json.dumps(sealed(row), ensure_ascii=False).encode() + b"\n"
        with self._lock:
            if not self._open:
                return
            if self._file is None:
                self._file = open(self._path, "ab")  # noqa: SIM115 (closed by close)
                self._file.truncate(self._end)
            self._file.write(line)
            self._file.flush()
            self._add(key, reply)
            self.answered += reply.unused is None

    def close(self) -> None:
        """End writing."""
        with self._lock:
            self._open = False
            if self._file is not None:
                self._file.close()
