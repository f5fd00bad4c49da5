"""Where to look closely: the worst, the best and a typical place of a pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.report.drawing import spread
from geodelreg.report.frame import Frame
from geodelreg.report.residuals import WORTH_A_WORD, matched, unmatched
from geodelreg.values.points import TiePoints
from geodelreg.values.raster import FloatArray, Window

_SIDE_PX = 384
"""Of a place, PAN pixels: a screen shows them one by one."""
_LEAST_SIDE_PX = 48
_SHARE = 0.3
"""Of the shorter side of the common ground: small rasters have small places."""

_MOST_ASKED = 400
"""Points around which places are thought of."""
_FULL = 0.5
"""Of the most patches in a place, and of the usual number that matched: fewer tell too little."""


@dataclass(frozen=True, slots=True)
class Place:
    """A part of PAN that is worth a look.

    Attributes
    ----------
    name : str
        ``worst``, ``typical``, ``best``; ``middle`` when no point tells them apart; ``unmatched``
        where many patches match nothing.
    window : Window
        Of PAN.
    residual_px : (float, float)
        Median of what the correction leaves there, right and down; NaN when not known.
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
    """The worst, a typical and the best place, by what all points say that matched in each.

    And the place where most match nothing, if many do.

    Places with few patches, where much is missing, or that few of the patches matched in, are none
    of them where there are others.  The typical one has the median of their residuals.

    Parameters
    ----------
    points : TiePoints
    frame : Frame
    """
    window = frame.window
    some = np.flatnonzero(matched(points) & _within(points.reference_px, window))
    if not len(some):
        part = _window(_middle(window), frame)
        return [Place("middle", part, (float("nan"), float("nan")), part_of(_middle(part), window))]
    asked = spread(points.reference_px, some, _MOST_ASKED)
    windows = [_window(at, frame) for at in points.reference_px[asked]]
    tried = np.array([_within(points.reference_px, part).sum() for part in windows])
    inside = [some[_within(points.reference_px[some], part)] for part in windows]
    heard = np.array([len(index) for index in inside])
    residual = np.array([np.median(points.residual_px[index], axis=0) for index in inside])
    length = np.hypot(*residual.T)
    spoilt = np.array([np.hypot(*points.residual_px[index].T).mean() for index in inside])
    full = (tried >= _FULL * tried.max()) & (heard >= _FULL * np.median(heard))
    able = np.flatnonzero(full) if full.any() else np.arange(len(windows))
    median = np.sort(length[able])[(len(able) - 1) // 2]
    good = able[length[able] <= median]
    chosen = {
        "worst": able[np.argmax(length[able])],
        "typical": able[np.argmin(np.abs(length[able] - median))],
        "best": good[np.argmin(spoilt[good])],
    }
    return [
        Place(name, windows[i], (float(residual[i, 0]), float(residual[i, 1])),
              part_of(_middle(windows[i]), window))
        for name, i in chosen.items()
    ] + _unmatched(points, frame)  # fmt: skip


def _unmatched(points: TiePoints, frame: Frame) -> list[Place]:
    """Where most patches match nothing; none where few do."""
    away = unmatched(points) & _within(points.reference_px, frame.window)
    if away.sum() <= WORTH_A_WORD * len(points):
        return []
    asked = spread(points.reference_px, np.flatnonzero(away), _MOST_ASKED)
    windows = [_window(at, frame) for at in points.reference_px[asked]]
    lost = [_within(points.reference_px, part) for part in windows]
    part = windows[int(np.argmax([away[i].sum() - points.kept[i].sum() for i in lost]))]
    nowhere = float("nan"), float("nan")
    return [Place("unmatched", part, nowhere, part_of(_middle(part), frame.window))]


def _within(xy: FloatArray, window: Window) -> np.ndarray:
    low = np.array(window[:2])
    return np.asarray(((xy >= low) & (xy < low + np.array(window[2:]))).all(axis=1))


def _window(at: FloatArray, frame: Frame) -> Window:
    """The place around a point, moved until it lies in the frame."""
    whole = frame.window
    side = min(_SIDE_PX, max(_LEAST_SIDE_PX, round(_SHARE * min(whole.width, whole.height))))
    size = min(side, whole.width), min(side, whole.height)
    column, row = (
        int(np.clip(round(float(c) - s / 2), start, start + full - s))
        for c, s, start, full in zip(at, size, whole[:2], whole[2:], strict=True)
    )
    return Window(column, row, *size)


def _middle(window: Window) -> FloatArray:
    return np.array([window.column + window.width / 2, window.row + window.height / 2])


def part_of(at: FloatArray, window: Window) -> str:
    """Which ninth of a window a point lies in: "lower left", "middle"."""
    x, y = (np.asarray(at) - window[:2]) / np.maximum(window[2:], 1)
    across = ("left", "middle", "right")[int(np.clip(3 * x, 0, 2))]
    down = ("upper", "middle", "lower")[int(np.clip(3 * y, 0, 2))]
    return "middle" if across == down == "middle" else f"{down} {across}".replace("middle ", "")
