"""What SECURITY.md promises of files that other people made: each sentence is held here."""

import json
import os
import shutil
from pathlib import Path

import polars as pl
import pytest
import torch

from forge.commands import mistake
from forge.errors import fails
from forge.pictures import write_images
from palpate.cli import main
from palpate.encoders.models import shipped_root
from palpate.evaluation.scorers import Weights
from palpate.evaluation.scoring import score
from palpate.studies.verifying import verify

POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n0 0 64 64 rectfill\nshowpage\n"
NOTES = b"the notes of years"
NAMES = [f"{side}/{k}.png" for side in ("photo", "touch") for k in range(4)]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder of pairs; a program ``gs`` first on the path, which leaves a mark."""
    monkeypatch.chdir(tmp_path)
    write_images(tmp_path / "set", NAMES)
    gs = tmp_path / "bin" / "gs"
    gs.parent.mkdir()
    gs.write_text("#!/bin/sh\ntouch " + str(tmp_path / "started") + "\n")
    gs.chmod(0o755)
    monkeypatch.setenv("PATH", f"{gs.parent}{os.pathsep}{os.environ['PATH']}")
    return tmp_path


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("import set -o m", 2),
        ("import set -o m --skip-bad", 0),
        ("validate set", 1),
        ("audit set/photo set/touch", None),
        ("generate set/photo/1.png -o t.png", 2),
        ("score --generated set/touch --reference set/photo --companions ssim", 2),
        ("score --generated set/photo --reference set/touch --encoder palpate/mini", 2),
        ("caption set --url http://localhost:1 --dry-run -o c", None),
    ],
)
@pytest.mark.parametrize("content", [POSTSCRIPT, b"\xc5\xd0\xd3\xc6" + bytes(26) + POSTSCRIPT])
def test_postscript_under_the_name_of_an_image_starts_no_program(
    here, capsys, content, command, status
):
    """Pillow chooses its decoder by the content, and that of PostScript is a program."""
    for name in ("photo/1.png", "touch/2.png"):
        (here / "set" / name).write_bytes(content)
    got = main(command.split())
    error = capsys.readouterr().err
    assert got != 70
    assert status in (None, got), error
    assert "Traceback" not in error
    assert not (here / "started").exists()
    if status == 2:
        assert "not an image" in error


class Writer(torch.nn.Module):
    """A TorchScript module that writes to a file when it is called."""

    def __init__(self, path: str):
        super().__init__()
        self.path = path

    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        written = torch.from_file(self.path, True, 4).fill_(7)
        return img.to(torch.float32).mean(dim=[2, 3]) + written.sum()


def test_torchscript_runs_only_where_the_user_says_so(here, capsys):
    torch.jit.script(Writer(str(here / "notes.txt"))).save("writer.pt")
    Path("notes.txt").write_bytes(NOTES)
    options = {"companions": ["fid"], "inception": "writer.pt", "permutations": 0}
    command = "score --generated set/touch --reference set/touch --companions fid"
    assert main(f"{command} --inception writer.pt".split()) == 2
    error = capsys.readouterr().err
    assert "--trust-torchscript must be given" in error
    assert "a program" in error
    fails("a program", Weights, inception="writer.pt")
    assert Path("notes.txt").read_bytes() == NOTES
    # A record says nothing for the user, whoever wrote it.
    results = score("set/touch", "set/touch", trust_torchscript=True, **options)
    assert Path("notes.txt").read_bytes() != NOTES  # it does run
    Path("notes.txt").write_bytes(NOTES)
    results.save("r.json")
    record = json.loads(Path("r.json").read_text())
    assert "trust_torchscript" not in record["calls"][0]["arguments"]
    record["calls"][0]["arguments"]["trust_torchscript"] = True
    Path("r.json").write_text(json.dumps(record))
    checked = verify("r.json")
    assert checked.counts["cannot check"]
    assert Path("notes.txt").read_bytes() == NOTES
    checks = verify("r.json", trust_torchscript=True).checks
    assert [check.status for check in checks if check.name.startswith("FID")] == ["same"]


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("r.json", "report r.json -o page.html"),
        ("set/metadata.csv", "import set --format hf -o m"),
        ("set/metadata.jsonl", "import set --format hf -o m"),
        ("r.json", "audit set --split r.json --vision photo/{id}.png --tactile touch/{id}.png"),
        ("set/touch/index.json", "score --generated set/touch --reference set/photo"),
        ("p.txt", "caption set --server http://localhost:1 --prompt p.txt --per frame -o c"),
    ],
)
def test_a_huge_file_of_text_is_refused_before_it_is_read(here, capsys, name, command):
    with open(name, "wb") as file:
        file.truncate(3 << 30)
    mistake(capsys, "at most 256 MiB", *command.split())


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("config.json", "score --generated set/touch --reference set/photo --encoder model"),
        (
            "tactile/config.json",
            "score --generated set/touch --reference set/photo --encoder model",
        ),
        ("tokenizer/vocab.json", "generate set/photo/1.png --model model -o t.png"),
    ],
)
def test_a_huge_text_of_a_model_is_refused_before_another_library_reads_it(
    here, capsys, name, command
):
    shutil.copytree(shipped_root() / "mini" / "encoders", "model")
    Path("model", name).parent.mkdir(exist_ok=True)
    with open(Path("model", name), "wb") as file:
        file.truncate(3 << 30)
    mistake(capsys, "at most 256 MiB", *command.split())


@pytest.mark.parametrize("command", ["import rows.parquet -o m", "audit rows.parquet"])
def test_a_small_parquet_file_of_many_equal_rows_is_refused(here, capsys, command):
    columns = {name: pl.repeat("photo/1.png", 9_000_000, eager=True) for name in ("id", "vision")}
    pl.DataFrame(columns).write_parquet("rows.parquet")
    assert Path("rows.parquet").stat().st_size < 1 << 20
    mistake(capsys, "at most 256 MiB are read at once", *command.split())


def test_a_panic_of_polars_over_a_damaged_table_is_a_bad_table(here, capsys, monkeypatch):
    def panic(*args, **options):
        raise pl.exceptions.PanicException("range end index 4 out of range")

    pl.DataFrame({"id": ["a"], "text": ["b"]}).write_parquet("t.parquet")
    for name in ("read_parquet", "read_parquet_schema", "read_parquet_metadata"):
        with monkeypatch.context() as patch:
            patch.setattr(pl, name, panic)
            mistake(capsys, "t.parquet", "import", "t.parquet", "-o", "m")
