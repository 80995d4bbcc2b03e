"""How answers show themselves: the same text at the prompt, by ``print`` and in notebooks."""

from __future__ import annotations

import html


class Shown:
    """An answer whose ``__str__`` is also its ``repr`` and, in notebooks, its HTML.

    The ``repr`` that dataclasses write is for records inside of others: it shows every field.
    """

    def __init_subclass__(cls) -> None:
        """Give the class the ``repr`` itself, which ``dataclass`` then leaves alone."""
        super().__init_subclass__()
        cls.__repr__ = Shown.__repr__

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f'<pre style="line-height: 1.3">{html.escape(str(self))}</pre>'
