"""What GDAL alone needs: ``python -m benchmarks.scale.floor FOLDER`` prints seconds as JSON.

A process of its own, so that what it leaves in memory is not counted for what is measured next.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from pathlib import Path

WORKING_PX = 400_000


def read_all(path: Path, level: int | None = None) -> float:
    """Seconds to read every pixel of a raster (or of an overview), block by block."""
    import rasterio

    options = {} if level is None else {"overview_level": level}
    started = time.perf_counter()
    with rasterio.open(path, **options) as raster:
        for _, window in raster.block_windows(1):
            raster.read(window=window)
    return time.perf_counter() - started


def sufficient_overview(path: Path) -> int | None:
    """Index of the coarsest overview that still has the pixels to match on; None without any."""
    import rasterio

    with rasterio.open(path) as raster:
        pixels = [raster.width * raster.height // factor**2 for factor in raster.overviews(1)]
    return max((i for i, count in enumerate(pixels) if count >= WORKING_PX), default=None)


def copy(path: Path) -> float:
    """Seconds to copy a file and flush the copy to the disk."""
    target = path.with_name("copy.tmp")
    started = time.perf_counter()
    shutil.copyfile(path, target)
    with target.open("rb") as file:
        os.fsync(file.fileno())
    elapsed = time.perf_counter() - started
    target.unlink()
    return elapsed


def main(folder: Path) -> None:
    """Measure a pair's floor; the first, untimed reading brings the files into memory."""
    import rasterio

    pan, ms = folder / "pan.tif", folder / "ms.tif"
    for path in (pan, ms):
        with path.open("rb") as file:
            while file.read(1 << 24):
                pass
    with rasterio.Env(GDAL_CACHEMAX=64_000_000):
        read_s = read_all(pan, sufficient_overview(pan)) + read_all(ms)
    print(json.dumps({"read_s": read_s, "copy_s": copy(ms)}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
