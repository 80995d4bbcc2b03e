"""From a world to a score, on captions: every verb on the way."""

import json
import shlex

import pytest

from forge.servers import FakeServer
from palpate.cli import main
from palpate.sim import WorldOptions, write_world

WORLD = WorldOptions(
    materials=3, objects_per_material=4, contacts_per_video=2, frames_per_contact=2, test=0.4
)
SPLIT = "--split data/splits/Orig.json"
CHAIN = f"""
import world --text captions -o data
train encoder data {SPLIT} --preset tiny -o encoders
train generator data {SPLIT} --preset tiny --clip encoders --steps 2 -o model
generate data {SPLIT} --model model --steps 2 -o generated
score --generated generated --reference data {SPLIT} --encoder encoders -o scores.json
"""


@pytest.mark.slow
def test_captions_train_encoders_and_a_generator_whose_images_are_scored(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_world(tmp_path / "world", WORLD)
    with FakeServer() as server:
        lines = [f"caption world -o captions --server {server.url}", *CHAIN.split("\n")]
        for line in filter(None, lines):
            assert main([*shlex.split(line), "-q"]) == 0, (line, capsys.readouterr().err)
    digest = json.loads((tmp_path / "captions" / "record.json").read_text())["digest"][:12]
    for model, part in (("encoders", "card"), ("model", "training")):
        facts = json.loads((tmp_path / model / "palpate.json").read_text())[part]
        assert digest in facts["text_source"], model
    scores = json.loads((tmp_path / "scores.json").read_text())["scores"]
    assert {"TMMD", "CI-TMMD"} <= {score["metric"] for score in scores}
