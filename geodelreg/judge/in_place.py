"""Whether patches resemble the other image best just where the correction puts them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geodelreg.fine.least_squares import MIN_CORRELATION, least_valid
from geodelreg.fine.patches import Patches, centred, cut_patches, patch_offsets, sample_step
from geodelreg.fine.surface import Surface, sample
from geodelreg.fine.texture import noise_of, show_texture
from geodelreg.fine.tiles import Tile
from geodelreg.fine.tuning import Tuning, tile_images
from geodelreg.fit.chance import log10_binomial_tail
from geodelreg.pair import Roles
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import Band, BoolArray, FloatArray, IntArray

_DISPLACED_RADII = (4.0, 9.0)  # patch pixels, beyond the texture's width; by hand: ½ to 2 × alike
_DIRECTIONS = 8  # at each radius: 16 places
_BY_CHANCE = 0.125  # twice 1/17: the best of 17 like places; by hand: ½ to 2 × alike
_TESTED_PATCHES = 160  # by hand: ½ to 2 × alike
_LEAST_DISPLACED = 8  # half of the places
_RESEMBLES = MIN_CORRELATION**2  # share of the variance that is explained
_FEWEST_TEXTURED = 8
"""Fewer than these prove nothing even if all are best in place: 0.125^8 by chance, and rarely all
are; then what varies from pixel to pixel may be the ground itself, not noise."""


class AreaEvidence(NamedTuple):
    """How areas correlate where the correction puts them.

    Attributes
    ----------
    tested, best_in_place : int
        Textured patches, and those that correlate better in place than at any displaced place.
    alike, alike_in_place : int
        The same of patches that resemble the other image at any of the places.
    log_chance : float
        log10 of the probability of `best_in_place` by chance.
    """

    tested: int = 0
    best_in_place: int = 0
    alike: int = 0
    alike_in_place: int = 0

    @property
    def log_chance(self) -> float:
        """log10 P(as many by chance)."""
        return log10_binomial_tail(self.best_in_place, self.tested, _BY_CHANCE)

    @property
    def support(self) -> float:
        """Share of the patches that resemble something that do so best in place; NaN of none."""
        return self.alike_in_place / self.alike if self.alike else float("nan")


def area_evidence(
    part: Roles, tiles: list[Tile], correction: PixelMap, tuning: Tuning, size: int, few: bool
) -> AreaEvidence:
    """Compare correlation in place with that at displaced places, patch by patch.

    Parameters
    ----------
    part, tiles, correction, tuning
        As for `geodelreg.fine.matching.match_pass`.
    size : int
        Side of a patch, template pixels.
    few : bool
        Test a sample of the patches instead of all.
    """
    angle = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.concatenate([np.zeros((1, 2)), *(ring * radius for radius in _DISPLACED_RADII)])
    every = sample_step([tile.template[0] for tile in tiles], size, _TESTED_PATCHES) if few else 1
    there = part.to_surface(correction)

    def asked(flat_too: bool) -> AreaEvidence:
        counts = [AreaEvidence()]
        for number, tile in enumerate(tiles):
            bands, surface = tile_images(part, tile, tuning)
            patches = cut_patches(bands, part.template.grid, size)
            chosen = np.arange(number % every, len(patches), every)
            if not flat_too:
                chosen = chosen[_textured(bands, patches.take(chosen))]
            scores = _explained(there, surface, patches, chosen, offsets)
            counts.append(best_in_place(scores))
        return AreaEvidence(*map(sum, zip(*counts, strict=True)))

    textured = asked(flat_too=False)
    return textured if textured.tested >= _FEWEST_TEXTURED else asked(flat_too=True)


def _textured(bands: list[Band], patches: Patches) -> BoolArray:
    """(P,) True for patches that show more than noise in any band."""
    shape = (len(patches), patches.size, patches.size)
    found = np.zeros(len(patches), dtype=np.bool_)
    for band, values in zip(bands, patches.values.swapaxes(0, 1), strict=True):
        found |= show_texture(values.reshape(shape), noise_of(band.data, band.valid))
    return found


def best_in_place(scores: FloatArray) -> AreaEvidence:
    """Count the patches that score best in place.

    Parameters
    ----------
    scores : (P, K) float64
        In place first, then at displaced places; NaN where a place cannot be seen.
    """
    seen = np.isfinite(scores)
    enough = seen[:, 0] & (seen[:, 1:].sum(axis=1) >= _LEAST_DISPLACED)
    ranked = np.where(seen[enough], scores[enough], -np.inf)
    if not len(ranked):
        return AreaEvidence()
    best = ranked.argmax(axis=1) == 0
    alike = ranked.max(axis=1) >= _RESEMBLES
    return AreaEvidence(len(best), int(best.sum()), int(alike.sum()), int((best & alike).sum()))


def _explained(
    to_surface: PixelMap, surface: Surface, patches: Patches, chosen: IntArray, offsets: FloatArray
) -> FloatArray:
    """(P, K) share of the surface's variance that the bands explain, per patch and offset.

    NaN where too little of the patch lies on the surface; patches without texture are left out.
    """
    size = patches.size
    picked = np.arange(0, size, 2)
    take = (picked[:, None] * size + picked[None, :]).ravel()
    spots = (offsets[:, None, :] + patch_offsets(picked, size)[None]).reshape(-1, 2) * patches.step
    # a patch is so small that its local affine puts its pixels where a map that bends does
    local = to_surface.linearise(patches.centre[chosen])
    place = local[:, None, :, 2] + np.einsum("pij,sj->psi", local[:, :, :2], spots)
    there, usable = sample(surface, place)
    shape = (len(chosen), len(offsets), len(take))
    seen = usable.reshape(shape) & patches.valid[chosen][:, None, take]
    weight = seen.astype(np.float64)[:, :, None]
    values = patches.values[chosen][:, None, :, take]
    alike = bool((seen == seen[:, :1]).all())  # then one basis serves all offsets
    bands = centred(values.astype(np.float64), weight[:, :1] if alike else weight)
    image = centred(there.reshape(shape)[:, :, None].astype(np.float64), weight)
    basis, _ = np.linalg.qr(bands.swapaxes(2, 3))
    explained = (np.matmul(image, basis) ** 2).sum(axis=(2, 3))
    energy = (image**2).sum(axis=(2, 3))
    share = seen.mean(axis=2)
    least = least_valid(share[:, 0])
    good = share > least * share[:, :1]  # elsewhere other pixels are hidden than those of the patch
    good[:, 0] = share[:, 0] > least
    good &= (np.abs(bands).sum(axis=(2, 3)) > 0) & (energy > 0)
    return np.where(good, explained / np.where(good, energy, 1.0), np.nan)
