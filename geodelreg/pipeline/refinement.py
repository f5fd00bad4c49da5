"""Passes of dense matching, each with better tone, point spread and transformation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from geodelreg.fit.models import IDENTITY
from geodelreg.match.refine import RefineOptions
from geodelreg.pipeline.dense import (
    DEFAULT_SIGMA,
    Dense,
    Tuning,
    fit_tone,
    match_pass,
)
from geodelreg.pipeline.search import Hypothesis, WorkingPair
from geodelreg.pipeline.sharpness import fit_sigma
from geodelreg.pipeline.tiles import (
    Roles,
    Tile,
    hide,
    overlap_in_template,
    patch_size,
    plan_tiles,
    read_tiles,
)
from geodelreg.types import FloatArray, Status

_PASSES = 2
_PASSES_FROM_AFAR = 3
_SOME_TILES = 2
_MANY_TILES = 5
_LAST_TOLERANCE = 0.005
_LAST_ITERATIONS = 5
_FEWER_SAMPLES = 4_000
_NEAR_HEADER_PX = 4.0
COARSE_SIGMA = 0.35
_COARSE_FROM = 1.5
Look = tuple[float, bool]  # high-pass and local tone, as in `Tuning`
_PLAIN: Look = (0.0, False)
_HAZE: Look = (1.0, False)
_SHARPER: tuple[Look, ...] = ((1.5, True), (1.0, True))
_CLEARLY = 0.8
_MOVE_PX = 0.1
_CONTRADICTION_SIGMAS = 4.0
_CONTRADICTION_FLOOR_PX = 0.05
_RELIEF_SIGMAS = 2.0
_CALM_SHARE = 0.9
_CALM_SIGMA_PX = 0.02
_SHARPER_SHARE = 0.6
_MUCH_VISIBLE = 0.75
_BLURRED_SIGMA = 0.85
_TELLING_PATCHES = 8  # fewer on the ground say nothing against what all others agree on


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Where the passes ended.

    Attributes
    ----------
    part : Roles
        With the step that suits what the template really shows.
    tiles : list of Tile
    tuning : Tuning
    dense : Dense
        The last pass over all patches; its estimate is not None.
    matrix : (2, 3) float64
        MS pixels to MS header pixels.
    size : int
        Side of a patch, pixels of the tiles' template bands.
    dark_only : bool
        The tiles show no bright objects.
    without_bright : bool
        Bright objects were left out, because with them the patches agree on something else.
    """

    part: Roles
    tiles: list[Tile]
    tuning: Tuning
    dense: Dense
    matrix: FloatArray
    size: int
    dark_only: bool = False
    without_bright: bool = False

    def is_blurred(self) -> bool:
        """True when larger template pixels would show as much, and enough of them are left."""
        return self.tuning.sigma > _BLURRED_SIGMA and self.part.step < self.part.largest_step


def refine_densely(
    part: Roles, hypothesis: Hypothesis, timings: dict[str, float]
) -> Refinement | None:
    """Passes over well-spread tiles, each with better tone, point spread and transformation.

    Where the template turns out to be blurred, as rasters are that were enlarged, its pixels are
    averaged until it no longer is: patches of so many pixels then show more.
    """
    start = perf_counter()
    matrix = _coarse_refinement(part, hypothesis)
    _add(timings, "refine", perf_counter() - start)
    refined = _refine(part, matrix, hypothesis, timings)
    while refined is not None and refined.is_blurred():
        step = part.step * round(refined.tuning.sigma / DEFAULT_SIGMA)
        part = replace(part, step=min(step, part.largest_step))
        coarser = _refine(part, matrix, hypothesis, timings)
        if coarser is None:
            break
        refined = coarser
    return refined


def _refine(
    part: Roles, matrix: FloatArray, hypothesis: Hypothesis, timings: dict[str, float]
) -> Refinement | None:
    start = perf_counter()
    region = overlap_in_template(part, matrix)
    if region is None:
        return None
    size = patch_size(region.width * region.height / part.step**2)
    tiles = read_tiles(part, plan_tiles(region, part), matrix, part.pair.threads)
    _add(timings, "read tiles", perf_counter() - start)
    start = perf_counter()
    options = RefineOptions(size=_size_for(tiles, size))
    refined = _of_the_ground(part, tiles, hypothesis, matrix, options) if tiles else None
    _add(timings, "refine", perf_counter() - start)
    return refined


def _add(timings: dict[str, float], step: str, seconds: float) -> None:
    timings[step] = timings.get(step, 0.0) + seconds


def _size_for(tiles: list[Tile], size: int) -> int:
    """Side of a patch, smaller than `size` where much is hidden and few patches would be left."""
    area = sum(tile.template[0].valid.size for tile in tiles)
    visible = sum(
        float(tile.template[0].valid.sum()) * float(tile.surface[0].valid.mean()) for tile in tiles
    )
    return min(size, patch_size(visible)) if visible < _MUCH_VISIBLE * area else size


def _of_the_ground(
    part: Roles,
    tiles: list[Tile],
    hypothesis: Hypothesis,
    matrix: FloatArray,
    options: RefineOptions,
) -> Refinement | None:
    """Refine on all pixels, unless those off bright objects (clouds?) say something else.

    Clouds are bright and smooth, and move; the ground is darker, has sharp edges, and does not.
    Where both agree on the place, bright objects are left out if nearly all others agree, or agree
    on more than a shift, or tell the place more sharply.
    """
    everything = _passes(part, tiles, matrix, options, (_PLAIN, *_SHARPER))
    clear = everything is not None and (everything.is_blurred() or _is_calm(everything.dense))
    if hypothesis.bright is None or clear:
        return everything
    hidden = [dark_tile(part, tile, hypothesis) for tile in tiles]
    small = replace(options, size=_size_for(hidden, options.size))
    ground = _passes(part, hidden, matrix, small, (_HAZE, _PLAIN), _near_header(part, matrix))
    if ground is not None:
        ground = replace(ground, dark_only=True) if _kept(ground) >= _TELLING_PATCHES else None
    if ground is not None and not _agree(part, ground, everything):
        everything = _passes(part, tiles, ground.matrix, options, (_PLAIN, *_SHARPER))
    if ground is None or everything is None:
        return ground or everything
    if not _agree(part, ground, everything):
        return replace(ground, without_bright=True)
    sigma = _difference(part, ground.dense, everything.dense)[1]
    if _is_calm(ground.dense) and not _is_calm(everything.dense):
        return ground  # what disagrees is bright
    if _is_shift(ground.dense) != _is_shift(everything.dense):
        return everything if _is_shift(ground.dense) else ground
    return ground if sigma[0] < _CLEARLY * sigma[1] else everything


def _kept(one: Refinement) -> int:
    return int((one.dense.status == Status.KEPT).sum())


def _is_calm(dense: Dense) -> bool:
    """True when nearly all textured patches agree to within their own noise."""
    if dense.estimate is None:
        return False
    textured = dense.status != Status.TEXTURE
    share = float((dense.status[textured] == Status.KEPT).mean()) if textured.any() else 0.0
    return share > _CALM_SHARE and _scatter(dense) < _CALM_SIGMA_PX


def _agree(part: Roles, one: Refinement, other: Refinement | None) -> bool:
    """True when two refinements differ by no more than their errors allow.

    Relief displaces neighbours alike, so that patches at other places may say something else by as
    much as all of them scatter.
    """
    if other is None:
        return False
    gap, sigma = _difference(part, one.dense, other.dense)
    scatter = _RELIEF_SIGMAS * max(_scatter(one.dense), _scatter(other.dense))
    return gap <= _CONTRADICTION_SIGMAS * sum(sigma) + max(scatter, _CONTRADICTION_FLOOR_PX)


def _scatter(dense: Dense) -> float:
    """Of patches beyond their own noise, in MS pixels."""
    assert dense.estimate is not None
    return float(np.sqrt(dense.estimate.extra_variance_px2))


def _near_header(part: Roles, matrix: FloatArray) -> bool:
    """True when the header is so close that patches could find the ground from there."""
    corners = part.pair.corners()
    gap = part.pair.to_reference(matrix, corners) - part.pair.to_reference(IDENTITY, corners)
    return bool(np.hypot(*gap.T).max() < _NEAR_HEADER_PX * part.pan_px_per_patch_px)


def _is_shift(dense: Dense) -> bool:
    """True when so few patches matched that nothing but a shift was fitted."""
    assert dense.estimate is not None
    return dense.estimate.transformation.model == "shift"


def _preference(one: Refinement) -> tuple[bool, float]:
    """Less for the start from which more patches agree more closely: model, then variance."""
    assert one.dense.estimate is not None
    return _is_shift(one.dense), float(np.diag(one.dense.estimate.covariance).sum())


def _difference(part: Roles, one: Dense, other: Dense) -> tuple[float, tuple[float, float]]:
    """Largest distance over the MS raster of two estimates, and the mean standard error of each."""
    assert one.estimate is not None
    assert other.estimate is not None
    where = part.pair.lattice()
    gap = one.estimate.transformation(where) - other.estimate.transformation(where)
    sigma = [float(e.sigma_at(where).mean()) for e in (one.estimate, other.estimate)]
    return float(np.hypot(*gap.T).max()), (sigma[0], sigma[1])


def _passes(
    part: Roles,
    tiles: list[Tile],
    matrix: FloatArray,
    options: RefineOptions,
    looks: tuple[Look, ...],
    or_header: bool = False,
) -> Refinement | None:
    """Passes with the first way to look at the images, then the others if they are sharper.

    Where the first way shows nothing, the second is tried.  All passes but the last go over some of
    the tiles, if those are enough; with `or_header` they also start from the header, unless nearly
    all patches agree from the other start, and the start that more patches agree with more closely
    is taken.
    """
    threads = part.pair.threads
    some = tiles[::_SOME_TILES] if len(tiles) >= _MANY_TILES else tiles
    starts = [matrix, IDENTITY] if or_header else [matrix]
    passes = _PASSES_FROM_AFAR if or_header else _PASSES
    near: Refinement | None = None
    others = looks[1:]
    tries = [(look, where) for look in looks[:2] for where in (some, tiles)]
    for look, where in tries if some is not tiles else tries[1::2]:
        for start in starts:
            found = _approach(part, where, start, options, look, passes)
            if found is not None and (near is None or _preference(found) < _preference(near)):
                near, others = found, looks[looks.index(look) + 1 :]
            if near is not None and _is_calm(near.dense):
                break  # no other start could please more patches
        if near is not None:
            break
    if near is None or near.is_blurred():
        return near
    if not _is_calm(near.dense):
        near = _sharpest(part, near, others, options, threads)
    tone = fit_tone(part, tiles, near.matrix, near.tuning.sigma, threads)
    tuning = replace(near.tuning, tone=tone)
    options = replace(options, tolerance=_LAST_TOLERANCE, iterations=_LAST_ITERATIONS)
    dense = match_pass(part, tiles, near.matrix, tuning, options, threads)
    if dense.estimate is None:
        return None
    matrix = dense.estimate.transformation.matrix
    return Refinement(part, tiles, tuning, dense, matrix, options.size)


def _approach(
    part: Roles,
    tiles: list[Tile],
    matrix: FloatArray,
    options: RefineOptions,
    look: Look,
    passes: int,
) -> Refinement | None:
    """Passes towards the transformation and the point spread, from a start a few pixels off."""
    threads = part.pair.threads
    local = look[1] and part.ms_is_template()
    sigma, near = DEFAULT_SIGMA, None
    for number in range(passes):
        tone = fit_tone(part, tiles, matrix, sigma, threads, _FEWER_SAMPLES)
        tuning = Tuning(sigma, tone, look[0], local)
        if near is not None and number == 1 and not local:  # without a common tone no sharpness
            sigma = fit_sigma(part, tiles, near.dense, tuning, options.size, threads)
            tuning = replace(tuning, sigma=sigma)
        dense = match_pass(part, tiles, matrix, tuning, options, threads)
        if dense.estimate is None:
            return None
        matrix = dense.estimate.transformation.matrix
        near = Refinement(part, tiles, tuning, dense, matrix, options.size)
    return near


def _sharpest(
    part: Roles,
    plain: Refinement,
    others: tuple[Look, ...],
    options: RefineOptions,
    threads: int,
) -> Refinement:
    """Try edges alone, with each patch's own tone: better where light or land changed."""
    best, changed = plain, False
    for high_pass, local_tone in others:
        local = local_tone and part.ms_is_template()
        tuning = replace(plain.tuning, high_pass=high_pass, local_tone=local)
        dense = match_pass(part, plain.tiles, best.matrix, tuning, options, threads)
        if not _is_sharper(part, dense, best.dense, 1.0 if changed else _CLEARLY):
            break
        haze = plain.tuning.high_pass and not plain.tuning.local_tone
        if haze and _moved(part, dense, best.dense):
            break  # more certain of another place is no gain where clouds are about
        assert dense.estimate is not None
        matrix = dense.estimate.transformation.matrix
        best, changed = replace(best, tuning=tuning, dense=dense, matrix=matrix), True
    return best


def _moved(part: Roles, one: Dense, other: Dense) -> bool:
    return other.estimate is not None and _difference(part, one, other)[0] > _MOVE_PX


def _is_sharper(part: Roles, one: Dense, other: Dense, factor: float) -> bool:
    """True when a pass is more certain, by a factor, without losing many patches.

    One of enough patches for an affine is, whatever the factor, when the other's are too few.
    """
    if one.estimate is None or other.estimate is None:
        return one.estimate is not None
    if _is_shift(one) != _is_shift(other):  # a shift is more certain, but of few patches
        return _is_shift(other)
    kept = [int((dense.status == Status.KEPT).sum()) for dense in (one, other)]
    sigma = _difference(part, one, other)[1]
    return kept[0] >= _SHARPER_SHARE * kept[1] and sigma[0] < factor * sigma[1]


def _coarse_refinement(part: Roles, hypothesis: Hypothesis) -> FloatArray:
    """One pass over the decimated pair, where that is much coarser than the template."""
    images = hypothesis.pair
    template = images.source[0] if part.ms_is_template() else images.reference
    step = ~part.template.grid.transform @ template.grid.transform
    if abs(step.a) < _COARSE_FROM:
        return hypothesis.matrix
    tile = working_tile(part, images)
    if hypothesis.bright is not None:
        tile = dark_tile(part, tile, hypothesis)
    tone = fit_tone(part, [tile], hypothesis.matrix, COARSE_SIGMA, 1)
    tuning = Tuning(COARSE_SIGMA, tone)
    dense = match_pass(part, [tile], hypothesis.matrix, tuning, RefineOptions(), 1)
    return dense.estimate.transformation.matrix if dense.estimate else hypothesis.matrix


def working_tile(part: Roles, images: WorkingPair) -> Tile:
    """The decimated pair as one tile."""
    if part.ms_is_template():
        return Tile(images.source, [images.reference])
    return Tile([images.reference], images.source)


def dark_tile(part: Roles, tile: Tile, hypothesis: Hypothesis) -> Tile:
    """The tile without the bright objects of a hypothesis that has some."""
    assert hypothesis.bright is not None
    source = hypothesis.bright[0], hypothesis.pair.source[0].grid
    reference = hypothesis.bright[1], hypothesis.pair.reference.grid
    template, surface = (source, reference) if part.ms_is_template() else (reference, source)
    return Tile(
        [hide(band, *template) for band in tile.template],
        [hide(band, *surface) for band in tile.surface],
    )
