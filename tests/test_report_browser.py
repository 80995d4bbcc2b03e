"""The page in a real browser, from disk: no request, no console message, every picture decoded, nothing wider than the window.

Screenshots are kept in ``$PALPATE_ARTIFACTS`` (default ``artifacts/``). The browser is Debian's chromium, or ``$PALPATE_CHROMIUM``.
"""

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from palpate.core import Note, SampleRef, Score
from palpate.report import write_report
from palpate.report.results import Audit, GalleryItem, LeakPair, Results
from report_fixtures import clean_audit, full_audit, images, pretraining_audit

LONG = "a_recording_with_a_name_that_no_line_of_a_phone_can_hold_2024_11_21_rig_b"

pytestmark = pytest.mark.browser


def touch(rng, kind, side):
    """A gel with a soft light and a relief of one of three kinds; (side, side, 3) uint8."""
    y, x = np.mgrid[0:side, 0:side] / side
    phase = rng.uniform(0, 6)
    relief = (
        np.sin(40 * x + phase),
        np.sin(25 * x + phase) * np.sin(25 * y),
        np.cos(60 * np.hypot(x - 0.5, y - 0.5) + phase),
    )[kind]
    light = np.stack([0.6 - 0.3 * y, 0.5 + 0.1 * x, 0.45 + 0.3 * y], axis=-1)
    return (
        (
            255
            * (
                light
                + 0.12 * relief[..., None] * np.array([1, -0.4, -1])
                + rng.normal(0, 0.01, (side, side, 3))
            )
        )
        .clip(0, 255)
        .astype(np.uint8)
    )


def forged(folder):
    """Results that use everything a page can hold, long names and undefined values among it."""
    rng = np.random.default_rng(0)
    materials = ("wood", "gravel", "synthetic fabric")
    gallery = []
    for k in range(48):
        kind, side = k % 3, 64 if k % 2 else 200
        names = [f"{what}{k}.png" for what in ("photo", "touch", "made")]
        for name in names:
            Image.fromarray(touch(rng, kind, side)).save(folder / name)
        sample = SampleRef(
            f"{LONG}/{k}",
            LONG if k == 0 else f"video{k % 5}",
            10 * k,
            materials[kind],
            names[0],
            names[1],
        )
        gallery.append(GalleryItem(sample, names[2], names[1] if k == 3 else None))
    gallery.append(
        GalleryItem(SampleRef("lost", material="wood", vision=f"{LONG}/{LONG}.png"), "absent.png")
    )
    pairs = [
        LeakPair(a.sample, b.sample, 3 * k + 1) for k, (a, b) in enumerate(pairwise(gallery[:9]))
    ]
    rows = [
        {"material": m, "train": 900, "test": 90, "groups_train": 9, "groups_test": 3}
        for m in materials
    ]
    audits = [
        Audit(
            "Orig",
            "video",
            91982,
            29879,
            120,
            106,
            100,
            29597,
            29597 / 29879,
            0,
            31,
            304.0,
            2485,
            [0, 30, 90, 300, 900, 2500],
            [0, 2400, 12080, 13002, 2115],
            pairs,
            rows,
            [Note("text", {"text": "One remark."})],
            "9f" * 32,
        ),
        Audit(
            "NoLeak", "video", 97000, 24000, 101, 25, 0, 0, 0.0, 0, materials=rows, split="5b" * 32
        ),
    ]
    common = {
        "estimator": "grouped",
        "bandwidth": 10.0,
        "scale": 1000.0,
        "encoder": "ab" * 32,
        "split": "5b" * 32,
        "n": 24000,
    }
    scores = []
    for k, metric in enumerate(("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD")):
        for subject, value in {"generated": 1.4 + k, "real": 0.05, f"baseline {LONG}": 2.9}.items():
            scores.append(
                Score(
                    metric,
                    subject,
                    value,
                    (0.8 * value, 1.2 * value),
                    null=(-0.05, 0.06),
                    floor=0.05,
                    note=LONG,
                    **common,
                )
            )
    matrix = rng.uniform(0, 3, (18, 18)).tolist()
    scores.append(
        Score(
            "D-TMMD",
            "background",
            None,
            note="Undefined: one picture.",
            details={"matrix": matrix},
            **common,
        )
    )
    scores.append(
        Score(
            "SSIM",
            "generated",
            0.49,
            (0.47, 0.51),
            higher_is_better=True,
            settings={"path": f"/{LONG}/{LONG}"},
        )
    )
    settings = {
        "data": {
            "root": f"/data/{LONG}/{LONG}",
            "digest": "cd" * 32,
            "split": {"seed": 0, "rule": {"group": "video"}},
        },
        LONG: [LONG] * 40,
    }
    facts = [
        "99.06 % of the test frames come from a video that train holds as well.",
        f"A fact about {LONG}.",
        "Real touch scores 0.05.",
    ]
    return Results(
        f"Touch from sight, {LONG}",
        facts,
        audits,
        scores,
        gallery,
        settings,
        [Note("text", {"text": "Synthetic data."})],
        [f"palpate audit {LONG} --out {LONG}"],
    )


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    return write_report(forged(folder), folder / "page.html").page


def opened(chromium, file, width, scheme):
    """The page, the folder for screenshots, and lists that fill with what the page says and asks for."""
    artifacts = Path(os.environ.get("PALPATE_ARTIFACTS", "artifacts"))
    artifacts.mkdir(parents=True, exist_ok=True)
    page = chromium.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme
    ).new_page()
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(file.as_uri())
    return page, artifacts, said, asked


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 360])
def test_page_in_chromium(chromium, page_file, width, scheme):
    page, artifacts, said, asked = opened(chromium, page_file, width, scheme)
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
    assert [url for url in asked if url != page_file.as_uri() and not url.startswith("data:")] == []
    assert page_file.as_uri() in asked
    assert said == []


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
    page, artifacts, said, asked = opened(chromium, audit_page, width, scheme)
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
    if (
        width == 360
    ):  # the tables of signals and of the cost are read downwards; nothing of them, nor of the matrix, is cut off
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
        url for url in asked if url != audit_page.as_uri() and not url.startswith("data:")
    ] == []
    assert said == []


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
def test_text_has_the_contrast_that_wcag_asks_for(chromium, page_file, scheme):
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
