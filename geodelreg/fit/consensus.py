"""The one similarity or affine that many matches agree on."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from geodelreg.geo.affine import affine_matrix
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import BoolArray, FloatArray

_MAX_STRETCH = 8.0  # or its inverse: no header of an MS and a PAN is as wrong
_FEWEST = {"similarity": 2, "affine": 3}
_MISSED = 1e-4  # probability that no sample was all inliers
_MOST_SAMPLES = 20_000  # of two matches, of which 3 % are right: eighteen are both right
_LOOSENING = (4.0, 2.0, 1.0, 1.0)  # of the threshold, from fit to fit (Chum et al. 2003)


class Consensus(NamedTuple):
    """A transformation and the matches that agree with it.

    Attributes
    ----------
    map : AffineMap or None
        Source pixels to reference pixels; None when nothing was found.
    inliers : (M,) bool
    """

    map: AffineMap | None
    inliers: BoolArray


def consensus(
    source_xy: FloatArray, reference_xy: FloatArray, threshold_px: float, kind: str = "affine"
) -> Consensus:
    """Find the transformation that most matches agree on, by sampling (OpenCV's RANSAC).

    Mirroring and scales beyond 1:8 are not taken.  Returns the best it saw, always the same: judge
    it by `geodelreg.fit.chance.log_nfa`.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        One-to-one matches, outer-corner pixels.
    threshold_px : float
        Largest residual of an inlier, in reference pixels.
    kind : str
        ``similarity`` or ``affine``.

    Returns
    -------
    Consensus
    """
    nothing = Consensus(None, np.zeros(len(source_xy), dtype=np.bool_))
    if len(source_xy) < _FEWEST[kind]:
        return nothing
    estimate = cv2.estimateAffinePartial2D if kind == "similarity" else cv2.estimateAffine2D
    found, _ = estimate(
        source_xy, reference_xy, method=cv2.RANSAC, ransacReprojThreshold=threshold_px,
        maxIters=_MOST_SAMPLES, confidence=1.0 - _MISSED,
    )  # fmt: skip
    matrix = np.full((2, 3), np.nan) if found is None else np.asarray(found, dtype=np.float64)
    best = AffineMap.of(matrix)
    if not _is_plausible(best):
        return nothing
    for loosening in _LOOSENING:  # two or three exact matches alone aim badly at the others
        near = radial_residuals(best, source_xy, reference_xy) <= loosening * threshold_px
        if near.sum() <= _FEWEST[kind]:
            break
        closer = fit_plainly(source_xy[near], reference_xy[near], kind)
        if not _is_plausible(closer):
            break
        best = closer
    return Consensus(best, radial_residuals(best, source_xy, reference_xy) <= threshold_px)


def _is_plausible(there: AffineMap) -> bool:
    """True of a transformation that is finite, does not mirror, and stretches by at most 1:8."""
    matrix = affine_matrix(there.affine)
    linear = matrix[:, :2]
    if not (np.isfinite(matrix).all() and np.linalg.det(linear) > 0):
        return False
    stretch = np.linalg.svd(linear, compute_uv=False)
    return bool(stretch[0] <= _MAX_STRETCH and stretch[1] >= 1 / _MAX_STRETCH)


def radial_residuals(
    there: PixelMap, source_xy: FloatArray, reference_xy: FloatArray
) -> FloatArray:
    """(M,) float64, distance of each mapped source point from its reference point."""
    gap = there.forward(source_xy) - reference_xy
    return np.asarray(np.hypot(gap[:, 0], gap[:, 1]))


def fit_plainly(source_xy: FloatArray, reference_xy: FloatArray, kind: str) -> AffineMap:
    """Least-squares similarity or affine from source to reference points.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        At least two points (similarity) or three that are not collinear (affine).
    kind : str
        ``similarity`` or ``affine``.
    """
    source_mean, reference_mean = source_xy.mean(axis=0), reference_xy.mean(axis=0)
    # einsum, for BLAS may round differently from one thread count to another
    across = np.einsum("mi,mj->ij", source_xy - source_mean, reference_xy - reference_mean)
    normal = np.einsum("mi,mj->ij", source_xy - source_mean, source_xy - source_mean)
    if kind == "similarity":
        power = max(float(np.trace(normal)), float(np.finfo(np.float64).tiny))
        along, turn = np.trace(across) / power, (across[0, 1] - across[1, 0]) / power
        linear = np.array([[along, -turn], [turn, along]])
    else:
        linear = (np.linalg.pinv(normal, hermitian=True) @ across).T
    return AffineMap.of(np.column_stack([linear, reference_mean - linear @ source_mean]))
