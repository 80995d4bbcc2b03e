"""Captions from columns, and texts that an import joins."""

import shutil
from dataclasses import replace

import polars as pl
import pytest

from forge.errors import fails
from palpate.captions import caption
from palpate.cli import main
from palpate.core import PalpateError, ProblemsError, Split
from palpate.data import import_dataset, texts
from palpate.data.manifest import Manifest
from palpate.encoders.embed import texts_of


@pytest.fixture
def data(small_manifest, tmp_path):
    """An import of 48 samples, with a split."""
    small_manifest.save(tmp_path / "tag" / "manifest.parquet")
    parts = {"train": small_manifest.ids[:40], "test": small_manifest.ids[40:]}
    split = Split.from_ids(manifest=small_manifest.digest, **parts)
    split.save(tmp_path / "tag" / "splits" / "Orig.json")
    return tmp_path / "tag"


def test_adjectives_of_the_material(data, tmp_path):
    result = caption(data, tmp_path / "c", template="")
    assert result.record["counts"]["texts"] == 12, "one a contact"
    assert [note.code for note in result.notes] == ["captions-of-columns"]
    assert not result.table["text"].str.to_lowercase().str.contains("wood|grass|brick").any()


def test_columns_in_braces(data, tmp_path):
    result = caption(data, tmp_path / "c", template="{material} in {video}", per="frame")
    assert result.table["text"].to_list()[:8] == ["Wood in v0"] * 8


@pytest.mark.parametrize(
    ("template", "got"),
    [("wood", "names none"), ("{color}", "{color}"), ("{object}", "object"), ("{material", "'}'")],
)
def test_templates_that_name_no_filled_column(data, tmp_path, template, got):
    with pytest.raises(PalpateError, match=got) as caught:
        caption(data, tmp_path / "c", template=template)
    assert caught.value.argument == "template"


def test_a_template_has_no_dry_run(data, tmp_path):
    fails("needs no model", caption, data, tmp_path / "c", template="", dry_run=True)
    assert not (tmp_path / "c").exists()


def test_captions_of_a_model_are_not_replaced(data, tmp_path):
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "replies.jsonl").write_text("{}\n")
    fails("no replies of a model", caption, data, tmp_path / "c", template="")
    assert [p.name for p in (tmp_path / "c").iterdir()] == ["replies.jsonl"]


def test_an_import_joins_captions_and_models_will_name_their_digest(data, tmp_path):
    made = caption(data, tmp_path / "c", template="{material} of {video}")
    args = ["import", data, "--text", tmp_path / "c", "-o", tmp_path / "tag-c", "-q"]
    assert main([*map(str, args)]) == 0
    manifest = Manifest.load(tmp_path / "tag-c")
    assert manifest.column("text") == made.table["text"].to_list()
    words, source = texts_of(manifest)
    assert made.record["digest"][:12] in source
    assert words[0] == "Wood of v0"
    assert Split.load(tmp_path / "tag-c" / "splits" / "Orig.json").manifest == manifest.digest
    assert manifest.paths("vision")[0].is_file()


def test_any_table_with_ids_and_texts_joins_and_what_it_lacks_is_listed(data, tmp_path):
    ids = Manifest.load(data).ids
    pl.DataFrame({"id": [*ids[:40], "stray"], "text": "rough"}).write_csv(tmp_path / "t.csv")
    imported = import_dataset(data, tmp_path / "o", text=tmp_path / "t.csv")
    assert imported.manifest.column("text") == ["rough"] * 40 + [None] * 8
    assert [problem.kind for problem in imported.suspicious] == ["no-text", "no-sample"]
    assert imported.facts["text_source"].startswith("t.csv, captions ")


@pytest.mark.parametrize(
    ("rows", "error", "got"),
    [
        ("id,text\nother/1,rough\n", PalpateError, "'other/1' instead of 'v0/0'"),
        ("id,caption\nv0/0,rough\n", PalpateError, "without text"),
        ("id,text\nv0/0,rough\nv0/0,hard\n", ProblemsError, "2 bad-id"),
    ],
)
@pytest.mark.parametrize("source", ["import", "table"])
def test_texts_of_another_kind_leave_nothing_behind(data, tmp_path, rows, error, got, source):
    (tmp_path / "t.csv").write_text(rows)
    if source == "table":
        table = Manifest.load(data).table.select("id", "vision", "tactile")
        table.write_csv(tmp_path / "root" / "pairs.csv")
        data = tmp_path / "root" / "pairs.csv"
    with pytest.raises(error, match=got):
        import_dataset(data, tmp_path / "o", text=tmp_path / "t.csv")
    assert not (tmp_path / "o").exists()


def with_other_photos(manifest, root):
    """The same samples in another folder, with another photo of the first contact."""
    shutil.copytree(manifest.root, root)
    other = replace(manifest, root=root)
    other.paths("vision")[0].write_bytes(manifest.paths("vision")[20].read_bytes())
    return other


def test_captions_of_other_photos_with_the_same_ids_are_an_error(data, tmp_path, capsys):
    made = tmp_path / "c"
    caption(data, made, template="{material} in {video}")
    with_other_photos(Manifest.load(data), tmp_path / "other").save(tmp_path / "o/manifest.parquet")
    joins = ["import", tmp_path / "o", "--text", made, "-o", tmp_path / "x"]
    for command in (joins, ["caption", "check", made, "--data", tmp_path / "o"]):
        assert main([*map(str, command), "-q"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all("made for another image of 'v0/0'" in line for line in lines)
    assert not (tmp_path / "x").exists()
    pl.read_parquet(made / "captions.parquet").select("id", "text").write_csv(tmp_path / "t.csv")
    assert import_dataset(tmp_path / "o", tmp_path / "x", text=tmp_path / "t.csv").manifest


@pytest.mark.parametrize("change", ["columns", "texts", "fewer", "elsewhere", "no files"])
def test_captions_of_the_same_photos_join_whatever_else_changed(data, tmp_path, change):
    manifest = Manifest.load(data)
    caption(data, tmp_path / "c", template="{material} in {video}")
    table, root = manifest.table, manifest.root
    if change == "columns":
        table = table.with_columns(object=pl.col("video"), material=None, session=pl.lit("s"))
    if change == "texts":
        table = table.with_columns(text=pl.lit("rough"))
    if change == "fewer":
        table = table.tail(7)
    if change == "elsewhere":
        root = shutil.copytree(root, tmp_path / "moved")
    if change == "no files":
        shutil.rmtree(root)
    joined = texts.joined(Manifest(table, root), texts.read_texts(tmp_path / "c"), tmp_path / "c")
    assert joined.column("text")[-1].startswith(manifest.column("material")[-1])
