"""How long and how large a page is, in a real browser; exits 1 over a limit.

    python benchmarks/page.py PAGE.html --viewport 1280x800 [--pictures FOLDER]

Prints, in light and dark: the height with folds closed, whether the first screen holds the hero
row (where there is one) and the cards, and whether a phone (390 px) would scroll sideways; then
bytes and printed pages. The browser is Debian's chromium, or ``$PALPATE_CHROMIUM``.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path
from typing import Any

#: Most pixels of height, and most bytes.
HEIGHT, BYTES = 6_400, 1_500_000
PHONE = 390
#: The lowest edge of what the first screen must hold, and how many cards there are.
FIRST = """(() => {
    const parts = [...document.querySelectorAll('.first .hero, .first .card')];
    const samples = document.querySelectorAll('.first .hero .row').length;
    const images = [...document.querySelectorAll('.first .hero img')].map(i => i.clientWidth);
    return {bottom: Math.max(0, ...parts.map(e => e.getBoundingClientRect().bottom)), samples,
        cards: document.querySelectorAll('.first .card').length, least: Math.min(...images)};
})()"""
TALL = "document.documentElement.scrollHeight"
#: Load what would be loaded on scrolling there, for a picture of all of it.
EAGER = """Promise.all([...document.images]
    .filter(image => !image.closest('details:not([open])'))
    .map(image => { image.loading = 'eager'; return image.decode(); }))"""
SIDEWAYS = "document.documentElement.scrollWidth > innerWidth"
#: CSS pixels between the margins of A4, and by how many the widest table is wider.
PAPER = 718
CUT = """(dispatchEvent(new Event('beforeprint')),
    [...document.querySelectorAll('table')].reduce((most, table) =>
        Math.max(most, Math.round(table.getBoundingClientRect().right - innerWidth)), 0))"""


def measure(browser: Any, page: Path, viewport: tuple[int, int], pictures: Path | None) -> dict:
    """Open the page in light and dark, wide and on a phone, and print it.

    Args:
        browser: of playwright.
        page: the HTML file.
        viewport: width and height in CSS pixels.
        pictures: folder for full-page pictures and the PDF, or None.
    """
    facts: dict[str, Any] = {"bytes": page.stat().st_size}
    for scheme in ("light", "dark"):
        for width, height in (viewport, (PHONE, viewport[1])):
            size = {"width": width, "height": height}
            tab = browser.new_page(viewport=size, color_scheme=scheme)
            tab.goto(page.resolve().as_uri())
            name = f"{scheme} {width}"
            facts[name] = {"height": tab.evaluate(TALL), "sideways": tab.evaluate(SIDEWAYS)}
            if width == viewport[0]:
                facts[name] |= tab.evaluate(FIRST)
            if pictures:
                tab.evaluate(EAGER)
                tab.screenshot(path=pictures / f"{scheme}-{width}.png", full_page=True)
                tab.screenshot(path=pictures / f"{scheme}-{width}-first.png")
            tab.close()
    tab = browser.new_page()
    tab.goto(page.resolve().as_uri())
    pdf = tab.pdf(path=pictures / "print.pdf" if pictures else None, format="A4")
    tab.emulate_media(media="print")
    tab.set_viewport_size({"width": PAPER, "height": viewport[1]})
    facts["cut in print"] = tab.evaluate(CUT)
    tab.close()
    return facts | {"print pages": len(re.findall(rb"/Type\s*/Page\b", pdf))}


def problems(facts: dict, viewport: tuple[int, int]) -> list[str]:
    """Return what is over a limit, in words; nothing if the page keeps to all."""
    found = [f"{facts['bytes']:,} bytes, over {BYTES:,}"] if facts["bytes"] > BYTES else []
    if facts["cut in print"]:
        found.append(f"a table is {facts['cut in print']} px wider than the paper")
    for name, seen in facts.items():
        if not isinstance(seen, dict):
            continue
        if seen["sideways"]:
            found.append(f"{name}: scrolls sideways")
        if "cards" not in seen:
            continue
        if seen["height"] > HEIGHT:
            found.append(f"{name}: {seen['height']:,} px tall, over {HEIGHT:,}")
        if seen["bottom"] > viewport[1]:
            found.append(f"{name}: the first screen ends at {seen['bottom']:.0f} px")
        if seen["cards"] < 3 or (seen["samples"] and seen["least"] < 160):
            found.append(f"{name}: {seen['cards']} cards, samples of {seen['least']} px")
    return found


def main() -> int:
    """Print what was measured and what is over a limit."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description="How long and how large a page is.")
    parser.add_argument("page", type=Path)
    parser.add_argument("--viewport", default="1280x800")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the page and its PDF")
    options = parser.parse_args()
    width, height = map(int, options.viewport.split("x"))
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    chromium = os.environ.get("PALPATE_CHROMIUM", "/usr/bin/chromium")
    with sync_playwright() as playwright:
        args = ["--no-sandbox", "--disable-gpu"]
        browser = playwright.chromium.launch(executable_path=chromium, args=args)
        facts = measure(browser, options.page, (width, height), options.pictures)
        browser.close()
    for name, seen in facts.items():
        print(f"{name}: {seen}")
    found = problems(facts, (width, height))
    print("\n".join(f"OVER: {line}" for line in found) or "within all limits")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
