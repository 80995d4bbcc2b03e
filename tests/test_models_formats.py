"""Models of earlier formats load, compute the same, and are saved in the current format."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.encoder_set import EncoderSet

FORMATS = Path(__file__).parent / "data" / "formats"
#: Of the version that wrote them.
DIGESTS = {
    "vision": "01a797e7934aa89c9f3f931868279e3135aba9296bf1144f3c073cd6b200d082",
    "text": "9e31cd9511c5facc2f915dc523e47122e6553ad575932391099a911f997ba2cf",
    "tactile": "4c03e9229a6bb1f3d4456a1eb1713af874a065f3180e09ae3aa91477c370e55d",
}
PIPELINE = "75a94f04e0763d109cc82abb7c392c319c1a71a6dffce3ada11d2b166a61d2b5"


def no_tower(value):
    """No key of a JSON object contains the word."""
    if isinstance(value, dict):
        return all("tower" not in key and no_tower(v) for key, v in value.items())
    return not isinstance(value, list) or all(map(no_tower, value))


def test_encoders_of_format_1(tmp_path):
    encoders = EncoderSet.load(FORMATS / "encoders-1")
    assert {m: encoders.digest(m) for m in encoders.modalities} == DIGESTS
    assert encoders.card["seed"] == 0
    encoders.save(tmp_path / "now", half=True)
    about = json.loads((tmp_path / "now" / "palpate.json").read_text())
    assert (about["format"], about["digests"]) == ("palpate-encoders/2", DIGESTS)
    assert sorted(p.name for p in (tmp_path / "now").iterdir() if p.is_dir()) == ["clip", "tactile"]
    assert no_tower(about)


def test_a_pipeline_of_format_1(tmp_path):
    pipeline = TactilePipeline.from_pretrained(FORMATS / "pipeline-1")
    assert pipeline.digest == PIPELINE
    # The image of the version that wrote it, at three places.
    photo = np.full((1, 16, 16, 3), 128, np.uint8)
    full = replace(pipeline.sampler, batch=4)
    image = pipeline.sample(pipeline.embed(photo), ["a"], seed=0, sampler=full)[0].astype(int)
    assert image.mean() == pytest.approx(127.7421875, abs=0.05)
    assert np.abs(image[0, 0] - [156, 130, 124]).max() <= 1
    assert np.abs(image[5, 7] - [77, 108, 110]).max() <= 1
    pipeline.save(tmp_path / "now", half=True)
    about = json.loads((tmp_path / "now" / "palpate.json").read_text())
    assert (about["format"], about["digest"]) == ("palpate-pipeline/2", PIPELINE)
    assert no_tower(about)
    assert TactilePipeline.from_pretrained(tmp_path / "now").digest == PIPELINE


def test_the_shipped_models_name_no_tower():
    mini = Path(__file__).parents[1] / "src" / "palpate" / "mini"
    for file in [*mini.rglob("*.json"), *mini.rglob("*.md")]:
        if file.name not in ("tokenizer.json",):
            assert "tower" not in file.read_text().lower(), file
