"""Which windows the refinement visits, and their pixels."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np

from geodelreg.fine.surface import SPLINE_REACH_PX, Surface, make_surface
from geodelreg.geo.grid import corners_of, window_around
from geodelreg.geo.pixel import pixel_centres
from geodelreg.pair import Roles
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Guess, Overview
from geodelreg.values.raster import Band, BoolArray, Grid, Window

PATCH_PX = 20  # square; by hand: ½: 1 of 36 refused, 1 four times as far off
_SPREAD_TILE_PATCHES = 4
_SPREAD_TILE_PATCHES_FINE = 3
_FINE_RATIO = 2.5  # by hand: ½ to 2 × alike
_ADJOINING_TILE_PATCHES = 8  # by hand: ½: 1 of 36 refused, 1 twice as far off
SMALLEST_PATCH_PX = 12  # square; by hand: 2 × refuses 5 of 36, ½: 1 thrice as far off
_WANTED_PATCHES = 40  # five times what the gate asks; by hand: ½ refuses 1 of 36, 2 × too
_MOST_TILES_PER_AXIS = 7  # by hand: ½ to 2 × alike
_DENSE_TILES_PER_AXIS = 36  # of a patch each: as many points as a field is quickly solved for
_USUAL_SIGMA = 0.7  # of a template pixel, the largest point spread that is usual
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
        """`make_surface` of the first surface band; the last one is remembered."""
        key = (*sigma_px, high_pass_px)
        with self._lock:  # several threads may match different bands of one tile
            if key not in self._memo:
                self._memo.clear()
                self._memo[key] = make_surface(self.surface[0], full, sigma_px, high_pass_px)
            return self._memo[key]


def largest_step(part: Roles) -> int:
    """`Roles.step` that leaves pixels for the patches that are wanted."""
    height, width = part.template.grid.shape
    least = _WANTED_PATCHES * SMALLEST_PATCH_PX**2
    return max(int(np.sqrt(height * width / least)), 1)


def patch_size(visible_px: float) -> int:
    """Side of a patch, in template pixels: smaller where few of them are to be seen."""
    side = np.sqrt(visible_px / _WANTED_PATCHES)
    return int(np.clip(round(float(side)), SMALLEST_PATCH_PX, PATCH_PX))


def plan_tiles(region: Window, part: Roles, dense: bool = False) -> list[Window]:
    """Template windows to visit: adjoining where there are few, else spread evenly.

    Tiles of many surface pixels are made smaller, so that all of them fit in memory.

    Parameters
    ----------
    region : Window
        Of the template, as from `geodelreg.pair.overlap_in_template`.
    part : Roles
    dense : bool
        Many small ones instead of few large ones: what is between them is asked for, too.

    Returns
    -------
    list of Window
        Whole multiples of `Roles.step` wide and high.
    """
    step, ratio = part.step, part.surface_px_per_patch_px
    size = patch_size(region.width * region.height / step**2)
    patches = _SPREAD_TILE_PATCHES if ratio < _FINE_RATIO else _SPREAD_TILE_PATCHES_FINE
    if dense:
        patches = 1
    columns = _spans(region.column, region.width, size * step, patches, dense)
    rows = _spans(region.row, region.height, size * step, patches, dense)
    return [Window(x, y, width, height) for y, height in rows for x, width in columns]


def _spans(offset: int, length: int, size: int, patches: int, dense: bool) -> list[tuple[int, int]]:
    """(start, length) of the tiles along one axis; adjoining ones hold whole patches.

    What is left over lies outside, or where it is asked for what is between patches, too, between
    the tiles: a field is least sure of what lies outside.
    """
    tile, most = size * patches, _DENSE_TILES_PER_AXIS if dense else _MOST_TILES_PER_AXIS
    if length > most * size * (1 if dense else _SPREAD_TILE_PATCHES):
        gaps = np.linspace(0, length - tile, most)
        return [(offset + round(float(gap)), tile) for gap in gaps]
    count = length // size
    tiles = -(-count // _ADJOINING_TILE_PATCHES)
    firsts = _ADJOINING_TILE_PATCHES * np.arange(tiles + 1)
    over = length - count * size
    before = np.full(tiles, over // 2)
    if dense and tiles > 1:
        before = np.rint(np.linspace(0, over, tiles)).astype(int)
    ends = np.minimum(firsts, count) * size
    return [
        (offset + int(gap + start), int(end - start))
        for gap, start, end in zip(before, ends, ends[1:], strict=False)
    ]


def read_tile(part: Roles, window: Window, correction: PixelMap) -> Tile | None:
    """Read a template window and the surface window around where it should lie."""
    place = part.to_surface(correction).forward(corners_of(window))
    if not np.isfinite(place).all():
        return None
    ratio = part.surface_px_per_patch_px
    margin = (_USUAL_SIGMA * _LOW_PASS_REACH + _SLACK_PX) * ratio + SPLINE_REACH_PX
    around = window_around(place, margin, part.surface.grid)
    if around is None:
        return None
    shape = (window.height // part.step, window.width // part.step)
    return Tile(
        part.template.read(part.template_bands, window, shape),
        part.surface.read(part.surface_bands, around),
    )


def read_tiles(part: Roles, windows: list[Window], correction: PixelMap) -> list[Tile]:
    """Read planned tiles, in order; those that lie outside the surface raster are left out."""
    threads = part.pair.threads
    with part.surface.passing(), part.template.passing(), ThreadPoolExecutor(threads) as pool:
        tiles = pool.map(lambda window: read_tile(part, window, correction), windows)
        return [tile for tile in tiles if tile is not None]


def overview_tile(part: Roles, images: Overview) -> Tile:
    """The decimated pair as one tile."""
    if part.ms_is_template:
        return Tile(images.source, [images.reference])
    return Tile([images.reference], images.source)


def dark_tile(part: Roles, tile: Tile, guess: Guess) -> Tile:
    """The tile without the bright objects of a guess that has some."""
    assert guess.bright is not None
    source = guess.bright[0], guess.images.source[0].grid
    reference = guess.bright[1], guess.images.reference.grid
    template, surface = (source, reference) if part.ms_is_template else (reference, source)
    return Tile(
        [_hide(band, *template) for band in tile.template],
        [_hide(band, *surface) for band in tile.surface],
    )


def _hide(band: Band, mask: BoolArray, mask_grid: Grid) -> Band:
    """The band with the pixels under a (coarser) mask of the same raster made invalid."""
    to_mask = ~mask_grid.transform @ band.grid.transform
    height, width = band.data.shape
    columns = np.floor(to_mask.a * pixel_centres(np.arange(width)) + to_mask.c).astype(np.intp)
    rows = np.floor(to_mask.e * pixel_centres(np.arange(height)) + to_mask.f).astype(np.intp)
    columns = np.clip(columns, 0, mask.shape[1] - 1)
    rows = np.clip(rows, 0, mask.shape[0] - 1)
    return replace(band, valid=band.valid & ~mask[np.ix_(rows, columns)])
