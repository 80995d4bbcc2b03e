"""The house: imports go one way without effects, help is quick, sources hold nothing personal."""

import ast
import functools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from forge.commands import python
from palpate.cli import VERBS

TOP = Path(__file__).resolve().parents[1]
LINT = Path(sys.executable).parent / "lint-imports"


#: What runs, from light to heavy -> libraries that are not loaded after it.
LIGHT = {
    "from palpate.cli import main; assert main(['--help']) == 0": "torch polars numpy tyro rich",
    "import palpate.metrics; palpate.metrics.TMMD()": "torch torchmetrics polars PIL",
    "import palpate.data": "polars",
    "import palpate.data.listing": "PIL av torch",
    "import palpate.data.importing": "datasets torch pyarrow",
    "import palpate.captions.captioning, palpate.captions.checking": "httpx2 torch transformers",
    "import palpate.encoders, palpate.diffusion.generation": "torch transformers diffusers",
}


def test_little_is_loaded():
    lines = [
        f"{code}\nassert not {{*{names.split()}}} & {{*sys.modules}}, {code!r}"
        for code, names in LIGHT.items()
    ]
    python("\n".join(["import sys", *lines]))


def test_help_is_quick():
    code = "import time; from palpate.cli import main; main(['--help']); print(time.process_time())"
    printed = [python(code) for _ in range(3)]
    assert min(float(output.split()[-1]) for output in printed) < 0.5  # CPU seconds
    assert all(f"\n  {verb} " in printed[0] for verb in VERBS)


def test_help_has_examples_and_loads_no_torch():
    code = """
import contextlib, sys
from palpate.cli import VERBS, main
for verb in VERBS:
    with contextlib.suppress(SystemExit):
        main([*verb.split(), "--help"])
assert "torch" not in sys.modules
"""
    output = python(code)
    for verb in VERBS.values():
        assert f"Example: {verb.example}" in output
    assert output.count("--json") >= len(VERBS)


def test_audit_and_split_load_no_torch(tmp_path, small_manifest):
    small_manifest.save(tmp_path / "manifest.parquet")
    for name in ("train", "test"):
        (tmp_path / f"{name}.txt").write_text("v/0000000001.jpg,1")
    code = """
import sys
from palpate.cli import main
assert main(["audit", "train.txt", "test.txt"]) == 1  # they leak
assert main(["split", "manifest.parquet", "-o", "s.json"]) == 0
assert "torch" not in sys.modules
"""
    python(code, cwd=tmp_path)


#: Lines that are planted into rooms, and whether the contracts allow them.
PLANTED = [
    ("core", "numpy", True),
    ("core", "polars", False),
    ("core", "PIL", False),  # core.images alone opens images
    ("report", "palpate.metrics", False),
    ("leakage", "palpate.sim", False),
    ("evaluation", "torch", False),
    ("encoders", "palpate.leakage", False),
]


def test_imports_go_one_way(tmp_path):
    """In a copy of the sources, every planted line that is forbidden is named, and no other."""
    if not LINT.exists():
        pytest.skip("import-linter is not installed")
    ignored = shutil.ignore_patterns("__pycache__", "mini", "templates")
    shutil.copytree(TOP / "src", tmp_path / "src", ignore=ignored)
    shutil.copy(TOP / "pyproject.toml", tmp_path)
    environment = {"PYTHONPATH": str(tmp_path / "src"), "PATH": ""}

    def check():
        done = subprocess.run([LINT], cwd=tmp_path, env=environment, capture_output=True, text=True)
        return done.returncode, set(re.findall(r"palpate\.\w+\.(planted\d) ?->", done.stdout))

    for wanted in (True, False):
        for k, (room, name, allowed) in enumerate(PLANTED):
            if allowed is wanted:
                (tmp_path / "src" / "palpate" / room / f"planted{k}.py").write_text(
                    f"import {name}\n"
                )
        names = {f"planted{k}" for k, row in enumerate(PLANTED) if not (row[2] or wanted)}
        assert check() == (int(not wanted), names)


def test_no_absolute_paths_no_forbidden_packages():
    for path in (TOP / "src").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"[\"'](/home|/work|/root|/nfs|/mnt|/Users)\b", text), path
        assert not re.search(
            r"^\s*(import|from) (torchvision|timm|open_clip|lpips)\b", text, re.MULTILINE
        ), path
    for path in (TOP / "src").rglob("*"):
        if path.suffix in (".json", ".md"):  # what ships beside the weights
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"[\s\"'`(](/home|/work|/root|/nfs|/mnt|/Users|/tmp)/", text), path


#: What decodes images or could run code from a file -> the only modules that call it, and how.
OPENERS = {
    "Image.open": (["core/images.py"], "formats=_installed_formats()"),
    "torch.load": (["encoders/models.py"], "weights_only=True"),
    "torch.jit.load": (["encoders/inception.py"], ""),
    "np.load": (None, "allow_pickle=False"),
}
#: Names that would run code, wherever they are called.
RUNNERS = (
    r"(c?pickle|dill|cloudpickle|joblib|shelve|marshal)\..*|(builtins\.)?(eval|exec)|yaml\..*load"
)
RUNNERS += r"|.*\.Unpickler|torch\.hub\..*|imageio\..*|iio\..*|cv2\.imread|plt\.imread"


def calls_of(path):
    """(name, keywords) of every call in a file, names as they were imported."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            prefix = {"PIL": ""}.get(node.module, f"{node.module}.")
            names |= {n.asname or n.name: f"{prefix}{n.name}" for n in node.names}
        elif isinstance(node, ast.Import):
            shorter = {"numpy": "np", "PIL.Image": "Image"}
            names |= {n.asname or n.name: shorter.get(n.name, n.name) for n in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, dot, rest = ast.unparse(node.func).partition(".")
            name = names.get(first, first) + dot + rest
            yield name, [ast.unparse(word) for word in node.keywords]


def opened_wrongly(path, place):
    """Calls in a file that open images, or what may hold code, otherwise than allowed."""
    for name, keywords in calls_of(path):
        if name in OPENERS:
            places, keyword = OPENERS[name]
            if not (places is None or place in places) or (keyword and keyword not in keywords):
                yield name
        if re.fullmatch(RUNNERS, name) or "trust_remote_code=True" in keywords:
            yield name


def test_images_have_one_door_and_no_file_runs_code(tmp_path):
    root = TOP / "src" / "palpate"
    wrong = {
        str(path): found
        for path in root.rglob("*.py")
        if (found := list(opened_wrongly(path, path.relative_to(root).as_posix())))
    }
    assert not wrong
    planted = """
import pickle, numpy, torch
from PIL import Image as Picture
Picture.open("a"); torch.load("a"); torch.jit.load("a"); numpy.load("a"); pickle.load("a")
torch.load("a", weights_only=False); eval("a")
AutoModel.from_pretrained("a", trust_remote_code=True)
"""
    (tmp_path / "planted.py").write_text(planted)
    assert len(list(opened_wrongly(tmp_path / "planted.py", "data/planted.py"))) == 8


READS = ("pl.read_parquet", "pl.scan_parquet")


def parquet_lines(path, *, guarded):
    """Lines of a file that read Parquet; the ``guarded`` ones, where a panic is an error."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        inside = isinstance(node, ast.With) and "reading_parquet()" in map(ast.unparse, node.items)
        if inside or (not guarded and isinstance(node, ast.Module)):
            calls = [n for n in ast.walk(node) if isinstance(n, ast.Call)]
            yield from {n.lineno for n in calls if ast.unparse(n.func).startswith(READS)}


def test_parquet_is_read_where_a_panic_of_polars_is_an_error(tmp_path):
    for path in (TOP / "src" / "palpate").rglob("*.py"):
        open_lines = {*parquet_lines(path, guarded=False)} - {*parquet_lines(path, guarded=True)}
        assert not open_lines, (path, open_lines)
    planted = tmp_path / "planted.py"
    planted.write_text("pl.read_parquet('a')\nwith reading_parquet():\n    pl.read_parquet('a')\n")
    assert {*parquet_lines(planted, guarded=False)} - {*parquet_lines(planted, guarded=True)} == {1}


def test_importing_a_room_has_no_effects():
    code = """
import importlib, os, random
import numpy as np

def state():
    environment = {k: v for k, v in os.environ.items() if k != "_RJEM_MALLOC_CONF"}  # polars' own
    return environment, random.getstate(), np.random.get_state()[1].tolist()

before = state()
for name in ("core", "data.manifest", "data.listing", "leakage", "sim", "metrics", "report"):
    importlib.import_module(f"palpate.{name}")
assert state() == before
"""
    assert python(code) == ""


def test_no_module_imports_itself_in_a_circle():
    """Strongly connected components of the import graph have one module each."""
    import grimp
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    graph = grimp.build_graph("palpate", exclude_type_checking_imports=True)
    modules = sorted(graph.modules)
    index = {name: k for k, name in enumerate(modules)}
    edges = np.array(
        [(index[a], index[b]) for a in modules for b in graph.find_modules_directly_imported_by(a)]
    )
    matrix = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(modules),) * 2)
    count, label = connected_components(matrix, directed=True, connection="strong")
    circles = [[m for m in modules if label[index[m]] == k] for k in range(count)]
    assert not [circle for circle in circles if len(circle) > 1]


def imported(tree):
    """What a module's own statements import, as (name, module that may hold it)."""
    statements = list(tree.body)
    while statements:
        match statements.pop():
            case ast.ImportFrom(module=str(module), names=names):
                yield from ((f"{module}.{name.name}", module) for name in names)
            case ast.Import(names=names):
                yield from ((name.name, None) for name in names)
            case ast.If(test=test, body=body, orelse=orelse):
                statements += orelse + body * ("TYPE_CHECKING" not in ast.unparse(test))
            case (
                ast.Try(body=body, orelse=orelse, finalbody=final)
                | ast.TryStar(body=body, orelse=orelse, finalbody=final)
            ):
                statements += body + orelse + final


def test_chains_of_imports_are_short_and_none_runs_back_to_the_door():
    """The longest way down through what modules import at once; before the rooms were cut, 25."""
    trees = {}
    for path in (TOP / "src" / "palpate").rglob("*.py"):
        name = ".".join(path.relative_to(TOP / "src").with_suffix("").parts)
        trees[name.removesuffix(".__init__")] = ast.parse(path.read_text(encoding="utf-8"))
    below = {}
    for name, tree in trees.items():
        pairs = ((n if n in trees else module) for n, module in imported(tree))
        below[name] = {n for n in pairs if n in trees and n != name}

    @functools.cache
    def chain(name):
        return [name, *max((chain(n) for n in below[name]), key=len, default=[])]

    assert not [name for name, names in below.items() if "palpate" in names]
    longest = max(map(chain, trees), key=len)
    assert len(longest) <= 20, "\n".join(longest)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "files"),
    [
        ("score --generated a --reference b --encoder palpate/mini", 41),
        ("audit a.txt b.txt", 28),
        ("generate b/0.png -o t.png", 29),  # noise is out of range, and noted
    ],
)
def test_the_main_paths_stay_short(tmp_path, words, files):
    """Files of palpate in which a function runs; before the house was made simple, 51 and 24."""
    images = np.random.default_rng(0).integers(0, 256, (2, 12, 64, 64, 3), dtype=np.uint8)
    for name, folder in zip("ab", images, strict=True):
        (tmp_path / name).mkdir()
        for k, image in enumerate(folder):
            Image.fromarray(image).save(tmp_path / name / f"{k}.png")
    for name in "ab":
        lines = [f"{name}{v}/{k}.jpg,{v % 3}\n" for v in range(6) for k in range(9)]
        (tmp_path / f"{name}.txt").write_text("".join(lines))
    script = [sys.executable, TOP / "benchmarks" / "walk.py", "--json", "walk.json", "--"]
    subprocess.run([*script, "palpate", *words.split()], cwd=tmp_path, check=True, timeout=300)
    walked = json.loads((tmp_path / "walk.json").read_text(encoding="utf-8"))
    assert len(walked) <= files, "\n".join(walked)


def test_workflows_and_the_makefile_call_scripts_that_can_run():
    top = Path(__file__).parents[1]
    files = [top / "Makefile", *sorted((top / ".github" / "workflows").glob("*.yml"))]
    called = {path.name: re.findall(r"(?<![\w./])\.ci/[\w.-]+", path.read_text()) for path in files}
    assert {".ci/run", ".ci/release"} <= {*called["release.yml"]}
    assert ".ci/release" in called["Makefile"]
    for script in {name for names in called.values() for name in names}:
        assert (top / script).is_file(), script
        assert script.endswith(".py") or os.access(top / script, os.X_OK), script
