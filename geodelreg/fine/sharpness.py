"""The point spread that tells the finer image from the coarser one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from geodelreg.fine.layers import Pass
from geodelreg.fine.surface import sample
from geodelreg.fine.tiles import Tile
from geodelreg.fine.tuning import LEAST_SAMPLES, Tuning, lattice, tile_images
from geodelreg.geo.affine import apply_affine
from geodelreg.pair import Roles
from geodelreg.values.points import Status
from geodelreg.values.raster import Band, BoolArray, Float32Array, FloatArray

_USUAL = (0.3, 0.4, 0.5, 0.6, 0.7)
"""Of a pixel: Gaussian point spreads that pass 0.64 to 0.09 of the contrast at Nyquist."""
_SOFTER = (0.85, 1.0, 1.2, 1.45, 1.75)  # the coarser image was enlarged, or is out of focus
_CLEARLY = 0.9  # of what is unlike; unexplained: ablate
_MUCH_UNLIKE = 0.5
_PIXELS = 300_000  # of the finer image; unexplained: ablate
_LEAST_SAMPLES = 32  # unexplained: ablate
_SAMPLES = 8_000  # correlations are then known to 0.01


def fit_sigma(part: Roles, tiles: list[Tile], near: Pass, tuning: Tuning, size: int) -> float:
    """Low-pass with which the finer image resembles the coarser one most, in template pixels.

    Judged where patches of `size` pixels agreed in the pass before: clouds have a sharpness, too.
    """
    assert near.estimate is not None
    there = part.to_surface(near.estimate.map)
    agreed = near.matched.template_px[near.status == Status.KEPT]
    count = max(_PIXELS // max(tiles[0].surface[0].data.size, 1), 1)
    chosen = tiles[len(tiles) // (2 * count) :: max(len(tiles) // count, 1)][:count]
    per_tile = max(_SAMPLES // len(chosen), LEAST_SAMPLES)
    lattices = [lattice(tile.template[0], part, per_tile) for tile in chosen]
    covered = [_covered(part, tile.template[0], agreed, size) for tile in chosen]

    def unexplained(sigma: float) -> float:
        total = 0.0
        for tile, (xy, take), inside in zip(chosen, lattices, covered, strict=True):
            images = Tile(tile.template, tile.surface)
            (template,), surface = tile_images(part, images, replace(tuning, sigma=sigma))
            values, usable = sample(surface, there.forward(xy)[:, None])
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
