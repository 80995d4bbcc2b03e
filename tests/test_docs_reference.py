"""The reference pages that are made from the code are current."""

import importlib.util
import sys
from pathlib import Path

import pytest

TOP = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def recipe():
    path = TOP / "recipes" / "reference_pages.py"
    spec = importlib.util.spec_from_file_location("reference_pages", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["reference_pages"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["world_options.md", "commands.md"])
def test_pages_are_current(recipe, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "96")
    text = (TOP / "docs" / "reference" / name).read_text(encoding="utf-8")
    assert recipe.PAGES[name]() == text, "run: python recipes/reference_pages.py --write"
