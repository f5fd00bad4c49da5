"""Mismatches found on the Delaunay mesh, and inliers won back by it.

The mesh of the source points is carried to their reference positions.  Around right matches it
keeps its orientation and the displacements vary smoothly; a mismatch folds triangles or disagrees
with its star.  Such points go, worst first, the rest is triangulated anew, and in the end rejected
points that agree with the mesh of the survivors come back (Zhao et al. 2015, GRSL 12(4), 711–715,
recover them through the Voronoi dual).  Unlike a global model this stands smooth distortion, but it
needs a majority of right matches around each point: a loose global consensus therefore comes first.
"""

from __future__ import annotations

import numpy as np

from geodelreg.fit.chance import log_nfa
from geodelreg.fit.consensus import Consensus, radial_residuals
from geodelreg.fit.neighbourhood import Field, Prediction, predict
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.triangulation import delaunay, edges, own_stars, stars_of, twice_area
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Status
from geodelreg.values.raster import BoolArray, FloatArray, IntArray, StatusArray

_MEDIAN = 2 * np.log(2)  # of squared distances over variances, in the plane
_LIMIT = 4.0  # standard deviations, as observed on the mesh, that a point may be off its star
_MAX_STRAIN = 0.02  # sd of the gradient of local distortion, px per px; by hand: ½ to 2 × alike
_MIN_SPREAD = 0.5  # the observed spread is believed down to this share of the stated sigmas
_SIGMA_PX = 0.3  # of a match, per axis, where no covariance is given; by hand: ½ to 2 × alike
_SURE = 16.0  # times a match's own variance; by hand: ½ to 2 × alike
_WORTHWHILE_GROWTH = 1.01  # one percent more points
_MAX_FLIPPED_SHARE = 0.5
_MAX_ROUNDS = 20  # it ends sooner; this is a bound
_ROBUST_FIT_ROUNDS = 12  # by hand: ½ to 2 × alike
_MIN_POINTS = 4
_LEAST_GAP_PX = 1e-3  # so that no point weighs without bound
_MIN_SIGMA_PX = 1e-4  # below what any image tells


def filter_matches(
    source_xy: FloatArray, reference_xy: FloatArray, found: Consensus
) -> StatusArray:
    """Keep the right ones of many matches, which a loose global consensus has thinned.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        One-to-one matches, outer-corner pixels of either image.
    found : Consensus
        Of these matches, at a tolerance for noise and distortion together.

    Returns
    -------
    (M,) uint8
        `Status.KEPT`, `Status.CONSENSUS` or `Status.STAR`; nothing is kept when the consensus
        could as well be chance.
    """
    status = np.full(len(source_xy), Status.CONSENSUS, dtype=np.uint8)
    if found.map is None or not found.inliers.any():
        return status
    residual = radial_residuals(found.map, source_xy, reference_xy)
    if not log_nfa(residual, _area(reference_xy), 3)[0] < 0:
        return status
    variance = np.full(len(source_xy), _SIGMA_PX**2)
    field = _field(source_xy, reference_xy, variance, found.map)
    status[found.inliers] = Status.STAR
    status[_agreeing(field, found.inliers)] = Status.KEPT
    return status


def star_filter(
    source_xy: FloatArray,
    reference_xy: FloatArray,
    covariance_px2: FloatArray | None = None,
) -> BoolArray:
    """Keep the matches that agree with the mesh around them; for up to one half of mismatches.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        Outer-corner pixels of either image.
    covariance_px2 : (M, 2, 2) float64, optional
        Of the reference positions; the mean of the two variances counts.

    Returns
    -------
    (M,) bool
        All True when there are fewer than four points: nothing can be told then.
    """
    count = len(source_xy)
    if count < _MIN_POINTS:
        return np.ones(count, dtype=np.bool_)
    if covariance_px2 is None:
        variance = np.full(count, _SIGMA_PX**2)
    else:
        trace = covariance_px2[:, 0, 0] + covariance_px2[:, 1, 1]
        variance = np.maximum(trace / 2, _MIN_SIGMA_PX**2)
    start = unfolded(source_xy, reference_xy)
    if start.sum() < _MIN_POINTS:
        return start
    common = _robust_affine(source_xy[start], reference_xy[start])
    return _agreeing(_field(source_xy, reference_xy, variance, common), start)


def unfolded(source_xy: FloatArray, reference_xy: FloatArray) -> BoolArray:
    """Keep the points around which the mesh of the source does not fold over in the reference.

    Points most of whose triangles flip go, and the rest is triangulated anew, until none do.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64

    Returns
    -------
    (M,) bool
    """
    keep = np.ones(len(source_xy), dtype=np.bool_)
    for _ in range(_MAX_ROUNDS):
        kept = np.flatnonzero(keep)
        triangles = delaunay(source_xy[kept])
        flipped = twice_area(reference_xy[kept], triangles) <= 0
        corners = triangles.reshape(-1)
        around = np.maximum(np.bincount(corners, minlength=len(kept)), 1)
        share = np.bincount(corners, np.repeat(flipped, 3), len(kept)) / around
        if not (share > _MAX_FLIPPED_SHARE).any():
            break
        keep[kept[share > _MAX_FLIPPED_SHARE]] = False
    return keep


def _agreeing(field: Field, start: BoolArray) -> BoolArray:
    """(M,) bool: drop what disagrees with its star, then take back what agrees with the rest.

    Taking back goes on from near to far as long as that is worth while, each time followed by
    another look at the new mesh.
    """
    keep, spread = _pruned(field, start)
    for _ in range(_MAX_ROUNDS):
        grown = _recovered(field, keep, spread)
        before = keep
        if (grown == before).all():
            break
        keep, spread = _pruned(field, grown)
        if keep.sum() <= _WORTHWHILE_GROWTH * before.sum():
            break
    return keep


def _pruned(field: Field, keep: BoolArray) -> tuple[BoolArray, float]:
    """Drop the points that disagree with their star, worst first; also the last usual misfit."""
    keep, spread = keep.copy(), 1.0
    for _ in range(_MAX_ROUNDS):
        kept = np.flatnonzero(keep)
        if len(kept) < _MIN_POINTS:
            break
        mesh = field.at(kept)
        triangles = delaunay(mesh.xy)
        told = predict(mesh.xy, own_stars(triangles, len(kept)), mesh, _MAX_STRAIN)
        spread = max(_usual_misfit(mesh, told), _MIN_SPREAD)
        misfit = _misfit(mesh, told, spread)
        worst = _locally_worst(misfit, misfit > _LIMIT, triangles)
        if not worst.any():
            break
        keep[kept[worst]] = False
    return keep, spread


def _recovered(field: Field, keep: BoolArray, spread: float) -> BoolArray:
    """Take back the rejected points that agree with the mesh of the kept ones around them."""
    keep = keep.copy()
    kept, rest = np.flatnonzero(keep), np.flatnonzero(~keep)
    if len(kept) < _MIN_POINTS or len(rest) == 0:
        return keep
    mesh, candidates = field.at(kept), field.at(rest)
    star = stars_of(candidates.xy, mesh.xy, own_stars(delaunay(mesh.xy), len(kept)))
    told = predict(candidates.xy, star, mesh, _MAX_STRAIN)
    sure = told.variance < _SURE * candidates.variance
    keep[rest[sure & (_misfit(candidates, told, spread) <= _LIMIT)]] = True
    return keep


def _usual_misfit(field: Field, told: Prediction) -> float:
    """Median difference from the star over what the variances say: 1 when they are right."""
    gap = field.displacement - told.displacement
    squared = (gap * gap).sum(axis=1) / (field.variance + told.variance)
    return float(np.sqrt(np.median(squared) / _MEDIAN))


def _misfit(field: Field, told: Prediction, spread: float) -> FloatArray:
    """Difference of each point from its star, in standard deviations as they are observed.

    `spread` is the usual misfit on the whole mesh; where the star itself scatters more around its
    plane (curved distortion), that counts too.
    """
    gap = field.displacement - told.displacement
    variance = spread**2 * (field.variance + told.variance)
    variance += np.maximum(told.scatter - spread**2, 0.0) * field.variance
    return np.asarray(np.hypot(gap[:, 0], gap[:, 1]) / np.sqrt(variance))


def _locally_worst(badness: FloatArray, bad: BoolArray, triangles: IntArray) -> BoolArray:
    """True for the bad points unless a neighbour on the mesh is twice as bad."""
    edge = edges(triangles)
    first, second = np.concatenate([edge, edge[:, ::-1]]).T
    worst = bad.copy()
    exceeded = bad[first] & (badness[second] > 2 * badness[first])
    worst[first[exceeded]] = False
    return worst


def _field(
    source_xy: FloatArray, reference_xy: FloatArray, variance: FloatArray, common: PixelMap
) -> Field:
    """What is left of the displacements when one affine is taken off."""
    return Field(source_xy, reference_xy - common.forward(source_xy), variance)


def _robust_affine(source_xy: FloatArray, reference_xy: FloatArray) -> AffineMap:
    """Affine of least absolute residuals, by reweighting."""
    weight = np.ones(len(source_xy))
    basis = np.column_stack([source_xy - source_xy.mean(axis=0), np.ones(len(source_xy))])
    for _ in range(_ROBUST_FIT_ROUNDS):
        normal = np.einsum("mi,m,mj->ij", basis, weight, basis)
        right = np.einsum("mi,m,mc->ic", basis, weight, reference_xy)
        coefficients = np.linalg.lstsq(normal, right, rcond=None)[0]
        gap = reference_xy - basis @ coefficients
        weight = 1.0 / np.maximum(np.hypot(gap[:, 0], gap[:, 1]), _LEAST_GAP_PX)
    linear = coefficients[:2].T
    offset = coefficients[2] - linear @ source_xy.mean(axis=0)
    return AffineMap.of(np.column_stack([linear, offset]))


def _area(xy: FloatArray) -> float:
    """Area of the box around the points."""
    return float(np.prod(np.maximum(np.ptp(xy, axis=0), 1.0)))
