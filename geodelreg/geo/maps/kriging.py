"""Kriging of one component: how the residual varies, and the equations that its points solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.values.raster import FloatArray

_JITTER = 1e-9  # of the variance: keeps the equations of points at one place solvable
_MATERN = 5.0  # twice the order 5/2


@dataclass(frozen=True, slots=True)
class Kernel:
    """How residual and noise vary.

    Attributes
    ----------
    range_px : float
        Distance scale of the Matérn 5/2 correlation, source pixels.
    variance_px2 : (float, float)
        Of the residual, along columns and rows.
    nugget_px2 : float
        Variance per axis that every patch has besides its own covariance.
    """

    range_px: float
    variance_px2: tuple[float, float]
    nugget_px2: float

    @property
    def decay(self) -> float:
        """Of the exponential, per pixel."""
        return float(np.sqrt(_MATERN)) / self.range_px

    def correlation(self, distance_px: FloatArray) -> FloatArray:
        """Of the residual at places so far apart."""
        scaled = self.decay * distance_px
        return np.asarray((1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled))

    def growth(self, distance_px: FloatArray) -> FloatArray:
        """Derivative of the correlation by the logarithm of the range."""
        scaled = self.decay * distance_px
        return np.asarray(scaled**2 / 3.0 * (1.0 + scaled) * np.exp(-scaled))

    def fall(self, distance_px: FloatArray) -> FloatArray:
        """Derivative of the correlation by the place, over the vector between both places."""
        scaled = self.decay * distance_px
        return np.asarray(-(self.decay**2) / 3.0 * (1.0 + scaled) * np.exp(-scaled))


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """The kriging equations of one component, whitened: factors, trend and what it leaves."""

    variance: float
    factor: FloatArray
    design: FloatArray
    normal: FloatArray
    beta: FloatArray
    white: FloatArray
    alpha: FloatArray

    def cost(self) -> float:
        """Minus twice the logarithm of the restricted likelihood, up to a constant."""
        logs = np.log(np.diag(self.factor)).sum() + np.log(np.diag(self.normal)).sum()
        return float(2.0 * logs + self.white @ self.white)

    def rates(self, *changes: FloatArray) -> list[float]:
        """Of `cost`, while the covariance of the points changes (Rasmussen & Williams 2006, 5.9).

        Parameters
        ----------
        *changes : (N, N) or (N,) float64
            Symmetric, or diagonals.
        """
        from scipy.linalg.lapack import dpotri

        half, _ = dpotri(self.factor, lower=1)  # symmetric, as changes are: half of it tells all
        own = np.diag(half)
        trend = _lower(self.normal, _upper(self.factor, self.design).T)
        taken = np.vstack([trend, self.alpha])
        found = []
        for change in changes:
            if change.ndim == 1:
                found.append(own @ change - (taken**2).sum(axis=0) @ change)
                continue
            whole = 2 * np.vdot(half.T, change) - own @ np.diag(change)
            found.append(whole - np.vdot(taken, taken @ change))
        return found

    def predict(self, near: FloatArray, columns: FloatArray) -> FloatArray:
        """(M,) displacement."""
        return np.asarray(columns @ self.beta + self.variance * (near.T @ self.alpha))

    def unknown(self, near: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """White parts of the error's covariance: known by the points, and lacking in the trend."""
        known = _lower(self.factor, self.variance * near)
        return known, _lower(self.normal, columns.T - self.design.T @ known)

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Leave-one-out residuals and their variances."""
        from scipy.linalg.lapack import dtrtri

        half, _ = dtrtri(self.factor, lower=1)
        trend = _lower(self.normal, self.design.T @ half)
        precision = (half**2).sum(axis=0) - (trend**2).sum(axis=0)
        return self.alpha / precision, 1.0 / precision


def solve_axis(
    columns: FloatArray,
    correlation: FloatArray,
    move: FloatArray,
    noise_px2: FloatArray,
    variance_px2: float,
) -> Axis:
    """Solve the equations of one component.

    Parameters
    ----------
    columns : (N, K) float64
        Of the trend.
    correlation : (N, N) float64
        Of the residual.
    move, noise_px2 : (N,) float64
    variance_px2 : float
        Of the residual.

    Raises
    ------
    numpy.linalg.LinAlgError
        The points determine no trend.
    """
    total = variance_px2 * correlation
    total[np.diag_indices_from(total)] += noise_px2 + _JITTER * variance_px2
    factor = _factor(total)
    design = _lower(factor, columns)
    white = _lower(factor, move)
    normal = _factor(design.T @ design)
    beta = _upper(normal, _lower(normal, design.T @ white))
    white = white - design @ beta
    return Axis(variance_px2, factor, design, normal, beta, white, _upper(factor, white))


# LAPACK itself: SciPy's own checks cost more than small equations


def _factor(matrix: FloatArray) -> FloatArray:
    from scipy.linalg.lapack import dpotrf

    factor, failed = dpotrf(matrix.T, lower=1, clean=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the points determine no trend")
    return np.asarray(factor)


def _lower(factor: FloatArray, right: FloatArray, transposed: bool = False) -> FloatArray:
    from scipy.linalg.lapack import dtrtrs

    return np.asarray(dtrtrs(factor, right, lower=1, trans=int(transposed))[0])


def _upper(factor: FloatArray, right: FloatArray) -> FloatArray:
    return _lower(factor, right, transposed=True)


def distances(one: FloatArray, other: FloatArray) -> FloatArray:
    """(N, M) distances between (N, 2) and (M, 2) points."""
    from scipy.spatial.distance import cdist

    return np.asarray(cdist(one, other))
