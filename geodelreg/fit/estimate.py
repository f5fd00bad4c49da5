"""Weighted robust least squares: tie points with covariances to a transformation with its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geodelreg.fit.models import NONLINEAR, Frame, design, fitted_map, points_that_fix
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import TINY, BoolArray, FloatArray, IntArray

_MEDIAN_CHI2_2 = 2.0 * math.log(2.0)
_STUDENT_DOF = 6.0  # tails heavier than normal; by hand: ½ to 2 × alike
REJECT_D2 = 25.0  # five standard deviations: of normal errors in the plane 4e-6 lie beyond
_MOST_ROUNDS = 20  # by hand: ½ to 2 × alike
_GAUSS_NEWTON_STEPS = 4  # from the identity; each squares an error of a percent or less
_CONVERGED = 1e-9  # of half the raster: 1e-5 px of one of 20 000
_RANK = 1e-13  # 450 times the rounding of float64
_SPREAD_ROUNDS = 6  # then it stays, so that the weights converge; by hand: ½ to 2 × alike
_CLOSE = 1e-4  # relative: far below the error of the variance itself
_MOST_CUTS = 50  # of an interval; five or six are usual
_MOST_LEVERAGE = 0.95  # a residual is magnified twentyfold at most; by hand: ½ to 2 × alike


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Point pairs to fit, in source pixels.

    Attributes
    ----------
    source, target : (N, 2) float64
        Source pixel, and the header pixel where its content lies.
    covariance : (N, 2, 2) float64
        Of `target`, in source pixels squared.
    """

    source: FloatArray
    target: FloatArray
    covariance: FloatArray

    def __len__(self) -> int:
        return len(self.source)

    @property
    def variances(self) -> FloatArray:
        """(N, 2) of `target` along columns and rows, in source pixels squared."""
        return self.covariance[:, (0, 1), (0, 1)]

    def take(self, keep: BoolArray | IntArray) -> Observations:
        """The pairs where `keep` is True, or with the indices in it."""
        return Observations(self.source[keep], self.target[keep], self.covariance[keep])


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A fitted transformation.

    Attributes
    ----------
    model : str
    map : PixelMap
        Source pixels to header pixels, with its standard error.
    parameters : (k,) float64
    covariance : (k, k) float64
        Of the parameters, from the residuals' real spread.
    frame : Frame
    extra_variance_px2 : float
        Spread of the tie points beyond their own covariances (terrain, parallax), per axis.
    inlier : (N,) bool
    distance2 : (N,) float64
        Squared Mahalanobis distance of each residual.
    """

    model: str
    map: PixelMap
    parameters: FloatArray
    covariance: FloatArray
    frame: Frame
    extra_variance_px2: float
    inlier: BoolArray
    distance2: FloatArray

    @property
    def is_shift(self) -> bool:
        """True when nothing but a shift was fitted."""
        return self.model == "shift"


def minimum_points(model: str) -> int:
    """Fewest points that determine a model with one to spare."""
    return points_that_fix(model) + 1


def weighted_fit(
    model: str, points: Observations, weight: FloatArray, frame: Frame
) -> tuple[FloatArray, FloatArray]:
    """Parameters and normal matrix of one weighted least-squares fit.

    Parameters
    ----------
    model : str
    points : Observations
    weight : (N, 2, 2) float64
        Inverse covariances, in source pixels.
    frame : Frame

    Returns
    -------
    parameters : (k,) float64
    normal : (k, k) float64
    """
    found, normal = _solve(*_system(model, points, frame), weight, frame)
    for _ in range(_GAUSS_NEWTON_STEPS if model in NONLINEAR else 0):
        found, normal = _solve(*_system(model, points, frame, found), weight, frame)
    return found, normal


def _system(
    model: str, points: Observations, frame: Frame, parameters: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """(N, 2, k) columns and (N, 2) right side of the equations, around some parameters."""
    columns, base = design(model, points.source, frame, parameters)
    return columns, frame.normalise(points.target) - base


def _solve(
    columns: FloatArray, right: FloatArray, weight: FloatArray, frame: Frame
) -> tuple[FloatArray, FloatArray]:
    weighted = np.matmul(weight * frame.span_px**2, columns)
    normal = np.einsum("nik,nil->kl", columns, weighted)
    moment = np.einsum("nik,ni->k", weighted, right)
    return np.linalg.lstsq(normal, moment, rcond=_RANK)[0], normal


def robust_fit(
    model: str,
    points: Observations,
    frame: Frame,
    extra_variance_px2: float | None = None,
    known: FloatArray | None = None,
) -> Estimate:
    """Fit by iteratively reweighted least squares with Student weights.

    The tie points' own covariances are enlarged by a common variance until the median residual is
    what they promise (DerSimonian & Laird's idea, by the median): terrain and parallax are real.

    Parameters
    ----------
    model : str
        One of `geodelreg.fit.models.MODEL_ORDER`.
    points : Observations
    frame : Frame
    extra_variance_px2 : float, optional
        Take this common variance instead of estimating it.
    known : (N,) float64, optional
        Student weights of a fit before, to be taken as they are; NaN of points to be judged.

    Returns
    -------
    Estimate

    Raises
    ------
    ValueError
        With fewer points than parameters need.
    """
    if len(points) < minimum_points(model):
        raise ValueError(f"{len(points)} points cannot determine a {model}")
    extra = extra_variance_px2 or 0.0
    variances, axes = np.linalg.eigh(points.covariance)
    columns, right = _system(model, points, frame)
    known = np.full(len(points), np.nan) if known is None else known
    student = np.where(np.isfinite(known), known, 1.0)
    previous = None
    for number in range(_MOST_ROUNDS):
        inverse = _inverse(points.covariance, extra)
        parameters, normal = _solve(columns, right, inverse * student[:, None, None], frame)
        if model in NONLINEAR:
            columns, right = _system(model, points, frame, parameters)
        residual = fitted_map(model, parameters, frame).forward(points.source) - points.target
        if extra_variance_px2 is None and number < _SPREAD_ROUNDS:
            extra = common_variance(residual, variances, axes)
            inverse = _inverse(points.covariance, extra)
        distance2 = np.einsum("ni,nij,nj->n", residual, inverse, residual)
        student = np.where(np.isfinite(known), known, student_weight(distance2))
        if previous is not None and np.abs(parameters - previous).max() < _CONVERGED:
            break
        previous = parameters
    inlier = distance2 < REJECT_D2
    sandwich = _sandwich(columns, inverse * student[:, None, None], residual, normal, frame)
    sandwich = sandwich / _response(distance2) ** 2
    return Estimate(
        model, fitted_map(model, parameters, frame, sandwich),
        parameters, sandwich, frame, extra, inlier, distance2,
    )  # fmt: skip


def student_weight(distance2: FloatArray) -> FloatArray:
    """Weights by squared Mahalanobis distances in the plane."""
    return (_STUDENT_DOF + 2) / (_STUDENT_DOF + distance2)


def _inverse(covariance: FloatArray, extra: float) -> FloatArray:
    """(N, 2, 2) inverses of covariances to which a common variance is added."""
    a, d = covariance[:, 0, 0] + extra, covariance[:, 1, 1] + extra
    b = covariance[:, 0, 1]
    inverse = np.empty_like(covariance)
    determinant = a * d - b * b
    inverse[:, 0, 0], inverse[:, 1, 1] = d / determinant, a / determinant
    inverse[:, 0, 1] = inverse[:, 1, 0] = -b / determinant
    return inverse


def _sandwich(
    columns: FloatArray, weight: FloatArray, residual: FloatArray, normal: FloatArray, frame: Frame
) -> FloatArray:
    """Covariance of the parameters from the residuals themselves, as if each point were left out.

    Huber–White's sandwich, HC3 (MacKinnon & White 1985, doi:10.1016/0304-4076(85)90158-7): a point
    that holds the fit by itself shows a small residual, not a small error.
    """
    bread = np.linalg.pinv(normal, hermitian=True)
    own = np.einsum("nik,kl,njl,nji->n", columns, bread, columns, weight) * frame.span_px**2 / 2
    left_out = residual / (1.0 - np.minimum(own, _MOST_LEVERAGE))[:, None]
    score = np.einsum("nik,nij,nj->nk", columns, weight, left_out) * frame.span_px
    return np.asarray(bread @ (score.T @ score) @ bread)


def _response(distance2: FloatArray) -> float:
    """How far the fit follows its points: mean derivative of the Student weighting (Huber 1981).

    Reweighted least squares moves less than its weights say when a point moves, because the weight
    falls on the way; without this factor the covariance is a quarter too small in sigma.
    """
    weight = student_weight(distance2)
    return float((weight * _STUDENT_DOF / (_STUDENT_DOF + distance2)).sum() / weight.sum())


def common_variance(residual: FloatArray, variances: FloatArray, axes: FloatArray) -> float:
    """Variance per axis to add to every covariance so that the median distance is that of χ²(2).

    Parameters
    ----------
    residual : (N, 2) float64
    variances, axes : (N, 2), (N, 2, 2) float64
        Eigenvalues and eigenvectors of the covariances.

    Returns
    -------
    float
        0 when the covariances already explain the residuals.
    """
    if not residual.any():
        return 0.0
    one, other = np.einsum("nji,nj->in", axes, residual) ** 2
    first, second = np.ascontiguousarray(variances.T)

    def missing(extra: float) -> float:
        """Nearly linear in `extra`: one less the median that χ²(2) has over that of the points."""
        here = _median(one / (first + extra) + other / (second + extra))
        return 1.0 - _MEDIAN_CHI2_2 / max(here, TINY)

    if not missing(0.0) > 0.0:
        return 0.0
    most = _median((residual**2).sum(axis=1)) + TINY
    return _root(missing, 0.0, most)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """Where a function that falls through 0 between two ends does, to `_CLOSE` of it.

    Regula falsi that halves the value of an end which stays (Illinois: Dowell & Jarratt 1971).
    """
    above, below = function(low), function(high)
    at, side = high, 0
    for _ in range(_MOST_CUTS):
        before, at = at, (low * below - high * above) / (below - above)
        value = function(at)
        if value > 0:
            low, above, below, side = at, value, below / (2 if side > 0 else 1), 1
        else:
            high, below, above, side = at, value, above / (2 if side < 0 else 1), -1
        if value == 0 or abs(at - before) <= _CLOSE * at:
            break
    return at


def _median(values: FloatArray) -> float:
    """`np.median` of (N,) finite values without its checks, which cost more than the median."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    ordered = np.partition(values, (half - 1, half))
    return float(ordered[half - 1] + ordered[half]) / 2
