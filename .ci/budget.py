"""Holds the size of palpate: `make lint` prints it next to budget.toml and fails above.

    .venv/bin/python .ci/budget.py             # the table
    .venv/bin/python .ci/budget.py --lower     # writes what is there where it is better

Tokens are those of Python's ``tokenize`` without comments, docstrings and line ends; of templates,
style sheets, scripts and JSON in the package, words and signs (shipped models and split lists are
not counted). Words of docs are those of docs/, README.md and CONTRIBUTING.md as committed. Options
are the leaves of a verb's parser but for --help, --json and --quiet. Modules are those of palpate
that a run of the verb loads. A bag is a dict that a function binds to a name and splats into a call
(.ci/bags.py). A parameter of a public name counts as documented if its docstring names it.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import inspect
import io
import pkgutil
import re
import subprocess
import sys
import tempfile
import tokenize
import tomllib
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from bags import found
from PIL import Image

TOP = Path(__file__).resolve().parents[1]
BUDGET = TOP / "budget.toml"
SOURCE = TOP / "src" / "palpate"
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
#: Files of the package, not Python's, that people write and read.
WRITTEN = {".j2", ".css", ".js", ".json", ".txt", ".tsv"}
COMMON = {"--help", "--json", "--quiet"}


def python_tokens(path: Path) -> int:
    """Tokens of a file, without docstrings."""
    source = path.read_bytes()
    docstrings = {
        (node.body[0].lineno, node.body[0].col_offset)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None
    }
    tokens = tokenize.tokenize(io.BytesIO(source).readline)
    return sum(t.type not in LAYOUT and t.start not in docstrings for t in tokens)


def tracked(*places: str) -> Iterator[Path]:
    """The files of a place that git tracks or would."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "--", *places]
    names = subprocess.run(command, cwd=TOP, capture_output=True, text=True, check=True).stdout
    return (TOP / name for name in names.splitlines() if (TOP / name).is_file())


def tokens() -> tuple[Counter[str], Counter[str]]:
    """Tokens and lines by room, of templates, tests and scripts."""
    count, lines = Counter(), Counter()
    for path in tracked("src/palpate"):
        parts = path.relative_to(SOURCE).parts
        if path.suffix == ".py":
            room = parts[0] if len(parts) > 1 else "door"
            count[room] += python_tokens(path)
            lines[room] += len(path.read_text(encoding="utf-8").splitlines())
        elif path.suffix in WRITTEN and parts[0] != "mini" and path.name != "tag_noleak.json":
            count["templates"] += len(re.findall(r"\w+|[^\w\s]", path.read_text(encoding="utf-8")))
    count["source"] = sum(count[room] for room in lines)
    lines["source"] = sum(lines.values())
    for name, places in (("tests", ("tests",)), ("scripts", ("benchmarks", "recipes", ".ci"))):
        for path in tracked(*places):
            if path.suffix == ".py":
                count[name] += python_tokens(path)
                lines[name] += len(path.read_text(encoding="utf-8").splitlines())
    return count, lines


def words() -> dict[str, int]:
    """Words of the docs that people write."""
    pages = [p for p in tracked("docs", "README.md", "CONTRIBUTING.md") if p.suffix == ".md"]
    return {"docs": sum(len(page.read_text(encoding="utf-8").split()) for page in pages)}


def options() -> dict[str, int]:
    """Options and positional arguments of every verb."""
    import tyro

    from palpate.cli import VERBS
    from palpate.cli.terminal import CONFIG

    counts = {}
    for verb, row in VERBS.items():
        module = importlib.import_module(f"palpate.cli.{row.module}")
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
            actions = tyro.extras.get_parser(module.Options, config=CONFIG)._actions
        names = [set(action.option_strings) or {action.dest} for action in actions]
        counts[verb] = sum(not n & COMMON for n in names)
    return counts


LOADED = """
import sys
from palpate.cli import main
main(sys.argv[1:])
print(sum(name.split(".")[0] == "palpate" for name in sys.modules))
"""


def modules() -> dict[str, int]:
    """Modules of palpate that a run of a verb loads."""
    commands = {
        "audit": "audit train.txt test.txt",
        "score": "score --generated a --reference b --encoder palpate/mini",
        "generate": "generate a/0.png -o touch.png",
    }
    images = np.random.default_rng(0).integers(0, 256, (2, 4, 64, 64, 3), dtype=np.uint8)
    counts = {}
    with tempfile.TemporaryDirectory() as work:
        for part, frame in (("train", 1), ("test", 2)):
            Path(work, f"{part}.txt").write_text(f"video/{frame:010d}.jpg,1\n")
        for folder, stack in zip("ab", images, strict=True):
            Path(work, folder).mkdir()
            for k, image in enumerate(stack):
                Image.fromarray(image).save(Path(work, folder, f"{k}.png"))
        for verb, command in commands.items():
            arguments = [sys.executable, "-c", LOADED, *command.split()]
            done = subprocess.run(arguments, cwd=work, capture_output=True, text=True, check=True)
            counts[verb] = int(done.stdout.split()[-1])
    return counts


def documented() -> dict[str, float]:
    """The share of parameters of public functions and records that their docstrings name."""
    import palpate

    names = [m.name for m in pkgutil.iter_modules(palpate.__path__) if m.name[0] != "_"]
    rooms = [palpate, *(importlib.import_module(f"palpate.{name}") for name in names)]
    public = [getattr(room, name) for room in rooms for name in getattr(room, "__all__", ())]
    total = said = 0
    for value in {v for v in public if inspect.isfunction(v) or dataclasses.is_dataclass(v)}:
        text = inspect.getdoc(value) or ""
        for name in inspect.signature(value).parameters:
            total += 1
            said += re.search(rf"\b{name}\b", text) is not None
    return {"parameters": round(said / total, 3)}


def main() -> int:
    """Print the table; 1 where something is above its budget."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--lower", action="store_true", help="lower budget.toml to what is there")
    args = parser.parse_args()
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8"))
    count, lines = tokens()
    measured = {
        "tokens": count,
        "words": words(),
        "options": options(),
        "modules": modules(),
        "house": {"bags": len(found())},
        "documented": documented(),
    }
    above = 0
    for table, values in measured.items():
        print(f"{table:26}     now  budget")
        for name in {**budget[table], **values}:
            now, most = values.get(name, 0), budget[table].get(name, 0)
            bad = now < most if table == "documented" else now > most
            above += bad
            more = f"  {lines[name]} lines" if table == "tokens" and name in lines else ""
            print(f"  {name:22} {now:9} {most:7}{more}{'  ABOVE' * bad}")
            if args.lower:
                budget[table][name] = max(now, most) if table == "documented" else min(now, most)
    if args.lower:  # numbers alone: the reasons stay
        table, rows = "", list[str]()
        for row in BUDGET.read_text(encoding="utf-8").splitlines():
            table = row.strip("[]") if row.startswith("[") else table
            name = re.match('"(.+?)" = ', row)
            number = str(budget[table][name[1]]) if name else ""
            rows.append(re.sub(r"(?<= = )[\d.]+", number, row, count=1) if name else row)
        BUDGET.write_text("\n".join(rows) + "\n", encoding="utf-8")
    if above:
        print("Above budget.toml: delete, or raise the line there with its reason in the diff.")
    return int(above > 0)


if __name__ == "__main__":
    sys.exit(main())
