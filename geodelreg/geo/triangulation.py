"""Delaunay triangulation of points in the plane, and what the filters ask of it.

Triangles are (T, 3) intp arrays of point indices.  All measures are free of scale, so they hold for
pixels and for metres alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geodelreg.values.raster import FloatArray, IntArray

_FEW_POINTS = 12  # by hand: ½ to 2 × alike


class InteriorEdges(NamedTuple):
    """Edges between two triangles.

    Attributes
    ----------
    ends : (E, 2) intp
        Points of the edge, the smaller index first.
    opposite : (E, 2) intp
        Third points of the two triangles.
    """

    ends: IntArray
    opposite: IntArray


class Star(NamedTuple):
    """Pairs of a target and a point of the field near it, in order of the targets.

    Attributes
    ----------
    target, member : (K,) intp
    """

    target: IntArray
    member: IntArray


def delaunay(xy: FloatArray) -> IntArray:
    """Delaunay triangulation, by GEOS.

    Of points at one place only the first takes part; points that are not finite do not.

    Parameters
    ----------
    xy : (N, 2) float64

    Returns
    -------
    (T, 3) intp
        Triangles of positive signed area (x to the right and y upwards: counter-clockwise), each
        beginning with its smallest index, in ascending order.  Empty when there are fewer than
        three places or all lie on one line.
    """
    from shapely import MultiPoint, delaunay_triangles, get_coordinates

    places, first = _distinct_places(xy)
    if len(places) < 3:
        return np.empty((0, 3), dtype=np.intp)
    rings = get_coordinates(delaunay_triangles(MultiPoint(places))).reshape(-1, 4, 2)
    corners = _as_complex(rings[:, :3].reshape(-1, 2))
    triangles = first[np.searchsorted(_as_complex(places), corners)].reshape(-1, 3)
    return _in_order(triangles[twice_area(xy, triangles) != 0], xy)


def _as_complex(xy: FloatArray) -> NDArray[np.complex128]:
    """One sortable number per point (numpy sorts complex numbers by their real part first)."""
    return np.ascontiguousarray(xy, dtype=np.float64).view(np.complex128).reshape(-1)


def _distinct_places(xy: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distinct finite places in ascending order, and the first point at each."""
    usable = np.flatnonzero(np.isfinite(xy).all(axis=1))
    values, first = np.unique(_as_complex(xy[usable] + 0.0), return_index=True)
    return values.view(np.float64).reshape(-1, 2), usable[first]


def _in_order(triangles: IntArray, xy: FloatArray) -> IntArray:
    turned = triangles.copy()
    clockwise = twice_area(xy, triangles) < 0
    turned[clockwise, 1], turned[clockwise, 2] = triangles[clockwise, 2], triangles[clockwise, 1]
    lead = turned.argmin(axis=1)[:, None]
    turned = np.take_along_axis(turned, (lead + np.arange(3)) % 3, axis=1)
    return np.asarray(turned[np.lexsort(turned.T[::-1])], dtype=np.intp)


def twice_area(xy: FloatArray, triangles: IntArray) -> FloatArray:
    """(T,) float64, twice the signed area; positive for triangles from `delaunay`."""
    a, b, c = (xy[triangles[:, k]] for k in range(3))
    return _cross(b - a, c - a)


def _cross(u: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def edges(triangles: IntArray) -> IntArray:
    """(E, 2) intp, every edge once: smaller index first, in ascending order."""
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = ends.min(axis=1), ends.max(axis=1)
    count = int(high.max()) + 1 if len(high) else 1
    return np.stack(np.divmod(distinct(low * count + high), count), axis=1)


def distinct(keys: IntArray) -> IntArray:
    """Each value once, ascending; faster than `numpy.unique` on the few thousand here."""
    ordered = np.sort(keys)
    new = np.ones(len(ordered), dtype=np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    return ordered[new]


def interior_edges(triangles: IntArray) -> InteriorEdges:
    """Edges that two triangles share."""
    ends = np.sort(triangles[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = np.flatnonzero((ends[order[1:]] == ends[order[:-1]]).all(axis=1))
    sides = np.stack([order[same], order[same + 1]], axis=1)
    return InteriorEdges(ends[sides[:, 0]], triangles.reshape(-1)[sides])


def own_stars(triangles: IntArray, count: int) -> Star:
    """Star of every point of a mesh, without the point itself.

    Parameters
    ----------
    triangles : (T, 3) intp
    count : int
        Number of points.  A dozen or fewer are all in each other's star, as are points without
        any triangle.
    """
    if count <= _FEW_POINTS or len(triangles) == 0:
        target, member = np.nonzero(~np.eye(count, dtype=np.bool_))
        return Star(target, member)
    edge = edges(triangles)
    first = np.sort(np.concatenate([edge, edge[:, ::-1]]) @ np.array([count, 1]))
    owner, near = np.divmod(first, count)
    degree = np.bincount(owner, minlength=count)
    reach = degree[near]
    through = np.repeat((np.cumsum(degree) - degree)[near], reach) + running(reach)
    keys = distinct(np.concatenate([first, np.repeat(owner, reach) * count + near[through]]))
    target, member = np.divmod(keys, count)
    other = target != member
    return Star(target[other], member[other])


def stars_of(targets: FloatArray, xy: FloatArray, own: Star) -> Star:
    """For each target, the nearest point of the mesh and that point's star.

    Parameters
    ----------
    targets : (T, 2) float64
    xy : (N, 2) float64
        At least one point.
    own : Star
        `own_stars` of these points.
    """
    from shapely import STRtree, points

    nearest = STRtree(np.asarray(points(xy))).nearest(np.asarray(points(targets)))
    start = np.searchsorted(own.target, np.arange(len(xy) + 1))
    size = np.diff(start)[nearest]
    number = np.arange(len(targets))
    target = np.concatenate([number, np.repeat(number, size)])
    around = own.member[np.repeat(start[nearest], size) + running(size)]
    order = np.argsort(target, kind="stable")
    return Star(target[order], np.concatenate([nearest, around])[order])


def running(sizes: IntArray) -> IntArray:
    """0, 1, ... for each of consecutive groups of the given sizes."""
    return np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)


def relative_altitude(xy: FloatArray, triangles: IntArray) -> FloatArray:
    """Smallest altitude over longest edge: 0 for collinear corners, √3/2 for equilateral ones.

    Parameters
    ----------
    xy : (N, 2) float64
    triangles : (T, 3) intp

    Returns
    -------
    (T,) float64
    """
    corners = xy[triangles]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = (sides * sides).sum(axis=2).max(axis=1)
    altitude = np.zeros(len(longest))
    np.divide(np.abs(twice_area(xy, triangles)), longest, out=altitude, where=longest > 0)
    return altitude


def incircle_sine(xy: FloatArray, interior: InteriorEdges) -> FloatArray:
    """In-circle determinant of the four corners around each edge, over the quad's four sides.

    That quotient is the sine of the sum of the two angles opposite the edge.  Four points on one
    circle make it 0 and make the Delaunay triangulation ambiguous there.  Where that sum is below
    90° the circles are far apart and 1 is returned.

    Parameters
    ----------
    xy : (N, 2) float64
    interior : InteriorEdges
        Of a Delaunay triangulation.

    Returns
    -------
    (E,) float64
        From 0 (cocircular) to 1; rounding may make it slightly negative.
    """
    a, b = xy[interior.ends[:, 0]], xy[interior.ends[:, 1]]
    sine, cosine = np.zeros(len(a)), np.ones(len(a))
    for k in (0, 1):
        apex = xy[interior.opposite[:, k]]
        u, v = a - apex, b - apex
        across, along = np.abs(_cross(u, v)), (u * v).sum(axis=1)
        length = np.hypot(across, along)
        across, along = across / length, along / length
        sine, cosine = sine * along + cosine * across, cosine * along - sine * across
    return np.where(cosine < 0, sine, 1.0)
