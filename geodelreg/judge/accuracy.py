"""How good a fitted correction is, in PAN pixels and metres."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from geodelreg.fine.overlay import Overlay
from geodelreg.fit.choice import Selection
from geodelreg.geo.grid import outline
from geodelreg.judge.unshared import PULL_PX
from geodelreg.pair import Roles, overlap_corners
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import TiePoints
from geodelreg.values.raster import FloatArray
from geodelreg.values.result import Accuracy

_E1_PIXELS = 40_000  # an RMSE of so many is known to 0.4 %
_LEAST_PIXELS = 64  # of fewer nothing is said; by hand: ½ to 2 × alike
_EDGE_PLACES = 8  # on each edge of a footprint; by hand: ½ to 2 × alike
_CE_PERCENT = 90  # as CE90 is defined

SYSTEMATIC_PX = 0.0012
"""What no residual shows: aliasing, interpolation and unlike point spreads move all patches alike,
by about this much of a pixel of the coarser image, per pair (docs/gate.md says how measured)."""


def measure(
    part: Roles,
    points: TiePoints,
    selection: Selection,
    before: Overlay,
    after: Overlay,
    unshared: float,
) -> Accuracy:
    """Accuracy in PAN pixels and metres, at points the fit has not seen where it says check.

    `unshared` is the share of what patches show that one image shows alone.
    """
    return replace(
        measure_points(part, points, selection, unshared),
        e1_before=grey_rmse(before, part.ms_is_template),
        e1_after=grey_rmse(after, part.ms_is_template),
        ncc_before=correlation(before),
        ncc_after=correlation(after),
    )


def measure_points(
    part: Roles, points: TiePoints, selection: Selection, unshared: float = 0.0
) -> Accuracy:
    """What the points alone say of it; what needs the images is not known."""
    pair, kept, correction = part.pair, points.kept, selection.estimate.map
    at = points.source_px[kept]
    unmoved = pair.header.forward(at) - points.reference_px[kept]
    check = selection.held_out_px[selection.estimate.inlier]
    in_pan = pair.header.linearise(correction.forward(at))[:, :, :2]
    check_px = np.einsum("pij,pj->pi", in_pan, check)
    check_m = check * np.array(pair.source_gsd_m)
    ratio = pair.pan_px_per_source_px
    floor = math.hypot(SYSTEMATIC_PX, PULL_PX * math.sqrt(unshared)) * pair.pan_px_per_coarser_px
    pan_m = float(np.sqrt(pair.reference_gsd_m[0] * pair.reference_gsd_m[1]))
    centre_px, corner_px = (
        ratio * float(correction.sigma_at(xy).max())
        for xy in (pair.source_centre, overlap_corners(part, correction))
    )
    return Accuracy(
        fit_rmse_px=_rms(points.residual_px[kept]),
        check_rmse_px=_rms(check_px),
        check_ce90_px=_ce90(check_px),
        check_rmse_m=_rms(check_m),
        check_ce90_m=_ce90(check_m),
        before_rmse_px=_rms(unmoved),
        before_rmse_m=_rms(unmoved) * pan_m,
        sigma_centre_px=math.hypot(centre_px, floor),
        sigma_corner_px=math.hypot(corner_px, ratio * selection.neglected_px, floor),
        systematic_px=floor,
        coverage=_coverage(part, points, correction),
        kept=int(kept.sum()),
        checked=int(np.isfinite(check_px).all(axis=1).sum()),
    )


def _rms(vectors: FloatArray) -> float:
    good = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.sqrt((good**2).sum(axis=1).mean())) if len(good) else math.nan


def _ce90(vectors: FloatArray) -> float:
    good = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.percentile(np.hypot(*good.T), _CE_PERCENT)) if len(good) else math.nan


def _coverage(part: Roles, points: TiePoints, correction: PixelMap) -> float:
    """Area of the kept points' hull over that of the overlap, both in template pixels."""
    from shapely import MultiPoint, Polygon, box

    kept = points.kept
    if kept.sum() < 3:
        return 0.0
    spots = points.source_px[kept] if part.ms_is_template else points.reference_px[kept]
    ring = part.to_surface(correction).inverse(outline(part.surface.grid, _EDGE_PLACES))
    seen = Polygon(ring).buffer(0)
    rows, columns = part.template.grid.shape
    common = seen.intersection(box(0, 0, columns, rows)).area
    return float(MultiPoint(spots).convex_hull.area / common) if common > 0 else 0.0


def grey_rmse(overlaid: Overlay, ms_is_template: bool) -> float:
    """E1: RMSE of grey values between PAN and MS after histogram matching, in DN of PAN.

    Zhang, Ma & Zhang 2013, on common valid pixels, of which so many are as good as all.
    """
    good = np.flatnonzero(overlaid.valid)
    if len(good) < _LEAST_PIXELS:
        return float("nan")
    good = good[:: max(len(good) // _E1_PIXELS, 1)]
    template, surface = overlaid.template.ravel()[good], overlaid.surface.ravel()[good]
    ms, pan = (template, surface) if ms_is_template else (surface, template)
    matched = np.empty(len(ms), dtype=np.float64)
    matched[np.argsort(ms, kind="stable")] = np.sort(pan)
    return float(np.sqrt(np.mean((matched - pan) ** 2)))


def correlation(overlaid: Overlay) -> float:
    """Correlation of the two images on common valid pixels."""
    good = overlaid.valid
    if good.sum() < _LEAST_PIXELS:
        return float("nan")
    one, other = overlaid.template[good], overlaid.surface[good]
    if one.std() == 0 or other.std() == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])
