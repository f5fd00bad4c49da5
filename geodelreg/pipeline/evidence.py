"""Evidence from pixels that the fit has not used, and grey-value measures before and after."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from affine import Affine

from geodelreg.fit.gate import log10_binomial_tail
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.pixel import pixel_centres
from geodelreg.image.synthetic_pan import single_band
from geodelreg.match.area import Overlay
from geodelreg.match.refine import ROUGH_STEP, Patches, RefineOptions, cut_patches
from geodelreg.match.surface import Surface, sample
from geodelreg.pipeline.dense import Dense, Tuning, match_pass, tile_images
from geodelreg.pipeline.tiles import Roles, Tile
from geodelreg.types import Band, FloatArray, Grid, IntArray, Status, TiePoints

_DISPLACED_RADII = (4.0, 9.0)
_DIRECTIONS = 8
_BY_CHANCE = 0.125
_TESTED_PATCHES = 160
_BAND_PATCHES = 100
_LEAST_SEEN = 0.6
_LEAST_DISPLACED = 8
_RESEMBLES = 0.25
_BANDS = 6
_BAND_SHARE = 0.5
_BAND_TILES = 8
_SURE_SIGMAS = 3.0
_RIVAL_TOLERANCE = 0.2
_RIVAL_SIGMA = 0.5
_RIVAL_SCORE = 0.5
_WIDEST = 2
_OVERLAY_ROWS = 128
_E1_PIXELS = 40_000


@dataclass(frozen=True, slots=True)
class AreaEvidence:
    """How areas correlate where the correction puts them.

    Attributes
    ----------
    tested, best_in_place : int
        Textured patches, and those that correlate better in place than at any displaced place.
    alike, alike_in_place : int
        The same of patches that resemble the other image at any of the places.
    log_chance : float
        log10 of the probability of `best_in_place` by chance.
    """

    tested: int = 0
    best_in_place: int = 0
    alike: int = 0
    alike_in_place: int = 0

    @property
    def log_chance(self) -> float:
        """log10 P(as many by chance)."""
        return log10_binomial_tail(self.best_in_place, self.tested, _BY_CHANCE)

    @property
    def support(self) -> float:
        """Share of the patches that resemble something that do so best in place; NaN of none."""
        return self.alike_in_place / self.alike if self.alike else float("nan")

    def plus(self, other: AreaEvidence) -> AreaEvidence:
        """Of both together."""
        return AreaEvidence(
            self.tested + other.tested,
            self.best_in_place + other.best_in_place,
            self.alike + other.alike,
            self.alike_in_place + other.alike_in_place,
        )


def area_evidence(
    part: Roles, tiles: list[Tile], matrix: FloatArray, tuning: Tuning, size: int, few: bool
) -> AreaEvidence:
    """Compare correlation in place with that at displaced places, patch by patch.

    Parameters
    ----------
    part, tiles, matrix, tuning
        As for `geodelreg.pipeline.dense.match_pass`.
    size : int
        Side of a patch, template pixels.
    few : bool
        Test a sample of the patches instead of all.
    """
    angle = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.concatenate([np.zeros((1, 2)), *(ring * radius for radius in _DISPLACED_RADII)])
    every = _sample_step(tiles, size, _TESTED_PATCHES) if few else 1
    found = AreaEvidence()
    for number, tile in enumerate(tiles):
        bands, surface = tile_images(part, tile, tuning)
        patches = cut_patches(bands, part.template.grid, size)
        chosen = np.arange(number % every, len(patches), every)
        scores = _explained(part, matrix, surface, patches, chosen, offsets)
        found = found.plus(best_in_place(scores))
    return found


def _sample_step(tiles: list[Tile], size: int, wanted: int) -> int:
    """Every which patch to look at, so that the wanted number or a few more are."""
    shapes = [tile.template[0].data.shape for tile in tiles]
    count = int(sum((height // size) * (width // size) for height, width in shapes))
    return max(count // wanted, 1)


def best_in_place(scores: FloatArray) -> AreaEvidence:
    """Count the patches that score best in place.

    Parameters
    ----------
    scores : (P, K) float64
        In place first, then at displaced places; NaN where a place cannot be seen.
    """
    seen = np.isfinite(scores)
    enough = seen[:, 0] & (seen[:, 1:].sum(axis=1) >= _LEAST_DISPLACED)
    ranked = np.where(seen[enough], scores[enough], -np.inf)
    if not len(ranked):
        return AreaEvidence()
    best = ranked.argmax(axis=1) == 0
    alike = ranked.max(axis=1) >= _RESEMBLES
    return AreaEvidence(len(best), int(best.sum()), int(alike.sum()), int((best & alike).sum()))


def bands_apart(
    part: Roles, tiles: list[Tile], matrix: FloatArray, tuning: Tuning, size: int, pool: Executor
) -> float:
    """How far apart two bands put the ground by themselves, beyond their standard errors.

    The detectors of a pushbroom sensor see a place one band after the other, from slightly
    different directions.  The bands are made to agree on the ground, so what lies high above it,
    or moves, is elsewhere in each: clouds contradict themselves, the ground does not.

    Parameters
    ----------
    part, tiles, matrix, tuning, size
        As for `geodelreg.pipeline.dense.match_pass`.
    pool : Executor
        Matches the bands, each in one thread.

    Returns
    -------
    float
        Pixels of a patch at the centre of the MS raster, of the two bands that are furthest apart;
        0 where fewer than two match as many patches as half of what the best one does.
    """
    pair = part.pair
    height, width = pair.source.grid.shape
    centre = np.array([[width / 2, height / 2]])
    count = len(pair.source_bands)
    some = tiles[:: max(len(tiles) // _BAND_TILES, 1)]
    options = RefineOptions(
        size=size, tolerance=ROUGH_STEP, every=_sample_step(some, size, _BAND_PATCHES)
    )

    def by_itself(band: int) -> Dense:
        alone = replace(tuning, tone=single_band(count, band), local_tone=False)
        return match_pass(part, some, matrix, alone, options, 1)

    matched = list(pool.map(by_itself, _spread(count, _BANDS) if count > 1 else []))
    found = []
    for dense in matched:
        if dense.estimate is not None:
            place = dense.estimate.transformation(centre)[0]
            kept = int((dense.status == Status.KEPT).sum())
            found.append((kept, float(dense.estimate.sigma_at(centre)[0]), place))
    enough = _BAND_SHARE * max((kept for kept, _, _ in found), default=0)
    seen = [(sigma, place) for kept, sigma, place in found if kept >= enough]
    apart = [
        float(np.hypot(*(here - there))) - _SURE_SIGMAS * float(np.hypot(one, other))
        for (one, here), (other, there) in combinations(seen, 2)
    ]
    return max([0.0, *apart]) * pair.pan_px_per_source_px / part.pan_px_per_patch_px


def _spread(count: int, most: int) -> list[int]:
    """At most so many indices, evenly spread from the first to the last."""
    return [int(i) for i in np.linspace(0, count - 1, min(count, most)).round()]


def rival_motion(points: TiePoints, unit_px: float) -> float:
    """Patches that agree on another motion over those that agree on the correction's.

    Clouds of one height move alike, and so do waves: where the correction follows one such layer,
    the patches on the ground, or on the other layers, agree on something else.

    Parameters
    ----------
    points : TiePoints
        With residuals under the correction.
    unit_px : float
        PAN pixels to one pixel of the coarser image.

    Returns
    -------
    float
        0 where the rest agrees on nothing; infinite where no point is kept.
    """
    sharp = (points.sigma_px < _RIVAL_SIGMA * unit_px).all(axis=1)
    tolerance = _RIVAL_TOLERANCE * unit_px
    with np.errstate(invalid="ignore"):
        away = np.hypot(*points.residual_px.T) > 2 * tolerance
    rest = points.residual_px[~points.kept & sharp & away & (points.score > _RIVAL_SCORE)]
    kept = int(points.kept.sum())
    if not len(rest) or not kept:
        return 0.0 if kept else float("inf")
    gap = np.hypot(*(rest[:, None] - rest[None]).transpose(2, 0, 1))
    return float((gap <= tolerance).sum(axis=1).max()) / kept


def _explained(
    part: Roles,
    matrix: FloatArray,
    surface: Surface,
    patches: Patches,
    chosen: IntArray,
    offsets: FloatArray,
) -> FloatArray:
    """(P, K) share of the surface's variance that the bands explain, per patch and offset.

    NaN where too little of the patch lies on the surface; patches without texture are left out.
    """
    size = patches.size
    picked = np.arange(0, size, 2)
    axis = pixel_centres(picked) - size / 2.0
    grid_x, grid_y = np.meshgrid(axis, axis)
    inside = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    take = (picked[:, None] * size + picked[None, :]).ravel()
    spots = (offsets[:, None, :] + inside[None]).reshape(-1, 2) * patches.step
    xy = patches.centre[chosen][:, None, :] + spots[None]
    there, usable = sample(surface, part.to_surface(matrix, xy))
    shape = (len(chosen), len(offsets), len(take))
    seen = usable.reshape(shape) & patches.valid[chosen][:, None, take]
    weight = seen.astype(np.float64)[:, :, None]
    values = patches.values[chosen][:, None, :, take]
    alike = bool((seen == seen[:, :1]).all())  # then one basis serves all offsets
    bands = _centred(values.astype(np.float64), weight[:, :1] if alike else weight)
    image = _centred(there.reshape(shape)[:, :, None].astype(np.float64), weight)
    basis, _ = np.linalg.qr(bands.swapaxes(2, 3))
    explained = (np.matmul(image, basis) ** 2).sum(axis=(2, 3))
    energy = (image**2).sum(axis=(2, 3))
    good = seen.mean(axis=2) > _LEAST_SEEN
    good &= (np.abs(bands).sum(axis=(2, 3)) > 0) & (energy > 0)
    return np.where(good, explained / np.where(good, energy, 1.0), np.nan)


def _centred(values: FloatArray, weight: FloatArray) -> FloatArray:
    total = np.maximum(weight.sum(axis=-1, keepdims=True), 1.0)
    mean = (values * weight).sum(axis=-1, keepdims=True) / total
    return np.asarray((values - mean) * weight)


def overlay(part: Roles, template: Band, surface: Surface, matrix: FloatArray) -> Overlay:
    """Resample a surface onto a (decimated) template window under a correction `matrix`."""
    height, width = template.data.shape
    to_full = ~part.template.grid.transform @ template.grid.transform
    values = np.empty((height, width), dtype=np.float32)
    usable = np.empty((height, width), dtype=np.bool_)
    for top in range(0, height, _OVERLAY_ROWS):  # positions need ten times the memory of values
        some = slice(top, min(top + _OVERLAY_ROWS, height))
        sides = (np.arange(width), np.arange(some.start, some.stop))
        x, y = to_full @ tuple(np.meshgrid(*(pixel_centres(side) for side in sides)))
        xy = np.stack([x, y], axis=-1)
        values[some], usable[some] = sample(surface, part.to_surface(matrix, xy))
    return Overlay(template.data, values, template.valid, usable)


def widened(part: Roles, template: Band, surface: Band, matrix: FloatArray) -> Band:
    """The template band with empty margins where the surface band has more to show.

    A rival place may lie there: of a repeated texture that was aligned too far out, the next period
    further in.  No margin is more than half as wide as the band.
    """
    height, width = surface.data.shape
    ring = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    full = apply_affine(~part.surface.grid.transform @ surface.grid.transform, ring)
    back = ~template.grid.transform @ part.template.grid.transform
    seen = apply_affine(back, part.to_template(matrix, full))
    rows, columns = template.data.shape
    if not np.isfinite(seen).all():
        return template
    low, high = -seen.min(axis=0), seen.max(axis=0) - (columns, rows)
    limit = (columns // _WIDEST, rows // _WIDEST)
    left, top = (int(v) for v in np.clip(np.ceil(low), 0, limit))
    right, bottom = (int(v) for v in np.clip(np.ceil(high), 0, limit))
    margins = ((top, bottom), (left, right))
    data, valid = np.pad(template.data, margins), np.pad(template.valid, margins)
    moved = template.grid.transform @ Affine.translation(-left, -top)
    return replace(
        template, data=data, valid=valid, grid=Grid(moved, data.shape, template.grid.crs_wkt)
    )


def grey_rmse(overlaid: Overlay, ms_is_template: bool) -> float:
    """E1: RMSE of grey values between PAN and MS after histogram matching, in DN of PAN.

    Zhang, Ma & Zhang 2013, on common valid pixels, of which so many are as good as all.
    """
    good = np.flatnonzero(overlaid.valid)
    if len(good) < 64:
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
    if good.sum() < 64:
        return float("nan")
    one, other = overlaid.template[good], overlaid.surface[good]
    if one.std() == 0 or other.std() == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])
