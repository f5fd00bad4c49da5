"""Whether a part of MS lies elsewhere than the rest, near or far, and where, in words.

Every patch is sought around its place, on several grids where there are few of them; a side that
matches nothing there is sought as one piece over the whole of the other image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from affine import Affine

from geodelreg.coarse.correlation import AMBIGUOUS, best_shift
from geodelreg.fine.clouds import OUTSHINING
from geodelreg.fine.ground import ANOTHER_PX, Ground, find_ground, other_motion
from geodelreg.fine.least_squares import MAX_MOVE
from geodelreg.fine.motions import LEAST_PATCHES, LEAST_SHARE, Motion, is_cut_off
from geodelreg.fine.overlay import Overlay, overlay
from geodelreg.fine.passes import Refinement
from geodelreg.fine.survey import REACH_PX, Places, survey
from geodelreg.fine.tiles import PATCH_PX, SMALLEST_PATCH_PX
from geodelreg.fit.field import FEWEST_POINTS
from geodelreg.judge.evidence import decimated
from geodelreg.judge.words import lies, region
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess
from geodelreg.values.raster import BoolArray, IntArray

_PLACED_SCORE = 0.5
SURVEY_SIGMA_PX = 0.05  # by hand: ½ refuses 1 of 36
_SURE_Z = 3.0
FEW_PATCHES = 200  # of a twentieth of more, enough lie within it wherever the grid begins
_GRIDS = (
    (PATCH_PX, ("flush", "flush")), (PATCH_PX, ("between", "flush")),
    (PATCH_PX, ("flush", "between")), (PATCH_PX, ("between", "between")),
    (SMALLEST_PATCH_PX, ("flush", "flush")), (SMALLEST_PATCH_PX, ("between", "between")),
)  # fmt: skip
"""Largest patches, and where they begin across and down."""


class Moved(NamedTuple):
    """Another motion: share of the textured patches, where they lie, if they are torn off."""

    share: float = 0.0
    words: str = ""
    is_torn: bool = False


NOTHING_MOVES = Moved()


def overlaid(guess: Guess, refined: Refinement, correction: PixelMap) -> tuple[Overlay, Affine]:
    """Both images, decimated, bright objects too, and pixels of that to those of the template."""
    template, _, surface = decimated(guess, refined, dark=False)
    to_full = ~refined.part.template.grid.transform @ template.grid.transform
    return overlay(refined.part, template, surface, correction), to_full


def unit_of(to_full: Affine) -> float:
    """Pixels of full resolution in one of a decimated image, along an axis."""
    return float(np.sqrt(abs(to_full.determinant)))


def small_motion(refined: Refinement, images: Overlay, to_full: Affine) -> Moved:
    """The same as `another_motion` of patches on other grids, where there are few on one.

    A part no wider than a patch or two lies astride two rows of one grid, and fills a row of
    another, or of smaller patches.  Of so few patches brightness proves no cloud; a part that is
    bright is left to clouds.
    """
    for largest_px, grid in _GRIDS:
        places = survey(images, grid, largest_px)
        index = np.flatnonzero(placed(places))
        gone = np.hypot(*places.move[index].T) > ANOTHER_PX
        if gone.sum() < LEAST_PATCHES or (~gone).sum() < FEWEST_POINTS:
            continue
        ground = ground_of(places, index)
        if ground.look.outshining >= OUTSHINING:
            continue
        moved = another_motion(refined, places, index, ground, to_full)
        if moved.share:
            return moved
    return NOTHING_MOVES


def far_motion(refined: Refinement, images: Overlay, places: Places, to_full: Affine) -> Moved:
    """Where a side of MS lies that shows something and matches nothing within reach.

    It is sought as one piece over the whole of the other image.
    """
    near = placed(places) & (np.hypot(*places.move.T) <= ANOTHER_PX)
    astray = places.textured & ~near
    least = max(LEAST_SHARE * int(places.textured.sum()), LEAST_PATCHES)
    if astray.sum() < least or not is_cut_off(places.centre, astray, near):
        return NOTHING_MOVES
    shown, half = np.zeros_like(images.template_valid), places.size / 2
    for left, top in (places.centre[astray] - half).astype(int):
        shown[top : top + places.size, left : left + places.size] = True
    piece = replace(images, template_valid=images.template_valid & shown)
    found = best_shift(piece)
    if found.rival > AMBIGUOUS or not np.hypot(*found.move) > ANOTHER_PX:
        return NOTHING_MOVES
    motion = Motion(astray[places.textured], found.move, is_torn=True)
    return _told(refined, places, places.textured, motion, to_full)


def ground_of(places: Places, index: IntArray) -> Ground:
    """What some of the patches belong to."""
    at = places.centre[index]
    doubt = np.full(len(index), SURVEY_SIGMA_PX**2)
    return find_ground(at, at + places.move[index], doubt, places.brightest[index])


def placed(places: Places) -> BoolArray:
    """(P,) True for textured patches whose best place is theirs."""
    near = np.hypot(*places.move.T) <= MAX_MOVE
    sure = near | (places.z > _SURE_Z)
    return np.asarray(places.textured & (places.score > _PLACED_SCORE) & sure)


def another_motion(
    refined: Refinement, places: Places, index: IntArray, ground: Ground, to_full: Affine
) -> Moved:
    """The largest other motion of some of the patches.

    Parameters
    ----------
    refined : Refinement
    places : Places
    index : (K,) intp
        Those that were placed.
    ground : Ground
        Of these.
    to_full : Affine
        Pixels of the overlay to those of the template.
    """
    at, move = places.centre[index], places.move[index]
    apart = move - np.median(move[ground.member], axis=0)
    textured = int(places.textured.sum())
    bright = places.brightest[index]
    motion = other_motion(at, apart, ground.label, bright, textured, REACH_PX)
    if motion is None:
        return NOTHING_MOVES
    return _told(refined, places, index, motion, to_full)


def _told(
    refined: Refinement,
    places: Places,
    among: IntArray | BoolArray,
    motion: Motion,
    to_full: Affine,
) -> Moved:
    """What is said of a motion of some of the patches, in pixels of the overlay."""
    part = refined.part
    size = places.centre.max(axis=0) + places.centre.min(axis=0)
    step = motion.move * unit_of(to_full) * part.pan_px_per_patch_px / part.step
    place = lies(-step if part.ms_is_template else step)
    share = float(motion.member.sum()) / int(places.textured.sum())
    where = region(places.centre[among], motion.member, size)
    return Moved(share, f"{where} {place}", motion.is_torn)
