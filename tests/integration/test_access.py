"""Names and files of others open nothing but local files, unless the user allows it."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import pytest
import rasterio

from geodelreg.door.names import LOCAL, NETWORK, needed_access
from geodelreg.errors import AccessNotAllowedError, RasterUnreadableError
from geodelreg.raster.reader import open_raster
from geodelreg.values.raster import Window
from tests.cli.helpers import run_command
from tests.integration.loopback import Server
from tests.integration.raster_samples import make_tiff


def read_some(name: Path | str, allow: str = LOCAL) -> None:
    with open_raster(name, allow=allow) as reader:
        height, width = reader.grid.shape
        reader.read([1], Window(0, 0, min(width, 64), min(height, 64)))
        assert reader.decimations


ADDRESSES = [
    "{url}/x.tif",
    "/vsicurl/{url}/x.tif",
    "/vsicurl_streaming/{url}/x.tif",
    "/vsizip//vsicurl/{url}/x.zip",
    "/vsizip/{{/vsicurl/{url}/x.zip}}/a.tif",
    "zip+{url}/x.zip!a.tif",
    "WMS:{url}/x",
    "WMTS:{url}/x",
    'NETCDF:"{url}/x":v',
    "/vsis3/bucket/x.tif",
]


@pytest.mark.parametrize("address", ADDRESSES)
def test_no_request_is_sent_by_default(server: Server, address: str) -> None:
    name = address.format(url=server.address)
    with pytest.raises(AccessNotAllowedError, match="only local files") as caught:
        open_raster(name)
    assert "`allow='network'`" in caught.value.remedy
    assert server.requests == []


@pytest.mark.parametrize("name", ["/vsistdin/", "MEM:::DATAPOINTER=1", "PG:host=x", "vrt://a.tif"])
def test_other_sources_are_refused_even_with_the_network(name: str) -> None:
    for allow in (LOCAL, NETWORK):
        with pytest.raises(AccessNotAllowedError, match="`allow='all'`"):
            open_raster(name, allow=allow)


@pytest.mark.parametrize(
    "name",
    ["/vsizip/a.zip/b.tif", "zip://a.zip!b.tif", "NETCDF:a.nc:v", "file:///a.tif", "a:b.tif"],
)
def test_archives_and_subdatasets_are_local(name: str) -> None:
    assert needed_access(name) == LOCAL


def test_allowed_addresses_are_asked_for(server: Server) -> None:
    with pytest.raises(RasterUnreadableError, match="cannot be opened"):
        open_raster(f"/vsicurl/{server.address}/gone.tif", allow=NETWORK)
    assert "/gone.tif" in server.requests


def test_a_network_file_that_vanishes_is_a_clean_error(server: Server) -> None:
    with pytest.raises(RasterUnreadableError, match=r"short\.tif"):
        read_some(f"/vsicurl/{server.address}/short.tif", NETWORK)
    assert server.requests


VRT = (
    '<VRTDataset rasterXSize="64" rasterYSize="64"><SRS>EPSG:32616</SRS>'
    "<GeoTransform>500000,30,0,1000000,0,-30</GeoTransform>"
    '<VRTRasterBand dataType="Byte" band="1">{band}</VRTRasterBand>{more}</VRTDataset>'
)
SOURCE = "<SimpleSource><SourceFilename>{}</SourceFilename></SimpleSource>"


def vrt(folder: Path, band: str, more: str = "", name: str = "a.vrt") -> Path:
    path = folder / name
    path.write_text(VRT.format(band=band, more=more))
    return path


@pytest.mark.parametrize(
    "band",
    [
        SOURCE.format("{url}/x.tif"),
        SOURCE.format("/vsicurl/{url}/x.tif"),
        SOURCE.format("WMTS:{url}/x"),
        '<SimpleSource SourceFilename="{url}/x.tif"/>',
        "<simplesource><SOURCEFILENAME>{url}/x.tif</SOURCEFILENAME></simplesource>",
        '<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{url}/x.tif</MDI></Metadata>',
        "<Overview><SourceFilename>{url}/x.tif</SourceFilename></Overview>",
        SOURCE.format("&lt;VRTDataset&gt;&lt;SourceDataset&gt;{url}/x.tif&lt;/SourceDataset&gt;"
                      "&lt;/VRTDataset&gt;"),
        "<Step><Argument name='gain_dataset_filename_1'>{url}/x.tif</Argument></Step>",
    ],
)  # fmt: skip
def test_no_request_is_sent_for_what_a_vrt_names(tmp_path: Path, server: Server, band: str) -> None:
    path = vrt(tmp_path, band.format(url=server.address))
    with pytest.raises(AccessNotAllowedError, match=r"a\.vrt"):
        read_some(path)
    outer = vrt(tmp_path, SOURCE.format(path), name="outer.vrt")
    with pytest.raises(AccessNotAllowedError, match=r"a\.vrt"):
        read_some(outer)
    assert server.requests == []


def test_local_sources_of_vrts_may_lie_anywhere(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    source = make_tiff(tmp_path / "elsewhere" / "x.tif")
    metadata = '<Metadata><MDI key="SOURCE">https://example.org/</MDI></Metadata>'
    read_some(vrt(tmp_path, SOURCE.format(source), metadata))


SERVICE = (
    '<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service>'
    "<DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>10</UpperLeftY><LowerRightX>10</LowerRightX>"
    "<LowerRightY>0</LowerRightY><SizeX>256</SizeX><SizeY>256</SizeY></DataWindow>"
    "<Projection>EPSG:3857</Projection><BandsCount>1</BandsCount></GDAL_WMS>"
)


def test_files_that_describe_web_services_are_not_opened(tmp_path: Path, server: Server) -> None:
    service = tmp_path / "wms.xml"
    service.write_text(SERVICE.format(url=server.address))
    for path in (service, vrt(tmp_path, SOURCE.format(service))):
        with pytest.raises(AccessNotAllowedError, match=r"wms\.xml is a file of the format WMS"):
            read_some(path)
    assert server.requests == []


@pytest.mark.parametrize("prefix", ["", "/vsicurl/"])
@pytest.mark.parametrize("place", ["tag", "pam"])
def test_overviews_elsewhere_are_not_fetched(
    tmp_path: Path, server: Server, prefix: str, place: str
) -> None:
    path, address = make_tiff(tmp_path / "ms.tif"), f"{prefix}{server.address}/x.ovr"
    if place == "tag":
        with rasterio.open(path, "r+") as dataset:
            dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=address)
    else:
        (tmp_path / "ms.tif.aux.xml").write_text(
            '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">'
            f"{address}</MDI></Metadata></PAMDataset>"
        )
    server.log.unlink(missing_ok=True)
    with pytest.raises(AccessNotAllowedError, match=r"ms\.tif"):
        read_some(path)
    assert server.requests == []


def test_python_in_a_vrt_is_not_run(tmp_path: Path) -> None:
    code = (
        "<PixelFunctionType>f</PixelFunctionType>"
        "<PixelFunctionLanguage>Python</PixelFunctionLanguage>"
        f"<PixelFunctionCode>open('{tmp_path}/ran', 'w')</PixelFunctionCode>"
    )
    path = vrt(tmp_path, code + SOURCE.format(make_tiff(tmp_path / "x.tif")))
    refused = pytest.raises(AccessNotAllowedError, match=r"a\.vrt contains Python code")
    with rasterio.Env(GDAL_VRT_ENABLE_PYTHON="YES"), refused:
        read_some(path)
    assert not (tmp_path / "ran").exists()


def test_raw_bytes_come_from_the_vrts_folder_only(tmp_path: Path) -> None:
    band = "<SourceFilename>{}</SourceFilename><ImageOffset>0</ImageOffset>"
    text = VRT.replace("<VRTRasterBand ", '<VRTRasterBand subClass="VRTRawRasterBand" ')
    (tmp_path / "secret").write_bytes(bytes(range(256)) * 16)
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "a.vrt"
    path.write_text(text.format(band=band.format(tmp_path / "secret"), more=""))
    with pytest.raises(AccessNotAllowedError, match="not in its folder"):
        read_some(path)
    (tmp_path / "secret").rename(tmp_path / "in" / "own")
    path.write_text(text.format(band=band.format(tmp_path / "in" / "own"), more=""))
    read_some(path)


@pytest.mark.parametrize("text", ["<VRTDataset", "<!DOCTYPE x><VRTDataset/>", "<VRTDataset></a>"])
def test_vrts_that_cannot_be_checked_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.vrt").write_text(text)
    with pytest.raises(RasterUnreadableError, match="no XML that can be checked"):
        read_some(tmp_path / "a.vrt")


def test_vrts_in_archives_are_not_opened(tmp_path: Path) -> None:
    vrt(tmp_path, SOURCE.format(make_tiff(tmp_path / "x.tif")))
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(tmp_path / "a.vrt", "a.vrt")
    with pytest.raises(RasterUnreadableError, match="cannot be opened"):
        read_some(f"/vsizip/{tmp_path}/a.zip/a.vrt")


def test_pipes_and_devices_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tif")
    for path in (tmp_path / "pipe.tif", vrt(tmp_path, SOURCE.format(tmp_path / "pipe.tif"))):
        with pytest.raises(RasterUnreadableError, match="device or a pipe"):
            read_some(path)
    with pytest.raises(RasterUnreadableError, match="device or a pipe"):
        read_some("/dev/zero")


def test_deeply_nested_vrts_are_refused(tmp_path: Path) -> None:
    make_tiff(tmp_path / "0.tif")
    last = tmp_path / "0.tif"
    for number in range(30):
        last = vrt(tmp_path, SOURCE.format(last), name=f"{number}.vrt")
    with pytest.raises(RasterUnreadableError, match="deep"):
        read_some(last)


def test_the_command_sends_no_request_and_says_what_allows_it(
    tmp_path: Path, server: Server
) -> None:
    make_tiff(tmp_path / "pan.tif")
    nested = make_tiff(tmp_path / "nested.tif")
    with rasterio.open(nested, "r+") as dataset:
        dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"{server.address}/x.ovr")
    server.log.unlink(missing_ok=True)
    hidden = vrt(tmp_path, SOURCE.format(nested))
    for name in (f"{server.address}/ms.tif", str(hidden)):
        result = run_command("check", name, tmp_path / "pan.tif")
        assert "Traceback" not in result.stderr
        if "://" in name:
            assert "add --allow network" in result.stderr
    assert server.requests == []


def test_a_source_on_the_network_is_looked_at_before_it_is_opened(
    tmp_path: Path, server: Server
) -> None:
    for name, served in (("/whole.tif", True), ("/x.mrf", False)):
        path = vrt(tmp_path, SOURCE.format(f"/vsicurl/{server.address}{name}"))
        if served:
            read_some(path, NETWORK)
        else:
            with pytest.raises(RasterUnreadableError, match=r"x\.mrf, a source of"):
                read_some(path, NETWORK)
            assert "/x.mrf" in server.requests
            assert not (tmp_path / "victim").exists()
