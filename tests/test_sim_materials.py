"""Added materials: what their functions may return, what they may be called, and that an edited one never enters a world begun without the edit."""

import dataclasses
import json

import numpy as np
import pytest

from palpate.core import PalpateError, ProblemsError, digest_folder, digest_json, digest_lines
from palpate.sim import MATERIALS, PRESETS, Material, Surface, WorldOptions, write_world
from palpate.sim.materials import draw_surface
from palpate.sim.materials.entries import added_materials

TINY = dataclasses.replace(PRESETS["tiny"], size=16, tile=64)
SOURCE = """
from palpate.sim import Surface
import numpy as np
DEPTH = {depth}
def deep(field):
    return field * {factor}
def cork(tile, rng, slack={slack}):
    return Surface(deep(tile.noise(1.0, 8.0)) * DEPTH, np.full((tile.n, tile.n, 3), 0.5), "only", ("springy", "{word}"))
"""


def made(depth=0.1, factor=1.0, slack=0, word="dry"):
    """A function as a user's module has it, without a source that could be read."""
    names = {"__name__": "cork_module"}
    exec(
        compile(
            SOURCE.format(depth=depth, factor=factor, slack=slack, word=word), "<none>", "exec"
        ),
        names,
    )
    return names["cork"]


def enter(monkeypatch, draw, label=20, noun="cork", subtypes=("only",), name="Cork"):
    monkeypatch.setitem(MATERIALS, name, Material(label, noun, draw, subtypes))


def stop(what, done, total, remark=""):
    if done == 2:
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    "change", [{"depth": 0.2}, {"factor": 2.0}, {"slack": 1}, {"word": "moist"}]
)
def test_a_material_edited_between_a_stop_and_its_rerun_makes_no_mixed_world(
    change, tmp_path, monkeypatch
):
    enter(monkeypatch, made())
    options = dataclasses.replace(TINY, materials=("Wood", "Cork"))
    with pytest.raises(KeyboardInterrupt):
        write_world(tmp_path / "w", options, progress=stop)
    enter(monkeypatch, made(**change))
    record = write_world(tmp_path / "w", options)
    assert record.rendered == record.counts["videos"]  # nothing of the old function was taken over
    whole = write_world(tmp_path / "whole", options)
    assert digest_folder(tmp_path / "w") == digest_folder(tmp_path / "whole")
    enter(monkeypatch, made())
    with pytest.raises(PalpateError, match="materials that were edited since"):
        write_world(tmp_path / "w", options)
    other = write_world(tmp_path / "other", options)
    assert other.rendered == other.counts["videos"]
    assert other.digest != whole.digest == record.digest


def test_the_record_names_added_materials_alone(tmp_path, monkeypatch):
    write_world(tmp_path / "v", TINY)
    assert "materials" not in json.loads((tmp_path / "v" / "world.json").read_text())
    enter(monkeypatch, made())
    write_world(tmp_path / "w", dataclasses.replace(TINY, materials=("Wood", "Cork")))
    told = json.loads((tmp_path / "w" / "world.json").read_text())["materials"]
    assert told == added_materials(("Wood", "Cork"))
    assert {k: v for k, v in told["Cork"].items() if k != "function"} == {
        "label": 20,
        "noun": "cork",
        "subtypes": ["only"],
    }
    assert len(told["Cork"]["function"]) == 64


def test_a_function_has_one_hash_and_a_changed_entry_of_a_built_in_is_added(monkeypatch):
    enter(monkeypatch, made())
    first = added_materials(("Cork",))
    enter(monkeypatch, made())
    assert added_materials(("Cork",)) == first
    assert added_materials(tuple(name for name in MATERIALS if name != "Cork")) == {}
    monkeypatch.setitem(MATERIALS, "Wood", dataclasses.replace(MATERIALS["Wood"], noun="timber"))
    assert list(added_materials(("Wood", "Sand"))) == ["Wood"]


def test_the_digests_of_the_presets_are_those_that_models_were_trained_on():
    assert {name: options.digest[:12] for name, options in PRESETS.items()} == {
        "tiny": "0220df4e2b2f",
        "demo": "5f36c0c26f0b",
        "pretrain": "656f0c971f58",
        "small": "3793c7e60638",
        "full": "dce313c96c4e",
    }


def test_the_digest_of_a_world_is_over_its_lists(tmp_path):
    record = write_world(tmp_path / "w", TINY)
    names = (
        "leak.csv",
        "label.txt",
        "category_reference.txt",
        "train.txt",
        "test.txt",
        "objects.csv",
        "captions.csv",
    )
    lists = {name: digest_lines((tmp_path / "w" / name).read_text().splitlines()) for name in names}
    data = json.loads((tmp_path / "w" / "world.json").read_text())
    assert record.digest == digest_json(
        {"version": data["version"], "options": data["options"], "lists": lists}
    )


def piece(**changes):
    return lambda tile, rng: Surface(
        **{
            "height": np.zeros((tile.n, tile.n), np.float32),
            "albedo": np.full((tile.n, tile.n, 3), 0.5, np.float32),
            "subtype": "only",
            "words": ("odd", "new"),
            **changes,
        }
    )


FLAT = np.zeros((64, 64))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"words": ("odd",)}, "2 to 4 different words"),
        ({"words": "odd"}, "2 to 4 different words"),
        ({"words": ("a", "b", "c", "d", "e")}, "2 to 4 different words"),
        ({"words": ("odd", "odd")}, "2 to 4 different words"),
        ({"words": ("odd", " ")}, "2 to 4 different words"),
        ({"words": ("odd", "two\nlines")}, "2 to 4 different words"),
        ({"words": ("odd", 3)}, "2 to 4 different words"),
        ({"words": None}, "how it feels.*Got no words"),
        ({"noun": "  "}, "noun of one line"),
        ({"noun": 3}, "noun of one line"),
        ({"height": [[0.0], [0.0, 1.0]]}, "must return a height of shape"),
        ({"height": None}, "must return a height of shape"),
        ({"height": FLAT + 1j}, "a height of real numbers. Got dtype complex128"),
        ({"height": FLAT > 0}, "a height of real numbers. Got dtype bool"),
        ({"height": FLAT.astype(object)}, "a height of real numbers. Got dtype object"),
        ({"height": np.ma.masked_array(FLAT, FLAT == 0)}, "without a mask"),
        ({"height": FLAT + 1e300}, "a finite height"),
        ({"height": FLAT + 51.0}, "a height of -50 to 50 mm. Got 51 to 51"),
        ({"albedo": np.zeros((64, 64))}, "must return an albedo of shape"),
        ({"albedo": np.full((64, 64, 3), 255)}, "an albedo of 0 to 1. Got 255 to 255"),
        ({"albedo": np.full((64, 64, 3), -2.0)}, "an albedo of 0 to 1"),
        ({"albedo": np.full((64, 64, 3), np.nan)}, "a finite albedo"),
        ({"gloss": "much"}, "gloss and softness in .0, 1.. Got gloss 'much'"),
        ({"softness": True}, "gloss and softness"),
        ({"softness": float("nan")}, "gloss and softness"),
        ({"subtype": np.array(["only", "only"])}, "one of its subtypes"),
    ],
)
def test_junk_is_refused(changes, message):
    with pytest.raises(PalpateError, match=message) as error:
        draw_surface(
            "Cork", Material(20, "cork", piece(**changes), ("only",)), 64, np.random.default_rng(0)
        )
    assert "'Cork'" in error.value.must
    assert "\n" not in str(error.value)


def test_what_is_odd_but_sound_is_taken():
    draw = piece(
        words=["odd", "new"],
        height=np.arange(64 * 64).reshape(64, 64) // 100,
        albedo=np.full((64, 64, 3), 1.5),
        gloss=np.float32(0.5),
    )
    surface = draw_surface("Cork", Material(20, "cork", draw), 64, np.random.default_rng(0))
    assert surface.words == ("odd", "new")
    assert surface.height.dtype == surface.albedo.dtype == np.float32
    assert float(surface.albedo.max()) == 1.0
    assert surface.noun == "cork"
    assert type(surface.gloss) is float


def failing(tile, rng):
    raise ZeroDivisionError("no grain\nat all")


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_function_that_fails_is_named_with_its_error(workers, tmp_path, monkeypatch):
    enter(monkeypatch, failing)
    with pytest.raises(PalpateError) as error:
        write_world(tmp_path / "w", dataclasses.replace(TINY, materials=("Cork",)), workers=workers)
    assert str(error.value) == (
        "The material 'Cork' must draw a piece without an error. Got ZeroDivisionError: no grain at all. "
        "Mend the function 'failing' of this material."
    )


def test_a_function_that_no_worker_can_import_is_told(tmp_path, monkeypatch):
    enter(monkeypatch, piece())
    with pytest.raises(
        PalpateError, match=r"'Cork' must be importable for several workers.*workers=1"
    ):
        write_world(
            tmp_path / "w", dataclasses.replace(TINY, materials=("Wood", "Cork")), workers=2
        )


@pytest.mark.parametrize("label", [3, -1, 1.0, "20", True, None, np.int64(20)])
def test_labels_must_be_whole_numbers_of_their_own(label, monkeypatch):
    enter(monkeypatch, piece(), label=label)
    with pytest.raises(PalpateError, match="label"):
        WorldOptions(materials=("Cork", "Sand"))
    WorldOptions(materials=("Sand",))  # of no concern to a world without it


@pytest.mark.parametrize(
    "name", ["../Cork", "Cork: 3", "Cork\n", " Cork", "Cork ", "Cork,3", "", "Körk", "a/b"]
)
def test_names_must_be_safe(name, monkeypatch):
    enter(monkeypatch, piece(), name=name)
    with pytest.raises(PalpateError, match="name of a material must be made of"):
        WorldOptions(materials=(name,))


def test_names_whose_objects_would_be_called_alike_are_refused(monkeypatch):
    enter(monkeypatch, piece(), name="natural_fabric")
    for materials in (("natural_fabric", "Sand"), ("Natural Fabric", "Sand"), 21):
        with pytest.raises(PalpateError) as error:
            WorldOptions(materials=materials)
        found = (
            [p.text for p in error.value.problems]
            if isinstance(error.value, ProblemsError)
            else [str(error.value)]
        )
        assert all("names of their own. Got 'natural_fabric'" in text for text in found)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ((20, "cork"), "a Material as its entry"),
        (Material(20, " ", piece()), "a noun"),
        (Material(20, "cork", piece(), "only"), "subtypes"),
        (Material(20, "cork", "draw"), "a function"),
    ],
)
def test_entries_must_be_materials(entry, message, monkeypatch):
    monkeypatch.setitem(MATERIALS, "Cork", entry)
    with pytest.raises(PalpateError, match=message):
        WorldOptions(materials=("Cork",))
