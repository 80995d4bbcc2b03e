"""The page in a browser, from disk: no request, no message, every image decoded, no overflow.

Screenshots are kept in ``$PALPATE_ARTIFACTS``, if that is set. The browser is Debian's
chromium, or ``$PALPATE_CHROMIUM``.
"""

import dataclasses
import os
import re
import runpy
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from forge.results import (
    clean_audit,
    difference,
    full_audit,
    full_results,
    images,
    pretraining_audit,
    score,
    small_audit,
    study_results,
    text_note,
)
from palpate.core import SampleRef
from palpate.report import write_report
from palpate.report.records import Claim, GalleryItem, LeakPair, StudyTable
from palpate.report.results import Results

LONG = "a_recording_with_a_name_that_no_line_of_a_phone_can_hold_2024_11_21_rig_b"

pytestmark = pytest.mark.browser


def long_results(folder):
    """Results with every section, long names and undefined values."""
    results = full_results(folder, 48, 200)
    lost = SampleRef("lost", LONG, 3, material="wood", vision=f"{LONG}/{LONG}.png")
    gallery = [*results.gallery, GalleryItem(lost, "absent.png")]
    gallery[3] = dataclasses.replace(gallery[3], background=gallery[3].generated)
    shown = [item.sample for item in gallery[:9]]
    pairs = [LeakPair(a, b, 3 * k + 1) for k, (a, b) in enumerate(pairwise(shown))]
    scores = [
        score(metric, subject, notes=(text_note(LONG),), split="5b" * 32)
        for metric in ("TMMD", "I-TMMD", "CI-TMMD")
        for subject in ("generated", "real", f"baseline {LONG}")
    ]
    matrix = np.random.default_rng(0).uniform(0, 3, (18, 18)).tolist()
    details = {"matrix": matrix}
    scores.append(score("D-TMMD", "background", None, details=details, split="5b" * 32))
    scores.append(difference("generated", LONG, split="5b" * 32))
    scores.append(score("SSIM", "generated", 0.49, settings={"path": f"/{LONG}/{LONG}"}))
    settings = {"data": {"root": f"/data/{LONG}/{LONG}", "digest": "cd" * 32}, LONG: [LONG] * 40}
    return dataclasses.replace(
        results,
        title=f"Touch from sight, {LONG}",
        facts=["99.06 % of the test frames leak.", f"A fact about {LONG}.", "Real: 0.05."],
        audits=[small_audit(pairs), small_audit(name="NoLeak", leaked_fraction=0.0, gap_counts=())],
        scores=scores,
        gallery=gallery,
        settings=settings,
        commands=[f"palpate audit {LONG} -o {LONG}"],
    )


def long_study(folder):
    """A study whose every name is too long, with 20 rows."""
    results = study_results(folder, 12)
    rows = [[f"{LONG} {k}", score(value=k / 7), LONG, score(value=None)] for k in range(20)]
    table = StudyTable(LONG, f"On {LONG}.", ["method", LONG, "words", "none"], rows, True, [])
    claims = [Claim(f"{LONG} {k}", LONG, "undecided", LONG, [score()]) for k in range(12)]
    tables, claims = [*results.tables, table], [*results.claims, *claims]
    return dataclasses.replace(results, tables=tables, claims=claims)


def all_audits(folder):
    """Every kind of audit, and one of long names."""
    names = images(folder, 16)
    row = {"group": LONG, "train": 91982, "val": 12000, "test": 29879, "leaking": 29879}
    long = full_audit(names, name=LONG, matrix=[row])
    audits = [full_audit(names), clean_audit(), pretraining_audit(names), long]
    return Results("Audits", audits=audits)


OVERFLOW = """document.documentElement.scrollWidth > window.innerWidth
    || [...document.body.children].some(e => e.getBoundingClientRect().right > window.innerWidth)"""
#: Whether each histogram holds all of its parts, and whether no label lies on another.
INSIDE = """[...document.querySelectorAll('svg.histogram')].map(s => {
    const box = s.getBoundingClientRect();
    return [...s.querySelectorAll('text, rect, line')].every(e => {
        const b = e.getBoundingClientRect();
        return b.left >= box.left - 0.5 && b.right <= box.right + 0.5
            && b.top >= box.top - 0.5 && b.bottom <= box.bottom + 0.5;
    });
})"""
APART = """[...document.querySelectorAll('svg.histogram')].map(s => {
    const boxes = [...s.querySelectorAll('text')].map(e => e.getBoundingClientRect());
    const above = (a, b) => a.bottom - 2 <= b.top, left = (a, b) => a.right <= b.left;
    return boxes.every((a, k) => boxes.every((b, j) =>
        j <= k || left(a, b) || left(b, a) || above(a, b) || above(b, a)));
})"""
UNCUT = """[...document.querySelectorAll('.stack, .matrix')]
    .every(t => t.scrollWidth <= t.parentElement.clientWidth)"""
ROLES = """[...document.querySelectorAll('.stack tbody td')]
    .every(e => e.getAttribute('role') === 'cell')"""
#: Colors of shaded cells and drawings, and of all text, on what is behind them.
DRAWN = """[...document.querySelectorAll('.matrix td, svg.histogram text')].map(e => {
    const options = {willReadFrequently: true};
    const canvas = document.createElement('canvas').getContext('2d', options);
    const rgb = color => {
        canvas.fillStyle = color;
        canvas.fillRect(0, 0, 1, 1);
        return `rgb(${canvas.getImageData(0, 0, 1, 1).data.slice(0, 3)})`;
    };
    const style = getComputedStyle(e), text = e.closest('svg') !== null;
    const paper = getComputedStyle(document.body).backgroundColor;
    const clear = text || style.backgroundColor === 'rgba(0, 0, 0, 0)';
    return rgb(text ? style.fill : style.color) + '|' + rgb(clear ? paper : style.backgroundColor);
})"""
WRITTEN = """[...document.querySelectorAll('main *, header *, footer *')]
    .filter(e => [...e.childNodes].some(n => n.nodeType === 3 && n.data.trim()))
    .filter(e => !e.closest('svg, .heat'))
    .map(e => {
        const color = e => getComputedStyle(e).backgroundColor;
        let b = e;
        while (b && color(b) === 'rgba(0, 0, 0, 0)') b = b.parentElement;
        return getComputedStyle(e).color + '|' + color(b ?? document.body);
    })"""
FOLDED = """[...document.querySelectorAll('details:not([open]) img')]
    .map(i => i.getBoundingClientRect().width > 0 && i.checkVisibility())"""
FOCUS = (
    """[document.activeElement.tagName, document.activeElement.getAttribute('aria-label') ?? '']"""
)
EAGER = """Promise.all([...document.images].map(image => {
    image.loading = 'eager';
    return image.decode();
}))"""
#: Text of claims and tables that is cut: wider than its box, where that does not scroll.
CUT = """[...document.querySelectorAll('#claims, #study')]
    .flatMap(s => [...s.querySelectorAll('th, td, p, li, summary, h3')])
    .filter(e => e.checkVisibility() && !e.closest('.hidden')
        && e.getBoundingClientRect().right > (e.closest('.wide') ? 1e9 : innerWidth))
    .map(e => e.textContent.slice(0, 80))"""
HEADS = "getComputedStyle(document.querySelector('.claims thead')).position"
DECODED = "[...document.images].map(i => [i.complete, i.naturalWidth, i.alt.length])"
UNFOLD = "document.querySelectorAll('details').forEach(d => { d.open = true })"


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A page with every section, one of audits, and those of studies, with names of all lengths."""
    folder = tmp_path_factory.mktemp("pages")
    makers = {"page": long_results, "audits": all_audits, "long": long_study}
    makers["study"] = lambda folder: study_results(folder, 40, 96)
    files = {}
    for name, make in makers.items():
        (folder / name).mkdir()
        limit = 10_000_000 if name == "page" else 1_500_000
        file = folder / name / "page.html"
        files[name] = write_report(make(folder / name), file, max_bytes=limit).page
    return files


@contextmanager
def opened(chromium, file, width=1280, scheme="light"):
    """The page; it must neither request anything else nor print a message."""
    viewport = {"width": width, "height": 900}
    context = chromium.new_context(viewport=viewport, color_scheme=scheme)
    page = context.new_page()
    messages, requests = [], []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(file.as_uri())
    yield page
    context.close()
    assert {url for url in requests if not url.startswith("data:")} == {file.as_uri()}
    assert messages == []


def screenshot(page, name):
    if folder := os.environ.get("PALPATE_ARTIFACTS"):
        page.screenshot(path=Path(folder) / f"{name}.png", full_page=True)


@pytest.mark.parametrize(("wide", "scheme"), [(True, "light"), (False, "dark")])
@pytest.mark.parametrize("name", ["page", "audits", "study", "long"])
def test_pages_fit_and_decode_every_image(chromium, pages, name, wide, scheme):
    width = 1280 if wide else {"page": 360, "audits": 360}.get(name, 390)
    with opened(chromium, pages[name], width, scheme) as page:
        for state in ("folded", "open"):
            if state == "open":
                page.evaluate(UNFOLD)
            screenshot(page, f"{name}-{width}-{scheme}-{state}")
            assert not page.evaluate(OVERFLOW), state
            assert page.evaluate(CUT) == []
        if name == "audits":  # no label lies on another, and nothing is cut off on a phone
            assert page.evaluate(INSIDE) == page.evaluate(APART) == [True] * 6
            assert wide or page.evaluate(UNCUT)
            assert page.evaluate(ROLES)
        elif name == "page":
            page.evaluate(EAGER)
            decoded = page.evaluate(DECODED)
            assert len(decoded) == 48 * 3 + 2 + 8 * 4
            assert all(complete and natural and alt for complete, natural, alt in decoded)
        elif not wide:  # claims become blocks, each value below its name
            assert page.evaluate(HEADS) == "absolute"


def luminance(color):
    """WCAG relative luminance of an ``rgb(r, g, b)`` string."""
    channels = [float(c) / 255 for c in color[color.index("(") + 1 : -1].split(",")[:3]]
    r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_has_the_contrast_of_wcag(chromium, pages, scheme):
    for file, ask in ((pages["audits"], DRAWN), (pages["page"], WRITTEN)):
        with opened(chromium, file, scheme=scheme) as page:
            pairs = set(page.evaluate(ask))
        assert len(pairs) >= 5
        for pair in pairs:
            a, b = sorted(map(luminance, pair.split("|")), reverse=True)
            assert (a + 0.05) / (b + 0.05) >= 4.5, pair


def test_the_keyboard_reaches_the_sections_and_the_wide_tables(chromium, pages):
    reached = []
    with opened(chromium, pages["page"], 360) as page:
        for _ in range(40):
            page.keyboard.press("Tab")
            reached.append(page.evaluate(FOCUS))
    tags = [tag for tag, _ in reached]
    assert tags[:6] == [*["A"] * 5, "FIGURE"]
    assert "SUMMARY" in tags
    assert any(tag == "DIV" and label == "Table: The verdict" for tag, label in reached)
    ask = """[...document.querySelectorAll('.wide')]
        .map(e => [e.tabIndex, e.scrollWidth > e.clientWidth])"""
    for width in (360, 1280):
        with opened(chromium, pages["page"], width) as page:
            assert all((tab == 0) == scrolls for tab, scrolls in page.evaluate(ask))


def test_a_printed_page_is_what_is_open_with_its_images(chromium, pages):
    with opened(chromium, pages["page"], 800) as page:
        page.emulate_media(media="print")
        folded = page.evaluate(FOLDED)
        assert len(folded) > 10
        assert not any(folded)
        pages = len(re.findall(rb"/Type\s*/Page\b", page.pdf()))
        page.evaluate(UNFOLD)
        assert len(re.findall(rb"/Type\s*/Page\b", page.pdf())) > pages


def test_a_sample_enlarges_by_click_and_by_key_and_commands_are_copied(chromium, pages):
    with opened(chromium, pages["page"]) as page:
        large = "document.querySelector('dialog[open] img')?.clientWidth ?? 0"
        page.click(".hero .row img >> nth=0")
        assert page.evaluate(large) > 200
        page.keyboard.press("Escape")
        assert page.evaluate(large) == 0
        page.focus("#gallery .row")
        page.keyboard.press("Enter")
        assert page.evaluate(large) > 200
        page.keyboard.press("Escape")
        page.click("#cite button")
        page.wait_for_function("document.querySelector('#cite button').textContent === 'Copied'")
        assert page.evaluate("getSelection().toString()").startswith(f"palpate audit {LONG}")


@pytest.mark.nightly
def test_pages_keep_the_limits_of_their_benchmark(chromium, pages, tmp_path):
    """Height, bytes, first screen, phone and print, as ``benchmarks/page.py`` measures them."""
    tool = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "page.py"))
    results = full_results(tmp_path, 48, 64)
    accuracy = score("material accuracy", "real", 0.6, details={"chance": 0.1})
    results = dataclasses.replace(results, scores=[*results.scores, accuracy])
    page, pictures = write_report(results, tmp_path / "page.html").page, tmp_path / "pictures"
    pictures.mkdir()
    for file, folder in ((pages["study"], None), (page, pictures)):
        facts = tool["measure"](chromium, file, (1280, 800), folder)
        assert tool["problems"](facts, (1280, 800)) == []
        assert facts["print pages"] <= 8
    assert {p.suffix for p in pictures.iterdir()} == {".png", ".pdf"}
    over = facts | {"bytes": 2_000_000, "light 390": facts["light 390"] | {"sideways": True}}
    assert len(tool["problems"](over, (1280, 500))) == 4
