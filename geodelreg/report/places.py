"""Where to look closely: the worst, the best and a typical place of a pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.report.frame import Frame
from geodelreg.report.residuals import local_residual, matched
from geodelreg.values.points import TiePoints
from geodelreg.values.raster import FloatArray, Window

_SIDE_PX = 384
"""Of a place, PAN pixels: a screen shows them one by one."""
_LEAST_SIDE_PX = 48
_SHARE = 0.3
"""Of the shorter side of the common ground: small rasters have small places."""


@dataclass(frozen=True, slots=True)
class Place:
    """A part of PAN that is worth a look.

    Attributes
    ----------
    name : str
        ``worst``, ``typical``, ``best``; ``middle`` when no point tells them apart.
    window : Window
        Of PAN.
    residual_px : (float, float)
        What the correction leaves there, right and down; NaN when not known.
    where : str
        In words.
    """

    name: str
    window: Window
    residual_px: tuple[float, float]
    where: str

    @property
    def distance_px(self) -> float:
        """Length of the residual."""
        return float(np.hypot(*self.residual_px))


def places(points: TiePoints, frame: Frame) -> list[Place]:
    """The worst place among all that matched; the typical and the best of those that were kept.

    Parameters
    ----------
    points : TiePoints
    frame : Frame
    """
    window = frame.window
    some = np.flatnonzero(matched(points) & _within(points.reference_px, window))
    if not len(some):
        middle = np.array([window.column + window.width / 2, window.row + window.height / 2])
        return [_place("middle", middle, (float("nan"), float("nan")), frame)]
    residual, _ = local_residual(points, points.reference_px[some])
    length = np.hypot(*residual.T)
    kept = np.flatnonzero(points.kept[some])
    good = kept if len(kept) else np.arange(len(some))
    order = good[np.argsort(length[good], kind="stable")]
    chosen = {
        "worst": int(np.argmax(length)),
        "typical": int(order[len(order) // 2]),
        "best": int(order[0]),
    }
    return [
        _place(name, points.reference_px[some[i]], (float(residual[i, 0]), float(residual[i, 1])),
               frame)
        for name, i in chosen.items()
    ]  # fmt: skip


def _within(xy: FloatArray, window: Window) -> np.ndarray:
    low = np.array(window[:2])
    return np.asarray(((xy >= low) & (xy < low + np.array(window[2:]))).all(axis=1))


def _place(name: str, at: FloatArray, residual: tuple[float, float], frame: Frame) -> Place:
    whole = frame.window
    side = min(_SIDE_PX, max(_LEAST_SIDE_PX, round(_SHARE * min(whole.width, whole.height))))
    size = min(side, whole.width), min(side, whole.height)
    column, row = (
        int(np.clip(round(float(c) - s / 2), start, start + full - s))
        for c, s, start, full in zip(at, size, whole[:2], whole[2:], strict=True)
    )
    return Place(name, Window(column, row, *size), residual, part_of(at, whole))


def part_of(at: FloatArray, window: Window) -> str:
    """Which ninth of a window a point lies in: "lower left", "middle"."""
    x, y = (np.asarray(at) - window[:2]) / np.maximum(window[2:], 1)
    across = ("left", "middle", "right")[int(np.clip(3 * x, 0, 2))]
    down = ("upper", "middle", "lower")[int(np.clip(3 * y, 0, 2))]
    return "middle" if across == down == "middle" else f"{down} {across}".replace("middle ", "")
