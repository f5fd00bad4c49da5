"""The displacement grid: what it says is what the correction does, on any CRS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from scipy.interpolate import RegularGridInterpolator

import geodelreg
from benchmarks.scenes.imagery import sample_imagery
from benchmarks.scenes.make import HeaderError, SceneSpec, make_scene, write_scene
from geodelreg import Alignment
from geodelreg.errors import OutputExistsError
from geodelreg.product.displacement import BANDS
from geodelreg_cli.main import cli

SPEC = SceneSpec("moves", "", HeaderError((1.3, -0.7)), (640, 640), (300, 300), ratio=2.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("moves")
    write_scene(make_scene(SPEC, sample_imagery()), folder)
    return folder


@pytest.fixture(scope="module")
def alignment(folder: Path) -> Alignment:
    return geodelreg.align(folder / "ms.tif", folder / "pan.tif")


def test_it_moves_the_header_to_the_correction(
    folder: Path, alignment: Alignment, tmp_path: Path
) -> None:
    """Read by rasterio alone: in metres from the header to the corrected one, and in PAN pixels."""
    out = tmp_path / "moves.tif"
    run = CliRunner().invoke(
        cli,
        [
            "align",
            *map(str, (folder / "ms.tif", folder / "pan.tif")),
            "--dry-run",
            "-q",
            "--displacement",
            str(out),
        ],
    )
    assert run.exit_code == 0, run.output
    with rasterio.open(out) as dataset, rasterio.open(folder / "pan.tif") as pan:
        moves, grid, to_pan = dataset.read(), dataset.transform, ~pan.transform
        assert dataset.descriptions == BANDS
        assert dataset.units == ("metre", "metre", "pixel", "pixel", "pixel")
    corrected = alignment.correction.corrected @ ~alignment.correction.original
    for row, column in ((0, 0), (17, 240), (299, 299)):
        x, y = grid @ (column + 0.5, row + 0.5)
        there = corrected @ (x, y)
        east, north, right, down, sigma = moves[:, row, column]
        assert (x + east, y + north) == pytest.approx(there, abs=1e-6)
        step = np.subtract(to_pan @ there, to_pan @ (x, y))
        assert (right, down) == pytest.approx(tuple(step), abs=1e-6)
        assert 0 < sigma < 0.1


def test_it_is_exact_between_pixels(alignment: Alignment, tmp_path: Path) -> None:
    out = tmp_path / "moves.tif"
    geodelreg.write_displacement(alignment, out)
    with rasterio.open(out) as grid:
        metres = [float(text) for text in grid.tags()["GEODELREG_METRES_PER_UNIT"].split()]
        moves = np.moveaxis(grid.read([1, 2]), 0, -1) / metres
    rows, columns = (np.arange(size) + 0.5 for size in grid.shape)
    known = RegularGridInterpolator((rows, columns), moves)
    rng = np.random.default_rng(0)
    at = rng.uniform(10, 290, (50, 2))
    header, corrected = alignment.correction.original, alignment.correction.corrected
    for x, y in at:
        back = ~grid.transform @ (header @ (x, y))
        found = np.add(header @ (x, y), known((back[1], back[0])))
        gap = np.subtract(~header @ tuple(found), ~header @ (corrected @ (x, y)))
        assert np.abs(gap).max() < 1e-6
    with pytest.raises(OutputExistsError):
        geodelreg.write_displacement(alignment, out)
