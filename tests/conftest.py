"""Small real rasters, written from arrays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import settings
from numpy.typing import NDArray

settings.register_profile("no deadline", deadline=None)  # a busy machine is no defect
settings.load_profile("no deadline")

UTM16 = "EPSG:32616"
TRANSFORM = Affine(30.0, 0.0, 500_000.0, 0.0, -30.0, 1_400_000.0)

WriteRaster = Callable[..., Path]


@pytest.fixture
def write_raster(tmp_path: Path) -> WriteRaster:
    """``write_raster(name, data, mask=None, colorinterp=None, descriptions=None, **profile)``.

    `data` is (H, W) or (B, H, W); the profile defaults to a north-up GeoTIFF of 30 m in UTM 16N.
    """

    def write(
        name: str,
        data: NDArray[Any],
        *,
        mask: NDArray[Any] | None = None,
        colorinterp: tuple[Any, ...] | None = None,
        descriptions: tuple[str, ...] | None = None,
        **profile: Any,
    ) -> Path:
        planes = data if data.ndim == 3 else data[np.newaxis]
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        settings = {
            "driver": "GTiff",
            "count": planes.shape[0],
            "height": planes.shape[1],
            "width": planes.shape[2],
            "dtype": planes.dtype,
            "crs": UTM16,
            "transform": TRANSFORM,
            **profile,
        }
        with rasterio.open(path, "w", **settings) as dataset:
            if colorinterp is not None:
                dataset.colorinterp = colorinterp
            dataset.write(planes)
            if descriptions is not None:
                dataset.descriptions = descriptions
            if mask is not None:
                dataset.write_mask(mask)
        return path

    return write
