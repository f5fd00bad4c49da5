"""The first transformation, at any rotation and shift: keypoints on a decimated pair."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from geodelreg.errors import NoDataError
from geodelreg.geo.affine import affine_from_matrix, affine_matrix, apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.footprint import overlap_windows
from geodelreg.image.bright import bright_mask
from geodelreg.image.stretch import to_uint8
from geodelreg.match.consensus import consensus_keypoints, fit_matrix, log_nfa, radial_residuals
from geodelreg.match.descriptors import (
    match_descriptors,
    matched_xy,
    one_to_one,
    ratio_test,
    select,
)
from geodelreg.match.keypoints import KeypointOptions, detect
from geodelreg.pipeline.state import Pair
from geodelreg.types import Band, BoolArray, FloatArray, Keypoints, Matches, Window

logger = logging.getLogger(__name__)

FIRST_BUDGET_PX = 400_000
SECOND_BUDGET_PX = 1_600_000
FIRST_KEYPOINTS = 1500
SECOND_KEYPOINTS = 8000
_THRESHOLD_PX = 1.0
_CHANCE_LOG_NFA = -2.0
_SURE_LOG_NFA = -12.0
_VISIBLE_BANDS = 3


@dataclass(frozen=True, slots=True)
class Scope:
    """Which part of the rasters a search looks at, and at which size.

    Attributes
    ----------
    source, reference : Window
    budget_px : int
        Pixels of each decimated image at most.
    keypoints : int
        Keypoints of each image at most.
    name : str
    """

    source: Window
    reference: Window
    budget_px: int
    keypoints: int
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class WorkingPair:
    """Both images of a scope, decimated to one ground sampling distance.

    Attributes
    ----------
    source : list of Band
        MS bands asked for.
    reference : Band
    scope : Scope
    """

    source: list[Band]
    reference: Band
    scope: Scope


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A first guess at the correction.

    Attributes
    ----------
    matrix : (2, 3) float64
        MS pixels to MS header pixels.
    log_nfa : float
        log10 of the expected number of chance agreements as good; NaN when not from keypoints.
    counts : dict of str to int
        Points that survive each step.
    pair : WorkingPair
    bright : tuple of (H, W) bool, or None
        Where the source and the reference of `pair` show bright objects, when those agree on
        something else: to be kept out of the refinement.
    """

    matrix: FloatArray
    log_nfa: float
    counts: dict[str, int]
    pair: WorkingPair
    bright: tuple[BoolArray, BoolArray] | None = None


def scopes(pair: Pair) -> Iterator[Scope]:
    """The header overlap grown by the search radius, the same finer, then both rasters whole."""
    windows = overlap_windows(
        pair.source.grid, pair.reference.grid, pair.options.search_radius_px, map_points
    )
    whole = tuple(
        Window(0, 0, r.grid.shape[1], r.grid.shape[0]) for r in (pair.source, pair.reference)
    )
    if windows is not None:
        yield Scope(*windows, FIRST_BUDGET_PX, FIRST_KEYPOINTS, "header overlap")
        if _decimated(pair, Scope(*windows, FIRST_BUDGET_PX, 0, "")):
            yield Scope(*windows, SECOND_BUDGET_PX, SECOND_KEYPOINTS, "header overlap, finer")
    if windows != whole:
        yield Scope(whole[0], whole[1], SECOND_BUDGET_PX, SECOND_KEYPOINTS, "both rasters whole")


def _decimated(pair: Pair, scope: Scope) -> bool:
    return _working_gsd_m(pair, scope) > 1.01 * max(*pair.source_gsd_m, *pair.reference_gsd_m)


def _working_gsd_m(pair: Pair, scope: Scope) -> float:
    areas = [
        window.width * window.height * gsd[0] * gsd[1]
        for window, gsd in (
            (scope.source, pair.source_gsd_m),
            (scope.reference, pair.reference_gsd_m),
        )
    ]
    return max(
        *pair.source_gsd_m, *pair.reference_gsd_m, float(np.sqrt(max(areas) / scope.budget_px))
    )


def read_working_pair(pair: Pair, scope: Scope) -> WorkingPair:
    """Read both images of a scope at the same ground sampling distance (METHOD trap 10)."""
    gsd = _working_gsd_m(pair, scope)
    source = pair.source.read(
        pair.source_bands, scope.source, _shape(scope.source, pair.source_gsd_m, gsd)
    )
    reference = pair.reference.read(
        [pair.options.pan_band],
        scope.reference,
        _shape(scope.reference, pair.reference_gsd_m, gsd),
    )
    return WorkingPair(source, reference[0], scope)


def _shape(window: Window, gsd_m: tuple[float, float], target_m: float) -> tuple[int, int]:
    height = round(window.height * gsd_m[1] / target_m)
    width = round(window.width * gsd_m[0] / target_m)
    return min(max(height, 1), window.height), min(max(width, 1), window.width)


def keypoint_hypotheses(pair: Pair, images: WorkingPair) -> Iterator[Hypothesis]:
    """Transformations that SIFT matches agree on, one per way to look at the MS bands.

    Stops after the first way that is beyond doubt; a weak one is followed by those of other bands.
    """
    found: list[Hypothesis] = []
    try:
        reference = _detect(images.reference, False, pair, images.scope)
    except NoDataError:
        return
    for band in _views(images.source):
        try:
            keypoints = _detect(band, _mirrored(pair), pair, images.scope)
        except NoDataError:
            continue
        agreed = _hypotheses_of(pair, images, band, keypoints, reference)
        if any(hypothesis.log_nfa < _SURE_LOG_NFA for hypothesis in agreed):
            yield from agreed
            return
        found.extend(agreed)
    yield from sorted(found, key=lambda h: h.log_nfa)[:3]


def _hypotheses_of(
    pair: Pair, images: WorkingPair, band: Band, source: Keypoints, reference: Keypoints
) -> list[Hypothesis]:
    """What all matches agree on, preceded by what those off bright objects say if that differs.

    Clouds move between the images, consistently and with many keypoints; the ground does not.
    """
    matched = _one_to_one(pair, source, reference)
    if matched is None:
        return []
    matches, counts = matched
    everywhere = _agree(pair, images, (source, reference), matches, counts)
    bright_source, bright_reference = bright_mask(band), bright_mask(images.reference)
    if bright_source is None or bright_reference is None:
        return [everywhere] if everywhere else []
    upright = bright_source[::-1] if _mirrored(pair) else bright_source
    dark = ~_look_up(upright, source.xy[matches.source_index])
    dark &= ~_look_up(bright_reference, reference.xy[matches.reference_index])
    clear = _agree(pair, images, (source, reference), select(matches, dark), counts)
    if clear is None or clear.log_nfa > _SURE_LOG_NFA or everywhere is None:
        return [h for h in (everywhere, clear) if h is not None]
    if _far_apart(pair, clear, everywhere):
        return [replace(clear, bright=(bright_source, bright_reference)), everywhere]
    return [everywhere]


def _look_up(mask: BoolArray, xy: FloatArray) -> BoolArray:
    index = np.floor(xy).astype(np.intp)
    rows = np.clip(index[:, 1], 0, mask.shape[0] - 1)
    return np.asarray(mask[rows, np.clip(index[:, 0], 0, mask.shape[1] - 1)])


def _far_apart(pair: Pair, one: Hypothesis, other: Hypothesis) -> bool:
    """True when two hypotheses differ somewhere by more than matching noise."""
    corners = pair.corners()
    gap = apply_affine(affine_from_matrix(one.matrix), corners)
    gap -= apply_affine(affine_from_matrix(other.matrix), corners)
    working_px = _working_gsd_m(pair, one.pair.scope) / min(pair.source_gsd_m)
    return float(np.abs(gap).max()) > _THRESHOLD_PX * working_px


def _views(bands: list[Band]) -> Iterator[Band]:
    """The mean of the first (visible) bands, then single bands, spread over the spectrum."""
    if len(bands) > 1:
        first = bands[: min(_VISIBLE_BANDS, len(bands))]
        yield mean_band(first)
        if len(bands) > _VISIBLE_BANDS:
            yield bands[_VISIBLE_BANDS]
            yield mean_band(bands[_VISIBLE_BANDS:])
            yield bands[2]
    else:
        yield bands[0]


def mean_band(bands: list[Band]) -> Band:
    """Mean of standardised bands."""
    data = np.zeros(bands[0].data.shape, dtype=np.float32)
    valid = np.ones(data.shape, dtype=bool)
    for band in bands:
        values = band.data[band.valid]
        spread = float(values.std()) if values.size else 0.0
        if spread == 0.0:
            continue
        data += (band.data - np.float32(values.mean())) / np.float32(spread)
        valid &= band.valid
    return Band(data, valid, bands[0].grid, "mean of " + ", ".join(b.name for b in bands))


def _mirrored(pair: Pair) -> bool:
    """True when one header is south-up and the other is not: SIFT knows no mirror images."""
    turns = [r.grid.transform.determinant for r in (pair.source, pair.reference)]
    return turns[0] * turns[1] < 0


def _detect(band: Band, flip: bool, pair: Pair, scope: Scope) -> Keypoints:
    image, valid = to_uint8(band), band.valid
    options = KeypointOptions(max_keypoints=min(scope.keypoints, pair.options.max_keypoints))
    if not flip:
        return detect(image, valid, options)
    return detect(np.ascontiguousarray(image[::-1]), np.ascontiguousarray(valid[::-1]), options)


def _one_to_one(
    pair: Pair, source: Keypoints, reference: Keypoints
) -> tuple[Matches, dict[str, int]] | None:
    if len(source) < 4 or len(reference) < 4:
        return None
    nearest = match_descriptors(source, reference)
    counts = {"keypoints MS": len(source), "keypoints PAN": len(reference)}
    passed = select(nearest, ratio_test(nearest.ratio, pair.options.ratio))
    counts["ratio test"] = len(passed)
    matches = select(passed, one_to_one(*matched_xy(source, reference, passed), passed.ratio))
    counts["one to one"] = len(matches)
    return matches, counts


def _agree(
    pair: Pair,
    images: WorkingPair,
    keypoints: tuple[Keypoints, Keypoints],
    matches: Matches,
    counts: dict[str, int],
) -> Hypothesis | None:
    """The correction that most matches agree on, unless chance would do as well."""
    if len(matches) < 4:
        return None
    source, reference = keypoints
    seed = pair.options.seed
    similar = consensus_keypoints(
        source, reference, matches, _THRESHOLD_PX, seed=seed, kind="similarity"
    )
    source_xy, reference_xy = matched_xy(source, reference, matches)
    if not np.isfinite(similar.matrix).all():
        return None
    matrix, inliers = _widen(similar.matrix, source_xy, reference_xy)
    residual = radial_residuals(matrix, source_xy, reference_xy)
    area = float(images.reference.data.size)
    surprise, _ = log_nfa(residual, area, 2, 2 * _THRESHOLD_PX)
    counts = counts | {"consensus": int(inliers.sum())}
    logger.debug("%s: %s, log NFA %.1f", images.scope.name, counts, surprise)
    if surprise > _CHANCE_LOG_NFA:
        return None
    to_source = _window_to_full(images.source[0], pair.source.grid.transform, _mirrored(pair))
    to_reference = _window_to_full(images.reference, pair.reference.grid.transform, False)
    full_source = apply_affine(affine_from_matrix(to_source), source_xy[inliers])
    full_reference = apply_affine(affine_from_matrix(to_reference), reference_xy[inliers])
    header = pair.mapping.inverse(full_reference)
    kind = "affine" if inliers.sum() >= 12 else "similarity"
    correction = fit_matrix(full_source, header, kind)
    return Hypothesis(correction, surprise, counts, images)


def _widen(
    matrix: FloatArray, source_xy: FloatArray, reference_xy: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Let a similarity become an affine where its inliers allow: more of them are then found."""
    inliers = radial_residuals(matrix, source_xy, reference_xy) <= _THRESHOLD_PX
    for _ in range(3):
        if inliers.sum() < 12:
            break
        trial = fit_matrix(source_xy[inliers], reference_xy[inliers], "affine")
        near = radial_residuals(trial, source_xy, reference_xy) <= _THRESHOLD_PX
        if near.sum() < inliers.sum():
            break
        matrix, inliers = trial, near
    return matrix, inliers


def _window_to_full(band: Band, full_transform: object, flipped: bool) -> FloatArray:
    """(2, 3) affine from pixels of a decimated window (flipped or not) to full-raster pixels."""
    matrix = affine_matrix(~full_transform @ band.grid.transform)  # type: ignore[operator]
    if flipped:
        height = band.data.shape[0]
        matrix[:, 2] += matrix[:, 1] * height
        matrix[:, 1] *= -1.0
    return matrix
