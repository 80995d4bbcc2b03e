"""``palpate.load``: every kind of source, nothing written, errors that name the argument."""

import polars as pl
import pytest

from forge.errors import fails
from forge.formats import TREES
from forge.pictures import tree, write_image
from palpate import data

ROWS = [
    {"video": "x", "frame": k, "vision": f"v/{k}.jpg", "gel": f"t/{k}.jpg", "material": "Mat 5"}
    for k in range(3)
]


@pytest.fixture
def images(tmp_path):
    root = tmp_path / "data"
    for k in range(3):
        write_image(root / "v" / f"{k}.jpg", k)
        write_image(root / "t" / f"{k}.jpg", k)
    return root


def sources(root):
    """The same three samples in every form that has a name for its columns."""
    frame = pl.DataFrame(ROWS)
    frame.write_csv(root / "t.csv")
    frame.write_ndjson(root / "t.jsonl")
    frame.write_parquet(root / "t.parquet")
    yield from (root / "t.csv", str(root / "t.jsonl"), root / "t.parquet", frame, ROWS)
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    yield pandas.DataFrame(ROWS)


def test_tables_frames_and_dictionaries_give_the_same_manifest(images):
    before = {*tree(images), "t.csv", "t.jsonl", "t.parquet"}
    digests = set()
    for source in sources(images):
        manifest = data.load(source, root=images, columns={"tactile": "gel"}).require_valid()
        assert manifest.ids == ["x/0", "x/1", "x/2"]
        assert manifest.column("material") == ["Mat 5"] * 3
        digests.add(manifest.digest)
    assert len(digests) == 1
    assert tree(images) == before


def test_an_import_and_a_manifest_object_are_taken_as_they_are(images, tmp_path):
    (images / "t.csv").write_text("vision\nv/0.jpg\nv/1.jpg\n")
    imported = data.import_dataset(images / "t.csv", tmp_path / "m").manifest
    for source in (imported, tmp_path / "m", tmp_path / "m" / "manifest.parquet"):
        assert data.load(source).digest == imported.digest
    assert data.load(images / "t.csv").digest == imported.digest


def test_tables_without_images_are_loaded_for_audits(tmp_path):
    frame = pl.DataFrame({"clip": ["a", "a", "b"], "k": [0, 1, 0]})
    manifest = data.load(frame, columns={"video": "clip", "frame": "k"})
    assert manifest.ids == ["a/0", "a/1", "b/0"]
    frame.write_csv(tmp_path / "t.csv")
    again = data.load(tmp_path / "t.csv", columns={"video": "clip", "frame": "k"})
    assert again.digest == manifest.digest
    (tmp_path / "list.txt").write_text("v/1.jpg,3\nv/2.jpg,3")
    assert data.load(tmp_path / "list.txt").column("contact") == ["v#0001"] * 2


@pytest.mark.parametrize("name", [name for name in TREES if name not in ("hf", "videos")])
def test_data_set_folders_load_as_they_import(name, tmp_path):
    made = TREES[name](tmp_path / "made")
    before = tree(tmp_path / "made")
    loaded = data.load(made.source, **made.options)
    assert tree(tmp_path / "made") == before
    imported = data.import_dataset(made.source, tmp_path / "m", **made.options).manifest
    assert loaded.digest == imported.digest
    assert loaded.require_valid().root == imported.root


def test_raw_videos_are_loaded_without_images_on_request(tmp_path):
    pytest.importorskip("av", reason="PyAV is not installed")
    from test_data_touch_and_go import make_recordings

    root = make_recordings(tmp_path / "tag", raw=("a",))
    error = fails(r"palpate import .* -o DIR", data.load, root)
    assert error.argument == "source"
    manifest = data.load(root, images=False)
    assert manifest.column("tactile") == [None] * len(manifest)


def test_a_folder_of_one_modality(images, tmp_path):
    assert data.load(images / "v").column("vision") == ["0.jpg", "1.jpg", "2.jpg"]
    (images / "t").rename(images / "gelsight")
    assert data.load(images / "gelsight").column("tactile") == ["0.jpg", "1.jpg", "2.jpg"]
    assert data.load(images / "v", side="tactile").column("vision") == [None] * 3


@pytest.mark.parametrize(
    ("source", "options", "argument"),
    [
        (3, {}, "source"),
        ("none", {}, "source"),
        (".", {}, "source"),
        (pl.DataFrame({"a": [1]}), {}, "source"),
        (ROWS, {"columns": {"tactile": "gel["}}, "columns"),
        (ROWS, {"size": 3}, "size"),
        (ROWS, {"classes": "none.txt"}, "classes"),
    ],
)
def test_mistakes_name_the_argument(source, options, argument, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    error = fails("", data.load, source, **options)
    assert error.argument == argument


def test_bad_rows_are_raised_together_or_skipped(images):
    bad = ({"video": "x", "frame": "one"}, {"video": "x", "frame": 0}, {"vision": "../x.jpg"})
    rows = [*ROWS, *bad]
    error = fails("", data.load, rows, root=images)
    kinds = enumerate(("bad-frame", "empty-cell", "outside-root"), 4)
    assert [(p.where, p.kind) for p in error.problems] == [(f"row:{k}", v) for k, v in kinds]
    assert len(data.load(rows, root=images, skip_bad=True)) == 3


def test_results_print_themselves(images, tmp_path):
    (images / "t.csv").write_text("vision\nv/0.jpg\nv/9.jpg\n")
    validation = data.validate(images / "t.csv")
    assert (validation.ok, len(validation.to_json()["missing"])) == (False, 1)
    assert "Missing: 1\n" in str(validation)
    imported = data.import_dataset(images / "t.csv", tmp_path / "m", skip_bad=True)
    assert "Skipped: 1\n" in str(imported)
    assert imported.to_json()["samples"] == 1
