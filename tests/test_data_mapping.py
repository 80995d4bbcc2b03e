"""Map expressions: every form, every mistake with its place, failures by row, and the examples of the documentation."""

import contextlib
import json
import re
import shlex
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_forge import write_image
from palpate.cli import main
from palpate.core import PalpateError
from palpate.data.manifest import Manifest
from palpate.data.mapping import NoValueError, compile_maps, text_of

DOCS = (Path(__file__).resolve().parents[1] / "docs" / "concepts" / "mapping.md").read_text(encoding="utf-8")
PATH = "data2/4-1702596295.70/vision/160-0.0207.jpg"
ROW = {"path": PATH, "left image": "l.png", "rgb-path": "r", "q": "it's", "none": None}


def value(text, row=ROW):
    return compile_maps({"video": text}, list(row), ["video"])["video"].value(row)


def test_the_table_of_the_documentation_is_true():
    cases = re.findall(r"^\| `(.*)` \| `(.*)` \|$", DOCS, re.MULTILINE)
    assert len(cases) == 14
    assert [(text, value(text)) for text, _ in cases] == cases


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("left image", "l.png"),
        ("rgb-path", "r"),
        (' "rgb-path" ', "r"),
        ("none[3]", None),
        ("'a' + none", None),
        ("'it''s'", "it's"),
        ("replace(q, '''', '-')", "it-s"),
        ("(path + 'x')[-1]", "x"),
        ("path[0:3][1]", "a"),
        ("path[40:]", "jpg"),
        ("path[100:]", None),
        ("path ~ /vision|touch/", "vision"),
        ("path ~ /[.]jpg/[1:]", "jpg"),
        ("int('0012.0')", "12"),
        ("int('-3')", "-3"),
        (r"part('a\b', 1)", "b"),
        ("stem('.hidden')", ".hidden"),
        ("parent('x')", None),
        ("stem(name(path))", "160-0.0207"),
    ],
)
def test_forms(text, wanted):
    assert value(text) == wanted


@pytest.mark.parametrize(
    ("text", "at", "word"),
    [
        ("path[", 6, "a whole number or ':'"),
        ("path[:15", 9, "']'"),
        ("path[a]", 6, "'a]'"),
        ("foo", 1, "no foo among path, left image"),
        ("'x' + foo", 7, "no foo"),
        ("stem(path", 10, "')'"),
        ("path ~ /(/", 7, "cannot be read"),
        ("path ~ /(a)(b)/", 7, "2 groups"),
        ("path ~ x", 8, "a pattern between slashes"),
        ("path path", 6, "the end must stand"),
        ("__import__('os')", 1, "no function '__import__'"),
        ("part(path, 'a')", 12, "a whole number"),
        ("part(path)", 10, "','"),
        ("replace(path, 1, 2)", 15, "'text'"),
        ("", 1, "the end where a column"),
        ("(" * 99 + "path", 51, "deep"),
        ("'open", 1, "a column"),
        ("path ~ /a{9999999999}/", 7, "cannot"),
    ],
)
def test_mistakes_are_told_with_the_expression_and_the_place(text, at, word):
    with pytest.raises(PalpateError) as caught:
        value(text)
    assert caught.value.must == f"The expression for video must be readable: {text}"
    assert caught.value.got.endswith(f"at character {at}")
    assert word in caught.value.got


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("path[99]", f"path[99]: '{PATH}' has 43 characters"),
        ("'a' + part(path, 9)", f"part(path, 9): '{PATH}' has 4 pieces"),
        ("path ~ /(q)/", "no match in"),
        ("path ~ /x|(q)|v/", "no match"),
        ("int(stem(path))", "int(stem(path)): '160-0.0207' is not a whole number"),
    ],
)
def test_what_a_cell_cannot_give_names_the_piece(text, said):
    with pytest.raises(NoValueError, match=re.escape(said)):
        value(text)


def test_rows_fail_one_by_one_and_runs_of_equal_cells_alike():
    expression = compile_maps({"frame": "int(stem(path))"}, ["path"], ["frame", "video"])["frame"]
    cells = ["a/01.jpg", "a/01.jpg", "a/x.jpg", "a/x.jpg", None, "b/2.jpg"]
    values, failed = expression.values({"path": cells}.__getitem__, len(cells))
    assert values == ["1", "1", None, None, None, "2"]
    assert sorted(failed) == [2, 3]


def test_targets_may_be_named_but_not_in_circles():
    maps = compile_maps({"video": "part(path, 0)", "id": "video + '/1'"}, ["path"], ["video", "id"])
    assert maps["id"].value({"path": "a/b"}) == "a/1"
    assert (
        compile_maps({"video": "video[:1]"}, ["video"], ["video"])["video"].value({"video": "xy"})
        == "x"
    )  # the column goes first
    with pytest.raises(PalpateError, match="'video', which is made of itself"):
        compile_maps({"video": "id", "id": "video"}, ["path"], ["video", "id"])
    with pytest.raises(PalpateError, match=r"among video.*'clip'"):
        compile_maps({"clip": "path"}, ["path"], ["video"])


@given(st.text(max_size=30), st.integers(-9, 9), st.integers(-9, 9))
def test_slices_are_those_of_python(text, low, high):
    assert value(f"path[{low}:{high}]", {"path": text}) == (text[low:high] or None)


@given(st.text("path[]()~/'\"+:,-0 stemint", max_size=25))
def test_any_text_is_an_expression_or_a_mistake_told(text):
    with contextlib.suppress(PalpateError, NoValueError):
        value(text)


def test_cells_as_text():
    assert [text_of(v) for v in (" a ", "", None, float("nan"), 3, 2.5, True)] == [
        "a",
        None,
        None,
        None,
        "3",
        "2.5",
        "True",
    ]


def forge(root: Path) -> None:
    """What the documentation's cases name."""
    for side in ("video_frame", "gelsight_frame"):
        write_image(root / "dataset" / "20220601_182052" / side / "0000033833.jpg", 1)
    (root / "label.txt").write_text("20220601_182052/0000033833.jpg,3")
    (root / "category_reference.txt").write_text("Wood: 3\n")
    for side in ("vision", "tactile"):
        write_image(root / "data2" / "4-1702596295.70" / side / "160-0.0207.jpg", 2)
    (root / "hct.csv").write_text(f'url,caption\n{PATH},"soft, warm"\n')
    for side, end in (("rgb", "rgb"), ("tac", "tac")):
        write_image(root / f"images_{side}" / f"image_437_{end}.jpg", 3)
    (root / "ssvtp.csv").write_text("url,caption\nimages_rgb/image_437_rgb.jpg,hard\n")
    write_image(root / "touches" / "camera_3" / "run_12" / "0007.png", 4)


def test_the_cases_of_the_documentation_run(tmp_path, monkeypatch, capsys):
    forge(tmp_path)
    monkeypatch.chdir(tmp_path)
    commands = [
        shlex.split(block.replace("\\\n", " "))
        for block in re.findall(r"```sh\n(.*?)```", DOCS, re.DOTALL)
    ]
    assert len(commands) == 4
    for command in commands:
        assert main([*command[1:], "-q"]) == 0, capsys.readouterr().err
    rows = {
        out: Manifest.load(Path(out)).require_valid().table.drop("id").row(0, named=True)
        for out in ("tag", "hct", "ssvtp", "touches_manifest")
    }
    said = {out: {k: v for k, v in row.items() if v is not None} for out, row in rows.items()}
    assert said["tag"] == {
        "video": "20220601_182052",
        "frame": 33833,
        "material": "Wood",
        "vision": "dataset/20220601_182052/video_frame/0000033833.jpg",
        "tactile": "dataset/20220601_182052/gelsight_frame/0000033833.jpg",
    }
    assert said["hct"] == {
        "video": "data2/4-1702596295.70",
        "frame": 160,
        "domain": "data2",
        "text": "soft, warm",
        "vision": PATH,
        "tactile": "data2/4-1702596295.70/tactile/160-0.0207.jpg",
    }
    assert said["ssvtp"] == {
        "vision": "images_rgb/image_437_rgb.jpg",
        "tactile": "images_tac/image_437_tac.jpg",
        "text": "hard",
    }
    assert said["touches_manifest"] == {
        "video": "camera_3",
        "frame": 7,
        "tactile": "camera_3/run_12/0007.png",
    }


def test_the_paths_of_a_real_published_list_follow_from_one_another(real_data):
    items = json.loads((real_data / "tvl" / "test_items.json").read_text())
    hct = {
        "vision": "image_fp",
        "tactile": "replace(vision, '/vision/', '/tactile/')",
        "video": "parent(parent(image_fp))",
        "frame": r"int(name(image_fp) ~ /^(\d+)-/)",
    }
    ssvtp = {
        "vision": "image_fp",
        "tactile": r"'ssvtp/images_tac/image_' + name(vision) ~ /^image_(\d+)_rgb\.jpg$/ + '_tac.jpg'",
    }
    count = {"hct": 0, "ssvtp": 0}
    for item in items:
        kind = item["image_fp"].split("/")[0]
        maps = compile_maps(
            hct if kind == "hct" else ssvtp, list(item), ["vision", "tactile", "video", "frame"]
        )
        assert maps["tactile"].value(item) == item["tactile_fp"]
        count[kind] += 1
        if kind == "hct":
            _, data, folder, _, name = item["image_fp"].split("/")
            assert maps["video"].value(item) == f"hct/{data}/{folder}"
            assert maps["frame"].value(item) == str(int(name.split("-")[0]))
    assert count == {"hct": 356, "ssvtp": 46}
