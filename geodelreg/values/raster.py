"""Rasters as the method sees them: arrays, windows, grids, bands, and the door to their pixels.

Pixel coordinates are float64 ``(column, row)`` with the *outer corner* of the upper-left pixel
at (0, 0), as in GDAL; `geodelreg.geo.pixel` alone converts to and from pixel centres.
"Source" is the multispectral image (MS), "reference" the panchromatic one (PAN).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from affine import Affine
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
StatusArray = NDArray[np.uint8]

TINY = 1e-30
"""Keeps quotients finite: below the square of any pixel's value, above the least float64."""
MAD_TO_SIGMA = 1.4826
"""Median absolute deviation of a normal distribution to its sigma: 1 / 0.6745."""


class Window(NamedTuple):
    """A rectangle of whole pixels: offsets of its upper-left corner, then its size."""

    column: int
    row: int
    width: int
    height: int

    @property
    def edges(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First and past the last row, and column: a window of rasterio's."""
        return (self.row, self.row + self.height), (self.column, self.column + self.width)


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the pixels of a raster lie on the ground.

    Attributes
    ----------
    transform : Affine
        Pixel (outer corner) to map coordinates.
    shape : tuple of int
        ``(height, width)`` in pixels.
    crs_wkt : str
        Coordinate reference system as WKT2; map axes are in (easting, northing) order.
    unit_m : float or None
        Metres to a map unit if whoever opened the raster knew; else look it up in `crs_wkt`.
    """

    transform: Affine
    shape: tuple[int, int]
    crs_wkt: str
    unit_m: float | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """One band, or a combination of bands, of a window of a raster.

    Attributes
    ----------
    data : (H, W) float32
        Pixel values; arbitrary but finite where `valid` is False.
    valid : (H, W) bool
        True where the value is good.
    grid : Grid
        Of these pixels: of the window, and decimated if the read was.
    name : str
        For messages and reports.
    """

    data: Float32Array
    valid: BoolArray
    grid: Grid
    name: str = ""


class WindowReader(Protocol):
    """Pixels on demand.  `geodelreg.raster.reader` has it on rasterio, tests have it on arrays."""

    @property
    def grid(self) -> Grid:
        """Grid of the full raster."""

    @property
    def name(self) -> str:
        """File name, for messages."""

    @property
    def band_names(self) -> tuple[str, ...]:
        """One name per band; band numbers are 1-based positions in it."""

    def passing(self) -> AbstractContextManager[None]:
        """While this lasts, what is read will not be asked for again: no cache need keep it."""

    def read(
        self, bands: Sequence[int], window: Window, shape: tuple[int, int] | None = None
    ) -> list[Band]:
        """Read 1-based `bands` of `window`, averaged down to `shape` when given."""
