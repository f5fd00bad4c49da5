"""SIFT keypoints: unbiased positions, spread over the image, away from invalid pixels."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geodelreg.geo.pixel import centre_to_corner
from geodelreg.values.points import Keypoints
from geodelreg.values.raster import BoolArray, Float32Array, FloatArray, IntArray

logger = logging.getLogger(__name__)

OCTAVE_LAYERS = 3
DESCRIPTOR_LENGTH = 128  # 4 × 4 cells of 8 directions, as Lowe has it
ROOT_DESCRIPTOR_NORM = 512.0  # OpenCV's norm of a plain descriptor
_TILE_PX = 640  # by hand: ½ to 2 × alike
_MARGIN_PX = 64  # by hand: ½ to 2 × alike
_FIELDS = 5  # of a keypoint: column, row, size, angle, response
_MASK_SIZE = 5  # of OpenCV's distance transform: precise to 2 %
_OCTAVES_PX = 64  # 2⁶: a start divisible by it is that of a pixel in the first six octaves


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
    root : bool
        Square root of the L1-normalised descriptor (RootSIFT: Arandjelović & Zisserman 2012,
        doi:10.1109/CVPR.2012.6248018) instead of the plain one: fewer wrong matches between dates.
    whole_px : int
        Images of more pixels are looked at in parts: a scale space takes some 230 bytes a pixel.
    """

    max_keypoints: int = 6000
    contrast: float = 0.04
    low_contrast: float = 0.01
    per_cell: int = 8
    root: bool = True
    whole_px: int = 600_000


def detect(
    image: NDArray[np.uint8], valid: BoolArray, options: KeypointOptions | None = None
) -> Keypoints:
    """Detect and describe SIFT keypoints (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94).

    The result does not depend on OpenCV's thread count.  Keypoints closer to an invalid pixel than
    their own diameter are dropped.  The others are ordered from the strongest
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
    found = [(tile, _detect_in_tile(sift, image, tile)) for tile in _tiles(image, options.whole_px)]
    table = np.concatenate([_table(points) + tile.offset for tile, points in found])
    candidates = np.flatnonzero(_away_from_invalid(table, valid))
    chosen = candidates[_spread_order(table[candidates], image.shape, options)]
    logger.debug("%d keypoints found, %d kept", len(table), len(chosen))
    if not len(chosen):
        return no_keypoints()
    descriptors = _describe(sift, image, found, chosen)
    xy = centre_to_corner(np.ascontiguousarray(table[chosen, :2]))
    return Keypoints(xy, _root(descriptors) if options.root else descriptors)


@dataclass(frozen=True, slots=True)
class _Tile:
    """Rows and columns of the image that belong to a tile, and those it is looked at with."""

    core: tuple[slice, slice]
    around: tuple[slice, slice]

    @property
    def offset(self) -> FloatArray:
        """(5,) what takes a row of `_table` from pixels of `around` to those of the image."""
        return np.array([self.around[1].start, self.around[0].start, 0, 0, 0], dtype=np.float64)


def _tiles(image: NDArray[np.uint8], whole_px: int) -> list[_Tile]:
    """Parts of a large image."""
    shape = image.shape
    if shape[0] * shape[1] <= whole_px:
        whole = (slice(0, shape[0]), slice(0, shape[1]))
        return [_Tile(whole, whole)]
    # two halves have the least margins; more parts are as square as they can be
    rows, columns = _spans(shape[0], 2), _spans(shape[1], 1)
    if max(around.stop - around.start for _, around in rows) * shape[1] > whole_px:
        rows, columns = (_spans(side, max(round(side / _TILE_PX), 1)) for side in shape)
    return [
        _Tile((row, column), (around_row, around_column))
        for row, around_row in rows
        for column, around_column in columns
    ]


def _spans(side: int, count: int) -> list[tuple[slice, slice]]:
    """Cores that start where all octaves have a pixel, and the same with margins."""
    step = -(-side // (count * _OCTAVES_PX)) * _OCTAVES_PX
    return [
        (
            slice(start, min(start + step, side)),
            slice(max(start - _MARGIN_PX, 0), min(start + step + _MARGIN_PX, side)),
        )
        for start in range(0, side, step)
    ]


def _detect_in_tile(sift: cv2.SIFT, image: NDArray[np.uint8], tile: _Tile) -> list[cv2.KeyPoint]:
    """Keypoints of a tile's core, in pixels of what it is looked at with."""
    found = list(sift.detect(np.ascontiguousarray(image[tile.around]), None))
    left, top = tile.offset[:2]
    rows, columns = tile.core

    def is_mine(point: cv2.KeyPoint) -> bool:
        x, y = point.pt[0] + left, point.pt[1] + top
        return bool(columns.start <= x < columns.stop and rows.start <= y < rows.stop)

    return found if tile.core == tile.around else [point for point in found if is_mine(point)]


def _table(found: Sequence[cv2.KeyPoint]) -> FloatArray:
    """(N, 5) position (pixel centres), size, angle and response."""
    table = np.array([(*k.pt, k.size, k.angle, k.response) for k in found], dtype=np.float64)
    return table.reshape(-1, _FIELDS)


def no_keypoints() -> Keypoints:
    """Of an image without any."""
    return Keypoints(np.empty((0, 2)), np.empty((0, DESCRIPTOR_LENGTH), dtype=np.float32))


def _away_from_invalid(table: FloatArray, valid: BoolArray) -> BoolArray:
    if valid.all():
        return np.ones(len(table), dtype=np.bool_)
    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, _MASK_SIZE)
    column = np.clip(np.rint(table[:, 0]).astype(np.intp), 0, valid.shape[1] - 1)
    row = np.clip(np.rint(table[:, 1]).astype(np.intp), 0, valid.shape[0] - 1)
    return np.asarray(distance[row, column] > table[:, 2] + 1.0)


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
    sift: cv2.SIFT,
    image: NDArray[np.uint8],
    found: Sequence[tuple[_Tile, list[cv2.KeyPoint]]],
    chosen: IntArray,
) -> Float32Array:
    """(N, 128) descriptors of the chosen ones, numbered through all tiles, in their order."""
    descriptors = np.empty((len(chosen), DESCRIPTOR_LENGTH), dtype=np.float32)
    first = 0
    for tile, points in found:
        mine = np.flatnonzero((chosen >= first) & (chosen < first + len(points)))
        if len(mine):
            kept = [points[number - first] for number in chosen[mine]]
            _, descriptors[mine] = sift.compute(np.ascontiguousarray(image[tile.around]), kept)
        first += len(points)
    return descriptors


def _root(descriptors: Float32Array) -> Float32Array:
    """RootSIFT, rounded to integers so that sums over it are exact in float32."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    rounded = np.rint(ROOT_DESCRIPTOR_NORM * np.sqrt(descriptors / total))
    return np.asarray(rounded, dtype=np.float32)
