"""One image resampled on the other, whole and coarse."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from affine import Affine

from geodelreg.fine.surface import Surface, sample
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.grid import outline
from geodelreg.geo.maps.spline import Values, by_polynomial, interpolated
from geodelreg.geo.pixel import pixel_centres
from geodelreg.pair import Roles
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import Band, BoolArray, Float32Array, FloatArray, Grid

_WIDEST = 2
_SPLINE_PX = 0.01  # of the finer raster, whose decimated pixels are wider than one
_POLYNOMIAL_PX = 1e-3  # of the finer raster: a tenth of what tones and overlays would show
_ROWS = 128  # at a time: positions of 1000 columns take 2 MB


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """Template image and the low-passed surface image resampled on it, coarse.

    Attributes
    ----------
    template, surface : (H, W) float32
    template_valid, surface_valid : (H, W) bool
        Of each image by itself.
    """

    template: Float32Array
    surface: Float32Array
    template_valid: BoolArray
    surface_valid: BoolArray

    @property
    def valid(self) -> BoolArray:
        """(H, W) bool, True where both are valid."""
        return self.template_valid & self.surface_valid

    def part(self, rows: slice, columns: slice) -> Overlay:
        """A window of the overlay."""
        where = (rows, columns)
        return Overlay(
            self.template[where],
            self.surface[where],
            self.template_valid[where],
            self.surface_valid[where],
        )


def overlay(part: Roles, template: Band, surface: Surface, correction: PixelMap) -> Overlay:
    """Resample a surface onto a (decimated) template window under a correction."""
    height, width = template.data.shape
    place = placed(part, template, correction)
    values = np.empty((height, width), dtype=np.float32)
    usable = np.empty((height, width), dtype=np.bool_)
    for top in range(0, height, _ROWS):  # positions need ten times the memory of values
        some = slice(top, min(top + _ROWS, height))
        sides = (pixel_centres(np.arange(*side)) for side in ((some.start, some.stop), (0, width)))
        values[some], usable[some] = sample(surface, place(*sides))
    return Overlay(template.data, values, template.valid, usable)


def placed(part: Roles, template: Band, correction: PixelMap) -> Values:
    """Where pixels of a (decimated) template window lie in the surface raster, outer corner.

    Of a map that is no affine through a polynomial, for each point costs PROJ's time, or a spline,
    for each costs a field a kernel.  Where the images jump, through one on either side.
    """
    there = part.to_surface(correction)
    to_full = ~part.template.grid.transform @ template.grid.transform

    def asked(y: FloatArray, x: FloatArray) -> FloatArray:
        return there.forward(apply_affine(to_full, np.stack(np.meshgrid(x, y), axis=-1)))

    if there.as_affine() is not None:
        return asked
    if correction.as_affine() is not None:
        return by_polynomial(asked, template.data.shape, _POLYNOMIAL_PX)
    pieces = correction.pieces()
    if len(pieces) == 1 or not part.ms_is_template:
        return interpolated(asked, template.data.shape, _SPLINE_PX)[0]
    sides = [placed(part, template, piece) for piece, _, _ in pieces]
    jumps = [(low - to_full.f) / to_full.e for _, low, _ in pieces[1:]]

    def on_its_side(y: FloatArray, x: FloatArray) -> FloatArray:
        rows = np.split(y, np.searchsorted(y, jumps, side="right"))
        return np.concatenate([side(some, x) for side, some in zip(sides, rows, strict=True)])

    return on_its_side


def widened(part: Roles, template: Band, surface: Band, correction: PixelMap) -> Band:
    """The template band with empty margins where the surface band has more to show.

    A rival place may lie there: of a repeated texture that was aligned too far out, the next period
    further in.  No margin is more than half as wide as the band.
    """
    to_full = ~part.surface.grid.transform @ surface.grid.transform
    full = apply_affine(to_full, outline(surface.grid, 1))
    back = ~template.grid.transform @ part.template.grid.transform
    seen = apply_affine(back, part.to_surface(correction).inverse(full))
    rows, columns = template.data.shape
    if not np.isfinite(seen).all():
        return template
    low, high = -seen.min(axis=0), seen.max(axis=0) - (columns, rows)
    limit = (columns // _WIDEST, rows // _WIDEST)
    left, top = (int(v) for v in np.clip(np.ceil(low), 0, limit))
    right, bottom = (int(v) for v in np.clip(np.ceil(high), 0, limit))
    margins = ((top, bottom), (left, right))
    data, valid = np.pad(template.data, margins), np.pad(template.valid, margins)
    moved = template.grid.transform @ Affine.translation(-left, -top)
    return replace(
        template, data=data, valid=valid, grid=Grid(moved, data.shape, template.grid.crs_wkt)
    )
