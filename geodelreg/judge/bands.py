"""Whether the bands of MS show the ground at one place, however far apart they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from affine import Affine

from geodelreg.coarse.correlation import best_shift
from geodelreg.fine.band_offsets import BandOffsets, BandPatches
from geodelreg.fine.looks import mean_band
from geodelreg.fine.matching import BandPass, match_band, match_bands
from geodelreg.fine.overlay import Overlay
from geodelreg.fine.passes import Refinement
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.judge.unshared import PULL_PX
from geodelreg.judge.words import lies
from geodelreg.pair import Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess, Status
from geodelreg.values.raster import TINY, FloatArray

_BAND_SHARE = 0.5
"""Of the patches that the best band matches: bands that match fewer have no say."""
_SURE_SIGMAS = 3.0
_TWO_SIDED_95 = 1.96  # standard errors
_NEAR_PX = 0.25  # of MS: one step from where the bands lie is right of less, and too long of more
_ALIKE = 0.5  # of a band's variance, which other bands leave: of less it shows what they show
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
    asked = _must_agree(pair)
    heard = _heard([one for one in found if one.band in asked])
    furthest = next(_gaps(heard, pair), None)
    return BandsApart() if furthest is None else furthest.told(pair)


def ask_bands(
    guess: Guess, refined: Refinement, correction: PixelMap, told_px: float, pool: Executor
) -> tuple[BandsApart, BandsApart]:
    """How far apart bands lie by what they match on PAN, and the ground alone on other bands.

    Where one step tells that bands which show the same lie together, PAN is not asked.

    Parameters
    ----------
    guess : Guess
        Its images are searched for bands that lie beyond the reach of dense matching.
    refined : Refinement
    correction : PixelMap
    told_px : float
        MS pixels: bands that are surely no further apart are not looked at closely.
    pool : Executor
        Each band takes one of its threads.
    """
    part, last = refined.part, refined.last
    ground = last.matched.template_px[last.status == Status.KEPT]
    patches = BandPatches(part, refined.tiles, ground, correction, refined.size)
    glance = patches.glance()
    if glance is None:
        return bands_apart(find_bands(guess, refined, correction, pool), part.pair), BandsApart()
    nearby = _furthest(glance, part.pair)
    # one step is right of small offsets, and what would be told is looked at closely
    widest = max((np.hypot(*glance.gap(*two)[0]) for two in _pairs(glance, part.pair)), default=0.0)
    right = bool(widest <= _NEAR_PX and nearby.distance_px <= told_px)
    if right and glance.unexplained.max() < _ALIKE:
        return BandsApart(), nearby
    found = find_bands(guess, refined, correction, pool)
    elsewhere = next(_gaps(found, part.pair), None)
    starts = [np.zeros_like(glance.offset_px)]
    if elsewhere is not None and elsewhere.sure_px > told_px:
        starts.append(_by_pan(found, part.pair))
    if len(starts) > 1 or not right:
        nearby = _ground_apart(patches, glance, starts, part.pair)
    return bands_apart(found, part.pair), nearby


def _ground_apart(
    patches: BandPatches, glance: BandOffsets, starts: Sequence[FloatArray], pair: Pair
) -> BandsApart:
    """How far apart the bands put the ground alone: each band matched on all other bands.

    A band that only looks unlike PAN, as near infrared over a coast does, matches it at another
    place than its own; among bands, what it shows alone widens its standard error.
    """
    sought = [offsets for start in starts if (offsets := patches.measure(start)) is not None]
    # a band at a place that is not its own is explained worse
    known = min(sought, key=lambda one: float(np.log(one.unexplained + TINY).sum()), default=glance)
    return _furthest(known, pair)


def _furthest(known: BandOffsets, pair: Pair) -> BandsApart:
    """The two bands whose ground is furthest apart, beyond its error."""
    best = BandsApart()
    for one, other in _pairs(known, pair):
        move, sigma_px = known.gap(one, other)
        pull_px = PULL_PX * float(np.sqrt(known.unexplained[one] + known.unexplained[other]))
        sure_px = float(np.hypot(*move)) - _TWO_SIDED_95 * float(np.hypot(sigma_px, pull_px))
        if sure_px > best.distance_px:
            best = BandsApart(sure_px, _told(pair, one, other, move))
    return best


def _pairs(known: BandOffsets, pair: Pair) -> list[tuple[int, int]]:
    """All pairs of the bands that must agree, those that lie most like the others first."""
    odd = np.hypot(*(known.offset_px - np.median(known.offset_px, axis=0)).T)
    return list(combinations(sorted(_must_agree(pair), key=lambda band: odd[band]), 2))


def _must_agree(pair: Pair) -> list[int]:
    """The bands that were named, else all, by their place among those read.

    Those without a weight, too: they may have lost it by lying elsewhere.
    """
    named = pair.options.agreeing_bands or pair.source_bands
    return [pair.source_bands.index(number) for number in named if number in pair.source_bands]


def _by_pan(found: Sequence[BandPass], pair: Pair) -> FloatArray:
    """(B, 2) offsets of the bands, MS pixels, as PAN says."""
    at, offsets = pair.source_centre, np.zeros((len(pair.source_bands), 2))
    maps = [(p.band, p.found.estimate.map) for p in found if p.found.estimate is not None]
    places = np.concatenate([m.forward(at) for _, m in maps])
    # content that lies further right comes, at one pixel, from further left
    offsets[[band for band, _ in maps]] = np.median(places, axis=0) - places
    return offsets


def _told(pair: Pair, one: int, other: int, move: FloatArray) -> str:
    """How the second band lies to the first, (2,) MS pixels off."""
    names = [pair.source.band_names[pair.source_bands[n] - 1] for n in (one, other)]
    local = pair.header.linearise(pair.source_centre)[0, :, :2]
    return f"{names[1]} {lies(local @ move, names[0])}"


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
        words = _told(pair, self.one, self.other, self.here - self.there)
        return BandsApart(max(self.sure_px, 0.0), words)


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
