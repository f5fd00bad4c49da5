"""The two rasters side by side: how their headers relate them, and which plays which role."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from geodelreg.errors import CrsTransformError, UnsupportedGeoreferenceError, UsageError
from geodelreg.geo.grid import corners_of, gsd_px_m, outline, window_around
from geodelreg.geo.maps.header import HeaderMap, header_map
from geodelreg.geo.maps.smooth import Inverse
from geodelreg.options import FOLLOWING, AlignOptions
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import FloatArray, Window, WindowReader
from geodelreg.values.timings import Timings

MOST_BANDS = 12
"""Bands of a hyperspectral image that are matched on at most."""

_LARGEST_RATIO = 1e4
"""Of the largest pixel size of the two rasters to the smallest."""

LATTICE = 5  # places along either axis of MS at which maps are compared: smooth in between
_EDGE_PLACES = 16  # on each edge of a footprint: edges of headers in unlike CRSs are curved
_SWAPPED_RATIO = 1.5  # MS and PAN of one sensor: 2 and more
_ROUNDING = 1e-6  # of a quotient of pixel sizes that went through a change of CRS

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """The two rasters and how their headers relate them.

    Attributes
    ----------
    source, reference : WindowReader
        MS and PAN.
    source_bands : tuple of int
        MS bands to match on, from 1.
    header : HeaderMap
        MS pixels to PAN pixels, as the headers claim.
    source_gsd_m, reference_gsd_m : (float, float)
        Ground size of a pixel along columns and rows.
    options : AlignOptions
    timings : Timings
        The caller's, to which the steps add.
    """

    source: WindowReader
    reference: WindowReader
    source_bands: tuple[int, ...]
    header: HeaderMap
    source_gsd_m: tuple[float, float]
    reference_gsd_m: tuple[float, float]
    options: AlignOptions
    timings: Timings = field(default_factory=Timings)

    @property
    def source_is_coarser(self) -> bool:
        """True when an MS pixel is at least as large as a PAN pixel."""
        return self.source_area_ratio >= 1.0 - _ROUNDING

    @property
    def source_area_ratio(self) -> float:
        """Area of an MS pixel over that of a PAN pixel."""
        mine, other = self.source_gsd_m, self.reference_gsd_m
        return (mine[0] * mine[1]) / (other[0] * other[1])

    @property
    def pan_px_per_source_px(self) -> float:
        """GSD ratio: PAN pixels to one MS pixel."""
        return float(np.sqrt(self.source_area_ratio))

    @property
    def pan_px_per_coarser_px(self) -> float:
        """PAN pixels to one pixel of the coarser raster."""
        return max(self.pan_px_per_source_px, 1.0)

    @property
    def through_proj(self) -> bool:
        """True when coordinates, or sizes of pixels, come from PROJ."""
        units = self.source.grid.unit_m, self.reference.grid.unit_m
        return self.header.as_affine() is None or None in units

    @property
    def threads(self) -> int:
        """Threads to use."""
        return self.options.threads or os.cpu_count() or 1

    @property
    def may_bend(self) -> bool:
        """True when a field was asked for, or may be written where one affine is not enough."""
        model, on_local = self.options.model, self.options.on_local
        asked = model in FOLLOWING or (model == "auto" and on_local == "field")
        return asked and self.options.method == "delaunay"

    @property
    def source_centre(self) -> FloatArray:
        """(1, 2) centre of the MS raster, pixels."""
        height, width = self.source.grid.shape
        return np.array([[width / 2, height / 2]])

    @property
    def metric(self) -> FloatArray:
        """(2, 2) MS pixel steps to metres on the ground, in the axes of the map."""
        t = self.source.grid.transform
        unit = np.array([[t.a, t.b], [t.d, t.e]])
        unit = unit / np.hypot(unit[0], unit[1])
        return np.asarray(unit * np.array(self.source_gsd_m))

    def source_lattice(self, per_axis: int) -> FloatArray:
        """(n², 2) pixels spread over the MS raster, row by row, its corners included."""
        height, width = self.source.grid.shape
        axes = np.linspace(0, width, per_axis), np.linspace(0, height, per_axis)
        columns, rows = np.meshgrid(*axes)
        return np.stack([columns.ravel(), rows.ravel()], axis=1)

    def to_reference(self, correction: PixelMap) -> PixelMap:
        """MS pixels to PAN pixels through a correction and the headers."""
        return correction.then(self.header)

    def move_px(self, correction: PixelMap, source_px: FloatArray) -> FloatArray:
        """(N, 2) PAN pixels by which a correction moves (N, 2) MS pixels."""
        return self.to_reference(correction).forward(source_px) - self.header.forward(source_px)


def bands_asked(source: WindowReader, options: AlignOptions) -> tuple[int, ...]:
    """MS bands to look at, from 1: the one asked for, or all, or as many as help and were named."""
    count = len(source.band_names)
    if options.band:
        return (options.band,)
    spread = np.linspace(1, count, min(count, MOST_BANDS)).round()
    return tuple(sorted({*map(int, spread), *options.agreeing_bands}))


def make_pair(
    source: WindowReader,
    reference: WindowReader,
    options: AlignOptions,
    timings: Timings | None = None,
) -> Pair:
    """Relate two rasters by their headers.

    Raises
    ------
    CrsTransformError
        If PROJ knows no operation between the CRSs.
    UnsupportedGeoreferenceError
        If the pixels of the two cannot be compared.
    """
    try:
        sizes = gsd_px_m(source.grid), gsd_px_m(reference.grid)
        header = header_map(source.grid, reference.grid)
    except CrsTransformError as error:
        raise CrsTransformError(
            f"{source.name} and {reference.name}: {error.cause}", error.remedy
        ) from error
    _check_sizes(source, reference, np.array(sizes))
    bands = bands_asked(source, options)
    timings = Timings() if timings is None else timings
    return Pair(source, reference, bands, header, *sizes, options, timings)


def check_order(source: WindowReader, reference: WindowReader, options: AlignOptions) -> None:
    """Refuse PAN in the place of MS: one band of small pixels, against many of large ones.

    Parameters
    ----------
    source, reference : WindowReader
    options : AlignOptions
        As they were asked for: who names a band of either means it so.

    Raises
    ------
    UsageError
    """
    ours, theirs = len(source.band_names), len(reference.band_names)
    if options.band or options.pan_band != 1 or not ours == 1 < theirs:
        return
    try:
        mine, other = (math.sqrt(math.prod(gsd_px_m(one.grid))) for one in (source, reference))
    except CrsTransformError:
        return  # told better when the two are related
    if other >= _SWAPPED_RATIO * mine:
        right = f": {reference.name} {source.name}" if reference.name != source.name else ""
        raise UsageError(
            f"{source.name} has one band of {mine:.4g} m pixels, and {reference.name} {theirs} of "
            f"{other:.4g} m: MS and PAN are swapped",
            f"MS, which is corrected, comes first{right}. If the raster of one band is to be "
            "corrected, say so: `band=1`.",
        )


def _check_sizes(source: WindowReader, reference: WindowReader, gsd_m: FloatArray) -> None:
    """Refuse headers whose pixels are absurd: filters and grids grow with the ratio of sizes."""
    known = np.isfinite(gsd_m).all() and gsd_m.min() > 0
    if known and gsd_m.max() <= _LARGEST_RATIO * gsd_m.min():
        return
    texts = [f"{across:.4g} × {down:.4g} m" for across, down in gsd_m.tolist()]
    raise UnsupportedGeoreferenceError(
        f"by their headers, pixels of {source.name} measure {texts[0]} and those of "
        f"{reference.name} {texts[1]}, which cannot be compared",
        "Correct the geotransform that is wrong: gdal_edit.py -a_ullr ULX ULY LRX LRY FILE.",
    )


@dataclass(frozen=True, slots=True, eq=False)
class Roles:
    """Which image is cut into patches (the coarser one) and which is sampled.

    Attributes
    ----------
    pair : Pair
    template, surface : WindowReader
    template_bands, surface_bands : tuple of int
    step : int
        Template pixels, along either axis, that are averaged to one pixel of a patch: more than 1
        where the template shows less than its pixels could, as enlarged rasters do.
    """

    pair: Pair
    template: WindowReader
    surface: WindowReader
    template_bands: tuple[int, ...]
    surface_bands: tuple[int, ...]
    step: int = 1

    @property
    def ms_is_template(self) -> bool:
        """True when the MS image is the coarser one."""
        return self.pair.source_is_coarser

    def to_surface(self, correction: PixelMap) -> PixelMap:
        """Template pixels to surface pixels under a correction."""
        there = self.pair.to_reference(correction)
        return there if self.ms_is_template else Inverse(there)

    @property
    def surface_px_per_template_px(self) -> float:
        """GSD ratio, at least 1."""
        ratio = self.pair.pan_px_per_source_px
        return ratio if self.ms_is_template else 1.0 / ratio

    @property
    def surface_px_per_patch_px(self) -> float:
        """Surface pixels, along either axis, to one pixel of a patch."""
        return self.step * self.surface_px_per_template_px

    @property
    def pan_px_per_patch_px(self) -> float:
        """PAN pixels, along either axis, to one pixel of a patch."""
        return self.step * self.pair.pan_px_per_coarser_px


def roles(pair: Pair) -> Roles:
    """The coarser image is the template."""
    pan = (pair.options.pan_band,)
    if pair.source_is_coarser:
        return Roles(pair, pair.source, pair.reference, pair.source_bands, pan)
    return Roles(pair, pair.reference, pair.source, pan, pair.source_bands)


def overlap_in_template(part: Roles, correction: PixelMap) -> Window | None:
    """Bounding window, in the template, of what the surface raster covers under a correction."""
    points = part.to_surface(correction).inverse(outline(part.surface.grid, _EDGE_PLACES))
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    return window_around(points, 0.0, part.template.grid)


def overlap_corners(part: Roles, correction: PixelMap) -> FloatArray:
    """(4, 2) MS pixels at the corners of the overlap's bounding window."""
    region = overlap_in_template(part, correction)
    if region is None:
        return part.pair.source_lattice(2)
    corners = corners_of(region)
    return corners if part.ms_is_template else part.to_surface(correction).forward(corners)


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Progress of one of several equal parts."""
    if progress is None:
        return None
    show = progress
    return lambda fraction, step: show((number + fraction) / count, step)
