"""What a correction leaves of the ground's map: how large it is, and how well that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geodelreg.geo.maps.field import FieldMap
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import TINY, FloatArray, IntArray

_DRAWS = 400  # by hand: ½ to 2 × alike
_ENDS = (2.5, 97.5)  # by hand: ½ to 2 × alike
_P95 = 95  # percent, as the name says
_FEWEST = 30  # by hand: ½ to 2 × alike
_DIGITS = 9  # what the number of BLAS threads changes lies far below
_BOUND = 6.0  # by hand: ½ to 2 × alike
_P95_OVER_RMS = math.sqrt(math.log(20.0))
"""Of distances in the plane whose components are normal (Rayleigh's distribution)."""


@dataclass(frozen=True, slots=True)
class Residual:
    """The ground's smooth map minus a correction; noise of patches is no part of it.

    Attributes
    ----------
    rms_px, p95_px : float
        Root mean square and 95th percentile of the distance; NaN = not known.
    low_px, high_px : float
        Ends of the 95 % interval of the root mean square.
    """

    rms_px: float = math.nan
    p95_px: float = math.nan
    low_px: float = math.nan
    high_px: float = math.nan


def residual_of(
    field: FieldMap, correction: PixelMap, xy: FloatArray, scale: FloatArray
) -> Residual:
    """Size of what a correction leaves of a field, by conditional simulation.

    What is not known of the field enlarges every draw; that part is taken off the lower end, so
    that a field which may be none is none there.

    Parameters
    ----------
    field : FieldMap
    correction : PixelMap
        Source pixels to header pixels.
    xy : (N, 2) float64
        Some 200 places in sight.
    scale : (2, 2) float64
        Header pixels to the pixels that distances are told in.
    """
    gap = field.forward(xy) - correction.forward(xy)
    covariance = field.joint_covariance(xy)
    random = np.random.default_rng(0).standard_normal((2, len(xy), _DRAWS))
    draws = np.stack(
        [
            mean[:, None] + _root(own) @ numbers
            for mean, own, numbers in zip(gap.T, covariance, random, strict=True)
        ]
    )
    distance2 = (np.einsum("ij,jnd->ind", scale, draws) ** 2).sum(axis=0)
    unknown = float(((scale**2) @ covariance.diagonal(axis1=1, axis2=2)).sum(axis=0).mean())
    low2, high2 = np.percentile(distance2.mean(axis=0), _ENDS)
    rms = math.sqrt(float(((gap @ scale.T) ** 2).sum(axis=1).mean()))
    p95 = float(np.percentile(np.hypot(*(gap @ scale.T).T), _P95))
    low, high = math.sqrt(max(float(low2) - unknown, 0.0)), math.sqrt(float(high2))
    return Residual(*(round(value, _DIGITS) for value in (rms, p95, low, high)))


def _root(covariance: FloatArray) -> FloatArray:
    """Square root of a covariance that rounding may have left slightly indefinite."""
    value, vector = np.linalg.eigh(covariance)
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))


def shared_by_neighbours(xy: FloatArray, residual: FloatArray) -> Residual:
    """What neighbouring residuals share.

    Noise of patches is their own; what bends the ground moves neighbours alike.  The mean product
    of neighbouring residuals is the variance of that part (Matheron's covariance at the first lag),
    quick to tell where a field need not be fitted.

    Parameters
    ----------
    xy : (N, 2) float64
        Patches.
    residual : (N, 2) float64
        Under the correction.

    Returns
    -------
    Residual
        Nothing is known from too few patches.
    """
    if len(xy) < _FEWEST:
        return Residual()
    size = np.hypot(*residual.T)
    most = _BOUND * float(np.median(size))  # a few mismatches are no ground
    bounded = residual * np.minimum(most / np.maximum(size, TINY), 1.0)[:, None]
    nearest = _nearest_others(xy)
    product = (bounded * bounded[nearest]).sum(axis=1)
    shared = float(product.mean())
    error = 2 * float(product.std() / np.sqrt(len(xy) / 2))  # most pairs count from both ends
    rms, low, high = (math.sqrt(max(v, 0.0)) for v in (shared, shared - error, shared + error))
    return Residual(rms, _P95_OVER_RMS * rms, low, high)


def _nearest_others(xy: FloatArray) -> IntArray:
    """(N,) which other point is nearest to each; of equally near ones the first."""
    points = np.ascontiguousarray(xy).view(np.complex128).reshape(-1)
    distance = np.abs(points[:, None] - points)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(distance.argmin(axis=1))
