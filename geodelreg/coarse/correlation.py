"""Correlation of whole areas: the displacement at which two images fit best.

Masked normalised cross-correlation through the Fourier transform (Padfield 2012,
doi:10.1109/TIP.2011.2181402).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from geodelreg.fine.overlay import Overlay
from geodelreg.fine.survey import beyond
from geodelreg.values.raster import TINY, BoolArray, Float32Array, FloatArray

AMBIGUOUS = 0.8  # rivals of repeated texture are 0.84 to 1, of others 0.1 to 0.8
_PIXELS = 90_000  # at most, 300²; by hand: ½ to 2 × alike
_SEARCH_OVERLAP = 0.15  # of the smaller image; by hand: ½ to 2 × alike
_HIGH_PASS_SIGMA_PX = 4.0
_CLIP_SIGMAS = 3.0
_ALL_VALID = 0.99  # share of a pixel, when decimated; the rest is rounding
_LEAST_SHARE = 1e-3  # of weight: means of less are not asked for
_LEAST_POWER = 1e-6  # of standardised values: of less there is no texture
_VERTEX_STEPS = 32  # a pixel: finer than the parabola is true
_PEAK_PX = 8  # further off is another place; by hand: ½ to 2 × alike


class Detail(NamedTuple):
    """What varies in an image from place to place, standardised.

    Attributes
    ----------
    image : (H, W) float32
        0 where it is not known.
    mask : (H, W) float32
        1 where it is, else 0.
    """

    image: Float32Array
    mask: Float32Array


class Shift(NamedTuple):
    """Where edges correlate best.

    Attributes
    ----------
    move : (2,) float64
        (columns, rows): content of `Overlay.template` at x is that of `Overlay.surface` at x plus
        this, to about half a pixel of the overlay.
    rival : float
        Significance of the best other place over that of this one; near 1 = ambiguous.
    """

    move: FloatArray
    rival: float


def best_shift(overlay: Overlay) -> Shift:
    """Displacement at which the edges of the two images correlate most significantly.

    Of two displacements that of larger overlap may have the smaller correlation and yet be the less
    likely by chance: what counts is the correlation in units of its own scatter, r √n.

    Parameters
    ----------
    overlay : Overlay
    """
    one, other = (_edges(detail) for detail in detail_pair(overlay))
    scores = significance(one, other, _SEARCH_OVERLAP)
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(scores)), scores.shape))
    height, width = one.image.shape
    # steps of its own, for the last bits of a Fourier transform depend on where its memory lies
    across, down = (
        round(part * _VERTEX_STEPS) / _VERTEX_STEPS
        for part in (beyond(scores[row], column), beyond(scores[:, column], row))
    )
    moved = np.array([width - 1 - (column + across), height - 1 - (row + down)])
    rows, columns = overlay.template.shape
    best = float(scores[row, column])
    scores[around(row, _PEAK_PX), around(column, _PEAK_PX)] = 0.0
    rival = float(scores.max()) / best if best > 0 else 1.0
    return Shift(np.asarray(moved * np.array([columns / width, rows / height])), rival)


def around(centre: int, reach: int) -> slice:
    """Rows or columns no further off than `reach`."""
    return slice(max(centre - reach, 0), centre + reach + 1)


def common_parts(
    shape: tuple[int, ...], step: Sequence[int]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Pixels of an image, and those of another (rows, columns) further, that both have."""
    sides = list(zip(shape, step, strict=True))
    mine = tuple(slice(max(-by, 0), min(side - by, side)) for side, by in sides)
    return mine, tuple(slice(max(by, 0), min(side + by, side)) for side, by in sides)


def _edges(of: Detail) -> Detail:
    """Gradient magnitude less its mean: blind to the sign of the contrast."""
    inner = cv2.erode(of.mask, np.ones((3, 3), np.uint8))
    strength = cv2.magnitude(
        cv2.Sobel(of.image, cv2.CV_32F, 1, 0), cv2.Sobel(of.image, cv2.CV_32F, 0, 1)
    )
    mean = float((strength * inner).sum() / max(float(inner.sum()), 1.0))
    return Detail(np.asarray((strength - mean) * inner, np.float32), np.asarray(inner, np.float32))


def detail_pair(overlay: Overlay) -> tuple[Detail, Detail]:
    """Template and surface, high-passed, standardised and scaled down."""
    scale = min(1.0, float(np.sqrt(_PIXELS / overlay.template.size)))
    return (
        _detail(overlay.template, overlay.template_valid, scale),
        _detail(overlay.surface, overlay.surface_valid, scale),
    )


def _detail(image: Float32Array, valid: BoolArray, scale: float) -> Detail:
    """High-passed, standardised image, scaled down."""
    weight = valid.astype(np.float32)
    level = float(image[valid].mean()) if valid.any() else 0.0
    centred: Float32Array = ((image - np.float32(level)) * weight).astype(np.float32)
    if scale < 1.0:
        shape = (max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1))
        centred = np.asarray(cv2.resize(centred, shape, interpolation=cv2.INTER_AREA), np.float32)
        weight = np.asarray(cv2.resize(weight, shape, interpolation=cv2.INTER_AREA), np.float32)
    smooth = cv2.GaussianBlur(centred, (0, 0), _HIGH_PASS_SIGMA_PX)
    share = cv2.GaussianBlur(weight, (0, 0), _HIGH_PASS_SIGMA_PX)
    mask = (weight > _ALL_VALID).astype(np.float32)
    detail = (centred - smooth / np.maximum(share, _LEAST_SHARE)) * mask
    spread = float(np.sqrt((detail**2).sum() / max(float(mask.sum()), 1.0)))
    detail = np.clip(detail / max(spread, TINY), -_CLIP_SIGMAS, _CLIP_SIGMAS)
    return Detail(np.asarray(detail, dtype=np.float32), np.asarray(mask, dtype=np.float32))


def significance(one: Detail, other: Detail, least_share: float) -> Float32Array:
    """(2 H − 1, 2 W − 1) correlation over its standard error, of all displacements.

    It is 0 where less than a share of the smaller of the two images is common.
    """
    least = least_share * float(min(one.mask.sum(), other.mask.sum()))
    scores, overlap = masked_correlation(one, other, least)
    return np.asarray(scores * np.sqrt(np.maximum(overlap, 0.0)))


def masked_correlation(
    one: Detail, other: Detail, least_overlap: float
) -> tuple[Float32Array, Float32Array]:
    """(2 H − 1, 2 W − 1) normalised correlation and common pixels of all displacements.

    The correlation is 0 where fewer than `least_overlap` pixels are common.
    """
    height, width = one.image.shape
    shape = (cv2.getOptimalDFTSize(2 * height - 1), cv2.getOptimalDFTSize(2 * width - 1))

    def spectrum(image: Float32Array) -> Float32Array:
        padded = np.zeros(shape, dtype=np.float32)
        padded[:height, :width] = image
        return np.asarray(cv2.dft(padded))

    def correlate(a: Float32Array, b: Float32Array) -> Float32Array:
        product = cv2.mulSpectrums(a, b, 0, conjB=True)
        full = cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE)
        rolled = np.roll(full, (height - 1, width - 1), axis=(0, 1))
        return np.asarray(rolled[: 2 * height - 1, : 2 * width - 1])

    mask_a, mask_b = spectrum(one.mask), spectrum(other.mask)
    overlap = correlate(mask_a, mask_b)
    together = correlate(spectrum(one.image), spectrum(other.image))
    power_one = correlate(spectrum(one.image**2), mask_b)
    power_other = correlate(mask_a, spectrum(other.image**2))
    enough = overlap > least_overlap
    power = np.sqrt(np.maximum(power_one * power_other, _LEAST_POWER))
    return np.asarray(np.where(enough, together / power, 0.0), dtype=np.float32), overlap
