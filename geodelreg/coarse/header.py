"""Where the header says, or a shift from there: by edges, and by patches that leave no doubt."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
from affine import Affine

from geodelreg.coarse.correlation import AMBIGUOUS, best_shift
from geodelreg.fine.layers import ELSEWHERE, SURE_LOG_NFA, Pass
from geodelreg.fine.least_squares import MAX_MOVE, ROUGH_STEP, MatchOptions
from geodelreg.fine.looks import mean_band
from geodelreg.fine.matching import match_pass
from geodelreg.fine.overlay import overlay
from geodelreg.fine.passes import COARSE_SIGMA
from geodelreg.fine.surface import make_surface
from geodelreg.fine.tiles import Tile, overview_tile
from geodelreg.fine.tuning import Tuning, decimation, fit_tone
from geodelreg.fit.chance import log_nfa
from geodelreg.fit.models import points_that_fix
from geodelreg.geo.maps.affine import IDENTITY, AffineMap
from geodelreg.pair import Pair, Roles, roles
from geodelreg.values.points import Guess, Overview, Status

logger = logging.getLogger(__name__)

_EDGE_SIGMA_PX = 0.5
_TONE_SAMPLES = 4_000  # half of the last pass; by hand: ½ to 2 × alike


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ProvenGuess(Guess):
    """A place near the header's on which nearly all patches agree.

    Attributes
    ----------
    proof : Pass
        Over the decimated images; its estimate is not None, and is the guess's map.
    tuning : Tuning
        Of that pass.
    """

    proof: Pass
    tuning: Tuning


def edge_guess(pair: Pair, images: Overview) -> Guess:
    """The shift at which edges correlate best, for pairs whose keypoints do not match."""
    return _by_edges(pair, images)[0]


def proven_guess(pair: Pair, images: Overview) -> ProvenGuess | None:
    """The header's place, or a shift from there, when nothing in the images lets one doubt it.

    That is when edges correlate there far better than at any other place, when nearly all patches
    of one or two passes over the decimated images agree, and when chance would not make so many.

    Returns
    -------
    ProvenGuess or None
        None = look with keypoints, which know rotations, large scales and clouds.
    """
    guess, rival = _by_edges(pair, images)
    if rival > AMBIGUOUS:
        return None
    part = roles(pair)
    tile = overview_tile(part, images)
    near = guess.map
    tuning = Tuning(COARSE_SIGMA, fit_tone(part, [tile], near, COARSE_SIGMA, _TONE_SAMPLES))
    for options in (MatchOptions(tolerance=ROUGH_STEP), MatchOptions()):
        found = match_pass(part, [tile], near, tuning, options)
        if found.estimate is None:
            return None
        near = found.estimate.map
        if found.is_calm:
            break
    surprise = _log_nfa(part, tile, found)
    logger.debug("at the header: rival %.2f, %d agree, log NFA %.1f", rival, found.kept, surprise)
    if not found.is_calm or surprise > SURE_LOG_NFA:
        return None
    return ProvenGuess(near, math.nan, {}, images, proof=found, tuning=tuning)


def _log_nfa(part: Roles, tile: Tile, found: Pass) -> float:
    """Chance agreement of the patches of the decimated images, each anywhere within its reach."""
    assert found.estimate is not None
    matched = np.isin(found.status, (Status.KEPT, *ELSEWHERE))
    points = found.points.take(matched)
    px = decimation(tile.template[0], part.template.grid)[0]
    px *= 1.0 if part.ms_is_template else part.surface_px_per_template_px
    gap = np.hypot(*(found.estimate.map.forward(points.source) - points.target).T) / px
    return log_nfa(gap, (2 * MAX_MOVE) ** 2, points_that_fix("affine"), MAX_MOVE)[0]


def _by_edges(pair: Pair, images: Overview) -> tuple[Guess, float]:
    """The shift at which edges correlate best, and how the best other place compares."""
    part = roles(pair)
    template, finer = mean_band(images.source), images.reference
    if not part.ms_is_template:
        template, finer = finer, template
    surface = make_surface(finer, part.surface.grid, (_EDGE_SIGMA_PX, _EDGE_SIGMA_PX))
    step = ~part.template.grid.transform @ template.grid.transform
    best = best_shift(overlay(part, template, surface, IDENTITY))
    move = best.move * np.array([step.a, step.e])
    if not part.ms_is_template:
        # template pixel x shows what the surface has at x + shift: carry that to MS pixels
        ends = part.to_surface(IDENTITY).forward(np.stack([move, np.zeros(2)]))
        move = ends[1] - ends[0]
    shift = AffineMap(Affine.translation(*move.tolist()))
    return Guess(shift, math.nan, {}, images), best.rival
