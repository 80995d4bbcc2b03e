"""The graph of stages: order, reuse, several processes, errors, and kill -9."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from forge.errors import fails
from palpate.core import PalpateError, locked
from palpate.studies.graph import Node, Nodes, Stamped
from palpate.studies.running import plan_graph, run_graph


def write(work, *, text):
    """Write the text below those of the nodes before."""
    texts = [(folder / "text").read_text() for folder in work.after.values()]
    (work.folder / "text").write_text("".join([*texts, text]))
    work.progress("writing", 1, 1)
    return {"text": text, "process": os.getpid()}


def node(name, *after, text=None, **fields):
    return Node(name, write, {"text": text or name}, after, **fields)


def built(lines):
    """The nodes that were begun, by the lines that were printed."""
    return {line.removesuffix(": ...") for line in lines if line.endswith(": ...")}


DIAMOND = [node("a"), node("b", "a"), node("c", "a"), node("d", "b", "c")]


def texts(folder):
    return {p.parent.name: p.read_text() for p in Path(folder).glob("*/text")}


@pytest.mark.parametrize("jobs", [1, 2])
def test_each_node_reads_what_the_nodes_before_it_wrote(tmp_path, jobs):
    lines = []
    stages = run_graph(DIAMOND, tmp_path, jobs=jobs, print_line=lines.append)
    assert texts(tmp_path) == {"a": "a", "b": "ab", "c": "ac", "d": "abacd"}
    assert list(stages) == ["a", "b", "c", "d"]
    assert built(lines) == {*"abcd"}
    processes = {s.facts["process"] for s in stages.values()}
    assert (os.getpid() in processes) == (jobs == 1)
    lines.clear()
    again = run_graph(DIAMOND, tmp_path, jobs=jobs, print_line=lines.append)
    assert built(lines) == set()
    assert {n: s.outputs for n, s in again.items()} == {n: s.outputs for n, s in stages.items()}


@pytest.mark.parametrize(
    ("changed", "names"),
    [
        (node("c", "a", text="other"), {"c", "d"}),
        (node("c", "a", version=2), {"c", "d"}),
        (node("c", "a", "b"), {"c", "d"}),
    ],
)
def test_a_changed_node_builds_itself_and_what_reads_it(tmp_path, changed, names):
    run_graph(DIAMOND, tmp_path)
    nodes = [changed if n.name == "c" else n for n in DIAMOND]
    planned, lines = plan_graph(nodes, tmp_path), []
    assert {name for name, done in planned.items() if not done} == names
    run_graph(nodes, tmp_path, print_line=lines.append)
    assert built(lines) == names


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize(("text", "names"), [("a", {"a"}), ("x", {*"abcd"})])
def test_what_reads_a_stage_is_built_again_where_that_has_other_files(tmp_path, jobs, text, names):
    """As of a training on a GPU, whose weights are not the same twice."""
    run_graph(DIAMOND, tmp_path)
    shutil.rmtree(tmp_path / "a")
    other = Node("a", write, {"text": Stamped(text, "a")})
    nodes = [other if n.name == "a" else n for n in DIAMOND]
    lines = []
    run_graph(nodes, tmp_path, jobs=jobs, print_line=lines.append)
    assert built(lines) == names
    assert texts(tmp_path)["d"] == f"{text}b{text}cd"


def test_a_plan_writes_nothing_and_is_in_order(tmp_path):
    nodes = [node("b"), node("a", "b")]
    assert [*plan_graph(nodes, tmp_path / "run").items()] == [("b", False), ("a", False)]
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "after", "words"),
    [
        ("a", (), "must have a name of its own, that of a folder. Got a"),
        ("b/c", (), "must have a name of its own, that of a folder. Got b/c"),
        (".b", (), "must have a name of its own, that of a folder. Got .b"),
        ("b", ("a", "c", "b"), "Stage b must come after stages of the same graph. Got b, c"),
    ],
)
def test_a_node_that_cannot_be_run(name, after, words):
    nodes = Nodes()
    nodes.add("a", write, text="a")
    fails(words, nodes.add, name, write, *after, text="b")
    assert [node.name for node in nodes] == ["a"]


def fail(work, *, error):
    raise error


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize(
    "error", [PalpateError("must", "got", "fix", argument="seed"), ZeroDivisionError("bug")]
)
def test_an_error_stops_the_run_and_finished_nodes_stay(tmp_path, jobs, error):
    nodes = [node("a"), Node("b", fail, {"error": Stamped(error, "")}, ("a",)), node("c", "b")]
    lines = []
    with pytest.raises(type(error)) as raised:
        run_graph(nodes, tmp_path, jobs=jobs, print_line=lines.append)
    assert str(raised.value) == str(error)
    assert "b: stopped by an error" in lines
    assert [p.parent.name for p in tmp_path.glob("*/stage.json")] == ["a"]


def die(work):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_dies_is_one_line(tmp_path):
    with pytest.raises(PalpateError, match=r"must stay alive\. Got one ended with status -9"):
        run_graph([Node("a", die, {})], tmp_path, jobs=2)


def name_process(work):
    (work.folder / "process").write_text(str(os.getpid()))


def end_first(work):
    """Kill the process that built ``a`` and now waits."""
    os.kill(int((work.after["a"] / "process").read_text()), signal.SIGKILL)
    time.sleep(0.3)


def test_an_idle_process_that_dies_is_one_line(tmp_path):
    nodes = [Node("b", rest, {"seconds": 1.0}), Node("a", name_process)]
    nodes += [Node("c", end_first, {}, ("b", "a"))]
    nodes += [Node(n, rest, {"seconds": 0.0}, ("c",)) for n in "de"]
    fails(r"must stay alive\. Got one ended with status -9", run_graph, nodes, tmp_path, jobs=2)


def test_one_run_at_a_time_holds_the_folder(tmp_path):
    with locked(tmp_path), pytest.raises(PalpateError, match="must be written by one run"):
        run_graph(DIAMOND, tmp_path)


def test_torchrun_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    fails("must be begun by one process", run_graph, DIAMOND, tmp_path)


def settings(work):
    time.sleep(0.3)  # the other process takes the other node
    return {n: os.environ.get(n) for n in ("CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")}


def test_gpus_are_dealt_out_and_threads_are_those_of_one_process(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    stages = run_graph([Node(n, settings, {}) for n in "ab"], tmp_path, jobs=2)
    facts = [tuple(stage.facts.values()) for stage in stages.values()]
    assert sorted(facts) == [("4", "3"), ("7", "3")]


def rest(work, *, seconds):
    time.sleep(seconds)


@pytest.mark.parametrize("jobs", [1, 2])
def test_work_within_a_node_is_reported_under_its_name(tmp_path, jobs):
    reports = []
    run_graph([node("a")], tmp_path, jobs=jobs, progress=lambda *args: reports.append(args))
    assert ("a: writing", 1, 1, "") in reports


SCRIPT = """
import sys, time
from pathlib import Path
from palpate.studies.graph import Node
from palpate.studies.running import run_graph

def grow(work):
    # Lines, one after the other, each of which holds what came before; resumes.
    folder, name = work.folder, work.stage
    file = folder / "lines"
    lines = file.read_text().splitlines() if file.exists() else []
    (folder.parent / f"{name}.resumed").write_text(str(len(lines)))
    for k in range(len(lines), 8):
        lines.append(f"{name} {k} {len(''.join(lines))}")
        file.write_text("\\n".join(lines))
        time.sleep(0.05)

if __name__ == "__main__":
    names = ["a", "b", "c"]
    nodes = [Node(n, grow, {}, ("a",) if n == "c" else ()) for n in names]
    run_graph(nodes, Path(sys.argv[1]), jobs=int(sys.argv[2]))
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """A study, and beside it the folder ``whole`` of a run that was not stopped."""
    file = tmp_path_factory.mktemp("study") / "study.py"
    file.write_text(SCRIPT)
    with start(file, file.with_name("whole"), 2) as process:
        process.communicate()
    assert process.returncode == 0
    return file


def start(script, folder, jobs):
    command = [sys.executable, str(script), str(folder), str(jobs)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_run_goes_on_to_the_same_files(tmp_path, script, jobs, number):
    with start(script, tmp_path / "run", jobs) as process:
        begun = tmp_path / "run" / "a.partial" / "lines"
        while not (begun.exists() and len(begun.read_text().splitlines()) >= 3):
            time.sleep(0.02)
        process.send_signal(number)
        _, errors = process.communicate()
    assert process.returncode != 0
    assert errors.count("KeyboardInterrupt") == (number == signal.SIGINT)
    assert not (tmp_path / "run" / "c").exists()
    time.sleep(0.3)  # a worker ends with its parent
    kept = begun.read_text().splitlines()
    time.sleep(0.3)
    assert begun.read_text().splitlines() == kept
    with start(script, tmp_path / "run", jobs) as process:
        process.communicate()
    assert process.returncode == 0
    assert int((tmp_path / "run" / "a.resumed").read_text()) == len(kept) >= 3
    for name in "abc":
        lines = (tmp_path / "run" / name / "lines").read_text()
        assert lines == (script.with_name("whole") / name / "lines").read_text()
        assert len(lines.splitlines()) == 8
