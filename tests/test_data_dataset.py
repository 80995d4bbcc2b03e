"""The samples of a part as a data set that PyTorch's loaders and Hugging Face take."""

import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

from forge.errors import fails
from palpate.core import MissingExtraError, PalpateError


def shape(image):
    return (image.mode, image.size)


def test_it_holds_the_samples_of_its_part_and_the_columns_that_none_lacks(tag):
    manifest, split = tag
    train = manifest.dataset(split, "train")
    assert [train[k]["id"] for k in range(len(train))] == manifest.part(split, "train").ids
    assert len(manifest.dataset()) == len(manifest)
    both = manifest.dataset(split, "test", "train")
    assert len(both) == len(manifest.dataset(split)) == len(manifest)
    sample = train[-1]
    row = manifest.part(split, "train").table.row(-1, named=True)
    assert set(sample) == {name for name in row if not manifest.table[name].null_count()}
    for name in ("vision", "tactile"):
        image = Image.open(manifest.path(row[name])).convert("RGB")
        assert np.array_equal(sample[name], np.asarray(image))
    assert sample["video"] == row["video"]
    with pytest.raises(IndexError):
        train[len(train)]
    with pytest.raises(TypeError):
        train["v0"]
    assert sum(1 for _ in train) == len(train)  # as a sequence


def test_a_transform_is_of_each_image_or_of_one_column(tag):
    manifest, split = tag
    assert manifest.dataset(split, transform=shape)[0]["vision"] == ("RGB", (32, 32))
    mixed = manifest.dataset(split, transform={"tactile": shape})[0]
    assert mixed["tactile"] == ("RGB", (32, 32))
    assert mixed["vision"].shape == (32, 32, 3)


def test_loaders_of_torch_read_it_with_workers(tag):
    data = pytest.importorskip("torch.utils.data")
    manifest, split = tag
    dataset = pickle.loads(pickle.dumps(manifest.dataset(split, "train")))
    for workers in (0, 2):
        batches = list(data.DataLoader(dataset, batch_size=5, num_workers=workers))
        assert [i for batch in batches for i in batch["id"]] == manifest.part(split, "train").ids
        assert batches[0]["tactile"].shape == (5, 32, 32, 3)
        assert (batches[1]["vision"][2].numpy() == dataset[7]["vision"]).all()


def test_hugging_face_holds_the_same(tag, monkeypatch):
    pytest.importorskip("datasets")
    manifest, split = tag
    ours = manifest.dataset(split, "test")
    theirs = ours.to_hf()
    assert len(theirs) == len(ours)
    assert set(theirs.column_names) == set(ours[0])
    assert isinstance(theirs[3]["tactile"], Image.Image)
    assert np.array_equal(theirs[3]["tactile"].convert("RGB"), ours[3]["tactile"])
    assert theirs[3]["video"] == ours[3]["video"]
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(MissingExtraError, match="datasets"):
        ours.to_hf()


def test_what_cannot_be_is_explained(tag):
    manifest, split = tag
    none = {name: pl.lit(None, pl.String) for name in ("vision", "tactile", "background")}
    bare = replace(manifest, table=manifest.table.with_columns(**none))
    fails(f"{len(bare)} vision and {len(bare)} tactile images missing", bare.dataset)
    fails("`parts` must be one of train, val, test", manifest.dataset, split, "training")
    fails("missing of 0 samples", manifest.dataset, split, "val")
    one = manifest.dataset(split, "train")
    Path(one.columns["vision"][0]).write_bytes(b"")
    with pytest.raises(PalpateError, match="must be whole and readable"):
        one[0]
