"""Errors for people: what must hold, what was found instead, and how to mend it.

Everything that a user can get wrong is raised as a :class:`PalpateError`; the command line prints it
without a traceback and exits with status 2.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any


class PalpateError(Exception):
    """A user's mistake, told as must / got / fix.

    Args:
        must: what has to hold, naming the file, row or flag (``"--ratio must lie in (0, 1)"``).
        got: what was found (``"1.5"``).
        fix: what to do next (``"Pass e.g. --ratio 0.8"``).
    """

    def __init__(self, must: str, got: str, fix: str) -> None:
        self.must, self.got, self.fix = must, got, fix
        super().__init__(f"{must.rstrip('.')}. Got {got.rstrip('.')}. {fix.rstrip('.')}.")

    def __reduce__(self) -> tuple[type[PalpateError], tuple[Any, ...]]:
        # By default an exception is rebuilt from its message alone, which this constructor does not take.
        return type(self), (self.must, self.got, self.fix)

    def to_json(self) -> dict[str, object]:
        """The error as a JSON object: ``error, must, got, fix``."""
        return {"error": type(self).__name__, "must": self.must, "got": self.got, "fix": self.fix}


@dataclass(frozen=True)
class Problem:
    """One bad thing in the input.

    Attributes:
        where: ``"file:line"``, or the file alone where lines have no meaning.
        kind: a stable word for machines, e.g. ``"missing-file"``, ``"bad-line"``, ``"duplicate-id"``.
        text: what is wrong, in one sentence without the place.
    """

    where: str
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.where}: {self.text}"


class ProblemsError(PalpateError):
    """Several bad things in one input, all told at once (``.problems``).

    Args:
        problems: what is wrong.
        fix: what to do next.
        must: what has to hold, where the input is neither rows nor files.
    """

    def __init__(self, problems: Sequence[Problem], fix: str, must: str = "") -> None:
        self.problems = list(problems)
        kinds = Counter(p.kind for p in self.problems)
        got = f"{len(self.problems)} problem{'s' * (len(self.problems) != 1)}: " + ", ".join(
            f"{n} {kind}" for kind, n in sorted(kinds.items())
        )
        super().__init__(
            must or "Every row and file of the input must be readable and consistent", got, fix
        )

    def __reduce__(self) -> tuple[type[PalpateError], tuple[Any, ...]]:
        return type(self), (self.problems, self.fix, self.must)

    def to_json(self) -> dict[str, object]:
        """The error as a JSON object, with the list ``problems``."""
        return super().to_json() | {"problems": [asdict(p) for p in self.problems]}


class MissingExtraError(PalpateError):
    """An optional dependency is not installed; says which ``pip install`` mends it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        self._given = (package, extra, purpose)
        super().__init__(
            f"{purpose} needs the package {package}",
            "no such package in this environment",
            f"Run: pip install 'palpate[{extra}]'",
        )

    def __reduce__(self) -> tuple[type[PalpateError], tuple[Any, ...]]:
        return type(self), self._given
