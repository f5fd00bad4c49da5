"""Numbers of the method: each has a name, and a name has a reason beside it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "geodelreg"
ROOMS = ("coarse", "fine", "fit", "judge", "paper", "geo/maps")
MODULES = sorted(
    [
        *(path for room in ROOMS for path in (ROOT / room).glob("*.py")),
        ROOT / "pair.py",
        ROOT / "align_pair.py",
    ]
)
PLAIN = {*range(-1, 5), 0.5}
"""Counts, signs, axes and halves explain themselves."""


def constants(tree: ast.Module) -> Iterator[tuple[ast.stmt, str]]:
    """Assignments to upper-case names at the module's top, with the text that follows them.

    Also the fields of options, which the docstring of their class explains.
    """
    for options in tree.body:
        if isinstance(options, ast.ClassDef) and options.name.endswith("Options"):
            text = ast.get_docstring(options) or ""
            fields = [node for node in options.body if isinstance(node, ast.AnnAssign)]
            yield from ((node, text) for node in fields)
    for number, node in enumerate(tree.body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
        names = [
            part.id for each in targets for part in ast.walk(each) if isinstance(part, ast.Name)
        ]
        if isinstance(node, ast.Assign | ast.AnnAssign) and all(map(str.isupper, names)):
            after = tree.body[number + 1] if number + 1 < len(tree.body) else None
            text = ""
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                text = str(after.value.value)
            yield node, text


def literals(node: ast.AST) -> Iterator[ast.Constant]:
    """Numbers in a piece of code that do not explain themselves."""
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and type(part.value) in (int, float):
            yield from [] if part.value in PLAIN else [part]


def offenders(source: str) -> list[str]:
    """Unnamed numbers, and named ones without a reason, as ``line: code``."""
    tree = ast.parse(source)
    lines = source.splitlines()
    named, found = set(), []
    for node, reason in constants(tree):
        numbers = list(literals(node))
        named.update(numbers)
        beside = lines[node.end_lineno - 1 if node.end_lineno else 0].partition("#")[2]
        if numbers and not (reason or beside):
            found.append(f"{node.lineno}: {lines[node.lineno - 1]}  (no reason)")
    found += [
        f"{number.lineno}: {lines[number.lineno - 1].strip()}"
        for number in literals(tree)
        if number not in named
    ]
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_number_of_the_method_is_named_and_has_a_reason(path: Path) -> None:
    assert offenders(path.read_text(encoding="utf-8")) == []


def test_numbers_without_a_name_or_a_reason_are_found() -> None:
    assert offenders("X = 7") == ["1: X = 7  (no reason)"]
    assert offenders("X = 7  # days of a week") == []
    assert offenders('X = 7\n"""Days of a week."""\n') == []
    assert offenders("def f(x):\n    return 7 * x + 0.5 * x[2]") == ["2: return 7 * x + 0.5 * x[2]"]
    assert offenders("class Options:\n    x: int = 7") == ["2:     x: int = 7  (no reason)"]
    assert offenders("def f(x=20): ...") == ["1: def f(x=20): ..."]
    assert offenders("def f(x): return x / 2 - 1") == []
