"""Resampling north-up: positions, gaps and metadata of the warped raster."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp, MaskFlags

from geodelreg.errors import (
    LossyOutputError,
    OutputExistsError,
    OutputIsInputError,
    UnsupportedGeoreferenceError,
)
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.options import WriteOptions
from geodelreg.product.warp import north_up_grid, write_warped
from geodelreg.values.raster import Grid
from geodelreg.values.result import Correction
from tests.integration.faults import names
from tests.integration.raster_samples import (
    GCPS,
    ROTATION,
    TAGS,
    TRANSFORM,
    UTM18,
    correction_of,
    make_tiff,
    texture,
)

WKT18 = rasterio.crs.CRS.from_string(UTM18).to_wkt()
WKT19 = rasterio.crs.CRS.from_string("EPSG:32619").to_wkt()
UNUSED = Grid(Affine.identity(), (1, 1), WKT18)


def write_ramps(path: Path, transform: Affine = TRANSFORM, **profile: Any) -> Path:
    """Raster whose two bands are the column and the row of each pixel's centre."""
    rows, columns = np.mgrid[:120, :150] + 0.5
    settings = {"driver": "GTiff", "height": 120, "width": 150, "count": 2, "dtype": "float64"}
    settings |= {"crs": UTM18, "transform": transform, **profile}
    with rasterio.open(path, "w", **settings) as dataset:
        dataset.write(np.stack([columns, rows]).astype(settings["dtype"]))
    return path


def source_positions(out: Path, corrected: Affine) -> tuple[Any, Any]:
    """Column and row of the source at the centre of every output pixel."""
    with rasterio.open(out) as dataset:
        rows, columns = np.mgrid[: dataset.height, : dataset.width] + 0.5
        x, y = dataset.transform @ (columns, rows)
        if dataset.crs != UTM18:
            change = pyproj.Transformer.from_crs(dataset.crs.to_wkt(), UTM18, always_xy=True)
            x, y = change.transform(x, y)
    return ~corrected @ (x, y)


@pytest.mark.parametrize("resampling", ["bilinear", "cubic", "cubicspline"])
@pytest.mark.parametrize("case", ["ms", "pan", "pan in the next zone"])
def test_pixels_come_from_the_right_place(tmp_path: Path, case: str, resampling: str) -> None:
    origin = (750_000.0, 4_000_000.0) if "zone" in case else (TRANSFORM.c, TRANSFORM.f)
    transform = Affine.translation(*origin) @ Affine.scale(2, -2)
    source, out = write_ramps(tmp_path / "ms.tif", transform), tmp_path / "out.tif"
    correction = correction_of(source, ROTATION)
    reference = Grid(Affine(0.7, 0, origin[0] + 30, 0, -0.7, origin[1] - 20), (300, 340), WKT18)
    if "zone" in case:
        change = pyproj.Transformer.from_crs(UTM18, "EPSG:32619", always_xy=True)
        x, y = change.transform(origin[0] + 30, origin[1] - 40)
        reference = Grid(Affine(0.7, 0, x, 0, -0.7, y), (300, 340), WKT19)
    options = WriteOptions(warp=True, warp_grid=case[:3].strip(), resampling=resampling)
    assert write_warped(source, out, correction, reference, TAGS, options) == []
    columns, rows = source_positions(out, correction.corrected)
    with rasterio.open(out) as dataset:
        found_columns, found_rows = dataset.read()
        valid = dataset.dataset_mask() > 0
        if case != "ms":
            assert (dataset.transform, dataset.shape) == (reference.transform, reference.shape)
            assert dataset.crs == rasterio.crs.CRS.from_wkt(reference.crs_wkt)
    inner = (columns > 4) & (columns < 146) & (rows > 4) & (rows < 116)
    assert inner.sum() > 10_000
    assert valid[inner].all()
    assert np.abs(found_columns - columns)[inner].max() < 1e-3
    assert np.abs(found_rows - rows)[inner].max() < 1e-3
    outside = (columns < -2) | (columns > 152) | (rows < -2) | (rows > 122)
    assert not valid[outside].any()


def test_ms_grid_continues_the_original_one_and_covers_all(tmp_path: Path) -> None:
    source = write_ramps(tmp_path / "ms.tif")
    correction = correction_of(source, ROTATION)
    grid = north_up_grid(correction, (120, 150))
    assert (grid.transform.a, grid.transform.e) == (2.0, -2.0)
    assert (grid.transform.c - TRANSFORM.c) % 2 == 0
    assert (grid.transform.f - TRANSFORM.f) % 2 == 0
    height, width = grid.shape
    corners = [correction.corrected @ corner for corner in ((0, 0), (150, 0), (0, 120), (150, 120))]
    pixels = [~grid.transform @ corner for corner in corners]
    assert min(p[0] for p in pixels) >= 0 > min(p[0] for p in pixels) - 1
    assert min(p[1] for p in pixels) >= 0 > min(p[1] for p in pixels) - 1
    assert max(p[0] for p in pixels) <= width < max(p[0] for p in pixels) + 1
    assert max(p[1] for p in pixels) <= height < max(p[1] for p in pixels) + 1


def test_unmoved_grid_stays_itself() -> None:
    correction = Correction("none", WKT18, TRANSFORM, TRANSFORM)
    assert north_up_grid(correction, (120, 150)) == Grid(TRANSFORM, (120, 150), WKT18)


@pytest.mark.parametrize("angle_deg", [30.0, 90.0, -90.0, 180.0])
def test_rotated_grids_become_north_up(angle_deg: float) -> None:
    original = Affine.translation(500, 900) @ Affine.rotation(angle_deg) @ Affine.scale(2, -3)
    grid = north_up_grid(Correction("none", WKT18, original, original), (100, 50))
    sizes = (2.0, 3.0) if abs(angle_deg) != 90 else (3.0, 2.0)
    assert (grid.transform.a, -grid.transform.e) == pytest.approx(sizes)
    assert grid.transform.b == grid.transform.d == 0


def test_no_data_of_each_band_stays_apart(tmp_path: Path) -> None:
    source, out = write_ramps(tmp_path / "ms.tif", dtype="uint16", nodata=0), tmp_path / "out.tif"
    with rasterio.open(source, "r+") as dataset:
        data = np.full((2, 120, 150), 1000, dtype=np.uint16)
        data[1, 50:70, 40:60] = 0
        dataset.write(data)
    correction = correction_of(source, ROTATION)
    write_warped(source, out, correction, UNUSED, TAGS, WriteOptions(warp=True))
    columns, rows = source_positions(out, correction.corrected)
    with rasterio.open(out) as dataset:
        assert (dataset.nodata, dataset.dtypes) == (0, ("uint16", "uint16"))
        first, second = dataset.read()
    assert set(np.unique(first)) == {0, 1000}
    assert set(np.unique(second)) == {0, 1000}
    gap = (np.abs(columns - 50) < 9) & (np.abs(rows - 60) < 9)
    assert (second[gap] == 0).all()
    assert (first[gap] == 1000).all()
    assert (first[(columns < -2) | (rows < -2)] == 0).all()


@pytest.mark.parametrize("mask", ["internal", "external", None])
def test_mask_is_warped_and_covers_what_is_missing(tmp_path: Path, mask: str | None) -> None:
    source, out = make_tiff(tmp_path / "ms.tif", mask=mask), tmp_path / "out.tif"
    correction = correction_of(source, ROTATION)
    write_warped(source, out, correction, UNUSED, TAGS, WriteOptions(warp=True))
    columns, rows = source_positions(out, correction.corrected)
    with rasterio.open(out) as dataset:
        assert dataset.mask_flag_enums == ([MaskFlags.per_dataset],) * 4
        assert dataset.nodata is None
        valid = dataset.dataset_mask() > 0
    assert names(tmp_path) - {"ms.tif.msk"} == {"ms.tif", "out.tif"}
    assert not valid[(columns < -1) | (columns > 211) | (rows < -1) | (rows > 191)].any()
    masked = (columns > 1) & (columns < 49) & (rows > 1) & (rows < 46)
    assert valid[masked].any() == (mask is None)
    assert valid[(columns > 52) & (columns < 208) & (rows > 2) & (rows < 188)].all()


def test_alpha_band_stays_the_alpha_band(tmp_path: Path) -> None:
    source, out = tmp_path / "ms.tif", tmp_path / "out.tif"
    profile = {"driver": "GTiff", "width": 90, "height": 80, "count": 4, "dtype": "uint8"}
    profile |= {"photometric": "rgb", "crs": UTM18, "transform": TRANSFORM, "alpha": "yes"}
    with rasterio.open(source, "w", **profile) as dataset:
        data = texture((4, 80, 90), "uint8")
        data[3] = 255
        data[3, :20] = 0
        dataset.write(data)
        dataset.colorinterp = (
            ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha,
        )  # fmt: skip
    correction = correction_of(source, ROTATION)
    write_warped(source, out, correction, UNUSED, TAGS, WriteOptions(warp=True))
    columns, rows = source_positions(out, correction.corrected)
    with rasterio.open(out) as dataset:
        assert dataset.colorinterp[3] is ColorInterp.alpha
        alpha = dataset.read(4)
    assert (alpha[(columns < -1) | (rows < 19)] == 0).all()
    assert (alpha[(columns > 2) & (columns < 88) & (rows > 22) & (rows < 78)] == 255).all()


def test_float_without_no_data_gets_nan(tmp_path: Path) -> None:
    source, out = write_ramps(tmp_path / "ms.tif", dtype="float32"), tmp_path / "out.tif"
    with rasterio.open(source, "r+") as dataset:
        data = dataset.read()
        data[:, 60, 70] = np.nan
        dataset.write(data)
    correction = correction_of(source, ROTATION)
    write_warped(source, out, correction, UNUSED, TAGS, WriteOptions(warp=True))
    columns, rows = source_positions(out, correction.corrected)
    with rasterio.open(out) as dataset:
        assert math.isnan(dataset.nodata)
        first = dataset.read(1)
    assert np.isnan(first[(columns < -1) | (rows < -1)]).all()
    far = (np.hypot(columns - 70.5, rows - 60.5) > 4) & (columns > 3) & (columns < 147)
    assert np.isfinite(first[far & (rows > 3) & (rows < 117)]).all()


def test_metadata_stays(tmp_path: Path) -> None:
    source, out = make_tiff(tmp_path / "ms.tif", overviews="internal"), tmp_path / "out.tif"
    with rasterio.open(source, "r+") as dataset:
        dataset.update_tags(1, STATISTICS_MEAN="77")
    correction = correction_of(source, ROTATION)
    write_warped(source, out, correction, UNUSED, TAGS, WriteOptions(warp=True))
    with rasterio.open(source) as before, rasterio.open(out) as after:
        for name in ("dtypes", "descriptions", "colorinterp", "scales", "offsets", "units"):
            assert getattr(after, name) == getattr(before, name), name
        assert after.overviews(1) == before.overviews(1)
        assert after.tags(ns="PRODUCT") == {"LEVEL": "L1"}
        assert after.tags(2, ns="CALIBRATION") == {"GAIN": "2"}
        assert after.tags(1) == {"WAVELENGTH": "401"}
        assert after.tags()["MISSION"] == before.tags()["MISSION"]
        assert TAGS.items() <= after.tags().items()
        assert after.profile["tiled"]
        assert after.compression is not None


def test_colour_table_is_resampled_by_nearest_neighbour(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", dtype="uint8", count=1)
    with rasterio.open(source, "r+") as dataset:
        dataset.write((dataset.read() > 100).astype(np.uint8) * 200)
        dataset.write_colormap(1, {0: (1, 2, 3, 255), 200: (9, 8, 7, 255)})
    out = tmp_path / "out.tif"
    warnings = write_warped(
        source, out, correction_of(source, ROTATION), UNUSED, TAGS, WriteOptions(warp=True)
    )
    assert "nearest" in warnings[0]
    with rasterio.open(out) as dataset:
        assert set(np.unique(dataset.read(1))) == {0, 200}
        assert dataset.colormap(1)[200] == (9, 8, 7, 255)


FLAGS = np.array([1, 21824, 21888, 22080, 22280, 23826, 23888, 30048, 54596], dtype=np.uint16)
"""Of Landsat's QA_PIXEL: fill, clear, water, clouds, shadow, snow, cirrus."""


def write_flags(
    path: Path,
    names: tuple[str | None, ...],
    overviews: bool = True,
    repeats: int = 4,
    **profile: Any,
) -> Path:
    """Raster of flags, in which the bands called B2 are images."""
    height, width = 30 * repeats, 38 * repeats
    settings = {"driver": "GTiff", "height": height, "width": width, "count": len(names)}
    settings |= {"dtype": "uint16", "crs": UTM18, "transform": TRANSFORM, **profile}
    random = np.random.default_rng(4)
    with rasterio.open(path, "w", **settings) as dataset:
        for band, name in enumerate(names, start=1):
            data = random.choice(FLAGS, (30, 38)).repeat(repeats, axis=0).repeat(repeats, axis=1)
            if name and "B2" in name:
                data = texture((1, height, width), "uint16")[0]
            dataset.write(data, band)
            dataset.set_band_description(band, name or "")
        if overviews:
            dataset.build_overviews([2, 4], rasterio.enums.Resampling.nearest)
    return path


@pytest.mark.parametrize("driver", ["GTiff", "COG"])
@pytest.mark.parametrize("resampling", ["bilinear", "cubic", "lanczos", "average"])
@pytest.mark.parametrize("nodata", [None, 0])
def test_flags_are_never_averaged(
    tmp_path: Path, nodata: int | None, resampling: str, driver: str
) -> None:
    names = ("B2", "QA_PIXEL", "B2 again", "SCL")
    source = write_flags(tmp_path / "ms.tif", names, nodata=nodata)
    out, plain = tmp_path / "out.tif", tmp_path / "plain.tif"
    correction = correction_of(source, ROTATION)
    options = WriteOptions(warp=True, resampling=resampling, driver=driver)
    warnings = write_warped(source, out, correction, UNUSED, TAGS, options)
    assert len(warnings) == 1
    assert "bands 2 (QA_PIXEL) and 4 (SCL)" in warnings[0]
    assert "nearest" in warnings[0]
    for level in (None, 0, 1):
        opened = {} if level is None else {"OVERVIEW_LEVEL": level}
        with rasterio.open(out, **opened) as dataset:
            for band in (2, 4):
                assert set(np.unique(dataset.read(band))) <= {0, *FLAGS.tolist()}
    columns, rows = source_positions(out, correction.corrected)
    inner = (columns > 1) & (columns < 151) & (rows > 1) & (rows < 119)
    # a pixel's centre that lies near its edge may belong to the next
    clear = inner & (np.abs(columns % 1 - 0.5) < 0.49) & (np.abs(rows % 1 - 0.5) < 0.49)
    with rasterio.open(source) as before, rasterio.open(out) as after:
        for band in (2, 4):
            there = before.read(band)[rows[clear].astype(int), columns[clear].astype(int)]
            assert np.array_equal(after.read(band)[clear], there)
        images = after.read([1, 3])
    with rasterio.open(source, "r+") as dataset:
        for band in (2, 4):
            dataset.set_band_description(band, "")
    assert write_warped(source, plain, correction, UNUSED, TAGS, options) == []
    with rasterio.open(plain) as dataset:
        assert np.array_equal(dataset.read([1, 3]), images)  # the images are resampled as ever
        assert not set(np.unique(dataset.read(2))) <= {0, *FLAGS.tolist()}


def test_quality_band_in_a_file_of_its_own_is_resampled_by_nearest_neighbour(
    tmp_path: Path,
) -> None:
    source = write_flags(tmp_path / "LC08_L2SP_T1_QA_PIXEL.TIF", (None,))
    for driver in ("GTiff", "COG"):
        out = tmp_path / f"{driver}.tif"
        options = WriteOptions(warp=True, driver=driver)
        warnings = write_warped(source, out, correction_of(source, ROTATION), UNUSED, TAGS, options)
        assert "nearest" in warnings[0]
        for level in (-1, 0, 1):
            with rasterio.open(out, **({} if level < 0 else {"OVERVIEW_LEVEL": level})) as dataset:
                assert set(np.unique(dataset.read(1))) <= {0, *FLAGS.tolist()}


def test_overviews_that_a_cog_adds_hold_flags_of_the_file(tmp_path: Path) -> None:
    source = write_flags(tmp_path / "ms.tif", ("B2", "QA_PIXEL"), overviews=False, repeats=20)
    for warp in (True, False):
        out, options = tmp_path / f"{warp}.tif", WriteOptions(warp=warp, driver="COG")
        if warp:
            write_warped(source, out, correction_of(source, ROTATION), UNUSED, TAGS, options)
        else:
            write_corrected(source, out, correction_of(source), GCPS, TAGS, options)
        with rasterio.open(out, OVERVIEW_LEVEL=0) as dataset:
            assert set(np.unique(dataset.read(2))) <= {0, *FLAGS.tolist()}


def test_flags_asked_for_by_nearest_neighbour_need_no_warning(tmp_path: Path) -> None:
    source = write_flags(tmp_path / "ms.tif", ("B2", "QA_PIXEL"))
    options = WriteOptions(warp=True, resampling="nearest")
    correction = correction_of(source, ROTATION)
    assert write_warped(source, tmp_path / "out.tif", correction, UNUSED, TAGS, options) == []


def test_pixel_is_point_is_placed_right(tmp_path: Path) -> None:
    source, out = write_ramps(tmp_path / "ms.tif"), tmp_path / "out.tif"
    with rasterio.open(source, "r+") as dataset:
        dataset.update_tags(AREA_OR_POINT="Point")
    correction = correction_of(source, ROTATION)
    write_warped(source, out, correction, UNUSED, TAGS, WriteOptions(warp=True))
    columns, rows = source_positions(out, correction.corrected)
    inner = (columns > 4) & (columns < 146) & (rows > 4) & (rows < 116)
    with rasterio.open(out) as dataset:
        assert dataset.tags()["AREA_OR_POINT"] == "Point"
        assert np.abs(dataset.read(1) - columns)[inner].max() < 1e-3


def test_creation_options_and_other_formats(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    correction = correction_of(source, ROTATION)
    plain, cog, envi = (tmp_path / name for name in ("out.tif", "cog.tif", "out.dat"))
    options = WriteOptions(warp=True, creation_options=("COMPRESS=ZSTD", "BLOCKXSIZE=128"))
    write_warped(source, plain, correction, UNUSED, TAGS, options)
    for path, driver in ((cog, "COG"), (envi, "ENVI")):
        write_warped(source, path, correction, UNUSED, TAGS, WriteOptions(warp=True, driver=driver))
    with rasterio.open(plain) as dataset:
        assert dataset.compression.name == "zstd"
        assert dataset.block_shapes[0] == (256, 128)
        expected, grid = dataset.read(), dataset.transform
    for path, driver in ((cog, "GTiff"), (envi, "ENVI")):
        with rasterio.open(path) as dataset:
            assert dataset.driver == driver
            assert dataset.transform == grid
            assert TAGS.items() <= dataset.tags().items()
            np.testing.assert_array_equal(dataset.read(), expected)
    with rasterio.open(cog) as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"


def test_refusals_leave_nothing(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", dtype="uint8", count=3)
    correction = correction_of(source, ROTATION)
    (tmp_path / "there.tif").write_bytes(b"older")
    with pytest.raises(OutputExistsError, match=r"there\.tif"):
        write_warped(
            source, tmp_path / "there.tif", correction, UNUSED, TAGS, WriteOptions(warp=True)
        )
    with pytest.raises(OutputIsInputError, match=r"ms\.tif"):
        write_warped(source, source, correction, UNUSED, TAGS, WriteOptions(warp=True))
    with pytest.raises(LossyOutputError, match=r"out\.jpg"):
        write_warped(
            source, tmp_path / "out.jpg", correction, UNUSED, TAGS, WriteOptions(warp=True)
        )
    assert names(tmp_path) == {"ms.tif", "there.tif"}


def test_pixels_too_large_for_a_grid_are_refused(tmp_path: Path) -> None:
    source = write_ramps(tmp_path / "ms.tif")
    tall = Affine(10.0, 0.0, 500_000.0, 0.0, -1e-310, 4e6)
    correction = Correction("affine", UTM18, tall, Affine.translation(0, 1e5) @ tall)
    with pytest.raises(UnsupportedGeoreferenceError, match=r"ms\.tif is too large"):
        write_warped(
            source, tmp_path / "out.tif", correction, UNUSED, TAGS, WriteOptions(warp=True)
        )
    assert names(tmp_path) == {"ms.tif"}
