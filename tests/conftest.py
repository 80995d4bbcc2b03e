"""Fixtures for all tests: small trees in true layouts, and the shared real data where present."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from palpate.data.manifest import Manifest

TOP = Path(__file__).resolve().parents[1]
CHROMIUM = Path(os.environ.get("PALPATE_CHROMIUM", "/usr/bin/chromium"))
ARGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]


def shared_data() -> Path | None:
    """The folder of shared real data, or None."""
    place = Path(os.environ.get("PALPATE_SHARED_DATA", TOP.parent / "shared" / "data"))
    return place if place.is_dir() else None


@pytest.fixture(scope="session")
def real_data() -> Path:
    place = shared_data()
    if place is None:
        pytest.skip("no shared real data: set PALPATE_SHARED_DATA")
    return place


@pytest.fixture
def small_manifest(tmp_path: Path) -> Manifest:
    """Six videos of three materials, two touches of four frames each, with 32-pixel pictures."""
    rows = []
    rng = np.random.default_rng(0)
    for v in range(6):
        material = ["Wood", "Grass", "Brick"][v % 3]
        for touch in range(2):
            for k in range(4):
                frame = 100 * touch + k
                paths = {}
                for kind in ("vision", "tactile", "background"):
                    path = tmp_path / "root" / f"v{v}" / kind / f"{frame}.png"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    base = 40 * (v % 3) + 20 if kind != "background" else 100
                    Image.fromarray(
                        (base + rng.integers(0, 30, (32, 32, 3))).astype(np.uint8)
                    ).save(path)
                    paths[kind] = path.relative_to(tmp_path / "root").as_posix()
                rows.append(
                    {
                        "id": f"v{v}/{frame}",
                        "video": f"v{v}",
                        "frame": frame,
                        "contact": f"v{v}#{touch}",
                        "material": material,
                        **paths,
                    }
                )
    return Manifest.from_rows(rows, tmp_path / "root")


@pytest.fixture(scope="session")
def chromium():
    """Debian's chromium, driven by playwright; tests that need it skip where it is absent."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM.is_file():
        pytest.skip(f"no chromium at {CHROMIUM}; install it or set PALPATE_CHROMIUM")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGS)
        yield browser
        browser.close()
