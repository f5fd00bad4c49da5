"""What the correction leaves, as a map over the raster: smooth, and deaf to single mismatches."""

from __future__ import annotations

import numpy as np

from geodelreg.fine.layers import ELSEWHERE
from geodelreg.geo.maps.kriging import distances
from geodelreg.report.frame import Frame
from geodelreg.values.points import Status, TiePoints
from geodelreg.values.raster import BoolArray, FloatArray, IntArray

WORTH_A_WORD = 0.3
"""Of all points: fewer tell too little, or match nothing, in any good pair."""
NEIGHBOURS = 8
"""Points whose median is taken: three gross mismatches among them change little."""
_CELLS = 48
_DISTANCES = 200_000
"""Between places and points, held at once: 3 MB."""
_REACH = 2.5
"""Usual distances between neighbours beyond which nothing is said of a place."""


def elsewhere(points: TiePoints) -> BoolArray:
    """(M,) True for points that matched, but at another place than the correction says."""
    return np.asarray(np.isin(points.status, ELSEWHERE) & _finite(points))


def matched(points: TiePoints) -> BoolArray:
    """(M,) True for points that matched anywhere, kept or not."""
    return np.asarray((points.kept & _finite(points)) | elsewhere(points))


def unmatched(points: TiePoints) -> BoolArray:
    """(M,) True for points that show something, and match nothing near where the others say."""
    return np.asarray(np.isin(points.status, (Status.CONVERGENCE, Status.CORRELATION)))


def _finite(points: TiePoints) -> BoolArray:
    return np.asarray(np.isfinite(points.residual_px).all(axis=1))


def local_residual(points: TiePoints, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Median residual of the points around some places.

    Parameters
    ----------
    points : TiePoints
        At least one of them matched.
    at : (N, 2) float64
        PAN pixels.

    Returns
    -------
    residual_px : (N, 2) float64
        PAN pixels: where MS lies after the correction, less where PAN has it.
    distance_px : (N,) float64
        To the farthest of the points asked.
    """
    near, distance = _neighbours(points, at)
    return np.asarray(np.median(points.residual_px[near], axis=1)), distance


def _neighbours(points: TiePoints, at: FloatArray) -> tuple[IntArray, FloatArray]:
    """(N, K) the matched points nearest to some places, and (N,) how far the farthest is."""
    some = np.flatnonzero(matched(points))
    count = min(NEIGHBOURS, len(some))
    near, distance = np.empty((len(at), count), np.intp), np.empty(len(at))
    # all distances, some places at a time: a tree would cost the import of scipy.spatial, 0.3 s
    rows = max(1, _DISTANCES // len(some))
    for start in range(0, len(at), rows):
        part = slice(start, start + rows)
        apart = distances(at[part], points.reference_px[some])
        order = np.argpartition(apart, count - 1, axis=1)[:, :count]
        near[part] = some[order]
        distance[part] = np.take_along_axis(apart, order, axis=1).max(axis=1)
    return near, distance


def cells(frame: Frame) -> FloatArray:
    """(n, m, 2) PAN pixels at the centres of square cells that cover the frame's window."""
    window = frame.window
    side = max(window.width, window.height) / _CELLS
    counts = (max(1, round(window.width / side)), max(1, round(window.height / side)))
    x, y = (
        start + (np.arange(count) + 0.5) * size / count
        for start, size, count in zip(window[:2], window[2:], counts, strict=True)
    )
    return np.stack(np.meshgrid(x, y), axis=-1)


def error_map(points: TiePoints, frame: Frame) -> FloatArray:
    """(n, m) length of the local residual in each cell, PAN pixels; NaN where none is near."""
    at = cells(frame)
    if not matched(points).any():
        return np.full(at.shape[:2], np.nan)
    flat = at.reshape(-1, 2)
    residual, reach = local_residual(points, flat)
    length = np.where(reach <= _reach_px(points), np.hypot(*residual.T), np.nan)
    return np.asarray(_on_ms(length, flat, frame).reshape(at.shape[:2]))


def sigma_map(points: TiePoints, frame: Frame) -> FloatArray:
    """(n, m) standard error of the correction in each cell, PAN pixels.

    NaN beyond MS, and where most points around lie elsewhere or none are near: the standard error
    is of a model that nothing supports there.  NaN everywhere of a map that has no standard errors:
    they are not known then, and not 0.  Of points that are not listed nothing is asked.
    """
    at = cells(frame)
    if not frame.sigma.values.any():
        return np.full(at.shape[:2], np.nan)
    flat = at.reshape(-1, 2)
    there = np.nan_to_num(frame.to_ms(flat, corrected=True))
    sigma = frame.sigma(there) * frame.pan_px_per_ms_px
    if matched(points).any():
        near, reach = _neighbours(points, flat)
        fits = points.kept[near].mean(axis=1) >= 0.5
        sigma = np.where(fits & (reach <= _reach_px(points)), sigma, np.nan)
    return np.asarray(_on_ms(sigma, flat, frame).reshape(at.shape[:2]))


def _reach_px(points: TiePoints) -> float:
    """How far points may lie from a place that they speak for, PAN pixels."""
    at = points.reference_px[matched(points)]
    return _REACH * float(np.median(_neighbours(points, at)[1]))


def _on_ms(values: FloatArray, at: FloatArray, frame: Frame) -> FloatArray:
    """The same where MS covers PAN, else NaN."""
    ms = frame.to_ms(at, corrected=True)
    inside = ((ms >= 0) & (ms <= frame.ms_size)).all(axis=1)
    return np.where(inside, values, np.nan)
