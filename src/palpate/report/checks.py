"""Whether results read from a file hold what the page needs: the right kind of value in every field, told by its place."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

from palpate.report.results import Results

_WORDS: Mapping[Any, str] = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    type(None): "null",
}


@cache
def _hints(kind: type) -> Mapping[str, Any]:
    return get_type_hints(kind)


def _wrong(value: Any, hint: Any, place: str) -> str:
    """What is wrong with a value at ``place`` that should be as the type hint says; '' if it is right."""
    if hint is Any:
        return ""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(value, hint):
            return f"{place} must be an object, is {value!r:.40}"
        hints = _hints(hint)
        found = (
            _wrong(getattr(value, f.name), hints[f.name], f"{place}.{f.name}")
            for f in dataclasses.fields(value)
        )
        return next(filter(None, found), "")
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        said = [_wrong(value, option, place) for option in inner]
        deeper = [s for s in said if not s.startswith(f"{place} must")]
        return "" if "" in said else next(iter(deeper), said[0])
    if origin is tuple:
        if not isinstance(value, tuple) or len(value) != len(inner):
            return f"{place} must be a list of {len(inner)}, is {value!r:.40}"
        return next(
            filter(
                None,
                (
                    _wrong(v, h, f"{place}[{k}]")
                    for k, (v, h) in enumerate(zip(value, inner, strict=True))
                ),
            ),
            "",
        )
    if origin in (Sequence, Mapping):
        if not isinstance(value, origin) or isinstance(value, str):
            return f"{place} must be {'a list' if origin is Sequence else 'an object'}, is {value!r:.40}"
        pairs = value.items() if isinstance(value, Mapping) else enumerate(value)
        return next(filter(None, (_wrong(v, inner[-1], f"{place}[{k}]") for k, v in pairs)), "")
    expected: Any = (int, float) if hint is float else hint
    fits = isinstance(value, expected) and (hint is bool or not isinstance(value, bool))
    return "" if fits else f"{place} must be {_WORDS.get(hint, hint)}, is {value!r:.40}"


def check_results(results: Results) -> None:
    """Refuses results with a value of the wrong kind, which a page could only stumble over.

    Raises:
        ValueError: naming the first such field, e.g. ``audits[0].signals[2].threshold must be a number, is 'high'``.
    """
    for name, values in (
        ("audits", results.audits),
        ("scores", results.scores),
        ("gallery", results.gallery),
    ):
        for k, value in enumerate(values):
            if said := _wrong(value, type(value), f"{name}[{k}]"):
                raise ValueError(said)
    for name in ("facts", "notes", "commands"):
        if said := _wrong(getattr(results, name), Sequence[str], name):
            raise ValueError(said)
    counted = [(k, j, row) for k, a in enumerate(results.audits) for j, row in enumerate(a.matrix)]
    for k, j, row in counted:
        for name in ("train", "val", "test", "leaking"):
            if said := _wrong(row.get(name), int | None, f"audits[{k}].matrix[{j}].{name}"):
                raise ValueError(said)
