"""The paper of 2013, standalone: plain SIFT, its steps and least squares, from keypoints to fit.

Nothing of the default method comes before the fit or between the steps.  The headers say only which
parts of the rasters overlap and at which ground sampling distance to read them.  Area patches
around the fit come after it: they are the gate's evidence and do not move it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from geodelreg.coarse.grey import to_uint8
from geodelreg.coarse.guesses import overviews
from geodelreg.coarse.keypoints import detect, no_keypoints
from geodelreg.coarse.scopes import SECOND_BUDGET_PX, scopes
from geodelreg.errors import NoDataError
from geodelreg.fine.fitted import Found
from geodelreg.fine.looks import mean_band
from geodelreg.fine.passes import Refinement, refine
from geodelreg.fit.chance import log_nfa
from geodelreg.fit.choice import Fitted, Selection, held_out
from geodelreg.fit.estimate import Estimate, Observations, minimum_points, weighted_fit
from geodelreg.fit.models import Frame, fitted_map, points_that_fix
from geodelreg.geo.affine import affine_matrix, apply_affine
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.pair import Pair, overlap_corners, roles
from geodelreg.paper.zhang2013 import ZhangOptions, lowe_options, match_sift, match_zhang2013
from geodelreg.values.points import Guess, Keypoints, Overview, Scope, TiePoints
from geodelreg.values.raster import TINY, Band

_GREY_BANDS = 3
"""The paper matches one grey image; the mean of the first bands, the visible ones, is it."""

_CHANCE_RADIUS_PX = 3.0
"""Of the test that the gate asks for, in MS pixels: ten times the scatter of a SIFT position."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PaperFit(Guess):
    """Steps 1 to 7 on one pair of images, for the gate to judge.

    Attributes
    ----------
    points : TiePoints
        All matches in full-raster pixels, with the step that rejected each as their status.
    observations : Observations
        The same, kept ones only, as MS pixels and MS header pixels.
    estimate : Estimate
        Their plain least squares.
    """

    points: TiePoints
    observations: Observations
    estimate: Estimate


def paper_fits(pair: Pair) -> Iterator[tuple[Pair, PaperFit]]:
    """Fits of the paper's methods, in the place of first guesses."""
    for seen, images in overviews(pair, paper_scopes(pair)):
        fit = paper_fit(seen, images)
        if fit is not None:
            yield seen, fit


def paper_scopes(pair: Pair) -> Iterator[Scope]:
    """What overlaps by the headers, grown by the search radius, then both rasters whole.

    Each once, at the coarser ground sampling distance, or decimated to `SECOND_BUDGET_PX`.
    """
    most, name = pair.options.max_keypoints, pair.options.method
    windows = {(scope.source, scope.reference): scope.is_whole for scope in scopes(pair)}
    return (
        Scope(source, reference, SECOND_BUDGET_PX, most, name, is_whole)
        for (source, reference), is_whole in windows.items()
    )


def grey_keypoints(images: Overview) -> tuple[Keypoints, Keypoints]:
    """Step 1: SIFT on the grey image of MS and on PAN, in pixels of `images`."""
    options = lowe_options(images.scope.keypoints)

    def found(band: Band) -> Keypoints:
        try:
            return detect(to_uint8(band), band.valid, options)
        except NoDataError:
            return no_keypoints()

    return found(mean_band(images.source[:_GREY_BANDS])), found(images.reference)


def paper_fit(pair: Pair, images: Overview) -> PaperFit | None:
    """Keypoints, the method's steps, plain least squares; None where too few points are left."""
    with pair.timings("match and fit"):
        points, counts = _match(pair, images)
        kept = points.kept
        model = "affine" if pair.options.model == "auto" else pair.options.model
        if kept.sum() < minimum_points(model):
            return None
        back = Inverse(pair.header)
        target, covariance = back.carry(points.reference_px[kept], points.covariance_px2[kept])
        observations = Observations(points.source_px[kept], target, covariance)
        estimate = least_squares(model, observations, Frame.of(pair))
        there = pair.to_reference(estimate.map).forward(points.source_px)
        points = replace(points, residual_px=there - points.reference_px)
        height, width = pair.reference.grid.shape
        radius = _CHANCE_RADIUS_PX * pair.pan_px_per_source_px
        gap = np.hypot(*points.residual_px[kept].T)
        chance = log_nfa(gap, float(height * width), points_that_fix(model), radius)[0]
    return PaperFit(
        estimate.map,
        chance,
        counts,
        images,
        points=points,
        observations=observations,
        estimate=estimate,
    )


def with_patches(pair: Pair, fit: PaperFit) -> Found | None:
    """A finished fit and the patches around it, as the gate's evidence; None of too few patches."""
    with pair.timings("refine"):
        area = refine(roles(pair), fit)
    if area is None:
        return None
    selection = Selection(fit.estimate, held_out(fit.observations, fit.estimate))
    apart = _apart(pair, fit, area)
    return Found(fit, area, Fitted(selection, fit.points, fit.counts, fit.log_nfa, apart))


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
    other = area.estimate.map
    corners = overlap_corners(roles(pair), other)
    mine, theirs = (pair.to_reference(m).forward(corners) for m in (fit.map, other))
    return float(np.hypot(*(mine - theirs).T).max())
