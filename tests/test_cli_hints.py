"""Every hint that palpate prints is a command, or options, that its own parser takes."""

import ast
import contextlib
import re
import shlex
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import pytest

from palpate.cli import VERBS, terminal
from palpate.core import PalpateError

SOURCE = Path(terminal.__file__).parents[1]
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in SOURCE.rglob("*.py")}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)
#: What stands for a part of a text that is filled in.
PLACEHOLDER = "X"


def parses(words):
    """Whether the words after ``palpate`` are a command, but for what it lacks."""
    name = next((n for n in (" ".join(words[:2]), words[0]) if n in VERBS), None)
    if name is None:
        return words == ["--help"]
    options = import_module(f"palpate.cli.{VERBS[name].module}").Options
    try:
        terminal.parse(name, options, words[len(name.split()) :])
    except SystemExit as stop:  # --help
        return stop.code == 0
    except PalpateError as error:
        return "must be given" in error.must
    return True


def text_of(node):
    """A text of the source, with a placeholder for what is filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            getattr(value, "value", PLACEHOLDER) if isinstance(value, ast.Constant) else PLACEHOLDER
            for value in node.values
        )
    return ""


def texts(node):
    """Texts below a node, but for parts of others and docstrings."""
    if text := text_of(node):
        yield text
    else:
        doc = isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None
        for child in ast.iter_child_nodes(node):
            if not (doc and child is node.body[0]):
                yield from texts(child)


def commands():
    """Commands in the texts of the source: a whole text, or what follows a colon or ``E.g.``."""
    for path, tree in TREES.items():
        for text in texts(tree):
            match = re.search(r"(?:^|: |E\.g\. )palpate ([a-z][^:?]*)$", text)
            if match and not text.startswith(("palpate is", "palpate must")):
                yield path.name, match[1]


COMMANDS = sorted({*commands()})


def test_many_commands_are_found():
    assert len(COMMANDS) > 15


@pytest.mark.parametrize(("file", "command"), COMMANDS)
def test_a_command_in_a_text_parses(file, command):
    assert parses(shlex.split(command)), (file, command)


def examples():
    """Argument and value of every example of an error that is written out."""
    for node in (node for tree in TREES.values() for node in ast.walk(tree)):
        match node:
            case ast.keyword(arg="example", value=ast.Dict(keys=keys, values=values)):
                pairs = zip(keys, values, strict=True)
            case ast.Call(func=ast.Name(id="require"), args=[_, name, _, _, value]):
                pairs = [(name, value)]
            case _:
                continue
        for name, value in pairs:
            with contextlib.suppress(ValueError):
                yield ast.literal_eval(name), ast.literal_eval(value)


@pytest.mark.parametrize("verb", VERBS)
def test_examples_are_written_as_the_options_of_a_verb(verb):
    """Those of the arguments that it has, the last of each."""
    options = import_module(f"palpate.cli.{VERBS[verb].module}").Options
    unnamed = [f.name for f in fields(options) if re.search("Positional|PathArg", f.type)]
    written = [terminal.option_name(verb, name) for name in unnamed if name != "manifest"]
    assert not [name for name in written if name.startswith("--")]
    strings, words = terminal.option_strings(options), {}
    for argument, value in examples():
        if (name := terminal.option_name(verb, argument)) in strings:
            words[name] = shlex.split(terminal._option(verb, argument, value))
    assert parses([*verb.split(), *(word for each in words.values() for word in each)])


def test_the_words_of_an_option_stand_for_true_and_false():
    assert terminal._option("score", "normalize", True) == "--normalize yes"
    assert terminal._option("audit", "group", "contact") == "--by contact"
    assert terminal._option("caption check", "data", "tag") == "--data tag"


@pytest.mark.parametrize(
    ("fix", "line"),
    [
        ("Import it: palpate import tag -o m", "must. Got x. Import it: palpate import tag -o m"),
        ("Did you mean: --list", "must. Got x. Did you mean: --list"),
        ("Choose another", "must. Got x. Choose another."),
    ],
)
def test_a_hint_for_pasting_has_no_full_stop(fix, line):
    assert str(PalpateError("must", "x", fix)) == line
    assert str(PalpateError("must", "x", fix, example={"a": 0.1})).endswith("E.g. a=0.1")
