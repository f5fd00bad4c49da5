"""MS warped onto PAN's grid, by an affine and by a field, beside GDAL's own warper."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import rasterio

from benchmarks.processes import Usage, measured, own_environment
from benchmarks.report import machine, replace_section
from benchmarks.sharpening.large import make

SIDE_PX = 10_000
MOST_MB, AFFINE_FACTOR, FIELD_FACTOR = 600, 1.2, 1.5
"""Most memory, and most time against gdalwarp."""
WAVE_PX, WAVE_LENGTH_PX = 0.5, 940.0
"""Of the field: MS pixels."""
_POINTS_AXIS = 20
_TIMEOUT_S = 1800.0
_CREATION = ("TILED=YES", "BLOCKXSIZE=256", "BLOCKYSIZE=256", "COMPRESS=DEFLATE", "PREDICTOR=2")
"""As geodelreg writes warped rasters."""


def write_points(folder: Path, wave_px: float) -> str:
    """Points that shift, turn and, where there is a wave, bend MS; their file's name."""
    name = "field.csv" if wave_px else "affine.csv"
    with rasterio.open(folder / "ms_whole.tif") as ms, (folder / name).open("w") as file:
        rows = csv.writer(file)
        rows.writerow(("id", "column", "line", "x", "y", "enable"))
        height, width = ms.shape
        lattice = np.meshgrid(
            np.linspace(40, width - 40, _POINTS_AXIS), np.linspace(40, height - 40, _POINTS_AXIS)
        )
        turns = 2 * np.pi / WAVE_LENGTH_PX
        for n, (c, r) in enumerate(zip(*(axis.ravel().tolist() for axis in lattice), strict=True)):
            there = (
                c + 0.8 + 1e-4 * r + wave_px * np.sin(turns * r),
                r - 0.6 - 1e-4 * c + wave_px * np.cos(turns * c),
            )
            rows.writerow((n, c, r, *map(float, ms.transform @ there), 1))
    return name


def warped(folder: Path, points: str, model: str) -> Usage:
    """``geodelreg refit --warp --grid pan``, whole process: the fit takes a second of it."""
    command = [
        sys.executable, "-m", "geodelreg_cli", "refit", points, "ms_whole.tif", "pan.tif",
        "--model", model, "-o", f"{model}.tif", "--warp", "--grid", "pan", "--max-shift", "1000",
        "--overwrite", "--quiet",
    ]  # fmt: skip
    return measured(command, own_environment(), _TIMEOUT_S, folder)


def by_gdal(folder: Path, resampling: str) -> Usage:
    """`gdalwarp` of the same affine: MS with the corrected header, onto PAN's grid."""
    with rasterio.open(folder / "pan.tif") as pan:
        left, bottom, right, top = map(repr, pan.bounds)
        size = [str(pan.width), str(pan.height)]
    command = [
        "gdalwarp", "-q", "-overwrite", "-r", resampling, "-te", left, bottom, right, top,
        "-ts", *size, "-multi", "-wo", "NUM_THREADS=ALL_CPUS", "-co", "BIGTIFF=IF_SAFER",
        "-co", "NUM_THREADS=ALL_CPUS",
        *(text for option in _CREATION for text in ("-co", option)),
        "header.tif", "gdal.tif",
    ]  # fmt: skip
    return measured(command, own_environment(), _TIMEOUT_S, folder)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks warp``."""
    parser.add_argument("--folder", type=Path, required=True, help="for 2 GB of files; kept")
    parser.add_argument("--side", type=int, default=SIDE_PX, help="of PAN, pixels")
    parser.add_argument("--repeat", type=int, default=3, help="runs of each, in turn")
    parser.add_argument("--resampling", default="cubic", help="of both")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def run(args: argparse.Namespace) -> int:
    """1 where memory or time is above what is promised."""
    folder = args.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    make(folder, args.side)
    affine, field = write_points(folder, 0.0), write_points(folder, WAVE_PX)
    header = [
        sys.executable, "-m", "geodelreg_cli", "refit", affine, "ms_whole.tif", "--model",
        "affine", "-o", "header.tif", "--max-shift", "1000", "--overwrite", "--quiet",
    ]  # fmt: skip
    measured(header, own_environment(), _TIMEOUT_S, folder)
    ways: dict[str, Callable[[], Usage]] = {
        "gdalwarp, affine": lambda: by_gdal(folder, args.resampling),
        "geodelreg, affine": lambda: warped(folder, affine, "affine"),
        "geodelreg, field": lambda: warped(folder, field, "field"),
    }
    found: dict[str, list[Usage]] = {name: [] for name in ways}
    for _ in range(args.repeat):
        for name, way in ways.items():
            found[name].append(way())
            print(name, found[name][-1], flush=True)
            if found[name][-1].status:
                return 1
    base = found["gdalwarp, affine"]
    lines = ["| | s | CPU s | MB | time of gdalwarp's |", "|---|---|---|---|---|"]
    good = True
    for name, runs in found.items():
        ratio = median(one.wall_s / other.wall_s for one, other in zip(runs, base, strict=True))
        wall, cpu = (median(getattr(one, key) for one in runs) for key in ("wall_s", "cpu_s"))
        peak = max(one.peak_mb for one in runs)
        lines.append(f"| {name} | {wall:.1f} | {cpu:.1f} | {peak:.0f} | {ratio:.2f} |")
        if name.startswith("geodelreg"):
            most = FIELD_FACTOR if name.endswith("field") else AFFINE_FACTOR
            good &= peak <= MOST_MB and ratio <= most
    print("\n".join(lines))
    if args.docs is not None:
        about = (
            f"`python -m benchmarks warp --folder D`: four uint16 bands of {args.side // 4}² onto "
            f"a PAN grid of {args.side}², {args.resampling}, both compressed alike, in turn, "
            f"medians of {args.repeat}, on {machine()}. The whole process is measured; geodelreg's "
            f"reads control points and fits before. Allowed are {MOST_MB} MB, "
            f"{AFFINE_FACTOR:g} and {FIELD_FACTOR:g} times gdalwarp's time."
        )
        table = "\n".join(lines)
        replace_section(args.docs, "warp", f"## What a warp costs\n\n{about}\n\n{table}")
    return 0 if good else 1
