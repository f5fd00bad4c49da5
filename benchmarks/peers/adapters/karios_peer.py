"""KARIOS: its KLT matcher with its own configuration, and an affine or a field through the points.

It wants two images of one grid, so PAN is brought to that of MS (default: averaged), or both to
PAN's size (expert).  It runs without and with its detection of large shifts; what more points agree
on is taken.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from common import (
    FloatArray,
    Pair,
    arguments,
    check_points,
    ms_zoomed,
    on_band_mix,
    pan_as_ms,
    pan_on_ms_grid,
    read_pair,
    save_grid_correction,
    save_on_grid,
    to_uint8,
)
from karios.core.configuration import ProcessingConfiguration
from karios.core.image import GdalRasterImage
from karios.matcher.klt import KLT
from karios.matcher.large_offset import LargeOffsetMatcher
from scattered import affine_without_outliers, agreeing, smooth_field

CONFIDENCE = 0.4
"""Points that score less are left out, as ``accuracy_analysis.confidence_threshold``."""


def _written(path: Path, image: np.ndarray, transform: Affine) -> GdalRasterImage:
    with rasterio.open(
        path, "w", driver="GTiff", dtype="uint8", count=1, height=image.shape[0],
        width=image.shape[1], transform=transform,
    ) as raster:  # fmt: skip
        raster.write(image, 1)
    return GdalRasterImage(str(path))


def _points(folder: Path, grey: np.ndarray, pan: np.ndarray, zoom: int) -> list[FloatArray]:
    """Matched positions of MS and of PAN on its grid, MS pixels."""
    import karios.configuration

    settings = Path(next(iter(karios.configuration.__path__)), "processing_configuration.json")
    klt = ProcessingConfiguration.from_file(str(settings)).klt_configuration
    here, there = to_uint8(grey), to_uint8(pan)
    scale = Affine.scale(1.0, -1.0)
    coarse = [
        _written(folder / f"coarse{i}.tif", np.ascontiguousarray(image[::zoom, ::zoom]), scale)
        for i, image in enumerate((here, there))
    ]
    # at MS size: magnified MS has nothing but noise above its Nyquist frequency
    large = np.round(LargeOffsetMatcher(*coarse).match()[::-1]) * zoom
    reference = _written(folder / "reference.tif", here, scale)
    found = []
    for offset in (np.zeros(2), large):
        moved = np.roll(there, -offset.astype(int)[::-1], axis=(0, 1))
        monitored = _written(folder / "monitored.tif", moved, scale)
        for table in KLT(klt).match(monitored, reference, None):
            kept = table[table["score"] >= CONFIDENCE]
            source = kept[["x0", "y0"]].to_numpy(float)
            target = source + kept[["dx", "dy"]].to_numpy(float) + offset
            found.append([(place + 0.5) / zoom for place in (source, target)])
    return max(found, key=lambda points: agreeing(*points))


def _matched(folder: Path, pair: Pair, pan: np.ndarray, zoom: int) -> list[FloatArray]:
    """Points on the best mix of the bands."""
    found: list[list[FloatArray]] = []

    def find(grey: np.ndarray) -> FloatArray:
        found.append(_points(folder, ms_zoomed(pair, grey, zoom), pan, zoom))
        return affine_without_outliers(*found[-1])

    on_band_mix(pair, find)
    return found[-1]


def main() -> None:
    """Default: on the MS grid.  Expert: at PAN size.  Local: thin plates through the points."""
    args = arguments("default", "expert", "local")
    pair = read_pair(args)
    folder = args.out.parent
    if args.setting == "default":
        points = _points(folder, pair.ms_grey(args.setting), pan_on_ms_grid(pair), 1)
    else:
        zoom = max(1, round(pair.ratio))
        points = _matched(folder, pair, pan_as_ms(pair, zoom), zoom)
    if args.setting == "local":
        save_on_grid(args, pair, smooth_field(*points, check_points(pair.ms.shape[1:])))
        return
    save_grid_correction(args, pair, affine_without_outliers(*points))


if __name__ == "__main__":
    main()
