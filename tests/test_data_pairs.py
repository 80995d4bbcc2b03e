"""Pairs: tables of four kinds and folders, with every bad row told at once; and formats found by look."""

import json
from functools import partial

import polars as pl
import pytest

from data_forge import tree, write_frames, write_image
from palpate.core import PalpateError, ProblemsError
from palpate.data.formats import FORMATS
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest

import_pairs = partial(import_dataset, format="pairs")


@pytest.fixture
def images(tmp_path):
    root = tmp_path / "data"
    for k in range(6):
        write_image(root / "v" / f"{k}.jpg", k)
        write_image(root / "t" / f"{k}.jpg", k)
    return root


ROWS = [{"clip": "x", "frame": k, "vision": f"v/{k}.jpg", "touch_path": f"t/{k}.jpg", "material": "wood" if k else None} for k in range(3)]


def write_table(path):
    frame = pl.DataFrame(ROWS)
    if path.suffix == ".parquet":
        frame.write_parquet(path)
    elif path.suffix == ".jsonl":
        path.write_text("".join(json.dumps(r) + "\n" for r in ROWS))
    else:
        path.write_bytes(b"\xef\xbb\xbf" + frame.write_csv(separator="\t" if path.suffix == ".tsv" else ",").replace("\n", "\r\n").encode())
    return path


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".jsonl", ".parquet"])
def test_tables_of_every_kind_give_the_same_manifest(images, tmp_path, suffix):
    table = write_table(images / f"pairs{suffix}")
    found = import_dataset(table, tmp_path / "out", columns={"video": "clip", "tactile": "touch_path"}, size=64)
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
        "a,v/0.jpg,t/0.jpg,0,\"soft,\nwarm\"\n"  # lines 2 and 3
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
    )  # fmt: skip
    return table, [
        (4, "duplicate-id"), (5, "outside-root"), (6, "missing-file"), (6, "missing-file"), (7, "bad-image"), (8, "bad-image"),
        (9, "bad-frame"), (10, "bad-row"), (11, "empty-cell"), (13, "outside-root"),
    ]  # fmt: skip


def test_every_bad_row_is_told_at_once_and_nothing_is_written(images, tmp_path):
    table, wanted = spoil(images)
    with pytest.raises(ProblemsError) as caught:
        import_pairs(table, tmp_path / "out")
    assert [(p.where, p.kind) for p in caught.value.problems] == [(f"{table}:{n}", kind) for n, kind in wanted]
    assert "used by 2 rows" in caught.value.problems[4].text
    assert not (tmp_path / "out").exists()
    found = import_pairs(table, tmp_path / "out", skip_bad=True)
    assert [(p.where, p.kind) for p in found.skipped] == [(f"{table}:{n}", kind) for n, kind in wanted]
    assert found.manifest.ids == ["a", "i"]
    assert found.manifest.column("text") == ["soft,\nwarm", None]
    assert found.facts["text_source"] == "column text"


def test_bad_lines_of_jsonl_and_foreign_parquet(images, tmp_path):
    table = images / "p.jsonl"
    table.write_text('{"vision": "v/0.jpg", "tactile": "t/0.jpg"}\n{oops\n\n[1]\n')
    with pytest.raises(ProblemsError) as caught:
        import_pairs(table, tmp_path / "out")
    assert [(p.where, p.kind) for p in caught.value.problems] == [(f"{table}:2", "bad-row"), (f"{table}:4", "bad-row")]
    (images / "p.parquet").write_bytes(b"words")
    with pytest.raises(ProblemsError, match="bad-table"):
        import_pairs(images / "p.parquet", tmp_path / "out")


def test_missing_columns_and_wrong_names_are_told(images, tmp_path):
    table = write_table(images / "pairs.csv")
    with pytest.raises(PalpateError, match="no tactile among clip"):
        import_pairs(table, tmp_path / "out")
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


@pytest.mark.parametrize("names", [("vision", "tactile"), ("rgb", "touch"), ("images", "gelsight"), ("image", "digit")])
def test_folders_flat_and_nested(tmp_path, names):
    vision, tactile = (tmp_path / "d" / name for name in names)
    write_image(vision / "plain.jpg", 1)
    write_image(tactile / "plain.png", 1)
    write_image(vision / "rec" / "f_0012.jpg", 2)
    write_image(tactile / "rec" / "f_0012.jpg", 2)
    (vision / ".DS_Store").write_bytes(b"x")
    found = import_dataset(tmp_path / "d", tmp_path / "out")
    rows = found.manifest.require_valid().table.select("id", "video", "frame", "vision", "tactile").rows()
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
    assert len(import_dataset(tmp_path / "tag", tmp_path / "out", max_per_touch=1, columns=None).manifest) == 1
    (tmp_path / "what").mkdir()
    (tmp_path / "what" / "readme.txt").write_text("x")
    with pytest.raises(PalpateError) as caught:
        import_dataset(tmp_path / "what", tmp_path / "out2")
    assert all(f.looks_for in str(caught.value) for f in FORMATS.values())
    assert "readme.txt" in caught.value.got
    with pytest.raises(PalpateError, match="nothing at"):
        import_dataset(tmp_path / "none", tmp_path / "out2")
    with pytest.raises(PalpateError, match="auto or one of touch-and-go, pairs"):
        import_dataset(tmp_path / "tag", tmp_path / "out2", format="zip")
    with pytest.raises(PalpateError, match="columns"):
        import_dataset(tmp_path / "tag", tmp_path / "out2", columns={"a": "b"})
    assert not (tmp_path / "out2").exists()
