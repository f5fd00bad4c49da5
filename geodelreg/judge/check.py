"""How far off a raster lies, and whether that is more than is tolerated."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np

from geodelreg.fine.layers import LOCAL_RMS_PX, many_elsewhere
from geodelreg.judge.verdict import SIGNIFICANCE, bands_reason
from geodelreg.judge.words import lies, local_distortion
from geodelreg.pair import Pair, overlap_corners, roles
from geodelreg.values.points import TiePoints
from geodelreg.values.result import (
    BandMap,
    CheckOutcome,
    Misalignment,
    Outcome,
    Solution,
    Verdict,
)


def measure_misalignment(pair: Pair, solution: Solution) -> Misalignment:
    """Largest displacement over the overlap; a refused solution knows none.

    An affine displacement is longest at a corner, and so is its standard error.
    """
    if not solution.verdict.knows_the_place:
        return Misalignment()
    moved = [
        r.message for r in solution.verdict.reasons if r.name == "two_motions" and not r.passed
    ]
    corners = overlap_corners(roles(pair), solution.map)
    moves = pair.move_px(solution.map, corners)
    return Misalignment(
        distance_px=float(np.hypot(*moves.T).max()),
        distance_m=float(np.hypot(*(moves * np.array(pair.reference_gsd_m)).T).max()),
        sigma_px=solution.accuracy.sigma_corner_px,
        local_px=local_distortion(solution.tie_points),
        residual_interval_px=solution.accuracy.residual_interval_px,
        moved="".join(moved),
    )


def without_one_place(pair: Pair, solution: Solution) -> Solution:
    """The solution, refused where its bands lie so far apart that no one place is right for all.

    Parameters
    ----------
    pair : Pair
    solution : Solution
        With the bands that were found one by one.
    """
    worst, words = 0.0, ""
    for one, other in combinations(solution.bands, 2):
        gap = pair.move_px(one.map, pair.source_centre) - pair.move_px(
            other.map, pair.source_centre
        )
        doubt = SIGNIFICANCE * math.hypot(one.sigma_px, other.sigma_px)
        apart = float(np.hypot(*gap[0])) - doubt
        if apart > worst:
            worst, words = apart, f"{one.name} {lies(gap[0], other.name)}"
    reason = bands_reason(worst, words)
    if reason.passed:
        return solution
    refused = Verdict(Outcome.REFUSED, (*solution.verdict.reasons, reason))
    return replace(solution, verdict=refused)


def measure_band(pair: Pair, solution: Solution, band: BandMap) -> Misalignment:
    """Largest displacement of one band; what is local it has of the common map."""
    moved = replace(solution, map=band.map)
    whole = measure_misalignment(pair, moved)
    return replace(whole, sigma_px=math.hypot(whole.sigma_px, band.sigma_px))


def judge_misalignment(misalignment: Misalignment, limit_px: float) -> CheckOutcome:
    """Misaligned when significantly more than `limit_px` off, in whole or locally, or torn.

    Otherwise aligned, provided that the measurement is sharp enough to have shown a misalignment of
    the limit's size, in whole and locally.

    Parameters
    ----------
    misalignment : Misalignment
    limit_px : float
        PAN pixels.
    """
    doubt = SIGNIFICANCE * misalignment.sigma_px
    if math.isnan(doubt):
        return CheckOutcome.CANNOT_TELL
    low, high = _interval(misalignment)
    off = math.hypot(max(misalignment.distance_px - doubt, 0.0), low)
    if misalignment.moved or off > limit_px or misalignment.local_px > limit_px:
        return CheckOutcome.MISALIGNED
    return CheckOutcome.ALIGNED if max(doubt, high) <= limit_px else CheckOutcome.CANNOT_TELL


def is_affine_enough(misalignment: Misalignment, limit_px: float, points: TiePoints) -> bool | None:
    """False when a local warp is needed for `limit_px`; None when nothing can be told.

    Nothing can, unless distorted, when few points agree or many lie elsewhere.
    """
    if math.isnan(misalignment.local_px):
        return None
    if max(misalignment.local_px, _interval(misalignment)[0]) > min(LOCAL_RMS_PX, limit_px):
        return False
    return None if many_elsewhere(points) else True


def _interval(misalignment: Misalignment) -> tuple[float, float]:
    """Ends of what one affine leaves, PAN pixels; 0 where nothing is known."""
    low, high = (0.0 if math.isnan(end) else end for end in misalignment.residual_interval_px)
    return low, high
