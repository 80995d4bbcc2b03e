"""Anyone's data: the commands of docs/your-data.md, folders without templates, and all verbs."""

import re
import shlex
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from forge.pictures import write_image
from palpate.cli import main
from palpate.core import PalpateError
from palpate.data import Manifest, import_dataset, load
from palpate.data.detection import detect_layout, template_of
from palpate.data.frames import MOVING
from palpate.data.templates import Template, assign, join
from palpate.report.results import Results
from test_data_contacts import gel_video, photos
from test_data_videos import save

PAGE = Path(__file__).resolve().parents[1] / "docs" / "your-data.md"
SECTIONS = re.findall(
    r"^### (.*?)\n(.*?)(?=^##)", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE
)


def blocks(text, kind):
    return re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)


def make_tree(paths, table=""):
    for k, path in enumerate(map(Path, paths)):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".csv":
            path.write_text(table)
        elif path.suffix in MOVING:
            save(path, gel_video(70, ((20, 30), (45, 55)), seed=k))
        else:
            write_image(path, k)


@pytest.mark.parametrize(("title", "text"), SECTIONS, ids=[title for title, _ in SECTIONS])
def test_a_command_of_the_page_uses_every_file(title, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tree,), (command,) = blocks(text, "text"), blocks(text, "sh")
    paths = tree.split()
    make_tree(paths, *blocks(text, "csv"))
    words = shlex.split(command.replace("\\\n", " "))
    assert main([*words[1:], "-q"]) == 0, capsys.readouterr().err
    table = Manifest.load(Path("m")).require_valid().table
    if any(p.endswith(MOVING) for p in paths):
        moving = [p for p in paths if p.endswith(MOVING)]
        sides = sum(table[side].count() > 0 for side in ("vision", "tactile"))
        stills = len(paths) - len(moving)
        assert table["video"].n_unique() == len(moving) // (sides - bool(stills))
        assert table["contact"].n_unique() == 2 * table["video"].n_unique()
        return
    used = {v for c in ("vision", "tactile", "background") for v in table[c].drop_nulls()}
    assert used == {p.removeprefix("own/") for p in paths if not p.endswith(".csv")}
    assert table["id"].n_unique() == len(table)


FOLDERS = {
    "side by side": ["{o}/press_{c}/photo/{f:04}.jpg", "{o}/press_{c}/touch/{f:04}.jpg"],
    "interleaved": ["{o}/{c}{f}_rgb.png", "{o}/{c}{f}_tac.png"],
    "roles on top": ["Camera/{o}/{c}/{f}.jpg", "GelSight/{o}/{c}/frame_{f}.jpg"],
    "ends of names": ["{o}/x{c}{f}.png", "{o}/x{c}{f}_tactile.png"],
    "a folder a sample": ["{o}_{c}_{f}/rgb.png", "{o}_{c}_{f}/gelsight.png"],
    "roles twice": ["all_rgb/x_{k}_rgb.jpg", "all_tac/x_{k}_tac.jpg"],
    "parts and materials": ["train/Wood/{o}_{k}_photo.jpg", "train/Wood/{o}_{k}_touch.jpg"],
    "tactile alone": ["gelsight/{o}/{c}/{f}.png"],
}
WHICH = {
    "ends that say nothing": ["{o}_{c}{f}.png", "{o}_{c}{f}_real.png"],
    "folders that say nothing": ["left/{o}/{c}{f}.png", "right/{o}/{c}{f}.png"],
    "one silent side": ["{o}/{c}{f}.png"],
}


def files_of(sides):
    places = list(product(("cup", "big_mug"), (1, 2), range(3)))
    return [s.format(o=o, c=c, f=f, k=k) for k, (o, c, f) in enumerate(places) for s in sides]


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_whose_names_say_what_is_where_needs_no_template(name, tmp_path, capsys):
    files = files_of(FOLDERS[name])
    make_tree([str(tmp_path / "own" / file) for file in files])
    assert main(["import", str(tmp_path / "own"), "-o", str(tmp_path / "m"), "-q"]) == 0
    assert capsys.readouterr().out.count("\nexample ") == 3
    table = Manifest.load(tmp_path / "m").table
    assert len(table) == 12
    for side, column in zip(reversed(FOLDERS[name]), ("tactile", "vision"), strict=False):
        assert sorted(table[column]) == sorted(files_of([side]))


@pytest.mark.parametrize("name", WHICH)
def test_a_folder_whose_names_do_not_say_answers_with_commands(name, tmp_path, capsys):
    make_tree([str(tmp_path / "own" / file) for file in files_of(WHICH[name])])
    command = ["import", str(tmp_path / "own"), "-o", str(tmp_path / "m"), "-q"]
    assert main(command) == 2
    assert not (tmp_path / "m").exists()
    answers = re.findall("(?m)^  palpate .*$", capsys.readouterr().err)
    assert 2 <= len(answers) <= 3
    for answer in answers:
        assert main([*shlex.split(answer)[1:], "--overwrite"]) == 0
        assert len(Manifest.load(tmp_path / "m")) in (6, 12, 24)


def test_lists_without_two_sides_are_read_as_photos(tmp_path):
    make_tree([str(tmp_path / "own" / file) for file in files_of(WHICH["one silent side"])])
    assert load(tmp_path / "own").table["vision"].count() == 12
    templated = load(tmp_path / "own", tactile="{object}/{frame}.png").table
    assert (templated["tactile"].count(), templated["object"].n_unique()) == (12, 2)


def test_fields_beyond_the_columns_are_kept_with_the_digest(tmp_path):
    make_tree([str(tmp_path / "own" / f"{o}/{s}/{k}.png") for o, s, k in product("ab", "lr", "12")])
    template = {"tactile": "{object}/{finger}/{frame}.png"}
    manifest = import_dataset(tmp_path / "own", tmp_path / "m", **template).manifest
    again = Manifest.load(tmp_path / "m")
    assert (again.digest, again.column("finger")) == (manifest.digest, list("llrrllrr"))
    renamed = {"tactile": "{object}/{side}/{frame}.png"}
    assert load(tmp_path / "own", **renamed).digest != manifest.digest
    other = Manifest(again.table.with_columns(id=pl.lit("x/") + pl.col("id")), again.root)
    assert "finger" in Manifest.join(again, other).table.columns


SESSIONS, NESTED = ["mon/cup/0", "mon/mug/0", "tue/cup/0"], ["bark/0/0", "wool/0/0"]


@pytest.mark.parametrize(
    ("column", "template", "places", "names"),
    [
        ("contact", "{material}/{contact}_{frame}", ["bark/0", "wool/0"], ["bark/0", "wool/0"]),
        ("contact", "{material}/{contact}_{frame}", ["bark/0", "wool/1"], ["0", "1"]),
        ("video", "{material}/{video}_{frame}", ["bark/0", "wool/0"], ["bark/0", "wool/0"]),
        ("contact", "{session}/{contact}_{frame}", ["mon/0", "tue/0"], ["mon/0", "tue/0"]),
        (
            "contact",
            "{session}/{object}/{contact}_{frame}",
            SESSIONS,
            ["cup/mon/0", "cup/tue/0", "mug/mon/0"],
        ),
        # the video has the name of its material
        ("contact", "{material}/{video}/{contact}_{frame}", NESTED, NESTED),
        ("contact", "{split}/{contact}_{frame}", ["train/0", "test/0"], ["0"]),
    ],
)
def test_one_name_under_different_fields_is_several(tmp_path, column, template, places, names):
    make_tree([str(tmp_path / "own" / f"{p}_{k}.png") for p, k in product(places, "12")])
    table = load(tmp_path / "own", tactile=f"{template}.png").table
    assert sorted(table[column].unique()) == names


PLACES = ("rgb/1", "rgb/2", "rgb/3", "tac/1", "tac/2")


@pytest.mark.parametrize(
    ("templates", "words"),
    [
        ({"vision": "*/nothing/{frame}.png"}, "matches none of"),
        ({"vision": "rgb/{frame}.png", "tactile": "tac/*.png"}, "must share a field"),
        ({"vision": "rgb/{frame}.png", "tactile": "rgb/{frame}.png"}, "same-image"),
        ({"vision": "rgb/{frame}.png", "tactile": "tac/{frame}.png"}, "1 unpaired"),
        ({"vision": "/etc/{frame}.png"}, "path below the folder"),
    ],
)
def test_templates_that_lose_something_are_errors(tmp_path, templates, words):
    make_tree([str(tmp_path / f"own/{p}.png") for p in PLACES])
    with pytest.raises(PalpateError, match=words):
        import_dataset(tmp_path / "own", tmp_path / "m", **templates)
    assert not (tmp_path / "m").exists()


def test_images_of_no_template_are_reported(tmp_path):
    make_tree([str(tmp_path / f"own/{p}.png") for p in ("rgb/1", "tac/1", "other/5")])
    templates = {"vision": "rgb/{frame}.png", "tactile": "tac/{frame}.png"}
    imported = import_dataset(tmp_path / "own", tmp_path / "m", **templates)
    kinds = {problem.kind: problem.text for problem in imported.suspicious}
    assert kinds["unmatched"] == "images of no template: other/5.png"


@pytest.mark.parametrize(
    ("names", "tactile"),
    [
        # Role words inside names, beside what varies.
        (
            ["2023_{o}_RGB_{c}{f:02}.png", "2023_{o}_GelSight_{c}{f:02}.png"],
            "2023_{object}_GelSight",
        ),
        (
            ["Object{c}Press{f}Rgb.png", "Object{c}Press{f}Tactile.png"],
            "Object{object}Press{contact}",
        ),
        (
            ["obj{c}_press2_{f}_rgb.png", "obj{c}_press2_{f}_gel.png"],
            "obj{object}_press2_{frame:d}_gel",
        ),
        # One side has the word, the other any word, none, or a weak one in its place.
        (["{o}/{c}/frames/{f}.png", "{o}/{c}/gelsight/{f}.png"], "{object}/{video}/gelsight/"),
        (["images/{o}_{c}{f}.png", "gelsight_images/{o}_{c}{f}.png"], "gelsight_images/{object}_"),
        (["touch_{c}/image_{f}.png", "touch_{c}/touch_{f}.png"], "touch_{contact}/touch_{frame:d}"),
        # Two sensors beside one camera.
        (
            ["t_{c}/camera0/{f}.png", "t_{c}/digit_l/{f}.png", "t_{c}/digit_r/{f}.png"],
            "{video}/digit_{sensor}/{frame:d}",
        ),
        # Words that name one field differently.
        (["obj{o}/IMG_{f}.png", "obj{o}/GEL_{f}.png"], "{video}/GEL_{frame:d}.png"),
        # What stands for something in a template.
        (["{{{o}}}/rgb/{f}.png", "{{{o}}}/tac/{f}.png"], "{video}/tac/{frame:d}"),
    ],
)
def test_templates_of_names(names, tactile):
    layout = detect_layout(sorted(set(files_of(names))), "own")
    assert layout["tactile"].startswith(tactile)
    rows, problems = join(
        assign(sorted(set(files_of(names))), {s: Template.parse(t) for s, t in layout.items()})
    )
    assert (len(rows) > 0, problems) == (True, [])


NAME = st.text("aB1_-. {}*ü", min_size=1, max_size=6).filter(lambda name: name.strip(". ") != "")


@settings(max_examples=150)
@given(st.lists(st.lists(NAME, min_size=1, max_size=3).map("/".join), min_size=1, unique=True))
def test_a_template_that_is_found_matches_every_file(paths):
    files = [f"{path}.png" for path in paths]
    for text in (template_of(files), *detect_layout(files, "own").values()):
        Template.parse(text)
    template = Template.parse(template_of(files))
    assert [file for file in files if template.match(file) is None] == []


def test_ten_thousand_names_are_understood():
    files = [
        f"{o}/{c}/{s}/{f}.png"
        for o, c, s, f in product(range(50), range(10), ("rgb", "tac"), range(10))
    ]
    assert detect_layout(files, "own") == {
        "vision": "{object}/{video}/rgb/{frame:d}.png",
        "tactile": "{object}/{video}/tac/{frame:d}.png",
    }


# --- All verbs


def texture(path, o, c, f):
    """Stripes of an object under a blob that moves with the contact and the frame."""
    rng = np.random.default_rng([o, c, f])
    y, x = np.mgrid[:32, :32]
    tactile = int("tac" in path.name or "touch" in str(path) or "real" in path.name)
    wave = 60 * np.sin((x * (1 + o % 4) + y * (o % 3)) / 4 + tactile)
    blob = 80 * np.exp(-((x - 8 * c - f) ** 2 + (y - 5 * c) ** 2) / 40)
    image = np.clip(100 + wave + blob + rng.normal(0, 8, (32, 32)), 0, 255).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).convert("RGB").save(path)


PHOTO, TOUCH = "{o}/press_{c}/photo/{f}.png", "{o}/press_{c}/touch/{f}.png"
#: Name -> files, arguments of the import.
STRANGERS = {
    "side by side": ((PHOTO, TOUCH), []),
    "interleaved": (("{o}/{c}{f}_rgb.png", "{o}/{c}{f}_tac.png"), []),
    "suffix pairs": (
        ("{o}_{c}{f}.png", "{o}_{c}{f}_real.png"),
        ["--vision", "{object}_{frame}.png", "--tactile", "{object}_{frame}_real.png"],
    ),
    "one-sided": (("touch/{o}/{c}/{f}.png",), []),
    "flat videos": (("{o}_cam.mp4", "{o}_gel.mp4"), ["--max-per-contact", "4"]),
    "one-sided videos": (
        ("{o}_1.mov",),
        ["--tactile", "{object}_{video}.mov", "--max-per-contact", "4"],
    ),
    "table": (
        (PHOTO, TOUCH),
        ["--map", "vision=image", "tactile=gel", "video=clip", "material=kind"],
    ),
}


def write_stranger(root, sides, as_table):
    if sides[0].endswith(MOVING):
        for o, side in product(range(6), sides):
            make = photos if "cam" in side else gel_video
            save(root / side.format(o=f"thing{o}"), make(70, ((20, 30), (45, 55)), seed=o))
        return root
    lines = ["clip,kind,image,gel"]
    for o, c, f in product(range(6), range(2), range(4)):
        paths = [side.format(o=f"thing{o}", c=c, f=f) for side in sides]
        for path in paths:
            texture(root / path, o, c, f)
        lines.append(f"{o},oak bark {o % 2},{','.join(paths)}")
    if as_table:
        (root / "list.csv").write_text("\n".join(lines))
    return root / "list.csv" if as_table else root


QUICK = "--permutations 0 --companions none"
#: Two-sided videos, a table and one side: the others differ in nothing but their import.
#: Layouts that go through every verb.
EVERY_VERB = {
    "flat videos": pytest.mark.slow,
    "table": pytest.mark.nightly,
    "one-sided": pytest.mark.slow,
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=EVERY_VERB.get(n, ())) for n in STRANGERS])
def test_a_strangers_layout_reaches_every_verb_with_one_import(name, tmp_path, monkeypatch, capsys):
    sides, options = STRANGERS[name]
    source = write_stranger(tmp_path / "own", sides, name == "table")
    monkeypatch.chdir(tmp_path)

    def run(words, *more):
        # A set this small has too few unrelated pictures: its audit cannot tell.
        allowed = (0, 3) if words.startswith("audit") else (0,)
        assert main([*words.split(), *more, "-q"]) in allowed, capsys.readouterr().err

    run(f"import {source} -o m", *options)
    run("split m -o s.json")
    run("audit m --split s.json -o audit.json", *["--no-images"] * (name not in EVERY_VERB))
    if name not in EVERY_VERB:
        return
    run("train encoder m --split s.json --preset tiny --device cpu -o e")
    if len(sides) == 1:
        (generated, *_) = [*source.glob("touch/thing1"), *Path("m/images").glob("thing1/*/*")]
        run(f"score --generated {generated} --reference m --encoder e --allow-seen {QUICK}")
        return
    run("train generator m --split s.json --clip e --preset tiny --steps 2 --device cpu -o g")
    run("generate m --model g --split s.json --device cpu -o made")
    run(f"score --generated made --reference m --split s.json --encoder e -o score.json {QUICK}")
    run("report audit.json score.json -o page.html")
    assert not list(tmp_path.glob(".*.work"))
    results = Results.load(tmp_path / "page.json")
    assert results.audits[0].leaked_fraction == 0
    assert results.scores
    assert results.gallery
    assert results.settings["digests"]["split"] == results.audits[0].split
    assert any(command.startswith("palpate score") for command in results.commands)
