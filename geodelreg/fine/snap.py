"""Points placed by hand, measured by matching the patch around each with the other image."""

from __future__ import annotations

import numpy as np
from affine import Affine

from geodelreg.fine.least_squares import Matched, MatchOptions
from geodelreg.fine.matching import match_tiles, observe
from geodelreg.fine.tiles import PATCH_PX, plan_tiles, read_tile, read_tiles
from geodelreg.fine.tuning import DEFAULT_SIGMA, Tuning, fit_sigma, fit_tone
from geodelreg.fit.estimate import Observations
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.pair import Roles, overlap_in_template
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Status
from geodelreg.values.raster import FloatArray, Window

_TONE_TILES = 6  # evenly spread: their pixels tell tone and sharpness
_ITERATIONS = 8  # a hand puts points a pixel off, a field of patches less
_TOLERANCE = 0.005  # of a patch pixel


def snap_points(
    part: Roles, source_px: FloatArray, target_px: FloatArray, start: PixelMap
) -> tuple[Observations, FloatArray]:
    """Measure points where a person has put them, or where the other points say.

    Parameters
    ----------
    part : Roles
    source_px, target_px : (N, 2) float64
        MS pixel, NaN where it is to be found by `start`, and MS header pixel.
    start : PixelMap
        MS pixels to MS header pixels, by other points.

    Returns
    -------
    points : Observations
        In MS pixels, at the centres of the patches; NaN of points that did not match.
    correlation : (N,) float64
    """
    count = len(source_px)
    points = Observations(
        np.full((count, 2), np.nan), np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    )
    correlation = np.full(count, np.nan)
    tuning = _tuning(part, start)
    if tuning is None:
        return points, correlation
    for index, (source, target) in enumerate(zip(source_px, target_px, strict=True)):
        for near in _starts(source, target, start):
            matched = _matched(part, target, near, tuning)
            if matched is not None:
                seen = observe(part, matched, near)
                points.source[index], points.target[index] = seen.source[0], seen.target[0]
                points.covariance[index] = seen.covariance[0]
                correlation[index] = abs(matched.correlation[0])
                break
    return points, correlation


def _tuning(part: Roles, start: PixelMap) -> Tuning | None:
    """Tone and sharpness of the pair; None where it does not overlap."""
    region = overlap_in_template(part, start)
    if region is None:
        return None
    windows = plan_tiles(region, part)
    tiles = read_tiles(part, windows[:: 1 + len(windows) // _TONE_TILES], start)
    if not tiles:
        return None
    tone = fit_tone(part, tiles, start, DEFAULT_SIGMA)
    tuning = Tuning(DEFAULT_SIGMA, tone)
    matched = match_tiles(part, tiles, start, tuning, MatchOptions())
    agreed = matched.template_px[matched.status == Status.KEPT]
    sigma = fit_sigma(part, tiles, start, agreed, tuning, PATCH_PX)
    return Tuning(sigma, fit_tone(part, tiles, start, sigma))


def _starts(source: FloatArray, target: FloatArray, start: PixelMap) -> list[PixelMap]:
    """Maps to begin with: through the point itself, then that of the others."""
    if not np.isfinite(source).all():
        return [start]
    off = target - start.forward(source[None])[0]
    return [start.then(AffineMap(Affine.translation(*off.tolist()))), start]


def _matched(part: Roles, target: FloatArray, near: PixelMap, tuning: Tuning) -> Matched | None:
    """The patch at a point; None where it does not match."""
    at = near.inverse(target[None])
    centre = at[0] if part.ms_is_template else part.pair.header.forward(target[None])[0]
    size = PATCH_PX * part.step
    height, width = part.template.grid.shape
    if not np.isfinite(centre).all():
        return None
    column, row = np.rint(centre - size / 2).astype(int).tolist()
    if column < 0 or row < 0 or column + size > width or row + size > height:
        return None
    tile = read_tile(part, Window(column, row, size, size), near)
    if tile is None:
        return None
    options = MatchOptions(PATCH_PX, _ITERATIONS, _TOLERANCE)
    matched = match_tiles(part, [tile], near, tuning, options)
    return matched if matched.status.tolist() == [Status.KEPT] else None
