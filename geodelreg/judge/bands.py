"""Whether the bands of MS show the ground at one place, however far apart they are."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from affine import Affine

from geodelreg.coarse.correlation import best_shift
from geodelreg.fine.looks import mean_band
from geodelreg.fine.matching import BandPass, match_band, match_bands
from geodelreg.fine.overlay import Overlay, overlay
from geodelreg.fine.passes import COARSE_SIGMA, Refinement
from geodelreg.fine.surface import make_surface
from geodelreg.fine.tiles import overview_tile
from geodelreg.fine.tuning import surface_sigma
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.judge.words import lies
from geodelreg.pair import Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess
from geodelreg.values.raster import BoolArray, Float32Array

_BAND_SHARE = 0.5
"""Of the patches that the best band matches: bands that match fewer have no say."""
_SURE_SIGMAS = 3.0
_CLEARLY = 0.97
"""Of the unexplained detail: bands that were moved have 0.86 and less, others 1.00 and more."""
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


def bands_apart(found: Sequence[BandPass], pair: Pair, moved: set[int] | None = None) -> BandsApart:
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
    moved : set of int, optional
        One of the two bands is among these.
    """
    at = pair.source_centre
    maps = [(p.band, p.found.estimate.map) for p in _heard(found) if p.found.estimate is not None]
    if len(maps) < 2:
        return BandsApart()
    places = np.concatenate([m.forward(at) for _, m in maps])
    sigmas = [float(m.sigma_at(at)[0]) for _, m in maps]
    odd = np.hypot(*(places - np.median(places, axis=0)).T)
    best = BandsApart()
    for one, other in combinations(np.argsort(odd, kind="stable").tolist(), 2):
        gap = float(np.hypot(*(places[one] - places[other])))
        sure = gap - _SURE_SIGMAS * float(np.hypot(sigmas[one], sigmas[other]))
        counts = moved is None or maps[one][0] in moved or maps[other][0] in moved
        if counts and sure > best.distance_px:
            # content that lies further right comes, at one pixel, from further left
            there, here = pair.header.forward(places[[other, one]])
            names = [
                pair.source.band_names[pair.source_bands[maps[n][0]] - 1] for n in (one, other)
            ]
            best = BandsApart(sure, f"{names[1]} {lies(here - there, names[0])}")
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


def really_elsewhere(
    found: Sequence[BandPass], guess: Guess, refined: Refinement, correction: PixelMap
) -> set[int]:
    """Bands that all the others, PAN too, explain clearly better when they are moved back.

    A band that only looks unlike PAN, as near infrared over a coast does, matches it at another
    place than its own; moved there it is explained worse, for each of the others has a weight of
    its own and either sign.

    Parameters
    ----------
    found : sequence of BandPass
    guess : Guess
        With the images that are looked at.
    refined : Refinement
    correction : PixelMap
        The common one.

    Returns
    -------
    set of int
        Their `BandPass.band`.
    """
    part, images = refined.part, guess.images
    centre = part.pair.source_centre
    step = ~images.source[0].grid.transform @ part.pair.source.grid.transform
    shown = [np.asarray(band.data, np.float32) for band in images.source]
    valid = np.logical_and.reduce([band.valid for band in images.source])
    if part.ms_is_template:
        sigma = surface_sigma(part, overview_tile(part, images), COARSE_SIGMA)
        surface = make_surface(images.reference, part.surface.grid, sigma)
        seen = overlay(part, images.source[0], surface, correction)
        shown.append(seen.surface)
        valid &= seen.valid

    def gain(near: BandPass) -> float:
        if near.found.estimate is None:
            return 1.0
        move = (correction.forward(centre) - near.found.estimate.map.forward(centre))[0]
        back = (float(move[0] * step.a), float(move[1] * step.e))
        here = _unexplained(shown, valid, near.band, (0.0, 0.0))
        return _unexplained(shown, valid, near.band, back) / here if here > 0 else 1.0

    return {near.band for near in found if gain(near) < _CLEARLY}


def _unexplained(
    shown: Sequence[Float32Array],
    valid: BoolArray,
    band: int,
    moved: tuple[float, float],
) -> float:
    """Share of a band's detail that the others do not explain, when it is read (x, y) further."""
    height, width = valid.shape
    matrix = np.array([[1.0, 0.0, moved[0]], [0.0, 1.0, moved[1]]])
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    there = cv2.warpAffine(shown[band], matrix, (width, height), flags=how)
    usable = cv2.warpAffine(valid.astype(np.float32), matrix, (width, height), flags=how)
    window = np.ones((2 * round(3 * _DETAIL_PX) + 1,) * 2, dtype=np.uint8)
    inner = cv2.erode((valid & (usable > _ALL_VALID)).astype(np.uint8), window) > 0
    if not inner.any():
        return 1.0
    others = np.stack([_detail(one)[inner] for n, one in enumerate(shown) if n != band])
    target = _detail(np.asarray(there, np.float32))[inner]
    weights = np.linalg.lstsq(others @ others.T, others @ target, rcond=None)[0]
    energy = float((target**2).sum())
    return float(((target - weights @ others) ** 2).sum()) / energy if energy > 0 else 1.0


def _detail(image: Float32Array) -> Float32Array:
    return np.asarray(image - cv2.GaussianBlur(image, (0, 0), _DETAIL_PX), dtype=np.float32)
