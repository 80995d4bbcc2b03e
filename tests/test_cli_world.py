"""``palpate world``: every option of a world can be given, and the others come from the preset."""

import dataclasses

import pytest

from palpate.cli import main
from palpate.cli.running import join_help_lines, parse
from palpate.cli.world import Options, world_options
from palpate.sim import MATERIALS, PRESETS, WorldOptions

SMALL = PRESETS["small"]


def options_of(*args):
    return world_options(parse("world", Options, ["-o", "w", *args]))


def test_presets():
    assert options_of() == SMALL
    for name, options in PRESETS.items():
        assert options_of("--preset", name) == options


@pytest.mark.parametrize("field", dataclasses.fields(WorldOptions), ids=lambda field: field.name)
def test_every_option_can_be_given(field):
    current = getattr(SMALL, field.name)
    if field.name == "materials":
        value = ("Wood", "Sand")
    elif "choices" in field.metadata:
        value = next(c for c in field.metadata["choices"] if c != current)
    else:
        value = current + 1 if isinstance(current, int) else current * 0.9
    words = [str(v) for v in value] if isinstance(value, tuple) else [str(value)]
    given = options_of(f"--{field.name.replace('_', '-')}", *words)
    assert given == dataclasses.replace(SMALL, **{field.name: value})


def test_words_that_imply_others():
    assert options_of("--materials", "4").materials == WorldOptions(materials=4).materials
    assert len(options_of("--materials", "20").materials) == len(MATERIALS)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--size", "300"], "--size must be a whole number from 16 to 256"),
        (["--materials", "Wod"], "--materials must be names of materials"),
        (["--materials", "0"], "--materials must be"),
        (["--layout", "tvl"], "layout"),
        (["--preset", "huge"], "preset"),
        (["--workers", "0"], "--workers must be at least 1"),
    ],
)
def test_mistakes_are_one_line(args, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["world", "-o", "w", *args]) == 2
    (line,) = (x for x in capsys.readouterr().err.splitlines() if x.startswith("palpate "))
    assert message in line
    assert not list(tmp_path.iterdir())


def test_groups_that_a_verb_makes_need_no_source(monkeypatch):
    """From Python 3.12 on their module is that of the verb, where there is no such class."""
    group = Options.__dataclass_fields__["world"].default_factory
    monkeypatch.setattr(group, "__module__", "palpate.cli.world")
    join_help_lines(Options)
