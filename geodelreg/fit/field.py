"""A map that no affine holds: an affine trend plus a smooth residual (universal kriging).

The residual is a Gaussian process with a Matérn 5/2 kernel, twice differentiable as terrain, jitter
and lens distortion are; what a patch shows beyond it is its own noise: its covariance and a nugget.
Range, amplitudes and nugget maximise the restricted likelihood of the patches (Patterson & Thompson
1971, doi:10.1093/biomet/58.3.545; Rasmussen & Williams 2006, chapters 2 and 5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geodelreg.fit.estimate import Observations
from geodelreg.values.raster import FloatArray, IntArray

FEWEST_POINTS = 12
"""Twice the parameters of the trend of both axes: fewer leave nothing to tell noise by."""
MOST_STRAIN = 0.04
"""Of a field that is believed: relief seen at 20° bends by less, a fold by much more."""
_STUDENT_DOF = 6.0  # unexplained: ablate
_REJECT_D2 = 25.0  # unexplained: ablate
_ROUNDS = 3
_TUNING_POINTS = 200  # unexplained: ablate
_LEAST_VARIANCE_PX2 = 1e-8  # unexplained: ablate
_JITTER = 1e-9  # unexplained: ablate
_AT_ONCE = 20_000  # unexplained: ablate
_IMPOSSIBLE = 1e12  # unexplained: ablate
_LEAST_NUGGET_PX2 = 1e-7  # unexplained: ablate
_STEPS = 20  # unexplained: ablate
_CLOSE = 1e-6  # relative; unexplained: ablate
_STEP = 1e-3  # of a logarithm; unexplained: ablate
_MATERN = 5.0  # twice the order 5/2
_DIGITS = 2  # of the logarithms of a kernel: a percent, far below what points tell of it


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

    def correlation(self, distance_px: FloatArray) -> FloatArray:
        """Of the residual at places so far apart."""
        scaled = np.sqrt(_MATERN) / self.range_px * distance_px
        return np.asarray((1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled))


@dataclass(frozen=True, eq=False)
class Field:
    """A fitted field: source pixels to header pixels.

    Attributes
    ----------
    points : Observations
        That it stands on.
    kernel : Kernel
    weight : (N,) float64
        Student weights of the points.
    """

    points: Observations
    kernel: Kernel
    weight: FloatArray

    def forward(self, xy: FloatArray) -> FloatArray:
        """(..., 2) header pixels of (..., 2) source pixels."""
        flat = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        out = flat.copy()
        for start in range(0, len(flat), _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            near, columns = self._near(flat[some]), self._columns(flat[some])
            for number, axis in enumerate(self.axes):
                out[some, number] += axis.predict(near, columns)
        return out.reshape(np.shape(xy))

    def joint_covariance(self, xy: FloatArray) -> FloatArray:
        """(2, M, M) covariance of each component between M points, source pixels squared."""
        near, columns = self._near(xy), self._columns(xy)
        prior = self._between(xy, xy)
        parts = []
        for axis in self.axes:
            known, lack = axis.unknown(near, columns)
            parts.append(axis.variance * prior - known.T @ known + lack.T @ lack)
        return np.stack(parts)

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Leave-one-out residuals of the points and their variances without noise, (N, 2) each.

        The variances are those of the predictions, to which the points' own noise comes.
        """
        parts = [axis.left_out() for axis in self.axes]
        residual, variance = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
        noise = np.stack([axis.noise for axis in self.axes], axis=1)
        return residual, variance - noise

    def cost(self) -> float:
        """Minus twice the logarithm of the restricted likelihood, up to a constant."""
        return sum(axis.cost() for axis in self.axes)

    @cached_property
    def axes(self) -> tuple[_Axis, _Axis]:
        """The equations of columns and rows, solved."""
        xy = self.points.source
        columns, correlation = self._columns(xy), self._between(xy, xy)
        one, other = (
            _solve(self.points, self.weight, self.kernel, columns, correlation, axis)
            for axis in (0, 1)
        )
        return one, other

    def _columns(self, xy: FloatArray) -> FloatArray:
        """(N, 3) trend: an affine."""
        low, high = self.points.source.min(axis=0), self.points.source.max(axis=0)
        span = max(float((high - low).max()) / 2, 1.0)
        return np.column_stack([np.ones(len(xy)), (xy - (low + high) / 2) / span])

    def _near(self, xy: FloatArray) -> FloatArray:
        return self._between(self.points.source, xy)

    def _between(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """(N, M) correlation of the residual between places."""
        return self.kernel.correlation(distances(one, other))


@dataclass(frozen=True, slots=True, eq=False)
class _Axis:
    """The kriging equations of one component, whitened: factors, trend and what it leaves."""

    variance: float
    noise: FloatArray
    factor: FloatArray
    design: FloatArray
    normal: FloatArray
    beta: FloatArray
    white: FloatArray
    alpha: FloatArray

    def cost(self) -> float:
        logs = np.log(np.diag(self.factor)).sum() + np.log(np.diag(self.normal)).sum()
        return float(2.0 * logs + self.white @ self.white)

    def predict(self, near: FloatArray, columns: FloatArray) -> FloatArray:
        return np.asarray(columns @ self.beta + self.variance * (near.T @ self.alpha))

    def unknown(self, near: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """White parts of the error's covariance: known by the points, and lacking in the trend."""
        known = _lower(self.factor, self.variance * near)
        return known, _lower(self.normal, columns.T - self.design.T @ known)

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        half = _lower(self.factor, np.eye(len(self.noise)))
        trend = _lower(self.normal, self.design.T @ half)
        precision = (half**2).sum(axis=0) - (trend**2).sum(axis=0)
        return self.alpha / precision, 1.0 / precision


def _solve(
    points: Observations,
    weight: FloatArray,
    kernel: Kernel,
    columns: FloatArray,
    correlation: FloatArray,
    axis: int,
) -> _Axis:
    from scipy.linalg import cho_solve, cholesky, solve_triangular

    variance = kernel.variance_px2[axis]
    noise = (points.covariance[:, axis, axis] + kernel.nugget_px2) / weight
    total = variance * correlation
    total[np.diag_indices_from(total)] += noise + _JITTER * variance
    factor = cholesky(total, lower=True, check_finite=False, overwrite_a=True)
    design = _lower(factor, columns)
    white = _lower(factor, points.target[:, axis] - points.source[:, axis])
    normal = cholesky(design.T @ design, lower=True)
    beta = cho_solve((normal, True), design.T @ white)
    white = white - design @ beta
    alpha = solve_triangular(factor, white, lower=True, trans=1, check_finite=False)
    return _Axis(variance, noise, factor, design, normal, beta, white, alpha)


def _lower(factor: FloatArray, right: FloatArray) -> FloatArray:
    from scipy.linalg import solve_triangular

    return np.asarray(solve_triangular(factor, right, lower=True, check_finite=False))


def distances(one: FloatArray, other: FloatArray) -> FloatArray:
    """(N, M) distances between (N, 2) and (M, 2) points."""
    gap2 = (one[:, None, 0] - other[None, :, 0]) ** 2
    gap2 += (one[:, None, 1] - other[None, :, 1]) ** 2
    return np.asarray(np.sqrt(gap2))


def fit_field(points: Observations) -> Field:
    """Fit a field robustly: points are judged by what the others predict where they are.

    Parameters
    ----------
    points : Observations

    Returns
    -------
    Field
        Standing on the points that the others predict well enough.

    Raises
    ------
    ValueError
        With fewer than `FEWEST_POINTS` points, or points on a line.
    """
    if len(points) < FEWEST_POINTS:
        raise ValueError(f"{len(points)} points cannot determine a field")
    extent = np.ptp(points.source, axis=0)
    if not extent.min() > 0:
        raise ValueError("points on a line cannot determine a field")
    inlier, weight = np.ones(len(points), dtype=bool), np.ones(len(points))
    distance2 = np.zeros(len(points))
    kernel = _first_guess(points)
    for _ in range(_ROUNDS):
        kept = points.take(inlier)
        kernel = _tuned(_thinned(kept, kernel, weight[inlier]))
        field = Field(kept, kernel, weight[inlier])
        residual, variance = field.left_out()
        own = np.stack([kept.covariance[:, i, i] + kernel.nugget_px2 for i in (0, 1)], axis=1)
        distance2[inlier] = (residual**2 / (variance + own)).sum(axis=1)
        weight = (_STUDENT_DOF + 2) / (_STUDENT_DOF + distance2)
        enough = distance2 <= _REJECT_D2
        if (inlier & enough).sum() < FEWEST_POINTS:
            break
        inlier = inlier & enough
    return Field(points.take(inlier), kernel, weight[inlier])


def _thinned(points: Observations, kernel: Kernel, weight: FloatArray) -> Field:
    """A field of some hundred of the points, evenly picked: enough to tune a kernel by."""
    step = -(-len(points) // _TUNING_POINTS)
    some: IntArray = np.arange(0, len(points), step)
    return Field(points.take(some), kernel, weight[some])


def _first_guess(points: Observations) -> Kernel:
    spacing = _spacing(points)
    move = points.target - points.source
    columns = np.column_stack([points.source, np.ones(len(points))])
    left = move - columns @ np.linalg.lstsq(columns, move, rcond=None)[0]
    variance = np.maximum(left.var(axis=0), _LEAST_VARIANCE_PX2)
    noise = float(np.median(points.covariance.trace(axis1=1, axis2=2))) / 2
    return Kernel(
        4 * spacing, (float(variance[0]), float(variance[1])), max(noise, _LEAST_NUGGET_PX2)
    )


def _spacing(points: Observations) -> float:
    extent = np.ptp(points.source, axis=0)
    return float(np.sqrt(extent[0] * extent[1] / len(points)))


def _tuned(field: Field) -> Kernel:
    """Kernel of greatest restricted likelihood.

    Parameters
    ----------
    field : Field
        Its kernel is the first guess.
    """
    from scipy.optimize import minimize

    points, weight = field.points, field.weight
    extent = float(np.ptp(points.source, axis=0).max())
    columns = field._columns(points.source)
    apart = distances(points.source, points.source)

    def kernel(theta: FloatArray) -> Kernel:
        range_px, one, other, nugget = (float(value) for value in np.exp(theta))
        return Kernel(range_px, (one, other), nugget)

    def cost(theta: FloatArray) -> float:
        trial = kernel(theta)
        correlation = trial.correlation(apart)
        try:
            return sum(
                _solve(points, weight, trial, columns, correlation, axis).cost() for axis in (0, 1)
            )
        except np.linalg.LinAlgError:
            return _IMPOSSIBLE

    most = (MOST_STRAIN * extent) ** 2
    low = np.log([_spacing(points), *3 * [_LEAST_VARIANCE_PX2]])
    high = np.log([max(extent, 2 * _spacing(points)), most, most, most])
    first = field.kernel
    start = np.log([first.range_px, *first.variance_px2, first.nugget_px2])
    found = minimize(
        cost,
        np.clip(start, low, high), method="L-BFGS-B", bounds=list(zip(low, high, strict=True)),
        options={"maxiter": _STEPS, "ftol": _CLOSE, "eps": _STEP},
    )  # fmt: skip
    return kernel(np.round(found.x, _DIGITS))
