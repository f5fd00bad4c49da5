"""Maps that no affine holds: an affine trend plus a smooth residual (universal kriging).

The residual is a Gaussian process with a Matérn 5/2 kernel, twice differentiable as terrain, jitter
and lens distortion are (Rasmussen & Williams 2006, chapters 2 and 4).  Where images were cut along
rows, each part has an offset and a residual of its own.  Far from its points a field is its trend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from geodelreg.geo.maps.kriging import Axis, Kernel, distances, solve_axis
from geodelreg.geo.maps.smooth import SmoothMap, point_rows, points_of_rows, solved
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray, IntArray

_AT_ONCE = 50_000  # distances: all that is made of them stays in the cache
_INVERSE_STEPS = 30  # each shrinks an error at least to the strain's share


@dataclass(frozen=True, eq=False)
class FieldMap(SmoothMap):
    """A fitted field: source pixels to header pixels.

    Attributes
    ----------
    source, target : (N, 2) float64
        Points that it stands on, source and header pixels.
    noise_px2 : (N, 2) float64
        Variance of the points along columns and rows, nugget included.
    kernel : Kernel
    jumps : tuple of float
        Rows at which the images are cut, ascending.
    only : int or None
        Number of the part between jumps whose field is taken everywhere; each has its own rows
        when not given.
    """

    source: FloatArray
    target: FloatArray
    noise_px2: FloatArray
    kernel: Kernel
    jumps: tuple[float, ...] = ()
    only: int | None = None

    def forward(self, xy: FloatArray) -> FloatArray:
        """(..., 2) header pixels of (..., 2) source pixels."""
        flat = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        return self._mapped(flat, self._taken(flat)).reshape(np.shape(xy))

    def inverse(self, xy: FloatArray) -> FloatArray:
        """(..., 2) source pixels of (..., 2) header pixels; NaN where it is not found.

        Where two parts cover a place the upper one is taken; where none does, between parts that
        have drifted apart, the one that is nearest.
        """
        goal = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        if self.only is not None:
            return self._inverse_of_part(goal, self.only).reshape(np.shape(xy))
        best = np.full(goal.shape, np.nan)
        miss = np.full(len(goal), np.inf)
        ends = [-np.inf, *self.jumps, np.inf]
        for part in range(len(self.jumps) + 1):
            found = self._inverse_of_part(goal, part)
            outside = np.maximum(ends[part] - found[:, 1], found[:, 1] - ends[part + 1])
            outside = np.maximum(outside, 0.0)
            nearer = outside < miss
            best[nearer], miss[nearer] = found[nearer], outside[nearer]
        return best.reshape(np.shape(xy))

    def linearise(self, xy: FloatArray) -> FloatArray:
        """(N, 2, 3) local affines, by the kernel's own derivative."""
        xy = np.asarray(xy, dtype=np.float64)
        part = self._taken(xy)
        out = np.empty((len(xy), 2, 3))
        for some in self._slices(len(xy)):
            gap = xy[some, None, :] - self.source[None]
            fall = self.kernel.fall(np.sqrt((gap**2).sum(axis=2)))
            if self.jumps:
                fall *= part[some, None] == self._part(self.source)[None]
            for number, axis in enumerate(self.axes):
                slope = axis.variance * np.einsum("mnk,mn,n->mk", gap, fall, axis.alpha)
                out[some, number, :2] = self._trend[number] + slope
        out[:, :, 2] = self._mapped(xy, part)
        return out

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """(N,) radial standard error at (N, 2) source pixels, in source pixels."""
        out = np.empty(len(xy))
        for some in self._slices(len(xy)):
            near, columns = self.correlation(self.source, xy[some]), self.columns(xy[some])
            total = np.zeros(near.shape[1])
            for axis in self.axes:
                known, lack = axis.unknown(near, columns)
                total += axis.variance - (known**2).sum(axis=0) + (lack**2).sum(axis=0)
            out[some] = np.sqrt(np.maximum(total, 0.0))
        return out

    def joint_covariance(self, xy: FloatArray) -> FloatArray:
        """(2, M, M) covariance of each component between M points, source pixels squared."""
        near, columns = self.correlation(self.source, xy), self.columns(xy)
        prior = self.correlation(xy, xy)
        parts = []
        for axis in self.axes:
            known, lack = axis.unknown(near, columns)
            parts.append(axis.variance * prior - known.T @ known + lack.T @ lack)
        return np.stack(parts)

    @property
    def places(self) -> FloatArray:
        """(N, 2) where it is likely to bend most: its points."""
        return self.source

    def strain_at(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Largest strain beyond the points' affine, and the determinant over its, both (N,)."""
        beyond = self.linearise(xy)[:, :, :2] @ np.linalg.inv(self._affine)
        return np.linalg.norm(beyond - np.eye(2), ord=2, axis=(1, 2)), np.linalg.det(beyond)

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Leave-one-out residuals of the points and their variances without noise, (N, 2) each.

        The variances are those of the predictions, to which the points' own noise comes.
        """
        parts = [axis.left_out() for axis in self.axes]
        residual, variance = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
        return residual, variance - self.noise_px2

    def cost(self) -> float:
        """Minus twice the logarithm of the restricted likelihood, up to a constant."""
        return sum(axis.cost() for axis in self.axes)

    def pieces(self) -> Sequence[tuple[PixelMap, float, float]]:
        """The field of each part, with its rows."""
        ends = [-np.inf, *self.jumps, np.inf]
        if self.only is not None or not self.jumps:
            return super().pieces()
        parts = [replace(self, only=part) for part in range(len(self.jumps) + 1)]
        for part in parts:
            vars(part)["axes"] = self.axes  # the same equations: they are solved once
        return list(zip(parts, ends, ends[1:], strict=False))

    def to_json(self) -> dict[str, Any]:
        """All that it is made of; every point as source, target and variances."""
        return {
            "kind": "field",
            "range_px": self.kernel.range_px,
            "variance_px2": list(self.kernel.variance_px2),
            "nugget_px2": self.kernel.nugget_px2,
            "jump_rows": list(self.jumps),
            "points": point_rows(self.source, self.target, self.noise_px2),
        }

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> FieldMap:
        """The same map again.

        Raises
        ------
        KeyError, TypeError, ValueError
            Of what `to_json` has not made.
        """
        one, other = said["variance_px2"]
        kernel = Kernel(float(said["range_px"]), (float(one), float(other)), said["nugget_px2"])
        jumps = tuple(float(row) for row in said["jump_rows"])
        return cls(*points_of_rows(said["points"]), kernel, jumps)

    @cached_property
    def axes(self) -> tuple[Axis, Axis]:
        """The equations of columns and rows, solved."""
        columns = self.columns(self.source)
        correlation = self.correlation(self.source, self.source)
        one, other = (
            solve_axis(
                columns,
                correlation,
                self.target[:, axis] - self.source[:, axis],
                self.noise_px2[:, axis],
                self.kernel.variance_px2[axis],
            )
            for axis in (0, 1)
        )
        return one, other

    def columns(self, xy: FloatArray) -> FloatArray:
        """(M, 3 + J) trend: an affine, and a step at every jump."""
        return self._columns(xy, self._part(xy))

    def _columns(self, xy: FloatArray, part: IntArray) -> FloatArray:
        centre, span = self._frame
        steps = [(part > jump).astype(np.float64) for jump in range(len(self.jumps))]
        return np.column_stack([np.ones(len(xy)), (xy - centre) / span, *steps])

    @cached_property
    def _frame(self) -> tuple[FloatArray, float]:
        low, high = self.source.min(axis=0), self.source.max(axis=0)
        return (low + high) / 2, max(float((high - low).max()) / 2, 1.0)

    @cached_property
    def _trend(self) -> FloatArray:
        """(2, 2) linear part of the trend."""
        span = self._frame[1]
        return np.eye(2) + np.stack([axis.beta[1:3] for axis in self.axes]) / span

    @cached_property
    def _affine(self) -> FloatArray:
        """(2, 2) linear part of the affine, with its steps, that is closest to the points."""
        columns = self.columns(self.source)
        slope = np.linalg.lstsq(columns, self.target - self.source, rcond=None)[0][1:3]
        return np.asarray(np.eye(2) + slope.T / self._frame[1])

    def _part(self, xy: FloatArray) -> IntArray:
        """(M,) number of the part between jumps."""
        return np.asarray(np.searchsorted(self.jumps, xy[:, 1]), dtype=np.intp)

    def _taken(self, xy: FloatArray) -> IntArray:
        """(M,) number of the part whose field is taken."""
        return self._part(xy) if self.only is None else np.full(len(xy), self.only)

    def _mapped(self, xy: FloatArray, part: IntArray) -> FloatArray:
        """(M, 2) header pixels of source pixels, each by the field of a given part."""
        out = xy.copy()
        for some in self._slices(len(xy)):
            near = self.kernel.correlation(distances(self.source, xy[some]))
            if self.jumps:
                near *= self._part(self.source)[:, None] == part[some][None]
            columns = self._columns(xy[some], part[some])
            for number, axis in enumerate(self.axes):
                out[some, number] += axis.predict(near, columns)
        return out

    def _inverse_of_part(self, goal: FloatArray, part: int) -> FloatArray:
        """(M, 2) source pixels of one part; NaN where none is found."""
        back: FloatArray = np.asarray(np.linalg.inv(self._affine).T, dtype=np.float64)
        offset = self._mapped(np.zeros((1, 2)), np.array([part]))[0]

        def forward(xy: FloatArray) -> FloatArray:
            return self._mapped(xy, np.full(len(xy), part))

        return solved(forward, goal, (goal - offset) @ back, back, _INVERSE_STEPS)

    def _slices(self, count: int) -> list[slice]:
        step = max(_AT_ONCE // len(self.source), 1)
        return [slice(start, start + step) for start in range(0, count, step)]

    def correlation(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """(N, M) correlation of the residual between places, none across a jump."""
        found = self.kernel.correlation(distances(one, other))
        if self.jumps:
            found *= self._part(one)[:, None] == self._part(other)[None]
        return found
