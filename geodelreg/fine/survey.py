"""Where every patch of one image lies on the other, far and near: what dense matching left unasked.

Dense matching says nothing of patches that lie beyond its reach, and an image torn in two has many
of them.  Here each patch of an overlay is correlated with all places around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from geodelreg.fine.overlay import Overlay
from geodelreg.fine.texture import noise_of, show_texture
from geodelreg.fine.tiles import PATCH_PX, patch_size
from geodelreg.values.raster import BoolArray, Float32Array, FloatArray

REACH_PX = 22
"""Of the search; with patches of 20 pixels, the largest, the windows measure 64."""

_BRIGHTEST_PERCENT = 95  # what a cloud covers of a patch that it moves, at the least
_MOST_R = 0.999  # below 1, where Fisher's transformation ends
_ROUNDED_R = 1.001  # above 1 by rounding; what lies beyond is flat
_LEAST_VALID = 0.8  # by hand: ½ to 2 × alike
_CORRELATION_LENGTH_PX = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Best places of the patches of an overlay.

    Attributes
    ----------
    centre : (P, 2) float64
        In pixels of the overlay, outer corner.
    move : (P, 2) float64
        From where the overlay's correction puts a patch to where it correlates best, same pixels.
    score, here : (P,) float64
        Absolute correlation there, and where the correction puts the patch.
    textured : (P,) bool
        The patch shows enough to be placed.
    brightest : (P,) float64
        Value that one in twenty pixels of the template exceeds.
    size : int
        Side of a patch.
    """

    centre: FloatArray
    move: FloatArray
    score: FloatArray
    here: FloatArray
    textured: BoolArray
    brightest: FloatArray
    size: int

    @property
    def z(self) -> FloatArray:
        """(P,) by how many standard errors the best place correlates better (Fisher 1915)."""
        independent = (self.size / _CORRELATION_LENGTH_PX) ** 2 - 3
        there, here = (np.arctanh(np.minimum(r, _MOST_R)) for r in (self.score, self.here))
        better = there - here
        return np.asarray(better * np.sqrt(independent / 2))


def survey(
    overlay: Overlay, grid: tuple[str, str] = ("centred", "centred"), largest_px: int = PATCH_PX
) -> Places:
    """Correlate every patch with all places up to `REACH_PX` pixels away.

    Parameters
    ----------
    overlay : Overlay
        The surface under the correction to be judged.
    grid : (str, str)
        Of patches, across and down: side by side and ``centred``, ``flush`` with the borders, or
        ``between`` those.
    largest_px : int
        Side of a patch at most.
    """
    size = min(patch_size(float(overlay.valid.sum())), largest_px)
    template = _filled(overlay.template, overlay.template_valid)
    surface = _filled(overlay.surface, overlay.surface_valid)
    reach, (height, width) = REACH_PX, template.shape
    padded = np.pad(surface, reach)
    template_seen, seen = (
        _share_of_squares(valid, size)
        for valid in (overlay.template_valid, np.pad(overlay.surface_valid, reach))
    )
    across, down = (
        _starts(length, size, how) for length, how in zip((width, height), grid, strict=True)
    )

    corners = [
        (left, top)
        for top in down
        for left in across
        if min(template_seen[top, left], seen[top + reach, left + reach]) >= _LEAST_VALID
    ]
    patches = np.empty((len(corners), size, size), dtype=np.float32)
    move, score, here = np.empty((len(corners), 2)), *np.empty((2, len(corners)))
    for number, (left, top) in enumerate(corners):
        patch = template[top : top + size, left : left + size]
        patches[number] = patch
        window = padded[top : top + size + 2 * reach, left : left + size + 2 * reach]
        scores = np.abs(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED))
        there = seen[top : top + len(scores), left : left + len(scores)]
        scores[~np.isfinite(scores) | (scores > _ROUNDED_R) | (there < _LEAST_VALID)] = 0.0
        row, column = (int(i) for i in np.unravel_index(int(scores.argmax()), scores.shape))
        move[number] = column + beyond(scores[row], column), row + beyond(scores[:, column], row)
        score[number], here[number] = scores[row, column], scores[reach, reach]
    flat = patches.reshape(len(corners), size**2)
    return Places(
        np.reshape(corners, (-1, 2)) + size / 2,
        move - reach,
        score,
        here,
        show_texture(patches, noise_of(template, overlay.template_valid)),
        np.percentile(flat, _BRIGHTEST_PERCENT, axis=1).astype(np.float64),
        size,
    )


def _share_of_squares(valid: BoolArray, size: int) -> Float32Array:
    """(H, W) share of valid pixels in the square that begins at each pixel."""
    count = cv2.boxFilter(
        valid.astype(np.float32), cv2.CV_32F, (size, size), anchor=(0, 0), normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )  # fmt: skip
    return np.asarray(count / size**2, dtype=np.float32)


def _starts(length: int, size: int, how: str) -> list[int]:
    """Where the patches of a grid begin along an axis."""
    if length < size or how == "centred":
        return list(range((length % size) // 2, length - size + 1, size))
    at = np.linspace(0, length - size, math.ceil(length / size)).round().astype(int)
    return [int(n) for n in ((at[:-1] + at[1:]) // 2 if how == "between" else at)]


def _filled(image: Float32Array, valid: BoolArray) -> Float32Array:
    """The image less its mean, 0 where it is not valid."""
    level = np.float32(image[valid].mean()) if valid.any() else np.float32(0)
    return np.where(valid, image - level, np.float32(0)).astype(np.float32)


def beyond(scores: Float32Array, best: int) -> float:
    """How far past the best of a row of scores the parabola through it and its neighbours peaks."""
    if not 0 < best < len(scores) - 1:
        return 0.0
    before, here, after = (float(score) for score in scores[best - 1 : best + 2])
    bend = before - 2 * here + after
    return (before - after) / (2 * bend) if bend < 0 else 0.0
