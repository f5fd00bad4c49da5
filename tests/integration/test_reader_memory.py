"""A decimated read: bounded memory, all cores, the same result."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

import geodelreg.raster.raster_file
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Window

SIDE = 6144
PEAK_MB = 100
KEPT_MB = 45

CHILD = """
import json, sys
import numpy
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Window

def status(name):
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))

with open_raster(sys.argv[1]) as reader:
    before = status("VmRSS")
    height, width = reader.grid.shape
    reader.read([1], Window(0, 0, width, height), (600, 600))
    print(json.dumps({"peak": status("VmHWM") - before, "kept": status("VmRSS") - before}))
"""


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A raster that would fill GDAL's cache (75 MB), deflated, without overviews."""
    path = tmp_path_factory.mktemp("large") / "large.tif"
    row, column = np.ogrid[:SIDE, :SIDE]
    with rasterio.open(
        path, "w", driver="GTiff", dtype="uint16", count=1, height=SIDE, width=SIDE,
        crs="EPSG:32633", transform=Affine(2, 0, 500_000, 0, -2, 5_000_000), tiled=True,
        blockxsize=512, blockysize=512, compress="deflate", zlevel=1,
    ) as raster:  # fmt: skip
        raster.write((row % 97 * 50 + column % 89 * 20).astype(np.uint16), 1)
    return path


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_decimated_read_needs_little_memory_and_keeps_less(large: Path) -> None:
    # the child's own high-water mark: ru_maxrss would start from this process's
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(large)], check=True, capture_output=True, text=True
    )
    grown = json.loads(done.stdout)
    assert grown["peak"] < PEAK_MB
    assert grown["kept"] < KEPT_MB


def test_number_of_threads_does_not_show(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for most in (1, 3):
        monkeypatch.setattr(geodelreg.raster.raster_file, "_MOST_THREADS", most)
        monkeypatch.setattr("os.cpu_count", lambda: 8)
        with open_raster(large) as reader:
            (band,) = reader.read([1], Window(5, 7, SIDE - 9, SIDE - 8), (311, 517))
        results.append(band.data.tobytes())
    assert results[0] == results[1]
