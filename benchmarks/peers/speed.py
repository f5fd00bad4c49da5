"""Wall time beside the script that one writes first, in turn, in one run.

Both start a process of their own, read the same copies and write a corrected raster.  They take
turns, so that whatever else the machine does meets both alike, and the fastest run of each counts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from benchmarks.peers.environments import ADAPTERS, OWN
from benchmarks.peers.run import Result, Tool, run_tool
from benchmarks.processes import ROOT, own_environment
from benchmarks.report import machine, replace_section

SCRIPT = "half_size_sift"
ALLOWED = dict.fromkeys("ABDEI", 1.0) | {"C": 1.2, "aerial": 1.2}
"""Wall time over that of the script."""
_LONG_LIVED = """
import json, sys, time
import geodelreg
seconds = []
for _ in range(int(sys.argv[3])):
    began = time.perf_counter()
    geodelreg.align(sys.argv[1], sys.argv[2])
    seconds.append(time.perf_counter() - began)
print(json.dumps(seconds))
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks speed``."""
    parser.add_argument("--scenes", type=Path, required=True, help="folder that `scenes` wrote")
    parser.add_argument("--only", default=",".join(ALLOWED), help="scenes, comma-separated")
    parser.add_argument("--repeat", type=int, default=5, help="turns")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def turns(scene: Path, repeat: int) -> tuple[Result, Result]:
    """The fastest run of geodelreg and that of the script."""
    own = Tool(OWN, "default", None, None)
    script = Tool("half-size SIFT", "default", Path(sys.executable), ADAPTERS / f"{SCRIPT}.py")
    runs = [[run_tool(tool, scene, 300.0) for tool in (own, script)] for _ in range(repeat)]
    mine, theirs = (min(each, key=lambda run: run.wall_s) for each in zip(*runs, strict=True))
    return mine, theirs


def row(mine: Result, theirs: Result, later_s: float) -> str:
    """One line of the table."""
    ratio, allowed = mine.wall_s / theirs.wall_s, ALLOWED.get(mine.scene)
    met = "" if allowed is None else f" (≤ {allowed}: {'met' if ratio <= allowed else 'not met'})"
    return (
        f"| {mine.scene} | {mine.wall_s:.2f} s, {mine.cpu_s:.2f} CPU s, {mine.peak_mb:.0f} MB | "
        f"{mine.rmse_px:.4f} | {theirs.wall_s:.2f} s, {theirs.cpu_s:.2f} CPU s, "
        f"{theirs.peak_mb:.0f} MB | {theirs.rmse_px:.4f} | {ratio:.2f}{met} | {later_s:.2f} s |"
    )


def later_pairs(scene: Path, repeat: int) -> float:
    """Seconds of a pair in a process that has aligned one before, the fastest."""
    command = [
        sys.executable, "-c", _LONG_LIVED, str(scene / "ms.tif"), str(scene / "pan.tif"),
        str(repeat + 1),
    ]  # fmt: skip
    done = subprocess.run(
        command, cwd=ROOT, env=own_environment(), capture_output=True, text=True, check=True
    )
    seconds: list[float] = json.loads(done.stdout)
    return min(seconds[1:])


def run(args: argparse.Namespace) -> int:
    """Print a line for each scene, and write the section; 1 when a limit is not met."""
    lines = [
        "| scene | geodelreg | RMSE, px | script | RMSE, px | wall, ratio | later pairs |",
        "|---|---|---|---|---|---|---|",
    ]
    missed, host = 0, machine()
    for name in args.only.split(","):
        mine, theirs = turns(args.scenes / name, args.repeat)
        missed += mine.wall_s > ALLOWED.get(mine.scene, float("inf")) * theirs.wall_s
        lines.append(row(mine, theirs, later_pairs(args.scenes / name, args.repeat)))
        print(lines[-1], flush=True)
    if args.docs:
        text = (
            "## Beside the quick script\n\n"
            f"`python -m benchmarks speed --scenes DIR --docs docs/benchmarks.md` ({host}).\n\n"
            "The script reads both rasters, averages PAN to half its size, and matches SIFT "
            f"keypoints (`benchmarks/peers/adapters/{SCRIPT}.py`). Both run in turn as processes "
            f"of their own; the fastest of {args.repeat} counts. Later pairs are those of a "
            "process that has aligned one before.\n\n" + "\n".join(lines)
        )
        replace_section(args.docs, "speed", text)
    return 1 if missed else 0
