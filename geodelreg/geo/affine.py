"""Arrays of points through `affine.Affine`."""

from __future__ import annotations

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from geodelreg.values.raster import FloatArray


def apply_affine(transform: Affine, xy: NDArray[np.float64]) -> FloatArray:
    """Transform points.

    Parameters
    ----------
    transform : Affine
    xy : (..., 2) float64

    Returns
    -------
    (..., 2) float64
    """
    out = np.empty(np.shape(xy), dtype=np.float64)
    x, y = xy[..., 0], xy[..., 1]
    out[..., 0] = transform.a * x + transform.b * y + transform.c
    out[..., 1] = transform.d * x + transform.e * y + transform.f
    return out


def affine_matrix(transform: Affine) -> FloatArray:
    """(2, 3) float64 matrix of an affine transformation."""
    return np.array(
        [[transform.a, transform.b, transform.c], [transform.d, transform.e, transform.f]],
        dtype=np.float64,
    )


def affine_from_matrix(matrix: FloatArray) -> Affine:
    """Affine transformation of a (2, 3) matrix."""
    return Affine(*(float(value) for value in np.asarray(matrix)[:2, :3].ravel()))
