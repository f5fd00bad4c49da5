"""Real pairs: geodelreg and its peers, by a windowed correlation that shares no code with any."""

from __future__ import annotations

import argparse
import math
import shutil
import tempfile
from pathlib import Path

import rasterio

from benchmarks.accuracy.real_pairs import PAIRS, Pair, measure_pair
from benchmarks.peers.environments import OWN
from benchmarks.peers.run import Tool, add_tool_arguments, attempt, available_tools, named
from benchmarks.records import Row, keep, read_transform, resume
from benchmarks.report import machine, replace_section

EXTRA = (
    Pair("worldview2_city", "worldview2_city/ms.tif", "worldview2_city/pan.tif", 1, 0, 32, 16),
    Pair("aerial_on_sentinel2", "aerial_on_sentinel2/ms.tif", "aerial_on_sentinel2/pan.tif", 1),
)
BEFORE = "as delivered"
_ABOUT = """## Real pairs, side by side

`python -m benchmarks peers-real --data DIR --out FILE --docs docs/benchmarks.md` ({machine};
{limit:g} s for each run). Every tool gets the same two files, PAN as a file of one band. What it
says is measured by a windowed correlation that shares no code with any of them: the length of the
median offset / the median length of the windows' offsets, in PAN px. The measurement itself is good
to about 0.05 px, and to 0.1 or 0.2 px where images are small or years apart: smaller differences
say nothing. – = refused or failed."""


def run_pair(tool: Tool, pair: Pair, data: Path, timeout_s: float) -> Row:
    """Give one pair to one tool, and measure what it says."""
    row: Row = {"pair": pair.name, "tool": tool.name, "setting": tool.setting}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(data / pair.ms, folder / "ms.tif")
        one_band(data / pair.pan, pair.pan_band, folder / "pan.tif")
        usage, out, failure = attempt(tool, folder, timeout_s)
        row |= {"wall_s": usage.wall_s, "peak_mb": usage.peak_mb, "failure": failure}
        if failure:
            return row
        found = measure_pair(pair, data, read_transform(out))
    return row | {"off_px": found.distance_px, "radial_px": found.radial_px}


def one_band(source: Path, band: int, out: Path) -> None:
    """A copy of one band."""
    with rasterio.open(source) as raster:
        profile = raster.profile | {"count": 1, "driver": "GTiff"}
        with rasterio.open(out, "w", **profile) as copy:
            copy.write(raster.read(band), 1)


def table(rows: list[Row]) -> str:
    """Tools as rows, pairs as columns, as Markdown."""
    pairs = list(dict.fromkeys(row["pair"] for row in rows))
    tools = list(dict.fromkeys((row["tool"], row["setting"]) for row in rows))
    found = {(row["tool"], row["setting"], row["pair"]): row for row in rows}
    lines = ["| tool | " + " | ".join(pairs) + " |", "|---" * (len(pairs) + 1) + "|"]
    for tool, setting in tools:
        label = tool if tool in (OWN, BEFORE) else f"{tool}, {setting}"
        cells = [_cell(found.get((tool, setting, pair))) for pair in pairs]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    off = row.get("off_px", math.nan)
    return f"{off:.2f} / {row['radial_px']:.2f}" if math.isfinite(off) else "–"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks peers-real``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real pairs")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; a run continues them")
    parser.add_argument("--only", default="", help="pairs, comma-separated")
    add_tool_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Every tool on every pair that is there."""
    rows = resume(args.out)
    done = {(row["pair"], row["tool"], row["setting"]) for row in rows}
    wanted, only = map(named, (args.only, args.peers))
    tools = list(available_tools(args.envs, only))
    for pair in (*PAIRS, *EXTRA):
        there = all((args.data / name).exists() for name in (pair.ms, pair.pan))
        if not there or (wanted and pair.name not in wanted):
            continue
        if (pair.name, BEFORE, "") not in done:
            found = measure_pair(pair, args.data)
            before = {"off_px": found.distance_px, "radial_px": found.radial_px}
            keep(rows, {"pair": pair.name, "tool": BEFORE, "setting": ""} | before, args.out)
        for tool in tools:
            if (pair.name, tool.name, tool.setting) not in done:
                keep(rows, run_pair(tool, pair, args.data, args.timeout), args.out)
    if args.docs:
        about = _ABOUT.format(machine=machine(), limit=args.timeout)
        replace_section(args.docs, "peers-real", f"{about}\n\n{table(rows)}")
    return 0
