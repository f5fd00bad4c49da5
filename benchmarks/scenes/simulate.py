"""Renders what a sensor sees of a known, smooth ground: exactly placed, blurred, quantised, noisy.

The pixels of real imagery, at PAN resolution, are the samples of a band-limited function.  An MS
pixel integrates that function over its point spread: a box of its own size and orientation, and a
Gaussian.  That convolution is done in the Fourier domain, where it is exact; what is left is so
smooth that a quintic spline reads it at the true pixel centres with errors far below 0.001 px.
No low-order resampler takes part.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.scenes.truth import apply

FloatArray = NDArray[np.float64]
PSF_REACH_MS_PX = 4.0
TAPER_PX = 32
OVERSAMPLE_BELOW_RATIO = 2.5
FULL_SCALE = 4095
READ_NOISE = 1.5
SHOT_NOISE = 0.008
SPLINE_ORDER: Literal[5] = 5
KEPT_UP_TO_PX = 1_000_000


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the centres of the MS pixels truly lie.

    Attributes
    ----------
    centres_px : (H, W, 2) float64
        Outer-corner ``(column, row)`` in the field's pixels.
    linear : (2, 2) float64
        Steps of one MS column (first column) and one MS row (second), in the field's pixels.
    """

    centres_px: FloatArray
    linear: FloatArray


def affine_placement(ms_to_field: Affine, shape: tuple[int, int]) -> Placement:
    """Placement of an MS raster of `shape` by an affine from its pixels to the field's."""
    row, column = np.mgrid[: shape[0], : shape[1]] + 0.5
    x, y = apply(ms_to_field, column, row)
    linear = np.array([[ms_to_field.a, ms_to_field.b], [ms_to_field.d, ms_to_field.e]])
    return Placement(np.stack([x, y], axis=-1), linear)


def system_mtf(fx: FloatArray, fy: FloatArray, linear: FloatArray, blur_ms_px: float) -> FloatArray:
    """Modulation transfer of an MS pixel: its box, and a Gaussian for optics and motion.

    Parameters
    ----------
    fx, fy : float64, broadcastable
        Frequencies in cycles per field pixel.
    linear : (2, 2) float64
        As in `Placement`.
    blur_ms_px : float
        Standard deviation of the Gaussian, in MS pixels.
    """
    u = linear[0, 0] * fx + linear[1, 0] * fy
    v = linear[0, 1] * fx + linear[1, 1] * fy
    gaussian = np.exp(-2.0 * (np.pi * blur_ms_px) ** 2 * (u * u + v * v))
    return np.asarray(np.sinc(u) * np.sinc(v) * gaussian)


def render(field: NDArray[np.floating], placement: Placement, blur_ms_px: float) -> FloatArray:
    """What an MS band records of a field.

    Parameters
    ----------
    field : (H, W) float
        Ground radiance at PAN resolution; mirrored beyond its edges by the reach of the PSF.
    placement : Placement
    blur_ms_px : float
        Standard deviation of the Gaussian part of the PSF, in MS pixels.

    Returns
    -------
    (h, w) float64
        Noise-free band.
    """
    from scipy import ndimage

    smooth = _kept_blurred if field.size <= KEPT_UP_TO_PX else _blurred
    spline, pad, factor = smooth(
        *(field.tobytes(), field.shape, field.dtype.str, float(field.mean())),
        *(tuple(placement.linear.ravel().tolist()), blur_ms_px),
    )
    index = (placement.centres_px - 0.5 + pad) * factor
    sampled = ndimage.map_coordinates(
        spline,
        np.stack([index[..., 1], index[..., 0]]),
        output=field.dtype,
        order=SPLINE_ORDER,
        mode="mirror",
        prefilter=False,
    )
    return np.asarray(sampled, dtype=np.float64)


def _blurred(
    pixels: bytes,
    shape: tuple[int, ...],
    dtype: str,
    mean: float,
    linear: tuple[float, ...],
    blur_ms_px: float,
) -> tuple[FloatArray, int, int]:
    """Coefficients of the spline of a field as MS pixels see it, its margin and its density."""
    from scipy import fft, ndimage

    steps = np.reshape(linear, (2, 2))
    ratio = float(np.sqrt(abs(np.linalg.det(steps))))
    pad = int(np.ceil(PSF_REACH_MS_PX * ratio)) + TAPER_PX
    padded = _periodic(np.frombuffer(pixels, dtype).reshape(shape), pad, mean)
    size = padded.shape
    spectrum = fft.rfft2(padded, workers=2)
    fy, fx = fft.fftfreq(size[0])[:, None], fft.rfftfreq(size[1])[None, :]
    for rows in np.array_split(np.arange(size[0]), max(1, size[0] // 512)):
        spectrum[rows] *= system_mtf(fx, fy[rows], steps, blur_ms_px).astype(spectrum.real.dtype)
    factor = 2 if ratio < OVERSAMPLE_BELOW_RATIO else 1
    smooth = _inverse(spectrum, size, factor)
    return ndimage.spline_filter(smooth, SPLINE_ORDER, mode="mirror"), pad, factor


_kept_blurred = lru_cache(maxsize=4)(_blurred)
"""The four bands of small ground are rendered time and again, each time into another place."""


def _periodic(field: NDArray[np.floating], pad: int, mean: float) -> NDArray[np.floating]:
    """The field mirrored by `pad` pixels, or more, then fading to its mean: no jump at the seam."""
    from scipy import fft

    widths = []
    for n in field.shape:
        length = fft.next_fast_len(n + 2 * pad)
        while length % 2:
            length = fft.next_fast_len(length + 1)
        widths.append((pad, length - n - pad))
    level = field.dtype.type(mean)
    padded = np.pad(field, widths, mode="symmetric") - level
    ramp = (np.arange(TAPER_PX) + 0.5) / TAPER_PX
    fade = (0.5 - 0.5 * np.cos(np.pi * ramp)).astype(field.dtype)
    padded[:TAPER_PX] *= fade[:, None]
    padded[-TAPER_PX:] *= fade[::-1, None]
    padded[:, :TAPER_PX] *= fade
    padded[:, -TAPER_PX:] *= fade[::-1]
    return np.asarray(padded + level)


def _inverse(
    spectrum: NDArray[np.complexfloating], size: tuple[int, ...], factor: int
) -> NDArray[np.floating]:
    """Inverse transform, `factor` times more densely sampled (the spectrum padded with zeros)."""
    from scipy import fft

    if factor == 1:
        return np.asarray(fft.irfft2(spectrum, s=size, workers=2))
    height, width = size
    dense = np.zeros((factor * height, factor * width // 2 + 1), dtype=spectrum.dtype)
    half, columns = height // 2, width // 2
    dense[:half, :columns] = spectrum[:half, :columns]
    dense[-half + 1 :, :columns] = spectrum[-half + 1 :, :columns]
    dense *= factor * factor
    return np.asarray(fft.irfft2(dense, s=(factor * height, factor * width), workers=2))


def noise_variance(
    radiance: FloatArray, read_noise: float = READ_NOISE, shot: float = SHOT_NOISE
) -> FloatArray:
    """Variance of the noise at a radiance, both in counts."""
    return np.asarray(read_noise**2 + shot * np.maximum(radiance, 0))


def digitise(
    radiance: FloatArray,
    rng: np.random.Generator,
    read_noise: float = READ_NOISE,
    shot: float = SHOT_NOISE,
) -> NDArray[np.uint16]:
    """12-bit counts with signal-dependent Gaussian noise; 0 is kept for no-data.

    Parameters
    ----------
    radiance : (H, W) float64
        In counts, 0 to 4095.
    rng : numpy.random.Generator
    read_noise, shot : float
        Noise variance is ``read_noise² + shot · counts``.
    """
    sigma = np.sqrt(noise_variance(radiance, read_noise, shot))
    noisy = radiance + sigma * rng.standard_normal(radiance.shape)
    return np.clip(np.rint(noisy), 1, 4095).astype(np.uint16)


def tone(values: FloatArray, gamma: float, gain: float = 1.0) -> FloatArray:
    """Detector response: a gamma over the 12-bit range, then a gain."""
    return np.asarray(gain * 4095.0 * (np.clip(values, 0, 4095) / 4095.0) ** gamma)
