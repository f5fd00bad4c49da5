"""Pictures on a page lie on each other, whatever the two grids are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.warp import calculate_default_transform, reproject
from scipy import ndimage

import geodelreg
from geodelreg.report.frame import frame_of
from geodelreg.report.places import places
from tests.cli.helpers import copy_samples
from tests.cli.pages import Page, likeness, picture


def reprojected(path: Path, out: Path, crs: str) -> Path:
    """A raster in another CRS, 1.3 times as coarse."""
    with rasterio.open(path) as dataset:
        transform, width, height = calculate_default_transform(
            dataset.crs, crs, dataset.width, dataset.height, *dataset.bounds
        )
        scale = 1.3
        width, height = int(width / scale), int(height / scale)
        transform = transform @ transform.scale(scale)
        profile = dataset.profile | {
            "crs": crs, "transform": transform, "width": width, "height": height,
        }  # fmt: skip
        values = np.zeros((dataset.count, height, width), dataset.dtypes[0])
        reproject(
            dataset.read(), values, src_transform=dataset.transform, src_crs=dataset.crs,
            dst_transform=transform, dst_crs=crs, resampling=Resampling.cubic,
        )  # fmt: skip
        with rasterio.open(out, "w", **profile) as written:
            written.write(values)
    return out


def warped(path: Path, band: int, transform: Affine, pan: Path) -> NDArray[np.float64]:
    """A band on the grid of PAN by GDAL, under a geotransform; NaN where there is none."""
    with rasterio.open(path) as ms, rasterio.open(pan) as model:
        out = np.full(model.shape, np.nan)
        reproject(
            ms.read(band).astype(np.float64), out, src_transform=transform, src_crs=ms.crs,
            dst_transform=model.transform, dst_crs=model.crs, resampling=Resampling.cubic,
            src_nodata=np.nan, dst_nodata=np.nan,
        )  # fmt: skip
    return out


@pytest.mark.parametrize("crs", ["EPSG:32618", "EPSG:4326", "EPSG:32617"])
def test_pictures_are_what_gdal_makes_of_either_header(tmp_path: Path, crs: str) -> None:
    copy_samples(tmp_path)
    ms = reprojected(tmp_path / "ms.tif", tmp_path / "other.tif", crs)
    pan = tmp_path / "pan.tif"
    found = geodelreg.align(str(ms), str(pan), geodelreg.AlignOptions(band=3))
    geodelreg.write_report(found, tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    for view, transform in (
        ("before", found.correction.original),
        ("after", found.correction.corrected),
    ):
        wanted = warped(ms, 3, transform, pan)
        whole, *closely = (picture(i["src"]) for i in page.all("img", **{"data-view": view}))
        window = frame_of(found).window
        assert whole.shape == (window.height, window.width)
        inside = wanted[
            window.row : window.row + window.height, window.column : window.column + window.width
        ]
        rank = likeness(whole, inside)
        assert rank > 0.99
        # half a pixel more is worse
        moved = ndimage.shift(inside, (0.5, 0.5), order=1, cval=np.nan)
        assert likeness(whole, moved) < rank
        for place, image in zip(places(found.tie_points, frame_of(found)), closely, strict=True):
            column, row, width, height = place.window
            part = wanted[row : row + height, column : column + width]
            assert image.shape == part.shape
            assert likeness(image, part) > 0.99
