"""The whole method on one page: it asks readers for windows, opens no file and prints nothing."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from geodelreg.errors import NoDataError, NoOverlapError
from geodelreg.fit.gate import keypoints_apart, verdict
from geodelreg.fit.models import IDENTITY
from geodelreg.geo.affine import affine_from_matrix
from geodelreg.match.area import best_shift
from geodelreg.match.surface import make_surface
from geodelreg.options import AlignOptions
from geodelreg.pipeline.advice import warnings_of
from geodelreg.pipeline.baseline import PaperFit, paper_fits, paper_scopes, solve_baseline
from geodelreg.pipeline.evidence import overlay
from geodelreg.pipeline.search import (
    SURE_LOG_NFA,
    WHOLE,
    Hypothesis,
    WorkingPair,
    keypoint_hypotheses,
    mean_band,
    read_working_pair,
    scopes,
)
from geodelreg.pipeline.solve import Solution, solve, unsolved
from geodelreg.pipeline.state import Pair, Progress, make_pair
from geodelreg.pipeline.tiles import roles
from geodelreg.types import Band, Correction, FloatArray, Outcome, WindowReader

logger = logging.getLogger(__name__)

_FAIR_SHARE = 0.5


class Claim(NamedTuple):
    """What is remembered of a hypothesis that was refused: not its images.

    Attributes
    ----------
    matrix : (2, 3) float64
        MS pixels to MS header pixels.
    log_nfa : float
    """

    matrix: FloatArray
    log_nfa: float


def register(
    source: WindowReader,
    reference: WindowReader,
    options: AlignOptions,
    progress: Progress | None = None,
) -> tuple[Pair, Solution]:
    """Find the correction of the source's header, with its evidence.

    Hypotheses come from keypoints, coarse first, then from area correlation around the header; each
    is refined and judged, and the first that the evidence supports is taken.  Fits of the paper's
    methods are judged as they are.

    Parameters
    ----------
    source, reference : WindowReader
        MS and PAN.
    options : AlignOptions
    progress : callable, optional
        Called with a fraction 0 to 1 and the name of the step.

    Returns
    -------
    pair : Pair
    solution : Solution
        Its verdict may be a refusal.

    Raises
    ------
    NoOverlapError
        When headers and contents share no ground.
    NoDataError
        When a band has no texture where it matters.
    """
    report = progress or (lambda fraction, step: None)
    pair = make_pair(source, reference, options)
    start = perf_counter()
    refused: Solution | None = None
    heard: list[Claim] = []
    looked = 0.0
    report(0.02, "reading")
    for seen, hypothesis in hypotheses(pair):
        report(0.4 + looked / 4, "refining")
        found = perf_counter() - start
        if affine_from_matrix(hypothesis.matrix).is_degenerate:
            continue  # of headers that squeeze the ground to a line
        if isinstance(hypothesis, PaperFit):
            solution = solve_baseline(seen, hypothesis)
        else:
            solution = solve(seen, hypothesis)
        if solution is not None:
            read_s = hypothesis.pair.read_s
            solution = _finish(seen, solution, {"read": read_s, "search": found - read_s})
            solution = heeding(seen, solution, hypothesis, heard)
            if solution.verdict.accepted:
                report(1.0, "done")
                return seen, solution
            refused = _better(refused, solution)
        heard.append(Claim(hypothesis.matrix, hypothesis.log_nfa))
        looked = (1.0 + looked) / 2
    report(1.0, "refused")
    if refused is None:
        refused = _nothing_found(pair)
    return pair, refused


def hypotheses(pair: Pair) -> Iterator[tuple[Pair, Hypothesis]]:
    """First guesses, the most likely first; later ones are only computed when needed.

    The paper's methods make none: theirs are finished fits.

    Yields
    ------
    pair : Pair
        With the MS bands that show something where the guess was made.
    hypothesis : Hypothesis
    """
    by_area: list[tuple[Pair, WorkingPair]] = []
    empty: NoDataError | None = None
    read_s = 0.0
    is_paper = pair.options.method != "delaunay"
    for scope in paper_scopes(pair) if is_paper else scopes(pair):
        seen, images = _with_content(pair, read_working_pair(pair, scope, read_s))
        read_s = images.read_s
        empty = _emptiness(pair, images)
        if empty is not None:
            continue
        if not by_area:
            by_area.append((seen, images))
        for hypothesis in (paper_fits if is_paper else keypoint_hypotheses)(seen, images):
            yield seen, hypothesis
    for seen, images in [] if is_paper else by_area:
        yield seen, area_hypothesis(seen, images)
    if empty is not None and not by_area:
        raise empty


def _with_content(pair: Pair, images: WorkingPair) -> tuple[Pair, WorkingPair]:
    """Without the MS bands that show much less than others: only common pixels are matched."""
    shown = [int(band.valid.sum()) if _has_content(band) else 0 for band in images.source]
    keep = [number for number, count in enumerate(shown) if count > _FAIR_SHARE * max(shown)]
    if not keep or len(keep) == len(shown):
        return pair, images
    bands = tuple(pair.source_bands[number] for number in keep)
    source = [images.source[number] for number in keep]
    return replace(pair, source_bands=bands), replace(images, source=source)


def _has_content(band: Band) -> bool:
    values = band.data[band.valid]
    return bool(values.size and values.min() < values.max())


def _emptiness(pair: Pair, images: WorkingPair) -> NoDataError | None:
    for band in (images.source[0], images.reference):
        if not _has_content(band):
            values = band.data[band.valid]
            what = f"the constant value {values[0]:g}" if values.size else "no valid pixel"
            reader = pair.reference if band is images.reference else pair.source
            return NoDataError(
                f"{reader.name}: {band.name} has {what} where the rasters overlap",
                "Choose another band, or check the no-data value and the mask.",
            )
    return None


def area_hypothesis(pair: Pair, images: WorkingPair) -> Hypothesis:
    """The shift at which edges correlate best, for pairs whose keypoints do not match."""
    part = roles(pair)
    ms = mean_band(images.source)
    template, finer = (ms, images.reference) if part.ms_is_template() else (images.reference, ms)
    surface = make_surface(finer, part.surface.grid, (0.5, 0.5))
    view = overlay(part, template, surface, IDENTITY)
    shift = best_shift(view)
    step = ~part.template.grid.transform @ template.grid.transform
    moved = np.array([[0.0, 0.0]]) + shift * np.array([step.a, step.e])
    matrix = IDENTITY.copy()
    if part.ms_is_template():
        matrix[:, 2] = moved[0]
    else:
        # template pixel x shows what the surface has at x + shift: carry that to MS pixels
        ends = part.to_surface(IDENTITY, np.stack([moved[0], np.zeros(2)]))
        matrix[:, 2] = ends[1] - ends[0]
    return Hypothesis(matrix, float("nan"), {}, images)


def _finish(pair: Pair, solution: Solution, found_s: dict[str, float]) -> Solution:
    return replace(
        solution,
        warnings=solution.warnings + warnings_of(pair, solution),
        timings_s={**found_s, **solution.timings_s},
    )


def heeding(pair: Pair, solution: Solution, hypothesis: Hypothesis, heard: list[Claim]) -> Solution:
    """The solution, judged also by keypoints that agree with more certainty than its own.

    They were refused, where too little is in sight or clouds are about; that makes a place which
    fewer keypoints, or none, speak for no better.
    """
    points = solution.tie_points.source_px[solution.tie_points.kept]
    here = pair.to_reference(solution.transformation.matrix, points)
    unit = max(pair.pan_px_per_source_px, 1.0)
    apart = [
        float(np.median(np.hypot(*(here - pair.to_reference(other.matrix, points)).T))) / unit
        for other in heard
        if len(points) and other.log_nfa < SURE_LOG_NFA and not hypothesis.log_nfa < other.log_nfa
    ]
    reasons = (*solution.verdict.reasons, keypoints_apart(max(apart, default=0.0)))
    moves = solution.verdict.outcome is Outcome.ALIGNED
    return replace(solution, verdict=verdict(reasons, moves))


def _better(one: Solution | None, other: Solution) -> Solution:
    """Of two refused solutions the one that passed more of the gate, for the report."""
    if one is None:
        return other
    passed = [sum(reason.passed for reason in s.verdict.reasons) for s in (one, other)]
    return other if passed[1] > passed[0] else one


def _nothing_found(pair: Pair) -> Solution:
    """The refusal when not even a hypothesis could be refined.

    Raises
    ------
    NoOverlapError
        When the headers do not overlap either.
    """
    if next(scopes(pair)).name == WHOLE:
        raise NoOverlapError(
            f"{pair.source.name} and {pair.reference.name} do not overlap by their headers, and "
            "their contents do not match",
            "Check that both show the same ground and that CRSs and geotransforms are right.",
        )
    return unsolved()


def correction_of(pair: Pair, solution: Solution) -> Correction:
    """The correction to write: of an unbelieved or needless one, the header as it is."""
    original = pair.source.grid.transform
    moves = solution.verdict.outcome.value == "aligned"
    corrected = original @ affine_from_matrix(solution.transformation.matrix) if moves else original
    model = solution.transformation.model if moves else "none"
    return Correction(model, pair.source.grid.crs_wkt, original, corrected)
