"""The manifest: round trip, digest, validation with every problem at once, joining."""

import polars as pl
import pytest

from forge.errors import fails
from palpate.core import Split
from palpate.data.manifest import FOLLOWED, Manifest


def test_round_trip_keeps_rows_digest_facts_and_a_root_that_moves_along(small_manifest, tmp_path):
    small_manifest.save(tmp_path / "root" / "manifest.parquet")
    (tmp_path / "root").rename(tmp_path / "moved")
    again = Manifest.load(tmp_path / "moved")
    assert again.digest == small_manifest.digest
    assert again.table.equals(small_manifest.table)
    assert again.problems() == []  # the files are found under the new place


def test_digest_sees_every_cell_and_the_order(small_manifest):
    digests = {small_manifest.digest, small_manifest.take(small_manifest.ids[::-1]).digest}
    for column in ("text", "material", "vision"):
        cell = pl.when(pl.col("id") == "v0/0").then(pl.lit("x")).otherwise(pl.col(column))
        changed = small_manifest.table.with_columns(cell.alias(column))
        digests.add(Manifest(changed, small_manifest.root).digest)
    assert len(digests) == 5


def test_every_problem_is_listed_at_once(tmp_path):
    (tmp_path / "a.png").touch()
    rows = [
        {"id": "1", "vision": "a.png"},
        {"id": "1", "vision": "a.png"},
        {"id": None},
        {"id": "4", "tactile": "../b.png"},
        {"id": "5", "background": "gone.png"},
    ]
    error = fails("", Manifest.from_rows(rows, tmp_path).require_valid)
    assert {(p.where, p.kind) for p in error.problems} == {
        ("row 2", "duplicate-id"),
        ("row 3", "null-id"),
        ("row 4", "outside-root"),
        ("row 5", "missing-file"),
    }
    fails("1 empty", Manifest.from_rows([], tmp_path).require_valid)


def test_foreign_and_changed_files_are_rejected(small_manifest, tmp_path):
    path = tmp_path / "m.parquet"
    fails("must exist", Manifest.load, path)
    path.write_text("no table")
    fails("Parquet", Manifest.load, path)
    small_manifest.table.write_parquet(path)
    fails("another program", Manifest.load, path)
    metadata = {"palpate.format": "palpate-manifest/1", "palpate.root": "."}
    metadata["palpate.digest"] = small_manifest.digest
    small_manifest.table.head(3).write_parquet(path, metadata=metadata)
    fails("another program", Manifest.load, path)
    fails("'color'", Manifest.from_rows, [{"color": "red"}], tmp_path)


def test_a_manifest_whose_paths_climb_out_is_not_loaded(tmp_path):
    (tmp_path / "secret.png").touch()
    for path in ("../secret.png", "a/../../secret.png", str(tmp_path / "secret.png"), "C:/x.png"):
        manifest = Manifest.from_rows([{"id": "1", "vision": path}], tmp_path / "root")
        manifest.save(tmp_path / "root" / "manifest.parquet")
        fails("inside the root", Manifest.load, tmp_path / "root")


@pytest.mark.parametrize("value", ["a.png", "folder/a.png"])
def test_a_link_out_of_the_root_is_not_followed_but_where_an_import_met_it(tmp_path, value):
    (tmp_path / "secret" / "folder").mkdir(parents=True)
    (tmp_path / "secret" / value).touch()
    root = tmp_path / "root"
    root.mkdir()
    link = root / value.split("/")[0]
    link.symlink_to(tmp_path / "secret" / link.name)
    for facts in ({}, {"links": FOLLOWED}):
        manifest = Manifest.from_rows([{"id": "1", "tactile": value}], root, facts)
        manifest.save(root / "manifest.parquet")
        loaded = Manifest.load(root)
        if facts:
            assert loaded.paths("tactile") == [loaded.path(value)] == [root / value]
            continue
        for one in (loaded, loaded.take(["1"]), Manifest.join(loaded)):
            fails("must stay inside", one.path, value)
            fails("must stay inside", one.paths, "tactile")


def test_parts_follow_the_split_and_foreign_ids_are_named(small_manifest):
    split = Split.from_ids(train=["v1/0", "v0/0"], test=["v2/3"])
    assert small_manifest.part(split, "train").ids == ["v0/0", "v1/0"]
    fails("first 'zz'", small_manifest.part, Split.from_ids(train=["zz"]), "train")
    fails("1 without", Manifest.from_rows([{"id": "1"}], ".").paths, "vision")


def test_joined_manifests_find_their_files(small_manifest, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "a.png").touch()
    other = Manifest.from_rows([{"id": "o/1", "vision": "a.png"}], tmp_path / "other")
    both = Manifest.join(small_manifest, other)
    assert len(both) == len(small_manifest) + 1
    assert both.problems() == []
    assert both.table.tail(1)["tactile"][0] is None
    fails("must not share ids", Manifest.join, other, other)
