"""Correlation of whole areas: where an image lies on another, and whether it might elsewhere.

Masked normalised cross-correlation through the Fourier transform (Padfield 2012,
doi:10.1109/TIP.2011.2181402).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from geodelreg.types import BoolArray, Float32Array, FloatArray

_PIXELS = 90_000
_NEAR_PX = 8
_PEAK_PX = 3
_RIVALS = 5
_RIVAL_OVERLAP = 0.2
_BLOCK_PX = 32  # of the image magnified twice
_UNSUSPICIOUS = 0.5
_SEARCH_OVERLAP = 0.15
_HIGH_PASS_SIGMA_PX = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """Template image and the low-passed surface image resampled on it, coarse.

    Attributes
    ----------
    template, surface : (H, W) float32
    template_valid, surface_valid : (H, W) bool
        Of each image by itself.
    """

    template: Float32Array
    surface: Float32Array
    template_valid: BoolArray
    surface_valid: BoolArray

    @property
    def valid(self) -> BoolArray:
        """(H, W) bool, True where both are valid."""
        return self.template_valid & self.surface_valid

    def part(self, rows: slice, columns: slice) -> Overlay:
        """A window of the overlay."""
        where = (rows, columns)
        return Overlay(
            self.template[where],
            self.surface[where],
            self.template_valid[where],
            self.surface_valid[where],
        )


def rival_correlation(overlay: Overlay) -> float:
    """Best correlation at another displacement over that in place; 0 to about 1.

    Repeated texture (fields, waves, roofs) fits as well one period further: a value near 1 means
    that the images alone cannot tell.  Rivals are the displacements at which the whole correlates
    best; they are judged block by block, so that fields of inverted contrast do not cancel out.

    Returns
    -------
    float
        NaN when the overlay is too small or has no texture.
    """
    scale = min(1.0, float(np.sqrt(_PIXELS / overlay.template.size)))
    one, one_mask = _detail(overlay.template, overlay.template_valid, scale)
    other, other_mask = _detail(overlay.surface, overlay.surface_valid, scale)
    height, width = one.shape
    small = min(height, width) < 2 * _NEAR_PX or max(height, width) < 4 * _NEAR_PX
    common = float((one_mask * other_mask).sum())
    if small or common < 1000:
        return float("nan")
    signed, _ = _masked_correlation(one, one_mask, other, other_mask, _RIVAL_OVERLAP * common)
    scores = np.abs(signed)
    middle_y, middle_x = height - 1, width - 1
    reach = 1
    here = scores[middle_y - reach : middle_y + reach + 1, middle_x - reach : middle_x + reach + 1]
    in_place = float(here.max())
    if in_place <= 0:
        return float("inf")
    near = slice(middle_y - _NEAR_PX, middle_y + _NEAR_PX + 1)
    scores[near, middle_x - _NEAR_PX : middle_x + _NEAR_PX + 1] = 0.0
    rivals: list[float] = []
    by_block: Callable[[int, int], float] | None = None
    for _ in range(_RIVALS):
        row, column = (int(i) for i in np.unravel_index(int(scores.argmax()), scores.shape))
        ratio = float(scores[row, column]) / in_place
        if ratio < _UNSUSPICIOUS:
            rivals.append(ratio)
            break
        by_block = by_block or _rival_blocks(one, other)
        in_blocks = by_block(middle_y - row, middle_x - column)
        rivals.append(min(ratio, in_blocks) if np.isfinite(in_blocks) else ratio)
        scores[_around(row, _PEAK_PX), _around(column, _PEAK_PX)] = 0.0
    return max(rivals)


def _around(centre: int, reach: int) -> slice:
    return slice(max(centre - reach, 0), centre + reach + 1)


def _rival_blocks(one: Float32Array, other: Float32Array) -> Callable[[int, int], float]:
    """Like `rival_correlation`, of the blocks' correlations with any sign, for a displacement.

    Displacements are tried to half a pixel, so that a period of no whole number fits; NaN where
    no block can be compared.
    """
    finer = [cv2.resize(i, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC) for i in (one, other)]
    first, second = (np.asarray(image, np.float32) for image in finer)
    around = [(y, x) for y in range(-2, 3) for x in range(-2, 3)]

    def best(dy: int, dx: int) -> float:
        return max(_block_correlation(first, second, (2 * dy + y, 2 * dx + x)) for y, x in around)

    here = best(0, 0)
    return lambda dy, dx: best(dy, dx) / here if here > 0 else float("nan")


def _block_correlation(one: Float32Array, other: Float32Array, moved: tuple[int, int]) -> float:
    """Root mean square correlation of blocks of `one` with `other` at (rows, columns) further."""
    height, width = one.shape
    dy, dx = moved
    first = one[max(-dy, 0) : min(height - dy, height), max(-dx, 0) : min(width - dx, width)]
    second = other[max(dy, 0) : min(height + dy, height), max(dx, 0) : min(width + dx, width)]
    a, b = _blocks(first), _blocks(second)
    power = (a**2).sum(axis=1) * (b**2).sum(axis=1)
    textured = power > 1e-6
    if not textured.any():
        return float("nan")
    return float(np.sqrt(((a * b).sum(axis=1)[textured] ** 2 / power[textured]).mean()))


def _blocks(image: Float32Array) -> FloatArray:
    """(N, n²) blocks less their means."""
    rows, columns = (side // _BLOCK_PX for side in image.shape)
    cut = image[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    parts = cut.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).swapaxes(1, 2)
    values = parts.reshape(rows * columns, _BLOCK_PX**2).astype(np.float64)
    return np.asarray(values - values.mean(axis=1, keepdims=True))


def best_shift(overlay: Overlay) -> FloatArray:
    """Displacement at which the edges of the two images correlate most significantly.

    Of two displacements that of larger overlap may have the smaller correlation and yet be the less
    likely by chance: what counts is the correlation in units of its own scatter, r √n.

    Parameters
    ----------
    overlay : Overlay

    Returns
    -------
    (2,) float64
        (columns, rows): content of `overlay.template` at x is that of `overlay.surface` at x plus
        this, to about a pixel of the overlay.
    """
    scale = min(1.0, float(np.sqrt(_PIXELS / overlay.template.size)))
    one, one_mask = _edges(*_detail(overlay.template, overlay.template_valid, scale))
    other, other_mask = _edges(*_detail(overlay.surface, overlay.surface_valid, scale))
    least = _SEARCH_OVERLAP * float(min(one_mask.sum(), other_mask.sum()))
    scores, overlap = _masked_correlation(one, one_mask, other, other_mask, least)
    scores *= np.sqrt(np.maximum(overlap, 0.0))
    row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
    height, width = one.shape
    moved = np.array([width - 1 - int(column), height - 1 - int(row)], dtype=np.float64)
    rows, columns = overlay.template.shape
    return np.asarray(moved * np.array([columns / width, rows / height]))


def _edges(detail: Float32Array, mask: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Gradient magnitude less its mean: blind to the sign of the contrast."""
    inner = cv2.erode(mask, np.ones((3, 3), np.uint8))
    strength = cv2.magnitude(
        cv2.Sobel(detail, cv2.CV_32F, 1, 0), cv2.Sobel(detail, cv2.CV_32F, 0, 1)
    )
    mean = float((strength * inner).sum() / max(float(inner.sum()), 1.0))
    return np.asarray((strength - mean) * inner, np.float32), np.asarray(inner, np.float32)


def _detail(
    image: Float32Array, valid: BoolArray, scale: float
) -> tuple[Float32Array, Float32Array]:
    """High-passed, standardised image, scaled down, with its mask."""
    weight = valid.astype(np.float32)
    level = float(image[valid].mean()) if valid.any() else 0.0
    centred: Float32Array = ((image - np.float32(level)) * weight).astype(np.float32)
    if scale < 1.0:
        shape = (max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1))
        centred = np.asarray(cv2.resize(centred, shape, interpolation=cv2.INTER_AREA), np.float32)
        weight = np.asarray(cv2.resize(weight, shape, interpolation=cv2.INTER_AREA), np.float32)
    smooth = cv2.GaussianBlur(centred, (0, 0), _HIGH_PASS_SIGMA_PX)
    share = cv2.GaussianBlur(weight, (0, 0), _HIGH_PASS_SIGMA_PX)
    mask = (weight > 0.99).astype(np.float32)
    detail = (centred - smooth / np.maximum(share, 1e-3)) * mask
    spread = float(np.sqrt((detail**2).sum() / max(float(mask.sum()), 1.0)))
    detail = np.clip(detail / max(spread, 1e-12), -3, 3)
    return np.asarray(detail, dtype=np.float32), np.asarray(mask, dtype=np.float32)


def _masked_correlation(
    one: Float32Array,
    one_mask: Float32Array,
    other: Float32Array,
    other_mask: Float32Array,
    least_overlap: float,
) -> tuple[Float32Array, Float32Array]:
    """(2 H − 1, 2 W − 1) normalised correlation and common pixels of all displacements.

    The correlation is 0 where fewer than `least_overlap` pixels are common.
    """
    height, width = one.shape
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

    mask_a, mask_b = spectrum(one_mask), spectrum(other_mask)
    overlap = correlate(mask_a, mask_b)
    together = correlate(spectrum(one), spectrum(other))
    power_one = correlate(spectrum(one * one), mask_b)
    power_other = correlate(mask_a, spectrum(other * other))
    enough = overlap > least_overlap
    power = np.sqrt(np.maximum(power_one * power_other, 1e-6))
    return np.asarray(np.where(enough, together / power, 0.0), dtype=np.float32), overlap
