"""Where the time of one alignment goes: start, stages, output, and a later pair of a process."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.peers.speed import ALLOWED, later_pairs
from benchmarks.processes import Usage, measured, own_environment
from benchmarks.report import machine, replace_section

STAGES = ("open", "read", "search", "read tiles", "refine", "fit", "evidence")
"""As the report names them, in the order of the work."""
_TIMEOUT_S = 300.0
_IMPORTS = "import geodelreg_cli.align, geodelreg.api, geodelreg.writing"
_LIBRARIES = "import cv2, numpy, rasterio"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks stages``."""
    parser.add_argument("--scenes", type=Path, required=True, help="folder that `scenes` wrote")
    parser.add_argument("--only", default=",".join(ALLOWED), help="scenes, comma-separated")
    parser.add_argument("--repeat", type=int, default=5, help="runs, of which the fastest counts")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def _fastest(command: list[str], folder: Path, repeat: int) -> tuple[Usage, str]:
    """The fastest of several runs, and the report that it wrote, if any."""
    runs = []
    for _ in range(repeat):
        usage = measured([sys.executable, *command], own_environment(), _TIMEOUT_S, folder)
        if usage.status:
            raise subprocess.CalledProcessError(usage.status, command, stderr=usage.last_line)
        report = folder / "report.json"
        runs.append((usage, report.read_text() if report.exists() else ""))
    return min(runs, key=lambda run: run[0].wall_s)


def imports(repeat: int) -> tuple[float, float]:
    """CPU seconds of a process that loads the libraries, and what our own modules add to it.

    One thread loads them, so on a quiet machine that is the wall time, too.
    """
    with tempfile.TemporaryDirectory() as name:
        libraries, all_of_them = (
            min(_fastest(["-c", code], Path(name), 1)[0].cpu_s for _ in range(2 * repeat))
            for code in (_LIBRARIES, _IMPORTS)
        )
    return libraries, all_of_them - libraries


def row(scene: Path, repeat: int, loaded: tuple[float, float]) -> str:
    """One line of the table, in milliseconds."""
    with tempfile.TemporaryDirectory() as name:
        align = [
            "-m", "geodelreg_cli", "align", str(scene / "ms.tif"), str(scene / "pan.tif"),
            "-o", "out.tif", "--report", "report.json", "--overwrite", "--quiet",
        ]  # fmt: skip
        whole, report = _fastest(align, Path(name), repeat)
    seconds = json.loads(report)["timings_s"]
    rest = whole.wall_s - sum(loaded) - seconds["total"]
    shown = [*loaded, *(seconds[stage] for stage in STAGES), rest]
    shown += [whole.wall_s, whole.cpu_s, later_pairs(scene, repeat)]
    return f"| {scene.name} | {' | '.join(f'{1000 * value:.0f}' for value in shown)} |"


def run(args: argparse.Namespace) -> int:
    """Print a line for each scene, and write the section."""
    host, loaded = machine(), imports(args.repeat)
    heads = ("scene", "libraries", "own modules", *STAGES, "output, end", "wall", "CPU", "later")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in args.only.split(","):
        lines.append(row(args.scenes / name, args.repeat, loaded))
        print(lines[-1], flush=True)
    if args.docs:
        text = (
            "## Where the milliseconds go\n\n"
            f"`python -m benchmarks stages --scenes DIR --docs docs/benchmarks.md` ({host}).\n\n"
            "Milliseconds of one `geodelreg align`, the fastest of "
            f"{args.repeat} runs. *Libraries* is the CPU time of a process that imports OpenCV, "
            "numpy and rasterio, which a script has to load, too. *Own modules* is what the "
            "command line and the method add to it. The stages are those of the JSON report. "
            "*Output, end* is the rest of the wall time: the copy, its checks, the report and the "
            "end of the process. *Later* is a pair in a process that has aligned one before.\n\n"
            + "\n".join(lines)
        )
        replace_section(args.docs, "stages", text)
    return 0
