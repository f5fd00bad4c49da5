"""What moves together: the ground's smooth map, other motions, and what agrees with nothing.

Neighbouring patches of one smooth map differ by no more than its strain allows.  Edges of the
Delaunay triangulation that differ by more are cut; what stays connected is one layer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geodelreg.fit.chance import log10_binomial_tail
from geodelreg.fit.estimate import Observations
from geodelreg.fit.field import MOST_STRAIN
from geodelreg.geo.triangulation import edges, relative_altitude
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import BoolArray, FloatArray, IntArray

LEAST_SHARE = 0.05  # by hand: ½ to 2 × alike
TORN_SHARE = 0.02
"""The same of a part that a line cuts off, as no cloud is cut: 20 px off, it leaves 3 px RMS."""
LEAST_PATCHES = 4
"""That agree on another motion: less than one pair in a thousand has so many by chance, and a
raster of 40 patches has no more in a tenth of its area."""
_CHANCE = 1e-3
"""Expected false alarms a pair, the usual ε of a-contrario methods scaled to a thousand pairs."""
_SOLID = 0.9  # by hand: ½ to 2 × alike
_ROUNDING_PX = 1e-6  # by hand: ½ to 2 × alike
_ASTRIDE = 0.2  # of a part that is cut off: patches on the line are told as of either side
_DIRECTIONS = 16  # of a tear; those at a slant between two of them are cut off by most of a line
_CORE = 0.75
"""Share of its neighbours that a patch fits to, for it to join them to one layer (as in DBSCAN):
those astride a tear fit to both sides a little, and to neither well."""
_MEDIAN_GAP = math.sqrt(4.0 * math.log(2.0) / 2.0)
"""Median distance of two points of unit radial standard error (Rayleigh's distribution)."""
_NOISE_SIGMAS = 2.5  # by hand: ½ to 2 × alike
_SLIVER = 0.2
"""Altitude over longest side below which a triangle joins places along the hull, no neighbours."""


def layers(xy: FloatArray, move: FloatArray, sigma_px: FloatArray) -> IntArray:
    """Number of the layer of each patch, the largest being 0; -1 of a patch that fits to none.

    Parameters
    ----------
    xy : (N, 2) float64
        Where the patches are.
    move : (N, 2) float64
        Their displacements, in the same pixels.
    sigma_px : (N,) float64
        Radial standard errors of the displacements.

    Returns
    -------
    (N,) intp
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(xy)
    label = np.full(count, -1, dtype=np.intp)
    pairs = neighbours(xy)
    good = _smooth(xy, move, sigma_px, pairs)
    fits = np.bincount(pairs[good].ravel(), minlength=count)
    total = np.bincount(pairs.ravel(), minlength=count)
    core = (total > 0) & (fits >= _CORE * total)
    inner = good & core[pairs].all(axis=1)
    graph = coo_matrix(
        (np.ones(int(inner.sum())), (pairs[inner, 0], pairs[inner, 1])), shape=(count, count)
    )
    _, found = connected_components(graph, directed=False)
    size = np.bincount(found[core], minlength=int(found.max(initial=-1)) + 1)
    rank = np.empty(len(size), dtype=np.intp)
    rank[np.argsort(-size, kind="stable")] = np.arange(len(size))
    label[core] = rank[found[core]]
    # the others belong to the layer of most of the neighbours that they fit to
    number = max(int(label.max(initial=-1)) + 1, 1)
    votes = np.zeros((count, number), dtype=np.intp)
    one, other = np.concatenate([pairs[good], pairs[good][:, ::-1]]).T
    known = core[other] & ~core[one]
    np.add.at(votes, (one[known], label[other[known]]), 1)
    edge = ~core & (votes.max(axis=1) > 0)
    label[edge] = votes[edge].argmax(axis=1)
    return label


def largest_layer(points: Observations, correction: PixelMap) -> BoolArray:
    """(N,) True of the points that are one smooth ground, however far from where a map has them."""
    move = points.target - correction.forward(points.source)
    sigma = np.sqrt(points.variances.sum(axis=1))
    return np.asarray(layers(points.source, move, sigma) == 0)


def neighbours(xy: FloatArray) -> IntArray:
    """(E, 2) pairs of neighbours among (N, 2) points: edges of the Delaunay triangulation."""
    from scipy.spatial import Delaunay, QhullError

    if len(xy) < 4:
        return np.empty((0, 2), dtype=np.intp)
    try:
        triangle = Delaunay(xy, qhull_options="QJ Pp").simplices.astype(np.intp)
    except QhullError:
        return np.empty((0, 2), dtype=np.intp)
    return edges(triangle[relative_altitude(xy, triangle) > _SLIVER])


def _smooth(xy: FloatArray, move: FloatArray, sigma_px: FloatArray, pairs: IntArray) -> BoolArray:
    """(E,) True where two ends differ by no more than strain and noise allow."""
    one, other = pairs.T
    step = np.hypot(*(xy[one] - xy[other]).T)
    gap = np.hypot(*(move[one] - move[other]).T)
    common = float(np.median(gap)) / _MEDIAN_GAP if len(gap) else 0.0
    noise = np.hypot(np.maximum(sigma_px[one], common), np.maximum(sigma_px[other], common))
    return np.asarray(gap <= MOST_STRAIN * step + _NOISE_SIGMAS * noise)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Patches that agree on another displacement than the ground's.

    Attributes
    ----------
    member : (N,) bool
    move : (2,) float64
        Mean displacement of the members against the ground, in the pixels given.
    is_torn : bool
        A line cuts them off, and hardly anything else moves.
    """

    member: BoolArray
    move: FloatArray
    is_torn: bool = False


def second_motion(
    move: FloatArray, candidate: BoolArray, radius_px: float, reach_px: float
) -> Motion | None:
    """The largest group of patches that agree on one displacement, if chance makes no such group.

    A contrario: a patch that shows nothing of the other image is placed anywhere within reach,
    uniformly and by itself (Desolneux, Moisan & Morel 2008, chapter 3).

    Parameters
    ----------
    move : (N, 2) float64
        Displacement of the patches against the ground's map.
    candidate : (N,) bool
        Patches that the ground's map does not explain.
    radius_px : float
        Within which displacements agree.
    reach_px : float
        Radius of the search that found the displacements.

    Returns
    -------
    Motion or None
    """
    index = np.flatnonzero(candidate)
    if len(index) < 2:
        return None
    gap = np.hypot(*(move[index][:, None] - move[index][None]).transpose(2, 0, 1))
    near = gap <= radius_px
    best = int(near.sum(axis=1).argmax())
    centre = move[index][near[best]].mean(axis=0)
    inside = np.hypot(*(move[index] - centre).T) <= radius_px
    count, total = int(inside.sum()), len(index)
    share = min((radius_px / reach_px) ** 2, 1.0)
    # one of the members gave the place, so one less speaks for it
    log_nfa = math.log10(total) + log10_binomial_tail(count - 1, total - 1, share)
    if log_nfa > math.log10(_CHANCE):
        return None
    member = np.zeros(len(move), dtype=bool)
    member[index[inside]] = True
    return Motion(member, centre)


def is_solid(xy: FloatArray, member: BoolArray, ground: BoolArray) -> bool:
    """True when hardly any of the ground's patches lies among the members: they are one part.

    Parameters
    ----------
    xy : (N, 2) float64
        All patches that were placed.
    member, ground : (N,) bool
        What is neither is placed by chance, and says nothing.
    """
    from shapely import MultiPoint, contains_xy

    around = MultiPoint(xy[member]).convex_hull.buffer(_ROUNDING_PX)
    inside = contains_xy(around, xy[:, 0], xy[:, 1])
    return bool(member[inside].sum() >= _SOLID * (member | ground)[inside].sum())


def is_cut_off(xy: FloatArray, member: BoolArray, ground: BoolArray) -> bool:
    """True when a line has hardly any but the members on one side, and most of them there.

    Parameters
    ----------
    xy, member, ground
        As for `is_solid`.
    """
    angle = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    along = xy @ np.stack([np.cos(angle), np.sin(angle)])
    line = np.quantile(along[member], _ASTRIDE, axis=0)
    beyond = along >= line - _ROUNDING_PX
    members, all_placed = (beyond[who].sum(axis=0) for who in (member, member | ground))
    return bool((members >= _SOLID * all_placed).any())
