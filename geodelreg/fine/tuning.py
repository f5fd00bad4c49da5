"""What is known about the two sensors, and the images that are matched because of it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from geodelreg.fine.overlay import placed
from geodelreg.fine.surface import Surface, high_pass, make_surface, sample
from geodelreg.fine.tiles import Tile
from geodelreg.fine.tone import SyntheticPan, fit_synthetic_pan, single_band
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.pixel import pixel_centres
from geodelreg.pair import Roles
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import Band, BoolArray, Float32Array, FloatArray, Grid

DEFAULT_SIGMA = 0.5
_TONE_SAMPLES = 8_000  # by hand: ½ to 2 × alike
LEAST_SAMPLES = 64  # by hand: ½ to 2 × alike
_USUAL = (0.3, 0.4, 0.5, 0.6, 0.7)
"""Of a pixel: Gaussian point spreads that pass 0.64 to 0.09 of the contrast at Nyquist."""
_SOFTER = (0.85, 1.0, 1.2, 1.45, 1.75)  # the coarser image was enlarged, or is out of focus
_CLEARLY = 0.9  # of what is unlike; by hand: ½ to 2 × alike
_MUCH_UNLIKE = 0.5
_PIXELS = 300_000  # of the finer image; by hand: ½ to 2 × alike
_LEAST_SAMPLES = 32  # by hand: ½ to 2 × alike
_SAMPLES = 8_000  # correlations are then known to 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """What refinement knows about the two sensors.

    Attributes
    ----------
    sigma : float
        Gaussian low-pass that brings the finer image to the coarser one's sharpness, in template
        pixels.
    tone : SyntheticPan
    high_pass : float
        Take off the mean over this standard deviation, in template pixels; 0 = do not.  Haze and
        changed light are smooth, the ground's edges are not.
    local_tone : bool
        Weight the MS bands patch by patch instead of by `tone`; only where MS is the template.
    """

    sigma: float
    tone: SyntheticPan
    high_pass: float = 0.0
    local_tone: bool = False


def surface_sigma(part: Roles, tile: Tile, sigma: float) -> tuple[float, float]:
    """Low-pass along columns and rows in pixels of the tile's surface bands."""
    template, surface = tile.template[0], tile.surface[0]
    ratio = part.surface_px_per_template_px
    coarse_t = decimation(template, part.template.grid)
    coarse_s = decimation(surface, part.surface.grid)
    across, down = (sigma * ratio * t / s for t, s in zip(coarse_t, coarse_s, strict=True))
    return across, down


def decimation(band: Band, full: Grid) -> tuple[float, float]:
    """Full-raster pixels to one pixel of a band, along columns and rows."""
    step = ~full.transform @ band.grid.transform
    return abs(step.a), abs(step.e)


def fit_tone(
    part: Roles,
    tiles: list[Tile],
    correction: PixelMap,
    sigma: float,
    samples: int = _TONE_SAMPLES,
    agreed: tuple[FloatArray, int] | None = None,
) -> SyntheticPan:
    """Weights of the MS bands that reproduce PAN; the first band where none resembles it.

    Judged everywhere, or where patches agreed, whose (N, 2) centres and side are given: areas that
    show something in one image alone have no tone.
    """
    per_tile = max(samples // len(tiles), LEAST_SAMPLES)

    def samples_of(tile: Tile) -> tuple[Float32Array, Float32Array]:
        _, take = lattice(tile.template[0], part, per_tile)
        surfaces = _surfaces(part, tile, sigma)
        place = places(part, tile.template[0], take, correction)[:, None]
        fine = [sample(surface, place) for surface in surfaces]
        good = np.logical_and.reduce([usable[:, 0] for _, usable in fine])
        good &= np.logical_and.reduce([band.valid[take] for band in tile.template])
        if agreed is not None:
            good &= _covered(part, tile.template[0], *agreed)[take]
        coarse = np.stack([band.data[take][good] for band in tile.template])
        smooth = np.stack([v[good, 0] + s.level for (v, _), s in zip(fine, surfaces, strict=True)])
        return (coarse, smooth[0]) if part.ms_is_template else (smooth, coarse[0])

    with ThreadPoolExecutor(part.pair.threads) as pool:
        bands, target = zip(*pool.map(samples_of, tiles), strict=True)
    stacked, goal = np.concatenate(bands, axis=1), np.concatenate(target)
    fitted = fit_synthetic_pan(stacked, goal) if len(goal) >= LEAST_SAMPLES else None
    return fitted or single_band(len(stacked), 0)


def _surfaces(part: Roles, tile: Tile, sigma: float) -> list[Surface]:
    low_pass, grid = surface_sigma(part, tile, sigma), part.surface.grid
    if len(tile.surface) == 1:
        return [tile.low_passed(grid, low_pass, 0.0)]
    return [make_surface(band, grid, low_pass) for band in tile.surface]


def lattice(
    band: Band, part: Roles, count: int
) -> tuple[FloatArray, tuple[np.ndarray, np.ndarray]]:
    """About `count` pixels of a template band, evenly spread: full-raster centres, and indices."""
    height, width = band.data.shape
    step = max(int(np.sqrt(height * width / count)), 1)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    rows, columns = rows.ravel(), columns.ravel()
    to_full = ~part.template.grid.transform @ band.grid.transform
    x, y = to_full @ (pixel_centres(columns), pixel_centres(rows))
    return np.stack([x, y], axis=1), (rows, columns)


def places(
    part: Roles, band: Band, take: tuple[np.ndarray, np.ndarray], correction: PixelMap
) -> FloatArray:
    """(N, 2) where pixels of a `lattice` lie in the surface raster."""
    sides = (pixel_centres(np.unique(side)) for side in take)
    return placed(part, band, correction)(*sides).reshape(-1, 2)


def tile_images(part: Roles, tile: Tile, tuning: Tuning) -> tuple[list[Band], Surface]:
    """The template band (or the bands, with local tone) and the surface of a tile."""
    low_pass, wide = surface_sigma(part, tile, tuning.sigma), 0.0
    if tuning.high_pass:
        wide = float(np.mean(surface_sigma(part, tile, tuning.high_pass)))
    if part.ms_is_template:
        templates = tile.template if tuning.local_tone else [tuning.tone(tile.template)]
        surface = tile.low_passed(part.surface.grid, low_pass, wide)
    else:
        templates = tile.template[:1]
        finer = tuning.tone(tile.surface)
        surface = make_surface(finer, part.surface.grid, low_pass, wide)
    if tuning.high_pass:
        templates = [high_pass(band, tuning.high_pass) for band in templates]
    return templates, surface


def fit_sigma(
    part: Roles,
    tiles: list[Tile],
    correction: PixelMap,
    agreed: FloatArray,
    tuning: Tuning,
    size: int,
) -> float:
    """Low-pass with which the finer image resembles the coarser one most, in template pixels.

    Judged where patches of `size` pixels agreed in the pass before, whose (N, 2) centres are given:
    clouds have a sharpness, too.
    """
    count = max(_PIXELS // max(tiles[0].surface[0].data.size, 1), 1)
    chosen = tiles[len(tiles) // (2 * count) :: max(len(tiles) // count, 1)][:count]
    per_tile = max(_SAMPLES // len(chosen), LEAST_SAMPLES)
    lattices = [lattice(tile.template[0], part, per_tile)[1] for tile in chosen]
    pixels = zip(chosen, lattices, strict=True)
    where = [places(part, tile.template[0], take, correction) for tile, take in pixels]
    covered = [_covered(part, tile.template[0], agreed, size) for tile in chosen]

    def unexplained(sigma: float) -> float:
        total = 0.0
        for tile, take, inside, place in zip(chosen, lattices, covered, where, strict=True):
            images = Tile(tile.template, tile.surface)
            (template,), surface = tile_images(part, images, replace(tuning, sigma=sigma))
            values, usable = sample(surface, place[:, None])
            good = usable[:, 0] & template.valid[take] & inside[take]
            total += _unexplained(values[good, 0], template.data[take][good])
        return total

    with ThreadPoolExecutor(part.pair.threads) as pool:
        unlike = dict(zip(_USUAL, pool.map(unexplained, _USUAL), strict=True))
    usual = min(unlike.values())
    if usual >= len(chosen):  # nowhere enough to judge by
        return tuning.sigma
    if usual > _MUCH_UNLIKE * len(chosen):  # low-passing hides more and more of what is unlike
        return lowest(unlike)
    for softer in _SOFTER:
        if min(unlike, key=unlike.__getitem__) != max(unlike):
            break
        unlike[softer] = unexplained(softer)
    if min(unlike.values()) > _CLEARLY * usual:  # changed ground is as like at any sharpness
        unlike = {sigma: unlike[sigma] for sigma in _USUAL}
    return lowest(unlike)


def _covered(part: Roles, band: Band, centres: FloatArray, size: int) -> BoolArray:
    """(H, W) True where patches of `size` pixels of a template band lie."""
    inside = np.zeros(band.data.shape, dtype=np.bool_)
    to_band = ~band.grid.transform @ part.template.grid.transform
    corners = np.rint(apply_affine(to_band, centres) - size / 2).astype(int)
    for column, row in corners.tolist():
        rows, columns = (
            slice(max(row, 0), max(row + size, 0)),
            slice(max(column, 0), max(column + size, 0)),
        )
        inside[rows, columns] = True
    return inside


def lowest(values: dict[float, float]) -> float:
    """Where the parabola through the lowest value and its neighbours is lowest."""
    places = sorted(values)
    best = min(range(len(places)), key=lambda i: values[places[i]])
    if best in (0, len(places) - 1):
        return places[best]
    near = places[best - 1 : best + 2]
    bend, slope, _ = np.polyfit(near, [values[place] for place in near], 2)
    return float(np.clip(-slope / (2 * bend), near[0], near[2])) if bend > 0 else near[1]


def _unexplained(one: Float32Array, other: Float32Array) -> float:
    if len(one) < _LEAST_SAMPLES or not (one.std() > 0 and other.std() > 0):
        return 1.0
    return 1.0 - float(np.corrcoef(one, other)[0, 1]) ** 2
