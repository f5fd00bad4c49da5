"""GeoTIFF in, GeoTIFF out: encoded blocks, masks, overviews and metadata are those of the input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from affine import Affine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geodelreg.errors import (
    LossyOutputError,
    RasterNotFoundError,
    RasterUnreadableError,
    UsageError,
)
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.options import WriteOptions
from geodelreg.values.result import Correction
from tests.integration.raster_samples import (
    ENCODINGS,
    GCPS,
    ROTATION,
    SHIFT,
    TAGS,
    TRANSFORM,
    UTM18,
    assert_same_pixels,
    correction_of,
    description,
    encoded_blocks,
    make_cog,
    make_tiff,
    transform_of,
)


def write(source: Path, change: Affine = SHIFT, name: str = "out.tif", **options: object) -> Path:
    target = source.with_name(name)
    target_options = WriteOptions(**options)  # type: ignore[arg-type]
    warnings = write_corrected(
        source, target, correction_of(source, change), GCPS, TAGS, target_options
    )
    assert warnings == []
    return target


def assert_corrected_copy(source: Path, out: Path, change: Affine) -> None:
    assert transform_of(out).almost_equals(transform_of(source) @ change, precision=1e-9)
    assert encoded_blocks(out) == encoded_blocks(source)
    assert description(out) == description(source)
    assert_same_pixels(source, out)


@pytest.mark.parametrize("change", [SHIFT, ROTATION], ids=["shift", "rotation"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encoded_blocks_and_metadata_survive(tmp_path: Path, encoding: str, change: Affine) -> None:
    source = make_tiff(tmp_path / "ms.tif", encoding, mask="internal", overviews="internal")
    before = source.read_bytes()
    assert_corrected_copy(source, write(source, change), change)
    assert source.read_bytes() == before


@pytest.mark.parametrize("mask", ["internal", "external", None])
@pytest.mark.parametrize("overviews", ["internal", "external", None])
def test_masks_and_overviews_survive(
    tmp_path: Path, mask: str | None, overviews: str | None
) -> None:
    source = make_tiff(tmp_path / "ms.tif", mask=mask, overviews=overviews)
    out = write(source)
    assert_corrected_copy(source, out, SHIFT)
    for level in range(2 if overviews else 0):
        assert_same_pixels(source, out, level)
    for suffix in (".msk", ".ovr", ".msk.ovr"):
        side = source.with_name(source.name + suffix)
        assert out.with_name(out.name + suffix).exists() == side.exists()


@pytest.mark.parametrize("nodata", [0, 65535, None])
def test_no_data_value_survives(tmp_path: Path, nodata: int | None) -> None:
    source = make_tiff(tmp_path / "ms.tif", nodata=nodata)
    assert_corrected_copy(source, write(source), SHIFT)


def test_float_with_nan_survives(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", dtype="float32", predictor=3, nodata=float("nan"))
    with rasterio.open(source, "r+") as dataset:
        values = dataset.read()
        values[:, :20] = np.nan
        dataset.write(values)
    out = write(source)
    assert_corrected_copy(source, out, SHIFT)


def test_colour_table_survives(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", dtype="uint8", count=1)
    with rasterio.open(source, "r+") as dataset:
        dataset.write_colormap(1, {value: (value, 255 - value, 7, 255) for value in range(256)})
    assert_corrected_copy(source, write(source), SHIFT)


def test_pixel_is_point_keeps_its_half_pixel(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    with rasterio.open(source, "r+") as dataset:
        dataset.update_tags(AREA_OR_POINT="Point")
    for change in (SHIFT, ROTATION):
        out = write(source, change, overwrite=True)
        assert_corrected_copy(source, out, change)
        assert description(out)["tags"][0, ""]["AREA_OR_POINT"] == "Point"
        with tifffile.TiffFile(out) as tiff:
            tags = tiff.pages[0].tags
            corner = transform_of(source) @ change @ (0.5, 0.5)
            placed = tags[33922].value[3:5] if change is SHIFT else tags[34264].value[3:8:4]
            assert placed == pytest.approx(corner, abs=1e-6)


def test_rotation_leaves_no_pixel_scale_behind(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    with tifffile.TiffFile(write(source, ROTATION)) as tiff:
        codes = {tag.code for tag in tiff.pages[0].tags}
    assert 34264 in codes
    assert codes.isdisjoint({33550, 33922})
    with tifffile.TiffFile(write(source, SHIFT, "north_up.tif")) as tiff:
        assert 34264 not in {tag.code for tag in tiff.pages[0].tags}


def test_tags_and_gcps_are_inside(tmp_path: Path) -> None:
    with rasterio.open(write(make_tiff(tmp_path / "ms.tif"))) as dataset:
        assert TAGS.items() <= dataset.tags().items()
        rows = json.loads(dataset.tags(ns="GEODELREG")["GCPS"])
    assert [(r["id"], r["column"], r["row"], r["x"], r["y"], r["z"], r["info"]) for r in rows] == [
        (g.id, g.column, g.row, g.x, g.y, g.z, g.info) for g in GCPS
    ]


def test_aligning_an_output_again_replaces_its_provenance(tmp_path: Path) -> None:
    first = write(make_tiff(tmp_path / "ms.tif"))
    target = tmp_path / "again.tif"
    write_corrected(
        first, target, correction_of(first), GCPS[:1], {"GEODELREG_RUN": "2"}, WriteOptions()
    )
    with rasterio.open(target) as dataset:
        ours = {k: v for k, v in dataset.tags().items() if k.startswith("GEODELREG")}
        assert ours == {"GEODELREG_RUN": "2"}
        assert len(json.loads(dataset.tags(ns="GEODELREG")["GCPS"])) == 1
        assert dataset.tags()["MISSION"] == "Test & <Sat> é"


def test_unchanged_geotransform_keeps_its_tags_as_they_are(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    out = write(source, Affine.identity())
    with tifffile.TiffFile(source) as before, tifffile.TiffFile(out) as after:
        for code in (33550, 33922, 34735, 34737):
            assert before.pages[0].tags[code].value == after.pages[0].tags[code].value


def test_georef_gcps_places_the_raster_by_them(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    for point in (False, True):
        if point:
            with rasterio.open(source, "r+") as dataset:
                dataset.update_tags(AREA_OR_POINT="Point")
        out = write(source, georef="gcps", overwrite=True)
        with rasterio.open(out) as dataset:
            gcps, crs = dataset.gcps
            assert dataset.transform.is_identity
            assert crs == UTM18
        assert [(g.col, g.row, g.x, g.y) for g in gcps] == [
            (g.column, g.row, g.x, g.y) for g in GCPS
        ]
        assert encoded_blocks(out) == encoded_blocks(source)


def test_georef_gcps_without_gcps_is_wrong_usage(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    with pytest.raises(UsageError, match="no ground control points"):
        write_corrected(
            source, tmp_path / "o.tif", correction_of(source), [], TAGS, WriteOptions(georef="gcps")
        )
    assert not (tmp_path / "o.tif").exists()


def test_metadata_in_latin_1_survives(tmp_path: Path) -> None:
    source = tmp_path / "ms.tif"
    text = "capteur à défilement".encode("latin-1")
    data = np.arange(600, dtype=np.uint8).reshape(20, 30)
    item = b'<GDALMetadata>\n<Item name="NOTE">' + text + b"</Item>\n</GDALMetadata>"
    with tifffile.TiffWriter(source) as tiff:
        tiff.write(data, software=text, extratags=[(42112, 2, 0, item, True)])
    pam = f"<PAMDataset><SRS>{UTM18}</SRS><GeoTransform>0,2,0,9,0,-2</GeoTransform></PAMDataset>"
    (tmp_path / "ms.tif.aux.xml").write_text(pam)
    with tifffile.TiffFile(write(source)) as tiff:
        tags = tiff.pages[0].tags
        assert tags["Software"].value.encode("latin-1") == text
        file = tiff.filehandle
        file.seek(tags[42112].valueoffset)
        assert text in file.read(tags[42112].count)
    for name in ("out.dat", "out.vrt"):
        target = tmp_path / name
        options = WriteOptions(driver="ENVI" if name == "out.dat" else None)
        write_corrected(source, target, correction_of(source), GCPS, TAGS, options)
        assert_same_pixels(source, target)


FINITE = {"allow_nan": False, "allow_infinity": False}


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    pixel=st.floats(1e-6, 1e4, **FINITE),
    aspect=st.floats(-3, 3, **FINITE).filter(lambda v: abs(v) > 0.2),
    angle_deg=st.one_of(st.just(0.0), st.floats(-180, 180, **FINITE)),
    shear_deg=st.one_of(st.just(0.0), st.floats(-20, 20, **FINITE)),
    origin=st.tuples(st.floats(-2e7, 2e7, **FINITE), st.floats(-2e7, 2e7, **FINITE)),
    encoding=st.sampled_from(["striped", "big-endian", "bigtiff"]),
    point=st.booleans(),
)
def test_any_affine_is_read_back_exactly(
    tmp_path: Path,
    pixel: float,
    aspect: float,
    angle_deg: float,
    shear_deg: float,
    origin: tuple[float, float],
    encoding: str,
    point: bool,
) -> None:
    source = make_tiff(tmp_path / "ms.tif", encoding, shape=(8, 16), count=1)
    if point:
        with rasterio.open(source, "r+") as dataset:
            dataset.update_tags(AREA_OR_POINT="Point")
    wanted = (
        Affine.translation(*origin)
        @ Affine.rotation(angle_deg)
        @ Affine.shear(shear_deg, 0.0)
        @ Affine.scale(pixel, pixel * aspect)
    )
    correction = Correction("affine", UTM18, TRANSFORM, wanted)
    out = tmp_path / "out.tif"
    write_corrected(source, out, correction, [], {}, WriteOptions(overwrite=True))
    found = transform_of(out)
    # a double itself is no finer than this at that distance from the origin
    grain = 4 * np.spacing(max(map(abs, origin)) + 20 * pixel * 3)
    for corner in ((0, 0), (16, 0), (0, 8), (16, 8)):
        moved = np.subtract(found @ corner, wanted @ corner)
        assert np.abs(moved).max() <= 1e-9 * pixel + grain


def test_pansharpening_of_gdal_accepts_the_output(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", dtype="uint8", count=3, encoding="striped")
    out = write(source, Affine.translation(1.25, -3.5) @ Affine.scale(1.001, 0.999))
    placed = transform_of(out)
    pan = tmp_path / "pan.tif"
    profile = {"driver": "GTiff", "width": 840, "height": 760, "count": 1, "dtype": "uint8"}
    grid = placed @ Affine.scale(0.25)
    with rasterio.open(pan, "w", **profile, crs=UTM18, transform=grid) as dataset:
        dataset.write(np.full((1, 760, 840), 120, dtype=np.uint8))
    bands = "".join(
        f'<SpectralBand dstBand="{b}"><SourceFilename>{out}</SourceFilename>'
        f"<SourceBand>{b}</SourceBand></SpectralBand>"
        for b in (1, 2, 3)
    )
    with rasterio.open(
        '<VRTDataset subClass="VRTPansharpenedDataset"><PansharpeningOptions>'
        f"<PanchroBand><SourceFilename>{pan}</SourceFilename><SourceBand>1</SourceBand></PanchroBand>"
        f"{bands}</PansharpeningOptions></VRTDataset>"
    ) as sharpened:
        assert (sharpened.count, sharpened.shape) == (3, (760, 840))
        assert sharpened.transform.almost_equals(grid, precision=1e-9)
        assert sharpened.read().any()


@pytest.mark.parametrize("options", [{}, {"JPEG": 1}], ids=["deflate", "jpeg"])
@pytest.mark.parametrize("bigtiff", ["NO", "YES"])
@pytest.mark.parametrize("driver", [None, "GTiff", "COG"])
def test_cog_stays_cog_with_its_blocks(
    tmp_path: Path, options: dict[str, int], bigtiff: str, driver: str | None
) -> None:
    encoding = "jpeg" if options else "tiled-deflate"
    compression = "JPEG" if options else "DEFLATE"
    source = make_cog(tmp_path / "ms.tif", encoding, COMPRESS=compression, BIGTIFF=bigtiff)
    out = write(source, ROTATION, driver=driver)
    assert_corrected_copy(source, out, ROTATION)
    for level in range(len(description(source)["overviews"][0])):
        assert_same_pixels(source, out, level)
    with rasterio.open(out) as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    with tifffile.TiffFile(out) as tiff:
        places = [page.offset for page in tiff.pages]
        first_block = min(min(page.dataoffsets) for page in tiff.pages)
    assert places == sorted(places)
    assert places[-1] < first_block


def test_blocks_of_a_cog_keep_the_leaders_that_gdal_reads(tmp_path: Path) -> None:
    source = make_cog(tmp_path / "ms.tif")
    out = write(source)
    with tifffile.TiffFile(out) as tiff:
        page = tiff.pages[0]
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            tiff.filehandle.seek(offset - 4)
            assert int.from_bytes(tiff.filehandle.read(4), "little") == count


def test_classic_tiff_near_its_limit_becomes_a_bigtiff(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", overviews="internal")
    with source.open("r+b") as file:
        file.truncate(2**32 - 100)
    out = write(source)
    with tifffile.TiffFile(out) as tiff:
        assert tiff.is_bigtiff
    assert encoded_blocks(out) == encoded_blocks(source)
    assert description(out) == description(source)
    assert transform_of(out) == transform_of(source) @ SHIFT
    assert out.stat().st_blocks * 512 < 10_000_000  # holes stay holes


@pytest.mark.parametrize("encoding", ["striped", "tiled-deflate", "bigtiff"])
def test_truncated_input_is_refused(tmp_path: Path, encoding: str) -> None:
    source = make_tiff(tmp_path / "ms.tif", encoding)
    correction = correction_of(source)
    with source.open("r+b") as file:
        file.truncate(source.stat().st_size * 2 // 3)
    with pytest.raises(RasterUnreadableError, match=r"ms\.tif"):
        write_corrected(source, tmp_path / "out.tif", correction, GCPS, TAGS, WriteOptions())
    assert {path.name for path in tmp_path.iterdir()} == {"ms.tif"}


def test_missing_and_foreign_inputs_are_refused(tmp_path: Path) -> None:
    correction = Correction("shift", UTM18, TRANSFORM, TRANSFORM)
    out = tmp_path / "out.tif"
    with pytest.raises(RasterNotFoundError, match=r"no\.tif"):
        write_corrected(tmp_path / "no.tif", out, correction, [], {}, WriteOptions())
    text = tmp_path / "text.tif"
    text.write_text("II*\0 but nothing else")
    with pytest.raises(RasterUnreadableError, match=r"text\.tif"):
        write_corrected(text, out, correction, [], {}, WriteOptions())
    assert not out.exists()


def test_blocks_that_hang_on_unknown_pointers_are_not_moved(tmp_path: Path) -> None:
    source = tmp_path / "sub.tif"
    data = np.zeros((64, 64), dtype=np.uint8)
    with tifffile.TiffWriter(source) as tiff:  # sub-directories need a new layout here
        tiff.write(data, tile=(16, 16), subifds=1)
        tiff.write(data[::2, ::2], tile=(16, 16), subfiletype=1)
    with source.open("r+b") as file:
        file.truncate(2**32 - 100)
    correction = Correction("shift", UTM18, TRANSFORM, TRANSFORM @ SHIFT)
    with pytest.raises(LossyOutputError, match="330"):
        write_corrected(source, tmp_path / "out.tif", correction, [], {}, WriteOptions())
    assert not (tmp_path / "out.tif").exists()
