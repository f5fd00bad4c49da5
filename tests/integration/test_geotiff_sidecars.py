"""Files beside a raster: carried over where they stay true, gone where they would lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from affine import Affine

from geodelreg.errors import OutputExistsError
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.geotiff.sidecars import without_placement
from geodelreg.options import WriteOptions
from tests.integration.faults import contents
from tests.integration.raster_samples import (
    GCPS,
    SHIFT,
    TAGS,
    TRANSFORM,
    UTM18,
    correction_of,
    description,
    encoded_blocks,
    make_tiff,
    transform_of,
)

PLACED_PAM = (
    "<PAMDataset><SRS>EPSG:32617</SRS><GeoTransform>7,3,0,8,0,-3</GeoTransform>"
    '<Metadata><MDI key="NOTE">kept</MDI></Metadata>'
    '<PAMRasterBand band="1"><Metadata><MDI key="STATISTICS_MEAN">12.5</MDI></Metadata>'
    "</PAMRasterBand></PAMDataset>"
)
GCP_PAM = (
    '<PAMDataset><GCPList Projection="EPSG:32617">'
    '<GCP Id="1" Pixel="0" Line="0" X="1" Y="2"/><GCP Id="2" Pixel="9" Line="0" X="9" Y="2"/>'
    '<GCP Id="3" Pixel="0" Line="9" X="1" Y="9"/></GCPList></PAMDataset>'
)
ESRI_PAM = (
    '<PAMDataset><Metadata domain="xml:ESRI" format="xml"><GeodataXform><SpatialReference>'
    "<WKT>PROJCS[]</WKT></SpatialReference></GeodataXform></Metadata></PAMDataset>"
)


def write(source: Path, **options: object) -> list[str]:
    target_options = WriteOptions(**options)  # type: ignore[arg-type]
    target = source.with_name("out.tif")
    return write_corrected(source, target, correction_of(source), GCPS, TAGS, target_options)


def test_pam_of_the_source_is_carried_without_its_placement(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    (tmp_path / "ms.tif.aux.xml").write_text(PLACED_PAM)
    assert write(source) == []
    with rasterio.open(tmp_path / "out.tif") as dataset:
        assert dataset.transform == Affine(3, 0, 7, 0, -3, 8) @ SHIFT
        assert dataset.crs == "EPSG:32617"
        assert dataset.tags()["NOTE"] == "kept"
        assert dataset.tags(1)["STATISTICS_MEAN"] == "12.5"
    pam = (tmp_path / "out.tif.aux.xml").read_text()
    assert "SRS" not in pam
    assert "GeoTransform" not in pam


def test_pam_without_anything_else_is_not_carried(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    for pam in (GCP_PAM, ESRI_PAM):
        correction = correction_of(source)
        (tmp_path / "ms.tif.aux.xml").write_text(pam)
        options = WriteOptions(overwrite=True)
        write_corrected(source, tmp_path / "out.tif", correction, GCPS, TAGS, options)
        assert not (tmp_path / "out.tif.aux.xml").exists()
        assert transform_of(tmp_path / "out.tif") == TRANSFORM @ SHIFT
        (tmp_path / "ms.tif.aux.xml").unlink()


def test_untouched_pam_is_carried_byte_by_byte(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    pam = "<PAMDataset>\n<Metadata>  <MDI key='A'>1</MDI></Metadata>\n</PAMDataset>"
    (tmp_path / "ms.tif.aux.xml").write_text(pam)
    assert write(source) == []
    assert (tmp_path / "out.tif.aux.xml").read_text() == pam


@pytest.mark.parametrize("pam", ["<PAMDataset><SRS>", "<other/>", "<!DOCTYPE a []><PAMDataset/>"])
def test_strange_pam_is_left_behind_with_a_warning(tmp_path: Path, pam: str) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    (tmp_path / "ms.tif.aux.xml").write_text(pam)
    warnings = write(source)
    assert len(warnings) == 1
    assert "aux.xml is not carried over" in warnings[0]
    assert not (tmp_path / "out.tif.aux.xml").exists()


def test_provenance_in_pam_of_an_earlier_run_goes() -> None:
    pam = (
        b'<PAMDataset><Metadata><MDI key="GEODELREG_VERSION">0</MDI><MDI key="A">1</MDI></Metadata>'
        b'<Metadata domain="GEODELREG"><MDI key="GCPS">[]</MDI></Metadata></PAMDataset>'
    )
    rest = without_placement(pam)
    assert rest is not None
    assert b"GEODELREG" not in rest
    assert b'key="A"' in rest


def test_stale_files_beside_the_target_go_with_overwrite(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif", overviews="external")
    (tmp_path / "out.tif").write_bytes(b"something older")
    stale = {".tif.aux.xml": PLACED_PAM, ".tif.msk": "old", ".tif.ovr": "old"}
    stale[".tif.geodelreg-undo.json"] = "of the older file"
    world = dict.fromkeys((".tfw", ".tifw", ".wld", ".TFW"), "9\n0\n0\n-9\n1\n1\n")
    for suffix, text in (stale | world).items():
        (tmp_path / f"out{suffix}").write_text(text)
    before = contents(tmp_path)
    with pytest.raises(OutputExistsError, match=r"out\.tif exists"):
        write(source)
    assert contents(tmp_path) == before
    assert write(source, overwrite=True) == []
    assert {path.name for path in tmp_path.glob("out*")} == {"out.tif", "out.tif.ovr"}
    assert transform_of(tmp_path / "out.tif") == TRANSFORM @ SHIFT
    assert description(tmp_path / "out.tif") == description(source)


def test_leftovers_of_a_removed_target_are_not_silently_taken_over(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    (tmp_path / "out.tif.aux.xml").write_text(PLACED_PAM)
    with pytest.raises(OutputExistsError, match=r"out\.tif\.aux\.xml exists"):
        write(source)
    assert write(source, overwrite=True) == []
    assert transform_of(tmp_path / "out.tif") == TRANSFORM @ SHIFT


def test_world_files_of_other_rasters_stay(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    (tmp_path / "out.png").write_bytes(b"another raster")
    (tmp_path / "out.wld").write_text("belongs to out.png")
    (tmp_path / "out.pgw").write_text("belongs to out.png")
    assert write(source) == []
    assert (tmp_path / "out.wld").exists()
    assert (tmp_path / "out.pgw").exists()


def test_world_file_that_places_the_source_stays(tmp_path: Path) -> None:
    data = np.arange(600, dtype=np.uint8).reshape(20, 30)
    source = tmp_path / "out.tiff"
    tifffile.imwrite(source, data)
    (tmp_path / "out.wld").write_text("2\n0\n0\n-2\n101\n199\n")
    (tmp_path / "out.tiff.aux.xml").write_text(f"<PAMDataset><SRS>{UTM18}</SRS></PAMDataset>")
    (tmp_path / "out.tif").write_bytes(b"something older")
    assert write(source, overwrite=True) == []
    assert (tmp_path / "out.wld").exists()
    assert transform_of(source) == Affine(2, 0, 100, 0, -2, 200)


@pytest.mark.parametrize("name", ["ms.tfw", "ms.tifw", "ms.wld"])
def test_raster_placed_by_its_world_file_is_placed_inside(tmp_path: Path, name: str) -> None:
    source = tmp_path / "ms.tif"
    tifffile.imwrite(source, np.arange(600, dtype=np.uint16).reshape(20, 30))
    (tmp_path / name).write_text("2\n0\n0\n-2\n101\n199\n")
    (tmp_path / "ms.tif.aux.xml").write_text(f"<PAMDataset><SRS>{UTM18}</SRS></PAMDataset>")
    assert write(source) == []
    out = tmp_path / "out.tif"
    assert {path.name for path in tmp_path.glob("out*")} == {"out.tif"}
    with rasterio.open(out, GEOREF_SOURCES="INTERNAL") as dataset:
        assert dataset.transform == Affine(2, 0, 100, 0, -2, 200) @ SHIFT
        assert dataset.crs == UTM18
    assert encoded_blocks(out) == encoded_blocks(source)


def test_crs_without_epsg_code_is_taken_inside(tmp_path: Path) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    laea = "+proj=laea +lat_0=12.5 +lon_0=-61.25 +x_0=1000 +y_0=2000 +ellps=GRS80 +units=m"
    wkt = rasterio.crs.CRS.from_proj4(laea).to_wkt().replace('"', "&quot;")
    (tmp_path / "ms.tif.aux.xml").write_text(f"<PAMDataset><SRS>{wkt}</SRS></PAMDataset>")
    with rasterio.open(source) as dataset:
        crs = dataset.crs
    write(source)
    with rasterio.open(tmp_path / "out.tif") as dataset:
        there = dataset.crs.to_dict()
    wanted = crs.to_dict()
    assert {k: there[k] for k in ("proj", "lat_0", "lon_0", "x_0", "y_0")} == {
        k: wanted[k] for k in ("proj", "lat_0", "lon_0", "x_0", "y_0")
    }


@pytest.mark.parametrize("place", ["inside", "pam"])
def test_rpcs_are_warned_about_or_stripped(tmp_path: Path, place: str) -> None:
    source = make_tiff(tmp_path / "ms.tif")
    coefficients = " ".join(["1"] * 20)
    rpc = dict.fromkeys(
        ("LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF", "LINE_SCALE", "SAMP_SCALE",
         "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE"),
        "1",
    ) | dict.fromkeys(
        ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF"), coefficients
    )  # fmt: skip
    if place == "inside":
        with rasterio.open(source, "r+") as dataset:
            dataset.update_tags(ns="RPC", **rpc)
    else:
        items = "".join(f'<MDI key="{key}">{value}</MDI>' for key, value in rpc.items())
        text = f'<PAMDataset><Metadata domain="RPC">{items}</Metadata></PAMDataset>'
        (tmp_path / "ms.tif.aux.xml").write_text(text)
    warnings = write(source)
    assert len(warnings) == 1
    assert "`strip_rpc=True`" in warnings[0]
    with rasterio.open(tmp_path / "out.tif") as dataset:
        assert dataset.rpcs is not None
    assert write(source, overwrite=True, strip_rpc=True) == []
    with rasterio.open(tmp_path / "out.tif") as dataset:
        assert dataset.rpcs is None
