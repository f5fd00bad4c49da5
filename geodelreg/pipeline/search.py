"""The first transformation, at any rotation and shift: keypoints on a decimated pair."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from geodelreg.errors import NoDataError
from geodelreg.geo.affine import affine_from_matrix, affine_matrix, apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.footprint import overlap_windows
from geodelreg.image.bright import bright_mask
from geodelreg.image.stretch import to_uint8
from geodelreg.match.consensus import (
    Consensus,
    consensus_keypoints,
    fit_matrix,
    radial_residuals,
)
from geodelreg.match.delaunay_filter import FilterOptions, filter_matches
from geodelreg.match.descriptors import (
    match_descriptors,
    matched_xy,
    one_to_one,
    ratio_test,
    select,
)
from geodelreg.match.keypoints import KeypointOptions, detect, no_keypoints
from geodelreg.match.surprise import log_nfa
from geodelreg.pipeline.state import Pair
from geodelreg.types import Band, BoolArray, FloatArray, Keypoints, Matches, Status, Window

logger = logging.getLogger(__name__)

FIRST_BUDGET_PX = 250_000
SECOND_BUDGET_PX = 1_600_000
WHOLE = "both rasters whole"
FIRST_KEYPOINTS = 1500
SECOND_KEYPOINTS = 8000
_THRESHOLD_PX = 1.0
_CONTRADICTION = 1.5
_LOOSE_PX = 2.0
_FEWEST_MATCHES = 4
_AFFINE_MATCHES = 12
_CALM_SHARE = 0.8
_CHANCE_LOG_NFA = -2.0
SURE_LOG_NFA = -12.0
_VISIBLE_BANDS = 3
_TOGETHER_PX = 520_000  # a scale space takes some 230 bytes a pixel


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
    read_s : float
        Seconds that reading took, that of scopes before it included.
    """

    source: list[Band]
    reference: Band
    scope: Scope
    read_s: float = 0.0


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
    matches : tuple of (N, 2) float64, or None
        MS pixels and MS header pixels of the keypoint matches that agree.
    bright : tuple of (H, W) bool, or None
        Where the source and the reference of `pair` show bright objects, if they do: the
        refinement looks whether they move differently from the rest.
    """

    matrix: FloatArray
    log_nfa: float
    counts: dict[str, int]
    pair: WorkingPair
    matches: tuple[FloatArray, FloatArray] | None = None
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
        yield Scope(whole[0], whole[1], SECOND_BUDGET_PX, SECOND_KEYPOINTS, WHOLE)


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


def read_working_pair(pair: Pair, scope: Scope, read_s: float = 0.0) -> WorkingPair:
    """Read both images of a scope at the same ground sampling distance (METHOD trap 10)."""
    start = perf_counter()
    gsd = _working_gsd_m(pair, scope)
    source = pair.source.read(
        pair.source_bands, scope.source, _shape(scope.source, pair.source_gsd_m, gsd)
    )
    reference = pair.reference.read(
        [pair.options.pan_band],
        scope.reference,
        _shape(scope.reference, pair.reference_gsd_m, gsd),
    )
    return WorkingPair(source, reference[0], scope, read_s + perf_counter() - start)


def _shape(window: Window, gsd_m: tuple[float, float], target_m: float) -> tuple[int, int]:
    height = round(window.height * gsd_m[1] / target_m)
    width = round(window.width * gsd_m[0] / target_m)
    return min(max(height, 1), window.height), min(max(width, 1), window.width)


def keypoint_hypotheses(pair: Pair, images: WorkingPair) -> Iterator[Hypothesis]:
    """Transformations that SIFT matches agree on, one per way to look at the MS bands.

    Stops after the first way that is beyond doubt; a weak one is followed by those of other bands.
    """
    found: list[Hypothesis] = []
    bright = bright_mask(images.reference)
    reference: Keypoints | None = None
    dark: Keypoints | None = None
    for band in _views(images.source):
        source, reference = _detect_both(pair, images.scope, band, images.reference, reference)
        everywhere = _match_view(pair, images, source, reference)
        mine = None if bright is None else bright_mask(band)
        if mine is None or bright is None:
            agreed = [] if everywhere is None else [everywhere]
        else:
            ground = None
            if everywhere is None or not _is_calm(everywhere):
                hidden, scene = _hidden(band, mine), _hidden(images.reference, bright)
                source, dark = _detect_both(pair, images.scope, hidden, scene, dark)
                ground = _match_view(pair, images, source, dark)
            doubt = _in_doubt(pair, ground, everywhere)
            agreed = [replace(hypothesis, bright=(mine, bright)) for hypothesis in doubt]
        if any(hypothesis.log_nfa < SURE_LOG_NFA for hypothesis in agreed):
            yield from agreed
            return
        found.extend(agreed)
    yield from sorted(found, key=lambda h: h.log_nfa)[:3]


def _is_calm(found: Hypothesis) -> bool:
    """True when nearly all matches agree: nothing moves by itself."""
    return found.counts["Delaunay mesh"] > _CALM_SHARE * found.counts["one to one"]


def _in_doubt(
    pair: Pair, ground: Hypothesis | None, everywhere: Hypothesis | None
) -> list[Hypothesis]:
    """What the dark areas say first, unless all areas say the same.

    Clouds are bright; they move between the images, consistently and with many keypoints.
    """
    found = [hypothesis for hypothesis in (ground, everywhere) if hypothesis is not None]
    if ground is None or everywhere is None or _contradicts(pair, ground, everywhere):
        return found
    return [everywhere]


def _hidden(band: Band, mask: BoolArray) -> Band:
    return replace(band, valid=band.valid & ~mask)


def _match_view(
    pair: Pair, images: WorkingPair, source: Keypoints, reference: Keypoints
) -> Hypothesis | None:
    matched = _one_to_one(pair, source, reference)
    if matched is None:
        return None
    return _agree(pair, images, (source, reference), *matched)


def _contradicts(pair: Pair, clear: Hypothesis, everywhere: Hypothesis) -> bool:
    """True when most matches of one hypothesis do not fit the other."""
    assert clear.matches is not None
    source_px, header_px = clear.matches
    gap = apply_affine(affine_from_matrix(everywhere.matrix), source_px) - header_px
    working_px = _working_gsd_m(pair, clear.pair.scope) / np.array(pair.source_gsd_m)
    off = np.hypot(*(gap / working_px).T) > _CONTRADICTION * _THRESHOLD_PX
    return bool(off.mean() > 0.5)


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


def _detect_both(
    pair: Pair, scope: Scope, source: Band, reference: Band, known: Keypoints | None
) -> tuple[Keypoints, Keypoints]:
    """Keypoints of two images, at once where their scale spaces are small.

    Those of the reference are detected unless they are known.
    """
    flip = _mirrored(pair)
    if known is not None:
        return _detect(source, flip, pair, scope), known
    small = reference.data.size + source.data.size <= _TOGETHER_PX

    def mine(image: Band, flip: bool) -> Keypoints:
        return _detect(image, flip, pair, scope)

    with ThreadPoolExecutor(2 if small and pair.threads > 1 else 1) as pool:
        found = list(pool.map(mine, [reference, source], [False, flip]))
    return found[1], found[0]


def _detect(band: Band, flip: bool, pair: Pair, scope: Scope) -> Keypoints:
    try:
        image, valid = to_uint8(band), band.valid
    except NoDataError:
        return no_keypoints()
    options = KeypointOptions(max_keypoints=min(scope.keypoints, pair.options.max_keypoints))
    if not flip:
        return detect(image, valid, options)
    return detect(np.ascontiguousarray(image[::-1]), np.ascontiguousarray(valid[::-1]), options)


def _one_to_one(
    pair: Pair, source: Keypoints, reference: Keypoints
) -> tuple[Matches, dict[str, int]] | None:
    if min(len(source), len(reference)) < _FEWEST_MATCHES:
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
    if len(matches) < _FEWEST_MATCHES:
        return None
    source, reference = keypoints
    seed = pair.options.seed
    similar = consensus_keypoints(
        source, reference, matches, _THRESHOLD_PX, seed=seed, kind="similarity"
    )
    source_xy, reference_xy = matched_xy(source, reference, matches)
    if not np.isfinite(similar.matrix).all():
        return None
    loose = radial_residuals(similar.matrix, source_xy, reference_xy) <= _LOOSE_PX
    mesh = filter_matches(
        source_xy,
        reference_xy,
        matches.ratio,
        FilterOptions(consensus_px=_LOOSE_PX, seed=seed),
        Consensus(similar.matrix, loose),
    )
    inliers = mesh.status == Status.KEPT
    counts = counts | {"consensus": int(loose.sum()), "Delaunay mesh": int(inliers.sum())}
    if inliers.sum() < _FEWEST_MATCHES:
        return None
    kind = "affine" if inliers.sum() >= _AFFINE_MATCHES else "similarity"
    matrix = fit_matrix(source_xy[inliers], reference_xy[inliers], kind)
    residual = radial_residuals(matrix, source_xy, reference_xy)
    area = float(images.reference.data.size)
    surprise, _ = log_nfa(residual, area, 2, _LOOSE_PX)
    logger.debug("%s: %s, log NFA %.1f", images.scope.name, counts, surprise)
    if surprise > _CHANCE_LOG_NFA:
        return None
    to_source = _window_to_full(images.source[0], pair.source.grid.transform, _mirrored(pair))
    to_reference = _window_to_full(images.reference, pair.reference.grid.transform, False)
    full_source = apply_affine(affine_from_matrix(to_source), source_xy[inliers])
    full_reference = apply_affine(affine_from_matrix(to_reference), reference_xy[inliers])
    header = pair.mapping.inverse(full_reference)
    correction = fit_matrix(full_source, header, kind)
    return Hypothesis(correction, surprise, counts, images, (full_source, header))


def _window_to_full(band: Band, full_transform: object, flipped: bool) -> FloatArray:
    """(2, 3) affine from pixels of a decimated window (flipped or not) to full-raster pixels."""
    matrix = affine_matrix(~full_transform @ band.grid.transform)  # type: ignore[operator]
    if flipped:
        height = band.data.shape[0]
        matrix[:, 2] += matrix[:, 1] * height
        matrix[:, 1] *= -1.0
    return matrix
