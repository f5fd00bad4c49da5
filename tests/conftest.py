"""Small real rasters, written from arrays."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: idle threads of BLAS spin

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


@pytest.fixture(autouse=True)
def _process_as_found() -> Iterator[None]:
    """Undo what a command run in this process leaves to it: variables and levels of logging.

    The command line owns its process and sets both for good; in a test the next one would find
    the network closed to GDAL, or the log silent.
    """
    environment = dict(os.environ)
    loggers = [logging.getLogger(name) for name in (None, "geodelreg", "geodelreg_cli")]
    before = [(one, one.level, list(one.handlers)) for one in loggers]
    yield
    for name in os.environ.keys() - environment.keys():
        del os.environ[name]
    os.environ.update(environment)
    for one, level, handlers in before:
        one.setLevel(level)
        one.handlers = handlers


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
