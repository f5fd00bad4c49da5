"""Where the pixels of overviews really lie: not all software puts them where their size says."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from geodelreg.raster.decimate import BoxAverage
from geodelreg.values.raster import BoolArray, Float32Array, Window

logger = logging.getLogger(__name__)

ReadPatch = Callable[[bool, Window], tuple[Float32Array, BoolArray]]
"""(of the overview?, window there) → (1, h, w) pixels and validity."""

_PATCH_PX = 128
_FULL_PATCH_PX = 2048
_CENTRES = ((0.5, 0.5), (0.2, 0.25), (0.8, 0.75))
# nearest neighbour leaves much unexplained, even when placed right
_CLEARLY_BETTER = 0.9


class Placement(NamedTuple):
    """How an overview lies on the full raster, per axis (columns, rows).

    Attributes
    ----------
    scale : tuple of float
        Overview pixels per pixel of the full raster.
    offset_px : tuple of float
        Where the corner of the overview's first pixel lies, in its own pixels, when the full
        raster starts at 0.
    """

    scale: tuple[float, float]
    offset_px: tuple[float, float] = (0.0, 0.0)

    def area(self, window: Window) -> tuple[tuple[float, float], tuple[float, float]]:
        """(column, row) of the corner and (width, height) of a full-raster window, here."""
        (across, down), (x, y) = self.scale, self.offset_px
        return (
            (window.column * across - x, window.row * down - y),
            (window.width * across, window.height * down),
        )


def placements(shape: tuple[int, int], full_shape: tuple[int, int]) -> list[Placement]:
    """The ways in which software makes overviews; the ordinary one comes first.

    - averages and centred kernels: no offset; GDAL stretches them over the full raster, other
      software has cells of a whole number of pixels, the last ones incomplete;
    - nearest neighbour in GDAL, and the wavelet levels of JPEG 2000 (always whole numbers): the
      value belongs to the first pixel of the cell;
    - ``GAUSS`` in GDAL: to the last one.

    Parameters
    ----------
    shape, full_shape : tuple of int
        ``(height, width)`` of the overview and of the full raster.
    """
    true = (shape[1] / full_shape[1], shape[0] / full_shape[0])
    scales = [true]
    factors = (round(1 / true[0]), round(1 / true[1]))
    cells = (-(-full_shape[0] // factors[1]), -(-full_shape[1] // factors[0]))
    if cells == shape and (1 / factors[0], 1 / factors[1]) != true:
        scales.append((1 / factors[0], 1 / factors[1]))
    return [
        Placement(scale, (side * (1 - scale[0]) / 2, side * (1 - scale[1]) / 2))
        for side in (0, -1, 1)
        for scale in scales
    ]


def find_placement(
    read_patch: ReadPatch, shape: tuple[int, int], full_shape: tuple[int, int]
) -> Placement:
    """Find out how an overview was made, from a few patches of it.

    Each candidate predicts them from the full raster.  The best one wins if it is clearly better
    than the ordinary one.

    Parameters
    ----------
    read_patch : callable
    shape, full_shape : tuple of int
        ``(height, width)`` of the overview and of the full raster.
    """
    candidates = placements(shape, full_shape)
    errors = np.zeros(len(candidates))
    for centre in _CENTRES:
        patch = _patch_window(centre, shape, full_shape)
        if patch is not None:
            errors += _prediction_errors(read_patch, patch, candidates, full_shape)
    best = int(np.argmin(errors))
    if errors[best] >= _CLEARLY_BETTER * errors[0]:
        return candidates[0]
    logger.debug("overview of %s pixels is displaced, corrected: %s", shape, candidates[best])
    return candidates[best]


def _patch_window(
    centre: tuple[float, float], shape: tuple[int, int], full_shape: tuple[int, int]
) -> Window | None:
    starts, sizes = [], []
    for fraction, length, full in zip(centre, shape[::-1], full_shape[::-1], strict=True):
        size = min(_PATCH_PX, int(_FULL_PATCH_PX * length / full), length - 2)
        starts.append(min(max(int(fraction * length) - size // 2, 1), length - 1 - size))
        sizes.append(size)
    return Window(*starts, *sizes) if min(sizes) >= 2 else None


def _prediction_errors(
    read_patch: ReadPatch, window: Window, candidates: list[Placement], full_shape: tuple[int, int]
) -> list[float]:
    """Sum of squared prediction errors of one patch for each candidate."""
    scale = candidates[0].scale
    left = max(int((window.column - 2) / scale[0]), 0)
    top = max(int((window.row - 2) / scale[1]), 0)
    right = min(int((window.column + window.width + 2) / scale[0]) + 1, full_shape[1])
    bottom = min(int((window.row + window.height + 2) / scale[1]) + 1, full_shape[0])
    patch, patch_valid = read_patch(True, window)
    data, valid = read_patch(False, Window(left, top, right - left, bottom - top))
    predictions = []
    for candidate in candidates:
        (across, down), (x, y) = candidate
        average = BoxAverage(
            1,
            (window.height, window.width),
            ((window.column + x) / across, (window.row + y) / down),
            (window.width / across, window.height / down),
        )
        average.add(data, valid, left, top)
        predictions.append(average.result())
    shared = np.logical_and.reduce([patch_valid, *(covered for _, covered in predictions)])
    return [
        float(np.square((predicted - patch)[shared], dtype=np.float64).sum())
        for predicted, _ in predictions
    ]
