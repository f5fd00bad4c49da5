"""Fitting a field: kernel by restricted likelihood, points judged by what the others predict.

Range, amplitudes and nugget maximise the restricted likelihood of the patches (Patterson & Thompson
1971, doi:10.1093/biomet/58.3.545; Rasmussen & Williams 2006, chapters 2 and 5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geodelreg.fit.choice import FOLDS, Selection, fold_numbers, spatial_blocks
from geodelreg.fit.estimate import REJECT_D2, Estimate, Observations, student_weight
from geodelreg.fit.models import Frame
from geodelreg.geo.maps.field import FieldMap
from geodelreg.geo.maps.kriging import Kernel, distances, solve_axis
from geodelreg.geo.maps.tin import TinMap
from geodelreg.values.points import FitForm
from geodelreg.values.raster import BoolArray, FloatArray, IntArray

FEWEST_POINTS = 12
"""Twice the parameters of the trend of both axes: fewer leave nothing to tell noise by."""
MOST_STRAIN = 0.04
"""Of a field that is believed: relief seen at 20° bends by less, a fold by much more."""
_ROUNDS = 3
_TUNING_POINTS = 160  # by hand: ½ to 2 × alike
_LEAST_VARIANCE_PX2 = 1e-8  # by hand: ½ to 2 × alike
_IMPOSSIBLE = 1e12  # by hand: ½ to 2 × alike
_LEAST_NUGGET_PX2 = 1e-7  # by hand: ½ to 2 × alike
_STEPS = 20  # by hand: ½ to 2 × alike
_CLOSE = 1e-5  # relative: a hundredth of the likelihood that one unit of a kernel is worth
_DIGITS = 2  # of the logarithms of a kernel: a percent, far below what points tell of it


Follower = FieldMap | TinMap
"""Maps through points that follow what bends."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldFit:
    """A field with what became of each point.

    Attributes
    ----------
    field : FieldMap
        Standing on the points that the others predict well enough.
    weight : (K,) float64
        Student weights of those points.
    inlier : (N,) bool
        Which of all points they are.
    distance2 : (N,) float64
        Squared distance of each point from what the others predict, in variances; 2 on average.
    """

    field: FieldMap
    weight: FloatArray
    inlier: BoolArray
    distance2: FloatArray


def fit_field(
    points: Observations, start: Kernel | None = None, jumps: tuple[float, ...] = ()
) -> FieldFit:
    """Fit a field robustly: points are judged by what the others predict where they are.

    Parameters
    ----------
    points : Observations
    start : Kernel, optional
        Of a fit to nearly the same points; saves time.
    jumps : tuple of float
        Rows at which the images are cut; points at just these are on neither side, and left out.

    Raises
    ------
    ValueError
        With fewer than `FEWEST_POINTS` points, or points on a line.
    """
    if not determine_field(points):
        raise ValueError(f"{len(points)} points, or points on a line, cannot determine a field")
    inlier, weight = ~np.isin(points.source[:, 1], jumps), np.ones(len(points))
    distance2 = np.where(inlier, 0.0, np.inf)
    kernel = start or _first_guess(points)
    for number in range(_ROUNDS):
        kept = points.take(inlier)
        if number == 0 or start is None:
            kernel = tuned(kept, kernel, weight[inlier], jumps).kernel
        field = field_of(kept, kernel, weight[inlier], jumps)
        distance2[inlier] = _unlike(field, kept)
        enough = distance2 <= REJECT_D2
        if number and enough[inlier].all():  # another round would hardly change the weights
            return FieldFit(field, weight[inlier], inlier, distance2)
        weight = student_weight(distance2)
        if (inlier & enough).sum() < FEWEST_POINTS:
            break
        inlier = inlier & enough
    field = field_of(points.take(inlier), kernel, weight[inlier], jumps)
    return FieldFit(field, weight[inlier], inlier, distance2)


def determine_field(points: Observations) -> bool:
    """True of points that are enough for a field, and do not lie on a line of pixels."""
    return len(points) >= FEWEST_POINTS and bool(np.ptp(points.source, axis=0).min() > 0)


def fit_again(
    points: Observations, kernel: Kernel, weight: FloatArray, jumps: tuple[float, ...]
) -> FieldFit:
    """The fit that gave points their weights, with others beside them.

    Parameters
    ----------
    points : Observations
    kernel : Kernel
    weight : (N,) float64
        NaN of the others: they are judged by what all predict.
    jumps : tuple of float
    """
    before, weight = np.isfinite(weight), np.where(np.isfinite(weight), weight, 1.0)
    field = field_of(points, kernel, weight, jumps)
    distance2 = _unlike(field, points)
    inlier = before | (distance2 <= REJECT_D2)
    if not inlier.all():
        field = field_of(points.take(inlier), kernel, weight[inlier], jumps)
    return FieldFit(field, weight[inlier], inlier, distance2)


def _unlike(field: FieldMap, points: Observations) -> FloatArray:
    """(N,) squared distance of a field's points from what the others predict, in variances."""
    residual, variance = field.left_out()
    own = points.variances + field.kernel.nugget_px2
    return np.asarray((residual**2 / (variance + own)).sum(axis=1))


def form_of(estimate: Estimate) -> FitForm:
    """What a fit has beside its points."""
    field = estimate.map
    if not isinstance(field, FieldMap):
        return FitForm(estimate.model, estimate.extra_variance_px2)
    kernel = field.kernel
    return FitForm(
        estimate.model, kernel.nugget_px2, kernel.range_px, kernel.variance_px2, field.jumps
    )


def field_of(
    points: Observations, kernel: Kernel, weight: FloatArray, jumps: tuple[float, ...] = ()
) -> FieldMap:
    """The field through points whose noise is divided by (N,) weights."""
    own = points.variances + kernel.nugget_px2
    return FieldMap(points.source, points.target, own / weight[:, None], kernel, jumps)


def tuned(
    points: Observations, kernel: Kernel, weight: FloatArray, jumps: tuple[float, ...] = ()
) -> FieldMap:
    """The field of greatest restricted likelihood on some hundred of the points.

    Parameters
    ----------
    points : Observations
    kernel : Kernel
        The first guess.
    weight : (N,) float64
    jumps : tuple of float
    """
    from scipy.optimize import minimize

    mixed: IntArray = np.random.default_rng(len(points)).permutation(len(points))
    some = np.sort(mixed[:_TUNING_POINTS])
    points, weight = points.take(some), weight[some]
    first = field_of(points, kernel, weight, jumps)
    extent = float(np.ptp(points.source, axis=0).max())
    columns, apart = first.columns(points.source), distances(points.source, points.source)
    together = first.correlation(points.source, points.source) > 0 if jumps else None
    move = points.target - points.source
    own = points.variances

    def kernel_of(theta: FloatArray) -> Kernel:
        range_px, one, other, nugget = (float(value) for value in np.exp(theta))
        return Kernel(range_px, (one, other), nugget)

    def cost(theta: FloatArray) -> tuple[float, FloatArray]:
        """And its derivatives; of an axis by each part of its covariance (Rasmussen, 5.9)."""
        trial = kernel_of(theta)
        correlation, growth = trial.correlation(apart), trial.growth(apart)
        if together is not None:
            correlation, growth = correlation * together, growth * together
        noise = (own + trial.nugget_px2) / weight[:, None]
        total, slope = 0.0, np.zeros(4)
        try:
            for i, variance in enumerate(trial.variance_px2):
                axis = solve_axis(columns, correlation, move[:, i], noise[:, i], variance)
                total += axis.cost()
                spread, grow, noisy = axis.rates(growth, correlation, 1 / weight)
                slope[[0, 1 + i, 3]] += variance * spread, variance * grow, trial.nugget_px2 * noisy
        except np.linalg.LinAlgError:
            return _IMPOSSIBLE, np.zeros(4)
        return total, slope

    most = (MOST_STRAIN * extent) ** 2
    low = np.log([spacing(points), *3 * [_LEAST_VARIANCE_PX2]])
    high = np.log([max(extent, 2 * spacing(points)), most, most, most])
    start = np.log([kernel.range_px, *kernel.variance_px2, kernel.nugget_px2])
    found = minimize(
        cost, np.clip(start, low, high), jac=True,
        method="L-BFGS-B", bounds=list(zip(low, high, strict=True)),
        options={"maxiter": _STEPS, "ftol": _CLOSE},
    )  # fmt: skip
    return field_of(points, kernel_of(np.round(found.x, _DIGITS)), weight, jumps)


def _first_guess(points: Observations) -> Kernel:
    spacing_px = spacing(points)
    move = points.target - points.source
    columns = np.column_stack([points.source, np.ones(len(points))])
    left = move - columns @ np.linalg.lstsq(columns, move, rcond=None)[0]
    variance = np.maximum(left.var(axis=0), _LEAST_VARIANCE_PX2)
    noise = float(np.median(points.variances.sum(axis=1))) / 2
    return Kernel(
        4 * spacing_px, (float(variance[0]), float(variance[1])), max(noise, _LEAST_NUGGET_PX2)
    )


def spacing(points: Observations) -> float:
    """Mean distance of neighbours, source pixels, if the points fill their extent."""
    extent = np.ptp(points.source, axis=0)
    return float(np.sqrt(extent[0] * extent[1] / len(points)))


def facets_of(source: FloatArray, target: FloatArray, noise_px2: FloatArray) -> TinMap:
    """Facets through points, as uncertain as each is for a mesh without it.

    Parameters
    ----------
    source, target : (N, 2) float64
    noise_px2 : (N, 2) float64
        Of the points alone, which knows nothing of what bends within a facet.
    """
    plain = TinMap(source, target, noise_px2)
    error2 = held_out_errors(plain) ** 2
    known = np.isfinite(error2).all(axis=1)
    more = error2[known].mean(axis=0) if known.any() else 0.0
    return replace(plain, noise_px2=noise_px2 + more)


def held_out_errors(field: Follower) -> FloatArray:
    """(N, 2) errors of the field at its points, each predicted without all of its block.

    NaN where too few points are left.  The kernel is that of all points: four numbers of hundreds.
    """
    folds = fold_numbers(field.source)
    error = np.full((len(folds), 2), np.nan)
    for fold in range(FOLDS):
        out = folds == fold
        if out.any() and (~out).sum() >= FEWEST_POINTS:
            error[out] = _without(field, out).forward(field.source[out]) - field.target[out]
    return error


def selection_of(field: Follower, distance2: FloatArray, frame: Frame) -> Selection:
    """What follows a bend as a model with its held-out errors, at the points that it stands on.

    Parameters
    ----------
    field : FieldMap or TinMap
    distance2 : (N,) float64
        Of the points from what the others say, squared, in variances.
    frame : Frame
        Of MS.
    """
    model, extra = (
        ("field", field.kernel.nugget_px2) if isinstance(field, FieldMap) else ("tin", 0.0)
    )
    none, all_of_them = np.empty(0), np.ones(len(field.source), dtype=np.bool_)
    estimate = Estimate(model, field, none, none, frame, extra, all_of_them, distance2)
    return Selection(estimate, held_out_errors(field))


def halves_apart(field: Follower) -> float:
    """Largest distance over the points between fields through two disjoint halves, over two.

    The halves interleave, so that both cover the scene.
    """
    odd = np.argsort(np.argsort(spatial_blocks(field.source), kind="stable")) % 2 == 0
    if min(int(odd.sum()), int((~odd).sum())) < FEWEST_POINTS:
        return float("inf")
    one, other = (_without(field, half).forward(field.source) for half in (odd, ~odd))
    return float(np.hypot(*(one - other).T).max() / 2)


def _without(field: Follower, out: BoolArray) -> Follower:
    """The same on the other points; of a field with its kernel."""
    return replace(
        field, source=field.source[~out], target=field.target[~out], noise_px2=field.noise_px2[~out]
    )
