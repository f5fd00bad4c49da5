"""Values that are known on a lattice over a raster, and smooth between its places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.values.raster import FloatArray

_DECIMALS = 9  # of a step: beyond them is only rounding of the division


@dataclass(frozen=True, slots=True, eq=False)
class OnLattice:
    """A bilinear function of pixels.

    Attributes
    ----------
    values : (n, m) float64
        From corner to corner of the raster.
    shape : tuple of int
        ``(height, width)`` of the raster.
    """

    values: FloatArray
    shape: tuple[int, int]

    def __call__(self, xy: FloatArray) -> FloatArray:
        """(N,) values at (N, 2) pixels; beyond the raster those of its edge."""
        steps = np.array(self.values.shape[::-1]) - 1
        # rounded so that a place of the lattice has the value of that place, and no neighbour's
        at = np.round(np.clip(np.asarray(xy) / self.shape[::-1] * steps, 0, steps), _DECIMALS)
        first = np.minimum(at.astype(np.intp), np.maximum(steps - 1, 0))
        (x, y), (column, row) = (at - first).T, first.T
        right, below = np.minimum(column + 1, steps[0]), np.minimum(row + 1, steps[1])
        upper = self.values[row, column] * (1 - x) + self.values[row, right] * x
        lower = self.values[below, column] * (1 - x) + self.values[below, right] * x
        return np.asarray(upper * (1 - y) + lower * y)
