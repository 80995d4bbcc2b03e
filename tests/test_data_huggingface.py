"""Hugging Face data sets: read by maps; nothing of theirs is run."""

import json
import os
import sys

import pytest

from forge.errors import fails
from forge.formats import HF_MAPS as MAPS
from forge.formats import hf_kinds as kinds
from forge.formats import hf_rows, save_hf
from palpate.core import MissingExtraError
from palpate.data.importing import import_dataset, validate
from palpate.data.manifest import Manifest

datasets = pytest.importorskip("datasets", reason="the extra hf is not installed")


#: As ``MAPS``, with the frame from the path of the row.
BY_PATH = MAPS | {"frame": "split_part(split_part(path, '/', -1), '.', 1)"}


@pytest.fixture
def source(tmp_path):
    return save_hf(tmp_path / "mine", hf_rows(), **kinds())


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


def test_equal_images_are_written_once(tmp_path):
    rows = hf_rows()
    for row in rows:
        row["gel"] = rows[0]["gel"]
    source = save_hf(tmp_path / "mine", rows, **kinds())
    result = import_dataset(source, tmp_path / "out", columns=BY_PATH)
    assert set(result.manifest.column("tactile")) == {"train/tactile/00000000.jpg"}


def test_bad_rows_are_reported_with_their_place(tmp_path):
    rows = hf_rows()
    rows[1]["gel"] = None
    rows[2]["gel"] = {"bytes": b"", "path": "x.jpg"}
    rows[3]["rgb"] = {"bytes": rows[3]["rgb"]["bytes"][:-200], "path": "x.png"}
    rows[4]["path"] = "a/b"
    source = save_hf(tmp_path / "mine", rows, **kinds())
    error = fails("", import_dataset, source, tmp_path / "out", columns=BY_PATH)
    reported = sorted((p.where, p.kind) for p in error.problems)
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
    def rejected(words, source, **options):
        fails(words, import_dataset, source, tmp_path / "out", format="hf", **options)

    rejected("no vision and no tactile among part, path, kind, rgb, gel", source)
    part = next(source.glob("train/*.arrow"))
    part.write_bytes(b"x")
    rejected("mine must be whole and readable", source, columns=MAPS)
    part.unlink()
    os.mkfifo(part)
    rejected("a pipe or a device", source, columns=MAPS)
    (tmp_path / "csvs").mkdir()
    (tmp_path / "csvs" / "train.csv").write_text("a\n1\n")
    rejected("must be made of parquet or arrow", tmp_path / "csvs")
    (tmp_path / "script").mkdir()
    (tmp_path / "script" / "script.py").write_text("raise SystemExit('ran')")
    rejected("script", tmp_path / "script")
    rejected("a name on the hub like user/name", tmp_path / "none" / "such" / "place")

    def offline(*_, **__):
        raise ConnectionError("offline\nmode")

    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("palpate.data.formats.huggingface_source._streamed", offline)
    rejected(r"user/name must be whole and readable. Got offline\. Check the name", "user/name")
    monkeypatch.delenv("HF_HUB_OFFLINE")  # a hub out of reach is reported at once
    monkeypatch.setattr("huggingface_hub.HfApi.dataset_info", offline)
    rejected("hub must be within reach.*hf download --repo-type dataset user/name", "user/name")
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


def test_a_missing_extra_says_what_to_install(source, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(MissingExtraError, match=r"pip install -e '\.\[hf\]'"):
        import_dataset(source, tmp_path / "out", columns=MAPS)
