"""Pairs whose sharpened image is known: real ones, degraded by their own ratio, and simulated."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

import geodelreg

SAMPLE = Path(__file__).resolve().parents[2] / "sample_tiles"
Float32Array = NDArray[np.float32]
_LARGEST_SIDE = 480
_PAN_WEIGHTS = (0.15, 0.3, 0.35, 0.2)


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What sharpening should give, and what it starts from.

    Attributes
    ----------
    name : str
    is_real : bool
        PAN was seen by a sensor of its own.
    ratio : int
        PAN pixels to an MS pixel.
    reference : (B, H, W) float32
        MS at the size of PAN.
    pan : (H, W) float32
    transform : Affine
        Of `reference` and `pan`.
    crs_wkt : str
    """

    name: str
    is_real: bool
    ratio: int
    reference: Float32Array
    pan: Float32Array
    transform: Affine
    crs_wkt: str

    @property
    def bit_depth(self) -> int:
        """Bits of the largest value; Brovey would go beyond it where the bands are dark."""
        return int(self.reference.max()).bit_length()

    @property
    def ms(self) -> Float32Array:
        """(B, H / ratio, W / ratio) averages of the reference."""
        count, height, width = self.reference.shape
        shape = (count, height // self.ratio, self.ratio, width // self.ratio, self.ratio)
        return np.asarray(self.reference.reshape(shape).mean(axis=(2, 4)), dtype=np.float32)


REAL = {
    "landsat8_momotombo": ("landsat8_momotombo/ms.tif", "landsat8_momotombo/pan.tif", 2),
    "landsat8_oman": ("landsat8_oman/ms.tif", "landsat8_oman/pan.tif", 2),
    "worldview2_city": ("worldview2_city/ms.tif", "worldview2_city/pan.tif", 2),
}
"""MS, PAN and the ratio of their pixels: Wald's protocol degrades both by it."""

IMAGERY = {
    "sentinel2": ("sentinel2/s2_10m_b02_b03_b04_b08.tif", (1, 2, 3, 4), (2, 3, 4)),
    "naip": ("naip/m_4709963_se_14_1_20180716.tif", (1, 2, 3, 4), (4,)),
    "landsat8_twodates": ("landsat8_twodates/20190809.tif", (1, 2, 3, 4), (3,)),
}
"""Multispectral images, their bands, and the ratios that pairs are simulated at."""


def known_pairs(data: Path) -> Iterator[Known]:
    """The pair of this repository, and all that the folder has the files of."""
    truth = json.loads((SAMPLE / "truth.json").read_text("utf-8"))
    files, placed = (SAMPLE / "ms.tif", SAMPLE / "pan.tif"), Affine(*truth["ms_true"])
    yield degraded_pair("sample_tiles", *files, 4, placed, is_real=False)
    for name, (ms, pan, ratio) in REAL.items():
        if (data / ms).exists() and (data / pan).exists():
            placed = geodelreg.align(data / ms, data / pan).correction.corrected
            yield degraded_pair(name, data / ms, data / pan, ratio, placed, is_real=True)
    for name, (path, bands, ratios) in IMAGERY.items():
        for ratio in ratios if (data / path).exists() else ():
            yield simulated_pair(f"{name} {ratio}:1", data / path, bands, ratio)


def degraded_pair(
    name: str, ms: Path, pan: Path, ratio: int, placed: Affine, is_real: bool
) -> Known:
    """MS is what sharpening should give; PAN is averaged onto its pixels, where they truly lie."""
    with rasterio.open(ms) as dataset:
        reference = dataset.read().astype(np.float32)
        crs = dataset.crs
    with (
        rasterio.open(pan) as dataset,
        WarpedVRT(
            dataset,
            crs=crs,
            transform=placed,
            height=reference.shape[1],
            width=reference.shape[2],
            resampling=Resampling.average,
            add_alpha=True,
            tolerance=1e-3,
        ) as warped,
    ):
        averaged = warped.read(1).astype(np.float32)
        rows, columns = _covered(warped.read(warped.count) > 0, ratio)
    return Known(
        name,
        is_real,
        ratio,
        reference[:, rows, columns] * _gain(reference),
        averaged[rows, columns] * _gain(averaged),
        placed @ Affine.translation(columns.start, rows.start),
        crs.to_wkt(),
    )


def _gain(image: Float32Array) -> np.float32:
    """What makes 12 bits of reflectances and bytes, which whole numbers would round away."""
    largest = float(image.max())
    return np.float32(1.0 if largest > 255 else 4095 / largest)


def _covered(valid: NDArray[np.bool_], ratio: int) -> tuple[slice, slice]:
    """Rows and columns all of which are covered, whole MS pixels of them."""
    rows, columns = (np.flatnonzero(valid.mean(axis=axis) > 0.98) for axis in (1, 0))
    spans = []
    for found in (rows, columns):
        first = int(found[0])
        length = min(int(found[-1]) + 1 - first, _LARGEST_SIDE) // ratio * ratio
        spans.append(slice(first, first + length))
    return spans[0], spans[1]


def simulated_pair(name: str, path: Path, bands: tuple[int, ...], ratio: int) -> Known:
    """PAN is a sum of the bands of a real image, MS are averages of its pixels."""
    with rasterio.open(path) as dataset:
        side = [min(n, _LARGEST_SIDE) // ratio * ratio for n in dataset.shape]
        window = ((0, side[0]), (0, side[1]))
        reference = dataset.read(list(bands), window=window).astype(np.float32)
        transform, crs_wkt = dataset.transform, dataset.crs.to_wkt()
    reference = reference * _gain(reference)
    pan = np.tensordot(np.array(_PAN_WEIGHTS, dtype=np.float32), reference, axes=1)
    noise = np.random.default_rng(ratio).normal(0.0, 0.003 * float(pan.mean()), pan.shape)
    noisy = np.asarray(pan + noise, dtype=np.float32)
    return Known(name, False, ratio, reference, noisy, transform, crs_wkt)
