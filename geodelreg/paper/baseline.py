"""The paper's method and plain SIFT, for comparison; the same gate judges them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geodelreg.coarse.grey import to_uint8
from geodelreg.coarse.keypoints import KeypointOptions, detect
from geodelreg.fine.looks import mean_band
from geodelreg.fine.passes import Refinement, refine
from geodelreg.fit.chance import log_nfa
from geodelreg.fit.choice import Fitted, Selection, held_out
from geodelreg.fit.estimate import Estimate, Observations, minimum_points, weighted_fit
from geodelreg.fit.models import Frame, fitted_map
from geodelreg.geo.affine import affine_from_matrix, affine_matrix, apply_affine
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.pair import Pair, overlap_corners, roles
from geodelreg.paper.zhang2013 import ZhangOptions, match_sift, match_zhang2013
from geodelreg.values.points import Guess, Overview, TiePoints
from geodelreg.values.raster import TINY

_SIFT_SCATTER_PX = 0.3
"""Of the images, per axis; as `geodelreg.paper.zhang2013.ZhangOptions` has it."""


def find_by_keypoints(pair: Pair, guess: Guess) -> tuple[Guess, Refinement, Fitted] | None:
    """Match by the paper's steps (or its "traditional SIFT"), fit by plain least squares.

    The pair is the decimated one that the guess came from.  The guess itself plays no part in the
    match; area correlation from the fitted map gives the gate its evidence.
    """
    with pair.timings("match and fit"):
        points, counts = _match(pair, guess.images)
        kept = points.kept
        model = "affine" if pair.options.model == "auto" else pair.options.model
        if kept.sum() < minimum_points(model):
            return None
        back = Inverse(pair.header)
        target, covariance = back.carry(points.reference_px, points.covariance_px2)
        observations = Observations(points.source_px, target, covariance)
        estimate = least_squares(model, observations.take(kept), Frame.of(pair))
    matched = replace(guess, map=estimate.map, counts={}, bright=None)
    with pair.timings("refine"):
        area = refine(roles(pair), matched)
    if area is None:
        return None
    check = held_out(model, observations.take(kept), estimate)
    residual = pair.to_reference(estimate.map).forward(points.source_px) - points.reference_px
    points = replace(points, residual_px=residual)
    gap = np.hypot(*points.residual_px[points.kept].T)
    height, width = pair.reference.grid.shape
    fitted = Fitted(
        Selection(estimate, check),
        points,
        counts,
        log_nfa(gap, float(height * width), 3, 3 * pair.pan_px_per_source_px)[0],
        _apart(pair, estimate, area),
    )
    return matched, area, fitted


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
    residual = fitted_map(model, parameters, frame).forward(points.source) - points.target
    spare = max(residual.size - len(parameters), 1)
    variance = float((residual**2).sum()) / spare
    everyone = np.ones(len(points), dtype=bool)
    distance2 = (residual**2).sum(axis=1) / max(variance, TINY)
    spread = np.asarray(np.linalg.pinv(normal, hermitian=True) * variance, dtype=np.float64)
    there = fitted_map(model, parameters, frame, spread)
    return Estimate(model, there, parameters, spread, frame, variance, everyone, distance2)


def _match(pair: Pair, images: Overview) -> tuple[TiePoints, dict[str, int]]:
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


def _apart(pair: Pair, estimate: Estimate, area: Refinement) -> float:
    """Largest distance at the overlap's corners from what area correlation finds, PAN pixels."""
    other = area.estimate.map
    corners = overlap_corners(roles(pair), other)
    mine, theirs = (pair.to_reference(m).forward(corners) for m in (estimate.map, other))
    gap = mine - theirs
    return float(np.hypot(*gap.T).max())
