"""Matching through a field until it stands still.

Patches matched through a map measure what is left between it and the truth, averaged over their
area.  Matched through the map that they themselves gave, what is left shrinks, and with it what the
averaging hides: the field gets sharper than its patches are wide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geodelreg.fine.least_squares import Matched, MatchOptions
from geodelreg.fine.matching import match_tiles, observe
from geodelreg.fine.motions import largest_layer
from geodelreg.fine.passes import Refinement
from geodelreg.fine.tiles import SMALLEST_PATCH_PX, patch_size, plan_tiles, read_tiles
from geodelreg.fine.tuning import fit_sigma, fit_tone
from geodelreg.fit.estimate import Observations
from geodelreg.fit.field import FieldFit, determine_field, fit_field
from geodelreg.fit.jumps import cut_at_jumps
from geodelreg.geo.maps.field import FieldMap
from geodelreg.pair import overlap_in_template
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Status
from geodelreg.values.raster import FloatArray, IntArray, StatusArray

_MOST_PASSES = 4  # by hand, untried
_TUNED_PASSES = 2  # then tone and point spread are known
_STANDS_STILL = 0.2  # of its standard error; by hand, untried
_TONE_TILES = 120  # of a hundred samples each: weights of bands are then known to a percent
_STEEP = 4.0
"""Patches within which the residual varies, below which smaller ones are tried."""
_FLATTENED = (25 + 25 + 2 * 25 / 3) ** 0.5 / 24
"""Of a Matérn 5/2 field of unit variance and range, RMS of what its mean over a unit square hides:
1/24, the square's second moment, times the Laplacian, whose variance that is."""
_NOISY = 2.0
"""Scatter over the patches' own errors, above which it may be variation within them."""
_TOLERANCE = 0.005  # of a patch pixel; by hand, untried
_ITERATIONS = 5  # of the first pass; by hand, untried
_LATER_ITERATIONS = 3  # by hand, untried


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Where the passes ended.

    Attributes
    ----------
    fit : FieldFit
        Of the patches of the last pass that are the ground's.
    matched : Matched
        All patches of the last pass.
    points : Observations
        The same, in MS pixels.
    ground : (G,) intp
        Those that `fit` was given.
    refined : Refinement
        With the tiles, the tuning and the size of the patches.
    """

    fit: FieldFit
    matched: Matched
    points: Observations
    ground: IntArray
    refined: Refinement

    @property
    def status(self) -> StatusArray:
        """(P,) what became of each patch."""
        status = self.matched.status.copy()
        rejected = status == Status.KEPT
        rejected[self.ground] = False
        status[rejected] = Status.CONSENSUS
        status[self.ground[~self.fit.inlier]] = Status.RESIDUAL
        return status

    @property
    def weight(self) -> FloatArray:
        """(P,) of each patch in the fit; NaN of those that it does not stand on."""
        weight = np.full(len(self.matched.status), np.nan)
        weight[self.ground[self.fit.inlier]] = self.fit.weight
        return weight


def settle(refined: Refinement, start: PixelMap) -> Settled | None:
    """Match and fit in turn until the next pass would move the field by less than it is uncertain.

    A look that was chosen because patches disagreed, as they do where the ground bends, is held
    against the plain one.  Smaller patches are tried where the field bends within few of them.

    Parameters
    ----------
    refined : Refinement
    start : PixelMap
        MS pixels to MS header pixels.

    Returns
    -------
    Settled or None
        None when too few patches matched.
    """
    refined = _everywhere(refined, start)
    plain = replace(refined, tuning=replace(refined.tuning, high_pass=0.0, local_tone=False))
    looks = [refined, plain] if refined.tuning.high_pass or refined.tuning.local_tone else [plain]
    found = [one for one in (_passes(look, start, look.size) for look in looks) if one is not None]
    best = min(found, key=_unknown, default=None)
    if best is not None and refined.size > SMALLEST_PATCH_PX and _bends(best):
        finer = _passes(best.refined, best.fit.field, SMALLEST_PATCH_PX)
        if finer is not None and _unknown(finer) < _unknown(best):
            return finer
    return best


def _everywhere(refined: Refinement, start: PixelMap) -> Refinement:
    """With tiles that leave out neither bright objects, which are the ground's, nor the borders.

    Parameters
    ----------
    refined : Refinement
    start : PixelMap
    """
    part = refined.part
    region = overlap_in_template(part, start)
    if region is None:
        return refined
    tiles = read_tiles(part, plan_tiles(region, part, dense=True), start)
    size = refined.size
    if refined.dark_only:  # they may be smaller because much was hidden
        size = patch_size(region.width * region.height / part.step**2)
    return replace(refined, tiles=tiles, size=size, dark_only=False) if tiles else refined


def _passes(refined: Refinement, start: PixelMap, size: int) -> Settled | None:
    part, tiles, tuning = refined.part, refined.tiles, refined.tuning
    current, settled, moved = start, None, 0.0
    kernel = start.kernel if isinstance(start, FieldMap) else None
    options = MatchOptions(size, _ITERATIONS, _TOLERANCE, bent=True)
    some_tiles = tiles[:: 1 + len(tiles) // _TONE_TILES]
    for number in range(1, _MOST_PASSES + 1):
        if number <= _TUNED_PASSES:
            tone = fit_tone(part, some_tiles, current, tuning.sigma)
            tuning = replace(tuning, tone=tone)
        if settled is not None and number <= _TUNED_PASSES and not tuning.local_tone:
            agreed = settled.matched.template_px[settled.ground[settled.fit.inlier]]
            sigma = fit_sigma(part, tiles, current, agreed, tuning, size)
            tuning = replace(tuning, sigma=sigma)
        matched = match_tiles(part, tiles, current, tuning, options)
        points = observe(part, matched, current)
        good = np.flatnonzero(matched.status == Status.KEPT)
        good = good[np.isfinite(points.covariance[good]).all(axis=(1, 2))]
        some = points.take(good)
        ground = good[largest_layer(some, current)]
        some = points.take(ground)
        if not determine_field(some):
            return settled
        if settled is None:
            fit = cut_at_jumps(some, fit_field(some, kernel))
        else:
            fit = fit_field(some, kernel, settled.fit.field.jumps)
        there = replace(refined, tuning=tuning, size=size)
        settled = Settled(fit, matched, points, ground, there)
        before, moved = moved, _rms(fit.field.forward(some.source) - current.forward(some.source))
        current, kernel = fit.field, fit.field.kernel
        # what is left shrinks from pass to pass as it did before the last one
        shrinks = min(moved / before, 1.0) if number > 1 else 1.0
        if moved * shrinks < _STANDS_STILL * _sigma(settled):
            break
        options = replace(options, iterations=_LATER_ITERATIONS)
    return settled


def _bends(settled: Settled) -> bool:
    """True when smaller patches may tell more.

    The field varies within few patches, or their means hide more of it than they are uncertain, or
    what looks like noise may be the field.
    """
    kernel, size = settled.fit.field.kernel, settled.refined.size
    own = float(np.median(settled.points.variances[settled.ground].sum(axis=1))) / 2
    variance = max(kernel.variance_px2)
    steep = variance > own and kernel.range_px < _STEEP * size
    hidden = _FLATTENED * variance**0.5 * (size / kernel.range_px) ** 2
    return steep or hidden > own**0.5 or kernel.nugget_px2 > _NOISY**2 * own


def _unknown(settled: Settled) -> float:
    """Variance of a new patch against what the field predicts: its error, and the nugget."""
    return _sigma(settled) ** 2 + 2 * settled.fit.field.kernel.nugget_px2


def _sigma(settled: Settled) -> float:
    """Radial standard error of the field at its patches, RMS."""
    return float(np.sqrt((settled.fit.field.sigma_at(settled.fit.field.source) ** 2).mean()))


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
