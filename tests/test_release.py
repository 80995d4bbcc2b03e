"""What 0.1 promises: names, verbs, formats; and the container of the GPU machine."""

import inspect
import json
import re
import shlex
from pathlib import Path

import palpate as pp
from palpate.cli.verbs import VERBS

TOP = Path(__file__).resolve().parents[1]
PROMISED = json.loads((TOP / "tests" / "golden" / "promised.json").read_text())


def promise():
    """Names with their arguments, verbs, formats of files, as they are now."""
    arguments = {}
    for name in pp.__all__:
        value = getattr(pp, name)
        parameters = [] if inspect.isclass(value) else [*inspect.signature(value).parameters]
        arguments[name] = parameters
    source = "\n".join(p.read_text("utf-8") for p in (TOP / "src" / "palpate").rglob("*.py"))
    kinds = (
        "manifest|split|results|audit|captions|generated|pipeline|encoders|clip|autoencoder|world"
    )
    formats = sorted(set(re.findall(rf'"(palpate-(?:{kinds})/\d+)"', source)))
    return {"names": arguments, "verbs": sorted(VERBS), "formats": formats}


def test_what_is_promised_is_there():
    now = promise()
    for name, arguments in PROMISED["names"].items():
        assert name in now["names"], f"{name} was promised: deprecate it for a minor version"
        assert set(arguments) <= set(now["names"][name]), name
    for kind in ("verbs", "formats"):
        assert set(PROMISED[kind]) <= set(now[kind]), kind
    version = pp.__version__.split(".")
    assert len(version) == 3
    assert all(part.isdecimal() for part in version)
    cited = re.search(r"^version: (\S+)$", (TOP / "CITATION.cff").read_text(), re.MULTILINE)[1]
    assert cited == pp.__version__
    assert f"## [{pp.__version__}]" in (TOP / "CHANGELOG.md").read_text("utf-8")


def instructions():
    """(instruction, words) of the Dockerfile; continued lines are joined."""
    lines = (TOP / "Dockerfile").read_text("utf-8").replace("\\\n", " ").splitlines()
    return [line.split(maxsplit=1) for line in lines if line.strip() and line[0] != "#"]


def test_the_container_is_pinned_and_runs_as_nobody_special():
    made = instructions()
    names = [name for name, _ in made]
    assert set(names) <= {"FROM", "ENV", "WORKDIR", "COPY", "RUN", "USER", "ENTRYPOINT", "CMD"}
    assert names[0] == "FROM"
    assert re.fullmatch(r"python:3\.\d+\.\d+-[a-z-]+", made[0][1])  # a release, not a moving tag
    allowed = (TOP / ".dockerignore").read_text().splitlines()
    for name, text in made:
        if name == "COPY":
            for source in text.split()[:-1]:
                assert (TOP / source).exists(), source
                assert f"!{source}" in allowed, source
        if name == "RUN":
            assert shlex.split(text)
            for command in text.split("&&"):
                if "pip install" in command and "torch==" not in command:
                    assert "-c constraints.txt" in command
        if name in ("ENTRYPOINT", "CMD"):
            assert isinstance(json.loads(text), list)
    assert dict(made)["USER"] != "root"
    assert names.index("USER") > max(k for k, name in enumerate(names) if name == "RUN")
    pins = (TOP / "constraints.txt").read_text()
    assert re.search(r"^torch==\d", pins, re.MULTILINE)
