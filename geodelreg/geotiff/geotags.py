"""The TIFF tags that carry georeferencing and GDAL's metadata.

GeoTIFF 1.1 (OGC 19-008r4): ModelPixelScale, ModelTiepoint, ModelTransformation and the GeoKeys.
GDAL keeps metadata as XML in a tag of its own.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape  # that of xml.sax loads urllib, and ssl

from affine import Affine

from geodelreg.geotiff.sidecars import DOMAIN
from geodelreg.tiff import ASCII, DOUBLE, Directory, Entry, Layout, TiffFile
from geodelreg.values.points import Gcp

PIXEL_SCALE, TIE_POINTS, TRANSFORMATION = 33550, 33922, 34264
GEO_KEYS, GEO_DOUBLES, GEO_TEXTS = 34735, 34736, 34737
GDAL_METADATA, RPC_COEFFICIENTS = 42112, 50844

PLACEMENT = (PIXEL_SCALE, TIE_POINTS, TRANSFORMATION)
CRS_TAGS = (GEO_KEYS, GEO_DOUBLES, GEO_TEXTS)
_RASTER_TYPE_KEY, _PIXEL_IS_POINT = 1025, 2

_ITEM = re.compile(
    rb"[ \t]*<Item\b([^>]*?)(?:/>|>(?:<!\[CDATA\[.*?\]\]>|(?!<!\[CDATA\[).)*?</Item>)[ \t]*\r?\n?",
    re.DOTALL,
)


def gcps_json(gcps: Sequence[Gcp]) -> str:
    """GCPs as the JSON that outputs carry: outer-corner pixel, map position in the raster's CRS."""
    rows = [
        {"id": g.id, "column": g.column, "row": g.row, "x": g.x, "y": g.y, "z": g.z, "info": g.info}
        for g in gcps
    ]
    return json.dumps(rows, separators=(",", ":"), ensure_ascii=False)


def is_pixel_point(tiff: TiffFile, directory: Directory) -> bool:
    """Whether the GeoKeys place pixel centres instead of corners (AREA_OR_POINT=Point)."""
    keys = tiff.numbers(directory.find(GEO_KEYS))
    rows = [keys[i : i + 4] for i in range(4, len(keys) - 3, 4)]
    return any(row[0] == _RASTER_TYPE_KEY and row[3] == _PIXEL_IS_POINT for row in rows)


def placement_entries(
    tiff: TiffFile, directory: Directory, transform: Affine, pixel_point: bool
) -> list[Entry]:
    """Tags of a geotransform, as GDAL writes them.

    North-up ones become scale and tie point, all others a matrix.  What the file says about
    heights is kept.

    Parameters
    ----------
    tiff, directory
        The image that they are for.
    transform : Affine
        Outer corner of the pixels to map coordinates.
    pixel_point : bool
        The file places pixel centres: the tags are half a pixel further.
    """
    z_scale, z_offset = _heights(tiff, directory)
    half = 0.5 if pixel_point else 0.0
    x, y = transform @ (half, half)
    a, b, d, e = transform.a, transform.b, transform.d, transform.e
    if b == 0 and d == 0 and a > 0 and e < 0:
        return [
            Entry.of(tiff.layout, PIXEL_SCALE, DOUBLE, (a, -e, z_scale)),
            Entry.of(tiff.layout, TIE_POINTS, DOUBLE, (0, 0, 0, x, y, z_offset)),
        ]
    matrix = (a, b, 0, x, d, e, 0, y, 0, 0, z_scale, z_offset, 0, 0, 0, 1)
    return [Entry.of(tiff.layout, TRANSFORMATION, DOUBLE, matrix)]


def gcp_entries(layout: Layout, gcps: Sequence[Gcp], pixel_point: bool) -> list[Entry]:
    """Tie points of a raster that is placed by GCPs."""
    half = 0.5 if pixel_point else 0.0
    values = [v for g in gcps for v in (g.column - half, g.row - half, 0.0, g.x, g.y, g.z)]
    return [Entry.of(layout, TIE_POINTS, DOUBLE, values)]


def _heights(tiff: TiffFile, directory: Directory) -> tuple[float, float]:
    scale = tiff.numbers(directory.find(PIXEL_SCALE))
    ties = tiff.numbers(directory.find(TIE_POINTS))
    matrix = tiff.numbers(directory.find(TRANSFORMATION))
    if len(scale) >= 3:
        return scale[2], ties[5] if len(ties) == 6 else 0.0
    return (matrix[10], matrix[11]) if len(matrix) == 16 else (0.0, 0.0)


def metadata_entry(
    layout: Layout, existing: bytes, levels: Sequence[Mapping[str, Mapping[str, str]]]
) -> Entry:
    """GDAL's metadata tag with items added; those of an earlier alignment are dropped.

    Parameters
    ----------
    layout : Layout
    existing : bytes
        The tag's value so far, b"" when there is none; the rest of it is kept byte by byte.
    levels : sequence of mapping
        Items by domain ("" the default one): of the raster first, then of each band.
    """
    added = b""
    for number, domains in enumerate(levels):
        added += b"".join(_items(domains, f' sample="{number - 1}"' if number else ""))
    kept = _ITEM.sub(lambda m: b"" if _is_ours(m.group(1)) else m.group(0), existing.rstrip(b"\0"))
    end = kept.rfind(b"</GDALMetadata>")
    if end < 0:
        text = b"<GDALMetadata>\n" + added + b"</GDALMetadata>\n"
    else:
        text = kept[:end] + added + kept[end:]
    return Entry.of(layout, GDAL_METADATA, ASCII, text)


def _is_ours(attributes: bytes) -> bool:
    prefix = DOMAIN.encode()
    if re.search(rb'\bdomain="' + prefix + rb'"', attributes):
        return True
    return (
        b"domain=" not in attributes
        and re.search(rb'\bname="' + prefix + rb"_", attributes) is not None
    )


def _items(domains: Mapping[str, Mapping[str, str]], band: str) -> Iterable[bytes]:
    for domain, items in sorted(domains.items()):
        place = f' domain="{_attribute(domain)}"' if domain else ""
        for name, value in sorted(items.items()):
            # GDAL unescapes twice, once as XML and once more
            text = escape(escape(value, quote=False), quote=False)
            yield f'  <Item name="{_attribute(name)}"{band}{place}>{text}</Item>\n'.encode(
                errors="replace"
            )


def _attribute(text: str) -> str:
    return escape(text, quote=False).replace('"', "&quot;")
