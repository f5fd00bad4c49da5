"""Whether the bands of MS show the ground at one place, however far apart they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
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
from geodelreg.values.raster import Band, Float32Array, FloatArray

_BAND_SHARE = 0.5
"""Of the patches that the best band matches: bands that match fewer have no say."""
_SURE_SIGMAS = 3.0
_CLEARLY = 0.9
"""Of the unexplained detail: bands that were moved have 0.75 and less, others 0.96 and more."""
_DETAIL_PX = 2.0
"""Of the overview: only detail finer than this tells one place from the next."""
_AROUND_PX = 0.5
"""Of the overview: within this a parabola follows what remains unexplained."""
_NO_MOVE = np.zeros(2)
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
    furthest = next(_gaps(_heard(found), pair), None)
    return BandsApart() if furthest is None else furthest.told(pair)


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
    scale = np.array([step.a, step.e])
    best, most = BandsApart(), 0.0
    for gap in _gaps(found, pair):
        if gap.sure_px <= least_px:
            break
        one, other, move = images[gap.one], images[gap.other], (gap.there - gap.here) * scale
        little = _CLEARLY * _unexplained(one, other, _NO_MOVE)
        there = _unexplained(one, other, move)
        if there < little and _unexplained(other, one, -move) < little:
            closer = gap.here + _closer(one, other, move, there) / scale
            told = replace(gap, there=closer).told(pair)
            # of pairs as far apart, the one that looks most alike is surest of where it lies
            if told.distance_px * (1.0 - there) > most:
                best, most = told, told.distance_px * (1.0 - there)
    return best if best.distance_px > least_px else BandsApart()


@dataclass(frozen=True, slots=True, eq=False)
class _Gap:
    """Two bands, and where each puts the centre of MS, in header pixels."""

    one: int
    other: int
    here: FloatArray
    there: FloatArray
    sigma_px: float

    @property
    def sure_px(self) -> float:
        return float(np.hypot(*(self.there - self.here))) - _SURE_SIGMAS * self.sigma_px

    def told(self, pair: Pair) -> BandsApart:
        # content that lies further right comes, at one pixel, from further left
        move = np.diff(pair.header.forward(np.stack([self.there, self.here])), axis=0)[0]
        one, other = (
            pair.source.band_names[pair.source_bands[n] - 1] for n in (self.one, self.other)
        )
        return BandsApart(max(self.sure_px, 0.0), f"{other} {lies(move, one)}")


def _gaps(found: Sequence[BandPass], pair: Pair) -> Iterator[_Gap]:
    """All pairs of bands that are apart beyond their standard errors, the furthest first."""
    at = pair.source_centre
    maps = [(p.band, p.found.estimate.map) for p in found if p.found.estimate is not None]
    if len(maps) < 2:
        return
    places = np.concatenate([m.forward(at) for _, m in maps])
    sigmas = [float(m.sigma_at(at)[0]) for _, m in maps]
    odd = np.hypot(*(places - np.median(places, axis=0)).T)
    gaps = [
        _Gap(
            maps[n][0], maps[m][0], places[n], places[m], float(np.hypot(sigmas[n], sigmas[m]))
        )
        for n, m in combinations(np.argsort(odd, kind="stable").tolist(), 2)
    ]  # fmt: skip
    yield from sorted((gap for gap in gaps if gap.sure_px > 0), key=lambda gap: -gap.sure_px)


def _closer(one: Band, other: Band, move: FloatArray, there: float) -> FloatArray:
    """The move, pixels of the images, at which the bands explain most of each other.

    A band that looks unlike PAN is matched to it some tenths of a pixel off; another band is not.
    """
    best = move.copy()
    for axis in np.eye(2) * _AROUND_PX:
        before, after = (_unexplained(one, other, move + side * axis) for side in (-1.0, 1.0))
        bend = before - 2.0 * there + after
        if bend > 0:
            best += np.clip((before - after) / (2.0 * bend), -1.0, 1.0) * axis
    return best


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


def _unexplained(one: Band, other: Band, moved: FloatArray) -> float:
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
