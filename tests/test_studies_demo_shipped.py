"""The pipeline on ready models: what falls away, what goes on from where, and that every card says what its model saw."""

from dataclasses import replace

import pytest

from mini_fixtures import WORLD, write_shipped
from palpate.core import PalpateError, read_json, write_json
from palpate.data.importing import import_dataset
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders import models as shipped
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.models import shipped_folder
from palpate.evaluation import presets
from palpate.sim import MINI_SEEDS, write_world
from palpate.studies.inputs import require_unseen
from palpate.studies.pipeline import PipelineOptions, run_pipeline
from palpate.studies.summary import summarize

OPTIONS = PipelineOptions(preset="tiny", device="cpu", workers=1)


@pytest.fixture
def mini(tmp_path, monkeypatch):
    """The preset tiny, on shipped models that the test wrote."""
    generator = write_shipped(tmp_path / "root", monkeypatch)
    monkeypatch.setitem(
        presets.PRESETS, "tiny", replace(presets.PRESETS["tiny"], models="palpate/mini", start=True)
    )
    return generator


def test_no_preset_plays_in_a_world_that_the_shipped_models_saw():
    for preset in presets.PRESETS.values():
        assert preset.world.seed not in MINI_SEEDS
        assert preset.pretraining.seed not in MINI_SEEDS


@pytest.mark.slow
def test_shipped_models_take_the_place_of_three_stages(mini, tmp_path):
    done = run_pipeline(OPTIONS, tmp_path / "run")
    assert list(done.stages) == [
        "world",
        "data",
        "split",
        "encoders",
        "generator",
        "generated",
        "scores",
    ]
    assert done.models == {"clip": "palpate/mini", "autoencoder": "palpate/mini"}
    encoders, model = (
        EncoderSet.load(tmp_path / "run" / "encoders" / "encoders"),
        TactilePipeline.from_pretrained(tmp_path / "run" / "generator" / "model"),
    )
    ready = EncoderSet.load("palpate/mini")
    assert encoders.digest("vision") == ready.digest("vision")
    assert encoders.digest("tactile") != ready.digest("tactile")
    assert encoders.card["start_card"]["data"] == WORLD
    assert encoders.card["clip"] == "palpate/mini"
    assert model.training["start"] == mini.digest
    assert model.training["start_record"]["data"] == WORLD
    assert model.stats == mini.stats
    assert "Brick" in model.notice
    assert {s.encoder for s in done.scores if s.metric == "TMMD"} == {encoders.digest("tactile")}
    bound = done.stages["generator"].facts["autoencoder on test touches"]
    assert (bound["n"], bound["codes"]) == (len(done.split.ids("test")), 64)
    results = summarize(done, "palpate demo")
    (note,) = [n for n in results.notes if n.code == "models-shipped"]
    assert "the starting weights of the tactile encoder" in note.params["models"]
    assert "models-of-this-run" not in {n.code for n in results.notes}
    assert results.settings["models"] == done.models
    lines: list[str] = []
    run_pipeline(OPTIONS, tmp_path / "run", say=lines.append)
    assert all("already done" in line for line in lines)
    # A rewritten page changes nothing; another card, everything that carries it, and the same weights make the same pictures.
    place = shipped_folder("palpate/mini", "clip")
    for name, kept in (
        ("README.md", set(done.stages)),
        ("palpate.json", {"world", "data", "split", "generated"}),
    ):
        (place / name).write_text((place / name).read_text().replace("}", "} ", 1) + "\n")
        lines.clear()
        run_pipeline(OPTIONS, tmp_path / "run", say=lines.append)
        assert {line.split(":")[0] for line in lines if "already done" in line} == kept


@pytest.mark.slow
def test_from_scratch_and_the_variant_with_backgrounds_start_from_nothing(mini, tmp_path):
    done = run_pipeline(replace(OPTIONS, from_scratch=True), tmp_path / "a")
    assert {"pretraining", "clip", "autoencoder"} <= set(done.stages)
    assert (
        TactilePipeline.from_pretrained(tmp_path / "a" / "generator" / "model").training["start"]
        is None
    )
    assert (
        EncoderSet.load(tmp_path / "a" / "encoders" / "encoders").card["start_card"].get("data")
        is None
    )
    assert "models-of-this-run" in {n.code for n in summarize(done, "x").notes}
    run_pipeline(replace(OPTIONS, background=True), tmp_path / "b")
    assert (
        TactilePipeline.from_pretrained(tmp_path / "b" / "generator" / "model").training["start"]
        is None
    )


def test_a_world_that_the_shipped_models_saw_is_refused(mini, tmp_path):
    tiny = replace(presets.PRESETS["tiny"].world, seed=MINI_SEEDS[3])
    write_world(tmp_path / "seen", tiny, workers=1)
    assert read_json(tmp_path / "seen" / "world.json", "world")["seen_by_shipped_models"]
    with pytest.raises(
        PalpateError,
        match=r"must not have been trained on the data.*another --seed, or pass --from-scratch",
    ):
        run_pipeline(replace(OPTIONS, data=tmp_path / "seen"), tmp_path / "run")
    # Nor by any file or folder of it, a link to it, or a table elsewhere that was made of it.
    refusal = "must not have been trained on the data"
    (tmp_path / "link").symlink_to(tmp_path / "seen" / "manifest.parquet")
    for part in ("seen/manifest.parquet", "seen/dataset", "link"):
        with pytest.raises(PalpateError, match=refusal):
            run_pipeline(replace(OPTIONS, data=tmp_path / part), tmp_path / "run")
    done = import_dataset(tmp_path / "seen", tmp_path / "import").manifest
    (tmp_path / "seen").rename(tmp_path / "gone")
    assert done.facts["world_seed"] == str(MINI_SEEDS[3])
    with pytest.raises(PalpateError, match=refusal):
        require_unseen(tmp_path, done.facts)
    require_unseen(tmp_path, done.facts | {"world_seed": "7"})
    # The nearest world tells: a fresh one inside the folder of a seen one is unseen.
    write_json(tmp_path / "gone" / "new" / "world.json", {"format": "palpate-world/1"})
    require_unseen(tmp_path / "gone" / "new" / "manifest.parquet")


def test_absent_and_unknown_models_are_told_before_any_work(tmp_path, monkeypatch):
    with pytest.raises(PalpateError, match=r"must be one of palpate/mini\. Got 'palpate/maxi'"):
        run_pipeline(replace(OPTIONS, clip="palpate/maxi"), tmp_path / "run")
    monkeypatch.setattr(shipped, "shipped_root", lambda: tmp_path)
    with pytest.raises(PalpateError, match="must lie in the installed package"):
        run_pipeline(replace(OPTIONS, autoencoder="palpate/mini"), tmp_path / "run")
    assert not list((tmp_path / "run").glob("*"))
