"""The page: Results -> one HTML file that needs no network, no script and no other file.

Jinja2 with escaping on draws ``templates/page.html.j2``; the style sheet is inlined; a Content-Security-Policy in the
page itself forbids every request. Pictures are ``data:`` URIs that fit what the text leaves of ``max_bytes``.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import zip_longest
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape

from palpate import __version__
from palpate.core import PalpateError, Progress, SampleRef, quiet
from palpate.report import plots
from palpate.report.audits import (
    MAX_PAIRS,
    OPEN_PAIRS,
    AuditView,
    PairRow,
    audit_view,
    pair_facts,
    pair_lists,
    pair_pictures,
    side_of,
)
from palpate.report.notes import sentence
from palpate.report.pictures import Album, Darkroom, Picture, Wanted
from palpate.report.results import GalleryItem, LeakPair, Results
from palpate.report.sentences import purpose, summary_lines, where
from palpate.report.tables import heat_tables, score_tables, settings_of
from palpate.report.text import HINTS, HOW_TO_READ, count, defined, number, percent, plain, plural

#: Gallery rows that are open, and that the page holds at all; the JSON beside the page names every one.
OPEN_ROWS, MAX_ROWS = 40, 160
#: A list in the settings is cut here; the JSON keeps it whole.
LONG_LIST = 24
_DIGEST = re.compile(r"(?:sha256:)?[0-9a-f]{32,128}")
_NUMBER = re.compile(r"(?<![\w.,])[−-]?\d[\d,]*(?:\.\d+)?(?:\s?%)?(?!\w|-[A-Za-z])")


@dataclass(frozen=True)
class Row:
    """A gallery row with its pictures."""

    item: GalleryItem
    pictures: Sequence[Picture]


@dataclass(frozen=True)
class Folds:
    """Gallery rows by material: open ones and folded ones, and how many there are in all."""

    open: Mapping[str, Sequence[Row]]
    folded: Mapping[str, Sequence[Row]]
    shown: int
    total: int


def material_of(sample: SampleRef) -> str:
    """The material to group by; a sentence where there is none."""
    return sample.material or "Material not given"


def in_turns(items: Sequence[GalleryItem]) -> list[GalleryItem]:
    """The items so that every material comes once before any comes twice; the order inside a material is kept."""
    queues: defaultdict[str, list[GalleryItem]] = defaultdict(list)
    for item in items:
        queues[material_of(item.sample)].append(item)
    return [item for turn in zip_longest(*queues.values()) for item in turn if item is not None]


def _gallery_pictures(item: GalleryItem) -> list[Wanted]:
    s = item.sample
    said = f"{s.material or 'sample'}, {where(s)}"
    wanted = [
        Wanted(s.vision, f"Photo: {said}", "Photo"),
        Wanted(s.tactile, f"Real touch: {said}", "Real touch"),
    ]
    wanted.append(Wanted(item.generated, f"Generated touch: {said}", "Generated"))
    if item.background is not None:
        wanted.append(Wanted(item.background, f"Sensor without contact: {said}", "No contact"))
    return wanted


@dataclass(frozen=True)
class _Plan:
    """All rows in order of importance: open pairs, open gallery, folded pairs, folded gallery.

    Pairs take turns: every list of every audit shows its strongest pair before any shows its second. A row's place is
    (audit, list), or None in the gallery.
    """

    rows: Sequence[tuple[tuple[int, int] | None, GalleryItem | LeakPair]]
    essential: int
    sides: Sequence[str]

    @classmethod
    def of(cls, results: Results) -> _Plan:
        gallery = [(None, item) for item in in_turns(results.gallery)[:MAX_ROWS]]
        lists = [
            ((k, j), found.pairs)
            for k, a in enumerate(results.audits)
            for j, found in enumerate(pair_lists(a))
        ]
        turn = lambda ranks: [
            (place, pairs[r]) for r in ranks for place, pairs in lists if r < len(pairs)
        ]
        pairs, more = turn(range(OPEN_PAIRS)), turn(range(OPEN_PAIRS, MAX_PAIRS))
        rows = [*pairs, *gallery[:OPEN_ROWS], *more, *gallery[OPEN_ROWS:]]
        return cls(
            rows, len(pairs) + len(gallery[:OPEN_ROWS]), [side_of(a) for a in results.audits]
        )

    def wanted(self) -> list[list[Wanted]]:
        return [
            pair_pictures(item, self.sides[place[0]])
            if place is not None and isinstance(item, LeakPair)
            else _gallery_pictures(item)
            if isinstance(item, GalleryItem)
            else []
            for place, item in self.rows
        ]

    def views(self, results: Results, album: Album) -> tuple[Folds, list[AuditView]]:
        """What the album holds, put back into its sections."""
        gallery: list[Row] = []
        pairs: defaultdict[tuple[int, int], list[PairRow]] = defaultdict(list)
        for (place, item), pictures in zip(self.rows, album.rows, strict=False):
            if isinstance(item, GalleryItem):
                gallery.append(Row(item, pictures))
            elif place is not None:
                pairs[place].append(PairRow(item, pictures))
        folds = Folds(
            _by_material(gallery[:OPEN_ROWS]),
            _by_material(gallery[OPEN_ROWS:]),
            len(gallery),
            len(results.gallery),
        )
        audits = [
            audit_view(a, [pairs[k, j] for j in range(len(pair_lists(a)))])
            for k, a in enumerate(results.audits)
        ]
        return folds, audits


def _by_material(rows: Iterable[Row]) -> dict[str, list[Row]]:
    groups: defaultdict[str, list[Row]] = defaultdict(list)
    for row in rows:
        groups[material_of(row.item.sample)].append(row)
    return dict(sorted(groups.items(), key=lambda pair: pair[0].casefold()))


def _template(name: str) -> str:
    return (resources.files("palpate.report") / "templates" / name).read_text(encoding="utf-8")


def _unbroken(sentence: str) -> str:
    """The sentence with percentages that do not break across lines."""
    return re.sub(r"(?<=\d) %", "\u00a0%", sentence)


def _emphasise(sentence: str) -> Markup:
    """The sentence, escaped, with its first number marked."""
    sentence = _unbroken(sentence)
    found = _NUMBER.search(sentence)
    if found is None:
        return escape(sentence)
    return Markup("{}<b>{}</b>{}").format(
        sentence[: found.start()], found.group(), sentence[found.end() :]
    )


def _leaf(value: Any) -> Markup:
    """A setting's value: digests and paths in fixed pitch, a digest's first twelve digits (its short name) stronger than the rest."""
    if value is None:
        return Markup('<span class="none">none</span>')
    if isinstance(value, bool):
        return Markup("yes" if value else "no")
    if isinstance(value, int | float):
        return escape(f"{value:g}" if isinstance(value, float) else f"{value}")
    text = str(value)
    if _DIGEST.fullmatch(text):
        cut = text.find(":") + 13
        return Markup('<code class="digest"><b>{}</b>{}</code>').format(text[:cut], text[cut:])
    return Markup("<code>{}</code>").format(text) if "/" in text or "\\" in text else escape(text)


def _short_list(value: Sequence[Any]) -> tuple[Sequence[Any], int]:
    """The head of a list and how many entries were left out."""
    return value[:LONG_LIST], max(0, len(value) - LONG_LIST)


def _like_rows(value: Mapping[str, Any]) -> list[str]:
    """The keys that all of at least two entries share, if each entry is a flat mapping of just those; else nothing."""
    rows = list(value.values())
    if len(rows) < 2 or not all(
        isinstance(r, Mapping) and r and list(r) == list(rows[0]) for r in rows
    ):
        return []
    return (
        []
        if any(isinstance(v, Mapping | list) for r in rows for v in r.values())
        else list(rows[0])
    )


@cache
def environment() -> Environment:
    """Jinja2 with escaping on and unknown names refused; templates come out of the installed package."""
    env = Environment(
        loader=FunctionLoader(_template),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        auto_reload=False,
    )
    functions: dict[str, Any] = {
        "bar": plots.interval_bar,
        "axis_row": plots.axis_row,
        "short_list": _short_list,
        "like_rows": _like_rows,
        "pair_facts": pair_facts,
    }
    filters: dict[str, Any] = {
        "count": count,
        "number": number,
        "percent": percent,
        "plural": plural,
        "emphasise": _emphasise,
        "leaf": _leaf,
        "plain": plain,
        "sentence": sentence,
        "unbroken": _unbroken,
    }
    env.globals.update(functions)
    env.filters.update(filters)
    env.tests["tree"] = lambda value: isinstance(value, Mapping)
    env.tests["series"] = lambda value: isinstance(value, list)
    return env


def _told(album: Album, wanted: int) -> list[str]:
    """What the page must say about its pictures."""
    notes: list[str] = []
    if album.broken:
        notes.append(
            f"{plural(album.broken, 'picture')} could not be read; a placeholder names the file."
        )
    if len(album.rows) < wanted:
        left = plural(wanted - len(album.rows), "row")
        notes.append(
            f"{left} of pictures were left out and the others made at most {album.side} px to keep the page within its size."
        )
    elif album.side < 128:
        notes.append(f"Pictures were shrunk to {album.side} px to keep the page within its size.")
    return notes


def render_page(
    results: Results,
    base: Path,
    *,
    max_bytes: int,
    names: Sequence[str] = (),
    progress: Progress = quiet,
) -> str:
    """The whole page.

    Args:
        results: what to draw.
        base: folder that relative picture paths start from.
        max_bytes: the page's largest size in UTF-8.
        names: names of the files written beside the page, for the footer.
        progress: told while pictures are made.

    Returns:
        The HTML text.

    Raises:
        PalpateError: if scores may not stand in one table, or the text alone is larger than ``max_bytes``.
    """
    plan, darkroom = _Plan.of(results), Darkroom(base)
    rows = plan.wanted()
    fixed = {
        "results": results,
        "purpose": purpose(results),
        "facts": list(results.facts) or summary_lines(results),
        "tables": score_tables(results.scores),
        "heats": heat_tables(results.scores),
        "undefined": sum(not defined(s) for s in results.scores),
        "details": [
            (
                s,
                plain(
                    {k: v for k, v in s.details.items() if k not in ("matrix", "labels", "classes")}
                ),
            )
            for s in results.scores
        ],
        "settings": settings_of(results),
        "hints": HINTS,
        "how_to_read": HOW_TO_READ,
        "style": Markup(_template("style.css")),
        "names": names,
        "version": __version__,
    }

    def draw(album: Album) -> str:
        folds, audits = plan.views(results, album)
        notes = [*map(sentence, results.notes), *_told(album, len(rows))]
        return (
            environment()
            .get_template("page.html.j2")
            .render(**fixed, notes=notes, gallery=folds, audits=audits)
        )

    size = lambda text: len(text.encode())  # noqa: E731
    bare = size(draw(Album((), 0, 0)))
    if bare > max_bytes:
        raise PalpateError(
            "The page's largest size must hold at least its text",
            f"{max_bytes:,} bytes for {bare:,} of text",
            f"Allow {2 * bare:,}",
        )
    budget = max_bytes - bare
    while True:
        html = draw(darkroom.develop(rows, budget, plan.essential, progress))
        if (excess := size(html) - max_bytes) <= 0:
            return html
        budget -= excess + 1_000
