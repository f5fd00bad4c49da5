"""Where a map puts the pixels of a grid, through what is quicker where the map is smooth enough.

A field costs a kernel for every point that it stands on, wherever it is asked: a spline through a
lattice of its values costs nothing.  Between two CRSs a polynomial does, which needs no scipy.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from geodelreg.values.raster import FloatArray

MARGIN = 2  # nodes around the grid, where a spline has no end to be unsure of
COARSEST_PX, FINEST_PX = 64, 2
"""Steps between nodes: from where a field is asked for a few thousand places to where every other
pixel is, which no spline needs to do better."""
_DEGREE = 9  # projections are analytic: a scene of a degree of longitude leaves 1e-7 px of it

Values = Callable[[FloatArray, FloatArray], FloatArray]
"""(R, C, 2) places at (R,) rows and (C,) columns of a grid, outer corner."""


def interpolated(asked: Values, shape: tuple[int, int], tolerance_px: float) -> tuple[Values, int]:
    """A spline through as many places as it takes, and the distance of these in pixels.

    It is tried between its nodes; the map itself where that is not defined everywhere, or jumps.

    Parameters
    ----------
    asked : callable
        The map itself.
    shape : (int, int)
        Rows and columns of the grid.
    tolerance_px : float
        Between the spline and the map, pixels that the map leads to.
    """
    step = COARSEST_PX
    known = asked(*axes(shape, step))
    while np.isfinite(known).all() and step > FINEST_PX:
        spline = _spline(known, shape, step)
        finer = asked(*axes(shape, step // 2))
        gap = np.abs(spline(*axes(shape, step // 2)) - finer)
        step, known = step // 2, finer
        if np.nanmax(gap) <= tolerance_px:
            return _spline(known, shape, step), step
    return asked, COARSEST_PX


def by_polynomial(asked: Values, shape: tuple[int, int], tolerance_px: float) -> Values:
    """A polynomial of both axes through a few places; the map itself where that does not fit.

    Parameters
    ----------
    asked, shape, tolerance_px
        As for `interpolated`.
    """
    from numpy.polynomial.chebyshev import chebpts1, chebvander

    height, width = shape
    nodes, tried = (chebpts1(_DEGREE + n) for n in (1, 2))

    def pixels(places: FloatArray, size: int) -> FloatArray:
        return np.asarray((places + 1) * size / 2)

    known = asked(pixels(nodes, height), pixels(nodes, width))
    through = np.linalg.inv(chebvander(nodes, _DEGREE))
    terms = np.einsum("ij,jkc,lk->ilc", through, known, through)

    def values(y: FloatArray, x: FloatArray) -> FloatArray:
        down, across = (
            chebvander(2 * at / size - 1, _DEGREE) for at, size in ((y, height), (x, width))
        )
        return np.stack([down @ terms[:, :, axis] @ across.T for axis in (0, 1)], axis=-1)

    places = pixels(tried, height), pixels(tried, width)
    gap = np.abs(values(*places) - asked(*places))
    return values if np.isfinite(gap).all() and gap.max() <= tolerance_px else asked


def axes(shape: tuple[int, int], step: int) -> tuple[FloatArray, FloatArray]:
    """Rows and columns of nodes over a grid, with the margin."""
    rows, columns = (
        step * np.arange(-MARGIN, -(-size // step) + MARGIN + 1, dtype=np.float64) for size in shape
    )
    return rows, columns


def _spline(known: FloatArray, shape: tuple[int, int], step: int) -> Values:
    from scipy.interpolate import RectBivariateSpline

    rows, columns = axes(shape, step)
    across, down = (RectBivariateSpline(rows, columns, known[:, :, axis]) for axis in (0, 1))
    low, high = (rows[0], columns[0]), (rows[-1], columns[-1])

    def values(y: FloatArray, x: FloatArray) -> FloatArray:
        y, x = np.clip(y, low[0], high[0]), np.clip(x, low[1], high[1])
        return np.stack([across(y, x), down(y, x)], axis=-1)

    return values
