"""What follows for any smooth map from its two directions, and maps made of other maps."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from affine import Affine

from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray

_STEP_PX = 4.0
"""Half width of the differences that linearise: of pixels, over which headers hardly curve, and
wide enough that the rounding of coordinates of 10⁷ m (10⁻⁹ m) is lost."""
_SOLVED_PX = 1e-9  # far below what anyone sees, far above rounding


class SmoothMap(ABC):
    """A `PixelMap` of which `forward` and `inverse` are known."""

    __slots__ = ()

    @abstractmethod
    def forward(self, xy: FloatArray) -> FloatArray:
        """(..., 2) pixels to (..., 2) pixels."""

    @abstractmethod
    def inverse(self, xy: FloatArray) -> FloatArray:
        """The way back."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Kind and numbers, of plain types."""

    def linearise(self, xy: FloatArray) -> FloatArray:
        """(N, 2, 3) local affines by central differences."""
        right, down = np.array([_STEP_PX, 0.0]), np.array([0.0, _STEP_PX])
        image = self.forward(np.stack([xy + right, xy - right, xy + down, xy - down, xy]))
        out = np.empty((len(xy), 2, 3))
        out[:, :, 0] = (image[0] - image[1]) / (2 * _STEP_PX)
        out[:, :, 1] = (image[2] - image[3]) / (2 * _STEP_PX)
        out[:, :, 2] = image[4]
        return out

    def carry(self, xy: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points and covariances, as points and covariances there."""
        local = self.linearise(xy)
        jacobian = local[:, :, :2]
        return local[:, :, 2], np.einsum("pij,pjk,plk->pil", jacobian, covariance, jacobian)

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) zeros: exact."""
        return np.zeros(len(xy))

    def as_affine(self) -> Affine | None:
        """None: not known to be one."""
        return None

    def pieces(self) -> Sequence[tuple[PixelMap, float, float]]:
        """The map itself, everywhere."""
        return [(self, -math.inf, math.inf)]

    def then(self, other: PixelMap) -> PixelMap:
        """First this map, then the other."""
        return Composed(self, other)


@dataclass(frozen=True, slots=True, eq=False)
class Composed(SmoothMap):
    """One map, and then another."""

    first: PixelMap
    second: PixelMap

    def forward(self, xy: FloatArray) -> FloatArray:
        """Through the first, then through the second."""
        return self.second.forward(self.first.forward(xy))

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Back through the second, then through the first."""
        return self.first.inverse(self.second.inverse(xy))

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) standard errors of both, the first's magnified by the second."""
        between = self.first.forward(xy)
        grown = self.first.sigma_at(xy) * _magnification(self.second, between)
        return np.asarray(np.hypot(grown, self.second.sigma_at(between)))

    def pieces(self) -> Sequence[tuple[PixelMap, float, float]]:
        """Those of the second after the first, where that keeps rows apart; of the first as well.

        Jumps of a second map after one that turns rows would be no jumps along rows.
        """
        affine = self.first.as_affine()
        if affine is None:
            ahead = self.first.pieces()
            return [(piece.then(self.second), low, high) for piece, low, high in ahead]
        if affine.d != 0 or affine.e <= 0:
            return [(self, -math.inf, math.inf)]
        return [
            (self.first.then(piece), (low - affine.f) / affine.e, (high - affine.f) / affine.e)
            for piece, low, high in self.second.pieces()
        ]

    def to_json(self) -> dict[str, Any]:
        """Both, in order."""
        return {"kind": "composed", "maps": [self.first.to_json(), self.second.to_json()]}

    def as_affine(self) -> Affine | None:
        """The product, where both are affine."""
        one, other = self.first.as_affine(), self.second.as_affine()
        return None if one is None or other is None else other @ one


@dataclass(frozen=True, slots=True, eq=False)
class Inverse(SmoothMap):
    """A map the other way round."""

    of: PixelMap

    def forward(self, xy: FloatArray) -> FloatArray:
        """The inverse of the other."""
        return self.of.inverse(xy)

    def inverse(self, xy: FloatArray) -> FloatArray:
        """The other map."""
        return self.of.forward(xy)

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) standard errors of the other, in pixels on its side."""
        there = self.of.inverse(xy)
        return self.of.sigma_at(there) / _magnification(self.of, there)

    def to_json(self) -> dict[str, Any]:
        """The other map."""
        return {"kind": "inverse", "of": self.of.to_json()}

    def as_affine(self) -> Affine | None:
        """The inverse, where the other is affine."""
        affine = self.of.as_affine()
        return None if affine is None else ~affine


def solved(
    forward: Callable[[FloatArray], FloatArray],
    goal: FloatArray,
    start: FloatArray,
    back: FloatArray,
    steps: int,
) -> FloatArray:
    """(M, 2) places that a map sends to (M, 2) goals; NaN where it ends not.

    Newton's method with one slope for all.

    Parameters
    ----------
    forward : callable
        Of (K, 2) places.
    goal, start : (M, 2) float64
    back : (2, 2) float64
        What turns a gap in the goal into one in the place, on the right.
    steps : int
        At most; each shrinks an error at least to the strain's share.
    """
    at, gap = start.copy(), np.full(goal.shape, np.inf)
    going = np.flatnonzero(np.isfinite(at).all(axis=1))
    for _ in range(steps):
        if not len(going):
            break
        gap[going] = forward(at[going]) - goal[going]
        at[going] -= gap[going] @ back
        going = going[np.abs(gap[going]).max(axis=1) > _SOLVED_PX]
    at[~(np.abs(gap).max(axis=1) <= _SOLVED_PX)] = np.nan
    return at


def point_rows(source: FloatArray, target: FloatArray, noise_px2: FloatArray) -> list[list[float]]:
    """Points of a map for JSON: source, target and variances in a row."""
    rows: list[list[float]] = np.concatenate([source, target, noise_px2], axis=1).tolist()
    return rows


def points_of_rows(rows: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Source, target and variances again.

    Raises
    ------
    TypeError, ValueError
        Of what `point_rows` has not made.
    """
    parts = np.hsplit(np.array(rows, dtype=np.float64), 3)
    source, target, noise = (np.ascontiguousarray(part) for part in parts)
    return source, target, noise


def _magnification(of: PixelMap, xy: FloatArray) -> FloatArray:
    """(N,) pixels of the result to a pixel, along either axis."""
    return np.asarray(np.sqrt(np.abs(np.linalg.det(of.linearise(xy)[:, :, :2]))))
