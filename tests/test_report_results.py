"""Results and audits as objects: indexing, frames, files, the command."""

import json
import shutil
from pathlib import Path

import pytest

from forge.results import full_audit, full_results, images, score, small_audit
from palpate.cli import main
from palpate.core import PalpateError
from palpate.report.records import LeakPair
from palpate.report.results import Audit, Results


def test_results_are_a_table_of_scores():
    paper = score(value=2.0, settings={"preset": "paper"})
    results = Results("T", scores=[score(subject="a"), score("FID", "b"), paper])
    assert len(results) == 3
    assert [s.metric for s in results] == ["TMMD", "FID", "TMMD"]
    assert [float(s) for s in results["TMMD"]] == [1.374, 2.0]
    assert results[1].metric == "FID"
    assert float(results["TMMD", "a"]) == 1.374
    assert float(results["TMMD", "a", "paper"]) == 2.0
    with pytest.raises(KeyError, match="there is TMMD, a; FID, b"):
        results["TMMD", "b"]
    assert results
    frame = Results("T", scores=[score(), score(value=None, interval=None)]).to_frame()
    assert frame["interval_low"].to_list() == [1.01, None]
    assert frame["value"].to_list() == [1.374, None]
    assert "&lt;b&gt;" in Results("T", scores=[score(subject="<b>")])._repr_html_()
    assert "<pre" in small_audit()._repr_html_()


def test_results_and_audits_come_back_from_their_files(tmp_path):
    results = full_results(tmp_path)
    results.save(tmp_path / "r.json")
    again = Results.load(tmp_path / "r.json")
    assert again.scores == list(results.scores)
    audit = full_audit(images(tmp_path, 4, 16), others=[small_audit()], table="a frame")
    audit.save(tmp_path / "a.json")
    loaded = Audit.load(tmp_path / "a.json")
    assert loaded.to_json() == audit.to_json()
    assert isinstance(loaded.signals[0].worst[0], LeakPair)
    assert "table" not in json.loads((tmp_path / "a.json").read_text())
    assert audit.to_frame() == "a frame"
    with pytest.raises(PalpateError, match="has just run"):
        loaded.to_frame()


def test_image_paths_in_a_file_are_relative_to_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    results = full_results(tmp_path / "run").with_paths(lambda name: f"run/{name}")
    results.save("run/r.json")
    assert json.loads(Path("run/r.json").read_text())["gallery"][0]["generated"] == "generated0.png"
    shutil.move("run", "moved")
    again = Results.load("moved/r.json")
    assert Path(again.gallery[0].generated) == Path("moved/generated0.png")
    again.to_html("page.html")
    assert "data:image/webp" in Path("page.html").read_text()


def test_the_command_merges_files_of_results_and_audits(capsys, tmp_path):
    full_audit(images(tmp_path, 8, 32), others=[small_audit()]).save(tmp_path / "audit.json")
    Results("S", scores=[score(split="b" * 64)]).save(tmp_path / "scores.json")
    inputs = [str(tmp_path / name) for name in ("audit.json", "scores.json")]
    assert main(["report", *inputs, "-o", str(tmp_path / "page.html"), "-q"]) == 0
    merged = Results.load(tmp_path / "page.json")
    assert len(merged.audits) == 2
    assert [note.code for note in merged.notes] == ["other-split"]
    assert "No audit on this page is of the split" in (tmp_path / "page.html").read_text()
    again = ["report", str(tmp_path / "page.json"), "-o", str(tmp_path / "again.html"), "--json"]
    assert main(again) == 0
    assert json.loads(capsys.readouterr().out.partition("\n{")[2].join(["{", ""]))["page"]
