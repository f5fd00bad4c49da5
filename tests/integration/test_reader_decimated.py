"""Decimated reads: features stay where the grid says, whatever overviews the file has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import Resampling

import geodelreg.raster.raster_file
import geodelreg.raster.reader
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Band, Grid, Window
from tests.conftest import WriteRaster

SIZES = [(512, 256), (501, 777), (1570, 391)]


@pytest.fixture
def use_overviews(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small windows are averaged from full resolution; here they must not be."""
    monkeypatch.setattr(geodelreg.raster.reader, "_EXACT_PIXELS", 0)


def ramps(height: int, width: int) -> NDArray[np.float32]:
    """(2, H, W): at each pixel centre its own column and row, outer-corner convention."""
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    return np.stack([columns, rows]).astype(np.float32)


def placed(band: Band, grid: Grid, margin: int = 3) -> tuple[NDArray[np.float64], ...]:
    """Columns and rows of the pixel centres in the full raster, without the outermost pixels."""
    height, width = band.grid.shape
    to_full = ~grid.transform @ band.grid.transform
    columns, rows = to_full @ (
        np.arange(margin, width - margin) + 0.5,
        np.arange(margin, height - margin)[:, None] + 0.5,
    )
    return columns, rows


def misplacement_px(path: Path, window: Window, shape: tuple[int, int]) -> float:
    """Largest distance between ramp values and the grid, in decimated pixels."""
    with open_raster(path) as reader:
        bands = reader.read([1, 2], window, shape)
        columns, rows = placed(bands[0], reader.grid)
    inner = np.s_[3:-3, 3:-3]
    assert bands[0].valid[inner].all()
    errors = (
        np.abs(bands[0].data[inner] - columns).max() / (window.width / shape[1]),
        np.abs(bands[1].data[inner] - rows).max() / (window.height / shape[0]),
    )
    return float(max(errors))


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("ratio", [1.0, 1.37, 2.0, 2.5, 4.0, 7.3])
def test_ramp_is_where_the_grid_says(
    write_raster: WriteRaster, height: int, width: int, ratio: float
) -> None:
    path = write_raster("a.tif", ramps(height, width))
    for window in (Window(0, 0, width, height), Window(13, 101, width - 50, height - 133)):
        shape = (int(window.height / ratio), int(window.width / ratio))
        assert misplacement_px(path, window, shape) < 1e-3


@pytest.mark.usefixtures("use_overviews")
@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("method", ["average", "bilinear", "cubic", "lanczos"])
def test_overviews_are_where_the_grid_says(
    write_raster: WriteRaster, height: int, width: int, method: str
) -> None:
    path = write_raster("a.tif", ramps(height, width), tiled=True, blockxsize=256, blockysize=256)
    with rasterio.open(path, "r+") as dataset:
        dataset.build_overviews([2, 4, 8], Resampling[method])
    for ratio in (2.0, 3.1, 4.0, 9.7):
        window = Window(0, 0, width, height)
        shape = (int(height / ratio), int(width / ratio))
        assert misplacement_px(path, window, shape) < 0.02


@pytest.mark.usefixtures("use_overviews")
@pytest.mark.parametrize("method", ["nearest", "gauss", "mode"])
def test_displaced_overviews_are_put_right(write_raster: WriteRaster, method: str) -> None:
    # GDAL displaces these by up to half an overview pixel: 0.44 at 1:8
    path = write_raster("a.tif", ramps(1024, 512), tiled=True, blockxsize=256, blockysize=256)
    with rasterio.open(path, "r+") as dataset:
        dataset.build_overviews([2, 4, 8], Resampling[method])
    for ratio in (2, 4, 8, 10):
        shape = (1024 // ratio, 512 // ratio)
        assert misplacement_px(path, Window(0, 0, 512, 1024), shape) < 0.02


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.usefixtures("use_overviews")
def test_overviews_with_incomplete_last_cells_are_put_right(write_raster: WriteRaster) -> None:
    # other software averages whole cells of 2 × 2 and pads the last one
    data = ramps(1001, 777)
    path = write_raster("a.tif", data)
    padded = np.pad(data, ((0, 0), (0, 1), (0, 1)), mode="edge")
    half = padded.reshape(2, 501, 2, 389, 2).mean(axis=(2, 4)).astype(np.float32)
    write_raster("a.tif.ovr", half, crs=None, transform=Affine.identity())
    with open_raster(path) as reader:
        assert len(reader.decimations) == 2
    assert misplacement_px(path, Window(0, 0, 777, 1001), (501, 389)) < 0.02
    assert misplacement_px(path, Window(0, 0, 777, 1001), (300, 200)) < 0.02


@pytest.mark.usefixtures("use_overviews")
def test_wavelet_levels_of_jpeg2000_are_put_right(write_raster: WriteRaster) -> None:
    height, width = 1570, 1357
    data = np.round(ramps(height, width) * 40).astype(np.uint16)
    path = write_raster("a.jp2", data, driver="JP2OpenJPEG", QUALITY=100, REVERSIBLE="YES")
    with open_raster(path) as reader:
        assert len(reader.decimations) >= 2
        for ratio in (2.0, 3.3):
            shape = (int(height / ratio), int(width / ratio))
            bands = reader.read([1, 2], Window(0, 0, width, height), shape)
            columns, rows = placed(bands[0], reader.grid)
            inner = np.s_[3:-3, 3:-3]
            for band, place in zip(bands, (columns, rows), strict=True):
                errors = np.abs(band.data[inner] / 40 - place)
                assert np.quantile(errors, 0.99) < 0.02 * ratio  # the rest: tile borders


def test_small_windows_do_not_depend_on_overviews(write_raster: WriteRaster) -> None:
    data = np.random.default_rng(1).random((600, 600)).astype(np.float32)
    plain = write_raster("plain.tif", data)
    pyramid = write_raster("pyramid.tif", data)
    with rasterio.open(pyramid, "r+") as dataset:
        dataset.build_overviews([2, 4], Resampling.nearest)
    window, shape = Window(3, 5, 590, 580), (145, 147)
    with open_raster(plain) as first, open_raster(pyramid) as second:
        assert first.decimations == (1.0,)
        assert second.decimations == pytest.approx((1.0, 2.0, 4.0))
        np.testing.assert_array_equal(
            first.read([1], window, shape)[0].data, second.read([1], window, shape)[0].data
        )


@pytest.mark.usefixtures("use_overviews")
@pytest.mark.parametrize("internal", [True, False], ids=["internal", "msk"])
@pytest.mark.parametrize("early", [True, False], ids=["mask-first", "overviews-first"])
def test_masks_hold_on_overviews(write_raster: WriteRaster, internal: bool, early: bool) -> None:
    # GDAL takes overviews for valid everywhere when the mask has none
    mask = np.zeros((512, 512), dtype=bool)
    mask[:, 100:] = True
    layout = {"tiled": True, "blockxsize": 256, "blockysize": 256}
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal):
        path = write_raster("a.tif", ramps(512, 512), mask=mask if early else None, **layout)
        with rasterio.open(path, "r+") as dataset:
            dataset.build_overviews([2, 4], Resampling.average)
        if not early:
            with rasterio.open(path, "r+") as dataset:
                dataset.write_mask(mask)
    with open_raster(path) as reader:
        (band,) = reader.read([1], Window(0, 0, 512, 512), (128, 128))
    np.testing.assert_array_equal(band.valid, mask[::4, ::4])


def test_average_is_of_the_valid_pixels(write_raster: WriteRaster) -> None:
    rng = np.random.default_rng(3)
    data = rng.integers(1, 1000, (60, 90)).astype(np.uint16)
    data[rng.random(data.shape) < 0.4] = 0
    with open_raster(write_raster("a.tif", data, nodata=0)) as reader:
        (band,) = reader.read([1], Window(0, 0, 90, 60), (12, 18))
    cells = data.reshape(12, 5, 18, 5).swapaxes(1, 2).reshape(12, 18, 25)
    counts = (cells > 0).sum(axis=2)
    np.testing.assert_array_equal(band.valid, counts >= 12.5)
    expected = cells.sum(axis=2) / np.maximum(counts, 1)
    np.testing.assert_allclose(band.data[band.valid], expected[band.valid], rtol=1e-6)


@pytest.mark.parametrize("layout", [{}, {"tiled": True, "blockxsize": 64, "blockysize": 32}])
@pytest.mark.parametrize("shape", [(60, 80), (61, 83)], ids=["whole", "fractional"])
def test_pieces_do_not_show(
    write_raster: WriteRaster,
    monkeypatch: pytest.MonkeyPatch,
    layout: dict[str, object],
    shape: tuple[int, int],
) -> None:
    columns, rows = ramps(300, 500)
    waves = 2000 + 800 * np.sin(columns / 9) * np.cos(rows / 7)
    noise = np.random.default_rng(5).integers(0, 900, (300, 500)) * (shape == (60, 80))
    data = np.stack([waves, waves[::-1], waves + noise])
    data[:, 200:210, 300:400] = 0
    path = write_raster("a.tif", data.astype(np.float32), nodata=0, **layout)
    window = Window(7, 11, 480, 240)
    with open_raster(path) as reader:
        whole = reader.read([1, 3], window, shape)
        monkeypatch.setattr(geodelreg.raster.raster_file, "_PIECE_PIXELS", 3000)
        pieces = reader.read([1, 3], window, shape)
    for one, other in zip(whole, pieces, strict=True):
        np.testing.assert_array_equal(one.valid, other.valid)
        assert 0.8 < one.valid.mean() < 1
        np.testing.assert_allclose(one.data, other.data, rtol=3e-3 if shape == (61, 83) else 1e-6)


def test_memory_does_not_grow_with_the_raster(tmp_path: Path) -> None:
    path = tmp_path / "large.tif"
    profile = {"driver": "GTiff", "dtype": "uint16", "count": 1, "sparse_ok": True}
    with rasterio.open(
        path,
        "w",
        width=14_000,
        height=14_000,
        crs="EPSG:32616",
        transform=Affine(1, 0, 5e5, 0, -1, 1e6),
        tiled=True,
        **profile,
    ):
        pass
    script = """
import resource, sys
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Window
with open_raster(sys.argv[1]) as reader:
    reader.read([1], Window(0, 0, 600, 600), (200, 200))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    reader.read([1], Window(0, 0, 14000, 14000), (1000, 1000))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    grown_kib = int(subprocess.check_output([sys.executable, "-c", script, str(path)]))
    assert grown_kib < 150_000  # the raster itself has 390 MB


@pytest.mark.parametrize("bands", [1, 4, 8])
@pytest.mark.parametrize("side", [256, 512])
def test_pieces_cut_no_block(write_raster: WriteRaster, bands: int, side: int) -> None:
    """A block that is cut is decoded once for each of its parts."""
    data = np.ones((1, 1100, 1300), dtype=np.uint8)
    path = write_raster("a.tif", data, tiled=True, blockxsize=side, blockysize=side)
    with rasterio.open(path) as dataset:
        pieces = geodelreg.raster.raster_file._pieces(dataset, (0, 0), (1300, 1100), bands)
    assert sum(piece.width * piece.height for piece in pieces) == data.size
    for piece in pieces:
        assert piece.column % side == 0
        assert piece.row % side == 0
        assert (piece.column + piece.width) % side == 0 or piece.column + piece.width == 1300
        assert (piece.row + piece.height) % side == 0 or piece.row + piece.height == 1100


@pytest.mark.parametrize("nodata", [None, 0])
def test_empty_blocks_of_a_sparse_raster_count_as_what_they_are(
    tmp_path: Path, nodata: int | None
) -> None:
    values = np.zeros((2, 3000, 3000), dtype=np.uint16)
    values[:, 1400:1700, 500:1900] = np.random.default_rng(1).integers(1, 4000, (2, 300, 1400))
    path = tmp_path / "sparse.tif"
    profile = {"driver": "GTiff", "dtype": "uint16", "count": 2, "height": 3000, "width": 3000}
    profile |= {"tiled": True, "sparse_ok": True, "crs": "EPSG:32616", "nodata": nodata}
    transform = Affine(2, 0, 500_000, 0, -2, 4_000_000)
    with rasterio.open(path, "w", transform=transform, **profile) as dataset:
        rows, columns = slice(1280, 1792), slice(256, 2048)
        dataset.write(values[:, rows, columns], window=((1280, 1792), (256, 2048)))
    cells = values.reshape(2, 300, 10, 300, 10).astype(float)
    there = np.ones_like(cells) if nodata is None else (cells != nodata).astype(float)
    count = there.sum(axis=(2, 4))
    expected = cells.sum(axis=(2, 4)) / np.maximum(count, 1)
    with open_raster(path) as reader:
        bands = reader.read([1, 2], Window(0, 0, 3000, 3000), (300, 300))
    for band, mean, number in zip(bands, expected, count, strict=True):
        assert np.array_equal(band.valid, number >= 50)
        assert np.allclose(band.data[band.valid], mean[band.valid], rtol=1e-6)
