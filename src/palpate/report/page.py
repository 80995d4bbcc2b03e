"""The page: results -> one HTML file that needs no network, no script and no other file.

Jinja2 with escaping draws ``templates/page.html.j2``; the style sheet is inlined; a
Content-Security-Policy in the page forbids every request. Images are ``data:`` URIs that fit what
the text leaves of ``max_bytes``.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from functools import cache
from importlib import resources
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape

from palpate import __version__
from palpate.core import PalpateError, Progress, SampleRef, plain, quiet, write_json, write_text
from palpate.report import audits, plots, sentences
from palpate.report.notes import (
    HINTS,
    HOW_TO_READ,
    confidence,
    count,
    number,
    percent,
    plural,
    sentence,
    where,
)
from palpate.report.results import GalleryItem, LeakPair, Results, Strip
from palpate.report.tables import heat_tables, score_tables, settings_of, table_facts
from palpate.report.thumbnails import Album, Wanted, fit

#: Gallery rows and pairs of one list that show at once, and that the page holds at all.
OPEN_ROWS, MAX_ROWS = 40, 160
OPEN_PAIRS, MAX_PAIRS = 6, 24
#: A list in the settings is cut here; the JSON keeps it whole.
LONG_LIST = 24
_DIGEST = re.compile(r"(?:sha256:)?[0-9a-f]{32,128}")
_NUMBER = re.compile(r"(?<![\w.,])[−-]?\d[\d,]*(?:\.\d+)?(?:\s?%)?(?!\w|-[A-Za-z])")


class ReportFiles(NamedTuple):
    """What :func:`write_report` wrote."""

    page: Path
    json: Path
    markdown: Path


def write_report(
    results: Results,
    page: Path,
    *,
    base: Path | None = None,
    max_bytes: int = 10_000_000,
    progress: Progress = quiet,
) -> ReportFiles:
    """Write ``page`` (HTML) and, next to it, the same results as ``.json`` and ``.md``.

    Args:
        results: everything to show.
        page: the HTML file; its name must end in ``.html``.
        base: folder that relative image paths of ``results`` start from; by default that of
            ``page``. The JSON counts them from its own folder.
        max_bytes: largest size of the HTML file. Images shrink, then rows are skipped, and the page
            says so.
        progress: called while images are made.

    Raises:
        PalpateError: if ``page`` does not end in ``.html``, if scores of different settings would
            share a column (nothing is written then), or if ``max_bytes`` cannot hold the text.
    """
    page = Path(page)
    if page.suffix != ".html":
        fix = "Name it e.g. report.html"
        raise PalpateError("The page's file name must end in .html", f"{page.name!r}", fix)
    folder = page.parent
    results = results.relative_to(folder, base=base or folder)
    files = ReportFiles(page, page.with_suffix(".json"), page.with_suffix(".md"))
    names = (files.json.name, files.markdown.name)
    markdown = results.to_markdown()
    html = render_page(results, folder, max_bytes=max_bytes, names=names, progress=progress)
    write_json(files.json, results.to_json())
    write_text(files.markdown, markdown)
    write_text(page, html)
    return files


def render_page(
    results: Results,
    base: Path,
    *,
    max_bytes: int,
    names: Sequence[str] = (),
    progress: Progress = quiet,
) -> str:
    """Return the whole page as HTML.

    Args:
        results: what to draw.
        base: folder that relative image paths start from.
        max_bytes: the page's largest size in UTF-8.
        names: names of the files written next to the page, for the footer.
        progress: called while images are made.

    Raises:
        PalpateError: if scores of different settings would share a column, or the text alone is
            larger than ``max_bytes``.
    """
    rows, essential = image_rows(results)
    hidden = ("matrix", "labels", "classes")
    fixed = {
        "results": results,
        "purpose": sentences.purpose(results),
        "facts": list(results.facts) or sentences.summary_lines(results),
        "tables": score_tables(results.scores),
        "heats": heat_tables(results.scores),
        "details": [
            (s, plain({k: v for k, v in s.details.items() if k not in hidden}))
            for s in results.scores
        ],
        "settings": settings_of(results),
        "style": Markup(_template("style.css")),
        "names": names,
        "version": __version__,
    }

    def draw(album: Album) -> str:
        notes = [*map(sentence, results.notes), *_album_notes(album, len(rows))]
        page = environment().get_template("page.html.j2")
        return page.render(
            **fixed,
            notes=notes,
            images=album.rows,
            gallery=_gallery(results, album),
            strips=[
                (strip, album.rows[id(strip)])
                for strip in results.strips
                if id(strip) in album.rows
            ],
        )

    bare = len(draw(Album({}, 0)).encode())
    if bare > max_bytes:
        must = f"must hold at least the text of the page ({bare:,} bytes)"
        fix = f"Allow {2 * bare:,}"
        raise PalpateError(must, f"{max_bytes:,}", fix, argument="max_bytes")
    budget = max_bytes - bare
    while True:
        html = draw(fit(rows, base, budget, essential, progress))
        if (excess := len(html.encode()) - max_bytes) <= 0:
            return html
        budget -= excess + 1_000


def image_rows(results: Results) -> tuple[dict[Hashable, list[Wanted]], int]:
    """Return all rows of images by key, the most important first, and how many are essential.

    Pairs take turns: every list of every audit shows its strongest pair before any shows its
    second. Keys are (audit, list, pair) and ``id`` of a gallery item.
    """
    pairs: dict[Hashable, list[Wanted]] = {}
    folded_pairs: dict[Hashable, list[Wanted]] = {}
    lists = [
        (a, k, pair_list.pairs, audits.head_of(audit))
        for a, audit in enumerate(results.audits)
        for k, pair_list in enumerate(audits.pair_lists(audit))
    ]
    for rank in range(MAX_PAIRS):
        target = pairs if rank < OPEN_PAIRS else folded_pairs
        for a, k, members, head in lists:
            if rank < len(members):
                target[a, k, rank] = _pair_images(members[rank], head)
    gallery = [(id(i), _gallery_images(i)) for i in in_turns(results.gallery)[:MAX_ROWS]]
    strips = [(id(strip), _strip_images(strip)) for strip in results.strips]
    first = [*pairs.items(), *gallery[:OPEN_ROWS], *strips]
    return dict([*first, *folded_pairs.items(), *gallery[OPEN_ROWS:]]), len(first)


def _pair_images(pair: LeakPair, head: str) -> list[Wanted]:
    """Photos above, tactile images below, test left; without photos, tactile images and contact."""
    samples = (("Test", pair.test), (head, pair.train))
    kinds = ("photo", "tactile image") if pair.has_photos else ("tactile image", "contact")
    return [
        Wanted(
            s.vision if kind == "photo" else s.tactile,
            f"{name} {kind}: {where(s)}",
            f"{name} {kind}",
            s.background or "" if kind == "contact" else None,
        )
        for kind in kinds
        for name, s in samples
        if pair.has_photos or pair.test.tactile or pair.train.tactile
    ]


def _gallery_images(item: GalleryItem) -> list[Wanted]:
    sample = item.sample
    name = f"{sample.material or 'sample'}, {where(sample)}"
    images = [
        Wanted(sample.vision, f"Photo: {name}", "Photo"),
        Wanted(sample.tactile, f"Real tactile image: {name}", "Real"),
        Wanted(item.generated, f"Generated tactile image: {name}", "Generated"),
    ]
    if item.background is not None:
        images.append(Wanted(item.background, f"Sensor without contact: {name}", "No contact"))
    return images


def _strip_images(strip: Strip) -> list[Wanted]:
    """The query, then what was retrieved; a text has no image."""
    texts = (strip.query_text, *(match.text for match in strip.matches))
    samples = (strip.query, *(match.sample for match in strip.matches))
    kinds = (strip.queries, *[strip.keys] * len(strip.matches))
    labels = ["Query"]
    labels += [f"{m.similarity:.2f}{' right' if m.right else ''}" for m in strip.matches]
    return [
        Wanted(
            None if text else getattr(sample, kind, None),
            text or f"{kind} image: {where(sample)}",
            label,
        )
        for text, sample, kind, label in zip(texts, samples, kinds, labels, strict=True)
    ]


def material_of(sample: SampleRef) -> str:
    """Return the material to group by."""
    return sample.material or "Material not given"


def in_turns(items: Sequence[GalleryItem]) -> list[GalleryItem]:
    """Return the items so that every material comes once before any comes twice."""
    queues: defaultdict[str, list[GalleryItem]] = defaultdict(list)
    for item in items:
        queues[material_of(item.sample)].append(item)
    return [item for turn in zip_longest(*queues.values()) for item in turn if item is not None]


def _gallery(results: Results, album: Album) -> list[dict[str, list[Any]]]:
    """The gallery rows that fit, by material, as (item, images): those open, and those folded."""
    shown = [item for item in in_turns(results.gallery) if id(item) in album.rows]
    groups: list[dict[str, list[Any]]] = []
    for items in (shown[:OPEN_ROWS], shown[OPEN_ROWS:]):
        by_material: defaultdict[str, list[Any]] = defaultdict(list)
        for item in items:
            by_material[material_of(item.sample)].append((item, album.rows[id(item)]))
        groups.append(dict(sorted(by_material.items(), key=lambda pair: pair[0].casefold())))
    return groups


def _album_notes(album: Album, wanted: int) -> list[str]:
    notes: list[str] = []
    if album.broken:
        images = plural(album.broken, "image")
        notes.append(f"{images} could not be read; a placeholder names the file.")
    if len(album.rows) < wanted:
        skipped = plural(wanted - len(album.rows), "row")
        notes.append(
            f"{skipped} of images were skipped and the others made at most {album.side} px to keep "
            "the page within its size."
        )
    elif 0 < album.side < 128:
        notes.append(f"Images were shrunk to {album.side} px to keep the page within its size.")
    return notes


def _template(name: str) -> str:
    return (resources.files("palpate.report") / "templates" / name).read_text(encoding="utf-8")


@cache
def environment() -> Environment:
    """Return Jinja2 with escaping on and unknown names as errors."""
    env = Environment(
        loader=FunctionLoader(_template),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        auto_reload=False,
    )
    functions: dict[str, Any] = {
        "hints": HINTS,
        "how_to_read": HOW_TO_READ,
        "open_pairs": OPEN_PAIRS,
        "table_facts": table_facts,
        "long_list": LONG_LIST,
        "like_rows": _like_rows,
    }
    for module in (audits, plots, sentences):
        functions |= {k: v for k, v in vars(module).items() if callable(v)}
    env.globals.update(functions)
    words: dict[str, Any] = {"count": count, "number": number}
    words |= {"percent": percent, "plural": plural}
    env.filters.update(words)
    env.filters.update(
        emphasize=_emphasize,
        leaf=_leaf,
        plain=plain,
        unbroken=_unbroken,
        sentence=sentence,
        confidence=confidence,
    )
    return env


def _unbroken(line: str) -> str:
    """Keep percentages on one line."""
    return re.sub(r"(?<=\d) %", "\u00a0%", line)


def _emphasize(line: str) -> Markup:
    """Return the line, escaped, with its first number marked."""
    line = _unbroken(line)
    match = _NUMBER.search(line)
    if match is None:
        return escape(line)
    return Markup("{}<b>{}</b>{}").format(line[: match.start()], match.group(), line[match.end() :])


def _leaf(value: Any) -> Markup:
    """Return a setting's value; the first twelve digits of a digest (its short name) stand out."""
    if value is None:
        return Markup('<span class="none">none</span>')
    if isinstance(value, bool):
        return Markup("yes" if value else "no")
    if isinstance(value, int | float):
        return escape(f"{value:g}" if isinstance(value, float) else f"{value}")
    words = str(value)
    if _DIGEST.fullmatch(words):
        cut = words.find(":") + 13
        return Markup('<code class="digest"><b>{}</b>{}</code>').format(words[:cut], words[cut:])
    is_path = "/" in words or "\\" in words
    return Markup("<code>{}</code>").format(words) if is_path else escape(words)


def _like_rows(value: Mapping[str, Any]) -> list[str]:
    """Return the keys that all of at least two flat entries share; such settings are a table."""
    rows = list(value.values())
    if len(rows) < 2 or not all(isinstance(r, Mapping) and r for r in rows):
        return []
    same = all(list(r) == list(rows[0]) for r in rows)
    nested = any(isinstance(v, Mapping | list) for r in rows for v in r.values())
    return list(rows[0]) if same and not nested else []
