"""The templates of a folder, found from the names of its files.

Names are cut into words, numbers and signs. A word such as ``photo`` or ``gelsight`` that occurs in
some paths and not in others gives their side. What the paths of a side have in common is written
out; what varies becomes a field:

- digits at the end of file names are the ``frame``;
- a word before what varies names it (``press_3``: ``contact``), else its values do (``train``,
  ``Wood``);
- a name before frames that begin anew for each such name within a video is that of a ``contact``;
- of the other folders the innermost is the ``video`` of the images in it and the one around it the
  ``object``; folders at several depths are one ``video``.

The second half reads a folder by its templates, be they given or found.
"""

from __future__ import annotations

import contextlib
import posixpath
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from palpate.core import PalpateError, few, require
from palpate.data.captions import ADJECTIVES
from palpate.data.foreign import counted
from palpate.data.manifest import DIGITS, PART_NAMES, ROLE_OF, ROLES, SCHEMA
from palpate.data.scanning import Cells, Scan
from palpate.data.templates import TIME, Fields, Matches, Template, assign, join, walk

Side = Literal["vision", "tactile"]
SIDES = ("vision", "tactile")
#: Columns of files; the first one that is there decides the order of rows.
ORDER = ("tactile", "vision", "background")
#: What may be mapped.
TARGETS = (*SCHEMA, "split")
#: Words that say what an image shows if no other does.
_WEAK = {"image": "vision", "images": "vision", "img": "vision", "pictures": "vision"}
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


def detect_layout(files: Sequence[str], folder: str) -> dict[str, str]:
    """Column -> template of the images below a folder; empty if no name says what they show.

    Args:
        files: paths below it, at least one.
        folder: its name, which may say what its only side shows.
    """
    return _detected_and_fit(files, folder)[0]


def _detected_and_fit(files: Sequence[str], folder: str) -> tuple[dict[str, str], bool]:
    """The templates, and whether they fit."""
    templates, fit = _detected(files, folder)
    fit = fit or bool(templates and _fit(files, templates))
    if not {"vision", "tactile"} <= templates.keys() or fit:
        return templates, fit
    timed, _ = _detected([_TIMED.sub(_TIME, path) for path in files], folder)
    timed = {
        side: text.replace(_TIME, f"{{{TIME}}}").replace("{sample}", "{video}")
        for side, text in timed.items()
    }
    both = all(f"{{{TIME}}}" in timed.get(side, "") for side in ("vision", "tactile"))
    return (timed, True) if both and _fit(files, timed) else (templates, False)


def _detected(files: Sequence[str], folder: str) -> tuple[dict[str, str], bool]:
    """The templates of files without time stamps, and whether they are known to fit."""
    sides = _by_role({path: posixpath.splitext(path)[0] for path in files})
    if not sides and (roles := {ROLE_OF[w] for w in _words(folder) if w in ROLE_OF}):
        sides = {min(roles): list(files)} if len(roles) == 1 else {}
    if set(sides) <= {"background"}:
        return {}, False
    several = any(map(_several, sides.values()))
    sides = {side: sides[side] for side in ROLES if side in sides}
    together = _together(sides, several)
    if together and _fit(files, together):
        return together, True
    apart = _faced(_alike({side: template_of(sides[side], several) for side in sides}, sides))
    return together if together and _contradict([*apart.values()]) else apart, False


#: A time stamp at the end of a name, and what stands in its place.
_TIMED, _TIME = re.compile(r"(?:[0-9]{9,}(?:\.[0-9]+)?|[0-9]+\.[0-9]+)(?=\.\w+$)"), "\ue001"
#: In place of the word that says what an image shows.
_ROLE = "\ue000"


def _together(sides: Mapping[str, Sequence[str]], several: bool) -> dict[str, str]:
    """The templates by what the paths of all sides have in common but for the words of their side.

    So a folder that one side lacks, or has alone, is a field of both, with the values that each
    has. Empty where the sides differ by more than those words.
    """
    stems = {side: [posixpath.splitext(path) for path in files] for side, files in sides.items()}
    own = {s: set.intersection(*(set(_words(stem)) for stem, _ in stems[s])) for s in sides}
    shared = set.intersection(*own.values())
    bare: list[str] = []
    written: dict[str, tuple[str, ...]] = {}
    for side in sides:
        roles = {word for word in own[side] - shared if word in ROLE_OF or word in _WEAK}
        for stem, _ in stems[side]:
            tokens = _TOKEN.findall(stem)
            marked = tuple(t for t in tokens if t.lower() in roles)
            if written.setdefault(side, marked) != marked or not marked:
                return {}
            bare.append("".join(_ROLE if t in marked else t for t in tokens) + ".x")
    count = len(next(iter(written.values())))
    text = template_of(bare, several)
    template = Template.parse(text)
    plain = all(map(template.match, set(bare))) and text.count(_ROLE) == count
    if len(sides) < 2 or not plain or any(len(words) != count for words in written.values()):
        return {}
    templates: dict[str, str] = {}
    for side, words in written.items():
        suffixes = {suffix for _, suffix in stems[side]}
        parts = text.removesuffix(".x").split(_ROLE)
        path = "".join(map("".join, zip(parts, (*words, ""), strict=True)))
        templates[side] = path + (min(suffixes) if len(suffixes) == 1 else ".*")
    return templates


def _contradict(texts: Sequence[str]) -> bool:
    """Whether folders that no word of a side names face each other by two names."""
    folders = [text.split("/")[:-1] for text in texts]
    return len(set(map(len, folders))) == 1 and any(
        len(set(names)) > 1
        and not any("{" in name or ROLE_OF.keys() & set(_words(name)) for name in names)
        for names in zip(*folders, strict=True)
    )


def _faced(templates: dict[str, str]) -> dict[str, str]:
    """The templates, where a constant that faces a field of another side is that field.

    ``cup_{frame:d}.png`` next to ``{object}_{frame:d}_touch.png`` is ``{object}_{frame:d}.png``: it
    is the photo of one object and not of all.
    """
    for side in templates:
        for facing in (text for other, text in templates.items() if other != side):
            pieces, others = templates[side].split("/"), facing.split("/")
            fields = {*Template.parse(templates[side]).fields}
            if len(pieces) == len(others):
                pairs = zip(pieces, others, strict=True)
                templates[side] = "/".join(_facing(a, b, fields) for a, b in pairs)
    return templates


def _facing(piece: str, facing: str, fields: set[str]) -> str:
    """One piece of a template, with the fields of the piece that it faces."""
    field = re.compile(r"(\{\w+[^{}]*\})")
    both = [mark for mark in field.findall(facing) if mark in field.findall(piece)]
    split = re.compile("(" + "|".join(map(re.escape, both)) + ")") if both else re.compile("(\0)")
    mine, theirs = split.split(piece), split.split(facing)
    if len(mine) != len(theirs):
        return piece
    for k, (text, other) in enumerate(zip(mine, theirs, strict=True)):
        names = re.findall(r"\{(\w+)", other)
        if names and not fields & set(names) and not field.search(text):
            stems = [re.sub(r"\.[\w*]+$", "", part) for part in (text, other)]
            pattern = "".join(
                f"(?P<{part[1:-1].partition(':')[0]}>{'[0-9]+' if ':d' in part else '[^/]+'})"
                if field.fullmatch(part)
                else "".join(
                    "[A-Za-z]+" if t.lower() in ROLE_OF else re.escape(t)
                    for t in _TOKEN.findall(part)
                )
                for part in field.split(stems[1])
            )
            if match := re.fullmatch(pattern, stems[0]):
                spans = sorted(
                    (match.span(n), m) for n, m in zip(names, field.findall(other), strict=True)
                )
                for (first, last), mark in reversed(spans):
                    mine[k] = mine[k][:first] + mark + mine[k][last:]
                fields.update(names)
    return "".join(mine)


def _alike(templates: dict[str, str], sides: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """The templates, with one name for the only field that two sides do not share but equal."""
    first, *further = templates
    for side in further:
        one, two = (Template.parse(templates[s]) for s in (first, side))
        own = [n for n in one.fields if n not in two.fields]
        other = [n for n in two.fields if n not in one.fields]
        if len(own) == len(other) == 1 and (
            _values(one, own[0], sides[first]) == _values(two, other[0], sides[side])
        ):
            field = re.findall(rf"\{{{own[0]}\b[^{{}}]*\}}", one.text)
            templates[side] = re.sub(rf"\{{{other[0]}\b[^{{}}]*\}}", field[0], two.text)
    return templates


def _values(template: Template, field: str, files: Sequence[str]) -> set[str]:
    """The values of a field, numbers without leading zeros."""
    return {(template.match(path) or {}).get(field, "").lstrip("0") for path in files}


def _words(text: str) -> list[str]:
    return [token.lower() for token in _TOKEN.findall(text)]


def _by_role(stems: dict[str, str]) -> dict[str, list[str]]:
    """Side -> its files, by words that some have and others have not; else by a word of all.

    Files without such a word are the other side, if each is the partner of one with a word.
    """
    words = {path: _words(stem) for path, stem in stems.items()}
    shared = set.intersection(*map(set, words.values()))
    sides: dict[str, list[str]] = defaultdict(list)
    for path, own in words.items():
        strong = [ROLE_OF[word] for word in own if word in ROLE_OF and word not in shared]
        weak = [_WEAK[word] for word in own if word in _WEAK and word not in shared]
        # The picture of an empty gel may lie in the folder of the tactile images.
        role = "background" if "background" in strong else (strong or weak or [""])[-1]
        sides[role].append(path)
    plain = sides.pop("", [])
    if not sides:
        roles = {ROLE_OF[word] for word in shared if word in ROLE_OF} or {
            _WEAK[word] for word in shared if word in _WEAK
        }
        return {min(roles): list(stems)} if len(roles) == 1 else {}
    if plain and len(named := sides.keys() & {"vision", "tactile"}) == 1:
        (side,) = named
        partners = set[object]().union(*(_partners(stems[path], side) for path in sides[side]))
        places = {key[0] for key in partners if isinstance(key, tuple)}
        if 2 * sum(_has_partner(stems[path], partners, places) for path in plain) < len(plain):
            return {}
        sides["tactile" if side == "vision" else "vision"] = plain
    return dict(sides)


def _partners(stem: str, role: str) -> list[object]:
    """Paths without a word of a role: with any word in its place, or with none."""
    tokens, words = _TOKEN.findall(stem), {*ROLES[role], *(w for w in _WEAK if _WEAK[w] == role)}
    places = [k for k, token in enumerate(tokens) if token.lower() in words]
    word = rf"(?:{'|'.join(words)})(?![A-Za-z])"
    bare = re.sub(rf"(?i)[_\-. ]{word}|(?<![A-Za-z]){word}[_\-. ]?", "", stem)
    return [bare, *((k, *tokens[:k], "", *tokens[k + 1 :]) for k in places)]


def _has_partner(stem: str, partners: set[object], places: set[object]) -> bool:
    tokens = _TOKEN.findall(stem)
    inside = [k for k in places if isinstance(k, int) and k < len(tokens)]
    return stem in partners or any(
        (k, *tokens[:k], "", *tokens[k + 1 :]) in partners for k in inside
    )


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
    suffixes = {suffix for _, suffix in names}
    fields: set[str] = set()
    pieces = _folders(folders, fields)
    free = [k for k, piece in enumerate(pieces) if piece is None]
    named = ["object"] if fields & {"video", "contact"} else ["video" if several else "sample"]
    for k in free if named == ["object"] else reversed(free):
        pieces[k] = f"{{{_new(fields, *named, 'object', f'folder_{k + 1}')}}}"
    stem = _stem([stem for stem, _ in names], fields)
    suffix = min(suffixes) if len(suffixes) == 1 else ".*"
    text = "/".join([*map(str, pieces), stem + suffix])
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
        first, last = (_common(folders, end) for end in (1, -1))
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


def _common(folders: Sequence[Sequence[str]], step: int) -> Sequence[str]:
    """The folders that all paths begin (step 1) or end (-1) with."""
    common = posixpath.commonprefix([list(names[::step]) for names in folders])
    shortest = min(map(len, folders))
    return common if step == 1 else common[: max(0, shortest - len(_common(folders, 1)))]


def _column(before: str, middles: Sequence[str]) -> str:
    """What a varying part of a name is: by the word before it, else by its values."""
    words = [word for word in _words(before) if word.isalpha()]
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
    files = [name for name in every if name.lower().endswith(suffixes)]
    for name in (odd := [f for f in files if any("\ud800" <= c <= "\udfff" for c in f)]):
        result.problem(ascii(name), "bad-encoding", "the name of the file is not UTF-8")
    files = [name for name in files if name not in odd] if odd else files
    text = "links to folders that are read already"
    result.suspect(result.base, "linked-twice", text, again)
    rest = (name for name in every if not name.lower().endswith(suffixes))
    dead = [name for name in rest if not (result.base / name).exists()]
    result.suspect(result.base, "dead-link", "links that lead nowhere", dead)
    text = "files that are not read"
    result.suspect(result.base, "unread", text, counted(every))
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
    result.facts |= {f"template_{column}": template.text for column, template in templates.items()}
    fields = tuple(dict.fromkeys(name for t in templates.values() for name in t.fields))
    if TIME in fields and len(templates) > 1:
        pairs = {path for row in rows for path in row.values()} | {p.where for p in problems}
        text = "within half a step of the slower side; files that are nearest to none"
        text = f"images are paired by time, {text}: {len(used - pairs)}"
        result.suspect(result.base, "paired-by-time", text)
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
    if side is not None:
        return renamed({side: template_of(files)})
    templates, fit = _detected_and_fit(files, folder.resolve().name)
    if fit:
        return renamed(templates)
    if templates:
        choices = [templates, *({side: text} for side, text in templates.items())]
        got = f"{few(files)}, of which few share their names"
    else:
        every = template_of(files)
        choices = [{"tactile": every}, {"vision": every}]
        got = f"{few(files)}, without a word like {ROLES['vision'][0]} or {ROLES['tactile'][0]}"
    must = f"The names of the {kind} in {folder} must say what they show"
    raise PalpateError(must, got, "Choose one of these", choices=[*map(renamed, choices)])


def _fit(files: Sequence[str], templates: Mapping[str, str]) -> bool:
    """Whether templates join most of the files of a side, a frame of one with one of the other."""
    matches = assign(files, {side: Template.parse(text) for side, text in templates.items()})
    with contextlib.suppress(PalpateError):
        rows, _ = join(matches)
        both = [side for side in SIDES if side in matches]
        numbered = len(both) == 2 and all("{frame" in templates[side] for side in both)
        samples = len({tuple(v for n, v in row.items() if n not in matches) for row in rows})
        shared = numbered and any(len({row[s] for row in rows}) < samples for s in both)
        return not shared and 2 * len(rows) >= min(len(matches[side]) for side in both)
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
