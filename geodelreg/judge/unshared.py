"""Structure that one image shows and the other lacks: it moves all patches alike, and no residual.

Where PAN sees light that no MS band saw, the ground has edges and shadows in one image alone.  They
lie where the ground's do, only slightly to one side, and pull every patch that way: patches agree,
and are all wrong by a little.  How much such structure there is can be told, for unlike noise it is
wider than a pixel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geodelreg.fine.passes import Refinement
from geodelreg.fine.patches import centred, cut_patches, patch_offsets, sample_step
from geodelreg.fine.surface import sample_patches
from geodelreg.fine.tuning import tile_images
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import TiePoints
from geodelreg.values.raster import BoolArray, Float32Array, FloatArray

PULL_PX = 0.11
"""Standard error, pixels of the coarser image, where all that a patch shows is unshared.

Set on 199 simulated pairs of six sources, PAN and MS of different bands, so that the normalised
error has an RMS of 1 when each source counts the same; on others of these sources
(`python -m benchmarks unshared`) it has 0.8 to 0.9, of bands that were brought together."""
_PATCHES = 150  # their mean is known to a tenth
_NEIGHBOURS = 0.3
"""Correlation of adjoining pixels of structure finer than a pixel: exp(−1 / 4σ²) behind the usual
point spread of σ = 0.46 px.  In the pairs above it is 0.22 to 0.39, of noise 0."""
_BY_POINT_SPREAD = 0.05
"""What is left of it where both images show the same: their point spreads differ a little.  Of
pairs of one spectral mix the median, in docs/uncertainty.md's simulation."""


def unshared_share(refined: Refinement, correction: PixelMap, points: TiePoints) -> float:
    """Share of what patches show (of their variance) that is structure of one image alone.

    Noise is not: it is white, while structure has passed a point spread, so that adjoining pixels
    of it are alike.  The median of the patches that agree.

    Parameters
    ----------
    refined : Refinement
    correction : PixelMap
        MS pixels to MS header pixels.
    points : TiePoints
        Of all patches of the tiles, in their order.

    Returns
    -------
    float
        0 to 1; 0 where nothing can be told.
    """
    part, size = refined.part, refined.size
    tuning = replace(refined.tuning, local_tone=False)  # which would follow what is not shared
    there = part.to_surface(correction)
    every = sample_step([tile.template[0] for tile in refined.tiles], size, _PATCHES)
    offsets = patch_offsets(np.arange(-1, size + 1), size)
    left, alike, first = [], [], 0
    for tile in refined.tiles:
        images, surface = tile_images(part, tile, tuning)
        patches = cut_patches(images, part.template.grid, size)
        kept = points.kept[first : first + len(patches)]
        first += len(patches)
        chosen = np.flatnonzero(kept)[::every]
        if not len(chosen):
            continue
        patches = patches.take(chosen)
        local = there.linearise(patches.centre)
        owner = np.zeros(len(chosen), dtype=np.intp)
        values, usable = sample_patches(
            [surface], owner, local[:, :, 2], local[:, :, :2] * patches.step, offsets
        )
        wide = (len(chosen), size + 2, size + 2)
        inner = usable.reshape(wide)[:, 1:-1, 1:-1].reshape(len(chosen), -1) & patches.valid
        unexplained, neighbours = _unexplained(values.reshape(wide), patches.values, inner, size)
        left.append(unexplained)
        alike.append(neighbours)
    return _share(np.concatenate(left), np.concatenate(alike)) if left else 0.0


def _share(unexplained: FloatArray, neighbours: FloatArray) -> float:
    """From shares of the variance, of each patch: unexplained, and that neighbours share of it."""
    known = np.isfinite(unexplained)
    if not known.any():
        return 0.0
    most, shared = (float(np.median(v[known])) for v in (unexplained, neighbours))
    return float(np.clip((shared - _BY_POINT_SPREAD * most) / _NEIGHBOURS, 0.0, most))


def _unexplained(
    image: Float32Array, template: Float32Array, usable: BoolArray, size: int
) -> tuple[FloatArray, FloatArray]:
    """(P,) share of an image's variance that the template and a shift leave, and neighbours' in it.

    Parameters
    ----------
    image : (P, n + 2, n + 2) float32
    template : (P, 1, n²) float32
    usable : (P, n²) bool
    size : int
        n.

    Returns
    -------
    unexplained, neighbours : (P,) float64
        Mean square of what is left, and mean product of adjoining pixels of it, over the image's
        variance; NaN of patches that show nothing.
    """
    weight = usable[:, None].astype(np.float64)
    total = np.maximum(weight.sum(axis=(1, 2)), 1.0)
    slopes = (
        image[:, 1:-1, 1:-1],
        image[:, 1:-1, 2:] - image[:, 1:-1, :-2],
        image[:, 2:, 1:-1] - image[:, :-2, 1:-1],
    )
    rows = np.stack([*(v.reshape(len(image), -1) for v in slopes), template[:, 0]], axis=1)
    rows = centred(rows, weight)
    target = rows[:, :1]
    basis, _ = np.linalg.qr(rows[:, 1:].swapaxes(1, 2))
    rest = target - np.matmul(np.matmul(target, basis), basis.swapaxes(1, 2))
    rest, good = (v.reshape(-1, size, size) for v in (rest, usable))
    product, pairs = np.zeros(len(image)), np.zeros(len(image))
    for one, other in ((np.s_[:, :, 1:], np.s_[:, :, :-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        product += (rest[one] * rest[other]).sum(axis=(1, 2))
        pairs += (good[one] & good[other]).sum(axis=(1, 2))
    variance = (target**2).sum(axis=(1, 2)) / total
    variance[variance <= 0] = np.nan
    left = (rest**2).sum(axis=(1, 2)) / total
    return left / variance, product / np.maximum(pairs, 1.0) / variance
