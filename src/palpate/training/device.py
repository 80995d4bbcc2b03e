"""Names of devices, checked without torch."""

from __future__ import annotations

import re

from palpate.core import PalpateError

#: Kinds of devices that torch or a back end of it computes on.
KINDS = ("cpu", "cuda", "mps", "xpu", "hpu", "npu", "mtia", "xla", "privateuseone")
_NAME = re.compile(rf"auto|(?:{'|'.join(KINDS)})(?::\d+)?")


def require_device_name(device: str) -> None:
    """Refuses what cannot be the name of a device, whatever the machine has.

    Args:
        device: ``auto``, or one of :data:`KINDS`, with a number if wanted (``cuda:1``).

    Raises:
        PalpateError: for anything else.
    """
    if not _NAME.fullmatch(device):
        raise PalpateError(
            "--device must be auto, cpu, or a device that is there",
            repr(device),
            f"Choose auto, {', '.join(KINDS[:-1])}",
        )
