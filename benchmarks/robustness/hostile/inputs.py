"""Hostile content: side files, formats behind a wrong extension, vectors, CRSs."""

from __future__ import annotations

import json
from html import escape
from pathlib import Path

import rasterio

from benchmarks.robustness.hostile.formats import PAYLOADS, pam
from benchmarks.robustness.hostile.plan import READING, Plan, World, sound, utm_wkt
from benchmarks.robustness.hostile.vrts import AS_MASK, Shape, source, vrt
from benchmarks.robustness.seeds import RATIO

PARTS = (".aux.xml", ".ovr", ".msk", ".msk.ovr")
EXTENSIONS = (
    "tif", "tif", "tif", "img", "png", "jp2", "dat", "xml", "json", "lbl", "cub", "nc", "h5", "hdf",
    "mrf", "vrt", "kml", "map", "ers", "dim", "til", "jpg",
)  # fmt: skip


def raster_parts(name: str) -> tuple[str, ...]:
    """A raster that is written and what may lie beside it."""
    world_file = str(Path(name).with_suffix(".tfw"))
    return (name, *(name + part for part in PARTS), world_file)


def outputs_of(action: str) -> tuple[str, ...]:
    """What an action on ``ms.tif`` may change."""
    if action == "inplace":
        return ("ms.tif", "ms.tif.aux.xml", "ms.tfw", "ms.tif.geodelreg-undo.json")
    return raster_parts("out/out.tif") if action == "write" else ()


def shape_of(world: World, is_pan: bool) -> Shape:
    """Size and place of the sound rasters."""
    if is_pan:
        return Shape(world.side, 1, 4.0)
    return Shape(world.side // RATIO, 4, 4.0 * RATIO, 500_012.0, 4_000_008.0)


def sidecars(world: World, number: int) -> Plan:
    """A sound raster with a hostile file beside it, or a tag that names one."""
    rng = world.rng
    world.put_pair(rng.choice(("tiled-deflate", "striped", "planar", "world-file")))
    owner = rng.choice(("ms.tif", "ms.tif", "pan.tif"))
    shape = shape_of(world, owner == "pan.tif")
    kind = rng.choice(list(PAYLOADS))
    part = rng.choice((".msk", ".msk", ".ovr", ".ovr", "PAM", "tag", ".tfw", ".msk.ovr", ".aux"))
    half = Shape(shape.side // 2, shape.count, shape.pixel * 2, shape.left, shape.top)
    if part in ("PAM", "tag"):
        aim = rng.choice(("evil.dat", ":::BASE:::evil.dat", str(world.folder / "evil.dat")))
        if rng.random() < 0.3:
            aim = f"/vsicurl/{world.address}/a.ovr"
        world.put(PAYLOADS[kind](world, half, "evil.dat"))
        _name_overviews(world, owner, aim, part)
    elif part in (".tfw", ".aux"):
        stem = Path(owner).stem
        world.put(PAYLOADS[kind](world, shape, f"{stem}{part}"))
    else:
        if part == ".msk.ovr":
            mask = sound("external-mask", owner == "pan.tif", world.side).files["ms.tif.msk"]
            world.put({f"{owner}.msk": mask})
        payload = PAYLOADS[kind](world, half if "ovr" in part else shape, owner + part)
        world.put({f"{owner}{part}.aux.xml": f"<PAMDataset>{AS_MASK}</PAMDataset>".encode()})
        world.put(payload)
    action = rng.choice(READING)
    what = f"{kind} as {part} of {owner[:-4]}"
    return Plan(number, "hostile side file", what, action, outputs=outputs_of(action))


def _name_overviews(world: World, owner: str, aim: str, part: str) -> None:
    if part == "tag":
        with rasterio.open(world.folder / owner, "r+") as dataset:
            dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=aim)
        return
    item = f'<MDI key="OVERVIEW_FILE">{escape(aim)}</MDI>'
    text = f'<PAMDataset><Metadata domain="OVERVIEWS">{item}</Metadata></PAMDataset>'
    world.put({f"{owner}.aux.xml": text.encode()})


def drivers(world: World, number: int) -> Plan:
    """A raster or mask that is not what its extension says, and names what is not its own."""
    rng = world.rng
    world.put_pair()
    kind = rng.choice(list(PAYLOADS))
    role = rng.choice(("ms", "ms", "pan", "pan", "mask", "source"))
    extension = rng.choice(EXTENSIONS)
    shape = shape_of(world, role != "ms")
    name = f"hostile.{extension}"
    world.put(PAYLOADS[kind](world, shape, name))
    action = rng.choice(READING)
    what = f"{kind} as {role} .{extension}"
    if role == "source":
        name = _inside(world, name, shape)
    elif kind == "HDF5" and rng.random() < 0.4:
        name = f'HDF5:"{name}"://band'
    ms, pan = (
        (name if role == "ms" else "ms.tif"),
        (name if role in ("pan", "source") else "pan.tif"),
    )
    outputs = outputs_of(action)
    if role == "ms" and action == "inplace":
        outputs = (name, f"{name}.aux.xml", f"{name}.geodelreg-undo.json")
    mask = f"{name}=1" if role == "mask" else ""
    return Plan(number, "driver by content", what, action, ms, pan, mask=mask, outputs=outputs)


def _inside(world: World, name: str, shape: Shape) -> str:
    world.put({"view.vrt": vrt(shape, source(name, True))})
    return "view.vrt"


def vectors(world: World, number: int) -> Plan:
    """A mask whose content sends OGR elsewhere."""
    rng, address = world.rng, world.address
    world.put_pair()
    remote = f"/vsicurl/{address}/x.geojson"
    square = [[-75.0, 36.0], [-74.999, 36.0], [-74.999, 36.001], [-75.0, 36.0]]
    honest = {"type": "Polygon", "coordinates": [square]}
    gml = 'xmlns:gml="http://www.opengis.net/gml" xmlns:xlink="http://www.w3.org/1999/xlink"'
    crs = rng.choice(
        (
            {"type": "link", "properties": {"href": f"{address}/crs", "type": "proj4"}},
            {"type": "name", "properties": {"name": f"{address}/crs"}},
            {"type": "name", "properties": {"name": "http://opengis.net/def/crs/EPSG/0/1"}},
            {"type": "url", "properties": {"url": f"{address}/crs"}},
        )
    )
    contents = {
        "OGR VRT": f"<OGRVRTDataSource><OGRVRTLayer name='x'><SrcDataSource>{remote}"
        "</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>",
        "OGR VRT of a victim": "<OGRVRTDataSource><OGRVRTLayer name='secret'><SrcDataSource>"
        f"{world.victim('secret.raw')}</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>",
        "WFS": f"<OGRWFSDataSource><URL>{address}/wfs?</URL></OGRWFSDataSource>",
        "CSW": f"<OGRCSWDataSource><URL>{address}/csw?</URL></OGRCSWDataSource>",
        "GML schema": f"<gml:FeatureCollection {gml} xmlns:xsi="
        f'"http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="x {address}/x.xsd">'
        "<gml:featureMember><x/></gml:featureMember></gml:FeatureCollection>",
        "GML link": f'<gml:FeatureCollection {gml}><gml:featureMember><x><gml:g xlink:href='
        f'"{address}/x.gml#1"/></x></gml:featureMember></gml:FeatureCollection>',
        "GeoJSON with a CRS elsewhere": json.dumps(honest | {"crs": crs}),
        "KML link": '<kml xmlns="http://www.opengis.net/kml/2.2"><NetworkLink><Link><href>'
        f"{address}/x.kml</href></Link></NetworkLink></kml>",
        "next page": json.dumps(
            {"type": "FeatureCollection", "features": [], "links": [{"href": f"{address}/2"}]}
        ),
        "web map": f"<GDAL_WMS><Service name='WMS'><ServerUrl>{address}/w?</ServerUrl></Service>"
        "</GDAL_WMS>",
    }  # fmt: skip
    kind = rng.choice(list(contents))
    suffix = rng.choice(
        ("gml", "geojson", "gpkg", "shp", "json", "kml", "fgb", "tab", "vrt", "xml")
    )
    name = f"mask.{suffix}"
    world.put({name: contents[kind].encode()})
    return Plan(number, "hostile vector", f"{kind} as .{suffix}", "check", mask=name)


UTM_DERIVED = (
    'DERIVEDPROJCRS["d",BASEPROJCRS["u",BASEGEOGCRS["WGS 84",DATUM["World Geodetic System 1984",'
    'ELLIPSOID["WGS 84",6378137,298.257223563]]],CONVERSION["UTM 18N",METHOD["Transverse Mercator",'
    'ID["EPSG",9807]],PARAMETER["Latitude of natural origin",0],PARAMETER["Longitude of natural '
    'origin",-75],PARAMETER["Scale factor at natural origin",0.9996],PARAMETER["False easting",'
    '500000],PARAMETER["False northing",0]]],DERIVINGCONVERSION["Affine",METHOD["Affine parametric '
    'transformation",ID["EPSG",9624]],PARAMETER["A0",1],PARAMETER["A1",1],PARAMETER["A2",0],'
    'PARAMETER["B0",2],PARAMETER["B1",0],PARAMETER["B2",1]],CS[Cartesian,2],AXIS["e",east],'
    'AXIS["n",north],LENGTHUNIT["metre",1]]'
)
POINTS = "mapX,mapY,sourceX,sourceY,enable\n500050,3999950,2.5,-3.25,1\n"
CRS_ZOO = (
    'LOCAL_CS["site",UNIT["metre",1]]', UTM_DERIVED, "EPSG:32618+5773", "EPSG:4979", "EPSG:4978",
    'ENGCRS["s",EDATUM["d"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]',
    "+proj=utm +zone=18 +nadgrids=absent.gsb", "+proj=utm +zone=18 +nadgrids=@null +datum=WGS84",
    "+proj=nsper +h=3000000 +lat_0=36 +lon_0=-75", "+proj=pipeline +step +proj=utm +zone=18",
    "EPSG:27572", "EPSG:4807", "IAU_2015:49900", "ESRI:102100", "urn:ogc:def:crs:EPSG::32618",
    "EPSG:28992+5709", "+proj=longlat +a=1 +b=1", "+init=epsg:32618",
    "http://opengis.net/gml/srs/epsg.xml#32618", "COORDINATEMETADATA[ENGCRS[]]", "{}", "PROJCS[",
    "EPSG:99999999999", "OGC:CRS84", "EPSG:32618", "EPSG:4326", "EPSG:3857", "EPSG:27700",
    "EPSG:4326+5773", "EPSG:27561", "EPSG:5514", "EPSG:2193", "EPSG:3995", "EPSG:7415", "EPSG:5972",
    "EPSG:4899", "EPSG:9518", "EPSG:8857", "ESRI:54030", "ESRI:102003", "EPSG:2263", "EPSG:4937",
    "EPSG:2154+5720", "EPSG:27700+5701", "EPSG:9000", "EPSG:7912", "+proj=geos +h=35785831",
    "+proj=ob_tran +o_proj=longlat +o_lon_p=-162 +o_lat_p=39 +lon_0=180", "+proj=laea +lat_0=36",
)  # fmt: skip


def crs(world: World, number: int) -> Plan:
    """A CRS that is an address, or one that GeoTIFF does not hold, wherever one can be given."""
    rng = world.rng
    world.put_pair("world-file")
    address = rng.choice((f"{world.address}/crs", f"{world.address}/epsg.xml#1"))
    address = rng.choice((address, address, f"/vsicurl/{address}", f"urn:ogc:def:crs:{address}"))
    text = address if rng.random() < 0.4 else rng.choice(CRS_ZOO)
    carrier = rng.choice(("PAM", "PAM", "PAM", "epoch", "VRT", "points", "GCP VRT", "GCPs", ".prj"))
    text = utm_wkt() if carrier == "epoch" else text
    what, xml = f"{text[:40]} as {carrier}", escape(text)
    gcp = "<GCP Id='{0}' Pixel='{0}' Line='{0}' X='50000{0}' Y='400000{0}'/>"
    gcps = f"<GCPList Projection='{xml}'>" + "".join(gcp.format(i) for i in range(5)) + "</GCPList>"
    if carrier in ("points", "GCP VRT"):
        name, table = "in.vrt", f"<VRTDataset rasterXSize='20' rasterYSize='20'>{gcps}</VRTDataset>"
        if carrier == "points":
            name, table = "in.points", f"#CRS: {text}\n{POINTS}"
        world.put({name: table.encode()})
        target = rng.choice(("out/p.geojson", "out/p.points", "out/p.txt"))
        outputs = (target, f"{target}.aux.xml")
        return Plan(number, "CRS", what, "gcps", pan=name, target=target, outputs=outputs)
    action, ms = rng.choice(("check", "write", "write", "inplace")), "ms.tif"
    if carrier == ".prj":
        world.put({"ms.prj": text.encode()})
    elif carrier == "GCPs":
        world.put({"ms.tif.aux.xml": f"<PAMDataset>{gcps}</PAMDataset>".encode()})
    elif carrier == "VRT":
        ms = _inside(world, "ms.tif", shape_of(world, False))
        _change_srs(world.folder / ms, f"<SRS>{xml}</SRS>")
        action = action if action != "inplace" else "write"
    else:
        world.put({"ms.tif.aux.xml": pam(shape_of(world, False))})
        srs = f"<SRS>{xml}</SRS>"
        if carrier == "epoch":
            epoch = rng.choice(("2020.5", "nan", "-1", "x", ""))
            srs = f"<SRS coordinateEpoch='{epoch}'>{xml}</SRS>"
        _change_srs(world.folder / "ms.tif.aux.xml", srs)
    return Plan(number, "CRS", what, action, ms, outputs=outputs_of(action))


def _change_srs(path: Path, srs: str) -> None:
    text = path.read_text()
    path.write_text(text.partition("<SRS>")[0] + srs + text.partition("</SRS>")[2])
