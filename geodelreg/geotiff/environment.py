"""GDAL's settings while outputs are read and written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from geodelreg.errors import RasterUnreadableError

CACHE_BYTES = 64_000_000
"""GDAL's own default is 5 % of the RAM; writing block by block needs no more than this."""


@contextmanager
def gdal_session(source: Path, threads: int | None = None) -> Iterator[None]:
    """Bound GDAL's block cache, use all cores, keep masks inside TIFFs and write no statistics.

    Parameters
    ----------
    source : Path
    threads : int, optional
        Of GDAL's own; without it what the variable ``GDAL_NUM_THREADS`` says, or all cores.

    Raises
    ------
    RasterUnreadableError
        GDAL failed where nobody expected it: properties of a damaged `source` fail when asked for.
    """
    import rasterio
    from rasterio.env import get_gdal_config

    with rasterio.Env():
        cache = min(int(get_gdal_config("GDAL_CACHEMAX")), CACHE_BYTES)
    with rasterio.Env(
        GDAL_CACHEMAX=cache,
        GDAL_NUM_THREADS=threads or os.environ.get("GDAL_NUM_THREADS", "ALL_CPUS"),
        GDAL_TIFF_INTERNAL_MASK=True,
        GTIFF_IMPLICIT_JPEG_OVR=False,
    ):
        try:
            yield
        except gdal_failures() as error:
            raise RasterUnreadableError(
                f"{source} cannot be read by GDAL: {error}", "Obtain the file again, or repair it."
            ) from error


def thread_count() -> int:
    """Threads that pay: the processor's cores, or what ``GDAL_NUM_THREADS`` says."""
    asked = os.environ.get("GDAL_NUM_THREADS", "")
    return max(1, int(asked)) if asked.isdecimal() else os.cpu_count() or 1


def gdal_failures() -> tuple[type[Exception], ...]:
    """Exceptions that rasterio raises for GDAL's errors; the last when GDAL gives no reason."""
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError

    return (RasterioError, CPLE_BaseError, SystemError)
