"""Where each MS band lies: one common map, and a small one more for each band, found together.

The bands of a pushbroom sensor look from slightly different places, so that no one correction is
right for all of them.  A band by itself looks unlike PAN where the ground has another colour, and
seems displaced by that.  So each band is held against PAN and, once those have found their places,
all other bands, weighted patch by patch: what is left is the band's own displacement (least squares
over the pixels of the tiles, Gauss-Newton; the sandwich over tiles tells how sure that is).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from affine import Affine

from geodelreg.fine.passes import Refinement
from geodelreg.fine.surface import make_surface, sample
from geodelreg.fine.tiles import Tile
from geodelreg.fine.tone import single_band
from geodelreg.fine.tuning import lattice, places, tile_images
from geodelreg.fit.models import Frame, generators
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.values.maps import PixelMap
from geodelreg.values.raster import BoolArray, FloatArray
from geodelreg.values.result import BandMap

_BLURS_PX = (2.0, 2.0, 1.0, 0.0, 0.0)
"""Of MS, from step to step against PAN alone: a band is found from so far off, then exactly."""
_TOGETHER = 4  # steps more against all others: each takes up most of what is left
_TOGETHER_BLUR_PX = 1.0
"""Of MS: bands hold detail finer than their pixels, which lies with the pixels and not with the
ground, so that two of them draw each other onto one grid: by up to 0.07 PAN px at 4:1 without."""
_MOST_PIXELS = 300_000  # of MS: a band is then known to some hundredths of a PAN pixel
_EDGE_PX = 4  # of a tile, where gradients and displaced bands see what lies outside
_FEWEST_PIXELS = 64  # of a patch: more than there are unknowns
_MOST_SIGMA_PX = 0.1  # of MS: a band of which less is known is not said to lie anywhere
_REACH_PX = 4.0  # of MS: twice the first blur
_System = tuple[FloatArray, FloatArray, float, int]
"""Normal matrix and right side of a part, its sum of squares, and its pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One tile: its pixels, where all is valid, and PAN there."""

    tile: Tile
    xy: FloatArray
    good: BoolArray
    pan: FloatArray


def match_each_band(
    refined: Refinement, common: PixelMap, common_model: str, model: str
) -> tuple[BandMap, ...]:
    """Find the displacement of each band with what is left of the common map.

    Parameters
    ----------
    refined : Refinement
        Whose template is MS.
    common : PixelMap
        MS pixels to MS header pixels, for all bands.
    common_model : str
        Of that map.
    model : str
        Of a band's displacement: ``shift`` or ``affine``.

    Returns
    -------
    tuple of BandMap
        Of each band that is matched on and that shows enough.
    """
    fit = _Fit(refined, common, common_model, model)
    for blur in _BLURS_PX:
        fit.step(blur, against=())
    sure = [band for band in fit.bands if fit.is_sure(band)]
    for _ in range(_TOGETHER):
        fit.step(_TOGETHER_BLUR_PX, against=sure)
    likeness = fit.likeness()
    return tuple(fit.band_map(band, likeness[band]) for band in fit.bands if fit.is_sure(band))


class _Fit:
    """Displacements as far as they are known.

    `move` holds (B, 2, 3) numbers: of each band along x and y, constant and by place.
    """

    def __init__(
        self, refined: Refinement, common: PixelMap, common_model: str, model: str
    ) -> None:
        self.refined, self.common = refined, common
        self.bands = range(len(refined.part.pair.source_bands))
        # what may still change of the common map
        free = common_model if model == "shift" else "shift"
        self.linear = generators(free, Frame.of(refined.part.pair))
        self.terms = 1 if model == "shift" else 3
        height, width = refined.part.pair.source.grid.shape
        self.centre, self.span = np.array([width, height]) / 2, max(width, height) / 2
        self.move = np.zeros((len(self.bands), 2, 3))
        self.sigma_px = np.full(len(self.bands), np.inf)
        pixels = sum(tile.template[0].data.size for tile in refined.tiles)
        self._tiles = refined.tiles[:: 1 + pixels // _MOST_PIXELS]
        self._seen: list[_Seen] = []
        self._blur = -1.0

    def is_sure(self, band: int) -> bool:
        """True of a band whose displacement is known, and small enough to be."""
        near = np.abs(self.move[band, :, 0]).max() < _REACH_PX
        return bool(near) and bool(self.sigma_px[band] < _MOST_SIGMA_PX)

    def likeness(self) -> FloatArray:
        """(B,) correlation of each band with PAN, over the pixels of the tiles."""
        seen = [(self._images(one), one) for one in self._seen]
        good = [where & one.good.reshape(where.shape) for (_, where), one in seen]
        pan = np.concatenate(
            [one.pan.reshape(w.shape)[w] for w, (_, one) in zip(good, seen, strict=True)]
        )
        bands = [
            np.concatenate(
                [images[band][w] for w, ((images, _), _) in zip(good, seen, strict=True)]
            )
            for band in self.bands
        ]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.array([np.corrcoef(pan, band)[0, 1] for band in bands])

    def band_map(self, band: int, correlation: float) -> BandMap:
        """What a user is told of a band."""
        pair = self.refined.part.pair
        number = pair.source_bands[band]
        slope = self.move[band, :, 1:] / self.span
        offset = self.move[band, :, 0] - slope @ self.centre
        (a, b), (d, e) = np.eye(2) + slope
        return BandMap(
            number=number,
            name=pair.source.band_names[number - 1],
            map=AffineMap(~Affine(a, b, offset[0], d, e, offset[1])).then(self.common),
            sigma_px=float(self.sigma_px[band]) * pair.pan_px_per_source_px,
            correlation=float(correlation),
        )

    def step(self, blur: float, against: Sequence[int]) -> None:
        """One Gauss-Newton step of all bands, each against PAN and the others of some bands."""
        with ThreadPoolExecutor(self.refined.part.pair.threads) as pool:
            if blur != self._blur:
                look = partial(_look, self.refined, self.common, blur)
                self._blur, self._seen = blur, list(pool.map(look, self._tiles))
            found = pool.map(partial(self._systems, against=against), self._seen)
            systems = [one for tile in found for one in tile]
        if not systems:
            return
        solved, variance = _solved(systems, len(self.bands))
        own = 2 * self.terms * len(self.bands)
        steps, doubt = (v[:own].reshape(-1, 2, self.terms) for v in (solved, variance))
        self.move[:, :, : self.terms] += np.clip(steps, -1.0, 1.0)
        self.move[:, :, 1:] += np.einsum("l,lij->ij", solved[own:], self.linear)
        self.sigma_px = np.sqrt(doubt[:, :, 0].sum(axis=1))

    def _systems(self, seen: _Seen, against: Sequence[int]) -> list[_System]:
        """Equations of each band in one tile: its slopes, without what the others explain."""
        images, usable = self._images(seen)
        shape = usable.shape
        place = (seen.xy - self.centre) / self.span
        good = seen.good.reshape(shape) & usable
        basis = np.stack([np.ones(len(place)), *place.T]).reshape(3, *shape)
        slopes = np.stack([self._slopes(band, image, basis) for band, image in enumerate(images)])
        pan, patches = seen.pan.reshape(shape), _patches(good, self.refined.size)
        found = []
        for rows, columns, inside in patches:
            here = [image[rows, columns][inside] for image in images]
            steep = slopes[:, :, rows, columns][:, :, inside]
            level = [np.ones(len(here[0])), pan[rows, columns][inside]]
            for band in self.bands:
                others = [number for number in against if number != band]
                known = np.stack([*level, *(here[number] for number in others)], axis=1)
                found.append(_unexplained(here[band], steep[band], known, steep[others]))
        return found

    def _images(self, seen: _Seen) -> tuple[list[FloatArray], BoolArray]:
        """Each band of a tile as far as it has found its place, and where all are known."""
        shape = seen.tile.template[0].data.shape
        place = (seen.xy - self.centre) / self.span
        known, images = np.ones(len(place), dtype=np.bool_), list[FloatArray]()
        for pixels, move in zip(seen.tile.template, self.move, strict=True):
            surface = make_surface(pixels, self.refined.part.template.grid, (self._blur,) * 2)
            at = seen.xy + move[:, 0] + place @ move[:, 1:].T
            image, usable = sample(surface, at[:, None])
            images.append(np.asarray(image.reshape(shape), dtype=np.float64))
            known &= usable[:, 0]
        return images, known.reshape(shape)

    def _slopes(self, band: int, image: FloatArray, basis: FloatArray) -> FloatArray:
        """(K, H, W) derivatives of a band's image by all unknowns."""
        down, right = np.gradient(image)
        out = np.zeros((len(self.bands), 2, self.terms, *image.shape))
        out[band] = np.stack([right * basis[: self.terms], down * basis[: self.terms]])
        own = out.reshape(-1, *image.shape)
        moves = np.einsum("lij,jhw->lihw", self.linear, basis[1:])
        return np.concatenate([own, moves[:, 0] * right + moves[:, 1] * down])


def _patches(good: BoolArray, size: int) -> list[tuple[slice, slice, BoolArray]]:
    """Squares of a tile that show enough, with their usable pixels."""
    height, width = good.shape
    found = []
    for top in range(_EDGE_PX, height - _EDGE_PX, size):
        for left in range(_EDGE_PX, width - _EDGE_PX, size):
            rows = slice(top, min(top + size, height - _EDGE_PX))
            columns = slice(left, min(left + size, width - _EDGE_PX))
            if good[rows, columns].sum() >= _FEWEST_PIXELS:
                found.append((rows, columns, good[rows, columns]))
    return found


def _unexplained(
    image: FloatArray, slopes: FloatArray, known: FloatArray, others: FloatArray
) -> _System:
    """Normal equations of a patch: what of a band's image is not known from what explains it.

    Parameters
    ----------
    image : (N,) float64
    slopes : (K, N) float64
        Its derivatives by the unknowns.
    known : (N, 2 + M) float64
        A constant, PAN and the images of M other bands.
    others : (M, K, N) float64
        Derivatives of those, which move, too.
    """
    q, upper = np.linalg.qr(known)
    share = np.linalg.pinv(upper) @ (q.T @ image)
    design = slopes - np.einsum("m,mkn->kn", share[2:], others)
    design, goal = design - (design @ q) @ q.T, image - q @ (q.T @ image)
    return design @ design.T, -design @ goal, float(goal @ goal), len(goal)


def _solved(systems: Sequence[_System], bands: int) -> tuple[FloatArray, FloatArray]:
    """Unknowns of least squares and their variances, by the spread of the patches' own scores.

    The bands of a patch, so many, follow each other: they explain each other, and err together.
    Those that are explained worse than most count for less.
    """
    normal, right = (np.stack([one[i] for one in systems]) for i in (0, 1))
    energy, count = (np.array([one[i] for one in systems]) for i in (2, 3))
    variance, solved = energy / count, np.zeros(normal.shape[1])
    for _ in range(2):
        trust = 1.0 / (variance + np.median(variance))
        total = np.einsum("t,tij->ij", trust, normal)
        inverse = np.linalg.pinv(total, hermitian=True)
        solved = inverse @ np.einsum("t,ti->i", trust, right)
        left = energy - 2 * right @ solved + np.einsum("i,tij,j->t", solved, normal, solved)
        variance = np.maximum(left, 0.0) / count
    score = (trust[:, None] * (right - normal @ solved)).reshape(-1, bands, len(solved)).sum(axis=1)
    covariance = inverse @ (score.T @ score) @ inverse
    doubt = np.where(np.diag(total) > 0, np.maximum(np.diag(covariance), 0.0), np.inf)
    return solved, doubt


def _look(refined: Refinement, common: PixelMap, blur: float, tile: Tile) -> _Seen:
    part, band = refined.part, tile.template[0]
    xy, take = lattice(band, part, band.data.size)
    tuning = replace(
        refined.tuning,
        sigma=float(np.hypot(refined.tuning.sigma, blur)),
        tone=single_band(len(tile.template), 0),
        high_pass=0.0,
        local_tone=False,
    )
    surface = tile_images(part, Tile(tile.template, tile.surface), tuning)[1]
    pan, usable = sample(surface, places(part, band, take, common)[:, None])
    good = usable[:, 0] & np.logical_and.reduce([one.valid[take] for one in tile.template])
    return _Seen(tile, xy, good, np.asarray(pan[:, 0], dtype=np.float64))
