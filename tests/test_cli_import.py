"""The verbs import and validate: options of every format, statuses, JSON and text."""

import errno
import json
import os
import re
import shlex
from dataclasses import fields
from pathlib import Path

import pytest

from forge.commands import call, mistake
from forge.formats import TREES
from forge.pictures import write_image
from palpate.cli.importing import FormatOptions, TableOptions
from palpate.data.formats import FORMATS
from palpate.data.manifest import Manifest


@pytest.fixture
def tag(tmp_path):
    return TREES["touch-and-go"](tmp_path / "made").source


@pytest.fixture
def table(tmp_path):
    for k in range(4):
        write_image(tmp_path / "data" / "v" / f"{k}_rgb.jpg", k)
        write_image(tmp_path / "data" / "t" / f"{k}_tac.jpg", k)
    path = tmp_path / "data" / "t.csv"
    rows = [f"v/{k}_rgb.jpg,{k % 2},{'a' if k else ''}" for k in range(4)]
    path.write_text("\n".join(["url,kind,clip", *rows]))
    (tmp_path / "data" / "classes.txt").write_text("Wood: 0\nRock: 1\n")
    return path


TACTILE = "tactile=replace(replace(url, 'v/', 't/'), '_rgb', '_tac')"
MAPS = ["--map", "vision=url", TACTILE, "--map", "material=kind", "video=clip"]


def test_import_with_maps_classes_and_what_is_suspicious(capsys, table, tmp_path):
    args = ["import", table, "-o", tmp_path / "m", *MAPS, "--classes", table.parent / "classes.txt"]
    status, out, _ = call(capsys, *args, "--json")
    facts = json.loads(out)
    assert (status, facts["samples"], facts["materials"], facts["skipped"]) == (0, 4, 2, [])
    assert [p["kind"] for p in facts["suspicious"]] == ["null-group"]
    assert Manifest.load(tmp_path / "m").column("tactile") == [f"t/{k}_tac.jpg" for k in range(4)]
    assert "--overwrite" in call(capsys, *args)[2]
    status, out, _ = call(capsys, *args, "--overwrite")
    assert "Suspicious, but imported: 1" in out
    assert "1 of 4 rows have no video" in out


def test_options_of_the_format_pass_through(capsys, tag, tmp_path):
    options = ["--labels", tag / "train.txt", "--size", "16"]
    command = ["import", tag, "-o", tmp_path / "m", *options, "--max-per-contact", "1"]
    status, out, _ = call(capsys, *command, "--json")
    assert (status, json.loads(out)["samples"]) == (0, 2)
    lists = ["--labels", tag / "train.txt", tag / "test.txt"]
    status, out, _ = call(capsys, *command, *lists, "--json", "--overwrite")
    assert (status, json.loads(out)["samples"]) == (0, 4)
    # Options that matter to an import alone do no harm.
    status, out, _ = call(capsys, "validate", tag, *options, "--json")
    assert (status, json.loads(out)["samples"]) == (0, 6)


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--size", "three"], "size"),
        (["--swap", "fix"], "must be left out for the format touch-and-go"),
        (["--map", "video=a", "--map", "video=b"], "each column once"),
        (["--map", "video="], "as COLUMN=EXPRESSION"),
        (["--format", "zip"], "one of auto, touch-and-go"),
        (["--as", "vision"], "takes --labels, --size"),
    ],
)
@pytest.mark.parametrize("verb", ["import", "validate"])
def test_mistakes_in_options_are_one_line_and_status_2(capsys, tag, tmp_path, verb, args, word):
    output = ["-o", tmp_path / "m"] if verb == "import" else []
    mistake(capsys, word, verb, tag, *output, *args)
    assert not (tmp_path / "m").exists()


def test_validation_shows_facts_and_fails_on_what_is_requested(capsys, tag, table):
    status, out, _ = call(capsys, "validate", tag)
    assert status == 0
    assert re.search(r"^samples +12 *$", out, re.MULTILINE)
    facts = ("CC BY 4.0", "121,861 frames of 126 videos", "https://touch-and-go.github.io")
    for words in (*facts, "640 x 480", "Complete."):
        assert words in out
    (tag / "dataset" / "20220601_182052" / "gelsight_frame" / "0000000007.jpg").unlink()
    status, out, _ = call(capsys, "validate", tag)
    assert (status, "Missing: 1" in out, "Not complete." in out) == (1, True, True)
    status, out, _ = call(capsys, "validate", tag, "--json")
    data = json.loads(out)
    assert (status, data["ok"], data["samples"]) == (1, False, 11)
    assert [p["kind"] for p in data["missing"]] == ["missing-file"]
    assert (data["invalid"], data["facts"]["license"]) == ([], "CC BY 4.0")
    status, out, _ = call(capsys, "validate", table, *MAPS)
    assert (status, "Suspicious: 1" in out) == (0, True)
    assert call(capsys, "validate")[0] == 2


def test_problems_of_one_kind_are_one_line_and_all_are_in_json(capsys, table):
    rows = "".join(f"x.jpg,y.jpg,{k}\n" for k in range(30))
    table.write_text(f"vision,tactile,frame\n{rows}")
    status, out, _ = call(capsys, "validate", table)
    assert (status, out.count("no file"), out.count("  30 like ")) == (1, 2, 2)
    assert len(json.loads(call(capsys, "validate", table, "--json")[1])["missing"]) == 60


def test_every_option_of_every_format_is_an_option_of_the_command_line(capsys):
    status, out, _ = call(capsys, "validate", "--list")
    data = json.loads(call(capsys, "validate", "--list", "--json")[1])
    assert (status, list(data)) == (0, list(FORMATS))
    options = {f.name for group in (TableOptions, FormatOptions) for f in fields(group)}
    for name in FORMATS:
        assert f"\n{name}\n" in f"\n{out}"
        assert set(data[name]["options"]) <= options


def test_a_folder_of_one_kind_and_its_mistakes(capsys, table, tmp_path):
    command = ["import", table.parent / "v", "--as", "vision", "-o", tmp_path / "m", "--json"]
    status, out, _ = call(capsys, *command)
    assert (status, json.loads(out)["samples"]) == (0, 4)
    folder = tmp_path / "things"
    (table.parent / "v").rename(folder)
    # Xtmp_path / "x" / "things")
    for path in folder.iterdir():
        path.rename(path.with_name(path.name.replace("rgb", "a")))
    status, _, err = call(capsys, "import", folder, "-o", tmp_path / "n")
    assert status == 2
    for side in ("tactile", "vision"):  # complete commands to choose from
        command = shlex.split(next(line for line in err.splitlines() if f"--{side}" in line))
        assert call(capsys, *command[1:], "-o", tmp_path / side)[0] == 0
    status, _, err = call(capsys, "import", table, "--as", "vision", "-o", tmp_path / "n")
    assert (status, "Traceback" in err) == (2, False)


def test_a_full_disk_is_reported_in_a_line_and_leaves_nothing(capsys, tag, tmp_path, monkeypatch):
    assert call(capsys, "import", tag, "-o", tmp_path / "m", "-q")[0] == 0
    real = Path.write_bytes

    def full(path, data):
        if path.suffix == ".parquet":
            real(path, bytes(data)[:9])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    output = tmp_path / "full"
    for args in (
        ["import", tag, "-o", output],
        ["audit", tag / "train.txt", tag / "test.txt", "-o", output / "t.parquet"],
    ):
        status, _, err = call(capsys, *args, "-q")
        assert status == 2, err
        assert err.startswith(f"palpate {args[0]}: The disk must have room for ")
        assert "Got No space left on device. Free some space" in err
        assert "Traceback" not in err
        files = tmp_path.rglob("*.parquet")
        assert not [p for p in files if "full" in p.parts or p.name.startswith(".")]


def test_a_full_disk_is_reported_with_the_name_of_the_file(tmp_path, monkeypatch, capsys, tag):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")

    monkeypatch.setattr("tempfile.mkstemp", full)
    status, _, err = call(capsys, "import", tag, "-o", tmp_path / "m", "-q")
    assert (status, "somewhere" in err) == (2, False)
    assert f"must have room for {tmp_path / 'm'}" in err
