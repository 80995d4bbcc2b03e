"""The page: results -> one HTML file that needs no network and no other file.

Jinja2 with escaping draws ``templates/page.html.j2``; style sheet and script (copy buttons, larger
images) are inlined; a Content-Security-Policy in the page forbids every request and every other
script. Images are ``data:`` URIs that fit what the text leaves of ``max_bytes``.
"""

from __future__ import annotations

import base64
import datetime
import hashlib
import re
from collections import defaultdict
from collections.abc import Hashable, Sequence
from functools import cache
from importlib import resources
from itertools import compress, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape

from palpate._version import __version__
from palpate.core import (
    PalpateError,
    Progress,
    SampleRef,
    Score,
    plain,
    quiet,
    short,
    write_json,
    write_text,
)
from palpate.report import audits, findings, first_screen, labels, notes, plots, study, tables
from palpate.report.labels import number, plural, where
from palpate.report.notes import sentence
from palpate.report.records import GalleryItem, LeakPair, Strip
from palpate.report.results import Results
from palpate.report.tables import REAL, Cell, Head, Row, Table, families
from palpate.report.thumbnails import Album, ImageRequest, fit

#: Samples of the first screen; their images take at most a third of the bytes.
HERO_ROWS = 3
#: Gallery rows and pairs of one list that show at once, and that the page holds at all.
OPEN_ROWS, MAX_ROWS = 8, 160
OPEN_PAIRS, MAX_PAIRS = 6, 24
#: Claims that show at once.
OPEN_CLAIMS = 6
#: A list in the settings is cut here; the JSON keeps it whole.
LONG_LIST = 24
#: What the cells of a matrix are.
DIVERGENCE = (
    "Row against column; the diagonal compares two halves of one class. Stronger color: farther "
    "apart."
)
CONFUSION = (
    "Rows: the true class of test samples. Columns: what the classifier called them, as a share of "
    "the row."
)
_DIGEST = re.compile(r"(?:sha256:)?[0-9a-f]{32,128}")
#: What to cite: palpate, and the paper whose splits, metrics and generator it implements.
CITATIONS = (
    """@software{palpate,
  title   = {palpate: tactile images from photos, splits that do not leak, scores with intervals},
  author  = {{The palpate developers}},
  version = {VERSION}
}""".replace("VERSION", __version__),
    """@inproceedings{gungor2025towards,
  title     = {Towards Generalization of Tactile Image Generation:
               Reference-Free Evaluation in a Leakage-Free Setting},
  author    = {Gungor, C. and Eppinger, D. and Kovashka, A.},
  booktitle = {Proceedings of the IEEE/CVF International Conference on Computer Vision (ICCV)},
  year      = {2025}
}""",
)


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
    max_bytes: int = 1_500_000,
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
    folder.mkdir(parents=True, exist_ok=True)  # paths of images lead through it
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
    """Return the whole page as HTML of at most ``max_bytes``; ``names`` are files for the footer.

    Raises:
        PalpateError: if scores of different settings would share a column, or the text alone is
            larger than ``max_bytes``.
    """
    rows, essential = image_rows(results)
    by_family = families(results.scores, results.controls)
    columns = first_screen.telling_columns(by_family)
    cards = first_screen.cards(results, columns, results.controls)
    samples = gallery_images(results.gallery)
    hero_rows: dict[Hashable, list[ImageRequest]] = {
        id(item): images for item, images in samples[:HERO_ROWS]
    }
    script = _template("page.js")
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    fixed = {
        "results": results,
        "about": first_screen.about(results, date, __version__),
        "purpose": _lede(results),
        "caution": first_screen.caution(results),
        "facts": list(results.facts) or ([] if cards else findings.summary_lines(results)),
        "cards": cards,
        "row_labels": [request.label for request in samples[0][1]] if samples else [],
        "studied": list(map(study.of_study, results.tables)),
        "families": by_family,
        "verdict": tables.grid(columns),
        "reading": first_screen.annotated(by_family),
        "heats": matrices(results),
        "settings": plain(results.settings),
        "citations": CITATIONS,
        "style": Markup(_template("style.css")),
        "script": Markup(script),
        "script_hash": _hash(script),
        "names": names,
        "version": __version__,
    }

    def draw(first: Album, album: Album) -> str:
        hero, gallery = (
            [(item, a.rows[id(item)]) for item, _ in samples if id(item) in a.rows]
            for a in (first, album)
        )
        everything = Album({**first.rows, **album.rows}, album.side)
        notes = [sentence(note) for note in results.notes]
        notes += _album_notes(everything, len(hero_rows) + len(rows))
        return (
            environment()
            .get_template("page.html.j2")
            .render(
                fixed,
                notes=notes,
                hero=hero,
                images=album.rows,
                gallery=(gallery[:OPEN_ROWS], gallery[OPEN_ROWS:]),
                drawn=len(hero) + len(gallery),
                strips=[(s, album.rows[id(s)]) for s in results.strips if id(s) in album.rows],
            )
        )

    bare = len(draw(Album({}, 0), Album({}, 0)).encode())
    if bare > max_bytes:
        must = f"must hold at least the text of the page ({bare:,} bytes)"
        fix = f"Allow {2 * bare:,}"
        raise PalpateError(must, f"{max_bytes:,}", fix, argument="max_bytes")
    first = fit(hero_rows, base, (max_bytes - bare) // 3, HERO_ROWS)
    budget = max_bytes - len(draw(first, Album({}, 0)).encode())
    while True:
        html = draw(first, fit(rows, base, budget, essential, progress))
        if (excess := len(html.encode()) - max_bytes) <= 0:
            return html
        budget -= excess + 1_000


def image_rows(results: Results) -> tuple[dict[Hashable, list[ImageRequest]], int]:
    """Return all rows of images by key, the most important first, and how many are essential.

    Pairs take turns: every list of every audit shows its strongest pair before any shows its
    second. Keys are (audit, list, pair) and ``id`` of a gallery item.
    """
    pairs: dict[Hashable, list[ImageRequest]] = {}
    folded_pairs: dict[Hashable, list[ImageRequest]] = {}
    lists = [
        (a, k, pair_list.pairs, audits.head_of(audit))
        for a, audit in enumerate(results.audits)
        for k, pair_list in enumerate(audits.pair_lists(audit))
    ]
    for rank in range(MAX_PAIRS):
        target = pairs if rank < OPEN_PAIRS else folded_pairs
        for a, k, members, head in lists:
            if rank < len(members):
                target[a, k, rank] = pair_images(members[rank], head)
    gallery = [(id(i), w) for i, w in gallery_images(results.gallery)[HERO_ROWS:MAX_ROWS]]
    strips = [(id(strip), _strip_images(strip)) for strip in results.strips]
    first = [*gallery[:OPEN_ROWS], *pairs.items(), *strips]
    return dict([*first, *gallery[OPEN_ROWS:], *folded_pairs.items()]), len(first)


def pair_images(pair: LeakPair, head: str) -> list[ImageRequest]:
    """Photos above, tactile images below, test left; without photos, tactile images and contact."""
    samples = (("Test", pair.test), (head, pair.train))
    kinds = ("photo", "tactile image") if pair.has_photos else ("tactile image", "contact")
    return [
        ImageRequest(
            s.vision if kind == "photo" else s.tactile,
            f"{name} {kind}: {where(s)}",
            f"{name} {kind}",
            s.background or "" if kind == "contact" else None,
        )
        for kind in kinds
        for name, s in samples
        if pair.has_photos or pair.test.tactile or pair.train.tactile
    ]


def gallery_images(gallery: Sequence[GalleryItem]) -> list[tuple[GalleryItem, list[ImageRequest]]]:
    """Every sample with its images, materials in turn; a column that no sample has is skipped.

    Where a background is known, the contacts follow: without the background, both amplified alike.
    """
    rows: list[tuple[GalleryItem, list[ImageRequest]]] = []
    for item in in_turns(gallery):
        sample, background = item.sample, item.background or item.sample.background
        name = f"{sample.material or 'sample'}, {where(sample)}"
        tactile = (("Real", sample.tactile), ("Generated", item.generated))
        images = [ImageRequest(sample.vision, f"Photo: {name}", "Photo")]
        images += [ImageRequest(p, f"{kind} tactile image: {name}", kind) for kind, p in tactile]
        images += [
            ImageRequest(
                p and background and p,
                f"{kind} contact: {name}",
                f"{kind} contact",
                background,
                sample.tactile,
            )
            for kind, p in tactile
        ]
        rows.append((item, images))
    present = [
        any(image.path for image in column) for column in zip(*(w for _, w in rows), strict=True)
    ]
    return [(item, list(compress(images, present))) for item, images in rows]


def _strip_images(strip: Strip) -> list[ImageRequest]:
    """The query, then what was retrieved; a text has no image."""
    texts = (strip.query_text, *(match.text for match in strip.matches))
    samples = (strip.query, *(match.sample for match in strip.matches))
    kinds = (strip.queries, *[strip.keys] * len(strip.matches))
    labels = ["Query"]
    labels += [f"{m.similarity:.2f}{' right' if m.right else ''}" for m in strip.matches]
    return [
        ImageRequest(
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


def matrices(results: Results) -> list[Table]:
    """Return a table for each score whose details hold a square ``matrix`` of numbers.

    Only those of methods, unless there are none: without controls, and of several presets the
    first. ``details["classes"]`` names its rows, else they are numbered.
    """
    first: dict[Any, Score] = {}
    for score in results.scores:
        if score.a not in {REAL, *results.controls}:
            first.setdefault((score.measure, score.a, score.b), score)
    tables: list[Table] = []
    for score in first.values() or results.scores:
        matrix: Any = plain(score.details.get("matrix"))
        if not isinstance(matrix, list) or not all(
            isinstance(row, list) and len(row) == len(matrix) for row in matrix
        ):
            continue
        names = [*map(str, score.details.get("classes") or range(1, len(matrix) + 1))]
        values = [abs(v) for row in matrix for v in row if v is not None]
        digits, top = min(3, labels.decimals(values)), max(values, default=0.0) or 1.0
        rows = [
            [Cell(number(v, digits), share=round(max(0.0, v or 0.0) / top, 3)) for v in row]
            for row in matrix
        ]
        parts = [labels.label_of(score), labels.subject_of(score), score.settings.get("preset")]
        title = ", ".join(map(str, filter(None, parts)))
        if any(title == table.title for table in tables) and score.reference:
            title += f", reference {short(score.reference)}"
        text = CONFUSION if "accuracy" in score.metric else DIVERGENCE
        laid = [Row([Cell(name), *cells]) for name, cells in zip(names, rows, strict=True)]
        tables.append(Table(title, text, [*map(Head, ("", *names))], laid))
    return tables


def _lede(results: Results) -> str:
    """What the page shows; of audits alone, the question that the split asks."""
    lines = [] if results.scores or results.gallery else map(findings.question_line, results.audits)
    return next(filter(None, lines), "") or findings.purpose(results)


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


def _hash(script: str) -> str:
    """What a Content-Security-Policy names an inline script by."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}"


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
    functions = {
        name: value
        for module in (audits, findings, first_screen, labels, notes, plots, study, tables)
        for name, value in vars(module).items()
        if getattr(value, "__module__", "") == module.__name__
    }
    env.filters.update(functions, leaf=_leaf, plain=plain, unbroken=_unbroken)
    env.filters["label"] = lambda key: str(key).replace("_", " ")
    settings: dict[str, Any] = {
        "open_pairs": OPEN_PAIRS,
        "long_list": LONG_LIST,
        "READING": first_screen.READING,
        "open_claims": OPEN_CLAIMS,
        "verdict_marks": study.MARKS,
    }
    env.globals.update(functions | settings)
    return env


def _unbroken(line: str) -> str:
    """Keep percentages on one line."""
    return re.sub(r"(?<=\d) %", "\u00a0%", line)


def _leaf(value: Any) -> Markup:
    """Return a setting's value; of a digest the first twelve digits, its short name."""
    if value is None:
        return Markup('<span class="none">none</span>')
    if isinstance(value, bool):
        return Markup("yes" if value else "no")
    if isinstance(value, int | float):
        return escape(f"{value:g}" if isinstance(value, float) else f"{value}")
    words = str(value)
    if _DIGEST.fullmatch(words):
        return Markup("<code>{}</code>").format(words[: words.find(":") + 13])
    is_path = "/" in words or "\\" in words
    return Markup("<code>{}</code>").format(words) if is_path else escape(words)
