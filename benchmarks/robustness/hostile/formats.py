"""Formats whose files name other files or addresses: GDAL knows them by content, not by name."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from functools import cache
from html import escape
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.robustness.hostile.plan import World, template, utm_wkt
from benchmarks.robustness.hostile.vrts import VRTS, Files, Shape

Payload = Callable[[World, Shape, str], Files]


def pam(shape: Shape) -> bytes:
    """Georeference beside a file that has none."""
    return (
        f"<PAMDataset><SRS>{escape(utm_wkt())}</SRS><GeoTransform>{shape.geotransform}"
        "</GeoTransform></PAMDataset>"
    ).encode()


def _mrf(world: World, shape: Shape, name: str) -> Files:
    """A cache: GDAL fills it, wherever the file says that it lies."""
    victim = world.victim("thesis.doc")
    own = "pan.tif" if shape.count == 1 else "ms.tif"
    data = world.rng.choice((victim, victim, world.victim("new.dat"), "mrf.dat"))
    index = world.rng.choice((world.victim("new.idx"), "mrf.idx"))
    origin = world.rng.choice(
        (own, own, world.victim("ground.tif"), f"/vsicurl/{world.address}/a.tif")
    )
    clone = world.rng.choice(("", "", "", "", "", ' clone="true"'))
    cached = f"<CachedSource><Source{clone}>{origin}</Source></CachedSource>"
    if world.rng.random() < 0.25:
        data, cached = world.victim("secret.raw"), ""
    x, y, pixel, side = shape.left, shape.top, shape.pixel, shape.side
    return {
        name: (
            f'<MRF_META>{cached}<Raster><Size x="{side}" y="{side}" c="{shape.count}"/>'
            f'<PageSize x="{side}" y="{side}" c="1"/><Compression>NONE</Compression>'
            f"<DataType>UInt16</DataType><DataFile>{data}</DataFile>"
            f"<IndexFile>{index}</IndexFile></Raster><GeoTags>"
            f'<BoundingBox minx="{x}" miny="{y - pixel * side}" maxx="{x + pixel * side}" '
            f'maxy="{y}"/><Projection>{escape(utm_wkt())}</Projection></GeoTags></MRF_META>'
        ).encode()
    }


def _web_map(world: World, shape: Shape, name: str) -> Files:
    """What to fetch, where to, and where to keep it."""
    services = (
        (
            f'<Service name="WMS"><Version>1.1.1</Version><ServerUrl>{world.address}/w?</ServerUrl>'
            "<Layers>x</Layers><SRS>EPSG:32618</SRS></Service>"
        ),
        (
            f'<Service name="TMS"><ServerUrl>{world.address}/${{z}}/${{x}}/${{y}}.png</ServerUrl>'
            "</Service>"
        ),
        (
            f'<Service name="TiledWMS"><ServerUrl>{world.address}/tiled?</ServerUrl>'
            "<TiledGroupName>x</TiledGroupName></Service>"
        ),
        f'<Service name="AGS"><ServerUrl>{world.address}/ags</ServerUrl></Service>',
    )
    right, low = shape.left + shape.pixel * shape.side, shape.top - shape.pixel * shape.side
    return {
        name: (
            f"<GDAL_WMS>{world.rng.choice(services)}<DataWindow>"
            f"<UpperLeftX>{shape.left}</UpperLeftX><UpperLeftY>{shape.top}</UpperLeftY>"
            f"<LowerRightX>{right}</LowerRightX><LowerRightY>{low}</LowerRightY>"
            f"<SizeX>{shape.side}</SizeX><SizeY>{shape.side}</SizeY></DataWindow>"
            f"<Projection>EPSG:32618</Projection><BandsCount>{shape.count}</BandsCount>"
            f"<Cache><Path>{world.victim('cache')}</Path></Cache></GDAL_WMS>"
        ).encode()
    }


def _web_list(world: World, shape: Shape, name: str) -> Files:
    """Other services, tile indexes and catalogues."""
    address, remote = world.address, f"/vsicurl/{world.address}/a"
    remote_asset = {"href": f"{address}/a.tif", "type": "image/tiff; application=geotiff"}
    step, side = shape.pixel, shape.side
    west, north = shape.left, shape.top
    place = {
        "proj:epsg": 32618,
        "proj:shape": [side, side],
        "proj:transform": [step, 0, west, 0, -step, north],
        "proj:bbox": [west, north - step * side, west + step * side, north],
    }
    item = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": ["https://stac-extensions.github.io/projection/v1.0.0/schema.json"],
        "id": "x",
        "collection": "x",
        "properties": place,
        "assets": {"a": {**remote_asset, **place}},
    }
    matrix = {
        "identifier": "0",
        "scaleDenominator": shape.pixel / 0.00028,
        "topLeftCorner": [shape.left, shape.top],
        "tileWidth": shape.side,
        "tileHeight": shape.side,
        "matrixWidth": 1,
        "matrixHeight": 1,
    }
    matrices = {
        "type": "TileMatrixSetType",
        "identifier": "m",
        "supportedCRS": "http://www.opengis.net/def/crs/EPSG/0/32618",
        "tileMatrix": [matrix],
    }
    tiled = {
        "stac_version": "1.0.0",
        "stac_extensions": ["tiled-assets"],
        "type": "Feature",
        "properties": {
            "tiles:tile_matrix_links": {"m": {"url": "#m"}},
            "tiles:tile_matrix_sets": {"m": matrices},
        },
        "asset_templates": {"a": {"href": f"{address}/{{TileMatrix}}.tif"}},
    }
    corner = "<north>36</north><south>35</south><east>-75</east><west>-76</west>"
    # GDAL recognises these by their extension too
    by_extension = {
        "kml": [
            (
                f'<kml xmlns="http://www.opengis.net/kml/2.2"><GroundOverlay><Icon><href>{remote}.png'
                f"</href></Icon><LatLonBox>{corner}</LatLonBox></GroundOverlay></kml>"
            )
        ],
        "json": [json.dumps(tiled), json.dumps({"type": "FeatureCollection", "features": [item]})],
    }
    others = [
        (
            f"<WCS_GDAL><ServiceURL>{address}/wcs?</ServiceURL><CoverageName>x</CoverageName>"
            "</WCS_GDAL>"
        ),
        f"<GDAL_WMTS><GetCapabilitiesUrl>{address}/wmts</GetCapabilitiesUrl></GDAL_WMTS>",
        (
            f"<GDALTileIndexDataset><IndexDataset>{remote}.gpkg</IndexDataset>"
            "<IndexLayer>x</IndexLayer></GDALTileIndexDataset>"
        ),
    ]
    texts = by_extension.get(name.rpartition(".")[2], others)
    return {name: world.rng.choice(texts).encode()}


def _label(world: World, shape: Shape, name: str) -> Files:
    """A label that says where the pixels are."""
    aim, side = world.victim("secret.raw"), shape.side
    files = {
        "pds": f'PDS_VERSION_ID = PDS3\r\n^IMAGE = "{aim}"\r\nRECORD_BYTES = {2 * side}\r\n'
        f"OBJECT = IMAGE\r\nLINES = {side}\r\nLINE_SAMPLES = {side}\r\nSAMPLE_BITS = 16\r\n"
        "SAMPLE_TYPE = LSB_UNSIGNED_INTEGER\r\nBANDS = 1\r\nEND_OBJECT = IMAGE\r\nEND\r\n",
        "isis3": f"Object = IsisCube\n Object = Core\n ^Core = {aim}\n StartByte = 1\n"
        f" Format = BandSequential\n Group = Dimensions\n Samples = {side}\n Lines = {side}\n"
        " Bands = 1\n End_Group\n Group = Pixels\n Type = SignedWord\n ByteOrder = Lsb\n"
        " Base = 0.0\n Multiplier = 1.0\n End_Group\n End_Object\nEnd_Object\nEnd\n",
        "pds4": '<?xml version="1.0"?><Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1">'
        f"<File_Area_Observational><File><file_name>{aim}</file_name></File><Array_2D_Image>"
        '<offset unit="byte">0</offset><axes>2</axes><axis_index_order>Last Index Fastest'
        "</axis_index_order><Element_Array><data_type>UnsignedLSB2</data_type></Element_Array>"
        f"<Axis_Array><axis_name>Line</axis_name><elements>{side}</elements><sequence_number>1"
        f"</sequence_number></Axis_Array><Axis_Array><axis_name>Sample</axis_name><elements>{side}"
        "</elements><sequence_number>2</sequence_number></Axis_Array></Array_2D_Image>"
        "</File_Area_Observational></Product_Observational>",
        "ers": f'DatasetHeader Begin\n DataFile = "{aim}"\n DataSetType = ERStorage\n'
        " DataType = Raster\n ByteOrder = LSBFirst\n RasterInfo Begin\n"
        f" CellType = Unsigned16BitInteger\n NrOfLines = {side}\n NrOfCellsPerLine = {side}\n"
        " NrOfBands = 1\n RasterInfo End\nDatasetHeader End\n",
        "dimap": '<Dimap_Document><Raster_Dimensions><NCOLS>80</NCOLS><NROWS>80</NROWS><NBANDS>1'
        "</NBANDS></Raster_Dimensions><Raster_Encoding><NBITS>16</NBITS></Raster_Encoding>"
        "<Data_Access><Data_File><DATA_FILE_PATH "
        f'href="{world.victim("ground.tif")}"/></Data_File></Data_Access></Dimap_Document>',
    }  # fmt: skip
    kind = world.rng.choice(list(files))
    return {name: files[kind].encode(), f"{name}.aux.xml": pam(shape)}


def _hdf5(world: World, shape: Shape, name: str) -> Files:
    """80 × 80 pixels that another file holds: external, linked or virtual.

    The names in the templates are 255 bytes long, and slashes at the front make no difference.
    """
    kind = world.rng.choice(("external", "link", "virtual"))
    secret = "secret.raw" if kind == "external" else "secret.h5"
    path = bytes(world.root / "victims" / secret)
    data = template(kind).replace(b"/" + b"x" * 254, b"/" * (255 - len(path)) + path)
    return {name: data, f"{name}.aux.xml": pam(shape)}


@cache
def _hfa_of(length: int, shape: Shape, overviews: bool) -> tuple[bytes, bytes]:
    """An HFA whose pixels, or overviews, are in a file with a name of so many bytes; that file."""
    stem = "h" * (length - 4)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"{stem}.img")
        pixels = np.random.default_rng(1).integers(
            1, 999, (shape.count, shape.side, shape.side), np.uint16
        )
        west, step, north = shape.left, shape.pixel, shape.top
        transform = rasterio.Affine(step, 0, west, 0, -step, north)
        spill = {} if overviews else {"use_spill": True}
        with rasterio.open(
            path, "w", "HFA", shape.side, shape.side, shape.count, "EPSG:32618", transform,
            "uint16", **spill,
        ) as dataset:  # fmt: skip
            dataset.write(pixels)
        if overviews:
            with rasterio.Env(HFA_USE_RRD=True), rasterio.open(path, "r+") as dataset:
                dataset.build_overviews([2])
        other = path.with_suffix(".rrd" if overviews else ".ige")
        return path.read_bytes(), other.read_bytes()


def _hfa(world: World, shape: Shape, name: str) -> Files:
    aim, overviews = world.victim("secret.ige"), world.rng.random() < 0.3
    data, secret = _hfa_of(len(aim), shape, overviews)
    (world.root / "victims" / "secret.ige").write_bytes(secret)
    own = b"h" * (len(aim) - 4) + (b".rrd" if overviews else b".ige")
    return {name: data.replace(own, aim.encode())}


PAYLOADS: dict[str, Payload] = {
    **VRTS,
    "MRF": _mrf,
    "web map": _web_map,
    "web list": _web_list,
    "label": _label,
    "HDF5": _hdf5,
    "HFA": _hfa,
}
