"""Whether the images would fit as well elsewhere: repeated texture does, one period further."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from geodelreg.coarse.correlation import (
    Detail,
    around,
    common_parts,
    detail_pair,
    masked_correlation,
)
from geodelreg.fine.overlay import Overlay
from geodelreg.fine.patches import squares
from geodelreg.values.raster import Float32Array, FloatArray

_NEAR_PX = 8  # by hand: 2 × refuses 1 of 36
_PEAK_PX = 3
_LEAST_COMMON = 1000  # pixels; by hand: ½ to 2 × alike
_LEAST_POWER = 1e-6  # of standardised values: of less there is no texture
_RIVALS = 5  # by hand: ½ to 2 × alike
_RIVAL_OVERLAP = 0.2  # by hand: ½ to 2 × alike
_BLOCK_PX = 32  # of the image magnified twice
_UNSUSPICIOUS = 0.5
_EVEN = 0.2  # of images lit alike 0.17 at most
_FIELD_PX = 12  # of ten changed pairs six are then below 0.3, of 16 and 24 five; relief is alike


class Rival(NamedTuple):
    """What else the images would fit, over the correlation in place.

    Attributes
    ----------
    elsewhere : float
        Best correlation at another displacement, 0 to about 1.  Repeated texture (fields, waves,
        roofs) fits as well one period further: near 1 the images alone cannot tell.
    beside : float
        Best correlation of opposite contrast within a few pixels, on one side of the place only.
        Where light falls differently, slopes are bright in one image as they face it, and flat
        ground is in the other as it is: correlation changes its sign across the true place, which
        is beside the one found.  Of images lit alike it is even around the place.  Opposite to the
        contrast of the field at the place: fields that have changed are opposite as a whole.
    """

    elsewhere: float
    beside: float


_UNKNOWN = Rival(float("nan"), float("nan"))


def rival_correlation(overlay: Overlay) -> Rival:
    """Correlation at other displacements over that in place.

    Rivals are the displacements at which the whole correlates best; they are judged block by block,
    so that fields of inverted contrast do not cancel out.

    Returns
    -------
    Rival
        NaN when the overlay is too small or has no texture.
    """
    one, other = detail_pair(overlay)
    height, width = one.image.shape
    small = min(height, width) < 2 * _NEAR_PX or max(height, width) < 4 * _NEAR_PX
    common = float((one.mask * other.mask).sum())
    if small or common < _LEAST_COMMON:
        return _UNKNOWN
    signed, _ = masked_correlation(one, other, _RIVAL_OVERLAP * common)
    scores = np.abs(signed)
    middle_y, middle_x = height - 1, width - 1
    in_place = float(scores[around(middle_y, 1), around(middle_x, 1)].max())
    if in_place <= 0:
        return Rival(float("inf"), float("inf"))
    near = around(middle_y, _NEAR_PX), around(middle_x, _NEAR_PX)
    beside = float(_one_sided(signed[near]).max()) / in_place
    if beside > _EVEN:
        turned = Detail(_turned(one.image, other.image), one.mask)
        alike, _ = masked_correlation(turned, other, _RIVAL_OVERLAP * common)
        highest = float(np.abs(alike[around(middle_y, 1), around(middle_x, 1)]).max())
        beside = min(beside, float(_one_sided(alike[near]).max()) / highest)
    scores[near] = 0.0
    rivals: list[float] = []
    by_block: Callable[[int, int], float] | None = None
    for _ in range(_RIVALS):
        row, column = (int(i) for i in np.unravel_index(int(scores.argmax()), scores.shape))
        ratio = float(scores[row, column]) / in_place
        if ratio < _UNSUSPICIOUS:
            rivals.append(ratio)
            break
        by_block = by_block or _rival_blocks(one.image, other.image)
        in_blocks = by_block(middle_y - row, middle_x - column)
        rivals.append(min(ratio, in_blocks) if np.isfinite(in_blocks) else ratio)
        scores[around(row, _PEAK_PX), around(column, _PEAK_PX)] = 0.0
    return Rival(max(rivals), beside)


def _one_sided(signed: Float32Array) -> Float32Array:
    """Correlation of opposite sign to that in the middle, beyond what the other side has too.

    Of images that are alike it is even: side lobes come in pairs.
    """
    middle = signed.shape[0] // 2
    here = signed[around(middle, 1), around(middle, 1)]
    row, column = np.unravel_index(int(np.abs(here).argmax()), here.shape)
    opposite = np.maximum(-signed * np.sign(here[row, column]), 0.0)
    mirrored = np.roll(opposite[::-1, ::-1], (2 * (row - 1), 2 * (column - 1)), axis=(0, 1))
    return np.asarray(np.maximum(opposite - mirrored, 0.0), dtype=np.float32)


def _turned(one: Float32Array, other: Float32Array) -> Float32Array:
    """The first image, its contrast that of the other in every field."""
    (height, width), side = one.shape, _FIELD_PX
    by_rows = np.add.reduceat(one * other, np.arange(0, height, side), axis=0)
    together = np.add.reduceat(by_rows, np.arange(0, width, side), axis=1)
    opposite = np.where(together < 0, np.float32(-1), np.float32(1))
    spread = opposite.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]
    return np.asarray(one * spread, dtype=np.float32)


def _rival_blocks(one: Float32Array, other: Float32Array) -> Callable[[int, int], float]:
    """Like `rival_correlation`, of the blocks' correlations with any sign, for a displacement.

    Displacements are tried to half a pixel, so that a period of no whole number fits; NaN where
    no block can be compared.
    """
    finer = [cv2.resize(i, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC) for i in (one, other)]
    first, second = (np.asarray(image, np.float32) for image in finer)
    nearby = [(y, x) for y in range(-2, 3) for x in range(-2, 3)]

    def best(dy: int, dx: int) -> float:
        return max(_block_correlation(first, second, (2 * dy + y, 2 * dx + x)) for y, x in nearby)

    here = best(0, 0)
    return lambda dy, dx: best(dy, dx) / here if here > 0 else float("nan")


def _block_correlation(one: Float32Array, other: Float32Array, moved: tuple[int, int]) -> float:
    """Root mean square correlation of blocks of `one` with `other` at (rows, columns) further."""
    mine, theirs = common_parts(one.shape, moved)
    a, b = _blocks(one[mine]), _blocks(other[theirs])
    power = (a**2).sum(axis=1) * (b**2).sum(axis=1)
    textured = power > _LEAST_POWER
    if not textured.any():
        return float("nan")
    return float(np.sqrt(((a * b).sum(axis=1)[textured] ** 2 / power[textured]).mean()))


def _blocks(image: Float32Array) -> FloatArray:
    """(N, n²) blocks less their means."""
    height, width = (side - side % _BLOCK_PX for side in image.shape)
    values = squares(image[:height, :width], _BLOCK_PX).astype(np.float64)
    return np.asarray(values - values.mean(axis=1, keepdims=True))
