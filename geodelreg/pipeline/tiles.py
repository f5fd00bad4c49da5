"""Which windows the refinement visits, and their pixels."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np

from geodelreg.geo.pixel import pixel_centres
from geodelreg.image.environment import TILES_BYTES, passing_through
from geodelreg.match.surface import SPLINE_REACH_PX, Surface, make_surface
from geodelreg.pipeline.state import Pair
from geodelreg.types import Band, BoolArray, FloatArray, Grid, Window, WindowReader

PATCH_PX = 20
_SPREAD_TILE_PATCHES = 4
_SPREAD_TILE_PATCHES_FINE = 3
_FINE_RATIO = 2.5
_ADJOINING_TILE_PATCHES = 8
_MEMO = 1
SMALLEST_PATCH_PX = 12
_WANTED_PATCHES = 40
_MOST_TILES_PER_AXIS = 7
_LOW_PASS_REACH = 4.0
_SLACK_PX = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """Pixels of one place in both images.

    Attributes
    ----------
    template : list of Band
        Of the coarser image: the MS bands, or PAN.
    surface : list of Band
        Of the finer image.
    """

    template: list[Band]
    surface: list[Band]
    _memo: dict[tuple[float, float, float], Surface] = field(default_factory=dict, repr=False)
    _lock: Lock = field(default_factory=Lock, repr=False)

    def low_passed(self, full: Grid, sigma_px: tuple[float, float], high_pass_px: float) -> Surface:
        """`make_surface` of the first surface band; the last few are remembered."""
        key = (*sigma_px, high_pass_px)
        with self._lock:  # several threads may match different bands of one tile
            if key not in self._memo:
                while len(self._memo) >= _MEMO:
                    del self._memo[next(iter(self._memo))]
                self._memo[key] = make_surface(self.surface[0], full, sigma_px, high_pass_px)
            return self._memo[key]


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

    def to_surface(self, matrix: FloatArray, template_px: FloatArray) -> FloatArray:
        """(..., 2) template pixels to surface pixels under a correction `matrix`."""
        go = self.pair.to_reference if self.pair.source_is_coarser else self.pair.to_source
        return go(matrix, template_px)

    def to_template(self, matrix: FloatArray, surface_px: FloatArray) -> FloatArray:
        """The inverse of `to_surface`."""
        go = self.pair.to_source if self.pair.source_is_coarser else self.pair.to_reference
        return go(matrix, surface_px)

    @property
    def surface_px_per_template_px(self) -> float:
        """GSD ratio, at least 1."""
        ratio = self.pair.pan_px_per_source_px
        return ratio if self.pair.source_is_coarser else 1.0 / ratio

    @property
    def surface_px_per_patch_px(self) -> float:
        """Surface pixels, along either axis, to one pixel of a patch."""
        return self.step * self.surface_px_per_template_px

    @property
    def pan_px_per_patch_px(self) -> float:
        """PAN pixels, along either axis, to one pixel of a patch."""
        return self.step * max(self.pair.pan_px_per_source_px, 1.0)

    @property
    def largest_step(self) -> int:
        """Step that leaves pixels for the patches that are wanted."""
        height, width = self.template.grid.shape
        least = _WANTED_PATCHES * SMALLEST_PATCH_PX**2
        return max(int(np.sqrt(height * width / least)), 1)

    def ms_is_template(self) -> bool:
        """True when the MS image is the coarser one."""
        return self.pair.source_is_coarser


def roles(pair: Pair) -> Roles:
    """The coarser image is the template."""
    pan = (pair.options.pan_band,)
    if pair.source_is_coarser:
        return Roles(pair, pair.source, pair.reference, pair.source_bands, pan)
    return Roles(pair, pair.reference, pair.source, pan, pair.source_bands)


def overlap_in_template(part: Roles, matrix: FloatArray) -> Window | None:
    """Bounding window, in the template, of what the surface raster covers under `matrix`."""
    height, width = part.surface.grid.shape
    t = np.linspace(0.0, 1.0, 17)
    edge = np.concatenate(
        [
            np.stack([t * width, 0 * t], 1),
            np.stack([t * width, 0 * t + height], 1),
            np.stack([0 * t, t * height], 1),
            np.stack([0 * t + width, t * height], 1),
        ]
    )
    points = part.to_template(matrix, edge)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    return _clip(points.min(axis=0), points.max(axis=0), part.template.grid)


def overlap_corners(part: Roles, matrix: FloatArray) -> FloatArray:
    """(4, 2) MS pixels at the corners of the overlap's bounding window."""
    region = overlap_in_template(part, matrix)
    if region is None:
        return part.pair.corners()
    x = np.array([region.column, region.column + region.width], dtype=np.float64)
    y = np.array([region.row, region.row + region.height], dtype=np.float64)
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[0], y[1]], [x[1], y[1]]])
    return corners if part.ms_is_template() else part.to_surface(matrix, corners)


def _clip(low: FloatArray, high: FloatArray, grid: Grid) -> Window | None:
    height, width = grid.shape
    x0, y0 = (int(v) for v in np.floor(np.clip(low, 0, (width, height))))
    x1, y1 = (int(v) for v in np.ceil(np.clip(high, 0, (width, height))))
    return Window(x0, y0, x1 - x0, y1 - y0) if x1 > x0 and y1 > y0 else None


def patch_size(visible_px: float) -> int:
    """Side of a patch, in template pixels: smaller where few of them are to be seen."""
    side = np.sqrt(visible_px / _WANTED_PATCHES)
    return int(np.clip(round(float(side)), SMALLEST_PATCH_PX, PATCH_PX))


def plan_tiles(region: Window, part: Roles) -> list[Window]:
    """Template windows to visit: adjoining where there are few, else spread evenly.

    Tiles of many surface pixels are made smaller, so that all of them fit in memory.

    Parameters
    ----------
    region : Window
        Of the template, as from `overlap_in_template`.
    part : Roles

    Returns
    -------
    list of Window
        Whole multiples of `Roles.step` wide and high.
    """
    step, ratio = part.step, part.surface_px_per_patch_px
    size = patch_size(region.width * region.height / step**2)
    patches = _SPREAD_TILE_PATCHES if ratio < _FINE_RATIO else _SPREAD_TILE_PATCHES_FINE
    columns = _spans(region.column, region.width, size * step, patches)
    rows = _spans(region.row, region.height, size * step, patches)
    return [Window(x, y, width, height) for y, height in rows for x, width in columns]


def _spans(offset: int, length: int, size: int, patches: int) -> list[tuple[int, int]]:
    """(start, length) of the tiles along one axis; adjoining ones hold whole patches."""
    tile = size * patches
    if length > _MOST_TILES_PER_AXIS * size * _SPREAD_TILE_PATCHES:
        gaps = np.linspace(0, length - tile, _MOST_TILES_PER_AXIS)
        return [(offset + round(float(gap)), tile) for gap in gaps]
    tile, usable = size * _ADJOINING_TILE_PATCHES, length // size * size
    first = offset + (length - usable) // 2
    return [(first + start, min(tile, usable - start)) for start in range(0, usable, tile)]


def read_tile(part: Roles, window: Window, matrix: FloatArray) -> Tile | None:
    """Read a template window and the surface window around where it should lie."""
    corners = np.array(
        [
            [window.column + dx * window.width, window.row + dy * window.height]
            for dx in (0, 1)
            for dy in (0, 1)
        ],
        dtype=np.float64,
    )
    place = part.to_surface(matrix, corners)
    if not np.isfinite(place).all():
        return None
    ratio = part.surface_px_per_patch_px
    margin = (0.7 * _LOW_PASS_REACH + _SLACK_PX) * ratio + SPLINE_REACH_PX
    around = _clip(place.min(axis=0) - margin, place.max(axis=0) + margin, part.surface.grid)
    if around is None:
        return None
    shape = (window.height // part.step, window.width // part.step)
    return Tile(
        part.template.read(part.template_bands, window, shape),
        part.surface.read(part.surface_bands, around),
    )


def hide(band: Band, mask: BoolArray, mask_grid: Grid) -> Band:
    """The band with the pixels under a (coarser) mask of the same raster made invalid."""
    to_mask = ~mask_grid.transform @ band.grid.transform
    height, width = band.data.shape
    columns = np.floor(to_mask.a * pixel_centres(np.arange(width)) + to_mask.c).astype(np.intp)
    rows = np.floor(to_mask.e * pixel_centres(np.arange(height)) + to_mask.f).astype(np.intp)
    columns = np.clip(columns, 0, mask.shape[1] - 1)
    rows = np.clip(rows, 0, mask.shape[0] - 1)
    return replace(band, valid=band.valid & ~mask[np.ix_(rows, columns)])


def read_tiles(part: Roles, windows: list[Window], matrix: FloatArray, threads: int) -> list[Tile]:
    """Read planned tiles, in order; those that lie outside the surface raster are left out."""
    with passing_through(TILES_BYTES), ThreadPoolExecutor(max(threads, 1)) as pool:
        tiles = pool.map(lambda window: read_tile(part, window, matrix), windows)
        return [tile for tile in tiles if tile is not None]
