"""Files of others: no byte outside them is read, written or run, and no request is sent."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from affine import Affine

from geodelreg import AlignOptions, align
from geodelreg.door.formats import FORMATS, skip_the_rest
from geodelreg.errors import (
    AccessNotAllowedError,
    GcpFormatError,
    GeodelregError,
    RasterUnreadableError,
    UnsupportedGeoreferenceError,
)
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.options import WriteOptions
from geodelreg.product.gcps import GcpContext, read_gcps
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Grid, Window
from tests.cli.helpers import run_command
from tests.integration.faults import names
from tests.integration.loopback import Server
from tests.integration.raster_samples import GCPS, TAGS, correction_of, make_tiff

ROOT = Path(__file__).resolve().parents[2]
GROUND = "<GeoTransform>500000,2,0,4000000,0,-2</GeoTransform><SRS>EPSG:32618</SRS>"
MRF = (
    '<MRF_META><CachedSource><Source>{source}</Source></CachedSource><Raster><Size x="512" '
    'y="512" c="1"/><PageSize x="512" y="512" c="1"/><Compression>NONE</Compression>'
    "<DataType>Byte</DataType><DataFile>{data}</DataFile><IndexFile>{index}</IndexFile></Raster>"
    '<GeoTags><BoundingBox minx="0" miny="0" maxx="512" maxy="512"/>'
    "<Projection>EPSG:32618</Projection></GeoTags></MRF_META>"
)
VRT = (
    '<VRTDataset rasterXSize="210" rasterYSize="190">{ground}'
    '<VRTRasterBand dataType="Byte" band="1"{attributes}>{band}</VRTRasterBand></VRTDataset>'
)
SOURCE = "<SimpleSource><SourceFilename>{}</SourceFilename></SimpleSource>"


def read_all(name: Path | str, masks: list[str] | None = None, **options: Any) -> None:
    with open_raster(name, masks, **options) as reader:
        height, width = reader.grid.shape
        reader.read([1], Window(0, 0, width, height))
        assert reader.decimations


def mrf(path: Path) -> Path:
    """A file that makes GDAL append a copy of an image to ``victim``, in the folder above."""
    folder = path.parent
    image = make_tiff(folder / "image.tif", "striped", shape=(512, 512), count=1, dtype="uint8")
    victim = folder.parent / "victim"
    victim.write_bytes(b"not yours")
    path.write_text(MRF.format(source=image, data=victim, index=folder.parent / "index"))
    return path


def vrt(path: Path, band: str, attributes: str = "") -> Path:
    path.write_text(VRT.format(ground=GROUND, band=band, attributes=attributes))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def as_raster(folder: Path) -> None:
    read_all(mrf(folder / "x.tif"))


def as_mask(folder: Path) -> None:
    read_all(make_tiff(folder / "ms.tif"), [str(mrf(folder / "x.tif"))])


def in_a_vrt(folder: Path) -> None:
    read_all(vrt(folder / "a.vrt", SOURCE.format(mrf(folder / "x.tif"))))


def as_mask_beside(folder: Path) -> None:
    make_tiff(folder / "ms.tif")
    mrf(folder / "ms.tif.MSK")
    read_all(folder / "ms.tif")


def as_overviews_beside(folder: Path) -> None:
    make_tiff(folder / "ms.tif")
    mrf(folder / "ms.tif.ovr")
    read_all(folder / "ms.tif")


def as_overviews_of_a_mask_beside(folder: Path) -> None:
    make_tiff(folder / "ms.tif")
    make_tiff(folder / "ms.tif.msk", count=1, dtype="uint8", nodata=None)
    mrf(folder / "ms.tif.msk.ovr")
    read_all(folder / "ms.tif")


def named_in_pam(folder: Path) -> None:
    make_tiff(folder / "ms.tif")
    (folder / "ms.tif.aux.xml").write_text(
        '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">'
        f":::BASE:::{mrf(folder / 'x.tif').name}</MDI></Metadata></PAMDataset>"
    )
    read_all(folder / "ms.tif")


def named_in_a_tag(folder: Path) -> None:
    with rasterio.open(make_tiff(folder / "ms.tif"), "r+") as dataset:
        dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=str(folder / "x.tif"))
    mrf(folder / "x.tif")
    read_all(vrt(folder / "a.vrt", SOURCE.format(folder / "ms.tif")))


def beside_in_an_archive(folder: Path) -> None:
    with zipfile.ZipFile(folder / "a.zip", "w") as archive:
        archive.write(make_tiff(folder / "ms.tif"), "ms.tif")
        archive.write(mrf(folder / "x.tif"), "ms.tif.msk")
    read_all(f"/vsizip/{folder}/a.zip/ms.tif")


def as_source_of_an_output(folder: Path) -> None:
    ms = make_tiff(folder / "ms.tif")
    correction = correction_of(ms)
    mrf(ms)
    write_corrected(ms, folder / "out.tif", correction, GCPS, TAGS, WriteOptions())


PLACES: list[Callable[[Path], None]] = [
    as_raster, as_mask, in_a_vrt, as_mask_beside, as_overviews_beside,
    as_overviews_of_a_mask_beside, named_in_pam, named_in_a_tag, beside_in_an_archive,
    as_source_of_an_output,
]  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
def test_no_byte_is_appended_to_a_file_that_an_mrf_names(
    folder: Path, place: Callable[[Path], None]
) -> None:
    with pytest.raises(AccessNotAllowedError, match=r"format MRF.*`allow='all'`"):
        place(folder)
    assert (folder.parent / "victim").read_bytes() == b"not yours"
    assert names(folder.parent) == {"in", "victim"}


@pytest.mark.parametrize("which", ["MS", "PAN", "--mask"])
def test_the_command_opens_no_mrf_for_a_tiff(folder: Path, which: str) -> None:
    hostile, good = str(mrf(folder / "x.tif")), str(folder / "image.tif")
    names = {"MS": [hostile, good], "PAN": [good, hostile]}.get(which, [good, good])
    more = ["--mask", hostile] if which == "--mask" else []
    done = run_command("check", *names, *more)
    assert "format MRF" in done.stderr
    assert "--allow all" in done.stderr
    assert (folder.parent / "victim").read_bytes() == b"not yours"


def test_what_is_allowed_is_opened(folder: Path) -> None:
    read_all(mrf(folder / "x.tif"), allow="all")
    assert (folder.parent / "victim").stat().st_size > 200_000


@pytest.mark.parametrize("suffix", [".msk", ".MSK", ".ovr", ".msk.ovr"])
def test_python_in_side_files_is_not_run(folder: Path, suffix: str) -> None:
    ms = make_tiff(folder / "ms.tif", count=1, dtype="uint8")
    make_tiff(folder / "plain.tif", count=1, dtype="uint8")
    shutil.copy(folder / "plain.tif", folder / "ms.tif.msk")
    code = (
        "<PixelFunctionType>f</PixelFunctionType>"
        "<PixelFunctionLanguage>Python</PixelFunctionLanguage>"
        f"<PixelFunctionCode>open('{folder}/ran', 'w')</PixelFunctionCode>"
    )
    (folder / f"ms.tif{suffix}").unlink(missing_ok=True)
    band = code + SOURCE.format(folder / "plain.tif")
    vrt(folder / f"ms.tif{suffix}", band, ' subClass="VRTDerivedRasterBand"')
    refused = pytest.raises(AccessNotAllowedError, match="Python code")
    with rasterio.Env(GDAL_VRT_ENABLE_PYTHON="YES"), refused:
        read_all(ms)
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("suffix", [".msk", ".ovr"])
def test_side_files_reach_no_bytes_in_other_folders(folder: Path, suffix: str) -> None:
    (folder.parent / "secret").write_bytes(bytes(40_000))
    band = "<SourceFilename>../secret</SourceFilename><ImageOffset>0</ImageOffset>"
    band = band.replace("<SourceFilename>", '<SourceFilename relativeToVRT="1">')
    vrt(folder / f"ms.tif{suffix}", band, ' subClass="VRTRawRasterBand"')
    with pytest.raises(AccessNotAllowedError, match="not in its folder"):
        read_all(make_tiff(folder / "ms.tif"))


def test_honest_side_files_are_used(folder: Path) -> None:
    ms = make_tiff(folder / "ms.tif", mask="external", overviews="external")
    assert names(folder) >= {"ms.tif", "ms.tif.msk", "ms.tif.ovr"}
    with zipfile.ZipFile(folder / "a.zip", "w") as archive:
        for path in folder.glob("ms.tif*"):
            archive.write(path, path.name)
    for name in (str(ms), f"/vsizip/{folder}/a.zip/ms.tif"):
        with open_raster(name) as reader:
            (band,) = reader.read([1], Window(0, 0, 100, 100))
            assert not band.valid[:40, :50].any()
            assert band.valid[60:, :].all()


@pytest.mark.parametrize("name", ["external.h5", "virtual.h5"])
@pytest.mark.parametrize("ending", [".h5", ".tif"])
def test_hdf5_shows_no_bytes_of_other_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, ending: str
) -> None:
    monkeypatch.chdir(folder)
    (folder / "secret.bin").write_bytes(b"S" * 4096)
    path = shutil.copy(ROOT / "tests/data/hdf5" / name, folder / f"x{ending}")
    for given in (
        str(path),
        f'HDF5:"{path}"://image',
        str(vrt(folder / "a.vrt", SOURCE.format(path))),
    ):
        with pytest.raises(AccessNotAllowedError, match=r"format HDF5.*`allow='all'`"):
            read_all(given)


def spilled(folder: Path, target: str) -> Path:
    """An HFA file whose pixels lie in `target`, a name of 14 letters."""
    source = make_tiff(folder / "plain.tif", count=1, dtype="uint8")
    rasterio.shutil.copy(source, folder / "aaaaaaaaaa.img", driver="HFA", USE_SPILL="YES")
    data = (folder / "aaaaaaaaaa.img").read_bytes()
    assert data.count(b"aaaaaaaaaa.ige\0") == 1
    path = folder / "x.tif"
    path.write_bytes(data.replace(b"aaaaaaaaaa.ige", target.encode()))
    return path


def test_hfa_reads_pixels_in_its_own_folder_only(folder: Path) -> None:
    read_all(spilled(folder, "aaaaaaaaaa.ige"))
    with pytest.raises(RasterUnreadableError, match=r"x\.tif"):
        read_all(spilled(folder, "c:/data/be.ige"))  # where it was made, and not here
    (folder / "aaaaaaaaaa.ige").rename(folder.parent / "secrets.ige")
    path = spilled(folder, "../secrets.ige")
    for given in (path, vrt(folder / "a.vrt", SOURCE.format(path))):
        with pytest.raises(
            AccessNotAllowedError, match=r"secrets\.ige, which is not in its folder"
        ):
            read_all(given)


DIMAP = (
    '<?xml version="1.0"?><Dimap_Document><Raster_Dimensions><NCOLS>210</NCOLS><NROWS>190</NROWS>'
    "<NBANDS>4</NBANDS></Raster_Dimensions><Raster_Encoding><NBITS>16</NBITS>"
    "<DATA_TYPE>UNSIGNED</DATA_TYPE></Raster_Encoding><Data_Access><Data_File>"
    '<DATA_FILE_PATH href="{}"/></Data_File></Data_Access></Dimap_Document>'
)
TIL = 'numTiles = 1;\nBEGIN_GROUP = TILE_1\n\tfilename = "{}";\nEND_GROUP = TILE_1\nEND;\n'


@pytest.mark.parametrize(("text", "name"), [(DIMAP, "x.dim"), (TIL, "x.TIL")])
def test_products_name_files_of_their_own_folder_only(folder: Path, text: str, name: str) -> None:
    make_tiff(folder.parent / "outside.tif")
    (folder / name).write_text(text.format("../outside.tif"))
    with pytest.raises(AccessNotAllowedError, match=r"outside\.tif, which is not in its folder"):
        read_all(folder / name)
    (folder / name).write_text(text.format(mrf(folder / "inside.tif").name))
    with pytest.raises(AccessNotAllowedError, match="format MRF"):
        read_all(folder / name)
    assert (folder.parent / "victim").read_bytes() == b"not yours"


def test_a_dimap_product_is_read(folder: Path) -> None:
    image = make_tiff(folder / "image.tif")
    (folder / "x.dim").write_text(DIMAP.format(image.name))
    with rasterio.open(image) as whole, open_raster(folder / "x.dim") as reader:
        (band,) = reader.read([1], Window(0, 0, 210, 190))
        assert np.array_equal(band.data, whole.read(1))


GML = (
    '<wfs:FeatureCollection xmlns:wfs="http://www.opengis.net/wfs" '
    'xmlns:gml="http://www.opengis.net/gml">{}</wfs:FeatureCollection>'
)
SERVICES = {
    "wfs": "<OGRWFSDataSource><URL>{url}/wfs</URL></OGRWFSDataSource>",
    "wfs in gml": GML.format("<OGRWFSDataSource><URL>{url}/wfs</URL></OGRWFSDataSource>"),
    "capabilities": '<WFS_Capabilities xmlns:gml="http://www.opengis.net/gml" version="1.1.0">'
    "<Service><OnlineResource>{url}</OnlineResource></Service></WFS_Capabilities>",
    "vrt": '<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>/vsicurl/{url}/x.csv'
    "</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>",
}


@pytest.mark.parametrize("ending", [".gml", ".kml", ".gpkg", ".shp", ".tab", ".zip", ".geojsonl"])
@pytest.mark.parametrize("kind", list(SERVICES))
def test_vector_masks_fetch_nothing(folder: Path, server: Server, kind: str, ending: str) -> None:
    mask = folder / f"mask{ending}"
    text = SERVICES[kind].format(url=server.address)
    if ending == ".zip":
        with zipfile.ZipFile(mask, "w") as archive:
            archive.writestr("mask.gml", text)
    else:
        mask.write_text(text)
    server.log.unlink(missing_ok=True)
    with pytest.raises(GeodelregError, match="mask"):
        read_all(make_tiff(folder / "ms.tif"), [str(mask)])
    assert server.requests == []


GCP_LIST = (
    '<VRTDataset rasterXSize="9" rasterYSize="9"><GCPList Projection="{url}">'
    '<GCP Id="1" Info="" Pixel="1" Line="2" X="3" Y="4"/></GCPList></VRTDataset>'
)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.points", "#CRS: {url}\nmapX,mapY,pixelX,pixelY,enable\n1,2,3,-4,1\n"),
        ("a.vrt", GCP_LIST),
        ("a.gcp", '-a_srs "{url}" -gcp 1 2 3 4'),
    ],
)  # fmt: skip
def test_a_crs_that_is_an_address_is_not_fetched(
    folder: Path, server: Server, name: str, text: str
) -> None:
    (folder / name).write_text(text.format(url=f"{server.address}/crs"))
    ms = make_tiff(folder / "ms.tif")
    with rasterio.open(ms) as dataset:
        grid = Grid(dataset.transform, dataset.shape, dataset.crs.to_wkt())
    server.log.unlink(missing_ok=True)
    with pytest.raises(GcpFormatError, match="addresses are not fetched"):
        read_gcps(folder / name, None, GcpContext(grid, source_paths=(str(ms),)))
    assert server.requests == []


@pytest.mark.parametrize("name", ["http:x.tif", "s3:b.tif", "zip:x.tif", "file:x.tif", "WMS:x.tif"])
def test_files_whose_names_look_like_addresses_are_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(folder)
    make_tiff(folder / "ms.tif").rename(folder / name)
    for source in (name, str(folder / name)):
        read_all(source)
        out = folder / "out.tif"
        correction = correction_of(folder / name)
        for options in (WriteOptions(overwrite=True), WriteOptions(True, driver="COG")):
            write_corrected(Path(source), out, correction, GCPS, TAGS, options)
            with rasterio.open(out) as written, rasterio.open(folder / name) as given:
                assert np.array_equal(written.read(), given.read())
    read_all(
        vrt(folder / "a.vrt", SOURCE.format(name).replace("ename>", 'ename relativeToVRT="1">', 1))
    )
    with pytest.raises(AccessNotAllowedError):
        read_all(vrt(folder / "b.vrt", SOURCE.format("http:x.tif")))


@pytest.mark.parametrize("where", ["folder", "archive"])
def test_the_subdataset_that_is_advised_works(folder: Path, where: str) -> None:
    ms = make_tiff(folder / "ms.tif", count=2, dtype="uint8")
    rasterio.shutil.copy(ms, folder / "ms.nc", driver="netCDF")
    container = str(folder / "ms.nc")
    if where == "archive":
        with zipfile.ZipFile(folder / "a.zip", "w") as archive:
            archive.write(folder / "ms.nc", "ms.nc")
        container = f"/vsizip/{folder}/a.zip/ms.nc"
    with pytest.raises(RasterUnreadableError, match="container of 2") as caught:
        open_raster(container)
    advised = caught.value.remedy.removeprefix("Name one of them: ").rstrip(".").split(", ")[0]
    read_all(advised)
    alignment = align(advised, ms, AlignOptions(tolerance_px=0))
    from geodelreg import write

    write(alignment, folder / "out.tif")
    with rasterio.open(folder / "out.tif") as written, rasterio.open(ms) as given:
        assert np.array_equal(written.read(1), given.read(1))


def test_every_format_of_gdal_has_been_gone_through() -> None:
    with rasterio.Env() as env:
        assert set(env.drivers()) <= set(FORMATS)


def test_the_documented_table_is_that_of_the_code() -> None:
    text = (ROOT / "docs/robustness.md").read_text(encoding="utf-8")
    table = text.partition("## Drivers")[2].partition("\n## ")[0]
    rows = [line.split("|")[1:4] for line in table.splitlines() if line.startswith("| `")]
    said = {
        name.strip(" `"): (reach.strip(" `"), why.strip())
        for names, reach, why in rows
        for name in names.split("`, `")
    }
    assert said == {name: (one.reach, one.why) for name, one in FORMATS.items()}


def test_the_command_leaves_gdal_no_format_that_reaches_further() -> None:
    for allow, expected in (("local", False), ("network", True)):
        environment = {key: value for key, value in os.environ.items() if key != "GDAL_SKIP"}
        skip_the_rest(environment, allow)
        code = "import rasterio\nwith rasterio.Env() as env: print(*env.drivers())"
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True
        )
        left = set(done.stdout.split())
        assert {"GTiff", "VRT", "HFA", "PNG", "MEM"} <= left
        assert not {"MRF", "HDF5", "Zarr", "NITF", "DERIVED"} & left
        assert ("WMS" in left) is expected


def test_what_the_user_skips_stays_skipped() -> None:
    environment = {"GDAL_SKIP": "ESRI Shapefile,PNG"}
    skip_the_rest(environment, "local")
    skipped = environment["GDAL_SKIP"].split(",")
    assert skipped[:2] == ["ESRI Shapefile", "PNG"]
    assert "MRF" in skipped


def test_bands_of_several_types_in_a_vrt_are_read(folder: Path) -> None:
    one = make_tiff(folder / "one.tif", count=1, dtype="uint8", shape=(190, 210))
    two = make_tiff(folder / "two.tif", count=1, dtype="uint16", shape=(190, 210))
    text = VRT.format(ground=GROUND, band=SOURCE.format(one), attributes="")
    second = f'<VRTRasterBand dataType="UInt16" band="2">{SOURCE.format(two)}</VRTRasterBand>'
    (folder / "a.vrt").write_text(text.replace("</VRTDataset>", f"{second}</VRTDataset>"))
    with open_raster(folder / "a.vrt") as reader, rasterio.open(two) as second_band:
        _, band = reader.read([1, 2], Window(0, 0, 210, 190))
        assert np.array_equal(band.data, second_band.read(1))


def test_control_points_in_pam_beside_a_geotransform_are_named(folder: Path) -> None:
    ms = make_tiff(folder / "ms.tif")
    (folder / "ms.tif.aux.xml").write_text(
        '<PAMDataset><GCPList Projection="EPSG:32618"><GCP Id="1" Info="" Pixel="1" Line="2" '
        'X="500000" Y="4000000"/></GCPList></PAMDataset>'
    )
    with pytest.raises(UnsupportedGeoreferenceError, match=r"control points.*aux\.xml"):
        open_raster(ms)


def test_an_item_in_cdata_ends_no_metadata(folder: Path) -> None:
    ms = make_tiff(folder / "ms.tif", transform=Affine(2, 0, 500_000, 0, -2, 4_000_000))
    import tifffile

    with tifffile.TiffFile(ms, mode="r+b") as tiff:
        tag = tiff.pages[0].tags[42112]
        tag.overwrite(
            '<GDALMetadata><Item name="a"><![CDATA[x </Item> y]]></Item>'
            '<Item name="b">kept</Item></GDALMetadata>'
        )
    write_corrected(ms, folder / "out.tif", correction_of(ms), GCPS, TAGS, WriteOptions())
    with rasterio.open(folder / "out.tif") as out:
        assert out.tags()["a"] == "x </Item> y"
        assert out.tags()["b"] == "kept"
        assert out.tags()["GEODELREG_VERSION"] == TAGS["GEODELREG_VERSION"]


def test_no_raster_is_read_but_through_the_door() -> None:
    for path in (ROOT / "geodelreg").rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "rasterio.open":
                assert ast.unparse(call.args[1]) in ("'w'", "'r+'"), path
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "DatasetReader":
                assert path.parent.name == "door", path
