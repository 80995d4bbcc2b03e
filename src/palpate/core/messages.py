"""What rooms tell front ends: errors, notes, references to samples, and progress.

* Errors are for people: what must hold, what was given instead, and how to fix it. Everything that
  a user can get wrong raises a :class:`PalpateError`; the command line prints it without a
  traceback and exits with status 2.
* A note is what a reader must know about a number, as a code with parameters. Rooms make notes;
  :mod:`palpate.report.note_texts` has the sentence of each code. No program parses a sentence.
* Progress is counted in the rooms and drawn by the command line: a room that works for long takes
  ``progress: Progress = quiet`` and calls ``progress("decoding", 3, 100)``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, TypeVar

#: Names that a list in a sentence has.
FEW = 5
#: Lines of a printed list of problems, and how many of one kind it lists one by one.
SHOWN_PROBLEMS = 40
FEW_PROBLEMS = 3
#: A sentence that ends in a command or options, for pasting: it has no full stop.
_COMMAND = re.compile(r"(: |Use |E\.g\. )(palpate |pip |--?\w)")


class PalpateError(Exception):
    """A user's mistake: what must hold, what was given, how to fix it.

    Args:
        must: what has to hold. With ``argument`` a predicate of it that begins with "must"
            (``"must lie in (0, 1)"``), else a whole clause (``"The manifest must exist"``).
        got: what was given (``"1.5"``).
        fix: what to do next (``"Choose a smaller share"``); arguments in it are in backquotes, and
            the command line shows their options.
        argument: name of the Python argument that is at fault; the command line shows its option.
        example: arguments that would work (``{"train": 0.8}``); each front end writes them its way.
        choices: arguments of several calls that would work, for the user to choose from.

    Attributes:
        shared: whether all processes of a training raise it; the first one then prints it.
    """

    shared = False

    def __init__(
        self,
        must: str,
        got: str,
        fix: str,
        *,
        argument: str | None = None,
        example: Mapping[str, Any] | None = None,
        choices: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        self.must, self.got, self.fix = must, got, fix
        self.argument, self.example, self.choices = argument, dict(example or {}), list(choices)
        super().__init__(must, got, fix)

    def __reduce__(self) -> tuple[Any, ...]:
        # By default an exception is rebuilt by a call with its positional arguments alone.
        return type(self).__new__, (type(self), *self.args), self.__dict__

    def __str__(self) -> str:
        return self.message()

    def _render_traceback_(self) -> list[str]:
        """What a notebook shows in the place of a traceback."""
        return [f"{type(self).__name__}: {self}"]

    def message(
        self,
        name: Callable[[str], str] = lambda argument: f"`{argument}`",
        example: Callable[[str, Any], str] = lambda argument, value: f"{argument}={value!r}",
    ) -> str:
        """Return the error in one line: must, got, fix.

        Args:
            name: how an argument is written; the command line gives its option.
            example: how an argument with a value is written.
        """
        must = f"{name(self.argument)} {self.must}" if self.argument else self.must
        fix = re.sub(r"`(\w+)`", lambda argument: name(argument[1]), self.fix)
        parts = [p for p in (must, f"Got {self.got}", fix) if p]
        pasted = [p.endswith("...") or _COMMAND.search(p) is not None for p in parts]
        words = [p if c else f"{p.rstrip('.')}." for p, c in zip(parts, pasted, strict=True)]
        examples = [example(k, v) for k, v in self.example.items()]
        return " ".join([*words, *["E.g."] * bool(examples), *examples])

    def to_json(self) -> dict[str, Any]:
        """Return the error as a JSON object: ``error, must, got, fix, argument``."""
        names = ("must", "got", "fix", "argument", *["choices"] * bool(self.choices))
        return {"error": type(self).__name__} | {name: getattr(self, name) for name in names}


@contextmanager
def fields_of(name: str) -> Generator[None]:
    """Name arguments of errors that are raised inside as fields: ``lr`` as ``"loop.lr"``."""
    try:
        yield
    except PalpateError as error:
        if error.argument:
            error.example = {f"{name}.{k}": v for k, v in error.example.items()}
            error.argument = f"{name}.{error.argument}"
        raise


def few(names: Iterable[object]) -> str:
    """Return ``"a, b, c, d, e and 3 more"``, or ``"none"``."""
    words = [str(name) for name in names]
    more = f" and {len(words) - FEW:,} more" * (len(words) > FEW)
    return ", ".join(words[:FEW]) + more if words else "none"


def require_choice(argument: str, value: Any, choices: Iterable[str]) -> None:
    """Check that an argument is one of ``choices``.

    Raises:
        PalpateError: if it is not.
    """
    choices = list(choices)
    must = f"must be one of {', '.join(choices)}"
    require(value in choices, argument, must, repr(value), fix="Choose one of these")


def require(
    holds: bool, argument: str | None, must: str, got: Any, example: Any = None, *, fix: str = ""
) -> None:
    """Check an argument: ``require(0 < share < 1, "share", "must lie in (0, 1)", share, 0.5)``.

    Args:
        holds: what has to be true.
        argument: name of the argument; None if ``must`` is a whole clause.
        must: as in :class:`PalpateError`.
        got: what was given: a text as it is, anything else by its ``repr``.
        example: a value of the argument that would work.
        fix: as in :class:`PalpateError`.

    Raises:
        PalpateError: unless it ``holds``.
    """
    if not holds:
        examples = {argument: example} if argument and example is not None else {}
        text = got if isinstance(got, str) else repr(got)
        raise PalpateError(must, text, fix, argument=argument, example=examples)


def require_rows(ids: Iterable[str], wanted: Sequence[str], must: str, fix: str) -> list[int]:
    """Return the row of each wanted id.

    Raises:
        PalpateError: if one is missing.
    """
    row = {name: k for k, name in enumerate(ids)}
    if missing := [i for i in wanted if i not in row]:
        got = f"{len(missing)} of {len(wanted)} missing, first {missing[0]!r}"
        raise PalpateError(must, got, fix)
    return [row[i] for i in wanted]


def require_joined(ids: Iterable[str], others: Iterable[str], source: str) -> None:
    """Check a join by id of samples to a ``source`` with the ids ``others``.

    Raises:
        PalpateError: if it has none of theirs: the ids are another set's.
    """
    own, theirs = [*ids], {*others}
    if own and theirs.isdisjoint(own):
        wrong, right = (", ".join(map(repr, names[:2])) for names in (sorted(theirs), own))
        got, must = (
            f"{wrong or 'none'} instead of {right}",
            f"{source} must hold ids of these samples",
        )
        raise PalpateError(must, got, "Use those made for these, or write their ids there")


class PalpateWarning(UserWarning):
    """A result that needs a second look; results carry the same fact as a :class:`Note`."""


@dataclass(frozen=True)
class Problem:
    """One bad thing in the input.

    Attributes:
        where: ``"file:line"``, or the file alone where lines have no meaning.
        kind: a stable word for machines, e.g. ``"missing-file"``, ``"bad-line"``.
        text: what is wrong, in one sentence without the place.
    """

    where: str
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.where}: {self.text}"

    def sort_key(self) -> tuple[str, int]:
        """File and line."""
        name, _, line = self.where.rpartition(":")
        return (name, int(line)) if line.isdecimal() else (self.where, 0)


def problem_lines(problems: Sequence[Problem]) -> list[str]:
    """Return problems as lines of text: of more than a few of one kind the first and their number.

    Two are of one kind if their texts differ in quoted words, numbers, paths and values alone.
    """
    groups: dict[tuple[str, str], list[Problem]] = {}
    for problem in problems:
        bare = re.sub(r"'[^']*'|\S*[0-9/=.]\S*", "_", problem.text)
        groups.setdefault((problem.kind, bare), []).append(problem)
    lines: list[str] = []
    for group in groups.values():
        many = f"  {len(group):,} like {group[0]}"
        lines += [many] if len(group) > FEW_PROBLEMS else [f"  {problem}" for problem in group]
    more = len(lines) - SHOWN_PROBLEMS
    return lines[:SHOWN_PROBLEMS] + [f"  ... and {more} more (JSON lists all)"] * (more > 0)


class ProblemsError(PalpateError):
    """Several bad things in one input, reported together (``.problems``).

    Args:
        problems: what is wrong.
        fix: what to do next.
        must: what has to hold, where the input is neither rows nor files.
        example: arguments that would work.
    """

    def __init__(
        self,
        problems: Sequence[Problem],
        fix: str,
        must: str = "",
        *,
        example: Mapping[str, Any] | None = None,
    ) -> None:
        self.problems = list(problems)
        kinds = sorted(Counter(p.kind for p in self.problems).items())
        count = f"{len(self.problems)} problem{'s' * (len(self.problems) != 1)}"
        got = f"{count}: {', '.join(f'{n} {kind}' for kind, n in kinds)}"
        must = must or "Every row and file of the input must be readable and consistent"
        super().__init__(must, got, fix, example=example)

    def __str__(self) -> str:
        return "\n".join([self.message(), *problem_lines(self.problems)])

    def to_json(self) -> dict[str, Any]:
        """Return the error as a JSON object, with the list ``problems``."""
        return super().to_json() | {"problems": [asdict(problem) for problem in self.problems]}


class MissingExtraError(PalpateError):
    """An optional dependency is not installed; names the ``pip install`` that adds it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        must = f"{purpose} needs the package {package}"
        got = f"no such package in this environment; the extra {extra} brings it"
        super().__init__(must, got, f"In palpate's checkout run: pip install -e '.[{extra}]'")


@dataclass(frozen=True)
class Note:
    """One thing that a reader must know.

    Attributes:
        code: stable and lower-case, words joined by hyphens (``"copied-rows"``).
        params: what the sentence is filled with; plain JSON values.
    """

    code: str
    params: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SampleRef:
    """A sample. Image paths are absolute or relative to the results file; None = no image."""

    id: str
    video: str | None = None
    frame: int | None = None
    material: str | None = None
    vision: str | None = None
    tactile: str | None = None
    background: str | None = None


T = TypeVar("T")


class Progress(Protocol):
    """Called with the task, the amount done, the total (0 = unknown), and a short remark."""

    def __call__(self, task: str, done: int, total: int, remark: str = "", /) -> None:
        """Report once."""


def quiet(task: str, done: int, total: int, remark: str = "") -> None:
    """Show nothing."""


def track(items: Iterable[T], task: str, progress: Progress) -> Iterator[T]:
    """Yield ``items`` and report after each."""
    count = len(items) if isinstance(items, Sequence) else 0
    progress(task, 0, count)
    for done, item in enumerate(items, 1):
        yield item
        progress(task, done, count)
