"""What stages give to a generator: the gel of the train part where the data have none."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from palpate.core import Split
from palpate.diffusion.autoencoders import load_autoencoder
from palpate.studies import making, questions
from palpate.studies.methods import METHODS
from palpate.studies.study import PRESETS


class StopError(Exception):
    """Raised once the gels are known."""


class Pipeline:
    """Takes no photo and makes no image."""

    background, gel, size, vision_size = True, None, 32, 32

    def to(self, device):
        return self

    def embed_text(self, text):
        return np.zeros(4)

    def embed(self, photos):
        return np.zeros((len(photos), 4))

    def sampler_with(self, **how):
        return None

    def sample(self, photos, ids, *, background, **how):
        self.given = background
        raise StopError


@pytest.mark.parametrize("stage", ["make_images", "sample_in_steps", "move_images"])
def test_the_stock_gel_is_of_the_train_part(small_manifest, tmp_path, monkeypatch, stage):
    """Videos 0 and 3 are dark, the others bright; no sample has a no-contact image."""
    none = pl.lit(None, pl.String).alias("background")
    manifest = replace(small_manifest, table=small_manifest.table.with_columns(none))
    split = Split({i: "train" if i[1] in "03" else "test" for i in manifest.ids})
    pipeline = Pipeline()
    for module in (making, questions):
        monkeypatch.setattr(module, "data_of", lambda after, name: (manifest, split))
        fake = type("Fake", (), {"from_pretrained": lambda folder: pipeline})
        monkeypatch.setattr(module, "TactilePipeline", fake)
    loaded = type("Loaded", (), {"load": lambda folder, device: None})
    monkeypatch.setattr(questions, "EncoderSet", loaded)
    monkeypatch.setattr(questions, "embed", lambda *args, **how: None)
    how = {"generator": "g", "seed": 0, "device": "cpu"}
    if stage == "make_images":
        text = METHODS["Ours, by text"]
        how |= {"split": "NoLeak", "method": text, "preset": PRESETS["smoke"]}
    else:
        how |= {"encoders": "e"} | ({"options": None} if stage == "move_images" else {})
    module = making if stage == "make_images" else questions
    after = {"g": tmp_path, "e": tmp_path}
    with pytest.raises(StopError):
        getattr(module, stage)(tmp_path / "stage", after, lambda *_: None, **how)
    train = np.stack([np.asarray(i) for i in making.setting_of(
        manifest, split, tmp_path / "stage", size=32, progress=lambda *_: None
    ).pixels(manifest.part(split, "train"))])  # fmt: skip
    stock = np.median(train, axis=0).astype(np.uint8)
    assert (np.asarray(pipeline.given) == stock).all()
    assert len(pipeline.given) == len(manifest.part(split, "test"))


def test_a_given_autoencoder_is_taken_and_measured(small_manifest, tmp_path, monkeypatch):
    split = Split({i: "train" if i[1] in "03" else "test" for i in small_manifest.ids})
    monkeypatch.setattr(making, "data_of", lambda after, name: (small_manifest, split))
    where = tmp_path / "stage"
    how = {"split": "NoLeak", "options": "palpate/mini", "size": 64, "device": "cpu"}
    facts = making.make_autoencoder(where, {}, lambda *_: None, **how)
    given = load_autoencoder("palpate/mini")
    assert facts["digest"] == given.digest == load_autoencoder(where / "autoencoder").digest
    assert facts["ceiling"]["psnr"] > 10
