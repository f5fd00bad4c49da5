"""The only place that converts between the two pixel conventions.

Everywhere in geodelreg, and in GDAL, (0, 0) is the outer corner of the upper-left pixel.
OpenCV and array indices put (0, 0) at that pixel's centre.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

HALF_PIXEL = 0.5
_Floating = TypeVar("_Floating", np.float32, np.float64)


def centre_to_corner(xy: NDArray[_Floating]) -> NDArray[_Floating]:
    """Pixel-centre coordinates (OpenCV, array index) to outer-corner coordinates (GDAL).

    Parameters
    ----------
    xy : (..., 2) float
        ``(column, row)``, in pixels.
    """
    return xy + xy.dtype.type(HALF_PIXEL)


def corner_to_centre(xy: NDArray[_Floating]) -> NDArray[_Floating]:
    """Outer-corner coordinates (GDAL) to pixel-centre coordinates (OpenCV, array index)."""
    return xy - xy.dtype.type(HALF_PIXEL)


def pixel_centres(index: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """Outer-corner coordinate of the centre of pixel number `index` along one axis."""
    return np.asarray(index, dtype=np.float64) + HALF_PIXEL
