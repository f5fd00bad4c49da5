"""The paper's method and plain SIFT, for comparison; the same gate judges them."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from geodelreg.fit.estimate import Estimate, Observations, minimum_points, weighted_fit
from geodelreg.fit.models import Frame, transformation
from geodelreg.fit.select import Selection, held_out
from geodelreg.geo.affine import affine_from_matrix, affine_matrix, apply_affine
from geodelreg.image.stretch import to_uint8
from geodelreg.match.keypoints import KeypointOptions, detect
from geodelreg.match.surprise import log_nfa
from geodelreg.match.zhang2013 import ZhangOptions, match_sift, match_zhang2013
from geodelreg.pipeline.refinement import Refinement, refine_densely
from geodelreg.pipeline.search import Hypothesis, WorkingPair, mean_band
from geodelreg.pipeline.solve import Fitted, Solution, conclude
from geodelreg.pipeline.state import Pair
from geodelreg.pipeline.tiles import overlap_corners, roles
from geodelreg.types import FloatArray, TiePoints

_SIFT_SCATTER_PX = 0.3


def solve_baseline(pair: Pair, hypothesis: Hypothesis) -> Solution | None:
    """Match by the paper's steps (or its "traditional SIFT"), fit by plain least squares.

    The pair is the decimated one that the hypothesis came from.  The hypothesis itself plays no
    part in the match; area correlation from the fitted transformation gives the gate its evidence.
    """
    timings: dict[str, float] = {}
    start = perf_counter()
    points, counts = _match(pair, hypothesis.pair)
    kept = points.kept
    model = "affine" if pair.options.model == "auto" else pair.options.model
    if kept.sum() < minimum_points(model):
        return None
    target, covariance = pair.header_px(points.reference_px, points.covariance_px2)
    observations = Observations(points.source_px, target, covariance)
    estimate = least_squares(model, observations.take(kept), pair.frame())
    timings["match and fit"] = perf_counter() - start
    matched = replace(hypothesis, matrix=estimate.transformation.matrix, counts={}, bright=None)
    area = refine_densely(roles(pair), matched, timings)
    if area is None:
        return None
    check = held_out(model, observations.take(kept), estimate)
    points = replace(points, residual_px=_residual(pair, estimate, points))
    gap = np.hypot(*points.residual_px[points.kept].T)
    height, width = pair.reference.grid.shape
    fitted = Fitted(
        Selection(estimate, check, {}),
        points,
        counts,
        log_nfa(gap, float(height * width), 3, 3 * pair.pan_px_per_source_px)[0],
        _apart(pair, estimate, area),
    )
    return conclude(matched, area, fitted, timings)


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
    band = images.source[0] if pair.options.band else mean_band(images.source[:3])
    settings = KeypointOptions(max_keypoints=pair.options.max_keypoints, root=False)
    source = detect(to_uint8(band), band.valid, settings)
    reference = detect(to_uint8(images.reference), images.reference.valid, settings)
    steps = match_zhang2013 if pair.options.method == "zhang2013" else match_sift
    points, counts = steps(source, reference, ZhangOptions(ratio=pair.options.ratio))
    to_source = affine_matrix(~pair.source.grid.transform @ band.grid.transform)
    to_reference = affine_matrix(~pair.reference.grid.transform @ images.reference.grid.transform)
    linear = to_reference[:, :2] * _SIFT_SCATTER_PX
    counts = {"keypoints MS": len(source), "keypoints PAN": len(reference)} | counts
    moved = replace(
        points,
        source_px=apply_affine(affine_from_matrix(to_source), points.source_px),
        reference_px=apply_affine(affine_from_matrix(to_reference), points.reference_px),
        covariance_px2=np.broadcast_to(linear @ linear.T, (len(points), 2, 2)).copy(),
    )
    return moved, counts


def _residual(pair: Pair, estimate: Estimate, points: TiePoints) -> FloatArray:
    there = pair.to_reference(estimate.transformation.matrix, points.source_px)
    return there - points.reference_px


def _apart(pair: Pair, estimate: Estimate, area: Refinement) -> float:
    """Largest distance at the overlap's corners from what area correlation finds, PAN pixels."""
    corners = overlap_corners(roles(pair), area.matrix)
    mine = pair.to_reference(estimate.transformation.matrix, corners)
    return float(np.hypot(*(mine - pair.to_reference(area.matrix, corners)).T).max())
