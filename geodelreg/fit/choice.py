"""Held-out errors, and the simplest model that they do not reject."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from geodelreg.fit.estimate import (
    REJECT_D2,
    Estimate,
    Observations,
    minimum_points,
    robust_fit,
    student_weight,
    weighted_fit,
)
from geodelreg.fit.models import MODEL_ORDER, NORTH_UP, Frame, fitted_map
from geodelreg.options import FOLLOWING
from geodelreg.pair import Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import TiePoints
from geodelreg.values.raster import TINY, BoolArray, FloatArray, IntArray

FOLDS = 5  # a fifth of the points is held out at a time
_BLOCKS = 8  # 64 of them: the folds are twelve or thirteen each
_INSIDE = 1 - 1e-9  # the last point is in the last block
_SIGNIFICANT_T = 2.5  # a chance of 1 % or so with as many blocks
_TILT_PX = 0.1
"""Of PAN, at a corner: less is not worth a raster that GDAL's pansharpening refuses."""
_LEAST_PREDICTED = 0.5
_DOUBT_SIGMAS = 2.0


def spatial_blocks(xy: FloatArray, per_axis: int = _BLOCKS) -> IntArray:
    """(N,) block number of each point on a `per_axis` × `per_axis` grid over their extent."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = np.floor((xy - low) / np.maximum(high - low, TINY) * per_axis * _INSIDE)
    return np.asarray(cell[:, 1] * per_axis + cell[:, 0], dtype=np.intp)


def fold_numbers(xy: FloatArray) -> IntArray:
    """(N,) fold 0 … 4 of each point: whole blocks, spread like a knight's moves.

    Neighbouring tie points share errors (terrain, parallax); holding out whole blocks keeps the
    check points independent of the fit.
    """
    block = spatial_blocks(xy)
    return np.asarray((block % _BLOCKS + 2 * (block // _BLOCKS)) % FOLDS, dtype=np.intp)


def held_out(points: Observations, estimate: Estimate) -> FloatArray:
    """(N, 2) errors of every point as a fit without its fold predicts it, source pixels.

    NaN where a fold leaves too few points.

    Parameters
    ----------
    points : Observations
    estimate : Estimate
        Of all points; gives the weights, so that a fold needs one linear solution.
    """
    model, frame = estimate.model, estimate.frame
    weight = _precision(points, estimate)
    weight = weight * (student_weight(estimate.distance2) * estimate.inlier)[:, None, None]
    folds = fold_numbers(points.source)
    error = np.full((len(points), 2), np.nan)
    for fold in range(FOLDS):
        out = folds == fold
        rest = ~out & estimate.inlier
        if not out.any() or rest.sum() < minimum_points(model):
            continue
        parameters, _ = weighted_fit(model, points.take(rest), weight[rest], frame)
        predicted = fitted_map(model, parameters, frame)
        error[out] = predicted.forward(points.source[out]) - points.target[out]
    return error


def _precision(points: Observations, estimate: Estimate) -> FloatArray:
    """(N, 2, 2) inverse covariances, with the variance that all points have besides their own."""
    return np.asarray(np.linalg.inv(points.covariance + estimate.extra_variance_px2 * np.eye(2)))


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chosen model, and its errors at points it has not seen.

    Attributes
    ----------
    estimate : Estimate
    held_out_px : (N, 2) float64
        Of the points, source pixels; NaN where not known.
    neglected_px : float
        Source pixels by which rotation and shear, that are likely but not worth it, would move the
        worst corner.
    """

    estimate: Estimate
    held_out_px: FloatArray
    neglected_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A map of the chosen model before it is judged.

    Attributes
    ----------
    selection : Selection
    points : TiePoints
        With residuals under the map.
    counts : dict of str to int
        Points that survive each step.
    log_nfa : float
        log10 of the expected number of chance agreements as good.
    disagreement_px : float
        How far the map may be off at a corner by evidence it has not used, PAN pixels.
    """

    selection: Selection
    points: TiePoints
    counts: dict[str, int]
    log_nfa: float
    disagreement_px: float

    @property
    def map(self) -> PixelMap:
        """MS pixels to MS header pixels."""
        return self.selection.estimate.map


def select_model(
    points: Observations,
    frame: Frame,
    corners: FloatArray,
    model: str,
    tilt_px: float = 0.0,
) -> Selection:
    """Fit one model, or choose the simplest whose held-out error is not significantly worse.

    Parameters
    ----------
    points : Observations
    frame : Frame
    corners : (4, 2) float64
        Corners of the source raster, pixels.
    model : str
        A model's name, or ``auto``.
    tilt_px : float
        A model that rotates or shears must move a corner by so many source pixels against the best
        one that does not; infinite for none.
    """
    if model != "auto":
        return select_one(model, points, frame)
    candidates = [name for name in MODEL_ORDER if len(points) >= minimum_points(name)]
    full, neglected = robust_fit(candidates[-1], points, frame), 0.0
    level = [name for name in candidates if name in NORTH_UP]
    if level:
        upright = robust_fit(level[-1], points, frame)
        tilt = np.hypot(*(upright.map.forward(corners) - full.map.forward(corners)).T)
        if tilt.max() < tilt_px:
            doubt = _DOUBT_SIGMAS * full.map.sigma_at(corners)
            neglected = float(np.sqrt(np.maximum(tilt**2 - doubt**2, 0.0)).max())
            candidates, full = level, upright
    precision, errors = _precision(points, full), held_out(points, full)

    def distance2(error: FloatArray) -> FloatArray:
        """Squared, in variances; capped, so that one outlier does not decide."""
        squared = np.einsum("ni,nij,nj->n", error, precision, error)
        return np.asarray(np.minimum(squared, REJECT_D2))

    blocks = spatial_blocks(points.source)
    for name in candidates[:-1]:
        simpler = robust_fit(name, points, frame, extra_variance_px2=full.extra_variance_px2)
        worse = distance2(held_out(points, simpler)) - distance2(errors)
        if _paired_t(worse, blocks) < _SIGNIFICANT_T:
            return replace(select_one(name, points, frame), neglected_px=neglected)
    return Selection(full, errors, neglected)


def select_one(
    model: str,
    points: Observations,
    frame: Frame,
    spread_px2: float | None = None,
    weight: FloatArray | None = None,
) -> Selection:
    """Fit one model; with a spread and weights as an earlier fit gave them, which it then repeats.

    Parameters
    ----------
    model, points, frame, spread_px2, weight
        As for `geodelreg.fit.estimate.robust_fit`.
    """
    estimate = robust_fit(model, points, frame, spread_px2, weight)
    return Selection(estimate, held_out(points, estimate))


def select_for(pair: Pair, points: Observations) -> Selection:
    """`select_model` as the options of a pair ask; what follows a bend starts from an affine.

    Parameters
    ----------
    pair : Pair
    points : Observations
    """
    asked, frame, ratio = pair.options, Frame.of(pair), pair.pan_px_per_source_px
    model = "affine" if asked.model in FOLLOWING else asked.model
    tilt = math.inf if asked.north_up else _TILT_PX / ratio
    return select_model(points, frame, pair.source_lattice(2), model, tilt)


def _paired_t(difference: FloatArray, blocks: IntArray) -> float:
    """T of the mean of per-block means, blocks being the independent units."""
    good = np.isfinite(difference)
    if good.mean() < _LEAST_PREDICTED:
        return float("inf")
    number = np.bincount(blocks[good])
    total = np.bincount(blocks[good], weights=difference[good])
    means = total[number > 0] / number[number > 0]
    if len(means) < 3:
        return 0.0
    spread = means.std(ddof=1) / np.sqrt(len(means))
    return float(means.mean() / max(spread, TINY))


def half_disagreement(points: Observations, estimate: Estimate, corners: FloatArray) -> float:
    """Largest distance at the corners between fits to two disjoint halves, in source pixels.

    The halves interleave like a chessboard, so that both cover the scene; half the distance
    between their fits is about the error of the full fit.

    Returns
    -------
    float
        ``inf`` when a half cannot determine the model.
    """
    model, block = estimate.model, spatial_blocks(points.source)

    def both_fix(half: BoolArray) -> bool:
        return min(int(half.sum()), int((~half).sum())) >= minimum_points(model)

    white = (block % _BLOCKS + block // _BLOCKS) % 2 == 0
    if not both_fix(white):
        # a few points may all lie on one colour: then every other one of them, row by row
        white = np.argsort(np.argsort(block, kind="stable")) % 2 == 0
    if not both_fix(white):
        return float("inf")
    weight = _precision(points, estimate)
    ends = []
    for half in (white, ~white):
        parameters, _ = weighted_fit(model, points.take(half), weight[half], estimate.frame)
        ends.append(fitted_map(model, parameters, estimate.frame).forward(corners))
    return float(np.hypot(*(ends[0] - ends[1]).T).max() / 2)
