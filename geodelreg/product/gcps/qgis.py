"""QGIS georeferencer ``.points``.

QGIS reads columns by position: map X, map Y, source X, source Y, then 1 or 0 for enabled.  For a
georeferenced raster, as every MS raster is here, "source" is a map coordinate too: the pixel under
the raster's *original* geotransform.  Residuals are the model's source pixel minus the measured
one, columns and upward rows; QGIS writes them and never reads them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geodelreg.errors import GcpFormatError
from geodelreg.geo.affine import apply_affine
from geodelreg.product.gcps.context import (
    Decoded,
    GcpContext,
    crs_wkt_of,
    exact,
    gcps_at,
    ground_of,
    numbers,
    one_line,
    pixels_of,
)
from geodelreg.values.points import Gcp
from geodelreg.values.raster import FloatArray

_CRS_PREFIX = "#CRS: "
_HEADER = "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"


def encode(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of a ``.points`` file."""
    claimed = apply_affine(context.source.transform, pixels_of(gcps))
    lines = [_CRS_PREFIX + one_line(context.source.crs_wkt), _HEADER]
    for gcp, (x, y), (dx, dy) in zip(
        gcps, claimed.tolist(), _residuals(gcps, context).tolist(), strict=True
    ):
        values = (gcp.x, gcp.y, x, y)
        residual = (round(value, 6) + 0.0 for value in (dx, dy, math.hypot(dx, dy)))
        lines.append(",".join([*map(exact, values), "01"[gcp.enabled], *map(exact, residual)]))
    return "\n".join(lines) + "\n"


def _residuals(gcps: Sequence[Gcp], context: GcpContext) -> FloatArray:
    if context.corrected is None:
        return np.zeros((len(gcps), 2))
    modelled = apply_affine(~context.corrected, ground_of(gcps))
    difference: FloatArray = modelled - pixels_of(gcps)
    difference[:, 1] *= -1.0
    return difference


def decode(text: str, context: GcpContext | None) -> Decoded:
    """Points of a ``.points`` file and its CRS, when it names one.

    Raises
    ------
    GcpFormatError
        If a line is malformed, or the raster's original grid is not known.
    """
    if context is None:
        raise GcpFormatError(
            "QGIS points refer to the map coordinates of the raster they were made for",
            "Name that raster.",
        )
    lines = text.splitlines()
    crs_wkt = None
    if lines and lines[0].startswith(_CRS_PREFIX.strip()):
        crs_wkt = crs_wkt_of(lines.pop(0)[len(_CRS_PREFIX.strip()) :].strip())
    first = len(text.splitlines()) - len(lines) + 2
    rows = [
        _row(line, number) for number, line in enumerate(lines[1:], start=first) if line.strip()
    ]
    points = np.array(rows, dtype=np.float64).reshape(-1, 5)
    pixels = apply_affine(~context.source.transform, points[:, 2:4])
    gcps = zip(gcps_at(pixels, points[:, :2]), (points[:, 4] != 0).tolist(), strict=True)
    return tuple(replace(gcp, enabled=enabled) for gcp, enabled in gcps), crs_wkt


def _row(line: str, number: int) -> list[float]:
    """Four coordinates, and 0 where the point is not enabled."""
    fields = line.split("," if "," in line else "\t")
    if len(fields) < 4:
        raise GcpFormatError(f"line {number}: fewer than 4 columns")
    return numbers([*fields[:5], "1"][:5], number)
