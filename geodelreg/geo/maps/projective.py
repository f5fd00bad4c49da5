"""Projective maps of pixels: what a plane seen from elsewhere does to its image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from geodelreg.geo.maps.smooth import SmoothMap
from geodelreg.values.raster import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ProjectiveMap(SmoothMap):
    """A homography of pixels.

    Attributes
    ----------
    matrix : (3, 3) float64
        Of homogeneous coordinates; the third is positive where the map is defined.
    sigma : callable or None
        (N, 2) pixels to (N,) standard errors; None when the map is exact, or they are not known.
    """

    matrix: FloatArray
    sigma: Callable[[FloatArray], FloatArray] | None = None

    def forward(self, xy: FloatArray) -> FloatArray:
        """Map (..., 2) points; NaN on the horizon and behind it."""
        return _mapped(self.matrix, xy)

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Map (..., 2) points back."""
        return _mapped(np.asarray(np.linalg.inv(self.matrix), np.float64), xy)

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) standard errors, as they were given."""
        return np.zeros(len(xy)) if self.sigma is None else self.sigma(xy)

    def to_json(self) -> dict[str, Any]:
        """Its matrix."""
        return {"kind": "projective", "matrix": self.matrix.tolist()}


def _mapped(matrix: FloatArray, xy: FloatArray) -> FloatArray:
    there = np.asarray(xy, dtype=np.float64) @ matrix[:, :2].T + matrix[:, 2]
    depth = np.where(there[..., 2:] > 0, there[..., 2:], np.nan)
    return np.asarray(there[..., :2] / depth)
