"""Nearest descriptors, the ratio test and one-to-one pairs."""

from __future__ import annotations

import numpy as np

from geodelreg.values.points import Keypoints, Matches
from geodelreg.values.raster import BoolArray, Float32Array, FloatArray, IntArray

_PLACE_PX = 0.5  # as far apart repeated matches of one pair of places are, at most
BLOCK_ROWS = 1024  # of 8000 columns: 32 MB at a time


def match_descriptors(source: Keypoints, reference: Keypoints) -> Matches:
    """Nearest reference descriptor of every source descriptor, whatever its ratio.

    One matrix product per block of rows: about eight times as fast as OpenCV's brute-force matcher.
    Descriptors hold integers, so sums are exact in float32 and do not depend on the thread count.

    Parameters
    ----------
    source, reference : Keypoints

    Returns
    -------
    Matches
        One per source keypoint, in their order; none if `reference` has fewer than two keypoints.
        Distances are Euclidean (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94).
    """
    if len(source) == 0 or len(reference) < 2:
        none = np.empty(0, dtype=np.intp)
        return Matches(none, none, np.empty(0))
    nearest, best, second = _two_nearest(source.descriptors, reference.descriptors)
    distance, limit = np.sqrt(best), np.sqrt(second)
    ratio = np.divide(distance, limit, out=np.ones_like(distance), where=limit > 0)
    return Matches(np.arange(len(source), dtype=np.intp), nearest, ratio)


def _two_nearest(
    source: Float32Array, reference: Float32Array
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Index of the nearest row of `reference` and squared distances of the two nearest."""
    transposed = np.ascontiguousarray(-2.0 * reference.T, dtype=np.float32)
    reference_norm = np.einsum("ij,ij->i", reference, reference)
    nearest = np.empty(len(source), dtype=np.intp)
    best = np.empty(len(source), dtype=np.float64)
    second = np.empty(len(source), dtype=np.float64)
    for start in range(0, len(source), BLOCK_ROWS):
        block = slice(start, start + BLOCK_ROWS)
        gap = source[block] @ transposed
        gap += reference_norm
        rows = np.arange(len(gap))
        nearest[block] = column = gap.argmin(axis=1)
        best[block] = gap[rows, column]
        gap[rows, column] = np.inf
        second[block] = gap.min(axis=1)
    source_norm = np.einsum("ij,ij->i", source, source)
    return nearest, np.maximum(best + source_norm, 0.0), np.maximum(second + source_norm, 0.0)


def ratio_test(ratio: FloatArray, limit: float) -> BoolArray:
    """(M,) bool, True where the nearest descriptor is clearly nearer than the second one.

    Parameters
    ----------
    ratio : (M,) float64
        Nearest over second nearest distance.
    limit : float
        Lowe's limit; the ratio must be below it.
    """
    return np.asarray(ratio < limit)


def one_to_one(source_xy: FloatArray, reference_xy: FloatArray, ratio: FloatArray) -> BoolArray:
    """Make matches one-to-one by their pixel coordinates.

    SIFT gives one place several orientations and nearly equal scales, so one pair of places can
    match repeatedly.  Matches are visited from the best ratio on; one goes when its place, in
    either image, is taken.  A place is a cell of a lattice of half a pixel.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        Outer-corner pixels.
    ratio : (M,) float64

    Returns
    -------
    (M,) bool
        True for the matches that stay.
    """
    keep = np.zeros(len(ratio), dtype=np.bool_)
    order = np.argsort(ratio, kind="stable")
    source_place = _places(source_xy)
    reference_place = _places(reference_xy)
    source_taken = np.zeros(len(ratio), dtype=np.bool_)
    reference_taken = np.zeros(len(ratio), dtype=np.bool_)
    for i in order:
        s, r = source_place[i], reference_place[i]
        if not (source_taken[s] or reference_taken[r]):
            keep[i] = source_taken[s] = reference_taken[r] = True
    return keep


def _places(xy: FloatArray) -> IntArray:
    """Number of the place of each point."""
    if len(xy) == 0:
        return np.empty(0, dtype=np.intp)
    cell = np.floor(xy / _PLACE_PX).astype(np.int64)
    _, place = np.unique(cell, axis=0, return_inverse=True)
    return np.asarray(place.reshape(-1), dtype=np.intp)
