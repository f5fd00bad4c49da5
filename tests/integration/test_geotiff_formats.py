"""Other formats and creation options: decoded pixels are identical, or the output is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp

from geodelreg.errors import (
    AccessNotAllowedError,
    LossyOutputError,
    RasterUnreadableError,
    UsageError,
)
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.options import WriteOptions
from tests.integration.faults import names
from tests.integration.raster_samples import (
    GCPS,
    ROTATION,
    SHIFT,
    TAGS,
    TRANSFORM,
    UTM18,
    assert_same_pixels,
    correction_of,
    description,
    make_cog,
    make_tiff,
    texture,
    transform_of,
)


def write(source: Path, target: Path, change: Affine = SHIFT, **options: Any) -> list[str]:
    return write_corrected(
        source, target, correction_of(source, change), GCPS, TAGS, WriteOptions(**options)
    )


def make_raster(path: Path, driver: str, bands: int = 3, dtype: str = "uint8") -> Path:
    profile = {"driver": driver, "width": 80, "height": 60, "count": bands, "dtype": dtype}
    options = {"QUALITY": "100", "REVERSIBLE": "YES"} if driver == "JP2OpenJPEG" else {}
    with rasterio.open(path, "w", **profile, crs=UTM18, transform=TRANSFORM, **options) as dataset:
        dataset.write(texture((bands, 60, 80), dtype))
    return path


def make_vrt(folder: Path) -> Path:
    (folder / "tiles").mkdir()
    make_tiff(folder / "tiles" / "ms.tif")
    path = folder / "ms.vrt"
    rasterio.shutil.copy(folder / "tiles" / "ms.tif", path, driver="VRT")
    return path


@pytest.mark.parametrize("change", [SHIFT, ROTATION], ids=["shift", "rotation"])
@pytest.mark.parametrize("kind", ["JP2OpenJPEG", "ENVI", "PNG", "HFA", "VRT"])
def test_other_formats_become_geotiffs(tmp_path: Path, kind: str, change: Affine) -> None:
    source = make_vrt(tmp_path) if kind == "VRT" else make_raster(tmp_path / "ms.bin", kind)
    out = tmp_path / "out.tif"
    write(source, out, change)
    assert transform_of(out).almost_equals(TRANSFORM @ change, precision=1e-9)
    assert_same_pixels(source, out)
    with rasterio.open(out) as dataset, rasterio.open(source) as before:
        assert dataset.crs == UTM18
        assert dataset.driver == "GTiff"
        assert (dataset.descriptions, dataset.scales) == (before.descriptions, before.scales)
        assert TAGS.items() <= dataset.tags().items()
        assert len(json.loads(dataset.tags(ns="GEODELREG")["GCPS"])) == 3


def test_png_with_world_file(tmp_path: Path) -> None:
    source = make_raster(tmp_path / "ms.png", "PNG")
    (tmp_path / "ms.png.aux.xml").write_text(f"<PAMDataset><SRS>{UTM18}</SRS></PAMDataset>")
    (tmp_path / "ms.pgw").write_text("4\n0\n0\n-4\n102\n198\n")
    write(source, tmp_path / "out.tif")
    assert transform_of(tmp_path / "out.tif") == Affine(4, 0, 100, 0, -4, 200) @ SHIFT
    assert_same_pixels(source, tmp_path / "out.tif")


@pytest.mark.parametrize("change", [SHIFT, ROTATION], ids=["shift", "rotation"])
@pytest.mark.parametrize(
    ("name", "driver"),
    [("out.jp2", None), ("out.dat", "ENVI"), ("out.png", None), ("out.img", None), ("o.vrt", None)],
)
def test_geotiff_becomes_another_format(
    tmp_path: Path, name: str, driver: str | None, change: Affine
) -> None:
    source = make_tiff(tmp_path / "ms.tif", mask="internal")
    out = tmp_path / name
    write(source, out, change, driver=driver)
    assert transform_of(out).almost_equals(TRANSFORM @ change, precision=1e-7)
    assert_same_pixels(source, out)
    with rasterio.open(out) as dataset:
        assert dataset.driver == {"out.dat": "ENVI"}.get(name, dataset.driver)
        assert dataset.crs == UTM18
        assert TAGS.items() <= dataset.tags().items()
        assert len(json.loads(dataset.tags(ns="GEODELREG")["GCPS"])) == 3
        assert dataset.tags(ns="PRODUCT") == {"LEVEL": "L1"}


def test_what_a_format_cannot_hold_is_said(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", overviews="internal", count=3)
    with rasterio.open(source, "r+") as dataset:
        dataset.colorinterp = [ColorInterp.nir, ColorInterp.red, ColorInterp.green]
    warnings = write(source, tmp_path / "out.png")
    assert any("overviews" in text for text in warnings)
    assert any("colour interpretation" in text for text in warnings)


@pytest.mark.parametrize(
    "creation",
    [
        ("COMPRESS=ZSTD",),
        ("compress=lzw", "predictor=2"),
        ("TILED=NO",),
        ("INTERLEAVE=BAND",),
        ("BIGTIFF=YES", "BLOCKXSIZE=128", "BLOCKYSIZE=128"),
        ("COMPRESS=NONE",),
    ],
)
def test_creation_options_keep_everything_else(tmp_path: Path, creation: tuple[str, ...]) -> None:
    source = make_tiff(tmp_path / "ms.tif", mask="internal", overviews="internal")
    out = tmp_path / "out.tif"
    assert write(source, out, creation_options=creation) == []
    before, after = description(source), description(out)
    for text in creation:
        key, value = text.lower().split("=")
        if key == "compress":
            assert after["profile"].get("compress", "none") == value
        elif key == "tiled":
            assert not after["profile"]["tiled"]
        elif key == "interleave":
            assert after["profile"]["interleave"] == value
    for key in ("nodata", "dtypes", "masks", "overviews", "colorinterp", "descriptions", "scales"):
        assert after[key] == before[key], key
    kept = {place: tags for place, tags in before["tags"].items() if place[1] != "IMAGE_STRUCTURE"}
    assert {place: after["tags"][place] for place in kept} == kept
    for level in (None, 0, 1):
        assert_same_pixels(source, out, level)
    assert transform_of(out) == TRANSFORM @ SHIFT


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("out.tif", {"creation_options": ("COMPRESS=JPEG",)}),
        ("out.tif", {"creation_options": ("COMPRESS=WEBP",)}),
        ("out.tif", {"creation_options": ("COMPRESS=LERC", "MAX_Z_ERROR=3")}),
        ("out.tif", {"creation_options": ("NBITS=4",)}),
        ("out.tif", {"driver": "COG", "creation_options": ("COMPRESS=JPEG",)}),
        ("out.jpg", {}),
        ("out.jp2", {"creation_options": ("QUALITY=20", "REVERSIBLE=NO")}),
    ],
)
def test_lossy_outputs_are_refused(tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    source = make_tiff(tmp_path / "ms.tif", "tiled", dtype="uint8", count=3)
    with pytest.raises(LossyOutputError, match=rf"{name}.*lossless"):
        write(source, tmp_path / name, **options)
    assert names(tmp_path) == {"ms.tif"}


def test_change_of_data_type_is_refused(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", dtype="float32", count=1)
    with pytest.raises(LossyOutputError, match=r"out\.png.*instead of float32"):
        write(source, tmp_path / "out.png")
    assert names(tmp_path) == {"ms.tif"}


def test_lossy_source_is_written_anew_without_loss(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", "jpeg")
    warnings = write(source, tmp_path / "out.tif", creation_options=("BIGTIFF=YES",))
    assert any("DEFLATE" in text for text in warnings)
    assert_same_pixels(source, tmp_path / "out.tif")


@pytest.mark.parametrize("creation", [(), ("COMPRESS=ZSTD", "BLOCKSIZE=256")])
def test_geotiff_becomes_a_cog(tmp_path: Path, creation: tuple[str, ...]) -> None:
    source = make_tiff(tmp_path / "ms.tif", shape=(600, 700), mask="internal", overviews="internal")
    out = tmp_path / "out.tif"
    assert write(source, out, ROTATION, driver="cog", creation_options=creation) == []
    with rasterio.open(out) as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.overviews(1) == [2, 4]
        assert dataset.tags(2, ns="CALIBRATION") == {"GAIN": "2"}
    assert transform_of(out).almost_equals(TRANSFORM @ ROTATION, precision=1e-9)
    for level in (None, 0, 1):
        assert_same_pixels(source, out, level)


def test_cog_with_new_options_stays_a_cog_when_asked(tmp_path: Path) -> None:
    source = make_cog(tmp_path / "ms.tif")
    out = tmp_path / "out.tif"
    assert write(source, out, driver="COG", creation_options=("COMPRESS=ZSTD",)) == []
    with rasterio.open(out) as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.compression.name == "zstd"
    for level in (None, 0):
        assert_same_pixels(source, out, level)


def test_gcps_place_other_formats_too(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", count=1)
    for name in ("out.vrt", "out.png"):
        write(source, tmp_path / name, georef="gcps")
        with rasterio.open(tmp_path / name) as dataset:
            gcps, crs = dataset.gcps
        assert crs == UTM18
        assert [(g.col, g.row, g.x, g.y) for g in gcps] == [
            (g.column, g.row, g.x, g.y) for g in GCPS
        ]


def test_unknown_formats_are_wrong_usage(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    with pytest.raises(UsageError, match=r"\.xyzzy.*`driver='GTiff'`"):
        write(source, tmp_path / "out.xyzzy")
    with pytest.raises(UsageError, match="Nonsense"):
        write(source, tmp_path / "out.tif", driver="Nonsense")
    with pytest.raises(AccessNotAllowedError, match=r"out\.tif.*MRF can open others.*all"):
        write(source, tmp_path / "out.tif", driver="mrf")
    with pytest.raises(AccessNotAllowedError, match=r"out\.tif.*WMTS.*network"):
        write(source, tmp_path / "out.tif", driver="WMTS")
    assert names(tmp_path) == {"ms.tif"}


def test_broken_blocks_are_the_fault_of_the_source(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", "zstd")
    correction = correction_of(source)
    data = bytearray(source.read_bytes())
    data[400 : len(data) // 2] = bytes(len(data) // 2 - 400)
    source.write_bytes(data)
    options = WriteOptions(creation_options=("COMPRESS=NONE",))
    with pytest.raises(RasterUnreadableError, match=r"ms\.tif"):
        write_corrected(source, tmp_path / "out.tif", correction, GCPS, TAGS, options)
    assert names(tmp_path) == {"ms.tif"}


def test_overwritten_multi_file_format_leaves_nothing_stale(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", mask="internal")
    out = tmp_path / "out.dat"
    write(source, out, driver="ENVI")
    first = names(tmp_path)
    write(source, out, ROTATION, driver="ENVI", overwrite=True)
    assert names(tmp_path) == first
    assert transform_of(out).almost_equals(TRANSFORM @ ROTATION, precision=1e-7)
    np.testing.assert_array_equal(
        rasterio.open(out).read_masks(1), rasterio.open(source).read_masks(1)
    )
