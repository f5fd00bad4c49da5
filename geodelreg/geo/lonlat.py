"""Where a raster lies on the Earth, as a geometry of GeoJSON."""

from __future__ import annotations

from typing import Any

import numpy as np
from affine import Affine

from geodelreg.errors import CrsTransformError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.grid import outline
from geodelreg.values.raster import FloatArray, Grid

_PER_EDGE = 4
_DIGITS = 7
"""Of degrees: 1 cm."""


def footprint(grid: Grid, transform: Affine) -> dict[str, Any] | None:
    """Outline of a raster as a GeoJSON geometry, cut in two at the antimeridian.

    Parameters
    ----------
    grid : Grid
        Its shape and CRS count.
    transform : Affine
        Geotransform.

    Returns
    -------
    dict or None
        In longitude and latitude, degrees; None when PROJ cannot take the outline there.
    """
    from pyproj import CRS

    edge = outline(grid, _PER_EDGE)
    ring = np.vstack([edge, edge[:1]])[::-1]
    try:
        wgs84 = CRS.from_epsg(4326).to_wkt()
        lonlat = map_points(apply_affine(transform, ring), grid.crs_wkt, wgs84)
    except CrsTransformError:
        return None
    if not np.isfinite(lonlat).all():
        return None
    return _geometry(lonlat)


def _geometry(lonlat: FloatArray) -> dict[str, Any] | None:
    """A ring as GeoJSON wants it: within ±180°, counterclockwise."""
    from shapely import MultiPolygon, Polygon, box, set_precision
    from shapely.affinity import translate
    from shapely.geometry import mapping
    from shapely.geometry.polygon import orient

    unrolled = np.column_stack([np.unwrap(lonlat[:, 0], period=360.0), lonlat[:, 1]])
    outline = Polygon(unrolled)
    if not outline.is_valid:
        return None
    parts = [
        translate(outline.intersection(box(turn - 180, -90, turn + 180, 90)), -turn)
        for turn in (-360, 0, 360)
    ]
    rings = [
        orient(set_precision(part, 10.0**-_DIGITS))
        for part in parts
        if isinstance(part, Polygon) and part.area > 0
    ]
    geometry: dict[str, Any] = mapping(rings[0] if len(rings) == 1 else MultiPolygon(rings))
    return geometry
