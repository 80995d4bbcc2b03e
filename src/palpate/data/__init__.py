"""Data: the manifest, one file per data-set format, images and video frames."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.data.backgrounds import Backgrounds, propose_backgrounds
    from palpate.data.imported import Imported, Validation
    from palpate.data.importing import import_dataset, validate
    from palpate.data.manifest import Manifest
    from palpate.data.reading import load

#: Public name -> its module, imported on first use, so that ``import palpate.data`` is free.
_MODULES = {
    "Backgrounds": "backgrounds",
    "Imported": "imported",
    "Manifest": "manifest",
    "Validation": "imported",
    "import_dataset": "importing",
    "load": "reading",
    "propose_backgrounds": "backgrounds",
    "validate": "importing",
}

__all__ = [
    "Backgrounds",
    "Imported",
    "Manifest",
    "Validation",
    "import_dataset",
    "load",
    "propose_backgrounds",
    "validate",
]

__getattr__ = partial(import_name, __name__, _MODULES)
