"""What stages give to a generator: the gel of the train part where the data have none."""

from dataclasses import replace

import numpy as np
import polars as pl

from palpate.core import Split
from palpate.data.images import read_image
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import load_autoencoder
from palpate.encoders.embed import texts_of
from palpate.studies import making
from palpate.studies.graph import Work
from palpate.studies.methods import Setting


def test_the_stock_gel_is_of_the_train_part(small_manifest, tmp_path):
    """Videos 0 and 3 are dark, the others bright; no sample has a no-contact image."""
    none = pl.lit(None, pl.String).alias("background")
    manifest = replace(small_manifest, table=small_manifest.table.with_columns(none))
    split = Split({i: "train" if i[1] in "03" else "test" for i in manifest.ids})
    train, test = (manifest.part(split, part) for part in ("train", "test"))
    setting = Setting(train, test, Work(tmp_path / "stage"), 32)
    stock = np.median(np.asarray(setting.pixels(setting.train)), axis=0).astype(np.uint8)
    gels = np.asarray(setting.pixels(setting.test, "background"))
    assert gels.shape == (len(setting.test), 32, 32, 3)
    assert (gels == stock).all()


class Pipeline:
    """Makes of each text an image of its length, on the gel that it is given."""

    background, size, digest = True, 32, "d"

    def to(self, device):
        return self

    def embed_text(self, text):
        return np.array([[len(text)]])

    def sample(self, photos, ids, *, texts, seed, background):
        assert photos is None
        return (0 * background + texts[:, :, None, None]).astype(np.uint8)


def test_by_text_each_image_is_that_of_its_sample_s_text(small_manifest, tmp_path, monkeypatch):
    split = Split({i: "train" if i[1] in "03" else "test" for i in small_manifest.ids})
    monkeypatch.setattr(making, "data_of", lambda work, name: (small_manifest, split))
    fake = type("Fake", (), {"from_pretrained": lambda folder: Pipeline()})
    monkeypatch.setattr(making, "TactilePipeline", fake)
    work = Work(tmp_path / "stage", {"g": tmp_path}, device="cpu")
    work.folder.mkdir()
    facts = making.make_images(work, split="NoLeak", seed=0, generator="g", by_text=True)
    test = small_manifest.part(split, "test")
    made = Manifest.load(work.folder / "images")
    assert facts["images"] == len(test)
    assert made.ids == test.ids
    for path, text in zip(made.paths("tactile"), texts_of(test)[0], strict=True):
        assert (np.asarray(read_image(path)) == len(text)).all()


def test_a_given_autoencoder_is_taken_and_measured(small_manifest, tmp_path, monkeypatch):
    split = Split({i: "train" if i[1] in "03" else "test" for i in small_manifest.ids})
    monkeypatch.setattr(making, "data_of", lambda work, name: (small_manifest, split))
    work = Work(tmp_path / "stage", device="cpu")
    facts = making.make_autoencoder(work, split="NoLeak", options="palpate/mini", size=64)
    given = load_autoencoder("palpate/mini")
    assert facts["digest"] == given.digest == load_autoencoder(work.folder / "autoencoder").digest
    assert facts["ceiling"]["psnr"] > 10
