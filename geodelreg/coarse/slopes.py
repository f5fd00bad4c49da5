"""PAN as its slopes: shaded like relief, or the strength of its edges.

Some images show where another one changes, and not what it shows: a hillshade, an image of edges.
Correlation with PAN does not tell where they belong: it vanishes or changes its sign across the
true place.  With PAN's own slopes they agree, and all else stays as it is: what comes of it has to
pass the same gate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import cv2
import numpy as np

from geodelreg.coarse.correlation import Detail, common_parts, detail_pair, significance
from geodelreg.coarse.scopes import overview_shapes, scopes
from geodelreg.fine.looks import mean_band
from geodelreg.fine.overlay import overlay
from geodelreg.fine.surface import make_surface
from geodelreg.geo.grid import corners_of, decimated_grid, window_around
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.pair import Pair, roles
from geodelreg.values.raster import Band, BoolArray, Float32Array, Grid, Window, WindowReader

_REACH = 3  # units that a slope looks at: standard deviations of the smoothing before it
_LEAST_SHARE = 1e-3  # of weight: means of less are not asked for
_BETTER = 1.2
"""Times more significant that PAN's slopes must be than PAN itself: of images alike they are 0.6
times, for an image resembles its slopes beside the place."""
_SURE = 8.0  # standard errors of a correlation: of 10^6 displacements none has so many by chance
_SEARCH_OVERLAP = 0.3  # of the smaller image
_BOTH = 0.1
"""Share of what slopes leave unexplained that PAN itself explains where MS shows both: 0.27 where a
fifth of the variance is PAN's; 0.05 at most where MS shows slopes alone."""
_ANTIALIAS_PX = (0.5, 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class _Slope:
    """Derivatives of a smoothed band, and where they saw valid pixels only."""

    of: Band
    across: Float32Array
    down: Float32Array
    valid: BoolArray

    def strength(self) -> Band:
        """Whatever the direction."""
        strength = np.asarray(cv2.magnitude(self.across, self.down), np.float32)
        return replace(self.of, data=strength, valid=self.valid)

    def along(self, light: tuple[float, float]) -> Band:
        """Bright where the band rises towards a unit vector."""
        x, y = (np.float32(v) for v in light)
        return replace(self.of, data=x * self.across + y * self.down, valid=self.valid)


@dataclass(frozen=True, slots=True)
class Slopes:
    """A raster that is read as its slopes.

    Attributes
    ----------
    reader : WindowReader
    unit_px : float
        Pixels of the raster to one over which slopes are taken, after smoothing by as much:
        those of the other raster, if it is coarser.
    light : (float, float) or None
        Unit vector that slopes are taken along; None for their strength, whatever their direction.
    """

    reader: WindowReader
    unit_px: float
    light: tuple[float, float] | None = None

    @property
    def grid(self) -> Grid:
        """Grid of the full raster."""
        return self.reader.grid

    @property
    def name(self) -> str:
        """File name, for messages."""
        return self.reader.name

    @property
    def band_names(self) -> tuple[str, ...]:
        """One name per band."""
        return self.reader.band_names

    def passing(self) -> AbstractContextManager[None]:
        """As of the raster itself."""
        return self.reader.passing()

    def read(
        self, bands: Sequence[int], window: Window, shape: tuple[int, int] | None = None
    ) -> list[Band]:
        """Slopes of a window, taken at the unit or finer, then averaged down to `shape`."""
        slopes = self.slopes(bands, window, shape)
        found = [s.strength() if self.light is None else s.along(self.light) for s in slopes]
        return found if shape is None else [_averaged(band, shape) for band in found]

    def slopes(
        self, bands: Sequence[int], window: Window, shape: tuple[int, int] | None
    ) -> list[_Slope]:
        """Of a window; where it is to be averaged down, no finer than that and than the unit."""
        if shape is not None:
            most = (round(window.height / self.unit_px), round(window.width / self.unit_px))
            least = (window.height, window.width)
            inner = tuple(min(max(s, m), n) for s, m, n in zip(shape, most, least, strict=True))
            read = self.reader.read(bands, window, (inner[0], inner[1]))
            return [self._slope(band) for band in read]
        margin = math.ceil(_REACH * self.unit_px) + 1
        wide = window_around(corners_of(window), margin, self.grid)
        assert wide is not None
        top, left = window.row - wide.row, window.column - wide.column
        inside = np.s_[top : top + window.height, left : left + window.width]
        grid = decimated_grid(self.grid, window, None)
        return [
            _Slope(replace(s.of, grid=grid), s.across[inside], s.down[inside], s.valid[inside])
            for s in map(self._slope, self.reader.read(bands, wide))
        ]

    def _slope(self, band: Band) -> _Slope:
        step = ~self.grid.transform @ band.grid.transform
        unit = max(self.unit_px / max(abs(step.a), abs(step.e)), 1.0)
        weight = band.valid.astype(np.float32)
        level = np.float32(band.data[band.valid].mean()) if band.valid.any() else np.float32(0)
        smooth = cv2.GaussianBlur((band.data - level) * weight, (0, 0), unit)
        valid = band.valid
        if not valid.all():
            smooth = smooth / np.maximum(cv2.GaussianBlur(weight, (0, 0), unit), _LEAST_SHARE)
            side = 2 * math.ceil(_REACH * unit) + 1
            valid = cv2.erode(weight, np.ones((side, side), np.uint8)) > 0
        across, down = (
            np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *axis, ksize=1, scale=unit / 2), np.float32)
            for axis in ((1, 0), (0, 1))
        )
        return _Slope(band, across, down, np.asarray(valid))


def _averaged(band: Band, shape: tuple[int, int]) -> Band:
    """Means over the valid part of larger pixels, valid when that is half of them."""
    height, width = band.data.shape
    if (height, width) == shape:
        return band
    weight, size = band.valid.astype(np.float32), shape[::-1]
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(band.data * weight, size, interpolation=cv2.INTER_AREA)
    data = np.asarray(mean / np.maximum(share, _LEAST_SHARE), dtype=np.float32)
    grid = decimated_grid(band.grid, Window(0, 0, width, height), shape)
    return replace(band, data=data, valid=np.asarray(share >= 0.5), grid=grid)


def as_slopes(pair: Pair) -> Slopes | None:
    """PAN as the slopes that MS resembles more than it does PAN, about where the header says.

    Returns
    -------
    Slopes or None
        None where PAN itself is the better likeness, no likeness is significant, or MS shows both:
        what it shows of PAN itself would displace the slopes.
    """
    scope = next(scopes(pair))
    source_shape, shape = overview_shapes(pair, scope)
    view = Slopes(pair.reference, pair.pan_px_per_coarser_px)
    (slope,) = view.slopes([pair.options.pan_band], scope.reference, shape)
    ways = (slope.along((1.0, 0.0)), slope.along((0.0, 1.0)), slope.strength())
    source = mean_band(pair.source.read(pair.source_bands, scope.source, source_shape))
    plain, x, y, edges = (
        _Beside.of(pair, source, look)
        for look in (_averaged(way, shape) for way in (slope.of, *ways))
    )
    across, down, strength = (one.likeness() for one in (x, y, edges))
    shaded = np.hypot(across, down)
    best = max(float(shaded.max()), float(strength.max()))
    if best < max(_SURE, _BETTER * float(np.abs(plain.likeness()).max())):
        return None
    if strength.max() >= best:
        place = np.unravel_index(int(strength.argmax()), strength.shape)
        return None if plain.shows_too(edges.finer.image, place) else view
    place = np.unravel_index(int(shaded.argmax()), shaded.shape)
    light = float(across[place]) / best, float(down[place]) / best
    slopes = np.float32(light[0]) * x.finer.image + np.float32(light[1]) * y.finer.image
    return None if plain.shows_too(slopes, place) else replace(view, light=light)


@dataclass(frozen=True, slots=True, eq=False)
class _Beside:
    """Details of the coarser image and of one look at the finer, on one grid."""

    coarser: Detail
    finer: Detail

    @classmethod
    def of(cls, pair: Pair, source: Band, reference: Band) -> _Beside:
        """Of a band of MS and one of PAN, where the header puts them."""
        part = roles(pair)
        template, finer = (source, reference) if part.ms_is_template else (reference, source)
        surface = make_surface(finer, part.surface.grid, _ANTIALIAS_PX)
        return cls(*detail_pair(overlay(part, template, surface, IDENTITY)))

    def likeness(self) -> Float32Array:
        """Correlation over its standard error, at all displacements."""
        return significance(self.coarser, self.finer, _SEARCH_OVERLAP)

    def shows_too(self, slopes: Float32Array, place: Sequence[np.intp]) -> bool:
        """True when this look at PAN explains what its slopes, a little displaced, do not.

        Parameters
        ----------
        slopes : (H, W) float32
            On the grid of the finer image.
        place : (int, int)
            In `likeness`.
        """
        step = [side - 1 - int(i) for side, i in zip(self.coarser.image.shape, place, strict=True)]
        mine, other = common_parts(self.coarser.image.shape, step)
        first = np.gradient(slopes)
        second = [*np.gradient(first[0]), np.gradient(first[1])[1]]
        good = (self.coarser.mask[mine] * self.finer.mask[other]) > 0
        looks = [slopes, *first, *second, self.finer.image]
        columns = np.stack([look[other][good] for look in looks], axis=1).astype(np.float64)
        columns -= columns.mean(axis=0)
        target = self.coarser.image[mine][good].astype(np.float64)
        target -= target.mean()
        left = [
            float(np.square(target - some @ np.linalg.lstsq(some, target, rcond=None)[0]).sum())
            for some in (columns[:, :-1], columns)
        ]
        return left[1] < (1 - _BOTH) * left[0]
