"""One pass of matching: every patch of every tile, and what the patches that move together say."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from geodelreg.fine.layers import ELSEWHERE, Pass, agreement
from geodelreg.fine.least_squares import MAX_MOVE, ROUGH_STEP, Matched, MatchOptions, match_patches
from geodelreg.fine.patches import cut_patches, gather, sample_step
from geodelreg.fine.tiles import Tile
from geodelreg.fine.tone import single_band
from geodelreg.fine.tuning import Tuning, tile_images
from geodelreg.fit.chance import log_nfa
from geodelreg.fit.estimate import Observations
from geodelreg.fit.models import Frame
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.pair import Roles
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import FloatArray, StatusArray

_GROUP_PATCHES = 100  # by hand: ½ to 2 × alike
_BAND_PATCHES = 100  # or a few more: the band's sigma is a tenth of a patch's
_BANDS = 6  # evenly spread; by hand: ½ to 2 × alike
_BAND_TILES = 8  # evenly spread; by hand: ½ to 2 × alike


def match_pass(
    part: Roles,
    tiles: list[Tile],
    correction: PixelMap,
    tuning: Tuning,
    options: MatchOptions,
    threads: int = 0,
) -> Pass:
    """Match every patch of every tile once and fit an affine to those that agree.

    Parameters
    ----------
    part, tiles, correction, tuning, options, threads
        As for `match_tiles`.
    """
    matched = match_tiles(part, tiles, correction, tuning, options, threads)
    points = observe(part, matched, correction)
    status = matched.status.copy()
    status[~np.isfinite(points.covariance).all(axis=(1, 2))] = Status.TEXTURE
    frame = Frame.of(part.pair)
    unit = part.step if part.ms_is_template else part.surface_px_per_patch_px
    return Pass(matched, points, *agreement(points, status, correction, frame, unit))


def match_tiles(
    part: Roles,
    tiles: list[Tile],
    correction: PixelMap,
    tuning: Tuning,
    options: MatchOptions,
    threads: int = 0,
) -> Matched:
    """Match every patch of every tile once.

    Parameters
    ----------
    part : Roles
    tiles : list of Tile
    correction : PixelMap
        As it is known so far: MS pixels to MS header pixels.
    tuning : Tuning
    options : MatchOptions
    threads : int
        0 = those of the pair.
    """

    def one(group: list[Tile]) -> Matched | None:
        images = [tile_images(part, tile, tuning) for tile in group]
        grid, every = part.template.grid, slice(None, None, options.every)
        cut = [cut_patches(bands, grid, options.size).take(every) for bands, _ in images]
        patches = gather(cut)
        if not len(patches):
            return None
        return match_patches(patches, [surface for _, surface in images], there, options)

    there = part.to_surface(correction)
    with ThreadPoolExecutor(threads or part.pair.threads) as pool:
        found = [m for m in pool.map(one, _grouped(tiles, options)) if m is not None]
    return Matched.joined(found)


def _grouped(tiles: list[Tile], options: MatchOptions) -> Iterator[list[Tile]]:
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


def observe(part: Roles, matched: Matched, correction: PixelMap) -> Observations:
    """Patches as pairs of MS pixel and MS header pixel, with covariance in MS pixels."""
    back = Inverse(part.pair.header)
    if part.ms_is_template:
        target, covariance = back.carry(matched.surface_px, matched.covariance_px2)
        return Observations(matched.template_px, target, covariance)
    _, covariance = correction.carry(matched.surface_px, matched.covariance_px2)
    return Observations(matched.surface_px, back.forward(matched.template_px), covariance)


def tie_points(
    part: Roles,
    matched: Matched,
    correction: PixelMap,
    status: StatusArray,
    weight: FloatArray | None = None,
) -> TiePoints:
    """Patches as tie points between MS and PAN pixels, with residuals under a correction."""
    there = part.pair.to_reference(correction)
    if part.ms_is_template:
        source, reference = matched.template_px, matched.surface_px
        covariance = matched.covariance_px2
    else:
        source, reference = matched.surface_px, matched.template_px
        _, covariance = there.carry(source, matched.covariance_px2)
    residual = there.forward(source) - reference
    score = np.abs(matched.correlation)
    return TiePoints(source, reference, covariance, score, status, residual, weight)


def patches_log_nfa(part: Roles, points: TiePoints, sample_size: int) -> float:
    """Chance agreement of patches, each of which may end anywhere within its reach.

    Those that show something and match nowhere were asked, too.
    """
    matched = points.kept | np.isin(points.status, ELSEWHERE)
    asked = points.status != Status.TEXTURE
    gap = np.where(matched, np.hypot(*points.residual_px.T), np.inf)[asked]
    reach = 2 * MAX_MOVE * part.pan_px_per_patch_px
    return log_nfa(gap, reach**2, sample_size, reach / 2)[0]


class BandPass(NamedTuple):
    """What one MS band says by itself.

    Attributes
    ----------
    band : int
        Its place among the bands that are matched on, from 0.
    found : Pass
    """

    band: int
    found: Pass


def match_bands(
    part: Roles, tiles: list[Tile], tuning: Tuning, size: int, correction: PixelMap, pool: Executor
) -> list[BandPass]:
    """Some of the MS bands, evenly spread, each matched by itself; of one band none.

    Parameters
    ----------
    part, tiles, tuning, size, correction
        As for `match_band`.
    pool : Executor
        Each band takes one of its threads.
    """
    count = len(part.pair.source_bands)
    spread = np.linspace(0, count - 1, min(count, _BANDS)).round()
    one = partial(match_band, part, tiles, tuning, size, correction)
    return list(pool.map(one, map(int, spread if count > 1 else [])))


def match_band(
    part: Roles, tiles: list[Tile], tuning: Tuning, size: int, correction: PixelMap, band: int
) -> BandPass:
    """One MS band matched by itself, over some of the tiles, with one thread.

    Parameters
    ----------
    part, tiles, tuning, correction
        As for `match_pass`.
    size : int
        Side of a patch.
    band : int
        From 0.
    """
    some = tiles[:: max(len(tiles) // _BAND_TILES, 1)]
    every = sample_step([tile.template[0] for tile in some], size, _BAND_PATCHES)
    options = MatchOptions(size=size, tolerance=ROUGH_STEP, every=every)
    tone = single_band(len(part.pair.source_bands), band)
    alone = replace(tuning, tone=tone, local_tone=False)
    return BandPass(band, match_pass(part, some, correction, alone, options, threads=1))
