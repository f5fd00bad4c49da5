"""Affine maps of pixels: shifts, scales, similarities and affinities of a header."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from affine import Affine

from geodelreg.geo.affine import affine_from_matrix, affine_matrix, apply_affine
from geodelreg.geo.maps.smooth import Composed, SmoothMap
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class AffineMap(SmoothMap):
    """An affine transformation of pixels.

    Attributes
    ----------
    affine : Affine
    sigma : callable or None
        (N, 2) pixels to (N,) standard errors; None when the map is exact, or they are not known.
    """

    affine: Affine
    sigma: Callable[[FloatArray], FloatArray] | None = None

    @classmethod
    def of(cls, matrix: FloatArray) -> AffineMap:
        """From a (2, 3) matrix."""
        return cls(affine_from_matrix(matrix))

    def forward(self, xy: FloatArray) -> FloatArray:
        """Transform (..., 2) points."""
        return apply_affine(self.affine, np.asarray(xy, dtype=np.float64))

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Transform (..., 2) points back."""
        return apply_affine(~self.affine, np.asarray(xy, dtype=np.float64))

    def linearise(self, xy: FloatArray) -> FloatArray:
        """(N, 2, 3): the same linear part everywhere."""
        out = np.empty((len(xy), 2, 3))
        out[:] = affine_matrix(self.affine)
        out[:, :, 2] = self.forward(xy)
        return out

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) standard errors, as they were given."""
        return np.zeros(len(xy)) if self.sigma is None else self.sigma(xy)

    def as_affine(self) -> Affine:
        """The transformation."""
        return self.affine

    def to_json(self) -> dict[str, Any]:
        """Its (2, 3) matrix."""
        return {"kind": "affine", "matrix": affine_matrix(self.affine).tolist()}

    def then(self, other: PixelMap) -> PixelMap:
        """One affine map of two; of a fitted second one with its standard errors."""
        if not isinstance(other, AffineMap) or self.sigma is not None:
            return Composed(self, other)
        sigma = other.sigma
        return AffineMap(
            other.affine @ self.affine,
            None if sigma is None else lambda xy: sigma(self.forward(xy)),
        )


IDENTITY = AffineMap(Affine.identity())
"""The header as it is."""
