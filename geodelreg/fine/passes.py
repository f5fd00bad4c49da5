"""From a guess to patches that agree: passes, each with better tone, point spread and map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from geodelreg.fine.layers import (
    CALM_PATCHES,
    CALM_SIGMA_PX,
    ELSEWHERE,
    Pass,
    ground_alone,
    is_telling,
    nothing_moves,
    same_place,
)
from geodelreg.fine.least_squares import MatchOptions
from geodelreg.fine.looks import HAZE, PLAIN, SHARPER, Look, preference, sharpest
from geodelreg.fine.matching import match_pass
from geodelreg.fine.motions import largest_layer
from geodelreg.fine.tiles import (
    Tile,
    dark_tile,
    largest_step,
    overview_tile,
    patch_size,
    plan_tiles,
    read_tiles,
)
from geodelreg.fine.tone import SyntheticPan
from geodelreg.fine.tuning import DEFAULT_SIGMA, Tuning, decimation, fit_sigma, fit_tone
from geodelreg.fit.estimate import Estimate
from geodelreg.fit.field import FEWEST_POINTS, FieldFit, fit_field, spacing
from geodelreg.fit.jumps import cut_at_jumps
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.geo.maps.kriging import Kernel
from geodelreg.pair import Roles, overlap_in_template
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess, Overview, Status
from geodelreg.values.raster import FloatArray

COARSE_SIGMA = 0.35  # of a pixel; by hand: 2 × refuses 1 of 36
_PASSES = 2
_PASSES_FROM_AFAR = 3
_SOME_TILES = 2
_MANY_TILES = 5  # by hand: ½ to 2 × alike
_LAST_TOLERANCE = 0.005  # of a patch pixel; by hand: ½ to 2 × alike
_MANY_PATCHES = 200  # fewer follow the tone of the proof; by hand: ½ to 2 × alike
_ONLY_TOLERANCE = 0.0015  # of a patch pixel, where no pass of full resolution goes before
_LAST_ITERATIONS = 5  # by hand: ½ to 2 × alike
_FEWER_SAMPLES = 4_000  # half of the last pass; by hand: ½ to 2 × alike
_NEAR_HEADER_PX = 4.0
_COARSE_FROM = 1.5  # times coarser than full resolution; by hand: ½ to 2 × alike
_MUCH_VISIBLE = 0.75  # by hand: ½ to 2 × alike
_MINORITY = 0.4
"""Share of the patches that agree, below which the others may have spoilt the tone: a robust fit
breaks down at half, and patches at the edge of what shows something hold some of the rest."""
_GENTLE = 2.0
"""Patches within which a field varies: hills as wide as a patch give 2.1, banks of clouds that as
many follow 1.5 at most."""
_WITHIN_REACH = 0.6
"""Share of the textured patches: the affine of one part of waves leaves a third of them too far."""
_BLURRED_SIGMA = 0.85  # of a pixel, the first of `geodelreg.fine.tuning` that is not usual


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Where the passes ended.

    Attributes
    ----------
    part : Roles
        With the step that suits what the template really shows.
    tiles : list of Tile
    tuning : Tuning
    last : Pass
        Over all patches; its estimate is not None.
    size : int
        Side of a patch, pixels of the tiles' template bands.
    dark_only : bool
        The tiles show no bright objects.
    without_bright : bool
        Bright objects were left out, because with them the patches agree on something else.
    bend : Kernel or None
        Of the field on which nearly all patches agree, where that was asked.
    """

    part: Roles
    tiles: list[Tile]
    tuning: Tuning
    last: Pass
    size: int
    dark_only: bool = False
    without_bright: bool = False
    bend: Kernel | None = None

    @property
    def estimate(self) -> Estimate:
        """Of the last pass."""
        assert self.last.estimate is not None
        return self.last.estimate

    @property
    def is_blurred(self) -> bool:
        """True when larger template pixels would show as much, and enough of them are left."""
        return self.tuning.sigma > _BLURRED_SIGMA and self.part.step < largest_step(self.part)


def refine_proven(part: Roles, images: Overview, tuning: Tuning, proof: Pass) -> Refinement | None:
    """Passes from where patches of the decimated images agree already.

    Parameters
    ----------
    part : Roles
    images : Overview
        Which the proof is over; where they are not decimated and many patches agree, it stands for
        the first passes of full resolution.
    tuning : Tuning
        Of the proof.
    proof : Pass

    Returns
    -------
    Refinement or None
        None unless nearly all patches agree in full resolution, too, and show all they could.
    """
    assert proof.estimate is not None
    read = _read(part, proof.estimate.map)
    if read is None:
        return None
    (tiles, size), near, last = read, proof.estimate.map, proof
    options, some = MatchOptions(size=size), _some_of(tiles)
    agreed = proof.matched.template_px[proof.status == Status.KEPT]
    # a tone fitted at another sharpness, as the proof's was, draws the point spread towards that
    tuning = replace(tuning, tone=fit_tone(part, some, near, DEFAULT_SIGMA, _FEWER_SAMPLES))
    tuning = replace(tuning, sigma=fit_sigma(part, some, near, agreed, tuning, size))
    if proof.kept < _MANY_PATCHES or _are_coarse(part, overview_tile(part, images)):
        last = match_pass(part, some, near, tuning, options)
    found = Refinement(part, some, tuning, last, size)
    if not last.is_calm or found.is_blurred:
        return None
    closely = _closely(part, tiles, found, replace(options, tolerance=_ONLY_TOLERANCE))
    return closely if closely is not None and closely.last.is_calm else None


def refine(part: Roles, guess: Guess) -> Refinement | None:
    """Passes over well-spread tiles, each with better tone, point spread and map.

    Where the template turns out to be blurred, as rasters are that were enlarged, its pixels are
    averaged until it no longer is: patches of so many pixels then show more.

    Returns
    -------
    Refinement or None
        None when too few patches match.
    """
    near = _coarse_refinement(part, guess)
    refined = _refine(part, near, guess)
    while refined is not None and refined.is_blurred:
        step = part.step * round(refined.tuning.sigma / DEFAULT_SIGMA)
        part = replace(part, step=min(step, largest_step(part)))
        coarser = _refine(part, near, guess)
        if coarser is None:
            break
        refined = coarser
    return refined


def _coarse_refinement(part: Roles, guess: Guess) -> PixelMap:
    """One pass over the decimated pair, where that is much coarser than the template."""
    tile = overview_tile(part, guess.images)
    if not _are_coarse(part, tile):
        return guess.map
    if guess.bright is not None:
        tile = dark_tile(part, tile, guess)
    tuning = Tuning(COARSE_SIGMA, fit_tone(part, [tile], guess.map, COARSE_SIGMA))
    found = match_pass(part, [tile], guess.map, tuning, MatchOptions())
    return guess.map if found.estimate is None else found.estimate.map


def _are_coarse(part: Roles, tile: Tile) -> bool:
    """True when the decimated images show much less than the template."""
    return decimation(tile.template[0], part.template.grid)[0] >= _COARSE_FROM


def _refine(part: Roles, near: PixelMap, guess: Guess) -> Refinement | None:
    read = _read(part, near)
    return None if read is None else _of_the_ground(part, read[0], guess, near, read[1])


def _read(part: Roles, near: PixelMap) -> tuple[list[Tile], int] | None:
    """Tiles around a map and the side of their patches; None where nothing overlaps."""
    region = overlap_in_template(part, near)
    if region is None:
        return None
    size = patch_size(region.width * region.height / part.step**2)
    with part.pair.timings("read tiles"):
        tiles = read_tiles(part, plan_tiles(region, part), near)
    return (tiles, _size_for(tiles, size)) if tiles else None


def _some_of(tiles: list[Tile]) -> list[Tile]:
    """Some of the tiles, if those are enough for all passes but the last."""
    return tiles[::_SOME_TILES] if len(tiles) >= _MANY_TILES else tiles


def _size_for(tiles: list[Tile], size: int) -> int:
    """Side of a patch, smaller than `size` where much is hidden and few patches would be left."""
    area = sum(tile.template[0].valid.size for tile in tiles)
    visible = sum(
        float(tile.template[0].valid.sum()) * float(tile.surface[0].valid.mean()) for tile in tiles
    )
    return min(size, patch_size(visible)) if visible < _MUCH_VISIBLE * area else size


def _of_the_ground(
    part: Roles, tiles: list[Tile], guess: Guess, near: PixelMap, size: int
) -> Refinement | None:
    """Refine on all pixels, unless those off bright objects (clouds?) say something else.

    Clouds are bright and smooth, and move; the ground is darker, has sharp edges, and does not.
    """
    pair = part.pair
    everything = _passes(part, tiles, near, size, (PLAIN, *SHARPER))
    if guess.bright is None:
        return everything
    if everything is not None:
        if everything.is_blurred or everything.last.is_calm:
            return everything
        if (kernel := _calm_bend(everything)) is not None:
            return replace(everything, bend=kernel)
        unit = part.step if part.ms_is_template else part.surface_px_per_patch_px
        if nothing_moves(everything.last, unit):
            return everything
    hidden = [dark_tile(part, tile, guess) for tile in tiles]
    from_header = _is_near_header(part, near)
    ground = _passes(part, hidden, near, _size_for(hidden, size), (HAZE, PLAIN), from_header)
    if ground is None or not is_telling(ground.last):
        return everything
    ground = replace(ground, dark_only=True)
    if everything is None or not same_place(pair, ground.last, everything.last):
        everything = _passes(part, tiles, ground.estimate.map, size, (PLAIN, *SHARPER))
    if everything is None:
        return ground
    if not same_place(pair, ground.last, everything.last):
        return replace(ground, without_bright=True)
    return ground if ground_alone(pair, ground.last, everything.last) else everything


def _calm_bend(found: Refinement) -> Kernel | None:
    """How a field varies on which nearly all patches that match agree to within their own noise.

    Clouds have edges that are no rows: a field that follows them bends from patch to patch, or
    leaves them out.
    """
    last = found.last
    matched = np.flatnonzero(np.isin(last.status, (Status.KEPT, *ELSEWHERE)))
    least = _WITHIN_REACH * (last.status != Status.TEXTURE).sum()
    if len(matched) <= max(least, FEWEST_POINTS):
        return None
    points = last.points.take(matched)
    ground = largest_layer(points, found.estimate.map)
    if ground.mean() <= CALM_PATCHES or not np.ptp(points.source, axis=0).min() > 0:
        return None
    fit = fit_field(points)
    if not bends_gently(fit, spacing(points)):
        fit = cut_at_jumps(points, fit)
    return fit.field.kernel if bends_gently(fit, spacing(points)) else None


def bends_gently(fit: FieldFit, spacing_px: float) -> bool:
    """True when points agree to within their noise on a field that bends gently, or is cut."""
    kernel, calm = fit.field.kernel, CALM_SIGMA_PX**2
    agree = fit.inlier.mean() > CALM_PATCHES and kernel.nugget_px2 < calm
    bends = max(kernel.variance_px2) > calm and kernel.range_px > _GENTLE * spacing_px
    return bool(agree and (bends or fit.field.jumps))


def _is_near_header(part: Roles, correction: PixelMap) -> bool:
    """True when the header is so close that patches could find the ground from there."""
    gap = part.pair.move_px(correction, part.pair.source_lattice(2))
    return bool(np.hypot(*gap.T).max() < _NEAR_HEADER_PX * part.pan_px_per_patch_px)


def _passes(
    part: Roles,
    tiles: list[Tile],
    near: PixelMap,
    size: int,
    looks: Sequence[Look],
    or_header: bool = False,
) -> Refinement | None:
    """Passes with the first way to look at the images, then the others if they are sharper.

    Where the first way shows nothing, the second is tried.  All passes but the last go over some of
    the tiles, if those are enough; with `or_header` they also start from the header, unless nearly
    all patches agree from the other start, and the start that more patches agree with more closely
    is taken.
    """
    options = MatchOptions(size=size)
    some = _some_of(tiles)
    starts = [near, IDENTITY] if or_header else [near]
    passes = _PASSES_FROM_AFAR if or_header else _PASSES
    best: Refinement | None = None
    others = looks[1:]

    @cache  # whatever the look
    def first_tone(all_of_them: bool, from_header: bool) -> SyntheticPan:
        start, where = starts[from_header], tiles if all_of_them else some
        return fit_tone(part, where, start, DEFAULT_SIGMA, _FEWER_SAMPLES)

    tries = [(look, where) for look in looks[:2] for where in (some, tiles)]
    for look, where in tries if some is not tiles else tries[1::2]:
        for start in starts:
            tone = first_tone(where is tiles, start is not near)
            found = _approach(part, where, start, options, look, passes, tone)
            if found is None:
                continue
            if best is None or preference(found.last) < preference(best.last):
                best, others = found, looks[looks.index(look) + 1 :]
            if best.last.is_calm:
                break  # no other start could please more patches
        if best is not None:
            break
    if best is None or best.is_blurred:
        return best
    tuning, last = best.tuning, best.last
    if not last.is_calm:
        tuning, last = sharpest(part, best.tiles, (tuning, last), others, options)
    options = replace(options, tolerance=_LAST_TOLERANCE)
    return _closely(part, tiles, replace(best, tuning=tuning, last=last), options)


def _closely(
    part: Roles, tiles: list[Tile], found: Refinement, options: MatchOptions
) -> Refinement | None:
    """The last pass, over all tiles."""
    near = found.estimate.map
    tone = fit_tone(
        part, tiles, near, found.tuning.sigma, agreed=_few_agreed(found.last, found.size)
    )
    tuning = replace(found.tuning, tone=tone)
    options = replace(options, size=found.size, iterations=_LAST_ITERATIONS)
    last = match_pass(part, tiles, near, tuning, options)
    return None if last.estimate is None else Refinement(part, tiles, tuning, last, options.size)


def _few_agreed(found: Pass, size: int) -> tuple[FloatArray, int] | None:
    """Centres and side of the patches that agree, where these are a minority of the image."""
    agreed = found.status == Status.KEPT
    return (found.matched.template_px[agreed], size) if agreed.mean() < _MINORITY else None


def _smaller(found: Pass, size: int) -> int:
    """Side of a patch, for less area than was thought shows anything."""
    textured = int((found.status != Status.TEXTURE).sum())
    return min(size, patch_size(textured * size**2))


def _approach(
    part: Roles,
    tiles: list[Tile],
    near: PixelMap,
    options: MatchOptions,
    look: Look,
    passes: int,
    tone: SyntheticPan,
) -> Refinement | None:
    """Passes towards the map and the point spread, from a start a few pixels off, and its tone."""
    local = look.local_tone and part.ms_is_template
    sigma, found, few = DEFAULT_SIGMA, None, None
    for number in range(passes):
        if number:
            tone = fit_tone(part, tiles, near, sigma, _FEWER_SAMPLES, few)
        tuning = Tuning(sigma, tone, look.high_pass, local)
        if found is not None and number == 1 and not local:  # without a common tone no sharpness
            agreed = found.matched.template_px[found.status == Status.KEPT]
            sigma = fit_sigma(part, tiles, near, agreed, tuning, options.size)
            tuning = replace(tuning, sigma=sigma)
        found = match_pass(part, tiles, near, tuning, options)
        if found.estimate is None:
            return None
        near, few = found.estimate.map, _few_agreed(found, options.size)
        if few is not None:
            options = replace(options, size=_smaller(found, options.size))
    assert found is not None
    return Refinement(part, tiles, tuning, found, options.size)
