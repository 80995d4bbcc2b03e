"""``palpate world``: what is not given comes from the preset."""

import dataclasses

import pytest

from forge.commands import mistake
from palpate.cli.terminal import parse
from palpate.cli.world import FIELDS, Options, world_options
from palpate.sim import PRESETS, WorldOptions

#: Arguments -> preset, and what is changed in it.
ARGUMENTS = {
    "": ("small", {}),
    **{f"--preset {name}": (name, {}) for name in PRESETS},
    "--seed 7 --size 32": ("small", {"seed": 7, "size": 32}),
    "--preset demo --look digit": ("demo", {"look": "digit"}),
    "--objects-per-material 3": ("small", {"objects_per_material": 3}),
    "--videos-per-object 2": ("small", {"videos_per_object": 2}),
    "--leak frame --layout videos": ("small", {"leak": "frame", "layout": "videos"}),
    "--materials Wood Sand": ("small", {"materials": ("Wood", "Sand")}),
    "--scale real": ("small", {"scale": "real"}),
    "--materials 4": ("small", {"materials": WorldOptions(materials=4).materials}),
    "--set contacts_per_video=6 free_written=all": (
        "small",
        {"contacts_per_video": 6, "free_written": "all"},
    ),
}


@pytest.mark.parametrize("arguments", ARGUMENTS)
def test_options_change_a_preset(arguments):
    preset, changes = ARGUMENTS[arguments]
    options = world_options(parse("world", Options, ["-o", "w", *arguments.split()]))
    assert options == dataclasses.replace(PRESETS[preset], **changes)


def test_the_table_has_every_option():
    tested = {name for _, changes in ARGUMENTS.values() for name in changes}
    assert tested | {"surfaces"} > {*FIELDS}  # which needs files: test_sim_scans


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--size 300", "--size must be a whole number from 16 to 256"),
        ("--materials Wod", "--materials must be names of materials"),
        ("--materials 0", "--materials must be"),
        ("--layout tvl", "layout"),
        ("--preset huge", "preset"),
        ("--workers 0", "--workers must be at least 1"),
        ("--set hard=2", "--set hard must be a number from 0 to 1"),
        ("--set size=32", "Use --size"),
        ("--set contact_per_video=2", "Did you mean: contacts_per_video"),
    ],
)
def test_mistakes_are_one_line(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mistake(capsys, words, "world", "-o", "w", *arguments.split())
    assert not list(tmp_path.iterdir())
