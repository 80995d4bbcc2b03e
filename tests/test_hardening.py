"""Inputs that once ended in a traceback, destroyed a file or showed too much: each a line, exit 2.

The fuzzer (``tests/fuzz``) finds such inputs; here stay those that were found, one a row.
"""

import json
import os
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from forge.pictures import write_image
from forge.results import full_audit
from palpate.cli import main
from palpate.cli.terminal import working_folder
from palpate.core import PalpateError, atomic_folder, atomic_path, locked
from palpate.data.manifest import Manifest

INDEX = '{"format": "palpate-generated/1", "complete": true, "settings": {}, "digest": "x", '
RESULTS = '{"format": "palpate-results/1", "title": "t"%s}'


def audit_with(**fields):
    """A file of an audit, of which some fields are others."""
    return json.dumps(full_audit().to_json() | fields)


def zip_named_npy(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a", "b")


def bomb_of_zeros(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        header = np.lib.format.header_data_from_array_1_0(np.zeros((1, 64), "f4"))
        with file.open("features.npy", "w") as entry:
            np.lib.format.write_array_header_1_0(entry, header | {"shape": (5 << 18, 64)})
            for _ in range(5):
                entry.write(bytes(1 << 26))


def whole_manifest(path: Path) -> None:
    rows = [{"id": i, "video": i, "text": i} for i in "ab"]
    Manifest.from_rows(rows, path.parent).save(path)


def typed_manifest(path: Path) -> None:
    """A manifest whose columns have other types than palpate writes."""
    Manifest.from_rows([{"id": "a", "vision": "a.jpg"}], path.parent).save(path)
    with open(path, "rb") as file:
        metadata = pl.read_parquet_metadata(file)
    table = pl.read_parquet(path).with_columns(pl.lit(1).alias("vision"))
    table.write_parquet(path, metadata=metadata)


@pytest.mark.parametrize(
    ("name", "content", "command", "words"),
    [
        ("a.npy", zip_named_npy, "score --generated a.npy --reference a.npy", "named .npz"),
        ("a.npz", bomb_of_zeros, "score --generated a.npz --reference a.npz", "unpacks to 0.3 GB"),
        *(
            (name, os.mkfifo, command, "a pipe or a device")
            for name, command in (
                ("p.txt", "audit p.txt p.txt"),
                ("p.parquet", "validate p.parquet"),
                ("p.parquet", "background p.parquet -o o"),
                ("p.json", "report p.json -o page.html"),
                ("p.npy", "score --generated p.npy --reference p.npy"),
            )
        ),
        ("p.jpg", os.mkfifo, "generate p.jpg -o t.png", "an image that can be read"),
        ("v/a.npy", os.mkfifo, "import v --tactile {video}.npy -o m", "1 bad-video"),
        *(
            ("g/index.json", INDEX + f'"skipped": [], "images": {images}}}', command, words)
            for command in ("score --generated g --reference g", "generate a.jpg -o g")
            for images, words in (
                ('{"a": 3}', "images of type int"),
                ('{"a": Infinity}', "not JSON compliant"),
                ('{"a": "\\ud800"}', "surrogates not allowed"),
                ("3", "images of type int"),
            )
        ),
        *(
            ("r.json", RESULTS % fields, "report r.json -o p.html", words)
            for fields, words in (
                (', "facts": 3', "facts of type int"),
                (', "scores": [{"metric": "m", "a": "s"}]', "'value'"),
                (', "scores": [{"metric": "m", "a": "s", "value": "high"}]', "of type str"),
                (', "audits": [3]', "audits that holds no object"),
                (', "wrong": 3', "unknown field wrong"),
            )
        ),
        *(
            ("r.json", text, "report r.json -o p.html", words)
            for text, words in (
                ('{"format": "palpate-results/1", "title": 3}', "title"),
                (audit_with(format="other"), "must have the format palpate-results/1"),
                (audit_with(new=1), "new"),
                (audit_with(signals=5), "int"),
                (audit_with(others=[{"name": "x"}]), "missing"),
                (audit_with(impact={"rows": []}), "headline"),
            )
        ),
        ("a.txt", "", "audit a.txt b\udcff.txt", "must be UTF-8"),
        ("a.txt", "", ["audit", "a.txt", ""], "not empty"),
        ("m/manifest.parquet", typed_manifest, "split m -o s.json", "must have the format"),
        *(
            ("m/manifest.parquet", whole_manifest, f"{command} m/manifest.parquet", words)
            for command, words in (
                ("caption check m --output", "must not replace an input"),
                ("audit m m --no-images -o", "must not replace an input"),
                ("audit a.jpg a.jpg -o", "must be new"),
            )
        ),
    ],
)
def test_a_broken_input_is_one_line(name, content, command, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_image(tmp_path / "a.jpg", 1)
    Path(name).parent.mkdir(exist_ok=True)
    content(Path(name)) if callable(content) else Path(name).write_text(content)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    args = command.split() if isinstance(command, str) else command
    assert main([*args, "-q"]) == 2
    message, *listed = capsys.readouterr().err.splitlines()
    assert words in message
    assert all(line.startswith("  ") for line in listed)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_line_break_in_a_name_does_not_break_the_message(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["audit", "a\n\x1b[2J", "b"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_long_caption_is_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_image(tmp_path / "a.jpg", 1)
    Path("rows.csv").write_text(f"id,vision,tactile,text\na,a.jpg,a.jpg,{'x' * 200_000}\n")
    main(["import", "rows.csv", "-o", "m", "-q"])
    assert "field limit" not in capsys.readouterr().err


def test_a_device_is_written_to_and_stays(tmp_path):
    device, out = tmp_path / "null", tmp_path / "out"
    try:
        os.mknod(device, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only root makes devices")
    for k in range(2):
        write_image(tmp_path / "a" / f"{k}.jpg", k)
    folder = str(tmp_path / "a")
    assert main(["audit", folder, folder, "-o", str(device), "-q"]) in (0, 1)
    np.save(tmp_path / "x.npy", np.eye(4))
    vectors = str(tmp_path / "x.npy")
    args = ["score", "--generated", vectors, "--reference", vectors, "--permutations", "0"]
    assert main([*args, "-o", str(device), "-q"]) in (0, 2)
    assert stat.S_ISCHR(device.stat().st_mode)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "null", "x.npy"]
    assert not out.exists()


def test_a_pipe_is_written_to_and_a_link_stays(tmp_path):
    pipe, link, target = tmp_path / "pipe", tmp_path / "link", tmp_path / "target"
    os.mkfifo(pipe)
    with subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE) as reader:
        with atomic_path(pipe) as part:
            part.write_text("whole")
        assert reader.communicate()[0] == b"whole"
    reading, writing = os.pipe()  # without a name: the shell's | and >()
    with atomic_path(Path(f"/dev/fd/{writing}")) as part:
        part.write_text("whole")
    assert os.read(reading, 9) == b"whole"
    os.close(reading)
    os.close(writing)
    link.symlink_to(target)
    with atomic_path(link) as part:
        part.write_text("whole")
    assert (link.is_symlink(), target.read_text()) == (True, "whole")


def test_two_runs_do_not_share_a_folder_and_a_killed_one_does_not_block(tmp_path):
    folder = tmp_path / "out"
    with atomic_folder(folder) as part:
        (part / "first").touch()
        with pytest.raises(PalpateError, match="another run"):
            atomic_folder(folder).__enter__()
    assert [p.name for p in folder.iterdir()] == ["first"]
    code = "from palpate.core import locked; from pathlib import Path; import sys\n"
    code += "with locked(Path(sys.argv[1])): print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(PalpateError, match="another run"):
            locked(folder).__enter__()
        other.kill()
        other.wait()
    with locked(folder):
        pass


def test_two_commands_do_not_resume_from_one_folder(tmp_path):
    output = tmp_path / "scores.json"
    with working_folder(None, output) as folder:
        (folder / "half").touch()
        with pytest.raises(PalpateError, match=r"scores\.json must be written by one run"):
            working_folder(None, output).__enter__()
        with working_folder(tmp_path / "cache", output) as cache:  # of its own, by content
            assert cache == tmp_path / "cache"
    assert list(tmp_path.iterdir()) == []
    stopped = working_folder(None, output)
    (stopped.__enter__() / "half").touch()
    assert not stopped.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    with working_folder(None, output) as folder:
        assert [p.name for p in folder.iterdir()] == ["half"]


def test_what_a_killed_run_left_is_replaced(tmp_path):
    (tmp_path / ".out.part").mkdir()
    (tmp_path / ".out.part" / "half").touch()
    with atomic_folder(tmp_path / "out") as part:
        (part / "whole").touch()
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["whole"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_the_current_folder_is_rejected_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["split", "nowhere", "--folds", "2", "-o", "."]) == 2
    write_image(tmp_path / "m" / "a.jpg", 1)
    Manifest.from_rows([{"id": "a", "vision": "a.jpg"}], Path("m")).save(Path("m/manifest.parquet"))
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert main(["split", "../m", "--folds", "2", "-o", "."]) == 2
    assert "the current folder" in capsys.readouterr().err


def test_a_report_shows_no_image_outside_the_folder_of_its_results(tmp_path, capsys):
    write_image(tmp_path / "secret.jpg", 7)
    write_image(tmp_path / "results" / "mine.jpg", 8)
    sample = {"id": "a", "vision": "../secret.jpg", "tactile": "mine.jpg"}
    gallery = json.dumps([{"sample": sample, "generated": str(tmp_path / "secret.jpg")}])
    path = tmp_path / "results" / "r.json"
    path.write_text(RESULTS % f', "gallery": {gallery}')
    shown = []
    for k, more in enumerate(([], ["--images", str(tmp_path)])):
        page = tmp_path / f"page{k}.html"
        assert main(["report", str(path), "-o", str(page), "-q", *more]) == 0
        shown.append(page.read_text().count("data:image/"))
    assert shown == [1, 3]


def test_ctrl_c_while_libraries_load_is_no_traceback(monkeypatch, capsys):
    class Loading(dict):
        def __getattr__(self, name):
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "palpate.cli.terminal", Loading())
    assert main(["audit", "a", "b"]) == 130
    assert capsys.readouterr().err.strip().startswith("palpate: stopped")


@pytest.mark.parametrize(
    ("variable", "words"),
    [
        ("SOURCE_DATE_EPOCH=x", "must be a number under 2**32, as libraries need it. Got x."),
        ("SOURCE_DATE_EPOCH=99999999999", "SOURCE_DATE_EPOCH must be a number under 2**32"),
        ("PYTHONOPTIMIZE=2", "PYTHONOPTIMIZE must be 0 or 1, as libraries need it. Got 2."),
    ],
)
def test_a_variable_that_breaks_libraries_is_one_line(variable, words):
    name, value = variable.split("=")
    command = [sys.executable, "-m", "palpate", "validate", "nothing"]
    done = subprocess.run(
        command, env=os.environ | {name: value}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("verb", ["train encoder", "train autoencoder", "train generator"])
def test_a_tracker_that_is_not_installed_is_answered_before_anything_is_read(
    verb, monkeypatch, capsys
):
    monkeypatch.setattr("palpate.training.options.find_spec", lambda name: None)
    assert main([*verb.split(), "no-data", "-o", "o", "--trackers", "tensorboard"]) == 2
    error = capsys.readouterr().err
    assert "--trackers must be installed. Got tensorboard. pip install tensorboard" in error
