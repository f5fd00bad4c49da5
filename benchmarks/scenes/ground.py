"""What the scenes look like on the ground: cut-outs of real imagery, clouds, changed fields."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from benchmarks.scenes.imagery import Float32Array, Imagery

FloatArray = NDArray[np.float64]
FULL_SCALE_COUNTS = 3000.0
FULL_SCALE_PERCENTILE = 99.8
SHADOW_STEP = (38, -52)
"""Rows and columns from a cloud to its shadow, PAN pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Four bands of radiance at PAN resolution, some margin around PAN included.

    Attributes
    ----------
    bands : (4, H, W) float32
        In 12-bit counts.
    offset : tuple of int
        ``(column, row)`` of PAN's upper-left pixel in `bands`.
    pan_shape : tuple of int
        ``(height, width)``.
    """

    bands: Float32Array
    offset: tuple[int, int]
    pan_shape: tuple[int, int]

    @property
    def pan_window(self) -> tuple[slice, slice]:
        """Rows and columns of PAN in `bands`."""
        (column, row), (height, width) = self.offset, self.pan_shape
        return slice(row, row + height), slice(column, column + width)


def cut_ground(
    imagery: Imagery, pan_origin: tuple[int, int], pan_shape: tuple[int, int], margin: int
) -> Ground:
    """Cut PAN's window and a margin out of imagery, mirrored beyond the imagery's edges.

    Parameters
    ----------
    imagery : Imagery
    pan_origin : tuple of int
        ``(column, row)`` of PAN's upper-left pixel in the imagery; may be negative.
    pan_shape : tuple of int
    margin : int
        In pixels, on every side.
    """
    full = np.percentile(imagery.bands[:, ::4, ::4], FULL_SCALE_PERCENTILE, axis=(1, 2))
    gain = (FULL_SCALE_COUNTS / full).astype(np.float32)
    rows = _mirrored(pan_origin[1] - margin, pan_shape[0] + 2 * margin, imagery.shape[0])
    columns = _mirrored(pan_origin[0] - margin, pan_shape[1] + 2 * margin, imagery.shape[1])
    bands = imagery.bands[:, rows][:, :, columns] * gain[:, None, None]
    return Ground(bands, (margin, margin), pan_shape)


def _mirrored(start: int, length: int, size: int) -> NDArray[np.intp]:
    index = np.arange(start, start + length) % (2 * size)
    return np.where(index < size, index, 2 * size - 1 - index)


def enlarge(imagery: Imagery, size: int, rng: np.random.Generator) -> Imagery:
    """Imagery of `size`² pixels: the real one magnified, with real texture added as fine detail.

    The fine detail is the high-pass of the same imagery in its native pixels, tile by tile in
    another orientation, scaled by a random smooth field: no two places are alike.

    Parameters
    ----------
    imagery : Imagery
    size : int
    rng : numpy.random.Generator
    """
    import cv2
    from scipy import ndimage

    height, width = imagery.shape
    side = min(height, width)
    strength = cv2.resize(fractal((size // 32, size // 32), 1.5, rng), (size, size))
    strength = (0.5 + 0.5 / (1.0 + np.exp(-2.0 * strength))).astype(np.float32)
    orientations = rng.permutation(np.arange(16) % 8)
    bands = np.empty((len(imagery.bands), size, size), np.float32)
    for out, band in zip(bands, imagery.bands, strict=True):
        cv2.resize(band[:side, :side], (size, size), dst=out, interpolation=cv2.INTER_CUBIC)
        detail = band - ndimage.gaussian_filter(band, 4.0)
        detail = np.clip(detail, *np.percentile(detail, [0.05, 99.95]))
        tiles = 0
        for row in range(0, size, side):
            for column in range(0, size, side):
                turned = _orient(detail[:side, :side], int(orientations[tiles % 16]))
                part = out[row : row + side, column : column + side]
                shape = part.shape
                part += (
                    strength[row : row + side, column : column + side]
                    * turned[: shape[0], : shape[1]]
                )
                tiles += 1
        np.maximum(out, 1.0, out=out)
    step = imagery.transform @ Affine.scale(side / size)
    return replace(
        imagery, bands=bands, transform=step, source=f"{imagery.source}, magnified to {size}²"
    )


def _orient(tile: Float32Array, code: int) -> Float32Array:
    turned = np.rot90(tile, code % 4)
    return turned[:, ::-1] if code >= 4 else turned


def fractal(shape: tuple[int, int], slope: float, rng: np.random.Generator) -> Float32Array:
    """Gaussian noise with amplitude ``1 / frequency^slope``; zero mean, unit variance."""
    from scipy import fft

    fy, fx = fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :]
    frequency = np.hypot(fx, fy)
    frequency[0, 0] = np.inf
    white = fft.rfft2(rng.standard_normal(shape))
    noise = fft.irfft2(white / frequency**slope, s=shape)
    return np.asarray(noise / noise.std(), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class CloudLayer:
    """Clouds of one height: where they are, how bright, and how far they move between the images.

    Attributes
    ----------
    opacity : (H, W) float32
        0 to 1, as PAN sees it.
    radiance : (H, W) float32
        In counts.
    shadow : (H, W) float32
        Opacity as it falls on the ground, where it stays.
    shift_px : tuple of float
        MS position minus PAN position, ``(column, row)``, in PAN pixels.
    """

    opacity: Float32Array
    radiance: Float32Array
    shadow: Float32Array
    shift_px: tuple[float, float]

    def moved(self) -> CloudLayer:
        """The layer as MS sees it; both images are of one moment, so its shadow has not moved."""
        from scipy import ndimage

        step = (self.shift_px[1], self.shift_px[0])
        opacity = np.clip(ndimage.shift(self.opacity, step, order=3, mode="mirror"), 0, 1)
        radiance = ndimage.shift(self.radiance, step, order=3, mode="mirror")
        return replace(self, opacity=opacity, radiance=radiance)


def cloud_layer(
    shape: tuple[int, int], cover: float, shift_px: tuple[float, float], rng: np.random.Generator
) -> CloudLayer:
    """A layer of broken, bright, textured cloud covering the share `cover` of `shape`."""
    noise = fractal(shape, 1.6, rng)
    level = np.quantile(noise[::4, ::4], 1.0 - cover)
    opacity = np.clip((noise - level) / 0.25 + 0.5, 0, 1).astype(np.float32)
    radiance = 3000.0 + 350.0 * fractal(shape, 1.2, rng)
    radiance = np.clip(radiance, 1800, 3900).astype(np.float32)
    return CloudLayer(opacity, radiance, np.roll(opacity, SHADOW_STEP, axis=(0, 1)), shift_px)


def cover_with(ground: Ground, layers: list[CloudLayer]) -> Ground:
    """The ground under clouds and their shadows; shadows stay where they fall."""
    bands = ground.bands.copy()
    for layer in layers:
        bands *= 1.0 - 0.45 * layer.shadow
    for layer in layers:
        bands += layer.opacity * (layer.radiance - bands)
    return replace(ground, bands=bands)


def change_season(ground: Ground, rng: np.random.Generator) -> Ground:
    """The ground at another date: local contrast, vegetation, changed and inverted fields.

    About a tenth of the area shows inverted contrast (fields that were bright are dark), another
    tenth something else altogether; illumination gain and offset vary smoothly over the scene.
    """
    from scipy import ndimage

    bands = ground.bands.copy()
    shape = (bands.shape[1], bands.shape[2])
    inverted = _fields(shape, 0.10, rng)
    changed = _fields(shape, 0.10, rng)
    gain = (1.0 + 0.18 * fractal(shape, 2.0, rng)).clip(0.5, 1.6)
    haze = 150.0 + 60.0 * fractal(shape, 2.0, rng)
    for index, exponent in enumerate((0.85, 0.9, 1.1, 0.75)):
        band = bands[index]
        mean = ndimage.gaussian_filter(band, 40.0)
        other = np.roll(band, (shape[0] // 3, shape[1] // 5), axis=(0, 1))[::-1]
        turned = band + inverted * (mean - 0.7 * (band - mean) - band)
        turned = np.maximum(turned + changed * (other - turned), 1.0)
        bands[index] = gain * FULL_SCALE_COUNTS * (turned / FULL_SCALE_COUNTS) ** exponent + haze
    return replace(ground, bands=bands)


def _fields(shape: tuple[int, int], cover: float, rng: np.random.Generator) -> Float32Array:
    """Mask of turned rectangles, 60 to 200 px long, with edges a pixel soft."""
    import cv2

    mask = np.zeros(shape, np.uint8)
    while mask.mean() < cover:
        centre = (float(rng.uniform(0, shape[1])), float(rng.uniform(0, shape[0])))
        size = (float(rng.uniform(60, 200)), float(rng.uniform(60, 200)))
        corners = cv2.boxPoints((centre, size, float(rng.uniform(0, 90))))
        cv2.fillConvexPoly(mask, corners.astype(np.int32), 1)
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.8), np.float32)
