"""Exact change of map coordinates between CRSs, through pyproj."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from geodelreg.errors import CrsTransformError
from geodelreg.geo.affine import apply_affine
from geodelreg.values.raster import FloatArray, Grid

if TYPE_CHECKING:
    from pyproj import Transformer

_ONE_AT_A_TIME = Lock()
"""Of a transformation; pyproj makes those that it lists for a pair of CRSs for one thread each."""


@dataclass(frozen=True, slots=True)
class CrsOperation:
    """The pyproj operation that carries map points from one CRS to the other.

    Attributes
    ----------
    description : str
        PROJ's description with its accuracy; "" for identical CRSs.
    warning : str
        Non-empty when a better operation needs a grid that is not installed.
    """

    description: str = ""
    warning: str = ""


@lru_cache(maxsize=16)
def _operation(from_wkt: str, to_wkt: str) -> tuple[Transformer | None, CrsOperation]:
    if from_wkt == to_wkt:
        return None, CrsOperation()
    from pyproj import CRS
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    try:
        source, target = CRS.from_wkt(from_wkt), CRS.from_wkt(to_wkt)
        if source.equals(target, ignore_axis_order=True):
            return None, CrsOperation()
        with warnings.catch_warnings():
            # about missing grids, which the result says in its own words
            warnings.simplefilter("ignore", UserWarning)
            group = TransformerGroup(source, target, always_xy=True)
        transformer = group.transformers[0]
    except (ProjError, IndexError) as error:
        reason = f" ({error})" if isinstance(error, ProjError) else ""
        raise CrsTransformError(
            "no transformation between the coordinate reference systems "
            f"{_name(from_wkt)} and {_name(to_wkt)} is known{reason}",
            "Reproject one raster into the other's CRS, or correct its CRS definition.",
        ) from error
    warning = ""
    if not group.best_available and group.unavailable_operations:
        best = group.unavailable_operations[0]
        grids = ", ".join(grid.short_name for grid in best.grids) or "a grid"
        warning = (
            f"the best operation between the CRSs ({best.name}) needs {grids}, which PROJ does not "
            f"find; used {transformer.description!r} instead"
        )
    text = transformer.description
    if transformer.accuracy >= 0:  # else PROJ does not know it
        text = f"{text} (accuracy {transformer.accuracy:g} m)"
    return transformer, CrsOperation(text, warning)


def _name(wkt: str) -> str:
    found = re.search(r'"([^"]*)"', wkt)
    return repr(found[1]) if found else "without a name"


def crs_operation(from_wkt: str, to_wkt: str) -> CrsOperation:
    """Operation that `map_points` uses for this pair of CRSs.

    Raises
    ------
    CrsTransformError
        If PROJ knows none.
    """
    return _operation(from_wkt, to_wkt)[1]


def same_crs(one_wkt: str, other_wkt: str) -> bool:
    """True when coordinates are the same in both."""
    return _operation(one_wkt, other_wkt)[0] is None


def map_points(xy: FloatArray, from_wkt: str, to_wkt: str) -> FloatArray:
    """Transform map coordinates.

    Parameters
    ----------
    xy : (..., 2) float64
        (easting, northing) or (longitude, latitude).
    from_wkt, to_wkt : str
        WKT of the two CRSs.

    Returns
    -------
    (..., 2) float64
        NaN where a point has no image in the target CRS.

    Raises
    ------
    CrsTransformError
        If PROJ knows no operation.
    """
    transformer = _operation(from_wkt, to_wkt)[0]
    points = np.asarray(xy, dtype=np.float64)
    if transformer is None:
        return points.copy()
    with _ONE_AT_A_TIME:
        x, y = transformer.transform(points[..., 0].ravel(), points[..., 1].ravel())
    out = np.stack([x, y], axis=-1).reshape(points.shape)
    out[~np.isfinite(out)] = np.nan
    return out


def map_pixels(px: FloatArray, start: Grid, end: Grid) -> FloatArray:
    """(..., 2) pixels of one raster to (..., 2) pixels of another; NaN where undefined."""
    ground = map_points(apply_affine(start.transform, px), start.crs_wkt, end.crs_wkt)
    return apply_affine(~end.transform, ground)
