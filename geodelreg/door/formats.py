"""GDAL's formats by what a file of theirs can make GDAL open, and how they are known by content.

GDAL chooses the format by content, whatever the name says, and some formats hold names: of pixels
elsewhere, of caches to be written, of addresses.  Only formats that cannot are opened unasked,
and a few whose names are looked at before.  Everything else needs ``--allow``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, MutableMapping
from dataclasses import dataclass
from typing import Literal

from geodelreg.door.names import ALL, LOCAL, NETWORK

Reach = Literal["alone", "checked", "network", "all", "vector"]


@dataclass(frozen=True, slots=True)
class Format:
    """What a file of one format can make GDAL open.

    Attributes
    ----------
    reach : str
        ``alone``: itself, and side files that bear its name; ``checked``: files that it names,
        which are looked at before; ``network``, ``all``: needs that value of ``--allow``;
        ``vector``: holds no raster.
    why : str
        For the documentation.
    """

    reach: Reach
    why: str


_ALONE = """
    AAIGrid ACE2 AIG BIGGIF BLX BMP BSB BT BYN COG COSAR CTG CTable2 DIPEx DOQ1 DTED EHdr ELAS ENVI
    ESAT FIT GFF GIF GRASSASCIIGrid GRIB GS7BG GSAG GSBG GSC GTX GTiff GXF HF2 IRIS ISG JDEM
    JP2OpenJPEG JPEG KRO LAN LCP LOSLAS Leveller NGSGEOID NOAA_B NSIDCbin NTv2 NWT_GRC NWT_GRD
    PCRaster PNG PNM R RIK RMF ROI_PAC RRASTER SAGA SGI SIGDEM SNAP_TIFF SRTMHGT TGA Terragen
    USGSDEM WEBP XPM XYZ ZMap
"""
_CHECKED = {
    "DIMAP": "files of bands and parts, by path",
    "HFA": "pixels in an .ige, overviews in an .rrd; only from its own folder",
    "TIL": "tiles, by path",
    "VRT": "sources of any kind",
    "netCDF": "classic files only: netCDF-4 is HDF5",
}
_NETWORK = {
    "services, or files that describe them": "DAAS EEDA EEDAI HTTP NGW OGCAPI PLMOSAIC RASDAMAN "
    "STACIT STACTA WCS WMS WMTS",
    "vector services": "AmigoCloud CSW Carto Elasticsearch OAPIF PLSCENES WFS",
}
_ALL = {
    "a data file, to be read or written, by any path": "MRF",
    "external storage, virtual datasets and links to any file": "BAG HDF4 HDF4Image HDF5 HDF5Image "
    "S102 S104 S111",
    "names of files inside a label or header": "DOQ2 EIR ERS ILWIS ISIS2 ISIS3 MAP MFF MFF2 NDF "
    "OZI PAux PCIDSK PDS PDS4 PRF RST SNODAS VICAR",
    "products of many files, listed in one": "ADRG AirSAR CEOS COASP ECRGTOC FAST GenBin ISCE "
    "JAXAPALSAR KMLSUPEROVERLAY L1B MSGN RPFTOC RS2 SAFE SAR_CEOS SDTS SENTINEL2 SRP TSX",
    "images inside that GDAL again opens by content": "CALS NITF PDF",
    "an index of any rasters": "ESRIC GTI",
    "a database, which may write beside itself": "GPKG MBTiles Rasterlite SQLite",
    "references to any file or address": "Zarr",
    "made from other datasets by name": "DERIVED GDALG",
    "layers of any data source": "OGR_VRT",
    "a library that is loaded by name": "ADBC",
    "another program is started": "GPSBabel",
}
_VECTOR = {
    "rasterio's own memory": "MEM Memory",
    "no raster": "AVCBin AVCE00 AIVector CPG CSV DGN DXF EDIGEO ESRIJSON FlatGeobuf GML GMT "
    "GNMDatabase GNMFile GPX GTFS GeoJSON GeoJSONSeq GeoRSS Idrisi JML JSONFG KML LIBKML LVBAG MVT "
    "MapML MiraMonVector ODS OGR_GMT OGR_PDS OSM OpenFileGDB PGDUMP PMTiles S57 SXF Selafin "
    "TopoJSON VDV VFK WAsP XLSX",
}


_SPACED = ("ESRI Shapefile", "MapInfo File")


def _rows() -> Iterator[tuple[str, Format]]:
    yield from ((name, Format("alone", "")) for name in _ALONE.split())
    yield from ((name, Format("checked", why)) for name, why in _CHECKED.items())
    groups: tuple[tuple[Reach, dict[str, str]], ...] = (
        ("network", _NETWORK),
        ("all", _ALL),
        ("vector", _VECTOR),
    )
    for reach, whys in groups:
        for why, names in whys.items():
            yield from ((name, Format(reach, why)) for name in names.split())
    yield from ((name, Format("vector", "no raster")) for name in _SPACED)


FORMATS = dict(_rows())
"""By GDAL's short name.  A format that is not here needs `allow` to be ``all``."""

_REACHES = {LOCAL: ("alone", "checked"), NETWORK: ("alone", "checked", "network")}

_SIGNATURES = (
    ("GTiff", rb"II[*+]\0|MM\0[*+]"),
    ("PNG", rb"\x89PNG\r\n\x1a\n"),
    ("JPEG", rb"\xff\xd8\xff"),
    ("JP2OpenJPEG", rb"\0\0\0\x0cjP  \r\n\x87\n|\xff\x4f\xff\x51"),
    ("GIF", rb"GIF8[79]a"),
    ("WEBP", rb"RIFF.{4}WEBP"),
    ("HFA", rb"EHFA_HEADER_TAG"),
    ("netCDF", rb"CDF[\x01\x02\x05]"),
)
"""What no other format begins with."""

_MARKS = (
    ("VRT", rb"<VRTDataset"),
    ("DIMAP", rb"<Dimap_Document"),
    ("MRF", rb"<MRF_META"),
    ("WMS", rb"<GDAL_WMS|<WMS_Tile_Service|<WMT_MS_Capabilities|<WMS_Capabilities"),
    ("WMTS", rb"<GDAL_WMTS|<Capabilities"),
    ("WCS", rb"<WCS_GDAL"),
    ("GTI", rb"<GDALTileIndexDataset"),
    ("STACTA", rb'\{[^\0]*"stac_'),
    ("HDF5", rb"\x89HDF\r\n\x1a\n"),
    ("HDF4", rb"\A\x0e\x03\x13\x01"),
    ("NITF", rb"\A(?:NITF|NSIF)\d"),
    ("PDF", rb"%PDF-"),
    ("SQLite", rb"\ASQLite format 3\0"),
    ("GTI", rb"\Afgb\x03"),
    ("PCIDSK", rb"\APCIDSK  "),
    ("ISIS3", rb"IsisCube"),
    ("PDS", rb"PDS_VERSION_ID|ODL_VERSION_ID|CCSD3ZF|NJPL1I|\^(?:IMAGE|QUBE)"),
    ("VICAR", rb"LBLSIZE="),
    ("ERS", rb"(?i:DatasetHeader Begin|Algorithm Begin)"),
    ("ILWIS", rb"(?i:\[ilwis\]|\[MapStore\])"),
    ("OZI", rb"\AOziExplorer"),
    ("MFF", rb"IMAGE_FILE_FORMAT"),
    ("PAux", rb"AuxilaryTarget"),
    ("EIR", rb"\AIMAGINE_RAW_FILE"),
    ("DOQ2", rb"BEGIN_USGS_DOQ_HEADER"),
    ("NDF", rb"\ANDF_REVISION|PRODUCT_TYPE="),
    ("SNODAS", rb"\AFormat version: NOHRSC"),
    ("SDTS", rb"\A\d{5}[123 ]L"),
    ("RPFTOC", rb"\A.{0,9} *A\.TOC"),
    ("FAST", rb"ACQUISITION DATE"),
    ("CALS", rb"srcdocid:"),
    ("ZIP", rb"\APK\x03\x04"),
    ("TIL", rb"numTiles\s*="),
)
"""What GDAL takes as a sign of formats that can name files; the first that is found."""

_MARKUP = re.compile(
    rb"\A(?:\xef\xbb\xbf)?\s*(?:<\?xml\s|<!--|<!DOCTYPE|<[A-Za-z][\w:.-]+[\s/>]|\{\s*\")"
)

_SIGNED = re.compile(
    b"|".join(b"(?P<%s>%s)" % (name.encode(), mark) for name, mark in _SIGNATURES), re.DOTALL
)
_MARKED = tuple((name, re.compile(mark, re.DOTALL)) for name, mark in _MARKS)

_MASKS_TOO = ("GPKG", "SQLite")
"""Databases that hold vector masks, which are opened by another GDAL under the same settings."""

HEAD_BYTES = 8192
"""What `format_of` needs to see of a file."""

BY_SIGNATURE = ("GTiff", "PNG", "JPEG", "JP2OpenJPEG", "GIF", "WEBP")
"""Formats that GDAL opens only where their signature is, and that reach nothing else."""


def format_of(head: bytes) -> str | None:
    """Format that a file certainly is, or one with names that GDAL could take it for.

    Parameters
    ----------
    head : bytes
        The first `HEAD_BYTES` of the file.

    Returns
    -------
    str or None
        None for a file that no such format would be chosen for.
    """
    signed = _SIGNED.match(head)
    if signed is not None:
        return signed.lastgroup
    return next((name for name, mark in _MARKED if mark.search(head)), None)


def is_markup(head: bytes) -> bool:
    """Whether a file is XML or JSON, of whatever kind."""
    return _MARKUP.match(head) is not None


def needed_for(driver: str) -> str:
    """Least value of `allow` under which files of a format are opened."""
    reach = FORMATS[driver].reach if driver in FORMATS else "all"
    return {"network": NETWORK, "all": ALL}.get(reach, LOCAL)


def alone() -> tuple[str, ...]:
    """Formats that reach nothing but side files of their own name."""
    return tuple(sorted(name for name, one in FORMATS.items() if one.reach == "alone"))


def unseen() -> tuple[str, ...]:
    """Formats for what is on the network: web services, and those that cannot name local files."""
    return tuple(sorted(n for n, one in FORMATS.items() if one.reach in ("alone", "network")))


def skip_the_rest(environment: MutableMapping[str, str], allow: str) -> None:
    """Keep formats out of a GDAL that is not loaded yet: nothing deep inside a file reaches them.

    Parameters
    ----------
    environment : mapping
        Variables of the process, changed; what the user has set stays.
    allow : str
        ``local`` or ``network``.
    """
    kept = (*_REACHES[allow], "vector")
    rest = sorted(name for name, one in FORMATS.items() if one.reach not in kept)
    skipped = environment.get("GDAL_SKIP", "")
    separator = "," if "," in skipped else " "  # as GDAL reads it
    names = [*skipped.split(separator), *(name for name in rest if name not in _MASKS_TOO)]
    environment["GDAL_SKIP"] = separator.join(dict.fromkeys(filter(None, names)))
    if allow == LOCAL:
        environment.setdefault("CPL_VSIL_CURL_ALLOWED_FILENAME", "none")
