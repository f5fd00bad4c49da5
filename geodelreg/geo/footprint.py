"""Where two rasters overlap, by their headers, as windows of each."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine

from geodelreg.geo.crs import map_pixels
from geodelreg.geo.grid import outline, window_around
from geodelreg.values.raster import BoolArray, FloatArray, Grid, Window

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_STEPS_PER_EDGE = 64
_LATTICE_STEPS = 128
_ROUND_TRIP_PX = 0.5
# a step along a mapped edge that is so much longer than usual crosses the antimeridian or a pole
_JUMP = 8.0


def footprint_in(moving: Grid, fixed: Grid) -> BaseGeometry | None:
    """Footprint of one raster in the pixels of another.

    Edges are densified, because they are curved where the CRSs differ.

    Parameters
    ----------
    moving, fixed : Grid

    Returns
    -------
    shapely polygon or None
        In outer-corner pixels of `fixed`; None when the outline cannot be followed there: parts
        of it have no image, or it is torn at the antimeridian or a pole.
    """
    from shapely import Polygon

    ring = outline(moving, _STEPS_PER_EDGE)
    mapped = map_pixels(ring, moving, fixed)
    if not _round_trips(ring, mapped, moving, fixed).all():
        return None
    steps = np.hypot(*np.diff(np.vstack([mapped, mapped[:1]]), axis=0).T).reshape(4, -1)
    if (steps.max(axis=1) > _JUMP * np.median(steps, axis=1) + 1e-6 * steps.sum()).any():
        return None
    polygon = Polygon(mapped)
    return polygon if polygon.is_valid else None


def overlap_windows(source: Grid, reference: Grid, grow_px: float) -> tuple[Window, Window] | None:
    """Windows of both rasters that cover all that can overlap.

    Parameters
    ----------
    source, reference : Grid
        In any CRSs, rotated and south-up ones included.
    grow_px : float
        How far off, in reference pixels, the headers may be.

    Returns
    -------
    tuple of Window or None
        Of the source: the part that is at most `grow_px` away from the reference.  Of the
        reference: the part that is at most `grow_px` away from that.  None when there is none.
    """
    from shapely import box

    parts = _shared_part(source, reference, grow_px)
    if parts is None:
        return _lattice_windows(source, reference, grow_px)
    in_source, in_reference = parts
    # grown along both axes, as `in_source` is: a round buffer would miss what touches at a corner
    near = in_reference
    if grow_px > 0 and not in_reference.is_empty:
        left, top, right, bottom = in_reference.bounds
        near = box(left - grow_px, top - grow_px, right + grow_px, bottom + grow_px)
    return _both(
        _window_of(in_source.intersection(box(0, 0, *source.shape[::-1])), source),
        _window_of(near.intersection(box(0, 0, *reference.shape[::-1])), reference),
    )


def _shared_part(
    source: Grid, reference: Grid, grow_px: float
) -> tuple[BaseGeometry, BaseGeometry] | None:
    """The part of the source near the reference, in source and in reference pixels.

    It is found in the pixels of the raster in which the other's outline can be followed (a world
    map has no outline in a UTM zone, but the zone's raster has one on the world map).
    """
    from shapely import box

    height, width = reference.shape
    footprint = footprint_in(source, reference)
    if footprint is not None:
        frame = box(-grow_px, -grow_px, width + grow_px, height + grow_px)
        part = footprint.intersection(frame)
        back = _mapped(part, reference, source)
        return None if back is None else (back, part)
    grown = Grid(
        reference.transform @ Affine.translation(-grow_px, -grow_px),
        (math.ceil(height + 2 * grow_px), math.ceil(width + 2 * grow_px)),
        reference.crs_wkt,
    )
    footprint = footprint_in(grown, source)
    if footprint is None:
        return None
    part = footprint.intersection(box(0, 0, *source.shape[::-1]))
    back = _mapped(part, source, reference)
    return None if back is None else (part, back)


def _mapped(geometry: BaseGeometry, start: Grid, end: Grid) -> BaseGeometry | None:
    """`geometry` in pixels of another raster; None when a part of it has no image there."""
    from shapely import segmentize, transform

    if geometry.is_empty:
        return geometry
    longest = max(geometry.bounds[2] - geometry.bounds[0], geometry.bounds[3] - geometry.bounds[1])
    dense = segmentize(geometry, max(longest / _STEPS_PER_EDGE, 1e-3))
    mapped = transform(dense, lambda xy: map_pixels(xy, start, end))
    if not np.isfinite(mapped.bounds).all():
        return None
    return mapped if mapped.is_valid else mapped.buffer(0)


def _window_of(geometry: BaseGeometry, grid: Grid) -> Window | None:
    """Whole pixels around a part of a raster, one more on each side."""
    if geometry.is_empty or geometry.area <= 0:
        return None
    return window_around(np.reshape(geometry.bounds, (2, 2)), 1.0, grid)


def _both(one: Window | None, other: Window | None) -> tuple[Window, Window] | None:
    return None if one is None or other is None else (one, other)


def _lattice_windows(source: Grid, reference: Grid, grow_px: float) -> tuple[Window, Window] | None:
    """`overlap_windows` of rasters so large that neither outline can be followed."""
    there = _lattice_near(source, reference, grow_px)
    back = _lattice_near(reference, source, 0.0)
    if len(there[0]) + len(back[0]) == 0:
        return None
    in_source, in_reference = np.vstack([there[0], back[1]]), np.vstack([there[1], back[0]])
    return _both(
        window_around(in_source, 1.0, source), window_around(in_reference, grow_px + 1.0, reference)
    )


def _lattice_near(moving: Grid, fixed: Grid, grow_px: float) -> tuple[FloatArray, FloatArray]:
    """Cells of a lattice over `moving` with a node inside `fixed`, grown, and the nodes' images.

    Returns
    -------
    (2 N, 2) float64
        Upper-left and lower-right corners of the cells around each node, in pixels of `moving`.
    (N, 2) float64
        Images of the nodes, in pixels of `fixed`.
    """
    step = np.array([moving.shape[1], moving.shape[0]]) / _LATTICE_STEPS
    columns, rows = np.meshgrid(*[np.arange(_LATTICE_STEPS + 1.0)] * 2)
    nodes = np.stack([columns.ravel(), rows.ravel()], axis=1) * step
    mapped = map_pixels(nodes, moving, fixed)
    limit = np.array([fixed.shape[1], fixed.shape[0]]) + grow_px
    with np.errstate(invalid="ignore"):
        near = ((mapped >= -grow_px) & (mapped <= limit)).all(axis=1)
    near &= _round_trips(nodes, mapped, moving, fixed)
    return np.vstack([nodes[near] - step, nodes[near] + step]), mapped[near]


def _round_trips(px: FloatArray, mapped: FloatArray, start: Grid, end: Grid) -> BoolArray:
    """Where mapping back returns to `px`: far outside its zone a projection is finite but wrong."""
    back = map_pixels(mapped, end, start)
    with np.errstate(invalid="ignore"):
        close = np.abs(back - px).max(axis=-1) <= _ROUND_TRIP_PX
    return np.asarray(close, dtype=np.bool_)
