"""Control points that carry a map which no geotransform holds: as many as GDAL's spline needs."""

from __future__ import annotations

import numpy as np

from geodelreg.errors import LossyOutputError
from geodelreg.geo.affine import apply_affine
from geodelreg.product.gcps.context import gcps_at
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Gcp
from geodelreg.values.raster import FloatArray, Grid

AGREEMENT_PX = 0.02
"""Of a pixel, between the map and GDAL's thin plate spline through the control points."""
_COUNTS = (4, 6, 9, 13, 19, 27)
"""Control points along either axis; of more the spline takes minutes."""
_CHECKED = 41  # places along either axis: no multiple of any of these


def gcps_of_map(name: str, placement: PixelMap, grid: Grid) -> tuple[Gcp, ...]:
    """Fewest control points on a lattice through which GDAL's thin plate spline is the map.

    Parameters
    ----------
    name : str
        Of the raster, for messages.
    placement : PixelMap
        Pixels of the raster to those of its header.
    grid : Grid
        With that header.

    Raises
    ------
    LossyOutputError
        No number of them agrees to `AGREEMENT_PX`.
    """
    from rasterio.control import GroundControlPoint
    from rasterio.transform import GCPTransformer

    def ground(px: FloatArray) -> FloatArray:
        return apply_affine(grid.transform, placement.forward(px))

    checked = _lattice(grid, _CHECKED)
    true = ground(checked)
    to_px = ~grid.transform
    best = np.inf
    for count in _COUNTS:
        nodes = _lattice(grid, count)
        places = ground(nodes)
        points = [
            GroundControlPoint(row=row, col=column, x=x, y=y)
            for (column, row), (x, y) in zip(nodes.tolist(), places.tolist(), strict=True)
        ]
        with GCPTransformer(points, tps=True) as spline:
            found = np.stack(spline.xy(*checked.T[::-1], offset="ul"), axis=1)
            back = np.stack(spline.rowcol(*true.T, op=np.positive)[::-1], axis=1)
        there = apply_affine(to_px, found) - apply_affine(to_px, true)
        gap = np.concatenate([there, back - checked])  # GDAL fits a spline either way
        best = min(best, float(np.hypot(*gap.T).max()))
        if best <= AGREEMENT_PX:
            return gcps_at(nodes, places)
    raise LossyOutputError(
        f"{name}: a thin plate spline through control points is {best:.2g} px off the correction "
        f"at best, and may be {AGREEMENT_PX:g}",
        "Resample (`warp=True`): jumps and short waves are exact there.",
    )


def _lattice(grid: Grid, count: int) -> FloatArray:
    """(count², 2) pixels over a raster, its corners included."""
    height, width = grid.shape
    axes = np.linspace(0, width, count), np.linspace(0, height, count)
    return np.stack([v.ravel() for v in np.meshgrid(*axes)], axis=1)
