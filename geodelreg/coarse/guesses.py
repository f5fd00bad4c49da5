"""First guesses at the correction, at any rotation and shift, on a decimated pair."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from geodelreg.coarse.descriptors import match_descriptors, one_to_one, ratio_test
from geodelreg.coarse.grey import to_uint8
from geodelreg.coarse.header import edge_guess, proven_guess
from geodelreg.coarse.keypoints import KeypointOptions, detect, no_keypoints
from geodelreg.coarse.scopes import read_overview, scopes, working_gsd_m
from geodelreg.errors import NoDataError
from geodelreg.fine.layers import SURE_LOG_NFA, bright_mask, in_doubt, is_calm_guess
from geodelreg.fine.looks import band_looks
from geodelreg.fit.chance import log_nfa
from geodelreg.fit.consensus import Consensus, consensus, fit_plainly, radial_residuals
from geodelreg.fit.delaunay_mesh import filter_matches
from geodelreg.geo.affine import affine_matrix
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.pair import Pair
from geodelreg.values.points import Guess, Keypoints, Matches, Overview, Scope, Status
from geodelreg.values.raster import Band, BoolArray, Grid

logger = logging.getLogger(__name__)

_THRESHOLD_PX = 1.0
_LOOSE_PX = 2.0
_FEWEST_MATCHES = 4
_AFFINE_MATCHES = 12  # four times what an affine needs; by hand: ½ to 2 × alike
_CHANCE_LOG_NFA = -2.0
_TOGETHER_PX = 520_000  # a scale space takes some 230 bytes a pixel
_FAIR_SHARE = 0.5
_FINER_LOOKS = 2  # one with bright objects and one without, or the best two


class _Look(NamedTuple):
    """A way to look at MS: which bands, and whether bright objects are left out."""

    bands: str
    dark: bool


def guesses(pair: Pair) -> Iterator[tuple[Pair, Guess]]:
    """First guesses, the most likely first; later ones are only made when asked for.

    From the header's place, where that leaves no doubt; from keypoints, scope by scope; then from
    edges around the header.

    Yields
    ------
    pair : Pair
        With the MS bands that show something where the guess was made.
    guess : Guess

    Raises
    ------
    NoDataError
        When a band has no texture where it matters.
    """
    first: tuple[Pair, Overview] | None = None
    told: dict[_Look, float] = {}
    for seen, images in overviews(pair, scopes(pair)):
        likely = _likely(told) if images.scope.is_closer else None
        told.clear()
        if first is None:
            first = seen, images
            proven = None if pair.options.search == "keypoints" else proven_guess(*first)
            if proven is not None:
                yield seen, proven
        for guess in _keypoint_guesses(seen, images, told, likely):
            yield seen, guess
    if first is not None:
        yield first[0], edge_guess(*first)


def overviews(pair: Pair, where: Iterable[Scope]) -> Iterator[tuple[Pair, Overview]]:
    """Both images of each scope that shows something, read when asked for.

    Yields
    ------
    pair : Pair
        With the MS bands that show something there.
    images : Overview

    Raises
    ------
    NoDataError
        When no scope shows anything.
    """
    shown = False
    empty: NoDataError | None = None
    for scope in where:
        seen, images = _with_content(pair, read_overview(pair, scope))
        empty = _emptiness(pair, images)
        if empty is None:
            shown = True
            yield seen, images
    if empty is not None and not shown:
        raise empty


def _with_content(pair: Pair, images: Overview) -> tuple[Pair, Overview]:
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


def _emptiness(pair: Pair, images: Overview) -> NoDataError | None:
    for reader, band in ((pair.source, images.source[0]), (pair.reference, images.reference)):
        if not _has_content(band):
            values = band.data[band.valid]
            what = f"the constant value {values[0]:g}" if values.size else "no valid pixel"
            return NoDataError(
                f"{reader.name}: {band.name} has {what} where the rasters overlap",
                "Choose another band, or check the no-data value and the mask.",
            )
    return None


def _likely(told: Mapping[_Look, float]) -> set[_Look]:
    """The looks to take again, closer: the least by chance with bright objects, and without."""
    ranked = sorted(told, key=told.__getitem__)
    dark = [look for look in ranked if look.dark][: _FINER_LOOKS - 1]
    return {*dark, *[look for look in ranked if not look.dark][: _FINER_LOOKS - len(dark)]}


def _keypoint_guesses(
    pair: Pair, images: Overview, told: dict[_Look, float], likely: set[_Look] | None
) -> Iterator[Guess]:
    """Maps that SIFT matches agree on, one per way to look at the MS bands.

    Stops after the first way that is beyond doubt; a weak one is followed by those of other bands.

    Parameters
    ----------
    pair : Pair
    images : Overview
    told : dict of _Look to float
        Takes the log NFA of each look.
    likely : set of _Look, optional
        Which to take; all where None.
    """
    found: list[Guess] = []
    bright = bright_mask(images.reference)
    reference: Keypoints | None = None
    dark: Keypoints | None = None
    working_px = working_gsd_m(pair, images.scope) / np.array(pair.source_gsd_m)
    for band in band_looks(images.source):
        all_of_it, without = _Look(band.name, False), _Look(band.name, True)
        everywhere = ground = None
        if likely is None or all_of_it in likely:
            source, reference = _detect_both(pair, images.scope, band, images.reference, reference)
            told[all_of_it], everywhere = _match(pair, images, source, reference)
        mine = None if bright is None else bright_mask(band)
        if mine is None or bright is None:
            agreed = [] if everywhere is None else [everywhere]
        else:
            calm = everywhere is not None and is_calm_guess(everywhere)
            if not calm and (likely is None or without in likely):
                hidden, scene = _hidden(band, mine), _hidden(images.reference, bright)
                source, dark = _detect_both(pair, images.scope, hidden, scene, dark)
                told[without], ground = _match(pair, images, source, dark)
            doubt = in_doubt(ground, everywhere, working_px)
            agreed = [replace(guess, bright=(mine, bright)) for guess in doubt]
        if any(guess.log_nfa < SURE_LOG_NFA for guess in agreed):
            yield from agreed
            return
        found.extend(agreed)
    yield from sorted(found, key=lambda guess: guess.log_nfa)[:3]


def _hidden(band: Band, mask: BoolArray) -> Band:
    return replace(band, valid=band.valid & ~mask)


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
    options = KeypointOptions(max_keypoints=scope.keypoints)
    if not flip:
        return detect(image, valid, options)
    return detect(np.ascontiguousarray(image[::-1]), np.ascontiguousarray(valid[::-1]), options)


def _match(
    pair: Pair, images: Overview, source: Keypoints, reference: Keypoints
) -> tuple[float, Guess | None]:
    """What the keypoints of one look say, if they say anything, and its log NFA."""
    if min(len(source), len(reference)) < _FEWEST_MATCHES:
        return math.inf, None
    nearest = match_descriptors(source, reference)
    passed = nearest.take(ratio_test(nearest.ratio, pair.options.ratio))
    matches = passed.take(one_to_one(*passed.xy(source, reference), passed.ratio))
    counts = {
        "keypoints MS": len(source),
        "keypoints PAN": len(reference),
        "ratio test": len(passed),
        "one to one": len(matches),
    }
    return _agree(pair, images, (source, reference), matches, counts)


def _agree(
    pair: Pair,
    images: Overview,
    keypoints: tuple[Keypoints, Keypoints],
    matches: Matches,
    counts: dict[str, int],
) -> tuple[float, Guess | None]:
    """The log NFA of the correction that most matches agree on, and that unless it is chance."""
    if len(matches) < _FEWEST_MATCHES:
        return math.inf, None
    source_xy, reference_xy = matches.xy(*keypoints)
    found = consensus(source_xy, reference_xy, _THRESHOLD_PX, "similarity")
    if found.map is None:
        return math.inf, None
    loose = radial_residuals(found.map, source_xy, reference_xy) <= _LOOSE_PX
    mesh = filter_matches(source_xy, reference_xy, Consensus(found.map, loose))
    inliers = mesh == Status.KEPT
    counts = counts | {"consensus": int(loose.sum()), "Delaunay mesh": int(inliers.sum())}
    if inliers.sum() < _FEWEST_MATCHES:
        return math.inf, None
    kind = "affine" if inliers.sum() >= _AFFINE_MATCHES else "similarity"
    there = fit_plainly(source_xy[inliers], reference_xy[inliers], kind)
    residual = radial_residuals(there, source_xy, reference_xy)
    surprise, _ = log_nfa(residual, float(images.reference.data.size), 2, _LOOSE_PX)
    logger.debug("%s: %s, log NFA %.1f", images.scope.name, counts, surprise)
    if surprise > _CHANCE_LOG_NFA:
        return surprise, None
    to_source = _to_full(images.source[0], pair.source.grid, _mirrored(pair))
    to_reference = _to_full(images.reference, pair.reference.grid, False)
    source_px = to_source.forward(source_xy[inliers])
    header_px = pair.header.inverse(to_reference.forward(reference_xy[inliers]))
    correction = fit_plainly(source_px, header_px, kind)
    guess = Guess(correction, surprise, counts, images, source_px, header_px, len(matches))
    return surprise, guess


def _to_full(band: Band, full: Grid, flipped: bool) -> AffineMap:
    """From pixels of a decimated window (flipped or not) to those of the full raster."""
    matrix = affine_matrix(~full.transform @ band.grid.transform)
    if flipped:
        height = band.data.shape[0]
        matrix[:, 2] += matrix[:, 1] * height
        matrix[:, 1] *= -1.0
    return AffineMap.of(matrix)
