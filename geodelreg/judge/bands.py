"""Whether the bands of MS show the ground at one place, however far apart they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from affine import Affine

from geodelreg.coarse.correlation import best_shift
from geodelreg.fine.looks import mean_band
from geodelreg.fine.matching import BandPass, match_band, match_bands
from geodelreg.fine.overlay import Overlay
from geodelreg.fine.passes import Refinement
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.judge.words import lies
from geodelreg.pair import Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess
from geodelreg.values.raster import Band, Float32Array

_BAND_SHARE = 0.5
"""Of the patches that the best band matches: bands that match fewer have no say."""
_SURE_SIGMAS = 3.0
_CLEARLY = 0.9
"""Of the unexplained detail: bands that were moved have 0.75 and less, others 0.96 and more."""
_DETAIL_PX = 2.0
"""Of the overview: only detail finer than this tells one place from the next."""
_ALL_VALID = 0.99  # share of a pixel that was resampled; the rest is rounding
_FAR_PX = 0.5  # of the overview: what lies nearer, dense matching has looked at


@dataclass(frozen=True, slots=True)
class BandsApart:
    """The two bands that are furthest apart.

    Attributes
    ----------
    distance_px : float
        MS pixels between where they put the ground, beyond their standard errors; 0 of bands that
        agree.
    words : str
        Which bands, and how they lie.
    """

    distance_px: float = 0.0
    words: str = ""


def bands_apart(found: Sequence[BandPass], pair: Pair) -> BandsApart:
    """How far apart two bands put the ground by themselves, beyond their standard errors.

    The detectors of a pushbroom sensor see a place one band after the other, from slightly
    different directions.  The bands are made to agree on the ground, so what lies high above it,
    or moves, is elsewhere in each: clouds contradict themselves, the ground does not, unless the
    product is wrong.

    Parameters
    ----------
    found : sequence of BandPass
        Each of one band alone.
    pair : Pair
    """
    return next(_furthest(_heard(found), pair), (BandsApart(), 0, 0))[0]


def ground_apart(
    found: Sequence[BandPass], guess: Guess, pair: Pair, least_px: float
) -> BandsApart:
    """The same of the ground alone: two bands that look like each other where they say they lie.

    A band that only looks unlike PAN, as near infrared over a coast does, matches it at another
    place than its own.  So two bands are believed when each explains clearly more of the other's
    detail once it is moved to where both find the same ground.

    Parameters
    ----------
    found : sequence of BandPass
        Each of one band alone, few matches or many.
    guess : Guess
        With the images that are looked at.
    pair : Pair
    least_px : float
        MS pixels: bands that are no further apart are not looked at.
    """
    images = guess.images.source
    step = ~images[0].grid.transform @ pair.source.grid.transform
    at = pair.source_centre
    places = {p.band: p.found.estimate.map.forward(at)[0] for p in found if p.found.estimate}

    def unexplained(one: int, other: int) -> float:
        move = places[other] - places[one]
        back = (float(move[0] * step.a), float(move[1] * step.e))
        here = _unexplained(images[one], images[other], (0.0, 0.0))
        return _unexplained(images[one], images[other], back) / here if here > 0 else 1.0

    for apart, one, other in _furthest(found, pair):
        if apart.distance_px <= least_px:
            break
        if max(unexplained(one, other), unexplained(other, one)) < _CLEARLY:
            return apart
    return BandsApart()


def _furthest(found: Sequence[BandPass], pair: Pair) -> Iterator[tuple[BandsApart, int, int]]:
    """All pairs of bands that are apart beyond their standard errors, the furthest first."""
    at = pair.source_centre
    maps = [(p.band, p.found.estimate.map) for p in found if p.found.estimate is not None]
    if len(maps) < 2:
        return
    places = np.concatenate([m.forward(at) for _, m in maps])
    sigmas = np.array([float(m.sigma_at(at)[0]) for _, m in maps])
    odd = np.hypot(*(places - np.median(places, axis=0)).T)
    pairs = np.array(list(combinations(np.argsort(odd, kind="stable").tolist(), 2)))
    gaps = np.hypot(*(places[pairs[:, 0]] - places[pairs[:, 1]]).T)
    sure = gaps - _SURE_SIGMAS * np.hypot(*sigmas[pairs].T)
    for number in np.argsort(-sure, kind="stable"):
        if sure[number] <= 0:
            return
        one, other = pairs[number]
        # content that lies further right comes, at one pixel, from further left
        there, here = pair.header.forward(places[[other, one]])
        bands = maps[one][0], maps[other][0]
        names = [pair.source.band_names[pair.source_bands[band] - 1] for band in bands]
        words = f"{names[1]} {lies(here - there, names[0])}"
        yield BandsApart(float(sure[number]), words), *bands


def _heard(found: Sequence[BandPass]) -> list[BandPass]:
    enough = _BAND_SHARE * max((p.found.kept for p in found), default=0)
    return [p for p in found if p.found.estimate is not None and p.found.kept >= enough]


def find_bands(
    guess: Guess, refined: Refinement, correction: PixelMap, pool: Executor
) -> list[BandPass]:
    """Match some bands by themselves, those that do not match here where their edges say.

    Parameters
    ----------
    guess : Guess
        Its images are searched for bands that lie beyond the reach of dense matching.
    refined : Refinement
    correction : PixelMap
    pool : Executor
        Each band takes one of its threads.
    """
    part = refined.part
    where = (part, refined.tiles, refined.tuning, refined.size)
    found = match_bands(*where, correction, pool)
    heard = {p.band for p in _heard(found)}

    def further(near: BandPass) -> BandPass:
        known = near.band in heard or not heard
        start = None if known else _start(guess, part.pair, near.band, heard)
        return near if start is None else match_band(*where, start.then(correction), near.band)

    return list(pool.map(further, found))


def _start(guess: Guess, pair: Pair, band: int, heard: set[int]) -> AffineMap | None:
    """Where a band shows what the others show elsewhere: its pixels to theirs; None if nearby."""
    images = guess.images.source
    mine, others = images[band], mean_band([images[number] for number in sorted(heard - {band})])
    shift = best_shift(Overlay(others.data, mine.data, others.valid, mine.valid)).move
    if not np.hypot(*shift) > _FAR_PX:
        return None
    step = ~pair.source.grid.transform @ mine.grid.transform
    return AffineMap(Affine.translation(-shift[0] * step.a, -shift[1] * step.e))


def _unexplained(one: Band, other: Band, moved: tuple[float, float]) -> float:
    """Share of one band's detail, read (x, y) further, that the other does not explain."""
    height, width = one.valid.shape
    matrix = np.array([[1.0, 0.0, moved[0]], [0.0, 1.0, moved[1]]])
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    there = cv2.warpAffine(np.asarray(one.data, np.float32), matrix, (width, height), flags=how)
    usable = cv2.warpAffine(one.valid.astype(np.float32), matrix, (width, height), flags=how)
    window = np.ones((2 * round(3 * _DETAIL_PX) + 1,) * 2, dtype=np.uint8)
    inner = cv2.erode((other.valid & (usable > _ALL_VALID)).astype(np.uint8), window) > 0
    if not inner.any():
        return 1.0
    mine = _detail(np.asarray(there, np.float32))[inner]
    theirs = _detail(np.asarray(other.data, np.float32))[inner]
    energy = float(mine @ mine) * float(theirs @ theirs)
    return 1.0 - float(mine @ theirs) ** 2 / energy if energy > 0 else 1.0


def _detail(image: Float32Array) -> Float32Array:
    return np.asarray(image - cv2.GaussianBlur(image, (0, 0), _DETAIL_PX), dtype=np.float32)
