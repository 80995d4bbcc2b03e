"""Every answer shows itself once: by ``str``, by ``repr`` at the prompt, and in a notebook."""

import builtins
import sys
from types import ModuleType

import numpy as np
import pytest

import palpate as pp
from palpate.captions.captioning import Captions, Estimate
from palpate.core import Split
from palpate.core.shown import Shown
from palpate.data.backgrounds import Backgrounds
from palpate.data.imported import Imported
from palpate.diffusion.generated import Generated
from palpate.encoders.embedded import embed_dataset
from palpate.metrics import tmmd
from palpate.report.results import Results
from palpate.studies.verifying import Check, Verification


class ZMQInteractiveShell:
    """What Jupyter's shell is called, by which libraries detect a notebook."""


@pytest.fixture
def notebook(monkeypatch):
    """What is displayed in a notebook by itself, besides the value of its cell."""
    displayed, module = [], ModuleType("IPython.display")
    module.display = lambda *objects, **_: displayed.extend(objects)
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    monkeypatch.setattr(builtins, "get_ipython", ZMQInteractiveShell, raising=False)
    return displayed


@pytest.fixture
def answers(small_manifest, tmp_path):
    """One answer of each kind, made where it takes no seconds."""
    rng = np.random.default_rng(0)
    split = Split({i: "test" if k % 4 == 0 else "train" for k, i in enumerate(small_manifest.ids)})
    score = tmmd(rng.normal(size=(40, 8)), rng.normal(size=(40, 8)), normalize=True)
    record = {"counts": {"texts": 3}, "digest": "0", "model": "m", "template": None, "per": "video"}
    checks = [Check("a", "same"), Check("b", "differs", "1 is 2")]
    return [
        small_manifest,
        split,
        pp.split(small_manifest),
        pp.audit(small_manifest, split=split),
        score,
        Results("", scores=[score]),
        Results(""),
        pp.validate(small_manifest.root),
        Imported(small_manifest, [], {}, 0, []),
        Backgrounds(small_manifest, tmp_path, 1, 2, 3, 4, {"v0": "reference"}, []),
        Captions(small_manifest.table, record, tmp_path),
        Estimate(3, 2),
        embed_dataset(small_manifest.root, "palpate/handcrafted", tmp_path / "embedded"),
        Generated(tmp_path, {"a": "a.png"}, notice="Made by a generator."),
        Verification("results.json", checks),
    ]


def test_each_shows_itself_once_and_equally(answers, notebook, capsys):
    kinds = {type(answer) for answer in answers}
    assert kinds >= {kind for kind in subclasses(Shown) if kind.__module__.startswith("palpate")}
    for answer in answers:
        text = str(answer)
        assert text.strip(), type(answer)
        assert repr(answer) == text
        page = answer._repr_html_()
        assert page.count("<pre") == 1
        assert page.count(text.split()[0]) >= 1
        assert not notebook, type(answer)  # the notebook shows the value of its cell alone
    assert capsys.readouterr() == ("", "")


def test_an_answer_reads_in_a_notebook_as_elsewhere(answers, notebook, monkeypatch):
    there = [str(answer) for answer in answers]
    monkeypatch.delattr(builtins, "get_ipython")
    assert there == [str(answer) for answer in answers]


def subclasses(cls):
    """All classes below one that have no further ones."""
    below = cls.__subclasses__()
    return {each for child in below for each in subclasses(child)} or {cls}
