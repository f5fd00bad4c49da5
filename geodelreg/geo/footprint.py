"""Where two rasters overlap, by their headers, as windows of each."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine

from geodelreg.geo.affine import apply_affine
from geodelreg.values.raster import BoolArray, FloatArray, Grid, Window

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

MapPoints = Callable[[FloatArray, str, str], FloatArray]
"""(..., 2) map coordinates, WKT of their CRS, WKT wanted → (..., 2), NaN where undefined."""

_STEPS_PER_EDGE = 64
_LATTICE_STEPS = 128
_ROUND_TRIP_PX = 0.5
# a step along a mapped edge that is so much longer than usual crosses the antimeridian or a pole
_JUMP = 8.0


def footprint_in(moving: Grid, fixed: Grid, map_points: MapPoints) -> BaseGeometry | None:
    """Footprint of one raster in the pixels of another.

    Edges are densified, because they are curved where the CRSs differ.

    Parameters
    ----------
    moving, fixed : Grid
    map_points : callable
        As `geodelreg.geo.crs.map_points`.

    Returns
    -------
    shapely polygon or None
        In outer-corner pixels of `fixed`; None when the outline cannot be followed there: parts
        of it have no image, or it is torn at the antimeridian or a pole.
    """
    from shapely import Polygon

    height, width = moving.shape
    along = np.linspace(0.0, 1.0, _STEPS_PER_EDGE, endpoint=False)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], dtype=np.float64)
    edges = corners[:-1, None] + along[None, :, None] * np.diff(corners, axis=0)[:, None]
    ring = edges.reshape(-1, 2)
    mapped = _map_pixels(ring, moving, fixed, map_points)
    if not _round_trips(ring, mapped, moving, fixed, map_points).all():
        return None
    steps = np.hypot(*np.diff(np.vstack([mapped, mapped[:1]]), axis=0).T).reshape(4, -1)
    if (steps.max(axis=1) > _JUMP * np.median(steps, axis=1) + 1e-6 * steps.sum()).any():
        return None
    polygon = Polygon(mapped)
    return polygon if polygon.is_valid else None


def overlap_windows(
    source: Grid, reference: Grid, grow_px: float, map_points: MapPoints
) -> tuple[Window, Window] | None:
    """Windows of both rasters that cover all that can overlap.

    Parameters
    ----------
    source, reference : Grid
        In any CRSs, rotated and south-up ones included.
    grow_px : float
        How far off, in reference pixels, the headers may be.
    map_points : callable
        As `geodelreg.geo.crs.map_points`.

    Returns
    -------
    tuple of Window or None
        Of the source: the part that is at most `grow_px` away from the reference.  Of the
        reference: the part that is at most `grow_px` away from that.  None when there is none.
    """
    from shapely import box

    parts = _shared_part(source, reference, grow_px, map_points)
    if parts is None:
        return _lattice_windows(source, reference, grow_px, map_points)
    in_source, in_reference = parts
    # grown along both axes, as `in_source` is: a round buffer would miss what touches at a corner
    near = in_reference
    if grow_px > 0 and not in_reference.is_empty:
        left, top, right, bottom = in_reference.bounds
        near = box(left - grow_px, top - grow_px, right + grow_px, bottom + grow_px)
    windows = (
        _bounding_window(in_source.intersection(box(0, 0, *source.shape[::-1])), source.shape),
        _bounding_window(near.intersection(box(0, 0, *reference.shape[::-1])), reference.shape),
    )
    return None if windows[0] is None or windows[1] is None else (windows[0], windows[1])


def _shared_part(
    source: Grid, reference: Grid, grow_px: float, map_points: MapPoints
) -> tuple[BaseGeometry, BaseGeometry] | None:
    """The part of the source near the reference, in source and in reference pixels.

    It is found in the pixels of the raster in which the other's outline can be followed (a world
    map has no outline in a UTM zone, but the zone's raster has one on the world map).
    """
    from shapely import box

    height, width = reference.shape
    outline = footprint_in(source, reference, map_points)
    if outline is not None:
        frame = box(-grow_px, -grow_px, width + grow_px, height + grow_px)
        part = outline.intersection(frame)
        back = _mapped(part, reference, source, map_points)
        return None if back is None else (back, part)
    grown = Grid(
        reference.transform @ Affine.translation(-grow_px, -grow_px),
        (math.ceil(height + 2 * grow_px), math.ceil(width + 2 * grow_px)),
        reference.crs_wkt,
    )
    outline = footprint_in(grown, source, map_points)
    if outline is None:
        return None
    part = outline.intersection(box(0, 0, *source.shape[::-1]))
    back = _mapped(part, source, reference, map_points)
    return None if back is None else (part, back)


def _mapped(
    geometry: BaseGeometry, start: Grid, end: Grid, map_points: MapPoints
) -> BaseGeometry | None:
    """`geometry` in pixels of another raster; None when a part of it has no image there."""
    from shapely import segmentize, transform

    if geometry.is_empty:
        return geometry
    longest = max(geometry.bounds[2] - geometry.bounds[0], geometry.bounds[3] - geometry.bounds[1])
    dense = segmentize(geometry, max(longest / _STEPS_PER_EDGE, 1e-3))
    mapped = transform(dense, lambda xy: _map_pixels(xy, start, end, map_points))
    if not np.isfinite(mapped.bounds).all():
        return None
    return mapped if mapped.is_valid else mapped.buffer(0)


def _bounding_window(geometry: BaseGeometry, shape: tuple[int, int]) -> Window | None:
    """Whole pixels around a geometry, one more on each side, inside the raster."""
    if geometry.is_empty or geometry.area <= 0:
        return None
    left, top, right, bottom = geometry.bounds
    return _window_between((left, top), (right, bottom), 1.0, shape)


def _window_between(
    low: tuple[float, float], high: tuple[float, float], margin_px: float, shape: tuple[int, int]
) -> Window:
    height, width = shape
    left = min(max(math.floor(low[0] - margin_px), 0), width - 1)
    top = min(max(math.floor(low[1] - margin_px), 0), height - 1)
    right = max(min(math.ceil(high[0] + margin_px), width), left + 1)
    bottom = max(min(math.ceil(high[1] + margin_px), height), top + 1)
    return Window(left, top, right - left, bottom - top)


def _lattice_windows(
    source: Grid, reference: Grid, grow_px: float, map_points: MapPoints
) -> tuple[Window, Window] | None:
    """`overlap_windows` of rasters so large that neither outline can be followed."""
    there = _lattice_near(source, reference, grow_px, map_points)
    back = _lattice_near(reference, source, 0.0, map_points)
    if len(there[0]) + len(back[0]) == 0:
        return None
    in_source, in_reference = np.vstack([there[0], back[1]]), np.vstack([there[1], back[0]])
    return (
        _window_between(*_extremes(in_source), 1.0, source.shape),
        _window_between(*_extremes(in_reference), grow_px + 1.0, reference.shape),
    )


def _extremes(points: FloatArray) -> tuple[tuple[float, float], tuple[float, float]]:
    low, high = points.min(axis=0), points.max(axis=0)
    return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))


def _lattice_near(
    moving: Grid, fixed: Grid, grow_px: float, map_points: MapPoints
) -> tuple[FloatArray, FloatArray]:
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
    mapped = _map_pixels(nodes, moving, fixed, map_points)
    limit = np.array([fixed.shape[1], fixed.shape[0]]) + grow_px
    with np.errstate(invalid="ignore"):
        near = ((mapped >= -grow_px) & (mapped <= limit)).all(axis=1)
    near &= _round_trips(nodes, mapped, moving, fixed, map_points)
    return np.vstack([nodes[near] - step, nodes[near] + step]), mapped[near]


def _map_pixels(px: FloatArray, start: Grid, end: Grid, map_points: MapPoints) -> FloatArray:
    ground = map_points(apply_affine(start.transform, px), start.crs_wkt, end.crs_wkt)
    return apply_affine(~end.transform, ground)


def _round_trips(
    px: FloatArray, mapped: FloatArray, start: Grid, end: Grid, map_points: MapPoints
) -> BoolArray:
    """Where mapping back returns to `px`: far outside its zone a projection is finite but wrong."""
    back = _map_pixels(mapped, end, start, map_points)
    with np.errstate(invalid="ignore"):
        close = np.abs(back - px).max(axis=-1) <= _ROUND_TRIP_PX
    return np.asarray(close, dtype=np.bool_)
