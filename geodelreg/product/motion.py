"""What a correction does, in the terms people use: shift, rotation, scale."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
from affine import Affine

from geodelreg.errors import CrsTransformError
from geodelreg.geo.affine import affine_matrix, apply_affine
from geodelreg.geo.crs import map_points
from geodelreg.geo.grid import gsd_px_m
from geodelreg.values.raster import FloatArray, Grid
from geodelreg.values.result import Alignment

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class HeaderMotion:
    """How a correction moves the MS raster, at its centre.  NaN where PROJ cannot tell.

    Attributes
    ----------
    shift_px : (float, float)
        In PAN pixels, along PAN columns and rows.
    shift_m : (float, float)
        In metres on the ground, east and north (map axes of the MS CRS).
    rotation_deg : float
        On the ground, counterclockwise.
    scale : (float, float)
        Growth along MS columns and along MS rows.
    shear_deg : float
        Change of the right angle between columns and rows.
    """

    shift_px: tuple[float, float]
    shift_m: tuple[float, float]
    rotation_deg: float
    scale: tuple[float, float]
    shear_deg: float

    @property
    def distance_px(self) -> float:
        """Length of the shift in PAN pixels."""
        return math.hypot(*self.shift_px)

    @property
    def distance_m(self) -> float:
        """Length of the shift in metres."""
        return math.hypot(*self.shift_m)


def header_motion(alignment: Alignment) -> HeaderMotion:
    """Shift, rotation and scale of an alignment's correction."""
    correction, source = alignment.correction, alignment.source.grid
    reference = alignment.reference.grid
    height, width = source.shape
    centre = np.array([width / 2, height / 2])
    before = apply_affine(correction.original, centre)
    after = apply_affine(correction.corrected, centre)
    unknown = np.full(2, np.nan)
    try:
        in_pan = map_points(np.stack([before, after]), source.crs_wkt, reference.crs_wkt)
        pan_px = apply_affine(~reference.transform, in_pan)
        shift_px = pan_px[1] - pan_px[0]
        metres = metres_per_unit(source, before)
    except CrsTransformError as error:
        logger.debug("shift in pixels and metres unknown: %s", error)
        shift_px, metres = unknown, unknown
    # without metres, map units of both axes count as equally long
    axes = np.where(np.isfinite(metres), metres, 1.0)[:, None]
    turn, scale, shear = _decompose(
        axes * affine_matrix(correction.original)[:, :2],
        axes * affine_matrix(correction.corrected)[:, :2],
    )
    shift_m = metres * (after - before)
    return HeaderMotion(
        shift_px=(float(shift_px[0]), float(shift_px[1])),
        shift_m=(float(shift_m[0]), float(shift_m[1])),
        rotation_deg=turn,
        scale=scale,
        shear_deg=shear,
    )


def metres_per_px(alignment: Alignment) -> float:
    """Metres that one PAN pixel is long on the ground, by its area; NaN where PROJ cannot tell."""
    try:
        return math.sqrt(math.prod(gsd_px_m(alignment.reference.grid)))
    except CrsTransformError:
        return math.nan


def metres_per_unit(source: Grid, at: FloatArray) -> FloatArray:
    """Metres that one map unit is long, along the x and the y axis, near a place of the map.

    Raises
    ------
    CrsTransformError
    """
    step = math.sqrt(abs(source.transform.determinant))
    pixel = Affine(step, 0.0, at[0] - step / 2, 0.0, -step, at[1] + step / 2)
    return np.array(gsd_px_m(Grid(pixel, (1, 1), source.crs_wkt, source.unit_m))) / step


def _decompose(before: FloatArray, after: FloatArray) -> tuple[float, tuple[float, float], float]:
    """Rotation in degrees, scale of columns and rows, shear in degrees between two pixel frames.

    Each is (2, 2): ground vectors of one step along a column index and along a row index.
    """
    lengths = np.hypot(*after) / np.hypot(*before)
    angles = np.degrees(np.arctan2(*after[::-1]) - np.arctan2(*before[::-1]))
    column_turn, row_turn = (float((angle + 180.0) % 360.0 - 180.0) for angle in angles)
    shear = (row_turn - column_turn + 180.0) % 360.0 - 180.0
    turn = column_turn + shear / 2
    return turn, (float(lengths[0]), float(lengths[1])), shear
