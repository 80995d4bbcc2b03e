"""Public names of a package, imported from their modules on first use (PEP 562)."""

import importlib
import sys
from collections.abc import Mapping
from typing import Any


def import_name(package: str, modules: Mapping[str, str], name: str) -> Any:
    """Import a public name of a package: its ``__getattr__``, with the first two given.

    Args:
        package: its ``__name__``.
        modules: public name -> the module below the package that defines it.
        name: the name.

    Raises:
        AttributeError: if the package has no such name.
    """
    if name not in modules:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    try:
        value = getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "diffusers", "transformers", "safetensors"):
            raise
        from palpate.core import MissingExtraError

        raise MissingExtraError(error.name, "all", f"{package}.{name}") from None
    setattr(sys.modules[package], name, value)
    return value
