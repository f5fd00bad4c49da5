"""Files that cannot be used: each gets its own error, which names the file and a remedy."""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path

import attr
import numpy as np
import pytest
from affine import Affine
from rasterio.control import GroundControlPoint
from rasterio.rpc import RPC

from geodelreg import errors
from geodelreg.door.names import ALL
from geodelreg.errors import GeodelregError
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Window
from tests.conftest import WriteRaster

TEXTURE = np.random.default_rng(0).integers(1, 4000, (300, 300)).astype(np.uint16)


@pytest.fixture(autouse=True)
def silence(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """GDAL must not write past our messages."""
    yield
    captured = capfd.readouterr()
    assert captured.err == ""
    assert captured.out == ""


def assert_refused(path: Path | str, kind: type[GeodelregError], *words: str) -> None:
    with pytest.raises(GeodelregError) as caught:
        open_and_read(path)
    assert type(caught.value) is kind
    assert Path(path).name in caught.value.cause
    assert caught.value.remedy
    for word in words:
        assert word in str(caught.value)


def open_and_read(path: Path | str) -> None:
    with open_raster(path) as reader:
        height, width = reader.grid.shape
        reader.read([1], Window(0, 0, min(width, 300), min(height, 300)))


def test_missing(tmp_path: Path) -> None:
    assert_refused(tmp_path / "a.tif", errors.RasterNotFoundError, "does not exist")


def test_empty(tmp_path: Path) -> None:
    (tmp_path / "a.tif").touch()
    assert_refused(tmp_path / "a.tif", errors.RasterUnreadableError, "is empty")


def test_text(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_text("not a raster")
    assert_refused(tmp_path / "a.tif", errors.RasterUnreadableError, "not a raster")


def test_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    assert_refused(tmp_path / "a", errors.RasterUnreadableError, "folder")


def test_garbage_behind_a_tiff_signature(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, 1000, dtype=np.uint8).tobytes()
    (tmp_path / "a.tif").write_bytes(b"II*\0" + noise)
    assert_refused(tmp_path / "a.tif", errors.RasterUnreadableError, "not a raster")


@pytest.mark.parametrize("layout", [{}, {"compress": "deflate"}, {"tiled": True}])
def test_truncated(write_raster: WriteRaster, layout: dict[str, object]) -> None:
    path = write_raster("a.tif", TEXTURE, **layout)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    words = ("columns 0 to 300, rows 0 to 300 cannot be decoded", "truncated")
    assert_refused(path, errors.RasterUnreadableError, *words)


def test_truncated_is_noticed_when_decimated(write_raster: WriteRaster) -> None:
    path = write_raster("a.tif", TEXTURE)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with open_raster(path) as reader, pytest.raises(errors.RasterUnreadableError, match="rows"):
        reader.read([1], Window(0, 0, 300, 300), (50, 50))


def test_no_crs(write_raster: WriteRaster) -> None:
    path = write_raster("a.tif", TEXTURE, crs=None)
    assert_refused(path, errors.MissingCrsError, "coordinate reference system", "gdal_edit")


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_no_geotransform(write_raster: WriteRaster) -> None:
    path = write_raster("a.tif", TEXTURE, transform=None)
    assert_refused(path, errors.MissingGeoreferenceError, "no geotransform", "gdal_edit")


def test_gcps_only(write_raster: WriteRaster) -> None:
    corners = [(0, 0), (0, 300), (300, 0)]
    gcps = [GroundControlPoint(r, c, 5e5 + 30 * c, 1e6 - 30 * r, 0) for r, c in corners]
    path = write_raster("a.tif", TEXTURE, transform=None, gcps=gcps)
    assert_refused(path, errors.UnsupportedGeoreferenceError, "ground control points", "gdalwarp")


def test_rpcs_only(write_raster: WriteRaster) -> None:
    fields = [field.name for field in attr.fields(RPC)]
    values = {name: [1.0] * 20 if name.endswith("coeff") else 1.0 for name in fields}
    path = write_raster("a.tif", TEXTURE, transform=None, crs=None, rpcs=RPC(**values))
    assert_refused(path, errors.UnsupportedGeoreferenceError, "RPCs", "gdalwarp -rpc")


@pytest.mark.parametrize(
    "transform",
    [
        Affine(float("nan"), 0, 5e5, 0, -30, 1e6),
        Affine(float("inf"), 0, 5e5, 0, -30, 1e6),
        Affine(30, 30, 5e5, 30, 30, 1e6),
        Affine(0, 0, 5e5, 0, 0, 1e6),
        Affine(30, 0, 5e5, 0, 0, 1e6),
    ],
    ids=["nan", "inf", "singular", "zero", "flat"],
)
def test_impossible_geotransform(write_raster: WriteRaster, transform: Affine) -> None:
    path = write_raster("a.tif", TEXTURE, transform=transform)
    assert_refused(path, errors.UnsupportedGeoreferenceError, "geotransform", "gdal_edit")


def test_complex_numbers(write_raster: WriteRaster) -> None:
    path = write_raster("a.tif", TEXTURE.astype(np.complex64))
    assert_refused(path, errors.RasterUnreadableError, "band 1", "complex", "amplitude")


def patch_header(path: Path, tags: dict[int, int]) -> None:
    """Overwrite tags in the directory of a little-endian classic TIFF."""
    content = bytearray(path.read_bytes())
    start = struct.unpack_from("<I", content, 4)[0]
    for entry in range(struct.unpack_from("<H", content, start)[0]):
        at = start + 2 + 12 * entry
        tag = struct.unpack_from("<H", content, at)[0]
        if tag in tags:
            struct.pack_into("<HII", content, at + 2, 4, 1, tags[tag])
    path.write_bytes(bytes(content))


WIDTH_TAG, HEIGHT_TAG, BANDS_TAG = 256, 257, 277


@pytest.mark.parametrize("side", [0, 2_000_000, 2_000_000_000])
def test_absurd_size_in_the_header(write_raster: WriteRaster, side: int) -> None:
    path = write_raster("a.tif", TEXTURE)
    patch_header(path, {WIDTH_TAG: side, HEIGHT_TAG: side})
    assert_refused(path, errors.RasterUnreadableError)


def test_absurd_number_of_bands_in_the_header(write_raster: WriteRaster) -> None:
    path = write_raster("a.tif", TEXTURE)
    patch_header(path, {BANDS_TAG: 60_000})
    assert_refused(path, errors.RasterUnreadableError, "cannot be decoded")


def write_vrt(path: Path, source: str, side: int = 300) -> Path:
    path.write_text(
        f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}"><SRS>EPSG:32616</SRS>'
        "<GeoTransform>500000,30,0,1000000,0,-30</GeoTransform>"
        '<VRTRasterBand dataType="UInt16" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="1">{source}</SourceFilename>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    return path


class TestVrt:
    def test_good_ones_are_read(self, write_raster: WriteRaster, tmp_path: Path) -> None:
        write_raster("a.tif", TEXTURE)
        write_vrt(tmp_path / "inner.vrt", "a.tif")
        open_and_read(write_vrt(tmp_path / "outer.vrt", "inner.vrt"))

    def test_absurd_size(self, write_raster: WriteRaster, tmp_path: Path) -> None:
        write_raster("a.tif", TEXTURE)
        path = write_vrt(tmp_path / "a.vrt", "a.tif", 2_000_000_000)
        assert_refused(path, errors.RasterUnreadableError, "2000000000")

    def test_missing_source(self, tmp_path: Path) -> None:
        path = write_vrt(tmp_path / "a.vrt", "gone.tif")
        assert_refused(path, errors.RasterNotFoundError, "gone.tif", "Restore")

    def test_contains_itself(self, tmp_path: Path) -> None:
        path = write_vrt(tmp_path / "a.vrt", "a.vrt")
        assert_refused(path, errors.RasterUnreadableError, "contains itself")

    def test_contains_itself_through_another(self, tmp_path: Path) -> None:
        write_vrt(tmp_path / "b.vrt", "a.vrt")
        path = write_vrt(tmp_path / "a.vrt", "b.vrt")
        assert_refused(path, errors.RasterUnreadableError, "b.vrt", "contains itself")


def test_container_of_rasters_lists_them(tmp_path: Path) -> None:
    from scipy.io import netcdf_file

    with netcdf_file(tmp_path / "a.nc", "w") as container:
        for name in "yx":
            container.createDimension(name, 20)
        for name in ("first", "second"):
            container.createVariable(name, "f4", ("y", "x"))[:] = TEXTURE[:20, :20]
    words = ("container of 2 rasters", ":first", ":second")
    assert_refused(tmp_path / "a.nc", errors.RasterUnreadableError, *words)


@pytest.mark.parametrize(
    "address", ["/vsicurl/http://127.0.0.1:9/x.tif", "http://127.0.0.1:9/x.tif", "NETCDF:no.nc:v"]
)
def test_addresses_go_to_gdal(address: str) -> None:
    with pytest.raises(errors.RasterUnreadableError, match=r"cannot be opened.*Check the address"):
        open_raster(address, allow=ALL)


def test_paths_inside_archives_go_to_gdal(write_raster: WriteRaster, tmp_path: Path) -> None:
    path = write_raster("a.tif", TEXTURE)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(path, "inside.tif")
    open_and_read(f"/vsizip/{tmp_path}/a.zip/inside.tif")
    open_and_read(f"zip://{tmp_path}/a.zip!inside.tif")


def test_a_raster_beyond_the_precision_of_its_coordinates_is_refused(
    write_raster: WriteRaster,
) -> None:
    far = Affine(15.0, -5.0, 1e30, -5.0, -15.0, 0.0)
    path = write_raster("far.tif", np.ones((8, 8), np.uint8), transform=far)
    assert_refused(path, errors.UnsupportedGeoreferenceError, "cannot be told apart")
