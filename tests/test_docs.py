"""The documentation is true: what it shows runs, its links resolve, its figures are the code's."""

import importlib
import linecache
import re
import shlex
import shutil
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from palpate.cli import VERBS, main
from palpate.core.images import IMAGE_FORMATS
from palpate.data.video import write_video
from palpate.metrics import PRESETS as METRIC_PRESETS
from palpate.sim import MATERIALS, VERSION, WorldOptions, plan_world, write_world
from palpate.sim import PRESETS as WORLD_PRESETS
from palpate.sim.felt import SCALES
from palpate.sim.plan import written_frames

TOP = Path(__file__).resolve().parents[1]
CONCEPTS = TOP / "docs" / "concepts"
METRICS, WORLD = ((CONCEPTS / f"{name}.md").read_text("utf-8") for name in ("metrics", "world"))
COVERAGE = (TOP / "docs" / "studies" / "metric_coverage.md").read_text("utf-8")
COVERAGE = COVERAGE.partition("## Where")[0]
PICTURES = {path.name: path for path in sorted((TOP / "docs" / "images").glob("world_*.png"))}
QUICK_PICTURE = "world_steps.png"
#: Pages whose blocks run here; those of concepts/ run in tests of their own.
PAGES = [
    "README.md",
    "docs/index.md",
    *sorted(f"docs/start/{p.name}" for p in (TOP / "docs" / "start").glob("*.md")),
]
#: What makes a command quick: presets for tests, few replicates.
QUICK = {
    "audit": ["--no-images"],
    "train encoder": ["--preset", "tiny", "--epochs", "1"],
    "train generator": ["--preset", "tiny", "--steps", "2"],
    "generate": ["--steps", "2"],
    "score": ["--permutations", "19"],
    "world": ["--preset", "tiny", "--size", "16", "--materials", "2", "--workers", "1"],
}
SLOW = {
    "docs/start/train.md": pytest.mark.nightly,
    "docs/start/generate.md": pytest.mark.nightly,
    "docs/start/reproduce.md": pytest.mark.nightly,
}
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
    write_video(folder / "clip.mp4", [np.asarray(Image.open(photo))] * 8, Fraction(8))
    (folder / "profile.csv").write_text("time_s,strength,shear_x,shear_y\n0,0.1,0,0\n1,0.9,0,0\n")
    gel = sorted((folder / "tag" / "dataset").glob("*/gelsight_frame/*.jpg"))[0]  # not yet touched
    Image.open(gel).save(folder / "no-contact.png")
    return folder


def run_command(line):
    words = shlex.split(line, comments=True)
    if not words:
        return
    assert words[0] == "palpate", line
    verb = " ".join(words[1:3]) if words[1] == "train" else words[1]
    assert main([*words[1:], *QUICK.get(verb, [])]) in (0, 1), line


def run_page(page):
    """Run the blocks of a page in order; one that begins with a file's name becomes the file."""
    names, text = {}, (TOP / page).read_text(encoding="utf-8")
    for language, block in re.findall(
        r"^```(sh|python)\n(.*?)^```", text, re.DOTALL | re.MULTILINE
    ):
        if language == "sh":
            for line in block.splitlines():
                run_command(line)
        elif name := re.match(r"# (\w+\.py)\n", block):
            Path(name[1]).write_text(block, encoding="utf-8")
        else:
            lines = block.splitlines(keepends=True)
            linecache.cache[page] = (len(block), None, lines, page)  # the source of its functions
            exec(compile(block, page, "exec"), names)


@pytest.mark.parametrize("page", [pytest.param(p, marks=SLOW.get(p, ())) for p in PAGES])
def test_the_blocks_of_a_page_run(page, examples, tmp_path, monkeypatch):
    shutil.copytree(examples, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    run_page(page)


def test_each_claim_on_security_names_its_tests():
    text = (TOP / "SECURITY.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 5
    for row in rows:
        tests = re.findall(r"`(\w+\.py)::(\w+)`", row.split(" | ")[1])
        assert tests, row
        for file, name in tests:
            assert f"\ndef {name}(" in (TOP / "tests" / file).read_text(), name
    decoders = re.search("decoders are (.*?), whatever", text)[1]
    assert re.split(", | AND ", decoders.upper()) == [*IMAGE_FORMATS]


def test_printed_answers_are_told_apart_by_words_and_by_more_than_rounding():
    alike = importlib.import_module("printed").alike
    assert alike("TMMD  0.70 [-0.5, 1.9]\n", "TMMD 0.71 [-0.52, 1.9]")
    assert not alike("4 of 8 leak", "5 of 8 leak")
    assert not alike("leaks", "no leak found")


def test_the_first_screen_is_short_and_shows_what_the_audit_prints(tmp_path):
    printed = importlib.import_module("printed")
    page = (TOP / "README.md").read_text("utf-8")
    assert len(page.split()) <= 700
    blocks = printed.BLOCK.findall(page)
    assert [b.split()[2] for b in blocks] == ["audit", "score", "generate"]
    assert page.count("<!-- printed -->") == len(blocks)
    printed.prepare(tmp_path, quick=True)
    assert printed.alike(blocks[0], printed.printed(blocks[0], tmp_path))


@pytest.mark.nightly
def test_every_printed_answer_is_current(tmp_path):
    printed = importlib.import_module("printed")
    printed.prepare(tmp_path)
    for page in (TOP / name for name in printed.PAGES):
        assert printed.update(page, tmp_path) == page.read_text("utf-8"), page


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


def test_the_page_of_commands_holds_every_verb(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "96")
    importlib.import_module("reference_pages").write(tmp_path)
    commands = (tmp_path / "commands.md").read_text(encoding="utf-8")
    assert commands.count("usage: palpate ") == len(VERBS)


# --- concepts/metrics.md


def percents(*names):
    """Shares of the rows of these names in the study of coverage."""
    rows = [line.strip("| ").split(" | ") for line in COVERAGE.splitlines()]
    cells = [cell for name, *cells in rows for cell in cells if name in names]
    assert len(cells) == 3 * len(names), names
    return [float(cell.split(" %")[0]) for cell in cells]


def test_the_page_of_metrics_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run_page("docs/concepts/metrics.md")
    printed = capsys.readouterr().out
    for metric in ("TMMD", "I-TMMD", "CI-TMMD", "D-TMMD"):
        assert re.search(rf"^{metric} -?[\d.]+ \(", printed, re.MULTILINE), metric
    assert re.search(r"^TMMD difference -.* ours$", printed, re.MULTILINE)


def test_ranges_of_coverage_match_the_study():
    covered = [
        percents("TMMD, unpaired", "TMMD, paired"),
        percents("I-TMMD: E", "CI-TMMD: E"),
        percents("D: inter"),
        percents("difference of TMMD, paired"),
    ]
    rejected = [f"true null rejected at 5 %, videos, {kind}" for kind in ("unpaired", "paired")]
    for values in (*covered, percents(*rejected), percents("TMMD null, paired")):
        assert f"{min(values):.1f} to {max(values):.1f} %" in METRICS
    assert all(92 <= value <= 99 for values in covered for value in values)
    assert all(3 <= value <= 8 for value in percents(*rejected))
    # over frames both fail
    assert max(percents("TMMD, frames, unpaired", "TMMD null, frames, unpaired")) < 92
    assert min(percents(*(name.replace("videos", "frames") for name in rejected))) > 8


def test_the_table_of_presets_matches_the_code():
    rows = dict(re.findall(r"^\| `([\w-]+)` \| (.*) \|$", METRICS, re.MULTILINE))
    assert set(rows) == set(METRIC_PRESETS)
    estimators = {"grouped": "different videos", "unbiased": '"unbiased"', "biased": '"biased"'}
    splits = {"group": "whole videos", "random": "random", "ordered": "order"}
    for name, plan in METRIC_PRESETS.items():
        pairs, halves, ratio, *_ = rows[name].split(" | ")
        assert estimators[plan.estimator] in pairs
        assert splits[plan.halves] in halves
        assert plan.aggregate.replace("_", " ").replace("the ", "") in ratio


# --- concepts/world.md


def test_the_page_of_the_world_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = dict(MATERIALS)
    try:
        run_page("docs/concepts/world.md")
        said = capsys.readouterr().out
        assert "8000" in said
        assert re.search(r"^\d test frames share a video with train$", said, re.MULTILINE)
        assert "(64, 64, 3)" in said.splitlines()[-1]
    finally:
        MATERIALS.clear()
        MATERIALS.update(before)
        sys.modules.pop("cork", None)


def test_the_numbers_of_the_world_are_those_of_the_code():
    felt = {word for scale in SCALES.values() for level in scale.words for word in level}
    assert f"from a list of {len(felt)}," in WORLD
    assert f"(now {VERSION})" in WORLD
    costs = re.search(r"^## Costs\n(.*?)(?=^## |\Z)", WORLD, re.DOTALL | re.MULTILINE)[1]
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| (\d+) \| ([\d,]+) \| ([\d,]+)", costs, re.MULTILINE)
    expected = []
    for name, options in WORLD_PRESETS.items():
        videos = len(plan_world(options))
        contact = videos * options.contacts_per_video * options.frames_per_contact
        written = videos * len(written_frames(options))
        sizes = (str(options.size), str(options.objects_per_material))
        expected.append((name, *sizes, f"{contact:,}", f"{written:,}"))
    assert rows == expected


def test_every_picture_is_small_and_shown_and_drawn_by_the_recipe():
    drawn = importlib.import_module("world_pictures").PICTURES
    assert {*PICTURES} == {*drawn} == {*re.findall(r"images/(world_\w+\.png)", WORLD)}
    for name, path in PICTURES.items():
        assert path.stat().st_size < 250_000, name


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n != QUICK_PICTURE)) for n in PICTURES]
)
def test_pictures_are_redrawn_alike(name):
    recipe = importlib.import_module("world_pictures")
    board = recipe.PICTURES[name]()
    with Image.open(PICTURES[name]) as image:
        assert image.size == board.image().size
        stored = np.asarray(image.convert("RGB")).astype(int)
    assert board.panels
    for x, y, pixels in board.panels:  # not the letters, which depend on the version of FreeType
        height, width = pixels.shape[:2]
        difference = np.abs(stored[y : y + height, x : x + width] - pixels)
        colored = (pixels != pixels[..., :1]).any()
        assert difference.max() <= 2 + (recipe.STEP // 2 if colored else 0)
