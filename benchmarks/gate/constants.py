"""Numbers of the method that were chosen by hand, halved and doubled: which matter."""

from __future__ import annotations

import argparse
import ast
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import geodelreg
from benchmarks.gate.ablate import Work, accepted, attempt, works, wrong
from benchmarks.gate.rules import Rule
from benchmarks.records import Row, keep, resume

MARK = "by hand"
"""Of a constant's comment: no derivation or experiment set it, this one tried it."""
PACKAGE = Path(geodelreg.__file__).parent
GROUP = 6
"""Constants that are changed together at first: most make no difference."""
WORSE = 1.25
"""Times the error, and `WORSE_PX` more, that is a difference."""
WORSE_PX = 0.003


class Change(NamedTuple):
    """A constant of a module, and what it is multiplied by."""

    module: str
    name: str
    factor: float

    @property
    def place(self) -> str:
        """Its full name."""
        return f"{self.module}.{self.name}"

    def __str__(self) -> str:
        return f"{self.place} × {self.factor:g}"


def constants() -> Iterator[tuple[str, str]]:
    """Module and name of each numeric constant whose comment has the mark."""
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        lines, body = source.splitlines(), ast.parse(source).body
        for node, after in pairwise([*body, ast.Pass()]):
            if not isinstance(node, ast.Assign):
                continue
            said = lines[(node.end_lineno or 1) - 1].partition("#")[2]
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                said += str(after.value.value)
            module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
            for part in ast.walk(node.targets[0]) if MARK in said else ():
                if isinstance(part, ast.Name):
                    yield module, part.id


def scaled(value: Any, factor: float) -> Any:
    """A number, or each of a tuple, times a factor; shares stay below 1, counts whole."""
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    if isinstance(value, int) and value < 50:
        return max(1, round(value * factor))
    for whole in (1.0, 100.0):  # shares, percentages
        if whole / 2 <= value < whole:
            return whole - (whole - value) / factor
    return type(value)(value * factor)


def changed(changes: list[Change]) -> Rule:
    """A rule whose switching off changes constants."""
    off: dict[str, Callable[[Any], Any]] = {
        one.place: partial(scaled, factor=one.factor) for one in changes
    }
    return Rule(" + ".join(map(str, changes)), off, {})


def differences(base: Row, row: Row) -> list[str]:
    """In what a pair came out worse, or otherwise, than without the change."""
    if row["outcome"].startswith("crash"):
        return ["crashed"]
    if wrong(row) and not wrong(base):
        return ["wrong"]
    if accepted(base) != accepted(row):
        return ["refused" if accepted(base) else "aligned"]
    before, after = base["error_px"] or 0.0, row["error_px"] or 0.0
    if before and after > WORSE * before + WORSE_PX:
        return [f"{after / before:.1f} times the error"]
    return []


def tried(
    changes: list[Change], pairs: list[Work], base: dict[str, Row], rows: list[Row], out: Path
) -> None:
    """Change constants together; where that makes a difference, halves of them, down to each."""
    rule = changed(changes)
    if rule.name not in {row["rule"] for row in rows if row["rule"]}:
        found = []
        for work in pairs:
            found += differences(base[work.name], attempt(work, rule))
            if found and len(changes) > 1:
                break
        keep(rows, {"pair": "", "rule": rule.name, "differences": found}, out)
    different = next(row["differences"] for row in rows if row["rule"] == rule.name)
    if different and len(changes) > 1:
        middle = len(changes) // 2
        for half in (changes[:middle], changes[middle:]):
            tried(half, pairs, base, rows, out)


def run(args: argparse.Namespace) -> int:
    """Try what is missing: constants in groups, on the quickest pair of each kind."""
    warnings.simplefilter("ignore")
    rows = resume(args.out)
    done = {row["pair"] for row in rows}
    made = list(works(args.data, args.scenes, args.out.parent / "pairs", args.count))
    for work in made:
        if work.name not in done:
            keep(rows, attempt(work), args.out)
    base = {row["pair"]: row for row in rows if row["pair"]}
    slowest_first = sorted(made, key=lambda work: base[work.name]["cpu_s"], reverse=True)
    quickest = {work.name.split("/")[0]: work for work in slowest_first}
    pairs = sorted(quickest.values(), key=lambda work: base[work.name]["cpu_s"])
    found = list(constants())
    for factor in (0.5, 2.0):
        changes = [Change(module, name, factor) for module, name in found]
        for start in range(0, len(changes), GROUP):
            tried(changes[start : start + GROUP], pairs, base, rows, args.out)
    print(table(rows, found))
    return 0


def table(rows: list[Row], found: list[tuple[str, str]]) -> str:
    """Constants that matter, as a Markdown table."""
    tries = {row["rule"]: row["differences"] for row in rows if row["rule"]}
    lines = ["| constant | halved | doubled |", "|---|---|---|"]
    for module, name in found:
        cells = []
        for factor in (0.5, 2.0):
            mine = str(Change(module, name, factor))
            what = tries.get(mine, [])
            cells.append(", ".join(sorted(f"{what.count(w)} {w}" for w in set(what))) or "—")
        if set(cells) != {"—"}:
            lines.append(
                f"| `{module.removeprefix('geodelreg.')}.{name}` | {cells[0]} | {cells[1]} |"
            )
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks constants``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real imagery")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of `benchmarks scenes`")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; a run continues it")
    parser.add_argument(
        "--count", type=int, default=48, help="pairs of the gate that can be aligned"
    )
