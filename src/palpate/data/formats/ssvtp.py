"""SSVTP (Kerr et al., 2022) as TVL distributes it: 4,587 presses of a DIGIT, worded by people.

::

    ssvtp/
      train.csv  test.csv                     url,tactile,caption
      images_rgb/image_437_rgb.jpg            the id is between image_ and _rgb
      images_tac/image_437_tac.jpg
      text/labels_437.txt                     first line: the caption
      tac_background.png                      the untouched gel, if the user put it there; TVL
                                              ships it with its code
      finetune.json  synonyms.json            not read: captions as talk; words that an evaluation
                                              takes for equal

The source may be ``ssvtp/`` or a folder that holds it. Tactile image and text are found by the id
of the photo, since the lists lack the column ``tactile`` or misname files in places. Without lists
every photo with its tactile image is a sample, and there is no part.

There is no recording, no object and no time in this set: ``video`` and ``frame`` are null, and only
near-duplicates say which samples belong together. The caption is the first line of the text file,
else the list's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from palpate.core import PalpateError, Progress, content_of, quiet
from palpate.data.formats import tvl
from palpate.data.formats.layout import file_names, natural, suspect_rows
from palpate.data.manifest import CLIMBS
from palpate.data.scanning import Facts, Format, Scan
from palpate.data.templates import Template, assign, join

FACTS = Facts(
    name="SSVTP (Touch-Vision-Language)",
    citation="J. Kerr, H. Huang, A. Wilcox, R. Hoque, J. Ichnowski, R. Calandra, K. Goldberg: "
    "Self-Supervised Visuo-Tactile Pretraining to Locate and Follow Garment Features. 2022, "
    f"arXiv 2209.13042. With captions: {tvl.CITATION}",
    url=tvl.URL,
    sensor="DIGIT",
    image_size=tvl.IMAGE_SIZE,
    samples="4,587 by TVL's paper; 46 in the test list",
    group="none is given: clusters of near-duplicates",
)
LOOKS_FOR = "ssvtp/, or images_rgb/ with image_<id>_rgb.jpg and images_tac/ with image_<id>_tac.jpg"
BACKGROUND = "tac_background.png"
FOLDERS = ("images_rgb", "images_tac")
TEMPLATES = {"tactile": "images_tac/image_{key}_tac", "vision": "images_rgb/image_{key}_rgb"}


def detect(source: Path) -> bool:
    """Whether a folder is SSVTP or holds ``ssvtp/``, without ``hct/``, which goes first."""
    root = find(source)
    return root is not None and (root == source or not (source / "hct").is_dir())


def find(source: Path) -> Path | None:
    """``ssvtp/``, from there or from the folder that holds it."""
    for root in (source, source / "ssvtp"):
        if all((root / folder).is_dir() for folder in FOLDERS):
            return root
    return None


def scan(source: Path, *, progress: Progress = quiet) -> Scan:
    """Read the lists, or the folders where there are none, and find the files of each sample."""
    root = find(source)
    if root is None:
        must = f"{source} must be SSVTP: {LOOKS_FOR}"
        raise PalpateError(must, "none of these", f"Unpack it from {tvl.URL}")
    paths = tvl.part_lists(root)
    result = Scan(root, {"layout": "ssvtp"})
    files = [f"{folder}/{name}" for folder in FOLDERS for name in file_names(root / folder)]
    matches = assign(files, {side: Template.parse(text) for side, text in TEMPLATES.items()})
    images = {side: {row["key"]: path for path, row in own} for side, own in matches.items()}
    misnamed = {*files}.difference(*(own.values() for own in images.values()))
    text = f"not named as {' and '.join(TEMPLATES.values())}"
    result.suspect(root, "unknown-name", text, sorted(misnamed))
    captions: dict[str, str | None] = {}
    if paths:
        lists = [path.name for path in paths.values()]
        result.split_rule = {"files": lists}
        for done, (part, path) in enumerate(paths.items()):
            progress("reading lists", done, len(paths))
            _read_list(result, path, part, images, captions)
        unlisted = [path for key, path in images["vision"].items() if key not in captions]
        result.suspect(root, "unlisted", "photos in no list", unlisted)
    else:
        pairs, result.problems = join(matches)
        for row in pairs:
            cells = {"id": f"ssvtp/{row.pop('key')}", **row}
            result.rows.append((str(root / row["vision"]), cells))
    _add_words(result, captions)
    background = BACKGROUND if (root / BACKGROUND).is_file() else None
    for _, row in result.rows:
        row |= {"background": background, "sensor": FACTS.sensor}
    result.facts["backgrounds"] = background or f"none: put {BACKGROUND} into ssvtp/ to have one"
    result.rows.sort(key=lambda row: natural(row[1]["id"].removeprefix("ssvtp/")))
    return result


FORMAT = Format(FACTS, detect, LOOKS_FOR, scan)


def _read_list(
    result: Scan,
    path: Path,
    part: str,
    images: Mapping[str, Mapping[str, str]],
    captions: dict[str, str | None],
) -> None:
    """Add the rows of one list; ``images`` has side -> id -> path, ``captions`` gets id -> text."""
    for where, cells in tvl.read_list(result, path):
        listed = {name: cells.get(name) for name in ("url", "tactile")}
        name = PurePosixPath(listed["url"] or "").name
        match = re.fullmatch(r"image_(.+?)(?:_rgb|_tac)?\.\w+", name)
        if not listed["url"]:
            result.problem(where, "empty-cell", "no url path")
        elif climbing := [c for c in listed.values() if c and re.search(CLIMBS, c)]:
            text = f"the path {climbing[0]!r} leaves the data set"
            result.problem(where, "outside-root", text)
        elif match is None:
            result.problem(where, "bad-path", f"{name!r} is not image_<id>_rgb.jpg")
        else:
            key = match[1]
            paths = {
                side: images[side].get(key, f"{text.format(key=key)}.jpg")
                for side, text in TEMPLATES.items()
            }
            captions.setdefault(key, tvl.clean_caption(cells.get("caption")))
            result.rows.append((where, {"id": f"ssvtp/{key}", **paths, "split": part}))


def _add_words(result: Scan, captions: dict[str, str | None]) -> None:
    """Add the text of each row, from its text file or else from its list."""
    sources: set[str] = set()
    without: list[str] = []
    for where, row in result.rows:
        key = row["id"].removeprefix("ssvtp/")
        caption = captions.get(key)
        text = _first_line(result.base / "text" / f"labels_{key}.txt")
        row["text"] = text or caption
        if text or caption:
            sources.add("text/labels_<id>.txt" if text else "column caption")
        else:
            without.append(where)
    result.facts["text_source"] = ", ".join(sorted(sources)) or "none"
    text = "neither a text file nor a caption in the list"
    suspect_rows(result, without, "no-text", text)


def _first_line(path: Path) -> str | None:
    if not path.is_file():
        return None
    lines = content_of(path).decode("utf-8-sig", errors="replace").splitlines()
    return tvl.clean_caption(lines[0]) if lines else None
