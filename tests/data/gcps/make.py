"""The points of this folder, and what writes their files; README.md has the rest of the recipe."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

from geodelreg.product.gcps import GcpContext, write_gcps
from geodelreg.values.points import Gcp
from geodelreg.values.raster import Grid

FORMATS = {
    "points.points": "qgis",
    "points.gcp": "gdal",
    "points.csv": "csv",
    "points.geojson": "geojson",
    "points.vrt": "vrt",
    "points.pts": "envi",
    "points_map.pts": "envi-map",
}
HEADER = Affine(30.0, 0.0, 500010.0, 0.0, -30.0, 1300020.0)
TRUTH = Affine(30.25, 0.0, 500012.5, 0.0, -29.875, 1299987.25)
PAN = Affine(7.5, 0.0, 499900.0, 0.0, -7.5, 1300100.0)
PIXELS = ((0.0, 0.0), (8.0, 0.0), (3.5, 2.5), (1.125, 4.75), (0.0, 6.0), (8.0, 6.0))


def points() -> tuple[Gcp, ...]:
    """Points that lie exactly on one affine, so that half a pixel shows."""
    ground = [TRUTH @ pixel for pixel in PIXELS]
    return tuple(
        Gcp(str(number), *pixel, *xy, info=f"point {number}, exact")
        for number, (pixel, xy) in enumerate(zip(PIXELS, ground, strict=True), start=1)
    )


def context(folder: Path) -> GcpContext:
    """Grids and names of the pair that the points connect."""
    wkt = Path(__file__).with_name("epsg32616.wkt").read_text().strip()
    return GcpContext(
        source=Grid(HEADER, (6, 8), wkt),
        corrected=TRUTH,
        reference=Grid(PAN, (40, 60), wkt),
        source_paths=(str(folder / "ms.tif"),),
        reference_path="pan.tif",
        reference_px=np.array([~PAN @ (gcp.x, gcp.y) for gcp in points()]),
    )


def main(folder: Path) -> None:
    """Write everything into `folder`."""
    profile = {"driver": "GTiff", "width": 8, "height": 6, "count": 2, "dtype": "uint16"}
    pixels = np.arange(96, dtype=np.uint16).reshape(2, 6, 8)
    with rasterio.open(
        folder / "ms.tif", "w", crs="EPSG:32616", transform=HEADER, nodata=0, **profile
    ) as dataset:
        dataset.write(pixels)
        dataset.descriptions = ("red", "near infrared")
    for name, kind in FORMATS.items():
        write_gcps(folder / name, points(), kind, context=context(folder), overwrite=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
