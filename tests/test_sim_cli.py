"""``palpate world``: every option of a world can be given, and what is not comes from the preset."""

import dataclasses
import json

import pytest

from palpate.cli import main
from palpate.cli.terminal import parse
from palpate.cli.world import Options, world_options
from palpate.sim import MATERIALS, PRESETS, WorldOptions


def named(*args):
    return world_options(parse("world", Options, ["-o", "w", *args]))


def test_the_default_is_small():
    assert named() == PRESETS["small"]
    for name, options in PRESETS.items():
        assert named("--preset", name) == options


def test_every_option_can_be_given():
    other = {
        "materials": ("Wood", "Sand"),
        "balance": "touch-and-go",
        "free_written": "all",
        "look": "digit",
        "leak": "none",
        "layout": "raw",
        "relax_mm": (1.0,),
        "slide_mm": (1.0, 2.0),
        "blur_px": (0.5,),
    }
    for field in dataclasses.fields(WorldOptions):
        now = getattr(PRESETS["small"], field.name)
        if field.name not in other:
            other[field.name] = (
                (now[0] * 1.01, now[1] * 0.99)
                if isinstance(now, tuple)
                else now + 1
                if isinstance(now, int)
                else now * 0.9
            )
        value = other[field.name]
        words = [str(v) for v in value] if isinstance(value, tuple) else [str(value)]
        found = named(f"--{field.name.replace('_', '-')}", *words)
        assert getattr(found, field.name) == value, field.name
        assert {
            f.name
            for f in dataclasses.fields(found)
            if getattr(found, f.name) != getattr(PRESETS["small"], f.name)
        } == {field.name}


def test_words_that_stand_for_more():
    assert named("--materials", "4").materials == WorldOptions(materials=4).materials
    assert len(named("--materials", "20").materials) == len(MATERIALS)
    assert named("--layout", "videos").free_written == "all"
    assert named("--layout", "hct").look == "digit"
    assert named("--layout", "hct", "--look", "gelsight").look == "gelsight"
    assert named("--relax-mm").relax_mm == ()


def test_a_world_can_be_repeated_from_its_record(tmp_path, capsys):
    size = ["--size", "16", "--tile", "64", "--workers", "1", "-q"]
    assert (
        main(
            [
                "world",
                "-o",
                str(tmp_path / "a"),
                "--preset",
                "tiny",
                "--layout",
                "raw",
                "--view-mm",
                "30",
                "40",
                *size,
            ]
        )
        == 0
    )
    assert (
        main(
            [
                "world",
                "-o",
                str(tmp_path / "b"),
                "--options",
                str(tmp_path / "a" / "world.json"),
                "--workers",
                "1",
                "-q",
            ]
        )
        == 0
    )
    assert json.loads((tmp_path / "a" / "world.json").read_text()) == json.loads(
        (tmp_path / "b" / "world.json").read_text()
    )
    assert (tmp_path / "a" / "vision.npy").read_bytes() == (
        tmp_path / "b" / "vision.npy"
    ).read_bytes()
    assert (
        main(
            [
                "world",
                "-o",
                str(tmp_path / "c"),
                "--options",
                str(tmp_path / "a"),
                "--preset",
                "tiny",
            ]
        )
        == 2
    )
    assert "Either --preset or --options" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--view-mm", "40", "30"], "lower end first"),
        (["--load-mm", "nan", "1"], "load_mm must be two numbers"),
        (["--size", "300"], "16 to 256"),
        (["--materials", "Wod"], "Did you mean 'Wood'"),
        (["--materials", "0"], "materials must be 1 to"),
        (["--layout", "tvl"], "layout"),
        (["--preset", "huge"], "preset"),
        (["--options", "nowhere.json"], "must exist"),
        (["--workers", "0"], "workers"),
    ],
)
def test_mistakes_are_one_line_and_status_2(args, word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["world", "-o", "w", *args]) == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("palpate "))
    assert word in line
    assert not list(tmp_path.iterdir())
