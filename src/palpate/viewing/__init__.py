"""``palpate view``: a data set, or results, to look at in a browser; a photo to touch."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.viewing.contents import Contents, contents
    from palpate.viewing.server import view

__all__ = ["Contents", "contents", "view"]
_MODULES = {"Contents": "contents", "contents": "contents", "view": "server"}

__getattr__ = partial(import_name, __name__, _MODULES)
