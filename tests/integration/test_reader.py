"""Pixels, grids and validity, read from real files of every kind."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp
from rasterio.env import get_gdal_config, set_gdal_config

from geodelreg.errors import BandGridError, BandNumberError, UsageError
from geodelreg.raster.reader import check_band, open_raster
from geodelreg.values.raster import Band, Window
from tests.conftest import TRANSFORM, WriteRaster

RNG = np.random.default_rng(7)
TEXTURE = RNG.integers(1, 200, (50, 70)).astype(np.uint16)
HALF = np.zeros((50, 70), dtype=bool)
HALF[:, 25:] = True


def read_all(path: Path | list[Path], bands: tuple[int, ...] = (1,)) -> list[Band]:
    with open_raster(path) as reader:
        height, width = reader.grid.shape
        return reader.read(bands, Window(0, 0, width, height))


@pytest.mark.parametrize(
    "dtype",
    [
        *[f"{kind}{bits}" for kind in ("uint", "int") for bits in (8, 16, 32, 64)],
        *("float32", "float64"),
    ],
)
def test_every_real_type_is_read(write_raster: WriteRaster, dtype: str) -> None:
    data = RNG.integers(0, 120, (2, 20, 30)).astype(dtype)
    if np.dtype(dtype).kind in "if":
        data -= np.array(60, dtype=dtype)
    path = write_raster("a.tif", data, nodata=7)
    second, first = read_all(path, (2, 1))
    for band, plane in ((first, data[0]), (second, data[1])):
        assert band.data.dtype == np.float32
        np.testing.assert_array_equal(band.valid, plane != 7)
        np.testing.assert_array_equal(band.data[band.valid], plane[plane != 7].astype(np.float32))
        assert np.isfinite(band.data).all()


@pytest.mark.parametrize(
    "transform",
    [
        Affine(30, 0, 5e5, 0, -30, 14e5),
        Affine(30, 0, 5e5, 0, 30, 14e5),
        Affine(30, 0, 5e5, 0, -15, 14e5),
        Affine.translation(5e5, 14e5) @ Affine.rotation(33.0) @ Affine.scale(2.0, -2.5),
    ],
    ids=["north-up", "south-up", "non-square", "rotated"],
)
def test_windows_know_where_they_lie(write_raster: WriteRaster, transform: Affine) -> None:
    path = write_raster("a.tif", TEXTURE, transform=transform)
    with open_raster(path) as reader:
        assert reader.grid.transform == transform
        assert reader.grid.shape == (50, 70)
        (band,) = reader.read([1], Window(11, 7, 20, 30))
        (small,) = reader.read([1], Window(11, 7, 20, 30), (4, 3))
    np.testing.assert_array_equal(band.data, TEXTURE[7:37, 11:31])
    for part in (band, small):
        height, width = part.grid.shape
        assert part.data.shape == part.valid.shape == (height, width)
        for (column, row), (x, y) in {(0, 0): (11, 7), (width, height): (31, 37)}.items():
            assert part.grid.transform @ (column, row) == pytest.approx(transform @ (x, y))


def test_crs_without_epsg_code_is_kept(write_raster: WriteRaster) -> None:
    crs = "+proj=laea +lat_0=12 +lon_0=-86 +ellps=GRS80 +units=m"
    with open_raster(write_raster("a.tif", TEXTURE, crs=crs)) as reader:
        assert reader.grid.crs_wkt.startswith("PROJCRS[")
        assert rasterio.CRS.from_wkt(reader.grid.crs_wkt) == rasterio.CRS.from_string(crs)


class TestValidity:
    def test_nodata_value(self, write_raster: WriteRaster) -> None:
        (band,) = read_all(write_raster("a.tif", np.where(HALF, TEXTURE, 0), nodata=0))
        np.testing.assert_array_equal(band.valid, HALF)

    def test_nodata_outside_the_type_marks_nothing(self, write_raster: WriteRaster) -> None:
        path = write_raster("a.vrt.tif", np.where(HALF, TEXTURE, 0))
        vrt = path.with_name("outside.vrt")
        vrt.write_text(
            '<VRTDataset rasterXSize="70" rasterYSize="50"><SRS>EPSG:32616</SRS>'
            "<GeoTransform>500000,30,0,1400000,0,-30</GeoTransform>"
            '<VRTRasterBand dataType="UInt16" band="1"><NoDataValue>-9999</NoDataValue>'
            f'<SimpleSource><SourceFilename relativeToVRT="1">{path.name}</SourceFilename>'
            "</SimpleSource></VRTRasterBand></VRTDataset>"
        )
        (band,) = read_all(vrt)
        assert band.valid.all()

    @pytest.mark.parametrize("nodata", [None, np.nan, -9999.0])
    def test_nan_and_infinity_are_never_good(
        self, write_raster: WriteRaster, nodata: float | None
    ) -> None:
        data = TEXTURE.astype(np.float32)
        data[3, 4], data[5, 6], data[7, 8] = np.nan, np.inf, -np.inf
        data[9, 9] = -9999
        (band,) = read_all(write_raster("a.tif", data, nodata=nodata))
        expected = np.isfinite(data)
        expected[9, 9] = nodata != -9999.0
        np.testing.assert_array_equal(band.valid, expected)
        assert np.isfinite(band.data).all()

    def test_nodata_written_with_few_digits(self, write_raster: WriteRaster) -> None:
        data = np.where(HALF, TEXTURE, np.float32(-3.4028235e38)).astype(np.float32)
        (band,) = read_all(write_raster("a.tif", data, nodata=-3.40282306074e38))
        np.testing.assert_array_equal(band.valid, HALF)

    def test_doubles_beyond_float32_are_not_good(self, write_raster: WriteRaster) -> None:
        data = np.where(HALF, TEXTURE, -1e300)
        (band,) = read_all(write_raster("a.tif", data))
        np.testing.assert_array_equal(band.valid, HALF)

    @pytest.mark.parametrize("internal", [True, False], ids=["internal", "msk"])
    def test_mask_and_nodata_both_count(self, write_raster: WriteRaster, internal: bool) -> None:
        data = TEXTURE.copy()
        data[10] = 0
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal):
            path = write_raster("a.tif", data, mask=HALF, nodata=0)
        assert path.with_name("a.tif.msk").exists() != internal
        (band,) = read_all(path)
        expected = HALF.copy()
        expected[10] = False
        np.testing.assert_array_equal(band.valid, expected)

    @pytest.mark.parametrize("colours", [1, 2, 3, 4])
    def test_alpha_masks_and_is_no_band(self, write_raster: WriteRaster, colours: int) -> None:
        meaning = (ColorInterp.gray, *[ColorInterp.undefined] * (colours - 1), ColorInterp.alpha)
        planes = np.stack([*[TEXTURE + i for i in range(colours)], HALF * 255]).astype(np.uint16)
        path = write_raster("a.tif", planes, colorinterp=meaning)
        with open_raster(path) as reader:
            assert len(reader.band_names) == colours
        bands = read_all(path, tuple(range(1, colours + 1)))
        for plane, band in zip(planes, bands, strict=False):
            np.testing.assert_array_equal(band.valid, HALF)
            np.testing.assert_array_equal(band.data[HALF], plane[HALF])


class TestOneFilePerBand:
    def test_bands_are_those_of_the_commonest_grid(self, write_raster: WriteRaster) -> None:
        finer = TRANSFORM @ Affine.scale(0.5)
        paths = [
            write_raster("S2_B02.tif", TEXTURE),
            write_raster("S2_B08.tif", np.tile(TEXTURE, (2, 2)), transform=finer),
            write_raster("S2_B03.tif", TEXTURE + 1),
        ]
        with open_raster(paths) as reader:
            assert reader.band_names == ("S2_B02", "S2_B03")
            assert reader.paths == (str(paths[0]), str(paths[2]))
            assert reader.other_paths == (str(paths[1]),)
            assert reader.grid.transform == TRANSFORM
            bands = reader.read([2, 1, 2], Window(5, 5, 10, 10))
        for band, plus in zip(bands, (1, 0, 1), strict=True):
            np.testing.assert_array_equal(band.data, TEXTURE[5:15, 5:15] + plus)
        assert [band.name for band in bands] == ["S2_B03", "S2_B02", "S2_B03"]

    def test_on_a_tie_the_finest_grid_wins(self, write_raster: WriteRaster) -> None:
        coarse = write_raster("coarse.tif", TEXTURE)
        fine = write_raster("fine.tif", TEXTURE, transform=TRANSFORM @ Affine.scale(0.5))
        with open_raster([coarse, fine]) as reader:
            assert reader.paths == (str(fine),)
            assert reader.other_paths == (str(coarse),)

    def test_different_crss_are_refused(self, write_raster: WriteRaster) -> None:
        paths = [write_raster("a.tif", TEXTURE), write_raster("b.tif", TEXTURE, crs="EPSG:32617")]
        with pytest.raises(BandGridError, match=r"a\.tif and .*b\.tif.*align"):
            open_raster(paths)

    def test_names_never_collide(self, write_raster: WriteRaster) -> None:
        paths = [write_raster("r10/B.tif", TEXTURE), write_raster("r20/B.tif", TEXTURE)]
        with open_raster(paths) as reader:
            assert len(set(reader.band_names)) == 2

    def test_nothing_is_an_error_of_usage(self) -> None:
        with pytest.raises(UsageError):
            open_raster([])


def test_band_descriptions_are_names(write_raster: WriteRaster) -> None:
    path = write_raster("a.tif", np.stack([TEXTURE] * 2), descriptions=("B2", "B3"))
    with open_raster(path) as reader:
        assert reader.band_names == ("B2", "B3")
        assert reader.name == "a.tif"
        assert reader.dtypes == ("uint16", "uint16")


@pytest.mark.parametrize(
    ("window", "shape"),
    [
        (Window(-1, 0, 5, 5), None),
        (Window(0, -1, 5, 5), None),
        (Window(66, 0, 5, 5), None),
        (Window(0, 46, 5, 5), None),
        (Window(0, 0, 0, 5), None),
        (Window(0, 0, 5, 5), (6, 5)),
        (Window(0, 0, 5, 5), (0, 5)),
    ],
)
def test_windows_outside_and_enlargements_are_refused(
    write_raster: WriteRaster, window: Window, shape: tuple[int, int] | None
) -> None:
    with open_raster(write_raster("a.tif", TEXTURE)) as reader, pytest.raises(ValueError):  # noqa: PT011
        reader.read([1], window, shape)


@pytest.mark.parametrize("number", [0, 3, -1])
def test_wrong_band_number_says_what_there_is(write_raster: WriteRaster, number: int) -> None:
    with open_raster(write_raster("a.tif", np.stack([TEXTURE] * 2))) as reader:
        with pytest.raises(BandNumberError, match=rf"a\.tif has no band {number}.*1 to 2"):
            check_band(reader, number)
        with pytest.raises(BandNumberError):
            reader.read([number], Window(0, 0, 5, 5))


def test_large_blocks_are_named(write_raster: WriteRaster) -> None:
    # GDAL splits strips by itself unless they are compressed
    strip = {"blockysize": 6000, "compress": "lzw"}
    whole = write_raster("strip.tif", np.zeros((6000, 6000), np.uint16), **strip)
    tiled = write_raster("tiled.tif", TEXTURE, tiled=True, blockxsize=64, blockysize=64)
    with open_raster(whole) as reader:
        assert "strip.tif" in reader.block_note
        assert "6000 × 6000" in reader.block_note
    with open_raster(tiled) as reader:
        assert reader.block_note == ""


class TestGdalState:
    @pytest.fixture
    def usual_cache(self) -> Iterator[int]:
        original = get_gdal_config("GDAL_CACHEMAX")
        set_gdal_config("GDAL_CACHEMAX", 300_000_000)
        yield 300_000_000
        set_gdal_config("GDAL_CACHEMAX", original)

    def test_cache_is_small_while_reading_and_restored_after(
        self, write_raster: WriteRaster, usual_cache: int
    ) -> None:
        path = write_raster("a.tif", TEXTURE)
        first, second = open_raster(path), open_raster(path)
        assert get_gdal_config("GDAL_CACHEMAX") <= 64_000_000
        first.close()
        assert get_gdal_config("GDAL_CACHEMAX") <= 64_000_000
        second.close()
        assert get_gdal_config("GDAL_CACHEMAX") == usual_cache

    def test_cache_is_restored_after_a_failed_open(self, tmp_path: Path, usual_cache: int) -> None:
        (tmp_path / "text.tif").write_text("no raster")
        with pytest.raises(Exception, match="text"):
            open_raster(tmp_path / "text.tif")
        assert get_gdal_config("GDAL_CACHEMAX") == usual_cache

    def test_reading_leaves_no_files_behind(self, write_raster: WriteRaster) -> None:
        path = write_raster("a.tif", TEXTURE)
        content = path.read_bytes()
        read_all(path)
        assert [p.name for p in path.parent.iterdir()] == ["a.tif"]
        assert path.read_bytes() == content

    def test_threads_share_a_reader(self, write_raster: WriteRaster) -> None:
        data = RNG.integers(0, 60000, (512, 512)).astype(np.uint16)
        path = write_raster(
            "a.tif", data, compress="deflate", tiled=True, blockxsize=64, blockysize=64
        )
        windows = [Window(c, r, 100, 90) for c in range(0, 400, 37) for r in range(0, 400, 41)]
        with open_raster(path) as reader, ThreadPoolExecutor(4) as pool:
            bands = list(pool.map(lambda window: reader.read([1], window)[0], windows))
        for (column, row, width, height), band in zip(windows, bands, strict=True):
            np.testing.assert_array_equal(
                band.data, data[row : row + height, column : column + width]
            )
