"""The reference pages that are made from the code hold all of it."""

import importlib.util
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from palpate.cli import VERBS
from palpate.sim import WorldOptions

TOP = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def recipe():
    path = TOP / "recipes" / "reference_pages.py"
    spec = importlib.util.spec_from_file_location("reference_pages", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["reference_pages"] = module
    spec.loader.exec_module(module)
    return module


def test_the_pages_hold_every_verb_and_every_option_of_a_world(recipe, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "96")
    recipe.write(tmp_path)
    commands = (tmp_path / "commands.md").read_text(encoding="utf-8")
    assert commands.count("usage: palpate ") == len(VERBS)
    options = (tmp_path / "world_options.md").read_text(encoding="utf-8")
    assert all(f"| `{field.name}` |" in options for field in fields(WorldOptions))
