"""Tie points of peers that give nothing else: an affine or a smooth field through them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ROUNDS = 5
OUTLIER_MEDIANS = 2.5
SMALLEST_LIMIT_PX = 0.1
NEIGHBOURS = 64
SMOOTHING = 1.0


def affine_without_outliers(source: FloatArray, target: FloatArray) -> FloatArray:
    """(2, 3) by least squares, five times, points beyond 2.5 median distances left out.

    The first distances are from the median shift, which half of the points may miss.
    """
    design = np.column_stack([source, np.ones(len(source))])
    matrix = np.vstack([np.eye(2), np.median(target - source, axis=0)])
    kept = np.ones(len(source), dtype=bool)
    for _ in range(ROUNDS):
        distance = np.hypot(*(design @ matrix - target).T)
        kept = distance < max(SMALLEST_LIMIT_PX, OUTLIER_MEDIANS * float(np.median(distance[kept])))
        matrix = np.linalg.lstsq(design[kept], target[kept], rcond=None)[0]
    return np.asarray(matrix.T)


def agreeing(source: FloatArray, target: FloatArray) -> int:
    """Points within a pixel of the affine through them."""
    linear = affine_without_outliers(source, target)
    off = source @ linear[:, :2].T + linear[:, 2] - target
    return int((np.hypot(*off.T) < 1.0).sum())


def smooth_field(source: FloatArray, target: FloatArray, at: FloatArray) -> FloatArray:
    """Where `at` goes: thin plates through the points that agree with their neighbours."""
    from scipy.interpolate import RBFInterpolator
    from scipy.spatial import cKDTree

    shift = target - source
    _, near = cKDTree(source).query(source, k=min(9, len(source)))
    off = np.hypot(*(shift - np.median(shift[near], axis=1)).T)
    kept = off < max(SMALLEST_LIMIT_PX, 2 * OUTLIER_MEDIANS * float(np.median(off)))
    _, first = np.unique(source[kept], axis=0, return_index=True)
    field = RBFInterpolator(
        source[kept][first], shift[kept][first], min(NEIGHBOURS, len(first)), SMOOTHING
    )
    return np.asarray(at + field(at))
