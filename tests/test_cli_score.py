"""``palpate score`` and ``palpate probe``: one call, tables and files; errors in one line."""

import errno
import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from forge import commands
from forge.pictures import paint
from forge.scores import IDS, LABELS, by_key, feature_sets
from palpate.cli import main
from palpate.core import Split
from palpate.evaluation import scoring
from palpate.report.labels import label_of, subject_of
from palpate.report.results import Results

PAIR = "--generated near.npz --reference real.npz --companions none --permutations 0"


@pytest.fixture
def sets(tmp_path, monkeypatch):
    """``real``, ``near`` and ``far`` as .npz and .npy in the working directory."""
    monkeypatch.chdir(tmp_path)
    made = feature_sets()
    for name, features in made.items():
        features.save(Path(f"{name}.npz"))
        np.save(f"{name}.npy", features.features)
    return made


def call(capsys, *args, verb="score"):
    return commands.call(capsys, verb, *(word for arg in args for word in shlex.split(str(arg))))


def run(*args, **options):
    command = [sys.executable, "-m", "palpate", "score", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def test_options_reach_the_function_and_json_is_its_result(capsys, sets):
    Path("labels.csv").write_text(
        "id,material\n" + "".join(f"{i},{m}\n" for i, m in zip(IDS, LABELS, strict=True))
    )
    Split.from_ids(train=IDS[24:], test=IDS[:24], rule={}, manifest="m").save(Path("s.json"))
    options = ("--sigma", "10", "median", "--normalize", "yes", "--presets", "paper")
    files = ("--labels", "labels.csv", "--split", "s.json")
    named = PAIR.replace("near", "ours=near")
    status, out, err = call(capsys, named, *options, *files, "--json")
    assert status == 0, err
    scores = by_key(Results.from_json(json.loads(out)))
    want = scoring.score(
        "near.npz",
        "real.npz",
        names=["ours"],
        labels="labels.csv",
        split="s.json",
        sigma=[10, "median"],
        normalize=True,
        presets=["paper"],
        companions=[],
        permutations=0,
    )
    assert {k: s.value for k, s in scores.items()} == {k: s.value for k, s in by_key(want).items()}
    assert json.loads(out)["commands"][0].startswith("palpate score --generated ours=near.npz")


def test_the_terminal_shows_scores_and_differences(capsys, sets):
    files = "--generated 'ours [x]=near.npz' theirs=far.npz --reference real.npz"
    status, out, err = call(capsys, files)
    assert status == 0, err
    head, tail = out.split("Paired differences", 1)
    assert "ours [x]" in head
    assert "floor" in head
    row = next(line for line in tail.splitlines() if line.startswith("TMMD ↓"))
    assert "> 99.9 %" in row


def test_scores_of_embeddings_and_pixels_load_no_torch_and_make_a_page(sets):
    for seed, name in enumerate(("pixels", "a", "b")):
        paint(Path(name), ["1", "2", "3"], seed)
    code = """
import sys
from palpate.cli import main
for line in (
    "score --generated near.npz far.npz --reference real.npz -q -o s.json --page p.html",
    "report s.json -o page.html -q",
    "score --generated a b --reference pixels --companions ssim psnr ms-ssim",
):
    assert main(line.split()) == 0
    assert not {"torch", "transformers", "safetensors"} & set(sys.modules)
"""
    assert "MS-SSIM" in commands.python(code)
    scores = Results.load(Path("s.json")).scores
    assert {subject_of(s) for s in scores} == {"near", "far", "near - far"}
    assert "TMMD" in Path("p.html").read_text()
    assert Path("page.html").is_file()
    assert Path("p.json").is_file()


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (f"{PAIR} --sigma ten", "--sigma must be NUMBER|median|multi"),
        ("--generated a=near.npz a=far.npz --reference real.npz", "--generated must differ"),
        (f"{PAIR} --group contact", "--group must be known for every input"),
        (f"{PAIR} --encoder palpate/mini", "--encoder must go with images"),
        (f"{PAIR} --labels absent.csv", "absent.csv"),
        (f"{PAIR} --companions none fid", "--companions must be none, or names"),
        ("--generated near.npz --reference nowhere", "nothing at nowhere"),
        (f"{PAIR} -o near.npz", "must not replace an input"),
        (f"{PAIR} -o folder", "folder must be writable"),
        (f"{PAIR} -o mine", "mine must be new"),
        (f"{PAIR} --page mine", "--page must end in .html"),
        (f"{PAIR} --cache real.npz", "--cache must not be an input"),
    ],
)
def test_mistakes_are_one_line_with_status_2(capsys, sets, args, words):
    Path("folder").mkdir()
    Path("mine").write_text("mine")
    commands.mistake(capsys, words, "score", *args.split(), "-q")


def test_a_full_disk_loses_no_scores(capsys, sets, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "o.json")

    monkeypatch.setattr(Results, "save", fail)
    status, out, err = call(capsys, PAIR, "-o", "o.json", "-q")
    assert (status, "TMMD" in out, "The disk must have room for o.json" in err) == (2, True, True)


def test_a_killed_run_goes_on_from_its_embeddings_and_leaves_no_cache(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("real", "made")):
        paint(Path(name), map(str, range(60)), seed)
    command = "score --generated made --reference real --encoder palpate/mini -o s.json -q"
    args = [*command.split(), "--companions", "none", "--presets", "paper", "--permutations"]
    process = subprocess.Popen([sys.executable, "-m", "palpate", *args, "200000"])
    cache, deadline = Path(".s.json.work"), time.monotonic() + 60
    while len([*cache.rglob("tactile-*.npy")]) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.wait()
    stamps = {p: p.stat().st_mtime_ns for p in cache.rglob("tactile-*.npy")}
    assert len(stamps) == 2
    assert main([*args, "0", "--cache", str(cache)]) == 0
    assert {p: p.stat().st_mtime_ns for p in cache.rglob("tactile-*.npy")} == stamps
    assert main([*args, "0"]) == 0
    assert not cache.exists()


def test_probe_scores_material_and_retrieval(capsys, tmp_path, small_manifest):
    pytest.importorskip("torch")
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    ids = small_manifest.ids
    split = Split.from_ids(
        train=ids[:24], test=ids[24:], rule={"group": "video"}, manifest=small_manifest.digest
    )
    split.save(tmp_path / "s.json")
    args = ("--split", tmp_path / "s.json", "--encoder", "palpate/mini", "-o", tmp_path / "p.json")
    status, out, err = call(capsys, tmp_path / "m", *args, verb="probe")
    assert status == 0, err
    results = Results.load(tmp_path / "p.json")
    assert [label_of(s) for s in results.scores] == [
        *("material accuracy", "material accuracy, balanced"),
        *("material accuracy, 20-NN", "material accuracy, 20-NN, balanced"),
        *(f"top-{k} of 24 (vision by tactile)" for k in (1, 5, 10)),
        *(f"top-{k} of 24 (tactile by vision)" for k in (1, 5, 10)),
        "median rank of 24 (vision by tactile)",
        "median rank of 24 (tactile by vision)",
    ]
    assert results.scores[0].details["chance"] == pytest.approx(1 / 3)
    assert results.settings["options"]["group"] == "video"
    assert "material accuracy" in out
    assert "majority" in out


def test_verify_counts_says_what_differs_or_was_not_checked_and_exits_1_or_3(capsys, sets):
    assert call(capsys, PAIR, "-o", "s.json", "-q")[0] == 0
    status, out, err = call(capsys, "s.json", verb="verify")
    assert (status, err) == (0, "")
    scores = len(json.loads(Path("s.json").read_text())["scores"])
    assert out == f"same {scores + 1}, differs 0, cannot check 0\n"
    data = json.loads(Path("s.json").read_text())
    data["scores"][0]["value"] = 0.0
    Path("s.json").write_text(json.dumps(data))
    status, out, err = call(capsys, "s.json", "--json", verb="verify")
    assert (status, json.loads(out)["counts"]["differs"]) == (1, 1)
    status, out, err = call(capsys, "s.json", verb="verify")
    count, line = out.splitlines()
    assert "differs 1," in count
    assert line.startswith("differs: TMMD of near (grouped): value 0 in the file, ")
    Path("near.npz").unlink()
    status, out, err = call(capsys, "s.json", verb="verify")
    count, line, why = out.splitlines()
    assert (status, err) == (3, "")
    assert line == f"cannot tell: {scores + 1} of {scores + 1} could not be checked"
    assert "nothing at near.npz" in why


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "must be a JSON object"),
        ('{"format": "palpate-split/1"}', "must have the format palpate-results/1"),
        ('{"format": "palpate-results/1", "title": "", "calls": [3]}', "must be as palpate writes"),
        ('{"format": "palpate-results/1", "title": "", "calls": [{"verb": 1}]}', "must be as"),
    ],
)
def test_verify_says_in_one_line_that_a_file_is_no_results(capsys, sets, text, words):
    Path("x.json").write_text(text)
    commands.mistake(capsys, words, "verify", "x.json")
