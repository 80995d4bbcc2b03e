"""Hugging Face data sets: exports come back whole, others by maps; nothing of theirs is run."""

import json
import subprocess
import sys

import pytest

from format_trees import HF_MAPS as MAPS
from format_trees import hf_kinds as kinds
from format_trees import hf_rows, save_hf
from palpate.core import MissingExtraError, PalpateError, ProblemsError, Split
from palpate.data.exporting import export_dataset
from palpate.data.importing import import_dataset, validate
from palpate.data.manifest import IMAGE_COLUMNS, Manifest

datasets = pytest.importorskip("datasets", reason="the extra hf is not installed")


#: As ``MAPS``, with the frame from the path of the row.
BY_PATH = MAPS | {"frame": "split_part(split_part(path, '/', -1), '.', 1)"}


@pytest.fixture
def source(tmp_path):
    return save_hf(tmp_path / "mine", hf_rows(), **kinds())


def same_bytes(one: Manifest, other: Manifest) -> bool:
    return all(
        (a is None and b is None) or one.path(a).read_bytes() == other.path(b).read_bytes()
        for column in IMAGE_COLUMNS
        for a, b in zip(one.column(column), other.column(column), strict=True)
    )


@pytest.mark.parametrize("form", ["saved", "parquet"])
def test_a_foreign_set_keeps_its_bytes_parts_and_labels(source, tmp_path, form):
    rows = hf_rows()
    if form == "parquet":
        loaded, source = datasets.load_from_disk(str(source)), tmp_path / "shards"
        (source / "data").mkdir(parents=True)
        for part, data in loaded.items():
            data.to_parquet(str(source / "data" / f"{part}-00000-of-00001.parquet"))
    result = import_dataset(source, tmp_path / "out", columns=MAPS)
    manifest = Manifest.load(tmp_path / "out").require_valid()
    assert manifest.ids == [f"data1/0-17.{k // 4}/{k}" for k in range(8)]
    assert manifest.column("frame") == list(range(8))
    assert manifest.column("material") == ["Wood", "Rock"] * 4
    assert [p.read_bytes() for p in manifest.paths("vision")] == [r["rgb"]["bytes"] for r in rows]
    assert [p.read_bytes() for p in manifest.paths("tactile")] == [r["gel"]["bytes"] for r in rows]
    assert {p.suffix for p in manifest.paths("vision")} == {".png"}
    assert result.splits["Orig"].counts() == {"train": 5, "val": 3}
    assert result.facts["format"] == "hf"
    assert (result.facts["dataset"], result.facts["text_source"]) == (source.name, "none")


@pytest.mark.parametrize("parted", [False, True])
def test_what_was_exported_comes_back_whole(small_manifest, tmp_path, parted):
    # in another order, which the parts tear apart
    table = small_manifest.table.sample(fraction=1, shuffle=True, seed=3)
    facts = {"dataset": "ours", "license": "CC0", "citation": "nobody, 2024"}
    facts |= {"url": "https://example.org", "format": "touch-and-go", "text_source": "none"}
    manifest = Manifest(table, small_manifest.root, facts)
    parts = {i: ("train", "val", "test")[k % 3] for k, i in enumerate(manifest.ids) if k % 7}
    split = Split(parts, {"method": "mine"}) if parted else None
    files = export_dataset(manifest, tmp_path / "hf", to="hf", split=split).files
    assert all(f.is_file() for f in files)
    loaded = datasets.load_from_disk(str(tmp_path / "hf"))
    assert sorted(loaded) == (["test", "train", "unused", "validation"] if parted else ["all"])
    first = next(iter(loaded.values()))
    assert isinstance(first.features["tactile"], datasets.Image)
    assert first[0]["tactile"].size == (32, 32)
    assert (first.info.license, first.info.citation) == ("CC0", "nobody, 2024")
    assert json.loads(first.info.description)["digest"] == manifest.digest
    again = import_dataset(tmp_path / "hf", tmp_path / "out")
    assert again.manifest.digest == manifest.digest
    assert dict(again.facts) == facts
    assert same_bytes(manifest, again.manifest)
    assert {n: (s.digest, s.rule) for n, s in again.splits.items()} == (
        {"Orig": (split.digest, {"method": "mine"})} if split else {}
    )


@pytest.mark.parametrize(
    ("to", "name"),
    [("csv", "manifest.csv"), ("jsonl", "manifest.jsonl"), ("parquet", "samples.parquet")],
)
def test_tables_come_back_with_their_split(small_manifest, tmp_path, to, name):
    text = small_manifest.table["id"] + ', "so\n called" 5"'
    manifest = Manifest(small_manifest.table.with_columns(text=text), small_manifest.root, {})
    split = Split({i: ("train", "test")[k % 2] for k, i in enumerate(manifest.ids) if k % 5})
    files = export_dataset(manifest, tmp_path / "o", to=to, split=split).files
    names = {f.relative_to(tmp_path / "o").as_posix() for f in files}
    assert names == {name, "lists/train.csv", "lists/test.csv"}
    again = import_dataset(tmp_path / "o" / name, tmp_path / "out", root=manifest.root)
    assert again.manifest.digest == manifest.digest
    assert again.splits["Orig"].digest == split.digest


def test_an_export_is_whole_or_absent(small_manifest, tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "x").touch()
    with pytest.raises(PalpateError, match="absent or an empty folder"):
        export_dataset(small_manifest, tmp_path / "o", to="csv")
    with pytest.raises(PalpateError, match="must be in the manifest"):
        export_dataset(small_manifest, tmp_path / "p", to="csv", split=Split({"none": "train"}))
    small_manifest.paths("tactile")[3].unlink()
    with pytest.raises(ProblemsError, match="missing-file"):
        export_dataset(small_manifest, tmp_path / "p", to="hf")
    assert not (tmp_path / "p").exists()


def test_equal_images_are_written_once_and_paths_of_exports_stay_inside(small_manifest, tmp_path):
    rows = hf_rows()
    for row in rows:
        row["gel"] = rows[0]["gel"]
    source = save_hf(tmp_path / "mine", rows, **kinds())
    result = import_dataset(source, tmp_path / "out", columns=BY_PATH)
    assert set(result.manifest.column("tactile")) == {"train/tactile/00000000.jpg"}
    export_dataset(small_manifest, tmp_path / "hf", to="hf")
    loaded = datasets.load_from_disk(str(tmp_path / "hf"))["all"]
    outside = [f"../../{k}.png" for k in range(len(small_manifest))]
    evil = loaded.remove_columns("tactile_path").add_column("tactile_path", outside)
    evil.save_to_disk(str(tmp_path / "evil"))
    again = import_dataset(tmp_path / "evil", tmp_path / "out2")
    assert all(p.startswith("all/tactile/") for p in again.manifest.column("tactile"))
    assert not [*tmp_path.glob("*.png"), *(tmp_path / "out2").glob("*.png")]


def test_bad_rows_are_reported_with_their_place(tmp_path):
    rows = hf_rows()
    rows[1]["gel"] = None
    rows[2]["gel"] = {"bytes": b"", "path": "x.jpg"}
    rows[3]["rgb"] = {"bytes": rows[3]["rgb"]["bytes"][:-200], "path": "x.png"}
    rows[4]["path"] = "a/b"
    source = save_hf(tmp_path / "mine", rows, **kinds())
    with pytest.raises(ProblemsError) as caught:
        import_dataset(source, tmp_path / "out", columns=BY_PATH)
    reported = sorted((p.where, p.kind) for p in caught.value.problems)
    expected = ["missing-image", "bad-image", "bad-image", "bad-frame"]
    assert reported == [(f"mine/train:{k}", kind) for k, kind in enumerate(expected, 1)]
    assert not (tmp_path / "out").exists()
    report = validate(source, columns=BY_PATH)
    assert sorted((p.where, p.kind) for p in [*report.missing, *report.invalid]) == reported
    result = import_dataset(source, tmp_path / "out", columns=BY_PATH, skip_bad=True)
    assert len(result.manifest) == 4


def test_named_images_must_be_inside_the_source(tmp_path):
    secret = tmp_path / "secret.jpg"
    secret.write_bytes(hf_rows()[0]["gel"]["bytes"])
    names = (str(secret), "in.jpg", "https://example.org/x.jpg")
    source = save_hf(tmp_path / "texts", [{"part": "all", "image": name} for name in names])
    (source / "in.jpg").write_bytes(secret.read_bytes())
    maps = {"tactile": "image"}
    result = import_dataset(source, tmp_path / "out", columns=maps, skip_bad=True)
    expected = [("texts/all:0", "outside-root"), ("texts/all:2", "missing-file")]
    assert [(p.where, p.kind) for p in result.skipped] == expected
    assert result.manifest.ids == ["all/00000001"]


def test_what_cannot_be_opened_is_reported(source, tmp_path, monkeypatch):
    def fails(word, source, **options):
        with pytest.raises(PalpateError, match=word):
            import_dataset(source, tmp_path / "out", format="hf", **options)

    fails("no vision and no tactile among part, path, kind, rgb, gel", source)
    next(source.glob("train/*.arrow")).write_bytes(b"x")
    fails("mine must be whole and readable", source, columns=MAPS)
    (tmp_path / "csvs").mkdir()
    (tmp_path / "csvs" / "train.csv").write_text("a\n1\n")
    fails("must be made of parquet or arrow", tmp_path / "csvs")
    (tmp_path / "script").mkdir()
    (tmp_path / "script" / "script.py").write_text("raise SystemExit('ran')")
    fails("script", tmp_path / "script")
    fails("a name on the hub like user/name", tmp_path / "none" / "such" / "place")

    def offline(*_, **__):
        raise ConnectionError("offline\nmode")

    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("palpate.data.formats.huggingface_source._streamed", offline)
    fails(r"user/name must be whole and readable. Got offline\. Check the name", "user/name")
    monkeypatch.delenv("HF_HUB_OFFLINE")  # a hub out of reach is reported at once
    monkeypatch.setattr("huggingface_hub.HfApi.dataset_info", offline)
    fails("hub must be within reach.*hf download --repo-type dataset user/name", "user/name")
    assert not (tmp_path / "out").exists()


def test_an_id_of_two_parts_is_in_neither_and_parts_follow_the_kept_row(tmp_path):
    rows = hf_rows()
    rows[5]["path"] = rows[1]["path"]  # of validation: the id of a row of train
    rows[2]["path"] = rows[1]["path"]  # twice in train
    source = save_hf(tmp_path / "mine", rows, **kinds())
    result = import_dataset(source, tmp_path / "out", columns=BY_PATH, skip_bad=True)
    expected = [("mine/train:2", "duplicate-id"), ("mine/validation:0", "two-parts")]
    assert [(p.where, p.kind) for p in result.skipped] == expected
    assert result.splits["Orig"].counts() == {"train": 3, "val": 2}
    assert "data1/0-17.0/1" in result.manifest.ids


def test_numbers_that_are_no_class_are_reported_and_minus_one_is_inconclusive(tmp_path):
    rows = hf_rows()
    rows[1]["kind"], rows[2]["kind"], rows[6]["kind"] = 7, -1, -2
    source = save_hf(tmp_path / "mine", rows, **kinds() | {"kind": datasets.Value("int64")})
    # a number that the library refuses to write, though not to read
    for path in source.glob("*/dataset_info.json"):
        info = json.loads(path.read_text())
        info["features"]["kind"] = {"names": ["Wood", "Rock"], "_type": "ClassLabel"}
        path.write_text(json.dumps(info))
    report = validate(source, columns=MAPS)
    reported = [("mine/train:1", "unknown-label"), ("mine/validation:1", "unknown-label")]
    assert sorted((p.where, p.kind) for p in report.invalid) == reported
    assert report.samples == 5
    result = import_dataset(source, tmp_path / "out", columns=MAPS, skip_bad=True)
    assert sorted((p.where, p.kind) for p in result.skipped) == reported
    assert result.inconclusive == 1
    assert result.manifest.column("frame") == [0, 3, 4, 5, 7]
    assert None not in result.manifest.column("material")


def test_a_missing_extra_says_what_to_install(small_manifest, source, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(MissingExtraError, match=r"pip install -e '\.\[hf\]'"):
        import_dataset(source, tmp_path / "out", columns=MAPS)
    with pytest.raises(MissingExtraError, match="datasets"):
        export_dataset(small_manifest, tmp_path / "hf", to="hf")
    assert not (tmp_path / "hf").exists()


def test_formats_load_without_datasets():
    code = "import sys, palpate.data.importing, palpate.data.exporting; "
    code += "assert not {'datasets', 'torch', 'pyarrow'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
