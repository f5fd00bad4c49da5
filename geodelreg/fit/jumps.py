"""Rows at which an image jumps, as where a scanner dropped lines.

They are found one by one, the most likely first.  A jump pays when the field with a cut there is so
much likelier that chance, asked at every row, does not make it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from geodelreg.fit.estimate import Observations
from geodelreg.fit.field import FieldFit, fit_field, tuned
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.kriging import Kernel
from geodelreg.values.raster import FloatArray, IntArray

_MOST_JUMPS = 6  # by hand, untried
_CHANCE = 1e-3
"""Expected false alarms a pair, the usual ε of a-contrario methods scaled to a thousand pairs."""
_CANDIDATES = 3
_SIDE_ROWS = 3
_LEAST_PER_PART = 3
"""Points, for the offset of a part: of a third of the patches a row that is cut through has some
more."""


def cut_at_jumps(points: Observations, smooth: FieldFit) -> FieldFit:
    """The fit to the same points with cuts where the images jump along rows; itself where not.

    Parameters
    ----------
    points : Observations
    smooth : FieldFit
        Of all of them, without cuts.
    """
    jumps = find_jumps(points.take(smooth.inlier), smooth.field.kernel, smooth.weight)
    return fit_field(points, smooth.field.kernel, jumps) if jumps else smooth


def find_jumps(points: Observations, kernel: Kernel, weight: FloatArray) -> tuple[float, ...]:
    """Rows where the displacement jumps, ascending; none where a smooth field explains as much.

    Between two rows of patches, or at one whose patches are cut through.

    Parameters
    ----------
    points : Observations
        On rows of patches, as a grid of them gives.
    kernel : Kernel
        Of the field without jumps.
    weight : (N,) float64
        Student weights.
    """
    rows = np.unique(points.source[:, 1])
    jumps: tuple[float, ...] = ()
    if 2 * len(rows) > len(points):
        return jumps  # not on rows: PAN was cut into patches
    middle = (rows[1:] + rows[:-1]) / 2
    here = tuned(points, kernel, weight, jumps)
    while len(jumps) < _MOST_JUMPS:
        steps = _steps(points, rows, jumps)
        found: list[tuple[float, FieldMap]] = []
        for number in np.argsort(-steps, kind="stable")[:_CANDIDATES]:
            cut = tuple(sorted({*jumps, float(middle[number])}))
            if len(cut) == len(jumps) or not _each_has_points(here.source, cut):
                continue
            if replace(here, jumps=cut).cost() > here.cost():
                continue  # no kernel will make a cut pay that this one's range has no use for
            field = tuned(points, here.kernel, weight, cut)
            found.append((field.cost(), field))
        # restricted likelihoods of unlike trends: the step's own unknown weighs log N per axis
        price = 2 * math.log(len(middle) / _CHANCE) + 2 * math.log(len(here.source))
        best = min(found, key=lambda trial: trial[0], default=None)
        if best is None or here.cost() - best[0] < price:
            break
        here, jumps = best[1], best[1].jumps
    return _through_rows(rows, jumps)


def _through_rows(rows: FloatArray, jumps: tuple[float, ...]) -> tuple[float, ...]:
    """One jump through a row of patches in place of two that have it alone between them.

    A jump cuts through these patches, and they say where neither side of it lies.
    """
    held = [rows[(rows > above) & (rows < below)] for above, below in pairwise(jumps)]
    for number, between in enumerate(held):
        if len(between) == 1:
            through = (*jumps[:number], float(between[0]), *jumps[number + 2 :])
            return _through_rows(rows, through)
    return jumps


def _each_has_points(xy: FloatArray, jumps: tuple[float, ...]) -> bool:
    part = np.searchsorted(jumps, xy[:, 1])
    return bool(np.bincount(part, minlength=len(jumps) + 1).min() >= _LEAST_PER_PART)


def _steps(points: Observations, rows: FloatArray, jumps: tuple[float, ...]) -> FloatArray:
    """(R - 1,) size of the step between neighbouring rows, each side being continued by a line."""
    move = points.target - points.source
    mean = np.stack([np.median(move[points.source[:, 1] == row], axis=0) for row in rows])
    part = np.searchsorted(jumps, rows)

    def end(side: IntArray, at: float) -> FloatArray:
        side = side[part[side] == part[side[0]]][:_SIDE_ROWS]
        line = np.polyfit(rows[side] - at, mean[side], min(len(side) - 1, 1))
        return np.asarray(line[-1])

    number = np.arange(len(rows))
    ends = [
        end(number[: i + 1][::-1], middle) - end(number[i + 1 :], middle)
        for i, middle in enumerate((rows[1:] + rows[:-1]) / 2)
    ]
    return np.asarray(np.hypot(*np.array(ends).reshape(-1, 2).T))
