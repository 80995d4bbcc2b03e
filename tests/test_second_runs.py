"""Two commands do not write one folder, nor go on from one: the second is refused in a line.

What is kept by its content (``--cache``) is shared: a file of it is whole or made again.
"""

import shutil
import subprocess
import sys
import time

import pytest
from PIL import Image

from forge.commands import mistake
from forge.pictures import picture
from forge.servers import FakeServer
from palpate.cli import VERBS, main
from palpate.core import PalpateError, digest_folder, locked
from palpate.data.manifest import Manifest
from palpate.sim.presets import PRESETS

pytest.importorskip("fcntl")
pytest.importorskip("torch")

TRAIN = ("tag", "--split", "split.json", "--preset", "tiny", "-o", "out")
WORLD = ("world", "-o", "out", "--preset", "tiny", "--workers", "1")
STUDY = ("--reference", "photos", "--generated", "first", "second", "--items", "2")
SCORE = ("score", "--generated", "photos", "--reference", "tag", "--encoder", "palpate/mini")
PROBE = ("probe", "tag", "--split", "split.json", "--train", "--preset", "tiny", "--epochs", "1")
#: A command, and what the first one that runs it holds meanwhile.
HELD = {
    "import": (("import", "photos", "--tactile", "{id}.png", "-o", "out"), "out"),
    "background": (("background", "bare", "-o", "out"), "out"),
    "caption": (("caption", "tag", "-o", "out", "--server", "SERVER"), "out"),
    "caption by a template": (("caption", "tag", "-o", "out", "--template", "{material}"), "out"),
    "split": (("split", "tag", "--seeds", "2", "-o", "out"), ".out.part"),
    "world": (WORLD, ".out.*.part"),
    "train encoder": (("train", "encoder", *TRAIN), ".out.work"),
    "train autoencoder": (("train", "autoencoder", *TRAIN), ".out.work"),
    "train generator": (("train", "generator", *TRAIN, "--clip", "palpate/mini"), ".out.work"),
    "embed": (
        ("embed", "tag", "--encoder", "palpate/handcrafted", "-o", "out"),
        "out/.part-1-of-1.part",
    ),
    "generate": (("generate", "photos", "-o", "out", "--steps", "1"), "out"),
    "audit": (("audit", "tag", "--split", "split.json", "-o", "out.json"), ".out.json.work"),
    "audit --impact": (
        ("audit", "tag", "--split", "split.json", "--impact", "--page", "out.html"),
        ".out.html.work",
    ),
    "score": ((*SCORE, "-o", "out.json"), ".out.json.work"),
    "probe": ((*PROBE, "--work", "out"), "out"),
    "preference make": (("preference", "make", *STUDY, "-o", "out"), ".out.part"),
    "preference serve": (("preference", "serve", "study", "--port", "0"), "study"),
    "demo": (("demo", "--preset", "tiny", "-o", "out"), "out"),
    "reproduce": (("reproduce", "world-gelsight", "--preset", "smoke", "-o", "out"), "out"),
}


#: What is written at once, at the end of a command, by other verbs, or not at all.
AT_ONCE = {
    "run",
    "view",
    "validate",
    "caption check",
    "preference score",
    "presets",
    "report",
    "verify",
}


@pytest.fixture(scope="module")
def study(rated, tmp_path_factory):
    output = tmp_path_factory.mktemp("made") / "study"
    sources = ("--reference", rated.reference, "--generated", *rated.methods)
    words = ("preference", "make", *sources, "--items", "4", "--size", "32", "-o", output, "-q")
    assert main([*map(str, words)]) == 0
    return output


@pytest.fixture
def place(tag, study, tmp_path):
    """Folders of photos, a manifest without backgrounds, and a study, beside the data ``tag``."""
    for name in ("photos", "first", "second"):
        (tmp_path / name).mkdir()
        for k in range(3):
            Image.fromarray(picture(k + 1, 32)).save(tmp_path / name / f"{k}.png")
    rows = [{**row, "background": None} for row in tag[0].table.iter_rows(named=True)]
    Manifest.from_rows(rows, tag[0].root).save(tmp_path / "bare" / "manifest.parquet")
    shutil.copytree(study, tmp_path / "study")
    return tmp_path


def test_every_verb_that_writes_for_long_is_here():
    verbs = [next(v for v in sorted(VERBS)[::-1] if name.startswith(v)) for name in HELD]
    assert {*verbs} == {*VERBS} - AT_ONCE


@pytest.mark.parametrize("name", HELD)
def test_what_a_first_run_holds_is_refused_to_a_second_and_stays(place, capsys, name):
    words, held = HELD[name]
    capsys.readouterr()
    held = held.replace("*", PRESETS["tiny"].digest[:12])
    with FakeServer() as server, locked(place / held):
        before = digest_folder(place)
        words = [server.url if word == "SERVER" else word for word in words]
        mistake(capsys, "must be written by one run", *words)
        assert digest_folder(place) == before


@pytest.mark.parametrize("name", HELD)
def test_a_link_out_of_what_is_held_is_not_written_through(place, capsys, name):
    words, held = HELD[name]
    folder = place / held.replace("*", PRESETS["tiny"].digest[:12])
    folder.mkdir(exist_ok=True, parents=True)
    (place / "notes").write_text("of years")
    (folder / "a").symlink_to(place / "notes")
    before = digest_folder(place)
    with FakeServer() as server:
        words = [server.url if word == "SERVER" else word for word in words]
        mistake(capsys, "", *words)
    assert digest_folder(place) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "held"),
    [
        ((*WORLD, "--size", "256", "--objects-per-material", "20"), ".out.*.part"),
        HELD["preference serve"],
    ],
)
def test_a_second_process_is_refused_and_the_first_goes_on(place, words, held):
    command = [sys.executable, "-m", "palpate", *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as first:
        try:
            while not is_held(place, held):
                assert first.poll() is None
                time.sleep(0.01)
            second = subprocess.run(command, capture_output=True, text=True, timeout=60)
            assert second.returncode == 2, second
            assert second.stderr.count("\n") == 1
            assert "must be written by one run" in second.stderr
            assert first.poll() is None
        finally:
            first.kill()


def is_held(place, held):
    """Whether some process holds a folder."""
    for folder in place.glob(held):
        try:
            with locked(folder):
                pass
        except PalpateError:
            return True
    return False
