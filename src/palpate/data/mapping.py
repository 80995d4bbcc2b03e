r"""Map expressions: how a manifest column follows from the columns of somebody's table, as ``--map NAME=EXPRESSION``.

================================  ==============================================================  =========================
expression                        its value                                                       of ``a/b/cd_07.jpg``
================================  ==============================================================  =========================
``path``                          the cell of that column, or of another mapped column
``"left image"``                  a column with spaces or signs in its name
``'wood'``                        this text (``''`` inside is one quotation mark)
``path[0:3]``, ``path[-2]``       characters, counted from 0, from the end if negative             ``a/b``, ``p``
``name(path)``                    what follows the last slash                                     ``cd_07.jpg``
``stem(path)``                    the same without its last suffix                                ``cd_07``
``parent(path)``                  what precedes the last slash                                    ``a/b``
``part(path, 1)``                 one of the pieces between slashes, counted as characters are     ``b``
``path ~ /_(\d+)/``               what the pattern's group (or the whole pattern) matches first   ``07``
``int(stem(path)[-2:])``          a whole number without leading zeros                            ``7``
``replace(path, '/b/', '/x/')``   every occurrence replaced                                       ``a/x/cd_07.jpg``
``parent(path) + '/n.jpg'``       one text after the other                                        ``a/b/n.jpg``
================================  ==============================================================  =========================

Brackets ``( )`` group. Both slashes separate pieces of paths. A pattern is one of Python's ``re`` with at most one group, a
slash in it written ``\/``. An empty cell makes every expression over it empty. What cannot be had of a cell (no such
character or piece, no match, no number) is a problem of its row. Nothing is evaluated as code. If the whole text is the
name of a column it means that column, whatever signs it holds.

::

    expression = term { "+" term }
    term       = primary { "[" [int] ":" [int] "]" | "[" int "]" | "~" "/" pattern "/" }
    primary    = name | '"' name '"' | "'" text "'" | "(" expression ")"
               | ("stem" | "name" | "parent" | "int") "(" expression ")"
               | "part" "(" expression "," int ")" | "replace" "(" expression "," "'" text "'" "," "'" text "'" ")"
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any

from palpate.core import PalpateError

Cell = str | None
#: From the cells of the inputs to a value; None stands for an empty one.
Step = Callable[[Sequence[Cell]], Cell]

_SPACE = re.compile(r"\s*")
_NAME = re.compile(r"[^\W\d]\w*(?:[.\-]+\w+)*")
_QUOTED = re.compile(r'"((?:[^"]|"")+)"')
_TEXT = re.compile(r"'((?:[^']|'')*)'")
_INT = re.compile(r"-?\d{1,9}(?!\w)")
_PATTERN = re.compile(r"/((?:[^/\\]|\\.)+)/")
_PIECES = re.compile(r"[/\\]")
#: Brackets within brackets.
DEEPEST = 50
GRAMMAR = "Write a column, 'text', x[0:15], stem(x), name(x), parent(x), part(x, 0), int(x), replace(x, 'a', 'b'), x ~ /(\\d+)/ or x + y"


class NoValueError(Exception):
    """An expression has no value for a row; its text says why."""


@dataclass(frozen=True)
class Expression:
    """A map expression, ready for rows.

    Attributes:
        text: as it was written.
        inputs: the columns that it reads.
        step: from their cells, in that order, to the value.
    """

    text: str
    inputs: tuple[str, ...]
    step: Step

    @property
    def column(self) -> str | None:
        """The column that the expression is, if it is nothing but one."""
        return self.inputs[0] if len(self.inputs) == 1 and self.step is _first else None

    def value(self, cells: Mapping[str, Cell]) -> Cell:
        """The value for one row; None if a cell that it needs is empty.

        Raises:
            NoValueError: if the cells are of a form that the expression cannot take.
        """
        return self.step([cells.get(name) for name in self.inputs]) or None

    def values(
        self, column: Callable[[str], Sequence[Cell]], count: int
    ) -> tuple[list[Cell], dict[int, str]]:
        """The values for all rows.

        Args:
            column: the cells of a column by its name, (count,).
            count: number of rows.

        Returns:
            (count,) values, and row -> why there is none.
        """
        if self.column is not None:
            return list(column(self.column)), {}
        found: list[Cell] = []
        failed: dict[int, str] = {}
        step = self.step
        rows = (
            zip(*(column(name) for name in self.inputs), strict=True)
            if self.inputs
            else repeat((), count)
        )
        before: tuple[Cell, ...] | None = None
        for k, row in enumerate(rows):
            if (
                row == before and k - 1 not in failed
            ):  # columns of groups repeat: no second evaluation, no second copy
                found.append(found[-1])
                continue
            before = row
            try:
                found.append(step(row) or None)
            except NoValueError as error:
                found.append(None)
                failed[k] = str(error)
        return found, failed


def compile_maps(
    maps: Mapping[str, str], columns: Sequence[str], targets: Sequence[str]
) -> dict[str, Expression]:
    """Reads map expressions; they may name the table's columns and each other's targets, columns first.

    Args:
        maps: target -> expression.
        columns: of the table.
        targets: what may be mapped.

    Returns:
        target -> expression, also for those targets that are columns by name and are not mapped.

    Raises:
        PalpateError: on a target that there is none, or an expression that cannot be read, with the place in it.
    """
    if unknown := sorted(set(maps) - set(targets)):
        raise PalpateError(
            f"Mapped columns must be among {', '.join(targets)}",
            repr(unknown[0]),
            "Write it as manifest column = expression over yours",
        )
    wanted = {name: f'"{name}"' for name in targets if name in columns} | dict(maps)
    return {
        target: _Reader(target, text, columns, maps, ()).expression()
        for target, text in wanted.items()
    }


def _first(row: Sequence[Cell]) -> Cell:
    return row[0]


class _Reader:
    """Recursive descent over one expression; ``inputs`` collects the columns that it names."""

    def __init__(
        self,
        target: str,
        text: str,
        columns: Sequence[str],
        maps: Mapping[str, str],
        within: tuple[str, ...],
        inputs: list[str] | None = None,
    ) -> None:
        self.target, self.text, self.columns, self.maps, self.within = (
            target,
            text,
            columns,
            maps,
            (*within, target),
        )
        self.inputs: list[str] = [] if inputs is None else inputs
        self.at = self.depth = 0

    def expression(self) -> Expression:
        step = self.whole()
        return Expression(
            self.text,
            tuple(self.inputs),
            _first if len(self.inputs) == 1 and self._plain() else step,
        )

    def whole(self) -> Step:
        """The step of the text as a whole: a column's name, or an expression."""
        if self.text.strip() in self.columns:
            return self.column(self.text.strip())
        step = self.sum()
        self.skip()
        if self.at < len(self.text):
            raise self.wrong("the end")
        return step

    def _plain(self) -> bool:
        bare = self.text.strip()
        return bare in self.columns or (
            len(bare) > 2
            and bare[1:-1].replace('""', '"') in self.columns
            and bare[0] == bare[-1] == '"'
        )

    def sum(self) -> Step:
        self.depth += 1
        if self.depth > DEEPEST:
            raise self.error(f"brackets more than {DEEPEST} deep", self.at)
        steps = [self.term()]
        while self.sign("+"):
            steps.append(self.term())
        self.depth -= 1
        if len(steps) == 1:
            return steps[0]

        def joined(row: Sequence[Cell]) -> Cell:
            values = [step(row) for step in steps]
            return None if None in values else "".join(v for v in values if v is not None)

        return joined

    def term(self) -> Step:
        self.skip()
        start = self.at
        step = self.primary()
        while True:
            if self.sign("["):
                step = self.characters(step)
            elif self.sign("~"):
                step = self.match(step)
            else:
                return step
            step = _told(step, self.text[start : self.at].strip())

    def characters(self, of: Step) -> Step:
        low = self.token(_INT)
        if self.sign(":"):
            high = self.token(_INT)
            self.need("]")
            cut = slice(None if low is None else int(low), None if high is None else int(high))
            return _over(of, lambda value: value[cut])
        if low is None:
            raise self.wrong("a whole number or ':'")
        self.need("]")
        return _over(of, _picker(int(low), str, "characters"))

    def match(self, of: Step) -> Step:
        start = self.at
        source = self.token(_PATTERN)
        if source is None:
            raise self.wrong("a pattern between slashes")
        try:
            pattern = re.compile(source.replace("\\/", "/"))
        except (re.error, OverflowError, RecursionError) as error:
            raise self.error(f"a pattern that cannot be read ({error})", start) from None
        if pattern.groups > 1:
            raise self.error(f"a pattern of {pattern.groups} groups, where one is the most", start)

        def found(value: str) -> str:
            hit = pattern.search(value)
            if hit is None or hit[pattern.groups] is None:
                raise NoValueError(f"no match in {value!r}")
            return str(hit[pattern.groups])

        return _over(of, found)

    def primary(self) -> Step:
        self.skip()
        start = self.at
        if self.sign("("):
            step = self.sum()
            self.need(")")
            return step
        if (text := self.token(_TEXT)) is not None:
            constant = text.replace("''", "'")
            return lambda row: constant
        if (name := self.token(_QUOTED)) is not None:
            return self.column(name.replace('""', '"'), start)
        name = self.token(_NAME)
        if name is None:
            raise self.wrong("a column, a function or 'text'")
        return self.function(name, start) if self.sign("(") else self.column(name, start)

    def function(self, name: str, start: int) -> Step:
        if name not in _FUNCTIONS:
            raise self.error(f"no function {name!r} (there are {', '.join(_FUNCTIONS)})", start)
        of, arguments = self.sum(), list[str]()
        for kind, what in _FUNCTIONS[name][0]:
            self.need(",")
            given = self.token(kind)
            if given is None:
                raise self.wrong(what)
            arguments.append(given)
        self.need(")")
        step = _over(of, _FUNCTIONS[name][1](*arguments))
        return _told(step, self.text[start : self.at])

    def column(self, name: str, start: int = 0) -> Step:
        """The step that takes a column, or the value of another mapped column."""
        if name in self.columns:
            if name not in self.inputs:
                self.inputs.append(name)
            k = self.inputs.index(name)
            return lambda row: row[k]
        if name in self.maps:
            if name in self.within:
                raise self.error(f"{name!r}, which is made of itself", start)
            return _Reader(
                name, self.maps[name], self.columns, self.maps, self.within, self.inputs
            ).whole()
        raise self.error(f"no {name} among {', '.join(self.columns)}", start)

    def skip(self) -> None:
        found = _SPACE.match(self.text, self.at)
        self.at = found.end() if found else self.at

    def sign(self, sign: str) -> bool:
        """Whether the next sign is this one; goes behind it."""
        self.skip()
        there = self.text.startswith(sign, self.at)
        self.at += len(sign) * there
        return there

    def token(self, kind: re.Pattern[str]) -> str | None:
        """What comes next, if it is of the kind; goes behind it."""
        self.skip()
        found = kind.match(self.text, self.at)
        if found is None:
            return None
        self.at = found.end()
        return found[kind.groups]

    def need(self, sign: str) -> None:
        if not self.sign(sign):
            raise self.wrong(repr(sign))

    def wrong(self, wanted: str) -> PalpateError:
        self.skip()
        there = repr(self.text[self.at : self.at + 12]) if self.at < len(self.text) else "the end"
        return self.error(f"{there} where {wanted} must stand", self.at)

    def error(self, got: str, at: int) -> PalpateError:
        return PalpateError(
            f"The expression for {self.target} must be readable: {self.text}",
            f"{got}, at character {at + 1}",
            GRAMMAR,
        )


def _over(of: Step, function: Callable[[str], str]) -> Step:
    """A function of a value that may be empty."""

    def step(row: Sequence[Cell]) -> Cell:
        value = of(row)
        return None if value is None else function(value)

    return step


def _told(step: Step, text: str) -> Step:
    """The same step, whose failures name the piece of the expression; the innermost piece is the one named."""

    def told(row: Sequence[Cell]) -> Cell:
        try:
            return step(row)
        except NoValueError as error:
            if error.__cause__ is not None:
                raise
            raise NoValueError(f"{text}: {error}") from error

    return told


def _picker(index: int, split: Callable[[str], Sequence[str]], what: str) -> Callable[[str], str]:
    def pick(value: str) -> str:
        pieces = split(value)
        if not -len(pieces) <= index < len(pieces):
            raise NoValueError(f"{value!r} has {len(pieces)} {what}")
        return pieces[index]

    return pick


def _split(value: str) -> list[str]:
    return [piece for piece in _PIECES.split(value) if piece]


def _name(value: str) -> str:
    return _PIECES.split(value)[-1]


def _stem(value: str) -> str:
    name = _name(value)
    stem, dot, _ = name.rpartition(".")
    return stem if dot and stem else name


def _parent(value: str) -> str:
    return value[: max(value.rfind("/"), value.rfind("\\"), 0)]


def _int(value: str) -> str:
    found = re.fullmatch(r"\s*([+-]?\d{1,18})(?:\.0+)?\s*", value)
    if found is None:
        raise NoValueError(f"{value!r} is not a whole number")
    return str(int(found[1]))


def _replacer(old: str, new: str) -> Callable[[str], str]:
    before, after = old.replace("''", "'"), new.replace("''", "'")
    return lambda value: value.replace(before, after) if before else value


#: Function -> (kinds of its further arguments with what they are called, how to make it of them).
_FUNCTIONS: dict[
    str, tuple[list[tuple[re.Pattern[str], str]], Callable[..., Callable[[str], str]]]
] = {
    "stem": ([], lambda: _stem),
    "name": ([], lambda: _name),
    "parent": ([], lambda: _parent),
    "part": ([(_INT, "a whole number")], lambda k: _picker(int(k), _split, "pieces")),
    "int": ([], lambda: _int),
    "replace": ([(_TEXT, "'text' in quotation marks")] * 2, _replacer),
}


def text_of(value: Any) -> Cell:
    """A cell as text without surrounding space; empty, null and NaN are None."""
    if isinstance(value, str):
        return value.strip() or None
    return None if value is None or value != value else str(value)
