"""Prompts as versioned text files, and the replies that they request.

A prompt file has three head lines, an empty line, and the text that the model reads::

    name: touch-adjectives/1
    reply: adjectives, surface_visible
    text: adjectives

    The photo shows ...

``reply`` lists the fields of the JSON object that the model must answer with (a choice of
``FIELDS``); the text must name each of them, for servers that ignore the schema. ``text`` is the
field that becomes the caption. A prompt never changes under its name: a new wording is a new
version.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, content_of, digest_json, require

#: Fields that a reply may have, as JSON schemas.
FIELDS: dict[str, dict[str, Any]] = {
    "adjectives": {"type": "array", "items": {"type": "string"}, "minItems": 3, "maxItems": 6},
    "sentence": {"type": "string"},
    "surface_visible": {"type": "boolean"},
}
#: Fields that can be the caption.
TEXTS = ("adjectives", "sentence")
HEAD = ("name", "reply", "text")
#: More adjectives than this are no description but a model that does not stop.
MOST_ADJECTIVES = 12
#: How models say no. Models reason aloud between ``think`` tags.
REFUSAL = re.compile(
    r"\b(i'?m sorry|i am sorry|i apologi[sz]e|as an ai\b|(i|we)( am|'m) (unable|not able)|"
    r"(i|we) (can'?t|cannot|can not|won'?t|will not|do not have|don'?t have)\b|"
    r"unable to (assist|help|describe|determine|identify|view|see)|no image (was |is )?(provided|"
    r"attached))",
    re.IGNORECASE,
)
#: Characters of a reply that are looked at: more are a model that does not stop.
LONGEST = 20_000
#: A thought between its tags; some servers leave the first tag out.
_THOUGHT = re.compile(r"\A((?!<think>).)*</think>|<think>.*?(</think>|$)", re.DOTALL)


@dataclass(frozen=True)
class Description:
    """What a reply says.

    Attributes:
        text: the caption; None if the reply has none that can be used.
        adjectives: its adjectives, if the prompt requests some.
        flags: ``refusal``, ``invalid``, ``schema-ignored``, ``surface-hidden``.
    """

    text: str | None
    adjectives: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()

    @property
    def answered(self) -> bool:
        """Whether another request is of no use: there is a text, or the model refuses."""
        return self.text is not None or "refusal" in self.flags


@dataclass(frozen=True)
class Prompt:
    """An instruction to a model, and the schema of its reply.

    Attributes:
        name: name and version, ``touch-adjectives/1``.
        body: the text that the model reads.
        fields: names of the fields of the reply.
        text: the field that becomes the caption.
    """

    name: str
    body: str
    fields: tuple[str, ...]
    text: str

    @classmethod
    def load(cls, source: str | Path) -> Prompt:
        """Return a prompt that ships, by its name, or that of a file.

        Raises:
            PalpateError: if there is no such prompt, or the file is none.
        """
        shipped = {p.name: p for p in map(cls.parse, _shipped())}
        if str(source) in shipped:
            return shipped[str(source)]
        path = Path(source)
        must = f"must be one of {', '.join(shipped)}, or a prompt file"
        require(path.is_file(), "prompt", must, str(source), fix="Check the name")
        try:
            return cls.parse(content_of(path).decode())
        except (UnicodeDecodeError, ValueError) as error:
            must = f"must have the lines {': ..., '.join(HEAD)}: ..., an empty line and a text"
            fix = "Start from one that ships: palpate/captions/prompts"
            raise PalpateError(must, f"{path}: {error}", fix, argument="prompt") from None

    @classmethod
    def parse(cls, text: str) -> Prompt:
        """Return the prompt that the text of a prompt file is.

        Raises:
            ValueError: saying what is missing.
        """
        head, _, body = text.replace("\r\n", "\n").strip().partition("\n\n")
        pairs = (line.partition(":") for line in head.splitlines())
        values = {name.strip(): value.strip() for name, _, value in pairs}
        if missing := [name for name in HEAD if not values.get(name)]:
            raise ValueError(f"no line that begins with '{missing[0]}:'")
        fields = tuple(name.strip() for name in values["reply"].split(","))
        if unknown := [name for name in fields if name not in FIELDS]:
            raise ValueError(f"the reply field {unknown[0]!r} is none of {', '.join(FIELDS)}")
        if values["text"] not in fields or values["text"] not in TEXTS:
            choices = [name for name in fields if name in TEXTS]
            one = f"one of {', '.join(choices)}" if choices else "a reply field with a text"
            raise ValueError(f"text: {values['text']} is not {one}")
        if absent := [name for name in fields if name not in body]:
            raise ValueError(f"the text does not request the field {absent[0]!r}")
        return cls(values["name"], body.strip(), fields, values["text"])

    @cached_property
    def schema(self) -> dict[str, Any]:
        """JSON schema of the reply."""
        return {
            "type": "object",
            "properties": {name: FIELDS[name] for name in self.fields},
            "required": list(self.fields),
            "additionalProperties": False,
        }

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything in the prompt but its name."""
        return digest_json([self.body, list(self.fields), self.text])

    def read(self, raw: str, *, refused: bool = False) -> Description:
        """Return what a reply says, whatever form it has.

        A reply that wraps the JSON object in prose, or has too few or too many adjectives, can be
        used but is flagged ``schema-ignored``; one without a usable object is ``invalid``.

        Args:
            raw: the reply as it came.
            refused: the server itself calls it a refusal.
        """
        plain = _THOUGHT.sub("", raw[:LONGEST]).strip()
        for alone, answer in _objects(plain):
            description = self._describe(answer, alone)
            if description is not None:
                return description
        refusal = refused or REFUSAL.search(plain)
        return Description(None, flags=("refusal" if refusal else "invalid",))

    def _describe(self, answer: Mapping[str, Any], alone: bool) -> Description | None:
        """The description in a JSON object; None if it lacks the caption."""
        words = answer.get("adjectives")
        words = words if isinstance(words, list) and all(isinstance(a, str) for a in words) else []
        adjectives = tuple(dict.fromkeys(a for a in map(_bare, words) if a))
        value: Any = ", ".join(adjectives) if self.text == "adjectives" else answer.get(self.text)
        if not isinstance(value, str) or not _bare(value) or len(adjectives) > MOST_ADJECTIVES:
            return None
        if REFUSAL.search(value):
            return Description(None, flags=("refusal",))
        limits = FIELDS["adjectives"]
        exact = alone and set(answer) == set(self.fields)
        if "adjectives" in self.fields:
            exact = exact and limits["minItems"] <= len(words) <= limits["maxItems"]
        flags = [] if exact else ["schema-ignored"]
        flags += ["surface-hidden"] if answer.get("surface_visible") is False else []
        text = " ".join(valid(value).split()).rstrip(".")
        return Description(text, adjectives, tuple(flags))


def _shipped() -> Iterator[str]:
    folder = resources.files("palpate.captions") / "prompts"
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        yield file.read_text(encoding="utf-8")


def valid(text: str) -> str:
    """A text whose characters all exist: JSON may hold halves of them, which no file can."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _bare(word: str) -> str:
    """An adjective as in a list: lower case, without quotes and full stops."""
    return " ".join(valid(word).strip(" \t\n.,;:'\"").lower().split())


def _objects(text: str) -> Iterator[tuple[bool, Mapping[str, Any]]]:
    """JSON objects in a text, and whether one is the whole text."""
    decoder, start = json.JSONDecoder(), text.find("{")
    while start >= 0:
        try:
            value, end = decoder.raw_decode(text, start)
        except (ValueError, RecursionError):
            end = start + 1
        else:
            if isinstance(value, dict):
                yield start == 0 and end == len(text), value
        start = text.find("{", end)
