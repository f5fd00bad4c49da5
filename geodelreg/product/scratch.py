"""Rasters that are in no file, written to one, window by window, for GDAL to read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geodelreg.door.opening import open_raster
from geodelreg.errors import (
    OutputUnwritableError,
    RasterUnreadableError,
    UnsupportedGeoreferenceError,
)
from geodelreg.geotiff.environment import gdal_failures, gdal_session
from geodelreg.product.pixels import geotiff_on
from geodelreg.raster.inputs import Opened

_STEP_PX = 1024
"""Rows and columns that are written together, at least."""


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder that is gone afterwards.

    Raises
    ------
    OutputUnwritableError
    """
    try:
        folder = TemporaryDirectory(prefix="geodelreg-")
    except OSError as error:
        raise _no_room(error) from error
    with folder as name:
        yield Path(name)


def file_of(raster: Opened, path: Path) -> None:
    """Write an open raster, arrays too, to a GeoTIFF of the same pixels in the same place.

    What is no data in one of the bands by another value than in the first takes that of the first.

    Parameters
    ----------
    raster : Opened
    path : Path

    Raises
    ------
    MissingCrsError, MissingGeoreferenceError, UnsupportedGeoreferenceError
        Where it lies is not known, or a GeoTIFF cannot say it.
    RasterUnreadableError
        Its pixels cannot be computed.
    OutputUnwritableError
        There is no room.
    """
    import rasterio
    from rasterio.crs import CRS

    source, grid = raster.dataset, raster.grid()
    profile = geotiff_on(grid) | {
        "count": source.count,
        "dtype": _type(source.dtypes),
        "nodata": source.nodatavals[0],
        "tiled": True,
        "photometric": "MINISBLACK",
    }
    try:
        with gdal_session(path), rasterio.open(path, "w", **profile) as file:
            file.descriptions = source.descriptions
            if None not in source.colorinterp:
                file.colorinterp = source.colorinterp
            for window, data, valid in _windows(raster):
                file.write(data, window=window)
                if valid is not None:
                    file.write_mask(valid, window=window)
        with open_raster(path) as file:
            kept = file.crs == CRS.from_wkt(grid.crs_wkt) and file.transform == grid.transform
    except gdal_failures() as error:
        raise _no_room(error) from error
    if not kept:
        raise UnsupportedGeoreferenceError(
            f"{raster.name}: a GeoTIFF does not keep its place or its reference system",
            "Write it to a file of another format, and name that.",
        )


def _windows(raster: Opened) -> Iterator[tuple[Any, NDArray[Any], NDArray[np.bool_] | None]]:
    """Window, (B, H, W) pixels, and where they are valid if a mask says that."""
    from rasterio.enums import MaskFlags

    source = raster.dataset
    flags, nodata = set(source.mask_flag_enums[0]), source.nodatavals
    bands = list(range(1, source.count + 1))
    rows, columns = (max(_STEP_PX, side) for side in source.block_shapes[0])
    for top, left in product(range(0, source.height, rows), range(0, source.width, columns)):
        bottom, right = min(top + rows, source.height), min(left + columns, source.width)
        window, valid = ((top, bottom), (left, right)), None
        try:
            data = source.read(bands, window=window)
            if not flags or MaskFlags.per_dataset in flags:
                masks = [source.read_masks(band, window=window) for band in bands]
                valid = np.logical_and.reduce(masks)
        except gdal_failures() as error:
            raise RasterUnreadableError(
                f"{raster.name} cannot be read: {error}", "Obtain its files again."
            ) from error
        for pixels, value in zip(data, nodata, strict=True):
            if value != nodata[0] and None not in (value, nodata[0]):
                pixels[pixels == value] = nodata[0]
        yield window, data, valid


def _type(names: Sequence[str]) -> np.dtype[Any]:
    """One type for all bands; GDAL has no floats of 16 bits."""
    kind = np.result_type(*names)
    return np.dtype(np.float32) if kind == np.float16 else kind


def _no_room(error: Exception) -> OutputUnwritableError:
    return OutputUnwritableError(
        f"no temporary file can be written ({error})",
        "Make room there, or let TMPDIR name another folder.",
    )
