"""ObjectFolder-Real (Gao et al., CVPR 2023): 100 real objects, in two layouts.

**Raw trials** (``objectfolder``), as T3 and Sparsh read them::

    root/
      <object 1..100>/tactile_data/<trial>/0/gelsight/<k>.png     pictures of one press, by number
      objectfolder_real_metadata.csv                              Index,Name,Material (optional; from alanzjl/t3)

A trial is a recording. Its first picture is taken to show the gel before contact: it is the background of the others and no
sample. (Inferred; nothing says so.) There is no vision in this layout. Several objects share a name, so an object is its number.
JPEGs beside the PNGs are T3's copies and are left aside.

**The cross-generation benchmark** (``objectfolder-generation``), of 50 of the objects::

    root/
      touch/<object>/<contact>.png   vision/<object>/<contact>.png
      touch_ref/touch_ref.png        the gel untouched, one for all
      vision_ref/<object>.png        not imported
      *.json                         {"train|val|test": [[object, contact], ..]}

The contacts of an object come in no order of time, so ``video`` and ``frame`` are null and the object is the group. One list
gives the split ``Orig``; several (cross-contact, cross-object) give one split each, named as the file.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from pathlib import Path

from palpate.core import PARTS, PalpateError, Problem, Progress, Split, quiet, write_json
from palpate.data.formats.base import Facts, Scan
from palpate.data.formats.numbered import (
    assign,
    few,
    natural,
    numbered,
    read_pairs,
    require_folder,
    subfolders,
    tell,
)
from palpate.data.images import SUFFIXES
from palpate.data.manifest import Manifest

CITATION = "R. Gao et al.: The ObjectFolder Benchmark: Multisensory Learning with Neural and Real Objects. CVPR, 2023"
LICENSE = "unknown for ObjectFolder-Real (CC BY 4.0 is stated for ObjectFolder 2.0)"
FACTS = Facts(
    "ObjectFolder-Real",
    CITATION,
    LICENSE,
    "https://github.com/objectfolder",
    "GelSight (T3 says black, Sparsh says Mini, AnyTouch files it with GelSlim)",
    None,
    "1,417,600 touch frames of 100 objects (counted by T3)",
    "object",
    {"touch, 50 images (T3)": ((0.46676, 0.45028, 0.45292), (0.08171, 0.06973, 0.08618))},
    group_column="object",
)
GENERATION_FACTS = Facts(
    "ObjectFolder-Real, visuo-tactile cross-generation",
    CITATION,
    LICENSE,
    "https://github.com/objectfolder/visuo-tactile-cross-generation",
    FACTS.sensor,
    None,
    "50,000 pairs: 1,000 of each of 50 objects (stated by the benchmark)",
    "object; of its two settings, cross-contact shares every object and cross-object none",
    group_column="object",
)
SENSOR = "GelSight"
METADATA = "objectfolder_real_metadata.csv"
MATERIALS = ("Ceramic", "Wood", "Steel", "Iron", "Plastic", "Glass", "Polycarbonate")
OBJECTS = 100
LIST = "split.json"
LOOKED_FOR = "<object>/tactile_data/<trial>/0/gelsight/"
GENERATION_LOOKED_FOR = "touch/, vision/ and touch_ref/ or vision_ref/"


def detect(source: Path) -> bool:
    """Whether a numbered folder holds ``tactile_data/``."""
    return source.is_dir() and any(
        (source / name / "tactile_data").is_dir() for name in subfolders(source) if name.isdecimal()
    )


def detect_generation(source: Path) -> bool:
    """Whether both sides and a folder of references are there."""
    there = lambda name: (source / name).is_dir()  # noqa: E731
    return there("touch") and there("vision") and (there("touch_ref") or there("vision_ref"))


def scan(source: Path, *, metadata: Path | None = None, progress: Progress = quiet) -> Scan:
    """Lists the pictures of all trials.

    Args:
        source: the folder of the objects.
        metadata: table of materials; default: ``objectfolder_real_metadata.csv`` in the source, if it is there.
        progress: told how many objects are read.

    Raises:
        PalpateError: if there is no object, or the table that was named is missing.
    """
    root = Path(source)
    require_folder(root, FACTS.name)
    every = subfolders(root)
    objects = [name for name in every if re.fullmatch("[0-9]+", name)]
    if not any((root / name / "tactile_data").is_dir() for name in objects):
        raise PalpateError(
            f"{root} must hold {LOOKED_FOR}", few(every), f"Fetch the data from {FACTS.url}"
        )
    facts = {
        "layout": "raw trials",
        "background": "first picture of the trial (inferred), which is no sample",
        "text_source": "none",
    }
    out = Scan([], root, facts=facts | {"vision": "none in this layout"})
    materials = _materials(root, metadata, out)
    for done, name in enumerate(objects):
        progress("reading objects", done, len(objects))
        _object(out, name, materials.get(int(name)) if materials else None)
    if odd := [name for name in every if name not in objects]:
        out.suspicious.append(
            Problem(
                str(root),
                "unknown-folder",
                f"folders that are no object's number are left out: {few(odd)}",
            )
        )
    if strange := [name for name in objects if not 1 <= int(name) <= OBJECTS]:
        out.suspicious.append(
            Problem(str(root), "unknown-object", f"objects outside 1 to {OBJECTS}: {few(strange)}")
        )
    if materials and (bare := [name for name in objects if int(name) not in materials]):
        out.suspicious.append(
            Problem(METADATA, "no-material", f"objects that the table lacks: {few(bare)}")
        )
    return out


def _object(out: Scan, name: str, material: str | None) -> None:
    """Adds the pictures of one object's trials."""
    place = f"{name}/tactile_data"
    trials = subfolders(out.base / place)
    if odd := [trial for trial in trials if re.fullmatch("[0-9]+", trial) is None]:
        out.suspicious.append(
            Problem(
                place,
                "unknown-folder",
                f"folders that are no trial's number are left out: {few(odd)}",
            )
        )
    trials = [trial for trial in trials if trial not in odd]
    if not trials:
        out.problems.append(Problem(place, "missing-folder", "the object has no trial"))
    lost = [trial for trial in trials if not (out.base / place / trial / "0" / "gelsight").is_dir()]
    if lost:
        out.problems.append(
            Problem(place, "missing-folder", f"trials without 0/gelsight: {few(lost)}")
        )
    single: list[str] = []
    for trial in (trial for trial in trials if trial not in lost):
        folder = f"{place}/{trial}/0/gelsight"
        found = numbered(out.base / folder, suffixes=(".png",))
        found = found if found.files else numbered(out.base / folder)
        tell(found, folder, out.problems, out.suspicious, steady=True)
        if not found.files:
            out.problems.append(Problem(folder, "missing-frames", "the trial has no picture"))
            continue
        (first, background), *_ = found.files.items()
        if len(found.files) == 1:  # it cannot be its own background
            single.append(trial)
        for k, file in found.files.items():
            if k != first or len(found.files) == 1:
                row = {
                    "id": f"{name}/{trial}/{k}",
                    "video": f"{name}/{trial}",
                    "frame": k,
                    "object": name,
                    "material": material,
                    "tactile": f"{folder}/{file}",
                    "background": None if k == first else f"{folder}/{background}",
                    "sensor": SENSOR,
                }
                out.rows.append((f"{folder}/{file}", row))
    if single:
        out.suspicious.append(
            Problem(
                place,
                "no-background",
                f"trials of one picture, which is kept as a sample: {few(single)}",
            )
        )


def _materials(root: Path, given: Path | None, out: Scan) -> dict[int, str]:
    """Object -> material from the table; empty without one.

    Raises:
        PalpateError: if the table that was named is missing, or has other columns.
    """
    path = Path(given) if given is not None else root / METADATA
    if not path.is_file():
        if given is None:
            return {}
        raise PalpateError(
            "The table of materials must exist",
            f"no file {path}",
            f"Fetch {METADATA} from github.com/alanzjl/t3",
        )
    reader = csv.reader(path.read_bytes().decode("utf-8-sig", errors="replace").splitlines())
    header = [cell.strip() for cell in next(reader, [])]
    if not {"Index", "Material"} <= set(header):
        raise PalpateError(
            f"{path} must have the columns Index, Name, Material",
            ", ".join(header) or "none",
            "Fetch it again",
        )
    index, column = header.index("Index"), header.index("Material")
    found: dict[int, str] = {}
    for cells in reader:
        where = f"{path}:{reader.line_num}"
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            out.problems.append(
                Problem(where, "bad-row", f"{len(cells)} cells under {len(header)} columns")
            )
        elif re.fullmatch(r"\s*[0-9]+\s*", cells[index]) is None or not cells[column].strip():
            out.problems.append(
                Problem(
                    where,
                    "bad-line",
                    f"{cells[index]!r}, {cells[column]!r} is no object and material",
                )
            )
        elif (before := found.setdefault(int(cells[index]), cells[column].strip())) != cells[
            column
        ].strip():
            out.problems.append(
                Problem(
                    where,
                    "two-labels",
                    f"object {cells[index].strip()} is {before} on an earlier line",
                )
            )
    if unknown := sorted(set(found.values()) - set(MATERIALS)):
        out.suspicious.append(
            Problem(
                str(path),
                "unknown-material",
                f"materials other than {', '.join(MATERIALS)}: {few(unknown)}",
            )
        )
    out.facts["materials"] = path.name
    return found


def scan_generation(source: Path, *, progress: Progress = quiet) -> Scan:
    """Pairs the pictures of the benchmark.

    Args:
        source: the folder with ``touch/`` and ``vision/``.
        progress: told how many objects are read.

    Raises:
        PalpateError: if a side is missing.
    """
    root = Path(source)
    require_folder(root, GENERATION_FACTS.name)
    if lacking := [side for side in ("touch", "vision") if not subfolders(root / side)]:
        raise PalpateError(
            f"{root} must hold {GENERATION_LOOKED_FOR}",
            f"no objects in {lacking[0]}/",
            f"See {GENERATION_FACTS.url}",
        )
    out = Scan([], root, facts={"layout": "cross-generation benchmark", "text_source": "none"})
    background = (
        "touch_ref/touch_ref.png" if (root / "touch_ref" / "touch_ref.png").exists() else None
    )
    if background is None:
        out.suspicious.append(
            Problem("touch_ref", "no-background", "no touch_ref.png: no sample has a background")
        )
    sides = {side: set(subfolders(root / side)) for side in ("touch", "vision")}
    ids: dict[tuple[str, str], str] = {}
    objects = sorted(sides["touch"] | sides["vision"], key=natural)
    for done, name in enumerate(objects):
        progress("reading objects", done, len(objects))
        touch, vision = (_contacts(root / side / name) for side in ("touch", "vision"))
        for side, mine, other in (("vision", vision, touch), ("touch", touch, vision)):
            if other and name not in sides[side]:
                out.problems.append(
                    Problem(
                        f"{side}/{name}",
                        "missing-folder",
                        f"no such folder, for {len(other)} contacts",
                    )
                )
            else:
                lost = (
                    f"{contact!r} of the object {name}" for contact in other if contact not in mine
                )
                out.problems += [
                    Problem(
                        f"{side}/{name}", "unpaired", f"no {side} picture of the contact {text}"
                    )
                    for text in lost
                ]
        for contact, file in touch.items():
            ids[name, contact] = f"{name}/{contact}"
            row = {
                "id": ids[name, contact],
                "object": name,
                "vision": f"vision/{name}/{vision.get(contact)}",
                "tactile": f"touch/{name}/{file}",
                "background": background,
                "sensor": SENSOR,
            }
            out.rows += [(row["tactile"] or "", row)] if contact in vision else []
    _splits(out, ids)
    return out


def write_lists(manifest: Manifest, split: Split, folder: Path) -> list[Path]:
    """Writes ``split.json``, ``{"train": [[object, contact], ..], "val": .., "test": ..}``; integers as such.

    Raises:
        PalpateError: if a touch does not lie in ``touch/<object>/``.
    """
    plain = lambda name: int(name) if re.fullmatch("0|[1-9][0-9]*", name) else name  # noqa: E731
    lists: dict[str, list[list[int | str]]] = {part: [] for part in PARTS}
    for part in split.counts():
        for name in manifest.part(split, part).column("tactile"):
            path = Path(str(name))
            if path.parent.parent.name != "touch":
                raise PalpateError(
                    "A list of the benchmark needs touches in touch/<object>/",
                    str(name),
                    "Write the split file alone",
                )
            lists[part].append([plain(path.parent.name), plain(path.stem)])
    write_json(Path(folder) / LIST, lists)
    return [Path(folder) / LIST]


def _contacts(folder: Path) -> dict[str, str]:
    """Contact -> file name, in order; a PNG goes before a copy in another form."""
    if not folder.is_dir():
        return {}
    names = [
        p.name
        for p in folder.iterdir()
        if p.suffix.lower() in SUFFIXES and not p.name.startswith(".") and not p.is_dir()
    ]
    found = {
        Path(name).stem: name
        for name in sorted(names, key=lambda n: (n.lower().endswith(".png"), n))
    }
    return {stem: found[stem] for stem in sorted(found, key=natural)}


def _splits(out: Scan, ids: Mapping[tuple[str, str], str]) -> None:
    """The parts of every JSON list at the root."""
    lists = {}
    for path in sorted(out.base.glob("*.json")):
        before = len(out.problems)
        entries = read_pairs(path, out.problems)
        if entries is not None:
            lists[path] = entries
        elif len(out.problems) == before:
            out.suspicious.append(
                Problem(
                    str(path),
                    "unknown-file",
                    'not {"train|val|test": [[object, contact], ..]}: left aside',
                )
            )
    for path, entries in lists.items():
        name = "Orig" if len(lists) == 1 else path.stem
        out.parts[name] = assign(
            path, [(entry, (entry.first, entry.second)) for entry in entries], ids, out.problems
        )
        out.rules[name] = {"method": "official", "files": [path.name]}
        if rest := len(ids) - len({(e.first, e.second) for e in entries} & set(ids)):
            out.suspicious.append(
                Problem(str(path), "unlisted", f"{rest} of {len(ids)} touches are in no part")
            )
