"""Finds bags of keyword arguments: a dict that a function binds to a name and splats into a call.

    .venv/bin/python .ci/bags.py

What is bound once and splatted once hides the arguments of a call from readers and type checkers;
what many calls share is a record. ``**kwargs`` of the function itself are handed on as they are.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src" / "palpate"
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def body(function: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a function without those of functions inside it."""
    for child in ast.iter_child_nodes(function):
        yield child
        if not isinstance(child, FUNCTIONS):
            yield from body(child)


def is_dict(value: ast.AST | None) -> bool:
    """Whether an expression says that it is a dict, also one of two or a union of some."""
    match value:
        case ast.Dict() | ast.DictComp() | ast.Call(func=ast.Name(id="dict")):
            return True
        case ast.IfExp(body=one, orelse=other) | ast.BinOp(left=one, op=ast.BitOr(), right=other):
            return is_dict(one) or is_dict(other)
    return False


def bound(node: ast.AST) -> Iterator[str]:
    """Names that a statement or ``:=`` binds to a dict."""
    match node:
        case ast.Assign(targets=targets, value=value) if is_dict(value):
            yield from (target.id for target in targets if isinstance(target, ast.Name))
        case ast.AnnAssign(target=ast.Name(id=name), value=value) if is_dict(value):
            yield name
        case ast.NamedExpr(target=ast.Name(id=name), value=value) if is_dict(value):
            yield name
        case ast.AugAssign(target=ast.Name(id=name), op=ast.BitOr()):
            yield name


def bags(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of each bag in a file."""
    for function in (node for node in ast.walk(tree) if isinstance(node, FUNCTIONS)):
        nodes = list(body(function))
        names = {name for node in nodes for name in bound(node)}
        for call in (node for node in nodes if isinstance(node, ast.Call)):
            for keyword in call.keywords:
                name = keyword.value
                if keyword.arg is None and isinstance(name, ast.Name) and name.id in names:
                    yield call.lineno, name.id


def found() -> list[str]:
    """Each bag of the package as ``file:line: **name``."""
    return [
        f"{path.relative_to(SOURCE.parent)}:{line}: **{name}"
        for path in sorted(SOURCE.rglob("*.py"))
        for line, name in bags(ast.parse(path.read_text(encoding="utf-8")))
    ]


if __name__ == "__main__":
    print(*found(), sep="\n")
