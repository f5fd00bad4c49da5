"""geodelreg and its peers side by side: error, wall time, CPU time and peak memory."""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.peers.environments import (
    ADAPTERS,
    OWN,
    PEERS,
    PeerUnavailableError,
    environment,
    own_command,
)
from benchmarks.processes import Usage, measured, own_environment
from benchmarks.records import read_transform
from benchmarks.report import machine
from benchmarks.scenes.truth import Truth, grid_rmse

CACHE = Path(__file__).parents[1] / ".cache"
QUICK_SCENES = ("A", "C", "G")
LOCAL = "local"
TIMEOUT_S = 300.0
"""For every tool, as tables say."""


@dataclass(frozen=True, slots=True)
class Result:
    """One run of one tool on one scene; errors in PAN pixels, NaN when it found nothing.

    Attributes
    ----------
    wall_s, cpu_s : float
        Of the whole process and its children, start-up included.
    peak_mb : float
        Largest resident set of any one process.
    failure : str
        Why there is no error figure; "" when there is one.
    """

    scene: str
    tool: str
    setting: str
    rmse_px: float
    p95_px: float
    max_px: float
    wall_s: float
    cpu_s: float
    peak_mb: float
    failure: str


@dataclass(frozen=True, slots=True)
class Tool:
    """Something that can be run on a scene: geodelreg, or a peer with a setting."""

    name: str
    setting: str
    python: Path | None
    script: Path | None

    def command(self, scene: Path, out: Path) -> list[str]:
        """Command line that writes `out` (a GeoTIFF for geodelreg, JSON for a peer)."""
        if self.script is None:
            return own_command(scene, out)
        return [
            str(self.python), str(self.script), "--ms", str(scene / "ms.tif"),
            "--pan", str(scene / "pan.tif"), "--out", str(out), "--setting", self.setting,
        ]  # fmt: skip


def attempt(tool: Tool, folder: Path, timeout_s: float) -> tuple[Usage, Path, str]:
    """Run a tool on ``ms.tif`` and ``pan.tif`` of a folder that holds nothing else.

    Returns
    -------
    usage : Usage
    out : Path
        What the tool wrote, if it did.
    failure : str
        Why it wrote nothing; "" when it did.
    """
    env = own_environment() if tool.script is None else {**os.environ, "PYTHONPATH": ""}
    out = folder / ("out.tif" if tool.script is None else "out.json")
    usage = measured(tool.command(folder, out), env, timeout_s, folder)
    failed = usage.status or not out.exists()
    return usage, out, (usage.last_line[:200] or f"exit {usage.status}") if failed else ""


def run_tool(tool: Tool, scene: Path, timeout_s: float) -> Result:
    """Run a tool on copies of a scene's rasters, without the truth, and score it."""
    truth = Truth.load(scene / "truth.json")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for raster in ("ms.tif", "pan.tif"):
            shutil.copy(scene / raster, folder / raster)
        usage, out, failure = attempt(tool, folder, timeout_s)
        error = dict.fromkeys(("rmse_px", "p95_px", "max_px"), math.nan)
        if not failure:
            error = grid_rmse(read_transform(out), truth)
    return Result(
        truth.name, tool.name, tool.setting, **error, wall_s=usage.wall_s, cpu_s=usage.cpu_s,
        peak_mb=usage.peak_mb, failure=failure,
    )  # fmt: skip


def available_tools(cache: Path, only: set[str], local: bool = False) -> Iterator[Tool]:
    """geodelreg, then every peer that can be built; the others are named with the reason.

    With `local`, the peers that follow what bends, with that setting.
    """
    yield Tool(OWN, LOCAL if local else "default", None, None)
    for peer in PEERS:
        settings = (LOCAL,) * peer.local if local else peer.settings
        if not settings or (only and peer.script not in only):
            continue
        try:
            python = environment(peer, cache)
        except PeerUnavailableError as error:
            print(f"{peer.name}: skipped, {error}", flush=True)
            continue
        for setting in settings:
            yield Tool(peer.name, setting, python, ADAPTERS / f"{peer.script}.py")


def add_tool_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments that all commands with peers have."""
    parser.add_argument("--peers", default="", help="adapters, comma-separated; 'none': geodelreg")
    parser.add_argument("--timeout", type=float, default=TIMEOUT_S, help="seconds a run may take")
    parser.add_argument("--envs", type=Path, default=CACHE, help="folder of the environments")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def named(text: str) -> set[str]:
    """Names between commas."""
    return set(filter(None, text.split(",")))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks peers``."""
    parser.add_argument("--scenes", type=Path, required=True, help="folder that `scenes` wrote")
    parser.add_argument(
        "--out", type=Path, required=True, help="JSON file for the results; a run continues it"
    )
    parser.add_argument("--only", default="", help="scenes, comma-separated")
    parser.add_argument("--quick", action="store_true", help="scenes A, C and G only")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each, the fastest counts")
    add_tool_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run every tool on every scene, one after the other, and write the results."""
    tools = list(available_tools(args.envs, named(args.peers)))
    wanted = named(args.only)
    wanted = wanted or (set(QUICK_SCENES) if args.quick else set())
    host, results = machine(), []
    if args.out.exists():
        results = [Result(**row) for row in json.loads(args.out.read_text())["results"]]
    done = {(result.scene, result.tool, result.setting) for result in results}
    for scene in sorted(path.parent for path in args.scenes.glob("*/truth.json")):
        if wanted and scene.name not in wanted:
            continue
        for tool in tools:
            if (Truth.load(scene / "truth.json").name, tool.name, tool.setting) in done:
                continue
            runs = [run_tool(tool, scene, args.timeout) for _ in range(args.repeat)]
            best = min(runs, key=lambda result: result.wall_s)
            results.append(best)
            print(
                f"{best.scene} {best.tool} ({best.setting}): {best.rmse_px:.4f} px, "
                f"{best.wall_s:.1f} s, {best.cpu_s:.1f} CPU s, {best.peak_mb:.0f} MB "
                f"{best.failure}",
                flush=True,
            )
            args.out.write_text(
                json.dumps({"machine": host, "results": [asdict(r) for r in results]}, indent=2)
            )
    if args.docs:
        from benchmarks.peers.table import write_page

        write_page(args.out, args.docs, args.timeout)
    return 0
