"""Column mapping: SQL expressions, mistakes in one line, and docs/concepts/data.md."""

import contextlib
import json
import re
import shlex
from pathlib import Path

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forge.errors import fails
from forge.pictures import write_image
from palpate.cli import main
from palpate.core import PalpateError
from palpate.data.manifest import Manifest
from palpate.data.mapping import compile_maps, text_of

DOCS = Path(__file__).resolve().parents[1] / "docs" / "concepts" / "data.md"
PATH = "data2/4-1702596295.70/vision/160-0.0207.jpg"
ROW = {"path": PATH, "left image": "l.png", "rgb-path": "r", "end": "7", "none": None}


def mapped(maps, row=ROW, targets=("video", "id", "frame", "tactile", "vision")):
    table = pl.DataFrame({k: [v] for k, v in row.items()}, schema=dict.fromkeys(row, pl.String))
    return compile_maps(maps, list(row), targets).apply(table).row(0, named=True)


def value(text):
    return mapped({"video": text})["video"]


def test_the_table_of_the_documentation_is_true():
    rows = re.findall(r"^\| `(.*)` \| `(.*)` \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE)
    cases = [(text.replace("\\|", "|"), result) for text, result in rows]
    assert len(cases) == 11
    assert [(text, value(text)) for text, _ in cases] == cases


@pytest.mark.parametrize(
    ("text", "result"),
    [
        ("rgb-path", "r"),  # the exact name of a column goes before any expression
        ("end", "7"),
        ("none", None),
        ("'a' || none", None),
        ("coalesce(none, 'a')", "a"),
        ("split_part(path, '/', 9)", ""),  # nothing there: a problem of the row
        ("' x '", "x"),
        ("cast(end as int) + 1", "8"),
    ],
)
def test_forms(text, result):
    assert value(text) == result


def test_expressions_use_columns_first_and_other_targets_in_any_order():
    assert mapped({"id": "video || '/1'", "video": "split_part(path, '/', 1)"})["id"] == "data2/1"
    cells = mapped({"video": "left(video, 1)", "id": "video"}, {"video": "xy"})
    assert cells == {"video": "x", "id": "xy"}
    maps = compile_maps({"video": "path", "id": '"left image" || path'}, list(ROW), ["video", "id"])
    assert (maps.source("video"), maps.source("id")) == ("path", None)
    assert set(maps.columns) == {"path", "left image"}
    assert maps.without(["id"]).columns == ("path",)


@pytest.mark.parametrize(
    ("maps", "got"),
    [
        ({"video": "foo"}, "video=foo: no foo among path, left image"),
        ({"video": "'x' || foo"}, "no foo among"),
        ({"video": "path +"}, "unable to parse"),
        ({"video": ""}, "video=: "),
        ({"video": "__import__('os')"}, "unsupported function '__import__'"),
        ({"video": "array_get(path, 1)"}, "expected List"),
        ({"video": "id", "id": "video"}, "depends on"),
        ({"clip": "path"}, "'clip'"),
    ],
)
def test_mistakes_name_the_target_and_the_expression(maps, got):
    error = fails("", mapped, maps)
    assert error.argument == "columns"
    assert got in error.got


@settings(max_examples=60)
@given(st.text("path[]()~/'\"|:,-0 substrelct", max_size=25))
def test_any_text_is_an_expression_or_an_error(text):
    with contextlib.suppress(PalpateError):
        value(text)


def test_cells_as_text():
    cells = (" a ", "", None, float("nan"), 3, 2.5, True)
    assert [text_of(v) for v in cells] == ["a", None, None, None, "3", "2.5", "True"]


def write_examples(root: Path) -> None:
    """The files that the documentation's examples name."""
    for side in ("video_frame", "gelsight_frame"):
        write_image(root / "dataset" / "20220601_182052" / side / "0000033833.jpg", 1)
    (root / "label.txt").write_text("20220601_182052/0000033833.jpg,3")
    (root / "category_reference.txt").write_text("Wood: 3\n")
    for side in ("vision", "tactile"):
        write_image(root / "data2" / "4-1702596295.70" / side / "160-0.0207.jpg", 2)
    (root / "hct.csv").write_text(f'url,caption\n{PATH},"soft, warm"\n')
    for side in ("rgb", "tac"):
        write_image(root / f"images_{side}" / f"image_437_{side}.jpg", 3)
    (root / "ssvtp.csv").write_text("url,caption\nimages_rgb/image_437_rgb.jpg,hard\n")
    write_image(root / "tactile" / "camera_3" / "run_12" / "0007.png", 4)


TAG, HCT = "dataset/20220601_182052", "data2/4-1702596295.70"
EXAMPLES = {
    "tag": {"video": "20220601_182052", "frame": 33833, "material": "Wood"}
    | {"vision": f"{TAG}/video_frame/0000033833.jpg"}
    | {"tactile": f"{TAG}/gelsight_frame/0000033833.jpg"},
    "hct": {"video": HCT, "frame": 160, "domain": "data2", "text": "soft, warm", "vision": PATH}
    | {"tactile": f"{HCT}/tactile/160-0.0207.jpg"},
    "ssvtp": {"vision": "images_rgb/image_437_rgb.jpg", "text": "hard"}
    | {"tactile": "images_tac/image_437_tac.jpg"},
    "tactile_manifest": {"video": "camera_3", "frame": 7, "tactile": "camera_3/run_12/0007.png"},
}


def test_the_examples_of_the_documentation_run(tmp_path, monkeypatch, capsys):
    write_examples(tmp_path)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```sh\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == len(EXAMPLES)
    for snippet in re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL):
        exec(snippet, {})
    for block in blocks:
        command = shlex.split(block.replace("\\\n", " "))
        assert main([*command[1:], "-q"]) == 0, capsys.readouterr().err
    for folder, cells in EXAMPLES.items():
        row = Manifest.load(Path(folder)).require_valid().table.drop("id").row(0, named=True)
        assert {k: v for k, v in row.items() if v is not None} == cells


def test_the_paths_of_a_real_published_list_follow_from_one_another(real_data):
    items = json.loads((real_data / "tvl" / "test_items.json").read_text())
    table = pl.DataFrame(items, schema=["image_fp", "tactile_fp"])
    maps = {
        "hct": "replace(image_fp, '/vision/', '/tactile/')",
        "ssvtp": "replace(replace(image_fp, '_rgb/', '_tac/'), '_rgb.', '_tac.')",
    }
    for kind, count in (("hct", 356), ("ssvtp", 46)):
        rows = table.filter(pl.col("image_fp").str.starts_with(kind))
        cells = compile_maps({"tactile": maps[kind]}, rows.columns, ["tactile"]).apply(rows)
        assert cells["tactile"].to_list() == rows["tactile_fp"].to_list()
        assert len(rows) == count


NUMBERS = {"path": ["a/b", "a/c"], "n": ["2", "9000000000000"], "k": ["5", "7"]}


def column(text):
    maps = compile_maps({"object": text}, list(NUMBERS), ["object"])
    return maps.apply(pl.DataFrame(NUMBERS))["object"].to_list()


@pytest.mark.parametrize(
    ("text", "got"),
    [
        *[(t, "no function of the cells of one row") for t in ("max(path)", "unnest(path)")],
        *[(t, "no function of the cells of one row") for t in ("path || count(*)", "first(path)")],
        ("rpad(substr(path, 1, 3), 60000)", "texts of more than"),
        ("rpad(path, 60000+300)", "texts of more than"),
        ("rpad/**/(path, 60000)", "texts of more than"),
        ("rpad(k, n)", "texts of more than"),  # as long as the second row says
        ("length(rpad(path, 1000000000000))", "texts of more than"),  # not even on the way
        (f"replace(path, '/', '{'x' * 5000}')", "texts of more than"),
        (f"concat_ws('{'Plus ' * 1000}', path, k)", "texts of more than"),
        (r"regexp_replace(rpad(path, 500), '(.*)', '\1\1\1\1\1\1\1\1\1')", "texts of more than"),
        ("substr(path, cast(n as bigint) * 10000000000)", "too large for its type"),
        ("(cast(n as bigint) * 10000000000) % 7", "too large for its type"),
        ("'a' || (cast(n as bigint) * 10000000000)", "too large for its type"),
        ("cast(k as tinyint) * 20 > 0", "too large for its type"),
        ("cast(cast(cast(n as bigint) * 10000000000 as text) as bigint)", "too large"),
    ],
)
def test_an_expression_sees_one_row_and_makes_no_long_text_and_no_wrong_number(text, got):
    assert got in fails("", column, text).got


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("'cup'", ["cup", "cup"]),
        ("n * 10", ["20", "90000000000000"]),
        ("lpad(k, 10, '0')", ["0000000005", "0000000007"]),
        ("replace(replace(path, '/', '/of/'), '/', '/by/')", ["a/by/of/by/b", "a/by/of/by/c"]),
        ("split_part(split_part(split_part(path, '/', 1), 'x', 1), 'y', 1)", ["a", "a"]),
        ("n - 9000000000000 * 2", ["-17999999999998", "-9000000000000"]),
        ("case when k in ('5', '6') then path else upper(path) end", ["a/b", "A/C"]),
    ],
)
def test_what_an_expression_may_do(text, values):
    assert column(text) == values
