"""The reference page that is made from the code holds all of it."""

import importlib.util
import sys
from pathlib import Path

import pytest

from palpate.cli import VERBS

TOP = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def recipe():
    path = TOP / "recipes" / "reference_pages.py"
    spec = importlib.util.spec_from_file_location("reference_pages", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["reference_pages"] = module
    spec.loader.exec_module(module)
    return module


def test_the_page_holds_every_verb(recipe, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "96")
    recipe.write(tmp_path)
    commands = (tmp_path / "commands.md").read_text(encoding="utf-8")
    assert commands.count("usage: palpate ") == len(VERBS)
