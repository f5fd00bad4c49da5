"""Patches: small squares of the coarser image, cut out to be matched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.geo.pixel import pixel_centres
from geodelreg.values.raster import Band, BoolArray, Float32Array, FloatArray, Grid, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Template patches, ready to be matched.

    Attributes
    ----------
    centre : (P, 2) float64
        Template raster pixels, outer corner.
    values : (P, B, n * n) float32
        One template, or several bands whose best combination is found for each patch by itself.
    valid : (P, n * n) bool
    step : (2,) float64
        Template raster pixels per patch pixel along columns and rows (1 unless decimated).
    size : int
        n.
    owner : (P,) intp
        Which of several surfaces each patch is matched on, in ascending order.
    """

    centre: FloatArray
    values: Float32Array
    valid: BoolArray
    step: FloatArray
    size: int
    owner: IntArray

    def __len__(self) -> int:
        return len(self.centre)

    def take(self, chosen: IntArray | slice) -> Patches:
        """Some of the patches."""
        return replace(
            self,
            centre=self.centre[chosen],
            values=self.values[chosen],
            valid=self.valid[chosen],
            owner=self.owner[chosen],
        )


def cut_patches(bands: list[Band], full: Grid, size: int) -> Patches:
    """Cut bands into a grid of adjoining patches.

    Parameters
    ----------
    bands : list of Band
        A window of the template raster, maybe decimated: one band, or several of one grid.
    full : Grid
        Grid of the full template raster.
    size : int
        Side in pixels of the bands.
    """
    height, width = bands[0].data.shape
    rows, columns = height // size, width // size
    top, left = (height - rows * size) // 2, (width - columns * size) // 2
    grid_y, grid_x = np.mgrid[0:rows, 0:columns]
    origins = np.stack([left + grid_x.ravel() * size, top + grid_y.ravel() * size], axis=1)

    whole = np.s_[top : top + rows * size, left : left + columns * size]
    values = np.stack([squares(band.data[whole], size) for band in bands], axis=1)
    valid = np.logical_and.reduce([squares(band.valid[whole], size) for band in bands])
    to_full = ~full.transform @ bands[0].grid.transform
    centre = origins + size / 2.0
    centre = np.stack(
        [to_full.a * centre[:, 0] + to_full.c, to_full.e * centre[:, 1] + to_full.f], axis=1
    )
    owner = np.zeros(len(centre), dtype=np.intp)
    return Patches(centre, values, valid, np.array([to_full.a, to_full.e]), size, owner)


def squares(image: NDArray[Any], size: int) -> NDArray[Any]:
    """(P, size²) the squares that an image of whole ones is made of, row by row."""
    rows, columns = (side // size for side in image.shape)
    parts = image.reshape(rows, size, columns, size).swapaxes(1, 2)
    return np.ascontiguousarray(parts).reshape(rows * columns, size * size)


def patch_offsets(index: IntArray, size: int) -> FloatArray:
    """(K², 2) places of the pixels with (K,) numbers along either axis, from a patch's centre."""
    axis = pixel_centres(index) - size / 2.0
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def centred(values: FloatArray, weight: FloatArray) -> FloatArray:
    """(..., N) values less their weighted means, times the weights."""
    total = np.maximum(weight.sum(axis=-1, keepdims=True), 1.0)
    mean = (values * weight).sum(axis=-1, keepdims=True) / total
    return np.asarray((values - mean) * weight)


def gather(parts: Sequence[Patches]) -> Patches:
    """Patches of one size from several places, the surface of each with the number of its part."""
    first = parts[0]
    return Patches(
        np.concatenate([part.centre for part in parts]),
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.valid for part in parts]),
        first.step,
        first.size,
        np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
    )


def sample_step(bands: Sequence[Band], size: int, wanted: int) -> int:
    """Every which patch of these bands to look at, so that the wanted number or a few more are."""
    shapes = [band.data.shape for band in bands]
    count = int(sum((height // size) * (width // size) for height, width in shapes))
    return max(count // wanted, 1)
