"""docs/concepts/world.md is true: commands and snippets run, pictures are redrawn alike."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from palpate.cli import main
from palpate.sim import MATERIALS, PRESETS, VERSION, plan_world
from palpate.sim.felt import SCALES
from palpate.sim.plan import written_frames

TOP = Path(__file__).resolve().parents[1]
DOCS = TOP / "docs"
PAGE = (DOCS / "concepts" / "world.md").read_text(encoding="utf-8")
COMMANDS = [
    shlex.split(line, comments=True)
    for line in "\n".join(re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)).splitlines()
    if line
]
SMALL = [
    "--materials",
    "2",
    "--objects-per-material",
    "2",
    "--size",
    "16",
    "--tile",
    "64",
    "--contacts-per-video",
    "2",
    "--frames-per-contact",
    "1",
    "--workers",
    "1",
]
QUICK = ("world_steps.png",)


def section(title):
    return re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE).group(1)


@pytest.fixture(scope="module")
def recipe():
    spec = importlib.util.spec_from_file_location(
        "world_pictures", TOP / "recipes" / "world_pictures.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules["world_pictures"] = module
    spec.loader.exec_module(module)
    return module


def test_the_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert len(COMMANDS) >= 9
    for words in COMMANDS:
        assert words[0] == "palpate"
        if "videos" in words and importlib.util.find_spec("av") is None:
            continue
        # The last of two equal options counts.
        small = [*SMALL, "-q"] if words[1] == "world" else []
        expected = 1 if words[1] == "audit" else 0  # the world's lists leak
        assert main([*words[1:], *small]) == expected, (words, capsys.readouterr().err)


def test_the_snippets_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    before, names = dict(MATERIALS), {}
    try:
        for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
            if name := re.match(r"# (\w+\.py)\n", block):
                (tmp_path / name.group(1)).write_text(block, encoding="utf-8")
            else:
                exec(block, names)
        said = capsys.readouterr().out
        assert "8000" in said
        assert re.search(r"^\d test frames share a video with train$", said, re.MULTILINE)
        assert "(64, 64, 3)" in said.splitlines()[-1]
    finally:
        MATERIALS.clear()
        MATERIALS.update(before)
        sys.modules.pop("cork", None)


def test_the_number_of_words_is_that_of_the_code():
    felt = {word for scale in SCALES.values() for level in scale.words for word in level}
    assert f"from a list of {len(felt)}," in PAGE


def test_the_table_of_costs_has_the_frames_of_the_presets():
    rows = re.findall(
        r"^\| `(\w+)` \| (\d+) \| (\d+) \| ([\d,]+) \| ([\d,]+)", section("Costs"), re.M
    )
    expected = []
    for name, options in PRESETS.items():
        videos = len(plan_world(options))
        contact = videos * options.contacts_per_video * options.frames_per_contact
        written = videos * len(written_frames(options))
        sizes = (str(options.size), str(options.objects_per_material))
        expected.append((name, *sizes, f"{contact:,}", f"{written:,}"))
    assert rows == expected


def test_links_resolve_and_the_version_is_told():
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", PAGE)
    assert len(links) > 5
    pages = [DOCS / "concepts" / link for link in links if not link.endswith("commands.md")]
    assert all(page.is_file() for page in pages)  # the page of commands is made with the site
    assert f"(now {VERSION})" in PAGE


def test_every_picture_is_small_and_shown_and_drawn_by_the_recipe(recipe):
    files = {path.name for path in (DOCS / "images").glob("world_*.png")}
    assert files == set(recipe.PICTURES) == set(re.findall(r"images/(world_\w+\.png)", PAGE))
    for name in files:
        assert (DOCS / "images" / name).stat().st_size < 250_000, name


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in sorted(path.name for path in (DOCS / "images").glob("world_*.png"))
    ],
)
def test_pictures_are_redrawn_alike(recipe, name):
    board = recipe.PICTURES[name]()
    with Image.open(DOCS / "images" / name) as image:
        assert image.size == board.image().size
        stored = np.asarray(image.convert("RGB")).astype(int)
    assert board.panels
    for (
        left,
        top,
        pixels,
    ) in board.panels:  # not the letters, which depend on the version of FreeType
        difference = np.abs(
            stored[top : top + pixels.shape[0], left : left + pixels.shape[1]] - pixels
        )
        colored = (pixels != pixels[..., :1]).any()
        assert difference.max() <= 2 + (recipe.STEP // 2 if colored else 0)
