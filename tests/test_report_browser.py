"""The page in a browser, from disk: no request, no message, every image decoded, no overflow.

Screenshots are kept in ``$PALPATE_ARTIFACTS`` (default ``artifacts/``). The browser is Debian's
chromium, or ``$PALPATE_CHROMIUM``.
"""

import dataclasses
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from palpate.core import SampleRef
from palpate.report import write_report
from palpate.report.results import GalleryItem, LeakPair, Results
from report_fixtures import (
    clean_audit,
    difference,
    full_audit,
    full_results,
    images,
    pretraining_audit,
    score,
    small_audit,
    text_note,
)

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


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    return write_report(long_results(folder), folder / "page.html").page


def opened(chromium, file, width, scheme):
    """The page, the folder of screenshots, and lists that fill with its messages and requests."""
    artifacts = Path(os.environ.get("PALPATE_ARTIFACTS", "artifacts"))
    artifacts.mkdir(parents=True, exist_ok=True)
    page = chromium.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme
    ).new_page()
    messages, requests = [], []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(file.as_uri())
    return page, artifacts, messages, requests


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 360])
def test_page_in_chromium(chromium, page_file, width, scheme):
    page, artifacts, messages, requests = opened(chromium, page_file, width, scheme)
    for state in ("folded", "open"):
        if state == "open":
            page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true })")
        page.screenshot(path=artifacts / f"page-{width}-{scheme}-{state}.png", full_page=True)
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), state
        assert page.evaluate(
            "Math.max(...[...document.body.children].map(e => e.getBoundingClientRect().right)) <= window.innerWidth"
        )
    pictures = page.evaluate(
        "[...document.images].map(i => [i.complete, i.naturalWidth, i.alt.length])"
    )
    page.context.close()
    assert len(pictures) == 48 * 3 + 1 + 8 * 4
    assert all(complete and natural > 0 and alt > 0 for complete, natural, alt in pictures)
    assert [
        url for url in requests if url != page_file.as_uri() and not url.startswith("data:")
    ] == []
    assert page_file.as_uri() in requests
    assert messages == []


@pytest.fixture(scope="module")
def audit_page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("audits")
    names = images(folder, 16)
    long = full_audit(
        names,
        name=LONG,
        matrix=[{"group": LONG, "train": 91982, "val": 12000, "test": 29879, "leaking": 29879}],
    )
    results = Results(
        "Audits", audits=[full_audit(names), clean_audit(), pretraining_audit(names), long]
    )
    return write_report(results, folder / "page.html").page


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 360])
def test_audits_in_chromium(chromium, audit_page, width, scheme):
    page, artifacts, messages, requests = opened(chromium, audit_page, width, scheme)
    page.screenshot(path=artifacts / f"audits-{width}-{scheme}.png", full_page=True)
    page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true })")
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    inside = """[...document.querySelectorAll('svg.histogram')].map(s => {
        const box = s.getBoundingClientRect();
        return [...s.querySelectorAll('text, rect, line')].every(e => {
            const b = e.getBoundingClientRect();
            return b.left >= box.left - 0.5 && b.right <= box.right + 0.5 && b.top >= box.top - 0.5 && b.bottom <= box.bottom + 0.5;
        });
    })"""
    assert page.evaluate(inside) == [True] * 6
    apart = """[...document.querySelectorAll('svg.histogram')].map(s => {
        const boxes = [...s.querySelectorAll('text')].map(e => e.getBoundingClientRect());
        return boxes.every((a, k) => boxes.every((b, j) => j <= k || a.right <= b.left || b.right <= a.left || a.bottom - 2 <= b.top || b.bottom - 2 <= a.top));
    })"""
    assert page.evaluate(apart) == [True] * 6  # no label lies on another
    if width == 360:  # nothing of the tables of signals and costs nor of the matrix is cut off
        assert page.evaluate(
            "[...document.querySelectorAll('.stack, .matrix')].every(t => t.scrollWidth <= t.parentElement.clientWidth)"
        )
        assert (
            page.evaluate(
                "getComputedStyle(document.querySelector('.stack td'), '::before').content"
            )
            == '"Flagged"'
        )
    roles = page.evaluate(
        "[...document.querySelectorAll('.stack tbody td')].every(e => e.getAttribute('role') === 'cell')"
    )
    page.context.close()
    assert roles
    assert [
        url for url in requests if url != audit_page.as_uri() and not url.startswith("data:")
    ] == []
    assert messages == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_shaded_counts_and_drawings_can_be_read(chromium, audit_page, scheme):
    context = chromium.new_context(color_scheme=scheme)
    page = context.new_page()
    page.goto(audit_page.as_uri())
    pairs = page.evaluate("""[...document.querySelectorAll('.matrix td, svg.histogram text')].map(e => {
        const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
        const rgb = color => { canvas.fillStyle = color; canvas.fillRect(0, 0, 1, 1); return `rgb(${canvas.getImageData(0, 0, 1, 1).data.slice(0, 3)})`; };
        const style = getComputedStyle(e), text = e.closest('svg') !== null;
        const paper = getComputedStyle(document.body).backgroundColor;
        const clear = text || style.backgroundColor === 'rgba(0, 0, 0, 0)';
        return rgb(text ? style.fill : style.color) + '|' + rgb(clear ? paper : style.backgroundColor);
    })""")
    context.close()
    assert len(pairs) > 100
    for pair in set(pairs):
        a, b = sorted((luminance(c) for c in pair.split("|")), reverse=True)
        assert (a + 0.05) / (b + 0.05) >= 4.5, pair


def luminance(color):
    """WCAG relative luminance of an ``rgb(r, g, b)`` string."""
    channels = [float(c) / 255 for c in color[color.index("(") + 1 : -1].split(",")[:3]]
    r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_the_contrast_of_wcag(chromium, page_file, scheme):
    context = chromium.new_context(color_scheme=scheme)
    page = context.new_page()
    page.goto(page_file.as_uri())
    pairs = page.evaluate("""[...new Set([...document.querySelectorAll('main *, header *, footer *')]
        .filter(e => [...e.childNodes].some(n => n.nodeType === 3 && n.data.trim()) && !e.closest('svg, .heat'))
        .map(e => {
            let b = e;
            while (b && getComputedStyle(b).backgroundColor === 'rgba(0, 0, 0, 0)') b = b.parentElement;
            return getComputedStyle(e).color + '|' + getComputedStyle(b ?? document.body).backgroundColor;
        }))]""")
    context.close()
    assert len(pairs) >= 5
    for pair in pairs:
        a, b = sorted((luminance(c) for c in pair.split("|")), reverse=True)
        assert (a + 0.05) / (b + 0.05) >= 4.5, pair


def test_keyboard_reaches_the_sections_and_the_wide_tables(chromium, page_file):
    context = chromium.new_context(viewport={"width": 360, "height": 900})
    page = context.new_page()
    page.goto(page_file.as_uri())
    reached = []
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                "[document.activeElement.tagName, document.activeElement.getAttribute('aria-label') ?? '']"
            )
        )
    context.close()
    tags = [tag for tag, _ in reached]
    assert tags[:6] == ["A"] * 6
    assert "SUMMARY" in tags
    assert any(
        tag == "DIV" and label.startswith("Table: Tactile features") for tag, label in reached
    )


def test_printed_page_opens_what_is_folded(chromium, page_file):
    context = chromium.new_context(viewport={"width": 800, "height": 900})
    page = context.new_page()
    page.goto(page_file.as_uri())
    ask = """[...document.querySelectorAll('details:not([open]) img')].map(i => i.getBoundingClientRect().width > 0 && i.checkVisibility())"""
    folded = page.evaluate(ask)
    page.emulate_media(media="print")
    page.wait_for_function(
        "getComputedStyle(document.querySelector('details'), '::details-content').contentVisibility === 'visible'"
    )
    printed = page.evaluate(ask)
    context.close()
    assert len(folded) == len(printed) > 10
    assert not any(folded)
    assert all(printed)
