"""`--warp --like FILE`: the exact grid of another raster, also in another CRS, resampled once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner, Result
from pyproj import Transformer

from geodelreg_cli.main import cli

HEADER = Affine(2.0, 0.0, 700_000.0, 0.0, -2.0, 4_500_000.0)
TRUE = Affine.translation(7.3, -4.1) @ HEADER
SHAPE = (120, 140)
CORNER = Transformer.from_crs(32618, 32619, always_xy=True).transform(700_060, 4_499_940)
LIKE = Affine(1.1, 0.0, CORNER[0], 0.0, -1.2, CORNER[1])


def run(*args: object) -> Result:
    return CliRunner().invoke(cli, [str(arg) for arg in args])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """MS whose bands are column and row, points that shift it, and a raster in another zone."""
    height, width = SHAPE
    rows, columns = np.mgrid[:height, :width] + 0.5
    profile = {"driver": "GTiff", "count": 2, "dtype": "float64", "crs": "EPSG:32618"}
    profile |= {"height": height, "width": width, "transform": HEADER, "nodata": -9.0}
    with rasterio.open(tmp_path / "ms.tif", "w", **profile) as dataset:
        dataset.write(np.stack([columns, rows]))
    profile |= {"crs": "EPSG:32619", "transform": LIKE, "height": 50, "width": 60, "count": 1}
    with rasterio.open(tmp_path / "like.tif", "w", **profile) as dataset:
        dataset.write(np.ones((1, 50, 60)))
    pixels = ((10.0, 20.0), (100.0, 30.0), (60.0, 100.0))
    lines = [",".join(map(repr, (*at, *(TRUE @ at)))) for at in pixels]
    (tmp_path / "points.csv").write_text("\n".join(["column,line,x,y", *lines]))
    return tmp_path


def test_it_lands_on_that_grid_by_refit_and_by_apply(folder: Path) -> None:
    report, like = folder / "r.json", folder / "like.tif"
    how = ("--warp", "--like", like, "-r", "bilinear", "-q")
    points = (folder / "points.csv", folder / "ms.tif", "--model", "shift")
    done = run("refit", *points, "-o", folder / "one.tif", "--report", report, *how)
    assert done.exit_code == 0, done.output
    assert json.loads(report.read_text("utf-8"))["correction"]["model"] == "shift"
    assert run("apply", report, folder / "ms.tif", "-o", folder / "two.tif", *how).exit_code == 0
    rows, columns = np.mgrid[:50, :60] + 0.5
    to_ms = Transformer.from_crs(32619, 32618, always_xy=True)
    expected = np.stack(~TRUE @ to_ms.transform(*(LIKE @ (columns, rows))))
    for name in ("one.tif", "two.tif"):
        with rasterio.open(folder / name) as dataset:
            assert (dataset.transform, dataset.shape) == (LIKE, (50, 60))
            assert dataset.crs.to_epsg() == 32619
            assert (dataset.read_masks() > 0).all()
            assert np.abs(dataset.read() - expected).max() < 0.002


def test_wrong_uses_write_nothing(folder: Path) -> None:
    like, before = folder / "like.tif", sorted(folder.iterdir())
    command = ("refit", folder / "points.csv", folder / "ms.tif", "--model", "shift")
    for args, code in (
        (("-o", folder / "out.tif", "--like", like), 2),
        (("-o", folder / "out.tif", "--warp", "--grid", "pan", "--like", like), 2),
        (("-o", like, "--warp", "--like", like, "--overwrite"), 2),
        (("-o", folder / "out.tif", "--warp", "--like", folder / "none.tif"), 1),
    ):
        done = run(*command, *args)
        assert getattr(done.exception, "exit_code", done.exit_code) == code, done.output
    assert sorted(folder.iterdir()) == before
    with rasterio.open(like) as dataset:
        assert dataset.shape == (50, 60)
