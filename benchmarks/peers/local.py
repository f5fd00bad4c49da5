"""Pairs that bend: geodelreg's field and the peers that follow such ground, by the known truth."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.accuracy.field import TEXTURES, Case, make, run_case
from benchmarks.gate.bent_cases import BentPair
from benchmarks.peers.run import Tool, add_tool_arguments, attempt, available_tools, named
from benchmarks.records import Row, keep, resume
from benchmarks.report import machine, replace_section
from benchmarks.scenes.make import write_scene
from benchmarks.scenes.truth import check_points

CASES = (
    *(Case("satellite", 2.0, length) for length in (600, 1200, 2400)),
    Case("aerial", 2.0, 1200),
)
_ABOUT = """## Pairs that bend, side by side

`python -m benchmarks peers-local --data DIR --out FILE --docs docs/benchmarks.md` ({machine};
{limit:g} s for each run). Waves of 2 PAN px, by their length, on PAN 2000² and MS 450² at 4:1
(aerial: smaller). Each cell: RMSE in PAN px over 21 × 21 places from edge to edge / CPU time, of
which up to twice as much fits into the wall time, of the whole process, which writes no pixels. All
peers work on the bands weighted as PAN sees them, with PAN low-passed as MS is. The field through
AROSICS's, KARIOS's and pandora2d's points is the adapter's (thin plates, outliers left out).
– = refused, failed, or not in time."""


def run_local(tool: Tool, case: Case, pair: BentPair, timeout_s: float) -> Row:
    """Give one pair to one tool, and compare with the truth."""
    row: Row = {"case": case.name, "tool": tool.name}
    if tool.script is None:
        own = run_case(case, pair)
        kept = {"rmse_px": own.get("rmse_px", math.nan), "failure": ", ".join(own["failed"])}
        return row | kept | {"wall_s": own["seconds"], "cpu_s": own["cpu_s"]}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(pair.scene, folder)
        (folder / "truth.json").unlink()
        usage, out, failure = attempt(tool, folder, timeout_s)
        row |= {
            "wall_s": usage.wall_s,
            "cpu_s": usage.cpu_s,
            "peak_mb": usage.peak_mb,
            "failure": failure,
        }
        if failure:
            return row | {"rmse_px": math.nan}
        found = np.array(json.loads(out.read_text())["points"])
    error = found - pair.pan_px(check_points(pair.scene.truth.ms_shape))
    return row | {"rmse_px": float(np.sqrt((error**2).sum(axis=1).mean()))}


def table(rows: list[Row]) -> str:
    """Tools as rows, cases as columns, as Markdown."""
    cases = list(dict.fromkeys(row["case"] for row in rows))
    lines = ["| tool | " + " | ".join(cases) + " |", "|---" * (len(cases) + 1) + "|"]
    for tool in dict.fromkeys(row["tool"] for row in rows):
        found = {row["case"]: row for row in rows if row["tool"] == tool}
        lines.append(f"| {tool} | " + " | ".join(_cell(found.get(case)) for case in cases) + " |")
    return "\n".join(lines)


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    error = f"{row['rmse_px']:.3f}" if math.isfinite(row["rmse_px"]) else "–"
    return f"{error} / {row['cpu_s']:.1f} s"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks peers-local``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real imagery")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; a run continues them")
    add_tool_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Every tool on every case, one after the other."""
    rows = resume(args.out)
    done = {(row["case"], row["tool"]) for row in rows}
    tools = list(available_tools(args.envs, named(args.peers), local=True))
    for case in CASES:
        todo = [tool for tool in tools if (case.name, tool.name) not in done]
        pair = make(case, TEXTURES[case.texture](args.data)) if todo else None
        for tool in todo:
            assert pair is not None
            keep(rows, run_local(tool, case, pair, args.timeout), args.out)
    if args.docs:
        about = _ABOUT.format(machine=machine(), limit=args.timeout)
        replace_section(args.docs, "peers-local", f"{about}\n\n{table(rows)}")
    return 0
