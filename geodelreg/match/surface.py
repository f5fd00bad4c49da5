"""A low-passed image as a continuous surface: cubic B-splines, sampled at any position.

`cv2.remap` with INTER_CUBIC does not reproduce a linear ramp (errors up to 0.048 px); cubic
B-splines (Unser 1999, doi:10.1109/79.799930) do, and they need no more than four bilinear look-ups
a sample (Sigg & Hadwiger 2005, GPU Gems 2, chapter 20).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from geodelreg.geo.affine import affine_matrix
from geodelreg.geo.pixel import corner_to_centre
from geodelreg.types import Band, BoolArray, Float32Array, FloatArray, Grid

_POLE = np.sqrt(3.0) - 2.0
_PREFILTER_RADIUS = 12
SPLINE_REACH_PX = _PREFILTER_RADIUS + 4
_VALID_SHARE = 0.999


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Cubic B-spline coefficients of a low-passed window of a raster.

    Attributes
    ----------
    coefficients : (H, W) float32
    usable : (H, W) bool
        True where the low-pass saw valid pixels only.
    to_window : (2, 3) float64
        Full-raster pixels to pixels of this window (both outer corner).
    level : float
        Taken off before filtering, for precision; add it to samples where the level matters.
    """

    coefficients: Float32Array
    usable: BoolArray
    to_window: FloatArray
    level: float


def window_matrix(full: Grid, part: Grid) -> FloatArray:
    """(2, 3) affine from pixels of `full` to pixels of `part`, a window of it, maybe decimated."""
    return affine_matrix(~part.transform @ full.transform)


def _spline_prefilter() -> FloatArray:
    k = np.abs(np.arange(-_PREFILTER_RADIUS, _PREFILTER_RADIUS + 1))
    taps = -6.0 * _POLE / (1.0 - _POLE**2) * _POLE**k
    return np.asarray(taps / taps.sum(), dtype=np.float64)


def low_pass_taps(sigma_px: float, box_px: float = 0.0) -> FloatArray:
    """1-D point spread: a Gaussian convolved with a box, sampled and normalised.

    Parameters
    ----------
    sigma_px : float
        Standard deviation of the Gaussian; 0 = none.
    box_px : float
        Width of the box (the detector); up to 1 = none.

    Returns
    -------
    (2 r + 1,) float64, sum 1
    """
    fine = 8
    taps = np.ones(1)
    if sigma_px > 0.05:
        radius = int(np.ceil(4.0 * sigma_px))
        x = np.arange(-radius, radius + 1, dtype=np.float64)
        taps = np.exp(-0.5 * (x / sigma_px) ** 2)
    if box_px > 1.0:
        half = box_px / 2.0
        radius = int(np.ceil(half))
        x = (np.arange(-radius * fine, radius * fine + 1)) / fine
        inside = (np.abs(x) <= half).astype(np.float64)
        centre = np.round(x).astype(int) + radius
        box = np.bincount(centre, weights=inside, minlength=2 * radius + 1)
        taps = np.convolve(taps, 0.5 * (box + box[::-1]))
    return np.asarray(taps / taps.sum(), dtype=np.float64)


def make_surface(
    band: Band, full: Grid, sigma_px: tuple[float, float], high_pass_px: float = 0.0
) -> Surface:
    """Low-pass a band and take its spline coefficients in one separable filter.

    Parameters
    ----------
    band : Band
        A window of the raster, maybe decimated.
    full : Grid
        Grid of the full raster.
    sigma_px : (float, float)
        Gaussian low-pass along columns and rows, in pixels of `band`.
    high_pass_px : float
        Take off a Gaussian mean of this standard deviation; 0 = do not.
    """
    filled, usable = band.data, band.valid
    taps = [low_pass_taps(sigma) for sigma in sigma_px]
    if not usable.all():
        filled, usable = _fill(band, taps)
    prefilter = _spline_prefilter()
    kernels = [np.convolve(t, prefilter) for t in taps]
    offset = np.float32(np.mean(filled)) if filled.size else np.float32(0)
    filled = filled - offset
    if high_pass_px > 0:
        filled = filled - cv2.GaussianBlur(filled, (0, 0), high_pass_px)
    coefficients = cv2.sepFilter2D(
        filled, cv2.CV_32F, kernels[0], kernels[1], borderType=cv2.BORDER_REFLECT_101
    )
    return Surface(
        np.asarray(coefficients, dtype=np.float32),
        usable,
        window_matrix(full, band.grid),
        float(offset),
    )


def high_pass(band: Band, sigma_px: float) -> Band:
    """The band less its Gaussian mean over valid pixels; `sigma_px` in its pixels."""
    valid = band.valid.astype(np.float32)
    level = np.float32(band.data[band.valid].mean()) if band.valid.any() else np.float32(0)
    centred = (band.data - level) * valid
    weight = cv2.GaussianBlur(valid, (0, 0), sigma_px)
    mean = cv2.GaussianBlur(centred, (0, 0), sigma_px) / np.maximum(weight, 1e-3)
    return replace(band, data=np.asarray(centred - mean, dtype=np.float32))


def _fill(band: Band, taps: list[FloatArray]) -> tuple[Float32Array, BoolArray]:
    """Replace invalid pixels by a local mean; usable where the low-pass sees none of them."""
    valid = band.valid.astype(np.float32)
    mean = np.float32(band.data[band.valid].mean()) if band.valid.any() else np.float32(0)
    centred = np.where(band.valid, band.data - mean, np.float32(0))
    wide = [np.convolve(t, np.ones(5) / 5) for t in taps]
    weight = cv2.sepFilter2D(valid, cv2.CV_32F, wide[0], wide[1])
    local = cv2.sepFilter2D(centred, cv2.CV_32F, wide[0], wide[1]) / np.maximum(weight, 1e-3)
    filled = np.where(band.valid, centred, local) + mean
    near = cv2.sepFilter2D(valid, cv2.CV_32F, taps[0], taps[1])
    return filled.astype(np.float32), np.asarray(near > _VALID_SHARE)


def sample(surface: Surface, xy: FloatArray) -> tuple[Float32Array, BoolArray]:
    """Values of the surface.

    Parameters
    ----------
    surface : Surface
    xy : (P, K, 2) float64
        Full-raster pixels, outer corner; K small.

    Returns
    -------
    values : (P, K) float32
        Relative to `Surface.level`.
    usable : (P, K) bool
        False outside the window and where the low-pass touched invalid pixels.
    """
    m = surface.to_window
    position = np.empty(xy.shape, dtype=np.float64)
    position[..., 0] = m[0, 0] * xy[..., 0] + m[0, 1] * xy[..., 1] + m[0, 2]
    position[..., 1] = m[1, 0] * xy[..., 0] + m[1, 1] * xy[..., 1] + m[1, 2]
    position = corner_to_centre(position)
    height, width = surface.coefficients.shape
    finite = np.isfinite(position).all(axis=-1)
    position[~finite] = -10.0
    nearest = np.rint(position)
    inside = finite & (nearest >= 1).all(axis=-1)
    inside &= (nearest[..., 0] <= width - 2) & (nearest[..., 1] <= height - 2)
    np.clip(nearest[..., 0], 0, width - 1, out=nearest[..., 0])
    np.clip(nearest[..., 1], 0, height - 1, out=nearest[..., 1])
    index = nearest.astype(np.int32)
    inside &= surface.usable[index[..., 1], index[..., 0]]
    return _evaluate(surface.coefficients, position), inside


def _evaluate(coefficients: Float32Array, position: FloatArray) -> Float32Array:
    base = np.floor(position)
    f = (position - base).astype(np.float32)
    base32 = base.astype(np.float32)
    square, cube = f * f, f * f * f
    w0 = (1 - 3 * f + 3 * square - cube) / 6
    w1 = (4 - 6 * square + 3 * cube) / 6
    w3 = cube / 6
    low = w0 + w1
    high = 1 - low
    at_low = base32 + (w1 / low - 1)
    at_high = base32 + (w3 / high + 1)
    out = np.zeros(position.shape[:-1], dtype=np.float32)
    for ax, wx in ((at_low, low), (at_high, high)):
        for ay, wy in ((at_low, low), (at_high, high)):
            value = cv2.remap(
                coefficients,
                np.ascontiguousarray(ax[..., 0]),
                np.ascontiguousarray(ay[..., 1]),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            out += wx[..., 0] * wy[..., 1] * np.asarray(value, dtype=np.float32)
    return out
