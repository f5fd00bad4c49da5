"""Which patches are the ground's, and what the others are: clouds, another motion, or nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geodelreg.fine.clouds import CloudLook, cloud_look
from geodelreg.fine.motions import (
    LEAST_PATCHES,
    LEAST_SHARE,
    TORN_SHARE,
    Motion,
    is_cut_off,
    is_solid,
    layers,
    second_motion,
)
from geodelreg.fit.consensus import consensus
from geodelreg.values.raster import BoolArray, FloatArray, IntArray

_CORE_SIGMAS = 3.0
_CORE_FLOOR_PX = 0.05
"""Of a rigid ground: what interpolation and unlike point spreads leave, coarser pixels."""
_ALL_BUT_STRAYS = 0.8  # of what is far off: banks of clouds leave half to others, tears nine tenths
ANOTHER_PX = 1.5
"""From which a motion is another one: dense matching reaches so far, and follows what is nearer."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What the patches that were placed belong to.

    Attributes
    ----------
    label : (N,) intp
        Layers as `geodelreg.fine.motions.layers` numbers them.
    look : CloudLook
        Of the patches that move against the affine that most agree on, or, where clouds cover most,
        against the correction to be judged.
    moving : float
        Their share.
    is_torn : bool
        A line cuts those off from the others.
    """

    label: IntArray
    look: CloudLook
    moving: float
    is_torn: bool

    @property
    def member(self) -> BoolArray:
        """(N,) True of the ground's patches: the largest layer, bent as it may be."""
        return np.asarray(self.label == 0)


def find_ground(
    source: FloatArray,
    target: FloatArray,
    variance_px2: FloatArray,
    brightest: FloatArray,
) -> Ground:
    """Tell layers apart, and whether what moves against one affine looks like clouds.

    Parameters
    ----------
    source, target : (N, 2) float64
        Patches, and where they lie less what the correction moves them, in pixels of the coarser
        image.
    variance_px2 : (N,) float64
        Trace of the covariance of `target`.
    brightest : (N,) float64
        As for `geodelreg.fine.clouds.cloud_look`.
    """
    tolerance = max(_CORE_SIGMAS * float(np.sqrt(np.median(variance_px2))), _CORE_FLOOR_PX)
    core = consensus(source, target, tolerance).inliers
    look, moves = CloudLook(), ~core
    for still in (core, np.hypot(*(target - source).T) <= tolerance):
        if not look.explains:
            look, moves = cloud_look(source, ~still, brightest), ~still
    label = layers(source, target - source, np.sqrt(variance_px2))
    torn = bool(moves.any()) and is_cut_off(source, moves, ~moves)
    return Ground(label, look, float(moves.mean()), torn)


def other_motion(
    source: FloatArray,
    move: FloatArray,
    label: IntArray,
    brightest: FloatArray,
    textured: int,
    reach_px: float,
) -> Motion | None:
    """The largest motion besides the ground's, if so many share it that no result may ignore it.

    Of a part that is torn off fewer do, and it is no cloud, however bright: a line cuts it off, and
    hardly anything else moves.

    Strips one patch wide are no layer, for most of their neighbours are the ground's; they count
    when they agree, and no other patches lie among them.

    Parameters
    ----------
    source : (N, 2) float64
    move : (N, 2) float64
        Where patches were placed minus where the ground's map puts them, coarser pixels.
    label : (N,) intp
        Layers; 0 is the ground.
    brightest : (N,) float64
        As for `find_ground`: a layer that outshines the ground beside it is a bank of clouds.
    textured : int
        Number of all textured patches, placed or not.
    reach_px : float
        Of the search that placed them.

    Returns
    -------
    Motion or None
    """
    some, many = (max(share * textured, LEAST_PATCHES) for share in (TORN_SHARE, LEAST_SHARE))
    ground, far = label == 0, np.hypot(*move.T) > ANOTHER_PX

    def judged(motion: Motion) -> Motion | None:
        count = int(motion.member.sum())
        torn = count >= _ALL_BUT_STRAYS * far.sum() and is_cut_off(source, motion.member, ground)
        return replace(motion, is_torn=torn) if count >= (some if torn else many) else None

    found = []
    for number in range(1, int(label.max(initial=0)) + 1):
        member = label == number
        layer = judged(Motion(member, np.median(move[member], axis=0)))
        if layer is None or not np.hypot(*layer.move) > ANOTHER_PX:
            continue
        both = member | ground
        if layer.is_torn or not cloud_look(source[both], member[both], brightest[both]).explains:
            found.append(layer)
    strip = second_motion(move, (label < 0) & far, ANOTHER_PX, reach_px)
    if strip is not None and is_solid(source, strip.member, ground):
        found += filter(None, [judged(strip)])
    return max(found, key=lambda motion: int(motion.member.sum()), default=None)
