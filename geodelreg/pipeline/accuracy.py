"""How good a fitted correction is, in PAN pixels and metres."""

from __future__ import annotations

import math

import numpy as np

from geodelreg.fit.models import IDENTITY
from geodelreg.fit.select import HeldOut, Selection
from geodelreg.geo.crs import linearise
from geodelreg.match.area import Overlay
from geodelreg.pipeline.evidence import correlation, grey_rmse
from geodelreg.pipeline.state import Pair
from geodelreg.pipeline.tiles import Roles, overlap_corners
from geodelreg.types import Accuracy, FloatArray, TiePoints

SYSTEMATIC_PX = 0.0012
"""What no residual shows: aliasing, interpolation and unlike point spreads move all patches alike,
by about this much of a pixel of the coarser image, per pair (docs/gate.md says how measured)."""


def measure(
    part: Roles, points: TiePoints, selection: Selection, before: Overlay, after: Overlay
) -> Accuracy:
    """Accuracy in PAN pixels and metres, at points the fit has not seen where it says check."""
    pair, kept = part.pair, points.kept
    matrix = selection.estimate.transformation.matrix
    unmoved = pair.to_reference(IDENTITY, points.source_px[kept]) - points.reference_px[kept]
    fit = points.residual_px[kept]
    check_px, check_m = _held_out(pair, points, selection.check, selection)
    ratio = pair.pan_px_per_source_px
    floor = SYSTEMATIC_PX * max(ratio, 1.0)
    height, width = pair.source.grid.shape
    centre = np.array([[width / 2, height / 2]])
    pan_m = float(np.sqrt(pair.reference_gsd_m[0] * pair.reference_gsd_m[1]))
    return Accuracy(
        fit_rmse_px=_rms(fit),
        check_rmse_px=_rms(check_px),
        check_ce90_px=_ce90(check_px),
        check_rmse_m=_rms(check_m),
        check_ce90_m=_ce90(check_m),
        before_rmse_px=_rms(unmoved),
        before_rmse_m=_rms(unmoved) * pan_m,
        sigma_centre_px=math.hypot(ratio * _sigma(selection, centre), floor),
        sigma_corner_px=math.hypot(ratio * _sigma(selection, overlap_corners(part, matrix)), floor),
        coverage=_coverage(part, points, matrix),
        e1_before=grey_rmse(before, part.ms_is_template()),
        e1_after=grey_rmse(after, part.ms_is_template()),
        ncc_before=correlation(before),
        ncc_after=correlation(after),
        kept=int(kept.sum()),
        checked=int(np.isfinite(check_px).all(axis=1).sum()),
    )


def _sigma(selection: Selection, xy: FloatArray) -> float:
    """Largest radial standard error at (N, 2) MS pixels, in MS pixels."""
    return float(selection.estimate.sigma_at(xy).max())


def _held_out(
    pair: Pair, points: TiePoints, check: HeldOut, selection: Selection
) -> tuple[FloatArray, FloatArray]:
    """Held-out residuals of the kept points, in PAN pixels and in metres."""
    inlier = selection.estimate.inlier
    residual = check.residual_px[inlier]
    at = points.source_px[points.kept]
    local = linearise(pair.mapping.forward, selection.estimate.transformation(at))[:, :, :2]
    in_pan = np.einsum("pij,pj->pi", local, residual)
    return in_pan, residual * np.array(pair.source_gsd_m)


def _rms(vectors: FloatArray) -> float:
    good = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.sqrt((good**2).sum(axis=1).mean())) if len(good) else float("nan")


def _ce90(vectors: FloatArray) -> float:
    good = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.percentile(np.hypot(good[:, 0], good[:, 1]), 90)) if len(good) else math.nan


def _coverage(part: Roles, points: TiePoints, matrix: FloatArray) -> float:
    """Area of the kept points' hull over that of the overlap, both in template pixels."""
    from shapely import MultiPoint, Polygon, box

    kept = points.kept
    if kept.sum() < 3:
        return 0.0
    spots = points.source_px[kept] if part.ms_is_template() else points.reference_px[kept]
    height, width = part.surface.grid.shape
    t = np.linspace(0.0, 1.0, 9)[:-1]
    ring = np.concatenate(
        [
            np.stack([t * width, 0 * t], 1),
            np.stack([0 * t + width, t * height], 1),
            np.stack([(1 - t) * width, 0 * t + height], 1),
            np.stack([0 * t, (1 - t) * height], 1),
        ]
    )
    seen = Polygon(part.to_template(matrix, ring)).buffer(0)
    rows, columns = part.template.grid.shape
    common = seen.intersection(box(0, 0, columns, rows)).area
    return float(MultiPoint(spots).convex_hull.area / common) if common > 0 else 0.0
