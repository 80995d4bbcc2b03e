"""Photos as they are sent: at most 768 pixels a side, JPEG of quality 90, no metadata."""

from __future__ import annotations

import io
import threading
from pathlib import Path

from PIL import Image

from palpate.data.images import read_image

SIDE, QUALITY = 768, 90
# One photo at a time: a photo is read in many small steps, and threads that take turns after each
# of them need half as much time again.
_LOCK = threading.Lock()


def prepared(path: Path) -> bytes:
    """The JPEG file that is sent for a photo.

    Raises:
        PalpateError: if the photo is missing, truncated or none.
    """
    data = io.BytesIO()
    with _LOCK:
        photo = read_image(path)
        photo.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
        photo.save(data, "JPEG", quality=QUALITY, exif=b"", icc_profile=None)
    return data.getvalue()
