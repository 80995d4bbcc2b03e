"""The command line: statuses, JSON, one-line errors, and the facts of the official lists."""

import json
from pathlib import Path

import pytest

from palpate.cli import main
from palpate.core import Split


@pytest.fixture
def lists(tmp_path: Path) -> tuple[str, str]:
    (tmp_path / "train.txt").write_text("a/0000000001.jpg,3\nb/0000000001.jpg,4")
    (tmp_path / "test.txt").write_text("a/0000000005.jpg,3\nc/0000000001.jpg,4")
    return str(tmp_path / "train.txt"), str(tmp_path / "test.txt")


def call(capsys, *args):
    status = main([str(a) for a in args])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_official_lists_give_the_published_facts(capsys, real_data):
    place = real_data / "touch_and_go" / "lists"
    status, out, _ = call(
        capsys, "audit", place / "train.txt", place / "test.txt", "--json", "--fail-over", "0.01"
    )
    facts = json.loads(out)
    wanted = {
        "test_samples": 29879,
        "groups_train": 120,
        "groups_test": 106,
        "groups_shared": 100,
        "test_samples_in_shared_groups": 29597,
        "leaked_fraction": 0.99056,
        "gap_min": 31,
        "gap_median": 304,
        "gap_max": 2485,
        "identical_samples": 0,
    }
    assert {name: facts[name] for name in wanted} == wanted
    assert (status, facts["failed"]) == (1, True)


def test_fail_over_is_a_limit_not_a_switch(capsys, lists):
    assert call(capsys, "audit", *lists)[0] == 0
    assert call(capsys, "audit", *lists, "--fail-over", "0.49")[0] == 1
    assert call(capsys, "audit", *lists, "--fail-over", "0.5")[0] == 0
    assert call(capsys, "audit", *lists, "--fail-over", "2")[0] == 2


def test_text_output_has_every_count(capsys, lists):
    _, out, _ = call(capsys, "audit", *lists)
    for line in (
        "50.0 % of the test samples share a video with train",
        "1 of 3 video groups are shared",
        "gap to the nearest train frame of the video: 4 to 4 frames, median 4",
    ):
        assert line in out, out


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["audti"], "Did you mean: palpate audit"),
        (["audit", "one.txt"], "TRAIN and TEST"),
        (["audit", "no.txt", "such.txt"], "nothing at no.txt"),
        (["audit", "--color", "red"], "Unrecognized"),
        (["split", "nowhere", "-o", "s.json"], "nothing at nowhere"),
        (["split", "nowhere", "-o", "s.json", "--train", "most"], "most"),
        (["import", "nowhere", "-o", "out"], "nothing at nowhere"),
        (["import", ".", "-o", "out", "--map", "vision"], "as COLUMN=EXPRESSION"),
        (["demo", "--data", "nowhere"], "nowhere"),
        (["report", "-o", "page.html"], "needs results"),
        (["generate", "-o", "out"], "photos or --manifest"),
        (["world", "-o", "w", "--size", "7"], "size"),
    ],
)
def test_a_users_mistake_is_one_line_and_status_2(capsys, tmp_path, monkeypatch, args, word):
    monkeypatch.chdir(tmp_path)
    status, out, err = call(capsys, *args)
    assert status == 2
    lines = [line for line in err.splitlines() if line.startswith("palpate ")]
    assert len(lines) == 1
    assert word in lines[0]
    assert "Traceback" not in err
    assert out == ""


def test_files_that_cannot_be_written_or_hold_rubbish_are_mistakes_too(
    capsys, lists, small_manifest, tmp_path
):
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    (tmp_path / "half.json").write_text('{"format": "palpate-split/1", "rule": {}, "digest": "x"}')
    (tmp_path / "odd.json").write_text(
        '{"format": "palpate-split/1", "rule": {}, "digest": "x", "parts": {"train": 3}}'
    )
    (tmp_path / "scores.json").write_text(
        '{"format": "palpate-results/2", "title": "t", "scores": [{"metric": "m", "subject": "s", "value": "high"}]}'
    )
    for args, word in (
        (["audit", *lists, "-o", tmp_path / "m"], f"{tmp_path / 'm'} must be writable"),
        (["audit", *lists, "-o", lists[0] + "/x.json"], "must be"),
        (["split", tmp_path / "m", "-o", tmp_path / "m"], "must not replace an input"),
        (["audit", tmp_path / "m", "--split", tmp_path / "half.json"], "an incomplete split file"),
        (["audit", tmp_path / "m", "--split", tmp_path / "odd.json"], "an incomplete split file"),
        (
            ["report", tmp_path / "scores.json", "-o", tmp_path / "p.html"],
            "must hold complete results",
        ),
        (["audit", *lists, "--worst", "-1"], "--worst must be at least 0"),
        (
            [
                "train",
                "encoder",
                tmp_path / "m",
                "--split",
                tmp_path / "half.json",
                "-o",
                tmp_path / "t",
                "--epochs",
                "nan",
            ],
            "--epochs must be",
        ),
    ):
        status, _, err = call(capsys, *args)
        assert (status, word in err, "Traceback" in err) == (2, True, False), (args, err)


def test_no_output_replaces_an_input_or_a_foreign_file(capsys, lists, small_manifest, tmp_path):
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    assert call(capsys, "audit", *lists, "-o", tmp_path / "a.json")[0] == 0
    (tmp_path / "notes.html").write_text("my notes")
    kept = {
        p: p.read_bytes()
        for p in (
            *map(Path, lists),
            tmp_path / "m" / "manifest.parquet",
            tmp_path / "a.json",
            tmp_path / "notes.html",
        )
    }
    for args in (
        ["audit", *lists, "-o", lists[0]],
        ["split", tmp_path / "m", "-o", tmp_path / "m" / "manifest.parquet"],
        ["report", tmp_path / "a.json", "-o", tmp_path / "a.html"],
        ["report", tmp_path / "a.json", "-o", tmp_path / "notes.html"],
        ["import", lists[0], "-o", tmp_path],
    ):
        assert call(capsys, *args)[0] == 2, args
    assert {p: p.read_bytes() for p in kept} == kept
    for _ in range(2):  # its own earlier output may be replaced
        assert (
            call(capsys, "report", tmp_path / "a.json", "-o", tmp_path / "page.html", "-q")[0] == 0
        )
        assert call(capsys, "audit", *lists, "-o", tmp_path / "a.json")[0] == 0
        assert call(capsys, "split", tmp_path / "m", "-o", tmp_path / "s.json")[0] == 0


def test_a_page_whose_audit_is_of_another_split_says_so(capsys, lists, tmp_path):
    score = {"metric": "TMMD", "subject": "x", "value": 1.0, "split": "b" * 64}
    (tmp_path / "r.json").write_text(
        json.dumps({"format": "palpate-results/2", "title": "t", "scores": [score]})
    )
    assert call(capsys, "audit", *lists, "-o", tmp_path / "a.json")[0] == 0
    assert (
        call(
            capsys,
            "report",
            tmp_path / "a.json",
            tmp_path / "r.json",
            "-o",
            tmp_path / "p.html",
            "-q",
        )[0]
        == 0
    )
    assert "No audit on this page is of the split" in (tmp_path / "p.html").read_text()


def test_piped_text_keeps_digests_whole(capsys, small_manifest, tmp_path):
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    _, out, _ = call(capsys, "split", tmp_path / "m", "-o", tmp_path / "s.json")
    assert Split.load(tmp_path / "s.json").digest in out


def test_a_bug_of_ours_has_a_status_of_its_own(capsys, lists, monkeypatch):
    monkeypatch.setattr("palpate.cli.terminal.Terminal.show", lambda *_: 1 / 0)
    status, _, err = call(capsys, "audit", *lists)
    assert status == 70
    assert "this is a bug in palpate" in err


def test_worst_counts_pairs_of_lists_as_well(capsys, lists):
    assert len(json.loads(call(capsys, "audit", *lists, "--json", "--worst", "0")[1])["worst"]) == 0
    assert len(json.loads(call(capsys, "audit", *lists, "--json")[1])["worst"]) == 1


def test_a_mistake_as_json(capsys, tmp_path):
    status, out, _ = call(capsys, "audit", tmp_path / "a", tmp_path / "b", "--json")
    assert status == 2
    assert set(json.loads(out)) >= {"error", "must", "got", "fix"}


def test_bad_lines_of_both_lists_are_told_at_once_or_skipped(capsys, lists):
    for path in lists:
        with open(path, "a") as file:
            file.write(
                "\nno comma here\n../../etc/passwd.jpg,3\nv/0000000007.jpg,stone\na/x.jpg,1\n"
            )
    status, out, err = call(capsys, "audit", *lists, "--json")
    assert status == 2
    problems = json.loads(out)["problems"]
    assert len(problems) == 8
    assert {Path(p["where"].rsplit(":", 1)[0]).name for p in problems} == {"train.txt", "test.txt"}
    assert {p["where"].rsplit(":", 1)[1] for p in problems} == {"3", "4", "5", "6"}
    status, out, err = call(capsys, "audit", *lists, "--json", "--skip-bad")
    data = json.loads(out)
    assert (status, data["test_samples"]) == (0, 2)
    counts = [n["params"]["count"] for n in data["notes"] if n["code"] == "rows-skipped"]
    assert counts == [4, 4]


def test_split_of_a_manifest_then_audit_then_report(capsys, small_manifest, tmp_path):
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    split = tmp_path / "s.json"
    status, out, _ = call(capsys, "split", tmp_path / "m", "-o", split, "--train", "0.5", "--json")
    facts = json.loads(out)
    assert (status, facts["group"]) == (0, "video")
    assert facts["deviation"] == 0.0
    status, out, _ = call(
        capsys,
        "audit",
        tmp_path / "m",
        "--split",
        split,
        "--json",
        "--fail-over",
        "0",
        "-o",
        tmp_path / "audit.json",
    )
    assert status == 0, out
    assert json.loads(out)["groups_shared"] == 0
    status, out, _ = call(
        capsys, "report", tmp_path / "audit.json", "-o", tmp_path / "page.html", "--json", "-q"
    )
    assert status == 0
    assert "NoLeak" in (tmp_path / "page.html").read_text()
    again = call(capsys, "report", tmp_path / "page.json", "-o", tmp_path / "again.html", "-q")
    assert again[0] == 0


def test_report_refuses_foreign_json(capsys, tmp_path):
    (tmp_path / "x.json").write_text('{"format": "other"}')
    assert (
        "must have the format palpate-results/2"
        in call(capsys, "report", tmp_path / "x.json", "-o", tmp_path / "p.html")[2]
    )
    (tmp_path / "x.json").write_text('{"format": "palpate-audit/2", "name": "x"}')
    assert (
        "missing or unknown field"
        in call(capsys, "report", tmp_path / "x.json", "-o", tmp_path / "p.html")[2]
    )
    assert not (tmp_path / "p.html").exists()
