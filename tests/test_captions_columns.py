"""Captions from columns, and texts that an import joins."""

import polars as pl
import pytest

from palpate.captions import caption
from palpate.cli import main
from palpate.core import PalpateError, ProblemsError, Split
from palpate.data import import_dataset
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
    with pytest.raises(PalpateError, match="needs no model"):
        caption(data, tmp_path / "c", template="", dry_run=True)
    assert not (tmp_path / "c").exists()


def test_captions_of_a_model_are_not_replaced(data, tmp_path):
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "replies.jsonl").write_text("{}\n")
    with pytest.raises(PalpateError, match="no replies of a model"):
        caption(data, tmp_path / "c", template="")
    assert [p.name for p in (tmp_path / "c").iterdir()] == ["replies.jsonl"]


def test_an_import_joins_captions_and_models_will_name_their_digest(data, tmp_path):
    made = caption(data, tmp_path / "c", template="{material} of {video}")
    args = ["import", data, "--text", tmp_path / "c", "-o", tmp_path / "tag-c", "-q"]
    assert main([*map(str, args)]) == 0
    manifest = Manifest.load(tmp_path / "tag-c")
    assert manifest.column("text") == made.table["text"].to_list()
    texts, source = texts_of(manifest)
    assert made.record["digest"][:12] in source
    assert texts[0] == "Wood of v0"
    assert Split.load(tmp_path / "tag-c" / "splits" / "Orig.json").manifest == manifest.digest
    assert manifest.paths("vision")[0].is_file()


def test_any_table_with_ids_and_texts_joins_and_what_it_lacks_is_listed(data, tmp_path):
    ids = Manifest.load(data).ids
    pl.DataFrame({"id": ids[:40], "text": ["rough"] * 40}).write_csv(tmp_path / "t.csv")
    imported = import_dataset(data, tmp_path / "o", text=tmp_path / "t.csv")
    assert imported.manifest.column("text") == ["rough"] * 40 + [None] * 8
    assert [problem.kind for problem in imported.suspicious] == ["no-text"]
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
