"""What fools a verdict: displacements that no header expresses, and structure that is no ground."""

from __future__ import annotations

from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.scenes.ground import fractal
from benchmarks.scenes.make import Bend
from benchmarks.scenes.truth import Truth, apply

Array = NDArray[np.float64]
Image = NDArray[np.uint16]


def waves(amplitude_px: float, length_px: float, rng: np.random.Generator) -> Bend:
    """Two crossed sines at a random angle, of so many PAN pixels at most, so long."""
    angle, first, second = rng.uniform(0, 2 * np.pi, 3)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    wave_number, size = 2 * np.pi / length_px, amplitude_px / np.sqrt(2)

    def bend(xy: Array) -> Array:
        u, v = np.moveaxis(xy @ turn.T, -1, 0) * wave_number
        across = np.stack([np.sin(v + first), np.sin(u + second)], axis=-1)
        return np.asarray(size * across @ turn)

    return bend


class Tear:
    """One side of a straight line lies elsewhere.

    Parameters
    ----------
    shift_px : (float, float)
    share : float
        Of a raster of `shape`, about.
    angle_deg : float
        0 tears the lower part off; others do it at a slant.
    shape : (int, int)
        Height and width of PAN.
    """

    def __init__(
        self,
        shift_px: tuple[float, float],
        share: float,
        angle_deg: float,
        shape: tuple[int, int],
    ) -> None:
        self._shift = np.array(shift_px)
        self._normal = np.array([np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))])
        rows, columns = np.mgrid[: shape[0] : 10, : shape[1] : 10]
        along = np.stack([columns, rows], axis=-1) @ self._normal
        self._limit = float(np.quantile(along, 1.0 - share))

    def inside(self, xy: Array) -> NDArray[np.bool_]:
        """(...,) True where (..., 2) PAN pixels are torn off."""
        return np.asarray(xy @ self._normal > self._limit)

    def __call__(self, xy: Array) -> Array:
        """(..., 2) displacement at (..., 2) PAN pixels."""
        return np.asarray(self.inside(xy)[..., None] * self._shift)


def relief_shading(image: Image, rng: np.random.Generator) -> Image:
    """The image as a hill-shade of itself: bright where it rises towards a light."""
    angle = rng.uniform(0, 2 * np.pi)
    smooth = _smoothed(image, 1.0)
    down, across = np.gradient(smooth, axis=(-2, -1))
    shade = np.cos(angle) * across + np.sin(angle) * down
    return _counts(1000 + 300 * shade / max(float(shade.std()), 1e-9))


def gradient_contrast(image: Image) -> Image:
    """The strength of the image's edges, without their sign."""
    down, across = np.gradient(_smoothed(image, 0.7), axis=(-2, -1))
    return _counts(300 + 4.0 * np.hypot(down, across))


def few_levels(image: Image, levels: int) -> Image:
    """The image in so many grey levels of equal count."""
    ranks = np.quantile(image, np.linspace(0, 1, levels + 1)[1:-1])
    return (100 + 200 * np.searchsorted(ranks, image)).astype(np.uint16)


def zero_fill(images: tuple[Image, ...], share: float, rng: np.random.Generator) -> None:
    """Undeclared zeros beyond a slanted edge of each image, the same ground in each, in place."""
    turn = rng.uniform(-0.4, 0.4)
    for image in images:
        height, width = image.shape[-2:]
        rows, columns = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
        along = columns + turn * rows
        image[..., along > np.quantile(along, 1.0 - share)] = 0


def frame(images: tuple[Image, ...], kind: str, rng: np.random.Generator) -> None:
    """The same structure on the pixel grid of each image, at the same place by the header.

    Parameters
    ----------
    images : tuple of (..., H, W) uint16
        Changed in place.
    kind : str
        ``collar``, ``labels``, ``stripes``, ``logo`` or ``fixed pattern``.
    rng : numpy.random.Generator
    """
    seed = int(rng.integers(2**31))
    for image in images:
        mask = _structure(kind, image.shape[-2:], np.random.default_rng(seed))
        image[..., mask] = 4000 if kind != "collar" else 20


def _structure(kind: str, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """(H, W) the structure in relative coordinates, so that it is the same at every GSD."""
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    y, x = rows / shape[0], columns / shape[1]
    if kind == "collar":
        width = rng.uniform(0.06, 0.14, 4)
        return np.asarray((x < width[0]) | (x > 1 - width[1]) | (y < width[2]) | (y > 1 - width[3]))
    if kind == "stripes":
        period = rng.uniform(0.05, 0.12)
        return np.asarray(y % period < 0.02)
    if kind == "fixed pattern":
        cell = 24
        dots = rng.random((cell, cell)) < 0.25
        return np.asarray(dots[(y * cell).astype(int) % cell, (x * cell).astype(int) % cell])
    mask = np.zeros(shape, dtype=np.bool_)
    count, size = (1, 0.3) if kind == "logo" else (12, 0.07)
    for _ in range(count):
        left, top = rng.uniform(0.02, 0.96 - size, 2)
        letters = rng.random((7, 5)) < 0.5
        u, v = (x - left) / size, (y - top) / size
        inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        cells = letters[(v[inside] * 7).astype(int), (u[inside] * 5).astype(int)]
        mask[inside] |= cells
    return mask


def flood(ms: Image, pan: Image, truth: Truth, ice: bool, rng: np.random.Generator) -> Image:
    """A fifth to a half of both images under water; returns PAN, and changes MS in place.

    With ice, floes lie in the water, each elsewhere in the other image.
    """
    field = fractal((pan.shape[0], pan.shape[1]), 2.0, rng)
    water = field > np.quantile(field, 1.0 - rng.uniform(0.2, 0.5))
    floes = water & (fractal((pan.shape[0], pan.shape[1]), 1.0, rng) > 1.2)
    to_pan = ~Affine(*truth.pan) @ Affine(*truth.ms_true)
    rows, columns = np.mgrid[: ms.shape[1], : ms.shape[2]] + 0.5
    x, y = (np.floor(v).astype(int) for v in apply(to_pan, columns, rows))
    spot = np.clip(y, 0, pan.shape[0] - 1), np.clip(x, 0, pan.shape[1] - 1)
    out = pan.copy()
    out[water] = _counts(rng.normal(180, 4, int(water.sum())))
    seen = water[spot]
    ms[:, seen] = _counts(rng.normal(160, 4, (len(ms), int(seen.sum()))))
    if ice:
        out[_drifted(floes, rng) & water] = 3000
        ms[:, floes[spot]] = 2800
    return out


def _drifted(floes: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.bool_]:
    """The floes, each up to 12 pixels away."""
    from scipy import ndimage

    label, count = ndimage.label(floes)
    steps = rng.integers(-12, 13, (count + 1, 2))
    rows, columns = np.nonzero(floes)
    down, across = steps[label[rows, columns]].T
    out = np.zeros_like(floes)
    there = np.clip(rows + down, 0, floes.shape[0] - 1)
    out[there, np.clip(columns + across, 0, floes.shape[1] - 1)] = True
    return out


def fade(image: Image, keep: float, rng: np.random.Generator) -> None:
    """All but the upper left part, so long along either axis, shows nothing but noise, in place."""
    height, width = image.shape[-2:]
    hidden = np.ones((height, width), dtype=np.bool_)
    hidden[: round(keep * height), : round(keep * width)] = False
    image[..., hidden] = _counts(rng.normal(300, 3, (*image.shape[:-2], int(hidden.sum()))))


def _smoothed(image: NDArray[Any], sigma: float) -> Array:
    from scipy import ndimage

    sigmas = (0.0,) * (image.ndim - 2) + (sigma, sigma)
    return np.asarray(ndimage.gaussian_filter(image.astype(np.float64), sigmas))


def _counts(values: Array) -> Image:
    return np.clip(np.rint(values), 1, 4095).astype(np.uint16)
