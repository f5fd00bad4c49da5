"""Traditional SIFT, the paper's method and geodelreg's on one pair, measured by its truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import process_time

import cv2
import numpy as np
from affine import Affine

from benchmarks.scenes.truth import Truth, grid_rmse
from geodelreg.align_pair import align_pair
from geodelreg.coarse.descriptors import match_descriptors, one_to_one
from geodelreg.coarse.scopes import read_overview
from geodelreg.errors import GeodelregError
from geodelreg.fine.looks import mean_band
from geodelreg.fine.overlay import overlay
from geodelreg.fine.passes import COARSE_SIGMA
from geodelreg.fine.surface import make_surface
from geodelreg.fine.tiles import overview_tile
from geodelreg.fine.tuning import surface_sigma
from geodelreg.fit.consensus import consensus
from geodelreg.fit.delaunay_mesh import filter_matches
from geodelreg.fit.estimate import Observations, minimum_points
from geodelreg.fit.models import Frame
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.judge.accuracy import grey_rmse
from geodelreg.options import AlignOptions
from geodelreg.pair import Pair, make_pair, roles
from geodelreg.paper.baseline import grey_keypoints, least_squares, paper_scopes
from geodelreg.paper.zhang2013 import (
    Pairs,
    ZhangOptions,
    initial_status,
    reject_ambiguous,
    reject_cocircular,
    reject_collinear,
    reject_duplicates,
    reject_unshared,
)
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Overview, Status
from geodelreg.values.raster import BoolArray, FloatArray, StatusArray, WindowReader

LOOSE_PX = 8.0
"""Tolerance of the consensus before the mesh: noise and distortion together."""
RIGHT_PX = 1.0
"""A match is right within this many coarser pixels of the truth: three standard deviations of a
SIFT position, and less than a cloud's parallax in the scenes."""
Step = Callable[[Pairs, StatusArray], StatusArray]
PAPER = ZhangOptions()
STEPS: dict[str, Step] = {
    "3 one-to-one": reject_duplicates,
    "5 collinear": partial(reject_collinear, min_altitude=PAPER.min_altitude),
    "5 cocircular": partial(reject_cocircular, min_incircle=PAPER.min_incircle),
    "6 second ratio": partial(reject_ambiguous, limit=PAPER.final_ratio),
    "6 shared edges": partial(reject_unshared, min_shared_edges=PAPER.min_shared_edges),
}
"""The paper's steps after the ratio test, in the order of `match_zhang2013`; 6 is our reading."""
SIFT, PRINTED, READ, MESH, OURS = (
    "traditional SIFT", "paper as printed", "paper with our step 6", "our filter", "ours",
)  # fmt: skip
METHODS = (SIFT, PRINTED, READ, MESH, OURS)
STEPS_OF = {
    SIFT: (),
    PRINTED: tuple(name for name in STEPS if not name.startswith("6")),
    READ: tuple(STEPS),
}
GATED = {SIFT: "sift", READ: "zhang2013", OURS: "delaunay"}


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """A pair, opened and read, with its truth.

    Attributes
    ----------
    pair : Pair
    images : Overview
        At the coarser ground sampling distance, as the paper's methods read them.
    truth : Truth
    """

    pair: Pair
    images: Overview
    truth: Truth

    @property
    def true_map(self) -> PixelMap:
        """MS pixels to MS header pixels, as it should be."""
        return AffineMap(~Affine(*self.truth.ms_header) @ Affine(*self.truth.ms_true))


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Matches of step 2 before the ratio test, in the working images and in full rasters.

    Attributes
    ----------
    source_xy, reference_xy : (M, 2) float64
        Pixels of the working images.
    ratio : (M,) float64
    source_px, reference_px : (M, 2) float64
        The same places in MS and in PAN pixels.
    right : (M,) bool
        Within `RIGHT_PX` of the truth.
    error_px : (M,) float64
        Distance from the truth in coarser pixels.
    """

    source_xy: FloatArray
    reference_xy: FloatArray
    ratio: FloatArray
    source_px: FloatArray
    reference_px: FloatArray
    right: BoolArray
    error_px: FloatArray


@dataclass(frozen=True, slots=True)
class Score:
    """What one method found on one pair.

    Attributes
    ----------
    steps : dict of str to int
        Points after each step.
    kept, right : int
        Points that the fit used, and how many of them are right.
    within_half, within_two : int
        As `right`, within half and within two coarser pixels.
    control_rmse_px : float
        Residual of the fit at its own points, PAN px: the paper's RMSE.
    true_rmse_px : float
        Error over 21 × 21 points, PAN px.
    e1 : float
        The paper's E1, DN of PAN.
    cpu_s : float
        CPU seconds of reading, matching and fitting.
    outcome : str
        The gate's verdict on the method of this name; "" when it was not asked.
    accepted_rmse_px : float
        Error of the correction that was accepted; NaN when none was.
    """

    steps: dict[str, int]
    kept: int
    right: int
    within_half: int
    within_two: int
    control_rmse_px: float
    true_rmse_px: float
    e1: float
    cpu_s: float
    outcome: str = ""
    accepted_rmse_px: float = math.nan


def set_stage(source: WindowReader, reference: WindowReader, truth: Truth) -> Stage:
    """Read the pair as ``--method zhang2013`` does."""
    pair = make_pair(source, reference, AlignOptions())
    return Stage(pair, read_overview(pair, next(paper_scopes(pair))), truth)


def match_plainly(stage: Stage) -> tuple[Matched, dict[str, int]]:
    """Steps 1 and 2 up to the nearest descriptor, as ``--method zhang2013`` does them.

    Returns
    -------
    Matched
    dict of str to int
        Keypoints of both images.
    """
    images, pair = stage.images, stage.pair
    source, reference = grey_keypoints(images)
    matches = match_descriptors(source, reference)
    source_xy, reference_xy = matches.xy(source, reference)
    to_source = ~pair.source.grid.transform @ images.source[0].grid.transform
    to_reference = ~pair.reference.grid.transform @ images.reference.grid.transform
    source_px = apply_affine(to_source, source_xy)
    reference_px = apply_affine(to_reference, reference_xy)
    error = _error_px(stage, source_px, reference_px)
    matched = Matched(
        source_xy, reference_xy, matches.ratio, source_px, reference_px, error <= RIGHT_PX, error
    )
    return matched, {"keypoints MS": len(source), "keypoints PAN": len(reference)}


def _error_px(stage: Stage, source_px: FloatArray, reference_px: FloatArray) -> FloatArray:
    """(M,) distance from the truth in pixels of the coarser image."""
    pair = stage.pair
    gap = pair.to_reference(stage.true_map).forward(source_px) - reference_px
    return np.asarray(np.hypot(gap[:, 0], gap[:, 1]) / max(pair.pan_px_per_source_px, 1.0))


def run_steps(matched: Matched, names: Sequence[str]) -> tuple[StatusArray, dict[str, int]]:
    """The ratio test and then some of the paper's steps, in the paper's order.

    Parameters
    ----------
    matched : Matched
    names : sequence of str
        Keys of `STEPS`; their order is that of `STEPS`, whatever it is here.

    Returns
    -------
    status : (M,) uint8
    counts : dict of str to int
        Points left after each step.
    """
    pairs = Pairs(matched.source_xy, matched.reference_xy, matched.ratio)
    status = reject_ambiguous(pairs, initial_status(matched.ratio), PAPER.ratio)
    counts = {"2 ratio": int((status == Status.KEPT).sum())}
    for name, step in STEPS.items():
        if name in names:
            status = step(pairs, status)
            counts[name] = int((status == Status.KEPT).sum())
    return status, counts


def run_mesh(matched: Matched) -> tuple[BoolArray, dict[str, int]]:
    """Step 3, then geodelreg's mismatch filter in the place of the paper's steps 4 to 6."""
    status, counts = run_steps(matched, ["3 one-to-one"])
    kept = np.flatnonzero(status == Status.KEPT)
    points = matched.source_xy[kept], matched.reference_xy[kept]
    mesh = filter_matches(*points, consensus(*points, LOOSE_PX))
    chosen = np.zeros(len(status), dtype=np.bool_)
    chosen[kept[mesh == Status.KEPT]] = True
    return chosen, counts | {"our filter": int(chosen.sum())}


def fit_plainly(stage: Stage, matched: Matched, kept: BoolArray) -> PixelMap | None:
    """Step 7: least-squares affine, MS pixels to header pixels; None of too few points."""
    if kept.sum() < minimum_points("affine"):
        return None
    points = _observations(stage, matched, kept)
    return least_squares("affine", points, Frame.of(stage.pair)).map


def fit_robustly(stage: Stage, matched: Matched, kept: BoolArray) -> PixelMap | None:
    """An affine by OpenCV's USAC MAGSAC instead of step 7, at one coarser pixel."""
    if kept.sum() < minimum_points("affine"):
        return None
    points = _observations(stage, matched, kept)
    ratio = stage.pair.pan_px_per_source_px
    matrix, _ = cv2.estimateAffine2D(
        points.source, points.target, method=cv2.USAC_MAGSAC,
        ransacReprojThreshold=RIGHT_PX * max(ratio, 1.0) / ratio, maxIters=20_000,
        confidence=0.9999,
    )  # fmt: skip
    return None if matrix is None else AffineMap.of(np.asarray(matrix, np.float64))


def _observations(stage: Stage, matched: Matched, kept: BoolArray) -> Observations:
    reference = matched.reference_px[kept]
    equal = np.tile(np.eye(2), (len(reference), 1, 1))
    target, covariance = Inverse(stage.pair.header).carry(reference, equal)
    return Observations(matched.source_px[kept], target, covariance)


def true_rmse(stage: Stage, correction: PixelMap | None) -> float:
    """Error of a correction over 21 × 21 points of the MS raster, PAN px."""
    affine = None if correction is None else correction.as_affine()
    if affine is None:
        return math.nan
    corrected = Affine(*stage.truth.ms_header) @ affine
    return grid_rmse(corrected, stage.truth)["rmse_px"]


def grey_error(stage: Stage, correction: PixelMap | None) -> float:
    """E1 of the mean of the visible bands against low-passed PAN under a correction, DN of PAN."""
    if correction is None:
        return math.nan
    part = roles(stage.pair)
    tile = overview_tile(part, stage.images)
    ms = mean_band(stage.images.source[:3])
    template, finer = ms, stage.images.reference
    if not part.ms_is_template:
        template, finer = finer, template
    surface = make_surface(finer, part.surface.grid, surface_sigma(part, tile, COARSE_SIGMA))
    return grey_rmse(overlay(part, template, surface, correction), part.ms_is_template)


def score_keypoints(
    stage: Stage, matched: Matched, kept: BoolArray, steps: dict[str, int], cpu_s: float
) -> Score:
    """Figures of a method that ends in plain least squares on keypoints.

    Parameters
    ----------
    stage : Stage
    matched : Matched
    kept : (M,) bool
    steps : dict of str to int
    cpu_s : float
        Of everything before the fit.
    """
    start = process_time()
    correction = fit_plainly(stage, matched, kept)
    cpu_s += process_time() - start
    control = math.nan
    if correction is not None:
        there = stage.pair.to_reference(correction).forward(matched.source_px[kept])
        control = float(np.sqrt(((there - matched.reference_px[kept]) ** 2).sum(axis=1).mean()))
    return Score(
        steps, *_counts(matched.error_px[kept]), control, true_rmse(stage, correction),
        grey_error(stage, correction), cpu_s,
    )  # fmt: skip


def _counts(error_px: FloatArray) -> tuple[int, int, int, int]:
    """How many there are, and how many lie within one, half and two coarser pixels."""
    within = [int((error_px <= limit * RIGHT_PX).sum()) for limit in (1.0, 0.5, 2.0)]
    return len(error_px), within[0], within[1], within[2]


def score_ours(stage: Stage) -> Score:
    """Figures of the library's default, with its gate's verdict, whatever that is."""
    start = process_time()
    try:
        _, solution = align_pair(stage.pair.source, stage.pair.reference, AlignOptions())
    except GeodelregError as error:
        lost = (math.nan, math.nan, math.nan, process_time() - start)
        return Score({}, 0, 0, 0, 0, *lost, outcome=type(error).__name__)
    cpu_s = process_time() - start
    points = solution.tie_points
    off_px = _error_px(stage, points.source_px[points.kept], points.reference_px[points.kept])
    correction = solution.map if points.kept.any() else None
    rmse = true_rmse(stage, correction)
    return Score(
        dict(solution.step_counts), *_counts(off_px), solution.accuracy.fit_rmse_px, rmse,
        grey_error(stage, correction), cpu_s, solution.verdict.outcome.value,
        rmse if solution.verdict.accepted else math.nan,
    )  # fmt: skip


def corrections(stage: Stage) -> dict[str, PixelMap | None]:
    """What each method but `MESH` finds on a pair, refused or not; None where nothing."""
    matched, _ = match_plainly(stage)
    found = {
        method: fit_plainly(stage, matched, run_steps(matched, steps)[0] == Status.KEPT)
        for method, steps in STEPS_OF.items()
    }
    _, solution = align_pair(stage.pair.source, stage.pair.reference, AlignOptions())
    return {**found, OURS: solution.map if len(solution.tie_points) else None}


def gate_on(stage: Stage, method: str) -> tuple[str, float]:
    """The gate's verdict on a method of the library, and the error of what it accepted."""
    options = AlignOptions(method=GATED[method])
    try:
        _, solution = align_pair(stage.pair.source, stage.pair.reference, options)
    except GeodelregError as error:
        return type(error).__name__, math.nan
    accepted = solution.verdict.accepted
    rmse = true_rmse(stage, solution.map) if accepted else math.nan
    return solution.verdict.outcome.value, rmse


def distinct_right(matched: Matched, kept: BoolArray) -> int:
    """Right matches among `kept`, each pair of places counted once."""
    chosen = np.flatnonzero(kept & matched.right)
    single = one_to_one(
        matched.source_xy[chosen], matched.reference_xy[chosen], matched.ratio[chosen]
    )
    return int(single.sum())
