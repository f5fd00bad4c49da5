"""``geodelreg gcps``: numbers worked out by hand or by rasterio, half pixels included."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.control import GroundControlPoint
from rasterio.warp import transform

from tests.cli.helpers import Command, snapshot

# The header of ms.tif: x = 437256.4 + 40 column, y = 4176413.8 - 40 row.
PIXEL = (10.5, 20.25)
UNDER_HEADER = (437256.4 + 40 * 10.5, 4176413.8 - 40 * 20.25)
TRUE = (437700.125, 4175650.5)


@pytest.fixture
def folder(pair: Path) -> Path:
    (pair / "in.points").write_text(
        "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n"
        f"{TRUE[0]},{TRUE[1]},{UNDER_HEADER[0]},{UNDER_HEADER[1]},1,0,0,0\n"
        "1,2,3,4,0,0,0,0\n",
        encoding="utf-8",
    )
    return pair


def test_qgis_to_gdal_translate(geodelreg: Command, folder: Path) -> None:
    done = geodelreg("gcps", "in.points", "out.txt", "--raster", "ms.tif", cwd=folder)
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == "out.txt: 1 points\n"
    words = (folder / "out.txt").read_text(encoding="utf-8").split()
    at = words.index("-gcp")
    assert words.count("-gcp") == 1
    assert np.allclose([float(word) for word in words[at + 1 : at + 5]], [*PIXEL, *TRUE])


def test_to_envi_counts_pixels_from_one(geodelreg: Command, folder: Path) -> None:
    done = geodelreg(
        *("gcps", "in.points", "out.pts", "--to", "envi", "--raster", "ms.tif"),
        *("--reference", "pan.tif", "-q"),
        cwd=folder,
    )
    assert (done.returncode, done.stderr) == (0, "")
    with rasterio.open(folder / "pan.tif") as pan:
        column, row = ~pan.transform @ TRUE
    last = (folder / "out.pts").read_text(encoding="utf-8").splitlines()[-1]
    numbers = [float(text) for text in last.replace(",", " ").split()]
    assert np.allclose(numbers, [column + 1, row + 1, PIXEL[0] + 1, PIXEL[1] + 1], atol=1e-3)


def test_points_in_another_crs_are_transformed(geodelreg: Command, folder: Path) -> None:
    (x,), (y,) = transform("EPSG:32618", "EPSG:32617", [TRUE[0]], [TRUE[1]])
    point = GroundControlPoint(row=PIXEL[1], col=PIXEL[0], x=x, y=y, id="1")
    profile = {"driver": "GTiff", "width": 30, "height": 30, "count": 1, "dtype": "uint8"}
    with rasterio.open(folder / "gcps.tif", "w", **profile) as dataset:
        dataset.gcps = ([point] * 3, "EPSG:32617")
    rio = [sys.executable, "-c", "from rasterio.rio.main import main_group; main_group()"]
    made = subprocess.run(
        [*rio, "gcps", "--collection", "--projected", "gcps.tif"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert made.returncode == 0, made.stderr
    (folder / "in.geojson").write_text(made.stdout, encoding="utf-8")
    done = geodelreg("gcps", "in.geojson", "out.csv", "--raster", "ms.tif", cwd=folder)
    assert done.returncode == 0, done.stderr
    header, first, *_ = (folder / "out.csv").read_text(encoding="utf-8").splitlines()
    values = dict(zip(header.split(","), first.split(","), strict=True))
    found = [float(values[name]) for name in ("column", "line", "x", "y")]
    assert np.allclose(found, [*PIXEL, *TRUE], rtol=0, atol=1e-3)


def test_refusals_change_nothing(geodelreg: Command, folder: Path) -> None:
    (folder / "bad.points").write_text("mapX,mapY,sourceX,sourceY\n1,2,three,4\n", encoding="utf-8")
    (folder / "old.txt").write_text("old", encoding="utf-8")
    before = snapshot(folder)
    for args, code, message in (
        (("bad.points", "out.txt"), 1, "bad.points"),
        (("missing.points", "out.txt"), 1, "missing.points"),
        (("in.points", "old.txt"), 1, "old.txt exists"),
        (("in.points", "out.xyz"), 1, "out.xyz"),
        (("in.points", "out.xyz", "--to", "kml"), 2, "'kml' is not one of"),
    ):
        done = geodelreg("gcps", *args, "--raster", "ms.tif", cwd=folder)
        assert done.returncode == code
        assert message in done.stderr
        assert "Traceback" not in done.stderr
    assert snapshot(folder) == before


def test_the_formats_offered_are_those_of_the_library() -> None:
    from geodelreg.product.gcps import GCP_FORMATS
    from geodelreg_cli.options import GCP_FORMAT

    assert tuple(GCP_FORMAT.choices) == tuple(GCP_FORMATS)
