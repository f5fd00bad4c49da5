"""Lines over a picture: residual arrows, the mesh, rejected points; as paths of SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geodelreg.geo.triangulation import delaunay, edges
from geodelreg.report.residuals import elsewhere, matched
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import BoolArray, FloatArray, IntArray, Window

MOST_ARROWS = 1500
_LONG_SHARE = 0.06
"""Of the picture's longer side: the arrow of a large residual."""
_SHORT_PX = 0.25
"""Residuals below which no arrow is drawn long, however small the others are."""
_LARGE_PERCENT = 95
_LONGEST = 3.0
"""Times `_LONG_SHARE`: where arrows of gross mismatches are cut off."""
_GAP = 3.0
"""Times the usual longest side of a triangle: a longer one bridges a gap."""
_HEAD = 0.35
_MOST_HEAD = 7.0


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """A picture of a window of PAN.

    Attributes
    ----------
    window : Window
    shape : tuple of int
        ``(height, width)`` of the picture.
    """

    window: Window
    shape: tuple[int, int]

    @classmethod
    def of(cls, window: Window, longest: int) -> Canvas:
        """Canvas with a longer side of `longest`, however small the window is."""
        scale = longest / max(window.width, window.height)
        height, width = (max(1, round(scale * side)) for side in (window.height, window.width))
        return cls(window, (height, width))

    def at(self, pan_px: FloatArray) -> FloatArray:
        """(N, 2) PAN pixels to places of the picture."""
        scale = np.array(self.shape[::-1]) / np.array(self.window[2:])
        return np.asarray((pan_px - self.window[:2]) * scale)

    def box(self, window: Window) -> tuple[float, float, float, float]:
        """Left, top, width and height of another window of PAN, in the picture."""
        corners = np.array([window[:2], (window[0] + window[2], window[1] + window[3])], float)
        (left, top), (right, bottom) = self.at(corners).tolist()
        return left, top, right - left, bottom - top


@dataclass(frozen=True, slots=True, eq=False)
class Arrows:
    """Residual arrows, magnified.

    Attributes
    ----------
    start, end : (N, 2) float64
        Places of the picture: where PAN has a point, and on towards where MS has it.
    kept : (N,) bool
    key_px : float
        A round residual, PAN pixels.
    key_length : float
        How long its arrow is, in the picture.
    magnified : float
        Times that residuals are drawn longer than they are.
    """

    start: FloatArray
    end: FloatArray
    kept: BoolArray
    key_px: float
    key_length: float
    magnified: float


def arrows(points: TiePoints, canvas: Canvas) -> Arrows:
    """Arrows of what the correction leaves at points that matched, kept or not."""
    some = spread(points.reference_px, np.flatnonzero(matched(points)), MOST_ARROWS)
    residual = points.residual_px[some]
    length = np.hypot(*residual.T)
    large = max(float(np.percentile(length, _LARGE_PERCENT)) if len(some) else 0.0, _SHORT_PX)
    longest = _LONG_SHARE * max(canvas.shape)
    times = longest / large
    cut = np.minimum(1.0, _LONGEST * longest / np.maximum(length * times, 1e-9))
    start = canvas.at(points.reference_px[some])
    key = round_below(large)
    per_px = canvas.shape[1] / canvas.window.width
    return Arrows(
        start,
        start + residual * times * cut[:, None],
        points.kept[some],
        key,
        key * times,
        times / per_px,
    )


def arrow_path(start: FloatArray, end: FloatArray) -> str:
    """Shafts and heads of arrows as one path."""
    parts = []
    for (x0, y0), (x1, y1) in zip(start.tolist(), end.tolist(), strict=True):
        parts.append(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}")
        length = math.hypot(x1 - x0, y1 - y0)
        if length < 1.0:
            continue
        head = min(_HEAD * length, _MOST_HEAD) / length
        dx, dy = (x1 - x0) * head, (y1 - y0) * head
        left, right = (x1 - dx - dy / 2, y1 - dy + dx / 2), (x1 - dx + dy / 2, y1 - dy - dx / 2)
        parts.append(
            f"M{left[0]:.1f} {left[1]:.1f}L{x1:.1f} {y1:.1f}L{right[0]:.1f} {right[1]:.1f}"
        )
    return "".join(parts)


MARKS = {
    "cross": "m-4-4l8 8m0-8l-8 8",
    "triangle": "m0-5l4.5 8h-9z",
    "diamond": "m0-5l5 5l-5 5l-5-5z",
    "plus": "m-4 0h8m-4-4v8",
    "ring": "m-3-3h6v6h-6z",
    "dot": "h0",
}
"""Shapes of marks, told apart without colour; a round line cap makes the last one a dot."""


def marks(at: FloatArray, shape: str) -> str:
    """Marks of one of `MARKS` at (N, 2) places, as one path."""
    return "".join(f"M{x:.1f} {y:.1f}{MARKS[shape]}" for x, y in at.tolist())


def mesh(points: TiePoints) -> IntArray:
    """(T, 3) Delaunay triangles of the kept points, as indices into all points.

    Those over gaps, as clouds leave them, are left out: nothing is known between their corners.
    """
    kept = np.flatnonzero(points.kept)
    triangles = np.asarray(kept[delaunay(points.source_px[kept])], dtype=np.intp).reshape(-1, 3)
    if not len(triangles):
        return triangles
    corners = points.source_px[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return np.asarray(triangles[longest <= _GAP * np.median(longest)])


def mesh_path(points: TiePoints, canvas: Canvas) -> str:
    """The edges of the mesh as one path."""
    at = canvas.at(points.reference_px)
    ends = at[edges(mesh(points))]
    return "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in ends.tolist())


def by_reason(points: TiePoints) -> dict[Status, IntArray]:
    """Rejected points with a place, by the stage that rejected them; the most telling first."""
    placed = np.isfinite(points.reference_px).all(axis=1)
    told = np.flatnonzero(elsewhere(points))
    order = [*np.unique(points.status[told]), *np.unique(points.status)]
    found = {
        Status(int(code)): np.flatnonzero((points.status == code) & placed)
        for code in dict.fromkeys(order)
        if code != Status.KEPT
    }
    return {status: index for status, index in found.items() if len(index)}


def spread(xy: FloatArray, index: IntArray, most: int) -> IntArray:
    """At most so many of some points, evenly over the picture row by row."""
    if len(index) <= most:
        return index
    order = index[np.lexsort(xy[index].T)]
    return np.sort(order[:: math.ceil(len(order) / most)])


def round_below(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not larger."""
    power = 10.0 ** math.floor(math.log10(value))
    step = max(s for s in (1.0, 2.0, 5.0) if s * power <= value * (1 + 1e-9))
    return float(f"{step * power:.3g}")
