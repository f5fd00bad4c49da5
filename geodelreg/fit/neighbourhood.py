"""What the neighbours of a point on the mesh say about its displacement.

The star of a point is its neighbours on the Delaunay mesh and theirs.  A plane is fitted to the
displacements of the star, robustly and with a prior against strong local strain, and evaluated at
the point, which itself takes no part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geodelreg.geo.triangulation import Star, running
from geodelreg.values.raster import TINY, FloatArray, IntArray

_FIT_ROUNDS = 2
_CAUCHY_TUNING = 2.0
_NEARNESS = 3.0
_QUARTER = 0.25  # more than half of the members may be wrong
_LOWER_QUARTILE = 0.5754  # of χ²(2): −2 ln 0.75


class Field(NamedTuple):
    """Displacements at scattered points.

    Attributes
    ----------
    xy : (N, 2) float64
    displacement : (N, 2) float64
    variance : (N,) float64
        Of one component of the displacement.
    """

    xy: FloatArray
    displacement: FloatArray
    variance: FloatArray

    def at(self, index: IntArray) -> Field:
        """Some of the points."""
        return Field(self.xy[index], self.displacement[index], self.variance[index])


class Prediction(NamedTuple):
    """Displacement that the star tells for each target.

    Attributes
    ----------
    displacement : (T, 2) float64
    variance : (T,) float64
        Of one component, by propagation; distance from the target counts as more variance of a
        member.  ``inf`` for a target without star.
    scatter : (T,) float64
        Mean square of one component around the plane, over the stated variances; far mismatches
        hardly count.
    """

    displacement: FloatArray
    variance: FloatArray
    scatter: FloatArray


def predict(targets: FloatArray, star: Star, field: Field, max_strain: float) -> Prediction:
    """Displacement at each target from its star.

    A plane, fitted by iteratively reweighted least squares (squared Cauchy weights) that begins at
    the medians.  Near points weigh more than far ones, which keeps the bias by curvature small.

    Parameters
    ----------
    targets : (T, 2) float64
    star : Star
    field : Field
    max_strain : float
        Standard deviation that a gradient of the displacement is expected to have, px per px.

    Returns
    -------
    Prediction
    """
    count = len(targets)
    offset = field.xy[star.member] - targets[star.target]
    distance2 = (offset * offset).sum(axis=1)
    size = np.maximum(np.bincount(star.target, minlength=count), 1)
    reach = np.sqrt(np.maximum(np.bincount(star.target, distance2, count) / size, TINY))
    basis = np.column_stack([np.ones(len(offset)), offset / reach[star.target, None]])
    values = field.displacement[star.member]
    stated = field.variance[star.member]
    gap = values - _medians(star.target, values, count)[star.target]
    spread2 = stated + max_strain**2 * distance2
    nearness = np.exp(-_NEARNESS * distance2 / reach[star.target] ** 2)
    prior = 1.0 / (max_strain * reach) ** 2
    for _ in range(_FIT_ROUNDS):
        misfit = (gap * gap).sum(axis=1) / spread2
        usual = _usual(misfit)
        weight = nearness / (stated * (1.0 + misfit / (_CAUCHY_TUNING**2 * usual)) ** 2)
        coefficients, variance = _fit_planes(star.target, basis, values, weight / usual, prior)
        gap = values - np.einsum("kb,kbc->kc", basis, coefficients[star.target])
        spread2 = stated
    total = np.maximum(np.bincount(star.target, weight, count), np.finfo(np.float64).tiny)
    around = np.bincount(star.target, weight * (gap * gap).sum(axis=1) / stated, count)
    return Prediction(coefficients[:, 0], variance, around / (2 * total))


def _usual(misfit: FloatArray) -> float:
    """Factor by which the stated variances are too small, at least 1; by the lower quartile.

    `misfit` has squared distances over variances, whose lower quartile is 0.575 for a normal
    distribution in the plane.
    """
    if len(misfit) == 0:
        return 1.0
    return max(float(np.quantile(misfit, _QUARTER)) / _LOWER_QUARTILE, 1.0)


def _fit_planes(
    target: IntArray, basis: FloatArray, values: FloatArray, weight: FloatArray, prior: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(T, 3, 2) plane coefficients and (T,) variance of the constant term."""
    count = len(prior)
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3, 2))
    weighted = weight[:, None] * basis
    for i, j in np.ndindex(3, 3):
        normal[:, i, j] = np.bincount(target, weighted[:, i] * basis[:, j], count)
    for i, c in np.ndindex(3, 2):
        right[:, i, c] = np.bincount(target, weighted[:, i] * values[:, c], count)
    starless = normal[:, 0, 0] == 0
    normal[starless, 0, 0] = 1.0
    normal[:, 1, 1] += prior
    normal[:, 2, 2] += prior
    inverse = np.linalg.inv(normal)
    variance = np.where(starless, np.inf, inverse[:, 0, 0])
    return np.einsum("tij,tjc->tic", inverse, right), variance


def _medians(target: IntArray, values: FloatArray, count: int) -> FloatArray:
    """(T, 2) float64, lower median per target and component; 0 for targets without star."""
    size = np.bincount(target, minlength=count)
    medians = np.zeros((count, 2))
    some = np.flatnonzero(size)
    padded = np.full((count, int(size.max(initial=0))), np.inf)
    for c in range(2):
        padded[target, running(size)] = values[:, c]
        medians[some, c] = np.sort(padded, axis=1)[some, (size[some] - 1) // 2]
    return medians
