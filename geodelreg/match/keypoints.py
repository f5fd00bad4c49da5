"""SIFT keypoints: unbiased positions, spread over the image, away from invalid pixels."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geodelreg.geo.pixel import centre_to_corner
from geodelreg.types import BoolArray, Float32Array, FloatArray, IntArray, Keypoints

logger = logging.getLogger(__name__)

OCTAVE_LAYERS = 3
DESCRIPTOR_LENGTH = 128
ROOT_DESCRIPTOR_NORM = 512.0


@dataclass(frozen=True, slots=True)
class KeypointOptions:
    """How keypoints are detected and thinned.

    Attributes
    ----------
    max_keypoints : int
        Most keypoints returned.
    contrast : float
        SIFT's contrast threshold, as OpenCV defines it (image range 0 to 1, times octave layers).
        Weaker keypoints are used only where stronger ones do not fill `max_keypoints` evenly.
    low_contrast : float
        Threshold below which keypoints are never used.
    per_cell : int
        Mean number of keypoints per cell of the grid they are spread over.
    invalid_margin : float
        Keypoints closer to an invalid pixel than this many of their own diameters are dropped.
    root : bool
        Square root of the L1-normalised descriptor (RootSIFT: Arandjelović & Zisserman 2012,
        doi:10.1109/CVPR.2012.6248018) instead of the plain one: fewer wrong matches between dates.
    """

    max_keypoints: int = 6000
    contrast: float = 0.04
    low_contrast: float = 0.01
    per_cell: int = 8
    invalid_margin: float = 1.0
    root: bool = True


def detect(
    image: NDArray[np.uint8], valid: BoolArray, options: KeypointOptions | None = None
) -> Keypoints:
    """Detect and describe SIFT keypoints (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94).

    The result does not depend on OpenCV's thread count.  Keypoints are ordered from the strongest
    of each cell of a grid to weaker ones, so any leading part of them is spread over the image.

    Parameters
    ----------
    image : (H, W) uint8
    valid : (H, W) bool
        False where `image` means nothing.
    options : KeypointOptions, optional

    Returns
    -------
    Keypoints
        Positions in outer-corner pixels of `image`; descriptors hold integers 0 to 512 as float32.
    """
    options = options or KeypointOptions()
    if min(image.shape) < 2:
        return no_keypoints()
    # Without precise upscaling every position is off by (+0.25, +0.25) px.
    sift = cv2.SIFT.create(
        nOctaveLayers=OCTAVE_LAYERS,
        contrastThreshold=min(options.contrast, options.low_contrast),
        enable_precise_upscale=True,
    )
    found = sift.detect(image, None)
    if not found:
        return no_keypoints()
    table = np.array([(*k.pt, k.size, k.angle, k.response) for k in found], dtype=np.float64)
    candidates = np.flatnonzero(_away_from_invalid(table, valid, options.invalid_margin))
    chosen = candidates[_spread_order(table[candidates], image.shape, options)]
    logger.debug("%d keypoints found, %d kept", len(found), len(chosen))
    return _describe(sift, image, [found[i] for i in chosen], options.root)


def no_keypoints() -> Keypoints:
    """Of an image without any."""
    empty = np.empty(0, dtype=np.float64)
    return Keypoints(
        np.empty((0, 2), dtype=np.float64),
        empty,
        empty,
        empty,
        np.empty((0, DESCRIPTOR_LENGTH), dtype=np.float32),
    )


def _away_from_invalid(table: FloatArray, valid: BoolArray, margin: float) -> BoolArray:
    if valid.all():
        return np.ones(len(table), dtype=np.bool_)
    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, 5)
    column = np.clip(np.rint(table[:, 0]).astype(np.intp), 0, valid.shape[1] - 1)
    row = np.clip(np.rint(table[:, 1]).astype(np.intp), 0, valid.shape[0] - 1)
    return np.asarray(distance[row, column] > margin * table[:, 2] + 1.0)


def _spread_order(table: FloatArray, shape: tuple[int, int], options: KeypointOptions) -> IntArray:
    """Indices of the keypoints to keep: the strongest of each cell, then the second ones, ...

    Those of low contrast queue behind the first `per_cell` of a cell.
    """
    x, y, size, angle, response = table.T
    cell_px = np.sqrt(shape[0] * shape[1] * options.per_cell / options.max_keypoints)
    columns = int(np.ceil(shape[1] / cell_px))
    cell = (y // cell_px).astype(np.intp) * columns + (x // cell_px).astype(np.intp)
    by_cell = np.lexsort((angle, size, x, y, -response, cell))
    starts = np.flatnonzero(np.diff(cell[by_cell], prepend=-1))
    lengths = np.diff(starts, append=len(cell))
    rank = np.empty(len(cell), dtype=np.intp)
    rank[by_cell] = np.arange(len(cell)) - np.repeat(starts, lengths)
    rank[response * OCTAVE_LAYERS < options.contrast] += options.per_cell
    return np.lexsort((angle, size, x, y, -response, rank))[: options.max_keypoints]


def _describe(
    sift: cv2.SIFT, image: NDArray[np.uint8], found: list[cv2.KeyPoint], root: bool
) -> Keypoints:
    if not found:
        return no_keypoints()
    described, computed = sift.compute(image, found)
    descriptors = np.asarray(computed, dtype=np.float32)
    table = np.array([(*k.pt, k.size, k.angle, k.response) for k in described], dtype=np.float64)
    return Keypoints(
        centre_to_corner(np.ascontiguousarray(table[:, :2])),
        table[:, 2].copy(),
        table[:, 3].copy(),
        table[:, 4].copy(),
        _root(descriptors) if root else descriptors,
    )


def _root(descriptors: Float32Array) -> Float32Array:
    """RootSIFT, rounded to integers so that sums over it are exact in float32."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    rounded = np.rint(ROOT_DESCRIPTOR_NORM * np.sqrt(descriptors / total))
    return np.asarray(rounded, dtype=np.float32)
