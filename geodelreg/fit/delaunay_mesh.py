"""Mismatches found on the Delaunay mesh, and inliers won back by it.

The mesh of the source points is carried to their reference positions.  Around right matches it
keeps its orientation and the displacements vary smoothly; a mismatch folds triangles or disagrees
with its star.  Such points go, worst first, the rest is triangulated anew, and in the end rejected
points that agree with the mesh of the survivors come back (Zhao et al. 2015, GRSL 12(4), 711–715,
recover them through the Voronoi dual).  Unlike a global model this stands smooth distortion, but it
needs a majority of right matches around each point: `filter_matches` therefore puts a loose global
consensus first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geodelreg.fit.chance import log_nfa
from geodelreg.fit.consensus import Consensus, consensus_affine, fit_plainly, radial_residuals
from geodelreg.fit.neighbourhood import Field, Prediction, own_stars, predict, stars_of
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.triangulation import delaunay, edges, twice_area
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Status
from geodelreg.values.raster import BoolArray, FloatArray, IntArray

_MEDIAN = 2 * np.log(2)  # of squared distances over variances, in the plane
_SURE = 16.0  # times a match's own variance; unexplained: ablate
_WORTHWHILE_GROWTH = 1.01  # one percent more points
_MAX_FLIPPED_SHARE = 0.5
_MAX_ROUNDS = 20  # it ends sooner; this is a bound
_ROBUST_FIT_ROUNDS = 12  # unexplained: ablate
_MIN_POINTS = 4
_LEAST_GAP_PX = 1e-3  # so that no point weighs without bound
_MIN_SIGMA_PX = 1e-4  # below what any image tells


@dataclass(frozen=True, slots=True)
class FilterOptions:
    """Tolerances of the filters.

    Attributes
    ----------
    limit : float
        A point disagrees with its star when they differ by more than this many standard
        deviations, as they are observed on the whole mesh.
    max_strain : float
        Standard deviation of the gradient of local distortion, px per px: how far from one affine
        the images may be locally.
    min_spread : float
        The observed spread is believed down to this share of the stated standard deviations.
    sigma_px : float
        Standard deviation of a match, in reference pixels per axis, where no covariance is given.
    consensus_px : float
        Tolerance of the global consensus, in reference pixels: noise and distortion together.
    seed : int
        Of the sampling in the global consensus.
    """

    limit: float = 4.0
    max_strain: float = 0.02
    min_spread: float = 0.5
    sigma_px: float = 0.3
    consensus_px: float = 8.0
    seed: int = 0


class Filtered(NamedTuple):
    """Outcome of `filter_matches`.

    Attributes
    ----------
    status : (M,) uint8
        `Status.KEPT`, `Status.CONSENSUS` or `Status.STAR`.
    map : AffineMap or None
        Least-squares affine of the kept matches, source to reference; None when none are kept.
    log10_nfa : float
        Number of false alarms of the global consensus (`log_nfa`).
    """

    status: NDArray[np.uint8]
    map: AffineMap | None
    log10_nfa: float


def filter_matches(
    source_xy: FloatArray,
    reference_xy: FloatArray,
    ratio: FloatArray,
    options: FilterOptions | None = None,
    found: Consensus | None = None,
) -> Filtered:
    """Keep the right ones of many matches: loose global consensus, then the Delaunay mesh.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        One-to-one matches, outer-corner pixels of either image.
    ratio : (M,) float64
        Descriptor distance ratio; smaller is better.
    options : FilterOptions, optional
    found : Consensus, optional
        A consensus of these matches, at about ``options.consensus_px``, when there is one already
        (`consensus_keypoints` stands more contamination); otherwise `consensus_affine` finds it.

    Returns
    -------
    Filtered
        Nothing is kept when the consensus could as well be chance.
    """
    options = options or FilterOptions()
    status = np.full(len(ratio), Status.CONSENSUS, dtype=np.uint8)
    if found is None:
        found = consensus_affine(source_xy, reference_xy, ratio, options.consensus_px, options.seed)
    alarms = np.inf
    if found.map is not None and found.inliers.any():
        residual = radial_residuals(found.map, source_xy, reference_xy)
        alarms, _ = log_nfa(residual, _area(reference_xy), 3)
    if found.map is None or not alarms < 0:
        return Filtered(status, None, float(alarms))
    variance = np.full(len(ratio), options.sigma_px**2)
    field = _field(source_xy, reference_xy, variance, found.map)
    keep = _agreeing(field, found.inliers, options)
    status[found.inliers] = Status.STAR
    status[keep] = Status.KEPT
    return Filtered(status, _final(source_xy, reference_xy, keep), float(alarms))


def star_filter(
    source_xy: FloatArray,
    reference_xy: FloatArray,
    covariance_px2: FloatArray | None = None,
    options: FilterOptions | None = None,
) -> BoolArray:
    """Keep the matches that agree with the mesh around them; for up to one half of mismatches.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        Outer-corner pixels of either image.
    covariance_px2 : (M, 2, 2) float64, optional
        Of the reference positions; the mean of the two variances counts.
    options : FilterOptions, optional

    Returns
    -------
    (M,) bool
        All True when there are fewer than four points: nothing can be told then.
    """
    options = options or FilterOptions()
    count = len(source_xy)
    if count < _MIN_POINTS:
        return np.ones(count, dtype=np.bool_)
    if covariance_px2 is None:
        variance = np.full(count, options.sigma_px**2)
    else:
        trace = covariance_px2[:, 0, 0] + covariance_px2[:, 1, 1]
        variance = np.maximum(trace / 2, _MIN_SIGMA_PX**2)
    start = unfolded(source_xy, reference_xy)
    if start.sum() < _MIN_POINTS:
        return start
    common = _robust_affine(source_xy[start], reference_xy[start])
    return _agreeing(_field(source_xy, reference_xy, variance, common), start, options)


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


def _agreeing(field: Field, start: BoolArray, options: FilterOptions) -> BoolArray:
    """(M,) bool: drop what disagrees with its star, then take back what agrees with the rest.

    Taking back goes on from near to far as long as that is worth while, each time followed by
    another look at the new mesh.
    """
    keep, spread = _pruned(field, start, options)
    for _ in range(_MAX_ROUNDS):
        grown = _recovered(field, keep, spread, options)
        before = keep
        if (grown == before).all():
            break
        keep, spread = _pruned(field, grown, options)
        if keep.sum() <= _WORTHWHILE_GROWTH * before.sum():
            break
    return keep


def _pruned(field: Field, keep: BoolArray, options: FilterOptions) -> tuple[BoolArray, float]:
    """Drop the points that disagree with their star, worst first; also the last usual misfit."""
    keep, spread = keep.copy(), 1.0
    for _ in range(_MAX_ROUNDS):
        kept = np.flatnonzero(keep)
        if len(kept) < _MIN_POINTS:
            break
        mesh = field.at(kept)
        triangles = delaunay(mesh.xy)
        told = predict(mesh.xy, own_stars(triangles, len(kept)), mesh, options.max_strain)
        spread = max(_usual_misfit(mesh, told), options.min_spread)
        misfit = _misfit(mesh, told, spread)
        worst = _locally_worst(misfit, misfit > options.limit, triangles)
        if not worst.any():
            break
        keep[kept[worst]] = False
    return keep, spread


def _recovered(field: Field, keep: BoolArray, spread: float, options: FilterOptions) -> BoolArray:
    """Take back the rejected points that agree with the mesh of the kept ones around them."""
    keep = keep.copy()
    kept, rest = np.flatnonzero(keep), np.flatnonzero(~keep)
    if len(kept) < _MIN_POINTS or len(rest) == 0:
        return keep
    mesh, candidates = field.at(kept), field.at(rest)
    star = stars_of(candidates.xy, mesh.xy, own_stars(delaunay(mesh.xy), len(kept)))
    told = predict(candidates.xy, star, mesh, options.max_strain)
    sure = told.variance < _SURE * candidates.variance
    keep[rest[sure & (_misfit(candidates, told, spread) <= options.limit)]] = True
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


def _final(source_xy: FloatArray, reference_xy: FloatArray, keep: BoolArray) -> AffineMap | None:
    if keep.sum() < 3:
        return None
    return fit_plainly(source_xy[keep], reference_xy[keep], "affine")


def _area(xy: FloatArray) -> float:
    """Area of the box around the points."""
    return float(np.prod(np.maximum(np.ptp(xy, axis=0), 1.0)))
