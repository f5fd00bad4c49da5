"""A low-passed image as a continuous surface: cubic B-splines, sampled at any position.

`cv2.remap` with INTER_CUBIC does not reproduce a linear ramp (errors up to 0.048 px); cubic
B-splines (Unser 1999, doi:10.1109/79.799930) do, and they need no more than four bilinear look-ups
a sample (Sigg & Hadwiger 2005, GPU Gems 2, chapter 20).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from geodelreg.geo.affine import affine_matrix
from geodelreg.geo.pixel import corner_to_centre
from geodelreg.values.raster import Band, BoolArray, Float32Array, FloatArray, Grid, IntArray

_POLE = np.sqrt(3.0) - 2.0
_PREFILTER_RADIUS = 8  # where the filter of pole 0.27 has decayed to 3e-5
SPLINE_REACH_PX = _PREFILTER_RADIUS + 4
_VALID_SHARE = 0.999  # of the low-pass's weight; the rest is rounding
_GAUSSIAN_REACH = 3.5  # standard deviations: 5e-4 of the weight lie beyond
_LEAST_SHARE = 1e-3  # of weight: means of less are not used
_SIXTHS = 6  # over the weights of a cubic B-spline: 1, 4 and 1 sixths at the knots
_NO_BLUR_PX = 0.05  # whose taps would be 1 and nothing


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
    taps = -float(_SIXTHS) * _POLE / (1.0 - _POLE**2) * _POLE**k
    return np.asarray(taps / taps.sum(), dtype=np.float64)


def low_pass_taps(sigma_px: float) -> FloatArray:
    """1-D Gaussian point spread, sampled and normalised.

    Parameters
    ----------
    sigma_px : float
        Standard deviation; 0 = none.

    Returns
    -------
    (2 r + 1,) float64, sum 1
    """
    if sigma_px <= _NO_BLUR_PX:
        return np.ones(1)
    radius = int(np.ceil(_GAUSSIAN_REACH * sigma_px))
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    taps = np.exp(-(x**2) / (2 * sigma_px**2))
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
    kernels = [_symmetric(np.convolve(t, prefilter)) for t in taps]
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


def _symmetric(taps: FloatArray) -> FloatArray:
    """Exactly symmetric taps, which OpenCV filters with half the work."""
    return (taps + taps[::-1]) / 2


def high_pass(band: Band, sigma_px: float) -> Band:
    """The band less its Gaussian mean over valid pixels; `sigma_px` in its pixels."""
    valid = band.valid.astype(np.float32)
    level = np.float32(band.data[band.valid].mean()) if band.valid.any() else np.float32(0)
    centred = (band.data - level) * valid
    weight = cv2.GaussianBlur(valid, (0, 0), sigma_px)
    mean = cv2.GaussianBlur(centred, (0, 0), sigma_px) / np.maximum(weight, _LEAST_SHARE)
    return replace(band, data=np.asarray(centred - mean, dtype=np.float32))


def _fill(band: Band, taps: list[FloatArray]) -> tuple[Float32Array, BoolArray]:
    """Replace invalid pixels by a local mean; usable where the low-pass sees none of them.

    The mean is a box's, whose cost does not grow with its width: it only has to meet its valid
    neighbours smoothly enough for the spline's short memory.
    """
    valid = band.valid.astype(np.float32)
    mean = np.float32(band.data[band.valid].mean()) if band.valid.any() else np.float32(0)
    centred = np.where(band.valid, band.data - mean, np.float32(0))
    box = (len(taps[0]) + 4, len(taps[1]) + 4)
    local = cv2.blur(centred, box) / np.maximum(cv2.blur(valid, box), np.float32(_LEAST_SHARE))
    filled = np.where(band.valid, centred, local) + mean
    near = cv2.sepFilter2D(valid, cv2.CV_32F, taps[0], taps[1])
    return filled.astype(np.float32), np.asarray(near > _VALID_SHARE)


def sample(surface: Surface, xy: FloatArray) -> tuple[Float32Array, BoolArray]:
    """Values of the surface anywhere.

    Parameters
    ----------
    surface : Surface
    xy : (P, K, 2) float64
        Full-raster pixels, outer corner.

    Returns
    -------
    values : (P, K) float32
        Relative to `Surface.level`.
    usable : (P, K) bool
        False outside the window and where the low-pass touched invalid pixels.
    """
    m = surface.to_window
    x = m[0, 0] * xy[..., 0] + m[0, 1] * xy[..., 1] + m[0, 2]
    y = m[1, 0] * xy[..., 0] + m[1, 1] * xy[..., 1] + m[1, 2]
    flat = len(x), math.prod(x.shape[1:])
    x32, y32 = (np.asarray(v, np.float32).reshape(flat) for v in (x, y))
    values, usable = _look_up([surface], np.zeros(len(x), np.intp), x32, y32)
    return values.reshape(x.shape), usable.reshape(x.shape)


def sample_patches(
    surfaces: Sequence[Surface],
    owner: IntArray,
    anchor: FloatArray,
    linear: FloatArray,
    offsets: FloatArray,
    bend: FloatArray | None = None,
) -> tuple[Float32Array, BoolArray]:
    """Values on a small lattice around each of many anchors, each on a surface of its own.

    Parameters
    ----------
    surfaces : sequence of Surface
        Windows of one raster.
    owner : (P,) intp
        Index of each anchor's surface; anchors of one surface are neighbours.
    anchor : (P, 2) float64
        Full-raster pixels, outer corner.
    linear : (P, 2, 2) float64
        Lattice steps to full-raster pixels, per anchor.
    offsets : (K, 2) float64
        The lattice.
    bend : (P, 2, 3) float64, optional
        Second derivatives by lattice steps: along columns, mixed, and along rows.

    Returns
    -------
    As `sample`, (P, K).
    """
    m = np.stack([surface.to_window for surface in surfaces])[owner]
    origin = np.matmul(m[:, :, :2], anchor[:, :, None])[:, :, 0] + m[:, :, 2]
    steps = np.matmul(m[:, :, :2], linear).astype(np.float32)
    grid = offsets.T.astype(np.float32)
    origin32 = origin.astype(np.float32)
    x = steps[:, 0, :] @ grid + origin32[:, 0, None]
    y = steps[:, 1, :] @ grid + origin32[:, 1, None]
    if bend is not None:
        square = np.stack([grid[0] ** 2 / 2, grid[0] * grid[1], grid[1] ** 2 / 2])
        curved = np.matmul(m[:, :, :2], bend).astype(np.float32) @ square
        x += curved[:, 0]
        y += curved[:, 1]
    return _look_up(surfaces, owner, x, y)


def _look_up(
    surfaces: Sequence[Surface], owner: IntArray, x: Float32Array, y: Float32Array
) -> tuple[Float32Array, BoolArray]:
    """Values and usability at (P, K) outer-corner positions of each row's window."""
    sides = np.array([surface.coefficients.shape for surface in surfaces], dtype=np.float32)
    last = sides[owner] - 2
    x, y = corner_to_centre(x), corner_to_centre(y)
    with np.errstate(invalid="ignore"):
        inside = (x >= 1) & (x <= last[:, 1:]) & (y >= 1) & (y <= last[:, :1])
    if not inside.all():
        x, y = np.where(inside, x, np.float32(1)), np.where(inside, y, np.float32(1))
    ends = np.searchsorted(owner, np.arange(len(surfaces) + 1))
    rows = [slice(start, end) for start, end in pairwise(ends.tolist())]
    for surface, mine in zip(surfaces, rows, strict=True):
        if not surface.usable.all():
            at = np.rint(y[mine]).astype(np.intp), np.rint(x[mine]).astype(np.intp)
            inside[mine] &= surface.usable[at]
    return _evaluate([surface.coefficients for surface in surfaces], rows, x, y), inside


def _evaluate(
    coefficients: list[Float32Array], rows: list[slice], x: Float32Array, y: Float32Array
) -> Float32Array:
    x_low, x_high, x_share = _two_taps(x)
    y_low, y_high, y_share = _two_taps(y)

    def bilinear(at_x: Float32Array, at_y: Float32Array) -> Float32Array:
        out = np.empty(at_x.shape, dtype=np.float32)
        for image, mine in zip(coefficients, rows, strict=True):
            if mine.start < mine.stop:
                out[mine] = cv2.remap(
                    image, at_x[mine], at_y[mine], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
        return out

    at_heights = []
    for at_y in (y_low, y_high):
        left, right = bilinear(x_low, at_y), bilinear(x_high, at_y)
        left -= right
        left *= x_share
        left += right
        at_heights.append(left)
    low, high = at_heights
    low -= high
    low *= y_share
    low += high
    return low


def _two_taps(at: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Positions of two linear look-ups that make up the cubic B-spline, and the first's weight."""
    base = np.floor(at)
    f = at - base
    square = f * f
    # six times the weights of the first two and the last two of the four spline coefficients, in
    # place: most of the time would go to memory for each term
    low = 2 * f
    for term in (-3, -3):
        low += term
        low *= f
    low += _SIXTHS - 1
    first = 3 * f
    first -= _SIXTHS
    first *= square
    first += 4
    first /= low
    first += base - 1
    second = square
    second *= f
    second /= _SIXTHS - low
    second += base + 1
    low /= np.float32(_SIXTHS)
    return first, second, low
