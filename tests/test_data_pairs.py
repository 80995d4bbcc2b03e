"""Pairs: tables of four kinds and folders, with every bad row reported; recognizing formats."""

import json
from functools import partial

import polars as pl
import pytest

from forge.errors import fails
from forge.pictures import tree, write_frames, write_image
from palpate.core import PalpateError
from palpate.data.formats import FORMATS
from palpate.data.importing import import_dataset, validate
from palpate.data.manifest import Manifest

import_pairs = partial(import_dataset, format="pairs")


@pytest.fixture
def images(tmp_path):
    root = tmp_path / "data"
    for k in range(6):
        write_image(root / "v" / f"{k}.jpg", k)
        write_image(root / "t" / f"{k}.jpg", k)
    return root


def write_table(path, text):
    path.write_text(text)
    return path


def problems_of(table, **options):
    invalid = validate(table, format="pairs", **options).invalid
    return [(p.where.rpartition(":")[2], p.kind) for p in invalid]


def rows_of(result, *columns):
    return result.manifest.require_valid().table.select(columns).rows()


# --- Tables

ROWS = [
    {"clip": "x", "frame": k, "vision": f"v/{k}.jpg", "touch": f"t/{k}.jpg", "material": material}
    for k, material in enumerate((None, "wood", "wood"))
]
MAPS = {"video": "clip", "tactile": "touch"}


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".jsonl", ".parquet"])
def test_tables_of_every_kind_give_the_same_manifest(images, tmp_path, suffix):
    table, frame = images / f"pairs{suffix}", pl.DataFrame(ROWS)
    if suffix == ".parquet":
        frame.write_parquet(table)
    elif suffix == ".jsonl":
        table.write_text("".join(json.dumps(row) + "\n" for row in ROWS))
    else:
        text = frame.write_csv(separator="\t" if suffix == ".tsv" else ",")
        table.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    result = import_dataset(table, tmp_path / "out", columns=MAPS)
    assert rows_of(result, "id", "frame", "material", "tactile", "text") == [
        ("x/0", 0, None, "t/0.jpg", None),
        ("x/1", 1, "wood", "t/1.jpg", None),
        ("x/2", 2, "wood", "t/2.jpg", None),
    ]
    assert result.facts["text_source"] == "none"
    assert Manifest.load(tmp_path / "out").digest == result.manifest.digest


def test_every_bad_row_is_reported_and_nothing_is_written(images, tmp_path):
    (images / "v" / "4.jpg").write_bytes((images / "v" / "4.jpg").read_bytes()[:-300])
    (images / "t" / "5.jpg").write_bytes(b"")
    lines = [
        ('a,v/0.jpg,t/0.jpg,0,"soft,', []),
        ('warm"', []),  # of the same row
        ("a,v/1.jpg,t/1.jpg,1,", ["duplicate-id"]),
        ("b,../data/../x.jpg,t/1.jpg,1,", ["outside-root"]),
        ("c,v/9.jpg,t/9.jpg,1,", ["missing-file"] * 2),
        ("d,v/4.jpg,t/1.jpg,1,", ["bad-image"]),  # cut
        ("e,v/4.jpg,t/5.jpg,1,", ["bad-image"]),  # cut again, reported once; and an empty one
        ("f,v/1.jpg,t/1.jpg,first,", ["bad-frame"]),
        ("g,v/1.jpg,t/1.jpg", ["bad-row"]),
        ("h,,t/1.jpg,1,", ["empty-cell"]),
        ("i,v/2.jpg,t/2.jpg,,", []),
        ("j,/etc/hostname,t/2.jpg,,", ["outside-root"]),
    ]
    text = "\n".join(["id,vision,tactile,frame,text", *(line for line, _ in lines)])
    table = write_table(images / "pairs.csv", text)
    expected = [(f"{table}:{n}", k) for n, (_, some) in enumerate(lines, 2) for k in some]
    error = fails("", import_pairs, table, tmp_path / "out")
    assert [(p.where, p.kind) for p in error.problems] == expected
    assert "used by 2 rows" in error.problems[4].text
    assert not (tmp_path / "out").exists()
    result = import_pairs(table, tmp_path / "out", skip_bad=True)
    assert [(p.where, p.kind) for p in result.skipped] == expected
    assert rows_of(result, "id", "text") == [("a", "soft,\nwarm"), ("i", None)]
    assert result.facts["text_source"] == "column text"


FINE = b'{"vision": "v/0.jpg"}'


@pytest.mark.parametrize(
    ("name", "data", "problems"),
    [
        ("p.jsonl", FINE + b"\n{oops\n\n[1]\n", {2: "bad-row", 4: "bad-row"}),
        (
            "p.jsonl",
            b'{"vision": "v/0.jpg", "text": "\\ud800"}\n{"vision": ["v/0.jpg"]}\n'
            b'{"vision": "v/1.jpg", "text": "\\u0000"}\n' + b"[" * 100_000,
            {1: "bad-encoding", 2: "bad-row", 3: "bad-encoding", 4: "bad-row"},
        ),
        (
            "p.csv",
            b"vision,frame\nv/0.jpg,-1\nv/\xff.jpg,1\nv/\x00.jpg,1\nv/1.jpg,2.5\nv/1.jpg,2.0\n",
            {2: "bad-frame", 3: "bad-encoding", 4: "bad-encoding", 5: "bad-frame"},
        ),
        ("p.csv", b'vision,frame\nv/1.jpg,1\n"v/2.jpg,1\nv/3.jpg,1\n', {3: "open-quote"}),
        # Two stray quotes make one cell of the rows between them.
        (
            "p.csv",
            b'vision,text\nv/0.jpg,a\nv/1.jpg,"b\nv/2.jpg,c\nv/3.jpg,d\nv/4.jpg,e"\nv/5.jpg,"f\n,g"\n',
            {3: "open-quote"},
        ),
        ("p.json", b"\xef\xbb\xbf[" + FINE + b", 7]", {2: "bad-row"}),
        ("p.json", b"[" + FINE + b" " + FINE + b"]", {1: "bad-row"}),
    ],
)
def test_rows_that_cannot_be_right_are_reported_by_line(images, name, data, problems):
    (images / name).write_bytes(data)
    assert sorted(problems_of(images / name)) == [(str(n), k) for n, k in problems.items()]


def test_tables_that_cannot_be_read(images, tmp_path):
    (images / "p.parquet").write_bytes(b"words")
    fails("bad-table", import_pairs, images / "p.parquet", tmp_path / "out")
    (images / "p.json").write_text('{"vision": ["v/0.jpg"]}')
    fails("a JSON list of objects", import_pairs, images / "p.json", tmp_path / "out")


def test_missing_columns_and_wrong_names(images, tmp_path):
    table = write_table(images / "t.csv", "clip,vision,touch\nx,v/0.jpg,t/0.jpg\n")
    lone = import_pairs(table, tmp_path / "lone")  # two images a sample may be meant
    assert [(p.where, p.kind) for p in lone.suspicious] == [(str(table), "one-sided")]
    with pytest.raises(PalpateError, match="no clap among"):
        import_pairs(table, tmp_path / "out", columns={"video": "clap", "tactile": "touch"})
    with pytest.raises(PalpateError, match="no clap among"):
        import_pairs(table, tmp_path / "out", columns={"frame": "left(clap, 2)"})
    fails("'clip'", import_pairs, table, tmp_path / "out", columns={"clip": "video"})
    for text, word in (
        ("clip,touch\nx,t/0.jpg\n", "no tactile among clip"),
        ("vision,tactile\n", "at least one"),
    ):
        fails(word, import_pairs, write_table(images / "other.csv", text), tmp_path / "out")


def test_root_and_unusual_but_inner_paths(images, tmp_path):
    text = f"vision,tactile\n./v/0.jpg,t/../t/0.jpg\n{images}/v/1.jpg,t/1.jpg\n"
    table = write_table(tmp_path / "elsewhere.csv", text)
    result = import_pairs(table, tmp_path / "out", root=images)
    expected = [("t/0", "v/0.jpg", "t/0.jpg"), ("t/1", "v/1.jpg", "t/1.jpg")]
    assert rows_of(result, "id", "vision", "tactile") == expected


def test_paths_that_no_file_can_have(images):
    paths = ["ä" * 200 + ".jpg", "v/" * 200 + "0.jpg", "v", ".", "v/0.jpg/x", "~/v/0.jpg"]
    text = "\n".join(["vision", *paths, "../x.jpg", "v/0.jpg"])
    table = write_table(images / "t.csv", text)
    assert problems_of(table) == [("2", "bad-path"), ("8", "outside-root")]
    missing = validate(table).missing
    assert [int(p.where.rpartition(":")[2]) for p in missing] == [3, 4, 5, 6, 7]


@pytest.mark.parametrize("sign", [",", ";", "\t"])
@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_unusual_but_right_files(images, tmp_path, sign, code, end):
    name = "größe, ½\u2028 x.jpg"  # a line separator that is not the end of a line
    write_image(images / "v" / name, 1)
    lines = [f"vision{sign}tactile{sign}text", "", f'"v/{name}"{sign}t/0.jpg{sign}"a ""b"""']
    lines += [f'v/1.jpg{sign}t/1.jpg{sign}5" pipe', f"{sign}{sign} "]
    (images / "odd.csv").write_bytes(end.join(lines).encode(code))
    result = import_pairs(images / "odd.csv", tmp_path / "out")
    assert rows_of(result, "vision", "text") == [(f"v/{name}", 'a "b"'), ("v/1.jpg", '5" pipe')]


def test_parquet_cells_of_any_type_and_brackets_in_names(images, tmp_path):
    table = {
        "vision": ["v/0.jpg", "v/1.jpg"],
        "frame": [3.0, None],
        "material": pl.Series(["a", "b"], dtype=pl.Categorical),
        "text": [1, 2],
        "emb": [[1.0], [2.0]],
    }
    pl.DataFrame(table).write_parquet(images / "p[1]*.parquet")
    result = import_dataset(images / "p[1]*.parquet", tmp_path / "out")
    assert rows_of(result, "frame", "material", "text") == [(3, "a", "1"), (None, "b", "2")]
    for bad, word in (
        ({"vision": [b"x"]}, "vision of type Binary.*format hf"),
        ({"vision": ["v/0.jpg"], "text": [["x"]]}, "text of type List"),
    ):
        pl.DataFrame(bad).write_parquet(images / "bad.parquet")
        fails(word, import_pairs, images / "bad.parquet", tmp_path / "bad")


def test_tables_without_a_header(images, tmp_path):
    table = write_table(images / "list.txt", "0.jpg,3\n1.jpg,4")
    maps = {"vision": "'v/' || path", "tactile": "'t/' || path", "material": "label"}
    result = import_pairs(table, tmp_path / "out", names="path, label", columns=maps)
    assert rows_of(result, "tactile", "material") == [("t/0.jpg", "3"), ("t/1.jpg", "4")]
    fails("no tactile among path, label", import_pairs, table, tmp_path / "out2")


# --- Maps, classes, parts, groups and ids


def test_one_modality_is_enough_and_paths_may_follow_from_another(images, tmp_path):
    table = write_table(images / "lone.csv", "vision\nv/0.jpg\nv/1.jpg\n")
    result = import_pairs(table, tmp_path / "a")
    assert rows_of(result, "id", "tactile") == [("v/0", None), ("v/1", None)]
    maps = {"tactile": "replace(vision, 'v/', 't/')", "frame": "substr(vision, 3, 1)"}
    result = import_pairs(table, tmp_path / "b", columns=maps | {"video": "'x'"})
    assert rows_of(result, "id", "tactile") == [("x/0", "t/0.jpg"), ("x/1", "t/1.jpg")]
    assert result.suspicious == []


def test_a_map_that_fails_is_a_problem_of_its_row(images):
    table = write_table(images / "t.csv", "vision\nv/0.jpg\nv/1.jpg\n")
    maps = {"frame": "replace(split_part(vision, '1', 2), '.jpg', '1')"}
    assert problems_of(table, columns=maps) == [("2", "bad-map")]


@pytest.mark.parametrize(
    "text",
    [
        'Wood: 3\n"Synthetic  Fabric": 8 (soft)\n',
        "id,name\n3,Wood\n8,Synthetic Fabric\n",
        "Wood;3\r\nSynthetic Fabric;8",
    ],
)
def test_classes_name_numbers_and_unknown_ones_are_problems(images, tmp_path, text):
    classes = write_table(images / "c.txt", text)
    labels = enumerate(("3", "8.0", "-1", "Wood", "", "9"))
    lines = [f"v/{k}.jpg,t/{k}.jpg,{label}" for k, label in labels]
    table = write_table(images / "t.csv", "\n".join(["vision,tactile,material", *lines]))
    result = import_pairs(table, tmp_path / "out", classes=classes, skip_bad=True)
    assert [(p.where, p.kind) for p in result.skipped] == [(f"{table}:7", "unknown-label")]
    assert result.manifest.column("material") == ["Wood", "Synthetic Fabric", "Wood", None]
    assert result.inconclusive == 1


@pytest.mark.parametrize(
    ("text", "word"),
    [("3,Wood\n3,Rock\n", "duplicate-id"), ("3,Wood\nx,y\n", "bad-line"), ("a,b\n", "none")],
)
def test_bad_tables_of_classes(images, tmp_path, text, word):
    table = write_table(images / "t.csv", "vision,material\nv/0.jpg,3\n")
    fails(word, import_pairs, table, tmp_path / "bad", classes=write_table(images / "c.txt", text))


def test_a_column_of_parts_becomes_the_split(images, tmp_path):
    parts = ("train", "Validation", "", "later")
    lines = [f"./v/{k}.jpg,./t/{k}.jpg,{part}" for k, part in enumerate(parts)]
    table = write_table(images / "t.csv", "\n".join(["vision,tactile,fold", *lines]))
    result = import_pairs(table, tmp_path / "out", columns={"split": "fold"}, skip_bad=True)
    assert dict(result.splits["Orig"].parts) == {"t/0": "train", "t/1": "val"}
    assert [p.kind for p in result.skipped] == ["unknown-part"]
    assert result.manifest.ids == ["t/0", "t/1", "t/2"]


def test_groups_in_doubt_are_reported_with_their_number(images, tmp_path):
    lines = [f"v/{k}.jpg,{video}," for k, video in enumerate(("a", "", ""))]
    table = write_table(images / "t.csv", "\n".join(["vision,video,object", *lines]))
    (problem, _) = import_pairs(table, tmp_path / "out").suspicious
    assert (problem.kind, problem.text[:26]) == ("null-group", "2 of 3 rows have no video,")
    assert f"{table}:3" in problem.text
    lines = [f"v/{k}.jpg,{thing},1" for k, thing in enumerate(("cup", "mug"))]
    table = write_table(images / "t.csv", "\n".join(["vision,object,contact", *lines]))
    (problem, _) = import_pairs(table, tmp_path / "out3").suspicious
    assert problem.kind == "shared-contact"
    assert "'1' in cup, mug" in problem.text


def test_an_id_of_two_parts_is_in_neither_and_the_first_usable_row_keeps_it(images, tmp_path):
    lines = ["id,vision,split", "a,v/0.jpg,train", "a,v/2.jpg,test", "c,v/3.jpg,test"]
    lines += ["c,v/none.jpg,train", "d,v/4.jpg,", "d,v/5.jpg,train", "e,v/5.jpg,test"]
    table = write_table(images / "t.csv", "\n".join([*lines, "e,v/1.jpg,test"]))
    result = import_pairs(table, tmp_path / "out", skip_bad=True)
    kinds = {3: "two-parts", 5: "missing-file", 7: "duplicate-id", 9: "duplicate-id"}
    assert [(p.where, p.kind) for p in result.skipped] == [
        (f"{table}:{n}", kind) for n, kind in kinds.items()
    ]
    rows = {"a": "v/0.jpg", "c": "v/3.jpg", "d": "v/4.jpg", "e": "v/5.jpg"}
    assert dict(rows_of(result, "id", "vision")) == rows
    assert dict(result.splits["Orig"].parts) == {"c": "test", "e": "test"}
    table = write_table(images / "t.csv", "vision,tactile\nv/2.jpg,t/1.jpg\nv/3.jpg,t/1.jpg\n")
    (problem,) = validate(table).invalid
    assert (problem.where, problem.kind) == (f"{table}:3", "duplicate-id")
    assert problem.text.endswith("made of the path since there is none: map a column to id")


# --- Folders


@pytest.mark.parametrize(
    "names", [("vision", "tactile"), ("rgb", "touch"), ("images", "gelsight"), ("image", "digit")]
)
def test_folders_flat_and_nested(tmp_path, names):
    vision, tactile = names
    paths = (f"{vision}/plain.jpg", f"{tactile}/plain.png")
    for path in (*paths, f"{vision}/rec/f_0012.jpg", f"{tactile}/rec/f_0012.jpg"):
        write_image(tmp_path / "d" / path, 1)
    (tmp_path / "d" / vision / ".DS_Store").write_bytes(b"x")
    result = import_dataset(tmp_path / "d", tmp_path / "out")
    assert rows_of(result, "id", "video", "frame", "vision", "tactile") == [
        ("plain", None, None, *paths),
        ("rec/f_0012", "rec", None, f"{vision}/rec/f_0012.jpg", f"{tactile}/rec/f_0012.jpg"),
    ]
    assert tree(tmp_path / "out") == {"manifest.parquet"}


def test_a_long_table_beside_the_images_that_names_none_of_them(tmp_path):
    for side in ("vision", "tactile"):
        write_image(tmp_path / "in" / side / "0.png", 1)
    (tmp_path / "in" / "log.csv").write_text("time,volt\n" + "1,2\n" * 60_000)
    assert len(rows_of(import_pairs(tmp_path / "in", tmp_path / "out"), "id")) == 1


def test_unpaired_doubled_and_cut_files_of_folders(tmp_path):
    root = tmp_path / "d"
    for k in range(4):
        write_image(root / "vision" / f"{k}.jpg", k)
        write_image(root / "tactile" / f"{k}.jpg", k)
    for path in ("vision/0.png", "vision/7.jpg", "tactile/w/8.jpg"):
        write_image(root / path, 0)
    (root / "tactile" / "2.jpg").write_bytes(b"")
    result = import_pairs(root, tmp_path / "out", skip_bad=True)
    assert {(p.where, p.kind) for p in result.skipped} == {
        ("vision/0.png", "duplicate-id"),
        ("vision/7.jpg", "unpaired"),
        ("tactile/w/8.jpg", "unpaired"),
        ("tactile/2.jpg", "bad-image"),
    }
    assert result.manifest.ids == ["0", "1", "3"]


def test_names_that_are_not_utf8_are_problems(tmp_path):
    root = tmp_path / "d"
    for name in ("0", "1", "\udcff"):
        write_image(root / "tactile" / f"{name}.png", 0)
    result = import_pairs(root, tmp_path / "out", skip_bad=True)
    assert [(p.where, p.kind) for p in result.skipped] == [
        (r"'tactile/\udcff.png'", "bad-encoding")
    ]
    assert len(result.manifest) == 2


def test_a_folder_of_one_kind_of_images(tmp_path):
    root = tmp_path / "d"
    for name in ("b/x 2.png", "b/deep/7.jpg", "a.jpg", ".hidden/1.jpg"):
        write_image(root / name, 1)
    (root / "b" / "again").symlink_to(root)  # links in circles end
    result = import_dataset(root, tmp_path / "out", side="tactile")
    assert rows_of(result, "id", "video", "frame", "vision", "tactile") == [
        ("a", None, None, None, "a.jpg"),
        ("b/x 2", "b", None, None, "b/x 2.png"),
        ("b/deep/7", "b/deep", None, None, "b/deep/7.jpg"),
    ]
    maps = {"video": "split_part(path, '/', 1)", "sensor": "'DIGIT'"}
    result = import_dataset(root, tmp_path / "out2", side="vision", columns=maps)
    assert rows_of(result, "video", "sensor") == [(v, "DIGIT") for v in ("a.jpg", "b", "b")]
    fails("say what they show", import_dataset, root, tmp_path / "out3")


def test_formats_are_recognized_or_all_that_were_looked_for_are_listed(tmp_path):
    for side in ("video_frame", "gelsight_frame"):
        write_frames(tmp_path / "tag" / "dataset" / "a" / side, 6)
    (tmp_path / "tag" / "label.txt").write_text("a/0000000005.jpg,3")
    options = {"max_per_contact": 1, "columns": None}
    result = import_dataset(tmp_path / "tag", tmp_path / "out", **options)
    assert (result.facts["dataset"], len(result.manifest)) == ("Touch and Go", 1)
    (tmp_path / "what").mkdir()
    (tmp_path / "what" / "readme.txt").write_text("x")
    error = fails("", import_dataset, tmp_path / "what", tmp_path / "out2")
    assert all(name in str(error) for name in FORMATS)
    assert "readme.txt" in error.got
    for options, word in (
        ({"format": "zip"}, r"one of auto, touch-and-go, .*pairs"),
        ({"columns": {"a": "b"}}, "columns"),
    ):
        fails(word, import_dataset, tmp_path / "tag", tmp_path / "out2", **options)
    fails("nothing at", import_dataset, tmp_path / "none", tmp_path / "out2")
    assert not (tmp_path / "out2").exists()
