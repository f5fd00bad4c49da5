"""The motion that a fair share of many points has in common to within their noise."""

from __future__ import annotations

import math

import numpy as np

from geodelreg.fit.consensus import consensus
from geodelreg.fit.estimate import Observations
from geodelreg.values.raster import TINY, BoolArray, FloatArray

_CORE_SIGMAS = 1.5  # of the patches' own noise; by hand: 2 ×: 1 of 36 twice as far off
_CORE_FLOOR_PX = 0.03  # of a patch pixel; by hand: ½ to 2 × alike
_GROWTH = 1.5  # of the tolerance from try to try; by hand: ½ to 2 × alike
_SHIFT_SHARE = 0.15  # by hand: ½ to 2 × alike
_AFFINE_SHARE = 0.25  # by hand: ½ to 2 × alike
_CORE_REACH = 2.0


def rigid_core(points: Observations, unit: float) -> BoolArray:
    """Points near the shift, or else the affine, that a fair share fits to within the noise.

    The ground is rigid: its patches agree to within their noise.  Clouds at various heights do not,
    however many they are.  The tolerance starts at the noise and grows until enough points agree.
    If they stand out from the others they are the core; over relief, which displaces neighbours
    alike and no place as it does the next, none do, and all points have their say.
    """
    variance = points.variances.sum(axis=1)
    tolerance = max(_CORE_SIGMAS * float(np.sqrt(np.median(variance))), _CORE_FLOOR_PX * unit)
    move = points.target - points.source
    apart = np.hypot(*(move[:, None] - move[None]).transpose(2, 0, 1))
    while tolerance <= unit:
        near = apart <= tolerance
        shift = move[near[int(near.sum(axis=1).argmax())]].mean(axis=0)
        residuals = [move - shift, *_affine_residuals(points, variance, tolerance)]
        shares = [float((np.hypot(*gap.T) <= tolerance).mean()) for gap in residuals]
        if shares[0] >= max(_SHIFT_SHARE, shares[-1] / 2):
            return _core(residuals[0], tolerance, variance)
        if shares[-1] >= _AFFINE_SHARE:
            return _core(residuals[-1], tolerance, variance)
        tolerance *= _GROWTH
    return np.ones(len(points), dtype=bool)


def _core(residual: FloatArray, tolerance: float, variance: FloatArray) -> BoolArray:
    """Points around 0, if more lie there than of a normal distribution as wide as theirs."""
    radius = np.hypot(*residual.T)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(residual.T)))
    fair = math.prod(math.erf(tolerance / (math.sqrt(2) * max(s, TINY))) for s in spread)
    if (radius <= tolerance).mean() < fair:
        return np.ones(len(radius), dtype=bool)
    return np.asarray(radius**2 < (_CORE_REACH * tolerance) ** 2 + 4.0 * variance)


def _affine_residuals(
    points: Observations, variance: FloatArray, tolerance: float
) -> list[FloatArray]:
    """(N, 2) residuals of the best affine; none where there is none."""
    found = consensus(points.source, points.target, tolerance)
    return [] if found.map is None else [points.target - found.map.forward(points.source)]
