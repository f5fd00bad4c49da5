"""What the adapters share: reading a pair, grids, and the result file.

Each adapter is a script that runs in the peer's own environment::

    python opencv_sift.py --ms ms.tif --pan pan.tif --out result.json --setting default

and writes the corrected geotransform of MS, in the MS CRS; with the setting ``local`` the PAN
positions of the check points of MS.  Positions are outer-corner pixel coordinates
``(column, row)``.

The settings: ``default`` is what the tool does by itself, on the mean of the bands.  ``expert`` is
what somebody who knows it would set, on the bands weighted as PAN sees them (`on_band_mix`) and
with PAN low-passed as MS is (`pan_as_ms`).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from pyproj import Transformer
from rasterio.enums import Resampling
from rasterio.warp import reproject

FloatArray = NDArray[np.float64]
FITTING_POINTS = 15
CHECK_POINTS_PER_SIDE = 21
PIXEL_SIGMA = 0.45
"""Blur of a pixel and its optics, in MS pixels, that did best with ECC on the project's scenes."""
KERNEL_SIGMAS = 3.0


def arguments(*settings: str) -> argparse.Namespace:
    """Command line of an adapter."""
    parser = argparse.ArgumentParser()
    for name in ("--ms", "--pan", "--out"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--setting", choices=settings or ("default",), default="default")
    return parser.parse_args()


@dataclass(frozen=True, eq=False)
class Pair:
    """An MS and a PAN raster, read whole.

    Attributes
    ----------
    ms : (B, h, w) float32
    pan : (H, W) float32
    ms_transform, pan_transform : Affine
    ms_crs, pan_crs : rasterio.crs.CRS
    """

    ms: NDArray[np.float32]
    pan: NDArray[np.float32]
    ms_transform: Affine
    pan_transform: Affine
    ms_crs: Any
    pan_crs: Any

    def ms_grey(self, setting: str) -> NDArray[np.float32]:
        """What is matched on first: by default the mean of all bands, else of the visible three."""
        bands = self.ms if setting == "default" else self.ms[:3]
        return np.asarray(bands.mean(axis=0), dtype=np.float32)

    @property
    def ratio(self) -> float:
        """MS pixel size over PAN pixel size, by the headers."""
        return float(np.hypot(*self.header_matrix()[:, 0]))

    def header_matrix(self) -> FloatArray:
        """(2, 3) affine from MS to PAN pixels by the headers."""
        points = _fitting_points(self.ms.shape[1:])
        return fit_affine(points, self.ms_to_pan_px(points))

    def ms_to_pan_px(self, points: FloatArray) -> FloatArray:
        """MS pixel positions (N, 2) in PAN pixels by the headers."""
        x, y = apply_transform(self.ms_transform, points)
        if self.ms_crs != self.pan_crs:
            x, y = Transformer.from_crs(self.ms_crs, self.pan_crs, always_xy=True).transform(x, y)
        return np.stack(apply_transform(~self.pan_transform, np.stack([x, y], axis=1)), axis=1)


def apply_transform(transform: Affine, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X and y of points (N, 2) through an affine."""
    a, b, c, d, e, f = tuple(transform)[:6]
    x, y = points[:, 0], points[:, 1]
    return a * x + b * y + c, d * x + e * y + f


def _fitting_points(shape: tuple[int, ...]) -> FloatArray:
    columns, rows = np.meshgrid(
        np.linspace(0, shape[1], FITTING_POINTS), np.linspace(0, shape[0], FITTING_POINTS)
    )
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def read_pair(args: argparse.Namespace) -> Pair:
    """Read both rasters of the command line."""
    with rasterio.open(args.ms) as ms, rasterio.open(args.pan) as pan:
        return Pair(
            ms.read(out_dtype="float32"), pan.read(1, out_dtype="float32"), ms.transform,
            pan.transform, ms.crs, pan.crs,
        )  # fmt: skip


def pan_on_ms_grid(pair: Pair, zoom: int = 1) -> NDArray[np.float32]:
    """PAN warped by GDAL to the MS header's grid (pixels divided by `zoom`), as users do it."""
    height, width = pair.ms.shape[1] * zoom, pair.ms.shape[2] * zoom
    out = np.zeros((height, width), np.float32)
    coarser = pair.ratio / zoom > 1.5
    reproject(
        pair.pan, out, src_transform=pair.pan_transform, src_crs=pair.pan_crs,
        dst_transform=pair.ms_transform @ Affine.scale(1 / zoom), dst_crs=pair.ms_crs,
        resampling=Resampling.average if coarser else Resampling.cubic,
    )  # fmt: skip
    return out


def pan_as_ms(pair: Pair, zoom: int = 1, transform: Affine | None = None) -> NDArray[np.float32]:
    """PAN with the blur of an MS pixel, by a cubic on the grid of MS (pixels divided by `zoom`).

    Parameters
    ----------
    pair : Pair
    zoom : int
    transform : Affine, optional
        Of MS; its header's by default.
    """
    height, width = pair.ms.shape[1] * zoom, pair.ms.shape[2] * zoom
    out = np.zeros((height, width), np.float32)
    reproject(
        blurred(pair.pan, PIXEL_SIGMA * pair.ratio), out, src_transform=pair.pan_transform,
        src_crs=pair.pan_crs,
        dst_transform=(transform or pair.ms_transform) @ Affine.scale(1 / zoom),
        dst_crs=pair.ms_crs, resampling=Resampling.cubic,
    )  # fmt: skip
    return out


def blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Gaussian blur, edges repeated."""
    reach = int(np.ceil(KERNEL_SIGMAS * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    for axis in (0, 1):
        size = image.shape[axis]
        edge = [(reach, reach) if axis == a else (0, 0) for a in (0, 1)]
        padded = np.pad(image, edge, mode="edge")
        image = np.zeros_like(image)
        for k, weight in enumerate(kernel):
            image += weight * np.take(padded, range(k, k + size), axis=axis)
    return image


def band_mix(pair: Pair, matrix: FloatArray) -> NDArray[np.float32]:
    """The bands weighted as PAN sees them, by least squares under a correction of the MS grid."""
    seen = pan_as_ms(pair, 1, pair.ms_transform @ Affine(*matrix.ravel()))
    known = (seen > 0) & (pair.ms > 0).all(axis=0)
    design = np.column_stack([*pair.ms[:, known], np.ones(int(known.sum()))])
    weights = np.linalg.lstsq(design, seen[known], rcond=None)[0]
    return np.asarray(np.tensordot(weights[:-1], pair.ms, axes=1), dtype=np.float32)


def on_band_mix(pair: Pair, find: Callable[[NDArray[np.float32]], FloatArray]) -> FloatArray:
    """(2, 3) correction of the MS grid that `find` gives on the best mix of the bands.

    The mix needs a place, so `find` is called twice, first with the mean of the visible bands.
    """
    return find(band_mix(pair, find(pair.ms_grey("expert"))))


def ms_zoomed(pair: Pair, grey: NDArray[np.float32], zoom: int) -> NDArray[np.float32]:
    """A grey MS image resampled by GDAL to pixels divided by `zoom`."""
    if zoom == 1:
        return grey
    height, width = pair.ms.shape[1:]
    out = np.zeros((height * zoom, width * zoom), np.float32)
    reproject(
        grey, out, src_transform=Affine.identity(), src_crs=pair.ms_crs,
        dst_transform=Affine.scale(1 / zoom), dst_crs=pair.ms_crs,
        resampling=Resampling.cubic_spline,
    )  # fmt: skip
    return out


def to_uint8(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Stretch between the 1st and the 99th percentile of what is not 0."""
    low, high = np.percentile(image[image > 0], [1, 99])
    return np.asarray(np.clip((image - low) / (high - low) * 255, 0, 255), dtype=np.uint8)


def fit_affine(source: FloatArray, target: FloatArray) -> FloatArray:
    """(2, 3) least-squares affine from `source` to `target`, both (N, 2)."""
    design = np.column_stack([source, np.ones(len(source))])
    return np.asarray(np.linalg.lstsq(design, target, rcond=None)[0].T)


def save_grid_correction(args: argparse.Namespace, pair: Pair, matrix: FloatArray) -> None:
    """Save a correction found on the MS grid.

    Parameters
    ----------
    args : argparse.Namespace
    pair : Pair
    matrix : (2, 3)
        From an MS pixel to where its content lies in PAN warped to the MS header's grid.
    """
    grid = Affine(*matrix.ravel())
    save(args, pair.ms_transform @ grid)


def save_pixel_match(args: argparse.Namespace, pair: Pair, matrix: FloatArray) -> None:
    """Save a (2, 3) affine from MS pixels to PAN pixels as a geotransform in the MS CRS."""
    points = _fitting_points(pair.ms.shape[1:])
    in_pan = np.stack(apply_transform(Affine(*matrix.ravel()), points), axis=1)
    x, y = apply_transform(pair.pan_transform, in_pan)
    if pair.ms_crs != pair.pan_crs:
        x, y = Transformer.from_crs(pair.pan_crs, pair.ms_crs, always_xy=True).transform(x, y)
    save(args, Affine(*fit_affine(points, np.stack([x, y], axis=1)).ravel()))


def check_points(shape: tuple[int, ...]) -> FloatArray:
    """(441, 2) positions from corner to corner of MS, where a local result is said."""
    steps = (np.linspace(0, size, CHECK_POINTS_PER_SIDE) for size in (shape[1], shape[0]))
    return np.stack([axis.ravel() for axis in np.meshgrid(*steps)], axis=1)


def save_on_grid(args: argparse.Namespace, pair: Pair, on_grid: FloatArray) -> None:
    """Write where the check points lie in PAN.

    Parameters
    ----------
    args : argparse.Namespace
    pair : Pair
    on_grid : (441, 2)
        Where their content lies in PAN warped to the MS header's grid, MS pixels.
    """
    args.out.write_text(json.dumps({"points": pair.ms_to_pan_px(on_grid).tolist()}))


def sampled(field: FloatArray, at: FloatArray, zoom: int = 1) -> FloatArray:
    """A field (h, w, 2) of pixels divided by `zoom`, linear between their centres, at `at`."""
    size = np.array(field.shape[1::-1])
    place = np.clip(at * zoom - 0.5, 0, size - 1)
    low = np.minimum(place.astype(int), size - 2)
    (u, v), (column, row) = (place - low).T[..., None], low.T
    upper = field[row, column] * (1 - u) + field[row, column + 1] * u
    lower = field[row + 1, column] * (1 - u) + field[row + 1, column + 1] * u
    return np.asarray(upper * (1 - v) + lower * v)


def save(args: argparse.Namespace, transform: Affine) -> None:
    """Write the corrected geotransform of MS."""
    args.out.write_text(json.dumps({"transform": [float(v) for v in tuple(transform)[:6]]}))
