"""All that speaks for and against a fitted map, gathered once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from geodelreg.fine.layers import Claim, keypoints_apart, rival_motion
from geodelreg.fine.overlay import Overlay, overlay, widened
from geodelreg.fine.passes import COARSE_SIGMA, Refinement
from geodelreg.fine.surface import Surface, make_surface
from geodelreg.fine.tiles import dark_tile, overview_tile
from geodelreg.fine.tuning import surface_sigma
from geodelreg.fit.choice import Fitted
from geodelreg.fit.models import points_that_fix
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.judge.accuracy import measure
from geodelreg.judge.bands import ask_bands
from geodelreg.judge.in_place import AreaEvidence, area_evidence
from geodelreg.judge.repeated import proof_without_repeated
from geodelreg.judge.rival import Rival, rival_correlation
from geodelreg.judge.unshared import unshared_share
from geodelreg.judge.verdict import Evidence
from geodelreg.judge.words import BANDS_TOLD_PX, followed_part
from geodelreg.pair import Pair
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess
from geodelreg.values.raster import TINY, Band
from geodelreg.values.result import Accuracy

_SURE_LOG_CHANCE = -12.0  # far beyond the gate's −8: all patches would say the same


def gather(
    guess: Guess, refined: Refinement, fitted: Fitted, heard: Sequence[Claim]
) -> tuple[Accuracy, Evidence]:
    """Measure how good a map is, and what the images say about it.

    Parameters
    ----------
    guess : Guess
        That led to it.
    refined : Refinement
        The patches around it.
    fitted : Fitted
    heard : sequence of Claim
        Of guesses that were refused before.
    """
    part, correction = refined.part, fitted.map
    pair = part.pair

    def overlaid() -> tuple[Accuracy, Rival]:
        before, after, wide = _overlays(guess, refined, correction)
        unshared = unshared_share(refined, correction, fitted.points)
        accuracy = measure(part, fitted.points, fitted.selection, before, after, unshared)
        return accuracy, rival_correlation(wide)

    def in_place() -> AreaEvidence:
        where = (part, refined.tiles, correction, refined.tuning, refined.size)
        few = area_evidence(*where, few=True)
        return few if few.log_chance <= _SURE_LOG_CHANCE else area_evidence(*where, few=False)

    enough = points_that_fix(fitted.selection.estimate.model)
    # where MS is coarser, the tiles still hold the last pass's surfaces for all of this to share
    with ThreadPoolExecutor(pair.threads) as pool:
        whole, places = pool.submit(overlaid), pool.submit(in_place)
        repeats = pool.submit(proof_without_repeated, refined, correction, enough)
        told_px = BANDS_TOLD_PX / pair.pan_px_per_source_px
        apart, told = ask_bands(guess, refined, correction, told_px, pool)
        (accuracy, rival), area, repeated = whole.result(), places.result(), repeats.result()
    turn_deg, scale = turn_and_scale(pair, correction)
    keypoints_px, keypoints_move = keypoints_apart(pair, guess, heard, correction, fitted.points)
    return accuracy, Evidence(
        points=accuracy.kept,
        log_nfa=fitted.log_nfa,
        log_chance=area.log_chance,
        coverage=accuracy.coverage,
        sigma_px=accuracy.sigma_corner_px,
        disagreement_px=fitted.disagreement_px,
        rival=rival.elsewhere,
        shading=rival.beside,
        repeated=repeated.log_chance,
        repeated_words=repeated.words,
        shift_px=float(np.hypot(*pair.move_px(correction, pair.source_centre)[0])),
        rotation_deg=abs(turn_deg),
        scale=scale,
        rival_motion=rival_motion(fitted.points, part.pan_px_per_patch_px),
        support=area.support,
        bands_apart=apart.distance_px * pair.pan_px_per_source_px / part.pan_px_per_patch_px,
        bands=told.distance_px * pair.pan_px_per_source_px,
        bands_words=told.words,
        keypoints_apart=keypoints_px,
        keypoints_words=followed_part(fitted.points, pair, keypoints_move),
    )


def _overlays(
    guess: Guess, refined: Refinement, correction: PixelMap
) -> tuple[Overlay, Overlay, Overlay]:
    """Both images, decimated, one on the other: under the header and under the correction.

    The third is the second with all that was read of the finer image.
    """
    part = refined.part
    template, finer, surface = decimated(guess, refined, refined.dark_only)
    wide = widened(part, template, finer, correction)
    everything = overlay(part, wide, surface, correction)
    left, top = (round(v) for v in ~wide.grid.transform @ (template.grid.transform @ (0, 0)))
    height, width = template.data.shape
    after = everything.part(slice(top, top + height), slice(left, left + width))
    return overlay(part, template, surface, IDENTITY), after, everything


def decimated(guess: Guess, refined: Refinement, dark: bool) -> tuple[Band, Band, Surface]:
    """Both images, decimated: the coarser, the finer, and what that shows at the former's size.

    Parameters
    ----------
    guess : Guess
    refined : Refinement
    dark : bool
        Leave bright objects out.
    """
    part, tone = refined.part, refined.tuning.tone
    tile = overview_tile(part, guess.images)
    if dark:
        tile = dark_tile(part, tile, guess)
    template, finer = tile.template[0], tile.surface[0]
    if part.ms_is_template:
        template = tone(tile.template)
    else:
        finer = tone(tile.surface)
    sigma = surface_sigma(part, tile, COARSE_SIGMA)
    return template, finer, make_surface(finer, part.surface.grid, sigma)


def turn_and_scale(pair: Pair, correction: PixelMap) -> tuple[float, float]:
    """Rotation on the ground in degrees, and the larger of the stretch and its inverse."""
    metric = pair.metric
    linear = correction.linearise(pair.source_centre)[0, :, :2]
    ground = metric @ linear @ np.linalg.inv(metric)
    stretch = np.linalg.svd(ground, compute_uv=False)
    turn = math.degrees(math.atan2(ground[1, 0] - ground[0, 1], ground[0, 0] + ground[1, 1]))
    return turn, float(max(stretch[0], 1 / max(stretch[1], TINY)))
