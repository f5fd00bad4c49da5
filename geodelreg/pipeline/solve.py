"""From one hypothesis to a solution: refine, select the model, measure accuracy and evidence."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from geodelreg.fit.gate import Evidence, is_worthwhile, judge, nothing_agrees, verdict
from geodelreg.fit.models import IDENTITY, PARAMETER_COUNT, Transformation
from geodelreg.fit.select import Selection, half_disagreement, select_model
from geodelreg.geo.crs import linearise
from geodelreg.match.area import Overlay, rival_correlation
from geodelreg.match.delaunay_filter import star_filter
from geodelreg.match.refine import RefineOptions
from geodelreg.match.surface import make_surface
from geodelreg.match.surprise import log_nfa
from geodelreg.pipeline.accuracy import measure
from geodelreg.pipeline.dense import Dense, surface_sigma
from geodelreg.pipeline.evidence import (
    AreaEvidence,
    area_evidence,
    bands_apart,
    overlay,
    rival_motion,
    widened,
)
from geodelreg.pipeline.refinement import (
    COARSE_SIGMA,
    Refinement,
    dark_tile,
    refine_densely,
    working_tile,
)
from geodelreg.pipeline.search import Hypothesis
from geodelreg.pipeline.state import Pair
from geodelreg.pipeline.tiles import Roles, overlap_corners, roles
from geodelreg.types import Accuracy, FloatArray, Status, StatusArray, TiePoints, Verdict

_NEGLIGIBLE_PX = 0.005
_FEWEST_POINTS = 4
_SURE_LOG_CHANCE = -12.0


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
    without_bright : bool
        Bright objects were left out, because they move differently.
    timings_s : dict of str to float
    """

    transformation: Transformation
    tie_points: TiePoints
    accuracy: Accuracy
    verdict: Verdict
    step_counts: dict[str, int]
    band_weights: dict[str, float]
    warnings: tuple[str, ...]
    without_bright: bool
    timings_s: dict[str, float]


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


def solve(pair: Pair, hypothesis: Hypothesis) -> Solution | None:
    """Refine a hypothesis by dense patches and judge it; None when too few patches match."""
    timings: dict[str, float] = {}
    start = perf_counter()
    refined = refine_densely(roles(pair), hypothesis, timings)
    if refined is None:
        return None
    part = refined.part
    status = _on_the_mesh(refined.dense)
    kept = status == Status.KEPT
    points = refined.dense.observations.take(kept)
    if len(points) < _FEWEST_POINTS:
        return None
    corners = pair.corners()
    negligible = _NEGLIGIBLE_PX / max(pair.pan_px_per_source_px, 1e-9)
    selection = select_model(points, pair.frame(), corners, pair.options.model, negligible)
    status[np.flatnonzero(kept)[~selection.estimate.inlier]] = Status.RESIDUAL
    matrix = selection.estimate.transformation.matrix
    tied = tie_points(part, refined.dense, matrix, status)
    corners = overlap_corners(part, matrix)
    fitted = Fitted(
        selection,
        tied,
        dict(hypothesis.counts) | _patch_counts(refined, tied),
        _agreement_log_nfa(part, tied, selection.estimate.transformation.model),
        pair.pan_px_per_source_px
        * half_disagreement(points.take(selection.estimate.inlier), selection.estimate, corners),
    )
    timings["fit"] = perf_counter() - start - sum(timings.values())
    return conclude(hypothesis, refined, fitted, timings)


def unsolved() -> Solution:
    """The refusal of a pair for which nothing was found that could be refined."""
    none = np.empty((0, 2))
    points = TiePoints(
        none, none, np.empty((0, 2, 2)), none[:, 0], np.empty(0, np.uint8), none[:, 0] > 0, none
    )
    return Solution(
        Transformation("none", IDENTITY),
        points,
        Accuracy(),
        verdict((nothing_agrees(),), moves=False),
        {"tie points": 0},
        {},
        (),
        False,
        {},
    )


def _on_the_mesh(dense: Dense) -> StatusArray:
    """Status with the patches marked that disagree with their star on the Delaunay mesh.

    Where nothing scatters beyond its own covariance there is nothing to find.
    """
    status = dense.status.copy()
    kept = np.flatnonzero(status == Status.KEPT)
    if dense.estimate is not None and dense.estimate.extra_variance_px2 > 0:
        points = dense.observations.take(kept)
        status[kept[~star_filter(points.source, points.target, points.covariance)]] = Status.STAR
    return status


def _patch_counts(refined: Refinement, points: TiePoints) -> dict[str, int]:
    matched = int((refined.dense.refined.status == Status.KEPT).sum())
    return {
        "patches": len(points),
        "patches matched": matched,
        "patches kept": int(points.kept.sum()),
    }


def _agreement_log_nfa(part: Roles, points: TiePoints, model: str) -> float:
    """Chance agreement of patches, each of which may end anywhere within its reach."""
    matched = points.kept | np.isin(points.status, (Status.CONSENSUS, Status.STAR, Status.RESIDUAL))
    gap = np.hypot(*points.residual_px[matched].T)
    reach = 2 * RefineOptions().max_move * part.pan_px_per_patch_px
    return log_nfa(gap, reach**2, PARAMETER_COUNT[model] // 2, reach / 2)[0]


def conclude(
    hypothesis: Hypothesis,
    refined: Refinement,
    fitted: Fitted,
    timings: dict[str, float],
) -> Solution:
    """Measure accuracy and evidence of a fitted model, and judge it."""
    start = perf_counter()
    part, estimate = refined.part, fitted.selection.estimate
    pair = part.pair
    matrix = estimate.transformation.matrix

    def overlaid() -> tuple[Accuracy, float]:
        before, after, wide = _overlays(hypothesis, refined, matrix)
        accuracy = measure(part, fitted.points, fitted.selection, before, after)
        return accuracy, rival_correlation(wide)

    # where MS is coarser, the tiles still hold the last pass's surfaces for all of this to share
    where = (part, refined.tiles, matrix, refined.tuning, refined.size)
    with ThreadPoolExecutor(pair.threads) as pool:
        whole = pool.submit(overlaid)
        apart = bands_apart(*where, pool)
        area = area_evidence(*where, few=True)
        if area.log_chance > _SURE_LOG_CHANCE:
            area = area_evidence(*where, few=False)
        accuracy, rival = whole.result()
    evidence = replace(_evidence(part, fitted, accuracy, area), rival=rival, bands_apart=apart)
    grid = pair.lattice()
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
        refined.without_bright,
        timings,
    )


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
    hypothesis: Hypothesis, refined: Refinement, matrix: FloatArray
) -> tuple[Overlay, Overlay, Overlay]:
    """Both images, decimated, one on the other: under the header and under the correction.

    The third is the second with all that was read of the finer image.
    """
    part, tuning = refined.part, refined.tuning
    tile = working_tile(part, hypothesis.pair)
    if refined.dark_only:
        tile = dark_tile(part, tile, hypothesis)
    if part.ms_is_template():
        template, finer = tuning.tone(tile.template), tile.surface[0]
    else:
        template, finer = tile.template[0], tuning.tone(tile.surface)
    sigma = surface_sigma(part, tile, COARSE_SIGMA)
    surface = make_surface(finer, part.surface.grid, sigma)
    wide = widened(part, template, finer, matrix)
    everything = overlay(part, wide, surface, matrix)
    left, top = (round(v) for v in ~wide.grid.transform @ (template.grid.transform @ (0, 0)))
    height, width = template.data.shape
    after = everything.part(slice(top, top + height), slice(left, left + width))
    return overlay(part, template, surface, IDENTITY), after, everything


def _evidence(part: Roles, fitted: Fitted, accuracy: Accuracy, area: AreaEvidence) -> Evidence:
    """What needs no more pixels."""
    pair = part.pair
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
        log_chance=area.log_chance,
        coverage=accuracy.coverage,
        sigma_px=accuracy.sigma_corner_px,
        disagreement_px=fitted.disagreement_px,
        rival=float("nan"),
        shift_px=float(np.hypot(*shift[0])),
        rotation_deg=abs(turn),
        scale=float(max(stretch[0], 1 / max(stretch[1], 1e-9))),
        rival_motion=rival_motion(fitted.points, part.pan_px_per_patch_px),
        support=area.support,
    )
