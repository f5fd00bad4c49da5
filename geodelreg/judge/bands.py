"""Whether the bands of MS show the ground at one place, however far apart they are."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations

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

_BAND_SHARE = 0.5
"""Of the patches that the best band matches: bands that match fewer have no say."""
_SURE_SIGMAS = 3.0
_FAR_PX = 1.0  # of the overview: what lies nearer, dense matching has looked at


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
        if sure > best.distance_px:
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
    shift = best_shift(Overlay(others.data, mine.data, others.valid, mine.valid))
    if not np.hypot(*shift) > _FAR_PX:
        return None
    step = ~pair.source.grid.transform @ mine.grid.transform
    return AffineMap(Affine.translation(-shift[0] * step.a, -shift[1] * step.e))
