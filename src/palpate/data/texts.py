"""Bytes of lists and tables as text: UTF-8, or UTF-16 with a byte-order mark."""

from __future__ import annotations

import codecs


def decoded(data: bytes) -> str:
    """Decode UTF-8, or UTF-16 with a byte-order mark; other bytes become U+FFFD."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    return data.decode("utf-8-sig", errors="replace")


def lines_of(text: str) -> list[str]:
    """The lines of a text by any of the ends LF, CR LF and CR, and by no other sign."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
