"""``palpate generate``: a photo in, an image out; mistakes in one line."""

import errno
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from forge import commands
from forge.models import write_shipped


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
    return commands.call(capsys, "generate", *args)


def test_a_photo_becomes_an_image_with_a_notice(place, capsys):
    status, out, _ = call(capsys, "photo.jpg", "-o", "tactile.png", "-q")
    assert status == 0
    assert "synthetic data alone" in out  # also with --quiet
    with Image.open("tactile.png") as image:
        assert (image.format, image.size, image.mode) == ("PNG", (32, 32), "RGB")
        notice = image.info["palpate.notice"]
    status, out, _ = call(capsys, "photo.jpg", "-o", "tactile.png", "--json")
    facts = json.loads(out)
    assert status == 0
    assert (facts["image"], facts["images"], facts["made_now"]) == ("tactile.png", 1, 0)
    assert (facts["model"], facts["notice"]) == ("palpate/mini", notice)
    status, out, _ = call(capsys, "photo.jpg", "-o", "new/deep/X.PNG", "--seed", "1", "--json")
    assert (status, json.loads(out)["made_now"]) == (0, 1)
    assert not [p.name for p in place.rglob(".*")]


def test_a_dry_run_is_one_line_and_writes_nothing(place, capsys):
    dry = ("photos", "-o", "a", "--guidance", "1", "--steps", "3", "--dry-run")
    status, out, _ = call(capsys, *dry)
    assert (status, out) == (0, "2 images to make, 6 passes through the network\n")
    assert not (place / "a").exists()
    assert call(capsys, *dry[:-1], "-q")[0] == 0
    for path in (place / "a" / "images").glob("a_*"):
        path.unlink()
    before = sorted(place.rglob("*"))
    status, out, _ = call(capsys, *dry, "--json")
    assert (status, json.loads(out)) == (0, {"missing": 1, "evaluations": 3})
    assert sorted(place.rglob("*")) == before


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


def test_bad_photos_may_be_skipped(place, capsys):
    (place / "cut.jpg").write_bytes((place / "photo.jpg").read_bytes()[:300])
    files = ("photo.jpg", "cut.jpg", "gone.jpg")
    status, out, err = call(capsys, *files, "-o", "t", "--skip-bad", "--json")
    facts = json.loads(out)
    kinds = {p["kind"] for p in facts["skipped"]}
    assert (status, facts["images"], kinds) == (0, 1, {"bad-image", "missing-file"})
    assert "Skipped 2" in err


def test_an_earlier_image_is_replaced_and_may_be_the_photo_of_another(place, capsys):
    assert call(capsys, "photo.jpg", "-o", "t.png", "-q")[0] == 0
    first = (place / "t.png").read_bytes()
    assert call(capsys, "photos/a.jpg", "-o", "t.png", "-q")[0] == 0
    assert (place / "t.png").read_bytes() != first
    assert call(capsys, "t.png", "-o", "u.png", "-q")[0] == 0
    assert call(capsys, "t.png", "-o", "t.png", "-q")[0] == 2


def test_mistakes_are_one_line_and_write_nothing(place, capsys):
    (place / "cut.jpg").write_bytes((place / "photo.jpg").read_bytes()[:300])
    Image.new("1", (20_000, 15_000)).save("huge.png")
    (place / "full").mkdir()
    (place / "full" / "mine.png").write_bytes((place / "photos" / "b.png").read_bytes())
    (place / "folder.png").mkdir()
    before = {p: p.read_bytes() for p in place.rglob("*") if p.is_file()}
    for args, words in (
        (["gone.jpg", "-o", "t.png"], "gone.jpg: no such file"),
        (["photo.jpg", "gone.jpg", "lost.jpg", "-o", "t"], "2 problems"),
        (["cut.jpg", "-o", "t.png"], "cut.jpg"),
        (["huge.png", "-o", "t.png"], "huge.png: more than 50,000,000 pixels"),
        (["photo.jpg", "photos/../photo.jpg", "-o", "t"], "PATH must differ in name"),
        (["photo.jpg", "-o", "t.jpg"], "--output must be a .png or a folder"),
        (["photo.jpg", "-o", "t.png", "--split", "photo.jpg"], "--split must go with a manifest"),
        (["--text", "x", "-o", "t.png", "--split", "photo.jpg"], "--split must go with a manifest"),
        (["photo.jpg", "-o", "t.png", "--weight", "0.2"], "photos and a text. Got no text"),
        (["--text", "x", "-o", "t.png", "--weight", "0.2"], "photos and a text. Got no photo"),
        (["cut.jpg", "gone.jpg", "-o", "t", "--skip-bad"], "2 problems"),
        (["photo.jpg", "photos/a.jpg", "-o", "t.png"], "2 photos"),
        (["photo.jpg", "-o", "folder.png"], "the folder folder.png"),
        (["photos/b.png", "-o", "photos/b.png"], "--output must not replace an input"),
        (["photo.jpg", "-o", "full/mine.png"], "--output must be new"),
        (["photo.jpg", "-o", "full"], "--output must be empty or hold generated"),
        (["photo.jpg", "-o", "photo.jpg/t.png"], "must be"),
        (["photo.jpg", "-o", "t.png", "--model", "palpate/maxi"], "must be one of palpate/mini"),
        (["photo.jpg", "-o", "t.png", "--model", "nowhere"], "no folder nowhere"),
        (["photo.jpg", "-o", "t.png", "--model", "photos"], "must exist"),
        (["photo.jpg", "-o", "t.png", "--steps", "0"], "--steps must lie in 1 to 1000"),
        (["photo.jpg", "-o", "t.png", "--guidance", "-1"], "--guidance must be a finite number"),
        (["photo.jpg", "-o", "t.png", "--device", "gpu"], "--device must be auto, cpu"),
        (["gone.parquet", "-o", "t"], "The manifest must exist"),
    ):
        commands.mistake(capsys, words, "generate", *args)
    assert {p: p.read_bytes() for p in place.rglob("*") if p.is_file()} == before


def test_broken_photos_and_unknown_models_are_reported_before_torch_is_imported(place):
    code = (
        "import sys; from palpate.cli import main; status = main(sys.argv[1:]);"
        "sys.exit(9 if {'torch', 'transformers', 'diffusers'} & set(sys.modules) else status)"
    )
    (place / "cut.jpg").write_bytes((place / "photo.jpg").read_bytes()[:300])
    for args in (["cut.jpg"], ["gone.jpg"], ["photo.jpg", "--model", "palpate/maxi"]):
        command = [sys.executable, "-c", code, "generate", *args, "-o", "t.png"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 2, (args, done.stderr)


def test_a_full_disk_is_one_line_and_the_next_run_goes_on(place, capsys, monkeypatch):
    save, room = Image.Image.save, [1]

    def limited(self, *args, **options):
        if not room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")
        room.pop()
        return save(self, *args, **options)

    monkeypatch.setattr(Image.Image, "save", limited)
    status, out, err = call(capsys, "photos", "-o", "t", "--steps", "1", "-q")
    assert (status, out, "Traceback" in err) == (2, "", False)
    assert "No space left on device" in err
    monkeypatch.undo()
    monkeypatch.chdir(place)
    write_shipped(place.parent / "root2", monkeypatch)
    assert len([*(place / "t" / "images").iterdir()]) == 1
    status, out, _ = call(capsys, "photos", "-o", "t", "--steps", "1", "--json")
    facts = json.loads(out)
    assert (status, facts["images"], facts["made_now"]) == (0, 2, 1)
