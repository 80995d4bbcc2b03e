"""Damage to files, as of a bad disk or a copy that broke off."""

from __future__ import annotations

import os
from pathlib import Path


def flip(file: Path) -> None:
    """Invert four bytes in the middle."""
    data = bytearray(file.read_bytes())
    middle = slice(len(data) // 2, len(data) // 2 + 4)
    data[middle] = bytes(255 - byte for byte in data[middle])
    file.write_bytes(data)


def cut(file: Path) -> None:
    """Keep the first half."""
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])


def head(file: Path) -> None:
    """Invert four bytes near the start, where headers are."""
    data = bytearray(file.read_bytes())
    data[12:16] = bytes(255 - byte for byte in data[12:16])
    file.write_bytes(data)


def tail(file: Path) -> None:
    """Invert the last four bytes."""
    data = bytearray(file.read_bytes())
    data[-4:] = bytes(255 - byte for byte in data[-4:])
    file.write_bytes(data)


def inflate(file: Path) -> None:
    """Add zeros up to 3 GB, which take no room on the disk."""
    os.truncate(file, 3 << 30)


DAMAGES = (flip, cut, head, tail)
