"""What a table of pairs shows of an alignment, and where its raster lies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from affine import Affine

from geodelreg.batch.job import FIGURES
from geodelreg.errors import CrsTransformError
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.product.motion import header_motion
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Alignment, Misalignment

_PER_EDGE = 4
_DIGITS = 7
"""Of degrees: 1 cm."""


def figures_of(alignment: Alignment) -> dict[str, float | str | None]:
    """`FIGURES` of an alignment; those that only a check measures are None."""
    accuracy, motion = alignment.accuracy, header_motion(alignment)
    found: dict[str, float | str] = {
        "model": alignment.correction.model,
        "offset_px": motion.distance_px,
        "offset_m": motion.distance_m,
        "before_rmse_px": accuracy.before_rmse_px,
        "check_rmse_px": accuracy.check_rmse_px,
        "check_rmse_m": accuracy.check_rmse_m,
        "check_ce90_px": accuracy.check_ce90_px,
        "sigma_corner_px": accuracy.sigma_corner_px,
        "coverage": accuracy.coverage,
        "tie_points": accuracy.kept,
    }
    return dict.fromkeys(FIGURES) | _known(found)


def check_figures(misalignment: Misalignment) -> dict[str, float | str | None]:
    """What a check measures, for `FIGURES`."""
    return _known(
        {
            "misalignment_px": misalignment.distance_px,
            "misalignment_m": misalignment.distance_m,
            "misalignment_sigma_px": misalignment.sigma_px,
        }
    )


def _known(values: Mapping[str, float | str]) -> dict[str, float | str | None]:
    """The same; numbers that are not finite are None."""
    return {
        name: value if isinstance(value, str) or math.isfinite(value) else None
        for name, value in values.items()
    }


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

    height, width = grid.shape
    corners = np.array([[0, 0], [0, height], [width, height], [width, 0], [0, 0]], dtype=np.float64)
    along = np.linspace(0.0, 1.0, _PER_EDGE, endpoint=False)[:, None]
    edges = [start + along * (end - start) for start, end in pairwise(corners)]
    ring = np.vstack([*edges, corners[:1]])
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
