"""Captions: what each touch feels like in words, by a vision-language model, and their check.

Names are imported on first use; importing this package loads no client of a server.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name

if TYPE_CHECKING:
    from palpate.captions.captioning import Captions, Estimate, StoppedError, caption
    from palpate.captions.checking import check_captions
    from palpate.captions.prompts import Prompt

__all__ = ["Captions", "Estimate", "Prompt", "StoppedError", "caption", "check_captions"]
#: Public name -> the module that it is imported from.
_MODULES = {
    "Captions": "captioning",
    "Estimate": "captioning",
    "Prompt": "prompts",
    "StoppedError": "captioning",
    "caption": "captioning",
    "check_captions": "checking",
}

__getattr__ = partial(import_name, __name__, _MODULES)
