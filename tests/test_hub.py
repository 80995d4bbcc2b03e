"""The hub: what is put there comes back, at a revision, with its card."""

import shutil
import time
from types import SimpleNamespace

import huggingface_hub
import pytest

from forge.errors import fails
from forge.models import make_encoders, make_pipeline
from palpate.core import Score, Split
from palpate.core.hub import fetch
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.encoder import Encoder
from palpate.report.results import Results


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A hub in a folder: one a place, kind and revision."""
    root = tmp_path / "hub"

    class Api:
        def __init__(self, token=None):
            self.token = token

        def create_repo(self, name, **_):
            return SimpleNamespace(repo_id=name)

        def create_branch(self, name, **_):
            pass

        def upload_folder(self, *, repo_id, folder_path, repo_type, revision):
            target = root / repo_type / (revision or "main") / repo_id
            shutil.copytree(folder_path, target, dirs_exist_ok=True)

    def snapshot(name, *, allow_patterns, revision, repo_type):
        place = root / repo_type / (revision or "main") / name
        if not place.is_dir():
            raise OSError(f"404: {name}\nand more lines")
        return str(place)

    monkeypatch.setattr(huggingface_hub, "HfApi", Api)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot)
    monkeypatch.chdir(tmp_path)
    return root


def test_a_split_comes_back_from_the_hub_with_its_card(hub):
    split = Split({"a": "train", "b": "test"}, {"name": "NoLeak"})
    split.push_to_hub("me/split", revision="v1")
    assert Split.load("me/split@v1").digest == Split.load("me/split", "v1").digest == split.digest
    card = (hub / "dataset" / "v1" / "me" / "split" / "README.md").read_text()
    assert card.startswith("---\ntags:\n- palpate\n")
    assert "train 1, test 1" in card
    assert "Split.load('me/split')" in card
    caught = fails("The split me/split must be a hub id within reach", Split.load, "me/split")
    assert "\n" not in str(caught)
    fails("splits/none.json", Split.load, "splits/none.json")  # a file is not looked for there


def test_results_come_back_without_images_and_paths(hub):
    results = Results("Scores", scores=[Score("SSIM", "ours", 0.5)])
    results.push_to_hub("me/results")
    again = Results.load("me/results")
    assert again["SSIM"][0].value == 0.5
    card = (hub / "dataset" / "main" / "me" / "results" / "README.md").read_text()
    assert "SSIM" in card
    assert "0.5" in card


def test_encoders_and_pipelines_are_loaded_at_a_revision(hub, tmp_path):
    encoders = make_encoders()
    Encoder(encoders, "tactile").push_to_hub("me/touch", revision="v1")
    again = Encoder.from_pretrained("me/touch", modality="tactile", device="cpu", revision="v1")
    assert again.digest == encoders.digest("tactile")
    place = hub / "model" / "v1" / "me" / "touch"
    assert "Encoder.from_pretrained" in (place / "README.md").read_text()
    pipeline = make_pipeline()
    pipeline.encoders = None
    pipeline.save(hub / "model" / "v2" / "me" / "pipeline")
    loaded = TactilePipeline.from_pretrained("me/pipeline", device="cpu", revision="v2")
    assert loaded.digest == pipeline.digest
    fails("pipeline me/pipeline must be a hub id", TactilePipeline.from_pretrained, "me/pipeline")


def test_a_hub_that_rejects_is_one_line(hub, monkeypatch):
    def rejected(*_, **__):
        raise OSError("403 Forbidden\nmore")

    monkeypatch.setattr(huggingface_hub.HfApi, "create_repo", rejected)
    caught = fails("you may write to", Split({"a": "train"}).push_to_hub, "me/split")
    assert "\n" not in str(caught)


def test_without_a_network_the_answer_comes_within_five_seconds_of_work(monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", "http://127.0.0.1:9")
    began = time.process_time()
    caught = fails("must be a hub id within reach", fetch, "a/b", ["*.json"], "pipeline", "fix")
    assert time.process_time() - began < 5
    assert "\n" not in str(caught)
