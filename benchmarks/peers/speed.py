"""Wall time and error beside two OpenCV scripts: the one written first, and an expert's.

Each starts a process of its own, reads the same files and says a corrected geotransform.  They take
turns, so that whatever else the machine does meets all alike, and the fastest run of each counts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.peers.environments import ADAPTERS, OWN
from benchmarks.peers.run import Result, Tool, run_tool
from benchmarks.processes import ROOT, own_environment
from benchmarks.report import machine, replace_section

SCRIPTS = ("half_size_sift", "default"), ("opencv_expert", "expert")
"""Adapters, each with its setting."""
ALLOWED = dict.fromkeys("ABDEI", 1.0) | {"C": 1.2, "aerial": 1.2}
"""Wall time over that of the first script."""
BEYOND = ("G", "H", "J", "K", "L", "M")
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
    parser.add_argument(
        "--only", default=",".join((*ALLOWED, *BEYOND)), help="scenes, comma-separated"
    )
    parser.add_argument("--repeat", type=int, default=5, help="turns")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def turns(scene: Path, repeat: int) -> list[Result]:
    """The fastest run of geodelreg and of each script."""
    tools = [Tool(OWN, "default", None, None)]
    for script, setting in SCRIPTS:
        tools.append(Tool(script, setting, Path(sys.executable), ADAPTERS / f"{script}.py"))
    runs = [[run_tool(tool, scene, 300.0) for tool in tools] for _ in range(repeat)]
    return [min(each, key=lambda run: run.wall_s) for each in zip(*runs, strict=True)]


def row(results: Sequence[Result], later_s: float) -> str:
    """One line of the table."""
    mine, quick, expert = results
    allowed = ALLOWED.get(mine.scene)
    ratio = mine.wall_s / quick.wall_s
    met = "" if allowed is None else f" (≤ {allowed}: {'met' if ratio <= allowed else 'not met'})"
    cells = [
        f"{one.rmse_px:.4f} px, {one.wall_s:.2f} s, {one.cpu_s:.2f} CPU s, {one.peak_mb:.0f} MB"
        for one in results
    ]
    more = [f"{ratio:.2f}{met}", f"{expert.rmse_px / mine.rmse_px:.1f}", f"{later_s:.2f} s"]
    return f"| {' | '.join([mine.scene, *cells, *more])} |"


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
        "| scene | geodelreg | quick script | expert's script | wall ratio | RMSE ratio | later |",
        "|---|---|---|---|---|---|---|",
    ]
    missed, host = 0, machine()
    for name in args.only.split(","):
        results = turns(args.scenes / name, args.repeat)
        mine, quick, _ = results
        missed += mine.wall_s > ALLOWED.get(mine.scene, float("inf")) * quick.wall_s
        lines.append(row(results, later_pairs(args.scenes / name, args.repeat)))
        print(lines[-1], flush=True)
    if args.docs:
        text = (
            "## Beside OpenCV scripts\n\n"
            f"`python -m benchmarks speed --scenes DIR --docs docs/benchmarks.md` ({host}).\n\n"
            "The quick script averages PAN to half its size, matches SIFT keypoints and takes "
            "RANSAC's affine (`benchmarks/peers/adapters/half_size_sift.py`). The expert's matches "
            "SIFT keypoints at the resolution of MS, takes MAGSAC's affine, weights the bands by "
            "least squares, and maximises the enhanced correlation coefficient "
            "(`opencv_expert.py`). Scenes K to M break what we assume: PAN holds infrared light "
            "that no MS band saw; MS is JPEG of 8 bits; the optics of MS are soft. All run in turn "
            f"as processes of their own; the fastest of {args.repeat} counts. The ratios are our "
            "wall time to the quick script's, and the expert's error to ours. Later: a pair in a "
            "process that has aligned one before.\n\n" + "\n".join(lines)
        )
        replace_section(args.docs, "speed", text)
    return 1 if missed else 0
