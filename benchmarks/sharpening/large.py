"""A large pair: sharpened beside GDAL's own tools, and aligned from arrays of dask."""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

from benchmarks.processes import Usage, measured, own_environment
from benchmarks.report import machine

RATIO = 4
GAINS = (0.6, 0.8, 1.0, 1.2)
"""Of the bands of MS, against PAN."""
SHARPEN_MB, SHARPEN_FACTOR = 700, 1.2
"""Most memory of a pair of 10 000², and most time against GDAL's tools."""
DASK_MB = 150
"""Most memory above reading the arrays."""
CHUNK = 2048
_BLOCK = 512
_TIMEOUT_S = 3600.0
_CREATION = ("TILED=YES", "COMPRESS=DEFLATE", "ZLEVEL=1", "PREDICTOR=2", "BIGTIFF=IF_SAFER")
"""As geodelreg writes sharpened rasters."""
_OPENED = (
    "import sys, rioxarray; "
    f"ms, pan = (rioxarray.open_rasterio(p, chunks={CHUNK}) for p in sys.argv[1:]); "
)
_READ = _OPENED + "[each.max().compute() for each in (ms, pan)]"
_ALIGN = _OPENED + "import geodelreg; geodelreg.align(ms, pan)"


def make(folder: Path, side: int) -> None:
    """Write what is not there: a pair to align, and MS that covers PAN to sharpen."""
    from benchmarks.scale.pairs import write_pair
    from benchmarks.scenes.imagery import sample_imagery

    if not (folder / "truth.json").exists():
        write_pair(folder, side, sample_imagery())
    whole = folder / "ms_whole.tif"
    if whole.exists():
        return
    with rasterio.open(folder / "pan.tif") as pan:
        shape = {"count": len(GAINS), "height": side // RATIO, "width": side // RATIO}
        profile = pan.profile | shape | {"transform": pan.transform @ Affine.scale(RATIO)}
        with rasterio.open(whole, "w", **profile) as ms:
            for _, window in ms.block_windows(1):
                rows, columns = window.toslices()
                seen = tuple((part.start * RATIO, part.stop * RATIO) for part in (rows, columns))
                size = (rows.stop - rows.start, columns.stop - columns.start)
                fine = pan.read(1, window=seen).astype(np.float32)
                mean = fine.reshape(size[0], RATIO, size[1], RATIO).mean(axis=(1, 3))
                bands = np.stack([np.rint(gain * mean) for gain in GAINS])
                ms.write(bands.astype(profile["dtype"]), window=window)


def sharpened(folder: Path, weights: str = "equal") -> Usage:
    """``geodelreg pansharpen --no-align``, whole process; GDAL's tools know equal weights only."""
    command = [
        sys.executable, "-m", "geodelreg_cli", "pansharpen", "ms_whole.tif", "pan.tif",
        "-o", "ours.tif", "--no-align", "--overwrite", "--quiet", "--weights", weights,
    ]  # fmt: skip
    return measured(command, own_environment(), _TIMEOUT_S, folder)


def by_gdal(folder: Path) -> Usage:
    """`gdalwarp` onto PAN's grid, then `gdal_pansharpen.py`."""
    with rasterio.open(folder / "pan.tif") as pan:
        left, bottom, right, top = map(repr, pan.bounds)
        size = [str(pan.width), str(pan.height)]
    warp = [
        "gdalwarp", "-q", "-overwrite", "-r", "cubic", "-te", left, bottom, right, top, "-ts",
        *size, "-multi", "-wo", "NUM_THREADS=ALL_CPUS", "-co", "TILED=YES", "-co",
        "BIGTIFF=IF_SAFER", "ms_whole.tif", "onto_pan.tif",
    ]  # fmt: skip
    creation = [text for option in _CREATION for text in ("-co", option)]
    sharpen = ["gdal_pansharpen.py", "-q", "-threads", "ALL_CPUS", *creation]
    sharpen += ["-co", "NUM_THREADS=ALL_CPUS", "pan.tif", "onto_pan.tif", "theirs.tif"]
    text = f"rm -f theirs.tif && {shlex.join(warp)} && {shlex.join(sharpen)}"
    return measured(["sh", "-c", text], own_environment(), _TIMEOUT_S, folder)


def of_dask(folder: Path, code: str) -> Usage:
    """A process that does something with the pair as arrays of dask."""
    command = [sys.executable, "-W", "ignore", "-c", code, "ms.tif", "pan.tif"]
    return measured(command, own_environment(), _TIMEOUT_S, folder)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks sharpen``."""
    parser.add_argument("--folder", type=Path, required=True, help="for the rasters, which stay")
    parser.add_argument("--side", type=int, default=10_000, help="of PAN, pixels; 4 divides it")
    parser.add_argument("--repeat", type=int, default=1, help="of each the fastest run counts")


def run(args: argparse.Namespace) -> int:
    """Measure, print the table, and tell by the exit code whether all limits are kept."""
    folder = args.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    # this process must stay smaller than what it measures
    code = "import sys; from benchmarks.sharpening.large import make; from pathlib import Path; "
    code += "make(Path(sys.argv[1]), int(sys.argv[2]))"
    made = measured(
        [sys.executable, "-c", code, str(folder), str(args.side)],
        own_environment(), _TIMEOUT_S, folder,
    )  # fmt: skip
    if made.status:
        print(made.last_line)
        return 1
    jobs: dict[str, Callable[[Path], Usage]] = {
        "geodelreg pansharpen --no-align, equal weights": sharpened,
        "reading arrays of dask": lambda where: of_dask(where, _READ),
        "align(ms, pan) of these arrays": lambda where: of_dask(where, _ALIGN),
    }
    if shutil.which("gdalwarp") and shutil.which("gdal_pansharpen.py"):
        jobs["gdalwarp + gdal_pansharpen.py"] = by_gdal
    jobs["geodelreg pansharpen --no-align, weights fitted"] = lambda where: sharpened(where, "auto")
    runs: dict[str, list[Usage]] = {name: [] for name in jobs}
    for _ in range(args.repeat):  # in turn: the machine's speed wanders
        for name, job in jobs.items():
            runs[name].append(job(folder))
    print(f"PAN {args.side}², MS at 4:1 with four bands, chunks of {CHUNK}² ({machine()}):\n")
    print("| what | wall | CPU | peak |\n|---|---|---|---|")
    found = []
    for name, each in runs.items():
        usage = sorted(each, key=lambda one: (one.status, one.wall_s))[len(each) // 2]
        if usage.status:
            print(f"{name} failed: {usage.last_line}")
            return 1
        cells = f"{usage.wall_s:.1f} s | {usage.cpu_s:.1f} s | {usage.peak_mb:.0f} MB"
        print(f"| {name} | {cells} |", flush=True)
        found.append(usage)
    ours, read, aligned, *theirs, _ = found
    above_mb = aligned.peak_mb - read.peak_mb
    shares = [ours.wall_s / each.wall_s for each in theirs]
    print(f"\nPeak {ours.peak_mb:.0f} MB (limit {SHARPEN_MB} MB).")
    print(f"Aligning arrays takes {above_mb:.0f} MB above reading them (limit {DASK_MB} MB).")
    for share in shares:
        print(f"{share:.2f} times the time of GDAL's tools (limit {SHARPEN_FACTOR}).")
    good = ours.peak_mb <= SHARPEN_MB and above_mb <= DASK_MB
    return 0 if good and all(share <= SHARPEN_FACTOR for share in shares) else 1
