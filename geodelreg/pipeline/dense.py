"""Sub-pixel refinement over many small patches: tone, point spread, matching, robust fit."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from affine import Affine

from geodelreg.fit.estimate import Estimate, Observations, minimum_points, robust_fit
from geodelreg.fit.models import Frame, Transformation
from geodelreg.geo.pixel import pixel_centres
from geodelreg.image.synthetic_pan import SyntheticPan, fit_synthetic_pan, single_band
from geodelreg.match.consensus import consensus_affine
from geodelreg.match.refine import Refined, RefineOptions, cut_patches, gather, refine
from geodelreg.match.surface import Surface, high_pass, make_surface, sample
from geodelreg.pipeline.tiles import Roles, Tile
from geodelreg.types import Band, BoolArray, Float32Array, FloatArray, Status, StatusArray

logger = logging.getLogger(__name__)

DEFAULT_SIGMA = 0.5
_TONE_SAMPLES = 8_000
_LEAST_SAMPLES = 64
_MIXED_SIGMA = 0.03
_GROUP_PATCHES = 100
_CORE_SIGMAS = 1.5
_CORE_FLOOR_PX = 0.03
_SHIFT_SHARE = 0.15
_AFFINE_SHARE = 0.25
_CORE_REACH = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """What refinement knows about the two sensors.

    Attributes
    ----------
    sigma : float
        Gaussian low-pass that brings the finer image to the coarser one's sharpness, in template
        pixels.
    tone : SyntheticPan
    high_pass : float
        Take off the mean over this standard deviation, in template pixels; 0 = do not.  Haze and
        changed light are smooth, the ground's edges are not.
    local_tone : bool
        Weight the MS bands patch by patch instead of by `tone`; only where MS is the template.
    """

    sigma: float
    tone: SyntheticPan
    high_pass: float = 0.0
    local_tone: bool = False


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


def fit_tone(
    part: Roles,
    tiles: list[Tile],
    matrix: FloatArray,
    sigma: float,
    threads: int,
    samples: int = _TONE_SAMPLES,
) -> SyntheticPan:
    """Weights of the MS bands that reproduce PAN; the first band where none resembles it."""
    per_tile = max(samples // len(tiles), 64)

    def samples_of(tile: Tile) -> tuple[Float32Array, Float32Array]:
        xy, take = lattice(tile.template[0], part, per_tile)
        surfaces = _surfaces(part, tile, sigma)
        place = part.to_surface(matrix, xy)[:, None]
        fine = [sample(surface, place) for surface in surfaces]
        good = np.logical_and.reduce([usable[:, 0] for _, usable in fine])
        good &= np.logical_and.reduce([band.valid[take] for band in tile.template])
        coarse = np.stack([band.data[take][good] for band in tile.template])
        smooth = np.stack([v[good, 0] + s.level for (v, _), s in zip(fine, surfaces, strict=True)])
        return (coarse, smooth[0]) if part.ms_is_template() else (smooth, coarse[0])

    with ThreadPoolExecutor(max(threads, 1)) as pool:
        bands, target = zip(*pool.map(samples_of, tiles), strict=True)
    stacked, goal = np.concatenate(bands, axis=1), np.concatenate(target)
    fitted = fit_synthetic_pan(stacked, goal) if len(goal) >= _LEAST_SAMPLES else None
    return fitted or single_band(len(stacked), 0)


def _surfaces(part: Roles, tile: Tile, sigma: float) -> list[Surface]:
    low_pass, grid = surface_sigma(part, tile, sigma), part.surface.grid
    if len(tile.surface) == 1:
        return [tile.low_passed(grid, low_pass, 0.0)]
    return [make_surface(band, grid, low_pass) for band in tile.surface]


def lattice(
    band: Band, part: Roles, count: int
) -> tuple[FloatArray, tuple[np.ndarray, np.ndarray]]:
    """About `count` pixels of a template band, evenly spread: full-raster centres, and indices."""
    height, width = band.data.shape
    step = max(int(np.sqrt(height * width / count)), 1)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    rows, columns = rows.ravel(), columns.ravel()
    to_full = ~part.template.grid.transform @ band.grid.transform
    x, y = to_full @ (pixel_centres(columns), pixel_centres(rows))
    return np.stack([x, y], axis=1), (rows, columns)


def tile_images(part: Roles, tile: Tile, tuning: Tuning) -> tuple[list[Band], Surface]:
    """The template band (or the bands, with local tone) and the surface of a tile."""
    low_pass, wide = surface_sigma(part, tile, tuning.sigma), 0.0
    if tuning.high_pass:
        wide = float(np.mean(surface_sigma(part, tile, tuning.high_pass)))
    if part.ms_is_template():
        templates = tile.template if tuning.local_tone else [tuning.tone(tile.template)]
        surface = tile.low_passed(part.surface.grid, low_pass, wide)
    else:
        templates = tile.template[:1]
        finer = tuning.tone(tile.surface)
        surface = make_surface(finer, part.surface.grid, low_pass, wide)
    if tuning.high_pass:
        templates = [high_pass(band, tuning.high_pass) for band in templates]
    return templates, surface


def match_pass(
    part: Roles,
    tiles: list[Tile],
    matrix: FloatArray,
    tuning: Tuning,
    options: RefineOptions,
    threads: int,
) -> Dense:
    """Match every patch of every tile once and fit an affine to those that agree."""

    def one(group: list[Tile]) -> Refined | None:
        images = [tile_images(part, tile, tuning) for tile in group]
        patches = gather(
            [
                cut_patches(bands, part.template.grid, options.size).take(every)
                for bands, _ in images
            ]
        )
        if not len(patches):
            return None
        surfaces = [surface for _, surface in images]
        return refine(patches, surfaces, lambda xy: part.to_surface(matrix, xy), options)

    every = slice(None, None, options.every)
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        groups = _grouped(tiles, options)
        parts = [r for r in pool.map(one, groups) if r is not None]
    refined = _concatenate(parts)
    observations = _observe(part, refined, matrix)
    status = refined.status.copy()
    status[~np.isfinite(observations.covariance).all(axis=(1, 2))] = Status.TEXTURE
    return Dense(refined, observations, *agreement(part, observations, status, matrix))


def _grouped(tiles: list[Tile], options: RefineOptions) -> Iterator[list[Tile]]:
    """Neighbouring tiles that have enough patches together to be matched in one go.

    Groups are the same for any number of threads, and so is what is found.
    """
    group: list[Tile] = []
    count = 0
    for tile in tiles:
        height, width = tile.template[0].data.shape
        group.append(tile)
        count += -(-(height // options.size) * (width // options.size) // options.every)
        if count >= _GROUP_PATCHES:
            yield group
            group, count = [], 0
    if group:
        yield group


def agreement(
    part: Roles, points: Observations, status: StatusArray, matrix: FloatArray
) -> tuple[StatusArray, Estimate | None]:
    """Robust fit of an affine to the patches that agree; where they are few, of a shift.

    The shift is one of the current transformation, whose rotation and scale stay.

    A robust mean of two motions is neither: where the patches scatter beyond their own
    covariances, the motion that many of them share to within their noise is found first.
    """
    status = status.copy()
    kept = np.flatnonzero(status == Status.KEPT)
    frame = part.pair.frame()
    unit = part.step if part.ms_is_template() else part.surface_px_per_patch_px
    estimate = _fit_all(points.take(kept), matrix, frame)
    if estimate is not None and _is_mixed(estimate, unit):
        inliers = _rigid_core(points.take(kept), unit)
        status[kept[~inliers]] = Status.CONSENSUS
        kept = kept[inliers]
        estimate = _fit_all(points.take(kept), matrix, frame)
    if estimate is not None:
        status[kept[~estimate.inlier]] = Status.RESIDUAL
    return status, estimate


def _fit_all(points: Observations, matrix: FloatArray, frame: Frame) -> Estimate | None:
    """Robust affine through many points, shift of `matrix` through few, None through hardly any."""
    if len(points) >= 3 * minimum_points("affine"):
        return robust_fit("affine", points, frame)
    if len(points) >= 2 * minimum_points("shift"):
        return _shifted(points, matrix, frame)
    return None


def _is_mixed(estimate: Estimate, unit: float) -> bool:
    """True when points scatter around an affine by more than patches of one motion do."""
    if estimate.transformation.model == "shift":
        return False
    return bool(np.sqrt(estimate.extra_variance_px2) > _MIXED_SIGMA * unit)


def _shifted(points: Observations, matrix: FloatArray, frame: Frame) -> Estimate:
    """Robust shift on top of a transformation."""
    there = Transformation("affine", matrix)(points.source)
    estimate = robust_fit("shift", replace(points, source=there), frame)
    moved = matrix.copy()
    moved[:, 2] += estimate.transformation.matrix[:, 2]
    return replace(estimate, transformation=Transformation("shift", moved))


def _rigid_core(points: Observations, unit: float) -> BoolArray:
    """Points near the shift, or else the affine, that a fair share fits to within the noise.

    The ground is rigid: its patches agree to within their noise.  Clouds at various heights do not,
    however many they are.  The tolerance starts at the noise and grows until enough points agree.
    If they stand out from the others they are the core; over relief, which displaces neighbours
    alike and no place as it does the next, none do, and all points have their say.
    """
    variance = points.covariance[:, 0, 0] + points.covariance[:, 1, 1]
    tolerance = max(_CORE_SIGMAS * float(np.sqrt(np.median(variance))), _CORE_FLOOR_PX * unit)
    while tolerance <= unit:
        residuals = list(_rigid_residuals(points, variance, tolerance))
        shares = [float((np.hypot(*gap.T) <= tolerance).mean()) for gap in residuals]
        if shares[0] >= max(_SHIFT_SHARE, shares[-1] / 2):
            return _core(residuals[0], tolerance, variance)
        if shares[-1] >= _AFFINE_SHARE:
            return _core(residuals[-1], tolerance, variance)
        tolerance *= 1.5
    return np.ones(len(points), dtype=bool)


def _core(residual: FloatArray, tolerance: float, variance: FloatArray) -> BoolArray:
    """Points around 0, if more lie there than of a normal distribution as wide as theirs."""
    radius = np.hypot(*residual.T)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(residual.T)))
    fair = math.prod(math.erf(tolerance / (math.sqrt(2) * max(s, 1e-9))) for s in spread)
    if (radius <= tolerance).mean() < fair:
        return np.ones(len(radius), dtype=bool)
    return np.asarray(radius**2 < (_CORE_REACH * tolerance) ** 2 + 4.0 * variance)


def _rigid_residuals(
    points: Observations, variance: FloatArray, tolerance: float
) -> Iterator[FloatArray]:
    """(N, 2) residuals of the best shift of the header, then of the best affine."""
    move = points.target - points.source
    near = np.hypot(*(move[:, None] - move[None]).transpose(2, 0, 1)) <= tolerance
    yield move - move[near[int(near.sum(axis=1).argmax())]].mean(axis=0)
    found = consensus_affine(points.source, points.target, variance, tolerance, kind="affine")
    if np.isfinite(found.matrix).all():
        yield points.target - Transformation("affine", found.matrix)(points.source)


def _concatenate(parts: list[Refined]) -> Refined:
    if not parts:
        nothing = np.empty((0, 2))
        status = np.empty(0, dtype=np.uint8)
        return Refined(nothing, nothing, np.empty((0, 2, 2)), np.empty(0), status)
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
