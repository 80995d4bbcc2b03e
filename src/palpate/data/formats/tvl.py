"""What the two halves of Touch-Vision-Language (TVL), HCT and SSVTP, share: lists and captions.

**Lists** are ``train.csv`` and ``test.csv`` (and ``val.csv``, as palpate writes it), with a header.

**Captions** are adjectives between commas; they are trimmed, in lower case, without full stops.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from palpate.core import PARTS, write_text
from palpate.data.mapping import LINE
from palpate.data.scanning import Row, Scan
from palpate.data.tables import csv_text, header_of, open_table

CITATION = (
    "L. Fu, G. Datta, H. Huang, W. C.-H. Panitch, J. Drake, J. Ortiz, M. Mukadam, M. Lambeta, "
    "R. Calandra, K. Goldberg: A Touch, Vision, and Language Dataset for Multimodal Alignment. "
    "2024, arXiv 2402.13232"
)
URL = "https://huggingface.co/datasets/mlfu7/Touch-Vision-Language-Dataset"
IMAGE_SIZE = (240, 320)
COLUMNS = ("url", "tactile", "tactile_background", "caption")


def part_lists(folder: Path) -> dict[str, Path]:
    """Part -> its list, for the lists in a folder."""
    return {part: path for part in PARTS if (path := folder / f"{part}.csv").is_file()}


def read_list(scan: Scan, path: Path) -> list[Row]:
    """Read one list; bad rows become problems of the scan.

    Returns:
        (``file:line``, cells by those of ``COLUMNS`` that are there); empty cells are None.
    """
    names = [name.lower() for name in header_of(path)]
    if not names:
        scan.problem(path, "empty-list", "the list has no lines")
        return []
    if "url" not in names and names[0] == "":  # saved with the photo as index
        names[0] = "url"
    if "url" not in names:
        scan.problem(path, "missing-column", f"no column url among {', '.join(names)}")
        return []
    table = open_table(path, names)
    rows = table.read([name for name in COLUMNS if name in names]).rows(named=True)
    scan.problems += table.problems
    return [(table.place(row[LINE]), row) for row in rows[1:]]  # the first is the header


def write_list(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str | None]]) -> Path:
    """Write one list with a header, atomically; None becomes an empty cell."""
    write_text(path, csv_text(columns, rows))
    return path


def clean_caption(text: str | None) -> str | None:
    """Adjectives between commas: trimmed, lower case, no full stops, none empty; None if none."""
    words = (" ".join(word.split()) for word in (text or "").replace(".", "").lower().split(","))
    return ", ".join(word for word in words if word) or None
