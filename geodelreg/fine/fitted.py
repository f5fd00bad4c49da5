"""From patches that agree to a map of the simplest model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geodelreg.fine.least_squares import Matched
from geodelreg.fine.matching import patches_log_nfa, tie_points
from geodelreg.fine.passes import Refinement
from geodelreg.fit.choice import Fitted, half_disagreement, select_for
from geodelreg.fit.estimate import student_weight
from geodelreg.fit.models import points_that_fix
from geodelreg.pair import Pair, overlap_corners
from geodelreg.values.points import Guess, Status, TiePoints
from geodelreg.values.raster import StatusArray

_FEWEST_POINTS = 4


class Found(NamedTuple):
    """What a guess led to: patches around a fitted map."""

    guess: Guess
    refined: Refinement
    fitted: Fitted


def fit_patches(
    pair: Pair, guess: Guess, refined: Refinement, status: StatusArray
) -> Fitted | None:
    """The map that the kept patches choose; None of too few.

    Parameters
    ----------
    pair : Pair
    guess : Guess
    refined : Refinement
    status : (P,) uint8
        Of the patches of the last pass; those that the fit rejects are marked in it.
    """
    part, last = refined.part, refined.last
    kept = np.flatnonzero(status == Status.KEPT)
    points = last.points.take(kept)
    if len(points) < _FEWEST_POINTS:
        return None
    selection = select_for(pair, points)
    estimate = selection.estimate
    status[kept[~estimate.inlier]] = Status.RESIDUAL
    weight = np.full(len(status), np.nan)
    weight[kept] = student_weight(estimate.distance2)
    tied = tie_points(part, last.matched, estimate.map, status, weight)
    halves = points.take(estimate.inlier)
    apart = half_disagreement(halves, estimate, overlap_corners(part, estimate.map))
    return Fitted(
        selection,
        tied,
        guess.counts | patch_counts(last.matched, tied),
        patches_log_nfa(part, tied, points_that_fix(estimate.model)),
        pair.pan_px_per_source_px * apart,
    )


def patch_counts(matched: Matched, tied: TiePoints) -> dict[str, int]:
    """How many patches were looked at, matched, and kept."""
    return {
        "patches": len(tied),
        "patches matched": int((matched.status == Status.KEPT).sum()),
        "patches kept": int(tied.kept.sum()),
    }
