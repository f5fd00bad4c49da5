"""Evidence from pixels that the fit has not used, and grey-value measures before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.fit.gate import log10_binomial_tail
from geodelreg.geo.pixel import HALF_PIXEL
from geodelreg.match.area import Overlay
from geodelreg.match.refine import Patches, cut_patches
from geodelreg.match.surface import Surface, sample
from geodelreg.pipeline.dense import Tuning, tile_images
from geodelreg.pipeline.tiles import Roles, Tile
from geodelreg.types import Band, FloatArray

_DISPLACED_RADII = (4.0, 9.0)
_DIRECTIONS = 8
_BY_CHANCE = 0.25
_TESTED_PATCHES = 160


@dataclass(frozen=True, slots=True)
class AreaEvidence:
    """How areas correlate where the correction puts them.

    Attributes
    ----------
    tested, best_in_place : int
        Textured patches, and those that correlate better in place than at any displaced place.
    log_chance : float
        log10 of the probability of that by chance.
    """

    tested: int
    best_in_place: int

    @property
    def log_chance(self) -> float:
        """log10 P(as many by chance)."""
        return log10_binomial_tail(self.best_in_place, self.tested, _BY_CHANCE)


def area_evidence(
    part: Roles, tiles: list[Tile], matrix: FloatArray, tuning: Tuning, size: int
) -> AreaEvidence:
    """Compare correlation in place with that at displaced places, patch by patch.

    Parameters
    ----------
    part, tiles, matrix, tuning
        As for `geodelreg.pipeline.dense.match_pass`.
    size : int
        Side of a patch, template pixels.
    """
    angle = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.concatenate([np.zeros((1, 2)), *(ring * radius for radius in _DISPLACED_RADII)])
    every = max(len(tiles) * 16 // _TESTED_PATCHES, 1)
    tested = best = 0
    for number, tile in enumerate(tiles):
        template, surface = tile_images(part, tile, tuning)
        patches = cut_patches(template, part.template.grid, size)
        for index in range(number % every, len(patches), every):
            scores = _correlations(part, matrix, surface, patches, index, offsets)
            if scores is not None:
                tested += 1
                best += int(np.argmax(scores) == 0)
    return AreaEvidence(tested, best)


def _correlations(
    part: Roles,
    matrix: FloatArray,
    surface: Surface,
    patches: Patches,
    index: int,
    offsets: FloatArray,
) -> FloatArray | None:
    """|correlation| of one patch at each offset; None where it has no texture or no surface."""
    size = patches.size
    axis = (np.arange(0, size, 2) + HALF_PIXEL - size / 2.0)
    grid_x, grid_y = np.meshgrid(axis, axis)
    inside = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    picked = np.arange(0, size, 2)
    take = (picked[:, None] * size + picked[None, :]).ravel()
    values, valid = patches.values[index, take], patches.valid[index, take]
    xy = patches.centre[index] + (offsets[:, None, :] + inside[None]) * patches.step
    there, usable = sample(surface, part.to_surface(matrix, xy))
    good = valid & usable.all(axis=0)
    if good.sum() < 0.6 * len(take) or values[good].std() == 0:
        return None
    one = values[good] - values[good].mean()
    other = there[:, good] - there[:, good].mean(axis=1, keepdims=True)
    power = np.sqrt((other**2).sum(axis=1) * (one**2).sum())
    return np.asarray(np.abs(other @ one) / np.maximum(power, 1e-12), dtype=np.float64)


def overlay(
    part: Roles, template: Band, surface: Surface, matrix: FloatArray
) -> Overlay:
    """Resample a surface onto a (decimated) template window under a correction `matrix`."""
    height, width = template.data.shape
    to_full = ~part.template.grid.transform @ template.grid.transform
    columns, rows = np.meshgrid(np.arange(width) + HALF_PIXEL, np.arange(height) + HALF_PIXEL)
    x, y = to_full @ (columns, rows)
    values, usable = sample(surface, part.to_surface(matrix, np.stack([x, y], axis=-1)))
    return Overlay(template.data, values, usable & template.valid)


def grey_rmse(overlaid: Overlay, ms_is_template: bool) -> float:
    """E1: RMSE of grey values between PAN and MS after histogram matching, in DN of PAN.

    Zhang, Ma & Zhang 2013, on common valid pixels.
    """
    good = overlaid.valid
    if good.sum() < 64:
        return float("nan")
    template, surface = overlaid.template[good], overlaid.surface[good]
    ms, pan = (template, surface) if ms_is_template else (surface, template)
    matched = np.empty(len(ms), dtype=np.float64)
    matched[np.argsort(ms, kind="stable")] = np.sort(pan)
    return float(np.sqrt(np.mean((matched - pan) ** 2)))


def correlation(overlaid: Overlay) -> float:
    """Correlation of the two images on common valid pixels."""
    good = overlaid.valid
    if good.sum() < 64:
        return float("nan")
    one, other = overlaid.template[good], overlaid.surface[good]
    if one.std() == 0 or other.std() == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])
