"""Grids of windows and of decimated reads, and how large a pixel is on the ground."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine

from geodelreg.errors import CrsTransformError
from geodelreg.values.raster import Grid, Window

if TYPE_CHECKING:
    from pyproj import CRS


def window_transform(grid: Grid, window: Window) -> Affine:
    """Geotransform of a window of a raster."""
    return grid.transform @ Affine.translation(window.column, window.row)


def decimated_grid(grid: Grid, window: Window, shape: tuple[int, int] | None = None) -> Grid:
    """Grid of a window that is averaged down to `shape`.

    The pixel size grows by the true ratio of sizes in each direction, so that the outer corners
    of the window stay where they are.

    Parameters
    ----------
    grid : Grid
        Of the full raster.
    window : Window
    shape : tuple of int, optional
        ``(height, width)``; the window's own when not given.
    """
    height, width = shape or (window.height, window.width)
    scale = Affine.scale(window.width / width, window.height / height)
    return Grid(window_transform(grid, window) @ scale, (height, width), grid.crs_wkt)


def is_north_up(grid: Grid) -> bool:
    """True when columns run east and rows south, exactly."""
    transform = grid.transform
    return transform.b == 0 and transform.d == 0 and transform.a > 0 and transform.e < 0


def gsd_px_m(grid: Grid) -> tuple[float, float]:
    """Ground size of a pixel at the centre of a raster.

    Parameters
    ----------
    grid : Grid
        Rotated, south-up and non-square ones included.

    Returns
    -------
    tuple of float
        Metres along a row (from one column to the next) and along a column.  Projected CRSs are
        taken at their word (scale factor 1); geographic ones are measured on their ellipsoid.

    Raises
    ------
    CrsTransformError
        If PROJ does not understand the CRS.
    """
    height, width = grid.shape
    transform = grid.transform
    # loading PROJ takes longer than all else here
    crs = _crs(grid.crs_wkt) if grid.unit_m is None else None
    if crs is None or not crs.is_geographic:
        unit_m = grid.unit_m if crs is None else _unit_m(crs)
        assert unit_m is not None
        return (
            unit_m * math.hypot(transform.a, transform.d),
            unit_m * math.hypot(transform.b, transform.e),
        )
    unit_deg = math.degrees(crs.axis_info[0].unit_conversion_factor)
    geod = crs.get_geod()
    assert geod is not None
    middle = np.array([width / 2, height / 2])
    sizes = []
    for step in (np.array([0.5, 0.0]), np.array([0.0, 0.5])):
        start = np.multiply(unit_deg, transform @ tuple(middle - step))
        end = np.multiply(unit_deg, transform @ tuple(middle + step))
        sizes.append(float(geod.inv(*start, *end)[2]))
    return sizes[0], sizes[1]


@lru_cache(maxsize=16)
def _crs(wkt: str) -> CRS:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return CRS.from_wkt(wkt)
    except CRSError as error:
        raise CrsTransformError(
            f"PROJ does not understand the coordinate reference system ({error})",
            "Correct the CRS definition of the raster.",
        ) from error


def _unit_m(crs: CRS) -> float:
    return float(crs.axis_info[0].unit_conversion_factor) if crs.axis_info else 1.0
