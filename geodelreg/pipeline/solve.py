"""From one hypothesis to a solution: refine, select the model, measure accuracy and evidence."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from geodelreg.fit.gate import Evidence, is_worthwhile, judge, verdict
from geodelreg.fit.models import IDENTITY, Transformation
from geodelreg.fit.select import HeldOut, Selection, half_disagreement, select_model
from geodelreg.geo.crs import linearise
from geodelreg.match.area import Overlay, rival_correlation
from geodelreg.match.consensus import log_nfa
from geodelreg.match.refine import RefineOptions
from geodelreg.match.surface import make_surface
from geodelreg.pipeline.dense import (
    DEFAULT_SIGMA,
    Dense,
    Tuning,
    fit_sigma,
    fit_tone,
    match_pass,
    surface_sigma,
)
from geodelreg.pipeline.evidence import area_evidence, correlation, grey_rmse, overlay
from geodelreg.pipeline.search import Hypothesis, WorkingPair
from geodelreg.pipeline.state import Pair
from geodelreg.pipeline.tiles import (
    Roles,
    Tile,
    hide,
    overlap_in_template,
    patch_size,
    plan_tiles,
    read_tiles,
    roles,
)
from geodelreg.types import Accuracy, FloatArray, Status, StatusArray, TiePoints, Verdict

_PASSES = 3
_COARSE_SIGMA = 0.35
_COARSE_FROM = 1.5
_NEGLIGIBLE_PX = 0.005
_PLAIN = (0.0, False)
_HAZE = (1.0, False)
_SHARPER = ((1.5, True), (1.0, True))
_CLEARLY = 0.8
_MOVE_PX = 0.1
_SURE_LOG_CHANCE = -12.0
_SHARPER_SHARE = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A correction with everything known about it.

    Attributes
    ----------
    transformation : Transformation
        MS pixels to MS header pixels.
    tie_points : TiePoints
    accuracy : Accuracy
    verdict : Verdict
    step_counts : dict of str to int
    band_weights : dict of str to float
    warnings : tuple of str
    timings_s : dict of str to float
    """

    transformation: Transformation
    tie_points: TiePoints
    accuracy: Accuracy
    verdict: Verdict
    step_counts: dict[str, int]
    band_weights: dict[str, float]
    warnings: tuple[str, ...]
    timings_s: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Tiles, what is known of the sensors, and the last pass over all patches."""

    tiles: list[Tile]
    tuning: Tuning
    dense: Dense
    matrix: FloatArray
    size: int


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A fitted model before it is judged.

    Attributes
    ----------
    selection : Selection
    points : TiePoints
    counts : dict of str to int
        Points that survive each step.
    log_nfa : float
        log10 of the expected number of chance agreements as good.
    disagreement_px : float
        How far the correction may be off at a corner by evidence it has not used, PAN pixels.
    """

    selection: Selection
    points: TiePoints
    counts: dict[str, int]
    log_nfa: float
    disagreement_px: float


def thread_count(pair: Pair) -> int:
    """Threads to use."""
    return pair.options.threads or os.cpu_count() or 1


def solve(pair: Pair, hypothesis: Hypothesis) -> Solution | None:
    """Refine a hypothesis by dense patches and judge it; None when too few patches match."""
    timings: dict[str, float] = {}
    part = roles(pair)
    start = perf_counter()
    refined = refine_densely(part, hypothesis, timings)
    if refined is None:
        return None
    kept = refined.dense.status == Status.KEPT
    points = refined.dense.observations.take(kept)
    if len(points) < 4:
        return None
    corners = raster_corners(pair)
    negligible = _NEGLIGIBLE_PX / max(pair.pan_px_per_source_px, 1e-9)
    selection = select_model(points, pair.frame(), corners, pair.options.model, negligible)
    status = refined.dense.status.copy()
    status[np.flatnonzero(kept)[~selection.estimate.inlier]] = Status.RESIDUAL
    matrix = selection.estimate.transformation.matrix
    tied = tie_points(part, refined.dense, matrix, status)
    corners = overlap_corners(part, matrix)
    fitted = Fitted(
        selection,
        tied,
        dict(hypothesis.counts) | _patch_counts(refined, tied),
        _agreement_log_nfa(pair, tied),
        pair.pan_px_per_source_px
        * half_disagreement(points.take(selection.estimate.inlier), selection.estimate, corners),
    )
    timings["fit"] = perf_counter() - start - sum(timings.values())
    return conclude(part, hypothesis, refined, fitted, timings)


def _patch_counts(refined: Refinement, points: TiePoints) -> dict[str, int]:
    matched = int((refined.dense.refined.status == Status.KEPT).sum())
    return {
        "patches": len(points),
        "patches matched": matched,
        "patches kept": int(points.kept.sum()),
    }


def _agreement_log_nfa(pair: Pair, points: TiePoints) -> float:
    """Chance agreement of patches, each of which may end anywhere within its reach."""
    matched = points.kept | np.isin(points.status, (Status.CONSENSUS, Status.STAR, Status.RESIDUAL))
    gap = np.hypot(*points.residual_px[matched].T)
    reach = 2 * RefineOptions().max_move * max(pair.pan_px_per_source_px, 1.0)
    return log_nfa(gap, reach**2, 3, reach / 2)[0]


def refine_densely(
    part: Roles, hypothesis: Hypothesis, timings: dict[str, float]
) -> Refinement | None:
    """Passes over well-spread tiles, each with better tone, point spread and transformation."""
    start = perf_counter()
    matrix = _coarse_refinement(part, hypothesis)
    region = overlap_in_template(part, matrix)
    if region is None:
        return None
    threads, size = thread_count(part.pair), patch_size(region)
    tiles = read_tiles(part, plan_tiles(region), matrix, threads)
    if hypothesis.bright is not None:
        tiles = [_without_bright(part, tile, hypothesis) for tile in tiles]
    timings["read tiles"] = perf_counter() - start
    start = perf_counter()
    if not tiles:
        return None
    refined = _passes(part, tiles, hypothesis, matrix, RefineOptions(size=size))
    timings["refine"] = perf_counter() - start
    return refined


def _passes(
    part: Roles, tiles: list[Tile], hypothesis: Hypothesis, matrix: FloatArray,
    options: RefineOptions,
) -> Refinement | None:  # fmt: skip
    threads = thread_count(part.pair)
    haze = _HAZE if hypothesis.bright is not None else _PLAIN
    sigma, dense, tuning = DEFAULT_SIGMA, None, None
    for number in range(_PASSES):
        tone = fit_tone(part, tiles, matrix, sigma)
        tuning = Tuning(sigma, tone, *haze)
        if number:
            sigma = fit_sigma(part, tiles, matrix, tuning)
            tuning = replace(tuning, sigma=sigma)
        dense = match_pass(part, tiles, matrix, tuning, options, threads)
        if dense.estimate is None:
            break
        matrix = dense.estimate.transformation.matrix
    if dense is None or tuning is None:
        return None
    best = Refinement(tiles, tuning, dense, matrix, options.size)
    others = _SHARPER if hypothesis.bright is None else (_PLAIN,)
    best = _sharpest(part, best, others, options, threads)
    return best if best.dense.estimate is not None else None


def _sharpest(
    part: Roles,
    plain: Refinement,
    others: tuple[tuple[float, bool], ...],
    options: RefineOptions,
    threads: int,
) -> Refinement:
    """Try looking at edges alone, with each patch's own tone: better where light or land changed."""
    best, changed, wary = plain, False, bool(plain.tuning.high_pass)
    for high_pass, local_tone in others:
        local = local_tone and part.ms_is_template()
        tuning = replace(plain.tuning, high_pass=high_pass, local_tone=local)
        dense = match_pass(part, plain.tiles, best.matrix, tuning, options, threads)
        clearly = 1.0 if changed else _CLEARLY
        if not _is_sharper(part, dense, best.dense, clearly, _MOVE_PX if wary else math.inf):
            break
        assert dense.estimate is not None
        matrix = dense.estimate.transformation.matrix
        best, changed = replace(best, tuning=tuning, dense=dense, matrix=matrix), True
    if not changed:
        return plain
    dense = match_pass(part, best.tiles, best.matrix, best.tuning, options, threads)
    if dense.estimate is None:
        return best
    return replace(best, dense=dense, matrix=dense.estimate.transformation.matrix)


def _is_sharper(part: Roles, one: Dense, other: Dense, factor: float, move_px: float) -> bool:
    """True when a pass is more certain, by a factor, than another without losing many patches."""
    if one.estimate is None or other.estimate is None:
        return one.estimate is not None
    where = lattice(part.pair)
    kept = [int((dense.status == Status.KEPT).sum()) for dense in (one, other)]
    sigma = [float(e.sigma_at(where).mean()) for e in (one.estimate, other.estimate)]
    if kept[0] < _SHARPER_SHARE * kept[1] or sigma[0] >= factor * sigma[1]:
        return False
    # more certain of another place is no gain where clouds are about: they are not the ground
    gap = one.estimate.transformation(where) - other.estimate.transformation(where)
    return bool(np.hypot(*gap.T).max() < move_px)


def _coarse_refinement(part: Roles, hypothesis: Hypothesis) -> FloatArray:
    """One pass over the decimated pair, where that is much coarser than the template."""
    images = hypothesis.pair
    template = images.source[0] if part.ms_is_template() else images.reference
    step = ~part.template.grid.transform @ template.grid.transform
    if abs(step.a) < _COARSE_FROM:
        return hypothesis.matrix
    tile = _working_tile(part, images)
    if hypothesis.bright is not None:
        tile = _without_bright(part, tile, hypothesis)
    tone = fit_tone(part, [tile], hypothesis.matrix, _COARSE_SIGMA)
    tuning = Tuning(_COARSE_SIGMA, tone)
    dense = match_pass(part, [tile], hypothesis.matrix, tuning, RefineOptions(), 1)
    return dense.estimate.transformation.matrix if dense.estimate else hypothesis.matrix


def _working_tile(part: Roles, images: WorkingPair) -> Tile:
    if part.ms_is_template():
        return Tile(images.source, [images.reference])
    return Tile([images.reference], images.source)


def _without_bright(part: Roles, tile: Tile, hypothesis: Hypothesis) -> Tile:
    assert hypothesis.bright is not None
    source = hypothesis.bright[0], hypothesis.pair.source[0].grid
    reference = hypothesis.bright[1], hypothesis.pair.reference.grid
    template, surface = (source, reference) if part.ms_is_template() else (reference, source)
    return Tile(
        [hide(band, *template) for band in tile.template],
        [hide(band, *surface) for band in tile.surface],
    )


def raster_corners(pair: Pair) -> FloatArray:
    """(4, 2) corners of the MS raster, pixels."""
    height, width = pair.source.grid.shape
    return np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])


def conclude(
    part: Roles,
    hypothesis: Hypothesis,
    refined: Refinement,
    fitted: Fitted,
    timings: dict[str, float],
) -> Solution:
    """Measure accuracy and evidence of a fitted model, and judge it."""
    start = perf_counter()
    pair, estimate = part.pair, fitted.selection.estimate
    matrix = estimate.transformation.matrix
    before, after = _overlays(part, hypothesis, refined.tuning, matrix)
    accuracy = measure(part, fitted, before, after)
    area = area_evidence(part, refined.tiles, matrix, refined.tuning, refined.size, few=True)
    if area.log_chance > _SURE_LOG_CHANCE:
        area = area_evidence(part, refined.tiles, matrix, refined.tuning, refined.size, few=False)
    evidence = _evidence(pair, fitted, accuracy, area.log_chance, rival_correlation(after))
    grid = lattice(pair)
    move = pair.to_reference(matrix, grid) - pair.to_reference(IDENTITY, grid)
    sigma = estimate.sigma_at(grid) * pair.pan_px_per_source_px
    moves = is_worthwhile(np.hypot(move[:, 0], move[:, 1]), sigma, pair.options.tolerance_px)
    names = [pair.source.band_names[band - 1] for band in pair.source_bands]
    weights = dict(zip(names, map(float, refined.tuning.tone.weights), strict=True))
    timings["evidence"] = perf_counter() - start
    return Solution(
        estimate.transformation,
        fitted.points,
        accuracy,
        verdict(judge(evidence, pair.options), moves),
        fitted.counts,
        weights,
        (),
        timings,
    )


def lattice(pair: Pair) -> FloatArray:
    """(25, 2) pixels spread over the MS raster, its corners included."""
    height, width = pair.source.grid.shape
    columns, rows = np.meshgrid(np.linspace(0, width, 5), np.linspace(0, height, 5))
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def overlap_corners(part: Roles, matrix: FloatArray) -> FloatArray:
    """(4, 2) MS pixels at the corners of the overlap's bounding window."""
    region = overlap_in_template(part, matrix)
    if region is None:
        return raster_corners(part.pair)
    x = np.array([region.column, region.column + region.width], dtype=np.float64)
    y = np.array([region.row, region.row + region.height], dtype=np.float64)
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[0], y[1]], [x[1], y[1]]])
    return corners if part.ms_is_template() else part.to_surface(matrix, corners)


def tie_points(part: Roles, dense: Dense, matrix: FloatArray, status: StatusArray) -> TiePoints:
    """Patches as tie points between MS and PAN pixels, with residuals under `matrix`."""
    pair, refined = part.pair, dense.refined
    if part.ms_is_template():
        source, reference = refined.template_px, refined.surface_px
        covariance = refined.covariance_px2
    else:
        source, reference = refined.surface_px, refined.template_px
        local = linearise(lambda xy: pair.to_reference(matrix, xy), source)[:, :, :2]
        covariance = np.einsum("pij,pjk,plk->pil", local, refined.covariance_px2, local)
    residual = pair.to_reference(matrix, source) - reference
    return TiePoints(
        source, reference, covariance, np.abs(refined.correlation), status,
        np.zeros(len(source), dtype=bool), residual,
    )  # fmt: skip


def _overlays(
    part: Roles, hypothesis: Hypothesis, tuning: Tuning, matrix: FloatArray
) -> tuple[Overlay, Overlay]:
    """Both images, decimated, one on the other: under the header, and under the correction."""
    tile = _working_tile(part, hypothesis.pair)
    if part.ms_is_template():
        template, finer = tuning.tone(tile.template), tile.surface[0]
    else:
        template, finer = tile.template[0], tuning.tone(tile.surface)
    sigma = surface_sigma(part, tile, _COARSE_SIGMA)
    surface = make_surface(finer, part.surface.grid, sigma)
    return overlay(part, template, surface, IDENTITY), overlay(part, template, surface, matrix)


def measure(part: Roles, fitted: Fitted, before: Overlay, after: Overlay) -> Accuracy:
    """Accuracy in PAN pixels and metres, at points the fit has not seen where it says check."""
    pair, points, selection = part.pair, fitted.points, fitted.selection
    kept = points.kept
    matrix = selection.estimate.transformation.matrix
    unmoved = pair.to_reference(IDENTITY, points.source_px[kept]) - points.reference_px[kept]
    fit = points.residual_px[kept]
    check_px, check_m = _held_out(pair, points, selection.check, selection)
    sigma = selection.estimate.sigma_at
    ratio = pair.pan_px_per_source_px
    height, width = pair.source.grid.shape
    pan_m = float(np.sqrt(pair.reference_gsd_m[0] * pair.reference_gsd_m[1]))
    return Accuracy(
        fit_rmse_px=_rms(fit),
        check_rmse_px=_rms(check_px),
        check_ce90_px=_ce90(check_px),
        check_rmse_m=_rms(check_m),
        check_ce90_m=_ce90(check_m),
        before_rmse_px=_rms(unmoved),
        before_rmse_m=_rms(unmoved) * pan_m,
        sigma_centre_px=float(sigma(np.array([[width / 2, height / 2]]))[0]) * ratio,
        sigma_corner_px=float(sigma(overlap_corners(part, matrix)).max()) * ratio,
        coverage=_coverage(part, points, matrix),
        e1_before=grey_rmse(before, part.ms_is_template()),
        e1_after=grey_rmse(after, part.ms_is_template()),
        ncc_before=correlation(before),
        ncc_after=correlation(after),
        kept=int(kept.sum()),
        checked=int(np.isfinite(check_px).all(axis=1).sum()),
    )


def _held_out(
    pair: Pair, points: TiePoints, check: HeldOut, selection: Selection
) -> tuple[FloatArray, FloatArray]:
    """Held-out residuals of the kept points, in PAN pixels and in metres."""
    inlier = selection.estimate.inlier
    residual = check.residual_px[inlier]
    at = points.source_px[points.kept]
    local = linearise(pair.mapping.forward, selection.estimate.transformation(at))[:, :, :2]
    in_pan = np.einsum("pij,pj->pi", local, residual)
    return in_pan, residual * np.array(pair.source_gsd_m)


def _rms(vectors: FloatArray) -> float:
    good = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.sqrt((good**2).sum(axis=1).mean())) if len(good) else float("nan")


def _ce90(vectors: FloatArray) -> float:
    good = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.percentile(np.hypot(good[:, 0], good[:, 1]), 90)) if len(good) else math.nan


def _coverage(part: Roles, points: TiePoints, matrix: FloatArray) -> float:
    """Area of the kept points' hull over that of the overlap, both in template pixels."""
    from shapely import MultiPoint, Polygon, box

    kept = points.kept
    if kept.sum() < 3:
        return 0.0
    spots = points.source_px[kept] if part.ms_is_template() else points.reference_px[kept]
    height, width = part.surface.grid.shape
    t = np.linspace(0.0, 1.0, 9)[:-1]
    ring = np.concatenate(
        [
            np.stack([t * width, 0 * t], 1),
            np.stack([0 * t + width, t * height], 1),
            np.stack([(1 - t) * width, 0 * t + height], 1),
            np.stack([0 * t, (1 - t) * height], 1),
        ]
    )
    seen = Polygon(part.to_template(matrix, ring)).buffer(0)
    rows, columns = part.template.grid.shape
    common = seen.intersection(box(0, 0, columns, rows)).area
    return float(MultiPoint(spots).convex_hull.area / common) if common > 0 else 0.0


def _evidence(
    pair: Pair, fitted: Fitted, accuracy: Accuracy, log_chance: float, rival: float
) -> Evidence:
    matrix = fitted.selection.estimate.transformation.matrix
    metric = np.array(pair.frame().metric).reshape(2, 2)
    ground = metric @ matrix[:, :2] @ np.linalg.inv(metric)
    height, width = pair.source.grid.shape
    centre = np.array([[width / 2, height / 2]])
    shift = pair.to_reference(matrix, centre) - pair.to_reference(IDENTITY, centre)
    stretch = np.linalg.svd(ground, compute_uv=False)
    turn = math.degrees(math.atan2(ground[1, 0] - ground[0, 1], ground[0, 0] + ground[1, 1]))
    return Evidence(
        points=int(fitted.points.kept.sum()),
        log_nfa=fitted.log_nfa,
        log_chance=log_chance,
        coverage=accuracy.coverage,
        sigma_px=accuracy.sigma_corner_px,
        disagreement_px=fitted.disagreement_px,
        rival=rival,
        shift_px=float(np.hypot(*shift[0])),
        rotation_deg=abs(turn),
        scale=float(max(stretch[0], 1 / max(stretch[1], 1e-9))),
    )
