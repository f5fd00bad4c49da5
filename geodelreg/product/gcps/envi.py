"""ENVI ``.pts``: image to image (PAN pixel ↔ MS pixel) and image to map (map ↔ MS pixel).

ENVI counts pixels from 1: the upper-left *corner* of the upper-left pixel is (1, 1).
Source: ENVI documentation, "GCP File Formats".
"""

from __future__ import annotations

import re
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodelreg.door.opening import open_raster
from geodelreg.errors import GcpFormatError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.product.gcps.context import (
    Decoded,
    GcpContext,
    gcps_at,
    ground_of,
    numbers,
    pixels_of,
    reference_pixels,
)
from geodelreg.values.points import Gcp
from geodelreg.values.raster import FloatArray

_FIRST_PIXEL = 1.0
_IMAGE_TITLE = "; ENVI Image to Image GCP File"
_MAP_TITLE = "; ENVI Image to Map GCP File"
_UNKNOWN_PROJECTION = "Arbitrary"


def is_image_to_map(text: str) -> bool:
    """Whether the file's first line is that of an image-to-map file."""
    return text.lstrip().lower().startswith(_MAP_TITLE.lower())


def encode_image_to_image(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of an image-to-image file: base is PAN, warp is MS."""
    header = [
        _IMAGE_TITLE,
        f"; base file: {context.reference_path}",
        f"; warp file: {context.source_label}",
        "; Base Image (x,y), Warp Image (x,y)",
        ";",
    ]
    base = reference_pixels(gcps, context) + _FIRST_PIXEL
    return _text(header, base, pixels_of(gcps) + _FIRST_PIXEL)


def encode_image_to_map(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of an image-to-map file."""
    header = [
        _MAP_TITLE,
        f"; projection info = {projection_info(context.source.crs_wkt)}",
        f"; warp file: {context.source_label}",
        "; Map (x,y), Image (x,y)",
        ";",
    ]
    return _text(header, ground_of(gcps), pixels_of(gcps) + _FIRST_PIXEL)


def _text(header: list[str], left: FloatArray, right: FloatArray) -> str:
    rows = [
        " ".join(f"{value:20.10f}" for value in row) for row in np.hstack([left, right]).tolist()
    ]
    return "\n".join([*header, *rows]) + "\n"


def decode_image_to_image(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of an image-to-image file, whose base pixels become map coordinates of the PAN grid.

    Raises
    ------
    GcpFormatError
        If a line has not 4 numbers, or the grids are not known.
    """
    if context is None or context.reference is None:
        raise GcpFormatError(
            "image-to-image points need both rasters' grids", "Name the two rasters."
        )
    table = _table(text)
    reference, crs_wkt = context.reference, context.source.crs_wkt
    base = apply_affine(reference.transform, table[:, :2] - _FIRST_PIXEL)
    ground = map_points(base, reference.crs_wkt, crs_wkt)
    return gcps_at(table[:, 2:] - _FIRST_PIXEL, ground), crs_wkt


def decode_image_to_map(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of an image-to-map file, and its CRS when ``projection info`` tells it.

    Raises
    ------
    GcpFormatError
        If a line has not 4 numbers.
    """
    info = re.search(r"^;\s*projection info\s*=\s*\{([^}]*)\}", text, re.MULTILINE | re.IGNORECASE)
    table = _table(text)
    crs_wkt = _crs_of_projection(info.group(1)) if info else None
    return gcps_at(table[:, 2:] - _FIRST_PIXEL, table[:, :2]), crs_wkt


def _table(text: str) -> FloatArray:
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith(";"):
            continue
        if len(fields) != 4:
            raise GcpFormatError(f"line {number}: {len(fields)} columns instead of 4")
        rows.append(numbers(fields, number))
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def projection_info(crs_wkt: str) -> str:
    """ENVI's description of a CRS, ``{Arbitrary, …}`` for one that ENVI cannot describe exactly.

    GDAL's ENVI driver makes it (as ``map info`` and ``projection info`` of a header) and reads it
    back; only a description that gives the same CRS again is used.
    """
    from rasterio.crs import CRS

    crs = CRS.from_wkt(crs_wkt)
    header = _envi_header(crs_wkt)
    numeric = re.search(r"^projection info = \{(.*)\}", header, re.MULTILINE)
    named = re.search(r"^map info = \{(.*)\}", header, re.MULTILINE)
    if numeric:
        fields = numeric.group(1).split(",")
    elif named:
        fields = named.group(1).split(",")
        del fields[1:7]
    else:
        fields = [_UNKNOWN_PROJECTION]
    text = ", ".join(field.strip() for field in fields if "units=" not in field)
    text += ", units=Degrees" if crs.is_geographic else ", units=Meters"
    found = _crs_of_projection(text)
    if found is None or CRS.from_wkt(found) != crs:
        text = f"{_UNKNOWN_PROJECTION}, units=Unknown"
    return f"{{{text}}}"


def _envi_header(crs_wkt: str) -> str:
    import rasterio
    from affine import Affine

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "tiny.img")
        profile = {"driver": "ENVI", "width": 1, "height": 1, "count": 1, "dtype": "uint8"}
        grid = Affine(2.0, 0.0, 0.0, 0.0, -2.0, 0.0)
        with rasterio.open(path, "w", crs=crs_wkt, transform=grid, **profile):
            pass
        return path.with_suffix(".hdr").read_text(encoding="utf-8")


def _crs_of_projection(info: str) -> str | None:
    """WKT of a ``projection info``; None when it does not name a datum that GDAL knows."""
    fields = [field.strip() for field in info.split(",")]
    units = [field for field in fields if field.lower().startswith("units")]
    fields = [field for field in fields if field not in units]
    numeric = fields[0].isdigit()
    name = fields[-1] if numeric else fields[0]
    rest = fields[-2:-1] if numeric else fields[1:]
    lines = ["ENVI", "samples = 2", "lines = 1", "bands = 1", "header offset = 0", "data type = 1"]
    lines += ["interleave = bsq", f"map info = {{{', '.join([name, *'110022', *rest, *units])}}}"]
    if numeric:
        lines.append(f"projection info = {{{', '.join(fields)}}}")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder, "tiny.img")
        path.write_bytes(b"\0\0")
        path.with_suffix(".hdr").write_text("\n".join(lines) + "\n", encoding="utf-8")
        with open_raster(path) as dataset:
            crs = dataset.crs
    known = crs is not None and (crs.is_geographic or crs.is_projected)
    return str(crs.to_wkt(version="WKT2_2019")) if known else None
