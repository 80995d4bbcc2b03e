"""What the two halves of Touch-Vision-Language (TVL), HCT and SSVTP, share: lists and captions.

**Lists** are ``train.csv`` and ``test.csv`` (``val.csv`` too, as palpate writes one). Their readers
disagree: one goes by position, one by name, one takes the first column for an index. So a first row
without the name of an image is a header; columns that it does not name as expected are, in order,
the missing columns of images, and the first other column that is not all numbers is the caption.

**Captions** are adjectives between commas; they are trimmed, in lower case, without full stops.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from palpate.core import PARTS, write_text
from palpate.data.formats.base import Row, Scan
from palpate.data.formats.layout import count_rows
from palpate.data.images import SUFFIXES
from palpate.data.tables import LINE, header_of, open_table

CITATION = (
    "L. Fu, G. Datta, H. Huang, W. C.-H. Panitch, J. Drake, J. Ortiz, M. Mukadam, M. Lambeta, "
    "R. Calandra, K. Goldberg: A Touch, Vision, and Language Dataset for Multimodal Alignment. "
    "2024, arXiv 2402.13232"
)
URL = "https://huggingface.co/datasets/mlfu7/Touch-Vision-Language-Dataset"
IMAGE_SIZE = (240, 320)
NORMALIZATION = {
    "touch, zero-padded to a square and turned by 90 degrees (TVL)": (
        (0.29175, 0.29713, 0.29104),
        (0.18764, 0.19468, 0.21872),
    ),
    "touch minus background, signed and without offset (TVL)": (
        (-0.00809, -0.01887, -0.01843),
        (0.04535, 0.04403, 0.05333),
    ),
    "touch, not padded, 50 images (T3)": ((0.42094, 0.44041, 0.44151), (0.14661, 0.08972, 0.09041)),
}
COLUMNS = ("url", "tactile", "tactile_background", "caption")


def part_lists(folder: Path) -> dict[str, Path]:
    """Part -> its list, for the lists in a folder."""
    return {part: path for part in PARTS if (path := folder / f"{part}.csv").is_file()}


def read_list(scan: Scan, path: Path, columns: Sequence[str] = COLUMNS) -> list[Row]:
    """Read one list; bad rows become problems of the scan.

    Returns:
        (``file:line``, cells by the names in ``columns``); empty cells are None.
    """
    first = header_of(path)
    if not first:
        scan.problem(path, "empty-list", "the list has no lines")
        return []
    table = open_table(path, [str(k) for k in range(len(first))])
    rows = table.read(table.names).drop(LINE).rows()
    scan.problems += table.problems
    start = 0 if any(map(is_image, first)) else 1
    names = _columns([name.lower() for name in first] if start else [], rows[start:], columns)
    if "url" not in names and rows[start:]:
        text = f"no column of photos (url) among {', '.join(first)}"
        scan.problem(path, "missing-column", text)
        return []
    return [
        (table.where(k), {n: cell for n, cell in zip(names, rows[k], strict=True) if n})
        for k in range(start, len(rows))
    ]


def _columns(
    header: Sequence[str], rows: Sequence[Sequence[str | None]], known: Sequence[str]
) -> list[str | None]:
    """What each column holds, or None where it holds nothing of use."""
    names = [name if name in known else None for name in header] or [None] * len(rows[0])
    paths = [name for name in known if name not in (*names, "caption")]
    for k, name in enumerate(names):
        cells = [row[k] for row in rows if row[k]]
        if name is None and 2 * sum(is_image(cell or "") for cell in cells) > len(cells):
            names[k] = paths.pop(0) if paths else None
        elif (
            name is None and "caption" not in names and not all(c and c.isdecimal() for c in cells)
        ):
            names[k] = "caption"
    return names


def write_list(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str | None]]) -> Path:
    """Write one list with a header, atomically; None becomes an empty cell."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text(path, text.getvalue())
    return path


def clean_caption(text: str | None) -> str | None:
    """Adjectives between commas: trimmed, lower case, no full stops, none empty; None if none."""
    words = (" ".join(word.split()) for word in (text or "").replace(".", "").lower().split(","))
    return ", ".join(word for word in words if word) or None


def is_image(cell: str) -> bool:
    """Whether a cell is the name of an image."""
    return cell.lower().endswith(SUFFIXES)


def suspect_rows(scan: Scan, places: Sequence[str], kind: str, text: str) -> None:
    """Report similar rows at the first of them, with their number; nothing for no rows."""
    if places:
        scan.suspect(places[0], kind, f"{count_rows(places)}: {text}")
