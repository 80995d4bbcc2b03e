"""``--preset NAME --set field=value ...``: presets as the command line lists and changes them.

A preset is a frozen dataclass whose fields may be frozen dataclasses again. A field is named by its
path, ``loop.lr``. Type and value are the dataclass's own; meaning and unit stand in the docstring
of its class: ``crop: side of the random crops [px]``.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import docstring_parser
import tyro

from palpate.core import PalpateError, require_choice

#: The option ``--set``: several fields each time it is given.
Settings = Annotated[
    tuple[tuple[str, ...], ...], tyro.conf.arg(name="set"), tyro.conf.UseAppendAction
]
_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


@dataclass(frozen=True)
class Field:
    """A field of a preset.

    Attributes:
        path: its name after those of the records that hold it.
        types: what its value may be.
        value: the preset's.
        meaning: in words.
        unit: of the value, or empty.
    """

    path: str
    types: tuple[Any, ...]
    value: Any
    meaning: str
    unit: str

    @property
    def type_text(self) -> str:
        """What its value may be, in words."""
        return " or ".join(self._words(kind) for kind in self.types)

    @property
    def text(self) -> str:
        """The preset's value as ``--set`` takes it."""
        if self.value is None or isinstance(self.value, str):
            return self.value or "none"
        return "" if dataclasses.is_dataclass(self.value) else json.dumps(self.value)

    def _words(self, kind: Any) -> str:
        if kind is NoneType:
            return "none"
        if get_origin(kind) is Literal:
            return f"one of {', '.join(get_args(kind))}"
        return f"a list such as {self.text}" if get_origin(kind) is tuple else _WORDS[kind]

    def read(self, text: str) -> Any:
        """Return the value that a text stands for.

        Raises:
            PalpateError: if it is of none of the field's types.
        """
        for kind in self.types:
            try:
                return _read(kind, text)
            except (LookupError, TypeError, ValueError):
                continue
        raise PalpateError(f"{self.path} must be {self.type_text}", repr(text), "", argument="set")


def _read(kind: Any, text: str) -> Any:
    """The value of one type; a ``LookupError``, ``TypeError`` or ``ValueError`` if it is none."""
    inner = get_args(kind)
    if kind is NoneType:
        return {"none": None}[text]
    if kind is bool:
        return {"true": True, "false": False}[text]
    if get_origin(kind) is Literal:
        return inner[inner.index(text)]
    if get_origin(kind) is tuple:
        cells = json.loads(text)
        inner = inner[:1] * len(cells) if inner[-1] is ... else inner
        return tuple(_read(k, json.dumps(cell)) for k, cell in zip(inner, cells, strict=True))
    return kind(text)


@dataclass(frozen=True)
class PresetTable:
    """The presets of a verb.

    Attributes:
        presets: by name.
        options: fields, or records of them, that ``--set`` does not take, with the option that does
            or an empty text.
    """

    presets: Mapping[str, Any]
    options: Mapping[str, str]

    def fields(self, name: str) -> dict[str, Field]:
        """The fields of a preset that ``--set`` takes, by path."""
        return {field.path: field for field in self._walk(self.presets[name], "")}

    def _walk(self, record: Any, prefix: str) -> Iterator[Field]:
        types, texts = get_type_hints(type(record)), _attributes(type(record))
        for each in dataclasses.fields(record):
            path, value, kind = prefix + each.name, getattr(record, each.name), types[each.name]
            if path in self.options:
                continue
            choices = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
            plain = tuple(k for k in choices if not dataclasses.is_dataclass(k))
            if plain == choices or set(plain) - {NoneType}:
                yield Field(path, plain, value, *texts.get(each.name, ("", "")))
            if dataclasses.is_dataclass(value):
                yield from self._walk(value, f"{path}.")

    def preset(self, name: str, settings: Sequence[Sequence[str]] = ()) -> Any:
        """Return a preset with the fields that ``--set`` gives.

        Args:
            name: of the preset.
            settings: ``field=value``, as :data:`Settings` holds them.

        Raises:
            PalpateError: if there is no such preset or field, or a value is not of the field's
                type, or lies outside its range.
        """
        require_choice("preset", name, self.presets)
        fields, values = self.fields(name), dict[str, Any]()
        for setting in (text for texts in settings for text in texts):
            path, _, text = setting.partition("=")
            if path not in fields or "=" not in setting:
                raise self._unknown(name, path, setting)
            values[path] = fields[path].read(text)
        for path in values:
            if upper := [other for other in values if path.startswith(f"{other}.")]:
                must = f"{path} must be left out beside {upper[0]}"
                raise PalpateError(must, "both", "", argument="set")
        return _changed(self.presets[name], "", values)

    def _unknown(self, name: str, path: str, setting: str) -> PalpateError:
        must = f"must be field=value, with a field of the preset {name}"
        paths = self.fields(name)
        if path in paths:
            return PalpateError(must, setting, f"E.g. {path}={paths[path].text}", argument="set")
        for part, option in self.options.items():
            if option and path == part:
                return PalpateError(must, setting, f"Use {option}", argument="set")
        last = {p: p.rpartition(".")[2] for p in (path, *paths)}
        best = difflib.get_close_matches(last.pop(path), last.values(), 1, 0.7)
        near = [p for p in paths if last[p] in best]
        fix = f"Did you mean: {' or '.join(near)}" if near else f"See: palpate presets {name}"
        return PalpateError(must, setting, fix, argument="set")


def _changed(record: Any, prefix: str, values: Mapping[str, Any]) -> Any:
    """A record with new values of its fields, all at once: only together they may be valid."""

    def value(name: str) -> Any:
        path, old = prefix + name, getattr(record, name)
        if path in values:
            return values[path]
        within = any(other.startswith(f"{path}.") for other in values)
        return _changed(old, f"{path}.", values) if within else old

    names = [field.name for field in dataclasses.fields(record)]
    try:
        return dataclasses.replace(record, **{name: value(name) for name in names})
    except PalpateError as error:
        if error.argument in names:  # of this record; the option is --set
            error.must, error.argument = f"{prefix}{error.argument} {error.must}", "set"
        raise


def _attributes(record: type[Any]) -> dict[str, tuple[str, str]]:
    """Meaning and unit of each attribute that a docstring describes."""
    texts: dict[str, tuple[str, str]] = {}
    for part in docstring_parser.parse(record.__doc__ or "").params:
        text = " ".join((part.description or "").replace("``", "").split()).removesuffix(".")
        meaning, mark, unit = text.removesuffix("]").rpartition(" [")
        pair = (meaning, unit) if mark and text.endswith("]") else (text, "")
        texts |= dict.fromkeys(part.arg_name.split(", "), pair)
    return texts
