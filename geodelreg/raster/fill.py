"""Fill that a file does not declare: a constant area of 0, or of the largest value, at a corner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.values.raster import Window

_SIDE_PX = 32
"""Of the squares that are looked at: no ground is the same over a thousand pixels."""


def undeclared_fill(
    read: Callable[[Window], NDArray[Any]], shape: tuple[int, int], dtype: str
) -> float | None:
    """The value that fills a corner of all bands up to the border; None without one.

    Scenes that were turned, cut or mosaicked are filled up to a rectangle, which takes in a corner.
    A raster that shows the value in its middle, too, is constant, not filled.

    Parameters
    ----------
    read : callable
        Pixels (B, h, w) of a window of the image bands, of a file that declares neither no-data
        nor masks.
    shape : tuple of int
        ``(height, width)``
    dtype : str
    """
    height, width = shape
    side = min(_SIDE_PX, height // 4, width // 4)
    if side < 2:
        return None

    def constant(row: int, column: int) -> float | None:
        """The one value of a square in all bands; None of several."""
        square = read(Window(column, row, side, side))
        return float(square.flat[0]) if (square == square.flat[0]).all() else None

    corners = [constant(row, column) for row in (0, height - side) for column in (0, width - side)]
    fill = next((value for value in corners if value in _fills(dtype)), None)
    if fill is None or constant((height - side) // 2, (width - side) // 2) == fill:
        return None
    return fill


def _fills(dtype: str) -> tuple[float, ...]:
    kind = np.dtype(dtype)
    return (0.0, float(np.iinfo(kind).max)) if kind.kind in "iu" else (0.0,)
