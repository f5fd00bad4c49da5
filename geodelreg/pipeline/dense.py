"""Sub-pixel refinement over many small patches: tone, point spread, matching, robust fit."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from affine import Affine

from geodelreg.fit.estimate import Estimate, Observations, minimum_points, robust_fit
from geodelreg.geo.pixel import HALF_PIXEL
from geodelreg.image.synthetic_pan import SyntheticPan, fit_synthetic_pan
from geodelreg.match.consensus import consensus_affine, log_nfa, radial_residuals
from geodelreg.match.refine import Patches, Refined, RefineOptions, cut_patches, refine
from geodelreg.match.surface import Surface, make_surface, sample
from geodelreg.pipeline.tiles import Roles, Tile
from geodelreg.types import Band, BoolArray, Float32Array, FloatArray, Status, StatusArray

logger = logging.getLogger(__name__)

DEFAULT_SIGMA = 0.5
_SIGMA_CANDIDATES = (0.3, 0.4, 0.5, 0.6, 0.7)
_TONE_SAMPLES = 20_000
_SIGMA_TILES = 6
_MIXED_SIGMA = 0.15
_AGREEMENT_PX = (0.1, 0.3, 0.8)


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """What refinement knows about the two sensors.

    Attributes
    ----------
    sigma : float
        Gaussian low-pass that brings the finer image to the coarser one's sharpness, in template
        pixels.
    tone : SyntheticPan
    """

    sigma: float
    tone: SyntheticPan


@dataclass(frozen=True, slots=True, eq=False)
class Dense:
    """Result of one pass.

    Attributes
    ----------
    refined : Refined
        All patches of all tiles.
    observations : Observations
        All patches, in MS pixels.
    status : (P,) uint8
    estimate : Estimate or None
        None when too few patches matched.
    """

    refined: Refined
    observations: Observations
    status: StatusArray
    estimate: Estimate | None


def surface_sigma(part: Roles, tile: Tile, sigma: float) -> tuple[float, float]:
    """Low-pass along columns and rows in pixels of the tile's surface bands."""
    template, surface = tile.template[0], tile.surface[0]
    ratio = part.surface_px_per_template_px
    coarse_t = _decimation(template, part.template.grid.transform)
    coarse_s = _decimation(surface, part.surface.grid.transform)
    return (
        sigma * ratio * coarse_t[0] / coarse_s[0],
        sigma * ratio * coarse_t[1] / coarse_s[1],
    )


def _decimation(band: Band, full: Affine) -> tuple[float, float]:
    step = ~full @ band.grid.transform
    return abs(step.a), abs(step.e)


def fit_tone(part: Roles, tiles: list[Tile], matrix: FloatArray, sigma: float) -> SyntheticPan | None:
    """Weights of the MS bands that reproduce PAN under the current transformation."""
    per_tile = max(_TONE_SAMPLES // len(tiles), 64)
    bands, target = [], []
    for tile in tiles:
        xy, take = _lattice(tile.template[0], part, per_tile)
        surfaces = [
            make_surface(band, part.surface.grid, surface_sigma(part, tile, sigma))
            for band in tile.surface
        ]
        place = part.to_surface(matrix, xy)[:, None]
        fine = [sample(surface, place) for surface in surfaces]
        good = np.logical_and.reduce([usable[:, 0] for _, usable in fine])
        good &= np.logical_and.reduce([band.valid[take] for band in tile.template])
        coarse = np.stack([band.data[take][good] for band in tile.template])
        smooth = np.stack(
            [v[good, 0] + s.level for (v, _), s in zip(fine, surfaces, strict=True)]
        )
        ms, pan = (coarse, smooth) if part.ms_is_template() else (smooth, coarse)
        bands.append(ms)
        target.append(pan[0])
    stacked, goal = np.concatenate(bands, axis=1), np.concatenate(target)
    return fit_synthetic_pan(stacked, goal) if len(goal) >= 64 else None


def _lattice(
    band: Band, part: Roles, count: int
) -> tuple[FloatArray, tuple[np.ndarray, np.ndarray]]:
    """About `count` pixels of a template band, evenly spread: full-raster centres, and indices."""
    height, width = band.data.shape
    step = max(int(np.sqrt(height * width / count)), 1)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    rows, columns = rows.ravel(), columns.ravel()
    to_full = ~part.template.grid.transform @ band.grid.transform
    x, y = to_full @ (columns + HALF_PIXEL, rows + HALF_PIXEL)
    return np.stack([x, y], axis=1), (rows, columns)


def tile_images(part: Roles, tile: Tile, tuning: Tuning) -> tuple[Band, Surface]:
    """The one template band and the one surface of a tile."""
    if part.ms_is_template():
        template, finer = tuning.tone(tile.template), tile.surface[0]
    else:
        template, finer = tile.template[0], tuning.tone(tile.surface)
    sigma = surface_sigma(part, tile, tuning.sigma)
    return template, make_surface(finer, part.surface.grid, sigma)


def fit_sigma(part: Roles, tiles: list[Tile], matrix: FloatArray, tuning: Tuning) -> float:
    """Low-pass with which the finer image resembles the coarser one most, in template pixels."""
    chosen = tiles[:: max(len(tiles) // _SIGMA_TILES, 1)][:_SIGMA_TILES]
    unlike = []
    for sigma in _SIGMA_CANDIDATES:
        total = 0.0
        for tile in chosen:
            template, surface = tile_images(part, tile, replace(tuning, sigma=sigma))
            xy, take = _lattice(template, part, 4000)
            values, usable = sample(surface, part.to_surface(matrix, xy)[:, None])
            good = usable[:, 0] & template.valid[take]
            total += _unexplained(values[good, 0], template.data[take][good])
        unlike.append(total)
    best = int(np.argmin(unlike))
    if best in (0, len(unlike) - 1):
        return _SIGMA_CANDIDATES[best]
    left, middle, right = unlike[best - 1 : best + 2]
    bend = left - 2 * middle + right
    offset = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return _SIGMA_CANDIDATES[best] + offset * (_SIGMA_CANDIDATES[1] - _SIGMA_CANDIDATES[0])


def _unexplained(one: Float32Array, other: Float32Array) -> float:
    if len(one) < 32 or not (one.std() > 0 and other.std() > 0):
        return 0.0
    return 1.0 - float(np.corrcoef(one, other)[0, 1]) ** 2


def match_pass(
    part: Roles,
    tiles: list[Tile],
    matrix: FloatArray,
    tuning: Tuning,
    options: RefineOptions,
    threads: int,
) -> Dense:
    """Match every patch of every tile once and fit an affine to those that agree."""

    def one(tile: Tile) -> Refined | None:
        template, surface = tile_images(part, tile, tuning)
        patches = cut_patches(template, part.template.grid, options.size)
        if not len(patches):
            return None
        return refine(patches, surface, lambda xy: part.to_surface(matrix, xy), options)

    with ThreadPoolExecutor(max(threads, 1)) as pool:
        parts = [r for r in pool.map(one, tiles) if r is not None]
    refined = _concatenate(parts)
    observations = _observe(part, refined, matrix)
    status = refined.status.copy()
    status[~np.isfinite(observations.covariance).all(axis=(1, 2))] = Status.TEXTURE
    return Dense(refined, observations, *_agreement(part, observations, status))


def _agreement(
    part: Roles, points: Observations, status: StatusArray
) -> tuple[StatusArray, Estimate | None]:
    """Robust fit of an affine (a shift where points are few) to the patches that agree.

    A robust mean of two motions is neither: where the patches scatter much beyond their own
    covariances, the motion that most of them share most closely is found first.
    """
    status = status.copy()
    kept = np.flatnonzero(status == Status.KEPT)
    model = "affine" if len(kept) >= 3 * minimum_points("affine") else "shift"
    if len(kept) < 2 * minimum_points(model):
        return status, None
    frame = part.pair.frame()
    unit = 1.0 if part.ms_is_template() else part.surface_px_per_template_px
    estimate = robust_fit(model, points.take(kept), frame)
    if np.sqrt(estimate.extra_variance_px2) > _MIXED_SIGMA * unit and model == "affine":
        inliers = _closest_agreement(points.take(kept), unit)
        status[kept[~inliers]] = Status.CONSENSUS
        kept = kept[inliers]
        if len(kept) < 2 * minimum_points(model):
            return status, None
        estimate = robust_fit(model, points.take(kept), frame)
    status[kept[~estimate.inlier]] = Status.RESIDUAL
    return status, estimate


def _closest_agreement(points: Observations, unit: float) -> BoolArray:
    """Points of the affine on which agreement is most surprising, over several tolerances."""
    best, least = np.ones(len(points), dtype=bool), np.inf
    quality = np.sqrt(points.covariance[:, 0, 0] + points.covariance[:, 1, 1])
    for threshold in _AGREEMENT_PX:
        found = consensus_affine(
            points.source, points.target, quality, threshold * unit, kind="affine"
        )
        if not np.isfinite(found.matrix).all():
            continue
        residual = radial_residuals(found.matrix, points.source, points.target)
        surprise, _ = log_nfa(residual, (3.0 * unit) ** 2, 3, threshold * unit)
        if surprise < least:
            best, least = residual < 2.0 * threshold * unit, surprise
    return best


def _concatenate(parts: list[Refined]) -> Refined:
    return Refined(
        np.concatenate([p.template_px for p in parts]),
        np.concatenate([p.surface_px for p in parts]),
        np.concatenate([p.covariance_px2 for p in parts]),
        np.concatenate([p.correlation for p in parts]),
        np.concatenate([p.status for p in parts]),
    )


def _observe(part: Roles, refined: Refined, matrix: FloatArray) -> Observations:
    """Patches as pairs of MS pixel and MS header pixel, with covariance in MS pixels."""
    if part.ms_is_template():
        target, covariance = part.pair.header_px(refined.surface_px, refined.covariance_px2)
        return Observations(refined.template_px, target, covariance)
    linear = matrix[:, :2]
    target = part.pair.mapping.inverse(refined.template_px)
    covariance = np.einsum("ij,pjk,lk->pil", linear, refined.covariance_px2, linear)
    return Observations(refined.surface_px, target, covariance)
