"""Pictures of both rasters on one grid: PAN, MS as delivered, MS corrected, one over the other."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geodelreg.geo.grid import window_around
from geodelreg.geo.pixel import corner_to_centre, pixel_centres
from geodelreg.raster.reader import RasterReader
from geodelreg.report.frame import Frame
from geodelreg.values.raster import Band, BoolArray, Float32Array, FloatArray, Window
from geodelreg.values.result import Alignment

_LATTICE = 17
"""Places along an axis where headers are asked; between them their curve is no part of a pixel."""
_MARGIN_PX = 3.0
_TOGETHER = 1.5
"""Of a part of MS: before and after are read as one where that is not much more."""
_STRETCH_PERCENT = (1.0, 99.0)
_MIDDLE_GREY, _MEDIANS = 0.42, (0.05, 0.7)
"""The median becomes a middle grey: under bright clouds the ground stays to be seen."""
_TINT = np.array([1.0, 0.93, 0.74], np.float32)
"""Of a single band of MS, which is told from PAN by it."""
_EMPTY = 38
"""Grey of what shows nothing."""
_JPEG_QUALITY = 86
_PIXEL_SIGMA = 0.45
"""Blur of a pixel and its optics, in pixels."""

_BROAD = 24.0
_FINEST_SIGMA = 3.0
"""Pixels of a blur that is not made any finer: the rest is done by averaging before."""

Picture = NDArray[np.uint8]
"""(H, W, 3), red first."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A part of PAN and what MS shows there.

    Attributes
    ----------
    pan, before, after : (H, W, 3) uint8
        MS under the header as delivered, and corrected.
    over_before, over_after : (H, W, 3) uint8
        MS (blue) laid over PAN (orange): grey where they agree, coloured fringes where not.
    """

    pan: Picture
    before: Picture
    after: Picture
    over_before: Picture
    over_after: Picture


class Pictures:
    """What a report shows of two open rasters.

    Parameters
    ----------
    ms, pan : RasterReader
    alignment : Alignment
    frame : Frame
    """

    def __init__(
        self, ms: RasterReader, pan: RasterReader, alignment: Alignment, frame: Frame
    ) -> None:
        self._ms, self._pan, self._frame = ms, pan, frame
        self._pan_band = alignment.options.pan_band
        self._bands = bands_to_show(ms, alignment)

    @property
    def shown(self) -> str:
        """Which bands of MS are shown, in words."""
        names = [self._ms.band_names[number - 1] for number in self._bands]
        return " / ".join(names)

    def look(self, window: Window, shape: tuple[int, int]) -> Look:
        """The pictures of a window of PAN, averaged down to `shape`."""
        band = self._pan.read([self._pan_band], window, shape)[0]
        pan = _stretched(band.data[None], band.valid)[0]
        shown = [_stretched(data, valid) for data, valid in self._ms_on(window, shape)]
        soft = _as_soft_as_ms(pan, self._frame.pan_px_per_ms_px * shape[1] / window.width)
        overs = [_over(soft, image) for image in shown]
        before, after = map(_coloured, shown)
        return Look(_picture(np.stack([pan] * 3)), before, after, *overs)

    def bands(self, window: Window, shape: tuple[int, int]) -> tuple[Band, Band, Band]:
        """PAN, and one band of MS as delivered and corrected, on one grid."""
        pan = self._pan.read([self._pan_band], window, shape)[0]
        (before, seen), (after, seen_after) = self._ms_on(window, shape)
        name = self.shown
        return (
            pan, Band(before[0], seen, pan.grid, name), Band(after[0], seen_after, pan.grid, name),
        )  # fmt: skip

    def _ms_on(
        self, window: Window, shape: tuple[int, int]
    ) -> list[tuple[Float32Array, BoolArray]]:
        """(B, H, W) MS as delivered and corrected on a PAN window, and where it is valid."""
        lattices = [self._lattice(window, corrected) for corrected in (False, True)]
        parts = [self._around(lattice) for lattice in lattices]
        both = self._around(np.concatenate(lattices))
        if None not in parts and both is not None:
            smaller = min(part.width * part.height for part in parts if part is not None)
            if both.width * both.height <= _TOGETHER * smaller:
                parts = [both, both]
        read: dict[Window, list[Band]] = {}
        out = []
        for part, lattice in zip(parts, lattices, strict=True):
            if part is None:
                nothing = np.zeros((len(self._bands), *shape), np.float32)
                out.append((nothing, np.zeros(shape, np.bool_)))
                continue
            if part not in read:
                read[part] = self._read(part, lattice, shape)
            out.append(_sampled(read[part], part, lattice, shape))
        return out

    def _around(self, lattice: FloatArray) -> Window | None:
        known = lattice[np.isfinite(lattice).all(axis=-1)]
        return window_around(known, _MARGIN_PX, self._ms.grid) if len(known) else None

    def _read(self, part: Window, lattice: FloatArray, shape: tuple[int, int]) -> list[Band]:
        """A window of MS, averaged down until its pixels are about those of the picture."""
        spread = np.maximum(np.nanmax(lattice, axis=(0, 1)) - np.nanmin(lattice, axis=(0, 1)), 1.0)
        step = np.maximum(spread / shape[::-1], 1.0)
        width, height = np.maximum(np.round(np.array(part[2:]) / step), 1).astype(int)
        return self._ms.read(list(self._bands), part, (int(height), int(width)))

    def _lattice(self, window: Window, corrected: bool) -> FloatArray:
        """(n, n, 2) MS pixels, outer corner, of places from edge to edge of a PAN window."""
        rows, columns = (
            start + np.linspace(0.0, size, _LATTICE)
            for start, size in ((window.row, window.height), (window.column, window.width))
        )
        return self._frame.to_ms(np.stack(np.meshgrid(columns, rows), axis=-1), corrected)


def _sampled(
    bands: Sequence[Band], part: Window, lattice: FloatArray, shape: tuple[int, int]
) -> tuple[Float32Array, BoolArray]:
    """(B, H, W) what was read of a part of MS at the places that a lattice spans."""
    size = np.array(bands[0].data.shape[::-1])
    local = corner_to_centre((lattice - part[:2]) * size / np.array(part[2:]))
    down, across = (_between(count) for count in shape)
    at = np.einsum("yi,ijk,xj->kyx", down, local, across, optimize=True)
    x, y = np.nan_to_num(at, nan=-10.0).astype(np.float32)
    valid = np.logical_and.reduce([band.valid for band in bands]).astype(np.float32)
    data = [
        cv2.remap(
            np.where(valid > 0, band.data, _middle(band.data, valid > 0)).astype(np.float32),
            x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE,
        )
        for band in bands
    ]  # fmt: skip
    share = cv2.remap(valid, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.stack(data), np.asarray(share > 0.5)


def bands_to_show(ms: RasterReader, alignment: Alignment) -> tuple[int, ...]:
    """Numbers of the bands that make a picture: red, green and blue, else the one matched on most.

    Parameters
    ----------
    ms : RasterReader
    alignment : Alignment
    """
    names = [re.split(r"[^a-z]+", name.lower()) for name in ms.band_names]
    found = []
    for colour in ("red", "green", "blue"):
        named = [n for n, words in enumerate(names, 1) if colour in words]
        meant = [n for n, what in enumerate(ms.colours, 1) if what == colour]
        found += (named or meant)[:1]
    if len(set(found)) == 3:
        return tuple(found)
    return (heaviest_band(ms, alignment),)


def heaviest_band(ms: RasterReader, alignment: Alignment) -> int:
    """Number of the band that was asked for, or else of the one matched on most."""
    options, weights = alignment.options, alignment.solution.band_weights
    heaviest = max(weights, key=lambda name: weights[name], default="")
    number = ms.band_names.index(heaviest) + 1 if heaviest in ms.band_names else 1
    return options.band or number


def data_uri(picture: NDArray[np.uint8], lossless: bool = False) -> str:
    """A picture as text that a page can hold: JPEG, or PNG."""
    ending, settings = (".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]) if lossless else (
        ".jpg",
        [
            cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
        ],
    )  # fmt: skip
    order = [2, 1, 0, *range(3, picture.shape[2])]
    _, encoded = cv2.imencode(ending, np.ascontiguousarray(picture[..., order]), settings)
    kind = "png" if lossless else "jpeg"
    return f"data:image/{kind};base64," + base64.b64encode(encoded.tobytes()).decode()


def fitting_shape(window: Window, longest: int) -> tuple[int, int]:
    """(height, width) of a window averaged down until no side is longer."""
    factor = max(1.0, max(window.width, window.height) / longest)
    return max(1, round(window.height / factor)), max(1, round(window.width / factor))


def _between(count: int) -> FloatArray:
    """(count, n) weights of the lattice's places at the centres of pixels."""
    at = pixel_centres(np.arange(count)) / count * (_LATTICE - 1)
    return np.maximum(1.0 - np.abs(at[:, None] - np.arange(_LATTICE)), 0.0)


def _middle(data: Float32Array, valid: BoolArray) -> float:
    return float(np.median(data[valid])) if valid.any() else 0.0


def _stretched(data: Float32Array, valid: BoolArray) -> Float32Array:
    """(B, H, W) values as 0 … 1, each band by its percentiles; NaN where not valid."""
    out = np.full(data.shape, np.nan, np.float32)
    for band, image in zip(data, out, strict=True):
        if valid.any():
            low, high = np.percentile(band[valid], _STRETCH_PERCENT)
            shown = np.clip((band[valid] - low) / max(high - low, 1e-12), 0.0, 1.0)
            median = np.clip(np.median(shown), *_MEDIANS)
            image[valid] = shown ** (np.log(_MIDDLE_GREY) / np.log(median))
    return out


def _coloured(image: Float32Array) -> Picture:
    return _picture(image if len(image) == 3 else image * _TINT[:, None, None])


def _as_soft_as_ms(pan: Float32Array, pixels: float) -> Float32Array:
    """PAN averaged to MS pixels of so many of its own: what only PAN resolves is no fringe."""
    sigma = _PIXEL_SIGMA * pixels
    if sigma < _PIXEL_SIGMA:
        return pan
    known = np.isfinite(pan)
    return np.where(known, _blurred(pan, known, sigma), np.nan)


def _over(pan: Float32Array, ms: Float32Array) -> Picture:
    """PAN orange, MS blue, as bright as each other; half of each in green keeps the sum grey.

    Only what changes over less than a `_BROAD` part of the picture counts: fields may be bright in
    one image and dark in the other, and still lie in place.
    """
    grey = np.mean(ms, axis=0)
    both = np.isfinite(pan) & np.isfinite(grey)
    if not both.any():
        return _picture(np.stack([pan, (pan + grey) / 2, grey]))
    sigma = max(max(pan.shape) / _BROAD, 2.0)
    broad = _blurred(pan, both, sigma)
    detail, wanted = grey - _blurred(grey, both, sigma), pan - broad
    gain = float(wanted[both].std() / max(float(detail[both].std()), 1e-6))
    grey = np.clip(broad + gain * detail, 0.0, 1.0)
    return _picture(np.stack([pan, (pan + grey) / 2, grey]))


def _blurred(image: Float32Array, known: BoolArray, sigma: float) -> Float32Array:
    """Mean around each pixel of what is known there; broad ones are made of averages of pixels."""
    height, width = image.shape
    step = max(1, int(sigma / _FINEST_SIGMA))
    small = (-(-width // step), -(-height // step))
    total, weight = (
        cv2.GaussianBlur(
            cv2.resize(plane.astype(np.float32), small, interpolation=cv2.INTER_AREA),
            (0, 0),
            sigma / step,
        )
        for plane in (np.where(known, image, 0.0), known)
    )
    mean = total / np.maximum(weight, np.float32(1e-6))
    return np.asarray(cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR))


def _picture(planes: Sequence[Any] | Float32Array) -> Picture:
    image = np.asarray(planes)
    image = np.where(np.isfinite(image).all(axis=0), 255 * image, _EMPTY)
    return np.ascontiguousarray(np.round(image).astype(np.uint8).transpose(1, 2, 0))
