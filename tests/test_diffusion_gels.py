"""A no-contact image of the user's gel: contacts and other sensors are said."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from forge.models import make_encoders, make_pipeline, write_shipped
from palpate.cli import main
from palpate.data.images import square
from palpate.data.video import VideoReader
from palpate.diffusion.gels import SMOOTH, gel_notes, unevenness
from palpate.diffusion.generation import generate
from palpate.sim import World, WorldOptions

DATA = Path(os.environ.get("PALPATE_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))


def samples(**options):
    world = World(WorldOptions(objects_per_material=1, contacts_per_video=1, seed=71, **options))
    rows = [world[k] for k in range(0, len(world), 3)]
    return tuple(np.stack([row[name] for row in rows]) for name in ("tactile", "background"))


@pytest.mark.parametrize(
    "options",
    [{}, {"markers": 0}, {"markers": 14}, {"look": "digit"}, {"look": "digit", "markers": 8}],
)
def test_contacts_of_all_materials_are_told_from_gels(options):
    contacts, gels = samples(**options)
    assert max(map(unevenness, gels)) < 0.75 * SMOOTH
    assert np.mean([unevenness(image) > SMOOTH for image in contacts]) > 0.75


@pytest.mark.parametrize(
    ("clip", "gel", "contact"),
    [("stone_0001", 0, 49), ("concrete_0", 0, 100), ("wood_00001", 0, 60)],
)
def test_real_gels_and_contacts(clip, gel, contact):
    file = DATA / "touch_and_go" / "clips" / "dataset" / f"clip_{clip}" / "gelsight.mp4"
    if not file.exists():
        pytest.skip(f"no {file}")
    pytest.importorskip("av")
    with VideoReader(file) as reader:
        rest, pressed = (square(Image.fromarray(reader[k]), 64) for k in (gel, contact))
    assert unevenness(rest) < SMOOTH < unevenness(pressed)


def test_what_speaks_against_a_gel_is_noted(tmp_path):
    contacts, gels = samples()
    digit = samples(look="digit")[1]
    worst = contacts[int(np.argmax([unevenness(image) for image in contacts]))]
    files = {"contact": worst, "gel": gels[5], "digit": digit[0]}
    codes = {}
    for name, image in files.items():
        Image.fromarray(image).save(tmp_path / f"{name}.png")
        codes[name] = [n.code for n in gel_notes(tmp_path / f"{name}.png", gels[0])]
    assert codes == {"contact": ["gel-contact"], "gel": [], "digit": ["gel-sensor"]}
    photo = np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    assert [n.code for n in gel_notes(tmp_path / "photo.png", None)] == ["gel-contact"]
    made = generate(
        tmp_path / "photo.png", model=make_pipeline(background=True), gel=tmp_path / "contact.png"
    )
    assert [n.code for n in made.notes] == ["gel-contact"]


def test_a_text_that_the_tokenizer_cuts_is_said(tmp_path, monkeypatch, capsys):
    encoders = make_encoders()
    model = replace(make_pipeline(width=encoders.dim), encoders=encoders.without_tactile())
    long = "rough " * 400
    (note,) = generate(text=long, model=model, steps=1).notes
    assert note.code == "text-cut"
    assert note.params["tokens"] > note.params["most"]
    assert not generate(text="rough", model=model, steps=1).notes
    write_shipped(tmp_path / "root", monkeypatch)
    command = ["generate", "--text", long, "--steps", "1", "-o", str(tmp_path / "t.png"), "--json"]
    assert main(command) == 0
    out, err = capsys.readouterr()
    assert [n["code"] for n in json.loads(out)["notes"]] == ["text-cut"]
    assert "Note: The text has" in err
