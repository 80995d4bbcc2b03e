"""Pairs: tables of four kinds and folders, with every bad row told at once; and formats found by look."""

import json
from functools import partial

import polars as pl
import pytest

from data_fixtures import tree, write_frames, write_image
from palpate.core import PalpateError, ProblemsError
from palpate.data.formats import FORMATS
from palpate.data.importing import import_dataset, validate_dataset
from palpate.data.manifest import Manifest

import_pairs = partial(import_dataset, format="pairs")


@pytest.fixture
def images(tmp_path):
    root = tmp_path / "data"
    for k in range(6):
        write_image(root / "v" / f"{k}.jpg", k)
        write_image(root / "t" / f"{k}.jpg", k)
    return root


ROWS = [
    {
        "clip": "x",
        "frame": k,
        "vision": f"v/{k}.jpg",
        "touch_path": f"t/{k}.jpg",
        "material": "wood" if k else None,
    }
    for k in range(3)
]


def write_table(path):
    frame = pl.DataFrame(ROWS)
    if path.suffix == ".parquet":
        frame.write_parquet(path)
    elif path.suffix == ".jsonl":
        path.write_text("".join(json.dumps(r) + "\n" for r in ROWS))
    else:
        path.write_bytes(
            b"\xef\xbb\xbf"
            + frame.write_csv(separator="\t" if path.suffix == ".tsv" else ",")
            .replace("\n", "\r\n")
            .encode()
        )
    return path


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".jsonl", ".parquet"])
def test_tables_of_every_kind_give_the_same_manifest(images, tmp_path, suffix):
    table = write_table(images / f"pairs{suffix}")
    found = import_dataset(
        table, tmp_path / "out", columns={"video": "clip", "tactile": "touch_path"}, size=64
    )
    assert found.manifest.ids == ["x/0", "x/1", "x/2"]
    assert found.manifest.column("frame") == [0, 1, 2]
    assert found.manifest.column("material") == [None, "wood", "wood"]
    assert found.manifest.column("tactile") == ["t/0.jpg", "t/1.jpg", "t/2.jpg"]
    assert found.manifest.column("text") == [None] * 3
    assert found.facts["text_source"] == "none"
    assert Manifest.load(tmp_path / "out").require_valid().digest == found.manifest.digest


def spoil(images):
    (images / "v" / "4.jpg").write_bytes((images / "v" / "4.jpg").read_bytes()[:-300])
    (images / "t" / "5.jpg").write_bytes(b"")
    table = images / "pairs.csv"
    table.write_text(
        "id,vision,tactile,frame,text\n"
        'a,v/0.jpg,t/0.jpg,0,"soft,\nwarm"\n'  # lines 2 and 3
        "a,v/1.jpg,t/1.jpg,1,\n"  # 4: the id again
        "b,../data/../x.jpg,t/1.jpg,1,\n"  # 5: climbs
        "c,v/9.jpg,t/9.jpg,1,\n"  # 6: both files missing
        "d,v/4.jpg,t/1.jpg,1,\n"  # 7: cut
        "e,v/4.jpg,t/5.jpg,1,\n"  # 8: cut again (told once), empty
        "f,v/1.jpg,t/1.jpg,first,\n"  # 9
        "g,v/1.jpg,t/1.jpg\n"  # 10: short
        "h,,t/1.jpg,1,\n"  # 11
        "i,v/2.jpg,t/2.jpg,,\n"  # 12: fine
        "j,/etc/hostname,t/2.jpg,,\n"  # 13: absolute
    )
    return table, [
        (4, "duplicate-id"),
        (5, "outside-root"),
        (6, "missing-file"),
        (6, "missing-file"),
        (7, "bad-image"),
        (8, "bad-image"),
        (9, "bad-frame"),
        (10, "bad-row"),
        (11, "empty-cell"),
        (13, "outside-root"),
    ]


def test_every_bad_row_is_told_at_once_and_nothing_is_written(images, tmp_path):
    table, wanted = spoil(images)
    with pytest.raises(ProblemsError) as caught:
        import_pairs(table, tmp_path / "out")
    assert [(p.where, p.kind) for p in caught.value.problems] == [
        (f"{table}:{n}", kind) for n, kind in wanted
    ]
    assert "used by 2 rows" in caught.value.problems[4].text
    assert not (tmp_path / "out").exists()
    found = import_pairs(table, tmp_path / "out", skip_bad=True)
    assert [(p.where, p.kind) for p in found.skipped] == [
        (f"{table}:{n}", kind) for n, kind in wanted
    ]
    assert found.manifest.ids == ["a", "i"]
    assert found.manifest.column("text") == ["soft,\nwarm", None]
    assert found.facts["text_source"] == "column text"


def test_bad_lines_of_jsonl_and_foreign_parquet(images, tmp_path):
    table = images / "p.jsonl"
    table.write_text('{"vision": "v/0.jpg", "tactile": "t/0.jpg"}\n{oops\n\n[1]\n')
    with pytest.raises(ProblemsError) as caught:
        import_pairs(table, tmp_path / "out")
    assert [(p.where, p.kind) for p in caught.value.problems] == [
        (f"{table}:2", "bad-row"),
        (f"{table}:4", "bad-row"),
    ]
    (images / "p.parquet").write_bytes(b"words")
    with pytest.raises(ProblemsError, match="bad-table"):
        import_pairs(images / "p.parquet", tmp_path / "out")


def test_missing_columns_and_wrong_names_are_told(images, tmp_path):
    table = write_table(images / "pairs.csv")
    lone = import_pairs(
        table, tmp_path / "lone"
    )  # touch_path is no name of ours: told, as one image a sample may be meant
    assert [(p.where, p.kind) for p in lone.suspicious] == [(str(table), "one-sided")]
    assert "no column tactile" in lone.suspicious[0].text
    (images / "neither.csv").write_text("clip,touch_path\nx,t/0.jpg\n")
    with pytest.raises(PalpateError, match="no tactile among clip"):
        import_pairs(images / "neither.csv", tmp_path / "out")
    with pytest.raises(PalpateError, match="no clap among"):
        import_pairs(table, tmp_path / "out", columns={"video": "clap", "tactile": "touch_path"})
    with pytest.raises(PalpateError, match="'clip'"):
        import_pairs(table, tmp_path / "out", columns={"clip": "video"})
    (images / "empty.csv").write_text("vision,tactile\n")
    with pytest.raises(PalpateError, match="at least one"):
        import_pairs(images / "empty.csv", tmp_path / "out")


def test_root_and_odd_but_inner_paths(images, tmp_path):
    table = tmp_path / "elsewhere.csv"
    table.write_text(f"vision,tactile\n./v/0.jpg,t/../t/0.jpg\n{images}/v/1.jpg,t/1.jpg\n")
    found = import_pairs(table, tmp_path / "out", root=images)
    assert found.manifest.column("vision") == ["v/0.jpg", "v/1.jpg"]
    assert found.manifest.column("tactile") == ["t/0.jpg", "t/1.jpg"]
    assert found.manifest.ids == ["t/0", "t/1"]


@pytest.mark.parametrize(
    "names", [("vision", "tactile"), ("rgb", "touch"), ("images", "gelsight"), ("image", "digit")]
)
def test_folders_flat_and_nested(tmp_path, names):
    vision, tactile = (tmp_path / "d" / name for name in names)
    write_image(vision / "plain.jpg", 1)
    write_image(tactile / "plain.png", 1)
    write_image(vision / "rec" / "f_0012.jpg", 2)
    write_image(tactile / "rec" / "f_0012.jpg", 2)
    (vision / ".DS_Store").write_bytes(b"x")
    found = import_dataset(tmp_path / "d", tmp_path / "out")
    rows = (
        found.manifest.require_valid()
        .table.select("id", "video", "frame", "vision", "tactile")
        .rows()
    )
    assert rows == [
        ("plain", None, None, f"{names[0]}/plain.jpg", f"{names[1]}/plain.png"),
        ("rec/f_0012", "rec", 12, f"{names[0]}/rec/f_0012.jpg", f"{names[1]}/rec/f_0012.jpg"),
    ]
    assert tree(tmp_path / "out") == {"manifest.parquet"}


def test_unpaired_doubled_and_cut_files_of_folders(tmp_path):
    root = tmp_path / "d"
    for k in range(4):
        write_image(root / "vision" / f"{k}.jpg", k)
        write_image(root / "tactile" / f"{k}.jpg", k)
    write_image(root / "vision" / "0.png", 0)
    write_image(root / "vision" / "7.jpg", 0)
    write_image(root / "tactile" / "w" / "8.jpg", 0)
    (root / "tactile" / "2.jpg").write_bytes(b"")
    with pytest.raises(ProblemsError) as caught:
        import_pairs(root, tmp_path / "out")
    wanted = {
        ("vision/0.png", "duplicate-id"),
        ("vision/7.jpg", "unpaired"),
        ("tactile/w/8.jpg", "unpaired"),
        ("tactile/2.jpg", "bad-image"),
    }
    assert {(p.where, p.kind) for p in caught.value.problems} == wanted
    found = import_pairs(root, tmp_path / "out", skip_bad=True)
    assert {(p.where, p.kind) for p in found.skipped} == wanted
    assert found.manifest.ids == ["0", "1", "3"]


def test_formats_are_found_by_look_or_what_was_looked_for_is_listed(tmp_path):
    write_frames(tmp_path / "tag" / "dataset" / "a" / "video_frame", 6)
    write_frames(tmp_path / "tag" / "dataset" / "a" / "gelsight_frame", 6)
    (tmp_path / "tag" / "label.txt").write_text("a/0000000005.jpg,3")
    assert import_dataset(tmp_path / "tag", tmp_path / "out").facts["dataset"] == "Touch and Go"
    assert (
        len(
            import_dataset(
                tmp_path / "tag", tmp_path / "out", max_per_contact=1, columns=None
            ).manifest
        )
        == 1
    )
    (tmp_path / "what").mkdir()
    (tmp_path / "what" / "readme.txt").write_text("x")
    with pytest.raises(PalpateError) as caught:
        import_dataset(tmp_path / "what", tmp_path / "out2")
    assert all(f.looks_for in str(caught.value) for f in FORMATS.values())
    assert "readme.txt" in caught.value.got
    with pytest.raises(PalpateError, match="nothing at"):
        import_dataset(tmp_path / "none", tmp_path / "out2")
    with pytest.raises(PalpateError, match=r"auto or one of touch-and-go, .*pairs"):
        import_dataset(tmp_path / "tag", tmp_path / "out2", format="zip")
    with pytest.raises(PalpateError, match="columns"):
        import_dataset(tmp_path / "tag", tmp_path / "out2", columns={"a": "b"})
    assert not (tmp_path / "out2").exists()


def problems_of(table, **options):
    return [
        (p.where.rpartition(":")[2], p.kind)
        for p in validate_dataset(table, format="pairs", **options).invalid
    ]


def test_json_arrays_count_their_items(images, tmp_path):
    table = images / "p.json"
    table.write_bytes(
        b'\xef\xbb\xbf[\r\n {"vision": "v/0.jpg",\n  "tactile": "t/0.jpg"}, 7,\n\n{"vision": "v/1.jpg", "tactile": "t/1.jpg"}]'
    )
    assert problems_of(table) == [("2", "bad-row")]
    found = import_pairs(table, tmp_path / "out", skip_bad=True)
    assert found.manifest.column("vision") == ["v/0.jpg", "v/1.jpg"]
    table.write_text('[{"vision": "v/0.jpg"} {"vision": "v/1.jpg"}]')
    assert problems_of(table) == [("1", "bad-row")]
    table.write_text('{"vision": ["v/0.jpg"]}')
    with pytest.raises(PalpateError, match="a JSON list of objects"):
        import_pairs(table, tmp_path / "out")


@pytest.mark.parametrize("sign", [",", ";", "\t"])
@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_odd_but_right_files(images, tmp_path, sign, code, end):
    name = "größe, ½\u2028 x.jpg"  # a line separator that is not the end of a line
    write_image(images / "v" / name, 1)
    lines = [
        f"vision{sign}tactile{sign}text",
        "",
        f'"v/{name}"{sign}t/0.jpg{sign}"a ""b"""',
        f'v/1.jpg{sign}t/1.jpg{sign}5" pipe',
        f"{sign}{sign} ",
    ]
    (images / "odd.csv").write_bytes(end.join(lines).encode(code))
    manifest = import_pairs(images / "odd.csv", tmp_path / "out").manifest
    assert manifest.column("vision") == [f"v/{name}", "v/1.jpg"]
    assert manifest.column("text") == ['a "b"', '5" pipe']


def test_rows_that_cannot_be_right_are_told_by_line(images):
    table = images / "bad.csv"
    table.write_bytes(
        b'vision,tactile,frame\nv/0.jpg,t/0.jpg,-1\nv/\xff.jpg,t/0.jpg,1\nv/\x00.jpg,t/0.jpg,1\nv/1.jpg,t/1.jpg,2.5\nv/1.jpg,t/1.jpg,2.0\n"v/2.jpg,t/2.jpg,1\nv/3.jpg,t/3.jpg,1\n'
    )
    assert problems_of(table) == [
        ("2", "bad-frame"),
        ("3", "bad-encoding"),
        ("4", "bad-encoding"),
        ("5", "bad-frame"),
        ("7", "open-quote"),
    ]
    table = images / "bad.jsonl"
    table.write_text(
        '{"vision": "v/0.jpg", "text": "\\ud800"}\n{"vision": ["v/0.jpg"]}\n{"vision": "v/1.jpg", "text": "\\u0000"}\n'
        + "[" * 100_000
    )
    assert problems_of(table) == [
        ("1", "bad-encoding"),
        ("2", "bad-row"),
        ("3", "bad-encoding"),
        ("4", "bad-row"),
    ]


def test_paths_that_no_file_can_have(images):
    table = images / "t.csv"
    table.write_text(
        "vision\n"
        + "ä" * 200
        + ".jpg\n"
        + "v/" * 200
        + "0.jpg\nv\n.\nv/0.jpg/x\n~/v/0.jpg\n../x.jpg\nv/0.jpg\n"
    )
    looked = validate_dataset(table)
    assert problems_of(table) == [("2", "bad-path"), ("8", "outside-root")]
    assert [int(p.where.rpartition(":")[2]) for p in looked.missing] == [3, 4, 5, 6, 7]


def test_one_modality_is_enough_and_paths_may_follow_from_another(images, tmp_path):
    table = images / "lone.csv"
    table.write_text("vision\nv/0.jpg\nv/1.jpg\n")
    found = import_pairs(table, tmp_path / "a")
    assert (found.manifest.ids, found.manifest.column("tactile")) == (["v/0", "v/1"], [None, None])
    found = import_pairs(
        table,
        tmp_path / "b",
        columns={
            "tactile": "replace(vision, 'v/', 't/')",
            "frame": "substr(vision, 3, 1)",
            "video": "'x'",
        },
    )
    assert found.manifest.column("tactile") == ["t/0.jpg", "t/1.jpg"]
    assert found.manifest.ids == ["x/0", "x/1"]
    assert found.suspicious == []


def test_a_map_that_fails_is_a_problem_of_its_row(images, tmp_path):
    table = images / "t.csv"
    table.write_text("vision,tactile\nv/0.jpg,t/0.jpg\nv/1.jpg,t/1.jpg\n")
    with pytest.raises(ProblemsError) as caught:
        import_pairs(
            table,
            tmp_path / "out",
            columns={"frame": "replace(split_part(vision, '1', 2), '.jpg', '1')"},
        )
    (problem,) = caught.value.problems
    assert (problem.where, problem.kind) == (f"{table}:2", "bad-map")
    assert "the expression for frame is empty here" in problem.text
    with pytest.raises(PalpateError, match="no clap among vision, tactile"):
        import_pairs(table, tmp_path / "out", columns={"frame": "left(clap, 2)"})


def test_groups_of_some_rows_only_are_told_with_their_number(images, tmp_path):
    table = images / "t.csv"
    table.write_text(
        "vision,tactile,video,object\nv/0.jpg,t/0.jpg,a,\nv/1.jpg,t/1.jpg,,\nv/2.jpg,t/2.jpg,,\n"
    )
    found = import_pairs(table, tmp_path / "out")
    assert [p.kind for p in found.suspicious] == ["null-group"]
    assert found.suspicious[0].text.startswith("2 of 3 rows have no video")
    assert f"{table}:3" in found.suspicious[0].text
    assert validate_dataset(table).ok


@pytest.mark.parametrize(
    "text",
    [
        'Wood: 3\n"Synthetic  Fabric": 8 (soft)\n',
        "id,name\n3,Wood\n8,Synthetic Fabric\n",
        "Wood;3\r\nSynthetic Fabric;8",
    ],
)
def test_classes_name_numbers_and_unknown_ones_are_problems(images, tmp_path, text):
    (images / "c.txt").write_text(text)
    table = images / "t.csv"
    table.write_text(
        "vision,tactile,material\n"
        + "".join(
            f"v/{k}.jpg,t/{k}.jpg,{m}\n" for k, m in enumerate(("3", "8.0", "-1", "Wood", "", "9"))
        )
    )
    assert problems_of(table, classes=images / "c.txt") == [("7", "unknown-label")]
    found = import_pairs(table, tmp_path / "out", classes=images / "c.txt", skip_bad=True)
    assert found.manifest.column("material") == ["Wood", "Synthetic Fabric", "Wood", None]
    assert found.inconclusive == 1
    for bad, word in (
        ("3,Wood\n3,Rock\n", "duplicate-id"),
        ("3,Wood\nx,y\n", "bad-line"),
        ("", "none"),
        ("a,b\n", "none"),
    ):
        (images / "c.txt").write_text(bad)
        with pytest.raises(PalpateError, match=word):
            import_pairs(table, tmp_path / "bad", classes=images / "c.txt")


def test_parquet_cells_of_any_type_and_brackets_in_names(images, tmp_path):
    rows = {
        "vision": ["v/0.jpg", "v/1.jpg"],
        "frame": [3.0, None],
        "material": pl.Series(["a", "b"], dtype=pl.Categorical),
        "text": [1, 2],
        "emb": [[1.0], [2.0]],
    }
    pl.DataFrame(rows).write_parquet(images / "p[1]*.parquet")
    manifest = import_dataset(images / "p[1]*.parquet", tmp_path / "out").manifest
    assert manifest.table.select("frame", "material", "text").rows() == [
        (3, "a", "1"),
        (None, "b", "2"),
    ]
    for bad, word in (
        ({"vision": [b"x"]}, "vision of type Binary.*format hf"),
        ({"vision": ["v/0.jpg"], "text": [["x"]]}, "text of type List"),
    ):
        pl.DataFrame(bad).write_parquet(images / "bad.parquet")
        with pytest.raises(PalpateError, match=word):
            import_pairs(images / "bad.parquet", tmp_path / "bad")


def test_a_column_of_parts_becomes_the_split(images, tmp_path):
    table = images / "t.csv"
    table.write_text(
        "vision,tactile,fold\n./v/0.jpg,./t/0.jpg,train\nv/1.jpg,t/1.jpg,Validation\nv/2.jpg,t/2.jpg,\nv/3.jpg,t/3.jpg,later\n"
    )
    found = import_pairs(table, tmp_path / "out", columns={"split": "fold"}, skip_bad=True)
    assert dict(found.splits["Orig"].parts) == {"t/0": "train", "t/1": "val"}
    assert [p.kind for p in found.skipped] == ["unknown-part"]
    assert found.manifest.ids == ["t/0", "t/1", "t/2"]


def test_tables_without_a_header(images, tmp_path):
    (images / "list.txt").write_text("0.jpg,3\n1.jpg,4")
    maps = {"vision": "'v/' + path", "tactile": "'t/' + path", "material": "label"}
    found = import_pairs(images / "list.txt", tmp_path / "out", names="path, label", columns=maps)
    assert found.manifest.column("tactile") == ["t/0.jpg", "t/1.jpg"]
    assert found.manifest.column("material") == ["3", "4"]
    with pytest.raises(PalpateError, match="A table must be one of"):
        import_pairs(images / "list.txt", tmp_path / "out2")


def test_a_folder_of_one_kind_of_images(tmp_path):
    for name in ("b/x 2.png", "b/deep/7.jpg", "a.jpg", ".hidden/1.jpg"):
        write_image(tmp_path / "d" / name, 1)
    found = import_dataset(tmp_path / "d", tmp_path / "out", side="tactile")
    rows = (
        found.manifest.require_valid()
        .table.select("id", "video", "frame", "vision", "tactile")
        .rows()
    )
    assert rows == [
        ("a", None, None, None, "a.jpg"),
        ("b/deep/7", "b/deep", 7, None, "b/deep/7.jpg"),
        ("b/x 2", "b", 2, None, "b/x 2.png"),
    ]
    mapped = import_dataset(
        tmp_path / "d",
        tmp_path / "out2",
        side="vision",
        columns={"video": "split_part(path, '/', 1)", "sensor": "'DIGIT'"},
    )
    assert mapped.manifest.column("video") == ["a.jpg", "b", "b"]
    assert mapped.manifest.column("sensor") == ["DIGIT"] * 3
    with pytest.raises(PalpateError, match=r"say what they show. E.g. side="):
        import_dataset(tmp_path / "d", tmp_path / "out3")


def test_links_in_circles_end(tmp_path):
    write_image(tmp_path / "d" / "a" / "1.jpg", 1)
    (tmp_path / "d" / "a" / "again").symlink_to(tmp_path / "d")
    assert len(import_dataset(tmp_path / "d", tmp_path / "out", side="vision").manifest) == 1
