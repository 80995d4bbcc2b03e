"""A small study: what its stages read and write; killed in each kind of stage; two processes."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.numpy import load_file

from forge import studies as small_study
from palpate.core import PalpateError, Score, Split, digest_file, digest_json, short
from palpate.evaluation.scorers import Weights
from palpate.report.records import Claim, StudyTable
from palpate.report.results import Results
from palpate.studies.files import read_scores
from palpate.studies.graph import digests_of
from palpate.studies.methods import OURS
from palpate.studies.names import SPLITS
from palpate.studies.reproduce import Plan, run_study
from palpate.studies.study import STUDIES

GOLDEN = Path(__file__).parent / "golden" / "study_stages.json"
#: What holds no times.
KEPT = ("*.png", "*.safetensors", "*.npz", "*.parquet", "scores.json", "results.json", "*.jpg")


def kind_of(node) -> str:
    """What builds a node: ``make_encoders`` for that of every split and seed."""
    return node.call.__name__


NODES = small_study.plan().nodes()
KINDS = list(dict.fromkeys(map(kind_of, NODES)))


def outcome(run):
    """The bytes of what a run is judged by."""
    stages = (run / node.name for node in NODES)
    files = {p for folder in stages for pattern in KEPT for p in folder.rglob(pattern)}
    return {p.relative_to(run).as_posix(): p.read_bytes() for p in files}


def differing(run, other):
    """Names of the files that are not the same in two runs."""
    a, b = outcome(run), outcome(other)
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))


# --- what stages read: cheap


def digests(study: str, preset: str) -> dict[str, str]:
    """Kind of stage -> digest over what each of them reads."""
    nodes, of_kind = Plan(STUDIES[study], preset=preset).nodes(), {}
    read = digests_of(nodes)
    for node in nodes:
        of_kind.setdefault(kind_of(node), []).append(read[node.name])
    return {kind: short(digest_json(values)) for kind, values in of_kind.items()}


def golden(part, now):
    """The committed values; with PALPATE_GOLDEN=write these ones are written in their place."""
    known = json.loads(GOLDEN.read_text()) if GOLDEN.is_file() else {}
    if os.environ.get("PALPATE_GOLDEN") == "write":
        GOLDEN.write_text(json.dumps(known | {part: now}, indent=1, sort_keys=True) + "\n")
        return now
    return known[part]


WRITE = "then run: PALPATE_GOLDEN=write pytest tests/test_studies_runs.py -k golden"


@pytest.mark.parametrize("study", ["world-gelsight", "world-digit"])
@pytest.mark.parametrize("preset", ["smoke", "mini"])
def test_golden_what_stages_read(study, preset):
    now = digests(study, preset)
    known = golden(f"{study} {preset}", now)
    changed = [kind for kind in now if now[kind] != known.get(kind)]
    assert not changed, (
        f"What {', '.join(changed)} read has changed: with this release every run builds them "
        f"again. If that is meant, {WRITE}"
    )


def inception(path, seed=0):
    """A file that is called as that of Inception is."""
    torch.manual_seed(seed)

    class Pooled(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.conv = torch.nn.Conv2d(3, 4, 3)

        def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
            return self.conv(img.to(torch.float32) / 127.5 - 1).relu().mean(dim=[2, 3])

    torch.jit.script(Pooled().eval()).save(str(path))
    return path


def test_published_weights_are_read_by_what_judges_alone(tmp_path):
    def read(**weights):
        return digests_of(Plan(small_study.STUDY, "tiny", weights=Weights(**weights)).nodes())

    file, other = inception(tmp_path / "a.pt"), inception(tmp_path / "b.pt", seed=1)
    trusted = {"trust_torchscript": True}
    none, one, two = read(), read(inception=file, **trusted), read(inception=other, **trusted)
    judges = {name for name in none if name.startswith("scores-")}
    assert {name for name in none if none[name] != one[name]} == judges | {"results"}
    assert all(one[name] != two[name] for name in judges)
    assert read(lpips=(file, other)) != read(lpips=(other, file)) != none
    assert read(clip="openai/clip") != none
    with pytest.raises(PalpateError, match="`lpips` must be a file"):
        read(lpips=(file, tmp_path / "absent.pth"))


# --- what stages write: a run each

slow = pytest.mark.slow


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    run = tmp_path_factory.mktemp("whole") / "run"
    small_study.run(run)
    return run


def summary(folder) -> dict[str, float]:
    """A stage in numbers that other machines give, too, to three digits."""
    numbers = {}
    for path in sorted(folder.rglob("*.safetensors")):
        weights = load_file(path).values()
        values = np.concatenate([np.ravel(w).astype(float) for w in weights])
        numbers[path.relative_to(folder).as_posix()] = np.abs(values).mean()
    for path in sorted(folder.rglob("*.npz")):
        with np.load(path) as arrays:
            values = [np.ravel(a) for a in arrays.values() if a.dtype.kind == "f"]
        numbers[path.relative_to(folder).as_posix()] = np.abs(np.concatenate(values)).mean()
    images = [*folder.rglob("*.png"), *folder.rglob("*.jpg")]
    if images:
        numbers["images"] = len(images)
        numbers["mean of images"] = np.mean([np.asarray(Image.open(p)).mean() for p in images])
    if (folder / "scores.json").is_file():
        numbers |= means(read_scores(folder))
    if (folder / "results.json").is_file():
        results = Results.load(folder / "results.json")
        cells = [c for t in results.tables for r in t.rows for c in r if isinstance(c, Score)]
        evidence = [score for claim in results.claims for score in claim.evidence]
        numbers |= means([*results.scores, *cells, *evidence])
        verdicts = Counter(claim.verdict for claim in results.claims)
        numbers |= {f"claims: {verdict}": count for verdict, count in verdicts.items()}
    for name in SPLITS:
        if (folder / f"{name}.json").is_file():
            counts = Split.load(folder / f"{name}.json").counts()
            numbers |= {f"{name}: {part}": count for part, count in counts.items()}
    return numbers


def means(scores) -> dict[str, float]:
    """The number of scores with a value, their mean, and that of their limits."""
    values = [float(s) for s in scores if s.value is not None]
    limits = [s.interval for s in scores if s.interval is not None]
    numbers = {"scores": len(values), "intervals": len(limits)}
    return numbers | {
        f"mean of {name}": np.abs(of).mean()
        for name, of in (("values", values), ("limits", limits))
        if of
    }


def test_a_summary_sees_other_numbers_verdicts_and_parts(tmp_path):
    """In tables and claims as well."""

    def summarized(value, verdict, train):
        score = Score("TMMD", "Ours", value, (value, value + 1))
        Results(
            title="",
            tables=[StudyTable("", "", ["a"], [[score]])],
            claims=[Claim("", "", verdict, "", [score])],
        ).save(tmp_path / "results.json")
        Split({"a": "test", "b": train}).save(tmp_path / "Orig.json")
        return summary(tmp_path)

    first = summarized(1.0, "holds", "train")
    assert first["scores"] == 2
    assert summarized(1.0, "holds", "train") == first
    for other in ((1.1, "holds", "train"), (1.0, "undecided", "train"), (1.0, "holds", "val")):
        assert summarized(*other) != first


@pytest.mark.nightly
@slow
def test_golden_what_stages_write(whole):
    last = {kind_of(node): node for node in NODES}
    now = {
        kind: {"version": n.version, **{k: float(f"{v:.4g}") for k, v in found.items()}}
        for kind, n in last.items()
        for found in [summary(whole / n.name)]
    }
    known = golden("outputs", now)
    for kind, numbers in now.items():
        assert numbers == pytest.approx(known[kind], rel=2e-3, abs=1e-3), (
            f"{kind} writes other results. If that is meant, raise the version of its Node in "
            f"palpate/studies/reproduce.py, so that no run takes the old ones for new; {WRITE}"
        )


@pytest.mark.nightly
@slow
def test_two_processes_write_what_one_does(whole, tmp_path):
    small_study.run(tmp_path / "run", jobs=2)
    assert differing(whole, tmp_path / "run") == []


@pytest.mark.nightly
@slow
def test_stages_killed_between_their_last_file_and_their_mark_go_on(whole, tmp_path):
    run = shutil.copytree(whole, tmp_path / "run")
    for node in NODES:  # as each stage was just before it was marked as finished
        record = json.loads((run / node.name / "stage.json").read_text())
        inputs = {key: record[key] for key in ("digest", "version", "inputs", "read")}
        (run / f"{node.name}.partial.json").write_text(json.dumps(inputs))
        (run / node.name / "stage.json").unlink()
        (run / node.name).rename(run / f"{node.name}.partial")
    small_study.run(run)
    assert not list(run.glob("*.partial*"))
    assert differing(whole, run) == []


def run_until(folder, kinds):
    """Run the study in a process of its own; kill it within the first stage of these kinds.

    Returns:
        the kind, or None if the run ended.
    """
    names = {f"{node.name}: ...\n": kind_of(node) for node in NODES if kind_of(node) in kinds}
    command = [sys.executable, small_study.__file__, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line in names:
                next(process.stdout)  # until it has done something
                process.send_signal(signal.SIGKILL)
                return names[line]
    assert process.returncode == 0
    return None


@pytest.mark.nightly
@pytest.mark.timeout(3600)  # a process for each kind of stage
@slow
def test_a_study_killed_in_each_kind_of_stage_ends_as_one_that_was_not(whole, tmp_path):
    killed = []
    while (kind := run_until(tmp_path / "run", {*KINDS} - {*killed})) is not None:
        killed.append(kind)
    assert killed == KINDS
    assert differing(whole, tmp_path / "run") == []


@pytest.mark.nightly
@slow
def test_published_weights_come_on_top_of_a_run(whole, tmp_path):
    run, file = tmp_path / "run", inception(tmp_path / "inception.pt")
    shutil.copytree(whole, run)
    before = {p.parent.name: p.stat().st_mtime_ns for p in run.glob("*/stage.json")}
    plan = replace(small_study.plan(), weights=Weights(inception=str(file), trust_torchscript=True))
    results = run_study(plan, run)
    after = {p.parent.name: p.stat().st_mtime_ns for p in run.glob("*/stage.json")}
    changed = {name for name in after if after[name] != before.get(name)}
    assert changed == {n for n in after if n.startswith("scores-")} | {"results"}
    table = next(t for t in results.tables if t.title.startswith("Table 3"))
    at = [*table.columns].index("FID (Inception)")
    assert all(row[at].value > 0 for row in table.rows if row[0] in (OURS, "GVST"))
    assert results.settings["digests"]["weights of inception"] == digest_file(file)
