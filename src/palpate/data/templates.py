"""Path templates: where the images of anyone's folder are, e.g. ``{object}/photo/{frame}.jpg``.

==============  ====================================================================================
in a template   matches
==============  ====================================================================================
``{name}``      one or more characters of one name; the earlier field takes as many as it can
``{name:d}``    all digits of a number (``0007`` is 7); the field ``frame`` is always one
``{name:**}``   any number of folders, also none
``{a|b}``       one of these words
``{time}``      the same as the first: a time stamp, by which sides are joined to the nearest
``*``  ``**``   the same as the first and the last, but not kept
==============  ====================================================================================

Everything else is literal. A field that occurs twice is equal in both places. Where the last
name has no dot, any suffix goes: ``{frame}`` is ``{frame}.*``.
"""

from __future__ import annotations

import os
import re
import unicodedata
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

from palpate.core import PalpateError, Problem, require
from palpate.data.manifest import CLIMBS, DIGITS, IMAGE_COLUMNS

_TOKEN = re.compile(
    r"(?<![^/])(?:\*\*|\{(?P<deep>\w+):\*\*\})(?P<end>/|$)"
    r"|\{(?P<field>\w+)(?::(?P<spec>[^{}]*))?\}|\{(?P<words>[^{}|]+(?:\|[^{}|]+)+)\}"
    r"|(?P<star>\*+)|(?P<literal>[^{}*]+)|(?P<wrong>.)"
)
#: The field of a time stamp.
TIME = "time"
FIX = "Write fields as {object}, {frame:d} or {video:**}, and * for what does not matter"
#: Field -> value, in the order of the template.
Fields = dict[str, str]
#: (path below the root, fields) of the files that match, in the order of the walk.
Matches = Sequence[tuple[str, Fields]]


@dataclass(frozen=True)
class Template:
    """A path with fields; see the module."""

    text: str  # as it was written
    fields: tuple[str, ...]  # names in the order of the path
    digits: frozenset[str]  # those that are numbers
    pattern: re.Pattern[str]  # of a whole path below the root
    letters: int  # how many characters stand for themselves

    @classmethod
    def parse(cls, text: str, argument: str | None = None) -> Template:
        """Read a template.

        Args:
            text: the template.
            argument: the name of the argument that holds it, for errors.

        Raises:
            PalpateError: if it is empty, leaves the root, or has a field that cannot be read or
                is named like the column of the paths themselves.
        """
        path = unicodedata.normalize("NFC", text.removeprefix("./"))

        def wrong(must: str, got: str) -> PalpateError:
            clause = must if argument else f"A template {must}"
            return PalpateError(clause, got, FIX, argument=argument)

        if not path.strip() or path.endswith("/") or re.search(CLIMBS, path):
            raise wrong("must be a path below the folder", repr(text))
        pieces: list[str] = []
        specs: dict[str, str] = {}
        before = "literal"  # what the piece before is
        for token in _TOKEN.finditer(path):
            name, spec = token["deep"] or token["field"], "**" if token["deep"] else token["spec"]
            spec = "d" if name == "frame" and not spec else spec or ""
            spec = "t" if name == TIME and not spec else spec
            readable = spec in ("", "d", "t", "**") and (not name or name.isidentifier())
            if token["wrong"] or not readable:
                raise wrong("must have fields that can be read", f"{token[0]!r} in {text!r}")
            if name in IMAGE_COLUMNS:
                must = f"must have fields other than {', '.join(IMAGE_COLUMNS)}"
                raise wrong(must, f"{token[0]!r} in {text!r}")
            written = token["literal"] or token["words"]
            kind = "literal" if written else "end" if token["end"] else spec or "any"
            if before == kind == "any":
                got = f"{token[0]!r} right after another in {text!r}"
                raise wrong("must have a sign between fields", got)
            if name and name in specs:
                pieces.append(f"(?P={name})")
            else:
                pieces.append(_piece(token, name, spec, loose=before in ("any", "d")))
                specs |= {name: spec} if name else {}
            before = kind
        last = path.rpartition("/")[2]
        if "." not in re.sub(r"\{\w+:?[^{}]*\}", "", last) and not last.endswith("*"):
            pieces.append(r"\.[^/]*" if not last.endswith(":**}") else "")
        digits = frozenset(name for name, spec in specs.items() if spec == "d")
        pattern = re.compile("".join(pieces), re.DOTALL)
        written = ((t["literal"], t["words"] or "") for t in _TOKEN.finditer(path))
        letters = sum(len(text or min(words.split("|"), key=len)) for text, words in written)
        return cls(path, tuple(specs), digits, pattern, letters)

    def match(self, path: str) -> Fields | None:
        """The fields of a path below the root, numbers without leading zeros; None if it differs.

        Letters are in their composed form (NFC), in which systems write them differently.

        A field of folders that matches none is left out.
        """
        match = self.pattern.fullmatch(unicodedata.normalize("NFC", path))
        if match is None:
            return None
        values = {name: value for name, value in match.groupdict().items() if value is not None}
        for name in self.digits:
            values[name] = str(int(values[name]))
        return values


def _piece(token: re.Match[str], name: str | None, spec: str, *, loose: bool) -> str:
    """The pattern of a token."""
    if token["literal"]:
        return re.escape(token["literal"])
    if token["words"]:
        return f"(?:{'|'.join(map(re.escape, token['words'].split('|')))})"
    if token["star"]:
        return "[^/]*"
    group = f"(?P<{name}>" if name else "(?:"
    if spec == "t":
        return f"{group}[0-9]+(?:\\.[0-9]+)?)"
    if spec == "d":
        return f"{'(?<![0-9])' * loose}{group}[0-9]{{1,{DIGITS}}})(?![0-9])"
    if token["end"] is None:
        return f"{group}[^/]+)"
    return f"(?:{group}.+)/)?" if token["end"] else f"{group}.+)"


def walk(root: Path, suffixes: tuple[str, ...] = ("",)) -> tuple[list[str], list[str]]:
    """All files below a folder, in the order of their names; hidden ones are skipped.

    Links to folders are followed, wherever they lead: the user named the folder that holds them.

    Returns:
        Paths below the root, and links to folders that were read already (circles too).
    """
    files: list[str] = []
    again: list[str] = []
    seen: set[str] = set()
    for folder, below, names in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        relative = os.path.relpath(folder, root).replace(os.sep, "/")
        prefix = "" if relative == "." else f"{relative}/"
        if real in seen:
            again.append(relative)
            below.clear()
            continue
        seen.add(real)
        below[:] = sorted(name for name in below if not name.startswith("."))
        names = (n for n in sorted(names) if not n.startswith(".") and n.lower().endswith(suffixes))
        files += [prefix + name for name in names]
    return files, again


def assign(files: Sequence[str], templates: Mapping[str, Template]) -> dict[str, Matches]:
    """The files of each template; of several that match, the one that spells out most has it."""
    matches: dict[str, list[tuple[str, Fields]]] = {side: [] for side in templates}
    for path in files:
        fields = {side: template.match(path) for side, template in templates.items()}
        fields = {side: values for side, values in fields.items() if values is not None}
        most = max((templates[side].letters for side in fields), default=0)
        for side, values in fields.items():
            if templates[side].letters == most:
                matches[side].append((path, values))
    return dict(matches)


def join(
    sides: Mapping[str, Matches], optional: Sequence[str] = ("background",)
) -> tuple[list[Fields], list[Problem]]:
    """Join the files of several templates by their equal fields.

    Several files of one side may share one of the other (a photo of an object, a background of a
    video); where both sides have several for the same fields, no row is made. Files with the field
    ``time`` are joined to the nearest, within half a step of the slower side.

    Args:
        sides: column -> its files; the first decides the order of the rows.
        optional: columns whose file a row may lack.

    Returns:
        Rows with all fields and the path of each column, and what has no partner or too many.
    """
    (first, matches), *further = sides.items()
    rows = [fields | {first: path} for path, fields in matches]
    problems: list[Problem] = []
    for side, matches in further:
        shared = {name for row in rows for name in row} - set(sides)
        shared &= {name for _, fields in matches for name in fields}
        keys = tuple(sorted(shared - {TIME}))
        must = "Templates must share a field, which says what belongs together"
        got = f"none for {len(rows)} files of {first} and {len(matches)} of {side}"
        fix = "Give one part of both paths the same field"
        require(bool(shared) or len(rows) <= 1 or len(matches) <= 1, None, must, got, fix=fix)
        partners = _by_key([(fields, path) for path, fields in matches], keys)
        alone = _by_key([(row, row[first]) for row in rows], keys)
        for key in partners.keys() - alone.keys() if side not in optional else ():
            text = f"no {first} image {_named(keys, key)}"
            problems += [Problem(path, "unpaired", text) for _, path in partners[key]]
        near: dict[str, tuple[tuple[Fields, str], str]] = {}
        for key in alone if TIME in shared else ():
            near |= _nearest(alone[key], partners.get(key, []))
        joined: list[Fields] = []
        for row in rows:
            key = tuple(map(row.get, keys))
            files, far = partners.get(key, []), ""
            if row[first] in near:
                nearest, far = near[row[first]]
                files = [] if far else [nearest]
            if len(files) > 1 and len(alone[key]) > 1:
                text = f"{len(alone[key])} {first} and {len(files)} {side} images"
                text += f" {_named(keys, key)}; a further field must distinguish them"
                problems.append(Problem(row[first], "ambiguous", text))
            elif not files and side not in optional:
                text = f"no {side} image {_named(keys, key)}{far}"
                problems.append(Problem(row[first], "unpaired", text))
            else:
                joined += [fields | row | {side: path} for fields, path in files] or [row]
        rows = joined
    return rows, sorted(problems, key=lambda problem: problem.where)


def _nearest(
    rows: Sequence[tuple[Fields, str]], files: Sequence[tuple[Fields, str]]
) -> dict[str, tuple[tuple[Fields, str], str]]:
    """Path of a row -> the file nearest in time, and in words why it is too far, if it is."""
    mine, theirs = ([float(fields[TIME]) for fields, _ in some] for some in (rows, files))
    steps = [median(b - a for a, b in pairwise(sorted(t))) for t in (mine, theirs) if len(t) > 1]
    most = 0.505 * max(steps, default=0)
    order = sorted(range(len(files)), key=theirs.__getitem__)
    times = [theirs[k] for k in order]
    near: dict[str, tuple[tuple[Fields, str], str]] = {}
    for (_, path), time in zip(rows, mine, strict=True) if files else ():
        k = bisect_left(times, time)
        best = min(range(max(0, k - 1), min(k + 1, len(times))), key=lambda j: abs(times[j] - time))
        away = abs(times[best] - time)
        far = f" within {most:.3g} of its time; the nearest is {away:.3g} away" * (away > most)
        near[path] = files[order[best]], far
    return near


def _by_key(
    items: Sequence[tuple[Fields, str]], keys: tuple[str, ...]
) -> dict[tuple[str | None, ...], list[tuple[Fields, str]]]:
    groups: dict[tuple[str | None, ...], list[tuple[Fields, str]]] = defaultdict(list)
    for fields, path in items:
        groups[tuple(map(fields.get, keys))].append((fields, path))
    return dict(groups)


def _named(keys: Sequence[str], values: Sequence[str | None]) -> str:
    """``with object=cup, frame=7``."""
    pairs = zip(keys, values, strict=True)
    return "with " + (", ".join(f"{key}={value}" for key, value in pairs) or "the same fields")
