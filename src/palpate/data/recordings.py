"""Which samples are one recording, one contact, one object, and how that is known.

Levels, coarse to fine, are *object*, *session*, *video*, *contact* and *frame*. What a manifest
knows of a level is in its column; where it is from is the *source* of the level:

- a column of a table, or the layout of a published data set, in which somebody declared it;
- the lines ``video/frame.jpg,label`` of a list;
- the template of a folder, or what the names of *all* inputs together suggest
  (:func:`name_recordings`), kept as the fact ``video_from``;
- time stamps in the names of recordings, which make sessions.

Names are read with care. A name is that of a video or an object only where a number follows that
runs: two frames or more of each on average, within a hundred times their count for half of them; or
where a word says so (``trial_7``, ``object-3``). Names of one kind, folders that say what images
show (``images_rgb``, ``images_tac``) and folders of parts (``train``, ``test``) name no recording.
Names of the usual shape decide, so that one odd cell changes nothing but its own row.

Two inputs mean the same by equal names only where somebody declared it: see :func:`same_names`.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import polars as pl

from palpate.core import NO_LEAK, Note, Split, few, require
from palpate.data.manifest import IMAGE_COLUMNS, PART_NAMES, PATH, ROLE_OF, SCHEMA, Manifest
from palpate.data.templates import Template

LEVELS = ("object", "session", "video", "contact", "frame")
#: Columns of names: those that inputs may have in common.
NAMES = ("id", "video", "contact", "object", "session")
#: Formats of anyone's data: what they name is not published.
OWN = (None, "pairs", "intervals", "hf", "videos")
#: Published lists: name -> pattern of a path, whose groups are columns.
KNOWN = {
    "HCT": r"(?:.*/)?(?P<video>data\d+/[^/]+-\d+\.\d+)/(?:vision|tactile)/(?P<frame>\d{1,18})-"
    r"[\d.]+\.\w+",
    "SSVTP": r"(?:.*/)?images_(?:rgb|tac)/image_(?P<frame>\d{1,18})_(?:rgb|tac)\.\w+",
}
#: A trajectory folder of HCT: a number that is used again, and the start in Unix seconds.
TRAJECTORY = re.compile(r"\d+-(\d+(?:\.\d+)?)")
#: Seconds between the starts of two folders of one session.
SESSION_GAP = 60.0
#: The share of names whose shape is the usual one; names that suggest the shape at most.
USUAL, LOOKED_AT = 0.95, 50_000
#: Frames that a recording must have on average, and its numbers from first to last for each.
FRAMES, SPREAD = 2, 100
#: The fewest recordings a side that intervals and p-values are made of.
LEAST = 8
#: A column of paths, with a name that no field can have.
MATCHED = "a path"
#: What equal names of two inputs mean: the same, nothing, or (auto) what their sources say.
Identity = Literal["auto", "names", "images"]


def groups_of(manifest: Manifest) -> list[tuple[str, str]]:
    """The levels that a manifest knows something of, coarse to fine, each with its source."""
    levels = (c for c in LEVELS if manifest.table[c].null_count() < len(manifest))
    return [(level, source_of(manifest, level)) for level in levels]


def recordings_note(*manifests: Manifest) -> Note:
    """What all of some samples know of levels, for the one line of an answer."""
    every = [groups_of(m) for m in manifests]
    levels = [pair for pair in every[0] if all(pair in pairs for pairs in every[1:])]
    return Note("recordings", {"levels": [list(pair) for pair in levels]})


def shared_groups(train: pl.DataFrame, test: pl.DataFrame) -> dict[str, tuple[int, int]]:
    """Column -> (test groups that are in train, test groups), of those that both parts know."""
    shared: dict[str, tuple[int, int]] = {}
    for column in ("video", "session", "object"):
        base, queries = (set(t[column].drop_nulls().unique()) for t in (train, test))
        if base and queries:
            shared[column] = len(base & queries), len(queries)
    return shared


def described(manifest: Manifest, split: Split) -> Split:
    """The split with a rule that says what is known of its samples, and what its parts share.

    It travels with what is trained or probed on the split; :func:`rule_notes` reads it.
    """
    train, test = (manifest.part(split, part).table for part in ("train", "test"))
    facts = {"recordings": groups_of(manifest), "shared": shared_groups(train, test)}
    return split.changed(rule={**split.rule, **facts})


def rule_notes(rule: Mapping[str, Any]) -> list[Note]:
    """What is known of the samples of a :func:`described` split, and that it is no NoLeak."""
    notes = [Note("recordings", {"levels": [list(pair) for pair in rule["recordings"]]})]
    name, verdict = rule.get("name", "split"), rule.get("audit")
    group = next((column for column, (count, _) in rule["shared"].items() if count), None)
    if verdict not in (None, NO_LEAK):
        notes.append(Note("not-noleak", {"name": name, "verdict": verdict}))
    elif verdict is None and group is not None:
        count, total = rule["shared"][group]
        params = {"name": name, "group": group, "count": count, "of": total}
        notes.append(Note("split-shares", params))
    return notes


def resampled_by(
    tables: Sequence[pl.DataFrame], requested: str, kept: str, *, paired: bool
) -> tuple[str, Note | None, list[Note]]:
    """The level whose units are left out and exchanged, for intervals, tests and folds.

    Samples that all sides have (pairs): the coarsest level with enough units, from what a split
    kept whole on. Other samples: the coarsest level of which one side has units that the first has
    not; of what both have, none is there by chance.

    Args:
        tables: what is known of each side.
        requested: a level, ``frame`` where no two samples are of one recording, or ``auto``.
        kept: the level that the split kept whole, if there is one.
        paired: whether all sides have the same samples.

    Returns:
        The level; why it carries neither intervals nor p, or None; and what to know of it.

    Raises:
        PalpateError: on a level that is not known for all.
    """
    named = LEVELS[:-1]
    units = {level: [{*t[level].drop_nulls()} for t in tables] for level in named}
    levels = [level for level in named if all(units[level])]
    must, got = "must be known for every input", f"{requested!r}, and {few(levels)} known"
    fix = "Pass labels with that column, or the default group"
    require(requested in ("auto", "frame", *levels), "group", must, got, fix=fix)
    enough = [level for level, own in units.items() if min(map(len, own)) >= LEAST]
    # What the data ask for, coarse to fine.
    levels = [n for k, n in enumerate(levels) if not any(cuts(t, levels[k:]) for t in tables)]
    apart = [n for n in levels if not paired and any(own != units[n][0] for own in units[n])]
    inner = levels[levels.index(kept) :] if paired and kept in levels else levels
    right = [*apart, *(level for level in inner if level in enough), *inner, "frame"][0]
    group, notes, doubt = right if requested == "auto" else requested, list[Note](), None
    if LEVELS.index(group) > LEVELS.index(right):
        group = group if paired else right
        notes.append(Note("group-finer", {"group": requested, "level": right, "used": group}))
    if group == "frame" != requested:
        doubt = Note("groups-unknown")
    elif group not in ("frame", *enough):
        count = min(map(len, units[group]))
        doubt = Note("groups-few", {"level": group, "count": count, "least": LEAST})
    return group, doubt, notes


def cuts(table: pl.DataFrame, levels: Sequence[str]) -> bool:
    """Whether a unit of a finer level is of several of the first: a video of two objects."""
    level, *finer = levels
    return any(len(table.select(level, n).unique()) > table[n].n_unique() for n in finer)


def source_of(manifest: Manifest, level: str) -> str:
    """Where the names of a level are from, in words."""
    facts = manifest.facts
    templates = [facts[f"template_{c}"] for c in IMAGE_COLUMNS if f"template_{c}" in facts]
    if written := facts.get(f"{level}_from"):
        return written
    if templates and (level == "id" or any(f"{{{level}" in text for text in templates)):
        return f"file names `{templates[0]}`"
    if published(manifest):
        return f"the layout of {facts.get('dataset', facts['format'])}"
    if "source" in facts:
        return "the list"
    return f"the column {level}"


def published(manifest: Manifest) -> bool:
    """Whether the samples are of a published data set, or of one world."""
    return manifest.facts.get("format") not in OWN


def is_sequence(manifest: Manifest) -> bool:
    """Whether somebody stated that the numbers of all samples are times of one sequence."""
    table, facts = manifest.table, manifest.facts
    stated = "templates" in facts or "`" in facts.get("frame_from", "")
    unknown = all(table[c].null_count() == len(table) for c in ("video", "object", "contact"))
    return stated and unknown and table["frame"].count() > 0


def same_names(a: Manifest, b: Manifest, identity: Identity = "auto") -> tuple[str, ...]:
    """The columns of names in which equal values of two inputs mean the same thing.

    All columns, if both have one root or are one published data set; all but the ids, in sibling
    folders that are named as parts (``train``, ``test``), unless frames are counted anew in each;
    else those that columns of tables declare in both by more than numbers.
    """
    facts = [[m.facts.get(fact) for fact in ("format", "dataset", "digest")] for m in (a, b)]
    one_set = facts[0] == facts[1] and published(a)
    if identity != "auto":
        return NAMES if identity == "names" else ()
    if one_set or a.root.resolve() == b.root.resolve():
        return NAMES
    if _are_parts(a.root, b.root) and not _count_anew(a.table, b.table):
        return NAMES[1:]
    return tuple(c for c in NAMES if _declares(a, c) and _declares(b, c))


def _are_parts(a: Path, b: Path) -> bool:
    """Whether two folders differ in one name, and there by the part of a split alone."""
    places = [folder.resolve().parts for folder in (a, b)]
    differing = [pair for pair in zip(*places, strict=False) if pair[0] != pair[1]]
    if len(places[0]) != len(places[1]) or len(differing) != 1:
        return False
    words = [re.split("([^A-Za-z]+)", name.lower()) for name in differing[0]]
    parts = [[PART_NAMES.get(word) for word in own] for own in words]
    bare = [["" if word in PART_NAMES else word for word in own] for own in words]
    return bare[0] == bare[1] and parts[0] != parts[1] and any(parts[0]) and any(parts[1])


def _count_anew(a: pl.DataFrame, b: pl.DataFrame) -> bool:
    """Whether most frames of the videos that two tables share have a number that both use."""
    column = next((c for c in ("video", "object") if a[c].count() and b[c].count()), None)
    if column is None:
        return True
    frames, others = (t.select(column, "frame", "contact").unique() for t in (b, a))
    frames = frames.filter(pl.col(column).is_in(others[column].drop_nulls().implode()))
    again = frames.join(others, on=frames.columns, how="semi", nulls_equal=True)
    return frames["frame"].count() > 0 and 2 * len(again) > len(frames)


def _declares(manifest: Manifest, column: str) -> bool:
    """Whether the names of a column are from a table, and more than numbers or paths of files."""
    table = manifest.table
    if source_of(manifest, column) != f"the column {column}":
        return False
    stems = [pl.col(c).str.replace(r"\.[^./]+$", "") == pl.col("id") for c in ("tactile", "vision")]
    paths = column == "id" and table.select(pl.any_horizontal(*stems).any()).item()
    return not paths and bool(table[column].str.contains("[^0-9]").any())


def name_recordings(manifests: Sequence[Manifest], template: str | None = None) -> list[Manifest]:
    """Fill the levels that the names of samples show, where nobody has declared them.

    Args:
        manifests: the inputs of one answer, whose names are read together, so that one that holds
            a single recording does not hide what varies between them.
        template: of their paths, if it is stated.

    Returns:
        The manifests in their order; those that know their videos, or whose names suggest nothing,
        as they are.
    """
    if not manifests:
        return []
    bare = [_unread(m, manifests, stated=template is not None) for m in manifests]
    schema = {PATH: pl.String, "input": pl.Int64}
    read = [
        pl.DataFrame({PATH: _names_of(own), "input": k}, schema)
        for k, own in enumerate(bare)
        if own is not None
    ]
    names = pl.concat([pl.DataFrame(schema=schema), *read])
    fields, levels, source = _read(names, template)
    if not levels:
        return list(manifests)
    named = [
        m if own is None else _filled(own, fields.filter(names["input"] == k), source)
        for k, (m, own) in enumerate(zip(manifests, bare, strict=True))
    ]
    return _with_sessions(named) if "HCT" in source else named


def _unread(manifest: Manifest, manifests: Sequence[Manifest], *, stated: bool) -> Manifest | None:
    """The samples without what their own names alone suggested; None if all is declared."""
    templates, facts = _templates(manifest), dict(manifest.facts)
    suggested = [c for c in LEVELS if facts.pop(f"{c}_from", None)]
    if published(manifest) or (templates and (stated or "templates" in manifest.facts)):
        return None
    if templates and all(templates == _templates(m) for m in manifests):
        return None  # they were read alike
    fields = {name for text in templates.values() for name in Template.parse(text).fields}
    cleared = [pl.lit(None, SCHEMA[c]).alias(c) for c in LEVELS if c in {*fields, *suggested}]
    table = manifest.table.with_columns(cleared)
    unknown = table["video"].null_count() == len(table) or (stated and PATH in table.columns)
    return replace(manifest, table=table, facts=facts) if unknown else None


def _templates(manifest: Manifest) -> dict[str, str]:
    return {k: text for k, text in manifest.facts.items() if k.startswith("template_")}


def _names_of(manifest: Manifest) -> pl.Series:
    """The paths of samples, without the place that a machine has them in; their ids without any."""
    table = manifest.table
    columns = (c for c in (PATH, "tactile", "vision") if c in table.columns and table[c].count())
    names = table[next(columns, "id")].str.replace_all("\\", "/", literal=True)
    return names.str.replace(r"^(?:[A-Za-z]:)?(?:\.?/)+", "")


def _read(names: pl.DataFrame, template: str | None) -> tuple[pl.DataFrame, Sequence[str], str]:
    """What the paths of some inputs say: fields of each, their levels, and how they were read."""
    paths = names.filter(pl.col(PATH) != "")
    if not len(paths):
        return paths, (), ""
    usual = _usual(paths[PATH])
    counts = {n: usual.str.contains(f"^(?:{pattern})$").sum() for n, pattern in KNOWN.items()}
    if template is None and sum(counts.values()) >= USUAL * len(usual):
        chosen = [name for name, count in counts.items() if count]
        tables = [_matched(re.compile(KNOWN[name]), names[PATH]) for name in chosen]
        fields = tables[0].with_columns(
            pl.col("frame").fill_null(table["frame"]) for table in tables[1:]
        )
        return fields, ("video", "frame"), f"file names of {', '.join(chosen)}"
    some = usual.to_list()
    if template is None and all(posixpath.splitext(path)[0].isdecimal() for path in some):
        return paths, (), ""  # bare numbers name no recording
    text = template or _suggested(some, paths)
    parsed = Template.parse(text)
    numbers = (pl.col(name).cast(pl.Int64).cast(pl.String) for name in parsed.digits)
    rows = _matched(parsed.pattern, names[PATH]).with_columns(numbers)
    rows = _apart(rows, parsed.fields).with_columns(names["input"])
    levels = parsed.fields if template else _convincing(rows.drop_nulls(MATCHED), parsed)
    kept = [name for name in parsed.fields if name in (*levels, "material")]
    return rows.select(kept), levels, f"file names `{text}`"


def _matched(pattern: re.Pattern[str], paths: pl.Series) -> pl.DataFrame:
    """What a pattern says of paths, a column for each group; ``MATCHED`` is null for others."""
    schema = dict.fromkeys((MATCHED, *pattern.groupindex), pl.String)
    matches = (pattern.fullmatch(path) if path else None for path in paths.to_list())
    none = (None,) * len(schema)
    rows = [(match[0], *match.groups()) if match else none for match in matches]
    return pl.DataFrame(rows, schema, orient="row")


def _apart(rows: pl.DataFrame, fields: Sequence[str]) -> pl.DataFrame:
    """The rows with videos and contacts of one name named apart."""
    from palpate.data.detection import name_apart

    columns = [c for c in ("material", *LEVELS[:-1]) if c in fields]
    if not columns:
        return rows
    distinct = rows.select(columns).unique(maintain_order=True)
    cells = [{c: v for c, v in row.items() if v is not None} for row in distinct.to_dicts()]
    name_apart(cells, fields)
    apart = pl.DataFrame(cells, dict.fromkeys(columns, pl.String))
    if apart.equals(distinct):
        return rows
    named = pl.concat([distinct, apart.rename("{}_apart".format)], how="horizontal")
    rows = rows.join(named, on=columns, how="left", nulls_equal=True, maintain_order="left")
    return rows.with_columns(pl.col(f"{c}_apart").alias(c) for c in columns)


def _usual(paths: pl.Series) -> pl.Series:
    """The paths of the usual shape, of so many that they show it; all if there is none."""
    some = paths.gather_every(max(1, len(paths) // LOOKED_AT))
    signs = some.str.replace_all("[A-Za-z]+", "a").str.replace_all("[0-9]+", "0")
    depth = some.str.replace_all("[^/]*/", "/").str.replace_all("[^/.]", "")
    depth = depth.str.replace_all(r"\.+", ".")  # folders, and whether there is a suffix
    for shape in (signs, depth):
        usual, count = shape.value_counts(sort=True).row(0)
        if count >= USUAL * len(some):
            return some.filter(shape == usual)
    return some


def _suggested(usual: Sequence[str], paths: pl.DataFrame) -> str:
    """The template that the usual of some paths suggest.

    Folders and endings that say what images show are ``*`` in it, as are folders of which every
    input has another one: they say where an input is.
    """
    from palpate.data.detection import template_of

    roles = "|".join(ROLE_OF)
    folder = re.compile(rf"(?i)(?:(?:{roles}|images?|frames?)[_\-. ]?)+")
    end = re.compile(rf"(?i)(?<=[_\-. ])(?:{roles})(?=\.\w+$)")
    inputs = paths.filter(pl.col(PATH).is_in(usual)).partition_by("input")
    own = [_folders(table[PATH].to_list()) for table in inputs]
    if len({match[0] for path in usual if (match := end.search(path))}) > 1:
        usual = [end.sub("*", path) for path in usual]
    shown = {
        k
        for k, values in enumerate(_folders(usual))
        if len(values) > 1
        and (
            all(map(folder.fullmatch, values))
            or (len(own) > 1 and all(len(columns[k]) == 1 for columns in own))
        )
    }
    if shown:
        split = (path.split("/") for path in usual)
        usual = ["/".join("*" if k in shown else n for k, n in enumerate(own)) for own in split]
    return template_of(usual)


def _folders(paths: Iterable[str]) -> list[set[str]]:
    """The names of the folders of some paths, by depth."""
    return [set(names) for names in zip(*(p.split("/")[:-1] for p in paths), strict=False)]


def _convincing(rows: pl.DataFrame, template: Template) -> list[str]:
    """The levels that names show: those of which numbers run, or that a word names.

    A name that differs between inputs alone is that of an input.
    """
    from palpate.data.detection import MEANING

    fields = [name for name in LEVELS if name in template.fields]
    levels: list[str] = []
    for level in (name for name in fields if name != "frame"):
        word = rf"(?i)(?<![a-z])(?:{'|'.join(MEANING[level])})[^A-Za-z0-9{{}}/]*\{{{level}\b"
        groups = rows.drop_nulls(level).group_by(level)
        varied = rows.group_by("input").agg(pl.col(level).n_unique())[level].max()
        if "frame" in fields:
            number = pl.col("frame").cast(pl.Int64)
            sizes = groups.agg(n=pl.len(), span=number.max() - number.min())
            several = sizes.filter(pl.col("n") > 1)
            runs = several["span"] < SPREAD * several["n"]
        else:
            sizes, runs = groups.agg(n=pl.len()), pl.Series([False])
        enough = sizes["n"].sum() >= FRAMES * len(sizes) and varied != 1
        if enough and (2 * runs.sum() >= len(runs) > 0 or re.search(word, template.text)):
            levels.append(level)
    return [*levels, *(["frame"] if "frame" in fields and levels else [])]


def _filled(manifest: Manifest, fields: pl.DataFrame, source: str) -> Manifest:
    """The samples with what their names say in the columns that are empty."""
    table, facts = manifest.table, dict(manifest.facts)
    columns: list[pl.Series] = []
    for values in fields:
        name = values.name
        if name in SCHEMA and values.count() and not table[name].count():
            columns.append(values.cast(SCHEMA[name], strict=False))
            facts[f"{name}_from"] = source
    return replace(manifest, table=table.with_columns(columns), facts=facts)


def _with_sessions(manifests: Sequence[Manifest]) -> list[Manifest]:
    """The samples of HCT with sessions by the times in the names of their folders."""
    sessions = sessions_of(v for m in manifests for v in m.table["video"].drop_nulls().unique())
    session = pl.col("video").replace_strict(sessions, default=None, return_dtype=pl.String)
    fact = {"session_from": "time stamps of the folders"}
    return [
        replace(m, table=m.table.with_columns(session=session), facts={**m.facts, **fact})
        if "video_from" in m.facts
        else m
        for m in manifests
    ]


def contact_names(
    videos: Sequence[str] | pl.Series,
    frames: Sequence[int] | pl.Series,
    labels: Sequence[object] | pl.Series | None,
) -> pl.Series:
    """The contact ``video#0001`` that each frame belongs to, in the order given.

    The numbers count the contacts of a video from 1 in the order of frames. Frames are integers in
    any order; ``labels`` are classes that a contact must not mix.
    """
    schema = {"video": pl.String, "frame": pl.Int64}
    table = pl.DataFrame({"video": videos, "frame": frames}, schema).with_row_index("row")
    table = table.with_columns(label=pl.lit(0) if labels is None else pl.Series(labels))
    named = pl.Enum(table["video"].drop_nulls().unique())
    table = table.with_columns(code=pl.col("video").cast(named).to_physical())
    table = table.sort("code", "frame", maintain_order=True)  # names take twice as long
    same = (pl.col(name) == pl.col(name).shift(1) for name in ("code", "label"))
    first = ~pl.all_horizontal(*same, pl.col("frame").diff() <= 1).fill_null(False)
    number = first.cast(pl.Int64).cum_sum().over("code").cast(pl.String).str.zfill(4)
    contacts = table.select("row", contact=pl.format("{}#{}", "video", number))
    return contacts.sort("row")["contact"]


def number_contacts(manifests: Sequence[Manifest]) -> list[Manifest]:
    """Number the contacts of bare frame lists together, so that one name means one contact."""
    place = ["video", "frame"]
    bare = [
        k
        for k, m in enumerate(manifests)
        if set(m.facts) == {"source"} and PATH not in m.table.columns
    ]
    if len(bare) < 2 or any(manifests[k].table[c].has_nulls() for k in bare for c in place):
        return list(manifests)
    rows = pl.concat([manifests[k].table.select(*place, "material") for k in bare])
    # A frame in two lists belongs to one contact.
    distinct = rows.unique(place, maintain_order=True)
    names = contact_names(*(distinct[name] for name in (*place, "material")))
    distinct = distinct.with_columns(contact=names)
    contacts = rows.join(distinct, on=place, how="left", maintain_order="left")
    numbered = list(manifests)
    for k in bare:
        m = manifests[k]
        numbered[k] = replace(m, table=m.table.with_columns(contacts["contact"].head(len(m))))
        contacts = contacts.slice(len(m))
    return numbered


def sessions_of(videos: Iterable[str]) -> dict[str, str]:
    """Video -> session, named by its first video; a name without a time is its own session.

    Folders of one rig that start at most ``SESSION_GAP`` seconds after each other are one session.
    """
    sessions: dict[str, str] = {}
    last: dict[str, tuple[float, str]] = {}
    for video in sorted(set(videos), key=in_time):
        rig, start, _ = in_time(video)
        if start >= 0:
            before, session = last.get(rig, (float("-inf"), ""))
            sessions[video] = session if start - before <= SESSION_GAP else video
            last[rig] = (start, sessions[video])
        else:
            sessions[video] = video
    return sessions


def in_time(video: str) -> tuple[str, float, str]:
    """Sort key of a trajectory: rig, start (-1 if the name has none), name."""
    rig, _, folder = video.partition("/")
    match = TRAJECTORY.fullmatch(folder)
    return rig, float(match[1]) if match else -1.0, folder
