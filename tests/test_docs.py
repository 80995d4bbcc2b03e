"""The documentation is true: its commands and Python lines run, its links resolve."""

import linecache
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from palpate.cli import main
from palpate.sim import WorldOptions, write_world

TOP = Path(__file__).resolve().parents[1]
#: Pages whose blocks run here; those of concepts/ have tests of their own.
PAGES = [
    "README.md",
    "docs/index.md",
    *sorted(f"docs/start/{p.name}" for p in (TOP / "docs" / "start").glob("*.md")),
]
#: What makes a command quick: presets for tests, few replicates.
QUICK = {
    "train encoder": ["--preset", "tiny", "--epochs", "1"],
    "train generator": ["--preset", "tiny", "--steps", "2"],
    "generate": ["--steps", "2"],
    "score": ["--permutations", "19"],
    "world": ["--preset", "tiny"],
}
SLOW = {"docs/start/train.md": pytest.mark.slow, "docs/start/reproduce.md": pytest.mark.nightly}
#: Pages that `make docs` writes.
MADE = {"commands.md"}


@pytest.fixture(scope="session")
def examples(tmp_path_factory):
    """What the pages assume: a data set, lists, folders of images, a photo."""
    folder = tmp_path_factory.mktemp("docs")
    options = WorldOptions(
        materials=4, objects_per_material=4, contacts_per_video=3, frames_per_contact=2, test=0.4
    )
    write_world(folder / "tag", options)
    for part in ("train", "test"):
        shutil.copy(folder / "tag" / f"{part}.txt", folder / f"{part}.txt")
    rng = np.random.default_rng(0)
    frames = sorted((folder / "tag" / "dataset").glob("*/gelsight_frame/*.jpg"))[::5][:40]
    for name, noise in (("real", 0), ("generated", 10), ("second", 30), ("train", 5)):
        (folder / name).mkdir()
        for k, path in enumerate(frames):
            image = np.asarray(Image.open(path)).astype(float)
            image += noise * rng.normal(size=image.shape)
            Image.fromarray(image.clip(0, 255).astype(np.uint8)).save(folder / name / f"{k}.png")
    photo = next((folder / "tag" / "dataset").glob("*/video_frame/*.jpg"))
    shutil.copy(photo, folder / "photo.jpg")
    gel = sorted((folder / "tag" / "dataset").glob("*/gelsight_frame/*.jpg"))[0]  # not yet touched
    Image.open(gel).save(folder / "no-contact.png")
    return folder


def blocks(page):
    """(language, text) of the blocks of a page that run."""
    text = (TOP / page).read_text(encoding="utf-8")
    return re.findall(r"^```(sh|python)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def run_command(line):
    words = shlex.split(line, comments=True)
    if not words:
        return
    assert words[0] == "palpate", line
    verb = " ".join(words[1:3]) if words[1] == "train" else words[1]
    assert main([*words[1:], *QUICK.get(verb, [])]) in (0, 1), line


@pytest.mark.parametrize("page", [pytest.param(p, marks=SLOW.get(p, ())) for p in PAGES])
def test_the_blocks_of_a_page_run(page, examples, tmp_path, monkeypatch):
    shutil.copytree(examples, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    names = {}
    for language, text in blocks(page):
        if language == "python":
            lines = text.splitlines(keepends=True)
            linecache.cache[page] = (len(text), None, lines, page)  # the source of its functions
            exec(compile(text, page, "exec"), names)
        else:
            for line in text.splitlines():
                run_command(line)


def test_links_resolve():
    pages = [TOP / "README.md", TOP / "CONTRIBUTING.md", *(TOP / "docs").rglob("*.md")]
    broken = []
    for page in pages:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
            exists = (page.parent / link).exists() or Path(link).name in MADE
            if not re.match(r"https?:", link) and not exists:
                broken.append(f"{page.relative_to(TOP)}: {link}")
    assert not broken
