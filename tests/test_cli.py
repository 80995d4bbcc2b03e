"""The command line: statuses, JSON, one-line errors, help, and how verbs connect."""

import json
import re
import shlex
import warnings
from importlib import import_module
from pathlib import Path

import pytest
import tyro

from forge.commands import call, mistake, python
from palpate.cli import VERBS, main, terminal
from palpate.cli.terminal import CONFIG, error_line, polish_help
from palpate.core import PalpateError, Split

#: Commands whose input NONE is not there; HERE is a folder that is.
ABSENT = """import NONE -o out|validate NONE|background NONE -o out|caption NONE -o out|audit NONE
audit HERE --split NONE|audit HERE --root NONE|caption check NONE|split NONE -o out.json
train encoder NONE -o out|train autoencoder NONE -o out|train generator HERE --split NONE -o out
generate HERE --gel NONE -o out|score --generated NONE --reference HERE
score --generated HERE --reference HERE --encoder palpate/mini --split NONE|probe NONE --split HERE
probe HERE --split NONE --train|preference make --reference HERE --generated HERE NONE -o out
view NONE|preference serve NONE|preference score HERE NONE|report NONE -o out.html|verify NONE
demo --data NONE|reproduce tag --root NONE -o out|embed NONE --encoder palpate/mini -o out
run embed NONE --encoder palpate/mini -o out --slices 2"""


@pytest.fixture
def lists(tmp_path: Path) -> tuple[str, str]:
    (tmp_path / "train.txt").write_text("a/0000000001.jpg,3\nb/0000000001.jpg,4")
    (tmp_path / "test.txt").write_text("a/0000000005.jpg,3\nc/0000000001.jpg,4")
    return str(tmp_path / "train.txt"), str(tmp_path / "test.txt")


@pytest.mark.parametrize(("limit", "status"), [("0.49", 1), ("0.5", 0), ("2", 2)])
def test_fail_over_is_a_limit(capsys, lists, limit, status):
    assert call(capsys, "audit", *lists, "--fail-over", limit)[0] == status


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["audti"], "Did you mean: palpate audit"),
        (["scor", "--generated"], "Did you mean: palpate score"),
        (["train", "generatr"], "Did you mean: palpate train generator"),
        (["score"], "--generated and --reference must be given. Got none"),
        (["preference", "serve"], "PATH must be given"),
        (["audit", "a", "b", "--split"], "--split must have its values"),
        (["audit", "a", "b", "--near-frames=x"], "--near-frames must be INT. Got x"),
        (["audit", "a", "b", "--by", "tree"], "--by must be one of auto, contact, domain"),
        (["split", "a", "b", "-o", "s", "--lists", "x", "y", "z", "--folds"], "--folds must"),
        (["validate", "--formats"], "Did you mean: --format"),
        (["validate", "--listt"], "Did you mean: --list"),
        (["audit", "no.txt", "such.txt"], "no.txt"),
        (["audit", "--color", "red"], "Got --color"),
        (["split", "nowhere", "-o", "s.json"], "nowhere"),
        (["split", "nowhere", "-o", "s.json", "--train", "most"], "most"),
        (["import", "nowhere", "-o", "out"], "nowhere"),
        (["demo", "--data", "nowhere"], "nowhere"),
        (["report", "-o", "page.html"], "needs results"),
        (["world", "-o", "w", "--size", "7"], "size"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(capsys, tmp_path, monkeypatch, args, words):
    monkeypatch.chdir(tmp_path)
    mistake(capsys, words, *args)


@pytest.mark.parametrize(
    ("verb", "error", "line"),
    [
        (
            "score",
            PalpateError("must be positive", "-1", "", argument="sigma", example={"sigma": 10}),
            "--sigma must be positive. Got -1. E.g. --sigma 10",
        ),
        (
            "audit",
            PalpateError("must exist", "x", "", argument="test", example={"skip_bad": True}),
            "TEST must exist. Got x. E.g. --skip-bad",
        ),
        (
            "audit",
            PalpateError(
                "must go", "x", "Fix it", example={"images": False, "names": ["a b", "c"]}
            ),
            "must go. Got x. Fix it. E.g. --no-images --names 'a b' c",
        ),
    ],
)
def test_errors_name_options(verb, error, line):
    assert error_line(verb, error) == line


def test_help_is_wrapped_by_the_terminal_and_says_no_empty_default(capsys):
    with pytest.raises(SystemExit):
        main(["train", "generator", "--help"])
    text = " ".join(re.sub("[│╭╰─╮╯]", "", capsys.readouterr().out).split())
    assert "hub id, or palpate/mini." in text
    assert "(default: mini)" in text
    assert "(default: None)" not in text
    for verb in VERBS.values():
        options = import_module(f"palpate.cli.{verb.module}").Options
        polish_help(options)
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
            actions = tyro.extras.get_parser(options, config=CONFIG)._actions
        assert not [action.dest for action in actions if "\n" in (action.help or "")]


@pytest.mark.parametrize(
    ("argv", "arguments"),
    [
        (
            "score --generated a b --reference r --sigma 10 median --group frame",
            {"generated": ("a", "b"), "sigma": (10.0, "median"), "group": "frame"},
        ),
        (
            "import d -o m --map vision=rgb 'video=substr(rgb, 1, 2)' --map id=n --every 0",
            {"columns": {"vision": "rgb", "video": "substr(rgb, 1, 2)", "id": "n"}, "every": 0},
        ),
        ("validate d --as vision", {"source": "d", "side": "vision", "columns": None}),
        ("split a b -o s --by object session", {"paths": ("a", "b"), "by": ("object", "session")}),
        ("train encoder d -o e --device cpu", {"data": "d", "device": "cpu", "clip": None}),
        ("generate -o t.png --text soft", {"photos": None, "text": "soft", "part": "test"}),
    ],
)
def test_words_become_arguments(argv, arguments):
    words = shlex.split(argv)
    name = next(n for n in (" ".join(words[:2]), words[0]) if n in VERBS)
    options = import_module(f"palpate.cli.{VERBS[name].module}").Options
    parsed = terminal.parse(name, options, words[len(name.split()) :]).keywords()
    plain = lambda v: str(v) if isinstance(v, Path) else v
    flat = {
        k: tuple(map(plain, v)) if isinstance(v, tuple) else plain(v) for k, v in parsed.items()
    }
    assert {k: flat[k] for k in arguments} == arguments


def test_a_group_of_verbs_lists_them(capsys):
    status, out, _ = call(capsys, "train", "--help")
    assert status == 0
    assert "train encoder " in out
    assert "train generator " in out


def test_files_that_cannot_be_written_or_read_are_mistakes_too(
    capsys, lists, small_manifest, tmp_path
):
    folder = tmp_path / "m"
    small_manifest.save(folder / "manifest.parquet")
    half, odd = (tmp_path / name for name in ("half.json", "odd.json"))
    half.write_text('{"format": "palpate-split/1", "rule": {}, "digest": "x"}')
    odd.write_text(
        '{"format": "palpate-split/1", "rule": {}, "digest": "x", "parts": {"train": 3}}'
    )
    for args, words in (
        (["audit", *lists, "-o", folder], f"{folder} must be writable"),
        (["audit", *lists, "-o", lists[0] + "/x.json"], "must be"),
        (["split", folder, "-o", folder], "must not replace an input"),
        (["audit", folder, "--split", half], "an incomplete split file"),
        (["audit", folder, "--split", odd], "an incomplete split file"),
    ):
        status, _, err = call(capsys, *args)
        assert (status, words in err, "Traceback" in err) == (2, True, False), (args, err)


def test_no_output_replaces_an_input_or_a_foreign_file(capsys, lists, small_manifest, tmp_path):
    manifest, audit, notes = (tmp_path / n for n in ("m/manifest.parquet", "a.json", "notes.html"))
    small_manifest.save(manifest)
    assert call(capsys, "audit", *lists, "-o", audit)[0] == 1
    notes.write_text("my notes")
    kept = {p: p.read_bytes() for p in (*map(Path, lists), manifest, audit, notes)}
    for args in (
        ["audit", *lists, "-o", lists[0]],
        ["split", manifest.parent, "-o", manifest],
        ["report", audit, "-o", tmp_path / "a.html"],
        ["report", audit, "-o", notes],
        ["import", lists[0], "-o", tmp_path],
    ):
        assert call(capsys, *args)[0] == 2, args
    assert {p: p.read_bytes() for p in kept} == kept
    for _ in range(2):  # its own earlier output may be replaced
        assert call(capsys, "report", audit, "-o", tmp_path / "page.html", "-q")[0] == 0
        assert call(capsys, "audit", *lists, "-o", audit)[0] == 1
        assert call(capsys, "split", manifest.parent, "-o", tmp_path / "s.json")[0] == 0


def test_piped_text_keeps_digests_whole(capsys, small_manifest, tmp_path):
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    _, out, _ = call(capsys, "split", tmp_path / "m", "-o", tmp_path / "s.json")
    assert Split.load(tmp_path / "s.json").digest in out


def test_a_bug_has_its_own_status(capsys, lists, monkeypatch):
    monkeypatch.setattr("palpate.cli.audit.run", lambda *_: 1 / 0)
    status, out, err = call(capsys, "audit", *lists, "--json")
    assert status == 70
    assert "this is a bug in palpate" in err
    assert json.loads(out)["error"] == "ZeroDivisionError"


def test_a_mistake_as_json(capsys, tmp_path):
    status, out, _ = call(capsys, "audit", tmp_path / "a", tmp_path / "b", "--json")
    assert status == 2
    assert set(json.loads(out)) >= {"error", "must", "got", "fix"}


def test_bad_lines_of_both_lists_are_reported_together_or_skipped(capsys, lists):
    bad = "\nno comma here\n../../etc/passwd.jpg,3\nv/0000000007.jpg,stone\na/x.jpg,1\n"
    for path in lists:
        with open(path, "a") as file:
            file.write(bad)
    status, out, _ = call(capsys, "audit", *lists, "--json")
    assert status == 2
    places = [problem["where"].rsplit(":", 1) for problem in json.loads(out)["problems"]]
    assert {Path(file).name for file, _ in places} == {"train.txt", "test.txt"}
    assert sorted(line for _, line in places) == sorted("34563456")
    status, out, _ = call(capsys, "audit", *lists, "--json", "--skip-bad")
    data = json.loads(out)
    assert (status, data["test_samples"]) == (1, 2)
    notes = [note["params"] for note in data["notes"] if note["code"] == "rows-skipped"]
    assert sum(params["count"] for params in notes) == 8


def test_an_error_of_all_processes_is_printed_by_the_first(monkeypatch, capsys):
    def fails(name, args):
        raise error

    monkeypatch.setattr(terminal, "call_verb", fails)
    error = PalpateError("It must hold", "not", "")
    printed = []
    for first, error.shared in ((False, False), (True, True), (False, True)):
        monkeypatch.setattr(terminal, "FIRST", first)
        assert main(["split", "x"]) == 2
        printed.append(capsys.readouterr().err != "")
    assert printed == [True, True, False]


def test_an_input_that_is_not_there_is_named_before_what_takes_seconds_is_imported(tmp_path):
    commands = [line.split() for line in ABSENT.replace("\n", "|").split("|")]
    reading = {name for name, verb in VERBS.items() if name not in ("world", "presets")}
    assert reading == {name for name in VERBS for c in commands if " ".join(c).startswith(name)}
    code = f"""
import contextlib, io, sys
from palpate.cli import main
for words in {commands}:
    words = [{{"NONE": "none", "HERE": "."}}.get(word, word) for word in words]
    error = io.StringIO()
    with contextlib.redirect_stderr(error):
        assert main(words) == 2, words
    assert "othing at none" in error.getvalue(), (words, error.getvalue())
    heavy = {{"scipy", "polars", "torch", "starlette"}} & {{*sys.modules}}
    assert not heavy, (words, heavy)
"""
    python(code, cwd=tmp_path)
    assert not list(tmp_path.iterdir())
