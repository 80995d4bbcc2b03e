"""The entries of the table of materials: what is wrong with them, and what tells an added one from every other.

Names and labels go into lists and ids, as Touch and Go's ``Name: id`` and ``name_000``: so a name is made of letters, digits, space and ``_ ( ) -``,
and no two materials share a label or the part of an object's id that comes from the name (lower case, ``_`` for spaces).

A built-in material is known by its name and VERSION. An added one can be edited between two runs, so a world records a SHA-256 of its function: of
the source (of the byte code, where there is none), of the functions of its module and the plain constants that it uses, of defaults and closure.
"""

from __future__ import annotations

import functools
import inspect
import re
import types
from collections.abc import Iterator
from typing import Any

import numpy as np

from palpate.core import PalpateError, digest_json
from palpate.sim.materials import BUILT_IN, MATERIALS, Material
from palpate.sim.materials.surface import is_line

#: What a material may be called.
NAME = re.compile(r"[A-Za-z0-9_()-]+(?: +[A-Za-z0-9_()-]+)*")


def object_prefix(name: str) -> str:
    """What the ids of a material's objects begin with, e.g. ``natural_fabric``."""
    return name.lower().replace(" ", "_")


def bad_entries(names: tuple[str, ...]) -> Iterator[PalpateError]:
    """What is wrong with the entries of these materials, by themselves and beside all others, which stand in the same list of categories."""
    for name in names:
        if not NAME.fullmatch(name):
            must = "The name of a material must be made of letters, digits, _ ( ) - and spaces between them"
            yield PalpateError(must, ascii(name), "Enter it in MATERIALS under another name")
        elif problem := _wrong(MATERIALS[name]):
            yield PalpateError(
                f"The material {name!r} must have {problem[0]}",
                problem[1],
                f"Mend MATERIALS[{name!r}]",
            )
        else:
            yield from _shared(name)


def _wrong(entry: Any) -> tuple[str, str] | None:
    """What an entry must have and what it has, or None; entries may be a user's."""
    if not isinstance(entry, Material):
        return "a Material as its entry", type(entry).__name__
    if type(entry.label) is not int or not 0 <= entry.label < 2**31:
        return (
            "a whole number from 0 to 2147483647 as its label",
            f"{type(entry.label).__name__} {str(entry.label)[:40]}",
        )
    if not is_line(entry.noun):
        return "a noun of one line", ascii(entry.noun)
    if not isinstance(entry.subtypes, tuple) or not all(is_line(kind) for kind in entry.subtypes):  # pyright: ignore[reportUnnecessaryIsInstance]
        return "a tuple of names as its subtypes", ascii(entry.subtypes)
    return None if callable(entry.draw) else ("a function that draws it", type(entry.draw).__name__)


def _shared(name: str) -> Iterator[PalpateError]:
    """Labels and prefixes that ``name`` has in common with other materials."""
    for other, entry in MATERIALS.items():
        if other == name:
            continue
        if isinstance(entry, Material) and entry.label == MATERIALS[name].label:  # pyright: ignore[reportUnnecessaryIsInstance]
            got = f"label {entry.label} of {name!r} and {other!r}"
            yield PalpateError(
                "Every material must have a label of its own",
                got,
                "Give the added one a label from 20",
            )
        if isinstance(other, str) and object_prefix(other) == object_prefix(name):  # pyright: ignore[reportUnnecessaryIsInstance]
            got = f"{object_prefix(name)!r} of {name!r} and {other!r}"
            yield PalpateError(
                "The objects of every material must have names of their own",
                got,
                "Give the added one another name",
            )


def added_materials(names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Of the materials that are not built in: name -> label, noun, subtypes and the SHA-256 of the function, see the module's text."""
    used = {name: MATERIALS[name] for name in names if BUILT_IN.get(name) != MATERIALS[name]}
    return {
        name: {
            "label": m.label,
            "noun": m.noun,
            "subtypes": list(m.subtypes),
            "function": digest_json(_code_of(m.draw, set())),
        }
        for name, m in used.items()
    }


def _code_of(function: Any, seen: set[int]) -> Any:
    """What a function does, as JSON: its source or byte code, and what it uses of its own module; the same in every process."""
    if id(function) in seen:
        return "above"
    seen.add(id(function))
    if isinstance(function, functools.partial):
        return [
            _code_of(function.func, seen),
            [_value(v, seen) for v in function.args],
            _values(function.keywords, seen),
        ]
    if isinstance(function, types.MethodType):
        return [_code_of(function.__func__, seen), _value(function.__self__, seen)]
    if not isinstance(function, types.FunctionType):  # an object that can be called
        return [
            _source(type(function)),
            _code_of(type(function).__call__, seen),
            _values(getattr(function, "__dict__", {}), seen),
        ]
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    used = {
        name: function.__globals__[name]
        for name in _names(function.__code__)
        if name in function.__globals__
    }
    used |= {name: cell.cell_contents for name, cell in cells}
    own = {
        k: v
        for k, v in used.items()
        if not isinstance(v, types.FunctionType) or v.__module__ == function.__module__
    }
    defaults = [_value(v, seen) for v in function.__defaults__ or ()]
    return [
        _source(function) or _bytes(function.__code__),
        defaults,
        _values(function.__kwdefaults__ or {}, seen),
        _values(own, seen),
    ]


def _source(of: Any) -> str:
    try:
        return inspect.getsource(of)
    except (
        OSError,
        TypeError,
        SyntaxError,
    ):  # typed at a prompt, made by exec, or not written in Python
        return ""


def _bytes(code: types.CodeType) -> list[Any]:
    inner = [
        _bytes(c) if isinstance(c, types.CodeType) else _value(c, set()) for c in code.co_consts
    ]
    return [code.co_code.hex(), inner, list(code.co_names)]


def _names(code: types.CodeType) -> list[str]:
    """The names that a function and those within it look up."""
    inner = [name for c in code.co_consts if isinstance(c, types.CodeType) for name in _names(c)]
    return sorted({*code.co_names, *inner})


def _values(values: dict[str, Any], seen: set[int]) -> dict[str, Any]:
    return {name: _value(values[name], seen) for name in sorted(values)}


def _value(value: Any, seen: set[int]) -> Any:
    """A constant as JSON; of what is neither plain nor a function its type alone, as its repr may hold an address."""
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, tuple | list):
        return [_value(v, seen) for v in value]
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if isinstance(value, dict):
        return {repr(k): _value(v, seen) for k, v in value.items()}
    if isinstance(value, np.ndarray) and value.dtype != object:
        return [str(value.dtype), list(value.shape), value.tobytes().hex()]
    return (
        _code_of(value, seen)
        if isinstance(value, types.FunctionType | functools.partial)
        else type(value).__name__
    )
