"""``palpate presets``, and ``--set`` of the trainings."""

import json
from dataclasses import replace

import pytest

from palpate.cli import main
from palpate.cli.presets import PRESETS
from palpate.core import PalpateError
from palpate.diffusion.presets import MINI, PAPER, TINY
from palpate.encoders.presets import PRESETS as ENCODERS
from palpate.leakage import split
from palpate.sim import PRESETS as WORLDS
from palpate.training.options import LoopOptions

GENERATOR = PRESETS["train generator"]


def test_all_presets_are_listed_with_cost_and_score(capsys):
    assert main(["presets", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {verb: [row["preset"] for row in rows[verb]] for verb in rows} == {
        "train encoder": list(ENCODERS),
        "train autoencoder": ["tiny", "mini", "small"],
        "train generator": ["tiny", "mini", "small", "paper"],
        "world": list(WORLDS),
    }
    for verb, table in rows.items():
        assert all(row["cost"] and (verb == "world" or row["score"]) for row in table)


@pytest.mark.parametrize("verb", PRESETS)
def test_every_field_has_a_type_and_a_meaning_and_takes_what_is_listed(verb):
    table = PRESETS[verb]
    for name, preset in table.presets.items():
        fields = table.fields(name)
        assert all(field.meaning and field.type_text for field in fields.values())
        settings = [f"{path}={field.text}" for path, field in fields.items() if field.text]
        assert table.preset(name, [settings]) == preset
    assert {"autoencoder.crop": "px", "loop.batch": "rows"}.items() <= {
        path: field.unit for path, field in GENERATOR.fields("mini").items()
    }.items()


def test_the_fields_of_a_preset_are_printed_for_each_verb_that_has_it(capsys):
    assert main(["presets", "mini"]) == 0
    text = capsys.readouterr().out
    assert text.count("autoencoder.crop") == 2
    assert "condition.source" in text
    assert "one of text, vision, both, resnet" in text
    assert main(["presets", "paper"]) == 0
    assert "train autoencoder" not in capsys.readouterr().out
    assert main(["presets", "huge"]) == 2
    assert "NAME must be one of tiny, mini," in capsys.readouterr().err


def test_fields_are_set_by_their_types():
    settings = [
        ["loop.lr=3e-4", "loop.clip_norm=none", "loop.betas=[0.8, 0.9]", "sampler.method=ddim"],
        ["unet.widths=[32,64]", "unet.attention=[true,false]", "unet.modulate=false"],
    ]
    loop = replace(PAPER.loop, lr=3e-4, clip_norm=None, betas=(0.8, 0.9))
    unet = replace(PAPER.unet, widths=(32, 64), attention=(True, False), modulate=False)
    assert GENERATOR.preset("paper", settings) == replace(PAPER, loop=loop, unet=unet)
    assert GENERATOR.preset("tiny", [["unet=folder"]]) == replace(TINY, unet="folder")
    # Together they are valid, one after the other they are not.
    size = PRESETS["train encoder"].preset("mini", [["tactile.width=64", "tactile.heads=4"]])
    assert (size.tactile.width, size.tactile.heads) == (64, 4)
    assert isinstance(MINI.loop, LoopOptions)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("loop.lr=fast", "loop.lr must be a number. Got 'fast'"),
        ("loop.batch=1.5", "loop.batch must be a whole number"),
        ("loop.lr=-1", "loop.lr must be positive and finite. Got -1.0"),
        ("loop.ema=off", "loop.ema must be a number or none"),
        ("loop.betas=[0.9]", "loop.betas must be a list such as [0.9, 0.999]"),
        ("loop.betas=0.9", "loop.betas must be a list such as [0.9, 0.999]"),
        ("unet.modulate=yes", "unet.modulate must be true or false"),
        ("sampler.method=euler", "sampler.method must be one of ddim, dpm"),
        ("lr=1", "field of the preset mini. Got lr=1. Did you mean: autoencoder.lr or loop.lr"),
        ("condition.sorce=text", "Did you mean: condition.source"),
        ("moduate=true", "Did you mean: unet.modulate"),
        ("autoencoder.codes=8", "See: palpate presets mini"),
        ("loop.lr", "must be field=value, with a field of the preset mini. Got loop.lr. E.g. "),
        ("loop.steps=3", "Use --steps"),
        ("name=x", "See: palpate presets mini"),
        ("condition.dropout=2", "condition.dropout must lie in [0, 1)"),
    ],
)
def test_mistakes_say_what_must_be(setting, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "generator", ".", "-o", "out", "--set", setting]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("palpate train generator: --set ")
    assert message in line


def test_a_part_and_its_fields_are_not_set_together():
    with pytest.raises(PalpateError, match=r"unet.layers must be left out beside unet"):
        GENERATOR.preset("mini", [["unet=folder", "unet.layers=1"]])


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("encoder DATA --clip palpate/mini --set tactile_course.lr=-1", "--set tactile_course.lr"),
        ("autoencoder DATA --preset tiny --set autoencoder.lr=-1", "--set autoencoder.lr"),
        ("generator nothing/", "PATH must exist. Got nothing at nothing"),
        ("generator DATA --set condition.dropout=2", "E.g. --set condition.dropout=0.1"),
    ],
)
def test_what_a_training_refuses_is_named_as_it_is_given(
    command, message, small_manifest, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    small_manifest.save(tmp_path / "manifest.parquet")
    split(small_manifest, by="video").save(tmp_path / "s.json")
    words = ["manifest.parquet" if word == "DATA" else word for word in command.split()]
    assert main(["train", *words, "--split", "s.json", "-o", "out"]) == 2
    assert message in capsys.readouterr().err
