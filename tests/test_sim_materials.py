"""Custom materials: what their functions may return, and how a world records them."""

import dataclasses

import numpy as np
import pytest

from palpate.core import PalpateError
from palpate.sim import MATERIALS, PRESETS, Material, Surface, WorldOptions, write_world
from palpate.sim.materials import draw_surface

TINY = dataclasses.replace(PRESETS["tiny"], size=16, tile=64)
FLAT = np.zeros((64, 64))


def piece(**changes):
    def draw(tile):
        height, albedo = np.zeros((tile.n, tile.n)), np.full((tile.n, tile.n, 3), 0.5)
        content = {"height": height, "albedo": albedo, "subtype": "only"}
        return Surface(**{**content, **changes})

    return draw


def springy(tile):
    albedo = np.full((tile.n, tile.n, 3), 0.5, np.float32)
    return Surface(tile.noise(1.0, 8.0) * 0.1, albedo, "only")


def add(monkeypatch, draw, label=20, name="Cork"):
    monkeypatch.setitem(MATERIALS, name, Material(label, draw))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"height": FLAT[1:]}, "height and an albedo of shapes"),
        ({"height": FLAT * np.nan}, "finite numbers"),
        ({"albedo": FLAT}, "height and an albedo of shapes"),
    ],
)
def test_what_a_material_draws_is_checked(changes, message):
    material = Material(20, piece(**changes))
    with pytest.raises(PalpateError, match=message) as error:
        draw_surface("Cork", material, 64, np.random.default_rng(0))
    assert "'Cork'" in error.value.must


def test_whole_numbers_are_converted():
    draw = piece(height=FLAT.astype(int), albedo=np.full((64, 64, 3), 1.5))
    surface = draw_surface("Cork", Material(20, draw), 64, np.random.default_rng(0))
    assert surface.height.dtype == surface.albedo.dtype == np.float32
    assert float(surface.albedo.max()) == 1.0


def test_labels_are_unique(monkeypatch):
    add(monkeypatch, piece(), label=3)
    with pytest.raises(PalpateError, match="label 3 of Wood, Cork"):
        WorldOptions(materials=("Cork", "Sand"))
    WorldOptions(materials=("Sand",))  # a world without it is not affected


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_custom_material_enters_lists(workers, tmp_path, monkeypatch):
    add(monkeypatch, springy)
    options = dataclasses.replace(TINY, materials=("Wood", "Cork"))
    write_world(tmp_path / "w", options, workers=workers)
    assert "Cork: 20" in (tmp_path / "w" / "category_reference.txt").read_text().splitlines()
