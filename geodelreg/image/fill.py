"""Fill that a file does not declare: a constant area of 0, or of the largest value, at a corner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from geodelreg.image.environment import gdal_calls

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_SIDE_PX = 32
"""Of the squares that are looked at: no ground is the same over a thousand pixels."""


def undeclared_fill(dataset: DatasetReader, bands: Sequence[int]) -> float | None:
    """The value that fills a corner of all bands up to the border; None without one.

    Scenes that were turned, cut or mosaicked are filled up to a rectangle, which takes in a corner.
    A raster that shows the value in its middle, too, is constant, not filled.

    Parameters
    ----------
    dataset : DatasetReader
        Without no-data value or mask.
    bands : sequence of int
        Numbers of the image bands.
    """
    height, width = dataset.shape
    side = min(_SIDE_PX, height // 4, width // 4)
    if side < 2:
        return None
    with gdal_calls():
        corners = [
            _constant(dataset, bands, row, column, side)
            for row in (0, height - side)
            for column in (0, width - side)
        ]
        fill = next((value for value in corners if value in _fills(dataset.dtypes[0])), None)
        middle = _constant(dataset, bands, (height - side) // 2, (width - side) // 2, side)
    return None if fill is None or middle == fill else fill


def _constant(
    dataset: DatasetReader, bands: Sequence[int], row: int, column: int, side: int
) -> float | None:
    """The one value of a square in all bands; None of several."""
    square = dataset.read(list(bands), window=((row, row + side), (column, column + side)))
    return float(square.flat[0]) if (square == square.flat[0]).all() else None


def _fills(dtype: str) -> tuple[float, ...]:
    kind = np.dtype(dtype)
    return (0.0, float(np.iinfo(kind).max)) if kind.kind in "iu" else (0.0,)
