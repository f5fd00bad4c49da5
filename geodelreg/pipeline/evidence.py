"""Evidence from pixels that the fit has not used, and grey-value measures before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.fit.gate import log10_binomial_tail
from geodelreg.geo.pixel import pixel_centres
from geodelreg.match.area import Overlay
from geodelreg.match.refine import Patches, cut_patches
from geodelreg.match.surface import Surface, sample
from geodelreg.pipeline.dense import Tuning, tile_images
from geodelreg.pipeline.tiles import Roles, Tile
from geodelreg.types import Band, FloatArray, IntArray

_DISPLACED_RADII = (4.0, 9.0)
_DIRECTIONS = 8
_BY_CHANCE = 0.25
_TESTED_PATCHES = 160
_LEAST_SEEN = 0.6


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
    part: Roles, tiles: list[Tile], matrix: FloatArray, tuning: Tuning, size: int, few: bool
) -> AreaEvidence:
    """Compare correlation in place with that at displaced places, patch by patch.

    Parameters
    ----------
    part, tiles, matrix, tuning
        As for `geodelreg.pipeline.dense.match_pass`.
    size : int
        Side of a patch, template pixels.
    few : bool
        Test a sample of the patches instead of all.
    """
    angle = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.concatenate([np.zeros((1, 2)), *(ring * radius for radius in _DISPLACED_RADII)])
    every = max(len(tiles) * 16 // _TESTED_PATCHES, 1) if few else 1
    tested = best = 0
    for number, tile in enumerate(tiles):
        bands, surface = tile_images(part, tile, tuning)
        patches = cut_patches(bands, part.template.grid, size)
        chosen = np.arange(number % every, len(patches), every)
        scores = _explained(part, matrix, surface, patches, chosen, offsets)
        tested += len(scores)
        best += int((scores.argmax(axis=1) == 0).sum()) if len(scores) else 0
    return AreaEvidence(tested, best)


def _explained(
    part: Roles,
    matrix: FloatArray,
    surface: Surface,
    patches: Patches,
    chosen: IntArray,
    offsets: FloatArray,
) -> FloatArray:
    """(P, K) share of the surface's variance that the bands explain, per patch and offset.

    Patches without texture or outside the surface are left out.
    """
    size = patches.size
    picked = np.arange(0, size, 2)
    axis = pixel_centres(picked) - size / 2.0
    grid_x, grid_y = np.meshgrid(axis, axis)
    inside = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    take = (picked[:, None] * size + picked[None, :]).ravel()
    spots = (offsets[:, None, :] + inside[None]).reshape(-1, 2) * patches.step
    xy = patches.centre[chosen][:, None, :] + spots[None]
    there, usable = sample(surface, part.to_surface(matrix, xy))
    there = there.reshape(len(chosen), len(offsets), -1).astype(np.float64)
    seen = usable.reshape(there.shape).all(axis=1) & patches.valid[chosen][:, take]
    good = seen.mean(axis=1) > _LEAST_SEEN
    weight = seen[good][:, None, :].astype(np.float64)
    bands = _centred(patches.values[chosen[good]][:, :, take].astype(np.float64), weight)
    image = _centred(there[good], weight)
    basis, _ = np.linalg.qr(bands.transpose(0, 2, 1))
    explained = (np.matmul(image, basis) ** 2).sum(axis=2)
    energy = np.maximum((image**2).sum(axis=2), 1e-12)
    textured = (np.abs(bands).sum(axis=(1, 2)) > 0) & (energy.min(axis=1) > 1e-9)
    return np.asarray((explained / energy)[textured])


def _centred(values: FloatArray, weight: FloatArray) -> FloatArray:
    mean = (values * weight).sum(axis=2, keepdims=True) / weight.sum(axis=2, keepdims=True)
    return np.asarray((values - mean) * weight)


def overlay(part: Roles, template: Band, surface: Surface, matrix: FloatArray) -> Overlay:
    """Resample a surface onto a (decimated) template window under a correction `matrix`."""
    height, width = template.data.shape
    to_full = ~part.template.grid.transform @ template.grid.transform
    columns, rows = np.meshgrid(*(pixel_centres(np.arange(side)) for side in (width, height)))
    x, y = to_full @ (columns, rows)
    values, usable = sample(surface, part.to_surface(matrix, np.stack([x, y], axis=-1)))
    return Overlay(template.data, values, template.valid, usable)


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
