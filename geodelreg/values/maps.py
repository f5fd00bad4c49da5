"""What every correction and every change of coordinates can do; `geodelreg.geo.maps` does it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from affine import Affine

from geodelreg.values.raster import FloatArray


class PixelMap(Protocol):
    """Pixels of one raster to pixels of another, or of the same with a better header.

    Whoever uses one never asks what it is made of: a header and a change of CRS, an affine, a
    composition.
    """

    def forward(self, xy: FloatArray) -> FloatArray:
        """(..., 2) pixels to (..., 2) pixels, outer corner; NaN where undefined."""

    def inverse(self, xy: FloatArray) -> FloatArray:
        """The way back."""

    def linearise(self, xy: FloatArray) -> FloatArray:
        """(N, 2, 3) local affines A: ``forward(xy + d) ≈ A[:, :, :2] @ d + A[:, :, 2]``."""

    def carry(self, xy: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N, 2) points and their (N, 2, 2) covariances, as points and covariances there."""

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) standard error of `forward`, radial, in pixels of its result; 0 of what is exact."""

    def as_affine(self) -> Affine | None:
        """The same as an affine transformation; None when it is none."""

    def pieces(self) -> Sequence[tuple[PixelMap, float, float]]:
        """Smooth maps, and the rows of the domain from and to which each holds, upper ones first.

        One, that holds everywhere, of all maps but those with jumps.
        """

    def to_json(self) -> dict[str, Any]:
        """Kind and numbers, of plain types."""

    def then(self, other: PixelMap) -> PixelMap:
        """First this map, then the other."""
