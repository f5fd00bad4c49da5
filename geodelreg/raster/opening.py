"""Opening raster files: every way a file can be unfit has its own error and remedy."""

from __future__ import annotations

import logging
import math
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from affine import Affine

from geodelreg.door.names import LOCAL, check_name, gdal_name, is_local
from geodelreg.door.opening import look_at, open_entry
from geodelreg.errors import (
    CrsTransformError,
    MissingCrsError,
    MissingGeoreferenceError,
    RasterNotFoundError,
    RasterUnreadableError,
    UnsupportedGeoreferenceError,
)
from geodelreg.fatal import contradiction
from geodelreg.raster.environment import gdal_calls
from geodelreg.values.raster import Grid

if TYPE_CHECKING:
    from rasterio.crs import CRS
    from rasterio.io import DatasetReader

logger = logging.getLogger(__name__)

_COMMON_PIXELS = 100_000_000
# the equator in pixels of 0.4 m
_LARGEST_SIDE = 100_000_000
# the densest lossless codecs of TIFF do not reach this
_PIXELS_PER_BYTE = 20_000
# share of a pixel that map coordinates may be rounded by
_ROUNDED = 1e-3


def open_dataset(path: str, overview_level: int | None = None, allow: str = LOCAL) -> DatasetReader:
    """Open a raster file with GDAL and check that it holds real pixels.

    Parameters
    ----------
    path : str
    overview_level : int, optional
    allow : str
        What may be opened, `AlignOptions.allow`.

    Raises
    ------
    RasterNotFoundError, RasterUnreadableError, AccessNotAllowedError
    """
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    options: dict[str, Any] = {} if overview_level is None else {"overview_level": overview_level}
    try:
        entry = look_at(path, allow)
        with gdal_calls(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = open_entry(entry, **options)
    except (RasterioError, OSError, ValueError, SystemError) as error:
        raise _unreadable(path, error) from error
    try:
        _check_pixels(path, dataset)
        _check_size(path, dataset, entry.stored_bytes)
        with gdal_calls():
            overviews = dataset.tags(ns="OVERVIEWS").get("OVERVIEW_FILE", "")
        check_name(overviews, allow, f", named in {path},")
    except BaseException:
        dataset.close()
        raise
    return dataset


def _unreadable(path: str, error: Exception) -> RasterUnreadableError | RasterNotFoundError:
    reason = " ".join(str(error).split())
    if not is_local(path):
        return RasterUnreadableError(
            f"{path} cannot be opened ({reason})", "Check the address and the access to it."
        )
    if Path(path).is_dir():
        return RasterUnreadableError(
            f"{path} is a folder", "Name a raster file, or one file per band."
        )
    if Path(path).stat().st_size == 0:
        return RasterUnreadableError(f"{path} is empty", "Copy or download it again.")
    return RasterUnreadableError(
        f"{path} is not a raster that GDAL can open ({reason})",
        "Give a GeoTIFF or another raster format that gdalinfo reads.",
    )


def _check_pixels(path: str, dataset: DatasetReader) -> None:
    if dataset.count == 0 and dataset.subdatasets:
        listed = ", ".join(map(gdal_name, dataset.subdatasets[:4]))
        more = ", …" if len(dataset.subdatasets) > 4 else ""
        raise RasterUnreadableError(
            f"{path} is a container of {len(dataset.subdatasets)} rasters, not a raster",
            f"Name one of them: {listed}{more}.",
        )
    if dataset.count == 0 or dataset.width < 1 or dataset.height < 1:
        raise RasterUnreadableError(f"{path} holds no pixels", "Give a raster with image bands.")
    with gdal_calls():
        is_ycbcr = dataset.tags(ns="IMAGE_STRUCTURE").get("COMPRESSION") == "YCbCr JPEG"
    if is_ycbcr and dataset.driver == "GTiff" and dataset.count != 3:
        raise contradiction(path, dataset.count)  # `check_survivable` sees local files only
    for number, dtype in enumerate(dataset.dtypes, start=1):
        if dtype.startswith("complex"):
            raise RasterUnreadableError(
                f"band {number} of {path} holds complex numbers",
                "Write its amplitude to a new file first, for example with gdal_calc.py.",
            )


def _check_size(path: str, dataset: DatasetReader, stored_bytes: int | None) -> None:
    """Refuse sizes that are certainly wrong, before anything is allocated or read for them."""
    side, pixels = max(dataset.width, dataset.height), dataset.width * dataset.height
    absurd = side > _LARGEST_SIDE
    if pixels > _COMMON_PIXELS and dataset.driver in ("GTiff", "VRT") and stored_bytes is not None:
        absurd |= pixels > _PIXELS_PER_BYTE * stored_bytes
    if absurd:
        raise RasterUnreadableError(
            f"the header of {path} claims {dataset.width} × {dataset.height} pixels, more than "
            "the file can hold",
            "The file is damaged: copy or download it again.",
        )


def dataset_grid(path: str, dataset: DatasetReader) -> Grid:
    """Grid of an open raster.

    Raises
    ------
    MissingGeoreferenceError, UnsupportedGeoreferenceError, MissingCrsError, CrsTransformError
    """
    with gdal_calls(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        transform, crs = dataset.transform, dataset.crs
        gcps, gcp_crs = dataset.gcps
        rpcs = dataset.rpcs
    _check_transform(path, transform, bool(gcps), rpcs is not None)
    if not crs and gcp_crs:
        raise UnsupportedGeoreferenceError(
            f"{path} is placed twice: by a geotransform, and by ground control points that hide "
            f"its coordinate reference system; {Path(path).name}.aux.xml may hold them",
            "Remove the points: gdal_translate -nogcp FILE OUT.tif, or remove the GCPList there.",
        )
    if not crs:
        raise MissingCrsError(
            f"{path} has no coordinate reference system",
            "Assign the right one: gdal_edit.py -a_srs EPSG:… FILE (or rio edit-info --crs).",
        )
    wkt, unit = _wkt2(crs), _unit_m(crs)
    _check_crs(path, dataset)
    return Grid(transform, (dataset.height, dataset.width), wkt, unit)


def _check_transform(path: str, transform: Affine, has_gcps: bool, has_rpcs: bool) -> None:
    values = tuple(transform)[:6]
    if not all(math.isfinite(value) for value in values):
        raise UnsupportedGeoreferenceError(
            f"the geotransform of {path} is not finite: {values}",
            "Assign a valid one: gdal_edit.py -a_ullr ULX ULY LRX LRY FILE.",
        )
    if transform == Affine.identity():
        _raise_without_geotransform(path, has_gcps, has_rpcs)
    across = math.hypot(transform.a, transform.d)
    down = math.hypot(transform.b, transform.e)
    if abs(transform.determinant) <= 1e-9 * across * down or min(across, down) == 0:
        raise UnsupportedGeoreferenceError(
            f"the geotransform of {path} is degenerate: its pixels have no area {values}",
            "Assign a valid one: gdal_edit.py -a_ullr ULX ULY LRX LRY FILE.",
        )
    if max(abs(transform.c), abs(transform.f)) * sys.float_info.epsilon > _ROUNDED * min(
        across, down
    ):
        raise UnsupportedGeoreferenceError(
            f"the geotransform of {path} puts it so far away that pixels cannot be told apart: "
            f"{values}",
            "Assign a valid one: gdal_edit.py -a_ullr ULX ULY LRX LRY FILE.",
        )


def _raise_without_geotransform(path: str, has_gcps: bool, has_rpcs: bool) -> None:
    if has_gcps:
        raise UnsupportedGeoreferenceError(
            f"{path} is placed by ground control points only; there is no geotransform to correct",
            "Turn them into a geotransform first: gdalwarp FILE OUT.tif.",
        )
    if has_rpcs:
        raise UnsupportedGeoreferenceError(
            f"{path} is placed by RPCs only; there is no geotransform to correct",
            "Orthorectify it first: gdalwarp -rpc -to RPC_DEM=DEM.tif FILE OUT.tif.",
        )
    raise MissingGeoreferenceError(
        f"{path} has no geotransform",
        "Give it a rough one first: gdal_edit.py -a_ullr ULX ULY LRX LRY FILE, or a world file.",
    )


def _unit_m(crs: CRS) -> float | None:
    """Metres to a map unit of a projected CRS; None of others, and where GDAL cannot tell."""
    from rasterio.errors import CRSError

    with gdal_calls():
        try:
            return float(crs.linear_units_factor[1]) if crs.is_projected else None
        except CRSError:
            return None


def _check_crs(path: str, dataset: DatasetReader) -> None:
    """Refuse a CRS that PROJ failed on, for want of a grid for instance, when it was looked at."""
    from rasterio._err import CPLE_BaseError

    try:
        with gdal_calls():
            _ = dataset.colorinterp  # GDAL holds errors of that kind back until the next call
    except CPLE_BaseError as error:
        if not str(error).startswith("PROJ"):
            raise _unreadable(path, error) from error
        raise CrsTransformError(
            f"PROJ cannot use the coordinate reference system of {path}: {error}",
            "Install the grid that it names (projsync, or PROJ_DATA), or assign another CRS: "
            "gdal_edit.py -a_srs EPSG:… FILE.",
        ) from error


def _wkt2(crs: object) -> str:
    from rasterio.enums import WktVersion
    from rasterio.errors import CRSError

    with gdal_calls():
        try:
            return str(crs.to_wkt(version=WktVersion.WKT2_2019))  # type: ignore[attr-defined]
        except CRSError:
            logger.debug("no WKT2 form of the CRS; WKT1 is used", exc_info=True)
            return str(crs.to_wkt())  # type: ignore[attr-defined]
