"""The notebooks of examples/: they run, and the docs show what they print."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from palpate.core import PalpateError

TOP = Path(__file__).resolve().parents[1]
recipe = importlib.import_module("notebooks")
NAMES = [path.stem for path in recipe.NOTEBOOKS]


def numbers_left_out(text):
    """A page without numbers, digests and widths of columns, which processors may change."""
    return re.sub(r"[-\d.,]+|[0-9a-f]{8,}|\s+", " ", text)


@pytest.mark.parametrize("name", NAMES)
def test_a_page_shows_all_cells_of_its_notebook_and_notebooks_hold_no_output(name):
    notebook = nbformat.read(TOP / "examples" / f"{name}.ipynb", as_version=4)
    shown = (TOP / "docs" / "examples" / f"{name}.md").read_text("utf-8")
    for cell in notebook.cells:
        assert cell.source in shown
        assert not cell.get("outputs")
    assert shown.count("```text") + shown.count("![") >= len(notebook.cells) // 3
    assert "Error" not in shown


@pytest.mark.nightly
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_and_its_page_is_current(name, tmp_path):
    text, _ = recipe.page(recipe.run(TOP / "examples" / f"{name}.ipynb", tmp_path), name)
    stored = (TOP / "docs" / "examples" / f"{name}.md").read_text("utf-8")
    headings = [line for line in stored.splitlines() if re.match(r"#|[A-Z]\w+.*notes$", line)]
    assert all(line.split()[0] in text for line in headings)
    assert len(numbers_left_out(text)) == pytest.approx(len(numbers_left_out(stored)), rel=0.1)


def test_a_mistake_in_a_notebook_is_one_line():
    error = PalpateError("must be a folder", "a file", "Pass another", argument="data")
    assert error._render_traceback_() == [
        "PalpateError: `data` must be a folder. Got a file. Pass another."
    ]


def test_without_torch_the_door_says_which_extra_to_install():
    code = """
import json, sys
sys.modules.update(dict.fromkeys(("torch", "diffusers", "transformers", "safetensors")))
import palpate as pp
from palpate.core import PalpateError
lines = []
for name in ("TactilePipeline", "Encoder"):
    try:
        getattr(pp, name)
    except PalpateError as error:
        lines += error._render_traceback_()
print(json.dumps(lines))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = json.loads(run.stdout)
    assert len(lines) == 2
    for line in lines:
        assert line.startswith("MissingExtraError: palpate.")
        assert line.endswith("run: pip install -e '.[all]'")
        assert "\n" not in line
