"""Draw ``before_after.png`` of the README: ``python docs/images/make_before_after.py``.

Needs ``pip install -e '.[report]'``.  MS of the sample pair is laid over PAN under its original and
under its corrected header; the resampling is for the eye only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from PIL import Image
from rasterio.warp import Resampling, reproject

import geodelreg
from geodelreg.product.figures import draw_before_after
from geodelreg.values.raster import Band, Grid

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "sample_tiles"
PICTURE = Path(__file__).with_name("before_after.png")
RED = 3


def on_pan(transform: Affine, grid: Grid) -> Band:
    """Red band of MS under a geotransform, on the grid of PAN."""
    data = np.zeros(grid.shape, dtype=np.float32)
    with rasterio.open(SAMPLES / "ms.tif") as ms:
        reproject(
            ms.read(RED).astype(np.float32),
            data,
            src_transform=transform,
            src_crs=ms.crs,
            dst_transform=grid.transform,
            dst_crs=grid.crs_wkt,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
    return Band(np.nan_to_num(data), np.isfinite(data), grid, "MS")


def main() -> None:
    """Align the sample pair and draw the figure."""
    alignment = geodelreg.align(SAMPLES / "ms.tif", SAMPLES / "pan.tif")
    grid, correction = alignment.reference, alignment.correction
    with rasterio.open(SAMPLES / "pan.tif") as dataset:
        data = dataset.read(1).astype(np.float32)
    draw_before_after(
        Band(data, np.ones(grid.shape, dtype=bool), grid, "PAN"),
        on_pan(correction.original, grid),
        on_pan(correction.corrected, grid),
        PICTURE,
        overwrite=True,
    )
    with Image.open(PICTURE) as picture:
        small = picture.convert("RGB").resize((picture.width * 2 // 3, picture.height * 2 // 3))
    small.quantize(128).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
