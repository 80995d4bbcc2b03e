"""The demo on shipped models: which stages fall away, what training starts from."""

import json
import shutil
from dataclasses import replace

import pytest

from palpate.core import PalpateError, read_json, write_json
from palpate.data.importing import import_dataset
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders import models
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import shipped_folder
from palpate.sim import MINI_SEEDS, write_world
from palpate.studies import presets
from palpate.studies.demo import DemoOptions, require_unseen, run_demo
from palpate.studies.demo_page import results_of

OPTIONS = DemoOptions(preset="tiny", device="cpu")
STAGES = ["world", "data", "split", "encoders", "generator", "generated", "scores"]


def test_no_preset_uses_a_world_that_the_shipped_models_saw():
    assert not {p.world.seed for p in presets.PRESETS.values()} & {*MINI_SEEDS}


@pytest.mark.slow
def test_training_goes_on_from_the_shipped_models(tmp_path, monkeypatch):
    shutil.copytree(models.shipped_root(), tmp_path / "models")
    monkeypatch.setattr(models, "shipped_root", lambda: tmp_path / "models")
    demo = run_demo(OPTIONS, tmp_path / "run")
    assert list(demo.stages) == STAGES
    encoders = EncoderSet.load(tmp_path / "run" / "encoders" / "encoders")
    model = TactilePipeline.from_pretrained(tmp_path / "run" / "generator" / "model")
    ready, shipped = (
        EncoderSet.load("palpate/mini"),
        TactilePipeline.from_pretrained("palpate/mini"),
    )
    assert encoders.digest("vision") == ready.digest("vision")
    assert encoders.digest("tactile") != ready.digest("tactile")
    assert (model.training["start"], model.stats) == (shipped.digest, shipped.stats)
    assert {s.encoder for s in demo.scores if s.metric == "TMMD"} == {encoders.digest("tactile")}
    notes = {note.code: note.params for note in results_of(demo, "palpate demo").notes}
    assert notes["models-shipped"]["name"] == "palpate/mini"
    lines: list[str] = []
    run_demo(OPTIONS, tmp_path / "run", print_line=lines.append)
    assert all("already done" in line for line in lines)
    # Other words change nothing; another license changes everything that carries the card.
    file = shipped_folder("palpate/mini", "clip") / "palpate.json"
    record = json.loads(file.read_text())
    for key, stages in {"summary": {*STAGES}, "license": {"world", "data", "split"}}.items():
        record["card"][key] = "other"
        file.write_text(json.dumps(record))
        lines.clear()
        run_demo(OPTIONS, tmp_path / "run", print_line=lines.append)
        assert {line.split(":")[0] for line in lines if "already done" in line} == stages


def test_a_world_that_the_shipped_models_saw_is_an_error(tmp_path):
    seen = replace(presets.PRESETS["tiny"].world, seed=MINI_SEEDS[3])
    write_world(tmp_path / "seen", seen, workers=1)
    assert read_json(tmp_path / "seen" / "world.json", "world")["seen_by_shipped_models"]
    words = "must not have been trained on the data"
    (tmp_path / "link").symlink_to(tmp_path / "seen" / "manifest.parquet")
    for part in ("seen", "seen/manifest.parquet", "seen/dataset", "link"):
        with pytest.raises(PalpateError, match=words):
            run_demo(replace(OPTIONS, data=tmp_path / part), tmp_path / "run")
    manifest = import_dataset(tmp_path / "seen", tmp_path / "import").manifest
    (tmp_path / "seen").rename(tmp_path / "gone")
    with pytest.raises(PalpateError, match=words):
        require_unseen(tmp_path, manifest.facts)  # a manifest names the seed of its world
    require_unseen(tmp_path, manifest.facts | {"world_seed": "7"})
    # The nearest world decides: a new one inside the folder of a seen one is unseen.
    write_json(tmp_path / "gone" / "new" / "world.json", {"format": "palpate-world/1"})
    require_unseen(tmp_path / "gone" / "new" / "manifest.parquet")


def test_absent_models_are_reported_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(models, "shipped_root", lambda: tmp_path)
    with pytest.raises(PalpateError, match="installed package"):
        run_demo(OPTIONS, tmp_path / "run")
    assert not list((tmp_path / "run").glob("*"))
