"""Sharpened ramps: each pixel says where it comes from, and what Brovey makes of it is known."""

from __future__ import annotations

import argparse
import itertools
import tempfile
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

import geodelreg

Array = NDArray[np.float64]
RATIOS = (2, 3, 4)
OFFSETS_PX = tuple(float(offset) for offset in np.arange(-8, 8.25, 0.25))
WEIGHTS = (0.1, 0.3, 0.4, 0.2)
MOST_PX = 0.01
MOST_SHARE = 1e-5
"""Of a value, between single precision and double."""
_SIDE = 30
_SUM = 4000.0
_BEGIN = 1000.0
_KERNEL_MS_PX = 2
"""That a cubic reaches, to either side."""
_BLOCK_PX = (23, 31)
_ORIGIN = (437_000.0, 4_176_000.0)


@dataclass(frozen=True, slots=True)
class Found:
    """What is wrong where MS covers the kernel, at worst.

    Attributes
    ----------
    off_px : float
        Distance of a pixel from where it belongs, PAN pixels.
    brovey : float
        Share by which a value differs from Brovey's in numpy.
    blocks : float
        Share of the pixels, anywhere, that a block or a GeoTIFF has otherwise than the whole VRT.
    """

    off_px: float
    brovey: float
    blocks: float

    @property
    def is_good(self) -> bool:
        """Within what is promised."""
        return self.off_px <= MOST_PX and self.brovey <= MOST_SHARE and self.blocks == 0


def measure(folder: Path, ratio: int, offset_px: float) -> Found:
    """Sharpen a ramp whose MS lies so far east, and half as far north, of PAN's corner.

    Parameters
    ----------
    folder : Path
        For the files.
    ratio : int
        PAN pixels to an MS pixel.
    offset_px : float
        PAN pixels.
    """
    shift = np.array([offset_px, -offset_px / 2])
    height, width = _SIDE * ratio - 5, _SIDE * ratio + 7
    ms, pan = folder / "ms.tif", folder / "pan.tif"
    places = (np.mgrid[:_SIDE, :_SIDE][::-1] + 0.5) * ratio + shift[:, None, None]
    corner = Affine(1, 0, _ORIGIN[0], 0, -1, _ORIGIN[1])
    _write(ms, _bands(places), corner @ Affine.translation(*shift) @ Affine.scale(ratio))
    x, y = np.mgrid[:height, :width][::-1] + 0.5
    inner = np.ones((height, width), dtype=bool)
    for at, begin in ((x, shift[0]), (y, shift[1])):
        reach = _KERNEL_MS_PX * ratio
        inner &= (at > begin + reach) & (at < begin + _SIDE * ratio - reach)
    bands = _bands(np.stack([x, y]))

    _write(pan, np.full((1, height, width), _SUM / 2), corner)
    whole = _sharpened(folder / "flat.tif", "equal")
    off_px = np.hypot(whole[0] - bands[0], whole[2] - bands[2])[inner].max()

    bright = np.random.default_rng(ratio).uniform(100, 3000, (1, height, width))
    _write(pan, bright, corner)
    expected = bands * bright.astype(np.float32) / np.tensordot(WEIGHTS, bands, axes=1)
    lazy, weights = folder / "sharp.vrt", ",".join(map(str, WEIGHTS))
    whole = _sharpened(lazy, weights)
    brovey = (np.abs(whole - expected) / expected)[:, inner].max()
    unlike = [_unlike(_sharpened(folder / "sharp.tif", weights), whole)]
    with rasterio.open(lazy) as dataset:
        rows, columns = _BLOCK_PX
        for top, left in itertools.product(range(0, height, rows), range(0, width, columns)):
            window = slice(top, min(top + rows, height)), slice(left, min(left + columns, width))
            part = dataset.read(window=tuple((edge.start, edge.stop) for edge in window))
            unlike.append(_unlike(part, whole[:, *window]))
    return Found(float(off_px), float(brovey), max(unlike))


def _unlike(one: Array, other: Array) -> float:
    return float(((one != other) & ~(np.isnan(one) & np.isnan(other))).mean())


def _bands(places: Array) -> Array:
    """(4, H, W) bands that say columns and rows, and add up to the same everywhere."""
    x, y = places + _BEGIN
    return np.stack([x, _SUM - x, y, _SUM - y])


def _write(path: Path, data: Array, transform: Affine) -> None:
    count, height, width = data.shape
    shape: dict[str, Any] = {"count": count, "height": height, "width": width, "dtype": "float32"}
    with rasterio.open(
        path, "w", driver="GTiff", crs="EPSG:32618", transform=transform, **shape
    ) as dataset:
        dataset.write(data.astype(np.float32))


def _sharpened(out: Path, weights: str) -> Array:
    pair = out.parent / "ms.tif", out.parent / "pan.tif"
    geodelreg.pansharpen(*pair, out, weights=weights, overwrite=True)
    with rasterio.open(out) as dataset:
        return np.asarray(dataset.read(), dtype=np.float64)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks ramps``."""
    parser.add_argument("--step", type=int, default=1, help="of the offsets, take every so many")


def run(args: argparse.Namespace) -> int:
    """Measure all cases; print the worst for each ratio, and whether all is within the limits."""
    print("| ratio | cases | off, PAN px | from Brovey in numpy | other in a block or a TIFF |")
    print("|---|---|---|---|---|")
    good = True
    with tempfile.TemporaryDirectory() as folder:
        for ratio in RATIOS:
            found = [measure(Path(folder), ratio, px) for px in OFFSETS_PX[:: args.step]]
            worst = Found(*np.max([astuple(one) for one in found], axis=0))
            good = good and worst.is_good
            cells = f"{worst.off_px:.1e} | {worst.brovey:.1e} | {worst.blocks:g}"
            print(f"| {ratio} | {len(found)} | {cells} |", flush=True)
    return 0 if good else 1
