"""``palpate generate``: a photo in, a picture out, with the generator that ships; and every way to hold it wrong."""

import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from mini_forge import write_shipped
from palpate.cli import main


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with photos, where ``palpate/mini`` is what the test wrote."""
    write_shipped(tmp_path / "root", monkeypatch)
    (tmp_path / "here" / "photos").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    rng = np.random.default_rng(0)
    for name in ("photo.jpg", "photos/a.jpg", "photos/b.png"):
        Image.fromarray(rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)).save(name)
    return tmp_path / "here"


def call(capsys, *args):
    status = main(["generate", *map(str, args)])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_a_photo_becomes_a_picture_and_the_user_is_told_what_it_is(place, capsys):
    status, out, _ = call(capsys, "photo.jpg", "-o", "touch.png", "-q")
    assert status == 0
    assert "synthetic data alone" in out  # also with --quiet
    assert "knows only these materials: Brick, Wood." in out
    with Image.open("touch.png") as image:
        assert (image.format, image.size, image.mode) == ("PNG", (32, 32), "RGB")
        notice = image.info["palpate.notice"]
    status, out, _ = call(capsys, "photo.jpg", "-o", "touch.png", "--json")
    facts = json.loads(out)
    assert (status, facts["image"], facts["images"], facts["made_now"], facts["model"]) == (
        0,
        "touch.png",
        1,
        0,
        "palpate/mini",
    )
    assert facts["notice"] == notice
    status, out, _ = call(capsys, "photo.jpg", "-o", "new/deep/TOUCH.PNG", "--seed", "1", "--json")
    assert (status, json.loads(out)["made_now"]) == (0, 1)
    assert not [p.name for p in place.rglob(".*")]


def test_several_photos_and_folders_become_folders(place, capsys):
    assert call(capsys, "photos", "-o", "a", "-q")[0] == 0
    assert call(capsys, "photos/a.jpg", "photo.jpg", "-o", "b", "-q")[0] == 0
    assert call(capsys, "photo.jpg", "-o", "c", "-q")[0] == 0
    index = {name: json.loads((place / name / "index.json").read_text()) for name in "abc"}
    assert {name: list(i["images"]) for name, i in index.items()} == {
        "a": ["a.jpg", "b.png"],
        "b": ["a.jpg", "photo.jpg"],
        "c": ["photo.jpg"],
    }
    assert all("synthetic" in i["notice"] for i in index.values())
    (place / "folder.png").mkdir()  # whoever names a picture does not mean to fill a folder
    status, _, err = call(capsys, "photo.jpg", "-o", "folder.png", "-q")
    assert (status, "the folder folder.png" in err, "Choose another name" in err) == (2, True, True)
    assert not any((place / "folder.png").iterdir())


@pytest.mark.parametrize("guidance", ["-1", "-0.001", "nan", "inf", "-inf"])
def test_guidance_must_be_a_number_from_zero_on(place, capsys, guidance):
    status, _, err = call(capsys, "photo.jpg", "-o", "y.png", "--guidance", guidance)
    assert (status, "finite number from 0 on" in err) == (2, True)
    assert not (place / "y.png").exists()


def test_what_cannot_be_done_is_one_line_and_writes_nothing(place, capsys):
    (place / "empty").mkdir()
    (place / "cut.jpg").write_bytes((place / "photo.jpg").read_bytes()[:300])
    (place / "words.jpg").write_text("no picture")
    (place / "mine.png").write_bytes((place / "photos" / "b.png").read_bytes())
    model = str(place.parent / "root" / "mini" / "generator")
    before = {p: p.read_bytes() for p in place.rglob("*") if p.is_file()}
    for args, word in (
        (["gone.jpg", "-o", "t.png"], "gone.jpg: no such file"),
        (["photo.jpg", "gone.jpg", "lost.jpg", "-o", "t"], "2 problems"),
        (["cut.jpg", "-o", "t.png"], "cut.jpg"),
        (["words.jpg", "-o", "t.png"], "words.jpg"),
        (["cut.jpg", "photo.jpg", "-o", "t"], "cut.jpg"),
        (["empty", "-o", "t"], "at least one photo"),
        (["empty", "-o", "t.png"], "a folder"),
        (["photo.jpg", "-o", "t.jpg"], "written as PNG"),
        (["photo.jpg", "photos/a.jpg", "-o", "t.png"], "2 photos"),
        (["--manifest", "m", "-o", "t.png"], "a manifest"),
        (["photo.jpg", "--manifest", "m", "-o", "t"], "Got both"),
        (["-o", "t"], "Got neither"),
        (["photos/b.png", "-o", "photos/b.png"], "must not replace an input"),
        (["photo.jpg", "-o", "mine.png"], "mine.png must be new"),
        (["photo.jpg", "-o", "photo.jpg/t.png"], "must be"),
        (["photo.jpg", "-o", "t.png", "--model", "palpate/maxi"], "must be one of palpate/mini"),
        (["photo.jpg", "-o", "t.png", "--model", "nowhere"], "no folder nowhere"),
        (["photo.jpg", "-o", "t.png", "--model", "photos"], "must exist"),
        (["photo.jpg", "-o", "t.png", "--steps", "0"], "steps"),
        ([model, "-o", "t"], "Pass it as the model"),
    ):
        status, out, err = call(capsys, *args)
        assert (status, word in err, out, "Traceback" in err) == (2, True, "", False), (args, err)
    assert {p: p.read_bytes() for p in place.rglob("*") if p.is_file()} == before


def test_a_broken_photo_is_refused_before_the_model_is_loaded(place, capsys, monkeypatch):
    """And whatever else needs no model: settings, device, output and the model's name."""
    from palpate.diffusion.pipeline import TactilePipeline

    loads = []
    load = TactilePipeline.load
    monkeypatch.setattr(TactilePipeline, "load", lambda *args: loads.append(args) or load(*args))
    (place / "cut.jpg").write_bytes((place / "photo.jpg").read_bytes()[:300])
    (place / "full").mkdir()
    (place / "full" / "notes.txt").write_text("mine")
    (place / "other").mkdir()
    (place / "other" / "index.json").write_text("{}")
    Image.new("RGB", (9, 9)).save(place / "photos" / "c.jpg")
    (place / "photos" / "c.jpg").write_bytes((place / "photos" / "c.jpg").read_bytes()[:300])
    for args, word in (
        (["cut.jpg", "-o", "t.png"], "cut.jpg"),
        (["gone.jpg", "-o", "t.png"], "gone.jpg"),
        (["cut.jpg", "photo.jpg", "-o", "t"], "E.g. --skip-bad"),
        (["photos", "-o", "t"], "c.jpg"),
        (["photo.jpg", "photos/../photo.jpg", "-o", "t"], "'photo.jpg' twice"),
        (["photo.jpg", "photos/../photo.jpg", "-o", "t", "--skip-bad"], "'photo.jpg' twice"),
        (["photo.jpg", "-o", "t.png", "--steps", "0"], "1 to 1000 steps"),
        (["photo.jpg", "-o", "t.png", "--steps", "1001"], "1 to 1000 steps"),
        (["photo.jpg", "-o", "t", "--batch", "0"], "batch of at least 1"),
        (["photo.jpg", "-o", "t.png", "--guidance", "-1"], "finite number from 0 on"),
        (["photo.jpg", "-o", "t.png", "--device", "gpu"], "Got 'gpu'. Choose auto, cpu"),
        (["photo.jpg", "-o", "t.png", "--device", "cpu:x"], "Got 'cpu:x'"),
        (["photo.jpg", "-o", "cut.jpg/"], "written as PNG"),
        (["photo.jpg", "-o", "full/notes.txt"], "Got a file"),
        (["photo.jpg", "-o", "full"], "Got other files"),
        (["photo.jpg", "-o", "other"], "another kind of folder"),
        (["photo.jpg", "-o", "t", "--model", "palpate/maxi"], "must be one of palpate/mini"),
        (["photo.jpg", "-o", "t", "--model", "nowhere"], "no folder nowhere"),
        (["photo.jpg", "-o", "t", "--model", ""], "no folder ''"),
        (["photo.jpg", "-o", "t", "--model", "./photos"], "must exist"),
        (["--manifest", "gone", "-o", "t"], "The manifest must exist"),
    ):
        status, _, err = call(capsys, *args)
        assert (status, word in err, loads, "Loading" in err) == (2, True, [], False), (args, err)
    assert call(capsys, "photo.jpg", "-o", "t.png")[0] == 0
    assert len(loads) == 1


def test_what_is_refused_first_needs_no_torch(place):
    code = (
        "import sys; from palpate.cli import main; status = main(sys.argv[1:]);"
        "sys.exit(9 if {'torch', 'transformers', 'diffusers'} & set(sys.modules) else status)"
    )
    (place / "cut.jpg").write_bytes((place / "photo.jpg").read_bytes()[:300])
    for args in (
        ["cut.jpg"],
        ["photo.jpg", "--steps", "0"],
        ["photo.jpg", "--device", "gpu"],
        ["photo.jpg", "--model", "palpate/maxi"],
    ):
        done = subprocess.run(
            [sys.executable, "-c", code, "generate", *args, "-o", "t.png"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 2, (args, done.stderr)


def test_bad_photos_may_be_left_out(place, capsys):
    (place / "cut.jpg").write_bytes((place / "photo.jpg").read_bytes()[:300])
    status, out, err = call(
        capsys, "photo.jpg", "cut.jpg", "gone.jpg", "-o", "t", "--skip-bad", "--json"
    )
    facts = json.loads(out)
    assert (status, facts["images"], {p["kind"] for p in facts["skipped"]}) == (
        0,
        1,
        {"bad-image", "missing-file"},
    )
    assert "Skipped 2" in err


def test_an_earlier_touch_is_replaced_and_one_touch_may_be_the_photo_of_another(place, capsys):
    assert call(capsys, "photo.jpg", "-o", "t.png", "-q")[0] == 0
    first = (place / "t.png").read_bytes()
    assert call(capsys, "photos/a.jpg", "-o", "t.png", "-q")[0] == 0
    assert (place / "t.png").read_bytes() != first
    assert call(capsys, "t.png", "-o", "u.png", "-q")[0] == 0
    assert call(capsys, "t.png", "-o", "t.png", "-q")[0] == 2
