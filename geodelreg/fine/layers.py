"""What moves together: which pixels are the ground, and which are clouds, relief or other layers.

The rules of the search are here, in the order in which a pair meets them: bright objects, keypoints
of the dark areas, patches of one pass, the ground against everything, the mesh, and what speaks
against a correction in the end.  What all patches of a found correction say is `fine/ground.py`'s:
`fine/motions.py` cuts them into motions, `fine/clouds.py` says which of these are clouds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from geodelreg.fine.least_squares import MIN_CORRELATION, Matched
from geodelreg.fit.delaunay_mesh import star_filter
from geodelreg.fit.estimate import Estimate, Observations, minimum_points, robust_fit
from geodelreg.fit.models import Frame
from geodelreg.fit.rigid_core import rigid_core
from geodelreg.geo.maps.affine import IDENTITY, AffineMap
from geodelreg.pair import LATTICE, Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess, Status, TiePoints
from geodelreg.values.raster import Band, BoolArray, FloatArray, StatusArray

ELSEWHERE = (Status.CONSENSUS, Status.STAR, Status.RESIDUAL)
"""Patches that matched, but at another place than the correction says."""
MATCHED = (Status.KEPT, *ELSEWHERE)
LOCAL_RMS_PX = 0.3
"""Smooth distortion left by an affine that calls for a local warp, PAN pixels."""

_GREYS = 256  # bins of the histogram, as in an image of 8 bit
_RANGE_PERCENT = (0.5, 99.5)  # outliers in half a percent; by hand: ½ to 2 × alike
_LEAST_VALUES = 256  # one to a bin
_LEAST_BRIGHT, _MOST_BRIGHT = 0.01, 0.9  # share of the image; by hand: ½ to 2 × alike
_GROWTH_PX = 5  # by hand: 2 × refuses 1 of 36
_SEPARATION = 3.5  # standard deviations of the dark class; by hand: ½ to 2 × alike
_LEAST_SPREAD = 1e-4  # of the value: beyond the rounding of float32, whose digits are 6e-8

_CALM_MATCHES = 0.8  # by hand: ½ to 2 × alike
_CONTRADICTION_PX = 1.5  # of the overview; by hand: 2 × refuses 1 of 36

_MIXED_SIGMA = 0.03  # of a patch pixel; by hand: ½: 1 of 36 twice as far off

CALM_PATCHES = 0.9  # by hand: 0.8: 1 of 36 2.6 times as far off
CALM_SIGMA_PX = 0.02  # by hand: ½ to 2 × alike
_TELLING_PATCHES = 8  # fewer on the ground say nothing against what all others agree on
_CONTRADICTION_SIGMAS = 4.0
_CONTRADICTION_FLOOR_PX = 0.05  # of MS; by hand: ½ to 2 × alike
_RELIEF_SIGMAS = 2.0
_STILL_PX = 0.4
"""Of a patch pixel: clouds of real Landsat pairs move by 0.45 to 1.3, unlike bands by up to 0.3."""
_STILL_SHARE = 0.98  # fewer than so many see no cloud that could matter
CLEARLY = 0.8  # of the standard error; by hand: ½ to 2 × alike

_RIVAL_TOLERANCE = 0.2  # of a patch pixel; by hand: ½ to 2 × alike
_RIVAL_SIGMA = 0.5
SURE_LOG_NFA = -12.0  # as sure as 40 bits; by hand: ½ to 2 × alike
_MANY_ELSEWHERE = 0.3  # share of the patches that matched; by hand: ½ to 2 × alike


def bright_threshold(band: Band) -> float | None:
    """Value that splits off a clearly separate bright class (Otsu 1979); None without one."""
    values = band.data[band.valid]
    if len(values) < _LEAST_VALUES:
        return None
    low, high = np.percentile(values, _RANGE_PERCENT)
    if not high - low > _LEAST_SPREAD * max(abs(low), abs(high)):
        return None
    inside = values[(values >= low) & (values <= high)]
    step = (high - low) / _GREYS
    grey = np.minimum((inside - low) / step, _GREYS - 1).astype(np.uint8)
    cut, _ = cv2.threshold(grey, 0, _GREYS - 1, cv2.THRESH_OTSU)
    threshold = float(low + (cut + 1) * step)
    bright = float((inside > threshold).mean())
    dark = values[values <= threshold]
    apart = float(values[values > threshold].mean() - dark.mean()) if 0 < bright < 1 else 0.0
    if not _LEAST_BRIGHT < bright < _MOST_BRIGHT or apart < _SEPARATION * float(dark.std()):
        return None
    return threshold


def bright_mask(band: Band) -> BoolArray | None:
    """(H, W) True on bright objects and near them; None when there are none."""
    threshold = bright_threshold(band)
    if threshold is None:
        return None
    bright = (band.data > threshold) & band.valid
    side = 2 * _GROWTH_PX + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(bright.astype(np.uint8), kernel) > 0)


def is_calm_guess(guess: Guess) -> bool:
    """True when nearly all matches agree: nothing moves by itself."""
    return guess.agreeing > _CALM_MATCHES * guess.candidates


def in_doubt(ground: Guess | None, everywhere: Guess | None, working_px: FloatArray) -> list[Guess]:
    """What the dark areas say first, unless all areas say the same.

    Clouds are bright; they move between the images, consistently and with many keypoints.

    Parameters
    ----------
    ground, everywhere : Guess or None
        From keypoints off bright objects, and from all.
    working_px : (2,) float64
        MS pixels to one pixel of the overview, along columns and rows.
    """
    found = [guess for guess in (ground, everywhere) if guess is not None]
    if ground is None or everywhere is None:
        return found
    gap = everywhere.map.forward(ground.source_px) - ground.header_px
    off = np.hypot(*(gap / working_px).T) > _CONTRADICTION_PX
    return found if off.mean() > 0.5 else [everywhere]


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """Result of one pass of matching.

    Attributes
    ----------
    matched : Matched
        All patches of all tiles.
    points : Observations
        All patches, in MS pixels.
    status : (P,) uint8
    estimate : Estimate or None
        Of the patches that move together; None when too few do.
    """

    matched: Matched
    points: Observations
    status: StatusArray
    estimate: Estimate | None

    @property
    def kept(self) -> int:
        """Patches that agree."""
        return int((self.status == Status.KEPT).sum())

    @property
    def scatter_px(self) -> float:
        """Of the patches beyond their own noise, MS pixels."""
        assert self.estimate is not None
        return float(np.sqrt(self.estimate.extra_variance_px2))

    @property
    def is_calm(self) -> bool:
        """True when nearly all textured patches agree to within their own noise."""
        if self.estimate is None:
            return False
        textured = self.status != Status.TEXTURE
        share = float((self.status[textured] == Status.KEPT).mean()) if textured.any() else 0.0
        return share > CALM_PATCHES and self.scatter_px < CALM_SIGMA_PX


def agreement(
    points: Observations, status: StatusArray, start: PixelMap, frame: Frame, unit: float
) -> tuple[StatusArray, Estimate | None]:
    """Robust fit of an affine to the patches that agree; where they are few, of a shift.

    A robust mean of two motions is neither: where the patches scatter beyond their own
    covariances, the motion that many of them share to within their noise is found first.  Of a
    start that bends, what is left of it is fitted.

    Parameters
    ----------
    points : Observations
    status : (P,) uint8
    start : PixelMap
        Where the patches started from: a shift keeps its rotation and scale.
    frame : Frame
    unit : float
        MS pixels to one pixel of a patch.
    """
    status = status.copy()
    kept = np.flatnonzero(status == Status.KEPT)
    if start.as_affine() is None:
        left = replace(points, source=start.forward(points.source))
        status, estimate = agreement(left, status, IDENTITY, frame, unit)
        return status, estimate and replace(estimate, map=start.then(estimate.map))
    estimate = _fit_all(points.take(kept), start, frame)
    if estimate is not None and _is_mixed(estimate, unit):
        inliers = rigid_core(points.take(kept), unit)
        status[kept[~inliers]] = Status.CONSENSUS
        kept = kept[inliers]
        estimate = _fit_all(points.take(kept), start, frame)
    if estimate is not None:
        status[kept[~estimate.inlier]] = Status.RESIDUAL
    return status, estimate


def _fit_all(points: Observations, start: PixelMap, frame: Frame) -> Estimate | None:
    """Robust affine through many points, shift of `start` through few, None through hardly any."""
    if len(points) >= 3 * minimum_points("affine"):
        return robust_fit("affine", points, frame)
    if len(points) >= 2 * minimum_points("shift"):
        return _shifted(points, start, frame)
    return None


def _is_mixed(estimate: Estimate, unit: float) -> bool:
    """True when points scatter around an affine by more than patches of one motion do."""
    if estimate.is_shift:
        return False
    return bool(np.sqrt(estimate.extra_variance_px2) > _MIXED_SIGMA * unit)


def _shifted(points: Observations, start: PixelMap, frame: Frame) -> Estimate:
    """Robust shift on top of a map, which is taken as exact."""
    estimate = robust_fit("shift", replace(points, source=start.forward(points.source)), frame)
    affine = start.as_affine()
    exact = start if affine is None else AffineMap(affine)
    return replace(estimate, map=exact.then(estimate.map))


def difference(pair: Pair, one: Pass, other: Pass) -> tuple[float, tuple[float, float]]:
    """Largest distance over the MS raster of two estimates, and the mean standard error of each."""
    assert one.estimate is not None
    assert other.estimate is not None
    where = pair.source_lattice(LATTICE)
    gap = one.estimate.map.forward(where) - other.estimate.map.forward(where)
    sigma = [float(e.map.sigma_at(where).mean()) for e in (one.estimate, other.estimate)]
    return float(np.hypot(*gap.T).max()), (sigma[0], sigma[1])


def is_telling(ground: Pass) -> bool:
    """True when enough patches off bright objects agree to be heard against all others."""
    return ground.kept >= _TELLING_PATCHES


def same_place(pair: Pair, one: Pass, other: Pass) -> bool:
    """True when two passes differ by no more than their errors allow.

    Relief displaces neighbours alike, so that patches at other places may say something else by as
    much as all of them scatter.
    """
    gap, sigma = difference(pair, one, other)
    scatter = _RELIEF_SIGMAS * max(one.scatter_px, other.scatter_px)
    return gap <= _CONTRADICTION_SIGMAS * sum(sigma) + max(scatter, _CONTRADICTION_FLOOR_PX)


def nothing_moves(everything: Pass, unit: float) -> bool:
    """True when hardly any patch lies elsewhere than the others: what is bright is no cloud.

    Parameters
    ----------
    everything : Pass
        Bright objects included.
    unit : float
        MS pixels to one pixel of a patch.
    """
    if everything.estimate is None:
        return False
    matched = np.isin(everything.status, MATCHED)
    textured = int((everything.status != Status.TEXTURE).sum())
    if not matched.sum() > CALM_PATCHES * textured:
        return False
    points = everything.points.take(np.flatnonzero(matched))
    gap = np.hypot(*(everything.estimate.map.forward(points.source) - points.target).T)
    return bool((gap <= _STILL_PX * unit).mean() >= _STILL_SHARE)


def ground_alone(pair: Pair, ground: Pass, everything: Pass) -> bool:
    """True to leave bright objects out although both agree on the place.

    That is when nearly all other patches agree, or agree on more than a shift, or tell the place
    more sharply.
    """
    assert ground.estimate is not None
    assert everything.estimate is not None
    if ground.is_calm and not everything.is_calm:
        return True  # what disagrees is bright
    if ground.estimate.is_shift != everything.estimate.is_shift:
        return not ground.estimate.is_shift
    sigma = difference(pair, ground, everything)[1]
    return sigma[0] < CLEARLY * sigma[1]


def on_the_mesh(found: Pass) -> StatusArray:
    """Status with the patches marked that disagree with their star on the Delaunay mesh.

    Where nothing scatters beyond its own covariance there is nothing to find.
    """
    status = found.status.copy()
    kept = np.flatnonzero(status == Status.KEPT)
    if found.estimate is not None and found.estimate.extra_variance_px2 > 0:
        points = found.points.take(kept)
        status[kept[~star_filter(points.source, points.target, points.covariance)]] = Status.STAR
    return status


def rival_motion(points: TiePoints, unit_px: float) -> float:
    """Patches that agree on another motion over those that agree on the correction's.

    Clouds of one height move alike, and so do waves: where the correction follows one such layer,
    the patches on the ground, or on the other layers, agree on something else.

    Parameters
    ----------
    points : TiePoints
        With residuals under the correction.
    unit_px : float
        PAN pixels to one pixel of the coarser image.

    Returns
    -------
    float
        0 where the rest agrees on nothing; infinite where no point is kept.
    """
    sharp = (points.sigma_px < _RIVAL_SIGMA * unit_px).all(axis=1)
    tolerance = _RIVAL_TOLERANCE * unit_px
    with np.errstate(invalid="ignore"):
        away = np.hypot(*points.residual_px.T) > 2 * tolerance
    rest = points.residual_px[~points.kept & sharp & away & (points.score > MIN_CORRELATION)]
    kept = int(points.kept.sum())
    if not len(rest) or not kept:
        return 0.0 if kept else float("inf")
    gap = np.hypot(*(rest[:, None] - rest[None]).transpose(2, 0, 1))
    return float((gap <= tolerance).sum(axis=1).max()) / kept


class Claim(NamedTuple):
    """What is remembered of a guess that was refused: not its images.

    Attributes
    ----------
    map : PixelMap
    log_nfa : float
    """

    map: PixelMap
    log_nfa: float


def keypoints_apart(
    pair: Pair, guess: Guess, heard: Sequence[Claim], correction: PixelMap, points: TiePoints
) -> tuple[float, FloatArray]:
    """How far from a correction keypoints that agree with more certainty put its tie points.

    They were refused, where too little is in sight or clouds are about; that makes a place which
    fewer keypoints, or none, speak for no better.

    Parameters
    ----------
    pair : Pair
    guess : Guess
        That led to the correction.
    heard : sequence of Claim
        Of guesses that were refused before.
    correction : PixelMap
    points : TiePoints

    Returns
    -------
    distance : float
        Median, in pixels of the coarser raster; 0 when nobody is more certain.
    move_px : (2,) float64
        Median from where the correction puts the tie points to there, PAN pixels.
    """
    source_px = points.source_px[points.kept]
    here = pair.to_reference(correction).forward(source_px)
    moves = [
        pair.to_reference(other.map).forward(source_px) - here
        for other in heard
        if len(source_px) and other.log_nfa < SURE_LOG_NFA and not guess.log_nfa < other.log_nfa
    ]
    apart = [(float(np.median(np.hypot(*move.T))), np.median(move, axis=0)) for move in moves]
    distance_px, move_px = max(apart, key=lambda one: one[0], default=(0.0, np.zeros(2)))
    return distance_px / pair.pan_px_per_coarser_px, move_px


def elsewhere(points: TiePoints) -> tuple[float, float]:
    """Share of the patches that matched elsewhere than the correction says, and how far off.

    The distance is the median of theirs in PAN pixels; NaN where there are none.
    """
    away = np.isin(points.status, ELSEWHERE)
    if not away.any():
        return 0.0, float("nan")
    share = float(away.sum() / (away.sum() + points.kept.sum()))
    return share, float(np.median(np.hypot(*points.residual_px[away].T)))


def many_elsewhere(points: TiePoints) -> bool:
    """True when so many patches lie elsewhere, and so far, that nobody knows who is right."""
    share, distance = elsewhere(points)
    return share > _MANY_ELSEWHERE and distance > LOCAL_RMS_PX
