"""A map through points that a person answers for: the fit of `align_pair` without its search.

No image proves such points, so the gate is not asked; what they do not determine is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geodelreg.errors import PointsError
from geodelreg.fine.snap import snap_points
from geodelreg.fit.choice import Selection, select_for, select_one
from geodelreg.fit.estimate import Observations, minimum_points, student_weight
from geodelreg.fit.field import (
    FEWEST_POINTS,
    facets_of,
    fit_again,
    fit_field,
    form_of,
    selection_of,
)
from geodelreg.fit.jumps import cut_at_jumps
from geodelreg.fit.models import Frame, design
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.kriging import Kernel
from geodelreg.geo.maps.tin import TinMap
from geodelreg.judge.accuracy import measure_points
from geodelreg.judge.evidence import turn_and_scale
from geodelreg.judge.verdict import judge_motion, moves_pair, verdict
from geodelreg.judge.whole import largest_strain
from geodelreg.judge.words import warnings_of
from geodelreg.options import FOLLOWING, AlignOptions
from geodelreg.pair import LATTICE, Pair, Progress, make_pair, roles
from geodelreg.values.points import FitForm, GivenPoints, Status, TiePoints
from geodelreg.values.raster import BoolArray, FloatArray, IntArray, WindowReader
from geodelreg.values.result import Solution
from geodelreg.values.timings import Timings

_BY_EYE_PX = 0.5  # of the coarser raster: of a point that was placed by hand
_LEAST_PX = 0.05  # of MS, where no point says how sure it is: their spread tells the rest
_SAME_PX = 1e-3  # of MS: two points at one place
_LINE = 1e-3  # of the extent of the points: nearer to a line they fix no model of the plane
_DOUBTFUL_PX = 0.7  # of PAN, as the gate's
_MOST_SCALE = 2.0  # of pixels; no header is so wrong, but the points of another raster are
_FEWEST_AUTO = 2  # the shift
_NAMED = 10  # points at most in one message


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """What was fitted, and to which points."""

    selection: Selection
    used: BoolArray
    weight: FloatArray


def refit_pair(
    source: WindowReader,
    reference: WindowReader | None,
    given: GivenPoints,
    options: AlignOptions,
    snap: bool = False,
    progress: Progress | None = None,
    timings: Timings | None = None,
) -> tuple[Pair, Solution]:
    """Fit the model asked for to given points.

    Parameters
    ----------
    source : WindowReader
        MS.
    reference : WindowReader, optional
        PAN; without it lengths are in pixels of MS.
    given : GivenPoints
    options : AlignOptions
    snap : bool
        Measure the points that were placed by hand, by matching their surroundings with PAN.
    progress : callable, optional
    timings : Timings, optional

    Raises
    ------
    PointsError
        The points determine no such map, or are of another raster.
    """
    report = progress or (lambda fraction, step: None)
    pair = make_pair(source, reference or source, options, timings)
    report(0.1, "reading points")
    _check_places(pair, given, snap, with_pan=reference is not None)
    by_hand = given.enabled & given.by_hand
    notes: list[str] = []
    if snap and by_hand.any():
        report(0.2, "measuring")
        with pair.timings("snap"):
            given, notes = _snapped(pair, given, by_hand)
    report(0.6, "fitting")
    with pair.timings("fit"):
        points, used = _observations(pair, given)
        form = given.form if given.form and options.model in ("auto", given.form.model) else None
        _check_enough(given, points, form.model if form else options.model)
        fit = _fit(pair, given, points, used, form)
    report(1.0, "done")
    return pair, _conclude(pair, given, fit, notes, with_pan=reference is not None)


def _check_places(pair: Pair, given: GivenPoints, snap: bool, *, with_pan: bool) -> None:
    """Refuse points without a pixel, two at one place, and those of other rasters."""
    from scipy.spatial import cKDTree

    on = np.flatnonzero(given.enabled)
    if not len(on):
        raise PointsError(f"{given.file} has no enabled point", "Enable or add some.")
    drawn, placed = on[~given.placed[on]], on[given.placed[on]]
    if len(drawn) and not snap:
        raise PointsError(
            f"{given.file}: point {given.ids[drawn[0]]} lacks the pixel of MS, row and col",
            "Fill it in, or let it be looked for, with PAN and `snap=True`.",
        )
    at = given.source_px[placed]
    twice = cKDTree(at).query_pairs(_SAME_PX) if len(at) else set()
    if twice:
        one, other = (given.ids[placed[index]] for index in min(twice))
        raise PointsError(
            f"{given.file}: points {one} and {other} are at one place of MS",
            "Take one of them out, or disable it.",
        )
    height, width = pair.source.grid.shape
    inside = _within(at, (0, 0), (width, height))
    goal = given.target_px[on]
    if with_pan:
        name, shape = pair.reference.name, pair.reference.grid.shape
        near = _within(pair.header.forward(goal), (0, 0), shape[::-1])
    else:
        name = f"the surroundings of {pair.source.name}"
        near = _within(goal, (-width, -height), (2 * width, 2 * height))
    for good, where in ((inside, pair.source.name), (near, name)):
        if good.sum() < len(good) / 2:
            raise PointsError(
                f"{given.file}: {len(good) - good.sum()} of {len(good)} points lie outside "
                f"{where}: they are those of another raster",
                "Name the raster that the points were made for, with its original header.",
            )


def _within(at: FloatArray, low: tuple[int, int], high: tuple[int, int]) -> BoolArray:
    return np.asarray(((at >= low) & (at <= high)).all(axis=1))


def _observations(pair: Pair, given: GivenPoints) -> tuple[Observations, BoolArray]:
    """Enabled points whose pixel is known; what is placed by hand counts as far as an eye sees."""
    # what a fit found too far has the little weight that it had, until someone says otherwise
    far = (given.status == Status.RESIDUAL) & np.isfinite(given.weight)
    used = (given.enabled | far) & given.placed
    covariance, unknown = given.covariance_px2[used], given.by_hand[used]
    sigma_px = _LEAST_PX
    if not unknown.all():
        sigma_px = _BY_EYE_PX * max(1.0, 1.0 / pair.pan_px_per_source_px)
    covariance[unknown] = sigma_px**2 * np.eye(2)
    return Observations(given.source_px[used], given.target_px[used], covariance), used


def _check_enough(given: GivenPoints, points: Observations, model: str) -> None:
    """Refuse points that do not fix a model: too few, or on a line."""
    fewest = FEWEST_POINTS if model == "field" else _FEWEST_AUTO
    if model not in ("auto", "field"):
        fewest = minimum_points(model)
    if len(points) < fewest:
        raise PointsError(
            f"{given.file}: {len(points)} enabled points determine no {model} "
            f"(`model={model!r}` needs {fewest})",
            "Add or enable points, or take a simpler model.",
        )
    plane = "affine" if model in ("auto", *FOLLOWING) and len(points) > _FEWEST_AUTO + 1 else model
    if plane in ("auto", "shift"):
        return
    low, high = points.source.min(axis=0), points.source.max(axis=0)
    own = Frame(tuple(((low + high) / 2).tolist()), max(float((high - low).max()) / 2, _SAME_PX))
    columns = design(plane, points.source, own)[0].reshape(2 * len(points), -1)
    size = np.linalg.svd(columns, compute_uv=False)
    if size[-1] < _LINE * size[0]:
        raise PointsError(
            f"{given.file}: the {len(points)} enabled points lie on a line, which determines no "
            f"{plane}",
            "Add points beside it, or use `model='shift'`.",
        )


def _fit(
    pair: Pair, given: GivenPoints, points: Observations, used: BoolArray, form: FitForm | None
) -> _Fit:
    """The model asked for, or that of the points' own fit; what it stands on of the points used.

    Points keep the weights that they have from that fit, unless they were edited.
    """
    model = form.model if form else pair.options.model
    weight, frame = given.weight[used], Frame.of(pair)
    if model == "field":
        if form:
            kernel = Kernel(form.range_px, form.variance_px2, form.spread_px2)
            fit = fit_again(points, kernel, weight, form.jump_rows)
        else:
            fit = cut_at_jumps(points, fit_field(points))
        selection = selection_of(fit.field, fit.distance2[fit.inlier], frame)
        inlier, judged = fit.inlier, np.full(len(points), np.nan)
        judged[inlier] = fit.weight
    elif model == "tin":
        facets = facets_of(points.source, points.target, points.variances)
        selection = selection_of(facets, select_for(pair, points).estimate.distance2, frame)
        inlier, judged = np.ones(len(points), dtype=np.bool_), np.ones(len(points))
    else:
        selection = (
            select_one(model, points, frame, form.spread_px2, weight)
            if form
            else select_for(pair, points)
        )
        inlier = selection.estimate.inlier
        judged = student_weight(selection.estimate.distance2)
    lattice = np.concatenate([pair.source_lattice(LATTICE), points.source])
    turned = np.linalg.det(selection.estimate.map.linearise(lattice)[:, :, :2])
    if not (turned > 0).all():
        raise PointsError(
            f"{given.file}: the {selection.estimate.model} through the points folds or mirrors MS",
            "Look for points that were mixed up (`model='shift'` names the worst), or for columns "
            "that were exchanged.",
        )
    scale = turn_and_scale(pair, selection.estimate.map)[1]
    if pair.options.max_scale is None and scale > _MOST_SCALE:
        raise PointsError(
            f"{given.file}: by the points, pixels of {pair.source.name} are {scale:.3g} times as "
            "large or small as its header says: they are those of another raster",
            "Name the raster that the points were made for, or allow it with `max_scale`.",
        )
    kept, weights = used.copy(), np.full(len(given), np.nan)
    kept[used], weights[used] = inlier, np.where(np.isfinite(weight), weight, judged)
    return _Fit(selection, kept, weights)


def _conclude(
    pair: Pair, given: GivenPoints, fit: _Fit, notes: list[str], *, with_pan: bool
) -> Solution:
    correction, model = fit.selection.estimate.map, fit.selection.estimate.model
    points = _tie_points(pair, given, fit)
    accuracy = measure_points(roles(pair), points, fit.selection)
    strain = largest_strain(pair, correction) if isinstance(correction, FieldMap | TinMap) else 0.0
    shift_px = float(np.hypot(*pair.move_px(correction, pair.source_centre)[0]))
    reasons = judge_motion(shift_px, *turn_and_scale(pair, correction), strain, pair.options)
    names = {"enabled": int(given.enabled.sum()), "kept": accuracy.kept}
    return Solution(
        model=model,
        map=correction,
        tie_points=points,
        accuracy=accuracy,
        verdict=verdict(reasons, moves_pair(pair, correction)),
        step_counts={"points": len(given), **names},
        warnings=(
            *notes,
            *_warnings(given, points, accuracy.sigma_corner_px, with_pan),
            *warnings_of(pair, model, points, matched=False),
        ),
        search="points",
        form=form_of(fit.selection.estimate),
    )


def _tie_points(pair: Pair, given: GivenPoints, fit: _Fit) -> TiePoints:
    """All points as tie points between MS and PAN, with residuals under the map."""
    reference, covariance = pair.header.carry(given.target_px, given.covariance_px2)
    status = given.status.copy()
    known = given.placed
    status[given.enabled] = np.where(fit.used, Status.KEPT, Status.RESIDUAL)[given.enabled]
    status[given.enabled & ~known] = Status.CONVERGENCE
    there = pair.to_reference(fit.selection.estimate.map)
    residual = np.full(reference.shape, np.nan)
    residual[known] = there.forward(given.source_px[known]) - reference[known]
    return TiePoints(
        given.source_px, reference, covariance, given.score, status, residual, fit.weight
    )


def _warnings(given: GivenPoints, points: TiePoints, sigma_px: float, with_pan: bool) -> list[str]:
    unsure = given.enabled & given.by_hand
    notes = []
    if not with_pan:
        notes.append("without PAN, what is called PAN pixels are pixels of MS")
    if unsure.sum() == given.enabled.sum():
        notes.append("no point says how sure it is: all count the same")
    elif unsure.any():
        by_hand = "1 point was" if unsure.sum() == 1 else f"{unsure.sum()} points were"
        notes.append(
            f"{by_hand} placed by hand ({_listed(given, np.flatnonzero(unsure))}), which counts as "
            f"{_BY_EYE_PX:g} coarser px uncertain"
        )
    far = given.enabled & (points.status == Status.RESIDUAL)
    if far.any():
        lie = "1 enabled point lies" if far.sum() == 1 else f"{far.sum()} enabled points lie"
        notes.append(f"{lie} far from the fit: {_listed(given, np.flatnonzero(far))}")
    if sigma_px > _DOUBTFUL_PX:
        notes.append(f"at a corner the correction is uncertain by {sigma_px:.2g} PAN px")
    return notes


def _listed(given: GivenPoints, some: IntArray) -> str:
    names = [given.ids[index] for index in some]
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")


def _snapped(pair: Pair, given: GivenPoints, by_hand: BoolArray) -> tuple[GivenPoints, list[str]]:
    """The points, those placed by hand measured where PAN shows what MS does."""
    others = replace(given, enabled=given.enabled & ~by_hand)
    points, _ = _observations(pair, others)
    if len(points) < _FEWEST_AUTO:
        points, _ = _observations(pair, given)
    if len(points) < _FEWEST_AUTO:
        raise PointsError(
            f"{given.file}: points that were drawn are looked for from where others lie, and "
            f"{len(points)} others are known",
            "Fill in row and col of two points or more.",
        )
    start = select_for(replace(pair, options=replace(pair.options, model="auto")), points)
    chosen = np.flatnonzero(by_hand)
    found, correlation = snap_points(
        roles(pair), given.source_px[chosen], given.target_px[chosen], start.estimate.map
    )
    good = np.isfinite(found.source).all(axis=1)
    hit = chosen[good]
    source, target = given.source_px.copy(), given.target_px.copy()
    covariance, score = given.covariance_px2.copy(), given.score.copy()
    source[hit], target[hit] = found.source[good], found.target[good]
    covariance[hit], score[hit] = found.covariance[good], correlation[good]
    measured = replace(
        given, source_px=source, target_px=target, covariance_px2=covariance, score=score
    )
    notes = [f"{len(hit)} of {len(chosen)} points placed by hand were measured on PAN"]
    if not good.all():
        missed = _listed(given, chosen[~good])
        notes[0] += f"; not {missed}, whose surroundings do not match"
    return measured, notes
