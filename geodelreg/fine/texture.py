"""Which patches show more than noise, by themselves and whatever the other image shows."""

from __future__ import annotations

import cv2
import numpy as np

from geodelreg.values.raster import BoolArray, Float32Array, FloatArray

_LAPLACE = 6  # the norm of its kernel (Immerkær 1996)
_NOISE_SHARE = 0.6745  # of a standard deviation: half of normal errors are smaller
_LARGEST_SIGMA_PX = 0.5
"""As in matching: what noise leaves more uncertain says nothing of the place."""
_CHANCE_SIGMAS = 3.0
_DIFFERENCE_SHARE = 0.5  # of the noise's variance in half the difference of two pixels
_DIFFERENCE_SPREAD = 0.75
"""Variance of the sum of squares of such differences, for each, over the noise's variance²: one
pixel serves two of them."""


def noise_of(image: Float32Array, valid: BoolArray) -> float:
    """Standard deviation of the pixels' noise, at most (Immerkær 1996, by the median).

    Parameters
    ----------
    image : (H, W) float32
    valid : (H, W) bool
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / _LAPLACE
    rough = np.abs(cv2.filter2D(image, cv2.CV_32F, kernel))[valid]
    return float(np.median(rough)) / _NOISE_SHARE if len(rough) else 0.0


def show_texture(patches: Float32Array, noise: float) -> BoolArray:
    """(P,) True for patches that least-squares matching could place.

    What noise alone would show is taken off their contrast: it has slopes of its own.

    Parameters
    ----------
    patches : (P, n, n) float32
    noise : float
        As from `noise_of`.
    """
    count = (patches.shape[1] - 2) * (patches.shape[2] - 2)
    across = (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]).reshape(-1, count) / 2
    down = (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]).reshape(-1, count) / 2
    xx, yy, xy = (
        np.einsum("pn,pn->p", a, b, dtype=np.float64)
        for a, b in ((across, across), (down, down), (across, down))
    )
    least: FloatArray = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    by_chance = _DIFFERENCE_SHARE * count + _CHANCE_SIGMAS * np.sqrt(_DIFFERENCE_SPREAD * count)
    return np.asarray(least > (by_chance + _LARGEST_SIGMA_PX**-2) * noise**2)
