"""The templates of a folder, found from the names of its files.

Names are cut into words, numbers and signs. A word such as ``photo`` or ``gelsight`` that occurs in
some paths and not in others gives their side. Without these words the paths of both sides are read
as one: what they have in common is written out; what varies, on one side or between both, becomes a
field, so a name that one side has alone is a field with one value there, and no partner of all:

- digits at the end of file names are the ``frame``;
- a word before what varies names it (``press_3``: ``contact``), else its values do (``train``,
  ``Wood``);
- a name before frames that begin anew for each such name within a video is that of a ``contact``;
- of the other folders the innermost is the ``video`` of the images in it and the one around it the
  ``object``; folders at several depths are one ``video``.

Where the sides are built differently (one photo for many touches), the names of the one are the
first of the other. The templates hold if they join most files, and no photo of one frame with the
touches of several. The second half reads a folder by its templates, be they given or found.
"""

from __future__ import annotations

import contextlib
import posixpath
import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

from palpate.core import PalpateError, few, require
from palpate.data.captions import ADJECTIVES
from palpate.data.foreign import counted
from palpate.data.manifest import DIGITS, PART_NAMES, ROLE_OF, ROLES, SCHEMA, SIDES
from palpate.data.scanning import Cells, Scan
from palpate.data.suspicions import other_clocks
from palpate.data.templates import TIME, Fields, Matches, Template, assign, join, walk

Side = Literal["vision", "tactile"]
#: Columns of files; the first one that is there decides the order of rows.
ORDER = ("tactile", "vision", "background")
#: What may be mapped.
TARGETS = (*SCHEMA, "split")
#: Words that say what an image shows if no other does, and words of any image.
_WEAK: dict[str, str] = dict.fromkeys(("image", "images", "img", "pictures"), "vision")
_SAYING = {*ROLE_OF, *_WEAK, "frame", "frames"}
#: What names one of several cameras or sensors, next to a word of its side.
_UNIT = re.compile(r"(?i)(?:[0-9]+|[a-z]|left|right|mini|realsense)(?:[_\-. ]|$)")
MEANING = {
    "video": ("video", "clip", "seq", "sequence", "recording", "rec", "run", "take", "trial"),
    "contact": ("contact", "press", "touch", "grasp", "tap", "poke", "interaction"),
    "object": ("object", "obj", "item"),
    "material": ("material", "mat", "class", "category"),
    "session": ("session", "day", "date"),
    "sensor": ("sensor", "gelsight", "digit", "gel"),
    "frame": ("frame", "img", "image"),
}
_MEANING_OF = {word: column for column, words in MEANING.items() for word in words}
_MATERIALS = {name.lower() for name in ADJECTIVES}
_TOKEN = re.compile(r"[A-Za-z]+|[0-9]+|[^A-Za-z0-9]")
#: A time stamp at the end of a name, and what replaces it.
_TIMED, _TIME = re.compile(r"(?:[0-9]{9,}(?:\.[0-9]+)?|[0-9]+\.[0-9]+)(?=\.\w+$)"), "\ue001"
#: In place of a name that says nothing but its side.
_ROLE = "\ue000"
#: A field of a template.
_MARK = re.compile(r"\{(\w+)[^{}]*\}")


def detect_layout(files: Sequence[str], folder: str) -> dict[str, str]:
    """Column -> template of the images below a folder; empty if their names do not say it.

    Args:
        files: paths below it, at least one.
        folder: its name, which may say what its only side shows.
    """
    files = [unicodedata.normalize("NFC", path) for path in files]
    for timed in (False, True):
        paths = [_TIMED.sub(_TIME, path) for path in files] if timed else files
        names = _Names(paths, folder)
        for texts in names.readings():
            if timed:
                texts = {
                    side: text.replace(_TIME, f"{{{TIME}}}").replace("{sample}", "{video}")
                    for side, text in texts.items()
                }
            both = all(f"{{{TIME}}}" in texts.get(side, "") for side in SIDES)
            if (both or not timed) and _fit(files, texts):
                return texts
    return {}


class _Names:
    """The paths of a folder as names, by the side that a word gives them."""

    def __init__(self, files: Sequence[str], folder: str) -> None:
        #: (which folder, which token of its name, the word there) that all paths have.
        self.shared = {
            (depth, *word)
            for depth, names in enumerate(zip(*map(_names, files), strict=False))
            for word in set.intersection(*({*enumerate(_tokens(name))} for name in {*names}))
        }
        self.silent = ""  # the side whose files no word gives
        self.sides = self._by_role(files, folder)

    def _saying(self, depth: int, name: str) -> list[str]:
        """The tokens of a name in lower case, empty where all paths have it."""
        return [t * ((depth, k, t) not in self.shared) for k, t in enumerate(_tokens(name))]

    def _by_role(self, files: Sequence[str], folder: str) -> dict[str, list[str]]:
        """Side -> its files, by words that some have and others have not; else by a word of all.

        Files without such a word are the other side.
        """
        sides: dict[str, list[str]] = defaultdict(list)

        @cache
        def words(depth: int, name: str) -> list[str]:
            return [word for word in self._saying(depth, name) if word in ROLE_OF or word in _WEAK]

        for path in files:
            saying = [
                word for depth, name in enumerate(_names(path)) for word in words(depth, name)
            ]
            strong = [ROLE_OF[word] for word in saying if word in ROLE_OF]
            weak = [_WEAK[word] for word in saying if word in _WEAK]
            # The picture of an empty gel may lie in the folder of the tactile images.
            side = "background" if "background" in strong else (strong or weak or [""])[-1]
            sides[side].append(path)
        plain = sides.pop("", [])
        if not sides:
            every = [word for *_, word in self.shared]
            for some, by in ((every, ROLE_OF), (every, _WEAK), (_tokens(folder), ROLE_OF)):
                roles = {by[word] for word in some if word in by}
                if len(roles) == 1:
                    return {min(roles): plain}
        if plain and len(named := sides.keys() & {*SIDES}) == 1:
            self.silent = "tactile" if "vision" in named else "vision"
            sides[self.silent] = plain
        return {side: sides[side] for side in ROLES if side in sides}

    def readings(self) -> Iterator[dict[str, str]]:
        """Templates of the sides, by the names of both, then by those of either."""
        main = [side for side in self.sides if side != "background"]
        several = any(map(_several, self.sides.values()))
        for units in (False, True)[: len(main)]:
            bare = {side: self._bare(side, units) for side in self.sides}
            for basis in (main, *([side] for side in main[::-1]))[: 2 * len(main)]:
                paths = dict.fromkeys(f"{path}.x" for side in basis for path in bare[side])
                template = template_of([*paths], several).removesuffix(".x")
                texts = {side: self._faced(template, side, units) for side in self.sides}
                if all(texts[side] for side in main):
                    yield {side: text for side, text in texts.items() if text}

    def _bare(self, side: str, units: bool) -> list[str]:
        """The paths of a side without what only says their side."""

        @cache
        def bare(depth: int, name: str, folder: bool) -> str:
            return "".join(name[c] for c in self._kept(depth, name, units and folder)) or _ROLE

        return [
            "/".join(bare(depth, name, depth + 1 < len(names)) for depth, name in enumerate(names))
            for names in map(_names, self.sides[side])
        ]

    def _kept(self, depth: int, name: str, units: bool) -> list[int]:
        """The characters of a name that say more than its side; maybe without those of a unit."""
        says = [word in _SAYING for word in self._saying(depth, name)]
        if not any(says):
            return [*range(len(name))]
        tokens = [*_TOKEN.finditer(name)]
        kept: list[re.Match[str]] = []
        for k, token in enumerate(tokens):
            if says[k]:
                kept = kept[:-1] if kept and not kept[-1][0].isalnum() else kept
            elif kept or token[0].isalnum() or not k or not says[k - 1]:
                kept.append(token)
        rest = "".join(token[0] for token in kept).strip("_-. ")
        kept = [] if not rest or (units and _UNIT.fullmatch(rest)) else kept
        return [c for token in kept for c in range(*token.span())]

    def _faced(self, template: str, side: str, units: bool) -> str:
        """The template of a side whose names face those of a bare template, or nothing."""
        files = self.sides[side]
        names = _names(max(files, key=lambda path: path.count("/")))
        bare, places, start = list[str](), list[int](), 0
        for depth, name in enumerate(names):
            kept = self._kept(depth, name, units and depth + 1 < len(names))
            bare.append("".join(name[c] for c in kept) or _ROLE)
            places += [start + c for c in (kept or [0])] + [start + len(name)]
            start += len(name) + 1
        text, path = "/".join(bare), "/".join(names)
        for own in _facing(template.split("/"), bare, side == self.silent):
            if match := Template.parse(f"{own}.x").pattern.fullmatch(f"{text}.x"):
                break
        else:
            return ""
        pieces, after = list[str](), 0
        marks = {mark[1]: mark[0] for mark in _MARK.finditer(own)}
        for (first, last), name in sorted((match.span(n), n) for n in marks if match[n]):
            a, b = places[first], places[last - 1] + 1
            if path[a:b] != text[first:last]:
                return ""  # a word of the side is within a field
            pieces += [_literal(path[after:a]), marks[name]]
            after = b
        own_names = "".join([*pieces, _literal(path[after:])]).split("/")
        for k, name in enumerate(bare) if len(own_names) == len(bare) else ():
            same = {other[k] for other in map(_names, files) if len(other) == len(bare)}
            if name == _ROLE and len(same) > 1:  # left and right, two sensors, or two words
                before, _, end = _affixes(sorted(same))
                words = "|".join(map(_literal, sorted(same)))
                units = bool(before or end) or all(
                    _MEANING_OF.get(name) == "sensor" for name in same
                )
                own_names[k] = f"{before}{{sensor}}{end}" if units else f"{{{words}}}"
        return "/".join(own_names) + _suffix(files)


def _facing(template: list[str], names: list[str], silent: bool) -> Iterator[str]:
    """What of a bare template the names of another side may face, the whole of it first."""
    yield "/".join(template)
    if silent and len(names) == len(template):
        pairs = zip(template, names, strict=True)
        yield "/".join(_literal(name) if piece == _ROLE else piece for piece, name in pairs)
    saying = [k for k, name in enumerate(names) if name != _ROLE]
    pieces = [piece for piece in template if piece != _ROLE]
    if saying and len(saying) <= len(pieces):
        own = dict(zip(saying, pieces, strict=False))
        last = own[saying[-1]]
        for end in (len(last), *(mark.end() for mark in [*_MARK.finditer(last)][::-1])):
            own[saying[-1]] = last[:end]
            yield "/".join(own.get(k, _ROLE) for k in range(len(names)))
    elif not saying:
        yield "/".join(names)


def _suffix(files: Sequence[str]) -> str:
    suffixes = {posixpath.splitext(path)[1] for path in files}
    return min(suffixes) if len(suffixes) == 1 else ".*"


def _names(path: str) -> list[str]:
    """The folders of a path, and the name of its file without the suffix."""
    return posixpath.splitext(path)[0].split("/")


def _tokens(text: str) -> list[str]:
    return [token.lower() for token in _TOKEN.findall(text)]


def _several(files: Sequence[str]) -> bool:
    """Whether a folder holds several of the files."""
    return len({path.rpartition("/")[0] for path in files}) < len(files)


def template_of(files: Sequence[str], several: bool | None = None) -> str:
    """The template of the paths of one side.

    Args:
        files: the paths.
        several: whether a folder holds several images of a side; default: of this one.
    """
    several = _several(files) if several is None else several
    places = [path.split("/") for path in files]
    folders = [parts[:-1] for parts in places]
    names = [posixpath.splitext(parts[-1]) for parts in places]
    fields: set[str] = set()
    pieces = _folders(folders, fields)
    free = [k for k, piece in enumerate(pieces) if piece is None]
    named = ["object"] if fields & {"video", "contact"} else ["video" if several else "sample"]
    for k in free if named == ["object"] else reversed(free):
        pieces[k] = f"{{{_new(fields, *named, 'object', f'folder_{k + 1}')}}}"
    stem = _stem([stem for stem, _ in names], fields)
    text = "/".join([*map(str, pieces), stem + _suffix(files)])
    text = re.sub(r"\**(\{\w+\})\**", r"\1", text)  # a field takes what is next to it
    text = re.sub(r"(?:\{\w+\}){2,}", _one_field, text)
    return _with_contacts(text, files) if {"video", "name", "frame"} <= fields else text


def _one_field(fields: re.Match[str]) -> str:
    """One field in place of several that no sign separates."""
    names = re.findall(r"\w+", fields[0])
    return f"{{{next((name for name in ('video', 'object') if name in names), names[0])}}}"


def _with_contacts(text: str, files: Sequence[str]) -> str:
    """The template where a name whose frames begin anew is that of a contact."""
    template = Template.parse(text)
    rows = [template.match(path) or {} for path in files]
    again = len({(row.get("video"), row.get("frame")) for row in rows}) < len(rows)
    return text.replace("{name}", "{contact}") if again and "contact" not in text else text


def _new(fields: set[str], *names: str) -> str:
    """The first of some names that is no field yet."""
    name = next(name for name in names if name not in fields)
    fields.add(name)
    return name


def _folders(folders: Sequence[Sequence[str]], fields: set[str]) -> list[str | None]:
    """The pieces of the folders; None for one that no word and no value names."""
    if len(set(map(len, folders))) > 1:
        first = posixpath.commonprefix([list(names) for names in folders])
        last = posixpath.commonprefix([list(names[len(first) :][::-1]) for names in folders])
        fields.add("video")
        return [*map(_literal, first), "{video:**}", *map(_literal, reversed(last))]
    pieces: list[str | None] = []
    for values in zip(*folders, strict=True):
        before, middles, after = _affixes(values)
        column = _column(before, middles)
        if not middles:
            pieces.append(before)
        elif column in fields or not column:
            pieces.append(None)
        else:
            pieces.append(f"{before}{{{_new(fields, column)}}}{after}")
    return pieces


def _column(before: str, middles: Sequence[str]) -> str:
    """What a varying part of a name is: by the word before it, else by its values."""
    words = [word for word in _tokens(before) if word.isalpha()]
    if words and words[-1] in _MEANING_OF:
        return _MEANING_OF[words[-1]]
    values = {middle.lower() for middle in middles}
    if values and values <= PART_NAMES.keys():
        return "split"
    return "material" if values and values <= _MATERIALS else ""


def _stem(stems: Sequence[str], fields: set[str]) -> str:
    """The piece of the file names, without their suffix."""
    before, middles, after = _affixes(stems)
    if not middles:
        return "{frame:d}" if re.fullmatch("[0-9]{1,18}", before) else before
    if aligned := _aligned(list(dict.fromkeys(stems)), fields):
        return aligned
    numbered = [re.fullmatch(r"(.*?)([_\-. ]?)([0-9]{1,18})", middle) for middle in middles]
    heads = [match[1] for match in numbered if match]
    signs = {match[2] for match in numbered if match}
    if all(numbered) and len(signs) == 1 and "" not in heads and 2 * len(set(heads)) <= len(stems):
        first, some, last = _affixes(heads)
        kind = "video" if any(re.search("[0-9]", head) for head in heads) else "object"
        head = f"{first}{{{_new(fields, kind, 'name')}}}{last}" if some else first
        return f"{before}{head}{min(signs)}{{frame:d}}{after}"
    return f"{before}{{name}}{after}"


def _aligned(stems: Sequence[str], fields: set[str]) -> str:
    """The piece of names with the same words, numbers and signs in a row; else an empty text."""
    lists = [_TOKEN.findall(stem) for stem in stems]
    if len(set(map(len, lists))) > 1:
        return ""
    columns = [dict.fromkeys(tokens) for tokens in zip(*lists, strict=True)]
    varying = [k for k, values in enumerate(columns) if len(values) > 1]
    kinds = {k: {token.isdecimal() for token in columns[k]} for k in varying}
    if any(len(kinds[k]) > 1 or not all(map(str.isalnum, columns[k])) for k in varying):
        return ""
    pieces: list[str] = []
    word = ""
    for k, values in enumerate(columns):
        token = next(iter(values))
        if k not in kinds:
            pieces.append(_literal(token))
            word = token if token.isalpha() else "" if token.isdecimal() else word
            continue
        number = kinds[k] == {True} and max(map(len, values)) <= DIGITS
        column = _column(word, list(values))
        if number and (k == varying[-1] or column == "frame") and column in ("", "frame", *fields):
            pieces.append(f"{{{_new(fields, 'frame', 'number')}:d}}")
        else:
            names = (
                column,
                "video" if number else "object",
                "name",
                *map("name_{}".format, range(k)),
            )
            pieces.append(f"{{{_new(fields, *filter(None, names))}}}")
        word = ""
    return "".join(pieces)


def _affixes(values: Sequence[str]) -> tuple[str, list[str], str]:
    """(what all values begin with, what varies, what all end with), cut between words and numbers.

    Equal values have no middle. Signs of templates are written as ``*``.
    """
    distinct = [_TOKEN.findall(value) for value in dict.fromkeys(values)]
    if len(distinct) == 1:
        return _literal(values[0]), [], ""
    p, s = (len(posixpath.commonprefix([t[::step] for t in distinct])) for step in (1, -1))
    for first, last in ((p, s), (0, s), (p, 0), (0, 0)):
        middles = ["".join(tokens[first : len(tokens) - last]) for tokens in distinct]
        if all(len(tokens) > first + last for tokens in distinct):
            tokens = distinct[0]
            after = "".join(tokens[len(tokens) - last :])
            return _literal("".join(tokens[:first])), middles, _literal(after)
    return "", list(values), ""


def _literal(text: str) -> str:
    return re.sub(r"[{}*]+", "*", text)


def walked(result: Scan, suffixes: tuple[str, ...]) -> list[str]:
    """The files of these suffixes below the root; what else lies there is counted.

    Names that are not UTF-8, which no table can hold, are reported.
    """
    every, again = walk(result.base)
    files, rest = list[str](), list[str]()
    for name in every:
        (files if name.lower().endswith(suffixes) else rest).append(name)
    for name in (odd := [f for f in files if re.search("[\ud800-\udfff]", f)]):
        result.problem(ascii(name), "bad-encoding", "the name of the file is not UTF-8")
    files = [name for name in files if name not in odd] if odd else files
    text = "links to folders that are read already"
    result.suspect(result.base, "linked-twice", text, again)
    dead = [name for name in rest if not (result.base / name).exists()]
    result.suspect(result.base, "dead-link", "links that lead nowhere", dead)
    text = "files that are not read"
    result.suspect(result.base, "unread", text, counted(rest))
    result.met = True
    return files


def parsed(texts: Mapping[str, str]) -> dict[str, Template]:
    """Templates by column, in the order in which their files give rows."""
    return {column: Template.parse(texts[column], column) for column in ORDER if column in texts}


def joined(
    result: Scan,
    files: Sequence[str],
    templates: Mapping[str, Template],
    matches: Mapping[str, Matches],
    kind: str,
) -> tuple[list[Fields], tuple[str, ...]]:
    """Rows of the files of all templates, and their fields; what is odd is reported.

    ``files`` should all be of a template; ``kind``, what they are, is for messages.
    """
    rows, problems = join({column: matches[column] for column in templates})
    result.problems += problems
    used = {path for found in matches.values() for path, _ in found}
    unmatched = [path for path in files if path not in used]
    result.suspect(result.base, "unmatched", f"{kind} of no template", unmatched)
    odd = [path for path in files if not unicodedata.is_normalized("NFC", path)]
    text = "names in the other form of letters (NFD), which are compared as composed ones"
    result.suspect(result.base, "other-letters", text, odd)
    result.facts |= {f"template_{column}": template.text for column, template in templates.items()}
    fields = tuple(dict.fromkeys(name for t in templates.values() for name in t.fields))
    if TIME in fields and len(templates) > 1:
        pairs = {path for row in rows for path in row.values()} | {p.where for p in problems}
        text = "within half a step of the slower side; files that are nearest to none"
        text = f"images are paired by time, {text}: {len(used - pairs)}"
        result.suspect(result.base, "paired-by-time", text)
    result.suspicious += [] if TIME in fields else other_clocks(matches)
    result.more = tuple(name for name in fields if name not in TARGETS)
    return rows, fields


def templates_of(
    files: Sequence[str],
    folder: Path,
    side: Side | None,
    kind: str = "images",
    renamed: Callable[[Mapping[str, str]], dict[str, str]] = dict,
) -> dict[str, str]:
    """The templates that the names of files below a folder suggest; ``side`` if all show one thing.

    ``kind``, what the files are, is for errors; ``renamed`` changes the names of fields.
    """
    require(bool(files), None, f"{folder} must hold {kind}", "none", fix="Check the path")
    must = f"The names of the {kind} in {folder} must say what they show"
    if side is None and (templates := detect_layout(files, folder.resolve().name)):
        return renamed(templates)
    names = _Names(files, folder.resolve().name)
    if side is not None:
        own = names.sides.get(side, [])
        if names.sides.keys() >= {*SIDES} and not names.silent:
            must = "must be left out where names say both sides"
            got = f"{side!r}, which the names of {len(own)} of {len(files)} {kind} say"
            choices = [renamed({side: template_of(own)})]
            raise PalpateError(must, got, "Leave it out", argument="side", choices=choices)
        return renamed({side: template_of(files)})
    sides = {s: files for s, files in names.sides.items() if s in SIDES}
    if sides:
        choices = [{side: template_of(files)} for side, files in sides.items()]
        got = f"{few(files)}, of which few share their names"
    else:
        every = template_of(files)
        choices = [{"tactile": every}, {"vision": every}]
        got = f"{few(files)}, without a word like {ROLES['vision'][0]} or {ROLES['tactile'][0]}"
    raise PalpateError(must, got, "Choose one of these", choices=[*map(renamed, choices)])


def _fit(files: Sequence[str], templates: Mapping[str, str]) -> bool:
    """Whether templates join most of the files of a side, a frame of one with one of the other."""
    matches = assign(files, {side: Template.parse(text) for side, text in templates.items()})
    with contextlib.suppress(PalpateError):
        rows, _ = join(matches)
        both = [side for side in SIDES if side in matches]
        numbered = len(both) == 2 and all("{frame" in templates[side] for side in both)
        sides = {*matches, "sensor"}  # several sensors may share a photo
        samples = len({tuple(v for n, v in row.items() if n not in sides) for row in rows})
        shared = numbered and any(len({row[s] for row in rows}) < samples for s in both)
        equal = len({*templates.values()}) < len(templates)
        return not (shared or equal) and 2 * len(rows) >= min(len(matches[side]) for side in both)
    return False


def name_apart(rows: Sequence[Cells], fields: Sequence[str]) -> None:
    """Name a video or contact by the fields before it, too, where its name alone means several."""
    outer = ("object", "session", "material")
    for column, around in (("video", outer), ("contact", ("video", *outer))):
        before = fields[: fields.index(column)] if column in fields else ()
        named = [row for row in rows if column in row]
        names: list[str] = []  # those that distinguish what earlier ones do not
        count = len({row[column] for row in named})
        for name in (name for name in around if name in before):
            several = len({tuple(map(row.get, (column, *names, name))) for row in named})
            names, count = ([*names, name], several) if several > count else (names, count)
        for row in named:
            row[column] = "/".join([*(row[name] for name in names if name in row), row[column]])
