"""Where each MS band lies beside the others: matched on them, patch by patch, and not on PAN.

All bands share one pixel grid, so nothing is resampled but a band that moved.  Within a patch the
other bands, weighted freely, explain a band: contrast may change from patch to patch.  What they
leave tells how far each band lies off (Gauss-Newton; all offsets at once, for all may be moved).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geodelreg.fine.patches import cut_patches
from geodelreg.fine.surface import make_surface, sample
from geodelreg.fine.tiles import Tile
from geodelreg.geo.affine import apply_affine
from geodelreg.geo.pixel import pixel_centres
from geodelreg.pair import Roles
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import TINY, Band, FloatArray, IntArray

_TILES = 8  # evenly spread
_PATCHES = 120  # or a few more: offsets are then known to a hundredth of a pixel
_PATCHES_EACH = 5  # for each unknown: the spread of fewer does not tell how sure it is
_LEAST_SHARE = 0.5  # of a patch: valid in all bands
_STEPS = 3  # from a pixel or two off
_BLUR_PX = 1.0  # of MS: detail finer than its pixels lies with these, and draws bands onto one grid
_LARGEST_STEP_PX = 1.0
_RIDGE = 1e-6  # of the power of the bands: they may be copies of each other


@dataclass(frozen=True, slots=True, eq=False)
class BandOffsets:
    """Where the content of the bands lies beside their common place.

    Attributes
    ----------
    offset_px : (B, 2) float64
        MS pixels to the right and down; their mean, which is not known, is 0.
    covariance_px2 : (2 B, 2 B) float64
        Of these, by the spread of the patches.
    unexplained : (B,) float64
        Share of a band's variance within patches that the others do not explain, 0 to 1; that of
        the median patch.
    """

    offset_px: FloatArray
    covariance_px2: FloatArray
    unexplained: FloatArray

    def gap(self, one: int, other: int) -> tuple[FloatArray, float]:
        """How the second lies to the first, (2,) MS pixels, and the standard error along that."""
        move = self.offset_px[other] - self.offset_px[one]
        along = np.zeros_like(self.offset_px)
        along[other] = move / max(float(np.hypot(*move)), TINY)
        along[one] = -along[other]
        flat = along.ravel()
        return move, math.sqrt(max(float(flat @ self.covariance_px2 @ flat), 0.0))


class BandPatches:
    """Patches of MS that show the ground, in all bands.

    Parameters
    ----------
    part : Roles
    tiles : sequence of Tile
    ground : (N, 2) float64
        Template pixels: centres of patches that show it.
    correction : PixelMap
        MS pixels to MS header pixels.
    size : int
        Side of those patches, in template pixels of the tiles.
    """

    def __init__(
        self,
        part: Roles,
        tiles: Sequence[Tile],
        ground: FloatArray,
        correction: PixelMap,
        size: int,
    ) -> None:
        self._full, self._size = part.pair.source.grid, size
        some = tiles[:: max(len(tiles) // _TILES, 1)]
        there = None if part.ms_is_template else part.pair.to_reference(correction)
        chosen = []
        bands = [tile.template if part.ms_is_template else tile.surface for tile in some]
        for of_tile in bands:
            centre = cut_patches(of_tile[:1], self._full, size).centre
            at = centre if there is None else there.forward(centre)
            apart = np.abs(at[:, None] - ground[None]).max(axis=2)
            chosen.append(np.flatnonzero((apart <= size * part.step / 2).any(axis=1)))
        every = max(sum(map(len, chosen)) // _PATCHES, 1)
        self._tiles = [(b, c[::every]) for b, c in zip(bands, chosen, strict=True) if len(c)]

    def glance(self) -> BandOffsets | None:
        """Offsets as one step from where the bands lie says: right of small ones, and quick.

        None where too few patches show the ground.
        """
        count = len(self._tiles[0][0]) if self._tiles else 0
        return self._step(np.zeros((count, 2)), 0.0)

    def measure(self, start: FloatArray) -> BandOffsets | None:
        """Offsets to the end, from (B, 2) MS pixels."""
        at, found = start, None
        for _ in range(_STEPS):
            found = self._step(at, _BLUR_PX)
            if found is None:
                return None
            at = found.offset_px
        return found

    def _step(self, at: FloatArray, blur: float) -> BandOffsets | None:
        products = [
            self._products([self._moved(b, m, blur) for b, m in zip(bands, at, strict=True)], kept)
            for bands, kept in self._tiles
        ]
        if sum(map(len, products)) < max(_PATCHES_EACH * 2 * (len(at) - 1), 1):
            return None
        return _solved(np.concatenate(products), at)

    def _moved(self, band: Band, move: FloatArray, blur: float) -> Band:
        """A band, its content put back by (x, y) MS pixels."""
        if not (move.any() or blur):
            return band
        rows, columns = map(np.arange, band.data.shape)
        x, y = np.meshgrid(pixel_centres(columns), pixel_centres(rows))
        at = apply_affine(~self._full.transform @ band.grid.transform, np.stack([x, y], -1))
        surface = make_surface(band, self._full, (blur, blur))
        return Band(*sample(surface, at + move), band.grid, band.name)

    def _products(self, bands: list[Band], chosen: IntArray) -> FloatArray:
        """(P, 3 B, 3 B) within patches: of bands, their slopes along x, and y, less the means."""
        size, count = self._size, len(bands)
        patches = cut_patches(bands, self._full, size).take(chosen)
        valid = patches.valid.reshape(-1, 1, size, size)
        image = patches.values.reshape(-1, count, size, size).astype(np.float64)
        right = (image[:, :, 1:-1, 2:] - image[:, :, 1:-1, :-2]) / (2 * patches.step[0])
        down = (image[:, :, 2:, 1:-1] - image[:, :, :-2, 1:-1]) / (2 * patches.step[1])
        usable = valid[:, :, 1:-1, 1:-1] & valid[:, :, 1:-1, 2:] & valid[:, :, 1:-1, :-2]
        usable &= valid[:, :, 2:, 1:-1] & valid[:, :, :-2, 1:-1]
        shape = (len(image), -1, (size - 2) ** 2)
        weight = usable.reshape(shape).astype(np.float64)
        total = weight.sum(axis=2, keepdims=True)
        enough = total[:, 0, 0] > _LEAST_SHARE * weight.shape[2]
        weight, total = weight[enough], total[enough]
        rows = np.concatenate(
            [v.reshape(shape)[enough] for v in (image[:, :, 1:-1, 1:-1], right, down)], axis=1
        )
        rows -= (rows * weight).sum(axis=2, keepdims=True) / total
        rows *= weight
        return np.asarray(rows @ rows.swapaxes(1, 2) / total)


def _solved(products: FloatArray, at: FloatArray) -> BandOffsets:
    """Offsets of least squares, and how the patches' own scores spread.

    Each band is explained by the others; patches where that goes badly count for less.

    Parameters
    ----------
    products : (P, 3 B, 3 B) float64
    at : (B, 2) float64
        Offsets that the bands were moved by.
    """
    count = len(at)
    power = np.maximum(np.median(products[:, range(count), range(count)], axis=0), TINY)
    scale = np.tile(1.0 / np.sqrt(power), 3)
    products = products * scale[:, None] * scale
    normal = np.zeros((len(products), 2 * count, 2 * count))
    score = np.zeros((len(products), 2 * count))
    unexplained = np.ones(count)
    for band in range(count):
        others = np.delete(np.arange(count), band)
        known = products[:, others][:, :, others]
        ridge = _RIDGE * (1.0 + known.trace(axis1=1, axis2=2))
        known = known + ridge[:, None, None] * np.eye(count - 1)
        share = np.linalg.solve(known, products[:, others])
        rest = products - products[:, :, others] @ share
        left = np.maximum(rest[:, band, band], 0.0)
        moves = np.insert(-share[:, :, band], band, 1.0, axis=1)  # the others move, too
        moves = np.tile(moves, 2)
        trust = 1.0 / (left + np.median(left) + TINY)
        outer = moves[:, :, None] * moves[:, None]
        normal += trust[:, None, None] * rest[:, count:, count:] * outer
        score -= trust[:, None] * rest[:, count:, band] * moves
        shown = products[:, band, band]
        unexplained[band] = np.median(left / np.maximum(shown, TINY))
    # what moves all bands alike changes nothing
    apart = np.kron(np.eye(2), np.eye(count) - 1.0 / count)
    inverse = np.linalg.pinv(apart @ normal.sum(axis=0) @ apart, hermitian=True)
    step = inverse @ score.sum(axis=0)
    own = (score - normal @ step) @ inverse
    order = np.arange(2 * count).reshape(2, count).T.ravel()
    covariance = (own.T @ own)[np.ix_(order, order)]
    step *= min(1.0, _LARGEST_STEP_PX / max(float(np.abs(step).max()), TINY))
    offset = at + step[order].reshape(count, 2)
    return BandOffsets(offset - offset.mean(axis=0), covariance, np.clip(unexplained, 0.0, 1.0))
