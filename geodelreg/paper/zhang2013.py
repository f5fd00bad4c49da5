"""The paper's method, step by step, and its "traditional SIFT" baseline.

Yongmei Zhang, Li Ma, Rui Zhang, "A Quick Image Registration Algorithm Based on Delaunay
Triangulation", TELKOMNIKA 11(2), 2013, 761–773.  Each numbered step of section 2 there is one
function over `Pairs` and a status.  A step returns a new status array:
points are never dropped, and only kept ones are looked at.  Step 1 is
`geodelreg.coarse.keypoints.detect` with `lowe_options`, step 7 plain least squares.

Where the paper is loose, the choice made here is a documented option.  Of step 6 it says only that
the correspondence of the triangulations and the distance ratio keep homologous pairs: both criteria
here are our reading.  `AS_PRINTED` is the method without them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from geodelreg.coarse.descriptors import match_descriptors, one_to_one, ratio_test
from geodelreg.coarse.keypoints import OCTAVE_LAYERS, KeypointOptions
from geodelreg.geo.triangulation import (
    delaunay,
    edges,
    incircle_sine,
    interior_edges,
    relative_altitude,
)
from geodelreg.values.points import Keypoints, Status, TiePoints
from geodelreg.values.raster import BoolArray, FloatArray, IntArray, StatusArray

LOWE_CONTRAST = 0.03
"""Least contrast of a keypoint on a grey scale of 0 to 1 (Lowe 2004, section 4)."""

_ONE_CELL = 10**9
"""Keypoints to a cell of the grid that spreads them: so many that the image is one cell."""


_Step = Callable[["Pairs", StatusArray], StatusArray]


class Pairs(NamedTuple):
    """What the steps look at.

    Attributes
    ----------
    source_xy, reference_xy : (M, 2) float64
        Outer-corner pixels of either image.
    ratio : (M,) float64
        Nearest over second nearest descriptor distance.
    """

    source_xy: FloatArray
    reference_xy: FloatArray
    ratio: FloatArray


@dataclass(frozen=True, slots=True)
class ZhangOptions:
    """What the paper leaves open.  All tolerances are free of scale.

    Attributes
    ----------
    ratio : float
        Step 2: Lowe's limit; the paper's value.
    min_altitude : float
        Step 5: three points are collinear when the smallest altitude of their triangle is less
        than this share of its longest edge; 0 switches the step off.
    min_incircle : float
        Step 5: four points are cocircular when the normalised in-circle determinant (the sine of
        the sum of the opposite angles) of two adjacent triangles is less than this; 0 switches the
        step off.
    final_ratio : float
        Step 6, our reading: descriptor distance ratio asked of the survivors; 1 switches the test
        off.
    min_shared_edges : float
        Step 6, our reading: smallest share of a point's edges that both triangulations have (shared
        edges over the edges it has in either one); 0 switches the test off.
    sigma_px : float
        Standard deviation of a SIFT position, in pixels of the keypoints' image, per axis.
    """

    ratio: float = 0.8
    min_altitude: float = 0.02
    min_incircle: float = 0.01
    final_ratio: float = 0.75
    min_shared_edges: float = 0.2
    sigma_px: float = 0.3


AS_PRINTED = ZhangOptions(final_ratio=1.0, min_shared_edges=0.0)
"""Steps 2 to 5 alone, without our reading of step 6."""


def lowe_options(max_keypoints: int) -> KeypointOptions:
    """Step 1 as in Lowe 2004: his contrast threshold, plain descriptors, no spreading.

    His image has no limit on the number of keypoints; here the strongest stay.

    Parameters
    ----------
    max_keypoints : int
    """
    contrast = LOWE_CONTRAST * OCTAVE_LAYERS  # OpenCV divides its threshold by the layers
    return KeypointOptions(max_keypoints, contrast, contrast, _ONE_CELL, root=False)


def match_zhang2013(
    source: Keypoints, reference: Keypoints, options: ZhangOptions | None = None
) -> tuple[TiePoints, dict[str, int]]:
    """Steps 2 to 6 of the paper's method.

    Parameters
    ----------
    source, reference : Keypoints
        Step 1, by `lowe_options`.
    options : ZhangOptions, optional

    Returns
    -------
    tie_points : TiePoints
        All nearest-neighbour matches, in pixels of the keypoints' images, with the step that
        rejected each as their status.
    step_counts : dict of str to int
        Matches left after each step, in order.
    """
    options = options or ZhangOptions()
    steps: dict[str, _Step] = {
        "ratio": partial(reject_ambiguous, limit=options.ratio),
        "one_to_one": reject_duplicates,
        "not_collinear": partial(reject_collinear, min_altitude=options.min_altitude),
        "not_cocircular": partial(reject_cocircular, min_incircle=options.min_incircle),
        "final_ratio": partial(reject_ambiguous, limit=options.final_ratio),
        "corresponding": partial(reject_unshared, min_shared_edges=options.min_shared_edges),
    }
    return _after(steps, source, reference, options.sigma_px)


def match_sift(
    source: Keypoints, reference: Keypoints, options: ZhangOptions | None = None
) -> tuple[TiePoints, dict[str, int]]:
    """Step 2 alone: the paper's "traditional SIFT" (steps 1, 2 and 7).

    Parameters and results as for `match_zhang2013`.
    """
    options = options or ZhangOptions()
    steps: dict[str, _Step] = {"ratio": partial(reject_ambiguous, limit=options.ratio)}
    return _after(steps, source, reference, options.sigma_px)


def _after(
    steps: Mapping[str, _Step],
    source: Keypoints,
    reference: Keypoints,
    sigma_px: float,
) -> tuple[TiePoints, dict[str, int]]:
    """Nearest neighbours, and what each of the steps leaves of them."""
    matches = match_descriptors(source, reference)
    pairs = Pairs(*matches.xy(source, reference), matches.ratio)
    status = initial_status(pairs.ratio)
    counts = {"nearest": _kept(status)}
    for name, step in steps.items():
        status = step(pairs, status)
        counts[name] = _kept(status)
    points = TiePoints(
        source_px=pairs.source_xy,
        reference_px=pairs.reference_xy,
        covariance_px2=np.tile(sigma_px**2 * np.eye(2), (len(status), 1, 1)),
        score=1.0 - pairs.ratio,
        status=status,
        residual_px=np.full((len(status), 2), np.nan),
    )
    return points, counts


def initial_status(ratio: FloatArray) -> StatusArray:
    """Every match kept: (M,) uint8."""
    return np.full(len(ratio), Status.KEPT, dtype=np.uint8)


def reject_ambiguous(pairs: Pairs, status: StatusArray, limit: float) -> StatusArray:
    """Step 2, and again in our reading of step 6: the ratio test of Lowe 2004.

    Parameters
    ----------
    pairs : Pairs
    status : (M,) uint8
    limit : float
        Kept matches with a ratio of `limit` or more become `Status.RATIO`; 1 and more keep all.

    Returns
    -------
    (M,) uint8
    """
    ambiguous = np.zeros(len(status), np.bool_) if limit >= 1 else ~ratio_test(pairs.ratio, limit)
    return _rejected(status, ambiguous, Status.RATIO)


def reject_duplicates(pairs: Pairs, status: StatusArray) -> StatusArray:
    """Step 3: matches become one-to-one by pixel coordinates; the best ratio stays.

    Parameters and result as for `reject_ambiguous`; the others become `Status.DUPLICATE`.
    """
    kept = np.flatnonzero(status == Status.KEPT)
    duplicate = np.zeros(len(status), dtype=np.bool_)
    duplicate[kept] = ~one_to_one(*(part[kept] for part in pairs))
    return _rejected(status, duplicate, Status.DUPLICATE)


def triangulate_kept(xy: FloatArray, status: StatusArray) -> IntArray:
    """Step 4: Delaunay triangulation of the kept points of one image.

    Parameters
    ----------
    xy : (M, 2) float64
    status : (M,) uint8

    Returns
    -------
    (T, 3) intp
        Indices into `xy`.
    """
    kept = np.flatnonzero(status == Status.KEPT)
    return kept[delaunay(xy[kept])]


def reject_collinear(pairs: Pairs, status: StatusArray, min_altitude: float) -> StatusArray:
    """Step 5, first half: points that make three points collinear, in either triangulation.

    Of each flat triangle, from the flattest on, the corner of the worst descriptor ratio becomes
    `Status.COLLINEAR`, unless one of its corners has already gone.

    Parameters and result as for `reject_ambiguous`; `min_altitude` as in `ZhangOptions`.
    """
    groups, measures = [], []
    for xy in (pairs.source_xy, pairs.reference_xy):
        triangles = triangulate_kept(xy, status)
        groups.append(triangles)
        measures.append(relative_altitude(xy, triangles))
    gone = _worst_of_groups(
        np.concatenate(groups), np.concatenate(measures), min_altitude, pairs.ratio
    )
    return _rejected(status, gone, Status.COLLINEAR)


def reject_cocircular(pairs: Pairs, status: StatusArray, min_incircle: float) -> StatusArray:
    """Step 5, second half: points that make four points cocircular, in either triangulation.

    Of each such quadrilateral, from the most ambiguous on, the corner of the worst descriptor
    ratio becomes `Status.COCIRCULAR`, unless one of its corners has already gone.

    Parameters and result as for `reject_ambiguous`; `min_incircle` as in `ZhangOptions`.
    """
    groups, measures = [], []
    for xy in (pairs.source_xy, pairs.reference_xy):
        interior = interior_edges(triangulate_kept(xy, status))
        groups.append(np.concatenate([interior.ends, interior.opposite], axis=1))
        measures.append(incircle_sine(xy, interior))
    gone = _worst_of_groups(
        np.concatenate(groups), np.concatenate(measures), min_incircle, pairs.ratio
    )
    return _rejected(status, gone, Status.COCIRCULAR)


def reject_unshared(pairs: Pairs, status: StatusArray, min_shared_edges: float) -> StatusArray:
    """Step 6, our reading: points whose edges the triangulations do not share: `Status.TOPOLOGY`.

    A homologous pair has the same neighbours in both triangulations, but for neighbours that are
    mismatched themselves.

    Parameters and result as for `reject_ambiguous`; `min_shared_edges` as in `ZhangOptions`.
    """
    count = len(status)
    source_edges = _edge_keys(triangulate_kept(pairs.source_xy, status), count)
    reference_edges = _edge_keys(triangulate_kept(pairs.reference_xy, status), count)
    shared = _edges_per_point(np.intersect1d(source_edges, reference_edges), count)
    either = _edges_per_point(np.union1d(source_edges, reference_edges), count)
    unshared = (status == Status.KEPT) & (shared < min_shared_edges * either)
    return _rejected(status, unshared, Status.TOPOLOGY)


def _edge_keys(triangles: IntArray, count: int) -> IntArray:
    edge = edges(triangles)
    return np.asarray(edge[:, 0] * count + edge[:, 1], dtype=np.intp)


def _edges_per_point(keys: IntArray, count: int) -> IntArray:
    ends = np.concatenate([keys // max(count, 1), keys % max(count, 1)])
    return np.bincount(ends, minlength=count).astype(np.intp)


def _worst_of_groups(
    groups: IntArray, measures: FloatArray, limit: float, ratio: FloatArray
) -> BoolArray:
    """(M,) bool, the points to drop so that no group with a measure below `limit` stays whole."""
    gone = np.zeros(len(ratio), dtype=np.bool_)
    degenerate = np.flatnonzero(measures < limit)
    for group in groups[degenerate[np.argsort(measures[degenerate], kind="stable")]]:
        if not gone[group].any():
            gone[group[ratio[group].argmax()]] = True
    return gone


def _kept(status: StatusArray) -> int:
    return int((status == Status.KEPT).sum())


def _rejected(status: StatusArray, which: BoolArray, reason: Status) -> StatusArray:
    return np.where(which & (status == Status.KEPT), reason, status).astype(np.uint8)
