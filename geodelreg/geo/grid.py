"""Grids of windows and of decimated reads, and how large a pixel is on the ground."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine

from geodelreg.errors import CrsTransformError
from geodelreg.values.raster import FloatArray, Grid, Window

if TYPE_CHECKING:
    from pyproj import CRS


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
    corner = Affine.translation(window.column, window.row)
    return Grid(grid.transform @ corner @ scale, (height, width), grid.crs_wkt)


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


def outline(grid: Grid, per_edge: int) -> FloatArray:
    """(4 n, 2) pixels along the four edges of a raster, once around."""
    height, width = grid.shape
    t = np.linspace(0.0, 1.0, per_edge + 1)[:-1]
    edges = [
        np.stack([t * width, 0 * t], 1),
        np.stack([0 * t + width, t * height], 1),
        np.stack([(1 - t) * width, 0 * t + height], 1),
        np.stack([0 * t, (1 - t) * height], 1),
    ]
    return np.concatenate(edges)


def corners_of(window: Window) -> FloatArray:
    """(4, 2) pixels at the corners of a window, row by row."""
    x = np.array([window.column, window.column + window.width], dtype=np.float64)
    y = np.array([window.row, window.row + window.height], dtype=np.float64)
    return np.array([[x[0], y[0]], [x[1], y[0]], [x[0], y[1]], [x[1], y[1]]])


def window_around(points: FloatArray, margin_px: float, grid: Grid) -> Window | None:
    """Whole pixels of a raster around (N, 2) points and a margin; None when there are none."""
    size = grid.shape[::-1]
    low, high = points.min(axis=0) - margin_px, points.max(axis=0) + margin_px
    x0, y0 = (int(v) for v in np.floor(np.clip(low, 0, size)))
    x1, y1 = (int(v) for v in np.ceil(np.clip(high, 0, size)))
    return Window(x0, y0, x1 - x0, y1 - y0) if x1 > x0 and y1 > y0 else None
