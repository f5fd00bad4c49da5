"""The paper of 2013, standalone: plain SIFT, its steps and least squares, from keypoints to fit.

Nothing of the default method comes before the fit or between the steps.  The headers say only which
parts of the rasters overlap and at which ground sampling distance to read them.  Area patches
around the fit come after it: they are the gate's evidence and do not move it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from geodelreg.errors import NoDataError
from geodelreg.fit.estimate import Estimate, Observations, minimum_points, weighted_fit
from geodelreg.fit.models import PARAMETER_COUNT, Frame, transformation
from geodelreg.fit.select import Selection, held_out
from geodelreg.geo.affine import affine_matrix, apply_affine
from geodelreg.image.stretch import to_uint8
from geodelreg.match.keypoints import detect, no_keypoints
from geodelreg.match.surprise import log_nfa
from geodelreg.match.zhang2013 import ZhangOptions, lowe_options, match_sift, match_zhang2013
from geodelreg.pipeline.refinement import Refinement, refine_densely
from geodelreg.pipeline.search import SECOND_BUDGET_PX, Hypothesis, Scope, WorkingPair, mean_band
from geodelreg.pipeline.search import scopes as search_scopes
from geodelreg.pipeline.solve import Fitted, Solution, conclude
from geodelreg.pipeline.state import Pair
from geodelreg.pipeline.tiles import overlap_corners, roles
from geodelreg.types import Band, Keypoints, TiePoints

_GREY_BANDS = 3
"""The paper matches one grey image; the mean of the first bands, the visible ones, is it."""

_CHANCE_RADIUS_PX = 3.0
"""Of the test that the gate asks for, in MS pixels: ten times the scatter of a SIFT position."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PaperFit(Hypothesis):
    """Steps 1 to 7 on one pair of images, for the gate to judge.

    Attributes
    ----------
    points : TiePoints
        All matches in full-raster pixels, with the step that rejected each as their status.
    observations : Observations
        The same, kept ones only, as MS pixels and MS header pixels.
    estimate : Estimate
        Their plain least squares.
    fit_s : float
        Seconds from keypoints to fit.
    """

    points: TiePoints
    observations: Observations
    estimate: Estimate
    fit_s: float


def paper_scopes(pair: Pair) -> Iterator[Scope]:
    """What overlaps by the headers, grown by the search radius, then both rasters whole.

    Each once, at the coarser ground sampling distance, or decimated to `SECOND_BUDGET_PX`.
    """
    name = pair.options.method
    limits = (SECOND_BUDGET_PX, pair.options.max_keypoints, name)
    windows = dict.fromkeys((scope.source, scope.reference) for scope in search_scopes(pair))
    return (Scope(source, reference, *limits) for source, reference in windows)


def grey_keypoints(images: WorkingPair) -> tuple[Keypoints, Keypoints]:
    """Step 1: SIFT on the grey image of MS and on PAN, in pixels of `images`."""
    options = lowe_options(images.scope.keypoints)

    def found(band: Band) -> Keypoints:
        try:
            return detect(to_uint8(band), band.valid, options)
        except NoDataError:
            return no_keypoints()

    return found(mean_band(images.source[:_GREY_BANDS])), found(images.reference)


def paper_fits(pair: Pair, images: WorkingPair) -> Iterator[PaperFit]:
    """Keypoints, the method's steps, plain least squares; nothing where too few points are left."""
    start = perf_counter()
    points, counts = _match(pair, images)
    kept = points.kept
    model = "affine" if pair.options.model == "auto" else pair.options.model
    if kept.sum() < minimum_points(model):
        return
    target, covariance = pair.header_px(points.reference_px[kept], points.covariance_px2[kept])
    observations = Observations(points.source_px[kept], target, covariance)
    estimate = least_squares(model, observations, pair.frame())
    matrix = estimate.transformation.matrix
    residual = pair.to_reference(matrix, points.source_px) - points.reference_px
    height, width = pair.reference.grid.shape
    radius = _CHANCE_RADIUS_PX * pair.pan_px_per_source_px
    gap = np.hypot(*residual[kept].T)
    yield PaperFit(
        matrix,
        log_nfa(gap, float(height * width), PARAMETER_COUNT[model] // 2, radius)[0],
        counts,
        images,
        points=replace(points, residual_px=residual),
        observations=observations,
        estimate=estimate,
        fit_s=perf_counter() - start,
    )


def solve_baseline(pair: Pair, fit: PaperFit) -> Solution | None:
    """Put a finished fit before the gate; None when too few patches match around it."""
    timings = {"match and fit": fit.fit_s}
    area = refine_densely(roles(pair), fit, timings)
    if area is None:
        return None
    model = fit.estimate.transformation.model
    selection = Selection(fit.estimate, held_out(model, fit.observations, fit.estimate), {})
    fitted = Fitted(selection, fit.points, fit.counts, fit.log_nfa, _apart(pair, fit, area))
    return conclude(fit, area, fitted, timings)


def least_squares(model: str, points: Observations, frame: Frame) -> Estimate:
    """Plain, unweighted least squares (step 7 of the paper): no point is doubted.

    Parameters
    ----------
    model : str
    points : Observations
        Their covariances are ignored.
    frame : Frame

    Returns
    -------
    Estimate
        With the covariance that equal, independent errors give.
    """
    equal = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    parameters, normal = weighted_fit(model, points, equal, frame)
    fitted = transformation(model, parameters, frame)
    residual = fitted.residuals(points.source, points.target)
    spare = max(residual.size - len(parameters), 1)
    variance = float((residual**2).sum()) / spare
    everyone = np.ones(len(points), dtype=bool)
    distance2 = (residual**2).sum(axis=1) / max(variance, 1e-30)
    spread = np.asarray(np.linalg.pinv(normal, hermitian=True) * variance, dtype=np.float64)
    return Estimate(fitted, parameters, spread, frame, variance, everyone, distance2)


def _match(pair: Pair, images: WorkingPair) -> tuple[TiePoints, dict[str, int]]:
    """The paper's steps 1 to 6, or 1 and 2, in full-raster pixels."""
    source, reference = grey_keypoints(images)
    steps = match_zhang2013 if pair.options.method == "zhang2013" else match_sift
    points, counts = steps(source, reference, ZhangOptions(ratio=pair.options.ratio))
    to_source = ~pair.source.grid.transform @ images.source[0].grid.transform
    to_reference = ~pair.reference.grid.transform @ images.reference.grid.transform
    linear = affine_matrix(to_reference)[:, :2]
    moved = replace(
        points,
        source_px=apply_affine(to_source, points.source_px),
        reference_px=apply_affine(to_reference, points.reference_px),
        covariance_px2=linear @ points.covariance_px2 @ linear.T,
    )
    return moved, {"keypoints MS": len(source), "keypoints PAN": len(reference)} | counts


def _apart(pair: Pair, fit: PaperFit, area: Refinement) -> float:
    """Largest distance at the overlap's corners from what area correlation finds, PAN pixels."""
    corners = overlap_corners(roles(pair), area.matrix)
    mine = pair.to_reference(fit.matrix, corners)
    return float(np.hypot(*(mine - pair.to_reference(area.matrix, corners)).T).max())
